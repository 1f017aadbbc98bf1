"""An emulated LED controller on a pseudo-terminal, which can produce faults, such as lost answers."""

import contextlib
import os
import select
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path

from sts_jax.hardware import protocol
from sts_jax.hardware.emulation import EmulatedController

TICK_S = 0.01  # longest wait between two checks of the watchdog


class Peer:
    """An emulated LED controller. Its port is `path`, a symbolic link to a pseudo-terminal.

    The list `faults` has one word for each of the next requests. Further requests are answered without a fault. The
    words are:

    - `none`: answer as usual.
    - `deaf`: ignore the request.
    - `damaged`: damage the request before it is read.
    - `lost`: execute the request, but send no answer.
    - `late`: send the answer together with the answer to the next request.
    - `doubled`: send the answer twice.
    - `garbled`: flip a bit of the answer.
    - `cut`: send only the first half of the answer.
    - `joined`: send the answer twice, the first time without the end of its line.
    - `noise`: send a line of meaningless bytes before the answer.
    - `watchdog`: send the message that the watchdog has turned the lights off, and then the answer.
    - `stale`: send an answer to a different request, and then the correct answer.
    - `vanish`: unplug the controller.

    By default, the controller's clock runs at a hundredth of the true speed, so that its watchdog does not interfere.
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
        """Make the port and begin to answer requests.

        Args:
            path: Path at which a symbolic link to the port is created or replaced.
            serial_number: Serial number of the controller.
            talk: Bytes that are sent repeatedly, with or without a request, as if the port belonged to another device.
                None: the controller answers requests.
            clock: The controller's clock, a function that returns seconds.
            make: Function that makes the emulated controller at each boot.
        """
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
        match fault:
            case "lost":
                return held
            case "late":
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
                self._master = self._slave = -1  # the system may give the old numbers to other files
                return b""
        return held + reply
