"""Planted faults of a made-up dataset are found, and nothing else."""

import numpy as np
import pytest
from made_up_dataset import COLLECTION, FRAMES, SKIN, Faults, write

import sts_jax as sts
from sts_jax import dataset

LAST = FRAMES - 1
BLACK = Faults(visual={(2, 3): 0}, tactile={(9, LAST): 5})
CLIPPED = Faults(tactile={(7, LAST): 255})
BLANK = Faults(tactile={(1, 2): SKIN, (4, 0): SKIN})  # trajectory 4 has no contact in frame 0
COPIES = Faults(copies={(15, 0): (3, 1), (2, 4): (2, 2)})
UNSEEN = Faults(hidden=((6, LAST), (6, 0)))


def found(folder, faults, **options):
    write(folder, faults)
    data = dataset.load(folder)
    return data, dataset.find_suspects(data, sts.Sensor(), dataset.find_untouched(data), **options)


def test_a_clean_dataset_has_no_suspects(tmp_path):
    data, suspects = found(tmp_path, Faults())
    assert suspects == []
    np.testing.assert_array_equal(dataset.find_untouched(data), np.full((24, 24, 3), SKIN, np.uint8))


@pytest.mark.parametrize(
    ("faults", "kind", "where", "reason"),
    [
        (BLACK, "black", [(2, 3), (9, LAST)], "visual image: brightest value 0"),
        (CLIPPED, "clipped", [(7, LAST)], "tactile image: 100% of the pixels are saturated"),
        (BLANK, "blank touch", [(1, 2)], "no imprint at "),
        (COPIES, "duplicate", [(2, 4), (15, 0)], "visual image of trajectory 2, frame 2"),
        (UNSEEN, "unseen", [(6, LAST)], "no pixel shows the object"),
    ],
)
def test_a_planted_fault_is_found_at_its_place(tmp_path, faults, kind, where, reason):
    data, suspects = found(tmp_path, faults)
    assert {one.kind for one in suspects} == {kind}
    assert [(one.trajectory, one.frame) for one in suspects] == where
    assert suspects[0].reason.startswith(reason)
    for one in suspects:
        assert tuple(data.frames[one.row]) == (one.trajectory, one.frame)


def test_only_the_asked_frames_are_examined(tmp_path):
    seen = []
    data, suspects = found(tmp_path, BLACK, rows=np.array([5, 0, 7]), progress=seen.append)
    assert suspects == []
    assert seen[-1] == 3
    (row,) = np.flatnonzero((data.frames == (2, 3)).all(1))
    assert [one.row for one in dataset.find_suspects(data, sts.Sensor(), None, rows=np.array([row]))] == [row]


def test_an_image_at_rest_may_repeat(tmp_path):
    """Identical images of an object that does not move are no fault, and neither are those of the empty pad."""
    write(tmp_path, COPIES)
    data = dataset.load(tmp_path)
    data.trajectory["pose"][2, 4, :3] = data.trajectory["pose"][2, 2, :3]
    assert [(one.trajectory, one.frame) for one in dataset.find_suspects(data, sts.Sensor(), None)] == [(15, 0)]


@pytest.mark.parametrize(("centre", "count"), [(0.074, 0), (0.069, 1)])
def test_an_object_that_hangs_over_the_edge_may_leave_no_imprint(tmp_path, centre, count):
    """The pad is 150 mm wide, so its edge is 75 mm from its centre."""
    write(tmp_path, BLANK)
    data = dataset.load(tmp_path)
    data.trajectory["wrench"][1, 2, 3] = centre * data.trajectory["wrench"][1, 2, 2]  # Mx = y Fz
    assert len(dataset.find_suspects(data, sts.Sensor(), dataset.find_untouched(data))) == count


@pytest.mark.slow
@pytest.mark.parametrize(
    "scenario", [sts.physics.Freefall(), sts.physics.Inclined(), sts.physics.Perturbed(), sts.physics.Released()]
)
def test_a_simulated_dataset_has_no_suspects(tmp_path, scenario):
    classes = ("camera",) if isinstance(scenario, sts.physics.Released) else COLLECTION.categories
    collection = dataset.Collection(scenario, classes, num_objects=4, num_per_object=2, num_full=2, objects_per_shard=4)
    dataset.collect(collection, sts.Sensor(), tmp_path)
    data = dataset.load(tmp_path)
    sensor = sts.Sensor()
    assert dataset.find_suspects(data, sensor, dataset.empty_frame(sensor, collection).tactile) == []
