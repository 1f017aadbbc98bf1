"""Random lifts with a parallel gripper: what is drawn, the physics of a lift, and the images at the moment of grasp."""

import concurrent.futures
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

import sts_jax as sts
from sts_jax import scene, storage
from sts_jax._devices import cores
from sts_jax._ranges import COUNT, NUMBER, POSITIVE
from sts_jax._ranges import check as check_ranges
from sts_jax.scene.geometry import body_of

SIDES = ("left", "right")  # the fingers, in the order of the arrays
DT = 0.001  # s, time step
OPENING = 0.12  # m, of the gripper before it closes
CLOSED, MOMENT, LIFTED, SHAKEN, END = 500, 800, 1250, 1650, 1900  # time steps at which a phase of a lift ends
FIRST_LIFT, LIFT = 0.005, 0.04  # m, up to the moment of grasp, and after it
SHAKES = 5.0  # 1/s, frequency at which the hand shakes up and down
PATCHES = 16  # pixels, of which the side of an image is a multiple, see `judging.Eye`
LOST = 0.01  # m, a lift fails if the object's middle comes down farther between the fingers, sliding or turning
ABOVE, BELOW = 0.002, 0.01  # m, a sensor's lower edge is above the table, and its middle is below the object's top
_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


@dataclasses.dataclass(frozen=True)
class Lifts:
    """The lifts of a dataset: objects, ranges of what is drawn for each lift, and the sensors' size and resolution."""

    num_objects: int = dataclasses.field(default=480, metadata=COUNT)  # objects, which the parts of the split share
    num_per_object: int = dataclasses.field(default=16, metadata=COUNT)  # lifts of each object
    categories: tuple[str, ...] = ("bottle", "camera", "mouse")  # classes of the objects
    shares: tuple[float, float, float] = (0.7, 0.1, 0.2)  # of the objects: training, validation and test
    seed: int = dataclasses.field(default=0, metadata=NUMBER)  # of the objects and the lifts
    objects_per_shard: int = dataclasses.field(default=24, metadata=COUNT)  # objects in a file of the dataset
    width: float = dataclasses.field(default=0.04, metadata=POSITIVE)  # side of a sensor (m)
    resolution: int = dataclasses.field(default=64, metadata=COUNT)  # side of the images (pixels)
    # hidden: mass divided by the volume of the convex hull (kg/m^3), drawn log-uniformly
    density: tuple[float, float] = (200.0, 1500.0)
    friction: tuple[float, float] = (0.3, 0.9)  # hidden: coefficient of sliding friction
    grip: tuple[float, float] = (0.3, 4.0)  # hidden: set point of the grip force (N), drawn log-uniformly
    shake: float = dataclasses.field(default=6.0, metadata=POSITIVE)  # largest acceleration while shaking (m/s^2)
    lean: float = 8.0  # standard deviation of the angle between the fingers and the object's narrow side (degrees)
    offset: float = 0.012  # largest distance of the object's middle from that of the fingers, along them (m)
    highest: float = 0.05  # largest height of the sensors' middle above the table (m)

    @property
    def num_shards(self) -> int:
        """Number of files of the dataset."""
        return -(-self.num_objects // self.objects_per_shard)

    @property
    def sensor(self) -> sts.Sensor:
        """The sensor of both fingers."""
        return sts.Sensor.sized(self.width)

    def check(self) -> None:
        """Raise a ValueError for a value out of range."""
        check_ranges(self)
        for category in self.categories:
            sts.objects.find_family(category)
        for name in ("density", "friction", "grip"):
            low, high = getattr(self, name)
            if not 0 < low <= high < np.inf:
                raise ValueError(f"{name} is {low} to {high}, but it must be two numbers > 0, the smaller one first")
        if self.resolution % PATCHES:
            raise ValueError(f"resolution must be a multiple of {PATCHES} pixels, got {self.resolution}")
        if min(map(len, self.split().values())) == 0:
            raise ValueError(
                f"shares {self.shares} of num_objects = {self.num_objects} leave a part of the split without objects: "
                "give more objects"
            )

    def split(self) -> dict[str, np.ndarray]:
        """Numbers of the objects of each part. Every part has all classes in turn."""
        ends = np.round(np.cumsum(self.shares) / sum(self.shares) * self.num_objects).astype(int)
        return dict(zip(("train", "validation", "test"), np.split(np.arange(self.num_objects), ends[:2]), strict=True))

    def category(self, number: int) -> str:
        """Class of an object."""
        return self.categories[number % len(self.categories)]

    def body(self, number: int) -> sts.objects.Body:
        """One of the objects."""
        key = jax.random.fold_in(jax.random.key(self.seed), number)
        return sts.objects.make(key, self.category(number))


class Hidden(NamedTuple):
    """What is hidden in n lifts, (n,)."""

    mass: np.ndarray  # kg
    friction: np.ndarray
    grip: np.ndarray  # N


class Grasp(NamedTuple):
    """How the fingers take hold of the object in n lifts, (n,)."""

    yaw: np.ndarray  # rotation of the object about the vertical (rad)
    x: np.ndarray  # place of the object's frame (m)
    y: np.ndarray
    height: np.ndarray  # of the sensors' middle above the table (m)


def _log_uniform(rng: np.random.Generator, limits: tuple[float, float], n: int) -> np.ndarray:
    return np.exp(rng.uniform(np.log(limits[0]), np.log(limits[1]), n))


def draw(lifts: Lifts, number: int, points: np.ndarray) -> tuple[Hidden, Grasp]:
    """Draw the lifts of an object, whose hull has the given points (m)."""
    rng, n = np.random.default_rng([lifts.seed, number]), lifts.num_per_object
    density, grip = (_log_uniform(rng, limits, n) for limits in (lifts.density, lifts.grip))
    hidden = Hidden(ConvexHull(points).volume * density, rng.uniform(*lifts.friction, n), grip)
    yaw = _narrow(points) + rng.normal(size=n) * np.deg2rad(lifts.lean)
    turned = np.stack([Rotation.from_rotvec([0, 0, angle]).apply(points) for angle in yaw])
    middle = (turned.min(axis=1) + turned.max(axis=1)) / 2
    low = lifts.width / 2 + ABOVE
    high = np.clip(np.ptp(points[:, 2]) - BELOW, low, max(low, lifts.highest))
    across = rng.uniform(-lifts.offset, lifts.offset, n)
    return hidden, Grasp(yaw, -middle[:, 0], across - middle[:, 1], rng.uniform(low, high, n))


def _narrow(points: np.ndarray) -> float:
    """Rotation about the vertical after which an object is least wide along x (rad)."""
    angles = np.deg2rad(np.arange(0, 180, 3))
    widths = np.ptp(points[:, :2] @ np.stack([np.cos(angles), -np.sin(angles)]), axis=0)
    return float(angles[widths.argmin()])


def model_of(lifts: Lifts, body: sts.objects.Body, hidden: Hidden, grasp: Grasp, index: int) -> mujoco.MjModel:
    """The scene of one lift."""
    spec = scene.gripper(
        lifts.sensor,
        body,
        mass=float(hidden.mass[index]),
        friction=float(hidden.friction[index]),
        grip=float(hidden.grip[index]),
        opening=OPENING,
        height=float(grasp.height[index]),
        yaw=float(grasp.yaw[index]),
        position=(float(grasp.x[index]), float(grasp.y[index])),
        timestep=DT,
    )
    for side in SIDES:
        scene.attach(spec, f"{side}_tip", lifts.sensor, name=side)
    return spec.compile()


def controls(height: float, shake: float) -> np.ndarray:
    """Targets of the two servos in every time step of a lift, (END, 2): close, lift a little, lift, shake, wait."""
    step = np.arange(END)

    def rise(begin: int, end: int) -> np.ndarray:
        share = np.clip((step - begin) / (end - begin), 0, 1)
        return share**2 * (3 - 2 * share)

    turns = 2 * np.pi * SHAKES * DT * np.clip(step - LIFTED, 0, SHAKEN - LIFTED)
    lift = height + FIRST_LIFT * rise(CLOSED, CLOSED + 150) + LIFT * rise(MOMENT, LIFTED - 50)
    lift += shake / (2 * np.pi * SHAKES) ** 2 * np.sin(turns)
    return np.stack([lift, OPENING * np.clip(1 - step / (CLOSED - 100), 0, 1)], axis=1)


def simulate(lifts: Lifts, models: list[mujoco.MjModel], heights: np.ndarray) -> np.ndarray:
    """MuJoCo's state after every time step of n lifts, (n, END, state)."""
    starts = np.zeros((len(models), mujoco.mj_stateSize(models[0], _STATE)))
    for start, model in zip(starts, models, strict=True):
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_getState(model, data, start, _STATE)
    control = np.stack([controls(height, lifts.shake) for height in heights])
    workers = [mujoco.MjData(models[0]) for _ in range(cores())]
    return mujoco.rollout.rollout(models, workers, starts, control)[0]


def at(model: mujoco.MjModel, states: np.ndarray, height: float, shake: float, steps: int) -> mujoco.MjData:
    """MuJoCo's data of a lift after some time steps."""
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, states[steps - 1], _STATE)
    data.ctrl[:] = controls(height, shake)[steps - 1]
    mujoco.mj_forward(model, data)
    return data


def slid(states: np.ndarray) -> np.ndarray:
    """How far the object's middle comes down between the fingers, from the closing to the end, (n,) (m)."""
    below = states[..., 1 + 5] - states[..., 1]  # after the time: joints `lift`, `left`, `right`, `object`
    return below[:, CLOSED - 1] - below[:, -1]


def lift_object(lifts: Lifts, number: int) -> dict[str, np.ndarray]:
    """All lifts of one object: images, wrenches and opening at the moment of grasp, outcome, and what is hidden."""
    body, sensor = lifts.body(number), lifts.sensor
    hidden, grasp = draw(lifts, number, np.asarray(body.hulls, np.float64).reshape(-1, 3))
    models = [model_of(lifts, body, hidden, grasp, index) for index in range(lifts.num_per_object)]
    states = simulate(lifts, models, grasp.height)
    view = scene.View(models[0], dict.fromkeys(SIDES, sensor), bodies={"object": body})
    moments = [at(*each, lifts.shake, MOMENT) for each in zip(models, states, grasp.height, strict=True)]

    def seen(data: mujoco.MjData) -> dict[str, np.ndarray]:
        frames = view(data, resolution=(lifts.resolution, lifts.resolution))
        wrench = view.wrenches(data)
        images = {
            stream: np.stack([np.round(255 * np.asarray(getattr(frames[side], stream))) for side in SIDES])
            for stream in ("visual", "tactile")
        }
        return {
            **{stream: image.astype(np.uint8) for stream, image in images.items()},
            "wrench": np.stack([np.asarray(wrench[side]["object"]) for side in SIDES]),
            "opening": np.asarray(data.qpos[1] + data.qpos[2], np.float32),
        }

    with concurrent.futures.ThreadPoolExecutor(cores()) as pool:
        first = seen(moments[0])  # compiles
        rows = [first, *pool.map(seen, moments[1:])]
    drop = slid(states)
    return {
        **{name: np.stack([row[name] for row in rows]) for name in first},
        "object": np.full(lifts.num_per_object, number),
        "slid": drop.astype(np.float32),
        "held": drop < LOST,
        **{name: leaf.astype(np.float32) for name, leaf in (hidden._asdict() | grasp._asdict()).items()},
    }


def replay(lifts: Lifts, number: int, index: int, times: Sequence[int]) -> list[dict[str, np.ndarray]]:
    """Pictures of a lift after some time steps: the view from outside, and both streams of the left finger."""
    body = lifts.body(number)
    hidden, grasp = draw(lifts, number, np.asarray(body.hulls, np.float64).reshape(-1, 3))
    model, height = model_of(lifts, body, hidden, grasp, index), float(grasp.height[index])
    (states,) = simulate(lifts, [model], np.array([height]))
    view, pictures = scene.View(model, dict.fromkeys(SIDES, lifts.sensor), bodies={"object": body}), []
    for steps in times:
        data = at(model, states, height, lifts.shake, steps)
        frame = view(data, resolution=(lifts.resolution, lifts.resolution))[SIDES[0]]
        streams = {stream: np.asarray(getattr(frame, stream)) for stream in ("visual", "tactile")}
        pictures.append({"outside": outside(model, data, body), **streams})
    return pictures


def outside(model: mujoco.MjModel, data: mujoco.MjData, body: sts.objects.Body) -> np.ndarray:
    """Render the gripper and the object from outside, (h, w, 3)."""
    owners = [number for number in range(model.nbody) if model.body_geomnum[number]]
    drawn = {o: body_of(model, np.flatnonzero(model.geom_bodyid == o)) for o in owners}
    drawn[model.body("object").id] = body
    turns = {o: data.xmat[o].reshape(3, 3) for o in drawn}
    ends = np.cumsum([0, *(len(one.vertices) for one in drawn.values())])
    return np.asarray(
        _photograph(
            jnp.concatenate([one.vertices @ turns[o].T + data.xpos[o] for o, one in drawn.items()]),
            jnp.concatenate([one.faces + end for one, end in zip(drawn.values(), ends[:-1], strict=True)]),
            jnp.concatenate([one.normals @ turns[o].T for o, one in drawn.items()]),
            jnp.concatenate([one.colors for one in drawn.values()]),
        )
    )


@jax.jit
def _photograph(vertices: jax.Array, faces: jax.Array, normals: jax.Array, albedo: jax.Array) -> jax.Array:
    eye, target = jnp.array([0.16, -0.42, 0.2]), jnp.array([0.0, 0.0, 0.07])
    return sts.optics.photograph(
        vertices, faces, normals, albedo, eye=eye, target=target, fov=0.5, resolution=(160, 160)
    )


def collect(lifts: Lifts, folder: Path, progress: Callable[[int, int], None]) -> Mapping[str, np.ndarray]:
    """Make the files of a dataset that a folder lacks, and read all. `progress` gets lifts done and in total."""
    remedy = f"delete {folder} to make it again"
    manifest = storage.read_manifest(folder, remedy) or storage.Manifest({}, {})
    shards = []
    for index in range(lifts.num_shards):
        name = f"lifts-{index:03d}.npz"
        first = index * lifts.objects_per_shard
        members = range(first, min(first + lifts.objects_per_shard, lifts.num_objects))
        if name not in manifest.files or not (folder / name).exists():
            rows = []
            for number in members:
                progress(number * lifts.num_per_object, lifts.num_objects * lifts.num_per_object)
                rows.append(lift_object(lifts, number))
            arrays = {key: np.concatenate([row[key] for row in rows]) for key in rows[0]}
            storage.write_arrays(folder / name, arrays)
            manifest = storage.write_manifest(folder, manifest.files | storage.checksums(folder, [name]))
        storage.verify(folder, manifest, remedy, [name])
        shards.append(storage.read_arrays(folder / name, remedy))
    return {key: np.concatenate([shard[key] for shard in shards]) for key in shards[0]}
