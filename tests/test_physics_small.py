"""Small and thin objects come to rest on their faces, what floats does not rest, and failures leave no files."""

import dataclasses
import os

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh
from physics_scenes import PAD, box, part, solid_block
from scipy.spatial.transform import Rotation

from sts_jax import objects, physics
from sts_jax.physics import engines, scene
from sts_jax.sensor import Sensor

DROP = physics.Freefall(spread=0.02)  # m, so that few objects hang over the rim of the pad


def solid(mesh: trimesh.Trimesh) -> objects.Body:
    """A solid body with the hull of a mesh and the density of water."""
    mesh.density = 1000.0
    return dataclasses.replace(
        solid_block(np.full(3, 0.01), mesh.mass),
        hulls=jnp.asarray(part(mesh.vertices), jnp.float32),
        shell_com=jnp.asarray(mesh.center_mass, jnp.float32),
        shell_inertia=jnp.asarray(mesh.moment_inertia, jnp.float32),
    )


def cube(side: float) -> objects.Body:
    return solid(trimesh.creation.box((side,) * 3))


die = trimesh.creation.icosahedron()
die.apply_scale(0.01)  # m
CUBES = {f"cube of {1e3 * side:g} mm": cube(side) for side in (0.005, 0.0075, 0.01, 0.015, 0.02, 0.05)}
THIN = {
    "coin": solid(trimesh.creation.cylinder(0.012, 0.002, sections=14)),
    "rod": solid(trimesh.creation.box((0.1, 0.003, 0.003))),
    "card": solid(trimesh.creation.box((0.085, 0.054, 0.0015))),
    "die of 20 faces": solid(die),
}
SMALL = CUBES | THIN


def leans(body: objects.Body, pose: np.ndarray) -> np.ndarray:
    """Angle (degrees) between each pose and the nearest pose on a stable face."""
    up = Rotation.from_quat(pose[:, 3:], scalar_first=True).as_matrix()[:, 2]
    cosine = np.max(up @ physics.stable_faces(body).up.T, axis=1)
    return np.degrees(np.arccos(np.minimum(cosine, 1)))


@pytest.mark.parametrize(
    ("engine", "num"), [("mujoco", 16), pytest.param("mjx", 3, marks=pytest.mark.slow)], ids=["mujoco", "mjx"]
)
def test_small_and_thin_objects_come_to_rest_on_their_faces(engine, num):
    found = physics.simulate(jax.random.key(1), list(SMALL.values()), Sensor(), DROP, num, engine=engine)
    rests = np.asarray(found.settled & (found.outcome == physics.Outcome.RESTS)).reshape(-1, num)
    poses = np.asarray(found.pose[:, -1]).reshape(-1, num, 7)
    assert rests.mean() > 0.9
    for name, own, pose in zip(SMALL, rests, poses, strict=True):
        assert leans(SMALL[name], pose[own]).max() < 1, name


def test_friction_is_bounded_by_the_size_of_the_object_in_both_engines():
    contact = physics.Contact(torsional=0.005, rolling=0.002)
    bodies = [solid_block(np.array(half), 0.1) for half in ([0.03, 0.001, 0.02], [0.06, 0.06, 0.06])]
    hidden = physics.Hidden(np.zeros(2), np.ones(2), np.full(2, 0.6), np.tile([0.0, 0, 1], (2, 1)))
    fields = engines.drawn_fields(bodies, np.arange(2), hidden, PAD, contact, 0.0)
    for body, drawn, expected in zip(bodies, fields["geom_friction"], ([0.0005, 4e-5], [0.005, 0.002]), strict=True):
        model = scene.compile_scene(np.asarray(body.hulls), PAD, contact)
        np.testing.assert_allclose(drawn[1:], np.tile([0.6, *expected], (len(drawn) - 1, 1)), rtol=1e-5)
        np.testing.assert_allclose(model.geom_friction[model.geom_bodyid > 0, 1:], [expected], rtol=1e-5)


@dataclasses.dataclass(frozen=True)
class Weightless(physics.Freefall):
    """Objects without gravity."""

    def gravity(self, time: jax.Array, condition: jax.Array) -> jax.Array:
        del time, condition
        return jnp.zeros(3)


@pytest.mark.parametrize("engine", ["mujoco", pytest.param("mjx", marks=pytest.mark.slow)])
def test_what_floats_has_not_settled(engine):
    heights = np.float32([0.03, 0.00999, 0.0099])  # m, of the centre: in the air, 0.01 mm and 0.1 mm deep
    pose = np.stack([np.float32([0, 0, height, 1, 0, 0, 0]) for height in heights])
    start = physics.Start(pose, np.array(0), np.zeros((3, 0), np.float32))
    given = {"start": start, "chunk": 3, "engine": engine}
    found = physics.simulate(jax.random.key(0), cube(0.02), Sensor(), Weightless(), 3, **given)
    assert not found.settled.any()


def test_a_failed_simulation_names_the_contact_and_writes_nothing(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    before = mujoco.MjLogConfig.get()
    unstable = dataclasses.replace(DROP, contact=physics.Contact(0.001, damping_ratio=1e-30))
    with pytest.raises(physics.BodyError, match=r"failed in each of 5 attempts .* scenario\.contact"):
        physics.simulate(jax.random.key(0), cube(0.02), Sensor(), unstable)
    assert not os.listdir(tmp_path)
    assert "WARNING" not in "".join(capfd.readouterr())
    after = mujoco.MjLogConfig.get()
    assert (after.logto_console, after.logto_file) == (before.logto_console, before.logto_file)


def test_the_smallest_width_counts_and_large_objects_keep_their_friction():
    given = physics.Contact(torsional=0.005, rolling=0.0002)
    turned = box(0.002, 0.03, 0.04) @ Rotation.random(rng=0).as_matrix()
    limited = given.limited(part(turned))
    assert (limited.torsional, limited.rolling) == pytest.approx((0.001, 0.00008))
    assert given.limited(part(box(0.012, 0.03, 0.04))) == given
