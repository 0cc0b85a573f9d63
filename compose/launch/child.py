"""A child process that a fork server has forked: its streams, its signals and its end."""

from __future__ import annotations

import os
import select
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import IO

KILL_S = 5.0
"""Time in s that a killed process has to end; then its fork server is considered hung, and is killed."""
SEND_S = 60.0
"""Time in s that a process has to read what is sent to it; then it is considered hung, and is killed."""
END_CHECK_S = 0.1
"""Interval in s at which a wait for the output of a process checks whether it has ended."""
READ_BYTES = 1 << 16
"""The largest number of bytes in one read from a process."""
ERROR_BYTES = 1 << 20
"""The number of bytes of standard error, counted from its end, that are kept."""


class ChildProcess:
    """A forked process. It ends when its standard input is closed, which its launcher holds open.

    It has its own session, so Ctrl-C reaches only the launcher.
    """

    def __init__(
        self,
        streams: tuple[int, int | None],
        errors: IO[bytes] | None,
        signal: Callable[[int], None],
        kill_parent: Callable[[], object],
        on_end: Callable[[], None],
    ) -> None:
        """`streams` are the launcher's ends of its standard input and output, `errors` its standard error.

        `signal` sends it a signal. `on_end` is called in another thread when it has ended.
        """
        self.started = time.monotonic()
        """Monotonic time of its start in s."""
        self.status: int | None = None
        """Exit status; negative is the signal that killed the process, and None that it has not ended."""
        self._signal = signal
        self._kill_parent = kill_parent
        self._stdin, self._stdout = streams
        os.set_blocking(self._stdin, False)
        self._open = [stream for stream in streams if stream is not None]
        self._errors = errors
        self._stderr_text = ""
        """The text of standard error; set once the file is closed."""
        self._why = ""
        self._on_end = on_end
        self._over = threading.Event()

    @property
    def running(self) -> bool:
        """True if the process has not ended yet."""
        return not self._over.is_set()

    @property
    def hung_up(self) -> bool:
        """True if it has closed its standard input, as it does by ending."""
        return not self.running or bool(_polled(self._stdin, 0, 0.0))

    def wait(self, timeout: float) -> bool:
        """Wait at most `timeout` seconds, and return whether the process has ended."""
        return self._over.wait(max(timeout, 0.0))

    def signal(self, number: int) -> None:
        """Send a signal to the process and its group, unless it has ended."""
        if self.running:
            self._signal(number)

    def terminate(self) -> None:
        """Send SIGTERM, and SIGCONT in case the process is suspended."""
        self.signal(signal.SIGTERM)
        self.signal(signal.SIGCONT)

    def kill(self) -> None:
        """Kill the process and its group."""
        self.signal(signal.SIGKILL)

    def end(self, timeout: float = 0.0) -> int:
        """Wait `timeout` seconds, then kill the process; free its streams, and return its exit status."""
        if not self.wait(timeout):
            self.kill()
            if not self.wait(KILL_S):
                self._kill_parent()
                self.wait(KILL_S)
        self.hang_up()
        if self._errors is not None:
            self._stderr_text = self.stderr_text()
            self._errors.close()
            self._errors = None
        return -signal.SIGKILL if self.status is None else self.status

    def hang_up(self) -> None:
        """Close the launcher's ends of its standard input and output, which ends it."""
        while self._open:
            os.close(self._open.pop())

    def send(self, data: bytes) -> None:
        """Write `data` to the standard input of the process, unless it has ended; kill it after SEND_S."""
        rest = memoryview(data)
        give_up = time.monotonic() + SEND_S
        with suppress(BrokenPipeError):
            while rest:
                if not _polled(self._stdin, select.POLLOUT, give_up - time.monotonic()):
                    self.kill()
                    return
                rest = rest[os.write(self._stdin, rest) :]

    def receive(self, timeout: float) -> bytes:
        """Return the next bytes of its standard output, none at the end. Raises TimeoutError."""
        assert self._stdout is not None
        give_up = time.monotonic() + timeout
        while not _polled(self._stdout, select.POLLIN, min(give_up - time.monotonic(), END_CHECK_S)):
            if not self.running and not _polled(self._stdout, select.POLLIN, 0.0):
                return b""  # the fork server still has the other end if it ended before it began
            if time.monotonic() >= give_up:
                raise TimeoutError
        return os.read(self._stdout, READ_BYTES)

    def stderr_text(self) -> str:
        """Return what the process has written to its standard error, at most its last ERROR_BYTES."""
        if self._errors is None:
            return self._stderr_text
        file = self._errors.fileno()
        begin = max(0, os.fstat(file).st_size - ERROR_BYTES)
        return os.pread(file, ERROR_BYTES, begin).decode(errors="replace").strip()

    def how_ended(self) -> str:
        """Return how the process ended, as part of an error message."""
        assert self.status is not None
        how = self._why or ending(self.status)
        lines = [] if self._why else self.stderr_text().splitlines()
        return f"{how}: {'; '.join(lines)}" if lines else how

    def ended(self, status: int, why: str = "") -> None:
        """Store the exit status, and why the process was killed if its fork server has ended."""
        self.status, self._why = status, why
        self._over.set()
        self._on_end()


def ending(status: int) -> str:
    """Return how a process with the exit status `status` ended; negative is the signal that killed it."""
    return f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"


def _polled(stream: int, events: int, timeout: float) -> bool:
    """Wait at most `timeout` s for `events` at the descriptor `stream`, or for its other end to be closed."""
    poll = select.poll()
    poll.register(stream, events)
    return bool(poll.poll(max(0.0, 1e3 * timeout)))
