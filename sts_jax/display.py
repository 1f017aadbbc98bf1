"""`show` draws a figure of a result, `save` writes a result to a file, and `load` reads it."""

import io
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike
from matplotlib.figure import Figure
from PIL import Image

from sts_jax import optics
from sts_jax._checked import check_arrays
from sts_jax.evaluation import STREAMS
from sts_jax.evaluation.figures import SAMPLES, draw_outlines
from sts_jax.evaluation.figures.motion import outside
from sts_jax.frame import Frame
from sts_jax.objects import Body
from sts_jax.physics import Trajectory
from sts_jax.prediction import Prediction
from sts_jax.sensor import Sensor
from sts_jax.storage import DamagedFileError, write_bytes

_Place = tuple[str, np.ndarray | None]  # name of an image, and the image
_KINDS: dict[str, type] = {kind.__name__: kind for kind in (Frame, Body, Trajectory)}
_INCH = 2.6  # height of a panel (inches)
_MOST = 4  # largest number of panels side by side
_STRIP = 12.0  # largest width of a strip of frames (inches)
_WIDE = 2.5  # least width of a strip in multiples of its height
_CELL, _SMALL = 1.7, 0.5  # side of an image of a prediction (inches), and that of a mean beside samples as its share
_FORMAT = 1  # version of the layout of .npz files


class NotebookFigure(Figure):
    """A Matplotlib figure that a notebook displays without a plotting backend."""

    def _repr_png_(self) -> bytes:
        data = io.BytesIO()
        self.savefig(data, format="png")
        return data.getvalue()


def show(
    thing: Frame | Body | Prediction | ArrayLike,
    *,
    title: str = "",
    given: Frame | Mapping[str, ArrayLike] | None = None,
    truth: Frame | Mapping[str, ArrayLike] | None = None,
    body: Body | None = None,
    sensor: Sensor | None = None,
) -> Figure:
    """Draw a frame, a body, a prediction or an image. A notebook displays the figure; elsewhere call `figure.savefig`.

    A prediction has one row for each stream: the input, the truth, up to four samples, and the mean. A mean over
    uncertain ends is blurred, and each sample is one possible end: predict with `num_samples` to see them. A roll-out
    has one strip of its steps for each of these images.

    Args:
        thing: One item. A `Frame` gives its visual and tactile image, depth (mm) and pressure (kPa), a `Body` an
            outside view on a pad, and a `Prediction` its images. An array (height, width, 3) of floats in [0, 1] or
            uint8 is an image. Images (n, height, width, 3), and the steps of a roll-out, are drawn side by side. Select
            item i of a batch with `jax.tree.map(lambda x: x[i], frames)`.
        title: Title of the figure. By default, the description of a `Body`, and no title otherwise.
        given: First frame, from which a `Prediction` was made: a `Frame`, or a mapping with the image `visual`,
            `tactile` or both. None draws no input.
        truth: True last frame, like `given`. For a roll-out, frames (steps, height, width, 3).
        body: Object whose outlines at up to 16 predicted poses are drawn over the visual image of `given`. For a
            roll-out, those of the last step.
        sensor: Sensor of `given`, whose camera sees the outlines. None: `Sensor()`.
    """
    if isinstance(thing, Prediction):
        figure = _prediction(thing, given, truth, body, sensor or Sensor())
    else:
        if named := [name for name, x in (("given", given), ("truth", truth), ("body", body)) if x is not None]:
            raise ValueError(f"{named[0]} is drawn beside a Prediction, but `thing` is a {type(thing).__name__}")
        figure = _row(_panels(thing))
        if isinstance(thing, Body):
            title = title or repr(thing)
    if title:
        figure.suptitle(title, fontsize=9)
    return figure


def _row(panels: Sequence["_Panel"]) -> Figure:
    """A figure with panels side by side. Strips are stacked."""
    height = _INCH if len(panels) > 1 else 1.5 * _INCH
    rows, columns, size = 1, len(panels), (1.15 * height * len(panels), height + 0.4)
    aspect = max(panel.values.shape[1] / panel.values.shape[0] for panel in panels)
    if stacked := aspect > _WIDE or len(panels) > _MOST:
        width = min(_STRIP, _INCH * aspect)
        rows, columns, size = len(panels), 1, (width, (width / aspect + 0.3) * len(panels) + 0.4)
    figure = NotebookFigure(figsize=size, layout="constrained")
    for axes, panel in zip(np.ravel(figure.subplots(rows, columns)), panels, strict=True):
        drawn = axes.imshow(panel.values, cmap=panel.colours)
        if panel.colours is not None:
            figure.colorbar(drawn, ax=axes, shrink=0.8)
        axes.set_title(panel.name, fontsize=9)
        axes.set_axis_off()
        axes.set_anchor("W" if stacked else "C")
    return figure


class _Panel(NamedTuple):
    """One image of a figure."""

    name: str
    values: np.ndarray  # RGB image, or one number per pixel
    colours: str | None = None  # name of the colour map, None for an RGB image


def _panels(thing: Frame | Body | ArrayLike) -> list[_Panel]:
    """The images of the figure of an item."""
    if isinstance(thing, Frame):
        _check_single("Frame", thing.depth, 2)
        seen = np.where(np.asarray(thing.segmentation), 1e3 * np.asarray(thing.depth), np.nan)
        return [
            _Panel("visual", np.asarray(thing.visual)),
            _Panel("tactile", np.asarray(thing.tactile)),
            _Panel("depth (mm)", seen, "viridis_r"),
            _Panel("pressure (kPa)", np.asarray(thing.pressure) / 1e3, "magma"),
        ]
    if isinstance(thing, Body):
        _check_single("Body", thing.vertices, 2)
        low, high = thing.vertices.min(0), thing.vertices.max(0)
        middle = (low + high) / 2
        pose = jnp.array([-middle[0], -middle[1], -low[2], 1, 0, 0, 0])
        return [_Panel("", np.asarray(outside(thing, pose, jnp.asarray(Sensor().gel.size), resolution=(400, 400))))]
    return [_Panel("", _image(_strip(thing)))]


def _prediction(
    prediction: Prediction,
    given: Frame | Mapping[str, ArrayLike] | None,
    truth: Frame | Mapping[str, ArrayLike] | None,
    body: Body | None,
    sensor: Sensor,
) -> Figure:
    """The figure of a prediction, see `show`."""
    means = {name: np.asarray(x) for name in STREAMS if (x := getattr(prediction, name)) is not None}
    if not means:
        raise ValueError("the prediction has no image, because its model predicts none: print it instead")
    steps = next(iter(means.values())).shape[:-3]
    if len(steps) > 1:
        _check_single("Prediction", next(iter(means.values())), 3)
    inputs, truths = _streams("given", given, ()), _streams("truth", truth, steps)
    rows = dict[str, list[_Place]]()
    for name, mean in means.items():
        drawn = () if prediction.samples is None else np.asarray(getattr(prediction.samples, name))[:SAMPLES]
        row: list[_Place] = [(head, x.get(name)) for head, x in (("input", inputs), ("truth", truths)) if x]
        row += [(f"sample {k + 1}", _strip(sample)) for k, sample in enumerate(drawn)]
        rows[name] = [*row, ("mean" if len(drawn) else "predicted", _strip(mean))]
    if max(map(len, rows.values())) == 1 or math.prod(steps) > 1:
        figure = _row([_Panel(f"{k}: {head}", x) for k, row in rows.items() for head, x in row if x is not None])
    else:
        figure = _grid(rows)
    if body is not None:
        _check_single("Body", body.vertices, 2)
        poses = prediction.pose if prediction.samples is None else prediction.samples.pose
        needed = {"a predicted pose": poses is not None, "a predicted visual image": "visual" in rows}
        needed["a visual image in `given`"] = "visual" in inputs
        if not all(needed.values()):
            lacking = next(name for name, there in needed.items() if not there)
            raise ValueError(f"the outlines of `body` need {lacking}, which is missing: leave out `body`")
        shape = inputs["visual"].shape[:2]
        window = given.window if isinstance(given, Frame) else optics.full_window(sensor.camera, shape)
        ends = np.asarray(poses).reshape(-1, *steps, 7)
        draw_outlines(figure.axes[0], sensor.camera, body, ends[:, -1] if steps else ends, window=window, shape=shape)
    return figure


def _streams(
    argument: str, value: Frame | Mapping[str, ArrayLike] | None, steps: tuple[int, ...]
) -> dict[str, np.ndarray]:
    """The images of both streams in the argument `given` or `truth`, with one frame for each of the steps."""
    if value is None:
        return {}
    every = value if isinstance(value, Mapping) else {name: getattr(value, name, None) for name in STREAMS}
    images: dict[str, Any] = {name: every[name] for name in STREAMS if every.get(name) is not None}
    if not images:
        raise TypeError(
            f"`{argument}` is a {type(value).__name__} without images: give a Frame, or a mapping with the image "
            "`visual`, `tactile` or both"
        )
    for name, image in images.items():
        if np.shape(image)[:-3] not in (steps, steps if math.prod(steps) > 1 else ()):
            raise ValueError(
                f"the {name} image of `{argument}` has shape {np.shape(image)}, but it must be "
                f"({', '.join([*map(str, steps), 'height', 'width', '3'])})"
            )
    return {name: _image(_strip(image)) for name, image in images.items()}


def _grid(rows: Mapping[str, Sequence[_Place]]) -> Figure:
    """A figure with a row of images for each stream. The mean beside samples is small."""
    heads = [head for head, _ in next(iter(rows.values()))]
    widths = [_SMALL if head == "mean" else 1 for head in heads]
    size = (_CELL * (sum(widths) + 0.2), _CELL * len(rows) + 0.4)
    figure = NotebookFigure(figsize=size, layout="constrained")
    grid = figure.subplots(len(rows), len(heads), squeeze=False, width_ratios=widths)
    for line, (name, row) in zip(grid, rows.items(), strict=True):
        line[0].set_ylabel(name, fontsize=9)
        for axes, (_, image) in zip(line, row, strict=True):
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
            if image is not None:
                axes.imshow(image)
    for axes, head in zip(grid[0], heads, strict=True):
        axes.set_title(head, fontsize=9)
    return figure


def _strip(images: Any) -> Any:
    """Join images (n, height, width, 3) side by side. Anything else stays as it is."""
    return np.concatenate(np.asarray(images), axis=1) if np.ndim(images) == 4 and len(images) else images


def save(path: str | os.PathLike[str], thing: Frame | Body | Trajectory | ArrayLike) -> None:
    """Write a frame, body, trajectory or image to a file, atomically.

    Args:
        path: A path that ends in `.npz` for all arrays of a `Frame`, a `Body` or a `Trajectory`, which `load` reads, or
            in `.png` for an image, or for the visual and the tactile image of a `Frame` side by side.
        thing: Item to write. An image is an array (height, width, 3) of floats in [0, 1] or uint8.
    """
    path = Path(path)
    if path.suffix.lower() == ".png":
        if isinstance(thing, Frame):
            _check_single("Frame", thing.depth, 2)
            image = np.concatenate([np.asarray(thing.visual), np.asarray(thing.tactile)], axis=1)
        else:
            image = _image(thing)
        data = io.BytesIO()
        Image.fromarray(np.round(255 * image).astype(np.uint8)).save(data, "png")
    elif path.suffix.lower() == ".npz":
        if not isinstance(thing, tuple(_KINDS.values())):
            raise TypeError(
                f"`thing` is a {type(thing).__name__}, but only a {', '.join(_KINDS)} can be written to an .npz file: "
                "write an image to a .png file, and other arrays with np.savez"
            )
        leaves, _ = jax.tree_util.tree_flatten_with_path(thing)
        arrays = {jax.tree_util.keystr(key, simple=True, separator="/"): np.asarray(leaf) for key, leaf in leaves}
        _check_stored(type(thing), arrays)
        arrays |= {"kind": np.array(type(thing).__name__), "format": np.array(_FORMAT)}
        data = io.BytesIO()
        np.savez_compressed(data, allow_pickle=False, **arrays)
    else:
        raise ValueError(f"path must end in .npz (Frame, Body, Trajectory) or .png (Frame, image), got {str(path)!r}")
    write_bytes(path, data.getvalue())


def load(path: str | os.PathLike[str]) -> Any:
    """Read the `Frame`, `Body` or `Trajectory` from an `.npz` file that `save` wrote."""
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    if path.is_dir() or path.suffix.lower() != ".npz":
        raise ValueError(f"path is {str(path)!r}, but it must be an .npz file that sts.save wrote")
    data = path.read_bytes()
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = dict(file)
        kind, version = _KINDS[str(arrays.pop("kind"))], int(arrays.pop("format"))
        if version != _FORMAT:
            raise ValueError(f"the file has format {version}, but this version of sts_jax reads format {_FORMAT}")
        if kind is Frame and "segmentation" in arrays:  # a file from before frames of several bodies
            arrays.setdefault("body", np.where(arrays["segmentation"], 0, -1))
        _check_stored(kind, arrays)
        return _built(kind, {key: jnp.asarray(value) for key, value in arrays.items()})
    except Exception as error:  # A damaged zip file raises exceptions of many types.
        reason = f"{type(error).__name__}: {error}"
        raise DamagedFileError(
            f"{path} is damaged or was not written by this version of sts.save ({reason}). Save the item again."
        ) from error


def _check_stored(kind: type, arrays: dict[str, Any]) -> None:
    """Raise a ValueError unless these are the arrays of a frame, body or trajectory."""
    if kind is Frame and {"pose", "balanced"} <= arrays.keys():  # `sense` returns an invalid pose unchanged
        arrays = arrays | {"pose": np.where(np.asarray(arrays["balanced"])[..., None], arrays["pose"], 0)}
    check_arrays(kind, arrays, infinite=("depth",))
    if kind is Body and np.ndim(arrays["vertices"]) == 2:
        _built(Body, {name: jnp.asarray(array) for name, array in arrays.items()}).check()


def _built(kind: type, arrays: dict[str, Any]) -> Any:
    """Build an instance from its leaves by their paths, such as `hidden/fill` for the leaf `fill` of field `hidden`."""
    fields: dict[str, Any] = {}
    for key, value in arrays.items():
        name, _, rest = key.partition("/")
        if rest:
            fields.setdefault(name, {})[rest] = value
        else:
            fields[name] = value
    nested = {name: kind.__annotations__[name](**value) for name, value in fields.items() if isinstance(value, dict)}
    return kind(**(fields | nested))


def _check_single(name: str, array: Any, rank: int) -> None:
    """Raise a ValueError if an array of a single item, which has `rank` axes, has leading axes."""
    if np.ndim(array) != rank:
        raise ValueError(
            f"the {name} has leading axes {np.shape(array)[: np.ndim(array) - rank]}, but a single item is needed: "
            "select one with jax.tree.map(lambda x: x[0], batch)"
        )


def _image(thing: Any) -> np.ndarray:
    """Check that an argument is an RGB image, and return it as floats in [0, 1]."""
    if not isinstance(thing, np.ndarray | jax.Array):
        raise TypeError(
            f"`thing` is a {type(thing).__name__}, but `show` draws a Frame, a Body, a Prediction or an image (height, "
            "width, 3), and a .png file has a Frame or an image"
        )
    image = np.asarray(thing)
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"the image has shape {image.shape}, but it must be (height, width, 3)")
    if image.dtype == np.uint8:
        return image / 255
    if image.dtype.kind != "f" or not (np.isfinite(image).all() and image.min() >= 0 and image.max() <= 1):
        raise ValueError(
            f"the image must be uint8 or floats in [0, 1], got {image.dtype} in [{image.min()}, {image.max()}]"
        )
    return image
