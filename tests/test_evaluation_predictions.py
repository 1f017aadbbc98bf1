"""Predictions of held-out trajectories, by a model that answers with its inputs and by re-rolls of a fake engine."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_evaluation_results import FELL, RESTS, judged, pairs

import sts_jax as sts
from sts_jax import dataset, evaluation, physics, statespace, training
from sts_jax.evaluation import references
from sts_jax.physics.arguments import check_start


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
    subsets = evaluation.subsets(("visual", "tactile", "pose"), state=True)
    assert len(subsets) == 2**3
    assert subsets["from tactile and pose"] == ("tactile", "pose")
    assert subsets["from all inputs"] == ("visual", "tactile", "pose")
    assert subsets["from visual and the true state"] == ("visual", "state")
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


class Riser:
    """A one-step model of two frames and 0.1 s, whose object rises by 1 cm in each step. It records its calls."""

    preprocessing = training.Preprocessing(stride=2, period=0.1)

    def __init__(self):
        self.calls = []

    def rollout(self, frame, steps, *, condition=None, time=0.0, key=None, num_samples=0, last=False):
        self.calls.append({"given": set(frame), "time": time, "steps": steps})
        rise = np.arange(1, steps + 1)[steps - 1 if last else 0 :, None] * np.eye(7)[2] / 100
        pose = frame["pose"][:, None] + rise
        visual = np.broadcast_to(frame["visual"][:, None], (*pose.shape[:2], *frame["visual"].shape[1:]))
        drawn = np.stack([pose + k * np.eye(7)[2] for k in range(num_samples)]) if num_samples else None
        samples = None if drawn is None else answer(0, np.repeat(visual[None], num_samples, 0), drawn)
        return answer(len(pose), visual, pose, samples)


def later(count, first=0, second=6):
    test = pairs(np.arange(count), np.zeros((count, 0)))
    return test._replace(frame=np.broadcast_to([first, second], (count, 2)))


@pytest.mark.parametrize("num_samples", [0, 2])
def test_a_one_step_model_is_rolled_out_to_the_second_frames(num_samples):
    model, test = Riser(), later(100, 4, 10)
    test.pose[:, 0, 2] = np.linspace(-0.1, 0.1, 100)
    known = {"num_samples": num_samples}
    found = evaluation.predict(model, ("visual", "pose"), test, physics.Freefall(), **known)
    np.testing.assert_allclose(found.pose[:, 2], test.pose[:, 0, 2] + 0.03, atol=1e-6)
    assert found.visual.shape == (100, 4, 4, 3)
    np.testing.assert_array_equal(found.outcome, np.where(found.pose[:, 2] < -0.005, FELL, RESTS))
    assert [call["steps"] for call in model.calls] == [3, 3]
    np.testing.assert_allclose(model.calls[0]["time"], 0.2)  # frame 4, with 0.05 s per frame
    every = evaluation.rollout(model, ("visual", "pose"), test, physics.Freefall(), steps=3, **known)
    assert [float(frame.pose[0, 2]) for frame in every] == pytest.approx([-0.09, -0.08, -0.07], abs=1e-6)
    jax.tree.map(np.testing.assert_array_equal, every[-1], found)
    if num_samples:
        assert found.samples.visual.dtype == np.uint8
        assert found.samples.pose.shape == (2, 100, 7)
        np.testing.assert_allclose(every[0].samples.pose[1, :, 2], test.pose[:, 0, 2] + 1.01, atol=1e-6)


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (None, "the pairs have no `frame`, which a one-step model needs"),
        ([[0, 6], [0, 8]], r"are 6, 8 frames apart, but a step of the model takes 2: .* frames=\(t, t \+ k \* 2\)\)"),
        ([[0, 5], [1, 6]], "are 5 frames apart, but a step of the model takes 2"),
        ([[6, 0], [6, 0]], "are -6 frames apart"),
    ],
)
def test_frames_that_no_number_of_steps_connects_are_refused(frames, message):
    test = later(2)._replace(frame=None if frames is None else np.array(frames))
    with pytest.raises(ValueError, match=message):
        evaluation.predict(Riser(), ("visual", "pose"), test, physics.Freefall())


def test_a_state_space_model_is_only_rolled_out_from_frame_0():
    """The engine's object at frame 4 moves, but a roll-out of this model would begin at rest."""
    model = Riser()
    model.model = types.SimpleNamespace(config=statespace.Config(inputs=("visual",), outcomes=1, stride=2))
    known = ("visual", "pose"), later(2, 4, 10), physics.Freefall()
    for function, more in ((evaluation.predict, {}), (evaluation.rollout, {"steps": 3})):
        with pytest.raises(ValueError, match=r"begin at frame 4, but .* at rest, as in frame 0: .*frames=\(0, t\)"):
            function(model, *known, **more)
        assert model.calls == []
    evaluation.predict(model, ("visual", "pose"), later(2), physics.Freefall())
    assert model.calls[0]["steps"] == 3


def test_a_model_of_the_last_frame_is_not_rolled_out():
    with pytest.raises(ValueError, match=r"predicts the last frame, and has no steps: use evaluation\.predict"):
        evaluation.rollout(Echo(), ("visual",), later(2), physics.Freefall(), steps=2)


TIMES, SIDE = 3, 4
COLLECTION = dataset.Collection(physics.Freefall(), num_objects=2, num_per_object=2, resolution=(2 * SIDE, 2 * SIDE))
OFF_FIRST = np.array([0.0, 1.0, -1.0])  # m, added to z in the re-rolls of an item


def starts():
    """Two starts of object 1, then one of object 0."""
    test = pairs([0, 0, 0], np.zeros((3, 0)))
    rng = np.random.default_rng(0)
    test.pose[:, 0, :3] = rng.uniform(0, 0.05, (3, 3))
    quat = rng.normal(size=(3, 4))
    test.pose[:, 0, 3:] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    return test._replace(object=np.array([1, 1, 0]))


@pytest.fixture
def engine(monkeypatch):
    """Replace the simulation by ends above or below the starts that `simulate` receives.

    The grey value of a picture depends on the object and on z. Pictures are twice as large as those of the items.
    """
    seen = {}

    def simulate(key, bodies, sensor, scenario, num, *, start, engine, progress):
        which, nth = np.repeat(np.arange(len(bodies)), num), np.tile(np.arange(num), len(bodies))
        start = check_start(start, scenario, len(which))
        seen.update(bodies=bodies, start=start)
        pose = jnp.stack([start.pose, start.pose + jnp.zeros(7).at[2].set(1) * OFF_FIRST[nth][:, None]], 1)
        nothing = jnp.zeros((len(which), 2, 6))
        rest = dict.fromkeys(physics.Trajectory._fields)
        outcome = jax.vmap(scenario.outcome)(pose[:, 0], pose[:, 1])
        return physics.Trajectory(**{**rest, "pose": pose, "wrench": nothing, "outcome": outcome})

    def render(sensor, body, pose, wrench, *, resolution, crop):
        grey = jnp.round(100 + 50 * pose[:, 2] + 10 * (body.shell_mass == seen["bodies"][0].shell_mass))
        image = jnp.broadcast_to(grey[:, None, None, None], (len(pose), *resolution, 3)).astype(jnp.uint8)
        return image, image, image[..., 0] > 0

    monkeypatch.setattr(references.physics, "simulate", simulate)
    monkeypatch.setattr(references.dataset, "render_uint8", render)
    return seen


def test_every_reroll_begins_at_the_start_of_its_item_and_its_end_is_a_sample(engine):
    test = starts()
    found = evaluation.ceiling(COLLECTION, sts.Sensor(), test, TIMES, jax.random.key(0))
    assert found.samples.pose.shape == (TIMES, 3, 7)
    for number, off in enumerate(OFF_FIRST):
        expected = test.pose[:, 0].copy()
        expected[:, 2] += off
        np.testing.assert_allclose(found.samples.pose[number], expected, atol=1e-6)
    np.testing.assert_allclose(found.pose[:, :3], test.pose[:, 0, :3], atol=1e-4)  # the median of -1, 0 and 1 m
    assert (np.asarray(engine["start"].held) == COLLECTION.scenario.steps).all()  # released at rest in frame 0
    assert not np.asarray(engine["start"].carried).any()
    # Each item is drawn with its own object: the first body of the engine is object 1.
    assert found.samples.tactile.shape == (TIMES, 3, SIDE, SIDE, 3)
    ends = 100 + 50 * found.samples.pose[..., 2]
    np.testing.assert_allclose(found.samples.visual[..., 0, 0, 0], ends + np.array([10, 10, 0]), atol=0.51)
    np.testing.assert_allclose(found.visual, found.samples.visual.mean(0) / 255, rtol=1e-6)
    # Two of three stay, and one falls off. One more re-roll is spread evenly.
    rests = [outcome == physics.Outcome.RESTS for outcome in COLLECTION.scenario.outcomes]
    np.testing.assert_allclose(found.outcome_probability[:, rests.index(True)], 2.5 / 4)
    assert found.outcome.tolist() == [physics.Outcome.RESTS] * 3


def test_rerolls_give_the_frames_that_the_pairs_have(engine):
    test = starts()
    for number, off in ((0, np.zeros(3)), (1, OFF_FIRST)):
        at = test._replace(frame=np.broadcast_to([0, number], (3, 2)))
        found = evaluation.ceiling(COLLECTION, sts.Sensor(), at, TIMES, jax.random.key(0))
        np.testing.assert_allclose(found.samples.pose[:, :, 2], test.pose[:, 0, 2] + off[:, None], atol=1e-6)
    with pytest.raises(ValueError, match="begin at frame 1, but a re-roll begins at rest in frame 0"):
        evaluation.ceiling(COLLECTION, sts.Sensor(), at._replace(frame=at.frame + 1), TIMES, jax.random.key(0))


def test_bad_calls_are_refused():
    with pytest.raises(ValueError, match="times must be >= 1"):
        evaluation.ceiling(COLLECTION, sts.Sensor(), starts(), 0, jax.random.key(0))
    with pytest.raises(ValueError, match="`test` has 0 trajectories: choose"):
        evaluation.predict(Echo(), ("visual",), starts().take(slice(0)), physics.Freefall())
