"""Render an object on the sensor, and draw all outputs in one picture. Try this command first.

    python -m experiments.sense bottle --out bottle.png     # one of the eight classes
    python -m experiments.sense mug.obj --longest-side 0.1 --mass 0.3 --resolution 1232 1640
    python -m experiments.sense classes --out classes.png --resolution 1232 1640    # all eight, about a minute

By default, the object is at rest under its own weight. The picture shows six images: the visual image, an image with
the LEDs at half power, the tactile image, depth, segmentation and pressure. With `classes`, the picture shows only the
first three images of each object. The command prints the size of the object, the face on which it rests, and how deep
it sinks into the gel.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

import sts_jax as sts
from experiments.shared import drawing, terminal
from sts_jax import tactile

G = 9.81  # gravity (m/s^2)
FILL = 0.5  # share of a container's interior that is filled


@dataclasses.dataclass(frozen=True)
class Placed:
    """Options of the command line: the object, its pose, its mass, the force of the pad on it, and the picture."""

    # path of a mesh file, name of an object class such as bottle, or `classes` for one object of each class
    mesh: Annotated[str, tyro.conf.Positional]
    out: Path = Path("sense.png")  # path of the picture
    sensor: Path | None = None  # file with the sensor's constants, written by Sensor.save. None: the paper's sensor
    resolution: tuple[int, int] = (480, 640)  # height and width of the images (pixels)

    rest: int = 0  # index of the face on which the object rests. 0 is the most likely one
    position: tuple[float, float] = (0.0, 0.0)  # x and y of the centre of the object's bounding box (m)
    height: float = 0.0  # height of the object's lowest point above the gel (m)
    turn: float = 0.0  # turn of the object about the vertical (degrees)
    tilt: tuple[float, float] = (0.0, 0.0)  # tilt of the object away from rest, about x and about y (degrees)

    mass: float | None = None  # mass of the object (kg). None: that of a shell half full of water
    # force of the pad on the object, upwards through its centre of mass (N). None: its weight, or 0 in the air
    force: float | None = None

    longest_side: float | None = None  # scale a mesh file so that its longest side has this length (m)
    scale: float | None = None  # length of one unit of a mesh file (m), such as 0.001 for millimetres
    up: Literal["x", "y", "z"] | None = None  # axis of a mesh file that points up. None: y for glTF, otherwise z
    faces: int | None = None  # reduce a mesh file with more faces to this number
    texture: Path | None = None  # image file to use as the texture of a mesh file
    seed: int = 0  # seed that selects the object of a class


@dataclasses.dataclass(frozen=True)
class Config(Placed):
    """Options of the command line, with those of the images."""

    crop: bool = False  # show only a window around the object, in the image's aspect ratio
    # brightness of the LEDs in the image between the visual and the tactile one, as a share of full power, 0 to 1
    light: float = 0.5


def check(config: Placed) -> None:
    """Check the options before any work."""
    if config.mass is not None and config.mass <= 0:
        raise ValueError(f"--mass is {config.mass}, but it must be > 0 (kg)")
    if config.force is not None and config.force < 0:
        raise ValueError(f"--force is {config.force}, but it must be >= 0 (N)")
    drawing.check_picture(config.out)


def read(config: Placed, name: str) -> sts.objects.Body:
    """Load the object from a mesh file, or make one of an object class such as `bottle`."""
    if name not in sts.objects.CATEGORIES:
        path = Path(name)
        if not path.exists() and not path.suffix:
            classes = ", ".join(sts.objects.CATEGORIES)
            raise FileNotFoundError(
                f"{name} is neither a file nor an object class ({classes}): give the path of a mesh file, or a class"
            )
        return sts.objects.load(
            path,
            longest_side=config.longest_side,
            scale=config.scale,
            mass=config.mass,
            up=config.up or ("y" if path.suffix.lower() in (".glb", ".gltf") else "z"),
            texture=config.texture,
            faces=config.faces,
        )
    for option in ("longest_side", "scale", "up", "faces", "texture"):
        if getattr(config, option) is not None:
            raise ValueError(
                f"--{option.replace('_', '-')} is for mesh files, but {name} is an object class: leave out this option"
            )
    index = sts.objects.CATEGORIES.index(name)
    body = sts.objects.make(jax.random.fold_in(jax.random.key(config.seed), index), name)
    if config.mass is None:
        return body
    return dataclasses.replace(
        body, shell_mass=jnp.float32(config.mass), contents_density=jnp.zeros_like(body.contents_density)
    )


def lay(config: Placed, sensor: sts.Sensor, body: sts.objects.Body) -> tuple[np.ndarray, np.ndarray, str]:
    """Place the object at rest, then tilt, turn and move it: its pose (7,), the wrench (6,) and a description."""
    shares = sts.physics.stable_faces(body, fill=FILL).share
    if not 0 <= config.rest < len(shares):
        raise ValueError(f"--rest is {config.rest}, but it must be the index of a face, from 0 to {len(shares) - 1}")
    rest = sts.physics.place(body, sensor, face=config.rest, fill=FILL)
    turn = Rotation.from_quat(np.asarray(rest.pose[3:], float), scalar_first=True)
    turn = Rotation.from_rotvec([*config.tilt, 0], degrees=True) * turn
    turn = Rotation.from_rotvec([0, 0, config.turn], degrees=True) * turn
    turned = turn.apply(np.asarray(body.vertices, float))
    low, high = turned.min(0), turned.max(0)
    place = np.array([*config.position, config.height]) - np.array([*(low + high)[:2] / 2, low[2]])
    pose = np.concatenate([place, turn.as_quat(canonical=True, scalar_first=True)])
    carries = np.asarray(sts.physics.weight(body, pose.astype(np.float32), fill=FILL), float)
    force = config.force if config.force is not None else carries[2] * (config.height <= 0)
    wrench = force / carries[2] * carries
    mass = float(carries[2]) / G
    face = f"face {config.rest} of the {len(shares)} that it can rest on (share {shares[config.rest]:.2f})"
    if any(config.tilt):
        face += ", tilted by {:g} and {:g} degrees".format(*config.tilt)
    where = f"{1e3 * config.height:.1f} mm over the gel" if config.height > 0 else f"pressed by {force:.3g} N"
    return pose, wrench, f"{face}; {mass:.3g} kg, {where}"


@functools.partial(jax.jit, static_argnames=("resolution", "crop", "light"))
def see(
    sensor: sts.Sensor,
    body: sts.objects.Body,
    pose: jax.Array,
    wrench: jax.Array,
    *,
    resolution: tuple[int, int],
    crop: bool,
    light: float,
) -> tuple[sts.Frame, jax.Array]:
    """Render all outputs of the sensor (`sts.Frame`), and an image with the LEDs at `light` times full power."""
    frame = sts.sense(sensor, body, pose, wrench, resolution=resolution, crop=crop)
    return frame, sts.expose(sensor, frame, light)


def look(config: Config, sensor: sts.Sensor, body: sts.objects.Body) -> tuple[sts.Frame, np.ndarray, str]:
    """Place and render the object: all outputs, the image with dimmed LEDs, and a text about pose and imprint."""
    pose, wrench, words = lay(config, sensor, body)
    given = sensor, body, jnp.asarray(pose, jnp.float32), jnp.asarray(wrench, jnp.float32)
    frame, between = see(*given, resolution=config.resolution, crop=config.crop, light=config.light)
    deepest = float(jnp.max(frame.pressure) / sensor.gel.stiffness)
    area = float(jnp.sum(frame.pressure > 0) * tactile.cell_area(sensor.gel))
    balanced = "balanced" if frame.balanced else "NOT balanced: the gel's limits leave part of the wrench uncarried"
    imprint = f"deepest imprint {1e3 * deepest:.2f} mm, contact area {1e6 * area:.0f} mm2, {balanced}"
    return frame, np.asarray(between), f"on {words}\n{imprint}"


def panels(frame: sts.Frame, between: np.ndarray, light: float) -> list[tuple[str, np.ndarray]]:
    """The titles and images of a frame, and of the image with the LEDs at `light` times full power."""
    seen = np.asarray(frame.segmentation)
    return [
        ("visual", np.asarray(frame.visual)),
        (f"light {light:g}", between),
        ("tactile", np.asarray(frame.tactile)),
        ("depth (mm)", np.where(seen, 1e3 * np.asarray(frame.depth), np.nan)),
        (f"segmentation: {seen.mean():.1%}", seen),
        ("pressure (kPa)", np.asarray(frame.pressure) / 1e3),
    ]


def draw(path: Path, pictures: list[tuple[str, np.ndarray]], columns: int) -> None:
    """Draw images with titles in rows of `columns`. An image of one number per pixel has a colour bar."""
    rows = -(-len(pictures) // columns)
    figure = Figure(figsize=(3.4 * columns, 2.8 * rows), layout="constrained")
    for axis, (title, image) in zip(figure.subplots(rows, columns).ravel(), pictures, strict=True):
        shown = axis.imshow(image, cmap="magma", interpolation="none")
        if image.ndim == 2 and image.dtype != bool:
            figure.colorbar(shown, ax=axis, shrink=0.8)
        axis.set_title(title, fontsize=9)
        axis.set_axis_off()
    drawing.write_figure(path, figure, dpi=100)


def main(config: Config) -> None:
    """Make the object, place it on the pad, render it, print a description, and draw the outputs."""
    check(config)
    sensor = sts.Sensor() if config.sensor is None else sts.Sensor.load(config.sensor)
    names = sts.objects.CATEGORIES if config.mesh == "classes" else (config.mesh,)
    pictures = []
    for name in names:
        body = read(config, name)
        frame, between, lines = look(config, sensor, body)
        size, faces = sts.objects.facts(body, (0.0, 0.0))[:2]
        print(f"{name}: {size} mm, {faces}\n{lines}", flush=True)
        images = panels(frame, between, config.light)
        pictures += images if len(names) == 1 else [(f"{name}, {stream}", image) for stream, image in images[:3]]
    draw(config.out, pictures, 3 if len(names) == 1 else 6)
    print(config.out)


if __name__ == "__main__":
    sts.enable_compilation_cache()
    with terminal.on_one_line():
        main(tyro.cli(Config, description=__doc__))
