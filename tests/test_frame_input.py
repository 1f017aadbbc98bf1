"""Invalid inputs of `sense`, `touch` and `expose`: errors for concrete values, finite images for traced ones."""

import dataclasses
import functools
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from optics_bodies import from_trimesh

import sts_jax as sts
from sts_jax import objects, tactile

# Without the tests' own checks of types and shapes, as users call them.
sense, touch, expose = (inspect.unwrap(call) for call in (sts.sense, sts.touch, sts.expose))
SENSOR = sts.Sensor()
BODY = from_trimesh(trimesh.creation.box((0.05, 0.03, 0.02)))
POSE = jnp.array([0.003, 0.002, 0.01, 1, 0, 0, 0], jnp.float32)
WRENCH = jnp.array([0.0, 0, 0.5, 0.001, -0.0015, 0], jnp.float32)
IMAGES = ("visual", "tactile", "pressure", "window", "pose")


@pytest.mark.parametrize(
    "resolution", [(0, 64), (64, -1), (64.0, 64), (64,), (64, 64, 3), 64, "64x64", None, (float("nan"), 64)]
)
def test_an_invalid_resolution_raises_an_error(resolution):
    draw = functools.partial(sense, resolution=resolution)
    for call in (draw, jax.jit(draw)):
        with pytest.raises(ValueError, match=r"resolution is .*whole numbers of pixels"):
            call(SENSOR, BODY, POSE, WRENCH)


@pytest.mark.parametrize("shape", [(), (6,), (8,), (1, 7), (3, 7)])
def test_a_pose_of_another_shape_raises_an_error(shape):
    for call in (sense, jax.jit(sense)):
        with pytest.raises(ValueError, match=r"pose has the shape .*\(7,\).*vmap"):
            call(SENSOR, BODY, jnp.zeros(shape), WRENCH)


@pytest.mark.parametrize("shape", [(), (3,), (7,), (2, 6)])
def test_a_wrench_of_another_shape_raises_an_error(shape):
    for call in (sense, jax.jit(sense)):
        with pytest.raises(ValueError, match=r"wrench has the shape .*\(6,\).*vmap"):
            call(SENSOR, BODY, POSE, jnp.zeros(shape))


@pytest.mark.slow
def test_lists_and_tuples_of_numbers_are_accepted():
    frame = sense(SENSOR, BODY, POSE, WRENCH)
    listed = sense(SENSOR, BODY, POSE.tolist(), tuple(WRENCH.tolist()))
    np.testing.assert_array_equal(listed.tactile, frame.tactile)
    imprint, window = np.full((24, 32), 1e-4), (-0.01, -0.01, 0.03, 0.02)
    np.testing.assert_array_equal(touch(SENSOR, imprint.tolist(), window), touch(SENSOR, imprint, jnp.array(window)))


@pytest.mark.slow
def test_the_quaternion_of_a_frame_has_w_at_least_0():
    for pose in (POSE.at[3].set(-1), POSE.at[3:].set(jnp.array([-0.01, 1, 0, 0]))):
        frame = sense(SENSOR, BODY, pose, WRENCH)
        assert float(frame.pose[3]) >= 0


def test_a_body_with_too_many_faces_raises_an_error():
    number = objects.FACE_CLASSES[-1] + 1
    many = {name: jnp.zeros((number, *getattr(BODY, name).shape[1:])) for name in ("normals", "colors", "uv")}
    body = dataclasses.replace(BODY, faces=jnp.zeros((number, 3), jnp.int32), **many)
    for call in (sense, jax.jit(sense)):
        with pytest.raises(ValueError, match=r"body has 131,073 faces, but at most 131,072.*faces="):
            call(SENSOR, body, POSE, WRENCH)


def test_other_types_than_sensor_and_body_raise_an_error():
    cases = [
        ((SENSOR, "mug.obj"), r"body is 'mug\.obj', but it must be one Body\. objects\.load reads a mesh file"),
        (
            (SENSOR, [BODY, BODY]),
            r"body is a list, but it must be one Body\. For several bodies use objects\.stack and jax\.vmap",
        ),
        ((SENSOR, None), "body is None, but it must be one Body"),
        (("sensor.json", BODY), r"sensor is 'sensor\.json', but it must be a Sensor"),
        ((BODY, SENSOR), r"sensor is Body\(.*, but it must be a Sensor"),
    ]
    for given, message in cases:
        with pytest.raises(TypeError, match=message):
            sense(*given, POSE, WRENCH)
    with pytest.raises(
        ValueError, match=r"vertices has the shape \(2, 1024, 3\), but it must be \(v, 3\): use jax\.vmap for"
    ):
        sense(SENSOR, objects.stack([BODY, BODY]), POSE, WRENCH)
    for call in (touch, expose):
        with pytest.raises(TypeError, match="sensor is None, but it must be a Sensor"):
            call(None, jnp.zeros((4, 4)), 0.5)


def test_other_types_than_arrays_of_numbers_raise_an_error():
    cases = [
        (
            lambda: sense(SENSOR, BODY, sts.physics.rest.Placement(POSE, WRENCH)),
            r"pose is a Placement, .* with \*, as in",
        ),
        (lambda: sense(SENSOR, BODY, None), r"pose is None, but it must be an array of shape \(7,\)"),
        (lambda: sense(SENSOR, BODY, POSE, "heavy"), r"wrench is 'heavy', but it must be an array of shape \(6,\)"),
        (lambda: touch(SENSOR, "imprint.png"), r"imprint is 'imprint\.png', but it must be an array"),
        (lambda: touch(SENSOR, jnp.zeros((4, 4)), "all"), r"window is 'all', but it must be an array of shape \(4,\)"),
        (lambda: expose(SENSOR, jnp.zeros((4, 4, 3)), 0.5), "frame is a .*, but it must be the Frame"),
    ]
    for call, message in cases:
        with pytest.raises(TypeError, match=message):
            call()


@pytest.mark.parametrize("field", ["vertices", "normals", "colors"])
def test_a_concrete_body_with_a_non_finite_value_raises_an_error(field):
    bad = dataclasses.replace(BODY, **{field: getattr(BODY, field).at[7, 1].set(jnp.nan)})
    for call in (sense, jax.jit(functools.partial(sense, SENSOR, bad))):
        with pytest.raises(ValueError, match=rf"{field} has values that are not finite \(\d of .*repair the mesh"):
            call(SENSOR, bad, POSE, WRENCH) if call is sense else call(POSE, WRENCH)


@pytest.mark.slow
def test_an_invalid_traced_body_or_pose_gives_the_empty_sensor():
    draw = jax.jit(functools.partial(sense, resolution=(16, 16)))
    gone = draw(SENSOR, BODY, POSE.at[2].set(-1), WRENCH)
    fields = {name: getattr(BODY, name).at[7, 1].set(jnp.nan) for name in ("vertices", "normals", "colors")}
    cases = [(dataclasses.replace(BODY, **{name: values}), POSE) for name, values in fields.items()]
    cases += [(BODY, POSE.at[4].set(1e30)), (BODY, POSE.at[3:].multiply(1e-30))]
    for body, pose in cases:
        frame = draw(SENSOR, body, pose, WRENCH)
        assert not bool(frame.balanced)
        for name in ("visual", "tactile", "pressure"):
            np.testing.assert_allclose(getattr(frame, name), getattr(gone, name), atol=1e-6)
    assert bool(draw(SENSOR, BODY, POSE, WRENCH).balanced)


@pytest.mark.parametrize("kind", [np.uint8, np.bool_, np.int32])
def test_an_imprint_of_whole_numbers_raises_an_error(kind):
    imprint = np.ones((5, 6), kind)
    for call in (touch, jax.jit(touch)):
        with pytest.raises(ValueError, match=rf"imprint has the type {np.dtype(kind)}, .* metres"):
            call(SENSOR, imprint)


def with_field(sensor, field, value):
    room, name = field.split(".")
    return dataclasses.replace(sensor, **{room: dataclasses.replace(getattr(sensor, room), **{name: value})})


NEAR = dataclasses.replace(SENSOR, lights=tactile.Leds())
IMPOSSIBLE = [
    (SENSOR, "camera.distance", 0.004),
    (SENSOR, "camera.fov", float("nan")),
    (SENSOR, "gel.stiffness", 0.0),
    (SENSOR, "gel.max_depth", 0.006),
    (SENSOR, "lights.directions", jnp.array([[0.0, 0, 1]] * 4)),
    (NEAR, "lights.positions", jnp.array([[0.0, 0, -0.004]] * 4)),
]


@pytest.mark.parametrize(("sensor", "field", "value"), IMPOSSIBLE)
def test_an_invalid_concrete_sensor_raises_an_error(sensor, field, value):
    bad = with_field(sensor, field, value)
    with pytest.raises(ValueError, match=f"field {field}") as checked:
        bad.check()
    for call in (functools.partial(sense, bad), jax.jit(functools.partial(sense, bad))):
        with pytest.raises(ValueError, match=f"field {field}") as error:
            call(BODY, POSE, WRENCH)
        assert str(error.value) == str(checked.value)
    frame = jax.jit(functools.partial(sense, resolution=(16, 16)))(SENSOR, BODY, POSE)
    for call in (functools.partial(touch, bad, frame.depth), functools.partial(expose, bad, frame, 0.5)):
        with pytest.raises(ValueError, match=f"field {field}"):
            call()


@jax.jit
def traced(sensor, pose):
    return sense(sensor, BODY, pose, WRENCH, resolution=(16, 16))


def possible(sensor):
    try:
        sensor.check()
    except ValueError:
        return False
    return True


@pytest.mark.slow
@pytest.mark.parametrize("lights", [tactile.Lights(), tactile.Leds()], ids=["far", "near"])
def test_an_invalid_traced_sensor_gives_an_unbalanced_frame_with_finite_images(lights):
    start = dataclasses.replace(SENSOR, lights=lights, skin=tactile.Skin(coupling=0.001, shadow_steps=4))
    assert bool(traced(start, POSE).balanced)
    empty = traced(start, POSE.at[2].set(-1))
    leaves, structure = jax.tree.flatten(start)
    refused = 0
    for index, (path, leaf) in enumerate(jax.tree_util.tree_leaves_with_path(start)):
        for value in (np.nan, np.inf, -np.inf, 0.0, -1.0, 10.0):
            bad = value if isinstance(leaf, float) else jnp.full_like(leaf, value)
            sensor = structure.unflatten([bad if k == index else v for k, v in enumerate(leaves)])
            frame = traced(sensor, POSE)
            words = f"{jax.tree_util.keystr(path)} is {value}"
            assert all(np.all(np.isfinite(getattr(frame, name))) for name in IMAGES), words
            if possible(sensor):
                assert np.any(frame.segmentation) or value == 10, words  # at 10 m it is smaller than a pixel
            else:
                assert not np.any(frame.segmentation), words
                refused += 1
                assert not bool(frame.balanced), words
                np.testing.assert_allclose(frame.visual, empty.visual, atol=1e-6)
                np.testing.assert_allclose(frame.tactile, empty.tactile, atol=1e-6)
    assert refused > 3 * len(leaves)  # three of the six values are not finite


@pytest.mark.slow
@pytest.mark.parametrize("lights", [tactile.Lights(), tactile.Leds()], ids=["far", "near"])
def test_touch_and_expose_are_finite_for_an_invalid_traced_sensor(lights):
    start = dataclasses.replace(SENSOR, lights=lights, skin=tactile.Skin(coupling=0.001, shadow_steps=4))
    frame = traced(start, POSE)
    imprint = jnp.zeros((24, 32)).at[8:14, 10:20].set(5e-4)
    pressed, between = jax.jit(touch), jax.jit(lambda sensor: expose(sensor, frame, 0.5))
    flat, half = pressed(start, 0 * imprint), between(start)
    assert np.any(pressed(start, imprint) != flat)
    leaves, structure = jax.tree.flatten(start)
    for index, (path, leaf) in enumerate(jax.tree_util.tree_leaves_with_path(start)):
        for value in (np.nan, np.inf, 0.0, -1.0):
            bad = value if isinstance(leaf, float) else jnp.full_like(leaf, value)
            sensor = structure.unflatten([bad if k == index else v for k, v in enumerate(leaves)])
            lit, mixed = pressed(sensor, imprint), between(sensor)
            words = f"{jax.tree_util.keystr(path)} is {value}"
            assert all(np.all(np.isfinite(image)) for image in (lit, mixed)), words
            if not possible(sensor):
                np.testing.assert_allclose(lit, flat, atol=1e-6, err_msg=words)
                np.testing.assert_allclose(mixed, half, atol=1e-6, err_msg=words)


@pytest.mark.slow
def test_steep_falloff_of_leds_gives_finite_images():
    steep = dataclasses.replace(SENSOR, lights=tactile.Leds(falloff=50.0))
    imprint = jnp.zeros((60, 80)).at[3:14, 1:20].set(5e-4)
    assert np.all(np.isfinite(touch(steep, imprint)))
    assert np.all(np.isfinite(jax.jit(touch)(steep, imprint)))


@pytest.mark.parametrize("shape", [(), (5,), (5, 6, 3), (0, 4)])
def test_an_imprint_of_another_shape_raises_an_error(shape):
    for call in (touch, jax.jit(touch)):
        with pytest.raises(ValueError, match=r"imprint has the shape .*\(height, width\).*vmap"):
            call(SENSOR, jnp.zeros(shape))


@pytest.mark.parametrize("bad", [(0, 0, 0, 0.1), (0, 0, 0.1, -0.1), (np.nan, 0, 0.1, 0.1), (0, 0, np.inf, 0.1)])
def test_an_invalid_window_raises_an_error_and_a_traced_one_shows_flat_skin(bad):
    imprint = jnp.zeros((24, 32)).at[8:14, 10:20].set(5e-4)
    bad = jnp.array(bad, jnp.float32)
    with pytest.raises(ValueError, match=r"window is .*four finite numbers, left, top, width, height"):
        touch(SENSOR, imprint, bad)
    np.testing.assert_allclose(jax.jit(touch)(SENSOR, imprint, bad), touch(SENSOR, 0 * imprint), atol=1e-6)
    with pytest.raises(ValueError, match=r"window has the shape \(3,\)"):
        touch(SENSOR, imprint, bad[:3])


def stl_of_a_million(path):
    """A ball of a thousand rings, written with NumPy, which is faster than a mesh library."""
    polar, around = np.meshgrid(np.linspace(0, np.pi, 1002), np.linspace(0, 2 * np.pi, 502), indexing="ij")
    points = 0.04 * np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], -1)
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    triangles = np.concatenate([np.stack([a, b, c], -2).reshape(-1, 3, 3), np.stack([a, c, d], -2).reshape(-1, 3, 3)])
    record = np.zeros(len(triangles), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    record["corners"] = triangles
    path.write_bytes(bytes(80) + np.uint32(len(record)).tobytes() + record.tobytes())
    return len(record)


@pytest.mark.slow
def test_a_mesh_of_a_million_faces_raises_an_error_or_is_decimated_with_a_warning(tmp_path):
    path = tmp_path / "ball.stl"
    number = stl_of_a_million(path)
    assert number > 1_000_000
    message = rf"ball\.stl: the mesh has {number:,} faces, but at most 131,072.*pass faces=131072"
    with pytest.raises(ValueError, match=message):
        objects.load(path)
    with pytest.warns(UserWarning, match=r"ball\.stl: decimated from 1,00\d,\d{3} to [\d,]+ faces"):
        body = objects.load(path, faces=4096)
    assert body.faces.shape == (4096, 3)
    # Decimation from a million to four thousand faces enlarges the ball by 4 %. From 20,480 faces it is below 0.5 %.
    np.testing.assert_allclose(np.ptp(np.asarray(body.vertices), axis=0), 0.08, rtol=0.05)
