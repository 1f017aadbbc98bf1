"""The loss of a state-space model.

For a batch of first moments with their last moments, it is the sum of

- the squared error of each image's expert at the true first pose, and the nats of its variance;
- the nats of the transition at the true outcome and the true final pose, for the belief of every non-empty subset of
  the inputs;
- the excess cross-entropy of both streams of the last moment, drawn in the true final pose with a sample of the look,
  and that of the first moment, drawn in the true first pose;
- beta times the divergence of the look from its prior, in nats.

A moment is drawn in its true pose, so that the decoder never averages over places. The subset whose belief gives the
look is drawn for each sample, among those with an image.
"""

import itertools
import math

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sts_jax.mvae import Gaussian, kl_standard_normal, product_of_experts
from sts_jax.statespace import poses
from sts_jax.statespace.networks import IMAGES, FinalPose, Model

POSE_LOG_VAR = -9.2  # of the expert of a pose that is given: 0.5 mm
UNKNOWN_LOG_VAR = 30.0  # of the same expert about the look: no precision at all
_LEAST = 1 / 1020  # predicted images are kept this far from 0 and 1


def experts(
    model: Model,
    inputs: dict[str, Array],
    counts: dict[str, Bool[Array, "n"]],
    empty: dict[str, Float[Array, "size size 3"]],
) -> dict[str, Gaussian]:
    """The Gaussian of each input over pose code and look.

    Args:
        model: the networks.
        inputs: some of `visual` and `tactile` `(n, size, size, 3)` in [0, 1], and `pose` `(n, 12)`, a code.
        counts: which items of each input count. The values of the others, NaN among them, have no influence.
        empty: both images of the untouched sensor, of the same size.
    """
    # Replaced before the networks see them: neither the product of experts nor a gradient is safe from 0 * NaN.
    change = {name: _counted(counts[name], inputs[name] - empty[name]) for name in IMAGES if name in inputs}
    found = {name: model.encoders[name](x) for name, x in change.items()}
    if "pose" in inputs:
        code = _counted(counts["pose"], inputs["pose"])
        nothing = jnp.zeros((len(code), model.config.look))
        log_var = [jnp.full_like(code, POSE_LOG_VAR), nothing + UNKNOWN_LOG_VAR]
        found["pose"] = Gaussian(jnp.concatenate([code, nothing], axis=-1), jnp.concatenate(log_var, axis=-1))
    return found


def fuse(found: dict[str, Gaussian], counts: dict[str, Bool[Array, "n"]]) -> Gaussian:
    """The product of the standard normal prior and of the experts that count, sample by sample."""
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *found.values())
    return product_of_experts(stacked, jnp.stack([counts[name] for name in found]))


def _counted(counts: Bool[Array, "n"], values: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Zero in place of the items that do not count."""
    return jnp.where(counts.reshape(-1, *(1,) * (values.ndim - 1)), values, 0)


def log_density(
    final: FinalPose, code: Float[Array, "n 12"], outcome: Int[Array, "n"]
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """The log probability of an outcome, and the log density of the pose code given the outcome."""

    def of_outcome(x: Array) -> Array:
        return jnp.take_along_axis(x, outcome.reshape(-1, *(1,) * (x.ndim - 1)), axis=1)[:, 0]

    weight, mean, log_var = (of_outcome(x) for x in (final.weight, final.mean, final.log_var))
    error = poses.turn_code_back(final.heading, code)[:, None] - mean
    each = -0.5 * jnp.sum(error**2 * jnp.exp(-log_var) + log_var + math.log(2 * math.pi), axis=-1)
    return of_outcome(final.outcome), jax.nn.logsumexp(weight + each, axis=-1)


def excess(image: Float[Array, "n h w c"], target: Float[Array, "n h w c"]) -> Float[Array, "n"]:
    """Binary cross-entropy less the target's own entropy, nats, summed over pixels and channels."""
    image = jnp.clip(image, _LEAST, 1 - _LEAST)
    cross = target * jnp.log(image) + (1 - target) * jnp.log1p(-image)
    inside = jnp.clip(target, 1e-6, 1 - 1e-6)
    own = inside * jnp.log(inside) + (1 - inside) * jnp.log1p(-inside)
    return jnp.sum(own - cross, axis=(1, 2, 3))


def reduced(images: Float[Array, "*n h w c"], size: int) -> Float[Array, "*n size size c"]:
    """Images at a resolution that theirs is a multiple of: means over blocks of pixels."""
    *lead, height, width, channels = images.shape
    blocks = images.reshape(*lead, size, height // size, size, width // size, channels)
    return jnp.mean(blocks, axis=(-4, -2))


def loss(
    graphdef: nnx.GraphDef[Model],
    params: nnx.State,
    key: PRNGKeyArray,
    inputs: dict[str, Array],
    targets: dict[str, Array],
    empty: dict[str, Float[Array, "size size 3"]],
    *,
    present: dict[str, Bool[Array, "n"]] | None = None,
    condition: Float[Array, "n c"] | None = None,
    beta: float | Float[Array, ""] = 1.0,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """The loss of one batch (module docstring).

    Args:
        graphdef: definition of the model.
        params: its parameters.
        key: consumed.
        inputs: as of `experts`: all that the model takes.
        targets: `visual` and `tactile` `(n, size, size, 3)` in [0, 1], of the size that is predicted; the codes `state`
            and `pose` `(n, 12)` of the first and the last pose; `outcome` `(n,)`, an index into the scenario's.
        empty: as of `experts`.
        present: which inputs count, by name; all where not given. Each sample needs one. The values of those that do
            not count, NaN among them, have no influence.
        condition: as of `Transition`.
        beta: weight of the look's divergence.

    Returns:
        The loss, and its parts: means over the items that count, before any weight. `state` is in units of the code
        squared, all others are in nats. `state`, `doubt` and `first` are summed over the input images.
    """
    model = nnx.merge(graphdef, params)
    config = model.config
    number = len(targets["pose"])
    counts = {name: jnp.ones(number, bool) for name in config.inputs} | (present or {})
    choice, noise = jax.random.split(key)
    found = experts(model, inputs, counts, empty)
    images = [name for name in IMAGES if name in found]
    state, doubt = zip(*(_state_error(found[name], targets["state"], counts[name]) for name in images), strict=True)
    terms = {"state": jnp.sum(jnp.stack(state)), "doubt": jnp.sum(jnp.stack(doubt))}

    subsets = [s for size in range(1, len(config.inputs) + 1) for s in itertools.combinations(config.inputs, size)]
    members = [{name: counts[name] & (name in subset) for name in config.inputs} for subset in subsets]
    beliefs = [fuse(found, own) for own in members]
    some = jnp.concatenate([jnp.any(jnp.stack(list(own.values())), axis=0) for own in members])
    weights = some / jnp.maximum(jnp.sum(some), 1)
    belief = jax.tree.map(lambda *x: jnp.concatenate(x), *beliefs)
    many = len(subsets)
    final = model.transition(belief, None if condition is None else jnp.tile(condition, (many, 1)))
    outcome, pose = log_density(final, jnp.tile(targets["pose"], (many, 1)), jnp.tile(targets["outcome"], many))
    terms |= {"outcome": -jnp.sum(weights * outcome), "pose": -jnp.sum(weights * pose)}

    seen = jnp.stack([jnp.any(jnp.stack([own[name] for name in images]), axis=0) for own in members], axis=1)
    chosen = jax.random.categorical(choice, jnp.where(seen, 0.0, -jnp.inf))
    looks = jax.tree.map(lambda *x: jnp.stack(x, axis=1)[..., poses.CODE :], *beliefs)
    look = jax.tree.map(lambda x: jnp.take_along_axis(x, chosen[:, None, None], axis=1)[:, 0], looks)
    terms["look"] = jnp.mean(kl_standard_normal(look))
    drawn = look.mean + jnp.exp(0.5 * look.log_var) * jax.random.normal(noise, look.mean.shape)

    last, first = (math.ceil(share * number) for share in (config.drawn, config.drawn_first))
    code = jnp.concatenate([targets["pose"][:last], targets["state"][:first]])
    shown = {name: reduced(x, config.image_size) for name, x in empty.items()}
    pictures = model.decoder(code, jnp.concatenate([drawn[:last], drawn[:first]]), shown)
    for name in IMAGES:
        terms[name] = jnp.mean(excess(pictures[name][:last], targets[name][:last]))
    terms["first"] = jnp.zeros(())
    for name in images:
        known = counts[name][:first]
        before = reduced(_counted(known, inputs[name][:first]), config.image_size)
        wrong = jnp.where(known, excess(pictures[name][last:], before), 0)
        terms["first"] += jnp.sum(wrong) / jnp.maximum(jnp.sum(known), 1)
    total = (
        terms["visual"]
        + config.tactile_weight * terms["tactile"]
        + config.first_weight * terms["first"]
        + config.state_weight * terms["state"]
        + config.pose_weight * (terms["doubt"] + terms["pose"])
        + config.outcome_weight * terms["outcome"]
        + beta * config.look_weight * terms["look"]
    )
    return total, terms


def _state_error(expert: Gaussian, state: Float[Array, "n 12"], counts: Bool[Array, "n"]) -> tuple[Array, Array]:
    """Squared error of an expert's first pose, and the nats of its variance, means over the samples that it counts for.

    The mean is learnt from the squared error alone. The nats of a Gaussian would weigh each component by its precision,
    and the rotation, the hardest part, would wait until the position is learnt.
    """
    mean, log_var = (x[:, : poses.CODE] for x in expert)
    error = jnp.sum((state - mean) ** 2, axis=-1)
    scatter = jax.lax.stop_gradient(state - mean) ** 2 * jnp.exp(-log_var)
    nats = 0.5 * jnp.sum(scatter + log_var + math.log(2 * math.pi), axis=-1)
    number = jnp.maximum(jnp.sum(counts), 1)
    return jnp.sum(counts * error) / number, jnp.sum(counts * nats) / number
