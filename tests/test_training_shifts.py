"""Trajectories that are moved over the pad."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError
from recorded_session import SQUARE, drawn

from sts_jax import training

EMPTY = np.clip(drawn(None, None) + np.arange(64)[:, None, None], 0, 255).astype(np.uint8)  # light that varies


def with_square(row, column):
    """The empty pad with a square that is 100 darker, or as far as it is in view."""
    image = EMPTY.copy()
    rows, columns = (slice(max(x, 0), max(x + SQUARE, 0)) for x in (row, column))
    image[rows, columns] -= 100
    return image


@pytest.mark.parametrize("shift", [(0, 0), (3, 0), (0, -5), (-12, 40)])
def test_a_shifted_trajectory_is_the_one_at_the_other_place(shift):
    images = np.stack([[with_square(10, 15), with_square(20, 15)]])
    moved = training.shifted(images, EMPTY, np.array([shift]))
    rows, columns = shift
    truth = np.stack([with_square(10 + rows, 15 + columns), with_square(20 + rows, 15 + columns)])
    np.testing.assert_array_equal(moved[0], truth)


def test_invalid_shapes_and_shifts_are_refused():
    images = np.stack([[EMPTY, EMPTY]])
    with pytest.raises(ValueError, match="must be below the image size"):
        training.shifted(images, EMPTY, np.array([[64, 0]]))
    with pytest.raises((ValueError, TypeCheckError), match="shifts"):
        training.shifted(images, EMPTY, np.array([[1, 0], [2, 0]]))
