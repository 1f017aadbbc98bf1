"""`Leds`: control of the sensor's lights through its LED controller. `Lit.unchanged_since` proves constant light."""

import contextlib
import dataclasses
import errno
import functools
import logging
import os
import random
import threading
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

import serial
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from sts_jax.hardware import protocol
from sts_jax.storage import Finite

READ_S = 0.02  # longest wait of one read (s)
WRITE_S = 0.2  # longest wait of one write (s)
REPEAT_S = 0.1  # wait for an answer before the request is repeated (s). A controller answers within 15 ms
_FIRST_WAIT_S = 0.1  # between the first two attempts of `reconnect`. It doubles after each attempt
_LONGEST_WAIT_S = 5.0

_log = logging.getLogger(__name__)

Answer = TypeVar("Answer", protocol.Controller, protocol.State, protocol.Watch)


class LedError(OSError):
    """The LED controller or its port failed. The message states the cause and the remedy."""


class LedTimeoutError(LedError):
    """The controller gave no valid answer in time, or accepted no bytes."""


class DisconnectedError(LedError):
    """The port has vanished or is closed. `Leds.reconnect` searches for the controller again."""


def find_controllers() -> list[ListPortInfo]:
    """List the serial ports, those of USB devices first. None is opened, because this restarts most boards."""
    return sorted(list_ports.comports(), key=lambda port: (port.vid is None, port.device))


@dataclasses.dataclass(frozen=True)
class Lit:
    """The controller's answer: the levels of the lights at some time between two times on `time.monotonic`."""

    levels: protocol.Levels  # duty cycles of the four light channels, 0 to 255
    counter: int  # number of changes of the levels since the controller booted
    boot: int  # number of the controller's boot, 0 to 65535. The controller counts its boots
    sent_s: Finite  # time just before the request was first sent (s)
    acknowledged_s: Finite  # time at which the answer had arrived (s)

    def unchanged_since(self, earlier: "Lit") -> bool:
        """Return True if the levels of the lights did not change between an earlier answer and this one."""
        return (self.boot, self.counter, self.levels) == (earlier.boot, earlier.counter, earlier.levels)


class Leds(contextlib.AbstractContextManager["Leds"]):
    """An open connection to the LED controller.

    ```python
    with Leds.connect("/dev/ttyACM0") as leds:
        before = leds.set((255, 255, 255, 255))
        ...  # take a picture
        assert leds.ping().unchanged_since(before)
    ```

    Several threads may use one `Leds`. The controller's watchdog turns the lights off after `watchdog_ms` without a
    request, so they go off if this process ends or hangs. A thread sends a request after each third of this time.
    """

    def __init__(self, connection: "Connection", answer_s: float = 1.0, watchdog_ms: int = protocol.DEFAULT_WATCH_MS):
        """Use `Leds.connect`."""
        self._answer_s, self._watchdog_ms = answer_s, watchdog_ms
        self._start(connection)

    @classmethod
    def connect(
        cls, port: str, *, timeout_s: float = 5.0, answer_s: float = 1.0, watchdog_ms: int = protocol.DEFAULT_WATCH_MS
    ) -> "Leds":
        """Connect to the controller on a port and turn its lights off. This restarts most boards, for up to 2 s.

        Args:
            port: Name of the device, such as `/dev/ttyACM0`, or a URL of pyserial.
            timeout_s: Longest wait for the controller's first answer (s).
            answer_s: Longest time of each later request, with all its repetitions (s). The first request after a
                restart of the controller takes at most twice as long.
            watchdog_ms: Time without requests after which the controller turns its lights off, 100 to 10000 (ms).
        """
        return cls(Connection(port, timeout_s), answer_s, watchdog_ms)

    @classmethod
    def find(cls, serial_number: str) -> "Leds":
        """Open the USB ports one after the other until the controller with a serial number answers."""
        return cls(_search(_usb_ports(serial_number), serial_number, timeout_s=5.0))

    def set(self, levels: Sequence[int]) -> Lit:
        """Set the duty cycles of the four channels, 0 (off) to 255, and wait until the controller has applied them.

        After a `LedTimeoutError`, it is unknown whether the lights changed.
        """
        checked = checked_levels(levels)
        lit = self._state(functools.partial(protocol.Set, levels=checked))
        if lit.levels != checked:
            raise LedError(f"the LED controller on {self.port} applied {lit.levels} instead of {checked}. {_FLASH}")
        return lit

    def ping(self) -> Lit:
        """Ask the controller for the present levels."""
        return self._state(protocol.Ping)

    def close(self) -> None:
        """Turn the lights off and close the port. Without an answer, the controller's watchdog turns them off."""
        if self._connection.stopped.is_set():
            return
        try:
            self.set(protocol.DARK)
        except LedError as error:
            _log.warning("the lights on %s were not turned off, so the watchdog does it: %s", self.port, error)
        self._stop()

    def reconnect(self, *, limit_s: float = 30.0) -> None:
        """Search for the controller after its port has vanished, connect to it again, and turn its lights off.

        It is recognised by its serial number, on the previous port or on another one with the same USB vendor and
        product ID. No attempt begins after `limit_s` (s). Requests of other threads raise a `DisconnectedError`.
        """
        self._stop()
        deadline, wait = time.monotonic() + limit_s, _FIRST_WAIT_S
        last = self._connection
        while True:
            try:
                ports = [last.name, *(_usb_ports(last.usb.serial_number, last.usb) if last.usb else [])]
                connection = _search(list(dict.fromkeys(ports)), self.serial_number, last.timeout_s)
                connection.usb = connection.usb or last.usb
                self._start(connection)
                return
            except LedError as error:
                if time.monotonic() + wait > deadline:
                    raise DisconnectedError(f"{error} The search took {limit_s:g} s.") from error
            time.sleep(wait)
            wait = min(2 * wait, _LONGEST_WAIT_S)

    def __exit__(self, *error: object) -> None:
        self.close()

    def _start(self, connection: "Connection") -> None:
        """Turn the lights off, and start the background thread of requests."""
        self._connection = connection
        self.port = connection.name  # name of the serial port
        self.controller = connection.controller  # firmware, board and serial number of the controller
        self.serial_number = self.controller.serial_number
        self._boot: int | None = None
        self._thread = threading.Thread(target=self._keep_alive, name=f"keep-alive of {self.port}", daemon=True)
        try:
            self.set(protocol.DARK)
        except BaseException:
            connection.close()
            raise
        self._thread.start()

    def _stop(self) -> None:
        self._connection.close()
        if self._thread.ident is not None:  # it was started
            self._thread.join()

    def _state(self, request: Callable[[int], protocol.Request]) -> Lit:
        """Send a request whose reply is a `State`. If the controller has rebooted, set the watchdog's period again."""
        connection = self._connection
        reply, sent_s, acknowledged_s = connection.exchange(request, protocol.State, timeout_s=self._answer_s)
        if reply.boot != self._boot:
            period = functools.partial(protocol.Watch, period_ms=self._watchdog_ms)
            connection.exchange(period, protocol.Watch, timeout_s=self._answer_s)
            self._boot = reply.boot
        return Lit(reply.levels, reply.counter, reply.boot, sent_s, acknowledged_s)

    def _keep_alive(self) -> None:
        """Send a request whenever a third of the watchdog's period has passed without one."""
        connection = self._connection
        wait = period_s = self._watchdog_ms / 3000
        while not connection.stopped.wait(wait):
            try:
                if time.monotonic() - connection.answered_s >= period_s:
                    self.ping()
                wait = period_s - (time.monotonic() - connection.answered_s)
            except LedError as error:
                _log.warning("%s", error)
                if isinstance(error, DisconnectedError):
                    return
                wait = 0.0


def _usb_ports(serial_number: str | None, like: ListPortInfo | None = None) -> list[str]:
    """USB ports, only those with the IDs of another port if it is given. Some boards show their serial number here."""
    ports = [port for port in find_controllers() if port.vid is not None]
    alike = [port for port in ports if like is None or (port.vid, port.pid) == (like.vid, like.pid)]
    return [port.device for port in sorted(alike, key=lambda port: port.serial_number != serial_number)]


def _search(ports: Sequence[str], serial_number: str, timeout_s: float) -> "Connection":
    """Connect to the first port whose controller has a serial number."""
    tried = []
    for port in ports:
        try:
            connection = Connection(port, timeout_s)
        except LedError as error:
            tried.append(f"{port} ({error})")
            continue
        if connection.controller.serial_number == serial_number:
            return connection
        connection.close()
        tried.append(f"{port} (controller {connection.controller.serial_number})")
    raise LedError(
        f"LED controller {serial_number} was not found: check its cable, or name a port that is not a USB port (the "
        f"argument `leds` of `STS.from_file`). Ports tried: {', '.join(tried) or 'none'}."
    )


class Connection:
    """An open serial port to the LED controller. Several threads may use one connection."""

    def __init__(self, name: str, timeout_s: float):
        """Open the port, and wait for at most `timeout_s` (s) for the description of the controller."""
        self.name, self.timeout_s = name, timeout_s
        self.usb = _usb_port(name)
        self.answered_s = time.monotonic()  # time of the last valid answer (s)
        self.stopped = threading.Event()  # set by `close`
        self._serial = _open_port(name)
        self._lock = threading.Lock()
        # Random, so that late answers to an earlier process have other sequence numbers.
        self._sequence = random.randrange(protocol.LAST_SEQUENCE)
        self._buffer = b""  # received bytes that are not processed yet
        self._heard = b""  # the last invalid line that arrived during the current exchange
        try:
            self.controller, _, _ = self.exchange(protocol.Hello, protocol.Controller, timeout_s=timeout_s)
            if self.controller.version != protocol.VERSION:
                raise LedError(
                    f"the LED controller on {name} uses version {self.controller.version} of the protocol instead of "
                    f"{protocol.VERSION}. {_FLASH}"
                )
        except BaseException:
            self.close()
            raise

    def exchange(
        self, request: Callable[[int], protocol.Request], answer: type[Answer], *, timeout_s: float
    ) -> tuple[Answer, float, float]:
        """Send a request, and repeat it with the same sequence number every 0.1 s until its answer arrives.

        The controller executes it only once. Damaged lines and answers to other requests are ignored. Returns the
        answer, the time before the request was first sent, and the time of the answer (`time.monotonic`, s).
        """
        with self._lock:
            self._sequence = self._sequence % protocol.LAST_SEQUENCE + 1
            line = protocol.encode_request(request(self._sequence))
            self._heard = b""
            sent_s = time.monotonic()
            deadline = sent_s + timeout_s
            while (now := time.monotonic()) < deadline:
                self._write(line)
                until = min(deadline, now + REPEAT_S)
                while (reply := self._next_reply(until)) is not None:
                    if isinstance(reply, protocol.Refused) and reply.sequence == 0:
                        break  # the request was damaged on its way, so it is sent again
                    if reply.sequence != self._sequence:
                        continue
                    if isinstance(reply, protocol.Refused):
                        raise LedError(f"the LED controller on {self.name} refused {line!r}: {reply.text}. {_FLASH}")
                    if isinstance(reply, answer):
                        self.answered_s = time.monotonic()
                        return reply, sent_s, self.answered_s
            hint = "Nothing was received: check the cable and the name of the port, and flash the firmware."
            if heard := self._heard or self._buffer:
                hint = f"Received {heard[:80]!r}: another device may be on this port."
            raise LedTimeoutError(f"no valid answer to {line!r} from {self.name} within {timeout_s:g} s. {hint}")

    def close(self) -> None:
        """Close the port. No more requests arrive, so the controller's watchdog turns the lights off."""
        self.stopped.set()
        with self._lock, contextlib.suppress(OSError):
            self._serial.close()

    def _next_reply(self, until: float) -> protocol.Reply | None:
        """The next valid reply, or None if none arrives until a time. Skips invalid lines and the watchdog's lines."""
        while (line := self._next_line(until)) is not None:
            if time.monotonic() >= until + REPEAT_S:  # the device sends without end
                return None
            try:
                reply = protocol.decode_reply(line)
            except protocol.ProtocolError:
                self._heard = line
                continue
            if not isinstance(reply, protocol.TurnedOff):
                return reply
            _log.warning("the watchdog of the LED controller on %s turned the lights off", self.name)
        return None

    def _next_line(self, until: float) -> bytes | None:
        """The next line that is not empty, or more bytes than a line may have, or None if none arrives until a time."""
        while True:
            expired = time.monotonic() >= until  # read once more, in case this process was suspended meanwhile
            try:
                self._buffer += self._serial.read_until(b"\n", protocol.LONGEST_LINE + 1)
            except (OSError, TypeError) as error:  # TypeError: pyserial reads from a port that was closed meanwhile
                raise self._vanished(error) from error
            if self._buffer.endswith(b"\n") or len(self._buffer) > protocol.LONGEST_LINE:
                line, self._buffer = self._buffer, b""
                if line != b"\n":
                    return line
            if expired:
                return None

    def _write(self, line: bytes) -> None:
        # pyserial also reports a timeout for a line that it has sent, if the operating system suspended the process in
        # between. This happens on a busy computer. A line that was not sent gets no answer.
        try:
            with contextlib.suppress(serial.SerialTimeoutException):
                self._serial.write(line)
        except (OSError, TypeError) as error:
            raise self._vanished(error) from error

    def _vanished(self, error: Exception) -> DisconnectedError:
        return DisconnectedError(f"the port {self.name} is gone or closed ({error}): check the cable, and reconnect().")


_FLASH = (
    "Flash the firmware of this version of sts_jax with `make flash PORT=...` (and its SERIAL=..., if it had one) in "
    "sts_jax/hardware/firmware."
)
_CAUSES = {
    errno.EACCES: "no permission: add your user to the port's group, usually with `sudo usermod -aG dialout $USER`",
    errno.EAGAIN: "it is in use: close the other program (`fuser` names it), or choose another port",
}
_CAUSES |= {errno.EPERM: _CAUSES[errno.EACCES], errno.EBUSY: _CAUSES[errno.EAGAIN]}


def _open_port(name: str) -> serial.Serial:
    """Open a port, and lock it against other programs that use pyserial's exclusive mode."""
    try:
        return serial.serial_for_url(
            name, baudrate=protocol.BAUD, timeout=READ_S, write_timeout=WRITE_S, exclusive=True
        )
    except (OSError, ValueError) as error:
        cause = _CAUSES.get(getattr(error, "errno", None) or 0, str(error))
        ports = ", ".join(f"{port.device} ({port.description})" for port in find_controllers()) or "none"
        raise LedError(f"cannot open {name}: {cause}. Ports found: {ports}.") from error


def _usb_port(name: str) -> ListPortInfo | None:
    """The USB port that a device name refers to, or None if it is not a USB port."""
    target = os.path.realpath(name)
    ports = (port for port in find_controllers() if port.vid is not None)
    return next((port for port in ports if os.path.realpath(port.device) == target), None)


def checked_levels(levels: Sequence[int]) -> protocol.Levels:
    """Return levels as a tuple of four integers from 0 to 255."""
    if len(levels) != protocol.CHANNELS or not all(level in range(256) for level in levels):
        raise ValueError(f"levels must be {protocol.CHANNELS} integers in 0..255, got {levels!r}")
    first, second, third, fourth = map(int, levels)
    return first, second, third, fourth
