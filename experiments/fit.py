"""Fit the pose of an object on the sensor to a tactile image, with the derivatives of the renderer.

    python -m experiments.fit scissors --out fit.png     # a minute or two
    python -m experiments.fit mug.obj --longest-side 0.1 --mass 0.3 --sensor soft.json

The first argument is an object class or a mesh file, as in experiments.sense. The target is one 8-bit tactile image of
the object at rest under its weight. The object, the face on which it rests and its weight are known. The command fits
x, y and yaw ten times. Each fit starts 3 mm and 10 degrees away from the true pose. The number of fits that end within
0.2 mm and 1 degree is ten for scissors, fork and mouse, and eight for scissors with `--seed 1`. To fit your own image,
call `descend` with a function that calls `slope` with your image as `target`.
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib.figure import Figure

import sts_jax as sts
from experiments.shared import drawing, laying
from experiments.shared.terminal import check_numbers, on_one_line
from sts_jax import tactile

# Standard deviations of the Gaussian blur that is applied to images before they are compared (m). The first one is
# about the distance by which the tips of a 12 cm long object move in a turn of 10 degrees.
BLURS = (0.012, 0.006, 0.003, 0.0015)
STEPS = 10  # largest number of steps with each blur
SETTLED = (1e-5, 1e-5, 1e-3)  # step in x (m), y (m) and yaw (rad) below which the fit continues with the next blur
OFF = (0.003, 10.0)  # error of the initial pose of a fit: distance (m) and yaw (degrees)
GOAL = (0.0002, 1.0)  # largest error of a successful fit: distance (m) and yaw (degrees)
SEEN = 0.02  # smallest change of a pixel's value by touch that counts as an imprint


@dataclasses.dataclass(frozen=True)
class Config(laying.Placed):
    """Options of the command line: the object, its true pose, and the number of fits."""

    out: Path = Path("fit.png")  # path of the picture
    resolution: tuple[int, int] = (240, 240)  # height and width of the image (pixels)
    position: tuple[float, float] = (0.0073, -0.0041)  # true x and y of the centre of the object's bounding box (m)
    turn: float = 23.7  # true turn of the object about the vertical axis (degrees)
    starts: int = 10  # number of fits, each from another initial pose


class Slope(NamedTuple):
    """The loss of an image, with the gradient and the Gauss-Newton matrix of half the loss in (x, y, yaw).

    r are the n pixel values of the blurred difference between image and target, and J = dr / d(x, y, yaw).
    """

    image: jax.Array  # tactile image, shape (h, w, 3)
    loss: jax.Array  # r^T r / n, shape ()
    gradient: jax.Array  # J^T r / n, shape (3,)
    curvature: jax.Array  # J^T J / n, shape (3, 3)


@functools.partial(jax.jit, static_argnames="resolution")
def touch(
    sensor: sts.Sensor, body: sts.objects.Body, pose: jax.Array, wrench: jax.Array, *, resolution: tuple[int, int]
) -> jax.Array:
    """Render the tactile image, shape (height, width, 3) in [0, 1], rounded to eight bits as a camera does."""
    return jnp.round(255 * sts.sense(sensor, body, pose, wrench, resolution=resolution).tactile) / 255


def moved(pose: jax.Array, at: jax.Array) -> jax.Array:
    """Shift a pose by (x, y) (m), and turn it by yaw (rad) about the vertical axis through the object's origin."""
    cos, sin = jnp.cos(at[2] / 2), jnp.sin(at[2] / 2)
    w, x, y, z = pose[3:]
    turn = jnp.stack([cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w])
    return jnp.concatenate([pose[:2] + at[:2], pose[2:3], turn])


def carried(wrench: jax.Array, pose: jax.Array, at: jax.Array) -> jax.Array:
    """The wrench (6,) after the pose is `moved`: the force is vertical, and acts at the same point of the object."""
    force = wrench[2]
    x, y = -wrench[4] / force - pose[0], wrench[3] / force - pose[1]
    cos, sin = jnp.cos(at[2]), jnp.sin(at[2])
    x, y = pose[0] + at[0] + cos * x - sin * y, pose[1] + at[1] + sin * x + cos * y
    return jnp.stack([jnp.zeros(()), jnp.zeros(()), force, y * force, -x * force, jnp.zeros(())])


@functools.partial(jax.jit, static_argnames="resolution")
def slope(
    sensor: sts.Sensor,
    body: sts.objects.Body,
    pose: jax.Array,
    wrench: jax.Array,
    at: jax.Array,
    target: jax.Array,
    blur: float,
    *,
    resolution: tuple[int, int],
) -> Slope:
    """The loss of the moved object's image, and its derivatives.

    The depth and the tilt of the moved object balance the forces in the gel. The derivatives treat them as constant,
    because the pad has the same properties at every position. `pose` (7,) and `wrench` (6,) are those before the move,
    `at` (3,) is the shift (m) and turn (rad), and `blur` is the standard deviation of a Gaussian (m).
    """
    frame = sts.sense(sensor, body, moved(pose, at), carried(wrench, pose, at), resolution=resolution)
    pitch = frame.window[2:] / jnp.array([resolution[1], resolution[0]])

    def residual(step: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        image = sts.sense(sensor, body, moved(frame.pose, step), resolution=resolution, moving_edges=True).tactile
        channels = [tactile.couple((image - target)[..., k], blur, pitch) for k in range(3)]
        return jnp.stack(channels), (jnp.stack(channels), image)

    jacobian, (r, image) = jax.jacfwd(residual, has_aux=True)(jnp.zeros(3))
    jacobian, r = jacobian.reshape(-1, 3), r.reshape(-1)
    return Slope(image, jnp.mean(r * r), r @ jacobian / r.size, jacobian.T @ jacobian / r.size)


def descend(look: Callable[[np.ndarray, float], Slope], start: np.ndarray) -> list[tuple[np.ndarray, Slope]]:
    """Minimise the loss by Levenberg-Marquardt steps, first with the strongest blur and last with the weakest.

    `look` maps (x, y, yaw) and the blur (m) to the loss and its derivatives, as `slope` does. Returns the accepted
    points with the results of `look`. The last point of a blur is the first of the next.
    """
    path, at = [], start
    for blur in BLURS:
        here, damping = look(at, blur), 1e-3
        path.append((at, here))
        for _ in range(STEPS):
            curvature = np.asarray(here.curvature, float)
            matrix = curvature + np.diag(damping * np.diag(curvature) + 1e-12)
            step = -np.linalg.solve(matrix, np.asarray(here.gradient, float))
            there = look(at + step, blur)
            if there.loss < here.loss:
                at, here, damping = at + step, there, damping / 5
                path.append((at, here))
            else:
                damping *= 10
            if np.all(np.abs(step) < SETTLED):
                break
    return path


def errors(at: np.ndarray) -> tuple[float, float]:
    """Convert the errors of x (m), y (m) and yaw (rad) to a distance (mm) and an angle (degrees)."""
    return 1e3 * float(np.hypot(at[0], at[1])), float((np.rad2deg(at[2]) + 180) % 360 - 180)


def draw(config: Config, target: np.ndarray, paths: list[list[tuple[np.ndarray, Slope]]]) -> None:
    """Draw the target, the images at the start and at the end of the first fit, and the paths of all fits."""
    first, last = paths[0][0], paths[0][-1]
    touched = np.abs(np.stack([target, first[1].image]) - np.median(target, axis=(0, 1))).max(axis=(0, -1)) > SEEN
    rows, columns = (np.flatnonzero(touched.any(axis)) for axis in (1, 0))
    part = slice(max(rows[0] - 5, 0), rows[-1] + 6), slice(max(columns[0] - 5, 0), columns[-1] + 6)

    figure = Figure(figsize=(13, 8), layout="constrained")
    axes = figure.subplots(2, 3).ravel()
    panels: list[tuple[str, np.ndarray | jax.Array]] = [("target", target)]
    for name, (at, there) in (("start", first), ("end", last)):
        panels.append(("{}, {:.3f} mm, {:+.2f} degrees off".format(name, *errors(at)), there.image))
        panels.append((f"{name} less target", 0.5 + (there.image - target) / 2))
    for axis, (title, image) in zip(axes, panels, strict=False):
        axis.imshow(np.clip(np.asarray(image), 0, 1)[part], interpolation="nearest")
        axis.set_title(title)
        axis.set_axis_off()
    for path in paths:
        ways, turns = 1e3 * np.stack([at for at, _ in path]), [abs(errors(at)[1]) for at, _ in path]
        axes[5].plot(ways[:, 0], ways[:, 1], "-", color="0.8", zorder=1)
        points = axes[5].scatter(ways[:, 0], ways[:, 1], c=turns, s=14, vmin=0, vmax=OFF[1], cmap="viridis")
    figure.colorbar(points, ax=axes[5], label="yaw off by (degrees)")
    axes[5].set(xlabel="x off by (mm)", ylabel="y off by (mm)", aspect="equal")
    drawing.write_figure(config.out, figure, dpi=100)


def main(config: Config) -> None:
    """Render a tactile image of the object on the pad, fit the pose to it several times, and draw the result."""
    laying.check(config)
    check_numbers(config, starts=(1, 1000))
    if config.force == 0:
        raise ValueError("--force is 0, but it must be > 0 (N), so that the object leaves an imprint")
    sensor = sts.Sensor() if config.sensor is None else sts.Sensor.load(config.sensor)
    body = laying.read(config, sensor, config.mesh)
    pose, wrench, words = laying.lay(config, sensor, body)
    given = jnp.asarray(pose, jnp.float32), jnp.asarray(wrench, jnp.float32)
    target = touch(sensor, body, *given, resolution=config.resolution)
    empty = touch(sensor, body, given[0].at[2].set(-1), given[1], resolution=config.resolution)
    if np.abs(target - empty).max() < SEEN:
        raise ValueError(f"{config.mesh} leaves no imprint in view: increase --force, or change --position")
    print(f"{config.mesh} on {words}", flush=True)

    def look(at: np.ndarray, blur: float) -> Slope:
        shift = jnp.asarray(at, jnp.float32)
        return slope(sensor, body, *given, shift, target, blur, resolution=config.resolution)

    random = np.random.default_rng(config.seed)
    paths, successes = [], 0
    for number in range(config.starts):
        way, sign = random.uniform(0, 2 * np.pi), random.choice([-1, 1])
        start = np.array([OFF[0] * np.cos(way), OFF[0] * np.sin(way), sign * np.deg2rad(OFF[1])])
        path = descend(look, start)
        paths.append(path)
        (far, turned), loss = errors(path[-1][0]), float(path[-1][1].loss)
        successes += far <= 1e3 * GOAL[0] and abs(turned) <= GOAL[1]
        print(
            f"start {number}: {1e3 * start[0]:+.2f}, {1e3 * start[1]:+.2f} mm, {sign * OFF[1]:+.0f} degrees off; end: "
            f"{far:.3f} mm, {turned:+.2f} degrees off, loss {loss:.1e}",
            flush=True,
        )
    print(f"{successes} of {config.starts} within {1e3 * GOAL[0]:g} mm and {GOAL[1]:g} degree")
    draw(config, np.asarray(target), paths)
    print(config.out)


if __name__ == "__main__":
    sts.enable_compilation_cache()
    with on_one_line():
        main(tyro.cli(Config, description=__doc__))
