"""Render an object on the sensor, and draw all outputs in one picture. Try this command first.

    python -m experiments.sense bottle --out bottle.png     # one of the eight classes
    python -m experiments.sense mug.obj --longest-side 0.1 --mass 0.3 --resolution 1232 1640
    python -m experiments.sense classes --out classes.png --resolution 1232 1640    # all eight, about a minute

By default, the object is at rest under its own weight. The picture shows six images: the visual image, an image with
the LEDs at half power, the tactile image, depth, segmentation and pressure. With `classes`, the picture shows only the
first three images of each object. The command prints the size of the object, the face on which it rests, and how deep
it sinks into the gel.
"""

import functools
import time

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib import colormaps
from PIL import Image, ImageDraw, ImageFont

import sts_jax as sts
from experiments.shared import drawing, terminal
from experiments.shared.laying import Config, check, lay, read
from sts_jax import tactile

HEAD = 22  # height of the caption above a panel (pixels)
SHEET = (234, 312)  # (height, width) of one image in the picture of all classes (pixels)
NARROWEST = 160  # smallest width of a panel (pixels). Smaller images are magnified


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
    """Place and render the object: all outputs, the image with dimmed LEDs, and a text about pose, imprint and time."""
    pose, wrench, words = lay(config, sensor, body)
    given = sensor, body, jnp.asarray(pose, jnp.float32), jnp.asarray(wrench, jnp.float32)
    seconds = []
    for _ in range(2):
        start = time.perf_counter()
        seen = see(*given, resolution=config.resolution, crop=config.crop, light=config.light)
        frame, between = jax.block_until_ready(seen)
        seconds.append(time.perf_counter() - start)
    deepest = float(jnp.max(frame.pressure) / sensor.gel.stiffness)
    area = float(jnp.sum(frame.pressure > 0) * tactile.cell_area(sensor.gel))
    balanced = "balanced" if frame.balanced else "NOT balanced: the gel's limits leave part of the wrench uncarried"
    lines = [
        f"on {words}",
        f"deepest imprint {1e3 * deepest:.2f} mm, contact area {1e6 * area:.0f} mm2, {balanced}",
        f"{seconds[1]:.3g} s a frame of {config.resolution[1]} x {config.resolution[0]} ({seconds[0]:.1f} s the first)",
    ]
    return frame, np.asarray(between), "\n".join(lines)


def panels(frame: sts.Frame, between: np.ndarray, light: float) -> list[tuple[str, np.ndarray]]:
    """The captions and images in [0, 1] of a frame, and of the image with the LEDs at `light` times full power."""
    seen = np.asarray(frame.segmentation)
    depth = np.where(seen, np.asarray(frame.depth), np.nan)
    near, far = (np.nanmin(depth), np.nanmax(depth)) if seen.any() else (0.0, 1.0)
    shade = np.nan_to_num((far - depth) / max(far - near, 1e-9), nan=-0.25) * 0.8 + 0.2
    pressure = np.asarray(frame.pressure)
    most = max(float(pressure.max()), 1e-9)
    span = f"{1e3 * near:.1f} to {1e3 * far:.1f} mm" if seen.any() else "nothing is seen"
    return [
        ("visual", np.asarray(frame.visual)),
        (f"light {light:g}", between),
        ("tactile", np.asarray(frame.tactile)),
        (f"depth: {span}", np.repeat(shade[..., None], 3, -1)),
        (f"segmentation: {seen.mean():.1%}", np.repeat(seen[..., None].astype(float), 3, -1)),
        (f"pressure: at most {pressure.max() / 1e3:.2f} kPa", colormaps["magma"](pressure / most)[..., :3]),
    ]


def compose(pictures: list[tuple[str, np.ndarray]], columns: int) -> Image.Image:
    """Arrange captions and images in rows of `columns`, all scaled to fit the size of the first image."""
    height, width = pictures[0][1].shape[:2]
    times = -(-NARROWEST // width)
    height, width = height * times, width * times
    rows = -(-len(pictures) // columns)
    sheet = Image.new("RGB", (columns * (width + 4), rows * (height + HEAD)), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=13)
    for index, (line, image) in enumerate(pictures):
        x, y = index % columns * (width + 4), index // columns * (height + HEAD)
        pen.text((x + 3, y + 3), line, fill="black", font=font)
        panel = Image.fromarray(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8))
        fit = min(width / panel.width, height / panel.height)
        panel = panel.resize((round(panel.width * fit), round(panel.height * fit)), Image.Resampling.NEAREST)
        sheet.paste(panel, (x + (width - panel.width) // 2, y + HEAD))
    return sheet


def main(config: Config) -> None:
    """Make the object, place it on the pad, render it, print a description, and draw the outputs."""
    check(config)
    sensor = sts.Sensor() if config.sensor is None else sts.Sensor.load(config.sensor)
    names = sts.objects.CATEGORIES if config.mesh == "classes" else (config.mesh,)
    sheet = []
    for name in names:
        body = read(config, name)
        frame, between, lines = look(config, sensor, body)
        size, faces = sts.objects.facts(body, (0.0, 0.0))[:2]
        print(f"{name}: {size} mm, {faces}\n{lines}", flush=True)
        pictures = panels(frame, between, config.light)
        if len(names) == 1:
            drawing.write_picture(config.out, compose(pictures, 3))
        else:
            small = SHEET[0] / config.resolution[0]
            for stream, values in pictures[:3]:
                image = Image.fromarray(np.round(255 * values).astype(np.uint8))
                image = image.resize((round(image.width * small), SHEET[0]), Image.Resampling.BOX)
                sheet.append((f"{name}, {stream}", np.asarray(image) / 255))
    if sheet:
        drawing.write_picture(config.out, compose(sheet, 6))
    print(config.out)


if __name__ == "__main__":
    sts.enable_compilation_cache()
    with terminal.on_one_line():
        main(tyro.cli(Config, description=__doc__))
