"""A further modality from one specification, from the dataset to the table, as `docs/extending.md` shows."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from extending_page import DOCS, blocks

import sts_jax as sts
from sts_jax import dataset, evaluation, training

NOTHING = np.full((32, 32, 3), 178, np.uint8)  # image of the empty sensor


def wrenches(data, trajectories):
    return data.trajectory["wrench"][trajectories][:, [0, -1]]


WRENCH = dataset.Measurement("wrench", (6,), wrenches, unit="N")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stands") / "dataset"
    scenario = sts.physics.Perturbed(frames=4)
    collection = dataset.Collection(
        scenario, categories=("bottle",), num_objects=3, num_per_object=2, num_full=0, resolution=(16, 16)
    )
    dataset.collect(collection, sts.Sensor(), folder)
    return dataset.load(folder)


@pytest.mark.slow
def test_pairs_have_the_measured_values(data):
    rows = np.array([4, 1])
    pairs = data.pairs(rows, measurements=(WRENCH,))
    np.testing.assert_array_equal(pairs.measurements["wrench"], data.trajectory["wrench"][[4, 1]][:, [0, -1]])
    assert np.abs(pairs.measurements["wrench"]).max() > 0.1
    assert len(pairs.take(slice(1)).measurements["wrench"]) == 1
    assert data.pairs(rows).measurements == {}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"measure": lambda data, rows: np.zeros((len(rows), 6))}, r"`measure` returned .* \(2, 6\).* \(2, 2, 6\)"),
        ({"measure": lambda data, rows: np.full((len(rows), 2, 6), np.inf)}, "`measure` returned infinite numbers"),
        (
            {"shape": (4, 4, 1), "measure": lambda data, rows: np.full((len(rows), 2, 4, 4, 1), 37.0)},
            r"return values in \[0, 1\]",
        ),
        ({"name": "pose"}, "name of a measurement is 'pose'"),
        ({"shape": (4, 4)}, r"shape is \(4, 4\)"),
        ({"scale": 0.0}, "scale is 0.0, but it must be > 0"),
        ({"shape": (32, 32, 3), "scale": 2.0}, "an image needs no scale"),
    ],
)
def test_a_wrong_measurement_of_a_dataset_is_named(data, changes, message):
    with pytest.raises(ValueError, match=message):
        data.pairs(np.array([0, 1]), measurements=(dataclasses.replace(WRENCH, **changes),))


# ---- Training and prediction. Load 2 follows from load 1, so that the truth is known. The images show nothing.


def loads(data, rows):
    """Load at rest (N): the first load times 3 minus 20."""
    first = data[rows]
    return np.stack([first, 3 * first - 20], axis=1)[..., None]


LOAD = dataset.Measurement("load", (1,), loads, unit="N", scale=50.0, weight=100.0)


def pairs_of(first, measurements=(LOAD,)):
    """Pairs with empty images, whose measurements are computed from an array in place of a dataset."""
    count = len(first)
    pose = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], np.float32), (count, 2, 1))
    values = {own.name: own.measure(first, np.arange(count)).astype(np.float32) for own in measurements}
    return dataset.Pairs(
        visual=np.tile(NOTHING, (count, 2, 1, 1, 1)),
        tactile=np.tile(NOTHING, (count, 2, 1, 1, 1)),
        segmentation=np.zeros((count, 2, 32, 32), bool),
        pose=pose,
        contact=np.zeros((count, 2), bool),
        condition=np.zeros((count, 0), np.float32),
        outcome=np.zeros(count, np.int32),
        object=np.arange(count, dtype=np.int32),
        trajectory=np.arange(count),
        support=np.zeros((count, 128), np.float32),
        mass=np.zeros(count, np.float32),
        com=np.zeros((count, 3), np.float32),
        measurements=values,
    )


def trained(folder, pairs, measurements=(LOAD,), steps=300):
    preprocessing = training.Preprocessing((32, 32))
    arrays, preprocessing = training.frame_arrays(pairs, (), preprocessing, NOTHING, measurements=measurements)
    model = training.paper_model((), preprocessing, measurements=measurements)
    model = dataclasses.replace(model, latent=8, hidden=32, widths=(4, 4, 4, 4))
    training.save_blank(folder, NOTHING, NOTHING)
    config = training.TrainConfig(
        steps=steps, batch_size=50, learning_rate=1e-2, encoder_epsilon=1e-3, log_every=steps, checkpoint_every=steps
    )
    fields = dataclasses.asdict(preprocessing)
    training.train(config, model, arrays, workdir=folder, absent=preprocessing.absent, preprocessing=fields)
    return sts.Predictor.load(folder)


@pytest.fixture(scope="module")
def predictor(tmp_path_factory):
    first = np.random.default_rng(0).uniform(0, 100, 200).astype(np.float32)
    return trained(tmp_path_factory.mktemp("load"), pairs_of(first))


def test_a_predictor_takes_and_returns_a_measurement_in_its_unit(predictor, tmp_path):
    first = np.random.default_rng(1).uniform(0, 100, (6, 4, 1)).astype(np.float32)
    truth = 3 * first - 20
    assert predictor.modalities == ("load",)
    prediction = predictor(measurements={"load": first}, key=jax.random.key(0), num_samples=2)
    assert np.mean((np.asarray(prediction.measurements["load"]) - truth) ** 2) < 0.05 * truth.var()
    assert prediction.samples.measurements["load"].shape == (2, 6, 4, 1)
    # A traced value that is not finite gives NaN in its item alone.
    traced = jax.jit(lambda x: predictor(measurements={"load": x}).measurements["load"])(
        jnp.asarray(first[0]).at[1].set(jnp.nan)
    )
    np.testing.assert_array_equal(np.isnan(traced[:, 0]), [False, True, False, False])
    np.testing.assert_allclose(traced[0], prediction.measurements["load"][0, 0], rtol=1e-4)
    predictor.save(tmp_path / "copy")
    again = sts.Predictor.load(tmp_path / "copy")(measurements={"load": first})
    np.testing.assert_array_equal(again.measurements["load"], prediction.measurements["load"])


@pytest.mark.parametrize(
    ("measurements", "message"),
    [
        ({"load": np.zeros(2, np.float32)}, r"load has shape \(2,\), but .* needs shape \(\.\.\., 1\)\.$"),
        ({"load": np.full(1, np.nan, np.float32)}, "load has NaN or infinite values"),
        ({}, "nothing to predict from: give at least one of load"),
    ],
)
def test_a_wrong_measurement_is_named(predictor, measurements, message):
    with pytest.raises(ValueError, match=message):
        predictor(measurements=measurements)


def test_values_that_were_not_measured_are_masked():
    def some(data, rows):
        values = loads(data, rows)
        values[0, 0], values[1, 1] = np.nan, np.nan
        return values

    late = dataclasses.replace(LOAD, name="late", measure=lambda *given: loads(*given) * [[[np.nan], [1]]])
    parts = (dataclasses.replace(LOAD, measure=some), late)
    pairs = pairs_of(np.array([10.0, 20.0, 30.0]), parts)
    preprocessing = training.Preprocessing((32, 32))
    arrays, preprocessing = training.frame_arrays(pairs, (), preprocessing, NOTHING, measurements=parts)
    assert preprocessing.absent == ("late",)
    assert training.Preprocessing.from_json(dataclasses.asdict(preprocessing)) == preprocessing
    assert set(arrays.inputs) == {"load"}
    np.testing.assert_array_equal(arrays.present["load"], [False, True, True])
    np.testing.assert_array_equal(arrays.target_present["load"], [True, False, True])
    np.testing.assert_allclose(arrays.targets["late"][:, 0], np.array([10, 40, 70]) / 50)

    learner = training.learner(training.paper_model((), preprocessing, measurements=parts), absent=preprocessing.absent)
    learner.check(arrays)
    graphdef, params, stats = learner.init(jax.random.key(0))

    @jax.jit
    @jax.value_and_grad
    def loss(params, batch):
        return learner.loss(graphdef, params, stats, jax.random.key(1), batch, jnp.float32(1))[0]

    filled = training.Arrays(**jax.tree.map(lambda x: np.nan_to_num(x, nan=123.0), vars(arrays)))
    (value, gradient), (same, again) = (loss(params, given.take(np.arange(3))) for given in (arrays, filled))
    assert np.isfinite(value)
    assert value == same
    assert float(optax.tree.norm(gradient)) == pytest.approx(float(optax.tree.norm(again)), rel=1e-6)


def test_measurements_are_scored_against_the_truth_and_the_baselines(predictor):
    def sometimes(data, rows):
        values = loads(data, rows)
        values[0, 1] = np.nan
        return values

    first = np.array([10.0, 40.0, 80.0, 20.0], np.float32)
    train, test = pairs_of(first[:2]), pairs_of(first, (dataclasses.replace(LOAD, measure=sometimes),))
    metric = evaluation.measurement_error(LOAD)
    scenario = sts.physics.Freefall()
    rows = evaluation.baselines(scenario, train, test)
    rows["model"] = evaluation.predict(predictor, ("load",), test, scenario)
    judge = evaluation.scorer(scenario, train, metrics=(metric,))
    scores = {name: judge(row, test) for name, row in rows.items()}
    summary = evaluation.summarise(scores, test, metrics=(metric,), num=20)["predictors"]
    errors = {name: row["load_error"] and row["load_error"]["value"] for name, row in summary.items()}
    truth = 3 * first[1:] - 20
    constant, copy, neighbour, below = evaluation.BASELINES
    assert errors[constant] == pytest.approx(np.abs(truth - 55).mean())  # 55: the mean of 3 * 10 - 20 and 3 * 40 - 20
    assert errors[copy] == pytest.approx(np.abs(truth - first[1:]).mean())
    assert errors[neighbour] == pytest.approx(np.abs(truth - 10).mean())  # all images are equal
    assert errors[below] is None
    predicted = np.asarray(predictor(measurements={"load": first[:, None]}).measurements["load"])[1:, 0]
    assert errors["model"] == pytest.approx(np.abs(truth - predicted).mean(), rel=1e-4)
    assert metric.title == "load error (N)"
    late = test._replace(measurements={"load": np.where([[[True], [False]]], np.nan, test.measurements["load"])})
    filled = evaluation.baselines(scenario, train, late)[copy].measurements["load"]
    np.testing.assert_allclose(filled, 55)  # the first frames were not measured
    with pytest.raises(ValueError, match=r"`inputs` contains 'load', but `test\.measurements` does not: make"):
        evaluation.predict(predictor, ("load",), test._replace(measurements={}), scenario)


@pytest.mark.slow
def test_the_code_of_the_page_trains_predicts_and_scores_a_force_and_a_sound(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    sound = rng.uniform(-1, 1, (64, 16)).astype(np.float32)
    pose = rng.uniform(-1, 1, (64, 12)).astype(np.float32)
    names = {"pose": pose, "sound": sound, "pose_after": sound[:, :12], "sound_after": sound}
    code, inputs = "\n".join(blocks("A further modality")), '("visual", "tactile", "pose")'
    assert (code.count("steps=2000"), code.count(inputs)) == (2, 1)
    exec(code.replace("steps=2000", "steps=4", 1).replace(inputs, '("visual",)'), names)  # 3 subsets in place of 15
    assert names["predictor"].modalities == ("visual", "force")
    assert names["prediction"].measurements["force"].shape == (len(names["test"].pose), 3)
    truth = names["data"].trajectory["wrench"][names["test"].trajectory][:, -1, :3]
    copy = names["data"].trajectory["wrench"][names["test"].trajectory][:, 0, :3]
    scored = names["summary"]["predictors"]["copy of the input"]["force_error"]["value"]
    assert scored == pytest.approx(np.linalg.norm(truth - copy, axis=1).mean(), rel=1e-4)
    assert "force error (N)" in capsys.readouterr().out
    error = np.mean((np.asarray(names["predicted"]["pose"]) - sound[:8, :12]) ** 2)
    assert error < 0.5 * np.mean((sound[:8, :12] - sound[:, :12].mean(0)) ** 2)


def test_the_page_names_files_and_functions_that_a_modality_of_a_state_space_model_changes():
    rows = re.findall(r"^\| `([\w/]+\.py)` \| (.*) \|$", (DOCS / "extending.md").read_text(), re.MULTILINE)
    assert len(rows) == 10
    for path, change in rows:
        code = (DOCS.parent / path).read_text()
        for name in re.findall(r"`(?:\w+\.)?(\w+)`", change):
            assert re.search(rf"\b{name}\b", code), f"{path} has no {name}"
