"""Codes of poses: encoding, decoding, and the short codes of an uncertain network. The criterion for a touch."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError

from sts_jax import geometry, training
from sts_jax.evaluation.metrics import geodesic_angle


def poses(count):
    key, turn = jax.random.split(jax.random.key(0))
    quats = jax.vmap(geometry.random_quat)(jax.random.split(turn, count))
    return jnp.concatenate([0.05 * jax.random.normal(key, (count, 3)), quats], axis=-1)


@pytest.mark.parametrize(("rotation", "size"), [("matrix", 12), ("quaternion", 7)])
def test_decoding_inverts_encoding(rotation, size):
    preprocessing, pose = training.Preprocessing(rotation=rotation), poses(200)
    code = preprocessing.encode_pose(pose)
    assert code.shape == (200, size) == (200, preprocessing.pose_size)
    again = preprocessing.decode_pose(code)
    np.testing.assert_allclose(again[:, :3], pose[:, :3], atol=1e-7)
    assert geodesic_angle(np.asarray(again), np.asarray(pose)).max() < 2e-3
    flipped = jnp.concatenate([pose[:, :3], -pose[:, 3:]], axis=-1)
    np.testing.assert_allclose(preprocessing.encode_pose(flipped), code, atol=1e-6)


@pytest.mark.parametrize("rotation", ["matrix", "quaternion"])
def test_an_uncertain_code_is_decoded_to_a_valid_pose(rotation):
    preprocessing = training.Preprocessing(rotation=rotation)
    pose = poses(50)
    code = preprocessing.encode_pose(pose)
    faint = preprocessing.decode_pose(code.at[:, 3:].multiply(0.05))  # a mean over many orientations is short
    assert geodesic_angle(np.asarray(faint), np.asarray(pose)).max() < 2e-3
    nothing = preprocessing.decode_pose(jnp.zeros(preprocessing.pose_size))
    np.testing.assert_array_equal(nothing[3:], [1, 0, 0, 0])


BLANK = np.full((64, 64, 3), 180, np.uint8)


def touched(preprocessing, images, blank=BLANK):
    return np.asarray(preprocessing.touched(jnp.asarray(images / 255, jnp.float32), jnp.asarray(blank / 255)))


def test_the_criterion_of_simulated_images_is_a_single_pixel():
    images = np.stack([BLANK] * 3).astype(float)
    images[1, 20, 30, 1] += 3  # not more than the threshold
    images[2, 20, 30, 1] += 4
    view = training.Preprocessing()
    np.testing.assert_array_equal(touched(view, images), [False, False, True])
    noisy = np.random.default_rng(0).normal(180, 1, (50, 64, 64, 3))
    largest = np.abs(np.float32(noisy / 255) - np.float32(BLANK / 255)).max((1, 2, 3))
    np.testing.assert_array_equal(touched(view, noisy), largest > 3 / 255)


def test_noise_bright_pixels_and_a_change_of_the_light_are_no_touch_and_a_faint_imprint_is():
    random = np.random.default_rng(1)

    def taken(change):
        noisy = np.round(BLANK.astype(float) + change + random.normal(0, 4, (40, *BLANK.shape)))
        return np.clip(noisy, 0, 255).astype(np.uint8)

    imprint, bright = np.zeros(BLANK.shape), np.zeros(BLANK.shape)
    imprint[30:36, 10:20] = [-25, 10, 15]
    bright[5, 5] = bright[50, 20] = 70
    own = training.touch_of_noisy_images(training.Preprocessing(), taken(imprint), BLANK)
    # The mean of 2 x 2 pixels has half the noise.
    assert own.touch_threshold * 255 == pytest.approx(6 * 4 / 2, rel=0.15)
    assert touched(training.Preprocessing(), taken(0)).all()  # the criterion of simulated images fails
    assert not touched(own, taken(0)).any()
    assert not touched(own, taken(-20)).any()
    assert not touched(own, taken(bright)).any()
    assert touched(own, taken(imprint)).all()
    assert touched(own, taken(imprint + 20)).all()
    assert training.Preprocessing.from_json(dataclasses.asdict(own)) == own


SMALL = np.zeros((2, 32, 32, 3), np.uint8)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: training.touch_of_noisy_images(training.Preprocessing(), SMALL, BLANK), "blank"),
        (lambda: training.touch_of_noisy_images(training.Preprocessing(), SMALL, SMALL[0]), r"\(32, 32\) pixels: give"),
        (lambda: training.Preprocessing(touch_block=3), "touch_block must divide"),
        (lambda: training.Preprocessing.from_json({}), "resolution is missing"),
        (lambda: training.Preprocessing(rotation="euler"), "rotation"),
        (lambda: training.paper_model(("visal",), training.Preprocessing()), "tactile, pose, got 'visal'"),
    ],
)
def test_bad_calls_are_refused(call, message):
    with pytest.raises((ValueError, TypeCheckError), match=message):  # tests check all annotations first
        call()
