"""The loss of a state-space model: a weighted sum of these terms (NLL is a negative log likelihood).

- `state` and `doubt`: the squared error of the state code that each encoder estimates, and the NLL by which the encoder
  learns the variance of this error
- `outcome` and `pose`: the NLL of the true outcome, and the NLL of the true final pose and of the rotation from the
  first to the final pose. Each is a mean over the beliefs from all non-empty subsets of the inputs
- `visual` and `tactile`: the cross-entropy of the rendered images of the last frame, minus the entropy of the targets.
  `visual` is a sum over the pixels that show the object. `tactile` is a sum over all pixels
- `first`: the sum of the terms `visual` and `tactile`, but computed for the input images of the first frame
- `covered`: the cross-entropy of the probability that a pixel shows the object, for both frames, and with
  `Config.imprints` that of the probability that a pixel of the tactile image shows an imprint
- `shaded`: with `Config.shading`, the term `tactile` of images with the true outline of the imprint. With
  `Config.outlines` in its place `imprint`: the energy score of drawn images of the last frame
- `look`: the divergence of the appearance code from its prior, multiplied by `beta` in the loss

The decoder renders the object in its true pose in each of the two frames. It therefore never learns a mean of images
for several possible poses. Its appearance code is drawn from the belief from a random subset of the inputs with at
least one image.

Views contribute to `state` and `doubt`. In `first` and `covered`, they replace the first frames of the trajectories.
Falls contribute to `outcome` and `pose`. The belief of a fall is made from the true state. In every second fall, noise
is added to the shape and the mass. With `Config.reflected`, a random half of all trajectories, with or without images,
is reflected before the transition.

In a one-step model, `pose` is the NLL of the motion over one step from a random frame of each trajectory or fall. The
belief about the first frame is moved along the true course to this frame, as a roll-out moves it along a predicted
course. `outcome` is 0.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sts_jax._checked import in_32_bits
from sts_jax.mvae import Gaussian, kl_standard_normal
from sts_jax.statespace import imprints, poses, state, window
from sts_jax.statespace.config import IMAGES, TINT, Config
from sts_jax.statespace.networks import (
    EXACT_LOG_VAR,
    FinalPose,
    Layers,
    Model,
    compose,
    counted,
    experts,
    fuse,
    imprinted,
    moved,
    of_state,
    reduced,
)

_LEAST = 1 / 1020  # rendered images are clipped to this distance from 0 and 1
# Standard deviation of the noise in the velocities from which a one-step model learns: 0.2 mm for a position scale of
# 50 mm, and 0.3 degrees
_JITTER = np.repeat(np.array([0.004, 0.005], np.float32), 3)


def log_density(
    final: FinalPose, code: Float[Array, "n 12"], turn: Float[Array, "n 3 3"], outcome: Int[Array, "n"]
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Evaluate predicted densities at the true outcomes and final poses of n trajectories.

    Args:
        final: Densities of the final poses.
        code: Final pose codes.
        turn: Rotation matrices from the first to the final poses.
        outcome: Indices into the outcomes of the scenario.

    Returns:
        The log probability of `outcome`, and the log density of `code` and `turn` for this outcome.
    """
    heading = poses.about_vertical(final.heading)
    level = (jnp.swapaxes(heading, -1, -2) @ turn @ heading).reshape(-1, 9)
    move = jnp.concatenate([poses.turn_code_back(final.heading, code), level], axis=-1)
    return _log_mixture(final, move, outcome)


def _log_mixture(
    final: FinalPose, numbers: Float[Array, "n m"], outcome: Int[Array, "n"]
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Log probability of the outcomes, and log density of the numbers in the frame of the heading for this outcome."""

    def of_outcome(x: Array) -> Array:
        return jnp.take_along_axis(x, outcome.reshape(-1, *(1,) * (x.ndim - 1)), axis=1)[:, 0]

    weight, mean, log_var = (of_outcome(x) for x in (final.weight, final.mean, final.log_var))
    error = numbers[:, None] - mean
    each = -0.5 * jnp.sum(error**2 * jnp.exp(-log_var) + log_var + math.log(2 * math.pi), axis=-1)
    return of_outcome(final.outcome), jax.nn.logsumexp(weight + each, axis=-1)


def excess(
    image: Float[Array, "n h w c"],
    target: Float[Array, "n h w c"],
    counts: Float[Array, "n h w"] | None = None,
) -> Float[Array, "n"]:
    """Binary cross-entropy of images in [0, 1] minus the entropy of the targets (nats), summed over pixels and
    channels.

    `counts` are weights of the pixels, 1 if None.
    """
    image = jnp.clip(image, _LEAST, 1 - _LEAST)
    cross = target * jnp.log(image) + (1 - target) * jnp.log1p(-image)
    inside = jnp.clip(target, 1e-6, 1 - 1e-6)
    entropy = inside * jnp.log(inside) + (1 - inside) * jnp.log1p(-inside)
    each = jnp.sum(entropy - cross, axis=-1)
    return jnp.sum(each if counts is None else counts * each, axis=(1, 2))


class _Ends(NamedTuple):
    """Beliefs about the first frames of trajectories, with the true first states and final poses.

    In a one-step model, `pose` and `condition` have an axis of frames in front of the last axis.
    """

    belief: Gaussian  # of the state code
    state: Float[Array, "n code"]  # true state codes of the first frame
    pose: Float[Array, "n *f 12"]  # pose codes of the last frame
    outcome: Int[Array, "n"]  # index of the outcome
    condition: Float[Array, "n *f c"] | None
    counts: Bool[Array, "n"]  # False for items without an input


class _Steps(NamedTuple):
    """Steps of one-step models, each from one frame of a trajectory."""

    belief: Gaussian  # of the state code in this frame
    velocity: Float[Array, "n 6"]  # motion over the step before
    motion: Float[Array, "n 6"]  # motion over the step
    condition: Float[Array, "n c"] | None
    gone: Bool[Array, "n"]  # True for objects that have left the pad and no longer move


class _Pictures(NamedTuple):
    """Objects to render, and the target images."""

    pose: Float[Array, "n 12"]  # pose codes of the frame to render
    turn: Float[Array, "n 3 3"]  # rotation from the frame of the belief to the frame to render
    belief: Gaussian  # of the state code and the appearance code
    images: dict[str, Float[Array, "n size size 3"]]  # targets
    counts: dict[str, Bool[Array, "n"]]  # False for items without the target


@in_32_bits
def loss(
    graphdef: nnx.GraphDef[Model],
    params: nnx.State,
    key: PRNGKeyArray,
    inputs: dict[str, Array],
    targets: dict[str, Array],
    empty: dict[str, Float[Array, "size size 3"]],
    *,
    present: dict[str, Bool[Array, "n"]] | None = None,
    condition: Float[Array, "n *f c"] | None = None,
    views: dict[str, Array] | None = None,
    falls: dict[str, Array] | None = None,
    beta: float | Float[Array, ""] = 1.0,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Compute the loss of one batch, see the docstring of the module.

    Args:
        key: Random key for the choice of inputs and for the noise.
        inputs: All inputs of the model by name: images `visual` and `tactile` `(n, size, size, 3)` in [0, 1] with the
            side `input_size`, and pose codes `pose` `(n, 12)`.
        targets: Images `visual` and `tactile` of the last frame in [0, 1] with the side `image_size`, state codes
            `state` of the first frames, pose codes `pose` of the last frames, and `outcome`, `(n,)`, indices into the
            outcomes of the scenario. A one-step model also needs the pose codes `course` of all f frames, `(n, f, 12)`.
            Its images may then be those of any frame, of which `pose` is the pose.
        empty: `visual` and `tactile` image of the empty sensor in [0, 1], with the side `input_size`.
        present: Masks `(n,)` of the inputs. An input without a mask is present in all items. Each item must have at
            least one input. Values of items whose mask is False have no influence and may be NaN.
        condition: From `training.Preprocessing.encode_condition`, or None. For a one-step model, in all f frames.
        views: Images `visual` `(m, size, size, 3)` in [0, 1] with the side `input_size`, and state codes `state`. The
            model must have the input `visual`.
        falls: `state`, `pose` (for a one-step model `course`) and `outcome` as in `targets` and, if the model has a
            condition, `condition`.
        beta: Weight of the divergence of the appearance code from its prior.

    Returns:
        The loss, and its terms by name without their weights, as means over items. Items without an input do not count
        in the terms of this input. The terms `state`, `doubt` and `first` are sums over the image inputs of the model.
        To save time, the decoder renders first frames (or views) only for the share `Config.drawn_first`, and last
        frames for the share `Config.drawn`. All terms but `state` are in nats.
    """
    model = nnx.merge(graphdef, params)
    config = model.config
    number = len(targets["pose"])
    counts = {name: jnp.ones(number, bool) for name in config.inputs} | (present or {})
    choice, noise, blur, other = jax.random.split(key, 4)
    end = "course" if config.stride else "pose"
    estimates = experts(model, inputs, counts, empty)
    images = [name for name in IMAGES if name in estimates]
    seen = {} if views is None else {"visual": model.encoders["visual"](views["visual"] - empty["visual"])}
    terms = _state_terms(estimates, targets["state"], counts, seen, views)

    subsets = [s for size in range(1, len(config.inputs) + 1) for s in itertools.combinations(config.inputs, size)]
    members = [{name: counts[name] & (name in subset) for name in config.inputs} for subset in subsets]
    beliefs = [fuse(estimates, masks) for masks in members]
    truth = targets["state"], targets[end], targets["outcome"], condition
    usable = [jnp.any(jnp.stack(list(masks.values())), axis=0) for masks in members]
    ends = [_Ends(of_state(belief), *truth, masks) for belief, masks in zip(beliefs, usable, strict=True)]
    if falls is not None:
        ends.append(_known_ends(blur, falls, end))
    every = jax.tree.map(lambda *x: jnp.concatenate(x), *ends)
    if config.reflected:
        every = _reflected(jax.random.fold_in(key, 1), config, every)
    terms |= _step_terms(model, jax.random.fold_in(key, 0), every) if config.stride else _end_terms(model, every)

    belief = _drawn_belief(choice, images, members, beliefs)
    # The divergence excludes the tint, because the encoder measures it and does not learn it.
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
        of_views = fuse(jax.tree.map(lambda x: x[:first], seen), known)
        before = _present_pictures(views["state"][:first], of_views, {"visual": views["visual"][:first]}, known)
    terms |= _picture_terms(model, (noise, other), after, before, empty)
    weights = config.weights
    total = (
        terms["visual"]
        + weights.tactile * (terms["tactile"] + terms.get("shaded", 0))
        + terms.get("imprint", 0)
        + weights.covered * terms["covered"]
        + weights.first * terms["first"]
        + weights.state * terms["state"]
        + weights.pose * (terms["doubt"] + terms["pose"])
        + weights.outcome * terms["outcome"]
        + beta * weights.look * terms["look"]
    )
    return total, terms


def rotation_between(code: Float[Array, "n code"], pose: Float[Array, "n 12"]) -> Float[Array, "n 3 3"]:
    """Rotation matrices from the first frames, given by state codes, to the final poses: `R_final @ R_first.T`."""
    return poses.matrix(pose) @ jnp.swapaxes(poses.matrix(code[:, : poses.CODE]), -1, -2)


def _state_terms(
    estimates: dict[str, Gaussian],
    truth: Float[Array, "n code"],
    counts: dict[str, Bool[Array, "n"]],
    seen: dict[str, Gaussian],
    views: dict[str, Array] | None,
) -> dict[str, Float[Array, ""]]:
    """The terms `state` and `doubt`, summed over the encoders, for first frames and views."""
    errors, doubts = [], []
    for name in (name for name in IMAGES if name in estimates):
        expert, code, valid = estimates[name], truth, counts[name]
        if views is not None and name in seen:
            expert = jax.tree.map(lambda *x: jnp.concatenate(x), expert, seen[name])
            code = jnp.concatenate([code, views["state"]])
            valid = jnp.concatenate([valid, jnp.ones(len(views["state"]), bool)])
        error, doubt = _state_error(expert, code, valid)
        errors.append(error)
        doubts.append(doubt)
    return {"state": jnp.sum(jnp.stack(errors)), "doubt": jnp.sum(jnp.stack(doubts))}


def _state_error(expert: Gaussian, code: Float[Array, "n code"], counts: Bool[Array, "n"]) -> tuple[Array, Array]:
    """Squared error of an encoder's state codes, and the negative log likelihood of its variances.

    Both are means over the items that have the image. The mean of the Gaussian is learnt from the squared error alone.
    The likelihood of a Gaussian would weight each component by its precision, and the position would soon outweigh the
    rotation, which is harder to learn.
    """
    mean, log_var = (x[:, : state.CODE] for x in expert)
    error = jnp.sum((code - mean) ** 2, axis=-1)
    scatter = jax.lax.stop_gradient(code - mean) ** 2 * jnp.exp(-log_var)
    nats = 0.5 * jnp.sum(scatter + log_var + math.log(2 * math.pi), axis=-1)
    number = jnp.maximum(jnp.sum(counts), 1)
    return jnp.sum(counts * error) / number, jnp.sum(counts * nats) / number


def _drawn_belief(
    key: PRNGKeyArray,
    images: Sequence[str],
    members: Sequence[dict[str, Bool[Array, "n"]]],
    beliefs: Sequence[Gaussian],
) -> Gaussian:
    """Choose a random subset of the inputs with an image for each item, and return the belief from this subset."""
    usable = jnp.stack([jnp.any(jnp.stack([masks[name] for name in images]), axis=0) for masks in members], axis=1)
    chosen = jax.random.categorical(key, jnp.where(usable, 0.0, -jnp.inf))
    stacked = jax.tree.map(lambda *x: jnp.stack(x, axis=1), *beliefs)
    return jax.tree.map(lambda x: jnp.take_along_axis(x, chosen[:, None, None], axis=1)[:, 0], stacked)


def _known_ends(key: PRNGKeyArray, falls: dict[str, Array], end: str = "pose") -> _Ends:
    """Trajectories without images, with a belief about the true first state, and the pose codes with the name `end`.

    In every second belief, the numbers of shape and mass have noise of random size, whose variance the belief states.
    """
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
    return _Ends(belief, code, falls[end], falls["outcome"], falls.get("condition"), known)


def _reflected(key: PRNGKeyArray, config: Config, ends: _Ends) -> _Ends:
    """Reflect (x -> -x) a random half of the trajectories, with their objects."""
    chosen = jax.random.bernoulli(key, shape=(len(ends.state), 1))
    factors = jnp.where(chosen, state.reflection(ends.state), 1)
    vectors = np.concatenate([np.tile([-1, 1], config.vectors), np.ones(config.condition)])[: config.condition]

    def of(values: Array, factors: Array) -> Array:
        return values * (factors if values.ndim == 2 else factors[:, None])

    return ends._replace(
        belief=ends.belief._replace(mean=of(ends.belief.mean, factors)),
        state=of(ends.state, factors),
        pose=of(ends.pose, factors[:, : poses.CODE]),
        condition=None if ends.condition is None else of(ends.condition, jnp.where(chosen, vectors, 1)),
    )


def _end_terms(model: Model, ends: _Ends) -> dict[str, Float[Array, ""]]:
    """The terms `outcome` and `pose`."""
    weights = ends.counts / jnp.maximum(jnp.sum(ends.counts), 1)
    final = model.transition(ends.belief, ends.condition)
    outcome, pose = log_density(final, ends.pose, rotation_between(ends.state, ends.pose), ends.outcome)
    return {"outcome": -jnp.sum(weights * outcome), "pose": -jnp.sum(weights * pose)}


def _step_terms(model: Model, key: PRNGKeyArray, ends: _Ends) -> dict[str, Float[Array, ""]]:
    """The terms `outcome` and `pose` of a one-step model. Objects that have left the pad do not count."""
    steps = _drawn_steps(key, model.config, ends)
    counts = ends.counts & ~steps.gone
    density = model.transition(steps.belief, steps.condition, steps.velocity)
    numbers = poses.turn_motion_back(density.heading, steps.motion)
    outcome, pose = _log_mixture(density, numbers, ends.outcome)
    weights = counts / jnp.maximum(jnp.sum(counts), 1)
    return {"outcome": -jnp.sum(weights * outcome), "pose": -jnp.sum(weights * pose)}


def _drawn_steps(key: PRNGKeyArray, config: Config, ends: _Ends) -> _Steps:
    """Draw a step of each trajectory: from frame 0, or from a frame with another one a step before it.

    Early frames are drawn more often (frame t with a density that falls as `t**-0.5`), because most objects soon rest.
    The belief about the first frame is moved to this frame. In every second step, noise is added to the velocity, so
    that the transition learns to correct the errors of earlier steps of a roll-out, and to bring slow objects to rest.
    """
    number, frames = ends.pose.shape[:2]
    which, jitter = jax.random.split(key)
    count = max(frames - 2 * config.stride, 0) + 1
    place = jnp.minimum((count * jax.random.uniform(which, (number,)) ** 2).astype(int), count - 1)
    frame = jnp.where(place == 0, 0, place + config.stride - 1)

    def at(values: Float[Array, "n f k"], frame: Int[Array, "n"]) -> Float[Array, "n k"]:
        return jnp.take_along_axis(values, frame[:, None, None], axis=1)[:, 0]

    now, after = at(ends.pose, frame), at(ends.pose, frame + config.stride)
    velocity = poses.motion(at(ends.pose, jnp.maximum(frame - config.stride, 0)), now)
    noisy = (jnp.arange(number) // 2 % 2 * (frame > 0))[:, None]
    rotation = rotation_between(ends.state, now)
    return _Steps(
        belief=moved(ends.belief, now[:, :3], rotation),
        velocity=velocity + noisy * _JITTER * jax.random.normal(jitter, velocity.shape),
        motion=poses.motion(now, after),
        condition=None if ends.condition is None else at(ends.condition, frame),
        gone=state.gone(state.split(ends.state), config.position_scale * now[:, 2], rotation),
    )


def _present_pictures(
    code: Float[Array, "n code"],
    belief: Gaussian,
    images: dict[str, Array],
    counts: dict[str, Bool[Array, "n"]],
) -> _Pictures:
    """First frames to render, from a belief about the same frames."""
    stays = jnp.broadcast_to(jnp.eye(3), (len(code), 3, 3))
    return _Pictures(code[:, : poses.CODE], stays, belief, images, counts)


def _picture_terms(
    model: Model,
    keys: tuple[PRNGKeyArray, PRNGKeyArray],
    after: _Pictures,
    before: _Pictures,
    empty: dict[str, Float[Array, "size size 3"]],
) -> dict[str, Float[Array, ""]]:
    """The terms `visual`, `tactile`, `first` and `covered`. `after` has last frames, and `before` has first frames."""
    size = model.config.image_size
    small = {name: reduced(x, size) for name, x in empty.items()}

    def looks(key: PRNGKeyArray, belief: Gaussian) -> Float[Array, "n look"]:
        mean, log_var = (x[:, state.CODE :] for x in belief)
        return mean + jnp.exp(0.5 * log_var) * jax.random.normal(key, mean.shape)

    layers = model.decoder(
        jnp.concatenate([after.pose, before.pose]),
        jnp.concatenate([after.turn, before.turn]),
        # The images do not train the state code, because it has its own target.
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
    if layers.pressed is not None:
        imprint = window.shows(after.images["tactile"] - small["tactile"])
        terms["covered"] += jnp.mean(_outline_nats(layers.pressed[:number], imprint))
        # These terms train the networks that draw imprints, and nothing else.
        fixed = jax.tree.map(lambda x: jax.lax.stop_gradient(x[:number]), layers)
        if model.decoder.outlines is not None:
            terms["imprint"] = _imprint_term(model, keys[0], fixed, after.images["tactile"], small["tactile"])
        elif model.decoder.shading is not None:
            weight, touch_there = model.decoder.imprint(fixed, imprint[..., None])
            shaded = imprinted(touch_there, weight, small["tactile"])
            terms["shaded"] = jnp.mean(excess(shaded, after.images["tactile"]))
    for name, image in before.images.items():
        counts = before.counts[name]
        target = reduced(counted(counts, image), size)
        share = counts / jnp.maximum(jnp.sum(counts), 1)
        seen = window.shows(target - small[name])
        if name == "visual":
            terms["covered"] += jnp.sum(share * _outline_nats(layers.covered[number:], seen))
            terms["first"] += jnp.sum(share * excess(layers.colour[number:], target, seen))
        else:
            terms["first"] += jnp.sum(share * excess(touch[number:], target))
            if layers.pressed is not None:
                terms["covered"] += jnp.sum(share * _outline_nats(layers.pressed[number:], seen))
    return terms


def _imprint_term(
    model: Model,
    key: PRNGKeyArray,
    layers: Layers,
    target: Float[Array, "n size size 3"],
    empty: Float[Array, "size size 3"],
) -> Float[Array, ""]:
    """The term `imprint`, from two drawn images of each object."""
    noise, place = jax.random.split(jax.random.fold_in(key, 2))
    twice = jax.tree.map(lambda x: jnp.concatenate([x, x]), layers)
    drawn = jax.random.normal(noise, (2 * len(target), imprints.NOISE))
    pressed, touch = model.decoder.imprint(twice, twice.pressed, drawn)
    one, other = jnp.split(imprinted(touch, pressed, empty), 2)
    return jnp.mean(imprints.energy_score(one, other, target, jax.random.randint(place, (2,), 0, 8)))


def _outline_nats(logit: Float[Array, "n h w 1"], seen: Float[Array, "n h w"]) -> Float[Array, "n"]:
    """Cross-entropy of the probability that a pixel shows the object (nats), summed over pixels."""
    return jnp.sum(jax.nn.softplus(logit[..., 0]) - seen * logit[..., 0], axis=(1, 2))
