"""The summary of predicted images without poses, against plain loops and closed forms."""

import math
from typing import NamedTuple

import numpy as np
import pytest

from sts_jax import evaluation
from sts_jax.evaluation import Predicted


class Images(NamedTuple):
    visual: np.ndarray
    tactile: np.ndarray


def some(count, seed):
    random = np.random.default_rng(seed)
    return Images(*(random.integers(30, 220, (count, 2, 8, 8, 3)).astype(np.uint8) for _ in range(2)))


TRAIN, TEST = some(7, 0), some(5, 1)
BASE = evaluation.image_baselines(TRAIN, TEST)
CONSTANT, COPY, NEIGHBOUR = BASE


def test_the_baselines_are_the_mean_the_input_and_the_nearest_end():
    np.testing.assert_allclose(BASE[CONSTANT].tactile[3], TRAIN.tactile[:, 1].mean(0) / 255, atol=1e-6)
    np.testing.assert_array_equal(BASE[COPY].visual, TEST.visual[:, 0])
    for item in range(5):
        gaps = [np.abs(TEST.visual[item, 0].astype(float) - image) for image in TRAIN.visual[:, 0]]
        nearest = int(np.argmin([(gap**2).sum() for gap in gaps]))
        np.testing.assert_array_equal(BASE[NEIGHBOUR].tactile[item], TRAIN.tactile[nearest, 1])


def test_bce_floor_and_skill_equal_plain_loops():
    guess = np.full((5, 8, 8, 3), 0.4, np.float32)
    found = evaluation.image_summary({**BASE, "guess": Predicted(visual=guess)}, TEST, num=50)
    truth = (TEST.visual[:, 1] / 255).ravel()
    bce = [-(x * math.log(0.4) + (1 - x) * math.log(0.6)) for x in truth]
    floor = [-(x * math.log(x) + (1 - x) * math.log(1 - x)) for x in truth]
    own = found["visual"]["predictors"]["guess"]
    assert found["visual"]["floor"] == pytest.approx(np.mean(floor), rel=1e-5)
    assert own["bce"]["value"] == pytest.approx(np.mean(bce), rel=1e-5)
    for key, name in (("skill", CONSTANT), ("skill_copy", COPY)):
        reference = found["visual"]["predictors"][name]["bce"]["value"]
        expected = 1 - (np.mean(bce) - np.mean(floor)) / (reference - np.mean(floor))
        assert own[key]["value"] == pytest.approx(expected, rel=1e-4)
        assert own[key]["low"] <= own[key]["value"] <= own[key]["high"]
    assert "guess" not in found["tactile"]["predictors"]


def test_the_truth_has_skill_one_and_the_constant_zero():
    exact = Predicted(TEST.visual[:, 1], TEST.tactile[:, 1])
    found = evaluation.image_summary({**BASE, "exact": exact}, TEST, num=20)
    for stream in evaluation.STREAMS:
        own = found[stream]["predictors"]
        assert own["exact"]["skill"]["value"] == pytest.approx(1, abs=1e-6)
        assert own["exact"]["bce"]["value"] == pytest.approx(found[stream]["floor"])
        assert own[CONSTANT]["skill"]["value"] == 0


def test_a_missing_baseline_and_a_wrong_shape_are_refused():
    with pytest.raises(ValueError, match="`predictions` lacks 'copy of the input'"):
        evaluation.image_summary({CONSTANT: BASE[CONSTANT]}, TEST)
    with pytest.raises(ValueError, match=r"'small': visual has shape \(5, 4, 4, 3\)"):
        evaluation.image_summary({**BASE, "small": Predicted(visual=np.zeros((5, 4, 4, 3)))}, TEST)
