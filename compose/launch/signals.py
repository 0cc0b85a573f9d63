"""Ctrl-C, SIGTERM, a closed terminal and the end of a launcher, delivered as items of an Inbox."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from compose.launch.interruption import STOPPING
from protocol.network.inbox import Inbox


def stop_with_launcher(inbox: Inbox) -> None:
    """Put "stop" into `inbox` when standard input, which a launcher holds open, comes to its end."""

    def wait() -> None:
        while os.read(0, 4096):
            pass
        inbox.put("stop", "the end of its launcher")

    threading.Thread(target=wait, daemon=True).start()


def stop_by_signal(inbox: Inbox) -> None:
    """Put "stop" into `inbox` on SIGINT, SIGTERM and SIGHUP, from now until the process ends.

    Before this call, such a signal raises an error (see `interruption`). The handlers are not removed after a
    run, so that a signal cannot interrupt the output and the files at the end of a run.
    """

    def hand_over(number: int, _frame: object) -> None:
        inbox.put("stop", signal.Signals(number).name)

    for number in STOPPING:
        if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup
            signal.signal(number, hand_over)


@contextmanager
def until_signal() -> Iterator[list[str]]:
    """Let the first of SIGINT, SIGTERM and SIGHUP end the block; its name is then in the list.

    The signals after it are ignored, so that they cannot interrupt the output at the end.
    """
    names: list[str] = []

    def interrupt(number: int, _frame: object) -> None:
        for one in STOPPING:
            signal.signal(one, signal.SIG_IGN)
        names.append(signal.Signals(number).name)
        raise KeyboardInterrupt

    for number in STOPPING:
        signal.signal(number, interrupt)
    with suppress(KeyboardInterrupt):
        yield names
    for number in STOPPING:
        signal.signal(number, signal.SIG_IGN)
