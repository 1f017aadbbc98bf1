"""One trajectory over time: a view from outside, a row of images, and an animation."""

import functools
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Array, Float, ScalarLike
from matplotlib.animation import FuncAnimation
from matplotlib.axes import Axes
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.text import Annotation, Text

from sts_jax import geometry, optics
from sts_jax._checked import in_32_bits
from sts_jax.evaluation.figures import pictures
from sts_jax.objects import Body
from sts_jax.storage import write_bytes

SLOWER = 2  # duration of an animation divided by the duration of the motion
_HEAD, _PANEL = 44, 104  # pixels, height of the text above the images and of one panel of curves below them
_MARGINS = (50, 12, 22, 10)  # pixels, of the curves in a panel: left, right, top, bottom
_DPI = 100  # pixels per inch of an animation
_HOLD = 1500  # ms, duration of the last frame
_REACH = 0.035  # s^2/m, length of the gravity arrow per unit of gravity, as a share of the image's side
_VISIBLE = 0.1  # m/s^2, smallest component of gravity along the pad that has an arrow
_THICKNESS = 0.012  # m, thickness of the box that is drawn as the housing of the sensor
_PAD = np.array([178, 178, 204], np.float32) / 255  # sRGB
_HOUSING = np.array([0.05, 0.05, 0.055], np.float32)


@in_32_bits
@functools.partial(jax.jit, static_argnames=("resolution",))
def outside(
    body: Body,
    pose: Float[Array, "7"],
    size: Float[Array, "2"],
    up: Float[Array, "3"] | None = None,
    wall: ScalarLike = 0.0,
    *,
    resolution: tuple[int, int] = (160, 160),
) -> Float[Array, "h w 3"]:
    """Render the object and the pad from outside, obliquely from above.

    Args:
        size: Size of the pad along x and y (m).
        up: Vector of any length that points upwards, in the sensor frame (default: the pad is level).
        wall: Height of the stop wall at the edge of the pad with the largest y (m). 0 draws no wall.
    """
    half = jnp.stack([size[0], size[1], jnp.float32(_THICKNESS)]) / 2
    corners = jnp.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-2, 0)], jnp.float32)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    box = jnp.asarray(np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), jnp.int32)
    thick = half[:2] + jnp.array([0.0, 0.003]) * (jnp.asarray(wall) > 0)
    stop = jnp.stack(
        [jnp.stack([x * half[0], y, z * wall]) for x in (-1, 1) for y in (half[1], thick[1]) for z in (0, 1)]
    )
    vertices = jnp.concatenate([geometry.transform(pose, body.vertices), corners * half, stop])
    faces = jnp.concatenate([body.faces, box + len(body.vertices), box + len(body.vertices) + 8])
    flat = jnp.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]], jnp.float32)
    flat = jnp.broadcast_to(jnp.tile(flat, (4, 1))[:, None], (24, 3, 3))
    normals = jnp.concatenate([body.normals @ geometry.quat_to_matrix(pose[3:]).T, flat])
    top = (flat[..., 2:] > 0) & (jnp.arange(24) < 12)[:, None, None]
    if up is not None:
        axis, along = jnp.cross(up, jnp.array([0.0, 0.0, 1.0])), geometry.norm(up)
        level = geometry.quat_from_rotvec(
            geometry.normalize(axis) * jnp.arctan2(geometry.norm(axis) / along, up[2] / along)
        )
        vertices, normals = (x @ geometry.quat_to_matrix(level).T for x in (vertices, normals))
    albedo = body.colors * optics.sample_texture(body.texture, body.uv)
    albedo = jnp.concatenate([albedo, jnp.where(top, optics.to_linear(jnp.asarray(_PAD)), jnp.asarray(_HOUSING))])
    return optics.photograph(
        vertices,
        faces,
        normals,
        albedo,
        eye=jnp.array([0.25, 0.53, 0.38]),
        target=jnp.array([0.0, 0.0, 0.03]),
        fov=0.44,
        resolution=resolution,
        two_sided=body.two_sided,
    )


def strip(
    path: Path,
    time: np.ndarray,
    view: np.ndarray,
    visual: np.ndarray,
    tactile: np.ndarray,
    wrench: np.ndarray,
    *,
    num: int = 10,
    title: str = "",
) -> None:
    """Draw one trajectory over time: a view from outside, the visual and tactile images, and the wrench.

    Args:
        time: Times of the frames (s). The other arrays have a row for each frame, and images are in [0, 1].
        view: Images of `outside`.
        wrench: Wrench in each frame (N, N m), `(frames, 6)`.
    """
    last = len(time) - 1
    chosen = np.unique(np.round(last * np.linspace(0, 1, num) ** 1.8).astype(int))
    figure, axes = plt.subplots(
        5, len(chosen), figsize=(1.5 * len(chosen), 7.8), height_ratios=[1, 1, 1, 0.8, 0.8], squeeze=False
    )
    for column, t in enumerate(chosen):
        for row, (name, images) in enumerate({"outside": view, "visual": visual, "tactile": tactile}.items()):
            pictures.show(axes[row, column], images[t])
            if column == 0:
                axes[row, column].set_ylabel(name, fontsize=8)
        axes[0, column].set_title(f"{time[t]:.2f} s", fontsize=8)
        axes[3, column].remove()
        axes[4, column].remove()
    grid = axes[0, 0].get_gridspec()
    force = figure.add_subplot(grid[3, :])
    moment = figure.add_subplot(grid[4, :], sharex=force)
    for axis, symbol, values, unit in (
        (force, "F", wrench[:, :3], "force (N)"),
        (moment, "M", 1e3 * wrench[:, 3:], "moment about\norigin (mN m)"),
    ):
        for k, direction in enumerate("xyz"):
            axis.plot(time, values[:, k], label=f"${symbol}_{direction}$", linewidth=1)
        axis.set_ylabel(unit, fontsize=8)
        axis.tick_params(labelsize=8)
        axis.legend(fontsize=7, ncols=3)
        axis.grid(alpha=0.3)
    force.tick_params(labelbottom=False)
    moment.set_xlabel("time (s)", fontsize=8)
    figure.align_ylabels([force, moment])
    figure.suptitle(title, fontsize=9)
    pictures.save(figure, path)


def animation(
    path: Path,
    time: np.ndarray,
    view: np.ndarray,
    visual: np.ndarray,
    tactile: np.ndarray,
    wrench: np.ndarray | None,
    gravity: np.ndarray,
    *,
    title: str = "",
    outcome: str = "",
    side: int = 240,
) -> None:
    """Write an animation of one trajectory: a view from outside, the visual and tactile images, and the wrench.

    Curves below the images show the wrench up to the current frame. A red arrow on the visual stream shows the
    component of `gravity` along the pad. The animation runs at half the speed of the motion (`SLOWER` is 2).

    Args:
        path: File whose suffix is `.gif` (256 colours), or `.webp` (all colours, a fraction of the size).
        time: Times of the frames (s). The other arrays have a row for each frame, and images are in [0, 1].
        view: Images of `outside`.
        wrench: Wrench (N, N m), `(frames, 6)`. None: no curves.
        gravity: Gravity minus the acceleration of the pad in the sensor frame (m/s^2), `(frames, 3)`.
        outcome: Text above the images in the last frame, such as `fell off`.
        side: Side of each of the three images (pixels).
    """
    width, height = 3 * side, _HEAD + side + (0 if wrench is None else 2 * _PANEL)
    figure = plt.figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
    figure.text(6 / width, 1 - 5 / height, title, va="top", fontsize=8)
    clock = figure.text(6 / width, 1 - 23 / height, "", va="top", fontsize=8.6)
    streams = {"outside": view, "visual": visual, "tactile": tactile}
    axes = [_axes(figure, column * side, _HEAD, side, side) for column in range(3)]
    pictures = [_picture(axis, name, images[0]) for axis, (name, images) in zip(axes, streams.items(), strict=True)]
    arrow, label = _gravity(axes[1])
    curves = []
    if wrench is not None:
        force, moment = wrench[:, :3], 1e3 * wrench[:, 3:]
        curves = [
            (_panel(figure, 0, "force (N)", "F", time, force), force),
            (_panel(figure, 1, "moment about the sensor's origin (mN m)", "M", time, moment), moment),
        ]

    def draw_page(t: int) -> None:
        last = f": {outcome}" if t == len(time) - 1 else ""
        clock.set_text(f"{time[t]:.2f} s, at 1/{SLOWER:g} of the true speed{last}")
        for picture, images in zip(pictures, streams.values(), strict=True):
            picture.set_data(np.clip(images[t], 0, 1))
        arrow.xy = tuple(0.5 + _REACH * gravity[t, :2])
        for artist in (arrow, label):
            artist.set_visible(bool(np.linalg.norm(gravity[t, :2]) > _VISIBLE))
        for lines, values in curves:
            for line, own in zip(lines, values.T, strict=True):
                line.set_data(time[: t + 1], own[: t + 1])

    # A GIF counts hundredths of a second, and its writer rounds down to whole milliseconds.
    step = 10 * max(round(100 * SLOWER * float(np.mean(np.diff(time)))), 2) if len(time) > 1 else 100
    pages = [*range(len(time)), *[len(time) - 1] * max(round(_HOLD / step) - 1, 0)]
    try:
        film = FuncAnimation(
            figure, draw_page, pages, init_func=lambda: None, interval=step + 0.5, cache_frame_data=False
        )
        with tempfile.TemporaryDirectory() as folder:
            temporary = Path(folder) / f"film{path.suffix}"
            film.save(temporary, "pillow", dpi=_DPI)
            write_bytes(path, temporary.read_bytes())
    finally:
        plt.close(figure)


def _axes(figure: plt.Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Add axes to a figure, at a position in pixels from its upper left corner."""
    across, down = figure.get_size_inches() * _DPI
    return figure.add_axes((left / across, 1 - (top + height) / down, width / across, height / down))


def _picture(axis: Axes, name: str, image: np.ndarray) -> AxesImage:
    """Draw the first image of a stream. The axes range from 0 to 1, and y points down."""
    axis.set_axis_off()
    axis.text(0.02, 0.98, name, fontsize=8)
    return axis.imshow(np.clip(image, 0, 1), extent=(0, 1, 1, 0), interpolation="bicubic")


def _gravity(axis: Axes) -> tuple[Annotation, Text]:
    """Add an arrow that starts in the middle of the image, and its label."""
    look = {"arrowstyle": "-|>", "color": "red", "linewidth": 2, "mutation_scale": 12, "shrinkA": 0, "shrinkB": 0}
    arrow = axis.annotate("", (0.5, 0.5), (0.5, 0.5), arrowprops=look)
    return arrow, axis.text(0.02, 0.02, "gravity along the pad", color="red", fontsize=8, va="top")


def _panel(
    figure: plt.Figure, place: int, title: str, symbol: str, time: np.ndarray, values: np.ndarray
) -> list[Line2D]:
    """Add axes below the images, with three curves that have no points yet. Return the curves."""
    across, down = figure.get_size_inches() * _DPI
    left, right, top, bottom = _MARGINS
    upper = down - (2 - place) * _PANEL
    axis = _axes(figure, left, upper + top, across - left - right, _PANEL - top - bottom)
    low, high = min(float(values.min()), 0.0), max(float(values.max()), 0.0)
    axis.set_xlim(time[0], max(time[-1], time[0] + 1e-6))
    axis.set_ylim(low, max(high, low + 1e-3))
    axis.axhline(0, color="lightgray", linewidth=1, zorder=0)
    axis.set_xticks([])
    axis.locator_params(axis="y", nbins=3)
    axis.tick_params(labelsize=8)
    axis.spines[["top", "right", "bottom"]].set_visible(False)
    axis.set_title(title, loc="left", fontsize=8.6, pad=5)
    colours = ("tab:blue", "tab:orange", "tab:green")
    lines = []
    for k, (direction, colour) in enumerate(zip("xyz", colours, strict=True)):
        lines += axis.plot([], [], color=colour, linewidth=1.5, clip_on=False)
        place_of_name = (1 - 0.04 * (2 - k), 1.05)
        axis.text(
            *place_of_name, f"{symbol}{direction}", color=colour, fontsize=8, ha="right", transform=axis.transAxes
        )
    return lines
