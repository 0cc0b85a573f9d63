"""The watchdog of a process, which ends it if a call of Zenoh does not return.

Nothing else could: no time-out and no signal interrupts a thread that waits inside Zenoh for one of Zenoh's
own locks. A process that has ended is restarted, or named as failed, like any that was killed.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from types import TracebackType

CHECK_S = 1.0
"""The time in s between two checks."""

_calls: dict[int, tuple[float]] = {}
"""The longest time in s of the call that each thread is in, by the thread's identifier."""


class Call:
    """A kind of calls of Zenoh: what a thread does inside `with` is watched."""

    def __init__(self, longest_s: float) -> None:
        self.longest_s = longest_s
        """The time in s after which a call hangs."""

    def __enter__(self) -> None:
        _calls[threading.get_ident()] = (self.longest_s,)  # a tuple of its own for each call

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        _calls.pop(threading.get_ident(), None)


CALL = Call(20.0)
"""A call that may wait. One within another ends the watch of both.

A put takes five seconds at most, if a link does not take it. With less time, such calls on a busy machine
would end the process; with more than the 30 s for which others wait for an answer, that would be too late.
"""

OPENING = Call(120.0)
"""The opening of a session. Looking up the names of some hosts takes a minute if no server answers."""


def watch(owner: str, end: Callable[[], object]) -> None:
    """Call `end`, which ends the process, once a call of Zenoh takes too long, and say so.

    `owner` begins the message. The time is counted in checks, so that of a suspended process does not count.
    """

    def check() -> None:
        checks: dict[int, tuple[tuple[float], int]] = {}
        while True:
            time.sleep(CHECK_S)
            before, checks = checks, {}
            for thread, call in dict(_calls).items():
                seen, times = before.get(thread, (None, 0))
                checks[thread] = call, times + 1 if seen is call else 0
                if checks[thread][1] * CHECK_S >= call[0]:
                    # not through sys.stderr, whose lock the thread may hold
                    os.write(2, f"{owner}: Zenoh has not returned from a call for {call[0]:g} s\n".encode())
                    end()

    threading.Thread(target=check, name="watchdog", daemon=True).start()
