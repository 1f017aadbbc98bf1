"""The serial protocol of the LED controller: messages as dataclasses, and their lines.

A line is ASCII text, `*`, the checksum of the text in four hexadecimal digits, and a newline: `7 PING*018E`. The
host sends requests, and the controller answers each with one reply of the same sequence number. The documentation's
page on the protocol defines both.

Parsing is strict: each message has exactly one valid line. Any other line raises a `ProtocolError`.
"""

import binascii
import dataclasses
import enum
import re

VERSION = 1  # of the protocol
BAUD = 115200  # 8 data bits, no parity, 1 stop bit
CHANNELS = 4
LONGEST_LINE = 64  # bytes, with the newline
LAST_SEQUENCE = 65535  # 1 follows. 0 belongs to lines of the controller that answer no request
SHORTEST_WATCH_MS = 100
LONGEST_WATCH_MS = 10_000
DEFAULT_WATCH_MS = 1000

Levels = tuple[int, int, int, int]  # duty cycles of the channels, 0 (off) to 255 (always on)
DARK: Levels = (0, 0, 0, 0)


class Code(enum.IntEnum):
    """The reason for which the controller refused a request."""

    CHECKSUM = 1  # the line is damaged
    COMMAND = 2  # there is no such command
    ARGUMENTS = 3  # too few, too many or out of range
    VERSION = 4  # the host speaks another version of the protocol
    LENGTH = 5  # the line is longer than `LONGEST_LINE`


class ProtocolError(ValueError):
    """A line that is not a message of the protocol. The error's message names the line.

    Attributes:
        code: The error code with which a controller answers this line.
        sequence: The sequence number of that answer.
    """

    def __init__(self, message: str, code: Code = Code.CHECKSUM, sequence: int = 0):
        super().__init__(message)
        self.code = code
        self.sequence = sequence


@dataclasses.dataclass(frozen=True)
class Hello:
    """Request for the controller's description."""

    sequence: int
    version: int = VERSION  # of the protocol that the host speaks


@dataclasses.dataclass(frozen=True)
class Set:
    """Request for new levels."""

    sequence: int
    levels: Levels


@dataclasses.dataclass(frozen=True)
class Ping:
    """Request for the state. It keeps the lights on."""

    sequence: int


@dataclasses.dataclass(frozen=True)
class Watch:
    """Request for another period of the watchdog."""

    sequence: int
    period_ms: int


@dataclasses.dataclass(frozen=True)
class Controller:
    """Reply to `Hello`."""

    sequence: int
    version: int  # of the protocol that the controller speaks
    firmware: str  # the firmware's own version
    board: str
    serial_number: str
    channels: int


@dataclasses.dataclass(frozen=True)
class State:
    """Reply to `Set` and `Ping`."""

    sequence: int
    levels: Levels  # applied now
    counter: int  # changes of the levels since the boot
    boot: int  # number of the boot, 0 to 65535
    uptime_ms: int | None = None  # time since the boot, in replies to `Ping` only


@dataclasses.dataclass(frozen=True)
class Watching:
    """Reply to `Watch`."""

    sequence: int
    period_ms: int


@dataclasses.dataclass(frozen=True)
class Refused:
    """Reply to a request that was not executed."""

    sequence: int
    code: Code
    text: str


@dataclasses.dataclass(frozen=True)
class TurnedOff:
    """Unsolicited line: the watchdog turned the lights off."""

    counter: int


Request = Hello | Set | Ping | Watch
Reply = Controller | State | Watching | Refused | TurnedOff


def checksum(text: bytes) -> int:
    """CRC-16 with polynomial 0x1021 and initial value 0xFFFF, neither reflected nor inverted (CRC-16/CCITT-FALSE)."""
    return binascii.crc_hqx(text, 0xFFFF)


def encode(text: str) -> bytes:
    """The line of a text.

    Raises:
        ProtocolError: The text has other characters than printable ASCII, or `*`, or is too long.
    """
    if not re.fullmatch(r"[ -)+-~]+", text):
        raise ProtocolError(f"a message must consist of printable ASCII without '*', got {text!r}", Code.ARGUMENTS)
    line = f"{text}*{checksum(text.encode()):04X}\n".encode()
    if len(line) > LONGEST_LINE:
        raise ProtocolError(
            f"a line must have at most {LONGEST_LINE} bytes, got {len(line)}: {text!r}. Shorten the text.", Code.LENGTH
        )
    return line


def decode(line: bytes) -> str:
    """The text of a line.

    Raises:
        ProtocolError: The line is too long, has no newline at its end, has other bytes than printable ASCII, or its
            checksum differs.
    """
    if len(line) > LONGEST_LINE:
        raise ProtocolError(
            f"line has {len(line)} bytes, but at most {LONGEST_LINE} are allowed: {line!r}", Code.LENGTH
        )
    found = re.fullmatch(rb"([ -)+-~]+)\*([0-9A-F]{4})\n", line)
    if found is None:
        raise ProtocolError(f"not a line of the protocol: {line!r}")
    text, digits = found.groups()
    if int(digits, 16) != checksum(text):
        raise ProtocolError(f"checksum is {checksum(text):04X}, but the line has {digits.decode()}: {line!r}")
    return text.decode()


def encode_request(request: Request) -> bytes:
    """The line of a request.

    Raises:
        ProtocolError: A value is out of its range.
    """
    match request:
        case Hello(sequence, version):
            text = f"{sequence} HELLO {version}"
        case Set(sequence, levels):
            text = f"{sequence} SET {_joined(levels)}"
        case Ping(sequence):
            text = f"{sequence} PING"
        case Watch(sequence, period_ms):
            text = f"{sequence} WATCH {period_ms}"
    line = encode(text)
    decode_request(line)  # checks the ranges
    return line


def decode_request(line: bytes) -> Request:
    """The request of a line.

    Raises:
        ProtocolError: The line is not a request. `code` and `sequence` are those of the controller's answer.
    """
    text = decode(line)
    words = text.split(" ")
    sequence = _number(words[0], 1, LAST_SEQUENCE)
    if sequence is None:
        raise ProtocolError(f"sequence number must be in 1..{LAST_SEQUENCE}: {line!r}", Code.ARGUMENTS)
    match words[1:]:
        case ["HELLO", version] if (number := _number(version, 0, 65535)) is not None:
            return Hello(sequence, number)
        case ["SET", *values] if (levels := _levels(values)) is not None:
            return Set(sequence, levels)
        case ["PING"]:
            return Ping(sequence)
        case ["WATCH", period] if (number := _number(period, SHORTEST_WATCH_MS, LONGEST_WATCH_MS)) is not None:
            return Watch(sequence, number)
        case ["HELLO" | "SET" | "PING" | "WATCH", *_]:
            raise ProtocolError(
                f"the arguments are missing, superfluous or out of range: {line!r}", Code.ARGUMENTS, sequence
            )
    raise ProtocolError(f"unknown command: {line!r}", Code.COMMAND, sequence)


def encode_reply(reply: Reply) -> bytes:
    """The line of a reply.

    Raises:
        ProtocolError: A value is out of its range.
    """
    match reply:
        case Controller(sequence, version, firmware, board, serial_number, channels):
            text = f"{sequence} OK HELLO {version} {firmware} {board} {serial_number} {channels}"
        case State(sequence, levels, counter, boot, None):
            text = f"{sequence} OK SET {_joined(levels)} {counter} {boot}"
        case State(sequence, levels, counter, boot, uptime_ms):
            text = f"{sequence} OK PING {_joined(levels)} {counter} {boot} {uptime_ms}"
        case Watching(sequence, period_ms):
            text = f"{sequence} OK WATCH {period_ms}"
        case Refused(sequence, code, words):
            text = f"{sequence} ERR {int(code)} {words}"
        case TurnedOff(counter):
            text = f"0 OFF watchdog {counter}"
    line = encode(text)
    decode_reply(line)  # checks the ranges
    return line


def decode_reply(line: bytes) -> Reply:
    """The reply of a line.

    Raises:
        ProtocolError: The line is not a reply.
    """
    found = _reply(decode(line).split(" "))
    if found is None:
        raise ProtocolError(f"not a reply of the protocol: {line!r}", Code.ARGUMENTS)
    return found


def _reply(words: list[str]) -> Reply | None:
    sequence = _number(words[0], 0, LAST_SEQUENCE)
    match words[1:]:
        case ["OFF", "watchdog", counter] if sequence == 0 and (changes := _number(counter, 1, _UINT32)) is not None:
            return TurnedOff(changes)
        case ["ERR", code, *text] if sequence is not None and (number := _number(code, 1, len(Code))) and any(text):
            return Refused(sequence, Code(number), " ".join(text))
    if not sequence:
        return None
    match words[1:]:
        case ["OK", "HELLO", *values]:
            return _controller(sequence, values)
        case ["OK", "SET", *values] if len(values) == CHANNELS + 2:
            return _state(sequence, values, timed=False)
        case ["OK", "PING", *values] if len(values) == CHANNELS + 3:
            return _state(sequence, values, timed=True)
        case ["OK", "WATCH", period] if (number := _number(period, SHORTEST_WATCH_MS, LONGEST_WATCH_MS)) is not None:
            return Watching(sequence, number)
    return None


_UINT32 = 2**32 - 1


def _controller(sequence: int, values: list[str]) -> Controller | None:
    """The reply to HELLO. All versions of the protocol begin it with the version."""
    version = _number(values[0], 0, 65535) if values else None
    if version is None:
        return None
    if version != VERSION:
        return Controller(sequence, version, "unknown", "unknown", "unknown", 0)
    match values[1:]:
        case [firmware, board, serial_number, count] if _number(count, CHANNELS, CHANNELS) is not None:
            if all(re.fullmatch(r"[A-Za-z0-9._-]+", name) for name in (firmware, board, serial_number)):
                return Controller(sequence, version, firmware, board, serial_number, CHANNELS)
    return None


def _state(sequence: int, values: list[str], *, timed: bool) -> State | None:
    levels = _levels(values[:CHANNELS])
    counter, boot = _number(values[CHANNELS], 0, _UINT32), _number(values[CHANNELS + 1], 0, 65535)
    uptime_ms = _number(values[CHANNELS + 2], 0, _UINT32) if timed else None
    if levels is None or counter is None or boot is None or (timed and uptime_ms is None):
        return None
    return State(sequence, levels, counter, boot, uptime_ms)


def _levels(words: list[str]) -> Levels | None:
    if len(words) != CHANNELS:
        return None
    first, second, third, fourth = (_number(word, 0, 255) for word in words)
    if first is None or second is None or third is None or fourth is None:
        return None
    return first, second, third, fourth


def _number(word: str, smallest: int, largest: int) -> int | None:
    """A decimal number without sign and leading zeros, or None if it is not one of the range."""
    if not re.fullmatch(r"0|[1-9][0-9]{0,9}", word):
        return None
    return int(word) if smallest <= int(word) <= largest else None


def _joined(levels: Levels) -> str:
    return " ".join(str(level) for level in levels)
