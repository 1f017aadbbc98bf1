"""Metrics of the shipped models on new objects: the calibration error of exact probabilities, and a small run."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest

import sts_jax
from benchmarks import shipped
from sts_jax import dataset


def test_the_calibration_error_of_exact_probabilities_has_its_closed_form():
    found = shipped.if_calibrated(np.full(400, 0.75), draws=2000)
    assert found == pytest.approx(np.sqrt(2 / np.pi) * np.sqrt(0.75 * 0.25 / 400), rel=0.05)  # E|X| of a Gaussian


def test_no_object_is_shared_with_the_training_of_the_model():
    args = shipped.Args("perturbed", objects=4)
    trained = shipped.EXPERIMENTS["perturbed"].LONG.collection
    assert shipped.collection(args).scenario == trained.scenario
    new, old = (dataset.make_bodies(made, np.arange(4)) for made in (shipped.collection(args), trained))
    assert not any(np.array_equal(one.vertices, two.vertices) for one in new for two in old)


def test_worse_images_have_the_noise_and_the_blur_of_the_options():
    line = np.zeros((2, 32, 32, 3), np.uint8)
    line[:, :, 16] = 255
    spread = shipped.degraded(line, shipped.Args("freefall", blur=1.5), np.random.default_rng(0)).astype(float)
    assert np.sum(spread[0, 8, :, 0] * (np.arange(32) - 16) ** 2) / np.sum(spread[0, 8, :, 0]) == pytest.approx(
        2.25, rel=0.05
    )
    grey = np.full((4, 64, 64, 3), 128, np.uint8)
    noisy = shipped.degraded(grey, shipped.Args("freefall", noise=4), np.random.default_rng(0)).astype(float)
    assert (noisy.mean(), noisy.std()) == pytest.approx((128, np.sqrt(16 + 1 / 12)), rel=0.01)  # 1/12: rounding
    assert np.array_equal(shipped.degraded(grey, shipped.Args("freefall"), np.random.default_rng(0)), grey)


@pytest.mark.long
def test_a_small_run_prints_the_metrics_of_every_input(tmp_path):
    args = shipped.Args("released", objects=10, workdir=tmp_path / "work")
    text = shipped.main(args)
    assert "32 held-out trajectories of 8 objects" in text
    assert "| from visual and tactile |" in text
    assert "Touch removes" in text
    assert {path.name for path in tmp_path.glob("*.png")} == {"work-visual.png", "work-all.png"}
    samples = text.split("# released: 16 samples of each prediction")[1]
    row = next(line for line in samples.splitlines() if line.startswith("| from all inputs |"))
    best, sharpness, touch_sharpness, energy, coverage = (float(cell.split()[0]) for cell in row.split("|")[2:-1])
    assert best > 0.4
    assert 0.5 < sharpness < 1.5
    assert 0.05 < touch_sharpness < sharpness
    assert 0 < energy < 100
    assert 0 < coverage <= 1
    assert shipped.main(args) == text  # the trajectories are reused
    copy = shutil.copytree(Path(sts_jax.__file__).parent / "models" / "released", tmp_path / "copy")
    same = shipped.main(dataclasses.replace(args, trained=copy))
    assert f"the model in {copy}" in same
    assert same.splitlines()[1:] == text.splitlines()[1:]
