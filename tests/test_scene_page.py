"""The code of `docs/scene.md`, but that of `Lift`, runs as it stands, with a gripper whose object is called cube."""

import re
import textwrap
from pathlib import Path

import mujoco
import numpy as np
import pytest
from extending_page import DOCS

import sts_jax as sts

BLOCKS = [
    textwrap.dedent(block)
    for block in re.findall(r"^ *```python\n(.*?)^ *```", (DOCS / "scene.md").read_text(), re.DOTALL | re.MULTILINE)
]
# The block of `Lift` takes minutes. `tests/test_environments.py` has its calls.
ATTACH, STEP, MEAN, PRESS, _, GYM, PLAYGROUND = BLOCKS


@pytest.fixture
def gripper(tmp_path, monkeypatch):
    """The file `gripper.xml` in the current folder."""
    monkeypatch.chdir(tmp_path)
    spec = sts.scene.gripper(sts.Sensor.sized(0.04))
    spec.body("object").name = "cube"
    Path("gripper.xml").write_text(spec.to_xml())


@pytest.mark.slow
def test_the_three_lines_and_the_frames_after_steps(gripper):
    names = {}
    exec(ATTACH, names)
    exec(STEP, names)
    assert names["frame"].visual.shape == (240, 320, 3)
    assert "cube" in names["view"].bodies
    assert names["wrench"].shape == (6,)
    exec(MEAN, names)
    assert names["frame"].tactile.shape == (64, 64, 3)
    assert names["data"].time == pytest.approx(21 * names["model"].opt.timestep)


def test_a_soft_pad(gripper):
    names = {"sts": sts, "spec": mujoco.MjSpec.from_file("gripper.xml"), "sensor": sts.Sensor.sized(0.04)}
    exec(PRESS, names)
    assert names["spec"].compile().geom("left").solref[0] < 0


@pytest.mark.slow
def test_the_environment_of_gymnasium():
    pytest.importorskip("gymnasium")
    names = {}
    exec(GYM, names)
    assert np.isfinite(names["reward"])


def test_playgrounds_wrapper():
    playground = pytest.importorskip("mujoco_playground")
    names = {"sts": sts, "mujoco_playground": playground}
    exec(PLAYGROUND, names)
    assert names["env"].action_size == 2
