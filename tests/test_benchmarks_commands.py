"""All documented command lines of the benchmarks are valid, and all commands are documented."""

import importlib
import re
import shlex
from pathlib import Path

import pytest
import tyro

import sts_jax
from benchmarks import device, faults, gap, hidden, scene, sharpness, shipped

ROOT = Path(__file__).parent.parent
SOURCES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/**/*.md"), *ROOT.glob("benchmarks/**/*.py")]
COMMAND = re.compile(r'python -m benchmarks\.(\w+)([^`"#\n]*)')
FURTHER = re.compile(r"^\| `\.\.\. ([^`]*)`", re.MULTILINE)  # options of the command in a row above
NAMES = [path.stem for path in ROOT.glob("benchmarks/*.py") if path.stem != "__init__"]


def documented():
    """Names of commands with their options, without repetitions."""
    found = set()
    for path in SOURCES:
        text = path.read_text()
        commands = list(COMMAND.finditer(text))
        found |= {(command[1], command[2].strip()) for command in commands}
        for row in FURTHER.finditer(text):
            above = [command for command in commands if command.start() < row.start()]
            found.add((above[-1][1], row[1].strip()))
    return sorted(found)


@pytest.mark.parametrize(("name", "options"), documented())
def test_documented_command_is_valid(name, options):
    module = importlib.import_module(f"benchmarks.{name}")
    if hasattr(module, "Args"):
        tyro.cli(module.Args, args=shlex.split(options))
    else:
        assert options == ""


@pytest.mark.parametrize("name", NAMES)
def test_every_command_is_documented(name):
    assert f"python -m benchmarks.{name}" in (ROOT / "docs" / "benchmarks.md").read_text()


PERTURBED = Path(sts_jax.__file__).parent / "models" / "perturbed"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: device.Args(pairs=2), "--lags-ms must have 1 to --pairs values, got 5"),
        (lambda: faults.Args(number=0), "--number must be at least 1, got 0"),
        (lambda: faults.Args(only=("rain",)), r"unknown kinds \['rain'\]"),
        (lambda: gap.main(gap.Args(trajectories=9)), "--trajectories must be >= 10, got 9"),
        (lambda: gap.main(gap.Args(resolution=(64, 64))), "must have the aspect ratio"),
        (lambda: hidden.Args(soaked=Path("a"), objects=200), "--soaked provides the trajectories"),
        (lambda: scene.Args(sizes=("64",)), "--sizes must be height x width, such as 64x64, got '64'"),
        (lambda: scene.Args(envs=(0,)), r"--envs and --repeats must be at least 1, got \(0,\) and 3"),
        (lambda: sharpness.Args(("fog",)), r"unknown conditions \['fog'\]"),
        (lambda: sharpness.Args(trajectories=50), "--trajectories must be a multiple of 24, at least 48, got 50"),
        (lambda: shipped.main(shipped.Args("perturbed", objects=4)), "--objects must be at least 5, got 4"),
        (lambda: shipped.main(shipped.Args("freefall", trained=PERTURBED)), "perturbed has outcomes=4 and condition=3"),
    ],
)
def test_bad_options_are_refused(call, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=message):
        call()
    assert not list(tmp_path.iterdir())
