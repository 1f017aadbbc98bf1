"""A digital twin in a process of its own, commissioned, with a hand that holds and releases the object."""

import contextlib
import json
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path

from experiments import commission

SIZE = (640, 480)  # pixels, width and height
FIELD_OF_VIEW = 160.0  # degrees, across the diagonal
HELD_S = 6.0  # s, for which the object is held
FREE_S = 6.0  # s, for which it moves and rests
_ENDED_S = 10.0  # s, for the process to end by itself
_ANSWER_S = 120.0  # s, longest answer, which waits for rendering


class OwnTwin:
    """The running twin. `folder` has its sensor file."""

    def __init__(self, folder: Path, leds: Path, url: str):
        """Use `own_twin`."""
        self.folder, self.leds = folder, str(leds)
        self.note = ""  # on the object
        self._url = url
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._operate, name="hand", daemon=True)

    def start(self) -> None:
        """Let the hand begin."""
        self._thread.start()

    def close(self) -> None:
        """Stop the hand."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _operate(self) -> None:
        while not self._stop.is_set():
            for command, seconds, note in (
                ("hold", HELD_S, "a hand holds the object"),
                ("release", FREE_S, "the hand has let go"),
            ):
                with contextlib.suppress(OSError):  # the twin has ended
                    self.phase(command)
                self.note = note
                if self._stop.wait(seconds):
                    return

    def phase(self, command: str) -> dict[str, object]:
        """Give the twin a command, and return its state."""
        request = urllib.request.Request(f"{self._url}/{command}", method="POST")
        with urllib.request.urlopen(request, timeout=_ANSWER_S) as answer:
            return json.load(answer)


@contextlib.contextmanager
def own_twin(folder: Path, *, seed: int = 0) -> Iterator[OwnTwin]:
    """Start a twin, write its sensor file into a folder, and end it afterwards.

    Args:
        folder: An empty folder.
        seed: Of the object and its trajectories.

    Raises:
        RuntimeError: The twin does not start.
    """
    leds = folder / "leds"
    command = [sys.executable, "-m", "experiments.twin", "--attached", "--port", str(leds), "--seed", str(seed)]
    command += ["--resolution", str(SIZE[1]), str(SIZE[0]), "--field-of-view", str(FIELD_OF_VIEW)]
    pipe = subprocess.PIPE
    # Ctrl-C must not reach the twin, which ends after its reader or when the pipe to it is closed.
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, start_new_session=True) as process:
        try:
            url = _address(process)
            commission.main(
                commission.Config(
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
    """The URL that a twin prints when it is ready."""
    assert process.stdout is not None
    url = ""
    for line in process.stdout:
        if line.startswith("camera:"):
            url = line.split()[1].removesuffix("/camera")
        if "Ctrl-C" in line:
            return url
    raise RuntimeError("the twin did not start. Its own error stands above: start it alone with -m experiments.twin")
