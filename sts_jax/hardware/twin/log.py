"""The log of a `Twin` (a simulated sensor): a file with the ground truth of each camera frame."""

import contextlib
import dataclasses
import json
import os
import threading
from pathlib import Path
from typing import BinaryIO, TextIO

from sts_jax import storage


@dataclasses.dataclass(frozen=True)
class Exposure:
    """The ground truth of one frame of a `Twin` (a simulated sensor): times, light, pose of the object and fault.

    All times are on the twin's clock. If the twin runs in a server (class `Served`), this clock is `time.monotonic`. If
    the fault `repeat` delivers an earlier frame again, `index`, `due_s` and `fault` belong to the new delivery. All
    other fields are those of the earlier frame.
    """

    index: int  # number of the frame, from 0
    start_s: float  # begin of the exposure (s)
    end_s: float  # end of the exposure (s)
    due_s: float  # planned time of delivery (s). A busy machine delivers later
    light: float  # mean brightness of the LEDs during the exposure, as a share of their full power
    lowest: float  # smallest brightness during the exposure, as a share
    highest: float  # largest brightness during the exposure, as a share
    phase: str  # phase of the scene in the middle of the exposure: empty, held, moving or still
    trajectory: int  # number of the current or last trajectory, or -1 before the first one
    frame: int  # index of the rendered pose in the trajectory
    pose: tuple[float, ...] | None  # object's position (m) and quaternion (w, x, y, z), or None without an object
    fault: str | None = None  # simulated fault of the frame: repeat, black, resize or None


class Log:
    """Writes two files: the ground truth of each frame as a line of JSON, and all frames as motion JPEG."""

    def __init__(self, path: str | os.PathLike | None, record: str | os.PathLike | None):
        """Create the files.

        Args:
            path: Path of the file for the JSON lines. None: no such file.
            record: Path of the motion JPEG file, with the same frames in the same order. None: no such file.

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
            self._files = files.pop_all()  # keeps the files open after this block, because both could be opened

    def write(self, exposure: Exposure, jpeg: bytes) -> None:
        """Write the ground truth and the JPEG image of a frame. Other programs can read them immediately."""
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
    """Read the log file of a `Twin` (a simulated sensor).

    The twin may still be writing the file. An incomplete last line is ignored.

    Args:
        path: Path that `Twin` received as its argument `log`.

    Returns:
        The ground truth of the frames, in the order in which they were written.

    Raises:
        OSError: The file cannot be read.
    """
    text = Path(path).read_text()
    lines = text[: text.rfind("\n") + 1].splitlines()
    return [storage.decode(Exposure, json.loads(line), "frame") for line in lines]
