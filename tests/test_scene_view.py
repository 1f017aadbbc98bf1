"""`scene.View` against embree, mirror images, single frames, and bad input."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import sts_jax as sts
from sts_jax import scene
from sts_jax.physics.scene import mjx
from sts_jax.scene import geometry

SENSOR = sts.Sensor(gel=sts.tactile.Gel(cells=(50, 50)))
SMALL = dataclasses.replace(SENSOR, gel=dataclasses.replace(SENSOR.gel, size=(0.04, 0.04)))
SIZE = (32, 32)

STEP = '<option timestep="0.001"/>'


def compiled(
    objects: str, sensor: sts.Sensor = SENSOR, finger: str = "", asset: str = "", option: str = ""
) -> mujoco.MjModel:
    """Objects above a pad on the world, and a finger without pad."""
    spec = mujoco.MjSpec.from_string(f"""
    <mujoco><option gravity="0 0 0" timestep="0.001">{option}</option><asset>{asset}</asset><worldbody>
    <site name="tip"/>{objects}
    <body name="finger" pos=".5 0 0">{finger}<site name="finger_tip"/></body></worldbody></mujoco>""")
    scene.attach(spec, "tip", sensor, name="pad")
    return spec.compile()


def forward(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


OBJECTS = {  # position, rotation vector, geom, the same shape by trimesh
    "ball": ((-0.03, -0.02, 0.0199), (0, 0, 0), 'type="sphere" size=".02"', trimesh.creation.icosphere(5, 0.02)),
    "rod": (
        (0.03, -0.03, 0.04),
        (0.5, 0.3, 0.2),
        'type="capsule" size=".01 .02"',
        trimesh.creation.capsule(0.04, 0.01, count=[64, 64]),
    ),
    "can": (
        (-0.03, 0.03, 0.05),
        (1.1, -0.4, 0.3),
        'type="cylinder" size=".015 .02" contype="0" conaffinity="0"',  # MJX has no collision with the pad
        trimesh.creation.cylinder(0.015, 0.04, sections=96),
    ),
    "block": (
        (0.025, 0.03, 0.05),
        (0.7, 0.4, -0.8),
        'type="box" size=".02 .01 .015"',
        trimesh.creation.box((0.04, 0.02, 0.03)),
    ),
    "egg": (
        (0.0, 0.0, 0.06),
        (0.2, 0.9, 0.1),
        'type="ellipsoid" size=".01 .02 .015" contype="0" conaffinity="0"',
        trimesh.creation.icosphere(5, 1.0).apply_scale((0.01, 0.02, 0.015)),
    ),
    "sheet": ((0.0, 0.0, 0.1), (np.pi, 0, 0), 'type="plane" size=".2 .2 .1"', None),
    # In the housing of the sensor, where nothing is seen
    "wire": ((0.0, 0.0, -0.03), (0, 0, 0), 'type="box" size=".05 .05 .001"', trimesh.creation.box((0.1, 0.1, 0.002))),
}
MODEL_OF_OBJECTS = "".join(
    f'<body name="{name}" pos="{" ".join(map(str, place))}" '
    f'quat="{" ".join(map(str, Rotation.from_rotvec(turn).as_quat(scalar_first=True)))}">'
    f'{"" if name == "sheet" else "<freejoint/>"}<geom name="{name}" {geom}/></body>'
    for name, (place, turn, geom, _) in OBJECTS.items()
)


@pytest.fixture(scope="module")
def objects() -> tuple[mujoco.MjModel, mujoco.MjData, scene.View, sts.Frame]:
    model = compiled(MODEL_OF_OBJECTS)
    data, view = forward(model), scene.View(model, {"pad": SENSOR})
    return model, data, view, view(data, resolution=SIZE)["pad"]


def test_primitives_have_the_depth_that_embree_finds(objects):
    _, _, view, frame = objects
    assert view.bodies == tuple(OBJECTS)
    meshes = []
    for number, (_, _, _, mesh) in enumerate(OBJECTS.values()):
        if mesh is None:
            mesh = trimesh.Trimesh([[-0.2, -0.2, 0], [0.2, -0.2, 0], [0.2, 0.2, 0], [-0.2, 0.2, 0]], [[0, 1, 2, 3]])
        placed = mesh.copy()
        pose = np.asarray(frame.pose[number], np.float64)  # as drawn: the ball has sunk in
        placed.apply_transform(np.asarray(sts.geometry.pose_to_matrix(pose)))
        meshes.append(placed)
    first = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)])
    slopes = sts.optics.rays(SENSOR.camera, frame.window, SIZE)
    ray = np.stack([*(np.asarray(slope, np.float64).ravel() for slope in slopes), np.ones(SIZE[0] * SIZE[1])], axis=1)
    start = np.zeros((len(ray), 3))
    together = trimesh.util.concatenate(meshes)
    start[:, 2] = -float(SENSOR.gel.thickness)
    start[:, :2] = ray[:, :2] * (start[0, 2] + float(SENSOR.camera.distance))
    place, number, face = together.ray.intersects_location(start, ray, multiple_hits=False)
    depth, body = np.full(len(ray), np.inf), np.full(len(ray), -1)
    depth[number] = place[:, 2] + float(SENSOR.camera.distance)
    body[number] = np.searchsorted(first, face, side="right") - 1
    same = body == np.asarray(frame.body).ravel()
    assert (~same).mean() < 0.01  # pixels at an edge
    assert {*np.unique(body)} - {-1} == {*range(len(OBJECTS) - 1)}  # all but the last one
    error = np.abs(np.asarray(frame.depth).ravel() - depth)[same & (body >= 0)]
    assert np.quantile(error, 0.95) < 1e-4
    np.testing.assert_array_equal(frame.segmentation, frame.body >= 0)


def test_what_touches_leaves_an_imprint_and_what_does_not_leaves_none(objects):
    _, _, view, frame = objects
    wrenches = view.wrenches(objects[1])["pad"]
    assert wrenches["ball"][2] > 0.1
    assert not np.any(np.stack([wrench for name, wrench in wrenches.items() if name != "ball"]))
    force = np.sum(frame.pressure) * sts.tactile.gel.cell_area(SENSOR.gel)
    np.testing.assert_allclose(force, wrenches["ball"][2], rtol=0.01)
    np.testing.assert_array_equal(frame.balanced, True)
    np.testing.assert_allclose(frame.pose[1:, :3], [place for place, *_ in list(OBJECTS.values())[1:]], atol=1e-6)


def test_given_wrenches_replace_those_of_the_data(objects):
    _, data, view, frame = objects
    wrenches = view.wrenches(data)
    half = jax.tree.map(lambda wrench: wrench / 2, wrenches)
    np.testing.assert_array_equal(view(data, wrenches=wrenches, resolution=SIZE)["pad"].tactile, frame.tactile)
    flatter = view(data, wrenches=half, resolution=SIZE)["pad"]
    np.testing.assert_allclose(flatter.pressure.sum(), frame.pressure.sum() / 2, rtol=0.01)
    for bad in ({}, {"pad": {}}, {"other": wrenches["pad"]}):
        with pytest.raises(
            ValueError, match=r"wrenches must have the pads \['pad'\], and for the pad 'pad' the bodies"
        ):
            view(data, wrenches=bad)


@pytest.mark.slow
@pytest.mark.parametrize("impl", ["jax", "warp"])
def test_a_batch_of_mjx_data_under_jit_gives_the_same_frames(objects, impl):
    model, data, view, frame = objects
    moved = forward(model)
    moved.qpos[:3] += [0.01, 0, 0]
    mujoco.mj_forward(model, moved)
    if impl == "warp":
        pytest.importorskip("warp")  # not a dependency: pip install warp-lang
        placed = jax.vmap(lambda qpos: mjx.make_data(model, impl=impl).replace(qpos=qpos))
        batch = placed(jnp.asarray([data.qpos, moved.qpos], jnp.float32))
        batch = jax.jit(jax.vmap(mjx.forward, (None, 0)))(mjx.put_model(model, impl=impl), batch)
    else:
        batch = jax.tree.map(lambda *x: jnp.stack(x), *[mjx.put_data(model, one) for one in (data, moved)])
    frames = jax.jit(jax.vmap(functools.partial(view, resolution=SIZE)))(batch)["pad"]
    for index, expected in enumerate((frame, view(moved, resolution=SIZE)["pad"])):
        np.testing.assert_allclose(frames.visual[index], expected.visual, atol=1e-5)
        np.testing.assert_allclose(frames.tactile[index], expected.tactile, atol=1e-4)
        np.testing.assert_array_equal(frames.body[index], expected.body)
    assert np.abs(frames.tactile[0] - frames.tactile[1]).max() > 0.1


@pytest.mark.slow
def test_an_image_has_derivatives_with_respect_to_poses_and_wrenches(objects):
    model, data, view, frame = objects
    given = mjx.put_data(model, data)
    egg = model.body("egg").id
    mask = jnp.asarray(frame.body == view.bodies.index("egg"))

    def total(height, force):
        moved = given.replace(xpos=given.xpos.at[egg, 2].add(height), sensordata=given.sensordata * force)
        now = view(moved, resolution=SIZE)["pad"]
        return jnp.sum(now.pressure), jnp.sum(jnp.where(mask & (now.body >= 0), now.depth, 0))

    along_height, along_force = jax.jit(jax.grad(lambda *x: sum(total(*x)), argnums=(0, 1)))(0.0, 1.0)
    # The gel carries the force. It grows with the square of `force`, which scales the contact's axes too.
    force = 2 * view.wrenches(data)["pad"]["ball"][2] / sts.tactile.gel.cell_area(SENSOR.gel)
    np.testing.assert_allclose(along_force, force, rtol=0.01)
    step = 2e-4
    slope = (total(step, 1.0)[1] - total(-step, 1.0)[1]) / (2 * step)
    np.testing.assert_allclose(along_height, slope, rtol=0.15)


@pytest.fixture(scope="module")
def gripper() -> tuple[mujoco.MjModel, scene.View]:
    spec = scene.gripper(SMALL, yaw=0.0)
    for side in ("left", "right"):
        scene.attach(spec, f"{side}_tip", SMALL, name=side)
    model = spec.compile()
    return model, scene.View(model, {"left": SMALL, "right": SMALL})


@pytest.mark.slow
def test_a_mirrored_scene_gives_mirrored_images(gripper):
    model = gripper[0]
    # The lamps of the room are not symmetric.
    room = dataclasses.replace(SMALL.room, colors=0 * SMALL.room.colors)
    view, frames = scene.View(model, dict.fromkeys(("left", "right"), dataclasses.replace(SMALL, room=room))), []
    for sign in (1, -1):
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.joint("left").qpos = data.joint("right").qpos = 0.02
        turn = Rotation.from_rotvec([0.2, 0.1 * sign, 0.3 * sign]).as_quat(scalar_first=True)
        data.joint("object").qpos = [0.004 * sign, 0.005, 0.02, *turn]
        mujoco.mj_forward(model, data)
        frames.append(view(data, resolution=SIZE))
    for name, mirrored in (("left", "right"), ("right", "left")):
        one, other = frames[0][name], frames[1][mirrored]
        np.testing.assert_allclose(one.depth, other.depth[:, ::-1], atol=2e-6)
        np.testing.assert_allclose(one.visual, other.visual[:, ::-1], atol=1e-3)
    assert np.abs(frames[0]["left"].depth - frames[0]["right"].depth[:, ::-1])[frames[0]["left"].body == 4].max() > 1e-3


@pytest.mark.slow
def test_each_finger_sees_the_other_one_but_not_itself(gripper):
    model, view = gripper
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    assert view.bodies == ("world", "hand", "left", "right", "object")
    for name, other in (("left", "right"), ("right", "left")):
        frame = view(data, resolution=SIZE)[name]
        seen = {view.bodies[number] for number in np.unique(frame.body) if number >= 0}
        assert other in seen
        assert name not in seen
        # The object hides the other pad, but not the finger above it.
        behind = SENSOR.camera.distance + 0.1 + SENSOR.gel.thickness
        np.testing.assert_allclose(frame.depth[frame.body == view.bodies.index(other)].min(), behind, atol=1e-6)
    alone = scene.View(model, dict.fromkeys(("left", "right"), SMALL), hide=["object"])
    frame = alone(data, resolution=SIZE)["left"]
    np.testing.assert_allclose(frame.depth[frame.body == alone.bodies.index("right")].min(), 0.1 + 0.1, atol=1e-6)


def test_the_pad_of_another_view_is_seen(gripper):
    assert scene.View(gripper[0], {"left": SMALL}, groups=[5]).bodies == ("right",)


def test_bodies_and_geoms_can_be_hidden(objects):
    view = scene.View(objects[0], {"pad": SENSOR}, hide=["wire", "sheet", "egg"])
    assert view.bodies == ("ball", "rod", "can", "block")
    assert scene.View(compiled(BALL + CLOTH), {"pad": SENSOR}, hide=["cloth"]).bodies == ("ball",)


@pytest.mark.slow
def test_a_body_can_replace_the_geoms_of_a_body(objects):
    model, data, view, frame = objects
    ball = geometry.body_of(model, [model.geom("block").id])
    replaced = scene.View(model, {"pad": SENSOR}, bodies={"block": ball, "egg": ball})
    assert replaced.bodies == view.bodies
    other = replaced(data, resolution=SIZE)["pad"]
    block, egg = (np.asarray(frame.body == view.bodies.index(name)) for name in ("block", "egg"))
    np.testing.assert_array_equal(
        other.depth[block & ~np.asarray(other.body == 4)], frame.depth[block & ~np.asarray(other.body == 4)]
    )
    assert np.abs(other.depth - frame.depth)[egg].max() > 1e-3


BALL = '<body name="ball" pos="0 0 .1"><freejoint/><geom name="ball" size=".02"/></body>'
CLOTH = (
    '<flexcomp name="cloth" type="grid" count="3 3 1" spacing=".01 .01 .01" pos="0 0 1" radius=".001">'
    '<edge equality="true"/></flexcomp>'
)
BODY = geometry.body_of(mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{BALL}</worldbody></mujoco>"), [0])


def late() -> mujoco.MjModel:
    """A model with a body that was added after `attach`."""
    spec = mujoco.MjSpec.from_string(f'<mujoco>{STEP}<worldbody><site name="tip"/>{BALL}</worldbody></mujoco>')
    scene.attach(spec, "tip", SENSOR, name="pad")
    body = spec.worldbody.add_body(name="late")
    body.add_freejoint()
    body.add_geom(name="late", size=[0.01, 0, 0])
    return spec.compile()


def on_finger(sensor: sts.Sensor, half: float, z: float = -0.015) -> mujoco.MjModel:
    geom = f'<geom type="box" size="{half} .02 .01" pos="0 0 {z}"/>'
    spec = mujoco.MjSpec.from_string(
        f'<mujoco>{STEP}<worldbody>{BALL}<body name="finger"><joint/>{geom}<site name="tip"/></body></worldbody>'
        "</mujoco>"
    )
    scene.attach(spec, "tip", sensor, name="pad")
    return spec.compile()


def test_a_body_beside_its_pad_and_a_long_time_step_are_named():
    geom = '<geom type="box" size=".02 .02 .01" pos="-.03 0 -.015"/>'
    for option, message in (
        ('timestep="0.001"', "the body 'finger' lies beside its pad 'pad', not behind it: turn the site"),
        (
            "",
            "the time step is 2 ms, at which the forces on the pad 'pad' jitter: set option.timestep to at most 1.5 ms",
        ),
    ):
        spec = mujoco.MjSpec.from_string(
            f'<mujoco><option {option}/><worldbody>{BALL}<body name="finger"><joint/>'
            f'{geom if option else ""}<site name="tip"/><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/></body>'
            "</worldbody></mujoco>"
        )
        scene.attach(spec, "tip", SMALL, name="pad")
        with pytest.warns(UserWarning, match=message):
            scene.View(spec.compile(), {"pad": SMALL})
    soft = mujoco.MjSpec.from_string(f'<mujoco><worldbody>{BALL}<site name="tip"/></worldbody></mujoco>')
    scene.attach(soft, "tip", SMALL, name="pad", press=scene.Press(force=1.0, area=4e-4, mass=0.1))
    scene.View(soft.compile(), {"pad": SMALL})  # no warning


def test_a_finger_that_collides_in_the_place_of_its_pad_is_named():
    sensors = {"sensors": {"pad": SMALL}}
    scene.View(on_finger(SMALL, 0.02, -0.0103), **sensors)  # behind the pad's face by 0.3 mm
    for z in (-0.01, -0.005):  # flush with it, and in front of it
        with pytest.warns(UserWarning, match="reaches to the face of its pad 'pad' and collides, too"):
            scene.View(on_finger(SMALL, 0.02, z), **sensors)


def without_faces() -> mujoco.MjModel:
    mesh = '<mesh name="shape" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/>'
    model = compiled('<body name="m"><geom name="m" type="mesh" mesh="shape"/></body>' + BALL, asset=mesh)
    model.mesh_facenum[:] = 0
    return model


INVALID = {
    "a model compiled before attach": (
        lambda: (mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{BALL}</worldbody></mujoco>"), {}),
        r"no pad 'pad': call scene.attach\(spec, site, sensor, name='pad'\) before spec.compile",
    ),
    "a plane without size": (
        lambda: (compiled(BALL + '<geom name="floor" type="plane" size="0 0 1" pos="0 0 -1"/>'), {}),
        "geom 'floor' is a plane without size",
    ),
    "a mesh without faces": (lambda: (without_faces(), {}), "geom 'm' uses the mesh 'shape', which has no faces"),
    "a body added after attach": (
        lambda: (late(), {}),
        "geom 'late' can touch the pad 'pad', but no sensor measures it",
    ),
    "a sensor larger than the finger": (
        lambda: (on_finger(SENSOR, 0.01), {}),
        r"the pad 'pad' measures 150 x 150 mm, but the body 'finger' .* only 20 x 40 mm there: .*sized\(0.02\)",
    ),
    "a site that points into the finger": (
        lambda: (on_finger(SMALL, 0.02, 0.011), {"sensors": {"pad": SMALL}}),
        r"the pad 'pad' faces its own body 'finger', which reaches 21 mm in front of the gel .*: turn the site",
    ),
    "another sensor than that of attach": (
        lambda: (compiled(BALL, SMALL), {}),
        "the pad 'pad' measures 40 x 40 x 5 mm, but its sensor has a gel of 150 x 150 x 5 mm",
    ),
    "a body that is pad and object": (
        lambda: (on_finger(SMALL, 0.02), {"bodies": {"finger": BODY}, "sensors": {"pad": SMALL}}),
        "name 'finger', but this body carries the pad 'pad'",
    ),
    "a body that does not exist": (
        lambda: (compiled(BALL), {"bodies": {"bal": BODY}}),
        "only the bodies 'world', 'ball'",
    ),
    "hiding what does not exist": (lambda: (compiled(BALL), {"hide": ["bal"]}), "hide has the name 'bal'"),
    "nothing to see": (lambda: (compiled(BALL), {"hide": ["ball"]}), "sensor 'pad' can see no body"),
    "sensors switched off": (
        lambda: (compiled(BALL, option='<flag sensor="disable"/>'), {}),
        "MuJoCo's sensors are switched off",
    ),
    "a flexible body": (lambda: (compiled(BALL + CLOTH), {}), r"flex 'cloth' .*hide=\['cloth'\]"),
    "no sensor": (lambda: (compiled(BALL), {"sensors": {}}), "sensors is empty"),
}


@pytest.mark.parametrize("case", INVALID)
def test_bad_input_of_a_view_is_named(case):
    make, message = INVALID[case]
    model, options = make()
    with pytest.raises(ValueError, match=message):
        scene.View(model, options.pop("sensors", {"pad": SENSOR}), **options)


def test_too_many_faces_are_counted():
    rows = '<hfield name="hills" nrow="300" ncol="300" size="1 1 .1 .1"/>'
    model = compiled('<body name="hills"><geom name="hills" type="hfield" hfield="hills"/></body>' + BALL, asset=rows)
    with pytest.raises(
        ValueError, match=r"body 'hills' has 181,\d+ faces, most of them in geom 'hills', but at most 131,072"
    ):
        scene.View(model, {"pad": SENSOR})


def test_bad_data_is_named(objects):
    model, data, view, _ = objects
    ball = compiled(BALL)
    with pytest.raises(ValueError, match=r"data of another model"):
        view(forward(ball))
    for empty in (mujoco.MjData(model), mjx.make_data(model)):
        with pytest.raises(ValueError, match=r"call mj_forward \(in MJX, mjx.forward\)"):
            view(empty)
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), mjx.put_data(ball, forward(ball)))
    with pytest.raises(ValueError, match=r"use jax.vmap"):
        scene.View(ball, {"pad": SENSOR}).wrenches(batch)
    with pytest.raises(ValueError, match="resolution"):
        view(data, resolution=(0, 10))
