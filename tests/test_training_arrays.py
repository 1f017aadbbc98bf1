"""Arrays in memory: batches, their order, and the checksum."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError
from recorded_session import SQUARE, drawn

import sts_jax as sts
from sts_jax import dataset, mvae, physics, training


def arrays(*, further=True):
    """Four samples. `further` adds three views and five falls."""
    rng = np.random.default_rng(0)
    views = {"visual": rng.integers(0, 256, (3, 8, 8, 3), dtype=np.uint8), "state": rng.random((3, 5), np.float32)}
    falls = {"state": rng.random((5, 5), np.float32), "pose": rng.random((5, 12), np.float32)}
    return training.Arrays(
        {"pose": rng.random((4, 12), np.float32)},
        {"pose": rng.random((4, 12), np.float32)},
        views=views if further else {},
        falls=falls | {"outcome": np.array([0, 1, 0, 1, 1], np.int32)} if further else {},
    )


@pytest.mark.parametrize(("samples", "size"), [(10, 4), (7, 7), (3, 8)])
def test_each_epoch_has_every_sample_once_from_any_start(samples, size):
    steps = 3 * samples
    whole = list(training.order(0, samples, size, 0, steps))
    flat = np.concatenate(whole)
    for epoch in range(len(flat) // samples):
        assert sorted(flat[epoch * samples : (epoch + 1) * samples]) == list(range(samples))
    np.testing.assert_array_equal(whole[5:], list(training.order(0, samples, size, 5, steps)))
    assert len({tuple(epoch) for epoch in flat[: 9 * samples].reshape(9, samples)}) > 1


def test_views_and_falls_are_taken_by_rows_of_their_own_and_change_the_checksum():
    data = arrays()
    rows = {"views": np.array([2, 0]), "falls": np.array([4, 4, 1])}
    batch = data.take(np.array([3, 1]), **rows)
    np.testing.assert_array_equal(batch["targets"]["pose"], data.targets["pose"][[3, 1]])
    for name, index in rows.items():
        own = getattr(data, name)
        assert batch[name].keys() == own.keys()
        for key, values in own.items():
            np.testing.assert_array_equal(batch[name][key], values[index])
    assert not {"views", "falls"} & data.take(np.array([0])).keys()
    sums = {data.checksum(), arrays(further=False).checksum()}
    for name in rows:
        for key, values in getattr(data, name).items():
            changed = values.copy()
            changed.reshape(-1)[-1] += 1
            sums.add(dataclasses.replace(data, **{name: getattr(data, name) | {key: changed}}).checksum())
    assert len(sums) == 2 + 2 + 3
    assert arrays().checksum() == data.checksum()


def test_image_arrays_are_first_inputs_and_last_targets_and_mask_first_touches_without_contact():
    random = np.random.default_rng(0)
    visual = random.integers(0, 256, (3, 2, 64, 64, 3)).astype(np.uint8)
    blank = np.full((64, 64, 3), 100, np.uint8)
    tactile = np.broadcast_to(blank, visual.shape).copy()
    tactile[1, 0, 10:20, 10:20] = 200
    tactile[2, 1, 10:20, 10:20] = 200
    arrays, own = training.image_arrays(visual, tactile, ("visual", "tactile"), training.Preprocessing(), blank)
    np.testing.assert_array_equal(arrays.inputs["visual"], visual[:, 0])
    np.testing.assert_array_equal(arrays.targets["tactile"], tactile[:, 1])
    np.testing.assert_array_equal(arrays.present["tactile"], [False, True, False])
    assert own.absent == ()
    alone, _ = training.image_arrays(visual, tactile, ("visual",), training.Preprocessing(), blank)
    assert set(alone.inputs) == set(alone.targets) == {"visual"}
    assert alone.present == {}


EMPTY = np.clip(drawn(None, None) + np.arange(64)[:, None, None], 0, 255).astype(np.uint8)  # light that varies


def with_square(row, column):
    """The empty pad with a square that is 100 darker, or as far as it is in view."""
    image = EMPTY.copy()
    rows, columns = (slice(max(x, 0), max(x + SQUARE, 0)) for x in (row, column))
    image[rows, columns] -= 100
    return image


@pytest.mark.parametrize("shift", [(0, 0), (3, 0), (0, -5), (-12, 40)])
def test_a_shifted_trajectory_is_the_one_at_the_other_place(shift):
    images = np.stack([[with_square(10, 15), with_square(20, 15)]])
    moved = training.shifted(images, EMPTY, np.array([shift]))
    rows, columns = shift
    truth = np.stack([with_square(10 + rows, 15 + columns), with_square(20 + rows, 15 + columns)])
    np.testing.assert_array_equal(moved[0], truth)


def test_invalid_shapes_and_shifts_are_refused():
    images = np.stack([[EMPTY, EMPTY]])
    with pytest.raises(ValueError, match=r"must be below \(64, 64\)"):
        training.shifted(images, EMPTY, np.array([[64, 0]]))
    with pytest.raises(TypeCheckError, match="shifts"):
        training.shifted(images, EMPTY, np.array([[1, 0], [2, 0]]))
    with pytest.raises(ValueError, match=r"resize them to \(32, 32\)"):
        training.image_arrays(images, images, ("visual",), training.Preprocessing((32, 32)), EMPTY)


COUNT, TIMES, SIDE = 4, 9, 32  # trajectories, frames of each, pixels


def trajectories(condition):
    """Pairs, further falls and the dataset of random trajectories, with images that all show a contact."""
    rng = np.random.default_rng(0)
    quat = rng.normal(size=(COUNT, TIMES, 4))
    pose = np.concatenate(
        [0.02 * rng.normal(size=(COUNT, TIMES, 3)), quat / np.linalg.norm(quat, axis=2, keepdims=True)], axis=2
    ).astype(np.float32)
    solid = {
        "support": rng.uniform(0.01, 0.03, (COUNT, 128)).astype(np.float32),
        "mass": rng.uniform(0.02, 0.2, COUNT).astype(np.float32),
        "com": np.zeros((COUNT, 3), np.float32),
    }
    given = {"condition": condition, "outcome": np.array([0, 1, 1, 0], np.int32)}
    time = np.broadcast_to(0.032 * np.arange(TIMES, dtype=np.float32), (COUNT, TIMES))
    nothing = dict.fromkeys(("frames", "shard_of", "record_of", "view_shard_of", "view_record_of"), np.zeros(0, int))
    data = dataset.Dataset({}, "", {}, {"pose": pose, "time": time, **given}, {}, solid, {}, shards=(), **nothing)
    images = rng.integers(0, 256, (2, COUNT, 2, SIDE, SIDE, 3)).astype(np.uint8)
    ends = {"pose": pose[:, [0, -1]], **given, **solid, "object": np.arange(COUNT), "trajectory": np.arange(COUNT)}
    shows = np.ones((COUNT, 2), bool)
    pairs = dataset.Pairs(
        *images, segmentation=np.broadcast_to(shows[..., None, None], images.shape[1:5]), contact=shows, **ends
    )
    return pairs, dataset.Ends(**ends), data


def test_a_one_step_model_gets_the_poses_and_conditions_of_all_frames():
    condition = np.random.default_rng(1).normal(size=(COUNT, 3)).astype(np.float32)
    scenario = dataclasses.replace(physics.Perturbed(), rate=31.25)
    pairs, falls, data = trajectories(condition)
    empty = dict.fromkeys(("visual", "tactile"), np.full((SIDE, SIDE, 3), 128, np.uint8))
    view = training.Preprocessing((SIDE, SIDE), condition_scale=scenario.condition_scale)
    made = functools.partial(training.state_model, pairs, sts.Sensor(), scenario, view, empty, image_size=16)
    model, own = made(stride=2, inputs=("visual", "pose"))
    assert (own.stride, own.period, own.condition_scale) == (2, 0.064, (*scenario.condition_scale, 1.0))
    assert (model.stride, model.condition, model.inputs, model.outcomes) == (2, 4, ("visual", "pose"), 1)
    pairs = pairs._replace(outcome=np.full(COUNT, 1, np.int32))
    falls = falls._replace(outcome=pairs.outcome)
    arrays = training.state_arrays(pairs, model, scenario, own, empty, falls=falls, data=data)
    training.arrays.check(model, arrays)
    course = np.asarray(own.encode_pose(jnp.asarray(data.trajectory["pose"])))
    for part in (arrays.targets, arrays.falls):
        np.testing.assert_allclose(part["course"], course, atol=1e-6)
        np.testing.assert_array_equal(part["outcome"], 0)
    assert "pose" not in arrays.falls
    np.testing.assert_allclose(arrays.targets["pose"], course[:, -1], atol=1e-6)
    expected = np.concatenate([np.repeat(condition[:, None], TIMES, 1), data.trajectory["time"][..., None]], axis=2)
    for found in (arrays.condition, arrays.falls["condition"]):
        np.testing.assert_allclose(found * [*scenario.condition_scale, 1.0], expected, rtol=1e-5)
    for change, message in (
        ({"data": None}, "a one-step model needs the poses in all frames: give data="),
        ({"model": dataclasses.replace(model, stride=TIMES)}, "stride is 9, but the trajectories have 9 frames"),
    ):
        given = {
            "pairs": pairs,
            "model": model,
            "scenario": scenario,
            "preprocessing": own,
            "empty": empty,
            "data": data,
        }
        with pytest.raises(ValueError, match=message):
            training.state_arrays(**given | change)
    final, same = made(inputs=("tactile",))
    assert (final.stride, final.condition, final.inputs, same) == (0, 3, ("tactile",), view)
    with pytest.raises(ValueError, match="the samples of `inputs` have the shapes"):
        training.arrays.check(final, arrays)


PICTURE = mvae.Config((mvae.Modality("v", "vector", (3,)), mvae.Modality("i", "image", (32, 32, 1))))
VECTOR, IMAGE = np.zeros((2, 3), np.float32), np.ones((2, 32, 32, 1), np.float32)
UNKNOWN = np.array([[0, 0, 0], [0, np.nan, 0]], np.float32)


@pytest.mark.parametrize(
    ("vector", "image", "message"),
    [
        (VECTOR.astype(np.uint8), IMAGE, "the array 'v' of `inputs` is uint8, which counts as an image"),
        (
            VECTOR,
            255 * IMAGE,
            "the array 'i' of `inputs` has values from 255 to 255, but float images",
        ),
        (UNKNOWN, IMAGE, "the array 'v' of `inputs` has values that are not finite: mask"),
    ],
)
def test_values_that_a_loss_takes_for_others_are_refused(vector, image, message):
    good, bad = {"v": VECTOR, "i": IMAGE}, {"v": vector, "i": image}
    with pytest.raises(ValueError, match=message):
        training.arrays.check(PICTURE, training.Arrays(bad, good))
    with pytest.raises(ValueError, match=message.replace("inputs", "targets")):
        training.arrays.check(PICTURE, training.Arrays(good, bad))


def test_masked_samples_may_have_any_value():
    mask, values = {"v": np.array([True, False])}, {"v": UNKNOWN, "i": (255 * IMAGE).astype(np.uint8)}
    training.arrays.check(PICTURE, training.Arrays(values, values, present=mask, target_present=mask))
