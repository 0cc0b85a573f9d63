"""Ctrl-C, SIGTERM, a closed terminal and the end of a launcher.

They end a command with STOPPED_STATUS. One with an inbox receives them as items of it.
"""

from __future__ import annotations

import datetime  # noqa: F401  # msgspec would drop the error of a signal during this import, and crash later
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import TYPE_CHECKING, NoReturn

from compose.errors import STOPPED_STATUS

if TYPE_CHECKING:
    from protocol.network.inbox import Inbox

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""The signals that stop a command."""
CLEANING_S = 5.0
"""The time in s in which a stopped command may clean up. A signal after it ends the process at once."""


class StoppedBySignal(KeyboardInterrupt):
    """A signal has stopped the command. The text of the error is the name of the signal."""


class Interruption:
    """The handlers of a command without an inbox: the first signal raises StoppedBySignal in the main thread.

    The error may come out of a library as another one, so that what counts is `signal_name`.
    """

    def __init__(self) -> None:
        self.signal_name: str | None = None
        """The name of the first signal; None until there is one."""
        self._command = "tandem"
        self._first_s = 0.0

    def begin(self, command: str) -> None:
        """Set the handlers for `command`, such as "tandem run"."""
        self._command = command
        sys.unraisablehook = self._unraisable
        _handle(self._interrupt)

    def end(self) -> None:
        """Ignore all signals from now on: the exit status is known."""
        for number in STOPPING:
            signal.signal(number, signal.SIG_IGN)

    def _interrupt(self, number: int, _frame: FrameType | None) -> None:
        if self.signal_name is None:
            self.signal_name = signal.Signals(number).name
            self._first_s = time.monotonic()
            raise StoppedBySignal(self.signal_name)
        if time.monotonic() > self._first_s + CLEANING_S:
            self._leave()

    def _unraisable(self, unraisable: sys.UnraisableHookArgs) -> None:
        """End the process if the error of a signal was lost, in a finalizer or in a callback from C."""
        if issubclass(unraisable.exc_type, StoppedBySignal):
            self._leave()
        sys.__unraisablehook__(unraisable)

    def _leave(self) -> NoReturn:
        """Say what stopped the command, and end the process at once, whatever it is doing."""
        with suppress(OSError):  # not through sys.stderr, which the signal may have interrupted
            os.write(2, f"{self._command}: stopped by {self.signal_name}\n".encode())
        os._exit(STOPPED_STATUS)


INTERRUPTION = Interruption()
"""The one of this process."""


def stop_with_launcher(inbox: Inbox) -> None:
    """Put "stop" into `inbox` when standard input, which a launcher holds open, comes to its end."""

    def wait() -> None:
        while os.read(0, 4096):
            pass
        inbox.put("stop", "the end of its launcher")

    threading.Thread(target=wait, daemon=True).start()


def stop_by_signal(inbox: Inbox) -> None:
    """Put "stop" into `inbox` on SIGINT, SIGTERM and SIGHUP, from now until the process ends.

    Before this call, such a signal raises an error (see `Interruption`). The handlers are not removed after a
    run, so that a signal cannot interrupt the output and the files at the end of a run.
    """
    _handle(lambda number, _: inbox.put("stop", signal.Signals(number).name))
    if INTERRUPTION.signal_name is not None:  # a library has dropped its error
        inbox.put("stop", INTERRUPTION.signal_name)


def _handle(handler: Callable[[int, FrameType | None], None]) -> None:
    """Let `handler` handle the signals. One that was ignored stays so, unless it is that of Ctrl-C."""
    for number in STOPPING:
        if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)
