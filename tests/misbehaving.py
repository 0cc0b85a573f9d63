"""Trials that fail, and a sweep that runs them: `python -m tests.misbehaving FUNCTION SPEC OUT`."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import threading
from pathlib import Path
from unittest.mock import patch

from msgspec.structs import replace

from agent.process.robot import Robot
from compose.launch import in_process
from compose.launch.forked import launcher
from compose.launch.signals import stop_by_signal
from compose.sweep import execution, spec, trial, worker_pool
from protocol.network.inbox import Inbox
from protocol.wire import encode

HANGS = "hangs"
"""The name of the file that a trial writes before it hangs."""


class Owned(worker_pool.WorkerProcess):
    """A process for trials whose timeout applies only to trials that hang, however slow the machine is."""

    def answer(self, timeout: float) -> bytes:
        """Return the next message. Raises TimeoutError if the trial hangs, and EOFError if it ends."""
        while True:
            try:
                return super().answer(timeout)
            except TimeoutError:
                if Path(self._folder.name, HANGS).exists():
                    raise


def astray(one: trial.Trial) -> trial.TrialRow:
    """Run a trial; the second raises an error, the fourth ends its process, and the sixth never ends."""
    match one.number:
        case 1:
            raise ValueError("two\nlines")
        case 3:
            os._exit(3)
        case 5:
            Path(tempfile.gettempdir(), HANGS).touch()
            threading.Event().wait()
    return trial.run_trial(one)


def boastful(one: trial.Trial) -> trial.TrialRow:
    """Run a trial; in the third of a cell, estimates report too early that robots are localised."""
    if one.number != 2:
        return trial.run_trial(one)
    with patch.object(in_process, "Robot", Boaster):
        return trial.run_trial(one)


class Boaster(Robot):
    """A robot whose estimates do not follow from its state."""

    def estimate(self) -> bytes:
        """Return and journal an estimate that reports the robot as localised."""
        frame = encode(replace(self.planner.estimate(self.state), localised=True))
        assert self._journal is not None
        self._journal.write(frame)
        return frame


def endless(one: trial.Trial) -> trial.TrialRow:
    """Run a trial that writes the file `playing` and never ends."""
    Path(tempfile.gettempdir(), "playing").touch()
    threading.Event().wait()
    return trial.run_trial(one)


def stubborn() -> None:
    """Ignore SIGTERM, say so to the launcher, and never end."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    launcher().send_bytes(b"ready")
    signal.pause()


def main(function: str, source: str, out: str) -> None:
    """Run the sweep with `function` on two workers, as `tandem sweep` does."""
    inbox = Inbox("misbehaving")
    stop_by_signal(inbox)
    means = execution.ExecutionOptions(workers=2, play=f"tests.misbehaving:{function}")
    silent = execution.Progress(say=print, begin=lambda *_: None, done=lambda _: None)
    with patch.object(worker_pool, "WorkerProcess", Owned):
        results = execution.sweep(spec.load(source), Path(out), means, inbox, silent)
    print(f"{len(results.table)} rows, {results.stopped}")


if __name__ == "__main__":
    main(*sys.argv[1:])
