"""What a command says: progress, errors and warnings on one line, and the instructions of a collection."""

import contextlib
import os
import select
import sys
import time
import warnings
from collections.abc import Iterator
from typing import Any

import jax
from tqdm import tqdm

from experiments.shared import interrupts
from sts_jax import hardware
from sts_jax.hardware import Action, Stage, View
from sts_jax.storage import LockedError

# Errors that the library raises for mistakes that the user can correct
CORRECTABLE = (
    OSError,
    ValueError,
    ImportError,
    FloatingPointError,
    LockedError,
    hardware.CameraError,
    hardware.LightError,
)
SEEDS = 0, 2**32 - 1  # least and largest seed
SIDES = 1, 8192  # least and largest side of an image (pixels)
LINES = {"": Action.CONFIRM, "d": Action.DISCARD, "q": Action.STOP}
_EVERY_S = 10.0  # time between two lines of progress where standard error is not a terminal (s)


def say(text: str) -> None:
    """Print one line for the user, on standard error."""
    print(text, file=sys.stderr, flush=True)


class Bar:
    """A progress bar on a terminal, and a line about every ten seconds elsewhere."""

    def __init__(self) -> None:
        self._bar: tqdm | None = None
        self._stage = ""
        self._said_s = 0.0

    def __enter__(self) -> "Bar":
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Show that `done` of `total` items of a stage are finished. A new stage starts a new bar."""
        if sys.stderr.isatty():
            if stage != self._stage or self._bar is None:
                if self._bar is not None:
                    self._bar.close()
                self._bar = tqdm(total=total, desc=stage, initial=done, dynamic_ncols=True)
            self._bar.set_postfix_str(note, refresh=False)
            self._bar.update(done - self._bar.n)
        elif stage != self._stage or done == total or time.monotonic() - self._said_s > _EVERY_S:
            say(f"{stage}: {done}/{total} {note}".rstrip())
            self._said_s = time.monotonic()
        self._stage = stage


@contextlib.contextmanager
def on_one_line(*, debug: bool = False) -> Iterator[None]:
    """End the program with one line after Ctrl-C, or, unless `debug` is set, after an error that can be corrected."""
    usual, warnings.formatwarning = warnings.formatwarning, _note
    try:
        yield
    except CORRECTABLE as error:
        if debug:
            raise
        raise SystemExit(f"error: {error}") from None
    except KeyboardInterrupt:
        say(interrupts.LINE)
        raise SystemExit(interrupts.CODE) from None
    except (MemoryError, OverflowError, jax.errors.JaxRuntimeError) as error:
        if debug or (isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" not in str(error)):
            raise
        reason = str(error).partition("\n")[0] or "out of memory"
        raise SystemExit(f"error: an option has too large a number for this computer: {reason}") from None
    finally:
        warnings.formatwarning = usual


def check_numbers(config: Any, **limits: tuple[float, float]) -> None:
    """Raise a ValueError for the first option with a number outside its limits (low, high), NaN included."""
    for name, (low, high) in limits.items():
        value = getattr(config, name)
        for number in value if isinstance(value, tuple) else (value,):
            if number is not None and not low <= number <= high:
                raise ValueError(f"--{name.replace('_', '-')} is {value}, but it must be from {low:,} to {high:,}")


def _note(message: Warning | str, *_: Any, **__: Any) -> str:
    return f"note: {message}\n"


class Terminal:
    """A `hardware.Person` at a terminal: an empty line confirms, `d` discards, `q` or the end of the input stops."""

    def __init__(self, count: int | None = None, *, listens: bool = True):
        """Explain the keys, unless nobody listens to them. `count` is the number of trajectories to reach, if any."""
        self._goal = "" if count is None else f" of {count}"
        self._listens = listens
        self._shown: object = None
        self._stages: tuple[Stage | None, Stage | None] = (None, None)  # stages of the last two views
        if listens:
            say("Enter confirms, d and Enter discard, q and Enter stop")

    def show(self, view: View) -> None:
        """Print the problem or the instruction of a view, unless it was printed last."""
        self._stages = self._stages[1], view.stage
        shown = view.instruction, view.problem, view.number
        if shown != self._shown:
            self._shown = shown
            number = "" if view.number is None else f" trajectory {view.number}:"
            say(f"[{view.confirmed}{self._goal}]{number} {view.problem or view.instruction}")

    def action(self) -> Action | None:
        """The action of the next line, or None. Only `q` counts before the person has seen the current stage."""
        while self._listens and select.select([sys.stdin], [], [], 0)[0]:
            line = b""
            while not line.endswith(b"\n") and (more := os.read(sys.stdin.fileno(), 1)):
                line += more
            if not line:
                say("the standard input has ended")
                return Action.STOP
            action = LINES.get(line.decode(errors="replace").strip().lower())
            if action is not None and (action is Action.STOP or self._stages[0] is self._stages[1]):
                return action
        return None
