"""All documented command lines of the benchmarks are valid, and all commands are documented."""

import importlib
import re
import shlex
from pathlib import Path

import pytest
import tyro

ROOT = Path(__file__).parent.parent
SOURCES = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("benchmarks/**/*.py")]
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
