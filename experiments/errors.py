"""Errors as the command line shows them."""

import contextlib
import dis
from collections.abc import Iterator


@contextlib.contextmanager
def on_one_line(*, debug: bool = False) -> Iterator[None]:
    """Show an error that the user can mend as `error: ...` without a traceback, and exit with code 1.

    The user can mend what the operating system refuses (OSError), and what this repository checks and refuses with a
    `raise` of its own. Everything else is a fault of the program and keeps its traceback.

    Args:
        debug: Keep every traceback.

    Raises:
        SystemExit: An error that the user can mend has occurred.
    """
    try:
        yield
    except Exception as error:  # of any type: the place where it was raised decides
        if debug or not (isinstance(error, OSError) or _raised_here(error)):
            raise
        raise SystemExit(f"error: {error}") from None


def _raised_here(error: Exception) -> bool:
    """Whether a `raise` statement of this repository raised an error; NumPy's C code, for one, has no frame."""
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    if last is None or isinstance(error, AssertionError):  # `assert` compiles to a raise
        return False
    package = last.tb_frame.f_globals.get("__name__", "").partition(".")[0]
    operation = last.tb_frame.f_code.co_code[last.tb_lasti]
    return package in ("sts_jax", "experiments") and operation == dis.opmap["RAISE_VARARGS"]
