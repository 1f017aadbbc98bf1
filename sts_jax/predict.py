"""A trained model as one function: from any of vision, touch and pose to what the sensor will see at rest."""

import functools
import math
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray

from sts_jax import mvae, training

MODALITIES = ("visual", "tactile", "pose")


class Prediction(NamedTuple):
    """The last moment, as a model expects it; None for what the model does not speak of."""

    visual: Float[Array, "*n h w 3"] | None  # [0, 1]
    tactile: Float[Array, "*n h w 3"] | None  # [0, 1]
    pose: Float[Array, "*n 7"] | None  # m, unit quaternion with w >= 0; mesh frame in the sensor frame
    mean: Float[Array, "*n latent"]  # of the fused posterior
    log_var: Float[Array, "*n latent"]
    samples: "Prediction | None" = None  # the same with a leading axis of samples, each from its own latent


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
    """What a model expects, from the mean of the fused posterior; pure, compiled once a shape and subset.

    Args:
        graphdef: The model's definition.
        state: Its parameters and running batch statistics.
        preprocessing: What it was trained on.
        blank: The tactile image of the untouched sensor, [0, 1].
        inputs: Some of `visual`, `tactile` `(*n, height, width, 3)` in [0, 1] and `pose` `(*n, 7)`.
        present: Which items of an input count, `(*n,)`; all where not given. A touch without contact never does,
            unless the model was trained to be fed the blank one.
        condition: `(*n, c)`, SI units, for models that have one.
        key: For the samples; consumed.
        num_samples: How many latents to draw besides the mean.
        shape: The leading axes where there is no input at all; the prediction is then the prior's.
    """
    lead = shape
    for name, value in inputs.items():
        lead = value.shape[: -1 if name == "pose" else -3]
    flat, counts = {}, {}
    for name, value in inputs.items():
        value = preprocessing.encode_pose(value) if name == "pose" else value
        flat[name] = value.reshape(-1, *value.shape[len(lead) :])
        counts[name] = present.get(name, jnp.ones(lead, bool)).reshape(-1)
    if "tactile" in flat:
        counts["tactile"] &= preprocessing.touched(flat["tactile"], blank)
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


class Predictor:
    """A checkpoint that is called: `predictor(visual=image)` gives a `Prediction`."""

    def __init__(self, model: training.Model, preprocessing: training.Preprocessing, blank: np.ndarray, name: str):
        """Use `Predictor.load`.

        Args:
            model: Definition, parameters and running statistics.
            preprocessing: What it was trained on.
            blank: The tactile image of the untouched sensor, [0, 1] `(height, width, 3)`.
            name: The model's folder, for messages.
        """
        self.model = model
        self.preprocessing = preprocessing
        self.name = name
        self._blank = jnp.asarray(blank)

    @classmethod
    def load(
        cls,
        folder: str | Path,
        *,
        resolution: tuple[int, int] | None = None,
        crop: bool | None = None,
    ) -> "Predictor":
        """Read a model's folder, such as `runs/freefall/models/mvae`.

        Args:
            folder: Where training left it.
            resolution: The images that will be given; refused if the model was trained on another.
            crop: The view that will be given (True: the square around the object); refused likewise.

        Raises:
            FileNotFoundError: There is no model in the folder.
            ValueError: The checkpoint is torn, or was trained on another view.
        """
        model = training.load(folder)
        preprocessing = training.preprocessing_from_json(model.settings["preprocessing"])
        for field, asked in (("resolution", resolution), ("crop", crop)):
            there = getattr(preprocessing, field)
            if asked is not None and asked != there:
                raise ValueError(
                    f"{folder} was trained on {field}={there}, asked for is {field}={asked}: "
                    "render that view, or train a model on this one."
                )
        _, tactile = training.load_blank(Path(folder))
        return cls(model, preprocessing, tactile.astype(np.float32) / 255, str(folder))

    def __call__(
        self,
        *,
        visual: ArrayLike | None = None,
        tactile: ArrayLike | None = None,
        pose: ArrayLike | None = None,
        condition: ArrayLike | None = None,
        present: dict[str, ArrayLike] | None = None,
        key: PRNGKeyArray | None = None,
        num_samples: int = 0,
    ) -> Prediction:
        """Predict the last moment from any non-empty subset of the first one's modalities.

        Args:
            visual: `(*n, height, width, 3)` in [0, 1], any leading axes, the same for all that is given.
            tactile: `(*n, height, width, 3)` in [0, 1]; items without contact are ignored.
            pose: `(*n, 7)` m and unit quaternion, mesh frame in the sensor frame.
            condition: `(*n, c)`, the scenario's input in SI units, for models that have one. Of a jerk: acceleration of
                the pad along x and y (m/s^2) and its duration (s).
            present: By name, which items of a modality count, bool `(*n,)`; what does not count may be NaN.
            key: For `num_samples`; consumed.
            num_samples: Draw this many predictions from the posterior besides that of its mean.

        Raises:
            ValueError: Nothing given, a modality the model does not have or was never given in training, a wrong
                shape, a value out of range, NaN. The message names it and what to do.
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
            raise ValueError(f"the leading axes differ: {leads}; give the same number of items of each modality.")
        masks = {name: np.asarray(mask, bool) for name, mask in (present or {}).items()}
        for name, mask in masks.items():
            if name not in arrays or mask.shape != lead:
                raise ValueError(
                    f"present[{name!r}] has shape {mask.shape}; it must mask a given modality, one of "
                    f"{list(arrays)}, with shape {lead}."
                )
        for name, array in arrays.items():
            self._check_values(name, array[masks[name]] if name in masks else array)
        condition = self._checked_condition(condition, lead)
        if num_samples < 0 or (num_samples > 0 and key is None):
            raise ValueError(f"num_samples={num_samples} needs a key and a number that is not negative.")
        return predict(
            self.model.graphdef,
            self.model.state,
            self.preprocessing,
            self._blank,
            arrays,
            masks,
            condition,
            key if num_samples else None,
            num_samples,
        )

    def prior(self, shape: tuple[int, ...] = (), *, condition: ArrayLike | None = None) -> Prediction:
        """What the model expects with no measurement given: the mean of the prior, for items of any leading `shape`.

        Args:
            shape: Of the items.
            condition: `(*shape, c)`, as in a call.
        """
        condition = self._checked_condition(condition, shape)
        return predict(
            self.model.graphdef, self.model.state, self.preprocessing, self._blank, {}, {}, condition, shape=shape
        )

    @property
    def modalities(self) -> tuple[str, ...]:
        """What this model can be given: what it has and was given in training."""
        return tuple(name for name in self.model.config.names if name not in self.preprocessing.absent)

    def _checked_name(self, name: str, value: ArrayLike) -> np.ndarray:
        if name not in self.model.config.names:
            raise ValueError(f"{self.name} has no {name}: it was trained on {', '.join(self.model.config.names)}.")
        if name in self.preprocessing.absent:
            raise ValueError(
                f"{self.name} cannot use {name}: no first moment it was trained on had any (in freefall nothing "
                f"touches the pad yet). Leave {name}= out, or use a model of another scenario."
            )
        array = np.asarray(value)
        if array.dtype.kind != "f":
            raise ValueError(
                f"{name} is {array.dtype}; give floats" + ("." if name == "pose" else " in [0, 1] (uint8 / 255).")
            )
        height, width = self.preprocessing.resolution
        tail = (7,) if name == "pose" else (height, width, 3)
        if array.ndim < len(tail) or array.shape[array.ndim - len(tail) :] != tail:
            raise ValueError(
                f"{name} has shape {array.shape}; {self.name} needs (..., {', '.join(map(str, tail))})"
                + ("." if name == "pose" else f": render with resolution={self.preprocessing.resolution}.")
            )
        if math.prod(array.shape) == 0:
            raise ValueError(f"{name} has shape {array.shape}: there is no item in it.")
        return array.astype(np.float32)

    def _checked_condition(self, value: ArrayLike | None, lead: tuple[int, ...]) -> np.ndarray | None:
        width = self.model.config.condition
        shape = None if value is None else np.shape(value)
        if shape != (None if width == 0 else (*lead, width)):
            raise ValueError(f"condition has shape {shape}; {self.name} needs {(*lead, width) if width else 'none'}.")
        if value is None:
            return None
        condition = np.asarray(value, np.float32)
        if not np.isfinite(condition).all():
            raise ValueError("condition has NaN or infinite values; every item needs one.")
        scale = np.array(self.preprocessing.condition_scale)
        if (np.abs(condition) > 100 * scale).any():
            raise ValueError(
                f"condition has {np.abs(condition).reshape(-1, width).max(0).tolist()}, where {scale.tolist()} is "
                "usual; are these SI units?"
            )
        return condition

    def _check_values(self, name: str, array: np.ndarray) -> None:
        if not np.isfinite(array).all():
            raise ValueError(f"{name} has NaN or infinite values; mask such items with present={{{name!r}: ...}}.")
        if name == "pose":
            lengths = np.linalg.norm(array[..., 3:], axis=-1)
            if lengths.size and np.abs(lengths - 1).max() > 1e-2:
                raise ValueError(
                    f"pose has a quaternion of length {lengths.flat[np.abs(lengths - 1).argmax()]:.3g}; "
                    "give position (m) and a unit quaternion [w, x, y, z]."
                )
            if array.size and np.abs(array[..., :3]).max() > 10:
                raise ValueError(
                    f"pose has a position {np.abs(array[..., :3]).max():.3g} m away; are these millimetres?"
                )
        elif array.size and (array.min() < 0 or array.max() > 1):
            raise ValueError(
                f"{name} has values in [{array.min():.3g}, {array.max():.3g}]; images are in [0, 1] (divide by 255?)."
            )
