"""Render one object on the sensor, with all outputs in one picture. Try this first.

    python -m experiments.sense bottle --out bottle.png     # one of the eight classes, 20 s (5 s the next time)
    python -m experiments.sense mug.obj --longest-side 0.1 --mass 0.3 --resolution 1232 1640
    python -m experiments.sense classes --out classes.png --resolution 1232 1640    # all eight, about a minute

The object is at rest under its own weight unless options change this. The picture shows both streams, the image halfway
between them, depth, segmentation and pressure, pixel for pixel. Prints the size of the object, how it rests and how
deep it sinks in.
"""

import dataclasses
import functools
import math
import time
import warnings
from pathlib import Path
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib import colormaps
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation

import sts_jax as sts
from experiments.shared import errors, output
from sts_jax import tactile

G = 9.81  # m/s^2
FILL = 0.5  # share of a container's interior that is filled
HEAD = 22  # pixels, height of the caption above a panel
SHEET = (234, 312)  # pixels, size of one picture on the sheet of all classes
NARROWEST = 160  # pixels, width of a panel, to which smaller images are magnified


@dataclasses.dataclass(frozen=True)
class Config:
    """The object, its pose and load, and the picture."""

    mesh: Annotated[str, tyro.conf.Positional]  # a mesh file, the name of a class, or `classes` for all eight
    out: Path = Path("sense.png")  # the picture
    sensor: Path | None = None  # a file written by Sensor.save (default: the paper's sensor)
    resolution: tuple[int, int] = (480, 640)  # height and width, pixels
    crop: bool = False  # show only a window around the object, in the image's aspect ratio
    light: float = 0.5  # share of the LEDs' power in the picture between the streams

    rest: int = 0  # index of the face that it rests on, the likeliest first
    position: tuple[float, float] = (0.0, 0.0)  # m, of the middle of its bounding box
    height: float = 0.0  # m, of its lowest point above the gel
    turn: float = 0.0  # degrees, about the vertical
    tilt: tuple[float, float] = (0.0, 0.0)  # degrees, from rest, about x and about y

    mass: float | None = None  # kg (default: that of a shell half full of water)
    force: float | None = None  # N, upwards on its centre of mass (default: its weight, or 0 in the air)

    longest_side: float | None = None  # m, longest side to which a mesh file is scaled
    scale: float | None = None  # m, length of one unit of a mesh file: 0.001 for millimetres
    up: Literal["x", "y", "z"] | None = None  # the axis of a mesh file that points up (default: y for glTF, else z)
    faces: int | None = None  # decimate a mesh file that has more faces
    texture: Path | None = None  # an image to use as the texture of a mesh file
    seed: int = 0  # selects the object of a class


def check(config: Config) -> None:
    """Check the options before any work.

    Raises:
        ValueError: An option is out of range.
        OSError: The picture cannot be written.
    """
    if min(config.resolution) < 1:
        raise ValueError(f"resolution is {config.resolution}, but height and width must be at least 1 pixel")
    numbers = {
        "position": config.position,
        "height": (config.height,),
        "turn": (config.turn,),
        "tilt": config.tilt,
        "force": (config.force or 0.0,),
        "mass": (1.0 if config.mass is None else config.mass,),
    }
    for name, values in numbers.items():
        if not all(math.isfinite(value) for value in values):
            raise ValueError(f"{name} is {getattr(config, name)}, but it must be finite")
    for name, value in (("mass", config.mass), ("force", config.force)):
        if value is not None and (value < 0 or (name == "mass" and value == 0)):
            raise ValueError(f"{name} is {value}, but it must be > 0" + (" or 0" if name == "force" else ""))
    output.check_picture(config.out)


def read(config: Config, name: str) -> sts.objects.Body:
    """Load the object from a file, or make one of a class.

    Raises:
        FileNotFoundError: The name is neither a file nor a class.
        ValueError: An option for files is given for a class, or `objects.load` refuses the file.
    """
    if name not in sts.objects.CATEGORIES:
        path = Path(name)
        if not path.exists() and not path.suffix:
            raise FileNotFoundError(f"{name} is neither a file nor a class ({', '.join(sts.objects.CATEGORIES)})")
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
            raise ValueError(f"{option} is for mesh files, but {name} is a class: leave it out")
    index = sts.objects.CATEGORIES.index(name)
    body = sts.objects.make(jax.random.fold_in(jax.random.key(config.seed), index), name)
    if config.mass is None:
        return body
    return dataclasses.replace(
        body, shell_mass=jnp.float32(config.mass), contents_density=jnp.zeros_like(body.contents_density)
    )


def lay(config: Config, sensor: sts.Sensor, body: sts.objects.Body) -> tuple[np.ndarray, np.ndarray, str]:
    """The pose of the object, the wrench that supports it, and a description of how it rests.

    The object is placed at rest by `physics.place`, then tilted, turned and moved as configured.

    Raises:
        ValueError: The object has no such face to rest on.
    """
    shares = sts.physics.stable_faces(body, fill=FILL).share
    if not 0 <= config.rest < len(shares):
        raise ValueError(
            f"rest is {config.rest}, but the object rests on {len(shares)} faces: give 0 to {len(shares) - 1}"
        )
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
    """Render the frame, and the image between its streams."""
    frame = sts.sense(sensor, body, pose, wrench, resolution=resolution, crop=crop)
    return frame, sts.expose(sensor, frame, light)


def look(config: Config, sensor: sts.Sensor, body: sts.objects.Body) -> tuple[sts.Frame, np.ndarray, str]:
    """Render the object at rest. Returns the frame, the image between its streams, and a description."""
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
    """All outputs as captioned images in [0, 1]: depth from bright (near) to dark, and pressure on its own grid."""
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
    """Panels in rows, pixel for pixel, each below its caption. A panel of another size is fitted in."""
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
    """Make the object, place it on the pad, render it, print a description, and draw."""
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
            compose(pictures, 3).save(config.out)
        else:
            small = SHEET[0] / config.resolution[0]
            for stream, values in pictures[:3]:
                image = Image.fromarray(np.round(255 * values).astype(np.uint8))
                image = image.resize((round(image.width * small), SHEET[0]), Image.Resampling.BOX)
                sheet.append((f"{name}, {stream}", np.asarray(image) / 255))
    if sheet:
        compose(sheet, 6).save(config.out)
    print(config.out)


if __name__ == "__main__":
    sts.enable_compilation_cache()
    warnings.formatwarning = lambda message, *_, **__: f"note: {message}\n"
    with errors.on_one_line():
        main(tyro.cli(Config, description=__doc__))
