"""Fits of x, y and yaw to a tactile image end at the true values."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from experiments import fit

pytestmark = pytest.mark.slow

SMALL = (64, 64)


@pytest.fixture
def seven(tmp_path):
    """A flat 7, 40 mm tall, with upright walls. Only its edges depend on its place."""
    stem, arm = trimesh.creation.box((0.008, 0.04, 0.01)), trimesh.creation.box((0.025, 0.008, 0.01))
    arm.apply_translation((0.01, 0.016, 0))
    path = tmp_path / "seven.stl"
    trimesh.util.concatenate([stem, arm]).export(path)
    return str(path)


def starts(text):
    """Errors at the beginning (mm, mm, degrees) and at the end (mm, degrees) of each start."""
    line = r"start \d: (\S+), (\S+) mm, (\S+) degrees off; end: (\S+) mm, (\S+) degrees off, loss \S+\n"
    return np.array(re.findall(line, text), float)


@pytest.mark.parametrize("mesh", ["seven", "scissors"])
def test_starts_3_mm_and_10_degrees_off_end_within_200_um_and_1_degree(mesh, seven, tmp_path, capsys):
    out = tmp_path / "fit.png"
    mass = 0.05 if mesh == "seven" else None
    fit.main(fit.Config(seven if mesh == "seven" else mesh, out=out, mass=mass, resolution=SMALL, starts=3))
    text = capsys.readouterr().out
    found = starts(text)
    np.testing.assert_allclose(np.hypot(found[:, 0], found[:, 1]), 3, atol=0.02)
    np.testing.assert_allclose(np.abs(found[:, 2]), 10)
    assert len(np.unique(found[:, 0])) == 3
    assert np.all(found[:, 3] <= 0.2)
    assert np.all(np.abs(found[:, 4]) <= 1)
    assert "3 of 3 within 0.2 mm and 1 degree" in text
    with Image.open(out) as picture:
        assert picture.size == (1300, 800)
        assert len(picture.convert("RGB").getcolors(1300 * 800)) > 100


def test_the_wrench_moves_with_the_pose():
    pose = np.array([0.01, -0.02, 0.003, *Rotation.from_euler("xyz", [0.3, -0.2, 1.0]).as_quat()[[3, 0, 1, 2]]])
    point = np.array([0.004, 0.007])  # where the force acts, relative to the pose's place
    x, y = pose[:2] + point
    wrench = np.array([0, 0, 2.0, 2 * y, -2 * x, 0])
    at = np.array([0.003, -0.001, 0.4])
    turn = Rotation.from_euler("z", 0.4)

    new = np.asarray(fit.moved(jnp.asarray(pose), jnp.asarray(at)))
    np.testing.assert_allclose(new[:3], [0.013, -0.021, 0.003], atol=1e-7)
    wanted = (turn * Rotation.from_quat(pose[[4, 5, 6, 3]])).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(new[[4, 5, 6, 3]]).as_matrix(), wanted, atol=1e-6)

    x, y = new[:2] + turn.apply([*point, 0])[:2]
    force = fit.carried(jnp.asarray(wrench), jnp.asarray(pose), jnp.asarray(at))
    np.testing.assert_allclose(force, [0, 0, 2, 2 * y, -2 * x, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"starts": 0}, "starts is 0, but it must be from 1 to 1,000"),
        ({"force": 0.0}, "force is 0, but it must be > 0"),
        ({"position": (0.3, 0.0), "resolution": SMALL}, "scissors leaves no imprint in view"),
    ],
)
def test_an_object_that_cannot_be_fitted_is_refused(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        fit.main(fit.Config(**{"mesh": "scissors", "out": tmp_path / "a.png"} | changes))
    assert not list(tmp_path.iterdir())
