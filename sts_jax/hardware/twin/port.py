"""A pseudo-terminal that acts as the serial port of the LED controller of a `Twin` (a simulated sensor)."""

import contextlib
import os
import select
import termios
import threading
import time
import tty
from pathlib import Path

from sts_jax.hardware.twin import faults
from sts_jax.hardware.twin.device import Twin

_WAIT_S = 0.003  # longest wait for bytes, after which the watchdog and late answers are checked (s)
_SPEED = termios.B115200  # baud rate of the protocol


class LedPort:
    """The serial port of the LED controller of a `Twin` (a simulated sensor).

    The port is a pseudo-terminal. A thread answers the requests of the host, which is the program that opens the port.

    The host must open the port at 115200 baud. As on a real serial line, a host at another rate receives
    unreadable bytes, and its requests are not executed.
    """

    def __init__(self, twin: Twin, link: str | os.PathLike | None = None):
        """Open the pseudo-terminal and start the thread.

        Args:
            twin: Twin that runs on the real clock.
            link: Path at which a symbolic link to the pseudo-terminal is made, so that the port has a fixed name. An
                existing symbolic link is replaced. Default: no link.

        Raises:
            FileExistsError: `link` exists and is not a symbolic link.
            OSError: The link cannot be made.
        """
        self._twin = twin
        self._link = None if link is None else Path(link)
        self._queue = faults.Queue()
        self._lock = threading.Lock()  # protects the queue and `_absent_s`
        self._absent_s: float | None = None  # time for which the port is to vanish (s), if the fault was injected
        self._late: list[tuple[float, bytes]] = []  # delayed answers, each with the time at which it is sent
        self._partial = b""  # received bytes of an incomplete line
        self._open()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="twin's LED port", daemon=True)
        self._thread.start()

    @property
    def device(self) -> str:
        """Path of the port: the symbolic link if there is one, else the pseudo-terminal."""
        return self._name if self._link is None else str(self._link)

    def inject(self, fault: faults.Fault) -> None:
        """Simulate a fault of the kind `deaf`, `lost`, `late`, `doubled`, `garbled` or `vanish` (see `Fault`)."""
        with self._lock:
            if fault.kind == "vanish":
                self._absent_s = fault.seconds
            else:
                self._queue.add(fault)

    def close(self) -> None:
        """End the thread, close the pseudo-terminal, and remove the symbolic link if there is one."""
        self._stop.set()
        self._thread.join()
        self._close()

    def _open(self) -> None:
        if self._link is not None and self._link.exists() and not self._link.is_symlink():
            raise FileExistsError(
                f"`link` is {self._link}, but this file exists and is not a symbolic link: choose another path"
            )
        # The slave stays open in this process, because reading the master fails while nobody has opened the slave.
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._name = os.ttyname(self._slave)
        if self._link is not None:
            try:
                self._link.unlink(missing_ok=True)
                self._link.symlink_to(self._name)
            except OSError:
                self._close()
                raise

    def _close(self) -> None:
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self._name:
            self._link.unlink()
        for descriptor in (self._master, self._slave):
            with contextlib.suppress(OSError):
                os.close(descriptor)

    def _serve(self) -> None:
        while not self._stop.is_set():
            with self._lock:
                absent_s, self._absent_s = self._absent_s, None
            if absent_s is not None:
                self._vanish(absent_s)
                continue
            readable = select.select([self._master], [], [], _WAIT_S)[0]
            self._send(self._twin.tick())
            now = time.monotonic()
            due, self._late = [x for x in self._late if x[0] <= now], [x for x in self._late if x[0] > now]
            for _, line in due:
                self._send(line)
            if readable:
                with contextlib.suppress(BlockingIOError):
                    self._receive(os.read(self._master, 4096))

    def _vanish(self, seconds: float) -> None:
        """Remove the port for a time. The controller and its watchdog keep running, as with their own power supply."""
        self._close()
        self._partial, self._late = b"", []
        until = time.monotonic() + seconds
        while time.monotonic() < until and not self._stop.wait(_WAIT_S):
            self._twin.tick()
        self._open()

    def _receive(self, data: bytes) -> None:
        if not self._right_speed():
            self._send(b"\xff" * len(data))
            return
        *lines, self._partial = (self._partial + data).split(b"\n")
        self._partial = self._partial[:1024]
        for line in lines:
            with self._lock:
                fault = self._queue.take()
            if fault is not None and fault.kind == "deaf":
                continue
            for answer in self._twin.receive(line + b"\n").splitlines(keepends=True):
                match fault.kind if fault is not None else None:
                    case None:
                        self._send(answer)
                    case "late":
                        self._late.append((time.monotonic() + fault.seconds if fault else 0.0, answer))
                    case "doubled":
                        self._send(answer + answer)
                    case "garbled":
                        self._send(faults.garble(answer))

    def _right_speed(self) -> bool:
        attributes = termios.tcgetattr(self._slave)
        return attributes[4] == attributes[5] == _SPEED

    def _send(self, data: bytes) -> None:
        """Send bytes to the host. If no host reads and the buffer of the line is full, they are lost."""
        if data:
            with contextlib.suppress(BlockingIOError):
                os.write(self._master, data)
