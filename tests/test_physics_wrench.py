"""`physics.wrench` against MuJoCo's generalised forces and MuJoCo's own sensors."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sts_jax import physics
from sts_jax.physics.scene import mjx

KINDS = [("pyramidal", 1), ("pyramidal", 3), ("pyramidal", 4), ("pyramidal", 6)]
KINDS += [("elliptic", 3), ("elliptic", 4), ("elliptic", 6)]


def moving(cone: str, condim: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A box whose centre of mass is off its middle, and a ball: they slide, roll and spin on a plane, and touch."""
    model = mujoco.MjModel.from_xml_string(f"""
    <mujoco>
      <option cone="{cone}" timestep="0.001" impratio="10"/>
      <default><geom condim="{condim}" friction="0.8 0.02 0.005" solref="0.01 1"/></default>
      <worldbody>
        <geom name="plane" type="plane" size="1 1 .1"/>
        <body name="box" pos="0 0 .02">
          <freejoint/>
          <inertial pos=".01 -.005 0" mass=".3" diaginertia="1e-4 1e-4 1e-4"/>
          <geom name="box" type="box" size=".03 .03 .02"/>
          <site name="tilted" pos=".01 .02 .03" euler="30 -40 70"/>
        </body>
        <body name="ball" pos=".2 0 .03">
          <freejoint/>
          <geom name="ball" type="sphere" size=".03" mass=".1"/>
        </body>
      </worldbody>
    </mujoco>""")
    data = mujoco.MjData(model)
    data.qpos[:3], data.qpos[7:10] = [0.1, -0.05, 0.0199], [0.1599, -0.04, 0.0299]
    data.qvel[:] = [0.3, -0.2, -0.05, 0.4, -0.3, 2.0, -0.4, 0.3, -0.05, 3.0, 5.0, -4.0]
    mujoco.mj_forward(model, data)
    assert data.ncon >= 6
    return model, data


@pytest.mark.slow
@pytest.mark.parametrize(("cone", "condim"), KINDS)
def test_all_contacts_of_a_free_body_are_its_constraint_force_in_both_engines(cone, condim):
    model, data = moving(cone, condim)
    mjx_model = mjx.put_model(model)
    in_mjx = jax.jit(mjx.forward)(mjx_model, mjx.put_data(model, data))
    for own, others, at in (("box", ["plane", "ball"], 0), ("ball", ["plane", 1], 6)):
        pose = data.qpos[at // 6 * 7 :][:7]
        turn = Rotation.from_quat(pose[3:], scalar_first=True)
        for d, m, tolerance in ((data, model, 1e-10), (in_mjx, mjx_model, 1e-5)):
            force = np.asarray(d.qfrc_constraint)[at : at + 6]
            expected = np.concatenate([force[:3], turn.apply(force[3:])])  # the free joint's moments are in its frame
            size = np.abs(expected).max()
            assert size > 0.1
            frame = np.array([*pose[:3], 1, 0, 0, 0])
            np.testing.assert_allclose(physics.wrench(m, d, others, frame), expected, atol=tolerance * size)
            np.testing.assert_allclose(physics.wrench(m, d, own, frame), -expected, atol=tolerance * size)
    truth = physics.wrench(model, data, "plane")
    batch = jax.vmap(lambda d: physics.wrench(mjx_model, d, "plane"))(jax.tree.map(lambda x: x[None], in_mjx))
    np.testing.assert_allclose(batch[0], truth, atol=2e-3 * np.abs(truth).max())


def test_contacts_among_the_geoms_do_not_count_and_actions_equal_reactions():
    model, data = moving("elliptic", 6)
    pair = physics.wrench(model, data, ["box", "ball"])
    np.testing.assert_allclose(pair, -physics.wrench(model, data, "plane"), atol=1e-12)
    alone = physics.wrench(model, data, "box") + physics.wrench(model, data, "ball")
    np.testing.assert_allclose(pair, alone, atol=1e-12)
    np.testing.assert_array_equal(physics.wrench(model, data, [0, 1, 2]), 0)


def test_a_site_and_its_pose_are_the_same_frame_and_move_the_moment():
    model, data = moving("elliptic", 4)
    site = data.site("tilted")
    turn = Rotation.from_matrix(site.xmat.reshape(3, 3))
    pose = np.concatenate([site.xpos, turn.as_quat(scalar_first=True)])
    force, moment = np.split(physics.wrench(model, data, "plane"), 2)
    expected = np.concatenate([turn.inv().apply(force), turn.inv().apply(moment - np.cross(site.xpos, force))])
    np.testing.assert_allclose(physics.wrench(model, data, "plane", pose), expected, atol=1e-12)
    np.testing.assert_allclose(physics.wrench(model, data, "plane", "tilted"), expected, atol=1e-12)
    m, d = mjx.put_model(model), mjx.put_data(model, data)
    size = np.abs(expected).max()
    for frame in ("tilted", jnp.asarray(pose, jnp.float32)):
        np.testing.assert_allclose(physics.wrench(m, d, "plane", frame), expected, atol=1e-5 * size)


def test_a_body_that_sleeps_has_no_contacts_to_be_summed():
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><option><flag sleep="enable"/></option><worldbody><geom name="pad" type="plane" size="1 1 1"/>
    <body pos="0 0 .0201"><freejoint/><geom type="box" size=".01 .01 .02" mass=".1"/></body></worldbody></mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 50)
    np.testing.assert_allclose(physics.wrench(model, data, "pad")[2], 0.981, rtol=0.01)
    mujoco.mj_step(model, data, 1950)
    with pytest.raises(ValueError, match="sleeping bodies"):
        physics.wrench(model, data, "pad")


def test_the_moment_has_a_gradient_in_the_frame():
    model, data = moving("elliptic", 3)
    m, d = mjx.put_model(model), mjx.put_data(model, data)
    force = physics.wrench(m, d, "plane")[:3]
    frame = jnp.array([0.01, 0.02, 0.03, 1, 0, 0, 0])
    slope = jax.jit(jax.jacobian(lambda pose: physics.wrench(m, d, "plane", pose)))(frame)[3:, :3]
    np.testing.assert_allclose(slope @ jnp.array([1.0, 2, 3]), -jnp.cross(jnp.array([1.0, 2, 3]), force), rtol=1e-4)


@pytest.mark.parametrize(
    ("geoms", "frame", "message"),
    [
        ("table", None, "the model has no geom 'table'"),
        ([0, 7], None, "geoms contains 7, but the model has geoms 0 to 2"),
        ("box", "wrist", "the model has no site 'wrist'"),
        ("box", np.array([0, 0, 0, 2.0, 0, 0, 0]), "frame has a quaternion of length 2, but it must be 1"),
    ],
)
def test_what_does_not_exist_is_named(geoms, frame, message):
    model, data = moving("elliptic", 3)
    with pytest.raises(ValueError, match=message):
        physics.wrench(model, data, geoms, frame)
