"""Baselines: what the nearest neighbour takes into account."""

import numpy as np
import pytest

from sts_jax import dataset, evaluation, physics

SIDE = 4


def pairs(grey, condition):
    """One pair a grey value of the first image; the outcome counts them."""
    grey = np.asarray(grey, np.uint8)
    num = len(grey)
    images = np.broadcast_to(grey[:, None, None, None, None], (num, 2, SIDE, SIDE, 3))
    pose = np.zeros((num, 2, 7), np.float32)
    pose[..., 3] = 1
    return dataset.Pairs(
        visual=images,
        tactile=images,
        segmentation=np.ones((num, 2, SIDE, SIDE), bool),
        pose=pose,
        contact=np.ones((num, 2), bool),
        condition=np.asarray(condition, np.float32).reshape(num, -1),
        outcome=np.arange(num, dtype=np.int32),
        object=np.arange(num),
        trajectory=np.arange(num),
    )


def nearest(train, test, scenario):
    predicted = evaluation.baselines(scenario, train, test)
    return predicted["nearest neighbour"].outcome.tolist()


def test_without_a_condition_the_nearest_image_decides():
    train = pairs([10, 60, 200], np.zeros((3, 0)))
    assert nearest(train, pairs([40, 150, 0], np.zeros((3, 0))), physics.Freefall()) == [1, 2, 0]


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_image_and_condition_count_alike_whatever_their_units(unit):
    corners = np.array([[0.0, 0, 0], [0, 0, 1], [1, 1, 0], [1, 1, 1]]) * [1, 1, unit]
    train = pairs([0, 200, 0, 200], corners)
    # The image says item 1 or 3, clearly; the condition decides between the two.
    assert nearest(train, pairs([190, 190], [[0.1, 0.1, unit], [0.9, 0.9, unit]]), physics.Perturbed()) == [1, 3]
    # The image is undecided: the condition alone decides.
    assert nearest(train, pairs([100] * 4, corners), physics.Perturbed()) == [0, 1, 2, 3]
