"""Prints the errors and warnings of a command on one line each, and ends a command that receives SIGTERM."""

import contextlib
import signal
import warnings
from collections.abc import Iterator
from typing import Any

from sts_jax import hardware
from sts_jax.storage import LockedError

# Types of the errors that the library raises for mistakes that the user can correct
CORRECTABLE = (
    OSError,
    ValueError,
    ImportError,
    FloatingPointError,
    LockedError,
    hardware.CameraError,
    hardware.LightError,
    hardware.NoContrastError,
)


@contextlib.contextmanager
def on_one_line(*, debug: bool = False) -> Iterator[None]:
    """If the user can correct an error of the `with` block, print `error: ...` on one line, and exit with code 1.

    A warning in the `with` block is printed as `note: ...` on one line.

    Args:
        debug: If True, raise all errors unchanged, so that Python prints their tracebacks.

    Raises:
        SystemExit: `debug` is False, and an error of one of the types in CORRECTABLE occurred.
    """
    usual, warnings.formatwarning = warnings.formatwarning, _note
    try:
        yield
    except CORRECTABLE as error:
        if debug:
            raise
        raise SystemExit(f"error: {error}") from None
    finally:
        warnings.formatwarning = usual


def _note(message: Warning | str, *_: Any, **__: Any) -> str:
    """Format a warning."""
    return f"note: {message}\n"


def interrupt_on_sigterm() -> None:
    """Make SIGTERM raise a `KeyboardInterrupt`, so that the process writes its files and ends as after Ctrl+C."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)
