"""Faults of a sensor's devices: no image of a wrong light, no read beyond its limit, and recovery from each fault."""

import pytest

from benchmarks import faults

SHORT = (
    "answer late",
    "answer garbled",
    "stale answer",
    "watchdog fires",
    "controller restarts",
    "port returns renamed",
    "frames held back",
    "frames repeated",
    "black",
    "stream closed",
)


def check(counts, number):
    assert sum(count.injected for count in counts.values()) == number
    # Frames that were held back for less than 2.5 periods cannot be told from new ones.
    assert sum(count.old for count in counts.values()) <= 0.03 * sum(count.images for count in counts.values())
    for kind, count in counts.items():
        assert count.wrong == count.unnamed == 0, kind
        assert count.recovered == count.injected, kind
        assert count.longest_s <= count.limit_s, kind
    for kind in counts.keys() - {faults.KILLED}:
        assert counts[kind].images >= 4 * counts[kind].injected, kind  # a pair before and after each fault


@pytest.mark.slow
def test_ten_short_faults(monkeypatch):
    monkeypatch.setattr(faults, "LONG", 0.0)
    counts = faults.measure(faults.Args(number=10, seed=4, only=SHORT))  # this seed has a short lag
    check(counts, 10)
    assert faults.report(counts).splitlines()[-1].split()[:2] == ["all", "10"]


@pytest.mark.slow
def test_every_kind_of_fault():
    number = len(faults.KINDS) + 1
    counts = faults.measure(faults.Args(number=number, seed=4))
    check(counts, number)
    assert 0 < counts[faults.KILLED].lit_s <= faults.WATCHDOG_MS / 1000 + faults.DARK_S
