"""Simulated faults of the twin's camera, LED controller and connections, to test the programs that use a sensor."""

import dataclasses
import math

IMAGE_KINDS = ("repeat", "black", "resize")  # faults of single frames
DEVICE_KINDS = (*IMAGE_KINDS, "stall", "reboot")  # faults of the camera and the controller
LINE_KINDS = ("deaf", "lost", "late", "doubled", "garbled", "vanish")  # faults of the serial port
KINDS = (*DEVICE_KINDS, *LINE_KINDS, "drop")


@dataclasses.dataclass(frozen=True)
class Fault:
    """One simulated fault of the camera, the LED controller or a connection.

    The effect depends on the field `kind`. `count` and `seconds` in the table are the other two fields.

    | kind | effect |
    |---|---|
    | `stall` | the camera delivers no frame for `seconds` |
    | `repeat` | the last frame is delivered again, `count` times |
    | `black` | `count` frames are black |
    | `resize` | `count` frames have half the width and height |
    | `deaf` | `count` requests do not reach the LED controller |
    | `lost` | `count` answers of the LED controller are lost |
    | `late` | `count` answers of the LED controller are sent `seconds` later |
    | `doubled` | `count` answers of the LED controller are sent twice |
    | `garbled` | one bit is flipped in each of `count` answers of the LED controller |
    | `drop` | all connections to the camera are closed |
    | `vanish` | the serial port vanishes and returns after `seconds` |
    | `reboot` | the LED controller restarts: the lights go off, and its count of boots increases |
    """

    kind: str  # one of the kinds in the table
    count: int = 1  # number of affected frames, requests or answers, >= 1
    seconds: float = 1.0  # duration of the kinds `stall`, `late` and `vanish`, >= 0 (s)

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            ValueError: The kind is unknown, or `count` or `seconds` is out of range.
        """
        if self.kind not in KINDS:
            raise ValueError(f"kind must be one of {', '.join(KINDS)}, got {self.kind!r}")
        if self.count < 1:
            raise ValueError(f"count must be >= 1, got {self.count}")
        if not 0 <= self.seconds < math.inf:
            raise ValueError(f"seconds must be >= 0 and finite, got {self.seconds}")


class Queue:
    """Queue of the faults that a twin (a simulated sensor) has not simulated yet. The queue is not thread-safe."""

    def __init__(self) -> None:
        self._waiting: list[Fault] = []

    def add(self, fault: Fault) -> None:
        """Append a fault to the queue. `fault.count` is the number of copies that are appended."""
        self._waiting += [fault] * fault.count

    def take(self, *kinds: str) -> Fault | None:
        """Remove and return the oldest fault of one of the given kinds, or of any kind if no kind is given.

        Returns:
            The fault, or None if the queue contains no such fault.
        """
        for i, fault in enumerate(self._waiting):
            if not kinds or fault.kind in kinds:
                return self._waiting.pop(i)
        return None


def garble(line: bytes) -> bytes:
    """Return a line of the LED protocol with one bit flipped, so that its checksum is wrong."""
    middle = len(line) // 2
    return line[:middle] + bytes([line[middle] ^ 1]) + line[middle + 1 :]
