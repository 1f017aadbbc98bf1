"""Predictions of held-out trajectories by a model that answers with its inputs."""

import types

import numpy as np
import pytest
from test_evaluation_results import FELL, RESTS, judged, pairs

from sts_jax import evaluation, physics, training


def answer(count, visual=None, pose=None, samples=None, probability=None):
    return types.SimpleNamespace(
        visual=visual, tactile=None, pose=pose, outcome_probability=probability, samples=samples, count=count
    )


class Echo:
    """Predicts the visual image and the pose that it is given, and records its calls."""

    modalities = ("visual", "pose")
    preprocessing = training.Preprocessing()

    def __init__(self):
        self.calls = []

    def __call__(self, *, visual=None, tactile=None, pose=None, condition=None, state=None, key=None, num_samples=0):
        given = {"visual": visual, "tactile": tactile, "pose": pose, "condition": condition, "state": state}
        self.calls.append({name: value for name, value in given.items() if value is not None})
        count = len(visual if pose is None else pose)
        samples = None
        if num_samples:
            drawn = None if pose is None else np.repeat(pose[None], num_samples, 0)
            samples = answer(count, None if visual is None else np.repeat(visual[None], num_samples, 0), drawn)
        return answer(count, visual, pose, samples)

    def prior(self, shape=(), *, condition=None):
        self.calls.append({"prior": shape})
        return answer(shape[0], pose=np.tile(np.array([0, 0, 0, 1.0, 0, 0, 0]), (*shape, 1)))


def test_subsets_are_described_in_words():
    found = evaluation.subsets(("visual", "tactile", "pose"), state=True)
    assert list(found) == [
        *("from visual", "from tactile", "from pose"),
        *("from visual and tactile", "from visual and pose", "from tactile and pose"),
        *("from all inputs", "from visual and the true state"),
    ]
    assert found["from tactile and pose"] == ("tactile", "pose")
    assert found["from visual and the true state"] == ("visual", "state")
    assert evaluation.subsets(("visual",)) == {"from visual": ("visual",)}
    assert list(evaluation.subsets(()).values()) == [()]


@pytest.mark.parametrize("count", [3, 150])
def test_predictions_are_those_of_single_items_in_calls_of_equal_size(count):
    test, model = pairs(np.arange(count), np.arange(count)), Echo()
    test.pose[:, 0, 2] = np.linspace(-0.1, 0.1, count)
    found = evaluation.predict(model, ("visual", "pose"), test, physics.Freefall())
    np.testing.assert_array_equal(found.visual, test.visual[:, 0] / 255)
    np.testing.assert_array_equal(found.pose, test.pose[:, 0])
    np.testing.assert_array_equal(found.outcome, np.where(test.pose[:, 0, 2] < -0.005, FELL, RESTS))
    assert {len(call["pose"]) for call in model.calls} == {min(count, 64)}
    assert set(model.calls[0]) == {"visual", "pose", "condition"}
    np.testing.assert_array_equal(model.calls[-1]["condition"][0], test.condition[64 * (count // 64)])


def test_no_trajectories_are_refused():
    test, model = pairs(np.arange(3), np.arange(3)), Echo()
    test = test.take(slice(0))
    with pytest.raises(ValueError, match="`test` has 0 trajectories: choose"):
        evaluation.predict(model, ("visual",), test, physics.Freefall())
    assert not model.calls


def test_only_the_requested_inputs_are_given():
    test, _ = judged()
    for inputs, expected in ((("pose",), {"pose"}), (("visual", "state"), {"visual", "state"})):
        model = Echo()
        evaluation.predict(model, inputs, test, physics.Freefall())
        assert set(model.calls[0]) == expected
    model = Echo()
    assert evaluation.predict(model, (), test, physics.Freefall()).pose.shape == (6, 7)
    assert model.calls == [{"prior": (6,)}]


def test_probabilities_are_the_shares_of_the_samples():
    test, _ = judged()
    found = evaluation.predict(Echo(), ("visual", "pose"), test, physics.Freefall(), num_samples=3)
    assert found.samples.visual.dtype == np.uint8
    np.testing.assert_array_equal(found.samples.visual[2], test.visual[:, 0])
    # All three samples have the same outcome, and one more is spread over both outcomes.
    fell = physics.Freefall.outcomes.index(physics.Outcome.FELL_OFF)
    expected = np.where(test.pose[:, 0, 2] < -0.005, 3.5 / 4, 0.5 / 4)
    np.testing.assert_allclose(found.outcome_probability[:, fell], expected)


def test_the_outcome_of_a_model_without_a_pose_depends_on_its_image():
    blank = np.full((4, 4, 3), 0.5)
    validation = pairs([128, 128, 255, 0], np.zeros((4, 0)))._replace(outcome=np.array([FELL, FELL, RESTS, RESTS]))
    test = pairs([0, 128, 255], np.zeros((3, 0)))

    def outcome(scenario, **further):
        return evaluation.predict(Echo(), ("visual",), test, scenario, **further).outcome

    assert outcome(physics.Freefall(), validation=validation, blank=blank).tolist() == [RESTS, FELL, RESTS]
    assert outcome(physics.Freefall()) is None
    assert outcome(physics.Perturbed(), validation=validation, blank=blank) is None  # more than two outcomes
