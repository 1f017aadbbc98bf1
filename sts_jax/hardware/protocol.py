"""The serial protocol of the LED controller: messages as dataclasses, and their encoding as lines of text.

A line consists of ASCII text, `*`, the checksum of the text in four hexadecimal digits, and a newline, such as
`7 PING*018E`. The host sends requests, and the controller answers each with one reply of the same sequence number.
docs/hardware/protocol.md defines them. Each message has exactly one valid line. Any other line is a `ProtocolError`.
"""

import binascii
import dataclasses
import enum
import re

VERSION = 1  # version of the protocol
BAUD = 115200  # 8 data bits, no parity, 1 stop bit
CHANNELS = 4  # lights of the sensor that are controlled separately
LONGEST_LINE = 64  # bytes, with the newline
LAST_SEQUENCE = 65535  # largest sequence number. 1 follows it. 0 marks replies to no particular request
SHORTEST_WATCH_MS = 100  # shortest period of the watchdog (ms)
LONGEST_WATCH_MS = 10_000  # longest period of the watchdog (ms)
DEFAULT_WATCH_MS = 1000  # period of the watchdog after a boot (ms)
_UINT16, _UINT32 = 2**16 - 1, 2**32 - 1

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
        self.code = code
        self.sequence = sequence


@dataclasses.dataclass(frozen=True)
class Hello:
    """Request for the description of the controller (`Controller`)."""

    sequence: int
    version: int = VERSION  # version of the protocol that the host uses


@dataclasses.dataclass(frozen=True)
class Set:
    """Request to set the levels of the lights (`State`)."""

    sequence: int
    levels: Levels


@dataclasses.dataclass(frozen=True)
class Ping:
    """Request for the state of the lights (`State`). Like any request, it restarts the watchdog."""

    sequence: int


@dataclasses.dataclass(frozen=True)
class Watch:
    """Request to set the watchdog's period (`Watching`)."""

    sequence: int
    period_ms: int  # the lights go off after this time without a request, 100 to 10000 (ms)


@dataclasses.dataclass(frozen=True)
class Controller:
    """The reply to a `Hello` request."""

    sequence: int
    version: int  # version of the protocol that the controller uses
    firmware: str  # version of the firmware
    board: str  # name of the board
    serial_number: str  # serial number of the controller
    channels: int  # number of channels


@dataclasses.dataclass(frozen=True)
class State:
    """The reply to a `Set` or `Ping` request."""

    sequence: int
    levels: Levels  # duty cycles that are applied at the time of the reply
    counter: int  # number of changes of the levels since the boot
    boot: int  # number of the boot, 0 to 65535
    uptime_ms: int | None = None  # time since the boot (ms). None in replies to `Set`


@dataclasses.dataclass(frozen=True)
class Watching:
    """The reply to a `Watch` request."""

    sequence: int
    period_ms: int


@dataclasses.dataclass(frozen=True)
class Refused:
    """The reply to a request that the controller did not execute."""

    sequence: int  # 0 if the controller could not read the request's sequence number
    code: Code
    text: str  # the reason in words


@dataclasses.dataclass(frozen=True)
class TurnedOff:
    """Line that the controller sends without a request: the watchdog has turned the lights off."""

    counter: int  # number of changes of the levels since the boot, this one included


Request = Hello | Set | Ping | Watch
Reply = Controller | State | Watching | Refused | TurnedOff


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
    """Decode a request from a line with its checksum and newline."""
    words = decode(line).split(" ")
    sequence = _number(words[0], 1, LAST_SEQUENCE)
    if sequence is None:
        raise ProtocolError(f"the sequence number of {line!r} must be in 1..{LAST_SEQUENCE}", Code.ARGUMENTS)
    match words[1:]:
        case ["HELLO", version] if (number := _number(version, 0, _UINT16)) is not None:
            return Hello(sequence, number)
        case ["SET", *values] if (levels := _levels(values)) is not None:
            return Set(sequence, levels)
        case ["PING"]:
            return Ping(sequence)
        case ["WATCH", period] if (number := _number(period, SHORTEST_WATCH_MS, LONGEST_WATCH_MS)) is not None:
            return Watch(sequence, number)
        case ["HELLO" | "SET" | "PING" | "WATCH", *_]:
            raise ProtocolError(f"wrong number or range of arguments in {line!r}", Code.ARGUMENTS, sequence)
    raise ProtocolError(f"unknown command in {line!r}", Code.COMMAND, sequence)


def encode_reply(reply: Reply) -> bytes:
    """Encode a reply as a line with its checksum and newline."""
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
    """Decode a reply from a line with its checksum and newline."""
    reply = _reply(decode(line).split(" "))
    if reply is None:
        raise ProtocolError(f"the line {line!r} is not a reply of the LED controller's protocol", Code.ARGUMENTS)
    return reply


def _reply(words: list[str]) -> Reply | None:
    """The reply that consists of these words, or None if they are not a valid reply."""
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


def _controller(sequence: int, values: list[str]) -> Controller | None:
    """Decode the reply to HELLO. In all versions of the protocol, its first value is the version."""
    version = _number(values[0], 0, _UINT16) if values else None
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
    counter, boot = _number(values[CHANNELS], 0, _UINT32), _number(values[CHANNELS + 1], 0, _UINT16)
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
    """A decimal number without sign and leading zeros, or None if the word is not one or is out of range."""
    if not re.fullmatch(r"0|[1-9][0-9]{0,9}", word):
        return None
    return int(word) if smallest <= int(word) <= largest else None


def _joined(levels: Levels) -> str:
    return " ".join(str(level) for level in levels)
