"""Error of `tactile.phong` on real images of a ball that is pressed into a GelSight sensor.

    python -m benchmarks.presses    # about a minute. Writes benchmarks/results/presses/

The package `taxim` 1.4.1 (MIT) contains 48 images (480x640, 0.0295 mm per pixel) of a ball of radius 2 mm, the centre
and radius of each contact, and the image without contact (the background). `tactile.phong` is fitted to 36 of the
presses, and every fourth press is held out. An image is modelled by

    image = background (1 + phong(pressed) - phong(flat))

where `pressed` (a sphere within the contact) and `flat` are the normals and points of the skin. Non-negative least
squares selects lights from candidates in rings around the image. Gradient descent then fits the lights, the fall-off,
the specular reflectance and the shininess. The fitted lights need not be at the places of the sensor's LEDs. Ratios are
over the pixels of the held-out presses within 0.92 times the radius of the contact. Candidates, number of steps and
learning rate were chosen on the 36 presses alone.
"""

import dataclasses
import functools
import importlib.util
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from jaxtyping import Array, Float
from PIL import Image
from scipy.optimize import nnls

from experiments.shared import drawing
from sts_jax import tactile

PITCH = 0.0295e-3  # m per pixel (taxim/calib/gelsight/params.json)
RADIUS = 2e-3  # m, radius of the ball
TRUSTED = 0.92  # share of a contact's radius within which the normals of the sphere are used
EVERY = 4  # one of this many presses is held out: the fourth, the eighth, ...
STEPS = 1000  # steps of Adam
RATE = 0.1  # initial learning rate of Adam
OUT = Path(__file__).parent / "results" / "presses"


@dataclasses.dataclass(frozen=True)
class Presses:
    """Images of presses in [0, 1], the circle of contact in each, and the image without contact."""

    background: Float[np.ndarray, "h w 3"]
    images: Float[np.ndarray, "n h w 3"]
    centres: Float[np.ndarray, "n 2"]  # column and row of the centre of each contact (pixels)
    radii: Float[np.ndarray, "n"]  # radius of each contact (pixels)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Pixels:
    """Pixels of several images of a ball that is pressed into the sensor, in one list."""

    normals: Float[Array, "p 3"]  # unit normals of the skin, towards the camera
    points: Float[Array, "p 3"]  # points of the skin (m), with the origin in the middle of the image
    color: Float[Array, "p 3"]  # colour of the real image, [0, 1]
    background: Float[Array, "p 3"]  # colour of the image without contact, [0, 1]


def read() -> Presses:
    """Read the images and contacts from the installed package `taxim`, without importing it."""
    spec = importlib.util.find_spec("taxim")
    path = Path(spec.origin or "").parent / "calib" / "gelsight" / "dataPack.npz" if spec else None
    if path is None or not path.is_file():
        raise FileNotFoundError("the package taxim 1.4.1 is missing: pip install -e '.[bench]' -c constraints.txt")
    with np.load(path) as pack:
        background, images = (pack[name][..., ::-1] / np.float32(255) for name in ("f0", "imgs"))  # blue is first
        return Presses(background, images, pack["touch_center"], pack["touch_radius"].astype(np.float64))


def held_out(number: int) -> np.ndarray:
    """Mask of the held-out presses among `number` presses, bool `(number,)`."""
    return np.arange(number) % EVERY == EVERY - 1


def skin_under_ball(
    centre: Float[np.ndarray, "2"], radius: float, row: np.ndarray, column: np.ndarray, shape: tuple[int, int]
) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"]]:
    """Compute normals and points of the skin inside its contact with the ball, where the skin is a part of a sphere."""
    x, y = PITCH * (column - centre[0]), PITCH * (row - centre[1])
    under = np.sqrt(RADIUS**2 - x**2 - y**2)
    depth = under - np.sqrt(max(RADIUS**2 - (PITCH * radius) ** 2, 0))
    middle = (np.array(shape) - 1) / 2
    points = np.stack([PITCH * (column - middle[1]), PITCH * (row - middle[0]), -depth], axis=-1)
    return np.stack([x, y, -under], axis=-1) / RADIUS, points


def pixels(presses: Presses, which: np.ndarray, *, every: int = 1, within: float = TRUSTED) -> Pixels:
    """Collect pixels of the contact circles in several images of a ball that is pressed into the sensor."""
    shape, found = presses.background.shape[:2], []
    rows, columns = np.meshgrid(np.arange(0, shape[0], every), np.arange(0, shape[1], every), indexing="ij")
    for index in which:
        centre, radius = presses.centres[index], presses.radii[index]
        inside = np.hypot(columns - centre[0], rows - centre[1]) < within * radius
        row, column = rows[inside], columns[inside]
        normals, points = skin_under_ball(centre, radius, row, column, shape)
        found.append((normals, points, presses.images[index, row, column], presses.background[row, column]))
    return Pixels(*(jnp.asarray(np.concatenate(v), jnp.float32) for v in zip(*found, strict=True)))


def shader(unknowns: dict[str, Array], *, near: bool) -> tuple[tactile.Phong, tactile.Lights | tactile.Leds]:
    """Convert the unbounded unknowns of the optimisation to reflectance constants and lights within allowed ranges."""
    positive = {k: jax.nn.softplus(v) for k, v in unknowns.items()}
    place = jnp.concatenate([unknowns["place"][:, :2], -positive["place"][:, 2:]], axis=1)
    constants = tactile.Phong(specular=positive["specular"], shininess=positive["shininess"])
    if near:
        leds = tactile.Leds(
            positions=1e-3 * place, colors=positive["color"], falloff=positive["falloff"], reference=0.02
        )
        return constants, leds
    return constants, tactile.Lights(directions=place, colors=positive["color"])


def changes(constants: tactile.Phong, lights: tactile.Lights | tactile.Leds, given: Pixels) -> Float[Array, "m p"]:
    """Image of the pressed skin minus image of the flat skin, for each light alone. All lights are white."""
    flat = jnp.broadcast_to(jnp.array([[0.0, 0, -1]]), given.normals.shape)
    normals = jnp.stack([given.normals, flat])
    points = jnp.stack([given.points, given.points * jnp.array([[1.0, 1, 0]])])
    white = jnp.ones((1, 3))

    def change(place: Float[Array, "3"]) -> Float[Array, "p"]:
        light = (
            dataclasses.replace(lights, positions=place[None], colors=white)
            if isinstance(lights, tactile.Leds)
            else tactile.Lights(place[None], white)
        )
        both = tactile.phong(constants, light, normals, points)[..., 0]
        return both[0] - both[1]

    return jax.vmap(change)(lights.positions if isinstance(lights, tactile.Leds) else lights.directions)


@jax.jit
def draw(constants: tactile.Phong, lights: tactile.Lights | tactile.Leds, given: Pixels) -> Float[Array, "p 3"]:
    """Render colours of the pressed skin, `background (1 + phong(pressed) - phong(flat))`."""
    return given.background * (1 + changes(constants, lights, given).T @ lights.colors)


def psnr(image: Array, truth: Array) -> float:
    """Peak signal-to-noise ratio (dB) of values in [0, 1]."""
    return float(-10 * np.log10(np.mean((np.asarray(image, np.float64) - np.asarray(truth, np.float64)) ** 2)))


def _inverse(value: float | np.ndarray) -> Array:
    """Inverse of the softplus."""
    return jnp.log(jnp.expm1(jnp.asarray(value, jnp.float32)))


def start(given: Pixels, *, near: bool) -> dict[str, Array]:
    """Compute the lights and the reflectance from which the optimisation starts."""
    rings = [(r, t) for r in ((14, 20, 35) if near else (20,)) for t in (0.2, 0.5, 1.0, 2.0)]
    angles = 2 * np.pi * np.arange(12) / 12
    rows = [[r * np.cos(a + k), r * np.sin(a + k), _inverse(r * t)] for k, (r, t) in enumerate(rings) for a in angles]
    places = np.array(rows, np.float32)
    unknowns = {"falloff": _inverse(2.0), "specular": _inverse(0.1), "shininess": _inverse(3.0)}
    white = {"place": jnp.asarray(places), "color": jnp.ones((len(places), 3))}
    each = np.asarray(jax.jit(changes)(*shader(unknowns | white, near=near), given), np.float64).T
    background, color = (np.asarray(v, np.float64) for v in (given.background, given.color))
    found = [nnls(background[:, k, None] * each, color[:, k] - background[:, k])[0] for k in range(3)]
    colors = np.stack(found, axis=1)
    shines = np.any(colors > 0, axis=1)
    return unknowns | {"place": jnp.asarray(places[shines]), "color": _inverse(np.maximum(colors[shines], 1e-3))}


@functools.partial(jax.jit, static_argnames=("near", "steps"))
def refine(unknowns: dict[str, Array], given: Pixels, *, near: bool, steps: int) -> dict[str, Array]:
    """Fit the unknowns of `shader` to the colours of pixels."""
    optimiser = optax.adam(optax.cosine_decay_schedule(RATE, steps))

    def loss(unknowns: dict[str, Array]) -> Array:
        return jnp.mean((draw(*shader(unknowns, near=near), given) - given.color) ** 2)

    def step(_: Array, state: tuple[dict[str, Array], optax.OptState]) -> tuple[dict[str, Array], optax.OptState]:
        unknowns, moments = state
        updates, moments = optimiser.update(jax.grad(loss)(unknowns), moments)
        return optax.apply_updates(unknowns, updates), moments

    return jax.lax.fori_loop(0, steps, step, (unknowns, optimiser.init(unknowns)))[0]


def fit(given: Pixels, *, near: bool, steps: int = STEPS) -> tuple[tactile.Phong, tactile.Lights | tactile.Leds]:
    """Fit the constants of the reflectance and the lights to the colours of pixels in real tactile images."""
    return shader(refine(start(given, near=near), given, near=near, steps=steps), near=near)


def panel(presses: Presses, index: int, constants: tactile.Phong, leds: tactile.Leds, *, half: int = 90) -> np.ndarray:
    """Draw the real image, the rendered image and their difference around a contact, one below the other."""
    given = pixels(presses, np.array([index]), within=1.0)
    column, row = (int(v) for v in presses.centres[index])
    shape = presses.background.shape[:2]
    rows, columns = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    inside = np.hypot(columns - presses.centres[index, 0], rows - presses.centres[index, 1]) < presses.radii[index]
    ours = presses.background.copy()
    ours[inside] = np.clip(draw(constants, leds, given), 0, 1)
    real = presses.images[index]
    parts = [
        np.pad(v, ((half, half), (half, half), (0, 0))) for v in (real, ours, np.clip(0.5 + 4 * (real - ours), 0, 1))
    ]
    return np.concatenate([v[row : row + 2 * half, column : column + 2 * half] for v in parts])


def main() -> None:
    """Fit the lights, print the peak signal-to-noise ratios, and write `presses.png`."""
    presses = read()
    held = held_out(len(presses.images))
    train, test = pixels(presses, np.flatnonzero(~held), every=8), pixels(presses, np.flatnonzero(held))
    print(f"fitted: {np.sum(~held)} presses, {len(train.color)} pixels; held out: {np.sum(held)}, {len(test.color)}")
    print(f"background alone: held out {psnr(test.background, test.color):.1f} dB")
    for name, near in (("far lights", False), ("near lights", True)):
        began = time.perf_counter()
        constants, lights = fit(train, near=near)
        fitted, unseen = (psnr(draw(constants, lights, part), part.color) for part in (train, test))
        seconds = time.perf_counter() - began
        print(f"{len(lights.colors)} {name}: fitted {fitted:.1f} dB, held out {unseen:.1f} dB ({seconds:.0f} s)")
    assert isinstance(lights, tactile.Leds)
    x, y, z = 1e3 * np.abs(np.asarray(lights.positions)).T
    across, down = 1e3 * PITCH * np.array(presses.background.shape[1::-1]) / 2
    print(
        f"near: {np.sum((x < across) & (y < down))} under the picture, {z.min():.1f} to {z.max():.0f} mm below the gel"
    )
    print(f"fall-off {lights.falloff:.2f}, specular {constants.specular:.3f}, shininess {constants.shininess:.2f}")
    strip = np.concatenate([panel(presses, int(index), constants, lights) for index in np.flatnonzero(held)], axis=1)
    drawing.write_picture(OUT / "presses.png", Image.fromarray(np.round(255 * strip).astype(np.uint8)))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
