"""Predictors: any subset and batch shape, clear errors, one compilation per shape and subset."""

import dataclasses
import itertools
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError
from scipy import optimize
from statespace_config import STATE, random_states, state_model

import sts_jax as sts
from sts_jax import mvae, statespace, training
from sts_jax.predict import MODELS
from sts_jax.prediction import predict

SIDE = 32


def train(folder, *, absent=(), condition_scale=()):
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (2, 6, SIDE, SIDE, 3), dtype=np.uint8)
    pose = np.concatenate([rng.normal(size=(6, 3)), np.tile([1.0, 0, 0, 0], (6, 1))], 1).astype(np.float32)
    preprocessing = training.Preprocessing(resolution=(SIDE, SIDE), absent=absent, condition_scale=condition_scale)
    code = np.asarray(preprocessing.encode_pose(jnp.asarray(pose)))
    moments = {"visual": images[0], "tactile": images[1], "pose": code}
    kinds = {"visual": "image", "tactile": "image", "pose": "vector"}
    modalities = tuple(mvae.Modality(name, kind, moments[name].shape[1:]) for name, kind in kinds.items())
    config = mvae.Config(modalities, latent=8, hidden=16, widths=(4, 4, 4, 4), condition=len(condition_scale))
    condition = rng.normal(size=(6, len(condition_scale))).astype(np.float32) if condition_scale else None
    training.save_blank(folder, images[0, 0], np.full((SIDE, SIDE, 3), 178, np.uint8))
    training.train(
        training.TrainConfig(steps=2, batch_size=4, log_every=1, checkpoint_every=2),
        config,
        training.Arrays({k: v for k, v in moments.items() if k not in absent}, moments, condition=condition),
        workdir=folder,
        absent=absent,
        preprocessing=dataclasses.asdict(preprocessing),
    )
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return train(tmp_path_factory.mktemp("mvae"))


@pytest.fixture(scope="module")
def predictor(folder):
    return sts.Predictor.load(folder)


def measurement(*lead, seed=0):
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(*lead, 4))
    return {
        "visual": rng.random((*lead, SIDE, SIDE, 3), np.float32),
        "tactile": rng.random((*lead, SIDE, SIDE, 3), np.float32),
        "pose": np.concatenate(
            [0.03 * rng.normal(size=(*lead, 3)), quat / np.linalg.norm(quat, axis=-1, keepdims=True)], -1
        ).astype(np.float32),
    }


@pytest.mark.parametrize(
    "names", [s for n in (1, 2, 3) for s in itertools.combinations(("visual", "tactile", "pose"), n)]
)
@pytest.mark.parametrize("lead", [(), (2,), (2, 3)])
def test_any_subset_and_any_leading_axes(predictor, names, lead):
    given = {name: value for name, value in measurement(*lead).items() if name in names}
    out = predictor(**given)
    assert out.visual.shape == out.tactile.shape == (*lead, SIDE, SIDE, 3)
    assert out.pose.shape == (*lead, 7)
    assert out.mean.shape == out.log_var.shape == (*lead, 8)
    np.testing.assert_allclose(np.linalg.norm(out.pose[..., 3:], axis=-1), 1, rtol=1e-5)
    assert np.all(out.pose[..., 3] >= 0)
    assert np.all((out.visual >= 0) & (out.visual <= 1))
    if lead:  # a prediction does not depend on the other items
        alone = predictor(**{name: value[(0,) * len(lead)] for name, value in given.items()})
        np.testing.assert_allclose(alone.visual, out.visual[(0,) * len(lead)], atol=1e-5)


def test_masked_and_untouched_items_fall_back_on_the_rest(predictor):
    given = measurement(3)
    given["visual"][1] = np.nan
    given["tactile"][2] = 178 / 255  # no contact
    out = predictor(**given, present={"visual": np.array([True, False, True])})
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(out))
    without = predictor(tactile=given["tactile"][1], pose=given["pose"][1])
    np.testing.assert_allclose(out.mean[1], without.mean, atol=1e-5)
    untouched = predictor(visual=given["visual"][2], pose=given["pose"][2])
    np.testing.assert_allclose(out.mean[2], untouched.mean, atol=1e-5)


def test_each_shape_and_subset_is_compiled_once(predictor):
    predictor(pose=measurement(4)["pose"])
    before = predict._cache_size()
    for seed in range(3):
        predictor(pose=measurement(4, seed=seed)["pose"])
    assert predict._cache_size() == before
    predictor(**measurement(4))
    assert predict._cache_size() == before + 1


def broken(name, change):
    given = measurement(2)
    given[name] = change(given[name])
    return given


GIVEN, POSE = measurement(2), measurement()["pose"]


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ({}, ValueError, "nothing to predict from: give at least one of visual, tactile, pose"),
        ({"visual": GIVEN["visual"][:, 1:]}, ValueError, r"has shape \(2, 31, 32, 3\).*resolution=\(32, 32\)"),
        (broken("visual", lambda x: x * 255), ValueError, "visual has values in .*divide by 255"),
        (broken("visual", lambda x: (x * 255).astype(np.uint8)), ValueError, "visual is uint8.*divide"),
        (broken("tactile", lambda x: x * np.nan), ValueError, "tactile has NaN"),
        (broken("pose", lambda x: np.where(np.arange(7) == 4, 1e30, x)), ValueError, r"quaternion of length 1e\+30"),
        (broken("pose", lambda x: x + np.eye(7, dtype=np.float32)[0] * 40), ValueError, "give metres"),
        (broken("pose", lambda x: x[0]), TypeCheckError, "pose"),
        ({**GIVEN, "condition": np.zeros((2, 3))}, ValueError, r"condition has shape \(2, 3\), but .* needs None"),
        ({**GIVEN, "present": {"pose": np.ones(2)}}, ValueError, r"present\['pose'\] is float64"),
        ({**GIVEN, "num_samples": 3}, ValueError, "and a key if it is > 0"),
        ({"pose": POSE, "key": jax.random.split(jax.random.key(0)), "num_samples": 1}, TypeCheckError, "key"),
    ],
)
@pytest.mark.parametrize("jit", [False, True])
def test_each_invalid_input_is_named(predictor, given, error, message, jit):
    """Inside `jax.jit`, for constants."""
    with pytest.raises(error, match=message):
        jax.jit(lambda: predictor(**given))() if jit else predictor(**given)


@pytest.mark.slow
def test_an_input_that_was_absent_in_training_is_refused(tmp_path):
    predictor = sts.Predictor.load(train(tmp_path / "mvae", absent=("tactile",)))
    assert predictor.modalities == ("visual", "pose")
    with pytest.raises(ValueError, match=r"mvae cannot use tactile"):
        predictor(tactile=measurement()["tactile"])
    assert predictor(visual=measurement()["visual"]).tactile.shape == (SIDE, SIDE, 3)


@pytest.mark.slow
def test_a_condition_is_given_in_si_units(tmp_path):
    scale = np.array([10.0, 10.0, 0.1])
    predictor = sts.Predictor.load(train(tmp_path / "mvae", condition_scale=tuple(scale.tolist())))
    given, condition = measurement(2), np.array([[4.0, -9.0, 0.07], [-4.0, 9.0, 0.12]])
    out = predictor(visual=given["visual"], condition=condition)
    logits, _ = mvae.predict(
        predictor.model.graphdef,
        predictor.model.state,
        {"visual": jnp.asarray(given["visual"])},
        condition=jnp.asarray(condition / scale),
    )
    np.testing.assert_allclose(out.visual, jax.nn.sigmoid(logits["visual"]), atol=1e-5)
    other = predictor(visual=given["visual"], condition=-condition)
    assert np.abs(other.visual - out.visual).max() > 1e-3
    nothing = predictor.prior((2,), condition=condition)
    assert np.abs(nothing.pose[0] - nothing.pose[1]).max() > 1e-3
    for wrong, message in ((None, r"condition has shape None, but .* needs \(2, 3\)"), (condition * 1e3, "SI units")):
        with pytest.raises(ValueError, match=message):
            predictor(visual=given["visual"], condition=wrong)
    traced = jax.jit(lambda condition: predictor(visual=given["visual"], condition=condition))
    assert np.isnan(traced(condition * np.array([[1], [1e3]])).pose).all(-1).tolist() == [False, True]


def test_a_checkpoint_of_another_view_is_refused(folder):
    sts.Predictor.load(folder, resolution=(SIDE, SIDE), crop=False)
    with pytest.raises(ValueError, match="crop=False, but crop=True is needed"):
        sts.Predictor.load(folder, crop=True)
    with pytest.raises(ValueError, match=r"resolution=\(32, 32\), but resolution=\(64, 64\) is needed"):
        sts.Predictor.load(folder, resolution=(64, 64))


def test_a_model_without_preprocessing_is_named(folder, monkeypatch):
    model = training.load(folder)
    settings = {**model.settings, "preprocessing": {}}
    monkeypatch.setattr(training, "load", lambda _: model._replace(settings=settings))
    with pytest.raises(ValueError, match=r"config\.json is not valid: .* training\.train\(.*, preprocessing="):
        sts.Predictor.load(folder)


def test_a_saved_predictor_is_loaded_unchanged(predictor, tmp_path):
    predictor.save(tmp_path / "copy")
    again = sts.Predictor.load(tmp_path / "copy")
    given = measurement(2)
    close(again(**given), predictor(**given), atol=0)
    assert repr(again) == repr(predictor).replace(predictor.name, str(tmp_path / "copy"))
    again.save(tmp_path / "second")
    for path in (tmp_path / "copy").glob("*.*"):
        if path.name != "manifest.json":
            assert path.read_bytes() == (tmp_path / "second" / path.name).read_bytes()
    with pytest.raises(FileExistsError, match="copy is not an empty folder"):
        predictor.save(tmp_path / "copy")
    train(tmp_path / "copy")  # A finished training is only read, for which the optimiser's state is not needed.
    assert [path.name for path in (tmp_path / "copy/checkpoints/00000002").iterdir() if path.is_dir()] == ["weights"]


def close(a, b, atol=1e-5):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=atol), a, b)


def test_jit_and_vmap_predict_the_same(predictor):
    given, present = measurement(2), {"visual": np.array([True, False])}
    more = {"key": jax.random.key(0), "num_samples": 5}
    want = predictor(pose=given["pose"], **more)
    close(jax.jit(lambda pose, key: predictor(pose=pose, key=key, num_samples=5))(given["pose"], more["key"]), want)
    close(jax.vmap(lambda pose: predictor(pose=pose))(given["pose"]), predictor(pose=given["pose"]))
    masked = predictor(**given, present=present)
    close(jax.jit(lambda present: predictor(**given, present=present))(present), masked)


def test_the_gradient_of_a_prediction_equals_finite_differences(predictor):
    pose, way = measurement()["pose"], np.eye(7, dtype=np.float32)[1]
    height = jax.jit(lambda pose: 1e3 * predictor(pose=pose).pose[2])
    slope = jax.grad(height)(pose)[1]
    step = 0.01
    np.testing.assert_allclose(slope, (height(pose + step * way) - height(pose - step * way)) / (2 * step), rtol=0.02)
    image = measurement()["visual"]
    of_image = jax.grad(lambda image: predictor(visual=image).pose[0])(image)
    assert np.isfinite(of_image).all()
    assert np.abs(of_image).max() > 0


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("visual", lambda x: x.at[0, 3, 4, 0].set(jnp.nan)),
        ("tactile", lambda x: x.at[0].set(jnp.nan)),  # no pixel differs from the blank gel by a comparison with NaN
        ("visual", lambda x: x.at[0].multiply(255)),
        ("pose", lambda x: x.at[0, 3:].set(0)),
        ("pose", lambda x: x.at[0, 0].set(40)),
        ("pose", lambda x: x.at[0, 2].set(jnp.inf)),
    ],
)
def test_only_an_invalid_traced_item_gives_nan(predictor, name, change):
    given = {key: jnp.asarray(value) for key, value in measurement(2).items()}
    want = predictor(**given)
    wrong = {**given, name: change(given[name])}
    out = jax.jit(lambda given: predictor(**given))(wrong)
    for leaf, good in zip(jax.tree.leaves(out), jax.tree.leaves(want), strict=True):
        assert np.isnan(leaf[0]).all()
        np.testing.assert_allclose(leaf[1], good[1], atol=1e-5)
    with pytest.raises(ValueError, match=name):
        predictor(**wrong)


def test_floats_of_any_precision_are_accepted(predictor):
    pose = np.array([0, 0, 0.5, 1, 0, 0, 0], np.float32)
    for dtype in (jnp.bfloat16, np.float64):
        close(predictor(pose=pose.astype(dtype)), predictor(pose=pose))


@pytest.fixture(scope="module")
def state_predictor(tmp_path_factory):
    folder = tmp_path_factory.mktemp("statespace") / "saved"
    state_model().save(folder)
    return sts.Predictor.load(folder)


CONDITION = np.array([[4.0, -9.0, 0.07], [-4.0, 9.0, 0.12]], np.float32)
SAMPLES = {"key": jax.random.key(0), "num_samples": 256}


def test_a_state_space_model_predicts_samples_and_outcomes(state_predictor):
    given = measurement(2)
    given["visual"][1, 4:12, 6:20] = 0.1
    present = {"visual": np.array([True, True])}
    out = state_predictor(**given, condition=CONDITION, present=present, **SAMPLES)
    assert out.visual.shape == out.tactile.shape == (2, 16, 16, 3)
    assert out.samples.visual.shape == out.samples.tactile.shape == (256, 2, 16, 16, 3)
    np.testing.assert_allclose(out.outcome_probability.sum(-1), 1, rtol=1e-5)
    assert out.outcome_probability.shape == (2, STATE.outcomes)
    np.testing.assert_allclose(out.tactile, out.samples.tactile.mean(0), atol=1e-6)
    np.testing.assert_allclose(out.visual, out.samples.visual.mean(0), atol=0.05)  # of sharp outlines
    np.testing.assert_allclose(np.linalg.norm(out.samples.pose[..., 3:], axis=-1), 1, rtol=1e-5)
    assert np.std(out.samples.pose[..., :3], axis=0).min() > 0
    # The belief has the given pose, because its expert is by far the most precise.
    code = state_predictor.preprocessing.encode_pose(jnp.asarray(given["pose"]))
    np.testing.assert_allclose(out.mean[:, :12], code, atol=0.02)
    for i in range(2):  # the pose is the centre of the samples
        place, quat = np.split(np.asarray(out.samples.pose[:, i], np.float64), [3], axis=1)
        turned = 2 * np.arccos(np.clip(np.abs(quat @ quat.T), 0, 1))
        apart = np.linalg.norm(place[:, None] - place, axis=-1) + 0.02 * turned
        np.testing.assert_allclose(out.pose[i, 3:], quat[apart.mean(0).argmin()], atol=1e-6)
        best = optimize.minimize(lambda x, place=place: np.linalg.norm(place - x, axis=1).mean(), place.mean(0))
        np.testing.assert_allclose(out.pose[i, :3], best.x, atol=1e-4 * place.std())

    broken = {**given, "visual": np.where(np.arange(2)[:, None, None, None] == 1, np.nan, given["visual"])}
    masked = {"visual": np.array([True, False])}
    nan = state_predictor(**broken, condition=CONDITION, present=masked, **SAMPLES)
    close(nan, state_predictor(**given, condition=CONDITION, present=masked, **SAMPLES), atol=0)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(nan))
    close(
        jax.tree.map(lambda x: x[0], nan._replace(samples=None)),
        jax.tree.map(lambda x: x[0], out._replace(samples=None)),
    )


@pytest.mark.slow
def test_a_state_space_model_works_in_jit_vmap_and_grad(state_predictor):
    pose, condition = measurement(2)["pose"], CONDITION
    want = state_predictor(pose=pose, condition=condition)
    close(want, state_predictor(pose=pose, condition=condition), atol=0)  # without a key: the same at every call
    each = jax.jit(jax.vmap(lambda pose, condition: state_predictor(pose=pose, condition=condition)))
    out = each(pose, condition)
    close(out.mean, want.mean)
    close(out.outcome_probability, want.outcome_probability)
    wrong = each(pose * np.array([[1], [np.nan]], np.float32), condition)
    close(wrong.visual[0], out.visual[0])
    assert np.isnan(wrong.outcome_probability).all(-1).tolist() == [False, True]
    slope = jax.grad(lambda pose: state_predictor(pose=pose, condition=condition).pose[:, 0].sum())(jnp.asarray(pose))
    assert np.isfinite(slope).all()
    assert np.abs(slope).max() > 0


@pytest.mark.slow
def test_a_true_state_determines_the_belief_and_the_prior_is_standard_normal(state_predictor, predictor):
    given, code = measurement(2), np.asarray(random_states(np.random.default_rng(0), 2))
    out = state_predictor(visual=given["visual"], condition=CONDITION, state=code)
    np.testing.assert_allclose(out.mean[:, : statespace.STATE_CODE], code, atol=2e-3)
    with pytest.raises(ValueError, match=r"state has shape \(2, 9\)"):
        state_predictor(visual=given["visual"], condition=CONDITION, state=code[:, :9])
    with pytest.raises(ValueError, match="does not accept state"):
        predictor(pose=given["pose"], state=code)
    nothing = state_predictor.prior((2,), condition=CONDITION)
    np.testing.assert_array_equal(nothing.mean, 0)
    np.testing.assert_array_equal(nothing.log_var, 0)
    assert np.abs(nothing.outcome_probability[0] - nothing.outcome_probability[1]).max() > 1e-4


@pytest.mark.parametrize(
    "change", [{"resolution": (16, 16)}, {"crop": True}, {"rotation": "quaternion"}, {"position_scale": 0.1}]
)
def test_a_state_space_model_of_another_view_is_refused(tmp_path, change):
    state_model(**change).save(tmp_path / "model")
    with pytest.raises(ValueError, match=f"networks of .* was trained with {next(iter(change))}="):
        sts.Predictor.load(tmp_path / "model")


@pytest.mark.parametrize("kind", ["predictor", "state_predictor"])
def test_a_compact_copy_predicts_nearly_the_same(kind, request, tmp_path):
    original = request.getfixturevalue(kind)
    original.save(tmp_path / "copy", compact=True)
    again = sts.Predictor.load(tmp_path / "copy")
    assert (again.preprocessing, again.model.config) == (original.preprocessing, original.model.config)
    assert (again.model.step, again.model.graphdef) == (original.model.step, original.model.graphdef)
    more = {"condition": CONDITION} if original.model.config.condition else {}
    given = measurement(2)
    out, want = again(**given, **more), original(**given, **more)
    for name in ("visual", "tactile", "mean", "log_var"):
        np.testing.assert_allclose(getattr(out, name), getattr(want, name), atol=5e-3)


def test_a_model_of_the_library_is_loaded_by_its_name(state_predictor, predictor, tmp_path, monkeypatch):
    monkeypatch.setattr("sts_jax.predict.MODELS", tmp_path / "library")
    state_predictor.save(tmp_path / "library/falls")
    monkeypatch.chdir(tmp_path)
    assert repr(sts.Predictor.load("falls")).startswith("Predictor('falls': takes visual, tactile, pose; ")
    (tmp_path / "falls").mkdir()  # no model is in it
    assert sts.Predictor.load(pathlib.Path("falls")).model.config == STATE
    with pytest.raises(FileNotFoundError, match=r"'freefal' is neither .* come with sts_jax \(falls\)"):
        sts.Predictor.load("freefal")
    with pytest.raises(FileNotFoundError, match=r"falls has no config\.json"):
        sts.Predictor.load(tmp_path / "falls")
    predictor.save("falls")
    assert sts.Predictor.load("falls").model.config == predictor.model.config


# experiments.ship wrote them and checked their size.
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name == "freefall" else pytest.mark.slow)
        for name in sorted(path.parent.name for path in MODELS.glob("*/config.json"))
    ],
)
def test_each_model_of_the_library_predicts_from_vision(name, tmp_path, monkeypatch):
    assert sum(path.stat().st_size for path in (MODELS / name).rglob("*") if path.is_file()) <= 12e6
    monkeypatch.chdir(tmp_path)
    predictor = sts.Predictor.load(name)
    visual = training.load_blank(MODELS / name)[0].astype(np.float32) / 255
    visual[40:80, 50:70] *= 0.3  # a dark object
    condition = np.array(predictor.preprocessing.condition_scale) / 2
    out = predictor(visual=visual, condition=condition if condition.size else None)
    size = predictor.model.config.image_size
    assert out.visual.shape == out.tactile.shape == (size, size, 3)
    scenario = getattr(sts.physics, name.capitalize())()
    assert predictor.outcomes == tuple(scenario.named(int(outcome)) for outcome in scenario.outcomes)
    assert out.outcome_probability.shape == (len(predictor.outcomes),)
    assert predictor.model.calibration is not None
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(out))
