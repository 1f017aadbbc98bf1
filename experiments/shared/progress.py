"""Shows the progress of a command to the user."""

import sys
import time

from tqdm import tqdm


class Bar:
    """A progress bar on a terminal, or a plain line about every ten seconds if standard error is not a terminal."""

    def __init__(self) -> None:
        self._bar: tqdm | None = None
        self._stage = ""
        self._said = 0.0

    def __enter__(self) -> "Bar":
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Show the progress of a stage.

        Args:
            stage: Name of the stage. A new name starts a new bar.
            done: Number of finished items.
            total: Number of all items.
            note: Remark at the end of the line.
        """
        if sys.stderr.isatty():
            if stage != self._stage or self._bar is None:
                if self._bar is not None:
                    self._bar.close()
                self._bar = tqdm(total=total, desc=stage, initial=done, dynamic_ncols=True)
            self._bar.set_postfix_str(note, refresh=False)
            self._bar.update(done - self._bar.n)
        elif stage != self._stage or done == total or time.monotonic() - self._said > 10:
            say(f"{stage}: {done}/{total} {note}".rstrip())
            self._said = time.monotonic()
        self._stage = stage


def say(text: str) -> None:
    """Print one line for the user, on standard error."""
    print(text, file=sys.stderr, flush=True)
