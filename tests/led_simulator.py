"""The real firmware of the LED controller in the simulator of its chip."""

import contextlib
import queue
import subprocess
import threading
import time
from pathlib import Path

from serial.tools.list_ports_common import ListPortInfo

from sts_jax.hardware import protocol

WAIT_S = 60.0  # longest wait for an event that must come


def until(condition):
    """Wait for a condition, and fail if it does not come true."""
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline, "the condition did not come true"
        time.sleep(0.005)


def usb_port(path, serial_number):
    """A listed USB port."""
    port = ListPortInfo(str(path))
    port.vid, port.pid, port.serial_number, port.description = 0x2341, 0x43, serial_number, "Arduino Uno"
    return port


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
