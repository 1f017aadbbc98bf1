"""A trained model as a function from any subset of vision, touch and pose to a prediction of the last moment."""

import dataclasses
import functools
import importlib.resources
import math
import operator
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray

from sts_jax import _files, mvae, statespace, training

MODALITIES = ("visual", "tactile", "pose")
MODELS = Path(str(importlib.resources.files("sts_jax"))) / "models"  # the models of the library, one folder each
_QUAT_TOLERANCE = 1e-2  # largest deviation of a quaternion's length from 1
_FARTHEST = 10.0  # m, largest coordinate of a position (larger numbers cannot be metres)
_LARGEST_CONDITION = 100.0  # largest condition, in units of its usual size
_POSES = 64  # samples of the final pose, from which the prediction of a state-space model is chosen
_DRAWN = 16  # samples that are drawn as images if `num_samples` is 0 (the predicted images are their means)
_TURN = 0.02  # m, weight of one radian in the choice of the pose


class Prediction(NamedTuple):
    """A predicted last moment. Modalities that the model lacks are None."""

    visual: Float[Array, "*n h w 3"] | None  # [0, 1]
    tactile: Float[Array, "*n h w 3"] | None  # [0, 1]
    pose: Float[Array, "*n 7"] | None  # m, unit quaternion with w >= 0, mesh frame in the sensor frame
    mean: Float[Array, "*n latent"]  # mean of the fused posterior
    log_var: Float[Array, "*n latent"]  # its log variance
    samples: "Prediction | None" = None  # samples on a leading axis, each from its own latent
    # Probability of each of the scenario's `outcomes`, in their order (None for a model of the paper's kind)
    outcome_probability: Float[Array, "*n outcomes"] | None = None

    def __repr__(self) -> str:
        shapes = (
            f"{name}={leaf.dtype}{list(leaf.shape)}" if isinstance(leaf, jax.Array | np.ndarray) else f"{name}={leaf!r}"
            for name, leaf in zip(self._fields, self, strict=True)
        )
        return f"Prediction({', '.join(shapes)})"


@functools.partial(jax.jit, static_argnames=("graphdef", "preprocessing", "num_samples", "shape"))
def predict(
    graphdef: nnx.GraphDef,
    state: nnx.State,
    preprocessing: training.Preprocessing,
    blank: Float[Array, "h w 3"],
    inputs: dict[str, Float[Array, "..."]],
    present: dict[str, Bool[Array, "*n"]],
    condition: Float[Array, "..."] | None = None,
    key: PRNGKeyArray | None = None,
    num_samples: int = 0,
    shape: tuple[int, ...] = (),
) -> Prediction:
    """Predict with a model of the paper's kind, from the mean of the fused posterior.

    The function is pure, and is compiled once per shape and subset of the inputs.

    Args:
        graphdef: The model's definition.
        state: Its parameters and running batch statistics.
        preprocessing: The preprocessing of its training.
        blank: The tactile image of the untouched sensor, [0, 1].
        inputs: Some of `visual`, `tactile` `(*n, height, width, 3)` in [0, 1] and `pose` `(*n, 7)`.
        present: Which items of an input count, `(*n,)` (default: all). A touch without contact never counts, unless
            the model was trained with blank images as inputs.
        condition: `(*n, c)`, SI units, for models that have one.
        key: The random key of the samples, consumed.
        num_samples: Number of latents to draw besides the mean.
        shape: The leading axes if there is no input. The prediction is then that of the prior.
    """
    lead = shape
    for name, value in inputs.items():
        lead = value.shape[: -1 if name == "pose" else -3]
    flat, counts = _flat(preprocessing, inputs, present, lead, blank)
    if flat:
        posterior = mvae.infer(graphdef, state, flat, present=counts)
    else:
        nothing = jnp.zeros((math.prod(shape), nnx.merge(graphdef, state).config.latent))
        posterior = mvae.Gaussian(nothing, nothing)
    if condition is not None:
        condition = preprocessing.encode_condition(condition).reshape(-1, condition.shape[-1])

    def decode(z: Float[Array, "... latent"], shape: tuple[int, ...]) -> Prediction:
        wide = None if condition is None else jnp.broadcast_to(condition, (*z.shape[:-1], condition.shape[-1]))
        out = mvae.decode(graphdef, state, z, condition=wide)
        out = {name: value.reshape(*shape, *value.shape[z.ndim - 1 :]) for name, value in out.items()}
        return Prediction(
            visual=jax.nn.sigmoid(out["visual"]) if "visual" in out else None,
            tactile=jax.nn.sigmoid(out["tactile"]) if "tactile" in out else None,
            pose=preprocessing.decode_pose(out["pose"]) if "pose" in out else None,
            mean=posterior.mean.reshape(*lead, -1),
            log_var=posterior.log_var.reshape(*lead, -1),
        )

    result = decode(posterior.mean, lead)
    if num_samples and key is not None:
        noise = jax.random.normal(key, (num_samples, *posterior.mean.shape))
        z = posterior.mean[None] + jnp.exp(0.5 * posterior.log_var)[None] * noise
        result = result._replace(samples=decode(z, (num_samples, *lead)))
    return result


@functools.partial(jax.jit, static_argnames=("graphdef", "preprocessing", "num_samples", "shape"))
def predict_samples(
    graphdef: nnx.GraphDef,
    state: nnx.State,
    preprocessing: training.Preprocessing,
    empty: dict[str, Float[Array, "h w 3"]],
    inputs: dict[str, Float[Array, "..."]],
    present: dict[str, Bool[Array, "*n"]],
    condition: Float[Array, "..."] | None = None,
    key: PRNGKeyArray | None = None,
    num_samples: int = 0,
    shape: tuple[int, ...] = (),
) -> Prediction:
    """Predict with a state-space model. Images are means over samples, and the pose is the most central sample.

    Without `num_samples` the images are means over 16 samples of a fixed key, so that every call gives the same
    prediction. The arguments are those of `predict`, with three differences: `empty` holds both images of the untouched
    sensor, [0, 1], `inputs` holds all inputs of the model (see `_completed`), and `shape` is their leading axes.
    """
    lead = shape
    flat, counts = _flat(preprocessing, inputs, present, lead, empty["tactile"])
    if condition is not None:
        condition = preprocessing.encode_condition(condition).reshape(-1, condition.shape[-1])
    drawn = num_samples or _DRAWN
    key = jax.random.key(0) if key is None else key
    found = statespace.sample(graphdef, state, key, flat, counts, empty, condition, num=max(_POSES, drawn), drawn=drawn)
    poses = preprocessing.decode_pose(found.pose)
    images = {name: x.reshape(drawn, *lead, *x.shape[2:]) for name, x in found.images.items()}
    mean, log_var = (x.reshape(*lead, -1) for x in found.belief)
    result = Prediction(
        visual=found.mean["visual"].reshape(*lead, *found.mean["visual"].shape[1:]),
        tactile=found.mean["tactile"].reshape(*lead, *found.mean["tactile"].shape[1:]),
        pose=_central(poses).reshape(*lead, 7),
        mean=mean,
        log_var=log_var,
        outcome_probability=found.outcome.reshape(*lead, -1),
    )
    if num_samples:
        own = poses[:drawn].reshape(drawn, *lead, 7)
        samples = result._replace(visual=images["visual"], tactile=images["tactile"], pose=own)
        result = result._replace(samples=samples)
    return result


def _central(poses: Float[Array, "k n 7"]) -> Float[Array, "n 7"]:
    """The pose of each item that has the least mean distance from the item's other poses."""
    apart = jnp.linalg.norm(poses[:, None, :, :3] - poses[None, :, :, :3], axis=-1)
    cosine = jnp.abs(jnp.einsum("inq,jnq->ijn", poses[..., 3:], poses[..., 3:]))
    turned = 2 * jnp.arccos(jnp.clip(cosine, 0, 1))
    best = jnp.argmin(jnp.mean(apart + _TURN * turned, axis=1), axis=0)
    return jnp.take_along_axis(poses, best[None, :, None], axis=0)[0]


def _completed(
    names: tuple[str, ...],
    resolution: tuple[int, int],
    inputs: dict[str, Any],
    present: dict[str, Any],
    lead: tuple[int, ...],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """All inputs of a model and their masks, so that one compiled program serves every subset.

    Inputs that are not given are masked for all items.
    """
    lying = np.array([0, 0, 0, 1, 0, 0, 0], np.float32)
    nothing = {
        name: np.broadcast_to(lying, (*lead, 7)) if name == "pose" else np.zeros((*lead, *resolution, 3), np.float32)
        for name in names
        if name not in inputs
    }
    counts = {name: np.full(lead, name in inputs) for name in names} | present
    return inputs | nothing, counts


def _flat(
    preprocessing: training.Preprocessing,
    inputs: dict[str, Array],
    present: dict[str, Array],
    lead: tuple[int, ...],
    blank: Float[Array, "h w 3"],
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Encoded inputs and their masks, with one leading axis."""
    flat, counts = {}, {}
    for name, value in inputs.items():
        value = preprocessing.encode_pose(value) if name == "pose" else value
        flat[name] = value.reshape(-1, *value.shape[len(lead) :])
        counts[name] = present.get(name, jnp.ones(lead, bool)).reshape(-1)
    if "tactile" in flat:
        counts["tactile"] &= preprocessing.touched(flat["tactile"], blank)
    return flat, counts


class Predictor:
    """A trained model as a function: `predictor(visual=image)` gives a `Prediction`.

    It is pure, and works inside `jax.jit`, `jax.vmap` and `jax.grad`. `Predictor.load("freefall")` loads a model that
    comes with the library, and `Predictor.load("runs/freefall/models/statespace")` one that you trained.
    """

    def __init__(
        self,
        model: training.Model,
        preprocessing: training.Preprocessing,
        blank: tuple[np.ndarray, np.ndarray],
        name: str,
    ):
        """Use `Predictor.load`.

        Args:
            model: Definition, parameters and running statistics.
            preprocessing: The preprocessing of its training.
            blank: The visual and the tactile image of the untouched sensor, `uint8 (height, width, 3)`.
            name: The model's folder, for messages.
        """
        self.model = model
        self.preprocessing = preprocessing
        self.name = name
        self._images = blank
        images = (jnp.asarray(image.astype(np.float32) / 255) for image in blank)
        self._empty = dict(zip(("visual", "tactile"), images, strict=True))
        config = model.config
        self._inputs = config.names if isinstance(config, mvae.Config) else config.inputs
        self._names = config.names if isinstance(config, mvae.Config) else MODALITIES

    @classmethod
    def load(
        cls,
        folder: str | Path,
        *,
        resolution: tuple[int, int] | None = None,
        crop: bool | None = None,
    ) -> "Predictor":
        """Load a trained model.

        Args:
            folder: The `workdir` of a training or the folder of `save`, such as `runs/freefall/models/mvae`, or the
                name of a model that comes with the library, such as `freefall`. A folder of this name in the current
                directory takes precedence if it has a `config.json`.
            resolution: The resolution of the images that will be given. A model of another resolution is refused.
            crop: The view that will be given (True: the square around the object). A model of another view is refused.

        Raises:
            FileNotFoundError: The folder holds no model, and the library has none of this name.
            OSError: A file is damaged, missing or not listed in `manifest.json`.
            ValueError: The model was trained on another view, by another version of sts_jax, or has no manifest.
        """
        path = _located(folder)
        model = training.load(path)
        try:
            preprocessing = training.preprocessing_from_json(model.settings.get("preprocessing", {}))
        except ValueError as error:
            raise ValueError(f"{path / 'config.json'}, preprocessing: {error}") from error
        for field, asked in (("resolution", resolution and tuple(resolution)), ("crop", crop)):
            there = getattr(preprocessing, field)
            if asked is not None and asked != there:
                raise ValueError(
                    f"{folder} was trained on {field}={there}, but {field}={asked} was requested: "
                    "render the first view, or train a model on the second."
                )
        if isinstance(model.config, statespace.Config):
            _check_view(str(folder), model.config, preprocessing)
        blank = training.load_blank(path)
        if any(image.shape[:2] != preprocessing.resolution for image in blank):
            raise ValueError(
                f"{path / 'blank.npz'} has images of {blank[0].shape[:2]}, but the model takes "
                f"{preprocessing.resolution}: the file belongs to another model. Delete {path} and train again."
            )
        return cls(model, preprocessing, blank, str(folder))

    def save(self, folder: str | Path, *, compact: bool = False) -> None:
        """Write a folder that `load` reads. It lacks the optimiser's state, so that training cannot resume from it.

        Args:
            folder: A new or an empty folder.
            compact: Round the weights to a third of their size. A weight changes by at most 1/256 of the root mean
                square of its output channel, and predictions change slightly.

        Raises:
            FileExistsError: The folder is not empty.
            OSError: The disk is full or the folder is not writable.
        """
        folder = Path(folder)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise FileExistsError(f"{folder} is not an empty folder: give the name of a new one.")
        settings = {**self.model.settings, "preprocessing": dataclasses.asdict(self.preprocessing)}
        params, stats = nnx.split_state(self.model.state, nnx.Param, nnx.BatchStat)
        training.save_blank(folder, *self._images)
        _files.write_json(folder / "config.json", settings)
        training.save(folder, training.Weights(params, stats, jnp.int32(self.model.step)), compact=compact)

    def __repr__(self) -> str:
        config, view = self.model.config, self.preprocessing
        return (
            f"Predictor({self.name!r}: takes {', '.join(self.modalities) or 'nothing'}; predicts "
            f"{', '.join(self._names)}; resolution={view.resolution}, crop={view.crop}, condition={config.condition}, "
            f"steps={self.model.step})"
        )

    def __call__(
        self,
        *,
        visual: ArrayLike | None = None,
        tactile: ArrayLike | None = None,
        pose: ArrayLike | None = None,
        condition: ArrayLike | None = None,
        state: ArrayLike | None = None,
        present: dict[str, ArrayLike] | None = None,
        key: PRNGKeyArray | None = None,
        num_samples: int = 0,
    ) -> Prediction:
        """Predict the last moment from any non-empty subset of the first one's modalities.

        Values that are traced by `jax.jit`, `jax.vmap` or `jax.grad` cannot be refused. There, an item whose values
        would raise an error outside gives a prediction of NaN, and the other items are not affected.

        Args:
            visual: `(*n, height, width, 3)` in [0, 1], any leading axes, the same for all inputs.
            tactile: `(*n, height, width, 3)` in [0, 1]. Items without contact are ignored.
            pose: `(*n, 7)` m and unit quaternion, mesh frame in the sensor frame.
            condition: `(*n, c)`, the scenario's input in SI units, for models that have one. For a jerk: acceleration
                of the pad along x and y (m/s^2) and its duration (s).
            state: `(*n, code)`, the true pose, shape and mass, from `statespace.encode`, for state-space models. A
                simulation provides them. The remaining error is that of the learned physics and of the decoder.
            present: By name, which items of a modality count, bool `(*n,)`. Items that do not count may be NaN.
            key: The random key for `num_samples`, consumed.
            num_samples: Draw this many predictions. A state-space model's images are then the means over them.

        Raises:
            ValueError: No input is given, the model lacks a modality or was trained without it, or a value has a wrong
                type or shape, or is out of range or NaN. The message names the argument and the remedy.
        """
        given = {
            name: value for name, value in zip(MODALITIES, (visual, tactile, pose), strict=True) if value is not None
        }
        if not given:
            raise ValueError(f"nothing to predict from: give at least one of {', '.join(self.modalities)}.")
        arrays = {name: self._checked_name(name, value) for name, value in given.items()}
        leads = {name: array.shape[: -1 if name == "pose" else -3] for name, array in arrays.items()}
        lead = next(iter(leads.values()))
        if len(set(leads.values())) > 1:
            raise ValueError(f"the leading axes differ: {leads}. Give the same number of items of each modality.")
        masks = _checked_masks(present, arrays, lead)
        valid: Array | None = None  # valid items, (*n,), or None if no value is traced
        for name, array in arrays.items():
            mask = masks.get(name)
            if _traced(array) or _traced(mask):
                fine = _plausible(name, jnp.asarray(array))
                fine = fine if mask is None else fine | ~mask
                valid = fine if valid is None else valid & fine
            else:
                _check_values(name, np.asarray(array if mask is None else array[mask]))
        if state is not None:
            arrays["state"] = self._checked_state(state, lead)
        condition, plausible = self._checked_condition(condition, lead)
        if plausible is not None:
            valid = plausible if valid is None else valid & plausible
        num_samples = _checked_samples(num_samples, key)
        result = self._predicted(arrays, masks, lead, condition, key if num_samples else None, num_samples)
        return result if valid is None else _flagged(result, valid)

    def prior(self, shape: tuple[int, ...] = (), *, condition: ArrayLike | None = None) -> Prediction:
        """Predict from the prior, without any measurement, for items of any leading `shape`.

        Args:
            shape: Leading axes of the items.
            condition: `(*shape, c)`, as in a call.

        Raises:
            ValueError: A size is not a positive whole number, or the condition is missing, superfluous or out of range.
        """
        try:
            shape = tuple(operator.index(size) for size in shape)
        except TypeError:
            raise ValueError(f"shape is {shape!r}, but it must be a tuple of whole numbers, such as (3,).") from None
        if min(shape, default=1) < 1:
            raise ValueError(f"shape is {shape}, but each size must be at least 1.")
        condition, plausible = self._checked_condition(condition, shape)
        result = self._predicted({}, {}, shape, condition, None, 0)
        return result if plausible is None else _flagged(result, plausible)

    def _predicted(
        self,
        inputs: dict[str, Any],
        present: dict[str, Any],
        lead: tuple[int, ...],
        condition: np.ndarray | Array | None,
        key: PRNGKeyArray | None,
        num_samples: int,
    ) -> Prediction:
        model, view = self.model, self.preprocessing
        if isinstance(model.config, mvae.Config):
            return predict(
                model.graphdef,
                model.state,
                view,
                self._empty["tactile"],
                inputs,
                present,
                condition,
                key,
                num_samples,
                () if inputs else lead,
            )
        inputs, present = _completed(self._inputs, view.resolution, inputs, present, lead)
        return predict_samples(
            model.graphdef, model.state, view, self._empty, inputs, present, condition, key, num_samples, lead
        )

    @property
    def modalities(self) -> tuple[str, ...]:
        """The modalities that the model accepts: its inputs, except those that were absent in training."""
        return tuple(name for name in self._inputs if name not in self.preprocessing.absent)

    def _checked_name(self, name: str, value: Any) -> np.ndarray | Array:
        """Check type and shape of an input and return it as float32. A traced value stays traced."""
        if name not in (*self._inputs, *self.preprocessing.absent):
            raise ValueError(f"{self.name} takes no {name}: it was trained on {', '.join(self._inputs)}.")
        if name in self.preprocessing.absent:
            raise ValueError(
                f"{self.name} cannot use {name}: no first moment of its training had any (in freefall nothing "
                f"touches the pad yet). Leave {name}= out, or use a model of another scenario."
            )
        array = _checked_array(name, value, "7 numbers" if name == "pose" else "floats in [0, 1]")
        if not jnp.issubdtype(array.dtype, jnp.floating):
            raise ValueError(
                f"{name} is {array.dtype}: give floats" + ("." if name == "pose" else " in [0, 1] (uint8 / 255).")
            )
        height, width = self.preprocessing.resolution
        tail = (7,) if name == "pose" else (height, width, 3)
        if array.ndim < len(tail) or array.shape[array.ndim - len(tail) :] != tail:
            raise ValueError(
                f"{name} has shape {array.shape}, but {self.name} needs (..., {', '.join(map(str, tail))})"
                + ("." if name == "pose" else f": render with resolution={self.preprocessing.resolution}.")
            )
        if math.prod(array.shape) == 0:
            raise ValueError(f"{name} has shape {array.shape}, so there is no item in it: give at least one.")
        return _float32(array)

    def _checked_state(self, value: Any, lead: tuple[int, ...]) -> np.ndarray | Array:
        """Check a state code and return it as float32."""
        if isinstance(self.model.config, mvae.Config):
            raise ValueError(f"{self.name} takes no state: it is a model of the paper's kind, which has none.")
        array = _checked_array("state", value, f"{statespace.STATE_CODE} numbers, from statespace.encode")
        if array.shape != (*lead, statespace.STATE_CODE):
            raise ValueError(f"state has shape {array.shape}, but it needs {(*lead, statespace.STATE_CODE)}.")
        if not _traced(array) and not np.isfinite(array).all():
            raise ValueError("state has NaN or infinite values, but every item needs its true state.")
        return _float32(array)

    def _checked_condition(
        self, value: Any, lead: tuple[int, ...]
    ) -> tuple[np.ndarray | Array | None, Bool[Array, "*n"] | None]:
        """Check a condition. Return it as float32 and, if it is traced, which items are plausible."""
        width = self.model.config.condition
        array = None if value is None else _checked_array("condition", value, f"{width} numbers in SI units")
        shape = None if array is None else array.shape
        if shape != (None if width == 0 else (*lead, width)):
            raise ValueError(f"condition has shape {shape}: {self.name} needs {(*lead, width) if width else 'none'}.")
        if array is None:
            return None, None
        if not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
            raise ValueError(f"condition is {array.dtype}, but it must be numbers in SI units.")
        condition = _float32(array)
        scale = np.array(self.preprocessing.condition_scale)
        if _traced(condition):
            return condition, jnp.all(jnp.abs(condition) <= _LARGEST_CONDITION * scale, axis=-1)
        if not np.isfinite(condition).all():
            raise ValueError("condition has NaN or infinite values, but every item needs a condition.")
        if (np.abs(condition) > _LARGEST_CONDITION * scale).any():
            raise ValueError(
                f"condition has {np.abs(condition).reshape(-1, width).max(0).tolist()}, but {scale.tolist()} is "
                "usual: give it in SI units."
            )
        return condition, None


def _located(folder: str | Path) -> Path:
    """The folder of a model, given the folder itself or the name of a model of the library."""
    path, name = Path(folder), str(folder)
    if name != path.name or (path / "config.json").exists():
        return path
    names = sorted(config.parent.name for config in MODELS.glob("*/config.json"))
    if name not in names:
        raise FileNotFoundError(
            f"{name!r} is neither a folder with a config.json nor one of the trained models that come with sts_jax "
            f"({', '.join(names) or 'none'}): give one of these names, or the folder of a trained model."
        )
    return MODELS / name


def _check_view(name: str, config: statespace.Config, preprocessing: training.Preprocessing) -> None:
    """Raise a ValueError if the networks were made for another view or another code of a pose."""
    presumed = {
        "resolution": (config.input_size,) * 2,
        "crop": False,
        "rotation": "matrix",
        "position_scale": config.position_scale,
    }
    for field, wanted in presumed.items():
        found = getattr(preprocessing, field)
        if found != wanted:
            raise ValueError(
                f"{name}: the state-space model needs preprocessing with {field}={wanted!r}, got {found!r}: train it "
                "with that preprocessing."
            )


def _traced(value: object) -> bool:
    return isinstance(value, jax.core.Tracer)


def _checked_array(name: str, value: Any, wanted: str) -> np.ndarray | Array:
    if _traced(value):
        return value
    if isinstance(value, str | bytes | Path):
        raise ValueError(
            f"{name} is {value!r}, but it must be an array of {wanted}, not a path (for a picture: "
            "np.asarray(PIL.Image.open(path)) / 255)."
        )
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is not an array ({error}): give an array of {wanted}.") from error
    if array.dtype.kind in "OUSMm":
        raise ValueError(f"{name} is a {type(value).__name__}, but it must be an array of {wanted}.")
    return array


def _float32(array: np.ndarray | Array) -> np.ndarray | Array:
    with np.errstate(over="ignore"):  # a number beyond the range of float32 becomes infinite, and is refused later
        return array.astype(np.float32)


def _checked_masks(
    present: Any, arrays: dict[str, np.ndarray | Array], lead: tuple[int, ...]
) -> dict[str, np.ndarray | Array]:
    if not isinstance(present, Mapping | None):
        raise ValueError(f"present is a {type(present).__name__}, but it must be a dict of bool arrays by modality.")
    masks = {}
    for name, value in (present or {}).items():
        mask = _checked_array(f"present[{name!r}]", value, "bool")
        if name not in arrays or mask.shape != lead:
            raise ValueError(
                f"present[{name!r}] has shape {mask.shape}, but it must mask a given modality, one of "
                f"{list(arrays)}, with shape {lead}."
            )
        if mask.dtype != bool:
            raise ValueError(f"present[{name!r}] is {mask.dtype}, but it must be bool, True for the items that count.")
        masks[name] = mask
    return masks


def _checked_samples(num_samples: Any, key: Any) -> int:
    try:
        number = operator.index(num_samples)
    except TypeError:
        raise ValueError(
            f"num_samples={num_samples!r}, but it must be a whole number. Inside jax.jit it must be a constant "
            "(static_argnames makes it one)."
        ) from None
    if number < 0 or (number > 0 and key is None):
        raise ValueError(f"num_samples={number}, but it must be >= 0, and needs a key if it is > 0.")
    if key is not None and not (
        isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.shape == ()
    ):
        shown = f"{key.dtype} of shape {key.shape}" if isinstance(key, jax.Array | np.ndarray) else repr(key)
        raise ValueError(f"key is {shown}, but it must be one key, such as jax.random.key(0).")
    return number


def _plausible(name: str, array: Float[Array, "..."]) -> Bool[Array, "*n"]:
    """Which items `_check_values` would accept."""
    if name == "pose":
        lengths = jnp.linalg.norm(jax.lax.stop_gradient(array[..., 3:]), axis=-1)
        return (jnp.abs(lengths - 1) <= _QUAT_TOLERANCE) & (jnp.abs(array[..., :3]) <= _FARTHEST).all(-1)
    return ((array >= 0) & (array <= 1)).all((-3, -2, -1))


def _check_values(name: str, array: np.ndarray) -> None:
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has NaN or infinite values: mask such items with present={{{name!r}: ...}}.")
    if name == "pose":
        lengths = np.linalg.norm(array[..., 3:].astype(np.float64), axis=-1)  # squares of 1e30 are beyond float32
        if lengths.size and np.abs(lengths - 1).max() > _QUAT_TOLERANCE:
            raise ValueError(
                f"pose has a quaternion of length {lengths.flat[np.abs(lengths - 1).argmax()]:.3g}: "
                "give a position (m) and a unit quaternion [w, x, y, z]."
            )
        if array.size and np.abs(array[..., :3]).max() > _FARTHEST:
            raise ValueError(f"pose has a position {np.abs(array[..., :3]).max():.3g} m away: give metres, not mm.")
    elif array.size and (array.min() < 0 or array.max() > 1):
        raise ValueError(
            f"{name} has values in [{array.min():.3g}, {array.max():.3g}], but images are in [0, 1] (divide by 255?)."
        )


def _flagged(prediction: Prediction, valid: Bool[Array, "*n"]) -> Prediction:
    """Set every number of the invalid items to NaN."""

    def flag(leaf: Array, axes: int) -> Array:
        return jnp.where(valid.reshape(*valid.shape, *(1,) * axes), leaf, jnp.nan)

    images, numbers = functools.partial(flag, axes=3), functools.partial(flag, axes=1)
    return Prediction(
        visual=jax.tree.map(images, prediction.visual),  # None stays None
        tactile=jax.tree.map(images, prediction.tactile),
        pose=jax.tree.map(numbers, prediction.pose),
        mean=numbers(prediction.mean),
        log_var=numbers(prediction.log_var),
        samples=None if prediction.samples is None else _flagged(prediction.samples, valid),
        outcome_probability=jax.tree.map(numbers, prediction.outcome_probability),
    )
