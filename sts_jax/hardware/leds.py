"""Control of the sensor's lights through its LED controller.

`Lit.unchanged_since` compares two answers of the controller, and returns True if the lights did not change in between.
"""

import contextlib
import dataclasses
import errno
import functools
import logging
import operator
import os
import random
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import TypeVar

import serial
from serial.tools import list_ports

from sts_jax.hardware import protocol

_log = logging.getLogger(__name__)

READ_S = 0.02  # longest wait of one read (s)
WRITE_S = 0.2  # longest wait of one write (s)


class LedError(OSError):
    """Base class of the errors of the LED controller and of its port. The message states the cause and the remedy."""


class PortNotFoundError(LedError):
    """Raised if a port does not exist, or if no port has the wanted controller. The message lists the ports found."""


class PortPermissionError(LedError):
    """Raised if the user is not allowed to open the serial port. The message names the group that has permission."""


class PortInUseError(LedError):
    """Raised if a process has opened the serial port already. The message names that process if it is known."""


class NotALedControllerError(LedError):
    """Raised if a device is not a serial port, or does not answer the requests as an LED controller does."""


class WrongVersionError(LedError):
    """Raised if the controller uses another version of the protocol. The message names both versions."""


class LedTimeoutError(LedError):
    """Raised if the controller gave no valid answer in time, or accepted no bytes."""


class DisconnectedError(LedError):
    """Raised if the port has vanished or is closed. `Leds.reconnect` searches for the controller again."""


@dataclasses.dataclass(frozen=True)
class Port:
    """A serial port of this machine."""

    device: str  # name for `Leds.connect`, such as /dev/ttyACM0
    description: str  # description by the operating system, may be empty
    serial_number: str | None  # USB serial number, None: unknown. The controller's own one is `Leds.serial_number`
    vendor: int | None  # number of the USB vendor, None: not a USB device
    product: int | None  # number of the USB product, None: not a USB device


def find_controllers() -> list[Port]:
    """List the serial ports of this machine.

    The LED controller may be on any of them. No port is opened, because opening a port restarts most boards.

    Returns:
        The ports. The ports of USB devices come first.
    """
    found = [
        Port(port.device, port.description or "", port.serial_number or None, port.vid, port.pid)
        for port in list_ports.comports()
    ]
    return sorted(found, key=lambda port: (port.vendor is None, port.device))


def open_port(name: str, baud: int = protocol.BAUD) -> serial.Serial:
    """Open a serial port, and lock it against other programs that use this library or pyserial's exclusive mode.

    Args:
        name: Name of the port, such as `/dev/ttyACM0`, or a URL of pyserial, such as `socket://localhost:7000`.
        baud: Rate of the serial line (baud).

    Returns:
        The open port.

    Raises:
        PortNotFoundError: There is no such port.
        PortPermissionError: The user is not allowed to open the port.
        PortInUseError: Another process, or another part of this process, has locked the port.
        NotALedControllerError: The device is not a serial port.
        LedError: The port cannot be opened for another reason.
    """
    try:
        return serial.serial_for_url(name, baudrate=baud, timeout=READ_S, write_timeout=WRITE_S, exclusive=True)
    except ValueError as error:
        raise PortNotFoundError(
            f"{name!r} is neither a port nor a URL of pyserial ({error}). {_ports_found()}"
        ) from error
    except OSError as error:
        raise _opening_error(name, error) from error


def _opening_error(name: str, error: OSError) -> LedError:
    """The error to raise for a port that cannot be opened, chosen by the operating system's error number."""
    match error.errno:
        case errno.ENOENT | errno.ENODEV | errno.ENXIO:
            return PortNotFoundError(f"there is no port {name}. {_ports_found()}")
        case errno.EACCES | errno.EPERM:
            group = _group(name)
            return PortPermissionError(
                f"no permission to open {name}: add your user to its group with `sudo usermod -aG {group} $USER` "
                f"(the group is usually dialout), then log in again."
            )
        case errno.EAGAIN | errno.EBUSY:
            users = ", ".join(users_of(name)) or "another process"
            return PortInUseError(f"{name} is in use by {users}: close the other program, or choose another port.")
        case errno.ENOTTY | errno.EISDIR:
            return NotALedControllerError(f"{name} is not a serial port. {_ports_found()}")
    if os.path.exists(name) and not Path(name).is_char_device():
        return NotALedControllerError(f"{name} is not a serial port. {_ports_found()}")
    return LedError(f"cannot open {name}: {error}. Unplug the controller, plug it in again, and retry.")


def _ports_found() -> str:
    """A sentence for error messages that lists the serial ports of this machine."""
    found = ", ".join(f"{port.device} ({port.description})" for port in find_controllers())
    return f"Ports found: {found}." if found else "No serial ports were found: connect the controller by USB."


def _group(name: str) -> str:
    """The group that owns a device, or dialout if it is unknown."""
    with contextlib.suppress(OSError, KeyError, ImportError):
        import grp  # not on Windows

        group = grp.getgrgid(os.stat(name).st_gid).gr_name
        return "dialout" if group == "root" else group
    return "dialout"


def users_of(name: str) -> list[str]:
    """Return the processes that have opened a device, as texts such as "process 123 (python)".

    The list contains only processes whose open files the current user is allowed to see. If the current process is
    the only one, the list contains the text "another part of this process". On systems other than Linux, the list is
    empty.

    Args:
        name: Path of the device, such as `/dev/ttyACM0`.
    """
    target, users, own = os.path.realpath(name), [], False
    for folder in Path("/proc").glob("[0-9]*/fd"):
        with contextlib.suppress(OSError):
            if any(_points_to(link, target) for link in folder.iterdir()):
                if folder.parent.name == str(os.getpid()):
                    own = True
                    continue
                command = (folder.parent / "comm").read_text().strip()
                users.append(f"process {folder.parent.name} ({command})")
    return sorted(users) or ["another part of this process"] * own


def _points_to(link: Path, target: str) -> bool:
    """Return True if a symbolic link leads to the target, and False if it does not or cannot be read."""
    with contextlib.suppress(OSError):
        return os.readlink(link) == target
    return False


REPEAT_S = 0.1  # wait for an answer before the request is repeated (s). A controller answers within 15 ms
_HEARD = 400  # largest number of invalid bytes that are kept for an error message


Answer = TypeVar("Answer", protocol.Controller, protocol.State, protocol.Watching)


class Connection:
    """An open serial port to the LED controller. Several threads may use one connection."""

    def __init__(self, name: str, baud: int):
        """Open the port. This method raises the same errors as `open_port`.

        Args:
            name: Name of the port, such as `/dev/ttyACM0`, or a pyserial URL, such as `socket://localhost:7000`.
            baud: Rate of the serial line (baud).
        """
        self.name = name
        self.baud = baud
        self.answered_s = time.monotonic()  # time of the last valid answer (s)
        self.stopped = threading.Event()  # set by `close`
        self._serial = open_port(name, baud)
        self._lock = threading.Lock()
        # Random, so that late answers to an earlier process have other sequence numbers.
        self._sequence = random.randrange(protocol.LAST_SEQUENCE)
        self._buffer = b""  # received bytes that are not processed yet
        self._heard = b""  # invalid lines that arrived during the current exchange

    def handshake(self, timeout_s: float) -> protocol.Controller:
        """Ask the controller for its description, and check that it uses the same version of the protocol as `sts_jax`.

        Opening a port restarts most boards. The request is therefore repeated every 0.1 s until an answer arrives.

        Args:
            timeout_s: Longest wait for the answer (s).

        Returns:
            The description of the controller, such as its firmware, board and serial number.

        Raises:
            NotALedControllerError: No valid answer arrived in time, or the port accepts no bytes.
            WrongVersionError: The controller uses another version of the protocol.
            LedError: The controller refused the request for another reason.
            DisconnectedError: The port vanished or is closed.
        """
        try:
            reply, _, _ = self.exchange(protocol.Hello, protocol.Controller, timeout_s=timeout_s)
        except LedTimeoutError as error:
            raise NotALedControllerError(
                f"no LED controller answered on {self.name} within {timeout_s:g} s. {self._description()}"
            ) from error
        if reply.version != protocol.VERSION:
            raise self._wrong_version(f"version {reply.version}")
        return reply

    def exchange(
        self, request: Callable[[int], protocol.Request], answer: type[Answer], *, timeout_s: float
    ) -> tuple[Answer, float, float]:
        """Send a request and wait for its answer.

        The request is repeated every 0.1 s with the same sequence number until its answer arrives.

        Args:
            request: Function that makes the request. Its argument is the sequence number of the request.
            answer: Type of the expected answer. A `protocol.Refused` reply to this request raises an error. Other
                replies are ignored.
            timeout_s: Longest wait for the answer, including all repetitions (s).

        Returns:
            The answer, the time just before the request was first sent, and the time just after the answer arrived.
            Both times are in seconds on the clock `time.monotonic`.

        Raises:
            LedTimeoutError: No valid answer arrived in time, or the port accepts no bytes.
            WrongVersionError: The controller refused the version of the protocol.
            LedError: The controller refused the request for another reason.
            DisconnectedError: The port vanished or is closed.
        """
        with self._lock:
            self._sequence = self._sequence % protocol.LAST_SEQUENCE + 1
            line = protocol.encode_request(request(self._sequence))
            self._heard = b""
            sent_s = time.monotonic()
            deadline = sent_s + timeout_s
            accepted = False
            while (now := time.monotonic()) < deadline:
                accepted |= self._write(line)
                until = min(deadline, now + REPEAT_S)
                while (reply := self._next_reply(until)) is not None:
                    if isinstance(reply, protocol.Refused) and reply.sequence in (0, self._sequence):
                        if reply.sequence == 0:  # the request was damaged on its way, so it is sent again
                            break
                        raise self._refusal(reply, line)
                    if isinstance(reply, answer) and reply.sequence == self._sequence:
                        self.answered_s = time.monotonic()
                        return reply, sent_s, self.answered_s
            if not accepted:
                raise LedTimeoutError(
                    f"the port {self.name} accepted no bytes for {timeout_s:g} s. Unplug the LED controller and plug "
                    "it in again."
                )
            raise LedTimeoutError(
                f"the LED controller on {self.name} gave no valid answer to the request "
                f"{line.decode().strip()!r} within {timeout_s:g} s. {self._description()}"
            )

    def close(self) -> None:
        """Close the port.

        If the lights are on, the controller's watchdog turns them off, because no more requests arrive.
        """
        self.stopped.set()
        with self._lock:
            try:
                self._serial.close()
            except OSError as error:
                _log.debug("closing %s: %s", self.name, error)

    def _next_reply(self, until: float) -> protocol.Reply | None:
        """The next valid reply, or None if none arrives until a time. Skips invalid lines and the watchdog's lines."""
        while (line := self._next_line(until)) is not None:
            if time.monotonic() >= until + REPEAT_S:  # the device sends without end
                return None
            try:
                reply = protocol.decode_reply(line)
            except protocol.ProtocolError as error:
                self._heard = (self._heard + line)[:_HEARD]
                _log.debug("%s: %s", self.name, error)
                continue
            if isinstance(reply, protocol.TurnedOff):
                _log.warning("the watchdog of the LED controller on %s turned the lights off", self.name)
                continue
            return reply
        return None

    def _next_line(self, until: float) -> bytes | None:
        """The next line that is not empty, or None if none arrives until a time.

        Bytes without a newline are returned once they are longer than any valid line.
        """
        expired = False
        while True:
            line, newline, rest = self._buffer.partition(b"\n")
            if newline or len(line) > protocol.LONGEST_LINE:
                self._buffer = rest
                if line:
                    return line + newline
                continue
            if expired:
                return None
            expired = time.monotonic() >= until  # read once more, in case this process was suspended meanwhile
            self._buffer += self._read()

    def _read(self) -> bytes:
        try:
            return self._serial.read(max(1, self._serial.in_waiting))
        except (OSError, TypeError) as error:  # TypeError: pyserial reads from a port that was closed meanwhile
            raise self._vanished(error) from error

    def _write(self, line: bytes) -> bool:
        """Write a line. Return False if the time `WRITE_S` has passed.

        pyserial also reports a timeout for a line that it has sent, if the operating system suspended the process in
        between. This happens on a busy computer.
        """
        try:
            self._serial.write(line)
        except serial.SerialTimeoutException:
            return False
        except (OSError, TypeError) as error:
            raise self._vanished(error) from error
        return True

    def _vanished(self, error: Exception) -> DisconnectedError:
        return DisconnectedError(
            f"the port {self.name} is gone or closed ({error}). Check the cable, then call `reconnect()`."
        )

    def _refusal(self, reply: protocol.Refused, line: bytes) -> LedError:
        if reply.code == protocol.Code.VERSION:
            return self._wrong_version(reply.text)
        return LedError(
            f"the LED controller on {self.name} refused the request {line.decode().strip()!r} with error "
            f"{int(reply.code)} ({reply.text}). Flash the firmware of this version of sts_jax."
        )

    def _wrong_version(self, found: str) -> WrongVersionError:
        return WrongVersionError(
            f"the LED controller on {self.name} uses another version of the protocol ({found}), but this version of "
            f"sts_jax needs version {protocol.VERSION}. Flash the firmware of this version of sts_jax: run `make flash "
            f"PORT={self.name}` in sts_jax/hardware/firmware."
        )

    def _description(self) -> str:
        """Sentences for an error message: the invalid bytes that were received, their likely cause and the remedy."""
        heard = self._heard + self._buffer
        if not heard:
            return "Nothing was received. Check the cable and the name of the port, and flash the firmware."
        strange = sum(not (32 <= byte < 127 or byte in b"\t\r\n") for byte in heard)
        if 5 * strange > len(heard):
            return (
                f"Received {len(heard)} bytes that are not text ({heard[:24]!r}), which is typical of a wrong baud "
                f"rate: the port was opened at {self.baud} baud, and the firmware uses {protocol.BAUD}. Set baud to "
                f"{protocol.BAUD}, or choose another port."
            )
        return f"Received {heard[:80]!r}, so another device may be on this port. Choose another port."


_FIRST_WAIT_S = 0.1  # between the first two attempts of `reconnect`. It doubles after each attempt
_LONGEST_WAIT_S = 5.0


@dataclasses.dataclass(frozen=True)
class Lit:
    """The controller's answer to a request: the levels of the lights, and the times of the request and the answer.

    The lights had these levels at some time between `sent_s` and `acknowledged_s`, both on the clock `time.monotonic`.
    """

    levels: protocol.Levels  # duty cycles of the four light channels, 0 to 255
    counter: int  # number of changes of the levels since the controller booted
    boot: int  # number of the controller's boot, 0 to 65535. The controller counts its boots
    sent_s: float  # time just before the request was first sent (s)
    acknowledged_s: float  # time at which the answer had arrived (s)

    def unchanged_since(self, earlier: "Lit") -> bool:
        """Return True if the levels of the lights did not change between an earlier answer and this one.

        Args:
            earlier: The earlier answer, from the same controller.
        """
        return (self.boot, self.counter, self.levels) == (earlier.boot, earlier.counter, earlier.levels)


class Leds:
    """An open connection to the LED controller.

    ```python
    with Leds.connect("/dev/ttyACM0") as leds:
        before = leds.set((255, 255, 255, 255))
        ...  # take a picture
        assert leds.ping().unchanged_since(before)
    ```

    Several threads may use one `Leds`. The controller has a watchdog, which turns the lights off if no request arrives
    for the time `watchdog_ms` (an argument of `connect`). A background thread therefore sends a request whenever a
    third of this time has passed without any request, so the lights stay on while this process runs. If the
    process ends or hangs, the watchdog turns the lights off.

    A request is repeated with the same sequence number every 0.1 s until its answer arrives. The controller executes it
    only once. Damaged lines and answers to other requests are ignored.

    A request takes at most the time `answer_s` (an argument of `connect`), and 0.3 s more if the port accepts no bytes
    or sends bytes without end. The first request after a restart of the controller takes at most twice as long. A
    thread also waits while the request of another thread is in progress.
    """

    def __init__(self, port: str, *, baud: int, timeout_s: float, answer_s: float, watchdog_ms: int):
        """Use `Leds.connect`."""
        self._port = port
        self._baud = baud
        self._timeout_s = timeout_s
        self._answer_s = answer_s
        self._watchdog_ms = watchdog_ms
        self._usb = _usb_port(port)
        self._thread: threading.Thread | None = None
        self._boot: int | None = None
        self._open = False
        connection, self._controller = self._handshake(port, timeout_s)
        self._start(connection)

    @classmethod
    def connect(
        cls,
        port: str,
        *,
        baud: int = protocol.BAUD,
        timeout_s: float = 5.0,
        answer_s: float = 1.0,
        watchdog_ms: int = protocol.DEFAULT_WATCH_MS,
    ) -> "Leds":
        """Connect to the controller on a port and turn its lights off.

        Opening the port restarts most boards, which takes up to 2 s.

        Args:
            port: Name of the device, such as `/dev/ttyACM0`, or a URL of pyserial. `find_controllers` lists the
                devices.
            baud: Rate of the serial line (baud). The firmware uses 115200.
            timeout_s: Longest wait for the controller's first answer (s).
            answer_s: Longest time of each later request, with all its repetitions (s).
            watchdog_ms: Time without requests after which the controller turns its lights off, 100 to 10000 (ms).

        Returns:
            The open connection. The lights of the controller are off.

        Raises:
            ValueError: `timeout_s`, `answer_s` or `watchdog_ms` is out of range.
            PortNotFoundError: There is no such port.
            PortPermissionError: The user is not allowed to open the port.
            PortInUseError: Another process has opened the port.
            NotALedControllerError: Another device is on the port, or the baud rate is wrong.
            WrongVersionError: The controller uses another version of the protocol.
            LedTimeoutError: The controller stopped answering after its first answer.
            DisconnectedError: The port vanished.
            LedError: The port cannot be opened for another reason, or the controller refused a request.
        """
        if not protocol.SHORTEST_WATCH_MS <= watchdog_ms <= protocol.LONGEST_WATCH_MS:
            raise ValueError(
                f"watchdog_ms must be in {protocol.SHORTEST_WATCH_MS}..{protocol.LONGEST_WATCH_MS}, got {watchdog_ms}"
            )
        for name, value in (("timeout_s", timeout_s), ("answer_s", answer_s)):
            if not 0 < value < float("inf"):
                raise ValueError(f"{name} must be positive and finite, got {value}")
        return cls(port, baud=baud, timeout_s=timeout_s, answer_s=answer_s, watchdog_ms=watchdog_ms)

    @classmethod
    def find(cls, serial_number: str, *, timeout_s: float = 5.0) -> "Leds":
        """Search the USB ports for the controller with a given serial number, and connect to it.

        The method opens the USB ports one after the other, and asks for the serial number, until the controller is
        found. It begins with the ports whose USB descriptor contains this serial number, which some boards provide.
        Opening a port restarts most boards.

        Args:
            serial_number: Serial number of the controller, as `Leds.serial_number` returns it.
            timeout_s: Longest wait for an answer on each port (s).

        Returns:
            The open connection. The lights of the controller are off.

        Raises:
            ValueError: `timeout_s` is out of range.
            PortNotFoundError: No USB port has this controller. The message lists the ports and the result on each.
        """
        tried = {}
        candidates = [port for port in find_controllers() if port.vendor is not None]
        for port in sorted(candidates, key=lambda port: port.serial_number != serial_number):
            try:
                leds = cls.connect(port.device, timeout_s=timeout_s)
            except LedError as error:
                tried[port.device] = str(error)
                continue
            if leds.serial_number == serial_number:
                return leds
            tried[port.device] = f"controller {leds.serial_number}"
            leds.close()
        found = ", ".join(f"{name} ({result})" for name, result in tried.items()) or "none"
        raise PortNotFoundError(
            f"LED controller {serial_number} was not found on any USB port. Connect it to a USB port. If it is "
            "connected to a port of another kind, pass the name of this port to `Leds.connect`, or to `STS.from_file` "
            "as the argument `leds`. "
            f"USB ports tried: {found}."
        )

    @property
    def port(self) -> str:
        """Name of the serial port, such as `/dev/ttyACM0`."""
        return self._port

    @property
    def serial_number(self) -> str:
        """Serial number that the controller reports."""
        return self._controller.serial_number

    @property
    def firmware(self) -> str:
        """Version of the controller's firmware, such as "1.0.0"."""
        return self._controller.firmware

    @property
    def board(self) -> str:
        """Name of the controller's board, such as "atmega328p"."""
        return self._controller.board

    def set(self, levels: Sequence[int]) -> Lit:
        """Set the lights and wait until the controller has applied the levels.

        Args:
            levels: Duty cycles of the four light channels, integers from 0 (off) to 255 (always on).

        Returns:
            The controller's answer, which contains the applied levels.

        Raises:
            ValueError: `levels` are not four integers from 0 to 255.
            LedTimeoutError: No valid answer arrived within the time `answer_s` (an argument of `connect`). It is
                unknown whether the lights changed.
            DisconnectedError: The port vanished or is closed.
            LedError: The controller refused the request or applied other levels.
        """
        checked = _checked(levels)
        lit = self._state(functools.partial(protocol.Set, levels=checked))
        if lit.levels != checked:
            raise LedError(
                f"the LED controller on {self._port} applied the levels {lit.levels} instead of {checked}. "
                "Flash the firmware of this version of sts_jax."
            )
        return lit

    def ping(self) -> Lit:
        """Ask the controller for the present levels of the four light channels, from 0 (off) to 255 (always on).

        Returns:
            The controller's answer.

        Raises:
            LedTimeoutError: No valid answer arrived within the time `answer_s` (an argument of `connect`).
            DisconnectedError: The port vanished or is closed.
            LedError: The controller refused the request.
        """
        return self._state(protocol.Ping)

    def close(self) -> None:
        """Turn the lights off and close the port.

        If the controller does not answer within the time `answer_s` (an argument of `connect`), the port is closed
        anyway. The controller's watchdog then turns the lights off. Closing twice is allowed.
        """
        if not self._open:
            return
        self._open = False
        try:
            self.set(protocol.DARK)
        except LedError as error:
            _log.warning(
                "the request to turn off the lights on %s failed. The controller's watchdog will turn them off. Cause "
                "of the failure: %s",
                self._port,
                error,
            )
        self._stop()

    def reconnect(self, *, limit_s: float = 30.0) -> None:
        """Search for the controller after its port has vanished, connect to it again, and turn its lights off.

        The controller is recognised by its serial number. The previous port is tried first, then all other ports with
        the USB vendor ID and product ID of the controller. The wait between attempts begins at 0.1 s and doubles up to
        5 s. Requests of other threads raise `DisconnectedError` meanwhile.

        Args:
            limit_s: Time after which no further attempt begins (s). An attempt takes at most `timeout_s + 2 * answer_s`
                for each port. `timeout_s` and `answer_s` are arguments of `connect`.

        Raises:
            DisconnectedError: The controller was not found. The message lists the ports that were tried.
        """
        self._stop()
        deadline, wait = time.monotonic() + limit_s, _FIRST_WAIT_S
        while True:
            tried = {}
            for name in self._candidates():
                try:
                    connection, controller = self._handshake(name, self._timeout_s)
                    if controller.serial_number != self.serial_number:
                        connection.close()
                        tried[name] = f"controller {controller.serial_number}"
                        continue
                    self._port, self._controller, self._boot = name, controller, None
                    self._usb = _usb_port(name) or self._usb
                    self._start(connection)
                    return
                except LedError as error:
                    tried[name] = str(error)
            if time.monotonic() + wait > deadline:
                raise DisconnectedError(
                    f"LED controller {self.serial_number} was not found within {limit_s:g} s. Check its cable. "
                    "Ports tried: " + (", ".join(f"{name} ({result})" for name, result in tried.items()) or "none")
                )
            time.sleep(wait)
            wait = min(2 * wait, _LONGEST_WAIT_S)

    def __enter__(self) -> "Leds":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _handshake(self, port: str, timeout_s: float) -> tuple[Connection, protocol.Controller]:
        """Open a port and return the connection and the controller's description."""
        connection = Connection(port, self._baud)
        try:
            return connection, connection.handshake(timeout_s)
        except BaseException:
            connection.close()
            raise

    def _start(self, connection: Connection) -> None:
        """Turn the lights off, and start the background thread of requests."""
        self._connection = connection
        try:
            self.set(protocol.DARK)
        except BaseException:
            connection.close()
            raise
        self._open = True
        self._thread = threading.Thread(
            target=self._keep_alive, args=(connection,), name=f"keep-alive of {self._port}", daemon=True
        )
        self._thread.start()

    def _stop(self) -> None:
        """Close the port and wait until the background thread has ended."""
        self._connection.close()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _state(self, request: Callable[[int], protocol.Request]) -> Lit:
        """Send a request whose reply is a `State`. If the controller has rebooted, set the watchdog's period again."""
        connection = self._connection
        reply, sent_s, acknowledged_s = connection.exchange(request, protocol.State, timeout_s=self._answer_s)
        if reply.boot != self._boot:
            period = functools.partial(protocol.Watch, period_ms=self._watchdog_ms)
            connection.exchange(period, protocol.Watching, timeout_s=self._answer_s)
            self._boot = reply.boot
        return Lit(reply.levels, reply.counter, reply.boot, sent_s, acknowledged_s)

    def _keep_alive(self, connection: Connection) -> None:
        """Send a request whenever a third of the watchdog's period has passed without one."""
        period_s = self._watchdog_ms / 3000
        wait = period_s
        while not connection.stopped.wait(wait):
            wait = period_s - (time.monotonic() - connection.answered_s)
            if wait > 0:
                continue
            wait = period_s
            try:
                self.ping()
            except DisconnectedError as error:
                _log.warning("%s", error)
                return
            except LedError as error:
                _log.warning("%s", error)
                wait = 0.0

    def _candidates(self) -> list[str]:
        """The names of the ports on which `reconnect` searches for the controller, in order."""
        names = [self._port]
        if self._usb is not None:
            kind = self._usb.vendor, self._usb.product
            found = [port for port in find_controllers() if (port.vendor, port.product) == kind]
            same = [port for port in found if port.serial_number == self._usb.serial_number]
            names += [port.device for port in same + [port for port in found if port not in same]]
        return list(dict.fromkeys(names))


def _usb_port(name: str) -> Port | None:
    """The USB port that a device name refers to, or None if it is not a USB port."""
    target = os.path.realpath(name)
    for port in find_controllers():
        with contextlib.suppress(OSError):
            if port.vendor is not None and os.path.realpath(port.device) == target:
                return port
    return None


def _checked(levels: Sequence[int]) -> protocol.Levels:
    """The levels as a tuple of four integers, or a `ValueError`."""
    try:
        found = tuple(operator.index(level) for level in levels)
    except TypeError as error:
        raise ValueError(f"levels must be {protocol.CHANNELS} integers in 0..255, got {levels!r}") from error
    if len(found) != protocol.CHANNELS or not all(0 <= level <= 255 for level in found):
        raise ValueError(f"levels must be {protocol.CHANNELS} integers in 0..255, got {levels!r}")
    first, second, third, fourth = found
    return first, second, third, fourth
