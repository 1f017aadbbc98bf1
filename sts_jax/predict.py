"""`Predictor`: a trained model as a function from any subset of vision, touch and pose to their values at rest."""

import dataclasses
import importlib.resources
import math
import operator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, ArrayLike, Bool, PRNGKeyArray

from sts_jax import _arguments, _files, mvae, statespace, training
from sts_jax.prediction import Prediction, completed, flagged, predict, predict_samples

MODALITIES = ("visual", "tactile", "pose")
MODELS = Path(str(importlib.resources.files("sts_jax"))) / "models"  # the models of the library, one folder each
_LARGEST_CONDITION = 100.0  # largest condition, in units of its usual size


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
        if self.model.calibration is not None:
            training.save_calibration(folder, self.model.calibration, self._inputs)

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
        masks = _arguments.checked_masks(present, arrays, lead)
        valid: Array | None = None  # valid items, (*n,), or None if no value is traced
        for name, array in arrays.items():
            mask = masks.get(name)
            if _arguments.traced(array) or _arguments.traced(mask):
                fine = _arguments.plausible(name, jnp.asarray(array))
                fine = fine if mask is None else fine | ~mask
                valid = fine if valid is None else valid & fine
            else:
                _arguments.check_values(name, np.asarray(array if mask is None else array[mask]))
        if state is not None:
            arrays["state"] = self._checked_state(state, lead)
        condition, plausible = self._checked_condition(condition, lead)
        if plausible is not None:
            valid = plausible if valid is None else valid & plausible
        num_samples = _arguments.checked_samples(num_samples, key)
        result = self._predicted(arrays, masks, lead, condition, key if num_samples else None, num_samples)
        return result if valid is None else flagged(result, valid)

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
        return result if plausible is None else flagged(result, plausible)

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
        inputs, present = completed(self._inputs, view.resolution, inputs, present, lead)
        return predict_samples(
            model.graphdef,
            model.state,
            view,
            self._empty,
            inputs,
            present,
            condition,
            key,
            num_samples,
            lead,
            model.calibration,
        )

    @property
    def modalities(self) -> tuple[str, ...]:
        """The modalities that the model accepts: its inputs, except those that were absent in training."""
        return tuple(name for name in self._inputs if name not in self.preprocessing.absent)

    @property
    def empty(self) -> dict[str, np.ndarray]:
        """The images of the untouched sensor in its training by stream, float32 `(height, width, 3)` in [0, 1]."""
        return {name: np.asarray(image) for name, image in self._empty.items()}

    def _checked_name(self, name: str, value: Any) -> np.ndarray | Array:
        """Check type and shape of an input and return it as float32. A traced value stays traced."""
        if name not in (*self._inputs, *self.preprocessing.absent):
            raise ValueError(f"{self.name} takes no {name}: it was trained on {', '.join(self._inputs)}.")
        if name in self.preprocessing.absent:
            raise ValueError(
                f"{self.name} cannot use {name}: no first moment of its training had any (in freefall nothing "
                f"touches the pad yet). Leave {name}= out, or use a model of another scenario."
            )
        array = _arguments.checked_array(name, value, "7 numbers" if name == "pose" else "floats in [0, 1]")
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
        return _arguments.float32(array)

    def _checked_state(self, value: Any, lead: tuple[int, ...]) -> np.ndarray | Array:
        """Check a state code and return it as float32."""
        if isinstance(self.model.config, mvae.Config):
            raise ValueError(f"{self.name} takes no state: it is a model of the paper's kind, which has none.")
        array = _arguments.checked_array("state", value, f"{statespace.STATE_CODE} numbers, from statespace.encode")
        if array.shape != (*lead, statespace.STATE_CODE):
            raise ValueError(f"state has shape {array.shape}, but it needs {(*lead, statespace.STATE_CODE)}.")
        if not _arguments.traced(array) and not np.isfinite(array).all():
            raise ValueError("state has NaN or infinite values, but every item needs its true state.")
        return _arguments.float32(array)

    def _checked_condition(
        self, value: Any, lead: tuple[int, ...]
    ) -> tuple[np.ndarray | Array | None, Bool[Array, "*n"] | None]:
        """Check a condition. Return it as float32 and, if it is traced, which items are plausible."""
        width = self.model.config.condition
        array = None if value is None else _arguments.checked_array("condition", value, f"{width} numbers in SI units")
        shape = None if array is None else array.shape
        if shape != (None if width == 0 else (*lead, width)):
            raise ValueError(f"condition has shape {shape}: {self.name} needs {(*lead, width) if width else 'none'}.")
        if array is None:
            return None, None
        if not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
            raise ValueError(f"condition is {array.dtype}, but it must be numbers in SI units.")
        condition = _arguments.float32(array)
        scale = np.array(self.preprocessing.condition_scale)
        if _arguments.traced(condition):
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
