"""Ctrl-C, SIGTERM and a closed terminal, as something that arrives like everything else."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from protocol.inbox import Inbox


def stop_with_launcher(inbox: Inbox) -> None:
    """Put "stop" into `inbox` when standard input, which a launcher holds open, comes to its end."""

    def wait() -> None:
        while os.read(0, 4096):
            pass
        inbox.put("stop", "the end of its launcher")

    threading.Thread(target=wait, daemon=True).start()


@contextmanager
def stops_into(inbox: Inbox) -> Iterator[None]:
    """Put "stop" into `inbox` when the process is told to stop.

    Before and afterwards such a signal ends the process at once and silently.
    """

    def hand_over(number: int, _frame: object) -> None:
        inbox.put("stop", signal.Signals(number).name)

    signals = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.signal(number, hand_over) for number in signals]
    try:
        yield
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)
