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

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib.figure import Figure

import sts_jax as sts
from experiments.shared import drawing, terminal
from experiments.shared.laying import Placed, check, lay, read
from sts_jax import tactile


@dataclasses.dataclass(frozen=True)
class Config(Placed):
    """Options of the command line, with those of the images."""

    crop: bool = False  # show only a window around the object, in the image's aspect ratio
    # brightness of the LEDs in the image between the visual and the tactile one, as a share of full power, 0 to 1
    light: float = 0.5


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
        body = read(config, sensor, name)
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
