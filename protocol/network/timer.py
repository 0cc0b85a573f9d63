"""A timer that ends a wait of another thread, for waits that have no timeout of their own."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable


class Timer:
    """A clock that calls `wake` in a thread of its own, once the time that was set last is reached.

    Setting it is cheap, because the thread only wakes at once if the new time is earlier than the one for
    which it sleeps. Otherwise it sees the new time when it wakes.
    """

    def __init__(self, wake: Callable[[], None], clock: Callable[[], float]) -> None:
        self._wake, self._clock = wake, clock
        self._at = math.inf
        """The time of the clock that was set last; infinite for none."""
        self._asleep_until = math.inf
        self._earlier = threading.Event()
        self._thread: threading.Thread | None = None

    def set(self, at: float) -> None:
        """Expire once, when the clock reaches `at`, instead of at the time that was set before."""
        self._at = at
        if at < self._asleep_until:
            self._earlier.set()
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, daemon=True)
                self._thread.start()

    def _run(self) -> None:
        expired_at: float | None = None
        while True:
            self._asleep_until = math.inf  # from here on, `set` wakes this thread
            self._earlier.clear()
            at = self._at
            if at != expired_at and at <= self._clock():
                expired_at = at
                self._wake()
            elif at in (expired_at, math.inf):
                self._earlier.wait()
            else:
                self._asleep_until = at
                self._earlier.wait(min(at - self._clock(), threading.TIMEOUT_MAX))
