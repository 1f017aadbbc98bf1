"""Figures show the numbers and pictures they are given."""

import dataclasses

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image
from test_evaluation_results import judged

import sts_jax as sts
from sts_jax import evaluation
from sts_jax.evaluation import figures
from sts_jax.evaluation.figures import motion, pictures

FRAMES = 5
TIME = np.linspace(0, 1, FRAMES)
WRENCH = np.zeros((FRAMES, 6))
WRENCH[:, 3] = 0.02 * TIME  # N m
STREAMS = [np.full((FRAMES, size, size, 3), 0.5) for size in (16, 8, 8)]


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are drawn, instead of files."""
    found = []
    monkeypatch.setattr(pictures, "save", lambda figure, path: found.append(figure))
    yield found
    for figure in found:
        plt.close(figure)


def test_a_strip_has_the_force_in_n_and_the_moment_in_mn_m(tmp_path, drawn):
    figures.strip(tmp_path / "a.png", TIME, *STREAMS, WRENCH, num=3)
    force, moment = drawn[0].axes[-2:]
    assert force.get_ylabel() == "force (N)"
    assert "(mN m)" in moment.get_ylabel()
    assert [line.get_label() for line in moment.lines] == ["$M_x$", "$M_y$", "$M_z$"]
    np.testing.assert_array_equal([line.get_ydata() for line in force.lines], WRENCH[:, :3].T)
    np.testing.assert_allclose([line.get_ydata() for line in moment.lines], 1e3 * WRENCH[:, 3:].T)
    assert force.get_xlim() == moment.get_xlim()


@pytest.mark.parametrize("sign", [1, -1])
def test_an_animation_draws_the_moment_below_the_force(tmp_path, sign):
    side, path = 60, tmp_path / "a.gif"
    figures.animation(path, TIME, *STREAMS, sign * WRENCH, np.zeros((FRAMES, 3)), outcome="stands", side=side)
    with Image.open(path) as film:
        assert film.n_frames == FRAMES
        assert film.info["duration"] == 500  # 0.25 s, twice as slow
        pages = []
        for t in range(FRAMES):
            film.seek(t)
            pages.append(np.asarray(film.convert("RGB")).astype(int))

    def blue_rows(page, panel):  # of the curve, not of its name above it
        top = motion._HEAD + side + panel * motion._PANEL
        part = page[top + 20 : top + motion._PANEL, 55:]
        return np.flatnonzero(((part[..., 2] - part[..., 0]) > 80).any(1))

    assert np.ptp(blue_rows(pages[-1], 1)) > 60  # from 0 to 20 mN m
    assert 10 < np.ptp(blue_rows(pages[2], 1)) < 50  # halfway
    assert not len(blue_rows(pages[-1], 0))  # no force: the three curves lie on each other, the last one is on top


def test_predictions_show_input_truth_mean_and_four_samples_of_both_streams(tmp_path, drawn):
    test, predicted = judged(k=5)
    figures.predictions(tmp_path / "a.png", test, predicted, num=2, title="t", scenario=sts.physics.Freefall())
    axes = np.array(drawn[0].axes).reshape(4, 7)  # two items, each visual and tactile
    heads = ["input", "truth", "mean of samples", "sample 1", "sample 2", "sample 3", "sample 4"]
    assert [axis.get_title() for axis in axes[0]] == heads
    assert [axis.get_ylabel() for axis in axes[:, 0]] == [
        "#0: rests\nvisual",
        "tactile",
        "#1: fell off\nvisual",
        "tactile",
    ]

    def picture(row, column):
        return np.asarray(axes[row, column].images[0].get_array())

    np.testing.assert_allclose(picture(2, 0), test.visual[1, 0] / 255, rtol=1e-6)
    np.testing.assert_allclose(picture(3, 1), test.tactile[1, 1] / 255, rtol=1e-6)
    np.testing.assert_allclose(picture(3, 2), predicted.tactile[1], rtol=1e-6)
    np.testing.assert_allclose(picture(2, 6), predicted.samples.visual[3, 1] / 255, rtol=1e-6)


def test_ends_are_drawn_in_millimetres_as_the_images_are_oriented(tmp_path, drawn):
    start, truth = np.array([0.01, -0.02, 0.1, 1, 0, 0, 0]), np.array([0.03, 0.04, 0.02, 1, 0, 0, 0])
    rerolled, sampled = (np.tile(truth, (k, 1)) for k in (16, 4))
    sampled[0, 0] = 0.12  # off the pad, and in the figure
    figures.ends(tmp_path / "a.png", (0.15, 0.15), start, truth, rerolled, sampled, title="t")
    left, right = drawn[0].axes
    low, high = left.get_ylim()
    assert low > high  # y points down
    assert right.get_xlim()[1] > 120
    for axis, poses in ((left, rerolled), (right, sampled)):
        first, true, ends = axis.lines
        np.testing.assert_allclose([first.get_xdata()[0], first.get_ydata()[0]], [10, -20])
        np.testing.assert_allclose([true.get_xdata()[0], true.get_ydata()[0]], [30, 40])
        np.testing.assert_allclose(np.transpose([ends.get_xdata(), ends.get_ydata()]), 1e3 * poses[:, :2])


@pytest.mark.parametrize(("last", "scale"), [(0.5, "log"), (-3.0, "linear")])
def test_a_loss_that_becomes_negative_is_drawn_on_a_linear_axis(tmp_path, drawn, last, scale):
    log = [{"step": step, "loss": loss} for step, loss in ((10, 100.0), (20, last))]
    figures.training_curves(tmp_path / "a.png", {"model": log})
    axis = drawn[0].axes[0]
    assert axis.get_yscale() == scale
    assert axis.get_ylim()[0] < last


def test_a_slope_is_drawn_as_a_slope():
    fork = sts.objects.make(jax.random.key(0), "fork")
    red = dataclasses.replace(fork, colors=fork.colors * 0 + jnp.array([1.0, 0, 0]))
    size, slope = jnp.array([0.15, 0.15]), jnp.pi / 6
    up = jnp.array([0.0, -jnp.sin(slope), jnp.cos(slope)])
    stand = jnp.array([1.0, 0, 0, 0])

    def place(position, up):
        picture = np.asarray(evaluation.outside(red, jnp.concatenate([position, stand]), size, up)).astype(float)
        return np.argwhere(picture[..., 0] > picture[..., 1] + 0.3).mean(0)

    level = place(jnp.array([0.0, 0, 0.06]), jnp.array([0.0, 0, 9.81]))
    np.testing.assert_allclose(place(0.06 * up, 9.81 * up), level, atol=2)  # the object above the pad is drawn above it
    downhill = place(jnp.array([0.0, 0.04, 0.06]), 9.81 * up)
    assert downhill[0] > place(jnp.array([0.0, 0.04, 0.06]), None)[0] + 8
