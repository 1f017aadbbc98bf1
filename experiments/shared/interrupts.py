"""What Ctrl-C does in a command. This module is imported before all others, so it imports only the standard library."""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType

LINE = "interrupted: run the same command again to go on. All finished results are kept"
CODE = 130  # exit status of a program that Ctrl-C has ended
_AGAIN_S = 0.05  # time until an exception that its receiver would swallow is raised again (s)
_SWALLOWS = "_xla_gc_callback"  # JAX's function that Python calls while it collects garbage, and that raises nothing


def end_at_once() -> None:
    """Let Ctrl-C end the process with one line, also while JAX compiles. Files are written atomically, so none breaks.

    Python itself would raise a KeyboardInterrupt in the main thread, after the call of compiled code that is running.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:  # ignored in the background of a shell
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    signal.signal(signal.SIGINT, _ignore)
    threading.Thread(target=_end, args=(reader,), name="Ctrl-C", daemon=True).start()


def _end(reader: int) -> None:
    while signal.SIGINT not in os.read(reader, 1):
        pass
    with contextlib.suppress(OSError):
        os.write(2, ("\n" * os.isatty(2) + LINE + "\n").encode())
    os._exit(CODE)


@contextlib.contextmanager
def in_order() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM raise a KeyboardInterrupt, so that devices and recordings are closed.

    Nothing changes in a program that has not called `end_at_once`. In the background of a shell, Ctrl-C stays ignored.
    """
    interrupt = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or interrupt not in (_ignore, signal.SIG_IGN):
        yield
        return
    writer = signal.set_wakeup_fd(-1)
    numbers = [signal.SIGTERM, signal.SIGALRM, *([signal.SIGINT] if interrupt is _ignore else [])]
    before = {number: signal.signal(number, _raise) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(writer)


def _ignore(*_: object) -> None:
    """The thread of `end_at_once` ends the process."""


def _raise(_: int, frame: FrameType | None) -> None:
    while frame is not None:
        if frame.f_code.co_name == _SWALLOWS:
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
            return
        frame = frame.f_back
    raise KeyboardInterrupt
