"""The page for builders: pins as in the firmware, arithmetic that holds, drawings as the script makes them."""

import collections
import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "hardware" / "building.md").read_text(encoding="utf-8")
FIRMWARE = (ROOT / "sts_jax" / "hardware" / "firmware" / "leds.c").read_text(encoding="utf-8")
DATA_SHEET = {"PD3": "D3", "PD5": "D5", "PD6": "D6", "PB3": "D11"}  # port to Arduino pin, Uno and Nano
E12 = (10, 12, 15, 18, 22, 27, 33, 39, 47, 56, 68, 82)
SUPPLY, WANTED = 12.0, 0.020  # V, A


def table(first_column):
    """The rows of the table whose first heading is given."""
    lines = PAGE.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith(f"| {first_column} |"))
    rows = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split("|")])
    return rows


def wired():
    """Channel to timer output, from the assignments of levels to compare registers, not from the comment."""
    return {int(level): f"OC{timer}" for timer, level in re.findall(r"OCR(\d[AB]) = levels\[(\d)\];", FIRMWARE)}


def test_pins_are_those_that_the_firmware_drives():
    rows = table("channel")
    assert {int(row[0]): row[2] for row in rows} == wired()
    ports = re.search(r"PORTD &= ~\((.*?)\);\s+PORTB &= ~(_BV\(PB\d\))", FIRMWARE).group(0)
    driven = {DATA_SHEET[port] for port in re.findall(r"_BV\((P[BD]\d)\)", ports)}
    assert {row[1] for row in rows} == driven
    comment = {int(c): (pin, timer) for c, pin, timer in re.findall(r"(\d)\s+(D\d+)\s+P[BD]\d\s+(OC\d[AB])", FIRMWARE)}
    assert {int(row[0]): (row[1], row[2]) for row in rows} == comment


def test_arithmetic_of_the_strings_holds():
    total = 0.0
    for row in table("channel | Vf (V)"):
        forward, ideal, chosen, current, power, strings, channel = map(float, row[1:])
        rest = SUPPLY - 3 * forward
        assert ideal == pytest.approx(rest / WANTED, abs=0.5)
        assert chosen == min(10 * value for value in E12 if 10 * value >= ideal)  # the next larger of E12
        assert current == pytest.approx(1e3 * rest / chosen, abs=0.05)
        assert power == pytest.approx(rest**2 / chosen, abs=6e-4)
        assert channel == pytest.approx(strings * 1e3 * rest / chosen, abs=0.05)
        total += channel
    stated = re.search(r"= ([\d.]+) mA at 12 V, which is ([\d.]+) W", PAGE)
    assert float(stated.group(1)) == pytest.approx(total, abs=0.05)
    assert float(stated.group(2)) == pytest.approx(12e-3 * total, abs=0.05)


def test_resistors_of_the_parts_list_are_those_of_the_strings():
    parts = table("part")
    listed = {int(m.group(1)): int(row[1]) for row in parts if (m := re.match(r"series resistor (\d+) Ω", row[0]))}
    counted = collections.Counter()
    for row in table("channel | Vf (V)"):
        counted[int(row[3])] += int(row[6])
    assert listed == counted


def test_pulses_of_an_exposure_follow_from_the_timers():
    period = 510 / 16e6  # phase-correct: the timer counts up and down
    assert "TCCR0A = _BV(WGM00);" in FIRMWARE
    assert f"a period of {1e6 * period:.1f} µs" in PAGE
    assert f"{1e-3 / period:.1f} kHz" in PAGE
    for exposure, pulses, difference in table("exposure (ms)"):
        count = 1e-3 * float(exposure) / period
        assert int(pulses) == round(count)
        assert difference == f"{100 / count:.1f} %"


@pytest.mark.parametrize("name", ["wiring", "side"])
def test_drawings_are_those_of_the_script(name):
    spec = importlib.util.spec_from_file_location("drawings", ROOT / "docs" / "hardware" / "drawings.py")
    drawings = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(drawings)
    drawn = {"wiring": drawings.wiring, "side": drawings.side_view}[name]()
    assert (ROOT / "docs" / "hardware" / f"{name}.svg").read_text(encoding="utf-8") == drawn
    if name == "wiring":
        shown = [f"{row[3]} Ω" for row in table("channel | Vf (V)")] + [row[1] for row in table("channel")]
        assert all(f">{text}<" in drawn for text in shown)
