"""`Prediction`, and the pure functions that compute predictions from the parameters of a model."""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float, Int, Key

from sts_jax import mvae, statespace, training

_POSES = 256  # number of sampled final poses, whose centre is the predicted pose of a state-space model
_DRAWN = 16  # number of sampled images if `num_samples` is 0. The predicted images are their means
_TURN = 0.02  # m, distance that counts as much as a rotation by one radian, in the choice of the most central sample
_ITERATIONS = 30  # iterations of Weiszfeld's method
_CLOSE = 1e-6  # m, distance below which the weight of a sample in Weiszfeld's method no longer grows


class Prediction(NamedTuple):
    """Prediction of the last frame. Modalities that the model does not predict are None.

    A roll-out has the axis of time behind the leading axes *n, one index for each step.
    """

    visual: Float[Array, "*n h w 3"] | None  # visual image, sRGB in [0, 1]
    tactile: Float[Array, "*n h w 3"] | None  # tactile image in [0, 1]
    pose: Float[Array, "*n 7"] | None  # pose of the object
    mean: Float[Array, "*n latent"]  # mean of the posterior of the latent, given all inputs
    log_var: Float[Array, "*n latent"]  # log variance of this posterior
    # None if `num_samples` is 0. Images, poses and measurements of samples have another leading axis of `num_samples`.
    samples: "Prediction | None" = None
    # Probability of each outcome, in the order of `Predictor.outcomes`. None for an `mvae` model.
    outcome_probability: Float[Array, "*n outcomes"] | None = None
    # Further modalities (`dataset.Measurement`) by name: numbers in SI units, images in [0, 1], or class probabilities.
    measurements: dict[str, Float[Array, "..."]] | None = None

    def __repr__(self) -> str:
        leaves = {name: leaf for name, leaf in self._asdict().items() if name != "measurements"}
        leaves |= self.measurements or {}
        shapes = (
            f"{name}={leaf.dtype}{list(leaf.shape)}" if isinstance(leaf, jax.Array | np.ndarray) else f"{name}={leaf!r}"
            for name, leaf in leaves.items()
        )
        return f"Prediction({', '.join(shapes)})"


@functools.partial(jax.jit, static_argnames=("graphdef", "preprocessing", "num_samples", "lead"))
def predict(
    graphdef: nnx.GraphDef,
    state: nnx.State,
    preprocessing: training.Preprocessing,
    blank: Float[Array, "h w 3"],
    inputs: dict[str, Float[Array, "..."]],
    present: dict[str, Bool[Array, "*n"]],
    condition: Float[Array, "..."] | None = None,
    key: Key[Array, "..."] | None = None,
    num_samples: int = 0,
    lead: tuple[int, ...] = (),
) -> Prediction:
    """Predict with a multimodal variational autoencoder: decode the mean of the posterior, given the inputs.

    Args:
        preprocessing: Preprocessing with which the model was trained.
        blank: Tactile image of the empty sensor in [0, 1].
        inputs: Inputs by name: images in [0, 1], poses (*n, 7), vectors in SI units. Any may be missing.
        present: Masks (*n,) by name. An input without a mask is used for all items.
        condition: Conditions in SI units, (*n, c), or None.
        key: Random key for the samples, one for all items or one for each. If it is None, no samples are drawn.
        num_samples: Number of samples to draw from the posterior and to decode.
        lead: Leading axes *n. Without inputs, the prediction is made from the prior.
    """
    flat, counts = _flat(preprocessing, inputs, present, lead, blank)
    if condition is not None:
        condition = preprocessing.encode_condition(condition).reshape(-1, condition.shape[-1])
    if flat:
        posterior = mvae.infer(graphdef, state, flat, present=counts, condition=condition)
    else:
        posterior = mvae.prior(graphdef, state, math.prod(lead), condition=condition)
    config = nnx.merge(graphdef, state).config

    def decode(z: Float[Array, "... latent"], shape: tuple[int, ...]) -> Prediction:
        wide = None if condition is None else jnp.broadcast_to(condition, (*z.shape[:-1], condition.shape[-1]))
        out = mvae.decode(graphdef, state, z, condition=wide)
        out = {name: value.reshape(*shape, *value.shape[z.ndim - 1 :]) for name, value in out.items()}
        return _named(_values(config, preprocessing, out), *(x.reshape(*lead, -1) for x in posterior))

    result = decode(posterior.mean, lead)
    if num_samples and key is not None:
        number, latent = posterior.mean.shape
        keys = jnp.broadcast_to(key.reshape(-1), number)
        noise = jax.vmap(lambda key: jax.random.normal(key, (num_samples, latent)), out_axes=1)(keys)
        z = posterior.mean[None] + jnp.exp(0.5 * posterior.log_var)[None] * noise
        result = result._replace(samples=decode(z, (num_samples, *lead)))
    return result


def _values(config: mvae.Config, preprocessing: training.Preprocessing, out: dict[str, Array]) -> dict[str, Array]:
    """Decode the output of the networks: `Preprocessing.decode`, and the probabilities of categories."""
    categories = {m.name for m in config.modalities if m.kind == "category"}
    return {
        name: jax.nn.softmax(value) if name in categories else preprocessing.decode(name, value)
        for name, value in out.items()
    }


def _named(values: dict[str, Array], mean: Array, log_var: Array) -> Prediction:
    """A prediction from decoded values by the name of the modality."""
    further = dict(values)
    return Prediction(
        visual=further.pop("visual", None),
        tactile=further.pop("tactile", None),
        pose=further.pop("pose", None),
        mean=mean,
        log_var=log_var,
        measurements=further or None,
    )


class _Frame(NamedTuple):
    """State of a roll-out: the frame of each course of each item, (rows, ...)."""

    values: dict[str, Array]  # by modality: images in [0, 1], poses (rows, 7), further modalities
    present: dict[str, Bool[Array, "rows"]]  # masks of the values that are inputs of the next step
    posterior: mvae.Gaussian  # of the latent from which the frame was predicted


@functools.partial(jax.jit, static_argnames=("graphdef", "preprocessing", "num_samples", "lead", "steps", "last"))
def rollout(
    graphdef: nnx.GraphDef,
    state: nnx.State,
    preprocessing: training.Preprocessing,
    blank: Float[Array, "h w 3"],
    inputs: dict[str, Float[Array, "..."]],
    present: dict[str, Bool[Array, "*n"]],
    condition: Float[Array, "..."] | None = None,
    key: Key[Array, "..."] | None = None,
    num_samples: int = 0,
    lead: tuple[int, ...] = (),
    *,
    steps: int,
    last: bool = False,
) -> Prediction:
    """Apply a one-step multimodal variational autoencoder to its own predictions, see `Predictor.rollout`.

    Args:
        condition: Conditions in SI units, of which the last number is the time of the first frame (s), or None.
        key: Random key, one for all items or one for each. None for the course of the means.
        num_samples: Number of sampled courses. If it is 0 and there is a key, the one course is sampled.
        last: True to return the last step only, with an axis of time of length 1.

    The other arguments are those of `predict`.
    """
    config, items = nnx.merge(graphdef, state).config, math.prod(lead)
    courses = 1 + num_samples  # that of the means first, unless the only course is sampled
    keys = None if key is None else jnp.broadcast_to(key.reshape(-1), items)

    def rows(x: Array) -> Array:
        """The values of all items, (*lead, ...), for each course."""
        return jnp.tile(x.reshape(items, *x.shape[len(lead) :]), (courses, *(1,) * (x.ndim - len(lead))))

    def noise(step: Int[Array, ""]) -> Float[Array, "rows latent"]:
        if keys is None:
            return jnp.zeros((courses * items, config.latent))
        shape = max(num_samples, 1), config.latent
        drawn = jax.vmap(lambda key: jax.random.normal(jax.random.fold_in(key, step), shape), out_axes=1)(keys)
        return jnp.concatenate([jnp.zeros((courses - len(drawn), *drawn.shape[1:])), drawn]).reshape(-1, config.latent)

    def advance(frame: _Frame, step: Int[Array, ""]) -> tuple[_Frame, _Frame | None]:
        flat, counts = _flat(preprocessing, frame.values, frame.present, (courses * items,), blank)
        now = None
        if begin is not None:
            now = preprocessing.encode_condition(begin.at[:, -1].add(step * preprocessing.period))
        posterior = mvae.infer(graphdef, state, flat, present=counts, condition=now)
        z = posterior.mean + jnp.exp(0.5 * posterior.log_var) * noise(step)
        values = _values(config, preprocessing, mvae.decode(graphdef, state, z, condition=now))
        known = {name: jnp.full(courses * items, name not in preprocessing.absent) for name in values}
        new = _Frame(values, known, posterior)
        return new, None if last else new

    begin = None if condition is None else rows(condition)
    nothing = {m.name: preprocessing.decode(m.name, jnp.zeros((*lead, *m.shape))) for m in config.modalities}
    absent = {name: jnp.full(lead, name in inputs) for name in config.names}
    unknown = mvae.Gaussian(*jnp.zeros((2, courses * items, config.latent)))
    start = _Frame(jax.tree.map(rows, nothing | inputs), jax.tree.map(rows, absent | present), unknown)
    end, frames = jax.lax.scan(advance, start, jnp.arange(steps))
    if frames is None:
        frames = jax.tree.map(lambda x: x[None], end)
    # (time, rows, ...) -> (courses, *lead, time, ...)
    values, posterior = jax.tree.map(
        lambda x: jnp.moveaxis(x, 0, 1).reshape(courses, *lead, len(x), *x.shape[2:]), (frames.values, frames.posterior)
    )
    every = _named(values, *posterior)
    result: Prediction = jax.tree.map(lambda x: x[0], every)
    if num_samples:
        samples = jax.tree.map(lambda x: x[1:], every)
        result = result._replace(samples=samples._replace(mean=result.mean, log_var=result.log_var))
    return result


@functools.partial(jax.jit, static_argnames=("graphdef", "preprocessing", "num_samples", "lead"))
def predict_samples(
    graphdef: nnx.GraphDef,
    state: nnx.State,
    preprocessing: training.Preprocessing,
    empty: dict[str, Float[Array, "h w 3"]],
    inputs: dict[str, Float[Array, "..."]],
    present: dict[str, Bool[Array, "*n"]],
    condition: Float[Array, "..."] | None = None,
    key: Key[Array, "..."] | None = None,
    num_samples: int = 0,
    lead: tuple[int, ...] = (),
    calibration: statespace.Calibration | None = None,
) -> Prediction:
    """Predict with a state-space model, which draws samples of the final pose and of the images.

    The predicted images are means over `num_samples` samples, or over 16 samples if `num_samples` is 0. The predicted
    position is the geometric median of at least 256 sampled positions. The predicted orientation is that of the sample
    with the smallest mean distance (in position and angle) from the other samples.

    Args:
        empty: Images "visual" and "tactile" of the empty sensor in [0, 1].
        inputs: All inputs of the model by name, see `completed`, and optionally the state codes "state".
        key: Random key for the samples, one for all items or one for each. None stands for `jax.random.key(0)`, so that
            every call gives the same result.
        calibration: From `statespace.fit_calibration`. None for no correction and the default contrast.

    The other arguments are those of `predict`.
    """
    flat, counts = _flat(preprocessing, inputs, present, lead, empty["tactile"])
    if condition is not None:
        condition = preprocessing.encode_condition(condition).reshape(-1, condition.shape[-1])
    drawn = num_samples or _DRAWN
    key = (jax.random.key(0) if key is None else key).reshape(-1)
    samples = statespace.sample(
        graphdef, state, key, flat, counts, empty, condition, calibration, num=max(_POSES, drawn), drawn=drawn
    )
    poses = preprocessing.decode_pose(samples.pose)
    mean, log_var = (x.reshape(*lead, -1) for x in samples.belief)
    result = Prediction(
        visual=samples.mean["visual"].reshape(*lead, *samples.mean["visual"].shape[1:]),
        tactile=samples.mean["tactile"].reshape(*lead, *samples.mean["tactile"].shape[1:]),
        pose=_central(poses).reshape(*lead, 7),
        mean=mean,
        log_var=log_var,
        outcome_probability=samples.outcome.reshape(*lead, -1),
    )
    if num_samples:
        images = {name: x.reshape(drawn, *lead, *x.shape[2:]) for name, x in samples.images.items()}
        of_samples = poses[:drawn].reshape(drawn, *lead, 7)
        drawn_samples = result._replace(visual=images["visual"], tactile=images["tactile"], pose=of_samples)
        result = result._replace(samples=drawn_samples)
    return result


@functools.partial(jax.jit, static_argnames=("graphdef", "preprocessing", "num", "steps", "lead"))
def _courses(
    graphdef: nnx.GraphDef,
    state: nnx.State,
    preprocessing: training.Preprocessing,
    empty: dict[str, Float[Array, "h w 3"]],
    inputs: dict[str, Float[Array, "..."]],
    present: dict[str, Bool[Array, "*n"]],
    condition: Float[Array, "..."] | None,
    key: Key[Array, "..."] | None,
    *,
    num: int,
    steps: int,
    lead: tuple[int, ...],
) -> tuple[statespace.Rollout, Float[Array, "steps k n 7"], Float[Array, "steps n 7"]]:
    """Courses of a one-step state-space model, their poses, and the centres of these poses."""
    flat, counts = _flat(preprocessing, inputs, present, lead, empty["tactile"])
    conditions = None
    if condition is not None:
        each = jnp.repeat(condition.reshape(-1, 1, condition.shape[-1]), steps, axis=1)
        conditions = preprocessing.encode_condition(each.at[..., -1].add(preprocessing.period * jnp.arange(steps)))
    rolled = statespace.rollout(graphdef, state, key, flat, counts, empty, conditions, steps=steps, num=num)
    poses = preprocessing.decode_pose(rolled.pose)
    return rolled, poses, poses[:, 0] if num == 1 else jax.vmap(_central)(poses)


_render = jax.jit(statespace.render, static_argnames="graphdef")


def rollout_samples(
    graphdef: nnx.GraphDef,
    state: nnx.State,
    preprocessing: training.Preprocessing,
    empty: dict[str, Float[Array, "h w 3"]],
    inputs: dict[str, Any],
    present: dict[str, Any],
    condition: Any = None,
    key: Key[Array, "..."] | None = None,
    num_samples: int = 0,
    lead: tuple[int, ...] = (),
    *,
    steps: int,
    last: bool = False,
) -> Prediction:
    """Roll out a one-step state-space model, see `Predictor.rollout` and `statespace.rollout`.

    With samples, the images are means over the sampled courses, and the poses are their centres, as in
    `predict_samples`. Without samples, there is one course: that of the likeliest steps, or with a key a sampled one.

    Args:
        condition: Conditions in SI units, of which the last number is the time of the first frame (s), or None.
        last: True to return the last step only, with an axis of time of length 1.

    The other arguments are those of `predict_samples`.
    """
    key = None if key is None else key.reshape(-1)
    given = empty, inputs, present, condition, key
    rolled, poses, centre = _courses(
        graphdef, state, preprocessing, *given, num=num_samples or 1, steps=steps, lead=lead
    )
    shown = range(steps)[-1:] if last else range(steps)
    frames = [_render(graphdef, state, key, rolled.belief, rolled.pose[i], rolled.turn[i], empty) for i in shown]

    def in_time(each: list[Array], axes: int) -> Array:
        """Stack an array for each frame, with the axes (*axes, items, ...), on an axis behind that of the items."""
        stacked = jnp.stack(each, axis=axes + 1)
        return stacked.reshape(*stacked.shape[:axes], *lead, *stacked.shape[axes + 1 :])

    def prediction(images: list[dict[str, Array]], poses: Array, axes: int) -> Prediction:
        return Prediction(
            visual=in_time([image["visual"] for image in images], axes),
            tactile=in_time([image["tactile"] for image in images], axes),
            pose=in_time([poses[i] for i in shown], axes),
            mean=in_time([rolled.belief.mean] * len(shown), 0),
            log_var=in_time([rolled.belief.log_var] * len(shown), 0),
        )

    if num_samples:
        samples = prediction([sharp for sharp, _ in frames], poses, 1)
        return prediction([soft for _, soft in frames], centre, 0)._replace(samples=samples)
    return prediction([jax.tree.map(lambda x: x[0], sharp) for sharp, _ in frames], poses[:, 0], 0)


def _central(poses: Float[Array, "k n 7"]) -> Float[Array, "n 7"]:
    """Centre of k sampled poses, for each of n items, see `predict_samples`."""
    place, quat = poses[..., :3], poses[..., 3:]

    def improved(_: Int[Array, ""], middle: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        weight = 1 / jnp.sqrt(jnp.sum((place - middle) ** 2, axis=-1, keepdims=True) + _CLOSE**2)
        return jnp.sum(weight * place, axis=0) / jnp.sum(weight, axis=0)

    middle = jax.lax.fori_loop(0, _ITERATIONS, improved, jnp.mean(place, axis=0))
    apart = jnp.linalg.norm(place[:, None] - place[None], axis=-1)
    turned = 2 * jnp.arccos(jnp.clip(jnp.abs(jnp.einsum("inq,jnq->ijn", quat, quat)), 0, 1))
    best = jnp.argmin(jnp.mean(apart + _TURN * turned, axis=1), axis=0)
    return jnp.concatenate([middle, jnp.take_along_axis(quat, best[None, :, None], axis=0)[0]], axis=-1)


def completed(
    names: tuple[str, ...],
    resolution: tuple[int, int],
    inputs: dict[str, Any],
    present: dict[str, Any],
    lead: tuple[int, ...],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Add a placeholder and a mask that is False for each of `names` that `inputs` lacks.

    One compiled program is therefore enough for all combinations of given inputs. `lead` are the leading axes.
    """
    lying = np.array([0, 0, 0, 1, 0, 0, 0], np.float32)
    nothing = {
        name: np.broadcast_to(lying, (*lead, 7)) if name == "pose" else np.zeros((*lead, *resolution, 3), np.float32)
        for name in names
        if name not in inputs
    }
    counts = {name: np.full(lead, name in inputs) for name in names} | present
    return inputs | nothing, counts


def _flat(
    preprocessing: training.Preprocessing,
    inputs: dict[str, Array],
    present: dict[str, Array],
    lead: tuple[int, ...],
    blank: Float[Array, "h w 3"],
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Encode all inputs, and return them and their masks with one leading axis. Images without contact are masked."""
    flat, counts = {}, {}
    for name, value in inputs.items():
        value = preprocessing.encode(name, value)
        flat[name] = value.reshape(-1, *value.shape[len(lead) :])
        counts[name] = present.get(name, jnp.ones(lead, bool)).reshape(-1)
    if "tactile" in flat:
        counts["tactile"] &= preprocessing.touched(flat["tactile"], blank)
    return flat, counts


def flagged(prediction: Prediction, valid: Bool[Array, "*n"], *, leading: int = 0, time: int = 0) -> Prediction:
    """Set the items of a prediction that are not valid to NaN.

    Samples have `leading` axes before those of `valid`, and roll-outs have `time` axes behind them.
    """

    def flag(leaf: Array, axes: int) -> Array:
        return jnp.where(valid.reshape(*valid.shape, *(1,) * axes), leaf, jnp.nan)

    values: dict[str, Any] = prediction._asdict()
    samples, measurements = values.pop("samples"), values.pop("measurements")
    for name, leaf in values.items():
        values[name] = None if leaf is None else flag(leaf, time + (3 if name in statespace.IMAGES else 1))
    return Prediction(
        **values,
        samples=None if samples is None else flagged(samples, valid, leading=1, time=time),
        measurements=jax.tree.map(lambda leaf: flag(leaf, leaf.ndim - valid.ndim - leading), measurements),
    )
