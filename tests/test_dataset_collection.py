import dataclasses
import inspect
import types

import numpy as np
import pytest

import sts_jax as sts
from sts_jax import dataset
from sts_jax.dataset import shards

SMALL = dataset.Collection(num_objects=4, num_per_object=2, num_full=1, objects_per_shard=2)


def test_a_list_as_resolution_is_named():
    collection = dataclasses.replace(SMALL)
    object.__setattr__(collection, "resolution", [64, 64])  # users have no check of annotations
    with pytest.raises(ValueError, match=r"resolution must be a tuple of two whole numbers .* got \[64, 64\]"):
        collection.check()


def test_the_only_frame_of_a_trajectory_is_stored_once():
    collection = dataclasses.replace(SMALL, scenario=sts.physics.Perturbed(frames=1))
    collection.check()
    made = inspect.unwrap(shards._frames_of)(collection, np.arange(2), types.SimpleNamespace(pose=np.zeros((4, 1, 7))))
    np.testing.assert_array_equal(made, [[i, 0] for i in range(4)])
    assert shards.planned(collection, 0) == (4, 4 + 2 * collection.num_views)


def test_the_split_of_published_collections_is_unchanged():
    split = dataset.split_objects(dataset.Collection(num_objects=21, seed=5))
    assert split["validation"].tolist() == [12, 18]
    assert split["test"].tolist() == [2, 3, 8, 9]


@pytest.mark.parametrize("seed", range(3))
def test_classes_of_different_sizes_have_equal_proportions_in_all_parts(seed):
    labels = ("mug",) * 100 + ("bowl",) * 10 + ("fork",)
    meshes = dataset.Meshes("meshes", tuple(f"{i}.stl" for i in range(111)), labels, "")
    split = dataset.split_objects(dataset.Collection(meshes=meshes, num_objects=111, seed=seed))
    assert {name: len(part) for name, part in split.items()} == {"train": 78, "validation": 11, "test": 22}
    np.testing.assert_array_equal(np.sort(np.concatenate(list(split.values()))), np.arange(111))
    for part, share in zip(split.values(), (0.7, 0.1, 0.2), strict=True):
        for name, number in (("mug", 100), ("bowl", 10)):
            assert abs(sum(labels[i] == name for i in part) - share * number) <= 1
    assert 110 in split["train"]  # the only object of its class


@pytest.mark.parametrize("shares", [(0.9, 0.04, 0.06), (0.7, 0.1, 0.2), (0.04, 0.06, 0.9)])
@pytest.mark.parametrize("count", [9, 10, 24])
def test_each_part_of_a_folder_of_meshes_has_at_least_three_objects(count, shares):
    names = tuple(f"{i}.stl" for i in range(count))
    meshes = dataset.Meshes("meshes", names, tuple("ab"[i % 2] for i in range(count)), "")
    split = dataset.split_objects(dataset.Collection(meshes=meshes, num_objects=count, shares=shares))
    assert sorted(i for part in split.values() for i in part) == list(range(count))
    assert min(map(len, split.values())) == 3


def test_a_part_without_a_share_stays_empty_and_one_procedural_object_is_not_enough():
    meshes = dataset.Meshes("meshes", tuple(f"{i}.stl" for i in range(20)), ("a",) * 20, "")
    split = dataset.split_objects(dataset.Collection(meshes=meshes, num_objects=20, shares=(0.95, 0.05, 0.0)))
    assert [len(part) for part in split.values()] == [17, 3, 0]
    split = dataset.split_objects(dataset.Collection(num_objects=24, shares=(0.9, 0.04, 0.06)))
    assert [len(part) for part in split.values()] == [18, 3, 3]


def test_classes_follow_the_categories():
    collection = dataset.Collection(categories=("fork", "bottle"), num_objects=20)
    names = dataset.class_names(collection)
    assert names == ("fork", "bottle") * 10
    for index, body in zip((1, 4), dataset.make_bodies(collection, np.array([1, 4])), strict=True):
        assert sts.objects.CATEGORIES[int(body.category)] == names[index]
    for part in dataset.split_objects(collection).values():
        assert sum(names[i] == "fork" for i in part) == len(part) / 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_rendered": 3}, r"num_rendered must be <= num_per_object=2, got 3"),
        ({"num_views": -1}, r"num_views must be >= 0, got -1"),
        ({"num_objects": 0}, r"num_objects must be >= 1, got 0"),
        ({"num_objects": 10**10}, r"num_objects must be <= 1,000,000, got 10000000000"),
        ({"num_per_object": 10**30}, r"num_per_object must be <= 1,000,000, got 10+"),
        (
            {"resolution": (10**5, 64)},
            r"resolution must be a tuple of two whole .* 1 to 8,192 pixels, got \(100000, 64\)",
        ),
        ({"resolution": (64, 0)}, r"resolution must be a tuple of two whole numbers .* got \(64, 0\)"),
        ({"categories": ()}, r"categories is empty, but it must name at least one class"),
        ({"categories": ("bottle", "cup")}, r"category is 'cup', but it must be one of bottle, camera"),
        ({"shares": (0.5, 0.5, 0.5)}, r"shares=\(0\.5, 0\.5, 0\.5\), but .* sum 1"),
    ],
)
def test_fields_out_of_range_are_refused_before_anything_is_written(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        dataset.collect(dataclasses.replace(SMALL, **changes), sts.Sensor(), tmp_path / "new")
    assert not (tmp_path / "new").exists()
