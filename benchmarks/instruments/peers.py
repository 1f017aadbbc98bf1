"""An emulated sensor: an LED controller on a pseudo-terminal, and a motion JPEG camera that sees its lights.

The grey value of a frame increases linearly with the mean light during its exposure. A corner shows the frame's number
as dark and light blocks, which remain readable after the JPEG compression. The camera logs the light by frame number,
so a benchmark can check the light of an image independently of `hardware.STS`.
"""

import contextlib
import dataclasses
import functools
import os
import select
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from sts_jax.hardware import protocol, web
from sts_jax.hardware.protocol import EmulatedController

SIZE = (160, 120)  # pixels, width and height
_BITS, _COLUMNS = 16, 4

Image = UInt8[np.ndarray, "height width 3"]
TICK_S = 0.01  # longest wait between two checks of the watchdog
DARK, LIT = 70, 210  # grey values of a frame with the lights off and fully on
CORNER = 32  # pixels, side of the corner that shows the number
# Share of the lights' full power. The twin's LEDs approach a new level exponentially, so a tolerance is needed. It is
# below the twin's read noise of 1.5e-3.
_TOLERANCE = 1e-3


class Shown(NamedTuple):
    """The number of a frame, and the mean light during its exposure."""

    number: int  # number of the frame
    light: float  # mean light during the exposure, as a share of the full power

    def is_of(self, share: float) -> bool:
        """Return True if the mean light during the exposure differs from `share` by at most 0.001 of the full power."""
        return abs(self.light - share) <= _TOLERANCE


def draw(number: int, size: tuple[int, int] = SIZE) -> Image:
    """Draw a number as 4 x 4 blocks, one for each bit, dark for 0 and light for 1."""
    bits = np.array([255 if number >> bit & 1 else 60 for bit in range(_BITS)], np.uint8).reshape(-1, _COLUMNS)
    return np.asarray(cv2.resize(np.repeat(bits[..., None], 3, 2), size, interpolation=cv2.INTER_NEAREST))


def number_of(image: Image) -> int:
    """Read the number that an image from `draw` shows as dark and light blocks."""
    height, width = image.shape[0] // 4, image.shape[1] // 4
    centres = image[height // 2 :: height, width // 2 :: width].mean(-1)[:4, :4].ravel()
    return sum(1 << bit for bit, value in enumerate(centres) if value > 157)


def jpeg(image: Image) -> bytes:
    """Encode a BGR image as a JPEG file."""
    return cv2.imencode(".jpg", image)[1].tobytes()


class MotionJpeg:
    """A server of a motion JPEG stream. Its attribute `mode` selects a fault, and may change at any time.

    `live`: numbered frames. `skip`: without the frames in `skipped`. `repeat`: the last frame again. `black`, `white`,
    `small` (half the size), `damaged` (incomplete): such frames. `stall`: nothing. `held`: frames are kept and sent
    together later. `close`: the stream ends. For new requests: `hang` (no answer), `missing` (404), `text` (no video).
    """

    def __init__(self, fps: float = 50, colour: tuple[int, int, int] | None = None, size: tuple[int, int] = SIZE):
        self.fps, self.colour, self.size = fps, colour, size
        self.mode = "live"
        self.skipped: set[int] = set()
        self.served: dict[int, float] = {}
        self.number = 0
        self.port = 0
        self._last = b""
        self.start()

    @property
    def url(self) -> str:
        """The address of the stream."""
        return f"http://127.0.0.1:{self.port}/video"

    def start(self) -> None:
        """Listen for requests. If the server was stopped before, it listens at its previous port again."""
        server = self

        class Handler(web.Handler):
            def do_GET(self) -> None:
                server.answer(self)

        self.running = True
        self.http = web.Server("127.0.0.1", self.port, Handler)
        self.port = self.http.server_port
        self.thread = threading.Thread(target=self.http.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        self.thread.start()

    def stop(self) -> None:
        """Close all connections and refuse new ones."""
        self.running = False
        self.http.shutdown()
        self.http.server_close()
        self.thread.join()

    def answer(self, request: web.Handler) -> None:
        """Answer a request for the stream in the way that the attribute `mode` selects."""
        if self.mode == "hang":
            self._pause("hang")
            return
        if self.mode == "missing":
            request.send_error(404)
            return
        if self.mode == "text":
            request.send("text/html", b"<html>no video</html>")
            return
        request.begin_stream()
        due = time.monotonic()
        held: list[bytes] = []
        while self.running and self.mode != "close":
            if self.mode == "stall":
                self._pause("stall")
                due = time.monotonic()
            due += 1 / self.fps
            time.sleep(max(due - time.monotonic(), 0))
            mode = self.mode  # read once for each frame, because another thread may change it
            if mode != "repeat":
                self.number += 1
            if mode == "skip" and self.number in self.skipped:
                continue
            if mode != "repeat" or not self._last:
                self._last = self._frame(mode)
            self.served.setdefault(self.number, time.monotonic())
            held.append(self._last)
            if mode != "held":
                for frame in held:
                    request.send_frame(frame)
                held = []

    def _pause(self, mode: str) -> None:
        while self.running and self.mode == mode:
            time.sleep(0.01)

    def _frame(self, mode: str) -> bytes:
        width, height = self.size
        if self.colour is not None:  # the corner alternates, because identical frames would count as frozen
            image = np.full((height, width, 3), self.colour, np.uint8)
            image[:16, :16] = 60 + self.number % 2 * 100
            return jpeg(image)
        if mode in ("black", "white"):
            return jpeg(np.full((height, width, 3), 255 * (mode == "white"), np.uint8))
        data = jpeg(draw(self.number, (width // 2, height // 2) if mode == "small" else self.size))
        return data[: len(data) // 2] if mode == "damaged" else data


class Peer:
    """An emulated LED controller. Its port is `path`, a symbolic link to a pseudo-terminal.

    `faults` has one word for each of the next requests, see `_answer`. By default, the controller's clock runs at a
    hundredth of the true speed, so that its watchdog does not interfere.
    """

    def __init__(
        self,
        path: Path,
        *,
        serial_number: str = "EMULATED",
        talk: bytes | None = None,
        clock: Callable[[], float] = lambda: time.monotonic() / 100,
        make: Callable[..., EmulatedController] = EmulatedController,
    ):
        """Make the port and begin to answer requests."""
        self.path = path
        self.clock = clock
        self._make = make
        self._serial_number = serial_number
        self.controller = make(serial_number=serial_number, now_s=clock())
        self.faults: list[str] = []
        self.requests: list[bytes] = []
        self.talk = talk
        self._held = b""
        self._pending = b""
        self._deaf_until_s = 0.0  # end of the boot on `time.monotonic`, before which requests are ignored
        self._lock = threading.Lock()  # other threads restart the controller or fire its watchdog
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        path.unlink(missing_ok=True)
        path.symlink_to(os.ttyname(self._slave))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def vanish(self) -> None:
        """Unplug the emulated controller, so that its port no longer exists."""
        self._stop.set()
        self._thread.join()
        for descriptor in (self._master, self._slave):
            with contextlib.suppress(OSError):
                os.close(descriptor)
        self._master = self._slave = -1  # the system may give the old numbers to other files
        self.path.unlink(missing_ok=True)

    def send(self, data: bytes) -> None:
        """Send bytes to the host. The bytes are lost if the port's buffer is full or the controller is unplugged."""
        with contextlib.suppress(OSError):
            os.write(self._master, data)

    def restart(self, boot_s: float = 0.0) -> None:
        """Restart the controller. The lights go off, and requests are ignored for `boot_s` seconds."""
        with self._lock:
            boot = self.controller.boot + 1
            self.controller = self._make(serial_number=self._serial_number, now_s=self.clock(), boot=boot)
            self._pending = self._held = b""
            self._deaf_until_s = time.monotonic() + boot_s

    def fire_watchdog(self) -> None:
        """Turn the lights off and send the watchdog's message, as if no request had arrived for too long."""
        with self._lock:
            self.controller._valid_s = -float("inf")
            sent = self.controller.tick(self.clock())
            self.controller._valid_s = self.clock()
        self.send(sent)

    def _serve(self) -> None:
        while not self._stop.is_set():
            if not select.select([self._master], [], [], TICK_S)[0]:
                with self._lock:
                    sent = self.controller.tick(self.clock())
                self.send(self.talk or sent)
                continue
            *lines, self._pending = (self._pending + os.read(self._master, 4096)).split(b"\n")
            for line in lines:
                self.requests.append(line + b"\n")
                self.send(self._answer(line + b"\n") if self.talk is None else self.talk)

    def _answer(self, line: bytes) -> bytes:
        if time.monotonic() < self._deaf_until_s:
            return b""
        fault = self.faults.pop(0) if self.faults else "none"
        if fault == "deaf":
            return b""
        if fault == "damaged":
            line = line.replace(b" ", b"!", 1)
        with self._lock:
            reply = self.controller.receive(line, self.clock())
        held, self._held = self._held, b""
        if fault == "late":
            self._held = reply
        if fault == "vanish":
            self._stop.set()
            os.close(self._slave)
            os.close(self._master)
            self._master = self._slave = -1  # the system may give the old numbers to other files
            return b""
        sent = {
            "lost": b"",
            "late": b"",
            "doubled": reply + reply,
            "garbled": reply[:4] + bytes([reply[4] ^ 8]) + reply[5:] if len(reply) > 4 else reply,
            "cut": reply[: len(reply) // 2],
            "joined": reply[:-1] + reply,
            "noise": b"\xff\x00\xfe\n" + reply,
            "watchdog": protocol.encode_reply(protocol.TurnedOff(0, 77)) + reply,
            "stale": protocol.encode_reply(protocol.State(65535, (9, 9, 9, 9), 9, 9)) + reply,
        }
        return held + sent.get(fault, reply)


class Lights:
    """A log of the light level of the emulated sensor over time, as a share of the full power."""

    def __init__(self) -> None:
        self._changes = [(0.0, 0.0)]  # each change: its time (s) and the share of the light from then on
        self._lock = threading.Lock()

    def changed(self, levels: protocol.Levels) -> None:
        """Log that the four channels have these levels, 0 to 255, from now on."""
        with self._lock:
            self._changes.append((time.monotonic(), sum(levels) / 1020))

    def shares(self, start_s: float, end_s: float) -> tuple[list[float], float]:
        """Return the levels of the emulated light during an interval."""
        with self._lock:
            changes = self._changes[-1000:]
        found: list[float] = []
        mean = 0.0
        for (begin_s, share), (stop_s, _) in zip(changes, [*changes[1:], (end_s + 1, 0.0)], strict=True):
            overlap_s = min(stop_s, end_s) - max(begin_s, start_s)
            if overlap_s > 0:
                if found[-1:] != [share]:
                    found.append(share)
                mean += share * overlap_s / (end_s - start_s)
        return found, mean

    def off_after(self, time_s: float) -> float | None:
        """Return the time at which the lights were last switched off, or `time_s` if `time_s` is later. Return None if
        the lights are on now. All times are in seconds on `time.monotonic`."""
        with self._lock:
            since_s, share = self._changes[-1]
        return max(since_s, time_s) if share == 0 else None


class SeenController(EmulatedController):
    """An emulated LED controller that passes the brightness of its LEDs on to the emulated camera."""

    def __init__(self, lights: Lights, **options: object):
        super().__init__(**options)  # type: ignore[arg-type]
        self._lights = lights
        lights.changed(self.levels)

    def _apply(self, levels: protocol.Levels) -> None:
        super()._apply(levels)
        self._lights.changed(levels)


@dataclasses.dataclass(frozen=True)
class Exposure:
    """The start and end of the exposure of one frame, and the light during the exposure."""

    shares: list[float]  # successive shares of the light during the exposure, only one if the light was constant
    mean: float  # mean share over the exposure
    start_s: float  # start of the exposure on `time.monotonic`
    end_s: float  # end of the exposure on `time.monotonic`


class SeenLights(MotionJpeg):
    """An emulated camera that sees `lights`."""

    def __init__(
        self, lights: Lights, *, fps: float, lag_s: float, exposure_s: float, size: tuple[int, int] = SIZE
    ) -> None:
        self.lights, self.lag_s, self.exposure_s = lights, lag_s, exposure_s
        self.log: dict[int, Exposure] = {}  # exposure of each frame, by the number of the frame
        self.blind = False  # True: frames do not show the light
        self.numbered = True  # True: frames show their number. False: pixel noise of 1 of 255 makes them different
        self.moving = False  # True: a black disc moves through the frames
        self.spot: tuple[int, int, int] | None = None  # column, row and radius of a dark object (pixels)
        super().__init__(fps=fps, size=size)

    def _frame(self, mode: str) -> bytes:
        if mode in ("black", "small", "damaged"):
            return super()._frame(mode)
        end_s = time.monotonic() - self.lag_s
        shares, mean = self.lights.shares(end_s - self.exposure_s, end_s)
        self.log[self.number] = Exposure(shares, mean, end_s - self.exposure_s, end_s)
        width, height = self.size
        image = np.full((height, width, 3), DARK if self.blind else DARK + mean * (LIT - DARK), np.uint8)
        if self.numbered:
            # The blocks are faint, because changes of strong blocks would count as motion of the scene.
            image[:CORNER, :CORNER] = 0.3 * draw(self.number, (CORNER, CORNER)) + 110
        if self.moving:
            cv2.circle(image, (20 + 7 * self.number % 100, height // 2), 16, (0, 0, 0), -1)
        if (spot := self.spot) is not None:
            cv2.circle(image, spot[:2], spot[2], (30, 30, 30), -1)
        if not self.numbered:
            noise = np.random.default_rng(self.number).normal(0, 1, image.shape)
            image = np.clip(image + noise, 0, 255).astype(np.uint8)
        return jpeg(image)

    def exposure_of(self, image: Image) -> Exposure | None:
        """Look up an image's exposure by the frame number in its corner."""
        if image.shape[1::-1] != self.size or image.max() < DARK / 2:
            return None
        return self.log.get(key(image))


class SensorPeer:
    """An emulated camera at the address `url`, and an emulated controller at the port `path`."""

    def __init__(
        self,
        path: Path,
        *,
        fps: float = 60,
        lag_s: float = 0.03,
        exposure_s: float = 0.012,
        size: tuple[int, int] = SIZE,
    ):
        self.lights = Lights()
        self._boots = 0
        self.path = str(path)
        self.plug_in(path)
        self.camera = SeenLights(self.lights, fps=fps, lag_s=lag_s, exposure_s=exposure_s, size=size)

    @property
    def url(self) -> str:
        """The address of the camera."""
        return self.camera.url

    def plug_in(self, path: Path) -> None:
        """Plug the controller in at the port `path`, so that the controller boots."""
        self._boots += 1
        self.leds = Peer(path, clock=time.monotonic, make=functools.partial(SeenController, self.lights))
        self.leds.controller.boot = self._boots

    def unplug(self) -> None:
        """Unplug the controller. Its lights go off."""
        self.leds.vanish()
        self.lights.changed(protocol.DARK)

    def judged(self, image: Image, *, lit: bool) -> bool:
        """Return whether the lights had the given state during the whole exposure of an image."""
        found = self.camera.exposure_of(image)
        return found is not None and found.shares == [1.0 if lit else 0.0]

    def stop(self) -> None:
        """Unplug the emulated camera and the emulated LED controller."""
        self.camera.stop()
        self.leds.vanish()

    def shown(self) -> dict[int, Shown]:
        """Return the mean light during the exposure of each frame that the emulated camera has logged."""
        return {number: Shown(number, exposure.mean) for number, exposure in self.camera.log.items()}


def key(image: Image) -> int:
    """Read the number of a frame from the corner of its image."""
    return number_of(image[:CORNER, :CORNER])
