"""Height maps of an object's underside: the faces that can press on the gel, and those that hide the sky."""

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from optics_bodies import from_trimesh

import sts_jax as sts
from sts_jax import geometry, objects, tactile
from sts_jax.rendering.equilibrium import underside

SENSOR = sts.Sensor()


def leaning(body, lift):
    """Vertices of a tilted body, `lift` metres above the skin."""
    turn = geometry.quat_from_rotvec(jnp.array([0.6, 0.5, 0.3]))
    points = geometry.transform(jnp.concatenate([jnp.zeros(3), turn]), body.vertices)
    return points + jnp.array([[0, 0, lift]]) - jnp.min(points[:, 2])[None, None] * jnp.array([[0, 0, 1.0]])


def test_the_gels_height_map_has_faces_within_reach_and_the_skys_has_all():
    # A foot 2 cm wide under a roof 10 cm wide, 4 cm above the skin.
    foot, roof = trimesh.creation.box((0.02, 0.02, 0.04)), trimesh.creation.box((0.1, 0.1, 0.01))
    body = from_trimesh(trimesh.util.concatenate([foot, roof.apply_translation((0, 0, 0.025))]))
    near, whole = jax.jit(underside)(
        SENSOR.gel, body.faces, body.two_sided, body.vertices + jnp.array([[0, 0, 0.02]]), jnp.bool_(True)
    )
    middle = np.abs(np.arange(150) - 74.5)
    apart = np.maximum(middle[:, None], middle[None, :])
    np.testing.assert_allclose(near, np.where(apart < 10, 0, np.inf), atol=1e-6)
    np.testing.assert_allclose(whole, np.where(apart < 10, 0, np.where(apart < 50, 0.04, np.inf)), atol=1e-6)


def test_faces_beyond_reach_do_not_change_the_equilibrium():
    settle = jax.jit(tactile.settle)
    for category in ("camera", "webcam", "bottle"):
        body = objects.make(jax.random.key(0), category)
        points = leaning(body, 0.0)
        near, whole = jax.jit(underside)(SENSOR.gel, body.faces, body.two_sided, points, jnp.bool_(True))
        assert np.any(np.asarray(near) != np.asarray(whole))
        for wrench in ([0, 0, 5, 0, 0, 0], [0, 0, 60, 1.0, -2.0, 0], [0, 0, 400, 9.0, 9.0, 0]):
            wrench = jnp.asarray(wrench, jnp.float32)
            got, truth = settle(SENSOR.gel, near, wrench), settle(SENSOR.gel, whole, wrench)
            assert float(jnp.max(truth.pressure)) > 0
            for one, other in zip(jax.tree.leaves(got), jax.tree.leaves(truth), strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-7)
