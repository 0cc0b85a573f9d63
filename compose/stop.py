"""Ctrl-C and SIGTERM, as something that arrives like everything else."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from queue import SimpleQueue
from types import FrameType
from typing import Any

STATUS = 130
"""the exit status of a process that was told to stop"""


@contextmanager
def stops_into(inbox: SimpleQueue[Any]) -> Iterator[None]:
    """Put ("stop", signal's name, b"") into `inbox` when the process is told to stop.

    Until then, and afterwards, such a signal ends the process at once and silently.
    """

    def hand_over(number: int, frame: FrameType | None) -> None:
        inbox.put(("stop", signal.Signals(number).name, b""))

    signals = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, hand_over) for number in signals]
    try:
        yield
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)
