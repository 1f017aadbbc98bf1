"""`scene.attach` and `View.wrenches` against statics, `physics.wrench`, and what `physics.simulate` recorded."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import physics_scenes
import pytest

import sts_jax as sts
from sts_jax import physics, scene
from sts_jax.physics.scene import mjx
from sts_jax.scene.pad import SLOTS

SENSOR = sts.Sensor(gel=sts.tactile.Gel(cells=(50, 50)))
SMALL = dataclasses.replace(SENSOR, gel=dataclasses.replace(SENSOR.gel, size=(0.04, 0.04)))
G = 9.81
OPTION = '<option cone="elliptic" impratio="10" timestep="0.001"/>'


def specification(objects: str, finger: str = "") -> mujoco.MjSpec:
    """A site `floor` on the world, objects, and a site `tip` on a fixed body after them."""
    return mujoco.MjSpec.from_string(f"""
    <mujoco>{OPTION}<worldbody><site name="floor"/>{objects}
    <body name="finger" pos=".2 0 0" euler="0 0 30">{finger}<site name="tip"/></body></worldbody></mujoco>""")


def settled(model: mujoco.MjModel, steps: int) -> mujoco.MjData:
    data = mujoco.MjData(model)
    for _ in range(steps):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    return data


def resting(name: str, x: float, shape: str, mass: float = 0.1) -> str:
    geom = f'<geom {shape} mass="{mass}" condim="6"/>'
    return f'<body name="{name}" pos="{x} 0 .0199" euler="0 0 20"><freejoint/>{geom}</body>'


@pytest.fixture(scope="module")
def crowd() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A ball and a block on each of two pads. The geoms of one pad are numbered before theirs, of the other after."""
    shapes = {"ball": 'type="sphere" size=".02"', "block": 'type="box" size=".02 .015 .02"'}
    objects = "".join(
        resting(f"{kind}_{pad}", x + side, shape, mass)
        for pad, x in (("floor", 0), ("tip", 0.2))
        for kind, side, shape, mass in (("ball", -0.04, shapes["ball"], 0.1), ("block", 0.03, shapes["block"], 0.2))
    )
    spec = specification(objects)
    scene.attach(spec, "floor", SENSOR, name="floor")
    scene.attach(spec, "tip", SENSOR, name="pad")
    model = spec.compile()
    return model, settled(model, 300)


def test_wrenches_equal_those_of_the_contacts_in_both_engines(crowd):
    model, data = crowd
    view = scene.View(model, {"floor": SENSOR, "pad": SENSOR})
    mjx_model, forward = mjx.put_model(model), jax.jit(mjx.forward)
    in_mjx = forward(mjx_model, mjx.put_data(model, data))
    for m, d in ((model, data), (mjx_model, in_mjx)):
        wrenches = view.wrenches(d)
        for pad, objects in (("floor", ("ball_floor", "block_floor")), ("pad", ("ball_tip", "block_tip"))):
            felt = wrenches[pad]
            np.testing.assert_allclose(sum(felt.values()), physics.wrench(m, d, pad, pad), atol=2e-5)
            for name, mass in zip(objects, (0.1, 0.2), strict=True):
                np.testing.assert_allclose(felt[name][2], mass * G, rtol=0.02)
            assert all(not np.any(wrench) for name, wrench in felt.items() if name not in objects)
    for depth in (0.002, 0.0045, 0.006, 0.0095):  # of a gel of 5 mm
        deep = mujoco.MjData(model)
        deep.qpos[:] = data.qpos - depth * np.tile([0, 0, 1, 0, 0, 0, 0], 4)
        mujoco.mj_forward(model, deep)
        for m, d in ((model, deep), (mjx_model, forward(mjx_model, mjx.put_data(model, deep)))):
            for pad, felt in view.wrenches(d).items():
                np.testing.assert_allclose(sum(felt.values()), physics.wrench(m, d, pad, pad), rtol=1e-4, atol=1e-3)
                assert sum(felt.values())[2] > 10


def test_a_ball_that_falls_deep_into_a_soft_pad_is_pushed_out_at_every_moment():
    small = sts.Sensor.sized(0.04)
    spec = specification('<body pos="0 0 .04"><freejoint/><geom type="sphere" size=".02" mass=".1" condim="6"/></body>')
    scene.attach(spec, "floor", small, name="pad", press=scene.Press(force=5.0, area=4e-4, mass=0.1))
    model = spec.compile()
    view, data, deepest = scene.View(model, {"pad": small}), mujoco.MjData(model), 0.0
    for _ in range(120):
        mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        felt = view.wrenches(data)["pad"]["body 1"]
        np.testing.assert_allclose(felt, physics.wrench(model, data, "pad", "pad"), rtol=1e-4, atol=1e-4)
        deepest = min(deepest, *data.contact.dist, 0.0)
    assert deepest < -1.9 * float(small.gel.thickness)


def test_a_block_on_a_tilted_pad_is_held_by_friction():
    geom = '<geom name="block" type="box" size=".02 .02 .03" mass=".3" friction=".9"/>'
    spec = specification(f'<body pos="0 0 .03"><freejoint/>{geom}</body>')
    spec.option.gravity = [0, G * np.sin(0.3), -G * np.cos(0.3)]
    scene.attach(spec, "floor", SENSOR, name="pad")
    model = spec.compile()
    wrench = scene.View(model, {"pad": SENSOR}).wrenches(settled(model, 500))["pad"]["body 1"]
    force = 0.3 * G * np.array([0, -np.sin(0.3), np.cos(0.3)])
    np.testing.assert_allclose(wrench[:3], force, atol=0.01 * 0.3 * G)
    # The force that balances the weight of the block acts through its centre, 30 mm above the pad.
    np.testing.assert_allclose(wrench[3:], np.cross([0, 0, 0.03], force), atol=0.01 * 0.03 * 0.3 * G)


def test_a_cube_between_two_pads_is_squeezed_equally_and_carried():
    spec = scene.gripper(SMALL, mass=0.15, friction=0.9, grip=8.0)
    for side in ("left", "right"):
        scene.attach(spec, f"{side}_tip", SMALL, name=side)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.ctrl[1] = 0
    for step in range(1500):
        data.ctrl[0] = model.key_ctrl[0, 0] + 0.03 * np.clip((step - 400) / 600, 0, 1)
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    wrenches = scene.View(model, {"left": SMALL, "right": SMALL}).wrenches(data)
    left, right = (np.asarray(wrenches[side]["object"]) for side in ("left", "right"))
    np.testing.assert_allclose(left[2], right[2], rtol=0.02)
    np.testing.assert_allclose(left[2], 8.0, rtol=0.02)
    np.testing.assert_allclose(-(left[1] + right[1]), 0.15 * G, rtol=0.02)  # y points down


@pytest.fixture(scope="module")
def recorded() -> tuple[sts.objects.Body, physics.Trajectory]:
    """A block that has come to rest on the pad."""
    body = physics_scenes.solid_block(np.array([0.02, 0.015, 0.01]), 0.08)
    scenario = physics.Freefall(frames=40)
    return body, physics.simulate(jax.random.key(0), body, SENSOR, scenario)


@pytest.mark.slow
def test_the_pad_of_simulate_rebuilt_gives_the_recorded_wrench_and_frames(recorded):
    body, trajectory = recorded
    pose, recorded_wrench = (np.asarray(x[0, -1], np.float64) for x in (trajectory.pose, trajectory.wrench))
    mass, com, inertia = physics_scenes.rigid([body], trajectory, 0)
    points = np.unique(np.asarray(body.hulls, np.float64).reshape(-1, 3), axis=0)
    spec = specification(
        f"""<body name="object" pos="{" ".join(map(str, pose[:3]))}" quat="{" ".join(map(str, pose[3:]))}"><freejoint/>
        <inertial pos="{" ".join(map(str, com))}" mass="{mass}"
         fullinertia="{" ".join(str(inertia[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))}"/>
        <geom type="mesh" mesh="hull" friction="{float(trajectory.hidden.friction[0])}"/></body>"""
    )
    spec.add_mesh(name="hull", uservert=points.ravel())
    constants = physics.Contact()
    spec.option.timestep, spec.option.impratio = constants.timestep, constants.impratio
    spec.option.gravity = trajectory.gravity[0, -1]
    scene.attach(spec, "floor", SENSOR, name="pad")
    model = spec.compile()
    data = settled(model, 100)
    view = scene.View(model, {"pad": SENSOR}, bodies={"object": body})
    in_mjx = jax.jit(mjx.forward)(mjx.put_model(model), mjx.put_data(model, data))
    for d in (data, in_mjx):
        wrench = view.wrenches(d)["pad"]["object"]
        np.testing.assert_allclose(wrench, recorded_wrench, atol=0.01 * recorded_wrench[2])
        frame = view(d, resolution=(32, 32))["pad"]
        now = np.concatenate([data.qpos[:3], data.qpos[3:7]])
        expected = sts.sense(SENSOR, body, jnp.asarray(now, jnp.float32), wrench, resolution=(32, 32))
        np.testing.assert_allclose(frame.depth, expected.depth, atol=1e-6)
        np.testing.assert_allclose(frame.visual, expected.visual, atol=2e-3)
        np.testing.assert_allclose(frame.tactile, expected.tactile, atol=2e-3)
        as_recorded = sts.sense(SENSOR, body, trajectory.pose[0, -1], trajectory.wrench[0, -1], resolution=(32, 32))
        np.testing.assert_allclose(frame.tactile, as_recorded.tactile, atol=0.02)


@pytest.mark.parametrize(("force", "side", "mass"), [(2.0, 0.03, 0.2039), (0.5, 0.024, 0.05097)])
def test_a_press_sinks_as_deep_in_the_physics_as_in_the_picture(force, side, mass):
    geom = f'<geom type="box" size="{side / 2} {side / 2} .02" mass="{mass}"/>'
    spec = specification(f'<body name="block" pos="0 0 .0199"><freejoint/>{geom}</body>')
    scene.attach(spec, "floor", SENSOR, name="pad", press=scene.Press(force=force, area=side**2, mass=mass))
    model = spec.compile()
    data = settled(model, 2000)
    depth = mass * G / (SENSOR.gel.stiffness * side**2)
    np.testing.assert_allclose(0.02 - data.qpos[2], depth, rtol=0.02)
    frame = scene.View(model, {"pad": SENSOR})(data, resolution=(32, 32))["pad"]
    drawn = SENSOR.camera.distance - frame.depth[frame.segmentation].min()
    np.testing.assert_allclose(drawn, 0.02 - data.qpos[2], rtol=0.05)


def test_the_pads_constants_count_whatever_the_object_has():
    geom = '<geom name="ball" size=".02" solref=".05 1" solimp=".5 .6 .1" friction=".3"/>'
    spec = specification(f'<body pos="0 0 .02"><freejoint/>{geom}</body><geom name="else" pos="0 0 -1" size=".1"/>')
    spec.geom("else").priority = 3
    scene.attach(spec, "floor", SENSOR, name="pad")
    scene.attach(spec, "tip", SENSOR, name="rough", friction=0.8)
    model = spec.compile()
    data, constants = mujoco.MjData(model), physics.Contact()
    for pad, friction in (("pad", 0.3), ("rough", 0.8)):
        data.qpos[:3] = 0.2 * (pad == "rough"), 0, 0.0199
        mujoco.mj_forward(model, data)
        assert data.ncon == 1
        contact = data.contact[0]
        assert contact.dim == 6
        np.testing.assert_allclose(contact.friction[0], friction)
        np.testing.assert_allclose(contact.solref, [constants.time_constant, constants.damping_ratio], rtol=1e-4)
        np.testing.assert_allclose(contact.solimp[:3], [constants.soft, constants.hard, constants.width], rtol=1e-2)


def test_the_site_may_have_any_frame_and_both_pads_of_a_closed_gripper_are_measured():
    spec = mujoco.MjSpec.from_string(f"""
    <mujoco>{OPTION}<worldbody>
      <body name="a"><joint type="slide" axis="0 0 1"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
        <frame pos=".1 0 0" euler="0 90 0"><site name="a_tip" pos="0 .01 .02" euler="0 0 45"/></frame></body>
      <body name="b" pos=".13 .01 0" euler="0 -90 0"><site name="b_tip" pos="0 0 .011"/></body>
    </worldbody></mujoco>""")
    scene.attach(spec, "a_tip", SMALL, name="a")
    scene.attach(spec, "b_tip", SMALL, name="b")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for name in ("a", "b"):
        np.testing.assert_allclose(data.site(name).xpos, data.site(f"{name}_tip").xpos, atol=1e-12)
        np.testing.assert_allclose(data.site(name).xmat, data.site(f"{name}_tip").xmat, atol=1e-12)
    view = scene.View(model, {"a": SMALL, "b": SMALL})
    wrenches = view.wrenches(data)
    force = np.asarray(wrenches["a"]["b"])
    assert force[2] > 1
    np.testing.assert_allclose(force, physics.wrench(model, data, "a", "a"), atol=1e-3 * force[2])
    np.testing.assert_allclose(wrenches["b"]["a"], physics.wrench(model, data, "b", "b"), atol=1e-3 * force[2])


@pytest.mark.parametrize(
    "default", ["", '<geom euler="0 90 0" fromto="0 0 0 0 0 1" mesh="x"/><site pos="1 1 1" euler="9 9 9"/>']
)
def test_a_site_of_an_attached_robot_keeps_its_units_and_defaults_do_not_turn_the_pad(default):
    robot = mujoco.MjSpec.from_string(f"""
    <mujoco><compiler angle="radian" eulerseq="ZYX"/><default><default class="robot">{default}</default></default>
    <worldbody><body name="hand" childclass="robot" euler=".1 .2 .3"><frame euler="0 .5 0" pos=".1 0 0">
    <site name="tip" pos="0 .1 0" euler="0 1.2 .3"/></frame></body></worldbody></mujoco>""")
    spec = specification("")
    spec.attach(robot, prefix="robot_", frame=spec.worldbody.add_frame())
    scene.attach(spec, "robot_tip", SMALL, name="pad")
    for model in (spec.compile(), mujoco.MjModel.from_xml_string(spec.to_xml())):
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        site, thickness = data.site("robot_tip"), SMALL.gel.thickness
        axes = site.xmat.reshape(3, 3)
        for part, depth in ((data.site("pad"), 0), (data.geom("pad"), thickness / 2)):
            np.testing.assert_allclose(part.xmat, site.xmat, atol=1e-6)
            np.testing.assert_allclose(part.xpos, site.xpos - depth * axes[:, 2], atol=1e-6)
        np.testing.assert_allclose(2 * model.geom("pad").size, [0.04, 0.04, thickness], rtol=1e-6)


def test_sensors_store_all_contacts_that_mujoco_finds(crowd):
    model, data = crowd
    found = np.concatenate([data.sensor(i).data[::17] for i in range(model.nsensor)])
    assert 0 < found.max() <= SLOTS


def test_a_press_of_a_signed_distance_field_is_felt_whole():
    corners = " ".join(f"{x} {y} {z}" for x in (-0.02, 0.02) for y in (-0.02, 0.02) for z in (-0.02, 0.02))
    spec = mujoco.MjSpec.from_string(f"""<mujoco>{OPTION}<asset><mesh name="cube" vertex="{corners}"/></asset>
    <worldbody><site name="floor"/><body name="cube" pos="0 0 .0199"><freejoint/>
    <geom type="sdf" mesh="cube" mass=".1" condim="6"/></body></worldbody></mujoco>""")
    scene.attach(spec, "floor", SENSOR, name="floor")
    model = spec.compile()
    data = settled(model, 300)
    force = scene.View(model, {"floor": SENSOR}).wrenches(data)["floor"]["cube"]
    np.testing.assert_allclose(force, physics.wrench(model, data, "floor", "floor"), atol=1e-3)
    assert data.sensor(0).data[0] > SLOTS  # contacts that were found


REFUSED = {
    "a site that does not exist": ({"site": "tpi"}, "no site 'tpi', only 'floor', 'line', 'tip'"),
    "a site between two points": ({"site": "line"}, "the site 'line' is given by fromto"),
    "a name that is taken": ({"name": "ball"}, "has a geom or a site 'ball' already"),
    "negative friction": ({"friction": -0.1}, "friction must be >= 1e-05"),
    "a press that is too deep": (
        {"press": scene.Press(50.0, 1e-4, 0.1)},
        "sinks 250 mm deep, but gel.max_depth is 3 mm",
    ),
    "a press without area": ({"press": scene.Press(1.0, 0.0, 0.1)}, "press.area must be > 0"),
    "an invalid sensor": (
        {"sensor": dataclasses.replace(SENSOR, gel=dataclasses.replace(SENSOR.gel, stiffness=-1.0))},
        "gel.stiffness",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_arguments_of_attach_are_named(case):
    changed, message = REFUSED[case]
    line = '<site name="line" type="capsule" size=".01" fromto="0 0 0 1 0 0"/>'
    spec = specification(f'<body><freejoint/><geom name="ball" size=".02"/>{line}</body>')
    arguments = {"site": "tip", "sensor": SENSOR, "name": "pad"} | changed
    with pytest.raises(ValueError, match=message):
        scene.attach(spec, arguments.pop("site"), arguments.pop("sensor"), **arguments)
    assert spec.geom("pad") is None
