"""Predictions of a state-space model: samples of the final pose and of both streams, from any subset of the inputs."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sts_jax.mvae import Gaussian
from sts_jax.statespace import calibration, poses, state
from sts_jax.statespace.networks import FinalPose, Model, compose
from sts_jax.statespace.objective import reduced


class Samples(NamedTuple):
    """k samples of the last moment of each of n items, of which the first few have images."""

    belief: Gaussian  # over the present state code and the look, (n, code + look)
    outcome: Float[Array, "n outcomes"]  # probability of each outcome
    pose: Float[Array, "k n 12"]  # codes of final poses
    images: dict[str, Float[Array, "drawn n size size 3"]]  # of the first `drawn` poses, with sharp outlines
    mean: dict[str, Float[Array, "n size size 3"]]  # of the images


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
    """Sample the end of each first moment.

    Args:
        graphdef: Definition of the model.
        params: Its parameters.
        key: Consumed.
        inputs: Some of the model's inputs, as in `objective.experts`.
        present: The items of each input that count.
        empty: As in `objective.experts`.
        condition: As in `Transition`.
        correction: Corrects the density of the final pose.
        num: Number of final poses.
        drawn: Number of these poses for which both images are drawn, each with its own look (at most `num`).
    """
    model = nnx.merge(graphdef, params)
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
    # The levels of each item are equally spaced, in random order.
    order = jax.vmap(lambda key: jax.random.permutation(key, drawn))(jax.random.split(outline, len(mean)))
    sharp = compose(layers, shown, (order.T.reshape(-1) + 0.5) / drawn)
    soft = compose(layers, shown)
    return Samples(
        belief=belief,
        outcome=jnp.exp(final.outcome),
        pose=codes,
        images={name: x.reshape(drawn, -1, *x.shape[1:]) for name, x in sharp.items()},
        mean={name: x.reshape(drawn, -1, *x.shape[1:]).mean(0) for name, x in soft.items()},
    )


def _final_pose(key: PRNGKeyArray, final: FinalPose) -> tuple[Float[Array, "n 12"], Float[Array, "n 3 3"]]:
    """Draw a final pose. Returns its code and the rotation from the present pose to it."""
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
