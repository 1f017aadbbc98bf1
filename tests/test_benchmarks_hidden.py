"""What `benchmarks.hidden` refuses before anything is simulated."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ("--soaked a --keep b --objects 200", "--objects and --keep would be ignored"),
        ("fill --scenario inclined", "parts of inclined are outcomes, truth, pictures"),
    ],
)
def test_what_would_be_ignored_is_refused(options, reason):
    command = [sys.executable, "-m", "benchmarks.hidden", *options.split()]
    told = subprocess.run(command, capture_output=True, text=True, check=False)
    assert told.returncode == 2
    assert reason in told.stderr
