"""Roll-outs of one-step models, compared with a loop that applies `mvae` step by step."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from optics_bodies import noise
from statespace_config import finite, same, untrained
from test_predict import CONDITION, SIDE, SMALL, close, measurement

import sts_jax as sts
from sts_jax import mvae
from sts_jax.prediction import rollout

pytestmark = pytest.mark.filterwarnings("ignore:(visual|tactile|pose) ")  # the images and poses are random

STEP = {"stride": 2, "period": 0.08}
SCALE = (10.0, 10.0, 0.1, 1.0)
TIMED = dataclasses.replace(SMALL, condition=4)
POSE = dataclasses.replace(SMALL, modalities=SMALL.modalities[2:])
GREY = np.float32(178 / 255)


def one_step(**view):
    return untrained(SMALL, **STEP | view)


def by_hand(predictor, given, steps, condition=None, time=0.0, normal=None):
    """Apply a model step by step. `normal(step)` is the noise of z."""
    model, view = predictor.model, predictor.preprocessing
    values, frames = {name: jnp.asarray(value) for name, value in given.items()}, []
    for step in range(steps):
        codes = values | ({"pose": view.encode_pose(values["pose"])} if "pose" in values else {})
        present = {}
        if "tactile" in values:
            differs = np.abs(np.asarray(values["tactile"]) - GREY).max((1, 2, 3)) > view.touch_threshold
            present = {"tactile": jnp.asarray(differs | (not view.mask_blank_touch))}
        wide = None
        if condition is not None:
            now = np.broadcast_to(np.asarray(time + step * view.period, np.float32), len(condition))
            wide = jnp.asarray(np.column_stack([condition, now]) / np.array(SCALE), jnp.float32)
        posterior = mvae.infer(model.graphdef, model.state, codes, present=present, condition=wide)
        z = posterior.mean if normal is None else posterior.mean + jnp.exp(posterior.log_var / 2) * normal(step)
        out = mvae.decode(model.graphdef, model.state, z, condition=wide)
        values = {name: jax.nn.sigmoid(out[name]) for name in ("visual", "tactile")}
        values["pose"] = view.decode_pose(out["pose"])
        frames.append({**values, "mean": posterior.mean, "touched": present.get("tactile")})
    return frames


def check(prediction, frames, atol=2e-5):
    for step, frame in enumerate(frames):
        for name in ("visual", "tactile", "pose", "mean"):
            np.testing.assert_allclose(getattr(prediction, name)[:, step], frame[name], atol=atol, err_msg=name)


@pytest.mark.parametrize("names", [("visual",), ("tactile", "pose"), ("visual", "tactile", "pose")])
def test_a_rollout_applies_the_model_to_its_own_predictions(names):
    given = {name: x for name, x in measurement(2).items() if name in names}
    out = one_step().rollout(given, 3)
    assert out.visual.shape == out.tactile.shape == (2, 3, SIDE, SIDE, 3)
    assert out.pose.shape == (2, 3, 7)
    assert out.samples is None
    check(out, by_hand(one_step(), given, 3))
    assert np.abs(np.diff(out.mean, axis=1)).max((0, 2)).min() > 1e-3  # the frames differ
    if len(names) == 3:
        close(one_step().rollout(given, 3, last=True), jax.tree.map(lambda x: x[:, 2:], out))


@pytest.mark.slow
def test_a_predicted_tactile_image_without_contact_is_ignored_like_a_given_one():
    given = measurement(6)
    given["tactile"][0] = GREY
    far = np.abs(one_step().rollout(given, 4).tactile - GREY).max((2, 3, 4))
    limit = float(np.median(far))
    model = one_step(touch_threshold=limit)
    frames = by_hand(model, given, 4)
    touched = np.stack([frame["touched"] for frame in frames])
    assert touched[0].tolist() == [False] + 5 * [True]
    assert touched[1:].any()
    assert not touched[1:].all()
    check(model.rollout(given, 4), frames)
    as_paper = one_step(touch_threshold=limit, mask_blank_touch=False)
    check(as_paper.rollout(given, 4), by_hand(as_paper, given, 4))
    assert np.abs(as_paper.rollout(given, 4).mean - model.rollout(given, 4).mean).max() > 1e-3


@pytest.mark.parametrize(
    ("time", "config"),
    [
        (np.array([0.2, 1.0]), TIMED),
        (0.0, dataclasses.replace(TIMED, encode_condition=True, prior="conditional")),
    ],
)
def test_the_condition_of_each_step_has_the_time_that_has_passed(time, config):
    model, given = untrained(config, **STEP, condition_scale=SCALE), measurement(2)
    out = model.rollout(given, 3, condition=CONDITION, time=time)
    check(out, by_hand(model, given, 3, CONDITION, time))
    assert np.abs(out.pose - model.rollout(given, 3, condition=CONDITION, time=3.0).pose).max() > 1e-3
    # The second half of a roll-out begins at a predicted frame.
    middle = jax.tree.map(lambda x: x[:, 0], out)
    rest = model.rollout(middle, 3, condition=CONDITION, time=time + 0.08)
    check(rest, by_hand(model, given, 4, CONDITION, time)[1:])


def test_a_key_draws_one_course_or_samples():
    model, given, key = one_step(), measurement(2), jax.random.key(7)

    def normal(step, number=1):
        drawn = jax.random.normal(jax.random.fold_in(key, step), (number, SMALL.latent))
        return lambda i: jnp.broadcast_to(drawn[i], (2, SMALL.latent))

    check(model.rollout(given, 3, key=key), by_hand(model, given, 3, normal=lambda step: normal(step)(0)))
    out = model.rollout(given, 3, key=key, num_samples=2)
    check(out, by_hand(model, given, 3))
    assert out.samples.visual.shape == (2, 2, 3, SIDE, SIDE, 3)
    assert out.samples.pose.shape == (2, 2, 3, 7)
    for i in range(2):
        drawn = by_hand(model, given, 3, normal=lambda step, i=i: normal(step, 2)(i))
        for step, frame in enumerate(drawn):
            np.testing.assert_allclose(out.samples.visual[i][:, step], frame["visual"], atol=2e-5)


def test_a_rollout_depends_neither_on_the_place_nor_on_the_batch():
    model, known = one_step(), {"key": jax.random.key(3), "num_samples": 2}
    given = {name: np.repeat(value[[0, 1]], 10, axis=0) for name, value in measurement(2).items()}  # more than a chunk

    def item(prediction, i):
        samples = [np.asarray(x)[:, i] for x in prediction.samples[:3]]
        return jax.tree.map(lambda x: np.asarray(x)[i], prediction._replace(samples=None)), samples

    out = model.rollout(given, 3, **known)
    for i in range(1, 10):
        close(item(out, i), item(out, 0), atol=1e-6)
    alone = model.rollout({name: value[0] for name, value in given.items()}, 3, **known)
    assert alone.pose.shape == (3, 7)
    close(item(out, 0), (alone._replace(samples=None), list(alone.samples[:3])), atol=1e-4)
    wide = model.rollout({name: x.reshape(4, 5, *x.shape[1:]) for name, x in given.items()}, 3, **known)
    assert wide.samples.visual.shape == (2, 4, 5, 3, SIDE, SIDE, 3)
    flat = jax.tree.map(lambda x: x.reshape(20, *x.shape[2:]), wide._replace(samples=None))
    same(flat, out._replace(samples=None))
    several = model.rollout(given, 3, **{**known, "key": jax.random.split(known["key"], 20)}).samples.pose
    assert np.abs(several[:, 1] - several[:, 0]).max() > 1e-3  # keys of their own give samples of their own


def test_a_rollout_works_in_jit_vmap_and_grad_and_compiles_once():
    model, pose, key = untrained(POSE, **STEP), measurement(4)["pose"], jax.random.key(0)

    def rolled(pose, key):
        return model.rollout({"pose": pose}, 3, key=key)

    want = rolled(pose, key)
    before = rollout._cache_size()
    rolled(measurement(4, seed=1)["pose"], jax.random.key(1))
    assert rollout._cache_size() == before
    close(jax.jit(rolled)(pose, key), want)
    close(jax.vmap(rolled, (0, None))(pose, key), want)
    slope = jax.jit(jax.grad(lambda pose: model.rollout({"pose": pose}, 3).pose[-1, 0]))(pose[0])
    finite(slope)
    assert np.abs(slope).max() > 0
    wrong = jax.jit(rolled)(jnp.asarray(pose).at[1, 3:].set(0), key)
    bad = [np.isnan(leaf).reshape(4, -1) for leaf in jax.tree.leaves(wrong)]
    assert all(leaf[1].all() and not leaf[[0, 2, 3]].any() for leaf in bad)


def test_the_first_frame_may_be_a_frame_or_a_prediction():
    frame = dataclasses.replace(noise((SIDE, SIDE)), pose=jnp.asarray(measurement()["pose"]))
    streams = {name: getattr(frame, name) for name in ("visual", "tactile", "pose")}
    model = one_step(absent=("pose",))
    same(model.rollout(frame, 2), model.rollout({name: streams[name] for name in ("visual", "tactile")}, 2))
    same(one_step().rollout(sts.Prediction(*streams.values(), None, None), 2), one_step().rollout(streams, 2))


GIVEN = measurement(2)


@pytest.mark.parametrize(
    ("given", "further", "error", "message"),
    [
        ({}, {}, ValueError, "nothing to predict from: give at least one of visual, tactile, pose"),
        (GIVEN, {"steps": 0}, ValueError, "steps must be >= 1, got 0"),
        ({"visual": GIVEN["visual"] * 255}, {}, ValueError, "visual has values in .*divide by 255"),
        ({"depth": GIVEN["visual"]}, {}, ValueError, "new does not accept depth"),
        (GIVEN["visual"], {}, TypeError, "`frame` is a ndarray: give a Frame, a Prediction, or a mapping with some of"),
        (GIVEN, {"num_samples": 3}, ValueError, "and a key if it is > 0"),
        (GIVEN, {"condition": CONDITION}, ValueError, r"condition has shape \(2, 3\), but .* needs None"),
    ],
)
def test_each_invalid_argument_is_named(given, further, error, message):
    with pytest.raises(error, match=message):
        one_step().rollout(given, **{"steps": 2} | further)


def test_a_wrong_condition_or_time_is_named():
    model = untrained(TIMED, **STEP, condition_scale=SCALE)
    for wrong in (None, CONDITION[:, :2], np.column_stack([CONDITION, [0, 0]])):
        with pytest.raises(ValueError, match=r"condition has shape .*, but new needs \(2, 3\)"):
            model.rollout(GIVEN, 2, condition=wrong)
    with pytest.raises(ValueError, match=r"condition and time have magnitudes .*SI units"):
        model.rollout(GIVEN, 2, condition=CONDITION, time=1000.0)
    with pytest.raises(ValueError, match=r"time has shape \(3,\): give one number, or one for each item, \(2,\)"):
        model.rollout(GIVEN, 2, condition=CONDITION, time=np.zeros(3))


def test_a_model_of_one_kind_is_not_used_as_the_other():
    assert one_step().stride == 2
    assert untrained(SMALL).stride is None
    for call in (lambda model: model(visual=GIVEN["visual"]), lambda model: model.prior((2,))):
        with pytest.raises(
            ValueError, match=r"new is a one-step model: .* 0\.08 s later, .* Use rollout\(frame, steps"
        ):
            call(one_step())
    with pytest.raises(
        ValueError, match=r"new predicts the last frame, and has no steps: call it, or train a one-step"
    ):
        untrained(SMALL).rollout(GIVEN, 2)


def test_a_saved_model_keeps_its_stride(tmp_path):
    one_step().save(tmp_path / "step")
    again = sts.Predictor.load(tmp_path / "step")
    assert (again.stride, again.preprocessing.period) == (2, 0.08)
    same(again.rollout(GIVEN, 3), one_step().rollout(GIVEN, 3))
