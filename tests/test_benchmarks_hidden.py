"""Errors of the command line of `benchmarks.hidden` before anything is simulated."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (
            "--soaked a --keep b --objects 200",
            "--soaked provides the simulated trajectories: leave out --objects and --keep",
        ),
        ("fill --scenario inclined", "the report for --scenario inclined has no part named fill: give some of"),
    ],
)
def test_command_line_rejects_contradictory_options(options, reason):
    command = [sys.executable, "-m", "benchmarks.hidden", *options.split()]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert reason in " ".join(done.stderr.replace("│", " ").split())  # tyro breaks the lines in a box
