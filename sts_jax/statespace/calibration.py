"""Fit the `Calibration` of a model to trajectories that its training did not see.

The encoders estimate the states of training objects better than the states of other objects. The transition learns
from training objects, and its density is too narrow for others. It is corrected for each subset of the inputs by three
temperatures in the sense of Guo et al. (2017), "On Calibration of Modern Neural Networks": an exponent of the
probabilities of the outcomes, an exponent of the weights of the mixtures, and a factor of the variances. The last two
can only widen the density of the pose: in a fit to few objects, a narrower density often has the largest likelihood,
but it covers too few of the true poses of other objects.

The fourth number is the contrast at which the gradient energy of the sampled images is nearest to that of the true
images. The gradient energy is the sum of the squared differences of neighbouring pixels.
"""

import functools
import math
from collections.abc import Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float, Int
from scipy import optimize

from sts_jax._checked import in_32_bits
from sts_jax.statespace.networks import CONTRAST, FinalPose, Model, compose
from sts_jax.statespace.objective import log_density, rotation_between
from sts_jax.statespace.predict import Calibration, corrected, draw, predict

CONTRASTS = (5.0, 10.0, 20.0, 40.0)  # contrasts of samples that are tried
_CHUNK = 64  # items in one compiled call
_SAMPLES = 4  # samples of each item for the choice of the contrast
_MOST = 128  # largest number of items for the choice of the contrast
# Bounds of the logarithms of the three numbers. The last two allow a wider density of the pose, and no narrower one.
_BOUNDS = ((-math.log(4), math.log(4)), (-math.log(4), 0), (0, math.log(4)))
_PRIOR = 0.5  # standard deviation of the logarithms in the prior, which is a normal distribution about 0
# Items of one compiled call: the arguments of `predict` between the model and the calibration
_Chunk = tuple[dict[str, Any], dict[str, Any], dict[str, Any], Any]


@in_32_bits
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
    """Fit the calibration of a model, by maximum likelihood with a prior that favours values near 1.

    Args:
        inputs: As in `loss`. Images may be uint8.
        targets: `state`, `pose`, `outcome` and `visual` as in `loss`. Images may be uint8.
        empty: `visual` and `tactile` image of the empty sensor, uint8 or in [0, 1].
        present: Masks `(n,)` of the inputs. An input without a mask is present in all items.
        condition: From `training.Preprocessing.encode_condition`, or None.

    Returns:
        The calibration. If no item has all inputs of a subset, its first three values are 1, and its contrast is
        `CONTRAST`.
    """
    names = nnx.merge(graphdef, params).config.inputs
    masks = {name: np.ones(len(targets["pose"]), bool) for name in names} | (present or {})
    fitted = np.ones((2 ** len(names), 4))
    fitted[:, 3] = CONTRAST
    for number in range(1, 2 ** len(names)):
        chosen = [name for i, name in enumerate(names) if number & 2**i]
        rows = np.flatnonzero(np.all([masks[name] for name in chosen], axis=0))
        if len(rows):
            final = _densities(graphdef, params, _chunks(inputs, empty, condition, chosen, rows), len(rows))
            truth = (jnp.asarray(targets[name][rows]) for name in ("state", "pose", "outcome"))
            numbers = fitted[number]
            numbers[:3] = _fitted(final, *truth)
            some = rows[np.linspace(0, len(rows), min(len(rows), _MOST), endpoint=False).astype(int)]
            chunks = _chunks(inputs, empty, condition, chosen, some)
            numbers[3] = _contrast(graphdef, params, chunks, targets["visual"][some], numbers[:3])
    return Calibration(*jnp.asarray(fitted.T, jnp.float32))


def _contrast(
    graphdef: nnx.GraphDef[Model],
    params: nnx.State,
    chunks: Iterable[_Chunk],
    target: np.ndarray,
    numbers: np.ndarray,
) -> float:
    """Find the contrast at which the gradient energy of samples is nearest to that of the true images `target`.

    `numbers` are the first three numbers of the calibration for the inputs of the chunks.
    """
    true = np.array(gradient_energy(jnp.asarray(_unit(target))))
    subsets = 2 ** len(nnx.merge(graphdef, params).config.inputs)
    correction = Calibration(*(jnp.full(subsets, x, jnp.float32) for x in (*numbers, CONTRAST)))
    parts = [_energies(graphdef, params, chunk, correction) for chunk in chunks]
    energies = np.concatenate(parts, axis=1)[:, : len(target)].mean(1)
    if true.sum() == 0 or not (energies > 0).all():
        return CONTRAST
    return CONTRASTS[np.argmin(np.abs(np.log(energies / true.mean())))]


def gradient_energy(images: Float[Array, "*n h w 3"]) -> Float[Array, "*n"]:
    """The gradient energy of each image: the sum of the squared differences of neighbouring pixels."""
    down, across = (jnp.diff(images, axis=axis) for axis in (-3, -2))
    return jnp.sum(down**2, axis=(-3, -2, -1)) + jnp.sum(across**2, axis=(-3, -2, -1))


@functools.partial(jax.jit, static_argnames="graphdef")
def _energies(
    graphdef: nnx.GraphDef[Model], params: nnx.State, chunk: _Chunk, correction: Calibration
) -> Float[Array, "contrasts n"]:
    """Mean gradient energy of the samples of each item, for each of the contrasts."""
    model, keys = nnx.merge(graphdef, params), jax.random.split(jax.random.key(0), _CHUNK)
    samples = draw(model, keys, *chunk, correction, num=_SAMPLES, drawn=_SAMPLES)
    energies = [
        gradient_energy(compose(samples.layers, samples.empty, samples.level, contrast)["visual"])
        for contrast in CONTRASTS
    ]
    return jnp.stack(energies).reshape(len(CONTRASTS), _SAMPLES, -1).mean(1)


def _densities(graphdef: nnx.GraphDef[Model], params: nnx.State, chunks: Iterable[_Chunk], number: int) -> FinalPose:
    """Predict the densities of the first `number` items of the chunks."""
    parts = [_density(graphdef, params, chunk) for chunk in chunks]
    return jax.tree.map(lambda *x: jnp.concatenate(x)[:number], *parts)


def _chunks(
    inputs: dict[str, np.ndarray],
    empty: dict[str, np.ndarray],
    condition: np.ndarray | None,
    chosen: list[str],
    rows: np.ndarray,
) -> Iterator[_Chunk]:
    """Divide items into chunks of one size, with the inputs `chosen`. Copies of items complete the last one."""
    present = {name: np.full(_CHUNK, name in chosen) for name in inputs}
    shown = {name: _unit(image) for name, image in empty.items()}
    for start in range(0, len(rows), _CHUNK):
        some = rows[np.arange(start, start + _CHUNK) % len(rows)]
        given = {name: _unit(values[some]) for name, values in inputs.items()}
        yield given, present, shown, None if condition is None else condition[some]


@functools.partial(jax.jit, static_argnames="graphdef")
def _density(graphdef: nnx.GraphDef[Model], params: nnx.State, chunk: _Chunk) -> FinalPose:
    return predict(nnx.merge(graphdef, params), *chunk)[1]


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
