"""Calibration of the predicted density of the final pose on trajectories that the training did not see.

The encoders estimate the states of training objects better than the states of other objects. The transition learns its
density from training objects, and this density is too narrow for other objects. The error depends on the inputs.

Three numbers for each subset of the inputs correct the density: a power of the probabilities of the outcomes, a power
of the weights of the mixture, and a factor of the variances. They are temperatures in the sense of Guo et al. (2017),
"On Calibration of Modern Neural Networks". The first number can make the outcomes less or more certain. After a short
training, the predicted probabilities are often too uncertain. The other two numbers can only widen the density of the
pose. On few objects, the likelihood is often largest for a narrower density, which then covers too few of the true
poses of other objects.
"""

import functools
import itertools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float, Int
from scipy import optimize

from sts_jax.mvae import Gaussian
from sts_jax.statespace.networks import FinalPose, Model
from sts_jax.statespace.objective import experts, fuse, log_density, of_state, rotation_between

_CHUNK = 64  # items in one compiled call
# Bounds of the logarithms of the three numbers. The last two allow a wider density of the pose, and no narrower one.
_BOUNDS = ((-math.log(4), math.log(4)), (-math.log(4), 0), (0, math.log(4)))
_PRIOR = 0.5  # standard deviation of the logarithms in the prior, which is a normal distribution about 0


class Calibration(NamedTuple):
    """Factors and exponents that correct the density of the final pose, for each subset of the model's inputs.

    Each array has one value for each subset. The value 1 leaves the density unchanged. A subset has the index
    `sum(2**i for i in members)`, where `members` are the positions of its inputs in `Config.inputs`. For example, the
    subset of the first and the second input has the index 3.
    """

    outcome: Float[Array, "subsets"]  # exponent of the probabilities of the outcomes, in [1/4, 4]
    weight: Float[Array, "subsets"]  # exponent of the weights of an outcome's mixture components, in [1/4, 1]
    variance: Float[Array, "subsets"]  # factor of the variances of the components, in [1, 4]


def predict(
    model: Model,
    inputs: dict[str, Array],
    present: dict[str, Bool[Array, "n"]],
    empty: dict[str, Float[Array, "size size 3"]],
    condition: Float[Array, "n c"] | None = None,
    calibration: Calibration | None = None,
) -> tuple[Gaussian, FinalPose]:
    """Infer the state and the appearance in the first frame, and predict the density of the final pose.

    Args:
        model: The networks.
        inputs: One or more inputs of n items, by name: images `visual` and `tactile` `(n, size, size, 3)` in [0, 1],
            pose codes `pose` `(n, 12)` and true state codes `state` `(n, code)`.
        present: A mask for each name in `inputs`, `(n,)`. True means that the item has the input.
        empty: `visual` and `tactile` image of the empty sensor, in [0, 1].
        condition: Known quantities of the scenario such as an acceleration, `(n, c)`, from
            `training.Preprocessing.encode_condition`. None if the model has no condition.
        calibration: Calibration of the density, or None. Items that have the true state code `state` as an input are
            not corrected.

    Returns:
        The posterior in the first frame, `(n, code + look)`, and the density of the final pose. The posterior is a
        Gaussian over the state code (pose, shape and mass) and the appearance code (all other visible properties).
    """
    belief = fuse(experts(model, inputs, present, empty), present)
    final = model.transition(of_state(belief), condition)
    if calibration is None:
        return belief, final
    number = sum(2**i * present[name].astype(int) for i, name in enumerate(model.config.inputs) if name in present)
    if "state" in present:
        number = jnp.where(present["state"], 0, number)
    return belief, corrected(final, *(x[jnp.asarray(number)] for x in calibration))


def corrected(
    final: FinalPose, outcome: Float[Array, "*n"], weight: Float[Array, "*n"], variance: Float[Array, "*n"]
) -> FinalPose:
    """Apply the three numbers of a calibration to the predicted densities of the final pose.

    Args:
        final: Densities of n items.
        outcome: Exponent of the probabilities of the outcomes: a scalar for all items, or `(n,)`.
        weight: Exponent of the weights of the mixture components: a scalar for all items, or `(n,)`.
        variance: Factor of the variances of the components: a scalar for all items, or `(n,)`.

    Returns:
        The corrected densities.
    """

    def power(log: Array, exponent: Array) -> Array:
        return jax.nn.log_softmax(log * exponent.reshape(-1, *(1,) * (log.ndim - 1)))

    return final._replace(
        outcome=power(final.outcome, outcome),
        weight=power(final.weight, weight),
        log_var=final.log_var + jnp.log(variance).reshape(-1, 1, 1, 1),
    )


def fit(
    graphdef: nnx.GraphDef[Model],
    params: nnx.State,
    inputs: dict[str, np.ndarray],
    targets: dict[str, np.ndarray],
    empty: dict[str, np.ndarray],
    *,
    present: dict[str, np.ndarray] | None = None,
    condition: np.ndarray | None = None,
) -> Calibration:
    """Fit the calibration of a model to the final poses of trajectories that its training did not see.

    The calibration has three values for each subset of the inputs. These values maximise the likelihood of the true
    outcomes and final poses, multiplied by a prior that favours calibration values near 1.

    Args:
        graphdef: Definition of the model, from `init`.
        params: Parameters of the model.
        inputs: All inputs of the model by name: images `visual` and `tactile` `(n, size, size, 3)`, uint8 or in [0, 1],
            and pose codes `pose` `(n, 12)`.
        targets: True values by name. `state` has the state codes of the first frames, `(n, code)`. `pose` has the pose
            codes of the last frames, `(n, 12)`. `outcome` has the index of each trajectory's outcome in the list of the
            scenario's outcomes, `(n,)`.
        empty: `visual` and `tactile` image of the empty sensor, uint8 or in [0, 1].
        present: Masks `(n,)` of the inputs. True means that the item has the input. An input without a mask is present
            in all items.
        condition: Known quantities of the scenario such as an acceleration, `(n, c)`, from
            `training.Preprocessing.encode_condition`. None if the model has no condition.

    Returns:
        The calibration. If no item has all inputs of a subset, the values of this subset are 1.
    """
    names = nnx.merge(graphdef, params).config.inputs
    number = len(targets["pose"])
    there = {name: np.ones(number, bool) for name in names} | (present or {})
    found = np.ones((2 ** len(names), 3))
    for members in itertools.product((False, True), repeat=len(names)):
        chosen = [name for name, member in zip(names, members, strict=True) if member]
        rows = np.flatnonzero(np.all([there[name] for name in chosen], axis=0)) if chosen else np.zeros(0, int)
        if len(rows):
            final = _densities(graphdef, params, inputs, empty, condition, chosen, rows)
            truth = (jnp.asarray(targets[name][rows]) for name in ("state", "pose", "outcome"))
            found[sum(2 ** names.index(name) for name in chosen)] = _fitted(final, *truth)
    return Calibration(*jnp.asarray(found.T, jnp.float32))


def _densities(
    graphdef: nnx.GraphDef[Model],
    params: nnx.State,
    inputs: dict[str, np.ndarray],
    empty: dict[str, np.ndarray],
    condition: np.ndarray | None,
    chosen: list[str],
    rows: np.ndarray,
) -> FinalPose:
    """Predict the densities of the items `rows` from the inputs `chosen`, in chunks of one size."""
    present = {name: np.full(_CHUNK, name in chosen) for name in inputs}
    shown = {name: _unit(image) for name, image in empty.items()}
    parts = []
    for start in range(0, len(rows), _CHUNK):
        some = rows[np.arange(start, start + _CHUNK) % len(rows)]
        own = {name: _unit(values[some]) for name, values in inputs.items()}
        parts.append(_density(graphdef, params, own, present, shown, None if condition is None else condition[some]))
    return jax.tree.map(lambda *x: jnp.concatenate(x)[: len(rows)], *parts)


@functools.partial(jax.jit, static_argnames="graphdef")
def _density(
    graphdef: nnx.GraphDef[Model],
    params: nnx.State,
    inputs: dict[str, Array],
    present: dict[str, Bool[Array, "n"]],
    empty: dict[str, Float[Array, "size size 3"]],
    condition: Float[Array, "n c"] | None,
) -> FinalPose:
    return predict(nnx.merge(graphdef, params), inputs, present, empty, condition)[1]


def _unit(values: np.ndarray) -> np.ndarray:
    """Convert uint8 images to float32 in [0, 1]. Other arrays are returned as they are."""
    return values.astype(np.float32) / 255 if values.dtype == np.uint8 else values


def _fitted(
    final: FinalPose, code: Float[Array, "n code"], pose: Float[Array, "n 12"], outcome: Int[Array, "n"]
) -> np.ndarray:
    """Fit the three numbers of one subset."""

    def evaluated(log: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = _nats(jnp.asarray(log, jnp.float32), final, code, pose, outcome)
        return float(value), np.asarray(slope, np.float64)

    return np.exp(optimize.minimize(evaluated, np.zeros(3), jac=True, bounds=_BOUNDS).x)


@jax.jit
@jax.value_and_grad
def _nats(
    log: Float[Array, "3"],
    final: FinalPose,
    code: Float[Array, "n code"],
    pose: Float[Array, "n 12"],
    outcome: Int[Array, "n"],
) -> Float[Array, ""]:
    """Negative log posterior density of the three numbers, up to a constant. `log` has their logarithms."""
    given, density = log_density(corrected(final, *jnp.exp(log)), pose, rotation_between(code, pose), outcome)
    return jnp.sum((log / _PRIOR) ** 2) / 2 - jnp.sum(given) - jnp.sum(density)
