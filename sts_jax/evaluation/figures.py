"""Pictures of what was predicted, learnt and simulated, each written to one PNG file."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib import colors, font_manager
from matplotlib.axes import Axes
from PIL import Image, ImageDraw, ImageFont

from sts_jax import physics
from sts_jax._files import write_whole
from sts_jax.dataset import Pairs
from sts_jax.evaluation.report import Predicted

SLOWER = 2  # an animation is so many times slower than what it shows
_PANEL = 104  # pixels, height of one panel of curves below an animation


def predictions(path: Path, test: Pairs, predicted: Mapping[str, Predicted], *, num: int, title: str) -> None:
    """Input, target and predictions of the first `num` held-out trajectories, one row each.

    Where there is a condition, an arrow on the input is the velocity against the pad that the jerk gives what slides
    freely: a quarter of the picture for 1 m/s.

    Args:
        path: The PNG to write.
        test: Held-out trajectories, in the dataset's order.
        predicted: By name; each gives one column a stream it predicts.
        num: How many rows.
        title: Of the figure.
    """
    num = min(num, len(test.visual))
    columns: list[tuple[str, np.ndarray]] = [
        ("input\nvisual", test.visual[:, 0] / 255),
        ("target\nvisual", test.visual[:, 1] / 255),
        *((f"{name}\nvisual", p.visual) for name, p in predicted.items() if p.visual is not None),
        ("target\ntactile", test.tactile[:, 1] / 255),
        *((f"{name}\ntactile", p.tactile) for name, p in predicted.items() if p.tactile is not None),
    ]
    figure, axes = plt.subplots(num, len(columns), figsize=(1.45 * len(columns), 1.35 * num + 0.9), squeeze=False)
    for row in range(num):
        for axis, (head, images) in zip(axes[row], columns, strict=True):
            _show(axis, images[row])
            if row == 0:
                axis.set_title(head, fontsize=7)
        outcome = physics.Outcome(int(test.outcome[row])).name.lower().replace("_", " ")
        axes[row, 0].set_ylabel(f"#{test.trajectory[row]}\n{outcome}", fontsize=7)
        if test.condition.shape[1]:
            height, width = test.visual.shape[2:4]
            middle = np.array([width - 1, height - 1]) / 2
            tip = middle - test.condition[row, :2] * test.condition[row, 2] * width / 4
            axes[row, 0].annotate("", tip, middle, arrowprops={"arrowstyle": "->", "color": "red"})
    figure.suptitle(title, fontsize=9)
    _save(figure, path)


def training_curves(path: Path, logs: Mapping[str, Sequence[Mapping[str, float]]]) -> None:
    """Loss, KL and the reconstruction of each modality against the gradient step, one line a model.

    Args:
        path: The PNG to write.
        logs: For each model its log: dictionaries with `step`, `loss`, `kl` and one number a modality.
    """
    keys = [
        key
        for key in ("loss", "kl", "visual", "tactile", "pose")
        if any(key in e for log in logs.values() for e in log)
    ]
    units = {"pose": "squared error (scaled pose)"}
    figure, axes = plt.subplots(1, len(keys), figsize=(3.6 * len(keys), 3.2), squeeze=False)
    for axis, key in zip(axes[0], keys, strict=True):
        for name, log in logs.items():
            points = [(entry["step"], entry[key]) for entry in log if key in entry]
            if points:
                axis.plot(*zip(*points, strict=True), label=name, linewidth=1)
        axis.set_xlabel("gradient step")
        axis.set_ylabel(units.get(key, "nats an item"))
        axis.set_title(key, fontsize=9)
        if key == "loss":
            axis.set_yscale("log")  # the models differ by the number of their subsets
        axis.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=7)
    _save(figure, path)


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
    """One trajectory: a view from outside, both streams, and what the pad exerts, over time.

    Below the pictures is the force, below that its moment about the sensor's origin.

    Args:
        path: The PNG to write.
        time: Of every frame (s), `(frames,)`.
        view: The scene from outside, `(frames, h, w, 3)`.
        visual: `(frames, height, width, 3)` in [0, 1].
        tactile: `(frames, height, width, 3)` in [0, 1].
        wrench: `(frames, 6)`, N and N m.
        num: How many frames are shown: from just before the first touch to the end, denser at the beginning.
        title: Of the figure.
    """
    last = len(time) - 1
    chosen = np.unique(np.round(last * np.linspace(0, 1, num) ** 1.8).astype(int))
    figure, axes = plt.subplots(
        5, len(chosen), figsize=(1.5 * len(chosen), 7.8), height_ratios=[1, 1, 1, 0.8, 0.8], squeeze=False
    )
    for column, t in enumerate(chosen):
        for row, (name, images) in enumerate({"outside": view, "visual": visual, "tactile": tactile}.items()):
            _show(axes[row, column], images[t])
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
    _save(figure, path)


def animation(
    path: Path,
    time: np.ndarray,
    view: np.ndarray,
    visual: np.ndarray,
    tactile: np.ndarray,
    wrench: np.ndarray,
    gravity: np.ndarray,
    *,
    title: str = "",
    outcome: str = "",
    side: int = 240,
) -> None:
    """One trajectory as a moving picture: a view from outside, both streams, force and moment so far.

    An arrow on the visual stream is gravity's part along the pad: what the slope, or the jerk of the pad, pulls with.
    All is shown SLOWER times slower than it happens.

    Args:
        path: The GIF to write.
        time: Of every frame (s), `(frames,)`.
        view: The scene from outside, `(frames, h, w, 3)` in [0, 1].
        visual: `(frames, height, width, 3)` in [0, 1].
        tactile: `(frames, height, width, 3)` in [0, 1].
        wrench: `(frames, 6)`, N and N m.
        gravity: `(frames, 3)`, m/s^2, sensor frame.
        title: Above.
        outcome: Shown at the end.
        side: Of each of the three pictures (pixels).
    """
    top, width = 44, 3 * side
    base = top + side
    across = np.interp(time, [time[0], max(time[-1], time[0] + 1e-6)], [50, width - 12])
    letters = font_manager.findfont("DejaVu Sans")  # comes with matplotlib; Pillow's own has no "²"
    font, small = (ImageFont.truetype(letters, size=size) for size in (12, 11))
    curves = [
        ("force (N)", "F", wrench[:, :3]),
        ("moment about the sensor's origin (mN m)", "M", 1e3 * wrench[:, 3:]),
    ]
    pages = []
    for t in range(len(time)):
        page = Image.new("RGB", (width, base + 2 * _PANEL), "white")
        draw = ImageDraw.Draw(page)
        draw.text((6, 5), title, "black", small)
        said = f"{time[t]:.2f} s, at 1/{SLOWER:g} of its speed" + (f": {outcome}" if t == len(time) - 1 else "")
        draw.text((6, 23), said, "black", font)
        for column, (name, images) in enumerate({"outside": view, "visual": visual, "tactile": tactile}.items()):
            picture = Image.fromarray(np.round(255 * np.clip(images[t], 0, 1)).astype(np.uint8))
            page.paste(picture.resize((side, side), Image.Resampling.BICUBIC), (column * side, top))
            draw.text((column * side + 5, top + side - 16), name, "black", small)
        middle = np.array([1.5 * side, top + side / 2])
        tip = middle + 0.035 * side * gravity[t, :2]
        if np.linalg.norm(gravity[t, :2]) > 0.1:
            along = (tip - middle) / np.linalg.norm(tip - middle)
            barbs = [tip - 10 * along + sign * 6 * along[::-1] * [-1, 1] for sign in (-1, 1)]
            draw.text((side + 5, top + 3), "gravity's part along the pad", "red", small)
            draw.line([*middle, *(tip - 8 * along)], "red", 3)
            draw.polygon([tuple(tip), *map(tuple, barbs)], "red")
        for panel, (head, symbol, values) in enumerate(curves):
            _curves(draw, small, base + panel * _PANEL, across, values, t, head, symbol)
        pages.append(page)
    # A GIF counts hundredths of a second.
    step = 10 * max(round(100 * SLOWER * float(np.mean(np.diff(time)))), 2) if len(time) > 1 else 100
    durations = [step] * (len(pages) - 1) + [1500]

    def write(temporary: Path) -> None:
        pages[0].save(temporary, "GIF", save_all=True, append_images=pages[1:], duration=durations, loop=0)

    write_whole(path, write)


def _curves(
    draw: ImageDraw.ImageDraw,
    font: ImageFont.FreeTypeFont,
    top: int,
    across: np.ndarray,
    values: np.ndarray,
    last: int,
    title: str,
    symbol: str,
) -> None:
    low, high = min(float(values.min()), 0.0), max(float(values.max()), 0.0)
    floor, scale = top + _PANEL - 10, (_PANEL - 32) / max(high - low, 1e-3)
    heights = floor - scale * (values - low)
    zero = floor + scale * low
    draw.line([across[0], zero, across[-1], zero], "lightgray")
    marks = {0.0: zero}
    for value, height in ((high, floor - scale * (high - low)), (low, floor)):
        if abs(height - zero) > 12:
            marks[value] = height
    for value, height in marks.items():
        draw.text((across[0] - 6, height), f"{value:.3g}", "black", font, anchor="rm")
    draw.text((across[0], top + 3), title, "black", font)
    for k, (direction, colour) in enumerate({"x": "tab:blue", "y": "tab:orange", "z": "tab:green"}.items()):
        ink = colors.to_hex(colour)
        draw.text((across[-1] - 72 + 28 * k, top + 3), f"{symbol}{direction}", ink, font)
        draw.line([*zip(across[: last + 1], heights[: last + 1, k], strict=True)], ink, 2)


def _show(axis: Axes, image: np.ndarray) -> None:
    axis.imshow(np.clip(image, 0, 1), interpolation="nearest")
    axis.set_xticks([])
    axis.set_yticks([])


def _save(figure: plt.Figure, path: Path) -> None:
    figure.set_layout_engine("constrained")
    try:
        write_whole(path, lambda temporary: figure.savefig(temporary, format="png", dpi=130))
    finally:
        plt.close(figure)
