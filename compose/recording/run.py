"""The record of a run: what its journals hold."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from compose.errors import UserError
from protocol.journal import journal_file
from protocol.journal.environment import is_blank
from protocol.messages import Command, Estimate, FinalReport, MissionEnd
from world.scenario import Scenario
from world.truth import Truth
from world.world_journal import history, opened

if TYPE_CHECKING:
    from agent.process.agent_journal import Past

WORLD_JOURNAL = "world.journal"


def agent_journal(robot: str) -> str:
    """The name of the file that `robot` keeps its record in."""
    return f"agent-{robot}.journal"


def robot_of(path: Path) -> str:
    """Whose record an agent's journal is, by its name."""
    return path.stem.removeprefix("agent-")


def journals_in(folder: Path) -> list[Path]:
    """Those of a record that are there, the world's first."""
    world = folder / WORLD_JOURNAL
    return [*([world] if world.exists() else []), *sorted(folder.glob(agent_journal("*")))]


@contextmanager
def folder_for(out: Path | None) -> Iterator[Path]:
    """Where a record goes: `out`, or a folder that is gone afterwards. Raises UserError."""
    if out is None:
        with tempfile.TemporaryDirectory(prefix="tandem-") as folder:
            yield Path(folder)
        return
    make(out)
    yield out


def make(out: Path) -> None:
    """See to it that `out` is a folder that can be written. Raises UserError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise UserError(cannot_write(out, error)) from None


def cannot_write(out: Path, error: OSError) -> str:
    """What to tell the user of `error`."""
    return f"--out: {out} cannot be written: {error.strerror or error}"


class TickRecord(msgspec.Struct, frozen=True):
    """One tick: where everyone was, and what everyone then set out to do."""

    truth: Truth
    commands: dict[str, Command]


class Recording(msgspec.Struct, frozen=True):
    """A run, whole."""

    scenario: Scenario
    moments: tuple[TickRecord, ...]
    end: MissionEnd | None
    """none if the record breaks off"""
    final_reports: dict[str, FinalReport]


class JournalFile(msgspec.Struct, frozen=True):
    """A journal, as it is found."""

    frames: list[bytes]
    torn: int
    """bytes of a torn write behind them"""


def books(folder: Path) -> dict[str, JournalFile]:
    """Every journal of the record in `folder`, by its name; the world's is the first, if there is one.

    Raises OSError if there is none at all or one cannot be read, journal.CorruptJournal where something
    stands that is no frame.
    """
    names = sorted([path.name for path in folder.glob(agent_journal("*"))])
    if not names or (folder / WORLD_JOURNAL).exists():
        names.insert(0, WORLD_JOURNAL)
    return {name: JournalFile(*journal_file.torn(folder / name)) for name in names}


def read(folder: Path) -> Recording:
    """The record of the run in `folder`: its world's journal, folded.

    Raises OSError if there is none, journal.CorruptJournal if it is damaged before its end.
    """
    path = folder / WORLD_JOURNAL
    told = history(journal_file.read(path), path)
    if told.disorder is not None:
        raise journal_file.CorruptJournal(f"{path}: {told.disorder.what}")
    moments = tuple([TickRecord(tick.world.truth, tick.commands) for tick in told.ticks])
    return Recording(told.scenario, moments, told.end, told.final_reports)


def estimates(folder: Path, robot: str) -> tuple[Estimate, ...]:
    """What `robot` held possible, tick by tick: of its own journal in the record in `folder`.

    Raises OSError if there is none, journal.CorruptJournal if it is damaged before its end, or another's.
    """
    told = past_of(folder, robot)
    return told.estimates if told is not None else ()


def past_of(folder: Path, robot: str) -> Past | None:
    """What `robot` journaled in the record in `folder`; None if it was killed before it was briefed.

    Raises like `estimates`.
    """
    from agent.process.agent_journal import past  # noqa: PLC0415  # whoever launches, and reads how it went, needs no planner

    path = folder / agent_journal(robot)
    frames = list(journal_file.read(path))
    if is_blank(frames):
        return None
    told = past(frames, path)
    if told.config.robot != robot:
        raise journal_file.CorruptJournal(f"{path} is the journal of {told.config.robot}")
    world = folder / WORLD_JOURNAL
    head = list(islice(journal_file.read(world), 2)) if world.exists() else []
    if not is_blank(head) and not opened(head, world)[0].is_of(told.config):
        raise journal_file.CorruptJournal(f"{path}: another run's: its briefing is not this world's")
    return told


@contextmanager
def legible(folder: Path) -> Iterator[None]:
    """Whatever keeps the record in `folder` from being read is a line for the user. Raises UserError."""
    try:
        yield
    except FileNotFoundError:
        raise UserError(f"{folder} holds no record: there is no {WORLD_JOURNAL}") from None
    except OSError as error:
        raise UserError(f"{folder} cannot be read: {error.strerror or error}") from None
    except journal_file.CorruptJournal as error:
        raise UserError(str(error)) from None
