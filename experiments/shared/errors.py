"""Errors on the command line."""

import contextlib
from collections.abc import Iterator

from sts_jax.dataset import LockedError

# The types of errors that the library raises on purpose.
MENDABLE = (
    OSError,
    ValueError,
    ImportError,
    FloatingPointError,
    LockedError,
)


@contextlib.contextmanager
def on_one_line(*, debug: bool = False) -> Iterator[None]:
    """Show an error that the user can correct as `error: ...` without a traceback, and exit with code 1.

    Args:
        debug: keep every traceback.

    Raises:
        SystemExit: an error of one of the types in MENDABLE occurred.
    """
    try:
        yield
    except MENDABLE as error:
        if debug:
            raise
        raise SystemExit(f"error: {error}") from None
