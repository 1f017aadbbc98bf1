"""The rate of pairs against the camera's limit, and their lights."""

import numpy as np
import pytest

from benchmarks import device
from sts_jax import hardware


def test_rate_and_limit_of_known_times():
    settled = hardware.Settling(visual_s=0.06, tactile_s=0.08)
    found = device.Measured(15.0, settled, pairs=80, wrong=1, frames=600, discarded=440, lost=2, seconds=10.0)
    np.testing.assert_allclose(found.rate, 8)
    np.testing.assert_allclose(found.limit, 1 / (2 / 60 + 0.07))
    assert "160 images, 1 of a wrong or mixed light" in device.report([found])


@pytest.mark.slow
def test_pairs_have_no_wrong_light():
    (found,) = device.measure_all(device.Args(pairs=20, lags_ms=(30,)))
    assert found.pairs == 20
    assert found.wrong == 0
    assert found.frames >= 40
