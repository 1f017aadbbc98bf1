"""`Predictor`: a trained model as a function that predicts the last frame of a trajectory from the first frame."""

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

from sts_jax import _arguments, mvae, statespace, storage, training
from sts_jax.prediction import Prediction, completed, flagged, predict, predict_samples

MODALITIES = ("visual", "tactile", "pose")
MODELS = Path(str(importlib.resources.files("sts_jax"))) / "models"  # trained models of the library, one folder each
_LARGEST_CONDITION = 100.0  # largest condition, as a multiple of its usual magnitude


class Predictor:
    """A trained model as a function: `predictor(visual=image)` returns a `Prediction`.

    The inputs are images and the object's pose in the first frame of a trajectory. A model can have further inputs
    (`dataset.Measurement`). The prediction is the last frame, in which the object has come to rest.

    `Predictor.load("freefall")` loads a model that comes with the library.
    `Predictor.load("runs/freefall/models/statespace")` loads a model that you trained. Calls are pure, and work inside
    `jax.jit`, `jax.vmap` and `jax.grad`. On a CPU, predict large batches in one thread only. With JAX 0.10.1, two
    simultaneous calls, each with a batch of 60 images, never returned.
    """

    def __init__(
        self,
        model: training.Model,
        preprocessing: training.Preprocessing,
        blank: tuple[np.ndarray, np.ndarray],
        name: str,
    ):
        """Create a predictor from its parts. `Predictor.load` is the usual way.

        Args:
            model: Trained model: definition, parameters and running statistics.
            preprocessing: Preprocessing with which the model was trained.
            blank: Visual and tactile image of the untouched sensor, each uint8 (height, width, 3).
            name: Name or folder of the model, for error messages.
        """
        if isinstance(model.config, mvae.Config):  # a vector without a scale was trained on its own numbers
            vectors = [own.name for own in model.config.modalities if own.kind == "vector" and own.name != "pose"]
            scales = tuple((name, dict(preprocessing.scales).get(name, 1.0)) for name in vectors)
            preprocessing = dataclasses.replace(preprocessing, scales=scales)
        self.model = model
        self.preprocessing = preprocessing
        self.name = name
        self._images = blank
        images = (jnp.asarray(image.astype(np.float32) / 255) for image in blank)
        self._empty = dict(zip(("visual", "tactile"), images, strict=True))
        config = model.config
        self._inputs = config.names if isinstance(config, mvae.Config) else config.inputs
        self._names = config.names if isinstance(config, mvae.Config) else MODALITIES
        size = (*preprocessing.resolution, 3)
        # kind of each input, and shape of one item
        self._kinds: dict[str, _arguments.Kind] = {"visual": "image", "tactile": "image", "pose": "pose"}
        self._shapes: dict[str, tuple[int, ...]] = {"visual": size, "tactile": size, "pose": (7,)}
        if isinstance(config, mvae.Config):
            for modality in config.modalities:
                self._kinds.setdefault(modality.name, modality.kind)
                self._shapes.setdefault(modality.name, modality.shape)

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
            folder: Folder of a trained model, such as `runs/freefall/models/mvae`, or the name of a model that comes
                with the library, such as `freefall`. The folder must be the `workdir` of a training or a folder that
                `save` wrote. If a name is given, and the current directory has a folder of this name that contains
                `config.json`, the model in this folder is loaded.
            resolution: Height and width of the images that you will pass (pixels). If given, a model that was trained
                at another resolution raises an error.
            crop: View of the images that you will pass: True for the square around the object, False for the whole pad.
                If given, a model that was trained on the other view raises an error.

        Returns:
            The predictor.

        Raises:
            FileNotFoundError: The folder contains no model, and the library has no model of this name.
            OSError: A file is damaged, missing or not listed in `manifest.json`.
            ValueError: The model was trained at another resolution or on another view, was written by another version
                of sts_jax, or has no manifest.
        """
        path = _located(folder)
        model = training.load(path)
        try:
            preprocessing = training.Preprocessing.from_json(model.settings["preprocessing"])
        except ValueError as error:
            raise ValueError(f"the field 'preprocessing' of {path / 'config.json'} is not valid: {error}") from error
        for field, asked in (("resolution", resolution and tuple(resolution)), ("crop", crop)):
            there = getattr(preprocessing, field)
            if asked is not None and asked != there:
                raise ValueError(
                    f"the model {folder} was trained with {field}={there}, but {field}={asked} was requested: "
                    f"render images with {field}={there}, or train a model with {field}={asked}."
                )
        if isinstance(model.config, statespace.Config):
            _check_view(str(folder), model.config, preprocessing)
        blank = training.load_blank(path)
        if any(image.shape[:2] != preprocessing.resolution for image in blank):
            raise ValueError(
                f"{path / 'blank.npz'} has images of {blank[0].shape[:2]} pixels, but the model needs "
                f"{preprocessing.resolution}: the file is from another model. Delete the folder {path} and train again."
            )
        return cls(model, preprocessing, blank, str(folder))

    def save(self, folder: str | Path, *, compact: bool = False) -> None:
        """Write the model to a folder that `load` reads.

        Training cannot resume from this folder, because the folder does not contain the state of the optimiser.

        Args:
            folder: New or empty folder.
            compact: If True, round the weights, which reduces their size on disk to a third. Each weight of an
                output channel changes by at most r / 256, where r is the root mean square of the channel's weights.
                Predictions change slightly.

        Raises:
            FileExistsError: The folder is not empty, or is a file.
            OSError: The disk is full, or the folder is not writable.
        """
        folder = Path(folder)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise FileExistsError(f"{folder} is not an empty folder: give a new or an empty folder.")
        settings = {**self.model.settings, "preprocessing": dataclasses.asdict(self.preprocessing)}
        params, stats = nnx.split_state(self.model.state, nnx.Param, nnx.BatchStat)
        training.save_blank(folder, *self._images)
        storage.write_json(folder / "config.json", settings)
        training.save(folder, training.TrainState(params, stats, None, jnp.int32(self.model.step)), compact=compact)
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
        measurements: dict[str, ArrayLike] | None = None,
        present: dict[str, ArrayLike] | None = None,
        key: PRNGKeyArray | None = None,
        num_samples: int = 0,
    ) -> Prediction:
        """Predict the last frame of trajectories from their first frames.

        Pass at least one of `visual`, `tactile`, `pose` and `measurements`. All arrays are floating-point and have the
        same leading axes *n: none for a single item, and any number for a batch.

        Outside `jax.jit`, an invalid value raises an error. Traced values cannot raise errors: an item with an invalid
        traced value gives a prediction of NaN. Other items of the batch are not affected.

        Args:
            visual: Visual images in [0, 1], (*n, height, width, 3).
            tactile: Tactile images in [0, 1], (*n, height, width, 3). Images without contact are ignored, unless the
                model was trained with blank tactile images as inputs.
            pose: Poses of the object, (*n, 7): position (m) and unit quaternion, mesh frame in the sensor frame.
            condition: Known parameters of the trajectories in SI units, (*n, c), for models that were trained with
                them. For the scenario `Perturbed`: acceleration of the pad along x and y (m/s^2), and its duration (s).
            state: Codes of the true pose, shape and mass, (*n, code), from `statespace.encode`. Only for state-space
                models. With the true state of a simulation, the remaining error is that of the learned physics and of
                the decoder.
            measurements: Values of further modalities (`dataset.Measurement`) by name: vectors in SI units, (*n, size),
                or images in [0, 1], (*n, height, width, channels).
            present: Dictionary from the name of a modality to a Boolean mask (*n,), False for items in which the
                modality is to be ignored. Ignored values may be NaN. By default, all items are used.
            key: Random key that draws the samples. It is needed only if `num_samples` > 0.
            num_samples: Number of predictions to draw for each item, returned in `Prediction.samples`. If it is > 0,
                the images of a state-space model's prediction are means over these samples.

        Returns:
            The prediction for each item.

        Raises:
            ValueError: No input is given, the model does not accept an input or was trained without it, or a value has
                a wrong type or shape, is out of range, or is NaN. The message names the argument and the remedy.
        """
        own = _arguments.checked_measurements(measurements, MODALITIES)
        every = {"visual": visual, "tactile": tactile, "pose": pose, **own}
        given = {name: value for name, value in every.items() if value is not None}
        if not given:
            raise ValueError(
                f"nothing to predict from: give at least one of these arguments: {', '.join(self.modalities)}."
            )
        arrays = {name: self._checked_name(name, value) for name, value in given.items()}
        leads = {name: array.shape[: array.ndim - len(self._shapes[name])] for name, array in arrays.items()}
        lead = next(iter(leads.values()))
        if len(set(leads.values())) > 1:
            raise ValueError(f"the leading axes differ: {leads}. Pass arrays with the same leading axes.")
        masks = _arguments.checked_masks(present, arrays, lead)
        valid: Array | None = None  # mask of the valid items, (*n,), or None if no value is traced
        for name, array in arrays.items():
            mask = masks.get(name)
            if _arguments.traced(array) or _arguments.traced(mask):
                fine = _arguments.plausible(self._kinds[name], jnp.asarray(array))
                fine = fine if mask is None else fine | ~mask
                valid = fine if valid is None else valid & fine
            else:
                _arguments.check_values(name, self._kinds[name], np.asarray(array if mask is None else array[mask]))
        if state is not None:
            arrays["state"] = self._checked_state(state, lead)
        condition, plausible = self._checked_condition(condition, lead)
        if plausible is not None:
            valid = plausible if valid is None else valid & plausible
        num_samples = _arguments.checked_samples(num_samples, key)
        result = self._predicted(arrays, masks, lead, condition, key if num_samples else None, num_samples)
        return result if valid is None else flagged(result, valid)

    def prior(self, shape: tuple[int, ...] = (), *, condition: ArrayLike | None = None) -> Prediction:
        """Predict the last frame of trajectories without any measurement, from the model's prior distribution.

        Args:
            shape: Sizes of the leading axes of the predictions. The default is a single prediction.
            condition: Known parameters of each trajectory in SI units, (*shape, number of parameters), for models that
                were trained with them. For the scenario `Perturbed`: acceleration of the pad along x and y (m/s^2),
                and its duration (s).

        Returns:
            The predictions.

        Raises:
            ValueError: A size in `shape` is not a whole number > 0, or `condition` is missing, not accepted by the
                model, or out of range.
        """
        try:
            shape = tuple(operator.index(size) for size in shape)
        except TypeError:
            raise ValueError(f"shape is {shape!r}, but it must be a tuple of whole numbers, such as (3,).") from None
        if min(shape, default=1) < 1:
            raise ValueError(f"shape is {shape}, but each size must be >= 1.")
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
        """Names of the inputs that the model accepts, such as "visual", "tactile" and "pose".

        The names can include further modalities, each defined by a `dataset.Measurement`. The model accepts an input
        only if the first frame of at least one training trajectory contains this input.
        """
        return tuple(name for name in self._inputs if name not in self.preprocessing.absent)

    @property
    def outcomes(self) -> tuple[str, ...]:
        """Names of the outcomes in the order of `Prediction.outcome_probability`, such as ("rests", "fell off").

        Empty for `mvae` models, and for state-space models of older versions that did not store the names.
        """
        config = self.model.config
        return config.outcome_names if isinstance(config, statespace.Config) else ()

    @property
    def empty(self) -> dict[str, np.ndarray]:
        """Images of the untouched sensor with the keys "visual" and "tactile": float32 (height, width, 3) in [0, 1]."""
        return {name: np.asarray(image) for name, image in self._empty.items()}

    def _checked_name(self, name: str, value: Any) -> np.ndarray | Array:
        """Check the type and shape of the input `name`, and return it as float32. A traced value stays traced."""
        argument = f"the argument {name}" if name in MODALITIES else f"measurements[{name!r}]"
        if name not in (*self._inputs, *self.preprocessing.absent):
            raise ValueError(
                f"{self.name} does not accept {name}: the model was trained on {', '.join(self._inputs)}. Leave out "
                f"{argument}."
            )
        if name in self.preprocessing.absent:
            raise ValueError(
                f"{self.name} cannot use {name}: the input {name} was absent from all first frames of the training "
                f"data (before a fall, for example, nothing touches the pad). Leave out {argument}, or use a model of "
                "another scenario."
            )
        tail, is_image = self._shapes[name], self._kinds[name] == "image"
        array = _arguments.checked_array(name, value, "floats in [0, 1]" if is_image else f"{tail[0]} numbers")
        if not jnp.issubdtype(array.dtype, jnp.floating):
            raise ValueError(
                f"{name} is {array.dtype}, but it must be floating-point"
                + (" in [0, 1]: divide uint8 images by 255." if is_image else ".")
            )
        if array.ndim < len(tail) or array.shape[array.ndim - len(tail) :] != tail:
            raise ValueError(
                f"{name} has shape {array.shape}, but {self.name} needs shape (..., {', '.join(map(str, tail))})"
                + (f": render with resolution={tail[:2]}." if is_image and name in MODALITIES else ".")
            )
        if math.prod(array.shape) == 0:
            raise ValueError(f"{name} has shape {array.shape}, which contains no item: pass at least one item.")
        return _arguments.float32(array)

    def _checked_state(self, value: Any, lead: tuple[int, ...]) -> np.ndarray | Array:
        """Check the argument `state`, and return it as float32."""
        if isinstance(self.model.config, mvae.Config):
            raise ValueError(
                f"{self.name} does not accept the argument `state`, because it is not a state-space model: leave out "
                "`state`."
            )
        array = _arguments.checked_array("state", value, f"{statespace.STATE_CODE} numbers, from statespace.encode")
        if array.shape != (*lead, statespace.STATE_CODE):
            raise ValueError(f"state has shape {array.shape}, but it must have shape {(*lead, statespace.STATE_CODE)}.")
        if not _arguments.traced(array) and not np.isfinite(array).all():
            raise ValueError("state has NaN or infinite values: give finite numbers, or leave out the argument state.")
        return _arguments.float32(array)

    def _checked_condition(
        self, value: Any, lead: tuple[int, ...]
    ) -> tuple[np.ndarray | Array | None, Bool[Array, "*n"] | None]:
        """Check the argument `condition`. Return it as float32 and, if it is traced, a mask of the plausible items."""
        width = self.model.config.condition
        array = None if value is None else _arguments.checked_array("condition", value, f"{width} numbers in SI units")
        shape = None if array is None else array.shape
        if width == 0 and shape is not None:
            raise ValueError(
                f"condition has shape {shape}, but {self.name} accepts no condition: leave out the argument condition."
            )
        if width != 0 and shape != (*lead, width):
            given = "condition is missing" if shape is None else f"condition has shape {shape}"
            raise ValueError(
                f"{given}, but {self.name} needs a condition of shape {(*lead, width)}: give an array of this "
                "shape, in SI units."
            )
        if array is None:
            return None, None
        if not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
            raise ValueError(f"condition has the type {array.dtype}, but it must be an array of numbers in SI units.")
        condition = _arguments.float32(array)
        scale = np.array(self.preprocessing.condition_scale)
        if _arguments.traced(condition):
            return condition, jnp.all(jnp.abs(condition) <= _LARGEST_CONDITION * scale, axis=-1)
        if not np.isfinite(condition).all():
            raise ValueError("condition has NaN or infinite values: give finite numbers for every item.")
        if (np.abs(condition) > _LARGEST_CONDITION * scale).any():
            raise ValueError(
                f"condition has magnitudes up to {np.abs(condition).reshape(-1, width).max(0).tolist()}, but the "
                f"limits are {(_LARGEST_CONDITION * scale).tolist()} ({_LARGEST_CONDITION:g} times the typical "
                "magnitudes in the model's scenario): give the condition in SI units."
            )
        return condition, None


def _located(folder: str | Path) -> Path:
    """Return the folder of a model, given this folder or the name of a model that comes with the library."""
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
    """Raise a ValueError if the preprocessing differs from the view or pose encoding that the networks need."""
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
                f"{name} is a state-space model and needs preprocessing with {field}={wanted!r}, but its preprocessing "
                f"has {field}={found!r}: train the model with {field}={wanted!r}."
            )
