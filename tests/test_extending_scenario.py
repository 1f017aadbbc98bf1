"""The scenarios of `docs/extending.md`, which the library does not contain, from starts to evaluation.

The experiment also has its own loss, optimiser, logger, metric and column.
"""

import dataclasses
import enum
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from extending_page import blocks
from physics_scenes import solid_block
from test_extending_experiments import summary, tiny

import sts_jax as sts
from experiments import perturbed
from experiments.shared import run
from sts_jax import dataset, evaluation, physics

ENGINES = ["mujoco", pytest.param("mjx", marks=pytest.mark.slow)]
FRICTION = 0.4


@pytest.fixture(scope="module")
def page() -> dict:
    """The names that the code of the page defines."""
    names: dict = {}
    exec("\n".join(blocks("A new scenario")), names)
    return names


@pytest.fixture(scope="module")
def block() -> sts.objects.Body:
    """A flat block, which slides and does not topple."""
    return solid_block(np.array([0.04, 0.04, 0.008]), 0.1)


def simulated(scenario, body, num, engine):
    """Trajectories of empty objects with a known friction."""
    ones = np.ones(num, np.float32)
    hidden = physics.Hidden(0 * ones, ones, FRICTION * ones, np.tile(np.float32([0, 0, 1]), (num, 1)))
    trajectory = physics.simulate(
        jax.random.key(1), body, sts.Sensor(), scenario, num, hidden=hidden, chunk=num, engine=engine
    )
    return jax.tree.map(np.asarray, trajectory)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_pushed_block_starts_with_its_velocity_and_slides_as_far_as_coulomb_says(page, block, engine):
    class Pushed(page["Rolled"]):
        """A block that lies flat."""

        def start(self, key, shape, pad):
            start = super().start(key, shape, pad)
            flat = jnp.array([1.0, 0, 0, 0])
            return start._replace(pose=shape.above(start.pose[:2], flat, -1e-5))

    scenario = Pushed(speed=(0.3, 0.5), frames=12, contact=physics.Contact())
    found = simulated(scenario, block, 3, engine)
    np.testing.assert_allclose(found.velocity[:, 0, :2], found.condition, atol=1e-6)
    np.testing.assert_allclose(found.velocity[:, 0, 2:], 0, atol=1e-6)
    speed = np.linalg.norm(found.condition, axis=1)
    moved = found.pose[:, -1, :2] - found.pose[:, 0, :2]
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), speed**2 / (2 * FRICTION * 9.81), rtol=0.03)
    far = np.linalg.norm(moved, axis=1, keepdims=True)
    np.testing.assert_allclose(moved / far, found.condition / speed[:, None], atol=0.02)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_block_on_a_tilting_pad_slides_as_a_float64_loop_does(page, block, engine):
    scenario = page["Tilting"](speed=(0.8, 0.9), frames=24)
    found = simulated(scenario, block, 2, engine)
    for row in range(2):
        rate, step, slid, speed = float(found.condition[row, 0]), scenario.contact.timestep, 0.0, 0.0
        for k in range((scenario.frames - 1) * scenario.steps):
            tilt = min(rate * k * step, scenario.steepest)
            pull = 9.81 * (math.sin(tilt) - FRICTION * math.cos(tilt))
            speed = max(0.0, speed + pull * step)
            slid += speed * step
        moved = found.pose[row, -1] - found.pose[row, 0]
        assert slid > 0.01
        np.testing.assert_allclose(moved[1], slid, rtol=0.05)
        np.testing.assert_allclose(found.gravity[row, -1], 9.81 * np.array([0, np.sin(0.5), -np.cos(0.5)]), rtol=1e-5)
    assert found.outcomes == (physics.Outcome.SLIDES,) * 2
    assert scenario.described(found.condition[0]) == f"angular speed {found.condition[0, 0]:.3g} rad/s"


def test_outcomes_of_the_scenario_have_names_and_are_counted(page):
    scenario, rolled = page["Rolled"](), page["rolled"]
    assert [scenario.named(number) for number in (1, 100, 101)] == ["fell off", "stops early", "rolls on"]
    with pytest.raises(ValueError, match=r"use scenario\.named\(10[01]\)"):
        _ = rolled.outcomes
    np.testing.assert_array_equal(rolled.outcome, jax.vmap(scenario.outcome)(rolled.pose[:, 0], rolled.pose[:, -1]))
    assert physics.variant(scenario, "wide-friction") == dataclasses.replace(scenario, friction=(0.3, 0.9))
    with pytest.raises(ValueError, match="needs the fields fill, shell_scale, tilt in Rolled"):
        physics.variant(scenario, "off")


TAKEN = enum.IntEnum("Taken", {"STOPS": 0})


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"outcomes": (physics.Outcome.RESTS,)}, r"add physics\.Outcome\.FELL_OFF"),
        ({"outcomes": (TAKEN.STOPS, physics.Outcome.FELL_OFF)}, r"0 to 7 are reserved for .* number your own outcomes"),
        ({"quantities": ()}, r"returns a condition of length 2, but scenario.quantities declares 0"),
        (
            {"quantities": (physics.Quantity("a", "s", 1.0), physics.Quantity("b", "m", 1.0, vector=True))},
            "scenario.quantities has the order a, b, but vectors must come before scalars",
        ),
        (
            {"outcomes": (physics.Outcome.FELL_OFF,)},
            r"scenario\.outcome returns 10\d, but the members .* have the values \[1\]",
        ),
    ],
)
def test_mistakes_in_a_scenario_are_named(page, changes, match):
    wrong = dataclasses.dataclass(frozen=True)(type("Wrong", (page["Rolled"],), changes))
    with pytest.raises(ValueError, match=match):
        physics.simulate(jax.random.key(0), page["bottle"], sts.Sensor(), wrong())


@pytest.mark.slow
def test_an_experiment_with_a_new_scenario_and_its_own_parts_goes_through_every_stage(page, tmp_path, capsys):
    names = {}
    exec("\n".join(blocks("A whole experiment with your own parts")), names)
    scenario, own = page["Rolled"](frames=16), names["own"]
    fewer = dataclasses.replace(perturbed.SMOKE.collection, num_objects=10)
    config = tiny(dataclasses.replace(perturbed.SMOKE, collection=fewer), scenario)
    run.main(config, tmp_path, own=own)
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert set(found["outcomes"]) <= {outcome.name.lower() for outcome in scenario.outcomes}
    assert sum(found["outcomes"].values()) == found["items"]
    assert any(title.startswith("state-space model") for title in found["predictors"])

    logged = [json.loads(line) for line in (tmp_path / "models/statespace/metrics.jsonl").read_text().splitlines()]
    printed = capsys.readouterr().out
    for record in logged:
        assert record["penalty"] > 0
        assert f"statespace {record['step']} {record['loss']}" in printed
    assert "farthest (mm)" in (tmp_path / "table.md").read_text()
    settings = json.loads((tmp_path / "models/statespace/config.json").read_text())
    assert settings["notes"] == {"optimiser": "AdamW, 1e-3"}

    data = dataset.load(tmp_path / "dataset")
    ends = data.ends(evaluation.rows_of(data)["test"]).pose
    copy = np.abs(ends[:, 0, :3] - ends[:, 1, :3]).max(1).mean()
    assert summary(tmp_path)["copy of the input"]["farthest"]["value"] == pytest.approx(copy, rel=1e-5)

    written = (tmp_path / "metrics.json").stat().st_mtime_ns
    run.main(config, tmp_path, own=own)
    assert (tmp_path / "metrics.json").stat().st_mtime_ns == written
    run.main(config, tmp_path, only="evaluate")  # again, because the list of metrics has changed
    assert "farthest" not in summary(tmp_path)["copy of the input"]
    with pytest.raises(ValueError, match=r"loss = 'given as loss='"):
        run.main(config, tmp_path, only="train")
