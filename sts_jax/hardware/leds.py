"""The LED controller of the sensor: lights whose state at any time can be proven."""

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

_FIRST_WAIT_S = 0.1  # between the attempts of `reconnect`, doubled after each
_LONGEST_WAIT_S = 5.0


@dataclasses.dataclass(frozen=True)
class Lit:
    """The controller's answer about its lights.

    The levels were applied at some moment between `sent_s` and `acknowledged_s`, both on the clock `time.monotonic`.
    """

    levels: protocol.Levels  # duty cycles of the channels, 0 to 255
    counter: int  # changes of the levels since the controller's boot
    boot: int  # number of the controller's boot
    sent_s: float  # before the request was first sent (s)
    acknowledged_s: float  # after the answer had come (s)

    def unchanged_since(self, earlier: "Lit") -> bool:
        """Whether the levels were the same without interruption from `earlier.acknowledged_s` to `self.sent_s`."""
        return (self.boot, self.counter, self.levels) == (earlier.boot, earlier.counter, earlier.levels)


class Leds:
    """An open LED controller.

    ```python
    with Leds.connect("/dev/ttyACM0") as leds:
        before = leds.set((255, 255, 255, 255))
        ...  # take a picture
        assert leds.ping().unchanged_since(before)
    ```

    Threads may share it. A thread of its own sends a request whenever a third of the watchdog's period has passed
    without one, so the lights stay on while this process runs. If the process ends or hangs, the controller's watchdog
    turns them off.

    A request is repeated with the same sequence number every 0.1 s until its answer comes, and the controller executes
    it once. Damaged lines and answers to other requests are ignored.

    A request takes at most `answer_s`, and 0.3 s more if the port takes no bytes or brings bytes without end. The first
    one after a restart of the controller takes at most twice that time. If another thread is in a request, its time is
    added.
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
        """Open a controller and turn its lights off.

        Opening restarts most boards, which takes up to 2 s.

        Args:
            port: Device such as `/dev/ttyACM0`, or a URL of pyserial. `find_controllers` lists the devices.
            baud: Rate (baud). The firmware uses 115200.
            timeout_s: Longest time until the controller answers (s).
            answer_s: Longest time of each later request, with all its repetitions (s).
            watchdog_ms: Time without requests after which the controller turns its lights off (ms), 100 to 10000.

        Raises:
            PortNotFoundError: There is no such port.
            PortPermissionError: The user may not open it.
            PortInUseError: Another process has opened it.
            NotALedControllerError: Another device is on the port, or the baud rate is wrong.
            WrongVersionError: The controller speaks another version of the protocol.
            LedTimeoutError: The controller stopped answering after the first answer.
            DisconnectedError: The port vanished.
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
        """Open the controller with a serial number.

        The controller states its number itself, so USB ports are opened one after the other until it is found. Ports
        whose USB serial number is the same come first. Opening a port restarts most boards.

        Args:
            serial_number: Serial number of the controller, which `Leds.serial_number` has.
            timeout_s: Longest time until the device on a port answers (s).

        Raises:
            PortNotFoundError: No port has this controller. The message lists the ports and the device on each.
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
            f"LED controller {serial_number} was not found. Connect it by USB, or give the name of its port. USB ports "
            f"tried: {found}."
        )

    @property
    def port(self) -> str:
        """Name of the port."""
        return self._port

    @property
    def serial_number(self) -> str:
        """Serial number of the controller."""
        return self._controller.serial_number

    @property
    def firmware(self) -> str:
        """Version of the firmware."""
        return self._controller.firmware

    @property
    def board(self) -> str:
        """Name of the board."""
        return self._controller.board

    def set(self, levels: Sequence[int]) -> Lit:
        """Set the lights and wait until the controller has applied the levels.

        Args:
            levels: Duty cycles of the four channels, 0 (off) to 255 (always on).

        Raises:
            ValueError: There are not four levels, or one is out of range.
            LedTimeoutError: No valid answer came within `answer_s`. The lights may have changed or not.
            DisconnectedError: The port vanished or is closed.
        """
        checked = _checked(levels)
        lit = self._state(functools.partial(protocol.Set, levels=checked))
        if lit.levels != checked:
            raise ports.LedError(
                f"the LED controller on {self._port} applied {lit.levels} instead of {checked}. "
                "Flash the firmware of this version of sts_jax."
            )
        return lit

    def ping(self) -> Lit:
        """The levels that are applied now.

        Raises:
            LedTimeoutError: No valid answer came within `answer_s`.
            DisconnectedError: The port vanished or is closed.
        """
        return self._state(protocol.Ping)

    def close(self) -> None:
        """Turn the lights off and close the port.

        If the controller does not answer within `answer_s`, the port is closed all the same, and the controller's
        watchdog turns the lights off. Closing twice is allowed.
        """
        if not self._open:
            return
        self._open = False
        try:
            self.set(protocol.DARK)
        except ports.LedError as error:
            _log.warning("the lights could not be turned off by a request, the watchdog will do it: %s", error)
        self._stop()

    def reconnect(self, *, limit_s: float = 30.0) -> None:
        """Find the controller again after its port has vanished, by its serial number, and turn its lights off.

        The port of the same name is tried first, then ports of the same USB device. The wait between attempts begins
        at 0.1 s and doubles up to 5 s. Requests of other threads raise `DisconnectedError` meanwhile.

        Args:
            limit_s: Time after which no further attempt begins (s). An attempt takes at most `timeout_s` and
                two times `answer_s` for each port.

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
                    f"controller {self.serial_number} was not found within {limit_s:g} s. Check its cable. Tried: "
                    + ", ".join(f"{name} ({result})" for name, result in tried.items())
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
        connection = _connection.Connection(port, self._baud)
        try:
            return connection, connection.handshake(timeout_s)
        except BaseException:
            connection.close()
            raise

    def _start(self, connection: _connection.Connection) -> None:
        """Turn the lights off, and keep the connection alive from now on."""
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
        """Close the port and wait for the end of the thread."""
        self._connection.close()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _state(self, request: Callable[[int], protocol.Request]) -> Lit:
        """Send a request about the levels. A controller that has booted gets the watchdog's period first."""
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
        """The ports on which `reconnect` looks for the controller."""
        names = [self._port]
        if self._usb is not None:
            kind = self._usb.vendor, self._usb.product
            found = [port for port in ports.find_controllers() if (port.vendor, port.product) == kind]
            same = [port for port in found if port.serial_number == self._usb.serial_number]
            names += [port.device for port in same + [port for port in found if port not in same]]
        return list(dict.fromkeys(names))


def _usb_port(name: str) -> ports.Port | None:
    """The USB port of a device, or None."""
    target = os.path.realpath(name)
    for port in ports.find_controllers():
        with contextlib.suppress(OSError):
            if port.vendor is not None and os.path.realpath(port.device) == target:
                return port
    return None


def _checked(levels: Sequence[int]) -> protocol.Levels:
    """The levels as a tuple of four integers."""
    try:
        found = tuple(operator.index(level) for level in levels)
    except TypeError as error:
        raise ValueError(f"levels must be {protocol.CHANNELS} integers, got {levels!r}") from error
    if len(found) != protocol.CHANNELS or not all(0 <= level <= 255 for level in found):
        raise ValueError(f"levels must be {protocol.CHANNELS} integers in 0..255, got {levels!r}")
    first, second, third, fourth = found
    return first, second, third, fourth
