"""The serial protocol of the LED controller: messages, their encoding as lines of text, and an emulated controller.

A line consists of ASCII text, `*`, the checksum of the text in four hexadecimal digits, and a newline, such as
`7 PING*018E`. The host sends requests, and the controller answers each with one reply of the same sequence number.
docs/hardware/protocol.md defines them. Each message has exactly one valid line. Any other line is a `ProtocolError`.
"""

import binascii
import enum
import re
from typing import Any, NamedTuple

VERSION = 1  # version of the protocol
BAUD = 115200  # 8 data bits, no parity, 1 stop bit
CHANNELS = 4  # lights of the sensor that are controlled separately
LONGEST_LINE = 64  # bytes, with the newline
LAST_SEQUENCE = 65535  # largest sequence number. 1 follows it. 0 marks replies to no particular request
SHORTEST_WATCH_MS = 100  # shortest period of the watchdog (ms)
LONGEST_WATCH_MS = 10_000  # longest period of the watchdog (ms)
DEFAULT_WATCH_MS = 1000  # period of the watchdog after a boot (ms)

Levels = tuple[int, int, int, int]  # duty cycles of the channels, 0 (off) to 255 (always on)
DARK: Levels = (0, 0, 0, 0)


class Code(enum.IntEnum):
    """The reason why the LED controller refused a request."""

    CHECKSUM = 1  # the checksum of the line is wrong
    COMMAND = 2  # there is no such command
    ARGUMENTS = 3  # the arguments are too few, too many or out of range
    VERSION = 4  # the host uses another version of the protocol
    LENGTH = 5  # the line is longer than `LONGEST_LINE`


class ProtocolError(ValueError):
    """A line is not a valid message. `code` and `sequence` are those of the controller's reply to this line."""

    def __init__(self, message: str, code: Code = Code.CHECKSUM, sequence: int = 0):
        super().__init__(message)
        self.code, self.sequence = code, sequence


class Hello(NamedTuple):
    """Request for the description of the controller (`Controller`)."""

    sequence: int
    version: int = VERSION  # version of the protocol that the host uses


class Set(NamedTuple):
    """Request to set the levels of the lights (`State`)."""

    sequence: int
    levels: Levels


class Ping(NamedTuple):
    """Request for the state of the lights (`State`). Like any request, it restarts the watchdog."""

    sequence: int


class Watch(NamedTuple):
    """Request to set the watchdog's period. The reply is the same."""

    sequence: int
    period_ms: int  # the lights go off after this time without a request, 100 to 10000 (ms)


class Controller(NamedTuple):
    """The reply to a `Hello` request."""

    sequence: int
    version: int  # version of the protocol that the controller uses. If it is another one, the rest is unknown
    firmware: str = "unknown"  # version of the firmware
    board: str = "unknown"  # name of the board
    serial_number: str = "unknown"  # serial number of the controller
    channels: int = 0  # number of channels


class State(NamedTuple):
    """The reply to a `Set` or `Ping` request."""

    sequence: int
    levels: Levels  # duty cycles that are applied at the time of the reply
    counter: int  # number of changes of the levels since the boot
    boot: int  # number of the boot, 0 to 65535
    uptime_ms: int | None = None  # time since the boot (ms). None in replies to `Set`


class Refused(NamedTuple):
    """The reply to a request that the controller did not execute."""

    sequence: int  # 0 if the controller could not read the request's sequence number
    code: Code
    text: str  # the reason in words


class TurnedOff(NamedTuple):
    """Line that the controller sends without a request: the watchdog has turned the lights off."""

    sequence: int  # always 0
    counter: int  # number of changes of the levels since the boot, this one included


Request = Hello | Set | Ping | Watch
Reply = Controller | State | Watch | Refused | TurnedOff

_NUMBER = "(0|[1-9][0-9]*)"  # no sign and no leading zeros
_NAME = "([A-Za-z0-9._-]+)"
_TEXT = "(.*[^ ].*)"  # may contain spaces
_UINT16, _UINT32 = range(2**16), range(2**32)
_LEVELS = (range(256),) * CHANNELS
_VERSION, _CHANNELS = range(VERSION, VERSION + 1), range(CHANNELS, CHANNELS + 1)
_PERIOD = range(SHORTEST_WATCH_MS, LONGEST_WATCH_MS + 1)
_NUMBERED = range(1, LAST_SEQUENCE + 1)

# Class, words after the sequence number, and valid values of each message: a range of numbers, or a pattern
_REQUESTS: tuple[tuple[type, str, tuple[range | str, ...]], ...] = (
    (Hello, "HELLO", (_NUMBERED, _UINT16)),
    (Set, "SET", (_NUMBERED, *_LEVELS)),
    (Ping, "PING", (_NUMBERED,)),
    (Watch, "WATCH", (_NUMBERED, _PERIOD)),
)
_REPLIES: tuple[tuple[type, str, tuple[range | str, ...]], ...] = (
    (Controller, "OK HELLO", (_NUMBERED, _VERSION, _NAME, _NAME, _NAME, _CHANNELS)),
    (State, "OK SET", (_NUMBERED, *_LEVELS, _UINT32, _UINT16)),
    (State, "OK PING", (_NUMBERED, *_LEVELS, _UINT32, _UINT16, _UINT32)),
    (Watch, "OK WATCH", (_NUMBERED, _PERIOD)),
    (Refused, "ERR", (range(LAST_SEQUENCE + 1), range(1, len(Code) + 1), _TEXT)),
    (TurnedOff, "OFF watchdog", (range(1), range(1, 2**32))),
)


def checksum(text: bytes) -> int:
    """CRC-16/CCITT-FALSE of a text: polynomial 0x1021, initial value 0xFFFF, not reflected, not inverted."""
    return binascii.crc_hqx(text, 0xFFFF)


def encode(text: str) -> bytes:
    """Append the checksum and the newline to a text of printable ASCII without `*`."""
    return f"{text}*{checksum(text.encode()):04X}\n".encode()


def decode(line: bytes) -> str:
    """Check the checksum of a line with its newline, and return the text before the checksum."""
    if len(line) > LONGEST_LINE:
        raise ProtocolError(f"a line must have at most {LONGEST_LINE} bytes, got {len(line)}: {line!r}", Code.LENGTH)
    match = re.fullmatch(rb"([ -)+-~]+)\*([0-9A-F]{4})\n", line)
    if match is None:
        raise ProtocolError(f"a line must consist of a text, '*', four hexadecimal digits and a newline, got {line!r}")
    text, digits = match.groups()
    if int(digits, 16) != checksum(text):
        raise ProtocolError(f"the line {line!r} is damaged: the checksum of its text is {checksum(text):04X}")
    return text.decode()


def encode_request(request: Request) -> bytes:
    """Encode a request as a line with its checksum and newline."""
    line = encode(_written(request, _REQUESTS))
    decode_request(line)  # checks the ranges
    return line


def decode_request(line: bytes) -> Request:
    """Decode a request from a line with its checksum and newline."""
    text = decode(line)
    request = _read(text, _REQUESTS)
    if request is not None:
        return request
    sequence, *words = text.split(" ")
    if not re.fullmatch(_NUMBER, sequence) or int(sequence) not in _NUMBERED:
        raise ProtocolError(f"the sequence number of {line!r} must be in 1..65535", Code.ARGUMENTS)
    if words[:1] in [[name] for _, name, _ in _REQUESTS]:
        raise ProtocolError(f"wrong number or range of arguments in {line!r}", Code.ARGUMENTS, int(sequence))
    raise ProtocolError(f"unknown command in {line!r}", Code.COMMAND, int(sequence))


def encode_reply(reply: Reply) -> bytes:
    """Encode a reply as a line with its checksum and newline."""
    return encode(_written(reply, _REPLIES))


def decode_reply(line: bytes) -> Reply:
    """Decode a reply from a line with its checksum and newline."""
    text = decode(line)
    reply = _read(text, _REPLIES)
    if reply is None and (other := re.fullmatch(f"{_NUMBER} OK HELLO {_NUMBER}( .*)?", text)):
        # In all versions of the protocol, the first value of this reply is the version.
        sequence, version = int(other[1]), int(other[2])
        if sequence in _NUMBERED and version in _UINT16 and version != VERSION:
            return Controller(sequence, version)
    if reply is None:
        raise ProtocolError(f"the line {line!r} is not a reply of the LED controller's protocol", Code.ARGUMENTS)
    return reply


def _written(message: Request | Reply, table: tuple) -> str:
    """The text of a message: that of the row with its class and its number of values."""
    values: list[Any] = [value for value in message if value is not None]
    if isinstance(message, Set | State):
        values[1:2] = message.levels
    name = next(name for kind, name, valid in table if isinstance(message, kind) and len(valid) == len(values))
    return " ".join([str(values[0]), name, *(f"{value}" for value in values[1:])])


def _read(text: str, table: tuple) -> Any:
    """The message that has a text, or None."""
    for kind, name, valid in table:
        first, *rest = (_NUMBER if isinstance(each, range) else each for each in valid)
        match = re.fullmatch(" ".join([first, name, *rest]), text)
        if match is None:
            continue
        pairs = zip(valid, match.groups(), strict=True)
        values: list[Any] = [int(word) if isinstance(each, range) else word for each, word in pairs]
        if any(isinstance(each, range) and value not in each for each, value in zip(valid, values, strict=True)):
            continue
        if kind in (Set, State):
            values[1 : 1 + CHANNELS] = [tuple(values[1 : 1 + CHANNELS])]
        if kind is Refused:
            values[1] = Code(values[1])
        return kind(*values)
    return None


class EmulatedController:
    """An emulated LED controller without a clock: each call passes the time. Tests compare it with the firmware."""

    def __init__(self, *, now_s: float = 0.0, boot: int = 1, serial_number: str = "EMULATED"):
        """Boot the controller for the `boot`-th time with all lights off, at the time `now_s` of the caller's clock."""
        self.levels = DARK  # levels that are applied now
        self.counter = 0  # number of changes of the levels since the boot
        self.boot = boot
        self.watch_ms = DEFAULT_WATCH_MS  # period of the watchdog (ms)
        self._serial_number = serial_number
        self._boot_s = self._valid_s = now_s  # times of the boot and of the last valid request (s)
        self._pending = b""  # bytes of an incomplete line
        self._answered: tuple[bytes, bytes] | None = None  # the last request that was executed, and its answer

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Process any number of bytes from the host, and return the lines that the controller sends."""
        sent = self.tick(now_s)
        *lines, self._pending = (self._pending + data).split(b"\n")
        self._pending = self._pending[:LONGEST_LINE]  # enough to see that the line is too long
        return sent + b"".join(self._answer(line + b"\n", now_s) for line in lines if line)

    def tick(self, now_s: float) -> bytes:
        """Turn the lights off if the watchdog's period has passed, and return the line that reports it."""
        if self.levels == DARK or now_s - self._valid_s < self.watch_ms / 1000:
            return b""
        self._apply(DARK)
        return encode_reply(TurnedOff(0, self.counter))

    def _answer(self, line: bytes, now_s: float) -> bytes:
        """The reply to one line. A repeated line gets the same reply again and is not executed."""
        if self._answered is not None and line == self._answered[0]:
            self._valid_s = now_s
            return self._answered[1]
        try:
            reply = encode_reply(self._execute(decode_request(line), now_s))
        except ProtocolError as error:
            text = f"protocol {VERSION}" if error.code is Code.VERSION else error.code.name.lower()
            return encode_reply(Refused(error.sequence, error.code, text))
        self._valid_s = now_s
        self._answered = line, reply
        return reply

    def _execute(self, request: Request, now_s: float) -> Reply:
        match request:
            case Hello(sequence, version):
                if version != VERSION:
                    raise ProtocolError(f"unknown version {version}", Code.VERSION, sequence)
                return Controller(sequence, VERSION, "emulated", "emulation", self._serial_number, CHANNELS)
            case Set(sequence, levels):
                self._apply(levels)
                return State(sequence, self.levels, self.counter, self.boot)
            case Ping(sequence):
                uptime_ms = int(1000 * (now_s - self._boot_s)) % 2**32
                return State(sequence, self.levels, self.counter, self.boot, uptime_ms)
            case Watch(sequence, period_ms):
                self.watch_ms = period_ms
                return request

    def _apply(self, levels: Levels) -> None:
        if levels != self.levels:
            self.levels = levels
            self.counter += 1
