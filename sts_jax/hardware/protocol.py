"""The serial protocol of the LED controller: messages as named tuples, and their encoding as lines of text.

A line consists of ASCII text, `*`, the checksum of the text in four hexadecimal digits, and a newline, such as
`7 PING*018E`. The host sends requests, and the controller answers each with one reply of the same sequence number.
docs/hardware/protocol.md defines them. Each message has exactly one valid line. Any other line is a `ProtocolError`.
"""

import binascii
import contextlib
import enum
import re
from collections.abc import Iterable
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

_UINT16, _UINT32 = range(2**16), range(2**32)
_VERSION, _CHANNELS = range(VERSION, VERSION + 1), range(CHANNELS, CHANNELS + 1)
_LEVELS = (range(256),) * CHANNELS
_PERIOD = range(SHORTEST_WATCH_MS, LONGEST_WATCH_MS + 1)
_NUMBERED = range(1, LAST_SEQUENCE + 1)
_NAME = re.compile(r"[A-Za-z0-9._-]+")
_TEXT = re.compile(r".*[^ ].*")  # may contain spaces, and is the last value of a line

# Class, words after the sequence number, sequence number and values of each message. A range contains the valid numbers
_REQUESTS: tuple[tuple[type, str, tuple], ...] = (
    (Hello, "HELLO", (_NUMBERED, _UINT16)),
    (Set, "SET", (_NUMBERED, _LEVELS)),
    (Ping, "PING", (_NUMBERED,)),
    (Watch, "WATCH", (_NUMBERED, _PERIOD)),
)
_REPLIES: tuple[tuple[type, str, tuple], ...] = (
    (Controller, "OK HELLO", (_NUMBERED, _VERSION, _NAME, _NAME, _NAME, _CHANNELS)),
    (State, "OK SET", (_NUMBERED, _LEVELS, _UINT32, _UINT16)),
    (State, "OK PING", (_NUMBERED, _LEVELS, _UINT32, _UINT16, _UINT32)),
    (Watch, "OK WATCH", (_NUMBERED, _PERIOD)),
    (Refused, "ERR", (range(LAST_SEQUENCE + 1), Code, _TEXT)),
    (TurnedOff, "OFF watchdog", (range(1), range(1, 2**32))),
)


def checksum(text: bytes) -> int:
    """CRC-16/CCITT-FALSE of a text: polynomial 0x1021, initial value 0xFFFF, not reflected, not inverted."""
    return binascii.crc_hqx(text, 0xFFFF)


def encode(text: str) -> bytes:
    """Append the checksum and the newline to a text of printable ASCII without `*`."""
    if not re.fullmatch(r"[ -)+-~]+", text):
        raise ProtocolError(f"a message must consist of printable ASCII without '*', got {text!r}", Code.ARGUMENTS)
    line = f"{text}*{checksum(text.encode()):04X}\n".encode()
    if len(line) > LONGEST_LINE:
        raise ProtocolError(f"a line must have at most {LONGEST_LINE} bytes, got {len(line)}: {text!r}", Code.LENGTH)
    return line


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
    try:
        number = _value(_NUMBERED, [sequence])
    except ValueError as error:
        raise ProtocolError(f"the sequence number of {line!r} must be in 1..65535", Code.ARGUMENTS) from error
    if words[:1] in [[name] for _, name, _ in _REQUESTS]:
        raise ProtocolError(f"wrong number or range of arguments in {line!r}", Code.ARGUMENTS, number)
    raise ProtocolError(f"unknown command in {line!r}", Code.COMMAND, number)


def encode_reply(reply: Reply) -> bytes:
    """Encode a reply as a line with its checksum and newline."""
    line = encode(_written(reply, _REPLIES))
    decode_reply(line)  # checks the ranges
    return line


def decode_reply(line: bytes) -> Reply:
    """Decode a reply from a line with its checksum and newline."""
    text = decode(line)
    reply = _read(text, _REPLIES)
    if reply is None and (other := re.fullmatch(r"([1-9][0-9]*) OK HELLO (0|[1-9][0-9]*)( .*)?", text)):
        # In all versions of the protocol, the first value of this reply is the version.
        sequence, version = int(other[1]), int(other[2])
        if sequence in _NUMBERED and version in _UINT16 and version != VERSION:
            return Controller(sequence, version)
    if reply is None:
        raise ProtocolError(f"the line {line!r} is not a reply of the LED controller's protocol", Code.ARGUMENTS)
    return reply


def _written(message: Request | Reply, table: tuple) -> str:
    """The text of a message: that of the row with its class and its number of values."""
    values = [value for value in message if value is not None]
    name = next(name for kind, name, ranges in table if isinstance(message, kind) and len(ranges) == len(values))
    return " ".join([str(values[0]), name, *_words(values[1:])])


def _words(values: Iterable[Any]) -> list[str]:
    return [word for value in values for word in (_words(value) if isinstance(value, tuple) else [f"{value}"])]


def _read(text: str, table: tuple) -> Any:
    """The message that has a text, or None."""
    for kind, name, ranges in table:
        sequence, *words = text.split(" ")
        names, words = words[: name.count(" ") + 1], [sequence, *words[name.count(" ") + 1 :]]
        with contextlib.suppress(ValueError, IndexError):
            values = [_value(valid, words) for valid in ranges]
            if names == name.split(" ") and not words:
                return kind(*values)
    return None


def _value(valid: Any, words: list[str]) -> Any:
    """Take the words of one value, and return the value. Any word that is not valid raises a `ValueError`."""
    if isinstance(valid, tuple):
        return tuple(_value(each, words) for each in valid)
    if valid is _TEXT:
        words[:] = [" ".join(words)]
    word = words.pop(0)
    if isinstance(valid, re.Pattern):
        if not valid.fullmatch(word):
            raise ValueError(word)
        return word
    # a number without sign and leading zeros
    if not re.fullmatch(r"0|[1-9][0-9]{0,9}", word) or (isinstance(valid, range) and int(word) not in valid):
        raise ValueError(word)
    return int(word) if isinstance(valid, range) else valid(int(word))
