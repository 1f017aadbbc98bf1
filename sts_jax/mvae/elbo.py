"""The time-lagged evidence lower bound over all subsets of the modalities, and prediction.

`L(x_t, x_T) = sum_{X} [ sum_{m in asked(X)} lambda_m E_{q(z | X_t)} E_m(x_T, z) + beta KL(q(z | X_t) || N(0, I)) ]`
is minimised, where `X` runs over the non-empty subsets (paper, "Learning Intuitive Physics with MVAEs") and predicts
the modalities `asked(X)`. `E_m` is the binary cross-entropy with logits of an image, summed over pixels and
channels, or the mean squared error of a vector's components. The loss is averaged over the batch and summed over the
subsets. One draw of `z` estimates the expectation.

A subset is empty for a sample if none of its modalities is present in the sample. It is then left out for this sample.
(Its posterior would be the prior, and decoders that predict the target from a random `z` learn to answer every `z` with
a share of the mean target.) A sample without any input keeps all subsets, because the mean target is then the right
prediction.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sts_jax.mvae.gaussian import Gaussian, kl_standard_normal, product_of_experts
from sts_jax.mvae.networks import MVAE, Config, Modality


class Terms(NamedTuple):
    """The loss, and its unweighted parts as means over the batch and over the subsets that count."""

    loss: Float[Array, ""]
    kl: Float[Array, ""]  # nats
    reconstruction: dict[str, Float[Array, ""]]  # nats per image, mean squared error per vector


class _Group(NamedTuple):
    """Subsets that are equal without the absent modalities."""

    members: int  # bit m is set if modality m is a member
    subsets: int
    asked: tuple[int, ...]  # for each modality, the number of subsets that predict it


def _groups(config: Config, asked: Literal["all", "own"], absent: tuple[str, ...], *, empty: bool) -> list[_Group]:
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
) -> tuple[Float[Array, ""], tuple[nnx.State, Terms]]:
    """The negative bound of one batch (module docstring), in training mode.

    Each modality is encoded once. Subsets that are equal without the `absent` modalities are computed once and
    weighted by their number, so `absent` changes the time and not the loss. In each sample, a subset is reduced to its
    modalities that are present. All subsets are decoded in one stacked call and share batch statistics, weighted like
    the subsets. The noise of a sample depends on the modalities that remain of a subset, so that equal subsets draw the
    same `z`.

    Args:
        graphdef: definition of the model.
        params: parameters.
        stats: running batch statistics.
        key: consumed for the noise of `z`.
        inputs: `x_t` by name, `(batch, *shape)`, images in [0, 1]. A missing input counts as `absent`.
        targets: `x_T` by name, all of them.
        present: which samples have an input, by name. Without a mask all have it. Masked values have no influence, even
            NaN.
        target_present: the same for the targets. A missing target adds nothing to the sum, and the mean is still taken
            over the whole batch.
        condition: `(batch, condition)`, required if the model has one.
        beta: weight of the divergence.
        asked: `all`: every subset predicts every target. `own`: each subset predicts its own modalities (paper's code).
        absent: names of modalities that are present in no sample.

    Returns:
        The loss, and the pair of the new batch statistics (same structure) and the parts of the loss.
    """
    model = nnx.merge(graphdef, params, stats, copy=True)
    config = model.config
    _check(config, asked, absent, targets, {**inputs, **(present or {}), **(target_present or {})})
    absent = tuple(name for name in config.names if name in absent or name not in inputs)
    batch = len(next(iter(targets.values())))
    experts, mask = _experts(model, inputs, present or {}, absent, batch, training=True)

    groups = _groups(config, asked, absent, empty=bool(present))  # only a mask can leave a sample without input
    members = jnp.array([[bool(g.members >> i & 1) for i in range(len(config.names))] for g in groups])
    left = members[:, :, None] & mask[None]
    counts = jnp.any(left, axis=1) | ~jnp.any(mask, axis=0)[None]  # (group, batch)
    posterior = jax.vmap(lambda p: product_of_experts(experts, p))(left)
    divergence = kl_standard_normal(posterior)
    subsets = jnp.array([g.subsets for g in groups], jnp.float32)[:, None] * counts
    kl = jnp.sum(subsets * divergence)
    z = posterior.mean + jnp.exp(0.5 * posterior.log_var) * _noise(key, groups, left, posterior.mean.shape)
    z = _with_condition(config, z, condition)

    total = beta * kl / batch
    reconstruction = {}
    for i, modality in enumerate(config.modalities):
        rows = [j for j, g in enumerate(groups) if g.asked[i]]
        times = jnp.array([groups[j].asked[i] for j in rows], jnp.float32)
        target = targets[modality.name]
        known = (target_present or {}).get(modality.name, jnp.ones(batch, bool))
        weights = (times[:, None] * counts[jnp.array(rows)] * known[None]).reshape(-1)
        output = model.decode(modality.name, z[jnp.array(rows)].reshape(-1, z.shape[-1]), weights)
        target = jnp.where(_over(known, target), target, 0)
        error = _error(modality, output.reshape(len(rows), *target.shape), target[None])
        summed = jnp.sum(weights * error.reshape(-1)) / batch
        total = total + modality.weight * summed
        reconstruction[modality.name] = summed * batch / jnp.maximum(jnp.sum(weights), 1)
    return total, (nnx.state(model, nnx.BatchStat), Terms(total, kl / jnp.sum(subsets), reconstruction))


def infer(
    graphdef: nnx.GraphDef[MVAE],
    state: nnx.State,
    inputs: dict[str, Array],
    *,
    present: dict[str, Bool[Array, "batch"]] | None = None,
) -> Gaussian:
    """The fused posterior `q(z | X)` with the running batch statistics.

    Args:
        graphdef: definition of the model.
        state: parameters and statistics, `nnx.merge_state(params, stats)`.
        inputs: at least one modality by name, `(batch, *shape)`, images in [0, 1].
        present: which samples have an input, by name. Without a mask all have it. A sample without inputs has the
            prior.

    Returns:
        Mean and log variance, `(batch, latent)`.

    Raises:
        ValueError: there is no input, or a name is unknown.
    """
    model = nnx.merge(graphdef, state)
    unknown = sorted({*inputs, *(present or {})} - set(model.config.names))
    if unknown or not inputs:
        raise ValueError(
            f"inputs are named {list(inputs)} and masks {list(present or {})}. Give at least one input, with "
            f"names from {list(model.config.names)}"
        )
    absent = tuple(name for name in model.config.names if name not in inputs)
    batch = len(next(iter(inputs.values())))
    return product_of_experts(*_experts(model, inputs, present or {}, absent, batch, training=False))


def decode(
    graphdef: nnx.GraphDef[MVAE],
    state: nnx.State,
    z: Float[Array, "*batch latent"],
    *,
    condition: Float[Array, "*batch condition"] | None = None,
) -> dict[str, Array]:
    """Decode every modality from a latent, with the running batch statistics.

    Args:
        graphdef: definition of the model.
        state: parameters and statistics, `nnx.merge_state(params, stats)`.
        z: latent, with any leading axes.
        condition: with the same leading axes, required if the model has one.

    Returns:
        By name: logits of images (`jax.nn.sigmoid` gives the image) and values of vectors, `(*batch, *shape)`.
    """
    model = nnx.merge(graphdef, state)
    z = _with_condition(model.config, z, condition)
    flat = z.reshape(-1, z.shape[-1])
    return {m.name: model.decode(m.name, flat, None).reshape(*z.shape[:-1], *m.shape) for m in model.config.modalities}


def predict(
    graphdef: nnx.GraphDef[MVAE],
    state: nnx.State,
    inputs: dict[str, Array],
    *,
    present: dict[str, Bool[Array, "batch"]] | None = None,
    condition: Float[Array, "batch condition"] | None = None,
) -> tuple[dict[str, Array], Gaussian]:
    """Predict from any subset of the inputs, by `decode` of the mean of `infer`. The arguments are those of both."""
    posterior = infer(graphdef, state, inputs, present=present)
    return decode(graphdef, state, posterior.mean, condition=condition), posterior


def _check(
    config: Config, asked: str, absent: tuple[str, ...], targets: dict[str, Array], given: dict[str, Array]
) -> None:
    if asked not in ("all", "own"):
        raise ValueError(f"asked is {asked!r}, but it must be 'all' or 'own'")
    if set(absent) - set(config.names):
        raise ValueError(f"absent is {absent}, but the model has only {config.names}")
    unknown = sorted(set(given) - set(config.names))
    if unknown:
        raise ValueError(f"inputs or masks are named {unknown}, but the model has only {config.names}")
    if set(targets) != set(config.names):
        raise ValueError(f"targets are named {sorted(targets)}, but the model needs {sorted(config.names)}")


def _over(mask: Array, like: Array) -> Array:
    """A mask over the batch with as many axes as `like`."""
    return mask.reshape(-1, *(1,) * (like.ndim - 1))


def _experts(
    model: MVAE,
    inputs: dict[str, Array],
    present: dict[str, Array],
    absent: tuple[str, ...],
    batch: int,
    *,
    training: bool,
) -> tuple[Gaussian, Array]:
    """All experts, `(modality, batch, latent)`, and the mask of those that are present, `(modality, batch)`."""
    nothing = jnp.zeros((batch, model.config.latent), jnp.float32)
    experts, masks = [], []
    for name in model.config.names:
        if name in absent:
            experts.append(Gaussian(nothing, nothing))
            masks.append(jnp.zeros(batch, bool))
            continue
        mask = present.get(name, jnp.ones(batch, bool)).astype(bool)
        x = jnp.where(_over(mask, inputs[name]), inputs[name], 0)
        experts.append(model.encode(name, x, mask.astype(jnp.float32) if training else None))
        masks.append(mask)
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *experts), jnp.stack(masks)


def _noise(key: PRNGKeyArray, groups: list[_Group], left: Array, shape: tuple[int, ...]) -> Array:
    """Standard normal noise `(group, batch, latent)`, a function of the modalities that remain in each sample."""
    possible = sorted({part for g in groups for part in range(g.members + 1) if part & g.members == part})
    drawn = jnp.stack([jax.random.normal(jax.random.fold_in(key, p), shape[1:]) for p in possible])
    place = jnp.zeros(possible[-1] + 1, jnp.int32).at[jnp.array(possible)].set(jnp.arange(len(possible)))
    bits = jnp.array([1 << i for i in range(left.shape[1])], jnp.int32)
    index = place[jnp.sum(jnp.where(left, bits[None, :, None], 0), axis=1)]
    return drawn[index, jnp.arange(shape[1])[None]]


def _with_condition(config: Config, z: Array, condition: Array | None) -> Array:
    width = 0 if condition is None else condition.shape[-1]
    if width != config.condition:
        raise ValueError(f"condition has width {width}, but the model needs {config.condition}")
    if condition is None:
        return z
    return jnp.concatenate([z, jnp.broadcast_to(condition, (*z.shape[:-1], width))], axis=-1)


def _error(modality: Modality, output: Array, target: Array) -> Array:
    """Reconstruction error of each item of the leading axes."""
    if modality.kind == "image":
        error = jax.nn.softplus(output) - output * target
        return jnp.sum(error, axis=(-3, -2, -1))
    return jnp.mean((output - target) ** 2, axis=-1)
