"""Errors of the checks by annotations are short enough to be read."""

import jax
import numpy as np
import pytest
from jaxtyping import Float

import sts_jax as sts
from sts_jax._checked import checked


def test_an_error_names_the_argument_and_the_axes_and_leaves_out_the_others():
    @checked
    def f(a: Float[np.ndarray, "b 3"], c: Float[np.ndarray, "b 4"], other: str) -> int:
        return len(a) + len(c) + len(other)

    assert f(np.zeros((2, 3)), np.zeros((2, 4)), "x") == 5
    with pytest.raises(TypeError) as found:
        f(np.zeros((2, 3)), np.zeros((5, 4)), "another argument")
    text = str(found.value)
    assert "parameter 'c'" in text
    assert "f64[5,4]" in text
    assert text.endswith("b=2")
    assert "another argument" not in text


def test_a_wrong_pose_is_the_end_of_the_message_of_sense():
    body = sts.objects.make(jax.random.key(0), "mouse")
    with pytest.raises(TypeError) as found:
        sts.sense(sts.Sensor(), body, np.zeros(6), np.zeros(6))
    lines = str(found.value).split("\n")
    assert len(lines) == 4
    assert "'pose'" in lines[1]
    assert "f64[6]" in lines[2]
