"""The predictor's promises: any subset, any batch shape, clear errors, one compilation a shape and subset."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sts_jax as sts
from sts_jax import mvae, training
from sts_jax.predict import predict

SIDE = 32


def train(folder, *, absent=(), condition_scale=()):
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (2, 6, SIDE, SIDE, 3), dtype=np.uint8)
    pose = np.concatenate([rng.normal(size=(6, 3)), np.tile([1.0, 0, 0, 0], (6, 1))], 1).astype(np.float32)
    preprocessing = training.Preprocessing(resolution=(SIDE, SIDE), absent=absent, condition_scale=condition_scale)
    code = np.asarray(preprocessing.encode_pose(jnp.asarray(pose)))
    moments = {"visual": images[0], "tactile": images[1], "pose": code}
    config = mvae.Config(
        tuple(
            mvae.Modality(name, "vector" if name == "pose" else "image", value.shape[1:])
            for name, value in moments.items()
        ),
        latent=8,
        hidden=16,
        widths=(4, 4, 4, 4),
        condition=len(condition_scale),
    )
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
    if lead:  # an item's prediction does not depend on its neighbours
        alone = predictor(**{name: value[(0,) * len(lead)] for name, value in given.items()})
        np.testing.assert_allclose(alone.visual, out.visual[(0,) * len(lead)], atol=1e-5)


def test_fusion_is_the_product_of_the_single_posteriors(predictor):
    given = measurement()
    parts = [predictor(**{name: value}) for name, value in given.items()]
    precision = 1 + sum(np.exp(-part.log_var) - 1 for part in parts)
    mean = sum(part.mean * np.exp(-part.log_var) for part in parts) / precision
    fused = predictor(**given)
    np.testing.assert_allclose(fused.log_var, -np.log(precision), atol=1e-4)
    np.testing.assert_allclose(fused.mean, mean, atol=1e-4)


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


def test_samples_scatter_about_the_mean(predictor):
    out = predictor(pose=measurement(2)["pose"], key=jax.random.key(0), num_samples=5)
    assert out.samples.visual.shape == (5, 2, SIDE, SIDE, 3)
    assert out.samples.pose.shape == (5, 2, 7)
    assert np.std(out.samples.pose[..., :3], axis=0).min() > 0
    again = predictor(pose=measurement(2)["pose"], key=jax.random.key(0), num_samples=5)
    np.testing.assert_array_equal(out.samples.pose, again.samples.pose)


def test_one_compilation_a_shape_and_subset(predictor):
    predictor(pose=measurement(4)["pose"])
    before = predict._cache_size()
    for seed in range(3):
        predictor(pose=measurement(4, seed=seed)["pose"])
    assert predict._cache_size() == before
    predictor(**measurement(4))
    assert predict._cache_size() == before + 1


def test_with_nothing_the_prior_speaks(predictor):
    out = predictor.prior((2,))
    np.testing.assert_array_equal(out.mean, 0)
    np.testing.assert_array_equal(out.visual[0], out.visual[1])


def broken(name, change):
    given = measurement(2)
    given[name] = change(given[name])
    return given


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "nothing to predict from: give at least one of visual, tactile, pose"),
        (broken("visual", lambda x: x[:, 1:]), r"visual has shape \(2, 31, 32, 3\).*resolution=\(32, 32\)"),
        (broken("visual", lambda x: x * 255), "visual has values in .*divide by 255"),
        (broken("visual", lambda x: (x * 255).astype(np.uint8)), "visual is uint8"),
        (broken("tactile", lambda x: x * np.nan), "tactile has NaN"),
        (broken("pose", lambda x: x * 2), "quaternion of length 2"),
        (broken("pose", lambda x: x[:, :6]), r"pose has shape \(2, 6\)"),
        (broken("pose", lambda x: x + np.eye(7, dtype=np.float32)[0] * 40), "millimetres"),
        (broken("pose", lambda x: x[0]), "the leading axes differ"),
        (measurement(0), "there is no item"),
        ({**measurement(2), "condition": np.zeros((2, 3))}, "condition has shape"),
        ({**measurement(2), "present": {"pose": np.ones(3, bool)}}, "present"),
        ({**measurement(2), "num_samples": 3}, "needs a key"),
    ],
)
def test_what_cannot_be_answered_is_named(predictor, given, message):
    with pytest.raises(ValueError, match=message):
        predictor(**given)


def test_a_touch_that_training_never_saw_is_refused(tmp_path):
    predictor = sts.Predictor.load(train(tmp_path / "mvae", absent=("tactile",)))
    assert predictor.modalities == ("visual", "pose")
    with pytest.raises(ValueError, match=r"mvae cannot use tactile"):
        predictor(tactile=measurement()["tactile"])
    assert predictor(visual=measurement()["visual"]).tactile.shape == (SIDE, SIDE, 3)


def test_a_condition_is_given_in_si_units(tmp_path):
    scale = np.array([10.0, 10.0, 0.1])
    predictor = sts.Predictor.load(train(tmp_path / "mvae", condition_scale=tuple(scale.tolist())))
    assert predictor.preprocessing.condition_scale == (10.0, 10.0, 0.1)
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
    samples = predictor(visual=given["visual"], condition=condition, key=jax.random.key(0), num_samples=2).samples
    assert samples.visual.shape == (2, 2, SIDE, SIDE, 3)
    for wrong, message in (
        (None, r"condition has shape None; .* needs \(2, 3\)"),
        (condition[0], r"needs \(2, 3\)"),
        (condition * np.nan, "condition has NaN"),
        (condition * 1e3, "SI units"),
    ):
        with pytest.raises(ValueError, match=message):
            predictor(visual=given["visual"], condition=wrong)
    with pytest.raises(ValueError, match="condition has shape None"):
        predictor.prior()


def test_a_checkpoint_of_another_view_is_refused(folder):
    sts.Predictor.load(folder, resolution=(SIDE, SIDE), crop=False)
    with pytest.raises(ValueError, match="crop=False, asked for is crop=True"):
        sts.Predictor.load(folder, crop=True)
    with pytest.raises(ValueError, match=r"resolution=\(32, 32\), asked for is resolution=\(64, 64\)"):
        sts.Predictor.load(folder, resolution=(64, 64))


def test_a_missing_or_torn_model_is_named(folder, tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        sts.Predictor.load(tmp_path / "nowhere")
    for path in folder.rglob("*"):
        if path.is_file():
            there = tmp_path / "torn" / path.relative_to(folder)
            there.parent.mkdir(parents=True, exist_ok=True)
            there.write_bytes(path.read_bytes())
    (tmp_path / "torn" / "config.json").write_text('{"model": ')
    with pytest.raises(ValueError, match=r"torn.*config\.json"):
        sts.Predictor.load(tmp_path / "torn")
    (tmp_path / "torn" / "config.json").write_bytes((folder / "config.json").read_bytes())
    (tmp_path / "torn" / "blank.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"blank\.npz"):
        sts.Predictor.load(tmp_path / "torn")
