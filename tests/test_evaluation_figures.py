"""What a trajectory's pictures show of a wrench: force and moment, each in its own axis, to scale."""

import numpy as np
import pytest
from PIL import Image

from sts_jax.evaluation import figures

FRAMES = 5
TIME = np.linspace(0, 1, FRAMES)
WRENCH = np.zeros((FRAMES, 6))
WRENCH[:, 3] = 0.02 * TIME  # N m
STREAMS = [np.full((FRAMES, size, size, 3), 0.5) for size in (16, 8, 8)]


def test_a_strip_has_the_force_in_n_and_the_moment_in_mn_m(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "_save", lambda figure, path: drawn.append(figure))
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
        top = 44 + side + panel * figures._PANEL
        part = page[top + 20 : top + figures._PANEL, 55:]
        return np.flatnonzero(((part[..., 2] - part[..., 0]) > 80).any(1))

    assert np.ptp(blue_rows(pages[-1], 1)) > 60  # from 0 to 20 mN m
    assert 10 < np.ptp(blue_rows(pages[2], 1)) < 50  # halfway
    assert not len(blue_rows(pages[-1], 0))  # no force: the three curves lie on each other, the last one is on top
