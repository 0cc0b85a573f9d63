"""What the commands that play a mission share: its scenario, its record, and what is said of it."""

from __future__ import annotations

import argparse
import secrets
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from compose import record
from compose.scenario import BadScenario, load
from compose.status import LOCALISED, NOT_LOCALISED, UserError
from world.scenario import Scenario


def validated(options: argparse.Namespace) -> Scenario:
    """The scenario that the user named. Raises UserError."""
    try:
        return load(options.scenario, seed=options.seed)
    except BadScenario as error:
        raise UserError(str(error)) from None


def named(options: argparse.Namespace, scenario: Scenario) -> str:
    """What the run is called: as the user says, else the scenario's name and something of its own."""
    return getattr(options, "run", None) or f"{scenario.name}-{secrets.token_hex(3)}"


@contextmanager
def record_folder(out: Path | None) -> Iterator[Path]:
    """Where the record goes: `out`, or a folder that is gone afterwards. Raises UserError."""
    if out is None:
        with tempfile.TemporaryDirectory(prefix="tandem-") as folder:
            yield Path(folder)
        return
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise UserError(cannot_write(out, error)) from None
    yield out


def cannot_write(out: Path | None, error: OSError) -> str:
    """What to tell the user of `error`."""
    return f"--out: {out} cannot be written: {error.strerror or error}"


@contextmanager
def progress(options: argparse.Namespace, scenario: Scenario, folder: Path) -> Iterator[None]:
    """Show the run while it runs, where somebody can see it."""
    if options.quiet or not sys.stdout.isatty():
        yield
        return
    from compose import show  # noqa: PLC0415  # where nothing is shown, nothing is loaded to show it

    with show.live(scenario, folder):
        yield


def break_off(options: argparse.Namespace, folder: Path, reason: str, began: float) -> None:
    """Leave the views of a record that has no end, if it is to stay; as far as there is a record."""
    if options.out is None:
        return
    with suppress(OSError, ValueError):
        played = record.read(folder)
        summary = record.summary(played, "processes", round(time.perf_counter() - began, 6))
        record.leave(played, summary | {"reason": reason}, folder)


def conclude(
    options: argparse.Namespace,
    played: record.Record,
    folder: Path | None,
    mode: record.Mode,
    began: float,
) -> int:
    """Leave the views of the record in `folder`, if it is to stay, and say how it went."""
    summary = record.summary(played, mode, round(time.perf_counter() - began, 6))
    if folder is not None and options.out is not None:
        record.leave(played, summary, folder)
    if options.quiet:
        print(record.outcome_line(summary))
    else:
        from compose import show  # noqa: PLC0415  # as above

        show.result(summary)
    return LOCALISED if summary["outcome"] == "localised" else NOT_LOCALISED
