"""Rounded weights: the largest change of a weight, and the size of the file."""

import numpy as np

from sts_jax.training import rounded


def trip(tmp_path, arrays):
    rounded.write(tmp_path / rounded.NAME, arrays)
    return rounded.read(tmp_path / rounded.NAME)


def test_a_weight_moves_by_at_most_half_a_step_of_its_channel(tmp_path):
    rng = np.random.default_rng(0)
    scale = 10.0 ** np.arange(-6, 6)
    kernels = {
        "dense/kernel": rng.normal(size=(64, 12)) * scale,
        "conv/kernel": rng.laplace(size=(3, 3, 16, 12)) * scale,
        "sparse/kernel": (rng.random((300, 12)) < 0.01) * scale,
        "zero/kernel": np.zeros((5, 12)),
        "one/kernel": rng.normal(size=(1, 12)),
    }
    kernels = {name: values.astype(np.float32) for name, values in kernels.items()}
    for name, values in trip(tmp_path, kernels).items():
        assert (values.shape, values.dtype) == (kernels[name].shape, np.float32)
        flat, exact = (x.reshape(-1, 12).astype(np.float64) for x in (values, kernels[name]))
        assert np.all(np.abs(flat - exact).max(0) <= 1.001 * np.sqrt(np.mean(exact**2, 0)) / 256)


def test_a_weight_far_larger_than_the_others_of_its_channel_is_kept(tmp_path):
    kernel = np.ones((100_000, 1), np.float32)
    kernel[7] = 1e5  # 316 times the root mean square, beyond 16 bits of its 128th part
    again = trip(tmp_path, {"kernel": kernel})["kernel"]
    np.testing.assert_allclose(again[7], 1e5, rtol=1e-4)
    assert np.abs(again - kernel).max() <= 1e5 / 2**15


def test_vectors_and_whole_numbers_are_kept(tmp_path):
    rng = np.random.default_rng(0)
    arrays = {
        "bias": rng.normal(size=100).astype(np.float32),
        "step": np.int32(26000),
        "table": rng.integers(9, size=(4, 5)),
        "empty": np.zeros((0,), np.float32),
    }
    again = trip(tmp_path, arrays)
    assert again.keys() == arrays.keys()
    for name, values in arrays.items():
        assert again[name].dtype == values.dtype
        np.testing.assert_array_equal(again[name], values)


def test_normal_weights_take_less_than_three_quarters_of_half_precision(tmp_path):
    kernel = np.random.default_rng(0).normal(size=(500, 500)).astype(np.float32)
    trip(tmp_path, {"kernel": kernel})
    np.savez_compressed(tmp_path / "half.npz", kernel=kernel.astype(np.float16))
    size, half = ((tmp_path / name).stat().st_size for name in (rounded.NAME, "half.npz"))
    assert size < 1.4 * kernel.size
    assert size < 0.75 * half
