"""The training loss, the predictions and the log evidence of the MVAE.

The model sees inputs `x_t` at the time t and predicts targets `x_T` at a later time T. Training minimises a negative
time-lagged evidence lower bound, summed over the non-empty subsets X of the modalities and averaged over the batch
(paper, "Learning Intuitive Physics with MVAEs"):

`L(x_t, x_T) = sum_X [ sum_{m in asked(X)} lambda_m E_{q(z | X_t)} E_m(x_T, z) + beta KL(q(z | X_t) || p(z)) ]`

`asked(X)` are the modalities that the subset has to predict, and `q(z | X_t)` is the product of the prior and of the
subset's experts, from which one `z` is drawn. `E_m` is the error of the prediction: the binary cross-entropy of an
image (nats, summed over pixels and channels), the mean squared error of the components of a vector, or the
cross-entropy of a category (nats). `lambda_m` is `Modality.weight`.

A condition `c` is always an input of the decoders, `E_m(x_T, z, c)`. With `Config.encode_condition` it is also an input
of the encoders, `q(z | X_t, c)`. The prior `p(z)` is `N(0, I)`, or `p(z | c)` with `Config.prior="conditional"`. Both
options together are the paper's equation (10).

If a sample has inputs, but none from the modalities of a subset, its loss omits the subset. The posterior of the subset
is the prior, and decoders that predict from such a `z` learn to mix the mean target into every prediction. If a sample
has no input at all, its loss keeps all subsets, because the mean target is then the right prediction.
"""

import functools
import math
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sts_jax._checked import in_32_bits
from sts_jax.mvae.gaussian import Gaussian, kl_divergence, kl_standard_normal, product_of_experts
from sts_jax.mvae.networks import MVAE, Config, Modality


class Terms(NamedTuple):
    """The loss of a batch and its parts, without the factors `beta` and `Modality.weight`.

    The parts are means over the combinations of a sample and a subset that the loss does not omit.
    """

    loss: Float[Array, ""]  # the weighted sum that is minimised, averaged over the batch
    kl: Float[Array, ""]  # divergence from the prior (nats)
    # error by modality: nats per image or category, or mean squared error of a vector
    reconstruction: dict[str, Float[Array, ""]]


class _Group(NamedTuple):
    """Subsets that have the same members after the absent modalities are removed."""

    members: int  # bit m is set if modality m is a member
    subsets: int  # number of these subsets
    asked: tuple[int, ...]  # for each modality, the number of subsets that predict it


def _groups(config: Config, asked: Literal["all", "own"], absent: tuple[str, ...], *, empty: bool) -> list[_Group]:
    """Group the subsets. The group without members is kept if `empty` is True or all modalities are absent."""
    count = len(config.modalities)
    kept = sum(1 << i for i, name in enumerate(config.names) if name not in absent)
    groups: dict[int, _Group] = {}
    for subset in range(1, 1 << count):
        old = groups.get(subset & kept, _Group(subset & kept, 0, (0,) * count))
        more = [1 if asked == "all" else subset >> i & 1 for i in range(count)]
        groups[old.members] = _Group(
            old.members, old.subsets + 1, tuple(a + b for a, b in zip(old.asked, more, strict=True))
        )
    return [g for g in groups.values() if g.members or empty or not kept]


@in_32_bits
def loss(
    graphdef: nnx.GraphDef[MVAE],
    params: nnx.State,
    stats: nnx.State,
    key: PRNGKeyArray,
    inputs: dict[str, Array],
    targets: dict[str, Array],
    *,
    present: dict[str, Bool[Array, "batch"]] | None = None,
    target_present: dict[str, Bool[Array, "batch"]] | None = None,
    condition: Float[Array, "batch condition"] | None = None,
    beta: float | Float[Array, ""] = 1.0,
    asked: Literal["all", "own"] = "all",
    absent: tuple[str, ...] = (),
    training: bool = True,
) -> tuple[Float[Array, ""], tuple[nnx.State, Terms]]:
    """Compute the loss of one batch, see the docstring of the module.

    The `absent` modalities are removed from all subsets. If several subsets are then equal, the term of one subset is
    computed and multiplied by their number. For each modality, one call of the decoder predicts the targets for all
    subsets, with one batch normalisation, in which a prediction for n equal subsets has the weight n. Two subsets that
    use the same modalities of a sample also use the same noise for its `z`.

    Args:
        key: Random key for the noise of `z`.
        inputs: Inputs by modality, `(batch, *shape)`. Images are in [0, 1]. A modality without an input counts as
            absent.
        targets: Targets of all modalities, `(batch, *shape)`. Images are in [0, 1], categories are probabilities.
        present: Masks of the inputs by modality. True means that the sample has the input. An input without a mask is
            present in all samples. Values of samples whose mask is False have no influence and may be NaN.
        target_present: Masks of the targets by modality. A target whose mask is False adds 0 to the loss, which is
            still divided by the size of the whole batch.
        condition: The condition of each sample, which is appended to its latent.
        beta: Weight of the divergence of the posterior from the prior.
        asked: `all` predicts all modalities for each subset, `own` only its members, as in the paper's code.
        absent: Names of modalities that are not inputs of any sample.
        training: True for the statistics of the batch in batch normalisation, False for the running ones.

    Returns:
        A tuple `(loss, (stats, terms))` with the loss, the new running batch statistics, and the terms of the loss.
    """
    model = nnx.merge(graphdef, params, stats, copy=True)
    config = model.config
    _check(config, asked, absent, targets, {**inputs, **(present or {}), **(target_present or {})})
    _check_condition(config, condition)
    absent = tuple(name for name in config.names if name in absent or name not in inputs)
    batch = len(next(iter(targets.values())))
    experts, mask = _experts(model, inputs, present or {}, absent, batch, condition, training=training)
    prior = model.prior(condition) if config.prior == "conditional" else None

    groups = _groups(config, asked, absent, empty=bool(present))  # only a mask can leave a sample without input
    members = jnp.array([[bool(g.members >> i & 1) for i in range(len(config.names))] for g in groups])
    left = members[:, :, None] & mask[None]
    counts = jnp.any(left, axis=1) | ~jnp.any(mask, axis=0)[None]  # (group, batch)
    posterior = jax.vmap(lambda p: product_of_experts(experts, p, prior))(left)
    divergence = kl_standard_normal(posterior) if prior is None else kl_divergence(posterior, _stacked(prior))
    subsets = jnp.array([g.subsets for g in groups], jnp.float32)[:, None] * counts
    kl = jnp.sum(subsets * divergence)
    z = posterior.mean + jnp.exp(0.5 * posterior.log_var) * _noise(key, groups, left, posterior.mean.shape)
    z = _with_condition(z, condition)

    total = beta * kl / batch
    reconstruction = {}
    for i, modality in enumerate(config.modalities):
        rows = [j for j, g in enumerate(groups) if g.asked[i]]
        times = jnp.array([groups[j].asked[i] for j in rows], jnp.float32)
        target = targets[modality.name]
        known = (target_present or {}).get(modality.name, jnp.ones(batch, bool))
        weights = (times[:, None] * counts[jnp.array(rows)] * known[None]).reshape(-1)
        output = model.decoders[modality.name](
            z[jnp.array(rows)].reshape(-1, z.shape[-1]), weights if training else None
        )
        target = jnp.where(_over(known, target), target, 0)
        error = _error(modality, output.reshape(len(rows), *target.shape), target[None])
        summed = jnp.sum(weights * error.reshape(-1)) / batch
        total = total + modality.weight * summed
        reconstruction[modality.name] = summed * batch / jnp.maximum(jnp.sum(weights), 1)
    return total, (nnx.state(model, nnx.BatchStat), Terms(total, kl / jnp.sum(subsets), reconstruction))


@in_32_bits
@functools.partial(jax.jit, static_argnames="graphdef")
def infer(
    graphdef: nnx.GraphDef[MVAE],
    state: nnx.State,
    inputs: dict[str, Array],
    *,
    present: dict[str, Bool[Array, "batch"]] | None = None,
    condition: Float[Array, "batch condition"] | None = None,
) -> Gaussian:
    """Compute the posterior `q(z | X)`, with the running batch statistics. Without any input, it is the prior.

    Args:
        state: Parameters and running batch statistics, `nnx.merge_state(params, stats)`.
        inputs: Inputs by modality, at least one, `(batch, *shape)`. Images are in [0, 1].
        present: Masks of the inputs by modality. An input without a mask is present in all samples.
        condition: The condition of each sample, for models whose encoders or prior depend on it.
    """
    model = nnx.merge(graphdef, state)
    _check_condition(model.config, condition, needed=_depends(model.config))
    unknown = sorted({*inputs, *(present or {})} - set(model.config.names))
    if unknown or not inputs:
        raise ValueError(
            f"the inputs are {list(inputs)} and the masks {list(present or {})}: give at least one input, and use only "
            f"the names {list(model.config.names)}"
        )
    absent = tuple(name for name in model.config.names if name not in inputs)
    batch = len(next(iter(inputs.values())))
    experts = _experts(model, inputs, present or {}, absent, batch, condition, training=False)
    return product_of_experts(*experts, model.prior(condition) if model.config.prior == "conditional" else None)


@in_32_bits
@functools.partial(jax.jit, static_argnames=("graphdef", "batch"))
def prior(
    graphdef: nnx.GraphDef[MVAE],
    state: nnx.State,
    batch: int,
    *,
    condition: Float[Array, "batch condition"] | None = None,
) -> Gaussian:
    """Compute the prior of `batch` samples: `N(0, I)`, or `p(z | c)` of a model with a conditional prior.

    The other arguments are those of `infer`.
    """
    model = nnx.merge(graphdef, state)
    _check_condition(model.config, condition, needed=model.config.prior == "conditional")
    if model.config.prior == "conditional":
        return model.prior(condition)
    nothing = jnp.zeros((batch, model.config.latent), jnp.float32)
    return Gaussian(nothing, nothing)


@in_32_bits
@functools.partial(jax.jit, static_argnames="graphdef")
def decode(
    graphdef: nnx.GraphDef[MVAE],
    state: nnx.State,
    z: Float[Array, "*batch latent"],
    *,
    condition: Float[Array, "*batch condition"] | None = None,
) -> dict[str, Array]:
    """Predict every modality from a latent, with the running batch statistics.

    Args:
        state: Parameters and running batch statistics, `nnx.merge_state(params, stats)`.
        condition: The condition, which is appended to each latent.

    Returns:
        The predictions by modality, `(*batch, *shape)`. Images and categories are logits.
    """
    model = nnx.merge(graphdef, state)
    _check_condition(model.config, condition)
    return _decoded(model, z, condition, model.config.names)


@in_32_bits
@functools.partial(jax.jit, static_argnames="graphdef")
def predict(
    graphdef: nnx.GraphDef[MVAE],
    state: nnx.State,
    inputs: dict[str, Array],
    *,
    present: dict[str, Bool[Array, "batch"]] | None = None,
    condition: Float[Array, "batch condition"] | None = None,
) -> tuple[dict[str, Array], Gaussian]:
    """Predict every modality from the mean of the posterior. Return the predictions and the posterior.

    The arguments are those of `infer` and `decode`.
    """
    posterior = infer(graphdef, state, inputs, present=present, condition=condition)
    return decode(graphdef, state, posterior.mean, condition=condition), posterior


@in_32_bits
def log_evidence(
    graphdef: nnx.GraphDef[MVAE],
    state: nnx.State,
    key: PRNGKeyArray,
    inputs: dict[str, Array],
    targets: dict[str, Array],
    *,
    present: dict[str, Bool[Array, "batch"]] | None = None,
    condition: Float[Array, "batch condition"] | None = None,
    num: int = 1000,
    chunk: int = 20,
) -> Float[Array, "batch"]:
    """Estimate the log evidence `log p(targets | c)` of each sample (nats), with the running batch statistics.

    The estimate is `log mean_k p(targets | z_k, c) p(z_k | c) / q(z_k | inputs, c)`, with `num` samples `z_k` from the
    posterior given the inputs (importance sampling). Its expectation is a lower bound, which rises to the log evidence
    with `num`. It is exact with one sample if the posterior is that of the targets.

    The likelihood of an image is that of independent Bernoulli variables, one for each pixel and channel. For pixels
    that are neither 0 nor 1, it is minus the binary cross-entropy, and no normalised density. The likelihood of a
    category is the probability of its class. The likelihood of a vector is a Gaussian with the variance
    `size / (2 weight)` around the output. With this variance, `weight` times the mean squared error is its negative
    logarithm up to a constant, so that the training loss is a bound on this evidence. `weight` has no influence on
    images and categories.

    Args:
        inputs: Inputs by modality, at least one, `(batch, *shape)`.
        targets: Targets of one or more modalities, `(batch, *shape)`: `log p(x)` or `log p(x, y)`.
        num: Number of importance samples.
        chunk: Number of importance samples that are decoded at once. It bounds the memory.

    The other arguments are those of `infer`. The function is a loop over compiled chunks, so call it outside `jax.jit`.
    """
    config = nnx.merge(graphdef, state).config
    if not targets or not set(targets) <= set(config.names) or num < 1 or chunk < 1:
        raise ValueError(
            f"got targets {list(targets)}, num={num} and chunk={chunk}: give targets of at least one of the modalities "
            f"{list(config.names)}, and num and chunk >= 1"
        )
    _check_condition(config, condition)
    proposal = infer(graphdef, state, inputs, present=present, condition=condition)
    base = prior(graphdef, state, len(proposal.mean), condition=condition)
    # A Python loop, because convolutions in `lax.scan` are slow on a CPU.
    sizes = [min(chunk, num - start) for start in range(0, num, chunk)]
    log_weights = [
        _log_weights(graphdef, state, jax.random.fold_in(key, i), proposal, base, targets, condition, size)
        for i, size in enumerate(sizes)
    ]
    return jax.nn.logsumexp(jnp.concatenate(log_weights), axis=0) - math.log(num)


@functools.partial(jax.jit, static_argnums=(0, 7))
def _log_weights(
    graphdef: nnx.GraphDef[MVAE],
    state: nnx.State,
    key: PRNGKeyArray,
    proposal: Gaussian,
    base: Gaussian,
    targets: dict[str, Array],
    condition: Array | None,
    num: int,
) -> Float[Array, "num batch"]:
    """Logarithms of the importance weights of `num` latents from the proposal. `base` is the prior."""
    model = nnx.merge(graphdef, state)
    q, p = _stacked(proposal), _stacked(base)
    noise = jax.random.normal(key, (num, *proposal.mean.shape))
    z = q.mean + jnp.exp(0.5 * q.log_var) * noise
    away = (z - p.mean) ** 2 * jnp.exp(-p.log_var)
    log_weight = 0.5 * jnp.sum(noise**2 + q.log_var - away - p.log_var, axis=-1)  # log p(z | c) - log q(z | inputs, c)
    outputs = _decoded(model, z, condition, tuple(targets))
    for modality in model.config.modalities:
        if modality.name in targets:
            error = _error(modality, outputs[modality.name], targets[modality.name][None])
            if modality.kind == "vector":
                variance = modality.shape[0] / (2 * modality.weight)
                error = modality.weight * error + 0.5 * modality.shape[0] * math.log(2 * math.pi * variance)
            log_weight = log_weight - error
    return log_weight


def _check(
    config: Config, asked: str, absent: tuple[str, ...], targets: dict[str, Array], given: dict[str, Array]
) -> None:
    unknown = sorted((set(absent) | set(given)) - set(config.names))
    if unknown or set(targets) != set(config.names) or asked not in ("all", "own"):
        raise ValueError(
            f"the model has the modalities {config.names}, and needs exactly these targets, got targets "
            f"{sorted(targets)}, unknown names {unknown}, and asked={asked!r} ('all' or 'own')"
        )


def _depends(config: Config) -> bool:
    """Whether the posterior depends on the condition."""
    return config.encode_condition or config.prior == "conditional"


def _check_condition(config: Config, condition: Array | None, *, needed: bool = True) -> None:
    width = 0 if condition is None else condition.shape[-1]
    if width != config.condition and (needed or condition is not None):
        raise ValueError(f"condition has width {width}, but the model needs width {config.condition}")


def _stacked(g: Gaussian) -> Gaussian:
    return Gaussian(g.mean[None], g.log_var[None])


def _over(mask: Array, like: Array) -> Array:
    """Append axes to a mask over the batch, so that it broadcasts with the array `like`."""
    return mask.reshape(-1, *(1,) * (like.ndim - 1))


def _experts(
    model: MVAE,
    inputs: dict[str, Array],
    present: dict[str, Array],
    absent: tuple[str, ...],
    batch: int,
    condition: Array | None,
    *,
    training: bool,
) -> tuple[Gaussian, Array]:
    """The experts of all modalities, `(modality, batch, latent)`, and the mask of the present ones."""
    nothing = jnp.zeros((batch, model.config.latent), jnp.float32)
    experts, masks = [], []
    for name in model.config.names:
        if name in absent:
            experts.append(Gaussian(nothing, nothing))
            masks.append(jnp.zeros(batch, bool))
            continue
        mask = present.get(name, jnp.ones(batch, bool)).astype(bool)
        x = jnp.where(_over(mask, inputs[name]), inputs[name], 0)
        weights = mask.astype(jnp.float32) if training else None
        experts.append(model.encoders[name](x, weights, condition if model.config.encode_condition else None))
        masks.append(mask)
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *experts), jnp.stack(masks)


def _noise(key: PRNGKeyArray, groups: list[_Group], left: Array, shape: tuple[int, ...]) -> Array:
    """Standard normal noise `(group, batch, latent)`, equal for groups with the same present modalities in a sample."""
    possible = sorted({part for g in groups for part in range(g.members + 1) if part & g.members == part})
    drawn = jnp.stack([jax.random.normal(jax.random.fold_in(key, p), shape[1:]) for p in possible])
    place = jnp.zeros(possible[-1] + 1, jnp.int32).at[jnp.array(possible)].set(jnp.arange(len(possible)))
    bits = jnp.array([1 << i for i in range(left.shape[1])], jnp.int32)
    index = place[jnp.sum(jnp.where(left, bits[None, :, None], 0), axis=1)]
    return drawn[index, jnp.arange(shape[1])[None]]


def _with_condition(z: Array, condition: Array | None) -> Array:
    if condition is None:
        return z
    return jnp.concatenate([z, jnp.broadcast_to(condition, (*z.shape[:-1], condition.shape[-1]))], axis=-1)


def _decoded(model: MVAE, z: Array, condition: Array | None, names: tuple[str, ...]) -> dict[str, Array]:
    """The predictions of some modalities from latents `(*batch, latent)`."""
    z = _with_condition(z, condition)
    flat, shapes = z.reshape(-1, z.shape[-1]), {m.name: m.shape for m in model.config.modalities}
    return {name: model.decoders[name](flat, None).reshape(*z.shape[:-1], *shapes[name]) for name in names}


def _error(modality: Modality, output: Array, target: Array) -> Array:
    """The error `E_m` of each item (module docstring). The leading axes remain."""
    if modality.kind == "image":
        error = jax.nn.softplus(output) - output * target
        return jnp.sum(error, axis=(-3, -2, -1))
    if modality.kind == "category":
        return -jnp.sum(target * jax.nn.log_softmax(output), axis=-1)
    return jnp.mean((output - target) ** 2, axis=-1)
