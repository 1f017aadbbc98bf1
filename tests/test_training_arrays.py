"""Arrays in memory: batches, their order, and the checksum."""

import dataclasses

import numpy as np
import pytest
from jaxtyping import TypeCheckError
from recorded_session import SQUARE, drawn

from sts_jax import training


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
