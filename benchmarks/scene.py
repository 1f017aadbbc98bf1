"""Frames per second of the sensors in a MuJoCo scene, and pictures of a grasp in both engines.

    python -m benchmarks.scene                          # about 15 minutes on two CPU cores
    python -m benchmarks.scene --envs 1 --sizes 64x64   # one environment, small images
    MUJOCO_GL=osmesa python -m benchmarks.scene         # also `mujoco.Renderer`, where OSMesa is installed
    python -m benchmarks.scene --pictures               # two minutes: benchmarks/results/scene/{c,mjx}.png

The scene is a parallel gripper with two sensors that holds an object: six bodies and a table. A frame of `scene.View`
has both streams, depth, segmentation and the gel's equilibrium of one sensor. Five things are measured in alternation,
as medians:

- `view`: frames of the scene, for 1, 16 and 256 environments under `vmap` (on a GPU also 4,096)
- `one body`: frames of `sense` of a single body that has all faces which one sensor can see
- `Renderer`: images of `mujoco.Renderer` at the place of the sensor's camera. An image is one RGB image without touch
- `MJX` and `C MuJoCo`: time steps of the physics
"""

import dataclasses
import functools
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import mujoco
import numpy as np
import tyro

import sts_jax as sts
from benchmarks.instruments.timing import median_seconds
from experiments.shared.drawing import write_figure
from sts_jax import geometry, objects, optics, scene, storage
from sts_jax.objects.body import FACE_CLASSES, pad, size_class
from sts_jax.physics.scene import mjx
from sts_jax.scene.geometry import body_of, visible

PADS = ("left", "right")
ENVS = (1, 16, 256), (1, 16, 256, 4096)  # on a CPU, on a GPU
WIDTH = 0.04  # m, width of the sensors
STEPS = 50  # time steps of one measurement of the physics
TACCEL = 915  # environment steps per second that Taccel published for 4,096 environments on an H100
CLOSE, LIFT, RISE = (0.0, 0.6), (0.8, 1.3), 0.06  # s, s, m: begin and end of closing and of lifting, and the height
MOMENTS = {"open": 0.2, "closed": 0.75, "lifted": 1.4}  # s, times of the pictures
RESULTS = Path(__file__).parent / "results" / "scene"


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    envs: tuple[int, ...] = ()  # numbers of environments (default: 1, 16 and 256, and on a GPU also 4096)
    sizes: tuple[str, ...] = ("64x64", "240x320")  # height and width of the images (pixels)
    repeats: int = 3  # number of measurements of each kind
    out: Path | None = None  # text file for the table (default: print only)
    pictures: bool = False  # draw the pictures of docs/scene.md instead

    def __post_init__(self) -> None:
        for size in self.sizes:
            sides = size.split("x")
            if len(sides) != 2 or not all(side.isdigit() and int(side) > 0 for side in sides):
                raise ValueError(f"--sizes must be height x width, such as 64x64, got {size!r}")
        if any(number < 1 for number in self.envs) or self.repeats < 1:
            raise ValueError(f"--envs and --repeats must be at least 1, got {self.envs} and {self.repeats}")


class Row(NamedTuple):
    """Rates of one image size and one number of environments (1/s)."""

    size: str
    envs: int
    view: float  # frames of the scene
    single: float  # frames of one body
    renderer: float | None  # images of `mujoco.Renderer`, None without OpenGL
    mjx: float  # time steps
    native: float  # time steps


def build(sensor: sts.Sensor, body: objects.Body | None = None) -> mujoco.MjModel:
    """A gripper with two sensors, cameras at the sensors' pinholes, the object, and a body on each side of it."""
    spec = scene.gripper(sensor, body)
    for name, kind, size, y in (
        ("ball", mujoco.mjtGeom.mjGEOM_SPHERE, [0.012, 0, 0], 0.038),
        ("block", mujoco.mjtGeom.mjGEOM_BOX, [0.012, 0.01, 0.03], -0.038),
    ):
        other = spec.worldbody.add_body(name=name, pos=[0, y, size[2] or size[0]])
        other.add_geom(name=name, type=kind, size=size, rgba=[0.2, 0.45, 0.7, 1])
    for name in PADS:
        tip = spec.site(f"{name}_tip")
        turn, quat = np.zeros(9), np.zeros(4)
        mujoco.mju_quat2Mat(turn, tip.quat)
        mujoco.mju_mulQuat(quat, tip.quat, np.array([0.0, 1, 0, 0]))  # MuJoCo's cameras look along -z, with y up
        tip.parent.add_camera(
            name=name,
            pos=tip.pos - float(sensor.camera.distance) * turn.reshape(3, 3)[:, 2],
            quat=quat,
            fovy=float(np.rad2deg(sensor.camera.fov)),
        )
        scene.attach(spec, f"{name}_tip", sensor, name=name)
    return spec.compile()


def control(model: mujoco.MjModel, seconds: float) -> np.ndarray:
    """Targets of the servos: close with all force, then lift."""
    home = model.key("home").ctrl
    close, lift = (np.clip((seconds - begin) / (end - begin), 0, 1) for begin, end in (CLOSE, LIFT))
    return np.array([home[0] + RISE * lift, home[1] * (1 - close)])


def grasp(model: mujoco.MjModel, engine: str) -> list[mujoco.MjData | mjx.Data]:
    """Simulate a grasp, and return the states at MOMENTS."""
    data, found = mujoco.MjData(model), []
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    on_device = mjx.put_model(model) if engine == "mjx" else None
    state = mjx.put_data(model, data) if engine == "mjx" else data
    advance = jax.jit(mjx.step)
    for number in range(round(max(MOMENTS.values()) / model.opt.timestep)):
        ctrl, moment = control(model, number * model.opt.timestep), (number + 1) * model.opt.timestep
        if engine == "mjx":
            state = advance(on_device, state.replace(ctrl=jnp.asarray(ctrl, jnp.float32)))
        else:
            data.ctrl[:] = ctrl
            mujoco.mj_step(model, data)
        if any(abs(moment - wanted) < model.opt.timestep / 2 for wanted in MOMENTS.values()):
            found.append(state if engine == "mjx" else _copy(model, data))
    return found


def _copy(model: mujoco.MjModel, data: mujoco.MjData) -> mujoco.MjData:
    copied = mujoco.MjData(model)
    mujoco.mj_copyData(copied, model, data)
    return copied


def merged(
    model: mujoco.MjModel, data: mujoco.MjData | mjx.Data, without: int, bodies: dict | None = None
) -> objects.Body:
    """All that is drawn, but the body `without`, as one body in the world's frame. `bodies` replaces some geoms."""
    geoms, parts = visible(model, None), []
    for owner in np.unique(model.geom_bodyid[geoms]):
        if owner != without:
            one = (bodies or {}).get(model.body(owner).name) or body_of(model, geoms[model.geom_bodyid[geoms] == owner])
            pose = jnp.concatenate([jnp.asarray(data.xpos[owner]), jnp.asarray(data.xquat[owner])])
            parts.append(moved(one, pose))
    counts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    size = size_class(max(int(counts[-1]), sum(len(part.faces) for part in parts)), FACE_CLASSES)
    return dataclasses.replace(
        parts[0],
        vertices=jnp.asarray(pad(np.concatenate([part.vertices for part in parts]), size, 0.0)),
        faces=jnp.asarray(pad(np.concatenate([p.faces + n for p, n in zip(parts, counts[:-1], strict=True)]), size, 0)),
        **{
            name: jnp.asarray(pad(np.concatenate([getattr(part, name) for part in parts]), size, 0.0))
            for name in ("normals", "colors", "uv")
        },
    )


def moved(body: objects.Body, pose: jax.Array) -> objects.Body:
    """The used faces of a body in another frame."""
    used = np.flatnonzero(np.any(np.asarray(body.faces) != np.asarray(body.faces)[:, :1], axis=1))
    turn = geometry.quat_to_matrix(pose[3:])
    return dataclasses.replace(
        body,
        vertices=geometry.transform(pose, body.vertices)[: int(np.max(body.faces)) + 1],
        faces=body.faces[used],
        normals=body.normals[used] @ turn.T,
        colors=body.colors[used],
        uv=body.uv[used],
    )


def several(model: mujoco.MjModel, data: mujoco.MjData, number: int) -> mjx.Data:
    """A state for each of several environments. The object's places differ by a micrometre."""
    first, row = mjx.put_data(model, data), model.body("object").id
    nudges = 1e-6 * jnp.arange(number, dtype=jnp.float32)
    return jax.vmap(lambda nudge: first.replace(xpos=first.xpos.at[row, 1].add(nudge)))(nudges)


def renderer_of(model: mujoco.MjModel, shape: tuple[int, int]) -> mujoco.Renderer | None:
    """MuJoCo's renderer, or None where there is no OpenGL."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return mujoco.Renderer(model, *shape)
        except Exception:  # of many kinds, according to the library that is missing
            return None


class Work(NamedTuple):
    """What is measured for one image size."""

    model: mujoco.MjModel
    held: mujoco.MjData  # the gripper holds the object
    frame: jax.Array  # the world's frame in the left sensor's frame
    see: Callable[[mjx.Data], object]  # frames of all sensors of several environments
    sense: Callable[[jax.Array], object]  # frames of one body in several poses
    steps: Callable[[mjx.Data], object]  # STEPS time steps of several environments
    renderer: mujoco.Renderer | None

    def rates(self, number: int, repeats: int) -> tuple[float, float, float | None, float, float]:
        """Rates of a number of environments, in the order of `Row`."""
        data, native = several(self.model, self.held, number), _copy(self.model, self.held)
        poses = self.frame + jnp.zeros((2 * number, 7)).at[:, 1].set(1e-6 * jnp.arange(2 * number))
        seconds = median_seconds(
            lambda: self.see(data),
            lambda: self.sense(poses),
            lambda: self.steps(data),
            lambda: mujoco.mj_step(self.model, native, STEPS),
            self.draw,
            repeats=repeats,
        )
        images = 2 / seconds[4] if self.renderer else None
        return 2 * number / seconds[0], 2 * number / seconds[1], images, number * STEPS / seconds[2], STEPS / seconds[3]

    def draw(self) -> None:
        """Draw an image from each sensor's camera with MuJoCo's renderer, if there is one."""
        if self.renderer is None:
            return
        for name in PADS:
            self.renderer.update_scene(self.held, camera=name)
            self.renderer.render()


def measure(args: Args) -> list[Row]:
    """Measure all sizes and numbers of environments."""
    sensor = sts.Sensor.sized(WIDTH)
    model = build(sensor)
    view = scene.View(model, dict.fromkeys(PADS, sensor))
    held = grasp(model, "c")[-1]
    on_device = mjx.put_model(model)
    wrench = view.wrenches(held)["left"]["object"]
    site, quat = model.site("left").id, np.zeros(4)
    mujoco.mju_mat2Quat(quat, held.site_xmat[site])
    frame = geometry.pose_inverse(jnp.asarray([*held.site_xpos[site], *quat], jnp.float32))
    single = merged(model, held, model.body("left").id)
    steps = jax.jit(jax.vmap(lambda data: jax.lax.fori_loop(0, STEPS, lambda _, x: mjx.step(on_device, x), data)))
    rows = []
    for size in args.sizes:
        shape = int(size.split("x")[0]), int(size.split("x")[1])
        sense = functools.partial(sts.sense, sensor, single, wrench=wrench, resolution=shape)
        work = Work(
            model=model,
            held=held,
            frame=frame,
            see=jax.jit(jax.vmap(functools.partial(view, resolution=shape))),
            sense=jax.jit(jax.vmap(sense)),
            steps=steps,
            renderer=renderer_of(model, shape),
        )
        for number in args.envs or ENVS[jax.default_backend() != "cpu"]:
            rows.append(Row(size, number, *work.rates(number, args.repeats)))
            print(line(rows[-1]), flush=True)
        if work.renderer is not None:
            work.renderer.close()  # a second renderer beside it would draw nothing, with OSMesa
    return rows


HEADER = "size      envs      view  one body  ratio  Renderer   MJX steps   C steps"


def line(row: Row) -> str:
    """One row of the table."""
    renderer = f"{row.renderer:8.0f}" if row.renderer else "       -"
    return (
        f"{row.size:8s}  {row.envs:4d}  {row.view:8.1f}  {row.single:8.1f}  {row.single / row.view:5.2f}  {renderer}  "
        f"{row.mjx:10,.0f}  {row.native:8,.0f}"
    )


def report(rows: list[Row]) -> str:
    """Format the results as a table, all columns but the ratio in 1/s."""
    device = jax.devices()[0].device_kind
    worst = max(row.single / row.view for row in rows)
    lines = [HEADER, *map(line, rows)]
    lines.append(
        f"{device}, {os.cpu_count()} CPU cores, jax {jax.__version__}, mujoco {mujoco.__version__}. 1/s, but ratio."
    )
    lines.append(f"A frame of the scene takes at most {worst:.2f} times as long as a frame of one body.")
    if jax.default_backend() != "cpu":
        best = max(rows, key=lambda row: row.view)
        lines.append(
            f"{best.view / 2:,.0f} environments a second, two frames of {best.size} each, {best.envs:,} at once. "
            f"Taccel published {TACCEL} environment steps a second on an H100, with its physics."
        )
    return "\n".join(lines)


def pictures() -> list[Path]:
    """Draw a grasp in both engines: the scene from outside, and both streams of both sensors at MOMENTS."""
    sensor, paths = sts.Sensor.sized(WIDTH), []
    body = objects.make(jax.random.key(3), "bottle")
    model = build(sensor, body)
    view = scene.View(model, dict.fromkeys(PADS, sensor), bodies={"object": body})
    titles = ("scene", *(f"{name}, {stream}" for name in PADS for stream in ("visual", "tactile")))
    for engine, title in (("c", "C MuJoCo"), ("mjx", "MJX")):
        figure, axes = plt.subplots(3, 5, figsize=(9, 5.8), layout="constrained")
        for row, (moment, data) in zip(axes, zip(MOMENTS, grasp(model, engine), strict=True), strict=True):
            numbers = " ".join(f"{number:.3f}" for number in view.wrenches(data)["left"]["object"])
            print(f"{title}, {moment}: the left pad presses on the object with {numbers} (N, N m)")
            frames = view(data, resolution=(180, 180))
            whole = merged(model, data, -1, {"object": body})
            outside = optics.photograph(
                whole.vertices,
                whole.faces,
                whole.normals,
                whole.colors,
                eye=jnp.array([0.25, -0.4, 0.25]),
                target=jnp.array([0.0, 0.0, 0.06]),
                two_sided=True,
            )
            images = [outside, *(getattr(frames[name], stream) for name in PADS for stream in ("visual", "tactile"))]
            for axis, image, text in zip(row, images, titles, strict=True):
                axis.imshow(np.asarray(image))
                axis.set(xticks=[], yticks=[])
                if moment == next(iter(MOMENTS)):
                    axis.set_title(text, fontsize=9)
            row[0].set_ylabel(moment, fontsize=9)
        figure.suptitle(title, fontsize=10)
        paths.append(RESULTS / f"{engine}.png")
        write_figure(paths[-1], figure, dpi=100)
        plt.close(figure)
    return paths


def main(args: Args) -> str:
    """Measure, or draw the pictures, and return a table or the names of the pictures."""
    if args.pictures:
        return "\n".join(map(str, pictures()))
    print(HEADER, flush=True)
    text = report(measure(args))
    if args.out is not None:
        storage.write_bytes(args.out, f"{text}\n".encode())
    return text


if __name__ == "__main__":
    print(main(tyro.cli(Args, description=__doc__)))
