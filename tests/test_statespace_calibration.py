"""Calibration of the final pose's density: closed forms, subsets of the inputs, and the file in a model's folder."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from scipy import special
from statespace_config import STATE, random_codes, random_densities, random_states, state_model, trajectories

from sts_jax import evaluation, statespace, storage, training
from sts_jax.statespace import calibration, objective, predict

NUMBER = 40
NUMBERS = statespace.Calibration(*(jnp.asarray(np.linspace(low, 2, 8), jnp.float32) for low in (0.5, 0.7, 0.9, 1.1)))


def arrays(**changes):
    parts = trajectories(NUMBER)
    for part in (parts["inputs"], parts["empty"]):
        part |= {name: np.round(255 * part[name]).astype(np.uint8) for name in statespace.IMAGES}
    return training.Arrays(**parts | changes)


@pytest.fixture
def folder(tmp_path):
    """A model without a calibration."""
    state_model().save(tmp_path / "model")
    return tmp_path / "model"


def test_corrections_are_powers_and_a_factor():
    final = random_densities(np.random.default_rng(0), 5, components=2)
    found = predict.corrected(final, jnp.float32(0.5), jnp.float32(2.0), jnp.float32(3.0))
    power = np.exp(np.asarray(final.outcome)) ** 0.5
    np.testing.assert_allclose(np.exp(found.outcome), power / power.sum(1, keepdims=True), rtol=1e-5)
    weight = np.exp(np.asarray(final.weight)) ** 2
    np.testing.assert_allclose(np.exp(found.weight), weight / weight.sum(2, keepdims=True), rtol=1e-5)
    np.testing.assert_allclose(np.exp(found.log_var), 3 * np.exp(final.log_var), rtol=1e-5)
    np.testing.assert_array_equal(found.mean, final.mean)


@pytest.mark.parametrize("spread", [np.sqrt(1.7), 0.3])
def test_fitted_variance_is_the_mean_of_squared_deviations_but_never_below_one(spread):
    """For one component, the most likely factor is the mean over items and dimensions of error^2 / variance."""
    rng, number = np.random.default_rng(1), 400
    code, pose = random_states(rng, number), random_codes(rng, number)
    outcome = rng.integers(0, 3, number)
    turn = np.asarray(objective.rotation_between(code, pose)).reshape(number, 9)
    move = np.concatenate([np.asarray(pose), turn], axis=1)[:, None, None]
    final = random_densities(rng, number)
    scatter = spread * np.exp(0.5 * np.asarray(final.log_var)) * rng.normal(size=final.mean.shape)
    final = final._replace(mean=jnp.asarray(move - scatter, jnp.float32))
    fitted = calibration._fitted(final, code, pose, jnp.asarray(outcome))
    chosen = np.arange(number), outcome, 0
    error = move[:, 0, 0] - np.asarray(final.mean)[chosen]
    expected = np.mean(error**2 / np.exp(np.asarray(final.log_var)[chosen]))
    np.testing.assert_allclose(expected, spread**2, rtol=0.1)
    np.testing.assert_allclose(fitted[2], max(expected, 1), rtol=0.01)


@pytest.mark.parametrize("true", [0.6, 1.5])
def test_fitted_power_recovers_the_power_of_drawn_outcomes(true):
    rng, number = np.random.default_rng(2), 4000
    code, pose = random_states(rng, number), random_codes(rng, number)
    final = random_densities(rng, number)
    chance = special.softmax(true * np.asarray(final.outcome, np.float64), axis=1)
    outcome = np.array([rng.choice(3, p=row) for row in chance])
    assert abs(calibration._fitted(final, code, pose, jnp.asarray(outcome))[0] / true - 1) < 0.1


@pytest.mark.slow
def test_each_item_is_corrected_by_the_numbers_of_its_inputs():
    """Items whose masks differ give the same density as if each were alone."""
    given = jax.tree.map(jnp.asarray, trajectories(8))
    graphdef, params, _ = statespace.init(jax.random.key(0), STATE)
    present = {name: jnp.arange(8) // 2**i % 2 == 1 for i, name in enumerate(STATE.inputs)}

    @jax.jit
    def run(params, given):
        parts = nnx.merge(graphdef, params), given["inputs"], present, given["empty"], given["condition"]
        return [predict.predict(*parts, correction)[1] for correction in (None, NUMBERS)]

    plain, found = run(params, given)
    for i in range(8):
        expected = predict.corrected(plain, *(x[i] for x in NUMBERS[:3]))
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a[i], b[i], rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_fitted_contrast_has_the_gradient_energy_of_the_true_images():
    """The energy at a contrast is that of samples. True images of this energy, plus 0.2 %, lead to this contrast."""
    given, chosen = arrays(), ["visual", "pose"]
    graphdef, params, _ = statespace.init(jax.random.key(0), STATE)
    params["decoder"]["last"]["bias"][...] += 3.0  # an untrained decoder covers hardly any pixel
    chunks = list(calibration._chunks(given.inputs, given.empty, given.condition, chosen, np.arange(NUMBER)))
    given = jax.tree.map(jnp.asarray, chunks[0])  # a call draws its samples for a whole chunk
    num, key = calibration._SAMPLES, jax.random.split(jax.random.key(0), calibration._CHUNK)
    sample = jax.jit(functools.partial(predict.sample, graphdef, num=num, drawn=num))
    noise = np.random.default_rng(1).random((NUMBER, STATE.image_size, STATE.image_size, 3))
    noise /= np.sqrt(evaluation.metrics.gradient_energy(noise))[:, None, None, None]
    for contrast in calibration.CONTRASTS:
        numbers = statespace.Calibration(*(jnp.full(8, x) for x in (1.0, 1.0, 1.0, contrast)))
        drawn = sample(params, key, *given, numbers)
        energy = evaluation.metrics.gradient_energy(np.asarray(drawn.images["visual"][:, :NUMBER])).mean()
        target = np.asarray(noise * np.sqrt(1.002 * energy), np.float32)
        assert calibration._contrast(graphdef, params, chunks, target, np.ones(3)) == contrast
    blank = np.zeros_like(target, np.uint8)  # all objects fell off
    assert calibration._contrast(graphdef, params, chunks, blank, np.ones(3)) == statespace.CONTRAST


@pytest.mark.slow
def test_a_calibration_is_fitted_again_only_if_it_is_damaged_or_the_data_differ(folder, monkeypatch):
    path, given = folder / "calibration.json", arrays(present={"tactile": np.zeros(NUMBER, bool)})
    for number, row in enumerate(np.asarray(training.calibrate(folder, given).calibration).T):
        absent = number == 0 or bool(number & 2 ** STATE.inputs.index("tactile"))
        assert (row == (1, 1, 1, statespace.CONTRAST)).all() == absent, number
    whole = path.read_text()
    for damaged in (whole.replace('"variance": ', '"variance": 1', 1), None):
        path.unlink() if damaged is None else path.write_text(damaged)
        with pytest.raises(storage.DamagedFileError, match=r"calibration\.json.*calibrate again"):
            training.load(folder)
    training.calibrate(folder, given)
    assert path.read_text() == whole
    monkeypatch.setattr(statespace, "fit_calibration", None)  # a call would fail
    training.calibrate(folder, given)
    with pytest.raises(TypeError):
        training.calibrate(folder, arrays())


def test_a_calibration_of_older_weights_is_not_kept(folder, monkeypatch):
    def meanwhile(*_, **__):
        listed = storage.read_manifest(folder, "")
        storage.write_manifest(folder, listed.files, {**listed.facts, "step": listed.facts["step"] + 1})
        return NUMBERS

    monkeypatch.setattr(statespace, "fit_calibration", meanwhile)
    with pytest.raises(ValueError, match="was trained on while its calibration was fitted"):
        training.calibrate(folder, arrays())
    assert not (folder / "calibration.json").exists()


@pytest.mark.parametrize("moment", [1, 2])
def test_a_kill_while_a_calibration_is_written_leaves_a_valid_model(folder, monkeypatch, moment):
    training.save_calibration(folder, NUMBERS, STATE.inputs)
    writes, write = [], storage.write_json

    def killed(path, content):
        writes.append(path.name)
        if len(writes) > moment:
            raise KeyboardInterrupt
        write(path, content)

    monkeypatch.setattr(storage, "write_json", killed)
    with pytest.raises(KeyboardInterrupt):
        training.save_calibration(folder, NUMBERS, STATE.inputs)
    assert writes == ["manifest.json", "calibration.json", "manifest.json"][: moment + 1]
    with pytest.warns(UserWarning, match=r"calibration\.json is not used"):
        assert training.load(folder).calibration is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "content is"),
        ({"data": 1}, "subsets is missing"),
        ({"data": "a", "subsets": {}}, "data is 'a'"),
        ({"data": 1, "subsets": {"a": {"outcome": 1, "weight": 1, "variance": 1}}}, r"subsets\.a\.contrast is missing"),
        ({"data": 1, "subsets": {"a": dict.fromkeys(NUMBERS._fields, -1)}}, r"outcome is -1"),
        ({"data": 1, "subsets": {"a": dict.fromkeys(NUMBERS._fields, 1)}}, "that of other inputs"),
    ],
)
def test_absurd_content_of_a_calibration_is_named_with_its_field(folder, content, message):
    training.save_calibration(folder, NUMBERS, STATE.inputs)
    storage.write_json(folder / "calibration.json", content)
    listed = storage.read_manifest(folder, "")
    storage.write_manifest(folder, listed.files | storage.checksums(folder, ["calibration.json"]), listed.facts)
    with pytest.raises(storage.DamagedFileError, match=rf"calibration\.json .*{message}"):
        training.load(folder)


def test_a_calibration_that_the_manifest_does_not_list_is_not_used_without_a_word(folder):
    storage.write_json(folder / "calibration.json", {})
    with pytest.warns(UserWarning, match=r"calibration\.json is not used, .*Calibrate again"):
        assert training.load(folder).calibration is None


def test_a_new_checkpoint_drops_the_calibration(folder):
    training.save_calibration(folder, NUMBERS, STATE.inputs)
    model = training.load(folder)
    np.testing.assert_array_equal(model.calibration, NUMBERS)
    training.save(folder, training.TrainState(model.state, nnx.State({}), None, jnp.int32(1)))
    assert training.load(folder).calibration is None
    assert not (folder / "calibration.json").exists()


def test_items_with_only_the_true_state_have_the_values_of_no_input():
    found = predict.of_items(STATE, NUMBERS, {"state": jnp.ones(3, bool)})
    for values, numbers in zip(found, NUMBERS, strict=True):
        np.testing.assert_array_equal(values, np.repeat(numbers[0], 3))
