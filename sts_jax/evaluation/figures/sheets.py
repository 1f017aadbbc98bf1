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

from sts_jax import geometry, optics, physics
from sts_jax.dataset import Images, Pairs
from sts_jax.evaluation.figures.outlines import COLOUR, draw_outlines
from sts_jax.evaluation.predictions import Predicted, in_unit
from sts_jax.objects import Body
from sts_jax.storage import write_bytes

STREAMS = ("visual", "tactile")
SAMPLES = 4  # number of samples that are shown for each prediction
_SIDE, _TALL = 1.0, 1.05  # inches, side of an image and width of a pose, height of a pose
_SMALL = 0.5  # inches, side of a mean below samples
# Inches, width of the labels, height of a line of text and of the legend, times the scale of the sheet's text
_LABEL, _LINE, _LEGEND = 1.2, 0.17, 0.32
_FONT, _LARGEST = 8.5, 1.5  # points, size of the text, and largest scale, for wide sheets that a page shows smaller
_GAP, _APART = 0.04, 0.12  # inches, between images, and between groups of rows
_DPI = 128  # pixels per inch: a pixel of an image of 64 x 64 covers 2 x 2 pixels of the sheet
_MOST_BYTES = 280_000
_TRUE, _PREDICTED = "0.35", COLOUR  # colours of true and predicted images and outlines
_ARROW = {"arrowstyle": "->", "color": "red"}
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
    small: bool = False
    over: Callable[[Axes, int], None] | None = None  # draws over the image of a column


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
    camera: optics.Camera | None = None,
) -> None:
    """Draw inputs, truth and predictions of some held-out trajectories, and their poses as coordinate frames.

    A prediction with samples is drawn as four samples, and its mean is small. The predicted frame is solid, and the
    true frame is dashed, as in the paper. What the model does not predict is left out, and so are tactile inputs if
    nothing touches the pad. A red arrow on the visual input is `Scenario.drift`, the velocity over the pad that a
    frictionless object receives. A quarter of the image is 1 m/s.

    Args:
        items: Indices of the trajectories in `test`, such as from `one_of_each`.
        names: Class of each object of the collection, from `dataset.class_names`.
        size: Size of the pad along x and y (m).
        bodies: The objects of `items`, such as from `dataset.make_bodies`, whose outlines are drawn too.
        camera: Camera of the sensor, to draw the outlines at sampled poses over the visual input as well. None for
            images that are cropped to the object.
    """
    drift = np.stack([scenario.drift(jnp.asarray(condition)) for condition in test.condition[items]])
    shape, ends = test.visual.shape[2:4], (predicted.samples or predicted).pose
    vision, touch = _inputs(test, items)

    def over(axis: Axes, column: int) -> None:
        if camera is not None and bodies is not None and ends is not None:
            window, poses = optics.full_window(camera, shape), ends[..., items[column], :].reshape(-1, 7)
            draw_outlines(axis, camera, bodies[column], poses, window=window, shape=shape)
        if drift[column].any():
            middle = np.array([shape[1] - 1, shape[0] - 1]) / 2
            axis.annotate("", tuple(middle + drift[column] * shape[1] / 4), tuple(middle), arrowprops=_ARROW)

    if camera is not None and bodies is not None and ends is not None:
        vision = vision._replace(label="visual input and\npredicted ends")
    groups = [[vision._replace(over=over), *([touch] if test.contact[items, 0].any() else [])]]
    for stream in STREAMS:
        if getattr(predicted, stream) is not None:
            groups.append([_true(test, stream, items), *_predicted(predicted, stream, items)])

    def draw(axis: Axes, column: int) -> None:
        item, body = items[column], None if bodies is None else bodies[column]
        assert predicted.pose is not None
        _draw_pose(axis, np.asarray(size), test.pose[item, 1], predicted.pose[item], body)

    if drift.any():
        title += ". Red arrow: velocity over the pad that a freely sliding object receives"
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
        given = {model: one for model, one in predicted.items() if getattr(one, stream) is not None}
        rows = [row for model, one in given.items() for row in _predicted(one, stream, items, f"{model}\n{stream}")]
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
        [touch, _true(test, "visual", items), *_predicted(from_touch, "visual", items, "visual\nfrom touch alone")],
        [
            vision,
            _true(test, "tactile", items),
            *_predicted(from_vision, "tactile", items, "tactile\nfrom vision alone"),
        ],
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
    steps, groups = [rolled[k - 1] for k in chosen], []
    every = steps if direct is None else [*steps, direct]
    for stream in STREAMS:
        if any(getattr(step, stream) is None for step in steps):
            continue
        parts = [_predicted(one, stream, np.array([item])) if getattr(one, stream) is not None else [] for one in every]
        rows = [_Row(f"true {stream}", getattr(images, stream)[frames])]
        *samples, mean = parts[0]
        for k, row in enumerate(samples):
            drawn = [part[k].images[0] if k + 1 < len(part) else None for part in parts]
            rows.append(row._replace(images=[None, *drawn]))
        rows.append(mean._replace(images=[None, *(part[-1].images[0] if part else None for part in parts)]))
        groups.append(rows)
    _sheet(path, groups, heads, title, last_apart=direct is not None)


def _inputs(test: Pairs, items: np.ndarray) -> list[_Row]:
    return [_Row(f"{stream} input", getattr(test, stream)[items, 0]) for stream in STREAMS]


def _true(test: Pairs, stream: str, items: np.ndarray) -> _Row:
    return _Row(f"true {stream}", getattr(test, stream)[items, 1])


def _predicted(predicted: Predicted, stream: str, items: np.ndarray, label: str = "") -> list[_Row]:
    """The rows of a prediction: the first samples and a small mean, or the mean alone."""
    mean, samples = getattr(predicted, stream)[items], getattr(predicted.samples, stream, None)
    if samples is None:
        return [_Row(label or f"predicted {stream}", mean, True)]
    head = f"{label}\n" if label else f"{stream} "
    rows = [_Row(f"{head}sample {k + 1}", sample[items], True) for k, sample in enumerate(samples[:SAMPLES])]
    return [*rows, _Row(f"{head}mean", mean, True, small=True)]


def _heads(test: Pairs, items: np.ndarray, scenario: physics.Scenario, names: Sequence[str]) -> list[str]:
    """The class and the number of each trajectory, and how it ends."""
    ends = [scenario.named(int(outcome)) for outcome in test.outcome[items]]
    which = zip(test.object[items], test.trajectory[items], ends, strict=True)
    return [f"{names[index]}\n#{trajectory}\n{end}" for index, trajectory, end in which]


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
    images = sum(sum(_side(row) + _GAP for row in rows) + _APART for rows in groups)
    legend = _legend(outlines)
    lines = math.ceil(len(legend) / max(int(width / scale), 2))  # an entry needs about an inch
    height = above + images + (0 if pose is None else _TALL + scale * (_LEGEND + _LINE * (lines - 1)))
    figure = plt.figure(figsize=(width, height))

    def left(column: int) -> float:
        return label_width + column * (_SIDE + _GAP) + _APART * (last_apart and column == len(heads) - 1)

    def add(column: int, top: float, wide: float, tall: float) -> Axes:
        start = left(column) + (_SIDE - wide) / 2
        axis = figure.add_axes((start / width, 1 - (top + tall) / height, wide / width, tall / height))
        axis.set_xticks([])
        axis.set_yticks([])
        return axis

    def name(text: str, middle: float, colour: str) -> None:
        place = ((label_width - 0.08) / width, 1 - middle / height)
        figure.text(*place, text, ha="right", va="center", fontsize=scale * _FONT, color=colour)

    figure.text(0.5, 1 - 0.08 / height, wrapped, ha="center", va="top", fontsize=scale * 10)
    top = above
    for rows in groups:
        for row in rows:
            side, colour = _side(row), _PREDICTED if row.predicted else _TRUE
            name(row.label, top + side / 2, _PREDICTED if row.predicted else "black")
            for column, image in enumerate(row.images):
                if image is None:
                    continue
                axis = add(column, top, side, side)
                axis.imshow(np.clip(in_unit(image), 0, 1), interpolation="nearest")
                axis.spines[:].set(color=colour, linewidth=1.5 if row.predicted else 0.8)
                if row.over is not None:
                    row.over(axis, column)
            top += side + _GAP
        top += _APART
    for column, head in enumerate(heads):
        place = ((left(column) + _SIDE / 2) / width, 1 - (above - 0.05) / height)
        figure.text(*place, head, ha="center", va="bottom", fontsize=scale * _FONT)
    if pose is not None:
        name("pose", top + _TALL / 2, "black")
        for column in range(len(heads)):
            pose(add(column, top, _SIDE, _TALL), column)
        look = {"fontsize": scale * _FONT, "ncols": math.ceil(len(legend) / lines), "labelspacing": 0.2}
        figure.legend(handles=legend, loc="lower center", frameon=False, borderaxespad=0.2, **look)
    _save(figure, path)


def _side(row: _Row) -> float:
    """Side of the images of a row (inches)."""
    return _SMALL if row.small else _SIDE


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
    picture = Image.open(buffer).convert("RGB")
    for method in (Image.Quantize.MEDIANCUT, Image.Quantize.MAXCOVERAGE):  # the second one has coarser greys
        if buffer.tell() > _MOST_BYTES:
            buffer = io.BytesIO()
            picture.quantize(256, method, 2).save(buffer, "png", optimize=True)
    write_bytes(path, buffer.getvalue())
