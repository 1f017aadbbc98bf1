"""The serial protocol of the LED controller: messages as dataclasses, and their encoding as lines of text.

A line consists of ASCII text, `*`, the checksum of the text in four hexadecimal digits, and a newline. For example,
`7 PING*018E` is a request with the sequence number 7. The host sends requests, and the controller answers each request
with one reply of the same sequence number. The page docs/hardware/protocol.md defines the requests and the replies.

Parsing is strict: each message has exactly one valid line. Any other line raises a `ProtocolError`.
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

Levels = tuple[int, int, int, int]  # duty cycles of the channels, 0 (off) to 255 (always on)
DARK: Levels = (0, 0, 0, 0)


class Code(enum.IntEnum):
    """The reason why the LED controller refused a request, such as a wrong checksum or an unknown command."""

    CHECKSUM = 1  # the checksum of the line is wrong
    COMMAND = 2  # there is no such command
    ARGUMENTS = 3  # the arguments are too few, too many or out of range
    VERSION = 4  # the host uses another version of the protocol
    LENGTH = 5  # the line is longer than `LONGEST_LINE`


class ProtocolError(ValueError):
    """Raised for a line that is not a valid message of the LED controller's protocol. The error's text shows the line.

    Attributes:
        code: Error code that a controller sends in its reply to this line.
        sequence: Sequence number of that reply.
    """

    def __init__(self, message: str, code: Code = Code.CHECKSUM, sequence: int = 0):
        super().__init__(message)
        self.code = code
        self.sequence = sequence


@dataclasses.dataclass(frozen=True)
class Hello:
    """Request for the description of the controller. The reply is a `Controller` message."""

    sequence: int
    version: int = VERSION  # version of the protocol that the host uses


@dataclasses.dataclass(frozen=True)
class Set:
    """Request to set the levels of the lights. The reply is a `State` message."""

    sequence: int
    levels: Levels  # duty cycles of the channels, 0 (off) to 255 (always on)


@dataclasses.dataclass(frozen=True)
class Ping:
    """Request for the state of the lights. The reply is a `State` message.

    Like any request, it restarts the watchdog, which turns the lights off after a time without requests.
    """

    sequence: int


@dataclasses.dataclass(frozen=True)
class Watch:
    """Request to set the watchdog's period. The reply is a `Watching` message.

    The watchdog turns the lights off if the controller receives no request during this period.
    """

    sequence: int
    period_ms: int  # the lights go off after this time without a request, 100 to 10000 (ms)


@dataclasses.dataclass(frozen=True)
class Controller:
    """The reply to a `Hello` request. It describes the controller."""

    sequence: int
    version: int  # version of the protocol that the controller uses
    firmware: str  # version of the firmware
    board: str  # name of the board
    serial_number: str  # serial number of the controller
    channels: int  # number of channels


@dataclasses.dataclass(frozen=True)
class State:
    """The reply to a `Set` or `Ping` request. It describes the state of the lights."""

    sequence: int
    levels: Levels  # duty cycles that are applied at the time of the reply
    counter: int  # number of changes of the levels since the boot
    boot: int  # number of the boot, 0 to 65535
    uptime_ms: int | None = None  # time since the boot (ms). None in replies to `Set`


@dataclasses.dataclass(frozen=True)
class Watching:
    """The reply to a `Watch` request: the controller will turn the lights off after `period_ms` without requests."""

    sequence: int
    period_ms: int  # the lights go off after this time without a request (ms)


@dataclasses.dataclass(frozen=True)
class Refused:
    """The reply to a request that the controller did not execute. It gives the reason."""

    sequence: int  # 0 if the controller could not read the request's sequence number
    code: Code  # reason for the refusal
    text: str  # the reason in words


@dataclasses.dataclass(frozen=True)
class TurnedOff:
    """Line that the controller sends without a request: the watchdog has turned the lights off."""

    counter: int  # number of changes of the levels since the boot, this one included


Request = Hello | Set | Ping | Watch
Reply = Controller | State | Watching | Refused | TurnedOff


def checksum(text: bytes) -> int:
    """Return the CRC-16/CCITT-FALSE of a text: polynomial 0x1021, initial value 0xFFFF, not reflected, not inverted."""
    return binascii.crc_hqx(text, 0xFFFF)


def encode(text: str) -> bytes:
    """Append the checksum and the newline to a text.

    Args:
        text: Printable ASCII without `*`.

    Returns:
        The line, at most 64 bytes (`LONGEST_LINE`).

    Raises:
        ProtocolError: The text is empty, contains `*` or a character that is not printable ASCII, or is too long.
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
    """Check the checksum of a line, and return the text before the checksum.

    Args:
        line: The whole line, with its newline.

    Raises:
        ProtocolError: The line is longer than 64 bytes (`LONGEST_LINE`), contains other bytes than printable ASCII,
            lacks the checksum or the newline, or has a wrong checksum.
    """
    if len(line) > LONGEST_LINE:
        raise ProtocolError(
            f"a line must have at most {LONGEST_LINE} bytes, got {len(line)}: {line!r}. The sender must shorten it.",
            Code.LENGTH,
        )
    found = re.fullmatch(rb"([ -)+-~]+)\*([0-9A-F]{4})\n", line)
    if found is None:
        raise ProtocolError(f"a line must consist of a text, '*', four hexadecimal digits and a newline, got {line!r}")
    text, digits = found.groups()
    if int(digits, 16) != checksum(text):
        raise ProtocolError(
            f"the checksum of the text is {checksum(text):04X}, but the line has {digits.decode()}: {line!r}. Send the "
            "line again, because it was probably damaged on its way."
        )
    return text.decode()


def encode_request(request: Request) -> bytes:
    """Encode a request as a line with its checksum and newline.

    Raises:
        ProtocolError: A value of the request is out of range.
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
    """Decode a request from a line.

    Args:
        line: The whole line, with its checksum and newline.

    Raises:
        ProtocolError: The line is not a valid request. A controller answers such a line with a `Refused` reply. The
            attributes `code` and `sequence` of the error are those of this reply.
    """
    text = decode(line)
    words = text.split(" ")
    sequence = _number(words[0], 1, LAST_SEQUENCE)
    if sequence is None:
        raise ProtocolError(
            f"the sequence number must be in 1..{LAST_SEQUENCE}, got {words[0]!r} in the line {line!r}", Code.ARGUMENTS
        )
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
                f"the line {line!r} has a wrong number of arguments or an argument that is out of range: HELLO needs "
                f"a version in 0..65535, SET needs {CHANNELS} levels in 0..255, PING needs no arguments, and WATCH "
                f"needs a period in {SHORTEST_WATCH_MS}..{LONGEST_WATCH_MS} ms",
                Code.ARGUMENTS,
                sequence,
            )
    raise ProtocolError(
        f"the command in the line {line!r} is unknown: it must be HELLO, SET, PING or WATCH", Code.COMMAND, sequence
    )


def encode_reply(reply: Reply) -> bytes:
    """Encode a reply as a line with its checksum and newline.

    Raises:
        ProtocolError: A value of the reply is out of range.
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
    """Decode a reply from a line.

    Args:
        line: The whole line, with its checksum and newline.

    Raises:
        ProtocolError: The line is not a valid reply.
    """
    found = _reply(decode(line).split(" "))
    if found is None:
        raise ProtocolError(
            f"the line {line!r} is not a reply of the LED controller's protocol: compare it with the replies in "
            "docs/hardware/protocol.md",
            Code.ARGUMENTS,
        )
    return found


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


_UINT32 = 2**32 - 1


def _controller(sequence: int, values: list[str]) -> Controller | None:
    """Decode the reply to HELLO. In all versions of the protocol, its first value is the version."""
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
    """A decimal number without sign and leading zeros, or None if the word is not one or is out of range."""
    if not re.fullmatch(r"0|[1-9][0-9]{0,9}", word):
        return None
    return int(word) if smallest <= int(word) <= largest else None


def _joined(levels: Levels) -> str:
    return " ".join(str(level) for level in levels)
