"""Derivatives of whole frames by pose, wrench and every constant, against finite differences in float64.

A pixel has a derivative where the forward and the backward difference agree. They differ where, within the step,
another face becomes visible, the skin is touched, or a light or a value reaches its limit. These pixels are left out,
and there are few of them.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from optics_bodies import at, from_trimesh, weight

import sts_jax as sts
from sts_jax import optics, tactile

pytestmark = pytest.mark.usefixtures("strict_ranks")

SHAPE = (40, 40)
STEP = 1e-5  # length of a step, over a visible change of the parameter
RELATIVE = 3e-3  # the gel's implicit derivative is damped by about this share: `_newton` adds 1e-5 to its matrix
FLOOR = 1e-6  # error of a value, which is about 1, per visible change
SETTLED = 1e-4  # error for a change of the pose, most of which the gel compensates
# Visible changes of a pose and of a wrench: m, quaternion, N, N m.
UNITS = np.array([1e-3] * 3 + [0.05] * 4), np.array([0.1] * 3 + [1e-3] * 3)

# Off the gel's plane. With lights in this plane, flat skin is at the edge of light and has no derivative.
FAR = tactile.Lights(directions=jnp.array([[-1.0, 0.1, -0.2], [1, 0, -0.1], [0.2, -1, -0.1], [0.1, 1, -0.3]]))
COLORS = 0.05 + 0.3 * FAR.colors  # inside of their range, like the tint below
FAR = dataclasses.replace(FAR, colors=COLORS)
NEAR = tactile.Leds(colors=COLORS, falloff=1.5)
GEL = tactile.Gel(size=(0.13, 0.12))  # the housing's walls are visible
ROOM = optics.Room(tint=jnp.array([0.8, 0.85, 0.95]))
SKIN = tactile.Skin(coupling=0.001, shadow_steps=6, shadow_reach=0.02, penumbra=0.3)
DIM = tactile.Phong(ambient=0.5)  # no pixel reaches 1, where it would be clipped
SENSORS = {
    name: sts.Sensor(gel=GEL, lights=lights, skin=SKIN, phong=DIM, room=ROOM)
    for name, lights in (("far", FAR), ("near", NEAR))
}


# Both have one size class and share a program.
BALL = from_trimesh(trimesh.creation.icosphere(subdivisions=3, radius=0.025))
BOX = from_trimesh(trimesh.creation.box((0.05, 0.04, 0.02)).subdivide().subdivide().subdivide().subdivide())


def seen(sensor, body, pose, wrench, crop):
    """All values of a frame that can have a derivative."""
    frame = sts.sense.__wrapped__(sensor, body, pose, wrench, resolution=SHAPE, crop=crop)  # also in 64 bits
    x, y = tactile.cell_centres(sensor.gel)
    force = frame.pressure * tactile.cell_area(sensor.gel)
    return {
        "tactile": frame.tactile,
        "visual": frame.visual,
        "depth": jnp.where(frame.segmentation, frame.depth, 0),
        "moments": jnp.stack([jnp.sum(force), jnp.sum(force * y), -jnp.sum(force * x)]),
        "pose": frame.pose,
    }


@functools.partial(jax.jit, static_argnames="crop")
def pushed(point, body, tangent, crop):
    """Values of the frame, and their derivatives along a tangent of (sensor, pose, wrench)."""
    return jax.jvp(lambda sensor, pose, wrench: seen(sensor, body, pose, wrench, crop), point, tangent)


def weights(like):
    key = jax.random.key(0)
    return jax.tree.map(lambda v: jax.random.normal(key, v.shape, jnp.float32), like)


@jax.jit
def slopes(sensor, pose, wrench, body):
    """Gradient of a weighted sum of all values, by reverse-mode differentiation."""

    def total(*point):
        values = seen(point[0], body, *point[1:], False)
        return sum(
            jnp.sum(v * w) for v, w in zip(jax.tree.leaves(values), jax.tree.leaves(weights(values)), strict=True)
        )

    return jax.grad(total, argnums=(0, 1, 2))(sensor, pose, wrench)


def double(tree):
    return jax.tree.map(
        lambda v: jnp.asarray(np.asarray(v, np.float64) if np.asarray(v).dtype.kind == "f" else v), tree
    )


def directions(point):
    """Name of each leaf, and a tangent along this leaf alone, as long as a visible change of it."""
    leaves, structure = jax.tree.flatten(point)
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(point)]
    for index, (name, leaf) in enumerate(zip(names, leaves, strict=True)):
        rng = np.random.default_rng(index)
        if name.startswith("[0]"):
            sides = [0.1 * max(float(jnp.max(jnp.abs(leaf))), 1e-3) * rng.choice([-1.0, 1.0], leaf.shape)]
        else:
            unit = UNITS[int(name[1]) - 1]
            sides = [unit[k] * np.eye(len(unit))[k] for k in range(len(unit))]
        for k, side in enumerate(sides):
            zeros = [jnp.zeros_like(v) for v in leaves]
            zeros[index] = jnp.asarray(side, leaf.dtype)
            yield f"{name}[{k}]", structure.unflatten(zeros)


def compare(point, body, crop, together=False):
    """For every leaf and stream: derivative, finite difference, and a mask of the values that have a derivative.

    `together` compares the derivative along the sum of the directions of all leaves instead.
    """
    with jax.enable_x64(True):
        point, body = double(point), double(body)
        ways = list(directions(point))
        if together:
            ways = [("all", functools.reduce(lambda a, b: jax.tree.map(jnp.add, a, b), [way for _, way in ways]))]
        for name, tangent in ways:
            here, along = pushed(point, body, tangent, crop)
            ahead, behind = (
                pushed(jax.tree.map(lambda v, t, s=s: v + s * STEP * t, point, tangent), body, tangent, crop)[0]
                for s in (1, -1)
            )
            for stream, slope in along.items():
                forward, backward = (ahead[stream] - here[stream]) / STEP, (here[stream] - behind[stream]) / STEP
                numeric = np.asarray(forward + backward) / 2
                defined = np.abs(np.asarray(forward - backward)) <= FLOOR + RELATIVE * np.abs(numeric)
                yield name, stream, np.asarray(slope), numeric, defined


PUSH, TURN = weight(0.5, 0.003, -0.002), (1, 0.1, 0.05, 0.2)
# Sensor, body, pose, wrench, crop.
POINTS = {
    # The edge of the contact runs through tiles of the image, and not along the grids.
    "ball": ("far", BALL, at(0.0031, -0.0022, 0.0249, TURN), PUSH, False),
    # A face lies flat on the gel, so the imprint is uniform.
    "flat box": ("far", BOX, at(0.0031, -0.0022, 0.01, (1, 0, 0, 0.1)), weight(0.5, 0.0031, -0.0022), False),
    "ball among LEDs, cropped": ("near", BALL, at(0.0031, -0.0022, 0.0249), PUSH, True),
}


@pytest.mark.slow
def test_the_derivative_along_all_parameters_together_equals_finite_differences():
    point = SENSORS["far"], at(0.0031, -0.0022, 0.0239, TURN), None  # in its place
    for _, stream, slope, numeric, defined in compare(point, BALL, False, together=True):
        assert np.mean(defined) > 0.95, stream
        slope, numeric = slope[defined], numeric[defined]
        largest = np.abs(numeric).max()
        assert largest > SETTLED, stream
        assert np.all(np.abs(slope - numeric) <= RELATIVE * (np.abs(numeric) + largest) + SETTLED), stream


@pytest.mark.slow
@pytest.mark.parametrize("name", POINTS)
def test_derivatives_equal_finite_differences(name):
    sensor, body, pose, wrench, crop = POINTS[name]
    moving = set()
    for leaf, stream, slope, numeric, defined in compare((SENSORS[sensor], pose, wrench), body, crop):
        words = f"{leaf}, {stream}"
        assert np.all(np.isfinite(slope)), words
        assert np.mean(defined) > 0.99, words
        slope, numeric = slope[defined], numeric[defined]
        largest = np.abs(numeric).max(initial=0)
        floor = SETTLED if leaf.startswith("[1]") else FLOOR
        assert np.all(np.abs(slope - numeric) <= RELATIVE * (np.abs(numeric) + largest) + floor), words
        moving |= {leaf} if largest > 10 * FLOOR else set()
    assert len(moving) > 25  # of about 50 parameters


FINITE = {
    "nothing": (BALL, at(5.0, 0.0, 0.1), weight(0, 0, 0)),
    "above": (BALL, at(0.01, 0.0, 0.06), weight(0, 0, 0)),
    "below": (BALL, at(0.01, 0.0, -0.06), weight(0.5, 0.01, 0)),
    "exactly flat": (BOX, at(0, 0, 0.01), weight(0.5, 0, 0)),
    "exactly flat, not pressed": (BOX, at(0, 0, 0.01), weight(0, 0, 0)),
    "exactly flat on a pixel's edge": (BOX, at(0.00375, 0.00375, 0.009), weight(0.5, 0.00375, 0.00375)),
    "round": (BALL, at(0.0031, -0.0022, 0.025), weight(0.5, 0.003, -0.002)),
    "partly out of view": (BALL, at(0.07, -0.06, 0.025), weight(0.5, 0.07, -0.06)),
    "more than the gel carries": (BALL, at(0, 0, 0.025), weight(50, 0.01, 0)),
    "pose not finite": (BALL, at(jnp.nan, 0, 0.025), weight(0.5, 0, 0)),
    "no rotation": (BALL, at(0, 0, 0.025, (0, 0, 0, 0)), weight(0.5, 0, 0)),
    "wrench not finite": (BALL, at(0, 0, 0.025), weight(jnp.inf, 0, 0)),
}


@pytest.mark.slow
def test_gradients_by_all_leaves_are_finite():
    sensor = SENSORS["far"]
    # Also the paper's lights, which lie in the gel's plane.
    plane = dataclasses.replace(sensor, lights=tactile.Lights())
    soft = dataclasses.replace(sensor, gel=dataclasses.replace(sensor.gel, stiffness=0.0))  # invalid
    for words, (body, pose, wrench) in FINITE.items():
        for given in (sensor, plane, soft):
            found = slopes(given, pose, wrench, body)
            for path, leaf in jax.tree_util.tree_leaves_with_path(found):
                assert np.all(np.isfinite(leaf)), f"{words}: {jax.tree_util.keystr(path)}"
