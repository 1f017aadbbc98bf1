"""`Background`: a thread that takes pairs of a visual and a tactile image continuously."""

import threading
from collections.abc import Callable

from sts_jax.hardware.proof import LightError, Pair


class Background:
    """A thread that takes pairs of a visual and a tactile image continuously, and keeps the newest pair."""

    def __init__(self, take: Callable[[], Pair], interrupt: Callable[[], None]):
        """Start the thread.

        Args:
            take: Function that takes one pair.
            interrupt: Function that makes a running call of `take` raise an error soon.
        """
        self._take, self._interrupt = take, interrupt
        self._changed = threading.Condition()
        self._pair: Pair | None = None
        self._fresh = False
        self._error: BaseException | None = None
        self._stopped = False
        self.reported = False  # True if the thread has ended with an error, and a caller has seen this error
        self._thread = threading.Thread(target=self._run, name="pairs of the sensor", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stopped:
            try:
                pair = self._take()
            except Exception as error:  # `latest` or `next` raises it in the caller's thread
                with self._changed:
                    self._error = error
                    self._changed.notify_all()
                return
            with self._changed:
                self._pair, self._fresh = pair, True
                self._changed.notify_all()

    def latest(self) -> Pair | None:
        """Return the newest visual and tactile image as a pair, or None if no pair has been taken yet.

        If an error has ended the thread that takes the pairs, this method raises the same error.
        """
        with self._changed:
            self._raise()
            return self._pair

    def next(self, limit_s: float) -> Pair:
        """Wait until there is a pair of images that this method has not returned yet, and return the newest pair.

        If an error has ended the thread that takes the pairs, this method raises the same error.

        Args:
            limit_s: Longest wait (s).

        Returns:
            The newest pair.

        Raises:
            LightError: No pair was taken in time.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._fresh or self._error is not None, limit_s):
                raise LightError(
                    f"no pair of a visual and a tactile image was taken within {limit_s:g} s: pass a larger "
                    "timeout_ms, or call read() to see the reason."
                )
            self._raise()
            self._fresh = False
            assert self._pair is not None
            return self._pair

    def stop(self) -> None:
        """Interrupt the thread, and wait for its end."""
        self._stopped = True
        self._interrupt()
        self._thread.join()

    def _raise(self) -> None:
        if self._error is not None:
            self.reported = True
            raise self._error
