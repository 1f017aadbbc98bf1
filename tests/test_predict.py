"""Predictors: any subset and batch shape, clear errors, one compilation per shape and subset."""

import dataclasses
import itertools
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize
from statespace_config import STATE, finite, same, state_model, untrained

import sts_jax as sts
from sts_jax import mvae, statespace, training
from sts_jax.predict import MODELS
from sts_jax.prediction import predict

SIDE = 32
pytestmark = pytest.mark.filterwarnings("ignore:(visual|tactile|pose) ")  # the images and poses are random

MODALITIES = (
    mvae.Modality("visual", "image", (SIDE, SIDE, 3)),
    mvae.Modality("tactile", "image", (SIDE, SIDE, 3)),
    mvae.Modality("pose", "vector", (12,)),
)
SMALL = mvae.Config(MODALITIES, latent=8, hidden=16, widths=(4, 4, 4, 4))


@pytest.fixture(scope="module")
def predictor(tmp_path_factory):
    path = tmp_path_factory.mktemp("mvae") / "saved"
    untrained(SMALL).save(path)
    return sts.Predictor.load(path)


@pytest.fixture(scope="module")
def traced(predictor):
    return jax.jit(lambda given: predictor(**given))


@pytest.fixture(scope="module")
def state_predictor(tmp_path_factory):
    path = tmp_path_factory.mktemp("statespace") / "saved"
    state_model().save(path)
    numbers = statespace.Calibration(*(jnp.full(8, x) for x in (0.8, 0.9, 1.5, 30.0)))
    training.save_calibration(path, numbers, STATE.inputs)
    return sts.Predictor.load(path)


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
def test_any_subset_and_any_leading_axes(predictor, names):
    lead = ((), (2,), (2, 3))[len(names) - 1]
    given = {name: value for name, value in measurement(*lead).items() if name in names}
    out = predictor(**given)
    assert out.visual.shape == out.tactile.shape == (*lead, SIDE, SIDE, 3)
    assert out.pose.shape == (*lead, 7)
    assert out.mean.shape == out.log_var.shape == (*lead, 8)
    np.testing.assert_allclose(np.linalg.norm(out.pose[..., 3:], axis=-1), 1, rtol=1e-5)
    assert np.all(out.pose[..., 3] >= 0)
    if lead == (2, 3):  # a prediction does not depend on the other items
        alone = predictor(**{name: value[0, 0] for name, value in given.items()})
        np.testing.assert_allclose(alone.visual, out.visual[0, 0], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mvae", "statespace"])
def test_a_prediction_depends_neither_on_its_place_nor_on_the_batch(request, kind):
    predictor = request.getfixturevalue("predictor" if kind == "mvae" else "state_predictor")
    given = {name: np.repeat(value[[0, 1]], 10, axis=0) for name, value in measurement(2).items()}  # more than a chunk
    if kind == "statespace":
        given["condition"] = np.repeat(CONDITION, 10, axis=0)
    known = {"key": jax.random.key(3), "num_samples": 4}

    def item(prediction, i):
        samples = [np.asarray(x)[:, i] for x in prediction.samples[:3]]
        return jax.tree.map(lambda x: x[i], prediction._replace(samples=None)), samples

    out = predictor(**given, **known)
    for i in range(1, 10):
        same(item(out, i), item(out, 0))
    alone = predictor(**{name: value[0] for name, value in given.items()}, **known)
    close(item(out, 0), (alone._replace(samples=None), list(alone.samples[:3])), atol=1e-4)
    wide = predictor(**{name: x.reshape(4, 5, *x.shape[1:]) for name, x in given.items()}, **known)
    assert wide.samples.pose.shape == (4, 4, 5, 7)
    same(jax.tree.map(lambda x: x.reshape(20, *x.shape[2:]), wide._replace(samples=None)), out._replace(samples=None))
    several = predictor(**given, **{**known, "key": jax.random.split(known["key"], 20)}).samples.pose
    assert np.abs(several[:, 1] - several[:, 0]).max() > 1e-3  # keys of their own give samples of their own
    with pytest.raises(ValueError, match=r"key has shape \(3,\)"):
        predictor(**given, **{**known, "key": jax.random.split(known["key"], 3)})


def test_masked_and_untouched_items_fall_back_on_the_rest(predictor):
    given = measurement(3)
    given["visual"][1] = np.nan
    given["tactile"][2] = 178 / 255  # no contact
    out = predictor(**given, present={"visual": np.array([True, False, True])})
    finite(out)
    for i, name in ((1, "tactile"), (2, "visual")):
        close(out.mean[i], predictor(**{name: given[name][i]}, pose=given["pose"][i]).mean)


def test_each_shape_and_subset_is_compiled_once(predictor):
    predictor(pose=measurement(4)["pose"])
    before = predict._cache_size()
    for seed in range(3):
        predictor(pose=measurement(4, seed=seed)["pose"])
    assert predict._cache_size() == before
    predictor(**measurement(4))
    assert predict._cache_size() == before + 1


GIVEN, POSE = measurement(2), measurement()["pose"]
CONDITION = np.array([[4.0, -9.0, 0.07], [-4.0, 9.0, 0.12]], np.float32)


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ({}, ValueError, "nothing to predict from: give at least one of visual, tactile, pose"),
        ({"visual": GIVEN["visual"][:, 1:]}, ValueError, r"has shape \(2, 31, 32, 3\).*resolution=\(32, 32\)"),
        (
            {"visual": GIVEN["visual"][..., 0]},
            ValueError,
            r"are grey.*np\.repeat\(image\[\.\.\., None\], 3",
        ),
        ({"visual": GIVEN["visual"][0, :, :, :1]}, ValueError, r"are grey.*np\.repeat\(image, 3, -1\)"),
        ({"visual": np.zeros((2, 48, 64), np.float32)}, ValueError, "are grey"),
        ({"visual": GIVEN["visual"][..., [0, 1, 2, 2]]}, ValueError, r"4 channels \(RGBA\?\).*image\[\.\.\., :3\]"),
        (
            {"tactile": np.moveaxis(GIVEN["tactile"], -1, 1)},
            ValueError,
            r"are first.*np\.moveaxis\(image, -3, -1",
        ),
        ({"visual": GIVEN["visual"][..., :2]}, ValueError, "the last axis must be the 3 channels"),
        ({"visual": GIVEN["visual"].reshape(2, -1)}, ValueError, "the last axis must be the 3 channels"),
        ({"visual": GIVEN["visual"][0], "pose": GIVEN["pose"]}, ValueError, r"leading axes differ.*array\[None\]"),
        ({"visual": GIVEN["visual"] * 255}, ValueError, "visual has values in .*divide by 255"),
        ({"visual": (GIVEN["visual"] * 255).astype(np.uint8)}, ValueError, "visual is uint8.*divide"),
        ({"tactile": GIVEN["tactile"] * np.nan}, ValueError, "tactile has NaN"),
        ({"pose": np.where(np.arange(7) == 4, 1e30, POSE)}, ValueError, r"quaternion of length 1e\+30"),
        ({"pose": POSE + 40 * np.eye(7, dtype=np.float32)[0]}, ValueError, "give metres"),
        ({**GIVEN, "pose": POSE}, ValueError, r"leading axes differ.*'pose': \(\)"),
        ({**GIVEN, "state": np.zeros((2, statespace.STATE_CODE))}, ValueError, "does not accept state"),
        ({**GIVEN, "condition": np.zeros((2, 3))}, ValueError, r"condition has shape \(2, 3\), but .* needs None"),
        ({**GIVEN, "present": {"pose": np.ones(2)}}, ValueError, r"present\['pose'\] is float64"),
        ({**GIVEN, "num_samples": 3}, ValueError, "and a key if it is > 0"),
        ({"pose": POSE, "key": jax.random.split(jax.random.key(0)), "num_samples": 1}, ValueError, "key has shape"),
    ],
)
@pytest.mark.parametrize("jit", [False, True])
def test_each_invalid_input_is_named(predictor, given, error, message, jit):
    """Inside `jax.jit`, for constants."""
    with pytest.raises(error, match=message):
        jax.jit(lambda: predictor(**given))() if jit else predictor(**given)


def test_an_input_that_was_absent_in_training_is_refused():
    predictor = untrained(SMALL, absent=("tactile",))
    assert predictor.modalities == ("visual", "pose")
    with pytest.raises(ValueError, match=r"new cannot use tactile"):
        predictor(tactile=GIVEN["tactile"])
    assert predictor(visual=GIVEN["visual"]).tactile.shape == (2, SIDE, SIDE, 3)


@pytest.mark.parametrize("options", [{}, {"encode_condition": True, "prior": "conditional"}])
def test_a_condition_is_given_in_si_units(options):
    scale, image = (10.0, 10.0, 0.1), GIVEN["visual"]
    predictor = untrained(dataclasses.replace(SMALL, condition=3, **options), condition_scale=scale)
    model, wide = predictor.model, jnp.asarray(CONDITION / np.array(scale), jnp.float32)
    logits, _ = mvae.predict(model.graphdef, model.state, {"visual": jnp.asarray(image)}, condition=wide)
    np.testing.assert_allclose(
        predictor(visual=image, condition=CONDITION).visual, jax.nn.sigmoid(logits["visual"]), atol=1e-5
    )
    prior = predictor.prior((2,), condition=CONDITION)
    assert np.ptp(prior.pose, axis=0).max() > 1e-3
    np.testing.assert_allclose(prior.mean, mvae.prior(model.graphdef, model.state, 2, condition=wide).mean, atol=1e-6)
    ignored = predictor(visual=image, condition=CONDITION, present={"visual": np.zeros(2, bool)})
    np.testing.assert_allclose(ignored.log_var, prior.log_var, atol=1e-6)
    assert bool(np.any(prior.mean)) == bool(options)
    for wrong, message in ((None, r"condition has shape None, but .* needs \(2, 3\)"), (CONDITION * 1e3, "SI units")):
        with pytest.raises(ValueError, match=message):
            predictor(visual=image, condition=wrong)
    traced = jax.jit(lambda condition: predictor(visual=image, condition=condition))
    assert np.isnan(traced(CONDITION * np.array([[1], [1e3]])).pose).all(-1).tolist() == [False, True]


def test_a_category_is_predicted_as_probabilities():
    label = mvae.Modality("label", "category", (4,))
    predictor = untrained(dataclasses.replace(SMALL, modalities=(MODALITIES[0], label)))
    known = np.eye(4, dtype=np.float32)
    predicted = predictor(measurements={"label": known}).measurements["label"]
    logits, _ = mvae.predict(predictor.model.graphdef, predictor.model.state, {"label": jnp.asarray(known)})
    np.testing.assert_allclose(predicted, jax.nn.softmax(logits["label"]), atol=1e-6)
    np.testing.assert_allclose(predicted.sum(-1), 1, rtol=1e-5)


def test_only_state_space_models_are_calibrated(predictor):
    with pytest.raises(ValueError, match="mvae model"):
        training.calibrate(predictor.name, training.Arrays({}, {}))


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        ("predictor", None, r"config\.json is not valid: .* training\.train\(.*, preprocessing="),
        ("state_predictor", {"resolution": [16, 16]}, "was trained with resolution=.*, but its networks need"),
        ("state_predictor", {"crop": True}, "was trained with crop="),
        ("state_predictor", {"rotation": "quaternion"}, "was trained with rotation="),
        ("state_predictor", {"position_scale": 0.1}, "was trained with position_scale="),
    ],
)
def test_a_model_without_its_preprocessing_is_refused(kind, change, message, request, monkeypatch):
    path = request.getfixturevalue(kind).name
    model = training.load(path)
    preprocessing = {} if change is None else model.settings["preprocessing"] | change
    settings = model.settings | {"preprocessing": preprocessing}
    monkeypatch.setattr(training, "load", lambda _: model._replace(settings=settings))
    with pytest.raises(ValueError, match=message):
        sts.Predictor.load(path)


@pytest.mark.parametrize("kind", ["predictor", "state_predictor"])
@pytest.mark.parametrize("compact", [False, True])
def test_a_saved_predictor_predicts_the_same(kind, compact, request, tmp_path):
    original, copy = request.getfixturevalue(kind), tmp_path / "copy"
    original.save(copy, compact=compact)
    again = sts.Predictor.load(copy)
    assert repr(again) == repr(original).replace(original.name, str(copy))
    assert (again.preprocessing, again.model.config) == (original.preprocessing, original.model.config)
    same(again.model.calibration, original.model.calibration)
    more = {"condition": CONDITION} if original.model.config.condition else {}
    close(again(**GIVEN, **more)._replace(pose=None), original(**GIVEN, **more)._replace(pose=None), 5e-3 * compact)
    again.save(tmp_path / "second", compact=compact)
    for path in copy.glob("*.*"):
        if path.name != "manifest.json":
            assert path.read_bytes() == (tmp_path / "second" / path.name).read_bytes()
    with pytest.raises(FileExistsError, match="copy is not an empty folder"):
        original.save(copy)


def close(a, b, atol=1e-5):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=atol), a, b)


def test_jit_vmap_and_floats_of_any_precision_predict_the_same(predictor):
    pose, present, key = GIVEN["pose"], {"visual": np.array([True, False])}, jax.random.key(0)
    sampled = jax.jit(lambda pose, key: predictor(pose=pose, key=key, num_samples=5))
    close(sampled(pose, key), predictor(pose=pose, key=key, num_samples=5))
    close(jax.vmap(lambda pose: predictor(pose=pose))(pose), predictor(pose=pose))
    masked = jax.jit(lambda present: predictor(**GIVEN, present=present))
    close(masked(present), predictor(**GIVEN, present=present))
    lying = np.array([0, 0, 0.5, 1, 0, 0, 0], np.float32)
    for dtype in (jnp.bfloat16, np.float64):
        close(predictor(pose=lying.astype(dtype)), predictor(pose=lying))


def test_the_gradient_of_a_prediction_equals_finite_differences(predictor):
    way, step = np.eye(7, dtype=np.float32)[1], 0.01
    height = jax.jit(lambda pose: 1e3 * predictor(pose=pose).pose[2])
    slope = (height(POSE + step * way) - height(POSE - step * way)) / (2 * step)
    np.testing.assert_allclose(jax.grad(height)(POSE)[1], slope, rtol=0.02)
    of_image = jax.grad(lambda image: predictor(visual=image).pose[0])(GIVEN["visual"][0])
    finite(of_image)
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
def test_only_an_invalid_traced_item_gives_nan(predictor, traced, name, change):
    given = {key: jnp.asarray(value) for key, value in GIVEN.items()}
    want = predictor(**given)
    wrong = {**given, name: change(given[name])}
    out = traced(wrong)
    for leaf, good in zip(jax.tree.leaves(out), jax.tree.leaves(want), strict=True):
        assert np.isnan(leaf[0]).all()
        np.testing.assert_allclose(leaf[1], good[1], atol=1e-5)
    with pytest.raises(ValueError, match=name):
        predictor(**wrong)


def test_a_state_space_model_predicts_samples_and_outcomes(state_predictor):
    given = measurement(2)
    given["visual"][1, 4:12, 6:20] = 0.1
    known = {"condition": CONDITION, "key": jax.random.key(0), "num_samples": 256}
    out = state_predictor(**given, **known)
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

    def first(prediction):
        return jax.tree.map(lambda x: x[0], prediction._replace(samples=None))

    broken = {**given, "visual": np.where(np.arange(2)[:, None, None, None] == 1, np.nan, given["visual"])}
    masked = {"visual": np.array([True, False])}
    nan = state_predictor(**broken, **known, present=masked)
    close(nan, state_predictor(**given, **known, present=masked), atol=0)
    finite(nan)
    close(first(nan), first(out))
    with pytest.raises(ValueError, match=r"state has shape \(2, 9\)"):
        state_predictor(**given, **known, state=np.zeros((2, 9), np.float32))
    nothing = state_predictor.prior((2,), condition=CONDITION)
    np.testing.assert_array_equal(np.stack([nothing.mean, nothing.log_var]), 0)
    assert np.abs(nothing.outcome_probability[0] - nothing.outcome_probability[1]).max() > 1e-4


@pytest.mark.slow
def test_a_state_space_model_works_in_jit_vmap_and_grad(state_predictor):
    def run(pose, condition):
        return state_predictor(pose=pose, condition=condition)

    pose, each = GIVEN["pose"], jax.jit(jax.vmap(run))
    want, out = run(pose, CONDITION), each(pose, CONDITION)
    close(want, run(pose, CONDITION), atol=0)  # without a key: the same at every call
    close(out.mean, want.mean)
    close(out.outcome_probability, want.outcome_probability)
    wrong = each(pose * np.array([[1], [np.nan]], np.float32), CONDITION)
    close(wrong.visual[0], out.visual[0])
    assert np.isnan(wrong.outcome_probability).all(-1).tolist() == [False, True]
    slope = jax.grad(lambda pose: run(pose, CONDITION).pose[:, 0].sum())(jnp.asarray(pose))
    finite(slope)
    assert np.abs(slope).max() > 0


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
    predictor.save("falls")  # a model of the library comes first, unless the name has a slash
    assert sts.Predictor.load("falls").model.config == STATE
    for own in ("./falls", pathlib.Path("./falls")):
        assert sts.Predictor.load(own).model.config == predictor.model.config


def test_the_work_directory_of_an_experiment_stands_for_its_only_model(state_predictor, predictor, tmp_path):
    workdir = tmp_path / "run"
    (workdir / "dataset").mkdir(parents=True)
    (workdir / "config.json").write_text("{}")
    state_predictor.save(workdir / "models/statespace")
    assert sts.Predictor.load(workdir).model.config == STATE
    predictor.save(workdir / "models/mvae")
    with pytest.raises(ValueError, match=r"has 2 models: give one of .*models/mvae, .*models/statespace"):
        sts.Predictor.load(workdir)


def test_models_of_the_library_are_small_calibrated_and_name_their_outcomes():
    for folder in sorted(path.parent for path in MODELS.glob("*/config.json")):
        assert sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) <= 12e6
        predictor = sts.Predictor.load(folder.name)
        scenario = getattr(sts.physics, folder.name.capitalize())()
        assert predictor.outcomes == tuple(scenario.named(int(outcome)) for outcome in scenario.outcomes)
        assert predictor.model.calibration is not None
