"""The files of a recording: its folder and the journals in it."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec

from compose.errors import FAILED, FULL_DISK, UserError, writing
from protocol.journal import journal_file
from protocol.journal.journal_file import CannotRecord, CorruptJournal
from protocol.messages import OfRobot
from world.scenario import Scenario

WORLD_JOURNAL = "world.journal"
ESTIMATE_CSV = "estimate.csv"
"""The file of `tandem estimate --out` that has the poses."""
KINDS = Scenario | OfRobot
"""The kinds of messages in any journal."""


def agent_journal(robot: str) -> str:
    """Return the file name of the journal of the agent of `robot`."""
    return f"agent-{robot}.journal"


def robot_of(name: str) -> str:
    """Return the robot of an agent's journal, from its file name."""
    return name.removeprefix("agent-").removesuffix(".journal")


def journals_in(folder: Path) -> list[Path]:
    """Return the paths of the journals in `folder`, the world's first, and of links to missing journals."""
    world = folder / WORLD_JOURNAL
    return [*([world] if os.path.lexists(world) else []), *sorted(folder.glob(agent_journal("*")))]


@contextmanager
def folder_for(out: Path | None) -> Iterator[Path]:
    """Yield the folder of a recording: `out`, created if necessary, or a temporary one. Raises UserError."""
    if out is None:
        with tempfile.TemporaryDirectory(prefix="tandem-") as folder:
            yield Path(folder)
        return
    make_folder(out)
    yield out


def make_folder(out: Path) -> None:
    """Create the folder `out` and check that it is writable. Raises UserError if it is not."""
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass


def not_recorded(error: CannotRecord) -> UserError:
    """Return the error for the user that a journal in the folder `--out` cannot be written."""
    found = UserError(f"--out: {error}")
    if error.errno in FULL_DISK:
        found.exit_status = FAILED
    return found


class JournalFile(msgspec.Struct, frozen=True):
    """A journal on disk."""

    frames: list[bytes]
    """The complete frames."""
    torn: int = 0
    """The number of bytes of a torn write at the end."""
    messages: list[Any] = []
    """The messages in `frames`, up to the first that is damaged or out of order."""
    problem: OSError | CorruptJournal | None = None
    """The error because of which not all of it can be read; None for a frame out of order."""


def opened(path: Path) -> JournalFile:
    """Return the journal at `path`, not decoded yet.

    An agent's journal that cannot be read is returned with its problem. Raises OSError or CorruptJournal for
    a world's journal that cannot be read, and OtherVersion for every journal of another version.
    """
    try:
        return JournalFile(*journal_file.torn(path))
    except (OSError, CorruptJournal) as error:
        if path.name == WORLD_JOURNAL or isinstance(error, journal_file.OtherVersion):
            raise
        return JournalFile([], problem=error)


@contextmanager
def user_errors(folder: Path) -> Iterator[None]:
    """Raise UserError, with one line, for every error that prevents reading the recording in `folder`."""
    try:
        yield
    except OSError as error:
        journals = journals_in(folder)
        if not folder.exists():
            raise UserError(f"{folder} does not exist") from None
        if isinstance(error, FileNotFoundError) and folder / WORLD_JOURNAL not in journals:
            hint = "; `tandem watch` and `tandem export --tum` read the estimate in it"
            hint = hint if (folder / ESTIMATE_CSV).exists() else ""
            raise UserError(f"{folder} contains no recording: there is no {WORLD_JOURNAL}{hint}") from None
        where = (error.filename if journals else None) or folder
        raise UserError(f"{where} cannot be read: {error.strerror or error}") from None
    except CorruptJournal as error:
        raise UserError(str(error)) from None
