"""Calibration of the predicted density on trajectories that the training did not see.

The density of the final pose is learnt on training objects, whose state the encoders estimate better than that of other
objects. For other objects it is too narrow, by an amount that depends on the inputs. Three numbers for each subset of
the inputs correct this: a power of the outcomes' probabilities, a power of the mixture's weights, and a factor of the
variances. They are temperatures in the sense of Guo et al. (2017), On calibration of modern neural networks. They can
only widen the density: the likelihood of a few objects often asks for a narrower one, which then covers too little.
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

_CHUNK = 64  # items of one compiled call
# Bounds of the logarithms of the three numbers, which allow a wider density and no narrower one
_BOUNDS = ((-math.log(4), 0), (-math.log(4), 0), (0, math.log(4)))
_PRIOR = 0.5  # standard deviation of these logarithms before the data are seen


class Calibration(NamedTuple):
    """Corrections of the density from each subset of the inputs. 1 changes nothing.

    The subset of index `sum of 2**i` has the inputs `Config.inputs[i]`.
    """

    outcome: Float[Array, "subsets"]  # power of the probabilities of the outcomes, in [1/4, 1]
    weight: Float[Array, "subsets"]  # power of the weights of an outcome's components, in [1/4, 1]
    variance: Float[Array, "subsets"]  # factor of the components' variances, in [1, 4]


def predict(
    model: Model,
    inputs: dict[str, Array],
    present: dict[str, Bool[Array, "n"]],
    empty: dict[str, Float[Array, "size size 3"]],
    condition: Float[Array, "n c"] | None = None,
    calibration: Calibration | None = None,
) -> tuple[Gaussian, FinalPose]:
    """The belief about the present state and the look, and the density of the final pose.

    Args:
        model: The networks.
        inputs: As in `objective.experts`.
        present: The items of each input that count.
        empty: As in `objective.experts`.
        condition: As in `Transition`.
        calibration: Corrects the density of items without a true `state`.
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
    """A density after the corrections of a `Calibration`, of all items or of each."""

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
    """The calibration with the largest posterior probability of the final poses of some trajectories.

    Args:
        graphdef: Definition of the model.
        params: Its parameters.
        inputs: All inputs of the model, as in `objective.experts`. Images may be uint8.
        targets: `state`, `pose` and `outcome`, as in `objective.loss`.
        empty: As in `objective.experts`. May be uint8.
        present: The items of each input that count (default: all).
        condition: As in `Transition`.

    Returns:
        The calibration. A subset of the inputs that no item has is not corrected.
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
    """The densities of some items from some of the inputs, in chunks of one size."""
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
    return values.astype(np.float32) / 255 if values.dtype == np.uint8 else values


def _fitted(
    final: FinalPose, code: Float[Array, "n code"], pose: Float[Array, "n 12"], outcome: Int[Array, "n"]
) -> np.ndarray:
    """The three numbers of one subset."""

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
    """Negative logarithm of the posterior density of a calibration, up to a constant."""
    given, density = log_density(corrected(final, *jnp.exp(log)), pose, rotation_between(code, pose), outcome)
    return jnp.sum((log / _PRIOR) ** 2) / 2 - jnp.sum(given) - jnp.sum(density)
