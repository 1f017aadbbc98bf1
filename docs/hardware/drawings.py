"""Draw wiring.svg and side.svg for building.md.

    python docs/hardware/drawings.py    # in the root folder of the repository

The dimensions are those of `sts_jax.Sensor()`, and the pins those of the firmware's source.
"""

import math
import re
from pathlib import Path

import sts_jax as sts

FOLDER = Path(__file__).parent
FIRMWARE = FOLDER.parents[1] / "sts_jax" / "hardware" / "firmware" / "leds.c"
STRIPS = (  # by channel: side in the image, colour, series resistor of a string (ohm), stroke
    ("left", "red", 330, "#c0392b"),
    ("right", "green", 150, "#1e8449"),
    ("top", "blue", 150, "#2e5cb8"),
    ("bottom", "white", 150, "#8a8a8a"),
)
GATE, PULL = "330 Ω", "10 kΩ"
MM = 3.2  # pixels per millimetre of the side view


def pins() -> dict[int, str]:
    """Read the Arduino pin of each channel from the comment at the head of the firmware."""
    rows = re.findall(r"^   (\d)\s+(D\d+)\s+P[BD]\d\s+OC\w+$", FIRMWARE.read_text(encoding="utf-8"), re.MULTILINE)
    return {int(channel): pin for channel, pin in rows}


def text(x: float, y: float, words: str, *, size: int = 14, anchor: str = "start", bold: bool = False) -> str:
    """Draw a line of text at (x, y)."""
    weight = ' font-weight="bold"' if bold else ""
    return f'<text x="{x:g}" y="{y:g}" font-size="{size}" text-anchor="{anchor}"{weight}>{words}</text>'


def line(*points: tuple[float, float], colour: str = "#222", width: float = 1.6, extra: str = "") -> str:
    """Draw a line through several points."""
    path = " ".join(f"{x:g},{y:g}" for x, y in points)
    return f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="{width}"{extra}/>'


def box(x: float, y: float, width: float, height: float, *, fill: str = "#fff", colour: str = "#222") -> str:
    """Draw a rectangle whose upper left corner is at (x, y)."""
    return (
        f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="3" fill="{fill}" stroke="{colour}" '
        'stroke-width="1.6"/>'
    )


def dot(x: float, y: float) -> str:
    """Draw a junction of wires at (x, y)."""
    return f'<circle cx="{x:g}" cy="{y:g}" r="3.4" fill="#222"/>'


def ground(x: float, y: float) -> str:
    """Draw the ground symbol below a wire that ends at (x, y)."""
    return "".join(line((x - w, y + 4 * i), (x + w, y + 4 * i)) for i, w in enumerate((10, 6, 2)))


def page(width: float, height: float, title: str, parts: list[str]) -> str:
    """Make the SVG file of a drawing. Its white background keeps it readable in the dark mode of the site."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" width="{width:g}" '
        f'height="{height:g}" font-family="sans-serif" fill="#222" role="img"><title>{title}</title>\n'
        f'<rect width="{width:g}" height="{height:g}" rx="8" fill="#fff"/>\n' + "\n".join(parts) + "\n</svg>\n"
    )


def channel(number: int, pin: str, y: float, rail: float) -> list[str]:
    """Draw the row of a channel: pin, gate resistor, pull-down resistor, transistor and LEDs.

    Args:
        number: Number of the channel.
        pin: Name of the Arduino pin.
        y: Height of the row in the drawing (pixels).
        rail: x of the supply's wire (pixels).
    """
    side, colour, ohms, stroke = STRIPS[number]
    parts = [text(312, y + 5, pin, anchor="end", bold=True), text(196, y + 5, f"channel {number}", size=12)]
    parts += [line((320, y), (350, y)), box(350, y - 9, 52, 18), text(376, y + 5, GATE, size=12, anchor="middle")]
    parts += [line((402, y), (470, y)), dot(436, y), line((436, y), (436, y + 14))]
    parts += [box(410, y + 14, 52, 18), text(436, y + 28, PULL, size=12, anchor="middle")]
    parts += [line((436, y + 32), (436, y + 42)), ground(436, y + 42)]
    parts += [box(470, y - 26, 70, 52), text(505, y + 5, f"Q{number}", anchor="middle", bold=True)]
    parts += [text(475, y + 4, "G", size=11), text(535, y - 11, "D", size=11, anchor="end")]
    parts += [text(535, y + 20, "S", size=11, anchor="end")]
    parts += [line((540, y + 15), (562, y + 15), (562, y + 42)), ground(562, y + 42)]
    parts += [line((540, y - 15), (rail, y - 15), colour=stroke, width=2.2), dot(rail, y - 15)]
    for k in range(3):  # LEDs, whose cathodes (bars) are on the side of the drain
        x = 625 + 45 * k
        triangle = f"{x},{y - 15} {x + 18},{y - 25} {x + 18},{y - 5}"
        parts.append(f'<polygon points="{triangle}" fill="{stroke}" stroke="{stroke}"/>')
        parts.append(line((x, y - 26), (x, y - 4), colour=stroke, width=2.6))
    parts += [box(770, y - 24, 62, 18, colour=stroke), text(801, y - 10, f"{ohms} Ω", size=12, anchor="middle")]
    parts.append(text(600, y + 16, f"{side} side, {colour}: 3 such strings in parallel", size=12))
    return parts


def wiring() -> str:
    """Make the drawing of the wiring: computer, board, four channels and supply."""
    rail, rows = 880.0, {number: 130 + 105 * number for number in pins()}
    parts = [text(20, 34, "Wiring of the lights", size=18, bold=True)]
    parts += [box(20, 110, 110, 60, fill="#eef2f7"), text(75, 145, "computer", anchor="middle")]
    parts += [box(20, 300, 110, 60, fill="#eef2f7"), text(75, 335, "camera", anchor="middle")]
    parts += [line((75, 170), (75, 300), width=3), text(84, 240, "USB or")]
    parts += [text(84, 257, "network")]
    parts += [line((130, 140), (186, 140), width=3), text(158, 130, "USB", anchor="middle")]
    parts += [box(186, 78, 134, 470, fill="#e8f3ee"), text(253, 102, "Arduino Uno/Nano", size=13, anchor="middle")]
    for number, pin in pins().items():
        parts += channel(number, pin, rows[number], rail)
    parts += [text(312, 527, "GND", anchor="end", bold=True), line((320, 522), (376, 522), (376, 534))]
    parts.append(ground(376, 534))
    parts += [line((rail, 84), (rail, 500), colour="#b03a2e", width=2.6)]
    parts.append(text(rail + 8, 92, "+12 V", bold=True))
    parts += [box(rail - 9, 500, 18, 44), text(rail + 16, 527, "fuse 0.5 A", size=13)]
    parts += [line((rail, 544), (rail, 566), colour="#b03a2e", width=2.6)]
    parts += [box(rail - 120, 566, 190, 50, fill="#fdf1e7")]
    parts += [text(rail - 25, 587, "12 V DC, 1 A, regulated", size=13, anchor="middle")]
    parts += [text(rail - 4, 608, "+", bold=True), text(rail - 108, 608, "−", bold=True)]
    parts += [line((rail - 120, 602), (rail - 160, 602), (rail - 160, 612)), ground(rail - 160, 612)]
    parts.append(text(20, 592, "All ground symbols are one net: the board's GND,", size=13))
    parts.append(text(20, 610, "the four sources and the supply's minus.", size=13))
    return page(1000, 640, "Wiring: computer, board, gate resistors, transistors, LEDs, supply", parts)


def arrow(x1: float, y1: float, x2: float, y2: float) -> str:
    """Draw a dimension line with an arrow head at each end."""
    return line((x1, y1), (x2, y2), width=1.2, extra=' marker-start="url(#a)" marker-end="url(#a)"')


def side_view() -> str:
    """Make the side view: gel, lights and camera in a section through the middle of the pad, to scale."""
    sensor, leds = sts.Sensor(), sts.tactile.Leds()
    width, thick = 1e3 * float(sensor.gel.size[0]), 1e3 * float(sensor.gel.thickness)
    distance, fov = 1e3 * float(sensor.camera.distance), float(sensor.camera.fov)
    beside, below = 1e3 * float(leds.positions[1, 0]), -1e3 * float(leds.positions[1, 2])
    cx, face = 430.0, 150.0
    half, floor = MM * width / 2, face + MM * distance
    parts = [
        '<defs><marker id="a" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" '
        'orient="auto-start-reverse"><path d="M0,1 L10,5 L0,9 z" fill="#222"/></marker></defs>'
    ]
    parts.append(text(20, 34, "Side view, to scale", size=18, bold=True))
    reach = MM * distance * math.tan(fov / 2)
    cone = f"{cx},{floor} {cx - reach:g},{face} {cx + reach:g},{face}"
    parts.append(f'<polygon points="{cone}" fill="#e9eef8" stroke="#2e5cb8" stroke-dasharray="5 4"/>')
    for sign in (-1, 1):  # half of 160 degrees across the image's diagonal
        angle = sign * math.radians(80)
        end = (cx + 230 * math.sin(angle), floor - 230 * math.cos(angle))
        parts.append(line((cx, floor), end, colour="#888", width=1.1, extra=' stroke-dasharray="3 4"'))
    parts.append(text(cx + 236, floor - 44, "lens: 160° across the diagonal", size=13))
    parts.append(
        text(cx, floor - 118, f"rows of the rectified view: {math.degrees(fov):.1f}°", size=13, anchor="middle")
    )
    parts.append(box(cx - half, face, 2 * half, MM * thick, fill="#cfe3ef"))
    parts.append(line((cx - half, face), (cx + half, face), colour="#6c3483", width=4))
    plate = face + MM * thick
    parts.append(
        f'<rect x="{cx - half:g}" y="{plate:g}" width="{2 * half:g}" height="14" fill="#f6f6f6" stroke="#888" '
        'stroke-dasharray="4 3"/>'
    )
    parts.append(text(cx - half + 8, plate + 32, "clear stiff plate (not described in the paper)", size=13))
    parts.append(text(cx - half + 8, face - 10, "semi-transparent reflective paint", size=13))
    object_box = (
        f"{cx + 60:g},{face - 4:g} {cx + 150:g},{face - 30:g} {cx + 166:g},{face - 78:g} {cx + 76:g},{face - 52:g}"
    )
    parts.append(f'<polygon points="{object_box}" fill="#ddd" stroke="#555"/>')
    parts.append(text(cx + 176, face - 56, "object", size=13))
    for sign in (-1, 1):
        x, y = cx + sign * MM * beside, face + MM * below
        parts.append(f'<circle cx="{x:g}" cy="{y:g}" r="8" fill="#f4c542" stroke="#8a6d00"/>')
    parts.append(text(cx - MM * beside, face - 8, "LEDs", size=13, anchor="middle"))
    parts.append(text(cx + MM * beside, face - 8, "LEDs", size=13, anchor="middle"))
    parts += [box(cx - 28, floor, 56, 34, fill="#444"), text(cx + 36, floor + 24, "camera", size=14)]
    top = 64.0
    parts.append(arrow(cx - half, top, cx + half, top))
    parts.append(text(cx, top - 7, f"pad {width:.0f} mm x {width:.0f} mm", anchor="middle"))
    left = cx - MM * beside - 30
    parts += [line((left - 6, face), (cx - half - 70, face), colour="#999", width=0.8)]
    parts += [line((left - 6, floor), (cx - 30, floor), colour="#999", width=0.8), arrow(left, face, left, floor)]
    parts.append(text(left + 10, (face + floor) / 2, f"{distance:.0f} mm"))
    y = face + 56
    parts += [line((cx + half, face + 18), (cx + half, y + 8), colour="#999", width=0.8)]
    parts += [line((cx + MM * beside, face + 22), (cx + MM * beside, y + 8), colour="#999", width=0.8)]
    parts += [arrow(cx + half, y, cx + MM * beside, y)]
    parts.append(text(cx + half + 48, y + 22, f"{beside - width / 2:.0f} mm", anchor="middle"))
    parts.append(text(cx + half + 6, y + 48, f"LEDs {below:.0f} mm under the face,", size=13))
    parts.append(text(cx + half + 6, y + 65, "at the height of the gel's edge", size=13))
    parts.append(text(cx + half + 6, y + 88, f"gel: {thick:.0f} mm thick", size=13))
    return page(880, floor + 60, "Side view of pad, LEDs and camera", parts)


def main() -> None:
    """Write both drawings."""
    for name, content in (("wiring.svg", wiring()), ("side.svg", side_view())):
        (FOLDER / name).write_text(content, encoding="utf-8")


if __name__ == "__main__":
    main()
