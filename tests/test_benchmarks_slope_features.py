"""Statics on the slope, compared with a block calculated by hand."""

import math

import numpy as np
import pytest

from benchmarks.instruments import slope_features

pytestmark = pytest.mark.slow


def test_balance_of_a_block_on_the_slope():
    # A support of 20 x 40 mm. The centre of mass is 10 mm high, then at the limit of tipping, then beside the support.
    corners = np.array([[-0.01, -0.02], [0.01, -0.02], [0.01, 0.02], [-0.01, 0.02]])
    angle = math.radians(30)
    high = 0.02 / math.tan(angle)
    centre = np.array([[0, 0, 0.01], [0, 0, 0.01], [0, 0, 1.01 * high], [0, 0, 0.99 * high], [0.011, 0, 0.01]])
    end, pressure = slope_features.balance(corners, centre, np.array([0.7, 0.5, 0.7, 0.7, 0.7]), angle)
    assert end.tolist() == [2, 1, 0, 2, 0]
    ahead = 0.01 * math.tan(angle)
    expected = [[0, ahead], [0, 0.005], [0, 0.02], [0, 0.99 * 0.02], [0.01, ahead]]
    np.testing.assert_allclose(pressure, expected, atol=1e-9)
