"""A LED controller on a pseudo-terminal that injects faults, and the real firmware in the simulator of its chip."""

import contextlib
import os
import queue
import select
import subprocess
import threading
import time
import tty
from pathlib import Path

from sts_jax.hardware import protocol
from sts_jax.hardware.emulation import EmulatedController

WAIT_S = 60.0  # longest wait for an event that must come


def until(condition):
    """Wait for a condition, and fail if it does not come true."""
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline, "the condition did not come true"
        time.sleep(0.005)


class Peer:
    """An emulated controller behind `path`, a link to a pseudo-terminal.

    `faults` has one word for each of the next requests, and requests are answered without faults after the last one.
    The emulated controller's clock runs at a hundredth of the speed, so that its watchdog does not interfere.
    """

    def __init__(self, path: Path, *, serial_number: str = "EMULATED", talk: bytes | None = None):
        self.path = path
        self.controller = EmulatedController(serial_number=serial_number, now_s=self._now_s())
        self.faults: list[str] = []
        self.requests: list[bytes] = []
        self.talk = talk  # what another device sends, asked or not, instead of any answer
        self._held = b""
        self._pending = b""
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        path.unlink(missing_ok=True)
        path.symlink_to(os.ttyname(self._slave))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def vanish(self):
        """Unplug the controller."""
        self._stop.set()
        self._thread.join()
        for descriptor in (self._master, self._slave):
            with contextlib.suppress(OSError):
                os.close(descriptor)
        self.path.unlink(missing_ok=True)

    def send(self, data: bytes):
        with contextlib.suppress(BlockingIOError):  # the host reads nothing
            os.write(self._master, data)

    def _now_s(self):
        return time.monotonic() / 100

    def _serve(self):
        while not self._stop.is_set():
            if not select.select([self._master], [], [], 0.01)[0]:
                self.send(self.talk or b"")
                continue
            *lines, self._pending = (self._pending + os.read(self._master, 4096)).split(b"\n")
            for line in lines:
                self.requests.append(line + b"\n")
                answer = self._answer(line + b"\n") if self.talk is None else self.talk
                self.send(answer)

    def _answer(self, line: bytes) -> bytes:
        fault = self.faults.pop(0) if self.faults else "none"
        if fault == "deaf":  # the request is lost
            return b""
        if fault == "damaged":  # the request is damaged
            line = line.replace(b" ", b"!", 1)
        reply = self.controller.receive(line, self._now_s())
        held, self._held = self._held, b""
        match fault:
            case "lost":
                return held
            case "late":  # it comes before the answer to the next request
                self._held = reply
                return held
            case "doubled":
                return held + reply + reply
            case "garbled":
                return held + reply[:4] + bytes([reply[4] ^ 8]) + reply[5:]
            case "cut":
                return held + reply[: len(reply) // 2]
            case "joined":
                return held + reply[:-1] + reply
            case "noise":
                return held + b"\xff\x00\xfe\n" + reply
            case "watchdog":
                return held + protocol.encode_reply(protocol.TurnedOff(77)) + reply
            case "stale":
                return held + protocol.encode_reply(protocol.State(65535, (9, 9, 9, 9), 9, 9)) + reply
            case "vanish":
                self._stop.set()
                os.close(self._slave)
                os.close(self._master)
                self.send = lambda data: None
                return b""
        return held + reply


class Simulated:
    """The firmware in the simulator. `levels` are the duty cycles that the registers of its timers give."""

    def __init__(self, program: Path, firmware: Path):
        self._process = subprocess.Popen([program, firmware], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.path = self._process.stdout.readline().strip()
        self.levels = None
        self.seen: queue.Queue = queue.Queue()
        threading.Thread(target=self._follow, daemon=True).start()

    def command(self, letter: str):
        self._process.stdin.write(letter)
        self._process.stdin.flush()

    def stop(self):
        self._process.stdin.close()
        self._process.wait(WAIT_S)
        self._process.stdout.close()

    def wait_for(self, levels: protocol.Levels):
        """Wait until the registers have these levels."""
        while self.levels != levels:
            self.levels = self.seen.get(timeout=WAIT_S)

    def _follow(self):
        with contextlib.suppress(ValueError):  # the output was closed
            for line in self._process.stdout:
                if line.startswith("levels "):
                    self.seen.put(tuple(int(word) for word in line.split()[1:]))
