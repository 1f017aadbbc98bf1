"""Pairs of any frames and one-step training arrays, in memory and from disk, against frames that are known."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from extending_page import blocks
from statespace_config import Killed, kill_at, same
from stored_frames import BLANK, FRAMES, RATE, SIZE, preprocessing, stored

import sts_jax as sts
from sts_jax import dataset, evaluation, geometry, mvae, physics, training

NAMES = ("visual", "tactile", "pose")


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    return stored(tmp_path_factory.mktemp("stored"))


@pytest.fixture(scope="module")
def sparse(tmp_path_factory):
    return stored(tmp_path_factory.mktemp("sparse"), ends_only=(1, 2))


def step_arrays(known, trajectories=(3, 0, 7), **options):
    given = {"modalities": NAMES, "preprocessing": preprocessing(), "blank": BLANK} | options
    return training.step_arrays(known.data, np.array(trajectories), **given)


# ---- Pairs of any frames


@pytest.mark.parametrize(
    ("frames", "places"),
    [
        ((0, -1), [[0, 4], [0, 4], [0, 4]]),
        ((1, 3), [[1, 3], [1, 3], [1, 3]]),
        ((-5, np.array([1, -2, 0])), [[0, 1], [0, 3], [0, 0]]),
        ((np.array([0, 1, 2]), np.array([2, 3, 4])), [[0, 2], [1, 3], [2, 4]]),
    ],
)
def test_pairs_have_the_given_frames(known, frames, places):
    index = np.array([9, 0, 4])
    pairs = known.data.pairs(index, frames=frames)
    np.testing.assert_array_equal(pairs.frame, places)
    for row, (trajectory, both) in enumerate(zip(index, places, strict=True)):
        for side, frame in enumerate(both):
            np.testing.assert_array_equal(pairs.visual[row, side], known.visual[trajectory, frame])
            np.testing.assert_array_equal(pairs.tactile[row, side], known.tactile[trajectory, frame])
            np.testing.assert_array_equal(pairs.segmentation[row, side], known.visual[trajectory, frame, ..., 0] > 127)
            assert pairs.contact[row, side] == known.data.trajectory["contact"][trajectory, frame]
            pose = known.data.trajectory["pose"][trajectory, frame]
            np.testing.assert_allclose(pairs.pose[row, side, :3], pose[:3])
            np.testing.assert_allclose(pairs.pose[row, side, 3:], pose[3:] * np.sign(pose[3]), rtol=1e-6)
    some = pairs.take(np.array([2, 0]))
    np.testing.assert_array_equal(some.frame, pairs.frame[[2, 0]])


def test_the_ends_of_a_trajectory_with_few_images_can_be_read(sparse):
    pairs = sparse.data.pairs(np.array([2, 3]), frames=(-1, 0))
    np.testing.assert_array_equal(pairs.visual, sparse.visual[2:4, [4, 0]])


FORCE = dataset.Measurement("force", (1,), lambda data, rows: np.zeros((len(rows), 2, 1)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames": (0, 5)}, r"frames contains 5, but the trajectories have the frames 0 to 4"),
        ({"frames": (-6, 0)}, r"frames contains -6, but"),
        ({"frames": (np.array([0.5, 1]), 1)}, r"frames is \(array.*, 1\), but it must be two whole numbers"),
        ({"frames": (0, 1, 2)}, r"frames is \(0, 1, 2\), but it must be two whole numbers"),
        ({"frames": (0, np.array([1, 2, 3]))}, r"two lists of 2 whole numbers, one for each trajectory"),
        ({"frames": (0, 2)}, r"trajectory 1 has no image of frame 2: .*`full_trajectories`.*`num_full`"),
        ({"frames": (1, -1), "measurements": (FORCE,)}, r"measurements exist for the first and last frames only"),
    ],
)
def test_frames_that_cannot_be_read_are_named(sparse, options, message):
    with pytest.raises(ValueError, match=message):
        sparse.data.pairs(np.array([0, 1]), **options)


# ---- Steps


@pytest.mark.parametrize("stride", [1, 3, 4])
def test_the_steps_are_all_frames_that_are_a_stride_apart(known, stride):
    rows = [(i, t, t + stride) for i in (7, 2) for t in range(FRAMES) if t + stride < FRAMES]
    np.testing.assert_array_equal(known.data.steps(np.array([7, 2]), stride), rows)


@pytest.mark.parametrize(
    ("trajectories", "options", "message"),
    [
        ((0, 3), {"stride": 5}, "stride is 5, but it must be a whole number from 1 to 4, because .* have 5 frames"),
        ((0, 3), {"stride": 0}, "stride is 0, but"),
        ((0, 1), {}, "contains 1, of which not all frames are stored: .*`full_trajectories`.*`num_full`"),
        ((0, 99), {}, "contains 99, but the dataset has trajectories 0 to 19"),
        ((0,), {"preprocessing": preprocessing(3)}, r"condition has 2 numbers, but condition_scale=\(2.0, 3.0, 4.0\)"),
        ((0,), {"modalities": ("visual", "sound")}, "modalities must be some of .* got 'sound'"),
        ((0,), {"image_size": 16}, r"`blank` has \(32, 32\) pixels .* the images have \(16, 16\): reduce"),
        ((0,), {"preprocessing": preprocessing(resolution=(16, 16))}, r"resolution is \(16, 16\), but"),
        (
            (0,),
            {"preprocessing": preprocessing(resolution=(5, 5)), "blank": BLANK[:5, :5], "image_size": 5},
            "size is 5",
        ),
    ],
)
@pytest.mark.parametrize("in_memory", [True, False])
def test_what_is_no_one_step_training_set_is_named(sparse, trajectories, options, message, in_memory):
    with pytest.raises(ValueError, match=message):
        step_arrays(sparse, trajectories, in_memory=in_memory, **options)


# ---- One-step training arrays


@pytest.mark.parametrize("stride", [1, 3])
@pytest.mark.parametrize("in_memory", [True, False])
def test_each_sample_is_a_frame_with_the_one_a_stride_later(known, in_memory, stride):
    arrays, view = step_arrays(known, in_memory=in_memory, stride=stride)
    rows = [(i, t) for i in (3, 0, 7) for t in range(FRAMES - stride)]
    assert len(arrays) == len(rows)
    index = np.random.default_rng(1).permutation(len(rows))
    batch = arrays.take(index)
    for place, sample in enumerate(index):
        trajectory, frame = rows[sample]
        for name, images in (("visual", known.visual), ("tactile", known.tactile)):
            np.testing.assert_array_equal(batch["inputs"][name][place], images[trajectory, frame])
            np.testing.assert_array_equal(batch["targets"][name][place], images[trajectory, frame + stride])
        assert batch["present"]["tactile"][place] == known.touched[trajectory, frame]
        for group, time in (("inputs", frame), ("targets", frame + stride)):
            pose = known.data.trajectory["pose"][trajectory, time]
            turn = geometry.quat_to_matrix(jnp.asarray(pose[3:])).ravel()
            np.testing.assert_allclose(batch[group]["pose"][place], [*pose[:3] / 0.05, *turn], atol=1e-5)
        known_numbers = known.data.trajectory["condition"][trajectory] / [2.0, 3.0]
        np.testing.assert_allclose(batch["condition"][place], [*known_numbers, frame / RATE], rtol=1e-5)
    assert (view.stride, view.condition_scale, view.absent) == (stride, (2.0, 3.0, 1.0), ())
    assert view.period == pytest.approx(stride / RATE)
    assert training.paper_model(NAMES, view).condition == 3


def test_both_ways_of_storing_give_the_same_arrays_and_checksum(known, tmp_path):
    memory, disk = (step_arrays(known, in_memory=kind)[0] for kind in (True, False))
    same(*(arrays.take(np.arange(5)) for arrays in (memory, disk)))
    same(disk.inputs["visual"][[4, 1]], memory.inputs["visual"][[4, 1]])
    assert memory.inputs["visual"].shape == disk.targets["tactile"].shape == (12, SIZE, SIZE, 3)
    others = [step_arrays(known, rows, stride=stride)[0] for rows, stride in (((3, 0, 8), 1), ((3, 0, 7), 2))]
    other_data = step_arrays(known._replace(data=dataclasses.replace(known.data, identity="b")))[0]
    sums = {arrays.checksum() for arrays in (memory, *others, other_data)}
    assert len(sums) == 4
    assert disk.checksum() == memory.checksum()


@pytest.mark.parametrize("in_memory", [True, False])
def test_the_images_are_reduced(known, in_memory):
    small = dataset.reduced_images({"tactile": BLANK}, 16)["tactile"]
    view = preprocessing(resolution=(16, 16), touch_threshold=1 / 255)
    arrays, _ = step_arrays(known, in_memory=in_memory, preprocessing=view, blank=small, image_size=16)
    pairs = dataset.reduced(known.data.pairs(np.array([3, 0, 7]), frames=(2, 3)), 16)
    batch = arrays.take(np.array([2, 6, 10]))
    for name in ("visual", "tactile"):
        np.testing.assert_array_equal(batch["inputs"][name], getattr(pairs, name)[:, 0])
        np.testing.assert_array_equal(batch["targets"][name], getattr(pairs, name)[:, 1])
    np.testing.assert_array_equal(batch["present"]["tactile"], known.touched[[3, 0, 7], 2])


def test_a_batch_reads_each_frame_once(known, monkeypatch):
    arrays, _ = step_arrays(known, in_memory=False)
    read, images = [], dataset.Dataset.images
    monkeypatch.setattr(
        dataset.Dataset, "images", lambda data, rows, **more: read.append(rows) or images(data, rows, **more)
    )
    arrays.take(np.array([0, 1, 2, 5]))  # frames 0 to 3 of one trajectory, and 1 and 2 of another
    assert [len(rows) for rows in read] == [6]


def test_a_scenario_without_a_condition_gets_no_time(tmp_path):
    arrays, view = step_arrays(stored(tmp_path, condition=0), preprocessing=preprocessing(0))
    assert arrays.condition is None
    assert view.condition_scale == ()
    assert training.paper_model(NAMES, view).condition == 0


def test_a_touch_that_no_frame_has_is_absent_and_an_unmasked_one_is_present(known):
    blank = np.zeros_like(BLANK)
    everywhere, _ = step_arrays(known, blank=blank)
    assert everywhere.present["tactile"].all()
    unmasked, _ = step_arrays(known, preprocessing=preprocessing(mask_blank_touch=False))
    assert unmasked.present["tactile"].all()
    none, view = step_arrays(known, preprocessing=preprocessing(touch_threshold=0.9))
    assert view.absent == ("tactile",)
    assert "tactile" not in none.inputs
    assert "tactile" in none.targets
    assert none.present == {}


@pytest.mark.parametrize("in_memory", [True, False])
@pytest.mark.parametrize("split", ["object", "trajectory"])
def test_no_frame_of_a_test_object_is_in_a_training_set(known, split, in_memory):
    rows = evaluation.rows_of(known.data, split)
    arrays, _ = step_arrays(known, rows["train"], in_memory=in_memory)
    batch = arrays.take(np.arange(len(arrays)))
    seen = {image.tobytes() for group in ("inputs", "targets") for image in batch[group]["visual"]}
    held_out = {image.tobytes() for image in known.visual[rows["test"]].reshape(-1, SIZE, SIZE, 3)}
    assert len(held_out) == len(rows["test"]) * FRAMES
    assert not seen & held_out
    assert seen == {image.tobytes() for image in known.visual[rows["train"]].reshape(-1, SIZE, SIZE, 3)}
    if split == "object":
        body = known.data.trajectory["body"]
        assert not np.isin(body[rows["train"]], body[rows["test"]]).any()


# ---- Training from disk


TINY = mvae.Config(
    (
        mvae.Modality("visual", "image", (SIZE, SIZE, 3)),
        mvae.Modality("tactile", "image", (SIZE, SIZE, 3)),
        mvae.Modality("pose", "vector", (12,)),
    ),
    condition=3,
    latent=4,
    hidden=8,
    widths=(4, 4, 4, 4),
)
CONFIG = training.TrainConfig(steps=6, batch_size=4, log_every=2, checkpoint_every=2)


@pytest.mark.slow
def test_a_training_from_disk_has_the_same_bits_as_one_from_memory_even_after_a_kill(known, tmp_path):
    memory, disk = (step_arrays(known, in_memory=kind)[0] for kind in (True, False))
    validation = step_arrays(known, (1, 5), in_memory=False)[0]
    whole = training.train(CONFIG, TINY, memory, workdir=tmp_path / "memory", validation=validation)
    with pytest.raises(Killed):
        training.train(CONFIG, TINY, disk, workdir=tmp_path / "disk", validation=validation, progress=kill_at(3))
    model = training.train(CONFIG, TINY, disk, workdir=tmp_path / "disk", validation=validation)
    same(model.state, whole.state)
    assert (tmp_path / "disk/metrics.jsonl").read_text() == (tmp_path / "memory/metrics.jsonl").read_text()


def test_a_damaged_shard_ends_the_training_with_its_name(tmp_path):
    made = stored(tmp_path)
    arrays, _ = step_arrays(made, in_memory=False)
    for path in made.data.shards:
        path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(dataset.loading.DamagedFileError, match=r"\.array_record is damaged"):
        training.train(CONFIG, TINY, arrays, workdir=tmp_path / "model")


@pytest.mark.slow
def test_the_code_of_the_page_trains_a_one_step_model(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scenario = physics.Perturbed()
    names = {
        **{"sts": sts, "np": np, "dataclasses": dataclasses, "Path": Path, "scenario": scenario},
        "data": stored(tmp_path, condition=3).data,
        "collection": dataset.Collection(scenario, resolution=(SIZE, SIZE)),
        "empty": dataset.Images(BLANK, BLANK, BLANK[..., 0] > 0),
    }
    (code,) = blocks("One-step models", "experiments")
    old = "steps=2000, checkpoint_every=500"
    assert old in code
    exec(code.replace(old, "steps=2, checkpoint_every=1, log_every=1"), names)
    assert names["last"].preprocessing.stride == 1
    assert names["best"].model.step == min(
        (1, 2), key=lambda step: training.records(Path("steps"))[step - 1]["validation"]
    )
