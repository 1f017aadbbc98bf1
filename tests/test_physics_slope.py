"""A block on a slope (gravity tilted in the pad's frame): it holds, or slides as Coulomb says, in every direction."""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from sts_jax import physics
from sts_jax.physics import contact, roll, scene
from sts_jax.physics.scenarios import G

PAD = (0.15, 0.15)
SLOPE = np.radians(30)
AZIMUTHS = np.radians([0, 22.5, 45, 90, 200])
STEPS = 50
ROLL = jax.jit(jax.vmap(roll.roll, in_axes=(None, None, None, 0, 0)))


def slide(friction: float, constants: physics.Contact, frames: int) -> roll.Record:
    """A block 60 x 40 x 20 mm laid on the pad, which is then tilted towards each azimuth; a record every 50 ms."""
    corners = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3) * [0.03, 0.02, 0.01]
    hull = jax.tree.map(jnp.asarray, contact.hull(np.concatenate([corners, np.repeat(corners[-1:], 24, axis=0)])))
    model, like, data = scene.template(PAD, constants)
    model = copy.copy(model)
    scene.set_rigid(model, mujoco.MjData(model), 0.1, np.zeros(3), 0.1 * np.diag([1.7e-4, 3.3e-4, 4.3e-4]), friction)
    own = like.tree_replace(scene.drawn(model, like))
    down = np.stack([np.cos(AZIMUTHS), np.sin(AZIMUTHS)], axis=-1)
    start = jax.vmap(lambda xy: roll.initial(jnp.array([*(-0.03 * xy), 0.01, 1, 0, 0, 0]), jnp.zeros(6)))(
        jnp.asarray(down, jnp.float32)
    )
    tilted = G * np.concatenate([np.sin(SLOPE) * down, np.full((len(down), 1), -np.cos(SLOPE))], axis=1)
    flat = np.tile([0, 0, -G], (len(down), 2, STEPS, 1))
    gravity = np.concatenate([flat, np.tile(tilted[:, None, None], (1, frames, STEPS, 1))], axis=1)
    return jax.tree.map(np.asarray, ROLL(own, data, hull, start, jnp.asarray(gravity, jnp.float32))[1])


def test_below_the_friction_angle_it_holds() -> None:
    found = slide(float(np.tan(SLOPE) / 0.97), physics.Perturbed().contact, 10)
    creep = np.linalg.norm(found.pose[:, -1, :2] - found.pose[:, 6, :2], axis=1) / (5 * STEPS * 1e-3)
    assert np.all(creep < 1e-3), creep


@pytest.mark.parametrize("friction", [0.2, 0.4])
def test_above_it_slides_with_what_friction_leaves(friction: float) -> None:
    found = slide(friction, physics.Perturbed().contact, 10)
    down = np.stack([np.cos(AZIMUTHS), np.sin(AZIMUTHS)], axis=-1)
    speed = np.einsum("nfi,ni->nf", found.velocity[..., :2], down)
    gained = (speed[:, 4] - speed[:, 2]) / (2 * STEPS * 1e-3)
    expected = G * (np.sin(SLOPE) - friction * np.cos(SLOPE))
    np.testing.assert_allclose(gained, expected, rtol=0.02)
    across = np.abs(found.velocity[:, 4, 0] * down[:, 1] - found.velocity[:, 4, 1] * down[:, 0])
    assert np.all(across < 0.01 * speed[:, 4])
