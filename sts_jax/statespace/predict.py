"""Predictions of a state-space model: the calibrated density of the final pose, and samples of poses and images."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, Key

from sts_jax._checked import in_32_bits
from sts_jax.mvae import Gaussian
from sts_jax.statespace import imprints, poses, state
from sts_jax.statespace.config import Config
from sts_jax.statespace.networks import (
    CONTRAST,
    FinalPose,
    Layers,
    Model,
    compose,
    experts,
    fuse,
    of_state,
    reduced,
)


class Calibration(NamedTuple):
    """Numbers that correct the density of the final pose and set the contrast of sampled images, see `calibration`.

    Each array has one value for each subset of the inputs. The subset with the inputs at the positions i of
    `Config.inputs` has the index `sum(2**i)`. If `outcome`, `weight` and `variance` are 1, the density is unchanged.
    """

    outcome: Float[Array, "subsets"]  # exponent of the probabilities of the outcomes, in [1/4, 4]
    weight: Float[Array, "subsets"]  # exponent of the weights of an outcome's mixture components, in [1/4, 1]
    variance: Float[Array, "subsets"]  # factor of the variances of the components, in [1, 4]
    contrast: Float[Array, "subsets"]  # contrast of the outlines in samples, `compose`


def of_items(config: Config, calibration: Calibration, present: dict[str, Bool[Array, "n"]]) -> Calibration:
    """The values of a calibration for the subset of the inputs that each item has, `(n,)`.

    An item with the input `state` gets the values of no input, which do not change its density.
    """
    names = enumerate(config.inputs)
    subset = jnp.asarray(sum(2**i * present[name].astype(int) for i, name in names if name in present))
    subset = jnp.broadcast_to(subset, len(next(iter(present.values()))))
    corrected_as = jnp.where(present["state"], 0, subset) if "state" in present else subset
    density = Calibration(*(x[corrected_as] for x in calibration))
    return density._replace(contrast=calibration.contrast[subset])


def predict(
    model: Model,
    inputs: dict[str, Array],
    present: dict[str, Bool[Array, "n"]],
    empty: dict[str, Float[Array, "size size 3"]],
    condition: Float[Array, "n c"] | None = None,
    calibration: Calibration | None = None,
) -> tuple[Gaussian, FinalPose]:
    """Infer the belief, `(n, code + look)`, and predict the density of the final pose.

    The arguments after `model` are those of `sample`.
    """
    belief = fuse(experts(model, inputs, present, empty), present)
    final = model.transition(of_state(belief), condition)
    if calibration is None:
        return belief, final
    numbers = of_items(model.config, calibration, present)
    return belief, corrected(final, numbers.outcome, numbers.weight, numbers.variance)


def corrected(
    final: FinalPose, outcome: Float[Array, "*n"], weight: Float[Array, "*n"], variance: Float[Array, "*n"]
) -> FinalPose:
    """Densities of the final pose with the exponents and the factor of a calibration, scalars or `(n,)`."""

    def power(log: Array, exponent: Array) -> Array:
        return jax.nn.log_softmax(log * exponent.reshape(-1, *(1,) * (log.ndim - 1)))

    return final._replace(
        outcome=power(final.outcome, outcome),
        weight=power(final.weight, weight),
        log_var=final.log_var + jnp.log(variance).reshape(-1, 1, 1, 1),
    )


class Samples(NamedTuple):
    """Samples of the last frame: k final poses for each of n items, and images of the first `drawn` of these poses."""

    belief: Gaussian  # posterior of the state code and the appearance code of the first frame, (n, code + look)
    outcome: Float[Array, "n outcomes"]  # probability of each outcome
    pose: Float[Array, "k n 12"]  # pose codes of the last frame
    images: dict[str, Float[Array, "drawn n size size 3"]]  # `visual` and `tactile` images with sharp outlines, [0, 1]
    mean: dict[str, Float[Array, "n size size 3"]]  # expected images: means over the `drawn` samples


@in_32_bits
def sample(
    graphdef: nnx.GraphDef[Model],
    params: nnx.State,
    key: Key[Array, "..."],
    inputs: dict[str, Array],
    present: dict[str, Bool[Array, "n"]],
    empty: dict[str, Float[Array, "size size 3"]],
    condition: Float[Array, "n c"] | None = None,
    correction: Calibration | None = None,
    *,
    num: int,
    drawn: int,
) -> Samples:
    """Sample final poses and images of the last frame, given inputs of the first frame.

    Args:
        key: One random key for each item, `(n,)`, or one for all items. The samples of an item then depend neither on
            its place in the batch nor on the other items.
        inputs: One or more inputs of n items, by name. `visual` and `tactile` are images in [0, 1], `(n, size, size,
            3)`, where size is `Config.input_size`. `pose` has pose codes, `(n, 12)`, and `state` true state codes, `(n,
            code)`.
        present: A mask for each name in `inputs`. Values of items whose mask is False have no influence and may be NaN.
        empty: `visual` and `tactile` image of the empty sensor, `(size, size, 3)` in [0, 1].
        condition: From `training.Preprocessing.encode_condition`, or None.
        correction: Calibration from `fit_calibration`. With None, the density is unchanged, and the contrast is
            `CONTRAST`.
        num: Number of final poses for each item.
        drawn: Number of final poses with images, from 1 to `num`. An appearance code is drawn for each of them.
    """
    if not 1 <= drawn <= num:
        raise ValueError(f"`drawn` must be from 1 to `num` ({num}), got {drawn}")
    model = nnx.merge(graphdef, params)
    samples = draw(model, key, inputs, present, empty, condition, correction, num=num, drawn=drawn)
    contrast = jnp.full(len(samples.outcome), CONTRAST)
    if correction is not None:
        contrast = of_items(model.config, correction, present).contrast
    contrasts = jnp.tile(contrast, drawn)
    sharp = compose(samples.layers, samples.empty, samples.level, contrasts, model.decoder, samples.noise)
    soft = compose(samples.layers, samples.empty, decoder=model.decoder)
    return Samples(
        belief=samples.belief,
        outcome=samples.outcome,
        pose=samples.pose,
        images={name: x.reshape(drawn, -1, *x.shape[1:]) for name, x in sharp.items()},
        mean={name: x.reshape(drawn, -1, *x.shape[1:]).mean(0) for name, x in soft.items()},
    )


class Drawn(NamedTuple):
    """Samples for n trajectories: k final poses for each of them, and layers for the first `drawn` of these poses."""

    belief: Gaussian  # posterior of the state code and the appearance code of the first frame, (n, code + look)
    outcome: Float[Array, "n outcomes"]  # probability of each outcome
    pose: Float[Array, "k n 12"]  # pose codes of the last frame
    layers: Layers  # outlines and colours, drawn * n, with the axis of the trajectories last
    level: Float[Array, "m"]  # threshold of each outline, drawn * n
    noise: Float[Array, "m noise"]  # random numbers of each imprint, drawn * n
    empty: dict[str, Float[Array, "size size 3"]]  # images of the empty sensor with the size of the layers


def draw(
    model: Model,
    key: Key[Array, "..."],
    inputs: dict[str, Array],
    present: dict[str, Bool[Array, "n"]],
    empty: dict[str, Float[Array, "size size 3"]],
    condition: Float[Array, "n c"] | None,
    correction: Calibration | None,
    *,
    num: int,
    drawn: int,
) -> Drawn:
    """Sample final poses, and render layers for a part of them. The arguments after `model` are those of `sample`."""
    belief, final = predict(model, inputs, present, empty, condition, correction)
    keys = jnp.broadcast_to(key, len(belief.mean))
    end, appearance, outline = jax.vmap(lambda key: jax.random.split(key, 3), out_axes=1)(keys)
    codes, turns = jax.vmap(functools.partial(_final_poses, num=num), out_axes=1)(end, final)
    looks, level = drawn_looks(appearance, belief, drawn), drawn_levels(outline, drawn)
    layers = rendered(model, belief, looks, codes[:drawn], turns[:drawn])
    shown = {name: reduced(x, model.config.image_size) for name, x in empty.items()}
    return Drawn(belief, jnp.exp(final.outcome), codes, layers, level, drawn_noise(outline, drawn), shown)


def drawn_looks(key: Key[Array, "n"], belief: Gaussian, num: int) -> Float[Array, "num n look"]:
    """Draw appearance codes of each item."""
    mean, log_var = (x[:, state.CODE :] for x in belief)
    noise = jax.vmap(lambda key: jax.random.normal(key, (num, mean.shape[1])), out_axes=1)(key)
    return mean + jnp.exp(0.5 * log_var) * noise


def drawn_levels(key: Key[Array, "n"], num: int) -> Float[Array, "m"]:
    """Levels of probability above which the pixels of each of num * n sharp images are covered, see `compose`.

    The levels of an item are equally spaced, in random order.
    """
    order = jax.vmap(lambda key: jax.random.permutation(key, num), out_axes=1)(key)
    return (order.reshape(-1) + 0.5) / num


def drawn_noise(key: Key[Array, "n"], num: int) -> Float[Array, "m noise"]:
    """Random numbers of each of num * n imprints, see `imprints.Outlines`."""

    def of_item(key: Key[Array, ""]) -> Float[Array, "num noise"]:
        return jax.random.normal(jax.random.fold_in(key, 1), (num, imprints.NOISE))

    return jax.vmap(of_item, out_axes=1)(key).reshape(-1, imprints.NOISE)


def rendered(
    model: Model,
    belief: Gaussian,
    looks: Float[Array, "k n look"],
    codes: Float[Array, "k n 12"],
    turns: Float[Array, "k n 3 3"],
) -> Layers:
    """Render k poses of each of n objects, from a belief about the first frames. The result has k * n items."""
    known = jnp.broadcast_to(belief.mean[:, : state.CODE], (*codes.shape[:2], state.CODE))
    return model.decoder(
        codes.reshape(-1, poses.CODE),
        turns.reshape(-1, 3, 3),
        known.reshape(-1, state.CODE),
        looks.reshape(-1, looks.shape[-1]),
    )


def _final_poses(
    key: Key[Array, ""], final: FinalPose, *, num: int
) -> tuple[Float[Array, "num 12"], Float[Array, "num 3 3"]]:
    """Draw final poses of one item. Return their codes and the rotation matrices from the first to the final pose."""
    which, noise = jax.random.split(key)
    joint = (final.outcome[:, None] + final.weight).reshape(-1)
    chosen = jax.random.categorical(which, joint, shape=(num,))
    mean, log_var = (x.reshape(-1, poses.MOVE)[chosen] for x in (final.mean, final.log_var))
    move = mean + jnp.exp(0.5 * log_var) * jax.random.normal(noise, mean.shape)
    heading = poses.about_vertical(final.heading)
    turn = heading @ poses.nearest(move[:, poses.CODE :]) @ heading.T
    return poses.turn_code(final.heading, poses.rigid(move[:, : poses.CODE])), turn
