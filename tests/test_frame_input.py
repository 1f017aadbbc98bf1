"""Invalid inputs of `sense`, `touch` and `expose`: errors for concrete values, finite images for traced ones."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from optics_bodies import from_trimesh, noise, with_field

import sts_jax as sts
from sts_jax import expose, objects, sense, tactile, touch

SENSOR = sts.Sensor()
BODY = from_trimesh(trimesh.creation.box((0.05, 0.03, 0.02)))
POSE = jnp.array([0.003, 0.002, 0.01, 1, 0, 0, 0], jnp.float32)
WRENCH = jnp.array([0.0, 0, 0.5, 0.001, -0.0015, 0], jnp.float32)
IMAGES = ("visual", "tactile", "pressure", "window", "pose")


def too_many_faces():
    number = objects.FACE_CLASSES[-1] + 1
    many = {name: jnp.zeros((number, *getattr(BODY, name).shape[1:])) for name in ("normals", "colors", "uv")}
    return dataclasses.replace(BODY, faces=jnp.zeros((number, 3), jnp.int32), **many)


IMPRINT = np.zeros((4, 5), np.float32)
THIN = with_field(SENSOR, "camera.distance", 0.004)
# A call, the type of its error, and a part of the message.
BAD_CALLS = [
    (lambda: sense(SENSOR, BODY, POSE, resolution=(0, 64)), ValueError, r"resolution .* from 1 to 8,192 .* \(0, 64\)"),
    (lambda: sense(SENSOR, BODY, POSE, resolution=(10**6, 9)), ValueError, r"resolution .* to 8,192 .* \(1000000, 9\)"),
    (lambda: sense(SENSOR, BODY, POSE[None]), TypeError, "parameter 'pose'"),
    (
        lambda: sense(SENSOR, BODY, sts.physics.rest.Placement(POSE, WRENCH)),
        TypeError,
        r"is a Placement: unpack it .*\*",
    ),
    (lambda: sense(SENSOR, [BODY, BODY], POSE), TypeError, r"'pose' has the shape \(7,\), .* \(2, 7\)"),
    (lambda: sense(SENSOR, objects.stack([BODY, BODY]), POSE), ValueError, r"\(v, 3\): use jax\.vmap for"),
    (lambda: sense(SENSOR, too_many_faces(), POSE), ValueError, "131,073 faces, but at most 131,072 .*faces=131072"),
    (lambda: touch(SENSOR, jnp.zeros((4, 5, 3))), TypeError, "parameter 'imprint'"),
    (lambda: touch(SENSOR, IMPRINT, jnp.array([np.nan, 0, 0.1, 0.1])), ValueError, "window must be finite"),
    (lambda: sense(THIN, BODY, POSE), ValueError, r"field camera\.distance"),
    (jax.jit(lambda: sense(THIN, BODY, POSE)), ValueError, r"field camera\.distance"),
    (lambda: touch(THIN, IMPRINT), ValueError, r"field camera\.distance"),
    (lambda: expose(THIN, noise((4, 4)), 0.5), ValueError, r"field camera\.distance"),
    (
        lambda: expose(SENSOR, noise((4, 4)), -0.1),
        ValueError,
        r"light is -0\.1, .*from 0 \(visual\) to 1 \(tactile\)",
    ),
    (
        lambda: sense(SENSOR, dataclasses.replace(BODY, normals=BODY.normals.at[7, 1].set(jnp.nan)), POSE),
        ValueError,
        r"normals has values that are not finite \(\d of .*repair the mesh",
    ),
]


@pytest.mark.parametrize(("call", "error", "message"), BAD_CALLS)
def test_an_invalid_argument_raises_an_error_that_names_it(call, error, message):
    for each in (call, jax.jit(call)) if error is TypeError else (call,):  # values are unknown inside jit
        with pytest.raises(error, match=message):
            each()


def posed(x=0.0, y=0.0, z=0.01, quat=(1, 0, 0, 0)):
    return np.array([x, y, z, *quat], np.float32)


UNLIKELY = [
    (posed(50, 20, 10), WRENCH, "in metres, not in millimetres"),
    (posed(0.003, np.nan), WRENCH, "pose has NaN"),
    (posed(quat=(1, 0, np.inf, 0)), None, "pose has NaN or infinite"),
    (posed(quat=(0, 0, 0, 0)), None, "quaternion of length 0"),
    (posed(0.15), WRENCH, "out of the camera's view"),
    (posed(0, -0.2), None, "out of the camera's view"),
    (posed(z=-0.05), WRENCH, "out of the camera's view"),
    (posed(z=-0.008), None, "below the pad: is the quaternion in the order w, x, y, z"),
    (posed(), np.full(6, np.nan), "wrench has NaN"),
    (posed(), 1000 * WRENCH, "force in N and the moment in N m"),
    (posed(), np.array([0, 0, 1.0, 50, 0, 0], np.float32), "force in N and the moment in N m"),
]


@pytest.mark.parametrize(("pose", "wrench", "message"), UNLIKELY)
def test_a_placement_that_is_probably_wrong_is_drawn_with_a_warning(pose, wrench, message):
    for kind in (np.asarray, jnp.asarray):
        given = kind(pose), None if wrench is None else kind(wrench)
        with pytest.warns(UserWarning, match=message) as caught:
            sense(SENSOR, BODY, *given, resolution=(16, 16))
        assert [warning.filename for warning in caught] == [__file__]
    jax.make_jaxpr(functools.partial(sense, SENSOR, BODY, resolution=(16, 16)))(pose, wrench)  # no warning inside jit


@pytest.mark.parametrize(
    "pose",
    [posed(0.074, 0.074), posed(-0.09), posed(0.1, 0, 0.0), posed(z=0.6), posed(0.3, 0, 0.9), posed(z=-1), POSE],
)
def test_a_likely_placement_is_drawn_without_a_warning(pose):
    """On the edge, partly beside the pad, far above, and nowhere."""
    sense(SENSOR, BODY, pose, WRENCH, resolution=(16, 16))


def test_an_invalid_traced_body_pose_or_wrench_gives_the_empty_sensor():
    draw = jax.jit(functools.partial(sense, resolution=(16, 16)))
    gone = draw(SENSOR, BODY, POSE.at[2].set(-1), WRENCH)
    fields = {name: getattr(BODY, name).at[7, 1].set(jnp.nan) for name in ("vertices", "normals", "colors")}
    cases = [(dataclasses.replace(BODY, **{name: values}), POSE, WRENCH) for name, values in fields.items()]
    cases += [(BODY, POSE.at[k].set(bad), WRENCH) for k, bad in ((1, np.nan), (4, np.inf), (4, 1e30))]
    cases += [(BODY, POSE.at[3:].multiply(1e-30), WRENCH), (BODY, POSE, WRENCH.at[3].set(np.inf))]
    for case in cases:
        frame = draw(SENSOR, *case)
        assert not bool(frame.balanced)
        for name in ("visual", "tactile", "pressure"):
            np.testing.assert_allclose(getattr(frame, name), getattr(gone, name), atol=1e-6)
    assert bool(draw(SENSOR, BODY, POSE, WRENCH).balanced)


@jax.jit
def traced(sensor, pose):
    return sense(sensor, BODY, pose, WRENCH, resolution=(16, 16))


def is_valid(sensor):
    try:
        sensor.check()
    except ValueError:
        return False
    return True


@pytest.mark.slow
def test_an_invalid_traced_constant_gives_finite_images_of_the_empty_sensor():
    start = dataclasses.replace(SENSOR, lights=tactile.Leds(), skin=tactile.Skin(coupling=0.001, shadow_steps=4))
    frame = traced(start, POSE)
    assert bool(frame.balanced)
    empty = traced(start, POSE.at[2].set(-1))
    imprint = jnp.zeros((24, 32)).at[8:14, 10:20].set(5e-4)
    pressed, between = jax.jit(touch), jax.jit(lambda sensor: expose(sensor, frame, 0.5))
    flat, half = pressed(start, 0 * imprint), between(start)
    assert np.any(pressed(start, imprint) != flat)
    leaves, structure = jax.tree.flatten(start)
    refused = 0
    for index, (path, leaf) in enumerate(jax.tree_util.tree_leaves_with_path(start)):
        for value in (np.nan, np.inf, 0.0, -1.0, 10.0):
            bad = value if isinstance(leaf, float) else jnp.full_like(leaf, value)
            sensor = structure.unflatten([bad if k == index else v for k, v in enumerate(leaves)])
            seen, lit, mixed = traced(sensor, POSE), pressed(sensor, imprint), between(sensor)
            words = f"{jax.tree_util.keystr(path)} is {value}"
            assert all(np.all(np.isfinite(image)) for image in (lit, mixed)), words
            assert all(np.all(np.isfinite(getattr(seen, name))) for name in IMAGES), words
            if is_valid(sensor):
                assert np.any(seen.segmentation) or value == 10, words  # at 10 m it is smaller than a pixel
                continue
            refused += 1
            assert not np.any(seen.segmentation), words
            assert not bool(seen.balanced), words
            np.testing.assert_allclose(seen.visual, empty.visual, atol=1e-6)
            np.testing.assert_allclose(seen.tactile, empty.tactile, atol=1e-6)
            np.testing.assert_allclose(lit, flat, atol=1e-6, err_msg=words)
            np.testing.assert_allclose(mixed, half, atol=1e-6, err_msg=words)
    assert refused > 2 * len(leaves)  # two of the five values are not finite


def test_an_invalid_traced_window_shows_flat_skin_and_steep_leds_give_finite_images():
    imprint = jnp.zeros((24, 32)).at[8:14, 10:20].set(5e-4)
    shown, flat = jax.jit(touch), touch(SENSOR, 0 * imprint)
    for bad in ((0, 0, 0, 0.1), (0, 0, 0.1, -0.1), (np.nan, 0, 0.1, 0.1), (0, 0, np.inf, 0.1)):
        np.testing.assert_allclose(shown(SENSOR, imprint, jnp.array(bad, jnp.float32)), flat, atol=1e-6)
    steep = dataclasses.replace(SENSOR, lights=tactile.Leds(falloff=50.0))
    assert np.all(np.isfinite(shown(steep, imprint)))
