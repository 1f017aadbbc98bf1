"""Samples of final poses and of visual and tactile images from a state-space model, given any subset of the inputs."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sts_jax.mvae import Gaussian
from sts_jax.statespace import calibration, poses, state
from sts_jax.statespace.layers import CONTRAST, Layers, compose
from sts_jax.statespace.networks import FinalPose, Model
from sts_jax.statespace.objective import reduced


class Samples(NamedTuple):
    """Samples of the last frame: k final poses for each of n items, and images of some of these poses.

    Each item has k poses, but only the poses with index 0 to `drawn` - 1 have images. `drawn` is an argument of
    `sample`.
    """

    belief: Gaussian  # posterior of the state code and the appearance code of the first frame, (n, code + look)
    outcome: Float[Array, "n outcomes"]  # probability of each outcome
    pose: Float[Array, "k n 12"]  # pose codes of the last frame
    images: dict[str, Float[Array, "drawn n size size 3"]]  # `visual` and `tactile` images with sharp outlines, [0, 1]
    mean: dict[str, Float[Array, "n size size 3"]]  # expected images: means over the `drawn` samples


def sample(
    graphdef: nnx.GraphDef[Model],
    params: nnx.State,
    key: PRNGKeyArray,
    inputs: dict[str, Array],
    present: dict[str, Bool[Array, "n"]],
    empty: dict[str, Float[Array, "size size 3"]],
    condition: Float[Array, "n c"] | None = None,
    correction: calibration.Calibration | None = None,
    *,
    num: int,
    drawn: int,
) -> Samples:
    """Sample final poses and images of the last frame, given inputs of the first frame.

    Args:
        graphdef: Definition of the model, from `init`.
        params: Parameters of the model.
        key: Random key for the samples.
        inputs: One or more inputs of n items, by name. `visual` and `tactile` are images in [0, 1],
            `(n, size, size, 3)`, where size is `Config.input_size`. `pose` contains pose codes, `(n, 12)`. `state`
            contains true state codes (pose, shape and mass), `(n, code)`. Inputs other than `state` must be in the
            model's `Config.inputs`.
        present: A mask for each name in `inputs`, `(n,)`. True means that the item has the input. Values of other items
            have no influence and may be NaN.
        empty: `visual` and `tactile` image of the empty sensor, `(size, size, 3)` in [0, 1].
        condition: Known quantities of the scenario such as an acceleration, `(n, c)`, from
            `training.Preprocessing.encode_condition`. None if the model has no condition.
        correction: Calibration from `fit_calibration`, which corrects the density of the final pose and sets the
            contrast. The contrast is the sharpness of the outlines in the sampled images. With None, the density is
            unchanged, and the contrast is the default of `compose`.
        num: Number of final poses for each item.
        drawn: Number of final poses with rendered visual and tactile images, from 1 to `num`. A random appearance code
            is drawn for each of these poses.

    Returns:
        The posterior of the first frame, the probabilities of the outcomes (such as resting or falling off), the
        sampled final poses and images, and the mean images of each item over the `drawn` samples. The posterior is a
        Gaussian over the state code (pose, shape and mass) and the appearance code (all other visible properties).

    Raises:
        ValueError: `drawn` is out of range.
    """
    if not 1 <= drawn <= num:
        raise ValueError(f"`drawn` must be from 1 to `num` ({num}), got {drawn}")
    model = nnx.merge(graphdef, params)
    found = draw(model, key, inputs, present, empty, condition, correction, num=num, drawn=drawn)
    contrast = jnp.full(len(found.outcome), CONTRAST)
    if correction is not None:
        contrast = calibration.of_items(model.config, correction, present).contrast
    sharp = compose(found.layers, found.empty, found.level, jnp.tile(contrast, drawn))
    soft = compose(found.layers, found.empty)
    return Samples(
        belief=found.belief,
        outcome=found.outcome,
        pose=found.pose,
        images={name: x.reshape(drawn, -1, *x.shape[1:]) for name, x in sharp.items()},
        mean={name: x.reshape(drawn, -1, *x.shape[1:]).mean(0) for name, x in soft.items()},
    )


class Drawn(NamedTuple):
    """Samples for n trajectories: k final poses for each of them, and layers for some of these poses.

    The layers are the outlines and colours of the objects, and the changes that the objects cause in the tactile
    images. `compose` combines them with the images of the empty sensor, and returns complete images. For each
    trajectory, only the first poses have layers. The argument `drawn` of `draw` is the number of these poses.
    """

    belief: Gaussian  # posterior of the state code and the appearance code of the first frame, (n, code + look)
    outcome: Float[Array, "n outcomes"]  # probability of each outcome
    pose: Float[Array, "k n 12"]  # pose codes of the last frame
    layers: Layers  # outlines and colours, drawn * n, with the axis of the trajectories last
    level: Float[Array, "m"]  # threshold of each outline, drawn * n
    empty: dict[str, Float[Array, "size size 3"]]  # images of the empty sensor with the size of the layers


def draw(
    model: Model,
    key: PRNGKeyArray,
    inputs: dict[str, Array],
    present: dict[str, Bool[Array, "n"]],
    empty: dict[str, Float[Array, "size size 3"]],
    condition: Float[Array, "n c"] | None,
    correction: calibration.Calibration | None,
    *,
    num: int,
    drawn: int,
) -> Drawn:
    """Sample final poses for each trajectory, and render layers for a part of these poses.

    The argument `num` is the number of poses. The argument `drawn` is the number of poses with layers. The layers are
    the outlines and colours of the objects, and the changes that the objects cause in the tactile images. `compose`
    combines them with the images of the empty sensor, and returns complete images. The arguments after `model` are the
    same as in `sample`.
    """
    belief, final = calibration.predict(model, inputs, present, empty, condition, correction)
    end, appearance, outline = jax.random.split(key, 3)
    codes, turns = jax.vmap(lambda key: _final_pose(key, final))(jax.random.split(end, num))
    known = jnp.broadcast_to(belief.mean[:, : state.CODE], (drawn, len(belief.mean), state.CODE))
    mean, log_var = (x[:, state.CODE :] for x in belief)
    looks = mean + jnp.exp(0.5 * log_var) * jax.random.normal(appearance, (drawn, *mean.shape))
    layers = model.decoder(
        codes[:drawn].reshape(-1, poses.CODE),
        turns[:drawn].reshape(-1, 3, 3),
        known.reshape(-1, state.CODE),
        looks.reshape(-1, looks.shape[-1]),
    )
    shown = {name: reduced(x, model.config.image_size) for name, x in empty.items()}
    # An image is sharp because pixels are covered above a level of probability. The levels of an item are equally
    # spaced, in random order.
    order = jax.vmap(lambda key: jax.random.permutation(key, drawn))(jax.random.split(outline, len(mean)))
    level = (order.T.reshape(-1) + 0.5) / drawn
    return Drawn(belief, jnp.exp(final.outcome), codes, layers, level, shown)


def _final_pose(key: PRNGKeyArray, final: FinalPose) -> tuple[Float[Array, "n 12"], Float[Array, "n 3 3"]]:
    """Draw a final pose for each item. Return its code and the rotation matrix from the first to the final pose."""
    which, noise = jax.random.split(key)
    number = len(final.outcome)
    joint = (final.outcome[:, :, None] + final.weight).reshape(number, -1)
    chosen = jax.random.categorical(which, joint)

    def of_chosen(x: Array) -> Array:
        flat = x.reshape(number, -1, poses.MOVE)
        return jnp.take_along_axis(flat, chosen[:, None, None], axis=1)[:, 0]

    mean, log_var = of_chosen(final.mean), of_chosen(final.log_var)
    move = mean + jnp.exp(0.5 * log_var) * jax.random.normal(noise, mean.shape)
    heading = poses.about_vertical(final.heading)
    turn = heading @ poses.nearest(move[:, poses.CODE :]) @ jnp.swapaxes(heading, -1, -2)
    return poses.turn_code(final.heading, poses.rigid(move[:, : poses.CODE])), turn
