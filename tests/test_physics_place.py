"""Bodies at rest: C MuJoCo leaves them there and carries them with the same wrench, and the gel balances them."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from physics_scenes import PAD, placed
from scipy.spatial.transform import Rotation

import sts_jax as sts
from sts_jax import objects, physics
from sts_jax.physics import scene

FRICTION = 0.6
PLACES = {"yaw": 0.7, "position": (0.03, -0.02), "fill": 0.3}


BODIES = {name: objects.make(jax.random.key(i), name) for i, name in enumerate(objects.CATEGORIES)}


def simulated(body: objects.Body, pose: np.ndarray, fill: float, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """The pose after some time in C MuJoCo, and the mean wrench of the pad about the sensor's origin."""
    contact = physics.Perturbed().contact
    model = scene.compile_scene(np.asarray(body.hulls), PAD, contact)
    data = mujoco.MjData(model)
    mass, com, inertia = (np.asarray(x, np.float64) for x in objects.rigid(body, fill, 1.0))
    scene.set_rigid(model, data, float(mass), com, inertia, FRICTION)
    data.qpos[:] = pose
    wrenches = []
    for _ in range(round(seconds / contact.timestep)):
        mujoco.mj_step(model, data)
        wrenches.append(physics.wrench(model, data, "pad"))
    return data.qpos.copy(), np.mean(wrenches[len(wrenches) // 2 :], axis=0)


@pytest.mark.parametrize("category", objects.CATEGORIES)
def test_c_mujoco_leaves_a_placed_body_there_and_carries_it_with_the_same_wrench(category):
    body = BODIES[category]
    for face in range(min(2, len(physics.stable_faces(body, fill=PLACES["fill"]).up))):
        placed = physics.place(body, sts.Sensor(), face=face, **PLACES)
        pose, wrench = (np.asarray(x, np.float64) for x in placed)
        last, mean = simulated(body, pose, PLACES["fill"], 0.5)
        np.testing.assert_allclose(last[:3], pose[:3], atol=1e-4)
        assert abs(last[3:] @ pose[3:]) > np.cos(np.radians(0.25))
        force = wrench[2]
        np.testing.assert_allclose(mean[2], force, rtol=1e-3)
        np.testing.assert_allclose(mean[[0, 1, 5]], 0, atol=2e-3 * force)
        # 0.15 mm of the centre of pressure: the contacts of a polygon with sides of 10 mm and more
        np.testing.assert_allclose(mean[3:5], wrench[3:5], atol=1.5e-4 * force)


def test_the_gel_balances_every_class_and_the_default_leds_neither_clip_nor_hide_it():
    sensor = sts.Sensor(lights=sts.tactile.Leds())
    away = jnp.array([0, 0, -1.0, 1, 0, 0, 0])
    empty = np.asarray(sts.sense(sensor, BODIES["bottle"], away).tactile)
    assert np.mean((empty <= 0) | (empty >= 1), axis=(0, 1)).max() < 1e-3
    for body in BODIES.values():
        frame = sts.sense(sensor, body, *physics.place(body, sensor, position=(0.01, 0.02)))
        assert bool(frame.balanced)
        image = np.asarray(frame.tactile)
        assert np.mean((image <= 0) | (image >= 1), axis=(0, 1)).max() < 1e-2
        assert np.abs(image - empty).max() > 0.05


def test_placement_has_the_requested_face_yaw_and_position():
    body = BODIES["bottle"]
    standing = physics.place(body, sts.Sensor(), face="upright", position=(0.01, -0.02), yaw=np.pi / 2)
    pose = np.asarray(standing.pose, np.float64)
    turn = Rotation.from_quat(pose[3:], scalar_first=True).as_matrix()
    np.testing.assert_allclose(turn[:, 2], [0, 0, 1], atol=1e-5)
    np.testing.assert_allclose(turn[:, 1], [-1, 0, 0], atol=1e-5)  # its -y, at the top of the image, turned by +90
    points = placed(pose, np.asarray(body.hulls, float).reshape(-1, 3))
    np.testing.assert_allclose((points.min(0) + points.max(0))[:2] / 2, [0.01, -0.02], atol=1e-6)
    np.testing.assert_allclose(points.min(0)[2], -1e-5, atol=1e-6)
    faces = physics.stable_faces(body)
    assert np.all(np.diff(faces.share) <= 0)
    np.testing.assert_allclose(faces.share.sum(), 1, rtol=1e-6)
