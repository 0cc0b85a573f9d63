"""The files that an export leaves: `run.mcap`, `frames.csv`, `ticks.csv` and `ticks.parquet`."""

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
    """What has been written, and of what."""

    files: tuple[Path, ...]
    torn: dict[str, int]
    """bytes of a torn write at the end of a journal, by its name; of those that have any"""
    missing: tuple[str, ...]
    """journals of robots that are not there"""


class _Ticks(NamedTuple):
    """What goes into the tables of ticks."""

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
    """Write those of the record in `folder` into `out`.

    Calls `done` after each file, and `check` now and then, which may raise.
    Raises OSError if there is no record, journal.CorruptJournal if it is damaged before its end,
    UserError if it is too long for a format, or `out` cannot be written.
    """
    books = run.books(folder)
    check()
    robots, told = _of_world(folder, books) if WORLD_JOURNAL in books else _of_robots(folder)
    check()
    shown = recorded.read(folder)
    run.make(out)
    mcap, frames, ticks, parquet = paths = tuple([out / name for name in FILES])
    writers: dict[Path, Callable[[Path], object]] = {
        mcap: lambda path: write_mcap(books, shown, path, check),
        frames: lambda path: path.write_text(frames_csv(in_time(books), check), encoding="utf-8"),
        ticks: lambda path: path.write_text(table(told.rows), encoding="utf-8"),
        parquet: lambda path: write_ticks(told.rows, told.commands, told.held, told.period, path),
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
    """Of whom journals there should be, and what the tables say."""
    told = run.read(folder)
    ids = [robot.id for robot in told.scenario.robots]
    there = [robot for robot in ids if run.agent_journal(robot) in books]
    return ids, _Ticks(
        list(rows(told)),
        {(robot, at.truth.tick): command for at in told.moments for robot, command in at.commands.items()},
        {(robot, one.tick): one for robot in there for one in run.estimates(folder, robot)},
        told.scenario.mission.period,
    )


def _of_robots(folder: Path) -> tuple[list[str], _Ticks]:
    """The same without a world."""
    told = pasts(folder)
    if not told:
        raise UserError(f"{folder}: there is no {WORLD_JOURNAL}, and no robot in it was briefed")
    briefings = [past.config for past in told.values()]
    return sorted({*told, *[one.peer for one in briefings]}), _Ticks(
        list(rows_of(told)),
        {
            (robot, step.observation.tick): step.command
            for robot, past in told.items()
            for step in past.steps
            if step.command is not None
        },
        {(robot, one.tick): one for robot, past in told.items() for one in past.estimates},
        briefings[0].mission.period,
    )
