"""The clock of a process, from which it takes all times for which it waits.

No time of a clock is sent to another process, so offsets do not matter. A clock that jumps ahead is like a
process that was suspended meanwhile. One that goes back would make a process wait as much longer; it counts
as one that stands still.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Annotated

import msgspec
from msgspec import Meta

from protocol import documents

Seconds = Annotated[float, Meta(ge=-1e9, le=1e9)]
"""A time of a clock, in s."""


class ClockError(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The error of a clock, to test that it does no harm."""

    offset: Seconds = 0.0
    """The time by which the clock is ahead from the start on, in s."""
    drift: Annotated[float, Meta(ge=-1e5, le=1e5)] = 0.0
    """The rate at which it gains time, in ppm: 1 ppm is a second in 11.6 days."""
    jumps: tuple[tuple[Annotated[float, Meta(ge=0.0, le=1e9)], Seconds], ...] = ()
    """Pairs of the time in s after the start at which it jumps, and by how many s: ahead, or back if
    negative."""

    def __post_init__(self) -> None:
        """Raise ValueError if there are more jumps than can be added up whenever the time is read."""
        if len(self.jumps) > 1000:
            raise ValueError("jumps: more than 1000")

    def arguments(self, since: float) -> list[str]:
        """Return the flag that tells a process of its clock's error, which starts at time `since` in s."""
        return ["--clock", msgspec.json.encode((self, since)).decode()]

    def added(self, elapsed: float) -> float:
        """Return what the clock is ahead `elapsed` s after the start, in s."""
        return self.offset + 1e-6 * self.drift * elapsed + sum([by for at, by in self.jumps if elapsed >= at])


class Clock:
    """A clock that never goes back: that of the computer, with an error if one is told."""

    def __init__(
        self,
        error: ClockError | None = None,
        since: float = 0.0,
        true: Callable[[], float] = time.monotonic,
    ) -> None:
        """`since` is the time of `true`, in s, at which `error` starts. `true` must not go back itself."""
        self._error, self._since, self._true = error, since, true
        self._latest = -1e18
        self._lost = 0.0
        """The s by which it has jumped back."""
        self._lock = threading.RLock()  # a signal handler may interrupt its holder

    @classmethod
    def told(cls, text: str) -> Clock:
        """Return the clock of `ClockError.arguments`. Raises ValueError."""
        try:
            return cls(*documents.json_value(text, tuple[ClockError, float]))
        except msgspec.DecodeError as error:
            raise ValueError(str(error)) from None

    def __call__(self) -> float:
        """Return the time in s."""
        if self._error is None:
            return self._true()
        with self._lock:
            now = self._true()
            shown = now + self._error.added(now - self._since)
            self._lost += max(0.0, self._latest - shown)
            self._latest = shown
            return shown + self._lost
