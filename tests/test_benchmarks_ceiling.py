"""The spread of the ends of one start, for ends with known distances."""

import numpy as np

from benchmarks.ceiling import spread
from sts_jax.physics import Outcome


def test_spread_reports_distances_from_the_start_and_between_ends():
    start = np.zeros((3, 7))
    end = np.zeros((2, 3, 7))
    end[:, 0, 0] = [0.010, 0.030]  # 20 mm apart, so that the unbiased spread is 10 mm * sqrt(2)
    end[:, 1, 1] = 0.005  # both ends in one place
    end[:, 2, 0] = [0.02, 0.2]  # one of the ends falls off
    outcome = np.array([[Outcome.RESTS] * 3, [Outcome.RESTS, Outcome.RESTS, Outcome.FELL_OFF]])
    lines = spread(start, end, outcome)
    assert lines[0] == "3 starts, 2 draws of the hidden values each"
    assert " 14.0 mm (mean, of those that stay)" in lines[1]  # of 10, 30, 5, 5 and 20
    assert "7.1 mm (mean), 7.1 (median)" in lines[2]  # of 14.1 and 0
    assert " 33.3 %" in lines[3]
