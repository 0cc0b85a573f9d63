"""The files that an export leaves: `run.mcap`, `frames.csv`, `ticks.csv` and `ticks.parquet`."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import NamedTuple

import msgspec

from compose import record, worldless
from compose.export.frames import in_time
from compose.export.recording import TooLong, write_mcap
from compose.export.tables import At, frames_csv, write_ticks
from compose.scene import recorded
from compose.status import UserError
from compose.ticks import Row, rows, table
from protocol.messages import Drive, Estimate


class Exported(msgspec.Struct, frozen=True):
    """What has been written, and of what."""

    files: tuple[Path, ...]
    torn: dict[str, int]
    """bytes of a torn write at the end of a journal, by its name; of those that have any"""
    missing: tuple[str, ...]
    """journals of robots that are not there"""


class _Ticks(NamedTuple):
    """What goes into the tables of ticks."""

    rows: list[Row]
    drives: dict[At, Drive]
    held: dict[At, Estimate]
    period: float
    missing: tuple[str, ...]
    """robots of which there is no journal"""


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
    books = record.books(folder, alone=True)
    told = _of_robots(folder) if worldless.is_worldless(folder) else _of_world(folder, books)
    run = recorded.read(folder)
    record.make(out)
    mcap, frames, ticks, parquet = files = tuple([out / name for name in FILES])
    writers: dict[Path, Callable[[], object]] = {
        mcap: lambda: write_mcap(books, run, mcap, check),
        frames: lambda: frames.write_text(frames_csv(in_time(books), check), encoding="utf-8"),
        ticks: lambda: ticks.write_text(table(told.rows), encoding="utf-8"),
        parquet: lambda: write_ticks(told.rows, told.drives, told.held, told.period, parquet),
    }
    try:
        for write in writers.values():
            write()
            done()
    except OSError as error:
        raise UserError(record.cannot_write(out, error)) from None
    except TooLong as error:
        raise UserError(str(error)) from None
    return Exported(
        files=files,
        torn={name: book.torn for name, book in books.items() if book.torn},
        missing=tuple([record.agent_journal(robot) for robot in told.missing]),
    )


def _of_world(folder: Path, books: Collection[str]) -> _Ticks:
    told = record.read(folder)
    ids = [robot.id for robot in told.scenario.robots]
    there = [robot for robot in ids if record.agent_journal(robot) in books]
    return _Ticks(
        list(rows(told)),
        {(robot, at.truth.tick): drive for at in told.moments for robot, drive in at.drives.items()},
        {(robot, one.tick): one for robot in there for one in record.estimates(folder, robot)},
        told.scenario.mission.period,
        tuple([robot for robot in ids if robot not in there]),
    )


def _of_robots(folder: Path) -> _Ticks:
    told = worldless.pasts(folder)
    if not told:
        raise FileNotFoundError(folder)
    briefings = [past.briefing for past in told.values()]
    return _Ticks(
        list(worldless.rows(told)),
        {
            (robot, step.sense.tick): step.drive
            for robot, past in told.items()
            for step in past.steps
            if step.drive is not None
        },
        {(robot, one.tick): one for robot, past in told.items() for one in past.estimates},
        briefings[0].mission.period,
        tuple([one.peer for one in briefings if one.peer not in told]),
    )
