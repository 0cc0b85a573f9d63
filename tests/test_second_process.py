"""A second process takes over tasks; whatever happens to it, the result is that of one process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import psutil
import pytest

from compose.launch import second_process
from compose.launch.second_process import OutputLine, Task, share
from compose.recording.run import read
from compose.view.export.folder import export
from protocol import files
from tests.commands import BOUND_S, tandem, until

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="there is a second process only on Linux")

PARENT = """
import os, signal, sys, time
from pathlib import Path
from protocol import files
from compose.launch.second_process import share

def task(name):
    with files.draft(Path(name)) as place:
        place.write_text(str(os.getpid()))
        while True:  # a signal just before a sleep does not end it
            time.sleep(0.01)

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell lets commands in the background ignore it
share([lambda: task("one"), lambda: task("two")], lambda lines: None)
"""
"""A process that shares two tasks which last for ever."""


@pytest.fixture(autouse=True)
def two_processors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two processors, on any machine."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})


def second_begins(folder: Path) -> Path:
    """Return the path of a file that appears when the second process has begun a task, with its pid."""
    return folder / "second"


def begin(folder: Path) -> None:
    """Let the file of `second_begins` appear."""
    files.write(second_begins(folder), str(os.getpid()))


def by_second(folder: Path, here: Callable[[], object], there: Callable[[], object]) -> Task:
    """Return a task: `there` in the second process and, once that has begun one, `here` in this one."""
    first = os.getpid()

    def task() -> Sequence[OutputLine]:
        if os.getpid() != first:
            begin(folder)
            there()
        else:
            until(lambda: second_begins(folder).exists(), "the second process has begun a task")
            here()
        return [OutputLine(str(os.getpid()))]

    return task


def nothing() -> None:
    """Do nothing."""


def shared(tasks: Sequence[Task]) -> list[str]:
    """Share `tasks`, and return the text of their lines."""
    lines: list[str] = []
    share(tasks, lambda some: lines.extend([line.text for line in some]))
    return lines


def assert_no_child() -> None:
    """Check that this process has no child that was forked for tasks."""
    with pytest.raises(ChildProcessError):
        os.waitpid(-1, os.WNOHANG)


def test_both_processes_do_tasks_and_their_lines_come_in_order(tmp_path: Path) -> None:
    meet = by_second(tmp_path, nothing, nothing)
    tasks: list[Task] = [meet, *[partial(_numbered, meet, number) for number in range(1, 40)]]
    lines: list[Sequence[OutputLine]] = []
    share(tasks, lines.append)
    assert [tuple(some[1:]) for some in lines] == [
        (),
        *[(OutputLine(str(n), error=True),) for n in range(1, 40)],
    ]
    assert {some[0].text for some in lines} == {str(os.getpid()), second_begins(tmp_path).read_text()}


def _numbered(task: Task, number: int) -> Sequence[OutputLine]:
    return [*task(), OutputLine(str(number), error=True)]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_tasks_of_a_second_process_that_is_killed_are_done_by_the_first(
    number: signal.Signals, tmp_path: Path
) -> None:
    task = by_second(tmp_path, nothing, lambda: os.kill(os.getpid(), number))
    assert shared([task] * 5) == [str(os.getpid())] * 5


def test_tasks_of_a_suspended_second_process_are_done_by_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(second_process, "SECOND_PROCESS_S", 0.2)
    monkeypatch.setattr(second_process, "END_S", 0.2)
    task = by_second(tmp_path, nothing, lambda: os.kill(os.getpid(), signal.SIGSTOP))
    assert shared([task] * 5) == [str(os.getpid())] * 5


def test_the_error_of_a_task_is_raised_by_the_first_process(tmp_path: Path) -> None:
    def fail() -> None:
        raise OSError(28, f"no space for {os.getpid()}")

    bad = by_second(tmp_path, fail, fail)
    with pytest.raises(OSError, match=f"no space for {os.getpid()}"):
        shared([by_second(tmp_path, nothing, fail), bad, bad])


@pytest.mark.parametrize("stage", ["check", "done"])
def test_an_error_ends_the_second_process_and_leaves_no_unfinished_file(stage: str, tmp_path: Path) -> None:
    first = os.getpid()

    def write(name: str) -> Sequence[OutputLine]:
        with files.draft(tmp_path / name) as place:
            place.write_text("begun")
            if os.getpid() == first:
                until(lambda: second_begins(tmp_path).exists(), "the second process has begun a task")
            elif name != "a":  # `done` is called for a first
                begin(tmp_path)
                time.sleep(BOUND_S)
        return ()

    def stop(*_: object) -> None:
        if second_begins(tmp_path).exists():
            raise InterruptedError

    began = time.monotonic()
    with pytest.raises(InterruptedError):
        share(
            [partial(write, name) for name in "abcd"],
            stop if stage == "done" else lambda _: None,
            stop if stage == "check" else nothing,
        )
    assert time.monotonic() - began < BOUND_S / 2
    assert not psutil.pid_exists(int(second_begins(tmp_path).read_text()))
    assert not list(tmp_path.glob(f"*{files.DRAFT}"))


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_the_second_process_ends_with_the_first(number: signal.Signals, tmp_path: Path) -> None:
    parent = subprocess.Popen([sys.executable, "-c", PARENT], cwd=tmp_path, stderr=subprocess.DEVNULL)
    drafts = [tmp_path / f".{name}.0{files.DRAFT}" for name in ("one", "two")]
    try:
        until(lambda: all(path.exists() and path.read_text() for path in drafts), "both tasks have begun")
        (second,) = {int(path.read_text()) for path in drafts} - {parent.pid}
        parent.send_signal(number)
        parent.wait(BOUND_S)
    finally:
        parent.kill()
        parent.wait()
    until(lambda: not psutil.pid_exists(second), "the second process has ended")
    left = [path for path in drafts if path.exists()]
    assert [int(path.read_text()) for path in left] == ([] if number == signal.SIGINT else [parent.pid])


@pytest.mark.parametrize("why", ["alone", "one processor", "no memory"])
def test_one_process_does_all_tasks_where_there_can_be_no_second(
    why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_memory() -> int:
        raise OSError(12, "Cannot allocate memory")

    if why == "one processor":
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    elif why == "no memory":
        monkeypatch.setattr(os, "fork", no_memory)
    lines: list[OutputLine] = []
    share([lambda: [OutputLine(str(os.getpid()))]] * 9, lines.extend, alone=why == "alone")
    assert lines == [OutputLine(str(os.getpid()))] * 9


def test_an_export_has_the_same_bytes_with_one_and_with_two_processes(tmp_path: Path) -> None:
    assert tandem("run", "noisy", "-q", "--out", tmp_path / "run").status == 0
    run = read(tmp_path / "run")
    one = export(run, tmp_path / "one", alone=True)
    two = export(run, tmp_path / "two", alone=False)
    assert [path.read_bytes() for path in two.files] == [path.read_bytes() for path in one.files]
