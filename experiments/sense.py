"""Render an object on the sensor, and draw all outputs in one picture. Try this command first.

    python -m experiments.sense bottle --out bottle.png     # one of the eight classes
    python -m experiments.sense mug.obj --longest-side 0.1 --mass 0.3 --resolution 1232 1640
    python -m experiments.sense classes --out classes.png --resolution 1232 1640    # all eight, about a minute
    python -m experiments.sense bottle --markers 0.006 --crop --force 3 --out markers.png    # dots in the skin, sheared

By default, the object is at rest under its own weight. The picture shows six images: the visual image, an image with
the LEDs at half power, the tactile image, depth, segmentation and pressure. With `classes`, the picture shows only the
first three images of each object. With `--markers`, the skin has dots, and the picture shows them without tangential
load, sheared and twisted. The command prints the size of the object, the face on which it rests, and how deep it sinks
into the gel.
"""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib.figure import Figure

import sts_jax as sts
from experiments.shared import drawing, terminal
from experiments.shared.laying import Placed, check, lay, read
from sts_jax import tactile

RADIUS = 0.15  # radius of a dot, as a share of the dots' distance
SHARE = 0.8  # tangential loads with `--markers`, as a share of what friction carries


@dataclasses.dataclass(frozen=True)
class Config(Placed):
    """Options of the command line, with those of the images."""

    crop: bool = False  # show only a window around the object, in the image's aspect ratio
    # brightness of the LEDs in the image between the visual and the tactile one, as a share of full power, 0 to 1
    light: float = 0.5
    # print dots in the skin at this distance from each other (m), and show them without tangential load, with a force
    # to the right, and with a moment about the vertical
    markers: float | None = None


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


def sheared(config: Config, sensor: sts.Sensor, body: sts.objects.Body) -> tuple[list[tuple[str, np.ndarray]], str]:
    """Images of a skin with dots under three wrenches, in rows of three, and a text about the loads."""
    assert config.markers is not None
    markers = tactile.Markers(pitch=config.markers, radius=RADIUS * config.markers)
    sensor = dataclasses.replace(sensor, markers=markers)
    pose, wrench, _ = lay(config, sensor, body)
    given = sensor, body, jnp.asarray(pose, jnp.float32)
    draw = functools.partial(see, resolution=config.resolution, crop=config.crop, light=config.light)
    pressure = np.asarray(draw(*given, jnp.asarray(wrench, jnp.float32))[0].pressure, float)
    carried = markers.friction * pressure * float(tactile.cell_area(sensor.gel))  # by friction, in each cell (N)
    if not carried.any():
        raise ValueError(f"--markers needs a contact, but the force is {wrench[2]:g} N: give a larger --force")
    x, y = (np.asarray(part, float) for part in tactile.cell_centres(sensor.gel))
    force, centre = SHARE * carried.sum(), [(carried * part).sum() / carried.sum() for part in (x, y)]
    moment = SHARE * (carried * np.hypot(x - centre[0], y - centre[1])).sum()
    loads = {
        f"{wrench[2]:.3g} N down": [0.0] * 6,
        f"and {force:.3g} N to the right": [-force, 0, 0, 0, 0, force * centre[1]],  # the pad pushes to the left
        f"and {moment:.3g} N m about the vertical": [0, 0, 0, 0, 0, -moment],
    }
    frames = [draw(*given, jnp.asarray(wrench + np.array(load), jnp.float32))[0] for load in loads.values()]
    shifts = [1e3 * np.linalg.norm(np.asarray(frame.shear), axis=-1) for frame in frames]
    pictures = [(title, np.asarray(frame.tactile)) for title, frame in zip(loads, frames, strict=True)]
    pictures += [("visual", np.asarray(frame.visual)) for frame in frames]
    pictures += [("pressure (kPa)", pressure / 1e3), *(("displacement (mm)", shift) for shift in shifts[1:])]
    balanced = "balanced" if all(frame.balanced for frame in frames) else "NOT balanced"
    return pictures, f"{', '.join(loads)}: the skin moves by up to {max(map(np.max, shifts)):.2f} mm, {balanced}"


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
        body = read(config, sensor, name)
        frame, between, lines = look(config, sensor, body)
        size, faces = sts.objects.facts(body, (0.0, 0.0))[:2]
        print(f"{name}: {size} mm, {faces}\n{lines}", flush=True)
        images = panels(frame, between, config.light)
        if config.markers is not None:
            images, lines = sheared(config, sensor, body)
            print(lines, flush=True)
        pictures += images if len(names) == 1 else [(f"{name}, {stream}", image) for stream, image in images[:3]]
    draw(config.out, pictures, 3 if len(names) == 1 else 6)
    print(config.out)


if __name__ == "__main__":
    sts.enable_compilation_cache()
    with terminal.on_one_line():
        main(tyro.cli(Config, description=__doc__))
