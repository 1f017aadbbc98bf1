"""Probes find a linear map that exists, and nothing in shuffled quantities."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import sklearn.linear_model
from statespace_config import untrained
from test_evaluation_results import pairs

from sts_jax import dataset, evaluation, mvae
from sts_jax.evaluation import metrics, probes

pytestmark = pytest.mark.filterwarnings("ignore:(visual|tactile|pose) ")  # the images and poses are random

SIDE = 32
NAMES = ("bottle", "fork", "spoon")
CONFIG = mvae.Config(
    (
        mvae.Modality("visual", "image", (SIDE, SIDE, 3)),
        mvae.Modality("tactile", "image", (SIDE, SIDE, 3)),
        mvae.Modality("pose", "vector", (12,)),
    ),
    latent=8,
    hidden=16,
    widths=(4, 4, 4, 4),
)


def test_ridge_is_scikit_learns_with_its_penalty_per_item_and_variance():
    rng = np.random.default_rng(0)
    penalties = np.array([1e-3, 1.0, 100.0])
    for count, width in ((50, 6), (6, 50)):
        features, targets = rng.normal(2, 3, (count, width)), rng.normal(size=(count, 2))
        weights, offsets = probes.ridge(features, targets, penalties)
        for k, penalty in enumerate(penalties):
            oracle = sklearn.linear_model.Ridge(alpha=penalty * count * features.var(0).mean()).fit(features, targets)
            np.testing.assert_allclose(weights[k], oracle.coef_.T, atol=1e-9)
            np.testing.assert_allclose(offsets[k], oracle.intercept_, atol=1e-9)


def test_the_probe_of_constant_features_is_the_mean():
    weights, offsets = probes.ridge(np.ones((4, 3)), np.arange(4.0)[:, None], np.array([0.1]))
    assert not weights.any()
    np.testing.assert_allclose(offsets, [[1.5]])


def linear(shuffled, count=900, width=12):
    """Features of three parts, and quantities that are linear in them, or belong to other items."""
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(width, 9))
    features, found = {}, {}
    for part in ("train", "validation", "test"):
        x = rng.normal(size=(count, width))
        y = x @ directions
        order = rng.permutation(count) if shuffled else np.arange(count)
        label = np.argmax(y[:, :3], 1)[order]
        features[part], y = x, y[order]
        found[part] = probes.Quantities(label, y[:, 3:4], y[:, 4:7], y[:, 7:8], y[:, 8:9])
    return features, found


def scores(features, found):
    return {name: metrics.skill(*error.T) for name, error in probes.errors(features, found).items()}


def test_a_linear_map_is_recovered():
    found = scores(*linear(shuffled=False))
    assert found.pop("class") > 0.9
    np.testing.assert_allclose(list(found.values()), 1, atol=1e-6)


def test_shuffled_quantities_have_no_r2_and_shuffled_classes_the_accuracy_of_chance():
    features, found = linear(shuffled=True)
    scored = scores(features, found)
    largest = np.bincount(found["test"].label).max() / len(found["test"].label)
    assert scored.pop("class") == pytest.approx(largest, abs=0.06)
    np.testing.assert_allclose(list(scored.values()), 0, atol=0.03)


def test_the_penalty_is_chosen_on_the_validation_part():
    """With more features than items, no penalty fits the noise: the chosen one is better out of sample than none."""
    rng = np.random.default_rng(2)
    truth, features, found = rng.normal(size=(200, 1)), {}, {}
    for part, count in (("train", 60), ("validation", 60), ("test", 300)):
        features[part] = rng.normal(size=(count, 200))
        y = features[part] @ truth + 20 * rng.normal(size=(count, 1))
        label = np.arange(count) % 2
        found[part] = probes.Quantities(label, y, np.repeat(y, 3, 1), y, np.zeros((count, 1)))
    scored = scores(features, found)
    assert "area" not in scored  # it is constant
    weights, offsets = probes.ridge(features["train"], found["train"].size, np.array([1e-6]))
    rest = ((features["test"] @ weights[0] + offsets[0] - found["test"].size) ** 2).sum()
    assert scored["size"] > 1 - rest / ((found["test"].size - found["train"].size.mean()) ** 2).sum()
    assert scored["colour"] == pytest.approx(scored["size"])


def frames(count, seed):
    """Pairs whose images, masks and forces are known, and their dataset."""
    rng = np.random.default_rng(seed)
    made = pairs(np.zeros(count), np.zeros((count, 0)))
    visual, tactile = (rng.integers(0, 256, (count, 2, SIDE, SIDE, 3), np.uint8) for _ in range(2))
    made = made._replace(
        visual=visual,
        tactile=tactile,
        segmentation=rng.random((count, 2, SIDE, SIDE)) < 0.3,
        object=np.arange(count) // 2,
        support=rng.random((count, 128)).astype(np.float32),
    )
    made.pose[..., :3] = 0.02 * rng.normal(size=(count, 2, 3))
    force = rng.normal(size=(count, 4, 6)).astype(np.float32)
    data = object.__new__(dataset.Dataset)  # without files
    object.__setattr__(data, "trajectory", {"wrench": force})
    return made, data


def test_quantities_are_those_of_the_first_of_the_two_frames():
    made, data = frames(6, 0)
    blank = np.zeros((SIDE, SIDE, 3), np.uint8)
    made.tactile[:] = 0
    made.tactile[:, 0, :8, :16] = 200  # an eighth of the image
    made.segmentation[1, 0] = False
    found = probes.quantities(data, made, NAMES, blank)
    assert found.label.tolist() == [0, 0, 1, 1, 2, 2]
    np.testing.assert_allclose(found.area, 1 / 8)
    np.testing.assert_allclose(found.force[:, 0], data.trajectory["wrench"][:, 0, 2])
    np.testing.assert_allclose(found.size[:, 0], 2 * made.support.mean(1), rtol=1e-6)
    for item in (0, 2):
        colour = made.visual[item, 0][made.segmentation[item, 0]].mean(0) / 255
        np.testing.assert_allclose(found.colour[item], colour, rtol=1e-5)
    assert np.isnan(found.colour[1]).all()
    later = made._replace(frame=np.tile([2, 3], (6, 1)))
    np.testing.assert_allclose(
        probes.quantities(data, later, NAMES, blank).force[:, 0], data.trajectory["wrench"][:, 2, 2]
    )


@pytest.fixture(scope="module")
def predictor():
    return untrained(CONFIG)


@pytest.mark.slow
def test_latents_are_the_predictors(predictor):
    made, _ = frames(70, 0)  # more than a chunk
    made.tactile[::2, 0] = np.round(255 * predictor.empty["tactile"])  # no contact
    for inputs in (("visual",), ("tactile",), ("visual", "tactile", "pose")):
        given = {name: getattr(made, name)[:, 0] for name in inputs}
        given = {name: jnp.float32(x / 255 if name != "pose" else x) for name, x in given.items()}
        want = np.asarray(predictor(**given).mean)
        np.testing.assert_allclose(probes.latents(predictor, inputs, made), want, atol=1e-4)


def test_latents_of_a_one_step_model_depend_on_the_condition_and_the_time():
    config = dataclasses.replace(CONFIG, condition=3, encode_condition=True, prior="conditional")
    predictor = untrained(config, condition_scale=(10.0, 0.1, 1.0), stride=2, period=0.04)
    made, rng = frames(5, 0)[0], np.random.default_rng(1)
    made = made._replace(condition=rng.normal(size=(5, 2)).astype(np.float32), frame=np.tile([6, 8], (5, 1)))
    given = {"visual": jnp.float32(made.visual[:, 0] / 255), "pose": jnp.asarray(made.pose[:, 0])}
    want = predictor.rollout(given, 1, condition=made.condition, time=6 * 0.02).mean[:, 0]
    found = probes.latents(predictor, ("visual", "pose"), made)
    np.testing.assert_allclose(found, want, atol=1e-4)
    earlier = probes.latents(predictor, ("visual", "pose"), made._replace(frame=np.tile([0, 2], (5, 1))))
    assert np.abs(found - earlier).max() > 1e-2


def test_raw_inputs_are_reduced_to_sixteen_pixels(predictor):
    made, _ = frames(3, 0)
    features = probes.raw(predictor, ("visual", "pose"), made)
    assert features.shape == (3, 16 * 16 * 3 + 12)
    block = made.visual[1, 0, 2:4, 4:6].mean((0, 1)) / 255
    np.testing.assert_allclose(features[1].reshape(-1)[(16 + 2) * 3 : (16 + 2) * 3 + 3], block, atol=0.5 / 255)


def test_a_table_has_each_subset_beside_its_inputs(predictor):
    made = {
        part: frames(count, seed)[0] for seed, (part, count) in enumerate(dict(train=24, validation=6, test=6).items())
    }
    for part, one in made.items():
        made[part] = one._replace(object=one.object % 3)
    _, data = frames(24, 0)
    made["test"].segmentation[3, 0] = False
    summary = evaluation.probe(predictor, data, made, NAMES, num=20)
    assert (summary["items"], summary["objects"], summary["classes"]) == (5, 3, 3)
    cell = summary["probes"]["from visual"]["force"]
    assert cell["difference"]["value"] == pytest.approx(cell["latent"]["value"] - cell["raw"]["value"])
    text = evaluation.probes_table(summary, title="Probes")
    lines = [line for line in text.splitlines() if line.startswith("| from")]
    assert len(lines) == 14
    assert lines[0].startswith("| from visual: latent |")
    assert "5 held-out trajectories of 3 objects" in text


def test_bold_marks_what_is_better_than_chance_would_allow():
    value = {"value": 0.5, "low": 0.4, "high": 0.6}
    worse = {"latent": value, "raw": value, "difference": {"value": -0.2, "low": -0.3, "high": -0.1}}
    equal = worse | {"difference": {"value": 0.1, "low": -0.1, "high": 0.3}}
    results = {"class": None, "size": worse, "colour": equal, "force": equal, "area": equal}
    summary = {"items": 4, "objects": 2, "classes": 2, "chance": 0.5, "probes": {"from visual": results}}
    latent, raw = evaluation.probes_table(summary, title="t").splitlines()[-2:]
    assert latent == "| from visual: latent | - | 0.50 [0.40, 0.60] | 0.50 [0.40, 0.60] |" + 2 * " 0.50 [0.40, 0.60] |"
    assert raw.startswith("| from visual: inputs | - | **0.50 [0.40, 0.60]** | 0.50 [0.40, 0.60] |")


def test_what_cannot_be_probed_is_named(predictor):
    made, data = frames(6, 0)
    with pytest.raises(ValueError, match=r"lacks the parts \['validation'\]"):
        evaluation.probe(predictor, data, {"train": made, "test": made}, NAMES)
    nothing = made._replace(segmentation=np.zeros_like(made.segmentation))
    with pytest.raises(ValueError, match="part 'validation' shows an object"):
        evaluation.probe(predictor, data, {"train": made, "validation": nothing, "test": made}, NAMES)
