"""The twin's own log: the truth about each frame."""

import contextlib
import dataclasses
import json
import os
import threading
from pathlib import Path
from typing import Any, BinaryIO, TextIO


@dataclasses.dataclass(frozen=True)
class Exposure:
    """The truth about one frame. Times are seconds of the twin's clock, which is `time.monotonic` when it is served."""

    index: int  # number of the frame, from 0
    start_s: float  # begin of the exposure
    end_s: float  # end of the exposure
    due_s: float  # time of delivery. A busy machine delivers later
    light: float  # share of the LEDs' power during the exposure: mean
    lowest: float  # lowest
    highest: float  # and highest value
    phase: str  # of the scene in the middle of the exposure: empty, held, moving or still
    trajectory: int  # number of the trajectory, or -1 before the first
    frame: int  # index of the drawn pose in the trajectory
    pose: tuple[float, ...] | None  # mesh frame in the sensor frame (m, quaternion)
    fault: str | None = None  # repeat, black or resize. The other fields of a repeated frame are those of its original


class Log:
    """Writes one JSON line for each frame, and optionally the JPEG of each frame into one motion JPEG file."""

    def __init__(self, path: str | os.PathLike | None, record: str | os.PathLike | None):
        """Create the files.

        Args:
            path: Of the JSON lines, None: not written.
            record: Of the motion JPEG file with the same frames in the same order, None: not written.

        Raises:
            OSError: A file cannot be written.
        """
        self._lock = threading.Lock()
        self._lines: TextIO | None = None
        self._jpegs: BinaryIO | None = None
        with contextlib.ExitStack() as files:
            if path is not None:
                self._lines = files.enter_context(Path(path).open("w", buffering=1))
            if record is not None:
                self._jpegs = files.enter_context(Path(record).open("wb", buffering=0))
            self._files = files.pop_all()  # all are open

    def write(self, exposure: Exposure, jpeg: bytes) -> None:
        """Write one frame. Both files are complete up to this frame afterwards."""
        with self._lock:
            if self._jpegs is not None:
                self._jpegs.write(jpeg)
            if self._lines is not None:
                self._lines.write(json.dumps(dataclasses.asdict(exposure)) + "\n")

    def close(self) -> None:
        """Close the files."""
        with self._lock:
            self._files.close()
            self._lines = self._jpegs = None


def read_log(path: str | os.PathLike) -> list[Exposure]:
    """The frames of a log, in order. A line that is still being written is left out."""
    text = Path(path).read_text()
    rows: list[dict[str, Any]] = [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]
    return [Exposure(**row | {"pose": None if row["pose"] is None else tuple(row["pose"])}) for row in rows]
