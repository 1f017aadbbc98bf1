"""Control of the sensor's lights through its LED controller.

`Lit.unchanged_since` compares two answers of the controller, and returns True if the lights did not change in between.
"""

import contextlib
import dataclasses
import functools
import logging
import operator
import os
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType

from sts_jax.hardware import _connection, ports, protocol

_log = logging.getLogger(__name__)

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
        candidates = [port for port in ports.find_controllers() if port.vendor is not None]
        for port in sorted(candidates, key=lambda port: port.serial_number != serial_number):
            try:
                leds = cls.connect(port.device, timeout_s=timeout_s)
            except ports.LedError as error:
                tried[port.device] = str(error)
                continue
            if leds.serial_number == serial_number:
                return leds
            tried[port.device] = f"controller {leds.serial_number}"
            leds.close()
        found = ", ".join(f"{name} ({result})" for name, result in tried.items()) or "none"
        raise ports.PortNotFoundError(
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
            raise ports.LedError(
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
        except ports.LedError as error:
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
                except ports.LedError as error:
                    tried[name] = str(error)
            if time.monotonic() + wait > deadline:
                raise ports.DisconnectedError(
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

    def _handshake(self, port: str, timeout_s: float) -> tuple[_connection.Connection, protocol.Controller]:
        """Open a port and return the connection and the controller's description."""
        connection = _connection.Connection(port, self._baud)
        try:
            return connection, connection.handshake(timeout_s)
        except BaseException:
            connection.close()
            raise

    def _start(self, connection: _connection.Connection) -> None:
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

    def _keep_alive(self, connection: _connection.Connection) -> None:
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
            except ports.DisconnectedError as error:
                _log.warning("%s", error)
                return
            except ports.LedError as error:
                _log.warning("%s", error)
                wait = 0.0

    def _candidates(self) -> list[str]:
        """The names of the ports on which `reconnect` searches for the controller, in order."""
        names = [self._port]
        if self._usb is not None:
            kind = self._usb.vendor, self._usb.product
            found = [port for port in ports.find_controllers() if (port.vendor, port.product) == kind]
            same = [port for port in found if port.serial_number == self._usb.serial_number]
            names += [port.device for port in same + [port for port in found if port not in same]]
        return list(dict.fromkeys(names))


def _usb_port(name: str) -> ports.Port | None:
    """The USB port that a device name refers to, or None if it is not a USB port."""
    target = os.path.realpath(name)
    for port in ports.find_controllers():
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
