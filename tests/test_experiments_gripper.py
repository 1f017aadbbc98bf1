"""The command `gripper`: its lifts against statics, its networks, the arithmetic of its table, and a small run."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from flax import nnx

from experiments import gripper
from experiments.shared import grasping, judging
from experiments.shared.grasping import Hidden, Lifts

G = 9.81


@pytest.mark.parametrize("name", gripper.PRESETS)
def test_every_preset_can_be_run_and_no_object_is_in_two_parts(name):
    config = gripper.PRESETS[name]
    gripper.check(config)
    parts = config.lifts.split()
    assert sorted(np.concatenate(list(parts.values()))) == list(range(config.lifts.num_objects))


@pytest.mark.parametrize(
    ("lifts", "fields", "message"),
    [
        ({"num_objects": 0}, {}, "num_objects must be >= 1"),
        ({"num_objects": 3}, {}, "shares .* of num_objects = 3 leave a part of the split without objects"),
        ({"categories": ("teapot",)}, {}, "category is 'teapot'"),
        ({"friction": (0.9, 0.3)}, {}, "friction is 0.9 to 0.3, but it must be two numbers > 0"),
        ({"resolution": 50}, {}, "resolution must be a multiple of 16 pixels, got 50"),
        ({}, {"seeds": ()}, "seeds must be one or more different"),
        ({}, {"seeds": (1, 1)}, "seeds must be one or more different"),
        ({}, {"training": judging.Training(steps=0)}, "steps must be >= 1"),
    ],
)
def test_a_wrong_field_is_an_error_before_anything_is_written(lifts, fields, message, tmp_path):
    config = dataclasses.replace(gripper.SMOKE, lifts=dataclasses.replace(gripper.SMOKE.lifts, **lifts), **fields)
    with pytest.raises(ValueError, match=message):
        gripper.main(config, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_lifts_are_drawn_from_their_ranges_and_do_not_depend_on_other_objects():
    lifts = Lifts(num_per_object=200)
    points = np.asarray(lifts.body(1).hulls, np.float64).reshape(-1, 3)
    hidden, grasp = grasping.draw(lifts, 1, points)
    assert lifts.friction[0] <= hidden.friction.min() < hidden.friction.max() <= lifts.friction[1]
    assert lifts.grip[0] <= hidden.grip.min() < hidden.grip.max() <= lifts.grip[1]
    assert hidden.mass.max() / hidden.mass.min() <= lifts.density[1] / lifts.density[0]
    assert 0.022 <= grasp.height.min() < grasp.height.max() <= lifts.highest
    again, _ = grasping.draw(dataclasses.replace(lifts, num_objects=7), 1, points)
    np.testing.assert_array_equal(hidden.mass, again.mass)
    other, _ = grasping.draw(lifts, 2, points)
    assert not np.allclose(hidden.friction, other.friction)


def test_the_fingers_close_on_the_narrow_side():
    corners = np.array(np.meshgrid([-0.03, 0.03], [-0.01, 0.01], [0, 0.05])).reshape(3, -1).T
    angle = grasping._narrow(corners)
    assert abs(np.cos(angle)) < 0.06  # the long side of 60 mm lies along the fingers
    assert grasping._narrow(corners[:, [1, 0, 2]]) == pytest.approx(0)


@pytest.mark.parametrize("number", [0, 1])  # a bottle and a camera
def test_a_lift_holds_if_friction_carries_the_load_of_the_shake(number):
    """Two fingers carry at most 2 mu F. The load is m g at rest and m (g + a) at the turning points of the shake."""
    lifts, friction = Lifts(num_per_object=3), 0.5
    body = lifts.body(number)
    _, grasp = grasping.draw(dataclasses.replace(lifts, offset=0.0, lean=0.0), number, _points(body))
    mass = 0.08
    loads = mass * np.array([1.4 * (G + lifts.shake), G + 0.3 * lifts.shake, 0.8 * G])
    hidden = Hidden(np.full(3, mass), np.full(3, friction), loads / (2 * friction))
    models = [grasping.model_of(lifts, body, hidden, grasp, index) for index in range(3)]
    slid = grasping.slid(grasping.simulate(lifts, models, grasp.height))
    assert slid[0] < 1e-3  # holds
    assert slid[1] > 2e-3  # slides while the hand shakes
    assert slid[2] > grasping.LOST  # stays on the table


def test_the_hand_shakes_with_the_stated_acceleration():
    lift, opening = grasping.controls(0.03, 6.0).T
    acceleration = np.diff(lift, 2)[grasping.LIFTED : grasping.SHAKEN - 2] / grasping.DT**2
    assert np.abs(acceleration).max() == pytest.approx(6.0, rel=0.01)
    assert lift[0] == pytest.approx(0.03)
    assert lift[grasping.MOMENT - 1] - 0.03 == pytest.approx(grasping.FIRST_LIFT, abs=1e-6)
    assert lift[-1] - 0.03 == pytest.approx(grasping.FIRST_LIFT + grasping.LIFT, abs=1e-6)
    assert opening[0] == grasping.OPENING
    assert not opening[grasping.CLOSED :].any()


def test_the_order_of_the_fingers_does_not_matter():
    judge = judging.Judge((2, 32, 32, 3), 0.3, nnx.Rngs(0))
    judge.eval()
    images = jax.random.uniform(jax.random.key(0), (3, 2, 32, 32, 3))
    decide = nnx.jit(lambda judge, images: judge(images))
    logits = decide(judge, images)
    np.testing.assert_allclose(logits, decide(judge, images[:, ::-1]), atol=1e-5)
    assert np.std(logits) > 1e-4


def synthetic(n=300):
    """Lifts of 30 objects that hold if the grip force of the left finger is above 2 N."""
    rng = np.random.default_rng(0)
    wrench = rng.normal(2, 1, (n, 2, 6)).astype(np.float32)
    data = {"wrench": wrench, "opening": np.ones(n, np.float32), "held": wrench[:, 0, 2] > 2}
    parts = dict(zip(("train", "validation", "test"), np.split(np.arange(n), [200, 240]), strict=True))
    return data, parts


def test_a_network_learns_the_rule_of_a_toy_problem_and_repeats_itself():
    data, parts = synthetic()
    options = judging.Training(steps=200, batch_size=50)
    found = judging.judged(options, data, parts, judging.FORCES, 0)
    assert np.mean((found > 0.5) == data["held"][parts["test"]]) > 0.9
    np.testing.assert_array_equal(found, judging.judged(options, data, parts, judging.FORCES, 0))


def test_scores_are_those_of_the_definitions():
    probability = np.array([[0.9, 0.4, 0.2], [0.6, 0.6, 0.4]])
    scores = gripper.score(probability, np.array([True, True, False]))
    np.testing.assert_allclose(scores["accuracy"], [1, 0.5, 1])
    np.testing.assert_allclose(scores["log loss"][0], -(np.log(0.9) + np.log(0.6)) / 2)
    np.testing.assert_allclose(scores["log loss"][2], -(np.log(0.8) + np.log(0.6)) / 2)


def test_intervals_are_over_objects_and_differences_are_paired():
    """If touch is better by the same amount in every lift, the difference has no spread, and each score has one."""
    rng, objects = np.random.default_rng(0), np.repeat(np.arange(20), 5)
    loss = np.repeat(rng.uniform(0, 1, 20), 5)
    scores = {name: {"accuracy": loss, "log loss": loss} for name in ("vision", "touch")}
    scores["vision and touch"] = {name: row - 0.1 for name, row in scores["vision"].items()}
    numbers = gripper.summarise(scores, objects)
    difference, single = numbers["vision and touch - touch"]["log loss"], numbers["touch"]["log loss"]
    assert difference["low"] == pytest.approx(-0.1) == difference["high"]
    spread = 1.96 * loss[::5].std() / np.sqrt(20)
    assert single["high"] - single["value"] == pytest.approx(spread, rel=0.2)


@pytest.mark.slow
def test_a_small_run_writes_its_results_and_goes_on_where_it_stopped(tmp_path, capsys):
    gripper.main(gripper.SMOKE, tmp_path)
    files = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    names = {path.relative_to(tmp_path).as_posix() for path in files}
    assert {"table.md", "metrics.json", "figures/grasps.png", "figures/lifts.png", "manifest.json"} <= names
    numbers, text = json.loads((tmp_path / "metrics.json").read_text()), capsys.readouterr().out
    for name in (gripper.CONSTANT, *judging.INPUTS):
        assert f"| {name} | {numbers[name]['accuracy']['value']:.3f} [" in text
    arrays = dict(np.load(tmp_path / "dataset" / "lifts-000.npz"))
    assert arrays["visual"].shape == arrays["tactile"].shape == (12, 2, 32, 32, 3)
    lifted = arrays["slid"] < 1e-3
    np.testing.assert_allclose(arrays["wrench"][lifted, :, 2], arrays["grip"][lifted, None] * [1, 1], rtol=0.1)
    weight = -arrays["wrench"][lifted, :, 1].sum(axis=1)
    np.testing.assert_allclose(weight, G * arrays["mass"][lifted], rtol=0.05)

    gripper.main(gripper.SMOKE, tmp_path)  # complete
    assert all(path.stat().st_mtime_ns == time for path, time in files.items() if not path.name.startswith(".lock"))
    (tmp_path / "scores" / "touch-seed0.npz").unlink()
    (tmp_path / "table.md").unlink()
    gripper.main(gripper.SMOKE, tmp_path)
    again = {path for path, time in files.items() if path.stat().st_mtime_ns != time}
    assert not {path for path in again if path.parent.name == "dataset"}
    assert json.loads((tmp_path / "metrics.json").read_text()) == numbers


def _points(body):
    return np.asarray(body.hulls, np.float64).reshape(-1, 3)
