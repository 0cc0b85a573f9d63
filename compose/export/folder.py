"""The files that an export leaves: `run.mcap`, `frames.csv`, `ticks.csv` and `ticks.parquet`."""

from __future__ import annotations

from pathlib import Path

import msgspec

from compose import record
from compose.export.frames import in_time
from compose.export.recording import TooLong, write_mcap
from compose.export.tables import frames_csv, write_ticks
from compose.scene import recorded
from compose.status import UserError


class Exported(msgspec.Struct, frozen=True):
    """What has been written, and of what."""

    files: tuple[Path, ...]
    torn: dict[str, int]
    """bytes of a torn write at the end of a journal, by its name; of those that have any"""
    missing: tuple[str, ...]
    """journals of robots that are not there"""


def export(folder: Path, out: Path) -> Exported:
    """Write those of the record in `folder` into `out`.

    Raises OSError if there is no record, journal.CorruptJournal if it is damaged before its end,
    UserError if it is too long for a format, or `out` cannot be written.
    """
    books = record.books(folder)
    told = record.read(folder)
    there = [one.id for one in told.scenario.robots if record.agent_journal(one.id) in books]
    held = {robot: record.estimates(folder, robot) for robot in there}
    run = recorded.read(folder)
    record.make(out)
    mcap, frames, ticks, parquet = (
        out / name for name in ("run.mcap", "frames.csv", "ticks.csv", "ticks.parquet")
    )
    try:
        write_mcap(books, run, mcap)
        frames.write_text(frames_csv(in_time(books)), encoding="utf-8")
        ticks.write_text(record.ticks_csv(told), encoding="utf-8")
        write_ticks(told, held, parquet)
    except OSError as error:
        raise UserError(record.cannot_write(out, error)) from None
    except TooLong as error:
        raise UserError(str(error)) from None
    return Exported(
        files=(mcap, frames, ticks, parquet),
        torn={name: book.torn for name, book in books.items() if book.torn},
        missing=tuple([record.agent_journal(one.id) for one in told.scenario.robots if one.id not in there]),
    )
