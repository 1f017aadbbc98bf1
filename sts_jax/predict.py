"""`Predictor`: a trained model as a function that predicts the last frame of a trajectory, or frame after frame."""

import dataclasses
import functools
import importlib.resources
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, ArrayLike, Bool, Key, Num

from sts_jax import mvae, statespace, storage, training
from sts_jax._checked import checked, in_32_bits, warn
from sts_jax._devices import is_inside_mesh, on_each_device
from sts_jax._plausible import image_problem, order_problem, pair_problem, pose_problem
from sts_jax.prediction import Prediction, completed, flagged, predict, predict_samples, rollout, rollout_samples
from sts_jax.rendering.loop import looped

STREAMS = ("visual", "tactile")
MODALITIES = (*STREAMS, "pose")
MODELS = Path(str(importlib.resources.files("sts_jax"))) / "models"  # trained models of the library, one folder each
_QUAT_TOLERANCE = 1e-2  # largest deviation of a quaternion's length from 1
_FARTHEST = 10.0  # m, largest coordinate of a position. A larger number is probably in millimetres
_LARGEST_CONDITION = 100.0  # largest condition, as a multiple of its usual magnitude

# Most items that one compiled program predicts: on a CPU, where a larger batch is not faster, it limits the memory.
_CHUNK = {"cpu": 16}
_PER_ITEM = ("mean", "log_var", "outcome_probability")  # the same for all samples of an item

Images = Num[Array | np.ndarray, "..."]  # (*n, h, w, 3). `Predictor` compares the shape, for a better message
Poses = Num[Array | np.ndarray, "*n 7"]
Numbers = Num[Array | np.ndarray, "*n c"]
Kind = Literal["image", "pose", "vector"]  # each kind of inputs has its own range


class _Course(NamedTuple):
    """The arguments that only a roll-out has."""

    steps: int
    last: bool  # return the last step only
    time: Any  # s, time of the first frame: a number, or (*n,)


class Predictor:
    """A trained model as a function: `predictor(visual=image)` returns a `Prediction`.

    The prediction is the last frame, in which the object has come to rest. A one-step model predicts frame after frame:
    `predictor.rollout(frame, steps)`. `Predictor.load("freefall")` loads a model that comes with the library, and
    `Predictor.load("runs/freefall")` one that you trained. Calls are pure, work inside `jax.jit`, `jax.vmap` and
    `jax.grad`, and may run in several threads. The prediction of an item does not depend on the other items of its
    batch. Outside `jax.jit`, the memory does not grow with the batch.
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
            preprocessing: Preprocessing with which the model was trained.
            blank: Visual and tactile image of the empty sensor, each uint8 (height, width, 3).
            name: Name or folder of the model, for error messages.
        """
        size = (*preprocessing.resolution, 3)
        # Kind of each input, and shape of one item
        self._kinds: dict[str, Kind] = {"visual": "image", "tactile": "image", "pose": "pose"}
        self._shapes: dict[str, tuple[int, ...]] = {"visual": size, "tactile": size, "pose": (7,)}
        config = model.config
        self._inputs = config.names if isinstance(config, mvae.Config) else config.inputs
        self._names = config.names if isinstance(config, mvae.Config) else MODALITIES
        if isinstance(config, mvae.Config):
            for modality in config.modalities:
                if modality.name in STREAMS and (modality.kind, modality.shape) != ("image", size):
                    raise ValueError(
                        f"{name}: the modality {modality.name!r} is {modality.kind} of shape {modality.shape}, but a "
                        f"Predictor needs an image of shape {size}: give this modality another name"
                    )
                self._kinds.setdefault(modality.name, "image" if modality.kind == "image" else "vector")
                self._shapes.setdefault(modality.name, modality.shape)
            # A vector without a scale was trained on its own numbers.
            vectors = [name for name, kind in self._kinds.items() if kind == "vector"]
            scales = tuple((name, dict(preprocessing.scales).get(name, 1.0)) for name in vectors)
            preprocessing = dataclasses.replace(preprocessing, scales=scales)
        else:
            self._kinds["state"], self._shapes["state"] = "vector", (statespace.STATE_CODE,)
        self.model = model
        self.preprocessing = preprocessing
        self.name = name
        self._blank = blank
        self._blank_of = {name: image.astype(np.float32) / 255 for name, image in zip(STREAMS, blank, strict=True)}
        self._empty = {name: jnp.asarray(image) for name, image in self._blank_of.items()}

    @classmethod
    @in_32_bits
    def load(cls, folder: str | Path) -> "Predictor":
        """Load a trained model, after comparing its files with their checksums.

        Args:
            folder: The name of a model that comes with the library, such as `freefall`, the folder of a model, or the
                work directory of an experiment with one model. Write `./freefall` for a folder of a library's name.
        """
        path = _located(folder)
        model = training.load(path)
        try:
            preprocessing = training.Preprocessing.from_json(model.settings.get("preprocessing"))
        except ValueError as error:
            raise ValueError(
                f"the field 'preprocessing' of {path / 'config.json'} is not valid: {error}. Train the model with "
                "training.train(..., preprocessing=dataclasses.asdict(p)), where p is a training.Preprocessing."
            ) from error
        if isinstance(model.config, statespace.Config):
            size, scale = (model.config.input_size,) * 2, model.config.position_scale
            needed: dict[str, Any] = {"resolution": size, "crop": False, "rotation": "matrix", "position_scale": scale}
            needed["stride"] = model.config.stride or None
            for field, value in needed.items():
                if (trained := getattr(preprocessing, field)) != value:
                    raise ValueError(
                        f"{folder} was trained with {field}={trained!r}, but its networks need {value!r}: train again"
                    )
        blank = training.load_blank(path)
        if any(image.shape[:2] != preprocessing.resolution for image in blank):
            raise ValueError(
                f"{path / 'blank.npz'} has images of {blank[0].shape[:2]} pixels, but the model needs "
                f"{preprocessing.resolution}: write it with training.save_blank, and train again."
            )
        return cls(model, preprocessing, blank, str(folder))

    @in_32_bits
    def save(self, folder: str | Path, *, compact: bool = False) -> None:
        """Write the model to a folder that `load` reads. It has no optimiser's state, so training cannot resume there.

        Args:
            folder: New or empty folder.
            compact: If True, round the weights, which reduces their size on disk to a third, see `training.save`.
        """
        folder = Path(folder)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise FileExistsError(f"{folder} is not an empty folder: give a new or an empty folder.")
        settings = {**self.model.settings, "preprocessing": dataclasses.asdict(self.preprocessing)}
        params, stats = nnx.split_state(self.model.state, nnx.Param, nnx.BatchStat)
        training.save_blank(folder, *self._blank)
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

    @in_32_bits
    @checked
    def __call__(
        self,
        *,
        visual: Images | None = None,
        tactile: Images | None = None,
        pose: Poses | None = None,
        condition: Numbers | None = None,
        state: Num[Array | np.ndarray, "*n code"] | None = None,
        measurements: Mapping[str, ArrayLike | None] | None = None,
        present: Mapping[str, ArrayLike] | None = None,
        key: Key[Array, "..."] | None = None,
        num_samples: int = 0,
    ) -> Prediction:
        """Predict the last frame of trajectories from their first frames.

        Pass at least one input. All arrays have the same leading axes *n. Outside `jax.jit`, an invalid value raises an
        error, and an image or pose that is probably wrong gives a warning (BGR, noise, no object in view, another
        sensor, a pose of another image). Inside, an item with an invalid traced value gives a prediction of NaN.

        Args:
            visual: Visual images in [0, 1].
            tactile: Tactile images in [0, 1]. Images without contact are ignored, see `Preprocessing.touched`.
            pose: Poses of the object: position (m) and unit quaternion, mesh frame in the sensor frame.
            condition: Conditions in SI units, for models that were trained with them. For `Perturbed`: acceleration of
                the pad along x and y (m/s^2), and its duration (s).
            state: State codes of the true states, from `statespace.encode`, for state-space models.
            measurements: Values of further modalities (`dataset.Measurement`) by name: vectors in SI units, (*n, size),
                or images in [0, 1], (*n, height, width, channels).
            present: Masks by the name of the input, False for items in which it is to be ignored. Ignored values may be
                NaN. By default, all items are used.
            key: Random key that draws the samples, needed only if `num_samples` > 0. With one key, equal items get
                equal samples. With a key for each item, such as `jax.random.split(key, n)`, their samples differ.
            num_samples: Number of predictions to draw for each item, returned in `Prediction.samples`.
        """
        self._check_kind(rolled=False)
        every = {"visual": visual, "tactile": tactile, "pose": pose, "state": state, **(measurements or {})}
        return self._answer(every, present or {}, condition, key, num_samples)

    @in_32_bits
    @checked
    def rollout(
        self,
        frame: Any,
        steps: int,
        *,
        condition: Numbers | None = None,
        time: Num[ArrayLike, "..."] = 0.0,
        key: Key[Array, "..."] | None = None,
        num_samples: int = 0,
        last: bool = False,
    ) -> Prediction:
        """Predict frame after frame with a one-step model, each frame from the predicted frame before.

        Without a key, each step decodes the mean of the posterior of the latent. With a key, each step draws the
        latent, and the result is one sampled course. With `num_samples`, the result is the course of the means, and its
        `samples` are sampled courses. From the second step on, all modalities that the model predicts are its inputs,
        even if the first frame lacks some. A predicted tactile image without contact is ignored like a given one.

        A state-space model infers the state from the first frame alone, in which the object is at rest. Without a key,
        each step is the likeliest one. With a key, each step draws one of the motions that are possible. With
        `num_samples`, the result has the mean images and the central poses of the sampled courses.

        Args:
            frame: First frame: a `Frame`, a mapping with some of `visual`, `tactile` and `pose`, or for the paper's
                models a `Prediction` of one frame. Arrays and checks are those of a call.
            steps: Number of steps, at least 1. A step takes `preprocessing.period` (s), which are `stride` frames.
            condition: Conditions as in a call. The time is added to them.
            time: Time of the first frame since frame 0 of its trajectory (s), for models with a condition.
            key: Random key for one course, or for the samples if `num_samples` > 0. One, or one for each item.
            num_samples: Number of sampled courses.
            last: True to return the last step only, with an axis of time of length 1. It saves memory.

        Returns:
            The predictions of all steps, with an axis of time: `visual` (*n, steps, h, w, 3), `pose` (*n, steps, 7).
            `samples` have a further first axis. Its `mean` and `log_var` are those of the course of the means.
        """
        self._check_kind(rolled=True)
        if steps < 1:
            raise ValueError(f"steps must be >= 1, got {steps}")
        if isinstance(frame, Mapping):
            every = dict(frame)
        elif all(hasattr(frame, name) for name in MODALITIES):
            values = {name: getattr(frame, name) for name in MODALITIES}
            values |= getattr(frame, "measurements", None) or {}
            every = {name: value for name, value in values.items() if name in self.modalities}
        else:
            raise TypeError(
                f"`frame` is a {type(frame).__name__}: give a Frame, a Prediction, or a mapping with some of "
                f"{', '.join(self.modalities)}."
            )
        return self._answer(every, {}, condition, key, num_samples, _Course(steps, last, time))

    def _check_kind(self, *, rolled: bool) -> None:
        """Raise a ValueError if a one-step model is called, or if a model of the last frame is rolled out."""
        if rolled and self.stride is None:
            raise ValueError(
                f"{self.name} predicts the last frame, and has no steps: call it, or train a one-step model with "
                "training.step_arrays, or training.state_model(stride=1)."
            )
        if not rolled and self.stride is not None:
            raise ValueError(
                f"{self.name} is a one-step model: it predicts the frame {self.preprocessing.period:g} s later, not "
                "the last one. Use rollout(frame, steps)."
            )

    def _answer(
        self,
        every: dict[str, Any],
        present: Mapping[str, Any],
        condition: Any,
        key: Any,
        num_samples: int,
        course: _Course | None = None,
    ) -> Prediction:
        """Check the arguments of a call or of a roll-out, and predict."""
        inputs = {name: self._input(name, value) for name, value in every.items() if value is not None}
        if not inputs:
            raise ValueError(f"nothing to predict from: give at least one of {', '.join(self.modalities)}.")
        leads = {name: array.shape[: array.ndim - len(self._shapes[name])] for name, array in inputs.items()}
        lead = next(iter(leads.values()))
        if len(set(leads.values())) > 1:
            raise ValueError(
                f"the leading axes differ: {leads}. Pass arrays with the same leading axes: add a missing axis of the "
                "batch with array[None]."
            )
        if num_samples < 0 or (num_samples and key is None):
            raise ValueError(f"num_samples={num_samples} and key={key}: give num_samples >= 0, and a key if it is > 0.")
        if key is not None and key.shape not in ((), lead):
            raise ValueError(f"key has shape {key.shape}: give one key, or keys of shape {lead}, one for each item.")
        masks = {name: _array(mask) for name, mask in present.items()}
        for name, mask in masks.items():
            if name not in inputs or mask.shape != lead or mask.dtype != bool:
                raise ValueError(
                    f"present[{name!r}] is {mask.dtype} of shape {mask.shape}, but it must be bool of shape {lead} for "
                    f"one of the given inputs {list(inputs)}."
                )
        valid = []  # masks of the items whose traced values are in range
        for name, array in inputs.items():
            fine, ignored = _in_range(self._kinds[name], array), ~masks[name] if name in masks else False
            if _traced(fine) or _traced(ignored):
                valid.append(fine | ignored)
            elif not np.all(fine | ignored):
                raise ValueError(_reason(name, self._kinds[name], np.asarray(array)[~(fine | ignored)]))
        predicted = self._predicted(inputs, masks, lead, condition, valid, key, num_samples, course)
        # JAX computes the prediction meanwhile.
        for problem in dict.fromkeys(filter(None, self._problems(inputs, masks, lead))):
            warn(problem)
        return predicted

    @in_32_bits
    @checked
    def prior(self, shape: tuple[int, ...] = (), *, condition: Numbers | None = None) -> Prediction:
        """Predict last frames from the model's prior distribution, for leading axes `shape`. Condition as in a call."""
        self._check_kind(rolled=False)
        return self._predicted({}, {}, shape, condition, [], None, 0)

    def _predicted(
        self,
        inputs: dict[str, Any],
        present: dict[str, Any],
        lead: tuple[int, ...],
        condition: Any,
        valid: list[Array],
        key: Array | None,
        num_samples: int,
        course: _Course | None = None,
    ) -> Prediction:
        condition, fine = self._condition(condition, lead, course)
        single = key is not None and not key.ndim
        given, shared = (inputs, present, condition, None if single else key), key if single else None

        def run(given: tuple, key: Any, lead: tuple[int, ...]) -> Prediction:
            inputs, present, condition, keys = given
            model, view = self.model, self.preprocessing
            graphdef, state, shared = model.graphdef, model.state, (condition, key if keys is None else keys)
            if isinstance(model.config, mvae.Config):
                arguments = graphdef, state, view, self._empty["tactile"], inputs, present, *shared, num_samples, lead
                if course is not None:
                    return rollout(*arguments, steps=course.steps, last=course.last)
                return predict(*arguments)
            inputs, present = completed(self._inputs, view.resolution, inputs, present, lead)
            more = *shared, num_samples, lead
            own = graphdef, state, view, self._empty, inputs, present
            if course is not None:
                return rollout_samples(*own, *more, steps=course.steps, last=course.last)
            return predict_samples(*own, *more, model.calibration)

        def of_device(given: tuple, key: Any) -> Prediction:
            return run(given, key, next(iter(jax.tree.leaves(given))).shape[: len(lead)] if inputs else lead)

        def whole(given: tuple, key: Any) -> Prediction:
            return on_each_device(of_device, given, key, _axes(num_samples)) if lead else run(given, key, lead)

        chunk, count = _CHUNK.get(jax.default_backend(), 256), math.prod(lead)
        if count <= chunk or any(map(_traced, jax.tree.leaves((given, key)))):
            # `jax.vmap` over an explicit axis of a mesh
            result = (looped(whole) if is_inside_mesh(given) else whole)(given, shared)
        else:
            flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[len(lead) :]), given)
            result = _joined([run(part, shared, (chunk,)) for part in _cut(flat, chunk, count)], lead)
        valid = valid if fine is None else [*valid, fine]
        return flagged(result, jnp.all(jnp.stack(valid), axis=0), time=int(course is not None)) if valid else result

    @property
    def stride(self) -> int | None:
        """Number of frames that one step of the model takes, or None if it predicts the last frame."""
        return self.preprocessing.stride

    @property
    def modalities(self) -> tuple[str, ...]:
        """Names of the inputs that the model accepts: those that the first frame of a training trajectory had."""
        return tuple(name for name in self._inputs if name not in self.preprocessing.absent)

    @property
    def outcomes(self) -> tuple[str, ...]:
        """Names of the outcomes in the order of `Prediction.outcome_probability`, empty for `mvae` models."""
        config = self.model.config
        return config.outcome_names if isinstance(config, statespace.Config) else ()

    @property
    def empty(self) -> dict[str, np.ndarray]:
        """Images of the empty sensor, `visual` and `tactile`: float32 (height, width, 3) in [0, 1]."""
        return {name: image.copy() for name, image in self._blank_of.items()}

    def _problems(self, inputs: dict[str, Any], present: dict[str, Any], lead: tuple[int, ...]) -> Iterator[str | None]:
        """Messages about inputs in range that are probably wrong, or None. Traced values are not examined."""
        config, crop = self.model.config, self.preprocessing.crop
        masks = {name: present.get(name, np.True_) for name in MODALITIES if name in inputs}
        given = {name for name, mask in masks.items() if not _traced(inputs[name]) and not _traced(mask)}
        used = {name: np.broadcast_to(masks[name], lead) for name in given}
        for item in np.ndindex(lead):
            values = {name: inputs[name][item] for name in given if used[name][item]}
            problems = [
                image_problem(name, values[name], self._blank_of[name], crop=crop) for name in STREAMS if name in values
            ]
            yield from problems
            if any(problems) or crop or "visual" not in values:
                continue
            if "tactile" in values:
                yield pair_problem(values["visual"], values["tactile"], self._blank_of)
            if "pose" in values and isinstance(config, statespace.Config):
                blank = self._blank_of["visual"]
                yield pose_problem(values["visual"], blank, values["pose"], config.camera_distance, config.view)
        if "pose" in given:
            yield order_problem(inputs["pose"][used["pose"]][:, 3:])

    def _input(self, name: str, value: ArrayLike) -> np.ndarray | Array:
        """Check the name, type and shape of an input, and return it as float32. A traced value stays traced."""
        if name in self.preprocessing.absent:
            raise ValueError(
                f"{self.name} cannot use {name}: no first frame of its training data had it (before a fall, for "
                "example, nothing touches the pad). Leave it out, or use a model of another scenario."
            )
        if name not in self._inputs and not (name == "state" and "state" in self._shapes):
            raise ValueError(
                f"{self.name} does not accept {name}: it was trained on {', '.join(self._inputs)}. Leave it out."
            )
        array = _array(value)
        tail, is_image = self._shapes[name], self._kinds[name] == "image"
        if not jnp.issubdtype(array.dtype, jnp.floating):
            raise ValueError(
                f"{name} is {array.dtype}, but it must be floating-point"
                + (" in [0, 1]: divide uint8 images by 255." if is_image else ".")
            )
        if array.ndim < len(tail) or array.shape[array.ndim - len(tail) :] != tail:
            raise ValueError(
                f"{name} has shape {array.shape}, but {self.name} needs shape (..., {', '.join(map(str, tail))})"
                + (_misshapen(array.shape, tail) if is_image else ".")
            )
        return _float32(array)

    def _condition(
        self, condition: Any, lead: tuple[int, ...], course: _Course | None
    ) -> tuple[np.ndarray | Array | None, Bool[Array, "*n"] | None]:
        """Check the condition. Return it as float32 and, if it is traced, a mask of the items in range.

        In a roll-out, the time of the first frame is its last number.
        """
        width = max(self.model.config.condition - (course is not None), 0)
        shape, needed = None if condition is None else condition.shape, (*lead, width) if width else None
        if shape != needed:
            raise ValueError(
                f"condition has shape {shape}, but {self.name} needs {needed} (None: leave out the condition), in SI "
                "units."
            )
        if condition is None:
            return None, None
        condition = _float32(_array(condition))
        if course is not None:
            time = _float32(_array(course.time))
            if time.shape not in ((), lead):
                raise ValueError(f"time has shape {time.shape}: give one number, or one for each item, {lead}.")
            xp = jnp if _traced(condition) or _traced(time) else np
            condition = xp.concatenate([condition, xp.broadcast_to(time, lead)[..., None]], -1)
        limit = _LARGEST_CONDITION * np.array(self.preprocessing.condition_scale)
        fine = (abs(condition) <= limit).all(axis=-1)
        if _traced(fine):
            return condition, fine
        if not fine.all():
            sizes = np.abs(condition).reshape(-1, len(limit)).max(0).tolist()
            raise ValueError(
                f"condition{' and time have' if course else ' has'} magnitudes up to {sizes}, but the limits are "
                f"{limit.tolist()} ({_LARGEST_CONDITION:g} times the typical magnitudes): give finite numbers in SI "
                "units."
            )
        return condition, None


def _cut(given: Any, chunk: int, count: int) -> Iterator[Any]:
    """Cut the arrays of a batch of `count` items into chunks. Copies of the last item fill the last one."""
    for start in range(0, count, chunk):
        rows = np.minimum(np.arange(start, start + chunk), count - 1)
        yield jax.tree.map(lambda x, rows=rows: x[rows], given)


def _joined(parts: list[Prediction], lead: tuple[int, ...], *, axis: int = 0) -> Prediction:
    """Concatenate the predictions of chunks without the filling, and give them the leading axes `lead`.

    The items are on the first axis, or on `axis` of the arrays that have further axes in front of them in samples.
    """

    def joined(axis: int, *leaves: Array) -> Array:
        leaf = jnp.concatenate(leaves, axis)
        kept = jax.lax.slice_in_dim(leaf, 0, math.prod(lead), axis=axis)
        return kept.reshape(*leaf.shape[:axis], *lead, *leaf.shape[axis + 1 :])

    drawn = [part.samples for part in parts if part.samples is not None]
    merged = {
        name: jax.tree.map(functools.partial(joined, 0 if name in _PER_ITEM else axis), *leaves)
        for name in Prediction._fields
        if name != "samples" and (leaves := [getattr(part, name) for part in parts])
    }
    return Prediction(**merged, samples=_joined(drawn, lead, axis=1) if drawn else None)


def _axes(num_samples: int) -> Prediction:
    """The axis of the items in the arrays of a prediction."""
    axes: dict[str, Any] = dict.fromkeys(Prediction._fields, 0)
    samples: dict[str, Any] = {name: 0 if name in _PER_ITEM else 1 for name in axes}
    return Prediction(**(axes | {"samples": Prediction(**samples) if num_samples else 0}))


def _traced(value: object) -> bool:
    return isinstance(value, jax.core.Tracer)


def _array(value: Any) -> np.ndarray | Array:
    """Convert a value to NumPy, because inside `jax.jit` a test of a JAX array would be traced."""
    return value if _traced(value) else np.asarray(value)


def _float32(array: Any) -> Any:
    """Convert to float32. Numbers that are too large become infinite, and a later check rejects them."""
    with np.errstate(over="ignore"):
        return array.astype(np.float32)


def _misshapen(shape: tuple[int, ...], tail: tuple[int, ...]) -> str:
    """What is wrong with the shape of images, as the end of a message."""
    last, channels = shape[-1] if shape else 0, tail[-1]
    if last == channels and len(shape) >= len(tail):
        return f": render with resolution={tail[:2]}."
    if last == channels + 1:
        return f": the images have {last} channels (RGBA?). Leave out the transparency: image[..., :{channels}]."
    if len(shape) >= len(tail) and shape[-3] in (channels, channels + 1):
        return ": the channels are first. Move them to the end: np.moveaxis(image, -3, -1)."
    if last == 1 or shape[-2:] == tail[:2] or (len(shape) > 1 and min(shape[-2:]) > channels + 1):
        grey = "image" if last == 1 else "image[..., None]"
        return f": the images are grey. Give {channels} channels: np.repeat({grey}, {channels}, -1)."
    return f": the last axis must be the {channels} channels."


def _in_range(kind: Kind, array: Any) -> Any:
    """Find the items of a batch whose numbers are in the range of their kind, with JAX only if they are traced."""
    xp = jnp if _traced(array) else np
    if kind == "vector":
        return xp.isfinite(array).all(-1)
    if kind == "pose":
        with np.errstate(over="ignore", invalid="ignore"):
            lengths = xp.linalg.norm(array[..., 3:], axis=-1)
            return (abs(lengths - 1) <= _QUAT_TOLERANCE) & (abs(array[..., :3]) <= _FARTHEST).all(-1)
    return xp.asarray((array >= 0) & (array <= 1)).all((-3, -2, -1))


def _reason(name: str, kind: Kind, items: np.ndarray) -> str:
    """The message for items that are not in the range of their kind."""
    if not np.isfinite(items).all():
        return f"{name} has NaN or infinite values: exclude such items with present={{{name!r}: mask}}."
    if kind == "image":
        return (
            f"{name} has values in [{items.min():.3g}, {items.max():.3g}], but images must be in [0, 1]: divide by 255 "
            "if the values are 8-bit."
        )
    lengths = np.linalg.norm(items[..., 3:].astype(np.float64), axis=-1)  # squares of 1e30 are beyond float32
    length = lengths.flat[np.abs(lengths - 1).argmax()]
    if abs(length - 1) > _QUAT_TOLERANCE:
        return f"pose has a quaternion of length {length:.5g}: give a position (m) and a unit quaternion [w, x, y, z]."
    return (
        f"pose has a coordinate of {np.abs(items[..., :3]).max():.3g} m, but at most {_FARTHEST:g} m is allowed: give "
        "metres, not millimetres."
    )


def _located(folder: str | Path) -> Path:
    """The folder of a model, given as `Predictor.load` describes."""
    path, name = Path(folder), str(folder)
    names = sorted(config.parent.name for config in MODELS.glob("*/config.json"))
    models = sorted(config.parent for config in path.glob("models/*/config.json"))
    # pathlib drops the dot of ./freefall
    own = isinstance(folder, Path) and (models or (path / "config.json").exists())
    if name in names and not own:
        return MODELS / name
    if len(models) > 1:
        raise ValueError(f"{folder} has {len(models)} models: give one of {', '.join(map(str, models))}.")
    if models:
        return models[0]
    if name == path.name and not (path / "config.json").exists():
        raise FileNotFoundError(
            f"{name!r} is neither a folder with a config.json nor one of the trained models that come with sts_jax "
            f"({', '.join(names) or 'none'}): give one of these names, or the folder of a trained model."
        )
    return path
