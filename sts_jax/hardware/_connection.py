"""`Connection`: a serial connection to the LED controller. Each request is repeated until an answer arrives."""

import logging
import random
import threading
import time
from collections.abc import Callable
from typing import TypeVar

import serial

from sts_jax.hardware import ports, protocol

REPEAT_S = 0.1  # wait for an answer before the request is repeated (s). A controller answers within 15 ms
_HEARD = 400  # largest number of invalid bytes that are kept for an error message

_log = logging.getLogger(__name__)

Answer = TypeVar("Answer", protocol.Controller, protocol.State, protocol.Watching)


class Connection:
    """An open serial port to the LED controller. Several threads may use one connection."""

    def __init__(self, name: str, baud: int):
        """Open the port. This method raises the same errors as `ports.open_port`.

        Args:
            name: Name of the port, such as `/dev/ttyACM0`, or a pyserial URL, such as `socket://localhost:7000`.
            baud: Rate of the serial line (baud).
        """
        self.name = name
        self.baud = baud
        self.answered_s = time.monotonic()  # time of the last valid answer (s)
        self.stopped = threading.Event()  # set by `close`
        self._serial = ports.open_port(name, baud)
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
        except ports.LedTimeoutError as error:
            raise ports.NotALedControllerError(
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
                raise ports.LedTimeoutError(
                    f"the port {self.name} accepted no bytes for {timeout_s:g} s. Unplug the LED controller and plug "
                    "it in again."
                )
            raise ports.LedTimeoutError(
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
        """Write a line. Return False if the time `ports.WRITE_S` has passed.

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

    def _vanished(self, error: Exception) -> ports.DisconnectedError:
        return ports.DisconnectedError(
            f"the port {self.name} is gone or closed ({error}). Check the cable, then call `reconnect()`."
        )

    def _refusal(self, reply: protocol.Refused, line: bytes) -> ports.LedError:
        if reply.code == protocol.Code.VERSION:
            return self._wrong_version(reply.text)
        return ports.LedError(
            f"the LED controller on {self.name} refused the request {line.decode().strip()!r} with error "
            f"{int(reply.code)} ({reply.text}). Flash the firmware of this version of sts_jax."
        )

    def _wrong_version(self, found: str) -> ports.WrongVersionError:
        return ports.WrongVersionError(
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
