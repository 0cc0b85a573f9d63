"""The pool of processes in which trials run: one per worker thread and sweep, used for chunk after chunk.

If a trial hangs or its process dies, only that process is lost, and the next chunk gets a new one.
"""

from __future__ import annotations

import tempfile
import threading
import time
from contextlib import ExitStack
from typing import NamedTuple

from compose.launch.forked import ending, fork_server
from compose.sweep.worker import READY, error_text

START_S = 60.0
"""The time in s within which a new process must have imported its modules."""


class Answers(NamedTuple):
    """The answers to a chunk of trials, which may be too few."""

    rows: list[bytes]
    """The encoded rows of its first trials."""
    error: str = ""
    """The reason why the trial after these has no row; empty if there was no time for it."""
    wall_s: float | None = None
    """The wall time in s that this trial took."""


class WorkerProcess:
    """A process in which trials run. It has its own session, so Ctrl-C reaches only its owner."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="tandem-trials-", ignore_cleanup_errors=True)
        self.child = fork_server("compose.sweep.worker").start(
            "compose.sweep.worker:main", "tandem sweep worker", self._folder.name
        )
        self.used = threading.Lock()
        """Held while it runs a chunk."""
        self.ready = False
        """True once it has imported its modules."""

    def ask(self, chunk: bytes) -> None:
        """Send an encoded chunk to the process, which runs its trials. Raises TimeoutError and EOFError."""
        if not self.ready:
            self.ready = self.answer(START_S) == READY
        self.child.send(chunk)

    def answer(self, timeout: float) -> bytes:
        """Return the next message. Raises TimeoutError after `timeout` s, and EOFError if there is none."""
        return self.child.receive(timeout)

    def how_ended(self) -> str:
        """Return how the process ended, with the last line of its standard error."""
        if not self.child.wait(1.0):
            return "closed its connection"
        return ending(self.child.status or 0, self.child.stderr_text.splitlines()[-1:])

    def close(self) -> None:
        """Kill the process and those that its trials started, and remove its files."""
        self.child.end()
        self._folder.cleanup()


_lock = threading.Lock()
_processes: dict[tuple[str, int], WorkerProcess] = {}
"""The processes in this pool, by sweep and worker thread."""
_over: set[str] = set()
"""The sweeps that are over."""


def dismiss(sweep: str) -> None:
    """End all processes of the sweep in this pool, and start no more of them."""
    with _lock:
        _over.add(sweep)
        ended = [_processes.pop(key) for key in list(_processes) if key[0] == sweep]
    for process in ended:
        process.child.kill()
    for process in ended:
        with process.used:
            process.close()


def run(sweep: str, chunk: bytes, timeout: float) -> Answers:
    """Run an encoded chunk of the sweep, each trial within `timeout` s; none if the sweep is over."""
    key = sweep, threading.get_ident()
    rows: list[bytes] = []
    with ExitStack() as stack:
        with _lock:
            if sweep in _over:
                return Answers(rows)
            process = _processes.get(key)
            if process is None or not process.child.running:
                process = _processes[key] = WorkerProcess()
            stack.enter_context(process.used)
        began = time.perf_counter()
        try:
            process.ask(chunk)
            while (row := process.answer(timeout)) != READY:
                rows.append(row)
                began = time.perf_counter()
        except TimeoutError:
            error = f"hung: no answer within {timeout if process.ready else START_S:g} s"
        except EOFError:
            error = error_text(f"died: its process {process.how_ended()}")
        else:
            return Answers(rows)
        process.close()
        return Answers(rows, error, time.perf_counter() - began)
