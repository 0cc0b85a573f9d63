"""The recording of a run: its folder, its journals and their content."""

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
    """Return the file name of the journal of the agent of `robot`."""
    return f"agent-{robot}.journal"


def robot_of(path: Path) -> str:
    """Return the robot of an agent's journal, from its file name."""
    return path.stem.removeprefix("agent-")


def journals_in(folder: Path) -> list[Path]:
    """Return the paths of the journals in `folder`, the world's first."""
    world = folder / WORLD_JOURNAL
    return [*([world] if world.exists() else []), *sorted(folder.glob(agent_journal("*")))]


@contextmanager
def folder_for(out: Path | None) -> Iterator[Path]:
    """Yield the folder of a recording: `out`, created if necessary, or a temporary one. Raises UserError."""
    if out is None:
        with tempfile.TemporaryDirectory(prefix="tandem-") as folder:
            yield Path(folder)
        return
    make(out)
    yield out


def make(out: Path) -> None:
    """Create the folder `out` and check that it is writable. Raises UserError if it is not."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise UserError(cannot_write(out, error)) from None


def cannot_write(out: Path, error: OSError) -> str:
    """Return the message for the user that `out` cannot be written."""
    return f"--out: {out} cannot be written: {error.strerror or error}"


class TickRecord(msgspec.Struct, frozen=True):
    """One tick of a run."""

    truth: Truth
    """The true poses at the tick."""
    commands: dict[str, Command]
    """The Commands of the tick, by robot, without those that were late."""


class Recording(msgspec.Struct, frozen=True):
    """The content of the world's journal of a run."""

    scenario: Scenario
    ticks: tuple[TickRecord, ...]
    """The ticks of the run, from tick 0."""
    end: MissionEnd | None
    """The end of the mission; None if the recording breaks off."""
    final_reports: dict[str, FinalReport]
    """The FinalReports, by robot."""


class JournalFile(msgspec.Struct, frozen=True):
    """A journal on disk."""

    frames: list[bytes]
    """The complete frames."""
    torn: int
    """The number of bytes of a torn write at the end."""


def read_journals(folder: Path) -> dict[str, JournalFile]:
    """Return the journals of the recording in `folder`, by file name; the world's is first.

    Raises OSError if there is no journal or one cannot be read, CorruptJournal if one contains anything other
    than frames.
    """
    names = sorted([path.name for path in folder.glob(agent_journal("*"))])
    if not names or (folder / WORLD_JOURNAL).exists():
        names.insert(0, WORLD_JOURNAL)
    return {name: JournalFile(*journal_file.torn(folder / name)) for name in names}


def read(folder: Path) -> Recording:
    """Return the run recorded in `folder`, from the world's journal.

    Raises OSError if there is no such journal, CorruptJournal if it is damaged before its end.
    """
    path = folder / WORLD_JOURNAL
    run = history(journal_file.read(path), path)
    if run.disorder is not None:
        raise journal_file.CorruptJournal(f"{path}: {run.disorder.what}")
    ticks = tuple([TickRecord(tick.world.truth, tick.commands) for tick in run.ticks])
    return Recording(run.scenario, ticks, run.end, run.final_reports)


def estimates(folder: Path, robot: str) -> tuple[Estimate, ...]:
    """Return the Estimate of each tick in the journal of `robot` in `folder`.

    Raises OSError if there is no such journal, CorruptJournal if it is damaged before its end, or
    belongs to another robot or another run.
    """
    past = past_of(folder, robot)
    return past.estimates if past is not None else ()


def past_of(folder: Path, robot: str) -> Past | None:
    """Return the content of the journal of `robot` in `folder`; None if it has no RobotConfig.

    Raises OSError and CorruptJournal like `estimates`.
    """
    from agent.process.agent_journal import past as past_in  # noqa: PLC0415  # the launcher needs no planner

    path = folder / agent_journal(robot)
    frames = list(journal_file.read(path))
    if is_blank(frames):
        return None
    past = past_in(frames, path)
    if past.config.robot != robot:
        raise journal_file.CorruptJournal(f"{path} is the journal of {past.config.robot}")
    world = folder / WORLD_JOURNAL
    head = list(islice(journal_file.read(world), 2)) if world.exists() else []
    if not is_blank(head) and not opened(head, world)[0].is_of(past.config):
        raise journal_file.CorruptJournal(
            f"{path}: belongs to another run: its configuration does not match the world's"
        )
    return past


@contextmanager
def user_errors(folder: Path) -> Iterator[None]:
    """Raise UserError, with one line, for every error that prevents reading the recording in `folder`."""
    try:
        yield
    except FileNotFoundError:
        raise UserError(f"{folder} contains no recording: there is no {WORLD_JOURNAL}") from None
    except OSError as error:
        raise UserError(f"{folder} cannot be read: {error.strerror or error}") from None
    except journal_file.CorruptJournal as error:
        raise UserError(str(error)) from None
