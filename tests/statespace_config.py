"""The smallest models, which compile in seconds, random inputs for them, and a kill of a training."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from scipy import special

import sts_jax as sts
from sts_jax import mvae, objects, statespace, training
from sts_jax.statespace import networks, poses, state

TINY = statespace.Config(
    input_size=16,
    image_size=16,
    traits=4,
    own=1,
    shown=1,
    degree=2,
    directions=4,
    support=6,
    components=2,
    window=8,
    encoder=(4, 4, 4),
    decoder=(8, 4, 4),
    hidden=16,
    transition=16,
    canvas=16,
)

STATE = dataclasses.replace(TINY, inputs=statespace.INPUTS, outcomes=3, condition=3, input_size=32)


# Without `jit`, JAX would compile 60 programs for each number of items.
_pose_codes, _state_codes = jax.jit(training.Preprocessing().encode_pose), jax.jit(statespace.encode)

SMALL = mvae.Config((mvae.Modality("a", "vector", (3,)), mvae.Modality("b", "vector", (2,))), latent=4, hidden=8)


def arrays(samples=20, seed=0):
    """A training set for `SMALL`."""
    rng = np.random.default_rng(seed)
    data = {"a": rng.random((samples, 3), np.float32), "b": rng.random((samples, 2), np.float32)}
    return training.Arrays(data, data, {"b": rng.random(samples) < 0.5})


def random_codes(rng, number):
    """Codes of random poses."""
    quat = rng.normal(size=(number, 4))
    pose = np.concatenate([0.02 * rng.normal(size=(number, 3)), quat / np.linalg.norm(quat, axis=1)[:, None]], axis=1)
    return _pose_codes(jnp.asarray(pose, jnp.float32))


def random_states(rng, number):
    """Codes of random convex objects in random poses."""
    points = rng.normal(size=(number, 20, 3)) * [0.02, 0.015, 0.01]
    support = np.max(points @ objects.DIRECTIONS.T.astype(np.float64), axis=1)
    solid = support, rng.uniform(0.02, 0.2, number), 0.005 * rng.normal(size=(number, 3))
    return _state_codes(random_codes(rng, number), *(jnp.asarray(x, jnp.float32) for x in solid))


@jax.jit
def turned_states(angle, code):
    """State codes after a rotation of the scene."""
    return state.join(state.turn(angle, state.split(code)))


def trajectories(number):
    """Random inputs, targets and conditions of trajectories, and images of the empty sensor.

    A rectangle in each image is the object. The last images are the reduced first images of other trajectories.
    """
    rng = np.random.default_rng(0)
    empty = {name: rng.uniform(0.3, 0.6, (32, 32, 3)).astype(np.float32) for name in statespace.IMAGES}
    images = {name: np.tile(image, (number, 1, 1, 1)) for name, image in empty.items()}
    for image in images.values():
        for i in range(number):
            image[i, 5 + 2 * (i % 4) : 20, 8 : 16 + 3 * (i % 4)] = rng.uniform(0.1, 0.9, 3)
    small = {name: x.reshape(number, 16, 2, 16, 2, 3).mean((2, 4))[::-1] for name, x in images.items()}
    code, final = np.asarray(random_states(rng, number)), np.asarray(random_codes(rng, number))
    return {
        "inputs": images | {"pose": code[:, : poses.CODE]},
        "targets": small | {"state": code, "pose": final, "outcome": np.arange(number) % STATE.outcomes},
        "condition": rng.normal(size=(number, STATE.condition)).astype(np.float32),
        "empty": empty,
    }


def random_densities(rng, number, components=1, angle=0.0):
    """Random densities of the final pose, with the heading at an angle."""
    shape = (number, STATE.outcomes, components)
    numbers = {
        "outcome": special.log_softmax(rng.normal(size=shape[:2]), axis=1),
        "weight": special.log_softmax(rng.normal(size=shape), axis=2),
        "mean": rng.normal(size=(*shape, poses.MOVE)),
        "log_var": rng.uniform(-3, 0, (*shape, poses.MOVE)),
        "heading": np.broadcast_to(unit(angle), (number, 2)),
    }
    return networks.FinalPose(**{name: jnp.asarray(x, jnp.float32) for name, x in numbers.items()})


@functools.cache
def untrained(config, **view):
    """A predictor with an untrained model for images of 32x32 pixels."""
    kind = {statespace.Config: statespace, mvae.Config: mvae}[type(config)]
    graphdef, params, stats = kind.init(jax.random.key(0), config)
    settings = {"kind": kind.__name__.removeprefix("sts_jax."), "model": dataclasses.asdict(config)}
    model = training.Model(config, graphdef, nnx.merge_state(params, stats), 0, settings)
    grey = np.full((32, 32, 3), 178, np.uint8)
    return sts.Predictor(model, training.Preprocessing(**{"resolution": (32, 32)} | view), (grey, grey), "new")


def state_model(**view):
    return untrained(STATE, **{"condition_scale": (10.0, 10.0, 0.1)} | view)


class Killed(BaseException):
    """Not caught by `except Exception`, like the end of a process."""


def kill_at(step):
    """A `progress` that kills a training at a step."""

    def progress(done, total, record):
        if done == step:
            raise Killed

    return progress


def unit(angle):
    """Cosine and sine of angles."""
    angle = jnp.asarray(angle, jnp.float32)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def finite(tree):
    """Assert that a tree has only finite numbers."""
    jax.tree.map(lambda leaf: np.testing.assert_array_equal(np.isfinite(leaf), True), tree)


def same(a, b):
    """Assert that two trees have the same bits."""
    jax.tree.map(np.testing.assert_array_equal, a, b)
