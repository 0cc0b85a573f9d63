"""The files of an export: `run.mcap` with a layout for it, `frames.csv`, `ticks.csv` and `ticks.parquet`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec

from compose.errors import CannotWrite, UserError
from compose.recording.frames import in_time
from compose.recording.recording_files import agent_journal, make_folder
from compose.recording.rows import MessageRow, TickRow, csv_text, message_rows, tick_rows
from compose.recording.run import Run
from compose.view.export.parquet import write_ticks
from compose.view.foxglove.layout import layout
from compose.view.foxglove.mcap import TooLong, mcap
from compose.view.recorded import checked, scenes_of
from protocol import files


class Exported(msgspec.Struct, frozen=True):
    """The result of an export."""

    files: tuple[Path, ...]
    """The written files."""
    torn: dict[str, int]
    """The size in bytes of an incomplete last frame, by the journal's name; only journals that have one."""
    missing: tuple[str, ...]
    """The names of missing robot journals."""


FILES = ("run.mcap", "run.foxglove.json", "frames.csv", "ticks.csv", "ticks.parquet")


def export(
    run: Run,
    out: Path,
    *,
    done: Callable[[], object] = lambda: None,
    check: Callable[[], object] = lambda: None,
) -> Exported:
    """Write the files for `run` to `out`.

    Calls `done` after each file, and `check` between steps, which may raise.
    Raises OSError or CorruptJournal if a journal cannot be read to its end, UserError if there is no
    configuration, the run is too long for a format or `out` cannot be written.
    """
    robots, setup = checked(run)
    check()
    frames = in_time(run)
    ticks = list(tick_rows(run))
    check()
    make_folder(out)
    paths = tuple([out / name for name in FILES])
    writers: Sequence[Callable[[Path], object]] = (
        lambda path: path.write_bytes(mcap(setup, frames, scenes_of(run), check)),
        lambda path: path.write_bytes(layout(setup)),
        lambda path: path.write_text(csv_text(MessageRow, message_rows(frames, check)), encoding="utf-8"),
        lambda path: path.write_text(csv_text(TickRow, ticks), encoding="utf-8"),
        lambda path: write_ticks(run, ticks, setup.mission.period, path),
    )
    try:
        for write, path in zip(writers, paths, strict=True):
            check()
            with files.draft(path) as place:
                write(place)
            done()
    except OSError as error:
        raise CannotWrite(out, error) from None
    except TooLong as error:
        raise UserError(str(error)) from None
    names = [agent_journal(robot) for robot in robots]
    return Exported(
        files=paths,
        torn={name: journal.torn for name, journal in run.journals.items() if journal.torn},
        missing=tuple([name for name in names if name not in run.journals]),
    )
