"""Depth of whole frames against embree: a part of the measurement of `benchmarks.depth`."""

import pytest

from benchmarks import depth

# All have the same size class, so that there is one program for each size.
NAMES = [name for name in depth.PROCEDURAL + depth.LOADED + depth.MADE if name != "duckie"]


@pytest.mark.slow
@pytest.mark.parametrize("shape", depth.SIZES)
def test_depth_equals_embrees(shape):
    found = depth.total(list(depth.measure(NAMES, shape, (2, 1, 1)).values()))
    assert found.interior_beyond_10um <= 0.001 * found.interior
    assert found.interior_beyond_100um == 0
    assert found.elsewhere_beyond_1mm <= 0.01 * found.elsewhere
    assert found.strays == 0
    assert found.silhouette_differs <= 0.01 * found.silhouette
    assert found.elsewhere > 3000  # the comparison is not empty
    if min(shape) >= 200:
        assert found.interior > 10000
