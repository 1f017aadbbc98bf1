"""The statistics of `benchmarks.hidden` against known truths."""

import math

import jax
import numpy as np
import pytest

from benchmarks import classify, hidden, reader
from sts_jax import objects


def test_gain_is_that_of_a_known_channel_and_folds_do_not_part_objects():
    # The outcome is whether what is seen and what is felt agree, except one time in ten: sight alone knows nothing.
    rng = np.random.default_rng(0)
    body = np.repeat(np.arange(60), 40)
    seen, felt = rng.integers(0, 2, (2, len(body)))
    label = (seen ^ felt) ^ (rng.uniform(size=len(body)) < 0.1)
    named = rng.permutation(60)[body]  # tells the object
    before = classify.log_loss(classify.chances(np.stack([seen, named], 1), label, body), label)
    after = classify.log_loss(classify.chances(np.stack([seen, named, felt], 1), label, body), label)
    entropy = -0.1 * math.log(0.1) - 0.9 * math.log(0.9)
    assert before.mean() == pytest.approx(math.log(2), abs=0.02)
    assert after.mean() == pytest.approx(entropy, abs=0.03)
    gain = classify.interval(classify.gain, before, after, groups=body)
    assert gain.low < 1 - entropy / math.log(2) < gain.high
    assert gain.high - gain.low < 0.1
    assert classify.kept(before, after, before) == pytest.approx(0, abs=1e-6)
    assert classify.kept(before, after, after) == pytest.approx(1)

    # A coin thrown once for each object is known by name to whoever has seen the object.
    coin = rng.integers(0, 2, 60)[body]
    assert classify.log_loss(classify.chances(named[:, None], coin, body), coin).mean() > 0.6


def test_interval_is_as_wide_as_differing_objects_make_it():
    rng = np.random.default_rng(1)
    body = np.repeat(np.arange(100), 50)
    values = rng.normal(size=100)[body]
    figure = classify.interval(np.mean, values, groups=body)
    assert figure.high - figure.low == pytest.approx(2 * 1.96 * values.std() / 10, rel=0.1)


def test_auc_of_two_shifted_normals_and_of_ties():
    rng = np.random.default_rng(2)
    label = rng.uniform(size=20000) < 0.3
    assert classify.auc(label, rng.normal(size=20000) + label) == pytest.approx(0.7602, abs=0.01)  # Phi(1 / sqrt(2))
    assert classify.auc(label, np.zeros(20000)) == 0.5
    assert classify.auc(label, label.astype(float)) == 1


def test_what_the_classifier_is_told_of_a_shake_is_the_same_in_all_symmetries_of_the_pad():
    body = objects.make(jax.random.key(4), "bottle")
    seen = hidden.sight([body])
    place, pad = np.array([0.004, -0.013]), np.array([-3.0, 5.0])
    turns = [np.array([[0.0, -1], [1, 0]]), np.diag([1.0, -1]), np.array([[0.0, 1], [1, 0]]), np.eye(2)]
    pose = np.stack([np.append(turn @ place, [0.05, 1, 0, 0, 0]) for turn in turns])
    condition = np.stack([np.append(turn @ pad, 0.1) for turn in turns])
    blank = np.zeros(4)
    starts = hidden.Starts(np.zeros(4, int), pose, np.zeros((4, 6)), condition, *[blank] * 5)
    mass, com, _ = objects.rigid(body, 0.5, 1.0)
    rows = hidden.shaken([body], starts, np.full((4, 1), math.log(float(mass))))
    np.testing.assert_allclose(rows, rows[[0, 0, 0, 0]], rtol=1e-6)
    # Room to the edge that it is pushed to: 13 mm beyond the middle of y, pushed to -y and a little to +x.
    assert hidden.canonical(pose, condition)[1] == pytest.approx(np.array([[5.0, 3.0]] * 4))
    # The weight of a half full bottle says how high its centre of mass is.
    half = float(com[2]) - seen.low[0]
    assert rows[0, -3] == pytest.approx(half, rel=1e-3)


def test_tipping_begins_at_g_b_over_h():
    rigid = np.tile([[0.1, 0.05, 1e-4]], (2, 1))
    at = hidden.G * 0.01 / 0.05
    ratio, energy = hidden.tipping(rigid, np.full(2, 0.01), np.array([0.99, 2.5]) * at, np.full(2, 0.1), 0.55).T
    assert ratio == pytest.approx([0.99, 2.5])
    assert energy[0] == pytest.approx(math.log(1e-3))
    assert energy[1] > 0  # more than enough


def test_balance_of_a_block_on_the_slope():
    # 20 x 40 mm of support; the centre of mass 10 mm above its middle, then so high that it tips, then off centre.
    corners = np.array([[-0.01, -0.02], [0.01, -0.02], [0.01, 0.02], [-0.01, 0.02]])
    slope = math.radians(30)
    high = 0.02 / math.tan(slope)
    centre = np.array([[0, 0, 0.01], [0, 0, 0.01], [0, 0, 1.01 * high], [0, 0, 0.99 * high], [0.011, 0, 0.01]])
    end, pressure = hidden.balance(corners, centre, np.array([0.7, 0.5, 0.7, 0.7, 0.7]), slope)
    assert end.tolist() == [2, 1, 0, 2, 0]
    ahead = 0.01 * math.tan(slope)
    expected = [[0, ahead], [0, 0.005], [0, 0.02], [0, 0.99 * 0.02], [0.01, ahead]]
    np.testing.assert_allclose(pressure, expected, atol=1e-9)


def test_soaked_blocks_are_read_in_turn(tmp_path):
    rng = np.random.default_rng(4)
    blocks = [{f: rng.normal(size=(3, 2)) for f in hidden.Starts._fields if f != "rerolled"} for _ in range(2)]
    for index, block in enumerate(blocks):
        np.savez(tmp_path / f"inclined-{index:04d}-3.npz", **block, sunk=np.zeros(3))
    starts = hidden.soaked(tmp_path, "inclined")
    np.testing.assert_array_equal(starts.pose, np.concatenate([b["pose"] for b in blocks]))
    assert set(starts.rerolled) == {-1}
    with pytest.raises(FileNotFoundError, match="no block freefall"):
        hidden.soaked(tmp_path, "freefall")


def test_reader_reads_a_faint_blob_and_its_presence():
    rng = np.random.default_rng(3)
    size = rng.uniform(0, 1, 400)
    images = np.full((400, 32, 32, 3), 150.0) + rng.normal(scale=2, size=(400, 32, 32, 3))
    for image, (row, column), s in zip(images, rng.integers(2, 24, (400, 2)), size, strict=True):
        image[row : row + 6, column : column + 6] -= 40 * s
    images = images.round().astype(np.uint8)
    read = reader.fit(jax.random.key(0), images[:300], size[:400, None], steps=80)
    assert np.std(read(images[300:])[:, 0] - size[300:]) < 0.1
    tell = reader.fit(jax.random.key(0), images[:300], size[:400, None] > 0.5, steps=80)
    assert classify.auc(size[300:] > 0.5, tell(images[300:])[:, 0]) > 0.95
