"""A second client of the digital twin, which imports nothing of sts_jax: pyserial, OpenCV and the standard library.

    python tests/twin_client.py --port PORT --camera URL --log LOG --record RECORD [--switches 12]

It switches the lights by hand-written lines of the LED protocol and reads the camera through OpenCV. Each frame that it
received is found in the twin's recording by its pixels, and the light during its exposure is read in the twin's log.
Prints a summary as JSON and exits with 1 if a check fails.
"""

import argparse
import json
import sys
import time
import zlib

import cv2
import serial

ON, OFF = (255, 255, 255, 255), (0, 0, 0, 0)
FRAMES = 6  # frames that are read after each switch
RISE_S = 0.005  # s, after which the light of the twin has reached its level


def crc16(text):
    """CRC-16/CCITT-FALSE, bit by bit."""
    value = 0xFFFF
    for byte in text:
        value ^= byte << 8
        for _ in range(8):
            value = ((value << 1) ^ 0x1021 if value & 0x8000 else value << 1) & 0xFFFF
    return value


class Leds:
    """The host's side of the LED protocol."""

    def __init__(self, port):
        self._serial = serial.Serial(port, 115200, timeout=10)
        self._serial.reset_input_buffer()
        self._sequence = 0

    def request(self, text):
        """Send a request. Returns the words of its answer, the time before the sending and after the answer (s)."""
        self._sequence += 1
        body = f"{self._sequence} {text}".encode()
        sent = time.monotonic()
        self._serial.write(b"%s*%04X\n" % (body, crc16(body)))
        while True:
            line = self._serial.readline()
            text, _, digits = line.rstrip(b"\n").partition(b"*")
            check(line.endswith(b"\n") and int(digits, 16) == crc16(text), f"damaged or missing answer {line!r}")
            words = text.decode().split(" ")
            if words[0] == str(self._sequence):
                return words[1:], sent, time.monotonic()

    def set(self, levels):
        words, sent, acknowledged = self.request("SET {} {} {} {}".format(*levels))
        check(words[:6] == ["OK", "SET", *map(str, levels)], f"unexpected answer {words}")
        return sent, acknowledged


def check(holds, message):
    if not holds:
        sys.exit(f"twin_client: {message}")


def look(leds, camera, switches):
    """Switch the light and read frames. Returns the frames and the changes of the light.

    A frame is (checksum of its pixels, mean blue, mean green, mean red, time of arrival). A change is (levels, time
    before the request, time after its answer).
    """
    capture = cv2.VideoCapture(camera, cv2.CAP_FFMPEG)
    check(capture.isOpened(), f"OpenCV cannot open {camera}")
    frames, changes = [], []
    for number in range(switches):
        levels = (ON, OFF)[number % 2]
        changes.append((levels, *leds.set(levels)))
        for _ in range(FRAMES):
            good, image = capture.read()
            check(good, "the camera's stream has ended")
            frames.append((zlib.crc32(image), *cv2.mean(image)[:3], time.monotonic()))
    capture.release()
    return frames, changes


def recorded(path):
    """The number of each frame in the recording, by the checksum of its pixels."""
    capture, numbers = cv2.VideoCapture(path, cv2.CAP_FFMPEG), {}
    while True:
        good, image = capture.read()
        if not good:
            return numbers
        numbers[zlib.crc32(image)] = len(numbers)


def commanded(changes, start, end):
    """The level that the host may assume for an interval, or None if the light may have changed in it."""
    for i, (levels, _, acknowledged) in enumerate(changes):
        until = changes[i + 1][1] if i + 1 < len(changes) else float("inf")
        if acknowledged + RISE_S <= start and end <= until:
            return levels
    return None


def judge(frames, changes, log, numbers):
    """Compare the frames with the twin's log. Returns the counts."""
    check(all(frame[0] in numbers for frame in frames), "a frame is not in the recording")
    rows = [log[numbers[frame[0]]] for frame in frames]
    order = [row["index"] for row in rows]
    check(order == sorted(set(order)), f"frames are repeated or out of order: {order}")
    kinds = [
        "mixed" if row["highest"] - row["lowest"] > 1e-3 else "on" if row["light"] > 0.5 else "off" for row in rows
    ]
    counts = {"frames": len(frames)} | {kind: kinds.count(kind) for kind in ("on", "off", "mixed")}
    check(counts["on"] and counts["off"], "no frames with the light on, or none with the light off")
    bright, dark = (
        [sum(f[i] for f, k in zip(frames, kinds, strict=True) if k == kind) / counts[kind] for i in (1, 2, 3)]
        for kind in ("on", "off")
    )
    for frame, row, kind in zip(frames, rows, kinds, strict=True):
        check(frame[4] >= row["due_s"], f"frame {row['index']} arrived before its time")
        levels = commanded(changes, row["start_s"], row["end_s"])
        if levels is not None:
            check(abs(row["light"] - levels[0] / 255) < 1e-3, f"frame {row['index']}: {levels} against {row}")
        for mean, ends in zip(frame[1:4], zip(dark, bright, strict=True), strict=True):
            check(min(ends) - 1 <= mean <= max(ends) + 1, f"frame {row['index']} is {mean}, beyond {ends}")
            if kind != "mixed":
                check(abs(mean - ends[kind == "on"]) < 1, f"frame {row['index']} is {mean} instead of {ends}")
            elif 0.1 < row["light"] < 0.9 and abs(ends[0] - ends[1]) > 20:
                check(abs(mean - ends[0]) > 1 < abs(mean - ends[1]), f"frame {row['index']} is not mixed: {mean}")
    return counts | {"bright_bgr": bright, "dark_bgr": dark}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("--port", "--camera", "--log", "--record"):
        parser.add_argument(name, required=True)
    parser.add_argument("--switches", type=int, default=12)
    options = parser.parse_args()
    leds = Leds(options.port)
    words, _, _ = leds.request("HELLO 1")
    check(words[:3] == ["OK", "HELLO", "1"], f"unexpected answer {words}")
    check(leds.request("WATCH 10000")[0] == ["OK", "WATCH", "10000"], "the watchdog's period was not set")
    frames, changes = look(leds, options.camera, options.switches)
    leds.set(OFF)
    with open(options.log) as file:
        log = [json.loads(line) for line in file]
    print(json.dumps(judge(frames, changes, log, recorded(options.record))))


if __name__ == "__main__":
    main()
