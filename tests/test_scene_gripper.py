"""`scene.gripper` against statics: what it holds, what it drops, and the forces of its fingers."""

import jax
import mujoco
import numpy as np
import pytest

import sts_jax as sts
from sts_jax import scene
from sts_jax.physics.forces import wrench

SENSOR = sts.Sensor.sized(0.04)
G = 9.81
CLOSED, LIFTED = 500, 1000  # steps of 1 ms


def with_pads(spec):
    """Compile the gripper with a sensor at each tip, and return the model and the data of `home`."""
    for side in ("left", "right"):
        scene.attach(spec, f"{side}_tip", SENSOR, name=side)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    return model, data


def lift(model, data, by=0.04):
    """Close the fingers, and lift the object by `by` (m)."""
    opening, height = data.ctrl[1], data.ctrl[0]
    for step in range(CLOSED + LIFTED):
        data.ctrl[1] = opening * max(0, 1 - step / (0.8 * CLOSED))
        data.ctrl[0] = height + by * np.clip((step - CLOSED) / (0.6 * LIFTED), 0, 1)
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)


def test_home_has_the_open_gripper_around_an_object_at_rest():
    body = sts.objects.make(jax.random.key(0), "bottle")
    model, data = with_pads(scene.gripper(SENSOR, body, mass=0.2, opening=0.08, position=(0.01, -0.005), yaw=0.4))
    left, right = data.site("left_tip"), data.site("right_tip")
    np.testing.assert_allclose([left.xpos, right.xpos], [[-0.04, 0, 0.022], [0.04, 0, 0.022]], atol=1e-12)
    for tip, inwards in ((left, 1), (right, -1)):
        x, y, z = tip.xmat.reshape(3, 3).T
        np.testing.assert_allclose([y, z], [[0, 0, -1], [inwards, 0, 0]], atol=1e-12)
        np.testing.assert_allclose(np.cross(x, y), z, atol=1e-12)
    com = data.body("object").xpos + data.body("object").xmat.reshape(3, 3) @ np.asarray(body.shell_com)
    np.testing.assert_allclose(data.body("object").xipos, com, atol=1e-7)
    np.testing.assert_allclose(model.qpos0, data.qpos, atol=1e-12)  # new data are open too
    before = data.qpos.copy()
    mujoco.mj_step(model, data, 200)
    np.testing.assert_allclose(data.qpos, before, atol=1e-4)
    assert float(model.body("object").mass[0]) == pytest.approx(0.2)


@pytest.mark.parametrize("name", ["box", "bottle", "camera"])
def test_fingers_press_with_the_grip_force_and_carry_the_weight(name):
    body = None if name == "box" else sts.objects.make(jax.random.key(0), name)
    turn = np.pi / 2 if name == "camera" else 0.0
    model, data = with_pads(scene.gripper(SENSOR, body, mass=0.12, friction=0.5, grip=6.0, yaw=turn))
    lift(model, data)
    forces = np.zeros((50, 2, 3))
    for moment in forces:  # stiff contacts of a hull come and go, which moves the normal forces by a few per cent
        mujoco.mj_step(model, data)
        moment[:] = [wrench(model, data, side, f"{side}_tip")[:3] for side in ("left", "right")]
    np.testing.assert_allclose(forces[..., 2].mean(axis=0), 6, rtol=0.01)
    np.testing.assert_allclose(forces[..., 2], 6, rtol=0.1)
    np.testing.assert_allclose(-forces[..., 1].sum(axis=1), 0.12 * G, rtol=0.02)
    assert data.qpos[0] - 0.022 == pytest.approx(0.04, abs=2e-3)
    np.testing.assert_allclose(data.qpos[1], data.qpos[2], atol=2e-5)


def test_a_mean_over_twenty_steps_steadies_force_and_place_of_a_chattering_contact():
    body = sts.objects.make(jax.random.key(0), "camera")
    model, data = with_pads(scene.gripper(SENSOR, body, mass=0.12, friction=0.5, grip=6.0, yaw=np.pi / 2))
    lift(model, data)
    rows = np.zeros((600, 2, 6))
    for row in rows:
        mujoco.mj_step(model, data)
        row[:] = [wrench(model, data, side, f"{side}_tip") for side in ("left", "right")]
    spread = []
    for number in (1, 20):
        mean = np.stack([rows[end - number : end].mean(axis=0) for end in range(20, len(rows))])
        force, place = mean[..., 2], mean[..., 3:5] / mean[..., 2:3]
        spread.append([force.std(axis=0).max(), np.linalg.norm(place.std(axis=0), axis=-1).max()])
    momentary, averaged = spread
    assert momentary[0] > 0.02 * 6  # N
    assert averaged[0] < momentary[0] / 5
    assert averaged[1] < momentary[1] / 5


@pytest.mark.parametrize(("share", "held"), [(0.9, True), (1.1, False)])
def test_a_lift_holds_if_friction_carries_the_weight(share, held):
    """Two fingers carry at most 2 mu F."""
    mass = share * 2 * 0.5 * 4.0 / G
    model, data = with_pads(scene.gripper(SENSOR, mass=mass, friction=0.5, grip=4.0))
    lift(model, data, by=0.02)
    assert (data.body("object").xpos[2] > 0.025 + 0.015) == held


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mass": 0.0}, "mass is 0.0, but it must be > 0"),
        ({"friction": float("nan")}, "friction is nan"),
        ({"grip": -1.0}, "grip is -1.0"),
        ({"opening": 0.02}, "opening is 0.02 m, but the object reaches from x = -0.015 to 0.015 m"),
        ({"position": (0.05, 0.0)}, "it must be more than 0.130 m"),
        ({"height": 0.01}, "height is 0.01 m, but it must be from 0.02 m"),
    ],
)
def test_bad_arguments_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        scene.gripper(SENSOR, **options)
