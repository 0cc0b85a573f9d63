"""A second process, which takes over some of a command's tasks where there are two processors."""

from __future__ import annotations

import gc
import os
import select
import signal
import struct
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple, NoReturn

import msgspec

from compose.launch.interruption import STOPPING
from compose.launch.parent_end import end_with_parent

FRAME_NUMBER = struct.Struct("<H")
"""The number of a task in the pipe from which both processes take the next one."""
MAX_TASKS = select.PIPE_BUF // FRAME_NUMBER.size
"""The largest number of tasks: all their numbers are written to the pipe before one is read."""
SECOND_SIGNAL_S = 0.05
"""The time in s between two looks for a signal while this process waits for the second one."""
SECOND_PROCESS_S = 60.0
"""The time in s that the second process has once this one has no more tasks; then it is killed."""
END_S = 2.0
"""The time in s that the second process has to remove the files that it is writing; then it is killed."""


class OutputLine(NamedTuple):
    """A line for the terminal."""

    text: str
    error: bool = False
    """True if it belongs on standard error."""


Task = Callable[[], Sequence[OutputLine]]
"""A task: it writes files, and returns the lines to print about them."""


def share(
    tasks: Sequence[Task],
    done: Callable[[Sequence[OutputLine]], object],
    check: Callable[[], object] = lambda: None,
    *,
    alone: bool = False,
) -> None:
    """Do all `tasks`, begun in their order, and call `done` with the lines of each in the same order.

    A second process takes over some of them, unless `alone` is set, there is one processor, or the fork
    fails. This process does what the second one does not finish, so that it raises the error of a task.
    `check` is called between tasks and while this process waits. If `check` or `done` raises, the second
    process is ended.
    """
    early: dict[int, Sequence[OutputLine]] = {}
    reported = 0
    with _numbered(tasks) as waiting, _second_process(tasks, waiting, alone=alone) as second:
        for number, lines in _finished(tasks, waiting, second, check):
            early[number] = lines
            while reported in early:
                done(early.pop(reported))
                reported += 1


class _Result(NamedTuple):
    """A task that the second process has finished."""

    number: int
    lines: tuple[OutputLine, ...]


class _SecondProcess:
    """The second process, as the first one sees it."""

    def __init__(self, pid: int, results: int) -> None:
        """`results` is the end of the pipe from which its results are read."""
        self.running = True
        """True as long as results may still arrive."""
        self._pid = pid
        self._results = results
        self._received = b""
        self._ended = False

    def results(self, timeout: float) -> list[_Result]:
        """Return the tasks finished since the last call; wait at most `timeout` s if there are none."""
        if not self.running or not select.select([self._results], [], [], timeout)[0]:
            return []
        received = os.read(self._results, 1 << 16)
        self.running = bool(received)
        *whole, self._received = (self._received + received).split(b"\n")
        return [msgspec.json.decode(line, type=_Result) for line in whole]

    def end(self) -> None:
        """End the process, unless it has ended, and wait for its end."""
        if self._ended:
            return
        self._ended = True
        give_up = time.monotonic() + END_S
        while os.waitpid(self._pid, os.WNOHANG) == (0, 0):
            # again and again: a signal that arrives just before a system call does not interrupt it
            os.kill(self._pid, signal.SIGTERM if time.monotonic() < give_up else signal.SIGKILL)
            os.kill(self._pid, signal.SIGCONT)
            time.sleep(SECOND_SIGNAL_S / 10)


def _finished(
    tasks: Sequence[Task], waiting: int, second: _SecondProcess | None, check: Callable[[], object]
) -> Iterator[tuple[int, Sequence[OutputLine]]]:
    """Yield the number and the lines of each task, when it is finished."""
    missing = dict(enumerate(tasks))

    def from_second(timeout: float) -> Iterator[tuple[int, Sequence[OutputLine]]]:
        for number, lines in second.results(timeout) if second is not None else ():
            del missing[number]
            yield number, lines

    for number in _taken(waiting):
        check()
        yield number, missing.pop(number)()
        yield from from_second(0.0)
    give_up = time.monotonic() + SECOND_PROCESS_S
    while second is not None and second.running and time.monotonic() < give_up:
        check()
        yield from from_second(SECOND_SIGNAL_S)
    if second is not None:
        second.end()
    for number, task in missing.items():
        check()
        yield number, task()


@contextmanager
def _numbered(tasks: Sequence[Task]) -> Iterator[int]:
    """Yield a pipe from which each read takes the number of the next task."""
    assert len(tasks) <= MAX_TASKS
    waiting, numbers = os.pipe()
    os.write(numbers, b"".join([FRAME_NUMBER.pack(number) for number in range(len(tasks))]))
    os.close(numbers)
    try:
        yield waiting
    finally:
        os.close(waiting)


def _taken(waiting: int) -> Iterator[int]:
    """Take the next task's number from the pipe `waiting`, until there is none."""
    while taken := os.read(waiting, FRAME_NUMBER.size):
        yield FRAME_NUMBER.unpack(taken)[0]


@contextmanager
def _second_process(tasks: Sequence[Task], waiting: int, *, alone: bool) -> Iterator[_SecondProcess | None]:
    """Yield a second process that takes tasks from now on, or None; it has ended after the block."""
    if alone or sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2 or len(tasks) < 2:
        yield None
        return
    gc.freeze()  # else garbage collection would copy the pages that both processes share
    results, reported = os.pipe()
    parent = os.getpid()
    # this process's handlers of signals are not for the new one
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)
    try:
        pid = os.fork()
        if not pid:
            _work(tasks, waiting, reported, parent)
    except OSError:
        pid = 0
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        os.close(reported)
    second = _SecondProcess(pid, results) if pid else None
    try:
        yield second
    finally:
        if second is not None:
            second.end()
        os.close(results)


def _work(tasks: Sequence[Task], waiting: int, reported: int, parent: int) -> NoReturn:
    """Do tasks in the forked process until none is left, or one fails: the first process repeats it."""
    with suppress(BaseException):
        os.setsid()
        for stopping in STOPPING:
            signal.signal(stopping, _leave)
        end_with_parent(parent, signal.SIGTERM)
        try:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPPING)
            with Path(os.devnull).open("w", encoding="utf-8") as nowhere:
                sys.stdout = sys.stderr = nowhere
                for number in _taken(waiting):
                    result = _Result(number, tuple(tasks[number]()))
                    os.write(reported, msgspec.json.encode(result) + b"\n")
        finally:
            _ignore_signals()  # the exception of a later signal would reach the code of the first process
    os._exit(0)


def _leave(number: int, _frame: object) -> NoReturn:
    """End the process by an exception, so that it removes the files that it is writing."""
    _ignore_signals()
    raise SystemExit(128 + number)


def _ignore_signals() -> None:
    for stopping in STOPPING:
        signal.signal(stopping, signal.SIG_IGN)
