"""Sheets of predictions as in the paper: a column for each held-out trajectory, and a row for each kind of image."""

import io
import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from PIL import Image
from scipy.spatial import ConvexHull

from sts_jax import geometry, physics
from sts_jax.dataset import Images, Pairs
from sts_jax.evaluation.predictions import Predicted, in_unit
from sts_jax.objects import Body
from sts_jax.storage import write_bytes

STREAMS = ("visual", "tactile")
_SIDE, _TALL = 1.0, 1.05  # inches, side of an image and width of a pose, height of a pose
# Inches, width of the labels, height of a line of text and of the legend, times the scale of the sheet's text
_LABEL, _LINE, _LEGEND = 1.2, 0.17, 0.32
_FONT, _LARGEST = 8.5, 1.5  # points, size of the text, and largest scale, for wide sheets that a page shows smaller
_GAP, _APART = 0.04, 0.12  # inches, between images, and between groups of rows
_DPI = 128  # pixels per inch: a pixel of an image of 64 x 64 covers 2 x 2 pixels of the sheet
_MOST_BYTES = 280_000
_TRUE, _PREDICTED = "0.35", "tab:orange"  # colours of true and predicted images and outlines
_PAD = (0.86, 0.86, 0.92)  # colour
_AXES = ("tab:red", "tab:green", "tab:blue")  # colours of the x, y and z axis of a coordinate frame
_ARM = 0.4  # length of the axes of a coordinate frame, as a share of the pad's width
_BELOW = -0.02  # m, height of a frame below which its object has left the pad
_VIEWER = np.array([0.25, 0.53, 0.35])  # direction from the pad to the viewer of the poses


class _Row(NamedTuple):
    """A row of images, with None for an empty place."""

    label: str
    images: Sequence[np.ndarray | None]
    predicted: bool = False


def one_of_each(test: Pairs, names: Sequence[str], num: int) -> np.ndarray:
    """Choose up to `num` items for the columns of a sheet: classes and objects in turn, each with its first trajectory.

    Args:
        names: Class of each object of the collection, from `dataset.class_names`.

    Returns:
        Indices of items of `test`, int `(k,)`: first one object of each class, then a second one, and so on. If there
        are too few objects, their further trajectories follow.
    """
    order = []
    for item, index in enumerate(test.object.tolist()):
        same = test.object[:item] == index
        alike = [names[i] == names[index] for i in dict.fromkeys(test.object[:item].tolist()) if i != index]
        order.append((int(same.sum()), sum(alike), names[index], item))
    return np.array([item for *_, item in sorted(order)[:num]], np.int64)


def pose_sheet(
    path: Path,
    test: Pairs,
    predicted: Predicted,
    items: np.ndarray,
    *,
    scenario: physics.Scenario,
    names: Sequence[str],
    size: Sequence[float],
    title: str,
    bodies: Sequence[Body] | None = None,
) -> None:
    """Draw inputs, predictions and truth of some held-out trajectories, and their poses as coordinate frames.

    The predicted frame is solid, and the true frame is dashed, as in the paper. What the model does not predict is left
    out.

    Args:
        items: Indices of the trajectories in `test`, such as from `one_of_each`.
        names: Class of each object of the collection, from `dataset.class_names`.
        size: Size of the pad along x and y (m).
        bodies: The objects of `items`, such as from `dataset.make_bodies`, whose outlines are drawn too.
    """
    groups = [_inputs(test, items)]
    for stream in STREAMS:
        images = getattr(predicted, stream)
        if images is not None:
            groups.append([_Row(f"predicted {stream}", images[items], True), _true(test, stream, items)])

    def draw(axis: Axes, column: int) -> None:
        item, body = items[column], None if bodies is None else bodies[column]
        assert predicted.pose is not None
        _draw_pose(axis, np.asarray(size), test.pose[item, 1], predicted.pose[item], body)

    heads = _heads(test, items, scenario, names)
    _sheet(path, groups, heads, title, pose=None if predicted.pose is None else draw, outlines=bodies is not None)


def models_sheet(
    path: Path,
    test: Pairs,
    predicted: Mapping[str, Predicted],
    items: np.ndarray,
    *,
    scenario: physics.Scenario,
    names: Sequence[str],
    title: str,
) -> None:
    """Draw inputs, truth and the predictions of several models. Arguments as for `pose_sheet`, predictions by model."""
    groups = [_inputs(test, items)]
    for stream in STREAMS:
        images = {model: getattr(one, stream) for model, one in predicted.items()}
        rows = [_Row(f"{model}\n{stream}", x[items], True) for model, x in images.items() if x is not None]
        groups += [[_true(test, stream, items), *rows]] if rows else []
    _sheet(path, groups, _heads(test, items, scenario, names), title)


def crossed_sheet(
    path: Path,
    test: Pairs,
    from_touch: Predicted,
    from_vision: Predicted,
    items: np.ndarray,
    *,
    scenario: physics.Scenario,
    names: Sequence[str],
    title: str,
) -> None:
    """Draw vision predicted from touch alone, and touch from vision alone. Arguments as for `pose_sheet`."""
    vision, touch = _inputs(test, items)
    if from_touch.visual is None or from_vision.tactile is None:
        raise ValueError(
            "from_touch.visual or from_vision.tactile is None: give predictions of a model of both streams"
        )
    groups = [
        [touch, _Row("visual\nfrom touch alone", from_touch.visual[items], True), _true(test, "visual", items)],
        [vision, _Row("tactile\nfrom vision alone", from_vision.tactile[items], True), _true(test, "tactile", items)],
    ]
    _sheet(path, groups, _heads(test, items, scenario, names), title)


def rollout_strip(
    path: Path,
    time: np.ndarray,
    images: Images,
    rolled: Sequence[Predicted],
    item: int,
    *,
    stride: int = 1,
    direct: Predicted | None = None,
    num: int = 10,
    title: str = "",
) -> None:
    """Draw the roll-out of a one-step model beside the truth, at times that are denser at the beginning.

    Args:
        time: Times of the frames of the trajectory (s).
        images: Its true images, from `dataset.Dataset.strip`.
        rolled: The predictions of successive steps, from `evaluation.rollout`.
        item: Index of the trajectory in `rolled` and `direct`.
        stride: Number of frames in a step.
        direct: Predictions of the last frame from the first one, by another model. They have their own column.
        num: Largest number of frames of the roll-out.
    """
    if stride * len(rolled) >= len(time):
        raise ValueError(
            f"the roll-out has {len(rolled)} steps of {stride} frames, but the trajectory has {len(time)} frames: give "
            f"at most {(len(time) - 1) // stride} steps"
        )
    chosen = np.unique(np.round(1 + (len(rolled) - 1) * np.linspace(0, 1, num) ** 1.8).astype(int))
    frames = [0, *(stride * chosen).tolist()]
    heads = [f"{time[t]:.2f} s" for t in frames]
    heads[0] += "\ninput"
    if direct is not None:
        frames.append(len(time) - 1)
        heads.append(f"{time[-1]:.2f} s\ndirect")
    groups = []
    for stream in STREAMS:
        steps = [getattr(rolled[k - 1], stream) for k in chosen]
        if any(step is None for step in steps):
            continue
        predicted: list[np.ndarray | None] = [None, *(step[item] for step in steps)]
        if direct is not None:
            end = getattr(direct, stream)
            predicted.append(None if end is None else end[item])
        groups.append(
            [_Row(f"true {stream}", getattr(images, stream)[frames]), _Row(f"predicted {stream}", predicted, True)]
        )
    _sheet(path, groups, heads, title, last_apart=direct is not None)


def _inputs(test: Pairs, items: np.ndarray) -> list[_Row]:
    return [_Row(f"{stream} input", getattr(test, stream)[items, 0]) for stream in STREAMS]


def _true(test: Pairs, stream: str, items: np.ndarray) -> _Row:
    return _Row(f"true {stream}", getattr(test, stream)[items, 1])


def _heads(test: Pairs, items: np.ndarray, scenario: physics.Scenario, names: Sequence[str]) -> list[str]:
    return [f"{names[test.object[item]]}\n{scenario.named(int(test.outcome[item]))}" for item in items]


def _sheet(
    path: Path,
    groups: Sequence[Sequence[_Row]],
    heads: Sequence[str],
    title: str,
    *,
    pose: Callable[[Axes, int], None] | None = None,
    outlines: bool = False,
    last_apart: bool = False,
) -> None:
    """Write a sheet with groups of rows. `pose` draws the pose of a column, `last_apart` sets the last column apart."""
    scale = min(max(len(heads) / 7, 1), _LARGEST)
    label_width = scale * _LABEL
    width = label_width + len(heads) * (_SIDE + _GAP) + _APART
    wrapped = textwrap.fill(title, int(13 * width / scale))  # about thirteen letters fit into an inch
    above = scale * _LINE * (2.8 + wrapped.count("\n") + max(head.count("\n") for head in heads))
    images = sum(len(rows) * (_SIDE + _GAP) + _APART for rows in groups)
    legend = _legend(outlines)
    lines = math.ceil(len(legend) / max(int(width / scale), 2))  # an entry needs about an inch
    height = above + images + (0 if pose is None else _TALL + scale * (_LEGEND + _LINE * (lines - 1)))
    figure = plt.figure(figsize=(width, height))

    def left(column: int) -> float:
        return label_width + column * (_SIDE + _GAP) + _APART * (last_apart and column == len(heads) - 1)

    def add(column: int, top: float, tall: float) -> Axes:
        axis = figure.add_axes((left(column) / width, 1 - (top + tall) / height, _SIDE / width, tall / height))
        axis.set_xticks([])
        axis.set_yticks([])
        return axis

    def name(text: str, middle: float, colour: str) -> None:
        place = ((label_width - 0.08) / width, 1 - middle / height)
        figure.text(*place, text, ha="right", va="center", fontsize=scale * _FONT, color=colour)

    figure.text(0.5, 1 - 0.08 / height, wrapped, ha="center", va="top", fontsize=scale * 10)
    top = above
    for rows in groups:
        for label, pictures, predicted in rows:
            colour = _PREDICTED if predicted else _TRUE
            name(label, top + _SIDE / 2, "tab:orange" if predicted else "black")
            for column, image in enumerate(pictures):
                if image is None:
                    continue
                axis = add(column, top, _SIDE)
                axis.imshow(np.clip(in_unit(image), 0, 1), interpolation="nearest")
                axis.spines[:].set(color=colour, linewidth=1.5 if predicted else 0.8)
            top += _SIDE + _GAP
        top += _APART
    for column, head in enumerate(heads):
        place = ((left(column) + _SIDE / 2) / width, 1 - (above - 0.05) / height)
        figure.text(*place, head, ha="center", va="bottom", fontsize=scale * _FONT)
    if pose is not None:
        name("pose", top + _TALL / 2, "black")
        for column in range(len(heads)):
            pose(add(column, top, _TALL), column)
        look = {"fontsize": scale * _FONT, "ncols": math.ceil(len(legend) / lines), "labelspacing": 0.2}
        figure.legend(handles=legend, loc="lower center", frameon=False, borderaxespad=0.2, **look)
    _save(figure, path)


def _draw_pose(axis: Axes, size: np.ndarray, true: np.ndarray, predicted: np.ndarray, body: Body | None) -> None:
    """Draw the pad, and both poses as coordinate frames, obliquely from above in parallel projection."""
    forward = -_VIEWER / np.linalg.norm(_VIEWER)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    onto = np.stack([right, np.cross(right, forward)], 1)
    pad = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [*size / 2, 0] @ onto
    axis.add_patch(Polygon(pad, facecolor=_PAD, edgecolor="0.6", linewidth=0.8))
    reach, low, left = 1.04 * np.abs(pad[:, 0]).max(), 1.06 * pad[:, 1].min(), []
    looks: tuple[tuple[str, np.ndarray, str, dict[str, Any]], ...] = (
        ("predicted", predicted, _PREDICTED, {"linewidth": 3.2, "alpha": 0.55, "solid_capstyle": "round"}),
        ("true", true, _TRUE, {"linewidth": 1.3, "linestyle": (0, (2.2, 1.1))}),
    )
    for which, pose, colour, look in looks:
        place, turn = pose[:3].astype(np.float64), np.asarray(geometry.quat_to_matrix(jnp.asarray(pose[3:])))
        if body is not None:
            for part in np.unique(np.asarray(body.hulls, np.float64), axis=0):
                points = (part @ turn.T + place) @ onto
                outline = points[ConvexHull(points).vertices]
                axis.add_patch(Polygon(outline, fill=which == "true", facecolor="0.75", edgecolor=colour, alpha=0.6))
        for k, tint in enumerate(_AXES):
            arm = np.stack([place, place + _ARM * size.min() * turn[:, k]]) @ onto
            axis.plot(*arm.T, color=tint, **look)
        if (np.abs(place[:2]) > size / 2).any() or place[2] < _BELOW:
            left.append(which)
    axis.set_xlim(-reach, reach)
    axis.set_ylim(low, low + 2 * reach * _TALL / _SIDE)
    if left:
        text = f"{' and '.join(left)}:\noff the pad"
        axis.text(0.5, 0.98, text, ha="center", va="top", fontsize=_FONT, transform=axis.transAxes)
    axis.spines[:].set(color="0.8", linewidth=0.8)


def _legend(outlines: bool) -> list[Artist]:
    handles: list[Artist] = [
        Line2D([], [], color="0.3", linewidth=3.2, alpha=0.55, label="predicted frame"),
        Line2D([], [], color="0.3", linewidth=1.3, linestyle=(0, (2.2, 1.1)), label="true frame"),
        *(Line2D([], [], color=colour, linewidth=2, label=name) for name, colour in zip("xyz", _AXES, strict=True)),
    ]
    if outlines:
        handles.insert(1, Patch(facecolor="none", edgecolor=_PREDICTED, label="predicted outline"))
        handles.insert(3, Patch(facecolor="0.75", edgecolor=_TRUE, label="true outline"))
    return handles


def _save(figure: plt.Figure, path: Path) -> None:
    """Write a sheet as a PNG file, with 256 colours if it would be large otherwise, and close it."""
    buffer = io.BytesIO()
    try:
        figure.savefig(buffer, format="png", dpi=_DPI, pil_kwargs={"optimize": True})
    finally:
        plt.close(figure)
    if buffer.tell() > _MOST_BYTES:
        few = Image.open(buffer).convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, 2, dither=Image.Dither.NONE)
        buffer = io.BytesIO()
        few.save(buffer, "png", optimize=True)
    write_bytes(path, buffer.getvalue())
