"""`Background`: a thread that takes pairs continuously."""

import threading
from collections.abc import Callable

from sts_jax.hardware.shots import LightError, Pair


class Background:
    """Takes pairs in a thread and keeps the newest one."""

    def __init__(self, take: Callable[[], Pair], interrupt: Callable[[], None]):
        """Start the thread.

        Args:
            take: Takes one pair.
            interrupt: Makes a call of `take` that is under way end soon, by any error.
        """
        self._take, self._interrupt = take, interrupt
        self._changed = threading.Condition()
        self._pair: Pair | None = None
        self._fresh = False
        self._error: BaseException | None = None
        self._stopped = False
        self.reported = False  # whether the thread has ended with an error and the error has been raised
        self._thread = threading.Thread(target=self._run, name="pairs of the sensor", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stopped:
            try:
                pair = self._take()
            except Exception as error:  # raised by the next call of the user
                with self._changed:
                    self._error = error
                    self._changed.notify_all()
                return
            with self._changed:
                self._pair, self._fresh = pair, True
                self._changed.notify_all()

    def latest(self) -> Pair | None:
        """The newest pair, or None. Raises the thread's error."""
        with self._changed:
            self._raise()
            return self._pair

    def next(self, limit_s: float) -> Pair:
        """The newest pair that was not returned by this method yet. Raises the thread's error."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._fresh or self._error is not None, limit_s):
                raise LightError(f"no pair was taken within {limit_s:g} s: call read() to see the reason.")
            self._raise()
            self._fresh = False
            assert self._pair is not None
            return self._pair

    def stop(self) -> None:
        """End the thread."""
        self._stopped = True
        self._interrupt()
        self._thread.join()

    def _raise(self) -> None:
        if self._error is not None:
            self.reported = True
            raise self._error
