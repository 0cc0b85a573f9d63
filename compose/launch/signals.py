"""Ctrl-C, SIGTERM, a closed terminal and the end of a launcher, as something that arrives like the rest."""

from __future__ import annotations

import os
import signal
import threading

from protocol.network.inbox import Inbox


def stop_with_launcher(inbox: Inbox) -> None:
    """Put "stop" into `inbox` when standard input, which a launcher holds open, comes to its end."""

    def wait() -> None:
        while os.read(0, 4096):
            pass
        inbox.put("stop", "the end of its launcher")

    threading.Thread(target=wait, daemon=True).start()


def stop_by_signal(inbox: Inbox) -> None:
    """From now on, put "stop" into `inbox` when the process is told to stop.

    Until now such a signal has ended the process at once and silently. There is no way back: what has
    come to its end is said and written before the process ends, whatever arrives meanwhile.
    """

    def hand_over(number: int, _frame: object) -> None:
        inbox.put("stop", signal.Signals(number).name)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, hand_over)
