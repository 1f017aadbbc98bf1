"""Errors on the command line."""

import contextlib
from collections.abc import Iterator

from sts_jax import hardware
from sts_jax.dataset import LockedError

# The types of errors that the library raises for input that the user can correct
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
    """Show an error that the user can correct as `error: ...` without a traceback, and exit with code 1.

    Args:
        debug: Keep every traceback.

    Raises:
        SystemExit: An error of one of the types in CORRECTABLE occurred.
    """
    try:
        yield
    except CORRECTABLE as error:
        if debug:
            raise
        raise SystemExit(f"error: {error}") from None
