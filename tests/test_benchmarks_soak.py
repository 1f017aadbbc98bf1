"""Endurance with 104 trajectories of each scenario, and reading of kept blocks."""

import dataclasses

import numpy as np
import pytest

from benchmarks import soak
from benchmarks.instruments import starts as blocks
from benchmarks.instruments.starts import Starts
from sts_jax import physics
from sts_jax.physics.simulation import SUNK_LIMIT

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", blocks.SCENARIOS)
def test_trajectories_are_finite_settle_and_press_with_their_weight(name):
    found = soak.block(name, 0, 104)
    assert found["resampled"].sum() == 0  # every state was finite
    assert found["sunk"].max() <= SUNK_LIMIT
    assert np.isfinite(found["pose"]).all()
    assert found["settled"].mean() >= 0.9
    assert np.nanmedian(found["wrench_error"]) < 0.01
    assert np.unique(found["body"], return_counts=True)[1].tolist() == [blocks.NUM] * 13
    assert f"{name}: 104 trajectories" in soak.report(name, found)


def kept(folder, name, size=3):
    """Two kept blocks of noise."""
    rng = np.random.default_rng(4)
    made = [{f: rng.normal(size=(size, 2)) for f in Starts._fields if f != "rerolled"} for _ in range(2)]
    blocks.claim(folder, name, size)
    for index, block in enumerate(made):
        np.savez(folder / f"{name}-{index:04d}.npz", **block, sunk=np.zeros(size))
    return made


def test_soaked_reads_all_kept_blocks_in_order(tmp_path):
    made = kept(tmp_path, "inclined")
    loaded = blocks.soaked(tmp_path, "inclined")
    np.testing.assert_array_equal(loaded.pose, np.concatenate([b["pose"] for b in made]))
    assert set(loaded.rerolled) == {-1}
    with pytest.raises(FileNotFoundError, match="has no trajectories of freefall"):
        blocks.soaked(tmp_path, "freefall")


def test_soaked_rejects_blocks_of_other_settings(tmp_path, monkeypatch):
    kept(tmp_path, "inclined", soak.BLOCK)
    with pytest.raises(ValueError, match=r"json was made with block = 504, but the current settings have block = 104"):
        soak.main(soak.Args(num=100, only="inclined"), tmp_path)
    other = dataclasses.replace(physics.Inclined(), tries=1)
    monkeypatch.setitem(blocks.SCENARIOS, "inclined", other)
    with pytest.raises(ValueError, match=r"scenario = .*tries=16.*but the current settings have .*tries=1,"):
        blocks.soaked(tmp_path, "inclined")
