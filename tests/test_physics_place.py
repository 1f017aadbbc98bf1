"""Bodies at rest: C MuJoCo leaves them there and carries them with the same wrench, and the gel balances them."""

import dataclasses
import inspect

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sts_jax as sts
from sts_jax import objects, physics
from sts_jax.physics import scene

PAD = (0.15, 0.15)
FRICTION = 0.6
PLACES = {"yaw": 0.7, "position": (0.03, -0.02), "fill": 0.3}


@pytest.fixture(scope="module")
def bodies() -> list[objects.Body]:
    return [objects.make(jax.random.key(i), name) for i, name in enumerate(objects.CATEGORIES)]


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
        total, own = np.zeros(6), np.zeros(6)
        for index in range(data.ncon):
            mujoco.mj_contactForce(model, data, index, own)
            touching = data.contact[index]
            push, twist = (touching.frame.reshape(3, 3).T @ part for part in (own[:3], own[3:]))
            sign = 1 if model.geom_bodyid[touching.geom2] > 0 else -1  # the force is on the second geom
            total += sign * np.concatenate([push, twist + np.cross(touching.pos, push)])
        wrenches.append(total)
    return data.qpos.copy(), np.mean(wrenches[len(wrenches) // 2 :], axis=0)


@pytest.mark.parametrize("category", objects.CATEGORIES)
def test_c_mujoco_leaves_a_placed_body_there_and_carries_it_with_the_same_wrench(bodies, category):
    body = bodies[objects.CATEGORIES.index(category)]
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


def test_the_gel_balances_every_class_and_the_default_leds_neither_clip_nor_hide_it(bodies):
    sensor = sts.Sensor(lights=sts.tactile.Leds())
    away = jnp.array([0, 0, -1.0, 1, 0, 0, 0])
    empty = np.asarray(sts.sense(sensor, bodies[0], away).tactile)
    assert np.mean((empty <= 0) | (empty >= 1), axis=(0, 1)).max() < 1e-3
    for body in bodies:
        frame = sts.sense(sensor, body, *physics.place(body, sensor, position=(0.01, 0.02)))
        assert bool(frame.balanced)
        image = np.asarray(frame.tactile)
        assert np.mean((image <= 0) | (image >= 1), axis=(0, 1)).max() < 1e-2
        assert np.abs(image - empty).max() > 0.05


def test_the_wrench_is_the_weight_with_its_moment_about_the_origin(bodies):
    body = bodies[0]
    pose, wrench = physics.place(body, sts.Sensor(), **PLACES)
    mass, com, _ = (np.asarray(x, np.float64) for x in objects.rigid(body, PLACES["fill"], 1.0))
    w, x, y, z = np.asarray(pose[3:], np.float64)
    centre = Rotation.from_quat([x, y, z, w]).apply(com) + np.asarray(pose[:3])
    force = np.array([0, 0, 9.81 * mass])
    np.testing.assert_allclose(wrench, np.concatenate([force, np.cross(centre, force)]), rtol=1e-4, atol=1e-7)


def test_placement_has_the_requested_face_yaw_and_position(bodies):
    body = bodies[0]
    standing = physics.place(body, sts.Sensor(), face="upright", position=(0.01, -0.02), yaw=np.pi / 2)
    w, x, y, z = np.asarray(standing.pose[3:], np.float64)
    turn = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(turn[:, 2], [0, 0, 1], atol=1e-5)
    np.testing.assert_allclose(turn[:, 1], [-1, 0, 0], atol=1e-5)  # its -y, at the top of the image, turned by +90
    points = np.asarray(body.hulls, float).reshape(-1, 3) @ turn.T + np.asarray(standing.pose[:3])
    np.testing.assert_allclose((points.min(0) + points.max(0))[:2] / 2, [0.01, -0.02], atol=1e-6)
    np.testing.assert_allclose(points.min(0)[2], -1e-5, atol=1e-6)
    faces = physics.stable_faces(body)
    assert np.all(np.diff(faces.share) <= 0)
    np.testing.assert_allclose(faces.share.sum(), 1, rtol=1e-6)


def test_more_shell_or_contents_weigh_more(bodies):
    body = bodies[0]
    light, full, heavy = (
        float(physics.place(body, sts.Sensor(), face="upright", **changes).wrench[2])
        for changes in ({"fill": 0.0}, {"fill": 1.0}, {"fill": 0.0, "shell_scale": 2.0})
    )
    np.testing.assert_allclose(heavy, 2 * light, rtol=1e-5)
    assert full > light + 9.81 * 0.05


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"face": 99}, r"`face` is 99, .* no such face: the body can rest on faces 0 \(the most likely\) to \d+"),
        ({"face": -1}, r"`face` is -1, but the body has no such face: the body can rest on faces 0"),
        ({"face": "sideways"}, r"`face` is 'sideways', but it must be the index of a face or 'upright'"),
        ({"position": (0.2, 0.0)}, r"position is \(0.2, 0.0\) m, .* beyond the pad"),
        ({"position": (0.0, float("nan"))}, "position is .* 2 finite numbers"),
        ({"yaw": float("inf")}, "yaw is inf, but it must be one finite number"),
        ({"fill": 1.5}, "fill is 1.5, .* from 0 to 1"),
        ({"shell_scale": 0.0}, "shell_scale is 0.0, but it must be > 0"),
        ({"up": (0.0, 0.0, 2.0)}, r"`up` is .* which has the length 2, but it must have the length 1"),
    ],
)
def test_errors_name_arguments_of_place_that_are_out_of_range(bodies, changes, message):
    with pytest.raises(ValueError, match=message):
        physics.rest.place.__wrapped__(bodies[0], sts.Sensor(), **changes)


def test_errors_name_bodies_that_cannot_be_placed(bodies):
    leaning = Rotation.from_euler("x", 30, degrees=True).as_matrix().astype(np.float32)
    with pytest.raises(ValueError, match=r"`face` is 'upright', but the body does not stand stably"):
        physics.place(dataclasses.replace(bodies[0], hulls=bodies[0].hulls @ leaning.T), sts.Sensor(), face="upright")
    outside = dataclasses.replace(bodies[0], shell_com=jnp.array([0.3, 0.2, 0.3]), contents_density=jnp.float32(0))
    with pytest.raises(ValueError, match="the body cannot rest on any of its faces"):
        physics.place(outside, sts.Sensor())
    with pytest.raises(ValueError, match="hulls span no volume"):
        physics.place(dataclasses.replace(bodies[0], hulls=jnp.zeros((1, 64, 3))), sts.Sensor())
    with pytest.raises(ValueError, match=r"vertices has values that are not finite \(1 of"):
        physics.place(dataclasses.replace(bodies[0], vertices=bodies[0].vertices.at[3, 1].set(jnp.nan)), sts.Sensor())


def test_errors_name_arguments_of_place_of_another_type(bodies):
    sensor, place = sts.Sensor(), inspect.unwrap(physics.place)
    for given, message in (
        (("mug.obj", sensor), r"body is 'mug\.obj', but it must be one Body: .* objects\.load reads a mesh file"),
        ((sensor, bodies[0]), r"body is Sensor\(.*, but it must be one Body"),
        ((bodies[0], None), "sensor is None, but it must be a Sensor"),
    ):
        with pytest.raises(TypeError, match=message):
            place(*given)
    with pytest.raises(TypeError, match=r"`body`, .* is traced.* outside jit"):
        jax.eval_shape(lambda body: inspect.unwrap(physics.rest.stable_faces)(body), bodies[0])
