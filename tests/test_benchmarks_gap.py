"""Sessions of the twin for `experiments.gap`, and the table of known differences."""

import numpy as np
import pytest

from benchmarks import gap as benchmark
from sts_jax import hardware
from sts_jax.evaluation import gap

SIZE = (96, 128)


def test_clean_images_pass_through_the_twin_unchanged():
    images = np.random.default_rng(0).integers(0, 256, (2, 2, *SIZE, 3)).astype(np.uint8)
    clean = gap.Streams(*images, np.arange(2))
    same = benchmark.changed(clean, benchmark.Difference("none"), SIZE, 0)
    np.testing.assert_array_equal(same.visual, clean.visual)
    np.testing.assert_array_equal(same.tactile, clean.tactile)


def test_leakage_changes_the_visual_stream_only():
    images = np.random.default_rng(1).integers(0, 256, (2, 2, *SIZE, 3)).astype(np.uint8)
    clean = gap.Streams(*images, np.arange(2))
    (leaking,) = benchmark.levels("leakage", (0.2,))
    found = benchmark.changed(clean, leaking, SIZE, 0)
    np.testing.assert_array_equal(found.tactile, clean.tactile)
    assert np.abs(found.visual.astype(int) - clean.visual).mean() > 5


@pytest.mark.long
def test_both_twins_record_the_same_poses_and_the_table_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(benchmark, "SIZE", SIZE)
    monkeypatch.setattr(benchmark, "DIFFERENCES", benchmark.levels("vignetting", (0.6,)))
    args = benchmark.Args(workdir=tmp_path, trajectories=10, resolution=SIZE, out=tmp_path / "known.txt")
    benchmark.main(args)  # raises an error if the logs of both twins differ in a pose
    lines = (tmp_path / "known.txt").read_text().splitlines()
    assert lines == capsys.readouterr().out.splitlines()
    assert [line[:10] for line in lines[-3:]] == ["none: two ", "none: two ", "vignetting"]
    device = hardware.load_recordings(tmp_path / "device")[0].final
    clean = hardware.load_recordings(tmp_path / "clean")[0].final
    lens, pinhole = hardware.Device.load(tmp_path).lens, benchmark.sts.Sensor().camera
    for stream in ("visual", "tactile"):
        raw, wanted = getattr(device, stream).image, getattr(clean, stream).image.astype(int)
        rectified = hardware.rectified(lens, pinhole, raw, SIZE)
        assert np.abs(rectified - wanted).mean() < 10 < np.abs(raw - wanted).mean()
    with pytest.raises(ValueError, match="has 10 trajectories already: delete it"):
        benchmark.main(args)
