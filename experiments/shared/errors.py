"""How the commands report errors."""

import contextlib
from collections.abc import Iterator

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

    Args:
        debug: If True, raise all errors unchanged, so that Python prints their tracebacks.

    Raises:
        SystemExit: `debug` is False, and an error of one of the types in CORRECTABLE occurred.
    """
    try:
        yield
    except CORRECTABLE as error:
        if debug:
            raise
        raise SystemExit(f"error: {error}") from None
