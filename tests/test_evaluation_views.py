"""Stand-ins: a predicted pose as a picture that tells nothing else."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sts_jax as sts
from sts_jax import dataset, evaluation

FORK = sts.objects.make(jax.random.key(0), "fork")
LYING = [0.03, -0.02, 0.005, 1.0, 0, 0, 0]


@pytest.fixture(scope="module")
def pictures():
    poses = np.array([LYING, LYING, LYING, LYING], np.float32)
    poses[1, 2] = -0.004  # in the gel
    poses[2, :2] = -poses[2, :2]
    poses[3, 2] = -0.1  # fell off
    return evaluation.stand_ins(sts.Sensor(), [FORK] * 4, poses, (64, 64))


def middle(picture, empty):
    """Centre of what differs from the empty sensor, (row, column)."""
    return np.argwhere(np.abs(picture - empty).max(-1) > 0.05).mean(0)


def test_a_stand_in_lies_where_the_pose_says(pictures):
    empty = pictures[3]
    row, column = middle(pictures[0], empty)
    assert column > 31.5 + 5  # x = 30 mm is to the right: 64 pixels are 150 mm
    assert row < 31.5 - 4  # y = -20 mm is up
    other = middle(pictures[2], empty)
    np.testing.assert_allclose(other - 31.5, 31.5 - np.array([row, column]), atol=6)


def test_the_height_of_an_unsure_pose_does_not_matter(pictures):
    np.testing.assert_array_equal(pictures[0], pictures[1])


def test_a_stand_in_has_no_colours_of_its_own(pictures):
    loud = dataclasses.replace(FORK, colors=FORK.colors * 0 + 0.9, texture=FORK.texture * 0 + 0.5)
    again = evaluation.stand_ins(sts.Sensor(), [loud], np.array([LYING], np.float32), (64, 64))
    np.testing.assert_array_equal(again[0], pictures[0])


def test_one_that_fell_off_is_not_drawn(pictures):
    body = sts.objects.make(jax.random.key(5), "bottle")
    gone = jnp.array([[0.0, 0, -1, 1, 0, 0, 0]])
    visual, _, _ = dataset.render_uint8(sts.Sensor(), body, gone, jnp.zeros((1, 6)), resolution=(64, 64), crop=False)
    np.testing.assert_array_equal(pictures[3], np.asarray(visual[0]) / 255)


def test_a_slope_is_seen_as_one():
    red = dataclasses.replace(FORK, colors=FORK.colors * 0 + jnp.array([1.0, 0, 0]))
    size, slope = jnp.array([0.15, 0.15]), jnp.pi / 6
    up = jnp.array([0.0, -jnp.sin(slope), jnp.cos(slope)])
    stand = jnp.array([1.0, 0, 0, 0])

    def place(position, up):
        picture = np.asarray(evaluation.outside(red, jnp.concatenate([position, stand]), size, up)).astype(float)
        return np.argwhere(picture[..., 0] > picture[..., 1] + 0.3).mean(0)

    level = place(jnp.array([0.0, 0, 0.06]), jnp.array([0.0, 0, 9.81]))
    np.testing.assert_allclose(place(0.06 * up, 9.81 * up), level, atol=2)  # what is above is drawn above
    downhill = place(jnp.array([0.0, 0.04, 0.06]), 9.81 * up)
    assert downhill[0] > place(jnp.array([0.0, 0.04, 0.06]), None)[0] + 8
