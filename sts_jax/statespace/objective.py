"""The loss of a state-space model.

For a batch of first moments with their last moments, it is the sum of

- the squared error of the state of each image's expert, and the nats of its variance
- the nats of the transition at the true outcome, the true final pose and the rotation to it, for the belief of every
  non-empty subset of the inputs
- the excess cross-entropy of the last moment, drawn in the true final pose with a sample of the look, and that of the
  first moment, drawn in the true first pose. Both include the colours of the pixels that show the object, and the
  tactile image
- the cross-entropy of the probability that a pixel shows the object, in these pictures
- beta times the divergence of the look from its prior, in nats

A moment is drawn in its true pose, so that the decoder never averages over places. For each sample, the look comes from
the belief of a random subset with an image.

First moments without an end (views) contribute to the first part, and replace the first moments that are drawn.
Trajectories without images (falls) contribute to the second part, with beliefs around the true state.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sts_jax.mvae import Gaussian, kl_standard_normal, product_of_experts
from sts_jax.statespace import poses, state, window
from sts_jax.statespace.networks import IMAGES, TINT, UNKNOWN_LOG_VAR, Config, FinalPose, Model, compose

EXACT_LOG_VAR = -9.2  # of a pose that is an input, 0.5 mm
_LEAST = 1 / 1020  # least distance of predicted images from 0 and 1


def experts(
    model: Model,
    inputs: dict[str, Array],
    counts: dict[str, Bool[Array, "n"]],
    empty: dict[str, Float[Array, "size size 3"]],
) -> dict[str, Gaussian]:
    """The Gaussian of each input over state code and look.

    Args:
        model: The networks.
        inputs: Some of `visual` and `tactile` `(n, size, size, 3)` in [0, 1], the pose code `pose` `(n, 12)` and, if it
            is known, the true `state` `(n, code)`.
        counts: The items of each input that count. All others have no influence and may be NaN.
        empty: Both images of the untouched sensor, of the same size.
    """
    # Items that do not count are zero before the networks, because 0 * NaN would spoil the product and its gradient.
    change = {name: _counted(counts[name], inputs[name] - empty[name]) for name in IMAGES if name in inputs}
    found = {name: model.encoders[name](x) for name, x in change.items()}
    for name in ("pose", "state"):
        if name in inputs:
            code = _counted(counts[name], inputs[name])
            nothing = jnp.zeros((len(code), state.CODE - code.shape[1] + model.config.look))
            log_var = [jnp.full_like(code, EXACT_LOG_VAR), nothing + UNKNOWN_LOG_VAR]
            found[name] = Gaussian(jnp.concatenate([code, nothing], axis=-1), jnp.concatenate(log_var, axis=-1))
    return found


def fuse(found: dict[str, Gaussian], counts: dict[str, Bool[Array, "n"]]) -> Gaussian:
    """The product of the standard normal prior and of the experts that count, for each sample."""
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *found.values())
    return product_of_experts(stacked, jnp.stack([counts[name] for name in found]))


def of_state(belief: Gaussian) -> Gaussian:
    """The marginal over the state code of a belief over state code and look."""
    return Gaussian(belief.mean[:, : state.CODE], belief.log_var[:, : state.CODE])


def _counted(counts: Bool[Array, "n"], values: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """The values, with zeros for items that do not count."""
    return jnp.where(counts.reshape(-1, *(1,) * (values.ndim - 1)), values, 0)


def log_density(
    final: FinalPose, code: Float[Array, "n 12"], turn: Float[Array, "n 3 3"], outcome: Int[Array, "n"]
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """The log probability of an outcome, and the log density of the pose code given the outcome."""

    def of_outcome(x: Array) -> Array:
        return jnp.take_along_axis(x, outcome.reshape(-1, *(1,) * (x.ndim - 1)), axis=1)[:, 0]

    weight, mean, log_var = (of_outcome(x) for x in (final.weight, final.mean, final.log_var))
    heading = poses.about_vertical(final.heading)
    level = (jnp.swapaxes(heading, -1, -2) @ turn @ heading).reshape(-1, 9)
    move = jnp.concatenate([poses.turn_code_back(final.heading, code), level], axis=-1)
    error = move[:, None] - mean
    each = -0.5 * jnp.sum(error**2 * jnp.exp(-log_var) + log_var + math.log(2 * math.pi), axis=-1)
    return of_outcome(final.outcome), jax.nn.logsumexp(weight + each, axis=-1)


def excess(
    image: Float[Array, "n h w c"],
    target: Float[Array, "n h w c"],
    counts: Float[Array, "n h w"] | None = None,
) -> Float[Array, "n"]:
    """Binary cross-entropy minus the entropy of the target, in nats, summed over channels and the pixels that count."""
    image = jnp.clip(image, _LEAST, 1 - _LEAST)
    cross = target * jnp.log(image) + (1 - target) * jnp.log1p(-image)
    inside = jnp.clip(target, 1e-6, 1 - 1e-6)
    own = inside * jnp.log(inside) + (1 - inside) * jnp.log1p(-inside)
    each = jnp.sum(own - cross, axis=-1)
    return jnp.sum(each if counts is None else counts * each, axis=(1, 2))


def reduced(images: Float[Array, "*n h w c"], size: int) -> Float[Array, "*n size size c"]:
    """Means over blocks of pixels. The sides of the images must be multiples of `size`."""
    *lead, height, width, channels = images.shape
    blocks = images.reshape(*lead, size, height // size, size, width // size, channels)
    return jnp.mean(blocks, axis=(-4, -2))


class _Ends(NamedTuple):
    """Beliefs about first moments, with the true ends."""

    belief: Gaussian  # over the state code
    state: Float[Array, "n code"]
    pose: Float[Array, "n 12"]  # final pose codes
    outcome: Int[Array, "n"]
    condition: Float[Array, "n c"] | None
    counts: Bool[Array, "n"]


class _Pictures(NamedTuple):
    """Objects to be drawn, and the target images."""

    pose: Float[Array, "n 12"]
    turn: Float[Array, "n 3 3"]  # since the moment of the belief
    belief: Gaussian
    images: dict[str, Float[Array, "n size size 3"]]
    counts: dict[str, Bool[Array, "n"]]


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
    views: dict[str, Array] | None = None,
    falls: dict[str, Array] | None = None,
    beta: float | Float[Array, ""] = 1.0,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """The loss of one batch, see the docstring of the module.

    Args:
        graphdef: Definition of the model.
        params: Its parameters.
        key: Consumed.
        inputs: All inputs of the model, as in `experts`.
        targets: `visual` and `tactile` `(n, size, size, 3)` in [0, 1] at the predicted size, the state code `state`
            `(n, code)` of the first moment, the pose code `pose` `(n, 12)` of the last moment, and `outcome` `(n,)`, an
            index into the outcomes of the scenario.
        empty: As in `experts`.
        present: The samples `(n,)` of each input that count (default: all). Each sample needs one input. Inputs that do
            not count have no influence and may be NaN.
        condition: As in `Transition`.
        views: Further first moments without an end: `visual` `(m, size, size, 3)` and `state` `(m, code)`.
        falls: Further trajectories without images: `state`, `pose`, `outcome` and, if the model has a condition,
            `condition`, as above.
        beta: Weight of the divergence of the look.

    Returns:
        The loss, and its parts: means over the items that count, before weighting. `state` is in squared units of the
        code, and all others are in nats. `state`, `doubt` and `first` are sums over the input images, and `covered` is
        a sum over the first and the last moment.
    """
    model = nnx.merge(graphdef, params)
    config = model.config
    number = len(targets["pose"])
    counts = {name: jnp.ones(number, bool) for name in config.inputs} | (present or {})
    choice, noise, blur, other = jax.random.split(key, 4)
    found = experts(model, inputs, counts, empty)
    images = [name for name in IMAGES if name in found]
    seen = {} if views is None else {"visual": model.encoders["visual"](views["visual"] - empty["visual"])}
    terms = _state_terms(found, targets["state"], counts, seen, views)

    subsets = [s for size in range(1, len(config.inputs) + 1) for s in itertools.combinations(config.inputs, size)]
    members = [{name: counts[name] & (name in subset) for name in config.inputs} for subset in subsets]
    beliefs = [fuse(found, own) for own in members]
    ends = [_ends(belief, own, targets, condition) for belief, own in zip(beliefs, members, strict=True)]
    if falls is not None:
        ends.append(_known_ends(blur, falls))
    terms |= _end_terms(model, jax.tree.map(lambda *x: jnp.concatenate(x), *ends))

    belief = _drawn_belief(choice, images, members, beliefs)
    # The divergence excludes the tint, which is computed and not learnt.
    terms["look"] = jnp.mean(kl_standard_normal(jax.tree.map(lambda x: x[:, state.CODE + TINT :], belief)))
    last = math.ceil(config.drawn * number)
    turn = rotation_between(targets["state"], targets["pose"])
    after = _Pictures(
        pose=targets["pose"][:last],
        turn=turn[:last],
        belief=jax.tree.map(lambda x: x[:last], belief),
        images={name: targets[name][:last] for name in IMAGES},
        counts={name: jnp.ones(last, bool) for name in IMAGES},
    )
    first = math.ceil(config.drawn_first * number)
    if views is None:
        before = _present_pictures(
            targets["state"][:first],
            jax.tree.map(lambda x: x[:first], belief),
            {name: inputs[name][:first] for name in images},
            {name: counts[name][:first] for name in images},
        )
    else:
        known = {"visual": jnp.ones(len(views["state"][:first]), bool)}
        own = fuse(jax.tree.map(lambda x: x[:first], seen), known)
        before = _present_pictures(views["state"][:first], own, {"visual": views["visual"][:first]}, known)
    terms |= _picture_terms(model, (noise, other), after, before, empty)
    return _weighted(config, terms, beta), terms


def _weighted(config: Config, terms: dict[str, Float[Array, ""]], beta: float | Float[Array, ""]) -> Float[Array, ""]:
    """The loss of some terms."""
    return (
        terms["visual"]
        + config.tactile_weight * terms["tactile"]
        + config.covered_weight * terms["covered"]
        + config.first_weight * terms["first"]
        + config.state_weight * terms["state"]
        + config.pose_weight * (terms["doubt"] + terms["pose"])
        + config.outcome_weight * terms["outcome"]
        + beta * config.look_weight * terms["look"]
    )


def rotation_between(code: Float[Array, "n code"], pose: Float[Array, "n 12"]) -> Float[Array, "n 3 3"]:
    """The rotation from a state to a final pose."""
    return poses.matrix(pose) @ jnp.swapaxes(poses.matrix(code[:, : poses.CODE]), -1, -2)


def _state_terms(
    found: dict[str, Gaussian],
    truth: Float[Array, "n code"],
    counts: dict[str, Bool[Array, "n"]],
    seen: dict[str, Gaussian],
    views: dict[str, Array] | None,
) -> dict[str, Float[Array, ""]]:
    """`state` and `doubt`, summed over the experts of all images, for first moments and views."""
    errors, doubts = [], []
    for name in (name for name in IMAGES if name in found):
        expert, code, valid = found[name], truth, counts[name]
        if views is not None and name in seen:
            expert = jax.tree.map(lambda *x: jnp.concatenate(x), expert, seen[name])
            code = jnp.concatenate([code, views["state"]])
            valid = jnp.concatenate([valid, jnp.ones(len(views["state"]), bool)])
        error, doubt = _state_error(expert, code, valid)
        errors.append(error)
        doubts.append(doubt)
    return {"state": jnp.sum(jnp.stack(errors)), "doubt": jnp.sum(jnp.stack(doubts))}


def _state_error(expert: Gaussian, code: Float[Array, "n code"], counts: Bool[Array, "n"]) -> tuple[Array, Array]:
    """Squared error of an expert's state, and the nats of its variance, as means over the samples that count.

    The mean is learnt from the squared error alone. The nats of a Gaussian would weigh each component by its precision.
    The position would soon outweigh the rotation, which is harder to learn.
    """
    mean, log_var = (x[:, : state.CODE] for x in expert)
    error = jnp.sum((code - mean) ** 2, axis=-1)
    scatter = jax.lax.stop_gradient(code - mean) ** 2 * jnp.exp(-log_var)
    nats = 0.5 * jnp.sum(scatter + log_var + math.log(2 * math.pi), axis=-1)
    number = jnp.maximum(jnp.sum(counts), 1)
    return jnp.sum(counts * error) / number, jnp.sum(counts * nats) / number


def _ends(
    belief: Gaussian,
    counts: dict[str, Bool[Array, "n"]],
    targets: dict[str, Array],
    condition: Float[Array, "n c"] | None,
) -> _Ends:
    """The trajectories of a batch, predicted from the inputs that count."""
    counted = jnp.any(jnp.stack(list(counts.values())), axis=0)
    return _Ends(of_state(belief), targets["state"], targets["pose"], targets["outcome"], condition, counted)


def _drawn_belief(
    key: PRNGKeyArray,
    images: Sequence[str],
    members: Sequence[dict[str, Bool[Array, "n"]]],
    beliefs: Sequence[Gaussian],
) -> Gaussian:
    """Each sample's belief from a random subset of the inputs with an image, which the look of a picture comes from."""
    usable = jnp.stack([jnp.any(jnp.stack([own[name] for name in images]), axis=0) for own in members], axis=1)
    chosen = jax.random.categorical(key, jnp.where(usable, 0.0, -jnp.inf))
    stacked = jax.tree.map(lambda *x: jnp.stack(x, axis=1), *beliefs)
    return jax.tree.map(lambda x: jnp.take_along_axis(x, chosen[:, None, None], axis=1)[:, 0], stacked)


def _known_ends(key: PRNGKeyArray, falls: dict[str, Array]) -> _Ends:
    """Trajectories with a known first state. In every second one, shape and mass have noise of known variance."""
    code = falls["state"]
    number = len(code)
    size, noise = jax.random.split(key)
    log_std = jax.random.uniform(size, (number, 3), minval=math.log(0.02), maxval=math.log(1.0))
    shape, centre, mass = jnp.split(log_std, 3, axis=-1)
    exact = jnp.full((number, poses.CODE), EXACT_LOG_VAR / 2)
    doubt = state.join(
        state.State(
            exact,
            jnp.tile(shape, state.SUPPORT),
            jnp.tile(centre, 3),
            mass,
            jnp.tile(shape, state.SUPPORT),
            jnp.tile(centre, 3),
        )
    )
    exactly = jnp.arange(number)[:, None] % 2 == 0
    doubt = jnp.where(exactly, EXACT_LOG_VAR / 2, doubt)
    noisy = code + jnp.where(exactly, 0, jnp.exp(doubt)) * jax.random.normal(noise, code.shape)
    mean = jnp.concatenate([code[:, : poses.CODE], noisy[:, poses.CODE :]], axis=-1)
    known = jnp.ones(number, bool)
    belief = fuse({"state": Gaussian(mean, 2 * doubt)}, {"state": known})
    return _Ends(belief, code, falls["pose"], falls["outcome"], falls.get("condition"), known)


def _end_terms(model: Model, ends: _Ends) -> dict[str, Float[Array, ""]]:
    """The nats of the outcomes and of the final poses."""
    weights = ends.counts / jnp.maximum(jnp.sum(ends.counts), 1)
    final = model.transition(ends.belief, ends.condition)
    outcome, pose = log_density(final, ends.pose, rotation_between(ends.state, ends.pose), ends.outcome)
    return {"outcome": -jnp.sum(weights * outcome), "pose": -jnp.sum(weights * pose)}


def _present_pictures(
    code: Float[Array, "n code"],
    belief: Gaussian,
    images: dict[str, Array],
    counts: dict[str, Bool[Array, "n"]],
) -> _Pictures:
    """Pictures of the present moment, to which the belief belongs."""
    stays = jnp.broadcast_to(jnp.eye(3), (len(code), 3, 3))
    return _Pictures(code[:, : poses.CODE], stays, belief, images, counts)


def _picture_terms(
    model: Model,
    keys: tuple[PRNGKeyArray, PRNGKeyArray],
    after: _Pictures,
    before: _Pictures,
    empty: dict[str, Float[Array, "size size 3"]],
) -> dict[str, Float[Array, ""]]:
    """`visual` and `tactile` of the last moment, `first`, the sum of both for the first moment, and `covered`."""
    size = model.config.image_size
    small = {name: reduced(x, size) for name, x in empty.items()}

    def looks(key: PRNGKeyArray, belief: Gaussian) -> Float[Array, "n look"]:
        mean, log_var = (x[:, state.CODE :] for x in belief)
        return mean + jnp.exp(0.5 * log_var) * jax.random.normal(key, mean.shape)

    layers = model.decoder(
        jnp.concatenate([after.pose, before.pose]),
        jnp.concatenate([after.turn, before.turn]),
        # Pictures do not train the shape, because the state has its own target.
        jax.lax.stop_gradient(jnp.concatenate([x.belief.mean[:, : state.CODE] for x in (after, before)])),
        jnp.concatenate([looks(key, x.belief) for key, x in zip(keys, (after, before), strict=True)]),
    )
    number = len(after.pose)
    seen = window.shows(after.images["visual"] - small["visual"])
    touch = compose(layers, small)["tactile"]
    terms = {
        "visual": jnp.mean(excess(layers.colour[:number], after.images["visual"], seen)),
        "tactile": jnp.mean(excess(touch[:number], after.images["tactile"])),
        "covered": jnp.mean(_outline_nats(layers.covered[:number], seen)),
        "first": jnp.zeros(()),
    }
    for name, image in before.images.items():
        counts = before.counts[name]
        target = reduced(_counted(counts, image), size)
        share = counts / jnp.maximum(jnp.sum(counts), 1)
        if name == "visual":
            seen = window.shows(target - small[name])
            terms["covered"] += jnp.sum(share * _outline_nats(layers.covered[number:], seen))
            terms["first"] += jnp.sum(share * excess(layers.colour[number:], target, seen))
        else:
            terms["first"] += jnp.sum(share * excess(touch[number:], target))
    return terms


def _outline_nats(logit: Float[Array, "n h w 1"], seen: Float[Array, "n h w"]) -> Float[Array, "n"]:
    """Cross-entropy of the probability that a pixel shows the object, summed over pixels.

    Args:
        logit: Logit of the probability.
        seen: 1 for pixels that show the object, else 0.
    """
    return jnp.sum(jax.nn.softplus(logit[..., 0]) - seen * logit[..., 0], axis=(1, 2))
