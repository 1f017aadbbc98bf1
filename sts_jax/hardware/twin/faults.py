"""Faults of the twin's camera, LED controller and connections, for tests of a host."""

import dataclasses
import math

IMAGE_KINDS = ("repeat", "black", "resize")  # of single frames
DEVICE_KINDS = (*IMAGE_KINDS, "stall", "reboot")  # of camera and controller
LINE_KINDS = ("deaf", "lost", "late", "doubled", "garbled", "vanish")  # of the serial port
KINDS = (*DEVICE_KINDS, *LINE_KINDS, "drop")


@dataclasses.dataclass(frozen=True)
class Fault:
    """One fault.

    | kind | effect |
    |---|---|
    | `stall` | the camera delivers no frame for `seconds` |
    | `repeat` | the last frame is delivered again, `count` times |
    | `black` | `count` frames are black |
    | `resize` | `count` frames have half the width and height |
    | `deaf` | `count` requests do not reach the LED controller |
    | `lost` | `count` answers of the LED controller are lost |
    | `late` | `count` answers come `seconds` later |
    | `doubled` | `count` answers come twice |
    | `garbled` | a bit of each of `count` answers is flipped |
    | `drop` | all connections to the camera are closed |
    | `vanish` | the serial port vanishes and returns after `seconds` |
    | `reboot` | the LED controller restarts: its lights are off, and its boot number increases |
    """

    kind: str
    count: int = 1  # frames, requests or answers
    seconds: float = 1.0  # s

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: The kind is unknown, or a number is out of range.
        """
        if self.kind not in KINDS:
            raise ValueError(f"kind must be one of {', '.join(KINDS)}, got {self.kind!r}")
        if self.count < 1:
            raise ValueError(f"count must be >= 1, got {self.count}")
        if not 0 <= self.seconds < math.inf:
            raise ValueError(f"seconds must be >= 0 and finite, got {self.seconds}")


class Queue:
    """Faults that wait for their frame or answer. It is not thread-safe."""

    def __init__(self) -> None:
        self._waiting: list[Fault] = []

    def add(self, fault: Fault) -> None:
        """Append a fault, `count` times."""
        self._waiting += [fault] * fault.count

    def take(self, *kinds: str) -> Fault | None:
        """Remove and return the first fault of one of the kinds."""
        for i, fault in enumerate(self._waiting):
            if not kinds or fault.kind in kinds:
                return self._waiting.pop(i)
        return None


def garble(line: bytes) -> bytes:
    """The line with one flipped bit, which its checksum reveals."""
    middle = len(line) // 2
    return line[:middle] + bytes([line[middle] ^ 1]) + line[middle + 1 :]
