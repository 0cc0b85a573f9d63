"""Sweeps in this process: their files, how they run, and what they leave."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from compose.sweep import execution, spec
from compose.sweep.worker import PLAY
from protocol.network.inbox import Inbox
from tests.commands import PAPER_1, Ended, tandem, temporary_in, until

RANDOM = PAPER_1.replace("start", "# start")
"""A scenario with random starts."""


BOTH = """
name = "both"
scenario = "base.toml"
trials = 12
seed = 5
[[axis]]
field = "robot.b.anchor[0]"
values = [10.0, 8]
[[axis]]
field = "planner.name"
values = ["paper", "assured"]
paired = true
"""


LENGTHY = BOTH.replace("[10.0, 8]", "[60.0]").replace("trials = 12", "trials = 40")
"""A sweep that takes several seconds."""


ASTRAY = 'name = "astray"\nscenario = "base.toml"\ntrials = 8\n'


HASTY = ASTRAY + "trial_timeout = 1.5\n"
"""A sweep only for trials that hang; others may take longer than its timeout on a busy machine."""


def trial_processes(tmp_path: Path) -> list[int]:
    return [
        pid
        for pid in map(int, filter(str.isdigit, os.listdir("/proc")))
        if (words := said_by(pid))
        and words[:3] == ["tandem", "sweep", "worker"]
        and words[-1].startswith(f"{tmp_path}/")
    ]


def said_by(pid: int) -> list[str]:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode().replace("\0", " ").split()
    except OSError:  # ended meanwhile
        return []


def rows(out: Path) -> list[dict[str, Any]]:
    """Return all rows without their wall times."""
    return [
        {name: value for name, value in row.items() if name != "wall_s"}
        for row in pq.read_table(out / "trials.parquet").to_pylist()
    ]


def summary_rows(out: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((out / "summary.csv").read_text().splitlines()))


def sweep(folder: Path, spec: str, out: str, *arguments: str) -> Ended:
    return tandem("sweep", spec, "--out", out, *arguments, cwd=folder)


def played(
    folder: Path,
    source: str,
    out: str,
    *,
    trials: int | None = None,
    workers: int = 2,
    play: str = PLAY,
    audit: bool = True,
    done: Callable[[int], None] = lambda _: None,
) -> execution.Results:
    """Run the sweep as the command does, without figures and output."""
    silent = execution.Progress(say=print, begin=lambda *_: None, done=done)
    sweep = spec.load(str(folder / source), trials=trials)
    return execution.sweep(
        sweep,
        folder / out,
        execution.ExecutionOptions(workers=workers, play=play, audit=audit),
        Inbox("test"),
        silent,
    )


def parts(out: Path) -> int:
    return len(list(out.glob("parts/*.parquet")))


def with_files(folder: Path) -> Path:
    """Return `folder` with base.toml, both.toml, lengthy.toml, astray.toml and hasty.toml."""
    (folder / "base.toml").write_text(RANDOM)
    for name, text in (("both", BOTH), ("lengthy", LENGTHY), ("astray", ASTRAY), ("hasty", HASTY)):
        (folder / f"{name}.toml").write_text(text)
    return folder


@contextmanager
def nothing_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Put all temporary folders into tmp_path, and check at the end that no processes or files remain."""
    folder = temporary_in(tmp_path, monkeypatch)
    yield
    until(lambda: not trial_processes(tmp_path), "no process for trials is left")
    assert list(folder.iterdir()) == []
