"""Trials that go wrong, and a sweep of them: `python -m tests.misbehaving FUNCTION SPEC OUT`."""

from __future__ import annotations

import os
import sys
import tempfile
import threading
from pathlib import Path
from unittest.mock import patch

from msgspec.structs import replace

from agent.planning import planner
from agent.process.robot import Robot
from compose.launch import in_process
from compose.launch.signals import stop_by_signal
from compose.sweep import execution, spec, trial, worker_pool
from protocol.network.inbox import Inbox
from protocol.wire import encode

HANGS = "hangs"
"""a file that a trial leaves which hangs, and no other"""


class Owned(worker_pool.WorkerProcess):
    """Is given up only where a trial hangs, however long another takes."""

    def answer(self, timeout: float) -> bytes:
        """The next frame. Raises Hung where it hangs, and Died."""
        while True:
            try:
                return super().answer(timeout)
            except worker_pool.Hung:
                if Path(self._folder.name, HANGS).exists():
                    raise


def astray(one: trial.Trial) -> trial.TrialRow:
    """The second trial raises, the fourth ends its process, the sixth never ends; others are as they are."""
    match one.number:
        case 1:
            raise ValueError("two\nlines")
        case 3:
            os._exit(3)
        case 5:
            Path(tempfile.gettempdir(), HANGS).touch()
            threading.Event().wait()
    return trial.play(one)


def boastful(one: trial.Trial) -> trial.TrialRow:
    """In the third trial of a cell robots say that they know where they are before they do."""
    if one.number != 2:
        return trial.play(one)
    with patch.object(in_process, "Robot", Boaster):
        return trial.play(one)


class Boaster(Robot):
    """A robot whose estimates do not follow from what it knows."""

    def estimate(self) -> bytes:
        """Says that it is localised."""
        frame = encode(replace(planner.estimate(self.mind), localised=True))
        assert self._journal is not None
        self._journal.write(frame)
        return frame


def endless(one: trial.Trial) -> trial.TrialRow:
    """None ends; each says that it has begun."""
    Path(tempfile.gettempdir(), "playing").touch()
    threading.Event().wait()
    return trial.play(one)


def main(function: str, source: str, out: str) -> None:
    """Play the sweep so on two workers, as `tandem sweep` does."""
    inbox = Inbox("misbehaving")
    stop_by_signal(inbox)
    means = execution.ExecutionOptions(workers=2, play=f"tests.misbehaving:{function}")
    silent = execution.Progress(say=print, begin=lambda *_: None, done=lambda _: None)
    with patch.object(worker_pool, "WorkerProcess", Owned):
        results = execution.sweep(spec.load(source), Path(out), means, inbox, silent)
    print(f"{len(results.table)} rows, {results.stopped}")


if __name__ == "__main__":
    main(*sys.argv[1:])
