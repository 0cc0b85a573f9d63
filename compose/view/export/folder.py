"""The files of an export: `run.mcap`, `frames.csv`, `ticks.csv` and `ticks.parquet`."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import NamedTuple

import msgspec

from compose.errors import UserError
from compose.recording import run
from compose.recording.frames import in_time
from compose.recording.robots import pasts
from compose.recording.run import WORLD_JOURNAL
from compose.recording.ticks_csv import TickRow, rows, rows_of, table
from compose.view import recorded
from compose.view.export.parquet import At, frames_csv, write_ticks
from compose.view.foxglove.mcap import TooLong, write_mcap
from protocol import files
from protocol.messages import Command, Estimate


class Exported(msgspec.Struct, frozen=True):
    """The result of an export."""

    files: tuple[Path, ...]
    """The written files."""
    torn: dict[str, int]
    """The size in bytes of an incomplete last frame, by the journal's name; only journals that have one."""
    missing: tuple[str, ...]
    """The names of missing robot journals."""


class _Ticks(NamedTuple):
    """The data for the tables of ticks. `period` is T_s in s."""

    rows: list[TickRow]
    commands: dict[At, Command]
    held: dict[At, Estimate]
    period: float


FILES = ("run.mcap", "frames.csv", "ticks.csv", "ticks.parquet")


def export(
    folder: Path,
    out: Path,
    *,
    done: Callable[[], object] = lambda: None,
    check: Callable[[], object] = lambda: None,
) -> Exported:
    """Write the files for the recording in `folder` to `out`.

    Calls `done` after each file, and `check` between steps, which may raise.
    Raises OSError if there is no recording, journal_file.CorruptJournal if it is damaged before its end,
    UserError if it is too long for a format or `out` cannot be written.
    """
    books = run.read_journals(folder)
    check()
    robots, tables = _of_world(folder, books) if WORLD_JOURNAL in books else _of_robots(folder)
    check()
    shown = recorded.read(folder)
    run.make(out)
    mcap, frames, ticks, parquet = paths = tuple([out / name for name in FILES])
    writers: dict[Path, Callable[[Path], object]] = {
        mcap: lambda path: write_mcap(books, shown, path, check),
        frames: lambda path: path.write_text(frames_csv(in_time(books), check), encoding="utf-8"),
        ticks: lambda path: path.write_text(table(tables.rows), encoding="utf-8"),
        parquet: lambda path: write_ticks(tables.rows, tables.commands, tables.held, tables.period, path),
    }
    try:
        for path, write in writers.items():
            check()
            with files.draft(path) as place:
                write(place)
            done()
    except OSError as error:
        raise UserError(run.cannot_write(out, error)) from None
    except TooLong as error:
        raise UserError(str(error)) from None
    names = [run.agent_journal(robot) for robot in robots]
    return Exported(
        files=paths,
        torn={name: book.torn for name, book in books.items() if book.torn},
        missing=tuple([name for name in names if name not in books]),
    )


def _of_world(folder: Path, books: Collection[str]) -> tuple[list[str], _Ticks]:
    """Return the ids of all robots and the tables' data, from a recording with the world's journal."""
    recording = run.read(folder)
    ids = [robot.id for robot in recording.scenario.robots]
    there = [robot for robot in ids if run.agent_journal(robot) in books]
    return ids, _Ticks(
        list(rows(recording)),
        {(robot, at.truth.tick): command for at in recording.ticks for robot, command in at.commands.items()},
        {(robot, one.tick): one for robot in there for one in run.estimates(folder, robot)},
        recording.scenario.mission.period,
    )


def _of_robots(folder: Path) -> tuple[list[str], _Ticks]:
    """Return the same data from a recording in hardware mode. Raises UserError if it has no configuration."""
    robots = pasts(folder)
    if not robots:
        raise UserError(f"{folder}: there is no {WORLD_JOURNAL}, and no robot's journal has a configuration")
    configs = [past.config for past in robots.values()]
    return sorted({*robots, *[one.peer for one in configs]}), _Ticks(
        list(rows_of(robots)),
        {
            (robot, step.observation.tick): step.command
            for robot, past in robots.items()
            for step in past.steps
            if step.command is not None
        },
        {(robot, one.tick): one for robot, past in robots.items() for one in past.estimates},
        configs[0].mission.period,
    )
