"""The sizes of the rooms on docs/architecture.md, and the budgets that keep the code from growing back unnoticed."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "architecture.md").read_text()
# | room | paths | lines | budget |
ROOMS = [
    (name, re.findall(r"`([^`]+)`", paths), int(lines.replace(",", "")), int(budget.replace(",", "")))
    for name, paths, lines, budget in re.findall(r"^\| ([^|`]+) \| (`[^|]+) \| ([\d,]+) \| ([\d,]+) \|$", PAGE, re.M)
]
TOTALS = {
    "library without hardware": 26_730,
    "hardware": 5_060,
    "experiments": 7_420,
    "benchmarks": 5_800,
    "tests": 26_480,
}


def _files(paths):
    for path in paths:
        yield from [ROOT / path] if path.endswith(".py") else (ROOT / path).rglob("*.py")


def _lines(files):
    return sum(len(file.read_text().splitlines()) for file in files)


@pytest.mark.parametrize(("name", "paths", "lines", "budget"), ROOMS, ids=[room[0] for room in ROOMS])
def test_a_room_keeps_its_budget_and_the_page_states_its_size(name, paths, lines, budget):
    counted = _lines(_files(paths))
    assert counted <= budget, (
        f"{name} has {counted} lines, and its budget is {budget}: delete something, or raise the budget in "
        "docs/architecture.md in the commit that adds a capability, with the reason in its message"
    )
    assert abs(counted - lines) <= 0.1 * lines, f"docs/architecture.md states {lines} lines for {name}: {counted}"


def test_the_rooms_cover_all_code():
    covered = {file for _, paths, _, _ in ROOMS for file in _files(paths)}
    code = {file for top in ("sts_jax", "experiments", "benchmarks", "tests") for file in (ROOT / top).rglob("*.py")}
    assert code == covered


def test_the_budgets_add_up():
    budgets = {name: budget for name, _, _, budget in ROOMS}
    apart = {name: budgets.pop(name) for name in list(TOTALS)[1:]}
    assert {"library without hardware": sum(budgets.values()), **apart} == TOTALS
