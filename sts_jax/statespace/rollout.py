"""Roll-outs of one-step models: courses of poses from the belief about the first frame, and their images.

A course is a sequence of poses. Each step draws a component of the density that the transition predicts, and moves the
object by the mean of this component. An object that is most probably at rest stays at rest. The noise of a component is
not drawn: velocities integrate it, so that independent noise at each step would carry the object off the pad. The
belief about the first frame is moved along the course, so that its uncertainty about shape and rotation stays the same.

The decoder runs after the roll-out, and only for the frames that are asked for, because an image costs much more than a
step, and convolutions in `lax.scan` are slow on a CPU.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, Int, Key

from sts_jax import geometry
from sts_jax._checked import in_32_bits
from sts_jax.mvae import Gaussian
from sts_jax.statespace import poses, state
from sts_jax.statespace.networks import FinalPose, Model, compose, experts, fuse, moved, of_state, reduced
from sts_jax.statespace.predict import drawn_levels, drawn_looks, drawn_noise, rendered


class Rollout(NamedTuple):
    """k courses of `steps` steps for each of n objects, without frame 0."""

    belief: Gaussian  # posterior of the state code and the appearance code of the first frame, (n, code + look)
    pose: Float[Array, "steps k n 12"]  # pose codes
    turn: Float[Array, "steps k n 3 3"]  # rotation matrices from the first frame


class _Course(NamedTuple):
    """The moving part of the state of k courses for each of n objects."""

    position: Float[Array, "k n 3"]  # position codes
    turn: Float[Array, "k n 4"]  # quaternion of the rotation since the first frame
    velocity: Float[Array, "k n 6"]  # motion over the last step


@in_32_bits
def rollout(
    graphdef: nnx.GraphDef[Model],
    params: nnx.State,
    key: Key[Array, "..."] | None,
    inputs: dict[str, Array],
    present: dict[str, Bool[Array, "n"]],
    empty: dict[str, Float[Array, "size size 3"]],
    condition: Float[Array, "n steps c"] | None = None,
    *,
    steps: int,
    num: int = 1,
) -> Rollout:
    """Roll out a one-step model from inputs of the first frame.

    Each course begins at a pose that is drawn from the belief, at rest. In each step, it draws one of the components of
    the density, unless the component of resting objects is the likeliest. An object that has left the pad keeps its
    pose, as in the simulation.

    Args:
        key: As in `sample`, for n items. None for courses without random draws: they begin at the mean pose, and each
            step takes the likeliest component.
        condition: From `training.Preprocessing.encode_condition`, at the beginning of each step, or None.
        steps: Number of steps.
        num: Number of courses of each item.

    The other arguments are those of `sample`.
    """
    model = nnx.merge(graphdef, params)
    if not model.config.stride:
        raise ValueError("the model predicts the last frame: train a one-step model (stride >= 1), or use `sample`")
    belief = fuse(experts(model, inputs, present, empty), present)
    known = of_state(belief)
    start, walk, _, _ = _keys(key, len(known.mean))
    first = _first_poses(start, known, num)
    still = _Course(
        position=first[..., :3],
        turn=jnp.broadcast_to(jnp.array([1.0, 0, 0, 0]), (*first.shape[:2], 4)),
        velocity=jnp.zeros((*first.shape[:2], poses.MOTION)),
    )

    def advance(course: _Course, given: tuple[Int[Array, ""], Array | None]) -> tuple[_Course, _Course]:
        number, condition = given
        own = None if walk is None else jax.vmap(lambda key: jax.random.fold_in(key, number))(walk)
        course = step(model, own, known, course, condition)
        return course, course

    conditions = None if condition is None else jnp.swapaxes(condition, 0, 1)
    _, courses = jax.lax.scan(advance, still, (jnp.arange(steps), conditions))
    turn = geometry.quat_to_matrix(courses.turn)
    matrix = (turn @ poses.matrix(first)).reshape(*turn.shape[:-2], 9)
    return Rollout(belief, jnp.concatenate([courses.position, matrix], axis=-1), turn)


def step(
    model: Model,
    key: Key[Array, "n"] | None,
    known: Gaussian,
    course: _Course,
    condition: Float[Array, "n c"] | None,
) -> _Course:
    """Advance k courses of each item by one step.

    Args:
        key: A key for each item. None for the likeliest component.
        known: Belief about the state code in the first frame, `(n, code)`.
        condition: At the beginning of the step.
    """
    num, number = course.position.shape[:2]

    def tiled(x: Float[Array, "n *m"]) -> Float[Array, "kn *m"]:
        return jnp.tile(x, (num, *(1,) * (x.ndim - 1)))

    here, turn, velocity = jax.tree.map(lambda x: x.reshape(num * number, -1), course)
    rotation = geometry.quat_to_matrix(turn)
    belief = jax.tree.map(tiled, known)
    density = model.transition(moved(belief, here, rotation), None if condition is None else tiled(condition), velocity)
    motion = _motions(key, density, num)
    gone = state.gone(state.split(belief.mean), model.config.position_scale * here[:, 2], rotation)[:, None]
    motion = jnp.where(gone, 0, motion)
    turn = geometry.normalize(geometry.quat_multiply(geometry.quat_from_rotvec(motion[:, 3:]), turn))
    new = _Course(here + motion[:, :3], turn, motion)
    return jax.tree.map(lambda x: x.reshape(num, number, -1), new)


def _motions(key: Key[Array, "n"] | None, density: FinalPose, num: int) -> Float[Array, "kn 6"]:
    """The motion of each course in the sensor frame: the mean of a drawn component, or of the likeliest one."""
    weight, mean = density.weight[:, 0], density.mean[:, 0]
    chosen = jnp.argmax(weight, axis=-1)
    if key is not None:
        shares = weight.reshape(num, -1, weight.shape[-1])
        draw = jax.vmap(lambda key, log: jax.random.categorical(key, log, axis=-1), in_axes=(0, 1), out_axes=1)
        rests = chosen == weight.shape[-1] - 1
        chosen = jnp.where(rests, chosen, draw(key, shares).reshape(-1))
    return poses.turn_motion(density.heading, jnp.take_along_axis(mean, chosen[:, None, None], axis=1)[:, 0])


def _first_poses(key: Key[Array, "n"] | None, known: Gaussian, num: int) -> Float[Array, "num n 12"]:
    """Draw pose codes from the belief about the first frame, or return their means, with rotations."""
    mean, log_var = (jnp.broadcast_to(x[:, : poses.CODE], (num, len(x), poses.CODE)) for x in known)
    if key is not None:
        noise = jax.vmap(lambda key: jax.random.normal(key, (num, poses.CODE)), out_axes=1)(key)
        mean += jnp.exp(0.5 * log_var) * noise
    return poses.rigid(mean)


@in_32_bits
def render(
    graphdef: nnx.GraphDef[Model],
    params: nnx.State,
    key: Key[Array, "..."] | None,
    belief: Gaussian,
    pose: Float[Array, "k n 12"],
    turn: Float[Array, "k n 3 3"],
    empty: dict[str, Float[Array, "size size 3"]],
) -> tuple[dict[str, Float[Array, "k n small small 3"]], dict[str, Float[Array, "n small small 3"]]]:
    """Render one frame of a roll-out.

    Args:
        key: As in `sample`. It draws an appearance code for each course, which is the same in all frames. None for the
            mean appearance.
        belief: `Rollout.belief`.
        pose: `Rollout.pose` in this frame.
        turn: `Rollout.turn` in this frame.

    Returns:
        The images `visual` and `tactile` of each course in [0, 1], and their means over the courses. With a key, the
        outlines in the images of the courses are sharp.
    """
    model, num = nnx.merge(graphdef, params), len(pose)
    shown = {name: reduced(x, model.config.image_size) for name, x in empty.items()}
    _, _, appearance, outline = _keys(key, len(belief.mean))
    if appearance is None:
        looks = jnp.broadcast_to(belief.mean[:, state.CODE :], (*pose.shape[:2], model.config.look))
        level = noise = None
    else:
        looks = drawn_looks(appearance, belief, num)
        level, noise = drawn_levels(outline, num), drawn_noise(outline, num)
    layers = rendered(model, belief, looks, pose, turn)
    pictures = (
        compose(layers, shown, chosen, decoder=model.decoder, noise=numbers)
        for chosen, numbers in [(level, noise), (None, None)]
    )
    sharp, soft = ({name: x.reshape(*pose.shape[:2], *x.shape[1:]) for name, x in p.items()} for p in pictures)
    return sharp, {name: x.mean(0) for name, x in soft.items()}


def _keys(key: Key[Array, "..."] | None, number: int) -> Any:
    """Keys of each item for the first pose, the steps, the appearance and the outline, `(4, n)`, or 4 times None."""
    if key is None:
        return (None,) * 4
    return jax.vmap(lambda key: jax.random.split(key, 4), out_axes=1)(jnp.broadcast_to(key, number))
