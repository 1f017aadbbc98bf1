"""Runs a digital twin of the sensor in another process, and repeatedly holds and releases the simulated object."""

import contextlib
import json
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path

from experiments.shared import commissioning

SIZE = (640, 480)  # width and height of the images (pixels)
FIELD_OF_VIEW = 160.0  # field of view across the diagonal (degrees)
HELD_S = 6.0  # time for which the object is held (s)
FREE_S = 6.0  # time for which the object moves and rests after its release (s)
_ENDED_S = 10.0  # time within which the process ends by itself, before it is killed (s)
_ANSWER_S = 120.0  # longest wait for an answer of the twin, which may render images first (s)


class OwnTwin:
    """A digital twin of the sensor that runs in another process. The function `own_twin` starts and stops the twin."""

    def __init__(self, folder: Path, leds: Path, url: str):
        """Use `own_twin` instead.

        Args:
            folder: Folder with the twin's sensor file.
            leds: Serial port of the twin's LED controller.
            url: URL of the twin's HTTP server.
        """
        self.folder, self.leds = folder, str(leds)
        self.note = ""  # remark on the state of the object
        self._url = url
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._operate, name="hand", daemon=True)

    def start(self) -> None:
        """Start a thread that holds and releases the simulated object repeatedly."""
        self._thread.start()

    def close(self) -> None:
        """Stop the thread that holds and releases the simulated object. The digital twin itself keeps running."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _operate(self) -> None:
        while not self._stop.is_set():
            for command, seconds, note in (
                ("hold", HELD_S, "a hand holds the object"),
                ("release", FREE_S, "the hand has let go"),
            ):
                with contextlib.suppress(OSError):  # the twin may have ended
                    self.phase(command)
                self.note = note
                if self._stop.wait(seconds):
                    return

    def phase(self, command: str) -> dict[str, object]:
        """Send a command to the digital twin of the sensor, and return the state of the twin after the command.

        Args:
            command: `hold` holds an object on the pad, `release` lets it go, and `clear` takes it away.
        """
        request = urllib.request.Request(f"{self._url}/{command}", method="POST")
        with urllib.request.urlopen(request, timeout=_ANSWER_S) as answer:
            return json.load(answer)


@contextlib.contextmanager
def own_twin(folder: Path, *, seed: int = 0) -> Iterator[OwnTwin]:
    """Start a digital twin of the sensor in another process, and stop the twin at the end of the `with` block.

    Before the block, `commissioning.commission` writes the sensor file of the twin.

    Args:
        folder: Empty folder, which receives the sensor file and a link to the twin's virtual serial port.
        seed: Seed of the object and its trajectories.

    Raises:
        RuntimeError: The twin does not start.
    """
    leds = folder / "leds"
    command = [sys.executable, "-m", "experiments.twin", "--attached", "--port", str(leds), "--seed", str(seed)]
    command += ["--resolution", str(SIZE[1]), str(SIZE[0]), "--field-of-view", str(FIELD_OF_VIEW)]
    pipe = subprocess.PIPE
    # Ctrl-C must not reach the twin, because it has to run until this process has stopped reading its images. If this
    # process ends, the pipe is closed, and the twin stops by itself.
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, start_new_session=True) as process:
        try:
            url = _address(process)
            commissioning.commission(
                commissioning.Config(
                    camera=f"{url}/camera",
                    leds=str(leds),
                    out=folder,
                    width=SIZE[0],
                    height=SIZE[1],
                    ideal_lens=FIELD_OF_VIEW,
                    every=0.0,
                )
            )
            twin = OwnTwin(folder, leds, url)
            try:
                yield twin
            finally:
                twin.close()
        finally:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_ENDED_S)
            process.kill()


def _address(process: subprocess.Popen[str]) -> str:
    """Wait until a twin is ready, and return the URL that it prints."""
    assert process.stdout is not None
    url = ""
    for line in process.stdout:
        if line.startswith("camera:"):
            url = line.split()[1].removesuffix("/camera")
        if "Ctrl-C" in line:
            return url
    raise RuntimeError(
        "the digital twin did not start. Its error message is printed above. To reproduce it, run `python -m "
        "experiments.twin`"
    )
