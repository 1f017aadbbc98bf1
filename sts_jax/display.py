"""Display and storage of results: `show` draws a figure, `save` and `load` write and read one file."""

import io
import os
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike
from matplotlib.figure import Figure
from PIL import Image

from sts_jax._files import TornFileError, write_bytes
from sts_jax.evaluation.views import outside
from sts_jax.frame import Frame
from sts_jax.objects import Body
from sts_jax.physics import Trajectory
from sts_jax.prediction import Prediction
from sts_jax.sensor import Sensor

_KINDS: dict[str, type] = {kind.__name__: kind for kind in (Frame, Body, Trajectory)}
_INCH = 2.6  # height of a panel
_FORMAT = 1


class NotebookFigure(Figure):
    """A Matplotlib figure that a notebook displays without a plotting backend."""

    def _repr_png_(self) -> bytes:
        data = io.BytesIO()
        self.savefig(data, format="png")
        return data.getvalue()


def show(thing: Frame | Body | Prediction | ArrayLike, *, title: str = "") -> Figure:
    """Draw a frame, a body, a prediction or an image.

    A notebook displays the figure. Elsewhere call `figure.savefig(path)`.

    Args:
        thing: a `Frame` (both streams, depth in mm and pressure in kPa), a `Body` (a view from outside, standing on a
            pad), a `Prediction` (the predicted images) or an image `(height, width, 3)` in [0, 1]. It must be one item:
            index a batch with `jax.tree.map(lambda x: x[i], frames)`.
        title: of the figure.

    Returns:
        A Matplotlib figure.

    Raises:
        TypeError: `thing` is none of these.
        ValueError: `thing` has leading axes or no image, or an image has another shape or range.
    """
    panels = _panels(thing)
    if isinstance(thing, Body):
        title = title or repr(thing)
    height = _INCH if len(panels) > 1 else 1.5 * _INCH
    figure = NotebookFigure(figsize=(1.15 * height * len(panels), height + 0.4), layout="constrained")
    for axes, panel in zip(np.ravel(figure.subplots(1, len(panels))), panels, strict=True):
        drawn = axes.imshow(panel.values, cmap=panel.colours)
        if panel.colours is not None:
            figure.colorbar(drawn, ax=axes, shrink=0.8)
        axes.set_title(panel.name, fontsize=9)
        axes.set_axis_off()
    if title:
        figure.suptitle(title, fontsize=9)
    return figure


class _Panel(NamedTuple):
    """One image of a figure."""

    name: str
    values: np.ndarray  # an RGB image, or numbers to colour
    colours: str | None = None  # name of the colour map


def _panels(thing: Frame | Body | Prediction | ArrayLike) -> list[_Panel]:
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
    if isinstance(thing, Prediction):
        streams = {"visual": thing.visual, "tactile": thing.tactile}
        panels = [_Panel(f"predicted {name}", np.asarray(x)) for name, x in streams.items() if x is not None]
        if not panels:
            raise ValueError("the prediction has no image, because the model predicts the pose alone. Print it instead")
        for panel in panels:
            _check_single("Prediction", panel.values, 3)
        return panels
    return [_Panel("", _image(thing))]


def save(path: str | os.PathLike[str], thing: Frame | Body | Trajectory | ArrayLike) -> None:
    """Write one object to a file, completely or not at all.

    Args:
        path: `.npz` keeps all arrays of a `Frame`, a `Body` or a `Trajectory` for `load`. `.png` keeps the picture of a
            `Frame` (the visual and the tactile image side by side) or an image `(height, width, 3)` in [0, 1], with 8
            bits per channel.
        thing: the object to write.

    Raises:
        TypeError: an object of this type cannot be written to this type of file.
        ValueError: the path has another suffix, or the image has another shape or range.
        OSError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() == ".png":
        if isinstance(thing, Frame):
            _check_single("Frame", thing.depth, 2)
            image = np.concatenate([np.asarray(thing.visual), np.asarray(thing.tactile)], axis=1)
        elif isinstance(thing, Body | Prediction | Trajectory):
            remedies = ["save it as .npz"] * isinstance(thing, tuple(_KINDS.values()))
            remedies += ["draw it with sts.show(...).savefig(path)"] * (not isinstance(thing, Trajectory))
            raise TypeError(
                f"only a Frame or an image can be written to a .png file, got a {type(thing).__name__}: "
                f"{', or '.join(remedies)}"
            )
        else:
            image = _image(thing)
        data = io.BytesIO()
        Image.fromarray(np.round(255 * image).astype(np.uint8)).save(data, "png")
    elif path.suffix.lower() == ".npz":
        if not isinstance(thing, tuple(_KINDS.values())):
            raise TypeError(f"an .npz file keeps one of {', '.join(_KINDS)}, got {type(thing).__name__}")
        leaves, _ = jax.tree_util.tree_flatten_with_path(thing)
        arrays = {jax.tree_util.keystr(key, simple=True, separator="/"): np.asarray(leaf) for key, leaf in leaves}
        arrays |= {"kind": np.array(type(thing).__name__), "format": np.array(_FORMAT)}
        data = io.BytesIO()
        np.savez_compressed(data, allow_pickle=False, **arrays)
    else:
        raise ValueError(f"path is {str(path)!r}, but it must end in .npz (arrays) or .png (picture)")
    write_bytes(path, data.getvalue())


def load(path: str | os.PathLike[str]) -> Any:
    """Read the `Frame`, `Body` or `Trajectory` that `save` wrote to an `.npz` file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the path is a folder, or has another suffix than .npz.
        TornFileError: the file is damaged, or `save` did not write it.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file. Write it with sts.save")
    if path.is_dir() or path.suffix.lower() != ".npz":
        raise ValueError(f"path is {str(path)!r}, but it must be an .npz file that sts.save wrote")
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            arrays = dict(file)
        kind, version = _KINDS[str(arrays.pop("kind"))], int(arrays.pop("format"))
        if version != _FORMAT:
            raise ValueError(f"it has format {version}, but this version of sts_jax reads {_FORMAT}")
        return _built(kind, {key: jnp.asarray(value) for key, value in arrays.items()})
    except Exception as error:  # a damaged zip file raises one of many types
        reason = f"{type(error).__name__}: {error}"
        raise TornFileError(f"{path} is damaged or was not written by sts.save ({reason}). Save it again.") from error


def _built(kind: type, arrays: dict[str, Any]) -> Any:
    """Build an instance from its leaves, given by their paths. `hidden/fill` belongs to the field `hidden`."""
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
    if np.ndim(array) != rank:
        raise ValueError(
            f"the {name} has leading axes {np.shape(array)[: np.ndim(array) - rank]}. Give one item, such as "
            "jax.tree.map(lambda x: x[0], ...)"
        )


def _image(thing: Any) -> np.ndarray:
    if not isinstance(thing, np.ndarray | jax.Array):
        raise TypeError(
            f"an image must be an array, got {type(thing).__name__}. sts.show also draws a Frame, Body or Prediction"
        )
    image = np.asarray(thing)
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"the image has shape {image.shape}, but it must be (height, width, 3)")
    if image.dtype == np.uint8:
        return image / 255
    if image.dtype.kind != "f" or not (np.isfinite(image).all() and image.min() >= 0 and image.max() <= 1):
        raise ValueError(
            f"the image is {image.dtype} in [{image.min()}, {image.max()}], but it must be uint8, or floats in [0, 1]"
        )
    return image
