"""Options that describe an object on the pad, and functions that load the object and lay it there."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from scipy.spatial.transform import Rotation

import sts_jax as sts
from experiments.shared import drawing
from experiments.shared.terminal import SEEDS, SIDES, check_numbers

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


def check(config: Placed) -> None:
    """Check the options before any work."""
    check_numbers(
        config,
        resolution=SIDES,
        position=(-1, 1),
        height=(-1, 1),
        turn=(-1e6, 1e6),
        tilt=(-1e6, 1e6),
        mass=(0, 1000),
        force=(0, 1e6),
        seed=SEEDS,
    )
    if config.mass is not None and config.mass <= 0:
        raise ValueError(f"--mass is {config.mass}, but it must be > 0 (kg)")
    drawing.check_picture(config.out)


def read(config: Placed, sensor: sts.Sensor, name: str) -> sts.objects.Body:
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
            pad=float(min(sensor.gel.size)),
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
