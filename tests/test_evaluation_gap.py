"""Distances between real and simulated images, against closed forms, OpenCV, loops and known differences."""

import dataclasses

import cv2
import numpy as np
import pytest

from sts_jax.evaluation import gap
from sts_jax.hardware import twin
from sts_jax.hardware.twin import photometry

CLEAN = twin.Imperfections(leakage=0.0, vignetting=0.0, read_noise=0.0, full_well=1e12)
SIZE = (72, 96)


def scenes(seed, trajectories):
    """Images of bright and dark ellipses in other poses, two of each trajectory, sRGB in [0, 1]."""
    rng = np.random.default_rng(seed)
    images = []
    for _ in range(2 * trajectories):
        image = np.full((*SIZE, 3), (0.62, 0.62, 0.74), np.float32)
        center = (int(rng.uniform(30, 66)), int(rng.uniform(24, 48)))
        cv2.ellipse(image, center, (20, 9), rng.uniform(0, 180), 0, 360, (0.2, 0.25, 0.3), -1, cv2.LINE_AA)
        cv2.circle(image, center, 5, (0.1, 0.5, 0.2), -1, cv2.LINE_AA)
        images.append(image)
    return np.stack(images), np.repeat(np.arange(trajectories), 2)


def seen(images, imperfections):
    """Images of a camera with imperfections. Under full light the scene is bright everywhere."""
    blender = photometry.Blender(imperfections, lens=None, seed=0)
    return np.stack([blender.frame(blender.ends(image, np.full_like(image, 0.9)), 0.0) for image in images])


def test_errors_of_a_constant_offset_are_its_size():
    image = np.full((6, 64, 64, 3), 100, np.uint8)
    found = gap.pixel_errors(image, image + np.uint8(5), np.repeat(np.arange(3), 2))
    assert found.mae == pytest.approx((5, 5, 5))
    assert found.rmse == pytest.approx((5, 5, 5))
    assert found.psnr.value == pytest.approx(20 * np.log10(51))
    x, y = 100 / 255, 105 / 255
    assert found.ssim.value == pytest.approx((2 * x * y + 1e-4) / (x**2 + y**2 + 1e-4), abs=1e-4)


def test_features_of_vertical_stripes_are_their_colour_and_their_steps():
    image = np.zeros((1, 64, 64, 3), np.uint8)
    image[..., ::2, 1] = 255  # green in every other column
    found = gap.features(image)[0]
    colours, fine = found[:48].reshape(4, 4, 3), found[48:112].reshape(4, 4, 4)
    np.testing.assert_allclose(colours, np.broadcast_to([0, 0.5, 0], (4, 4, 3)), atol=1e-6)
    np.testing.assert_allclose(fine, np.broadcast_to([1 / 3, 0, 1 / 3, 1 / 3], (4, 4, 4)), atol=1e-6)
    np.testing.assert_allclose(found[112:], 0, atol=1e-6)  # at half the resolution the stripes are grey


@pytest.mark.parametrize("matched", [True, False])
def test_energy_distance_equals_its_definition_over_pairs_of_different_trajectories(matched):
    rng = np.random.default_rng(0)
    real, simulated = rng.normal(size=(8, 3)), rng.normal(0.5, 1, size=(8, 3))
    group = np.repeat(np.arange(4), 2)
    other = group if matched else group + 4
    scale = np.concatenate([real, simulated]).std(0)

    def mean(x, y, one, two):
        far = [
            np.linalg.norm((a - b) / scale)
            for a, i in zip(x, one, strict=True)
            for b, j in zip(y, two, strict=True)
            if i != j
        ]
        return np.mean(far)

    within = mean(real, real, group, group) + mean(simulated, simulated, other, other)
    expected = 1 - within / (2 * mean(real, simulated, group, other))
    assert gap.energy_distance(real, simulated, group, other).value == pytest.approx(expected)


def test_p_values_of_equal_distributions_are_uniform():
    rng = np.random.default_rng(1)
    group = np.repeat(np.arange(8), 2)
    p = [
        gap.energy_distance(*np.repeat(rng.normal(size=(2, 8, 4)), 2, axis=1), group, group + apart).p
        for apart in (0, 8)
        for _ in range(30)
    ]
    assert 0.35 < np.mean(p) < 0.65
    assert np.mean(np.array(p) < 0.1) < 0.25


def test_the_two_frames_of_a_trajectory_never_help_to_judge_each_other():
    rng = np.random.default_rng(0)
    # A code of its own for each trajectory, which separates the sides only for those who have seen the trajectory.
    codes = np.repeat(rng.normal(size=(80, 200)), 2, axis=0)
    group = np.repeat(np.arange(80), 2)
    accuracy = gap.told_apart(codes[:80], codes[80:], group[:80], group[80:])
    assert accuracy.low < 0.5 < accuracy.high
    alone = np.arange(160)  # as if they were images of different trajectories
    assert gap.told_apart(codes[:80], codes[80:], alone[:80], alone[80:]).value > 0.9


@pytest.mark.parametrize(
    ("field", "values"),
    [("read_noise", (0.003, 0.01, 0.03)), ("vignetting", (0.05, 0.2, 0.6)), ("leakage", (0.02, 0.1, 0.4))],
)
def test_distances_grow_with_known_imperfections(field, values):
    images, group = scenes(4, 20)
    clean = seen(images, CLEAN)
    errors, energies, accuracies = [], [], []
    for value in values:
        frames = seen(images, dataclasses.replace(CLEAN, **{field: value}))
        described = gap.features(frames), gap.features(clean), group, group
        energy, accuracy = gap.energy_distance(*described), gap.told_apart(*described)
        errors.append(gap.pixel_errors(frames, clean, group).mae.value)
        energies.append(energy.value)
        accuracies.append(accuracy.value)
        assert energy.p < 0.01
    assert errors == sorted(errors)
    assert energies == sorted(energies)
    assert accuracies[-1] > 0.9


IMAGES = np.zeros((12, 72, 96, 3), np.uint8)
NUMBERS, GROUP = np.zeros((12, 3)), np.repeat(np.arange(6), 2)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: gap.pixel_errors(IMAGES / 255, IMAGES, GROUP), "real must be uint8"),
        (lambda: gap.pixel_errors(IMAGES, IMAGES[:, :64], GROUP), "equal shapes"),
        (lambda: gap.features(IMAGES[:, :32]), "at least 64 pixels"),
        (lambda: gap.energy_distance(NUMBERS, NUMBERS, GROUP, GROUP + 4), "got 2 common trajectories"),
        (lambda: gap.told_apart(NUMBERS[:6], NUMBERS, GROUP[:6], GROUP + 6), "at least 5 trajectories, got 3"),
        (lambda: gap.energy_distance(NUMBERS, NUMBERS * np.nan, GROUP, GROUP + 6), "simulated must be finite, got nan"),
    ],
)
def test_bad_calls_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
