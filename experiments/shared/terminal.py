"""The terminal of `experiments.real collect --headless`: prints the instructions, and reads keys."""

import contextlib
import os
import select
import sys
from collections.abc import Iterator

from experiments.shared.progress import say
from sts_jax.hardware import Action, Stage, View

KEYS = {"\n": Action.CONFIRM, "\r": Action.CONFIRM, "d": Action.DISCARD, "q": Action.STOP}


class Terminal:
    """Implements `hardware.Person` with a terminal: prints the instructions, and reads the person's actions.

    The key Enter confirms the current stage of the recording, d discards the current trajectory, and q ends the
    collection. If the standard input is not a terminal, each line acts like a key, and an empty line acts like Enter.
    The end of the input has the same effect as q.
    """

    def __init__(self, count: int | None = None, *, keys: bool = True):
        """Print a line that explains the keys.

        Args:
            count: Number of trajectories that is shown as the goal. None: no goal.
            keys: False if no keys are read, so that the line is not printed.
        """
        self._goal = "" if count is None else f" of {count}"
        self._shown: object = None
        self._stages: tuple[Stage | None, Stage | None] = (None, None)  # stages of the last two views
        if keys:
            say("Enter confirms, d discards, q stops")

    def show(self, view: View) -> None:
        """Print `view.problem`, or `view.instruction` if there is no problem.

        Nothing is printed if the instruction, the problem and the number of the trajectory are the same as in the
        previous call.
        """
        self._stages = self._stages[1], view.stage
        shown = view.instruction, view.problem, view.number
        if shown != self._shown:
            self._shown = shown
            number = "" if view.number is None else f" trajectory {view.number}:"
            say(f"[{view.confirmed}{self._goal}]{number} {view.problem or view.instruction}")

    def action(self) -> Action | None:
        """Return the action of the next key that was pressed, or None if there is none.

        The method does not wait for a key. Unknown keys are ignored. Enter and d are also ignored if they were pressed
        before the person saw the current stage of the recording (`hardware.Stage`).
        """
        while select.select([sys.stdin], [], [], 0)[0]:
            data = os.read(sys.stdin.fileno(), 1)
            if not data:
                say("the standard input has ended")
                return Action.STOP
            key = data.decode(errors="replace")
            if not sys.stdin.isatty():
                key = self._line(data).decode(errors="replace").strip() or "\n"
            if (action := KEYS.get(key.lower())) is not None and (
                action is Action.STOP or self._stages[0] is self._stages[1]
            ):
                return action
        return None

    def _line(self, line: bytes) -> bytes:
        """Read the rest of a line whose first byte was read already."""
        while not line.endswith(b"\n") and (more := os.read(sys.stdin.fileno(), 1)):
            line += more
        return line


@contextlib.contextmanager
def single_keys() -> Iterator[None]:
    """Let the program read each key immediately, without waiting for Enter, as long as the `with` block runs.

    Raises:
        ValueError: The terminals of this system cannot be read key by key.
    """
    if not sys.stdin.isatty():
        yield
        return
    try:
        import termios
        import tty
    except ImportError as error:
        raise ValueError("the terminal of this system cannot be read key by key: leave out --headless") from error
    before = termios.tcgetattr(sys.stdin)
    try:
        tty.setcbreak(sys.stdin)
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
