"""The pool of processes in which trials run: one per worker thread, reused from chunk to chunk.

If a trial hangs or its process dies, only that process is lost. The row of the trial contains the error, and
a new process runs the remaining trials. Dask therefore sees only completed chunks.
"""

from __future__ import annotations

import signal
import tempfile
import threading
import time

import msgspec

from compose.launch.forked import fork_server
from compose.sweep.trial import lost
from compose.sweep.worker import MAX_ERROR, READY, Chunk
from protocol.output import one_line

_DECODER = msgspec.msgpack.Decoder(Chunk)
"""Made before there are several threads: msgspec crashes if two use a type for the first time."""

START_S = 60.0
"""The time in s within which a new process must have imported its modules."""


class Died(Exception):
    """A process has ended unexpectedly; the text says how."""


class Hung(Exception):
    """A process has not answered within its timeout."""


class WorkerProcess:
    """A process in which trials run. It has its own session, so Ctrl-C reaches only its owner."""

    def __init__(self) -> None:
        self.reused = False
        """True once it has run a chunk."""
        self._folder = tempfile.TemporaryDirectory(prefix="tandem-trials-", ignore_cleanup_errors=True)
        self._child = fork_server("compose.sweep.worker").start(
            "compose.sweep.worker:main", "tandem sweep worker", self._folder.name
        )

    def ask(self, chunk: Chunk) -> None:
        """Send the trials of `chunk` to the process, which runs them."""
        self._child.send(msgspec.msgpack.encode(chunk))

    def answer(self, timeout: float) -> bytes:
        """Return the next message. Raises Hung after `timeout` seconds, and Died if the process has ended."""
        try:
            return self._child.receive(timeout)
        except TimeoutError:
            raise Hung from None
        except EOFError:
            raise Died(self._how()) from None

    def _how(self) -> str:
        """Return how the process ended, with the last line of its standard error."""
        if not self._child.wait(1.0):  # its connection is closed, but it still runs
            self.kill()
            return "it closed its connection"
        status = self._child.status or 0
        errors = self._child.stderr_text[-MAX_ERROR:].splitlines()
        how = f"killed by {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"
        return f"{how}: {one_line(errors[-1])}" if errors else how

    def kill(self) -> None:
        """Kill the process. Processes that its trials started end with it."""
        self._child.kill()

    def close(self) -> None:
        """Kill the process, and remove its files."""
        self._child.end()
        self._folder.cleanup()


class _Children:
    """The processes of one sweep in this pool."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._all: set[WorkerProcess] = set()
        self._resting: list[WorkerProcess] = []
        self._over = False

    def take(self) -> WorkerProcess | None:
        """Return a process for this thread, a new one if none rests; None if the sweep is over.

        Raises Died or Hung if a new process does not become ready.
        """
        with self._lock:
            if self._over:
                return None
            if self._resting:
                return self._resting.pop()
            child = WorkerProcess()
            self._all.add(child)
        try:
            ready = child.answer(START_S)
            assert ready == READY
        except (Died, Hung):
            self.drop(child)
            raise
        return child

    def keep(self, child: WorkerProcess) -> None:
        """Store the process for another chunk; close it if the sweep is over."""
        child.reused = True
        with self._lock:
            if not self._over:
                self._resting.append(child)
                return
        child.close()

    def drop(self, child: WorkerProcess) -> bool:
        """Close the process, and return whether the sweep is still running."""
        with self._lock:
            self._all.remove(child)
        child.close()
        return not self._over

    def dismiss(self) -> None:
        """End all processes, and start no more of them."""
        with self._lock:
            self._over = True
            for child in self._all:
                child.kill()  # its thread, if it works for one, sees that it has ended, and closes it
        for child in self._resting:
            child.close()


_children: dict[str, _Children] = {}
"""The processes in this pool, by sweep."""


def dismiss(sweep: str) -> None:
    """End all processes of the sweep in this pool, and start no more of them."""
    _children.setdefault(sweep, _Children()).dismiss()


def run(sweep: str, encoded: bytes) -> list[bytes]:
    """Run an encoded chunk of the sweep, and return its encoded rows; fewer if the sweep is over.

    Raises Died or Hung if no new process for trials becomes ready.
    """
    chunk = _DECODER.decode(encoded)
    children = _children.setdefault(sweep, _Children())
    rows: list[bytes] = []
    timeout = chunk.options.timeout
    while len(rows) < len(chunk.trials) and (child := children.take()) is not None:
        asked = len(rows)
        began = time.perf_counter()
        try:
            child.ask(chunk.after(asked))
            for _ in chunk.trials[asked:]:
                rows.append(child.answer(timeout))
                began = time.perf_counter()
        except Hung:
            error = f"hung: no answer within {timeout:g} s"
        except Died as death:
            if child.reused and len(rows) == asked:  # a reused process may have ended earlier: try a new one
                children.drop(child)
                continue
            error = f"died: {death}"
        else:
            children.keep(child)
            break
        if not children.drop(child):
            break
        i = len(rows)
        took_s = time.perf_counter() - began
        rows.append(msgspec.msgpack.encode(lost(chunk.cell, chunk.trials[i], chunk.seeds[i], error, took_s)))
    return rows
