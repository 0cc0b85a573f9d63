"""`kills.jsonl`: the processes that were killed in a run, one line each.

The launcher writes the file beside the journals. Those do not show that a process was killed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from compose.recording.recording_files import KINDS, WORLD_JOURNAL, agent_journal
from compose.scenario.kills import WORLD, Kill, Point
from protocol import documents, files
from protocol.journal import journal_file
from protocol.journal.journal_file import CorruptJournal
from protocol.messages import Command, DeadlineMissed, Observation
from protocol.wire import MAX_FRAME_BYTES, decode

KILLS = "kills.jsonl"
"""The file's name."""
MOST_KILLS_BYTES = 1 << 20
"""The greatest size of the file that is read, about 14 000 lines."""
_Count = Annotated[int, Meta(ge=0)]


class Killed(msgspec.Struct, frozen=True):
    """A process that was killed."""

    who: str
    """The id of a robot, or WORLD."""
    tick: _Count
    point: Point
    """The point of the tick at which it was killed."""
    after: Annotated[float, Meta(ge=0.0)] | None
    """Time in s until it was started again; None if it was not."""
    replayed_ticks: _Count
    """The number of ticks in its journal. Started again, it replays them before it goes on."""


def add_kill(folder: Path, kill: Kill) -> None:
    """Append to the file in `folder` the process that `kill` has ended, before it is started again.

    Raises OSError if its journal cannot be read or the file cannot be written, and CorruptJournal or
    MalformedFrame if the journal is damaged.
    """
    journal = folder / (WORLD_JOURNAL if kill.who == WORLD else agent_journal(kill.who))
    messages = [decode(frame, KINDS, MAX_FRAME_BYTES) for frame in journal_file.torn(journal)[0]]
    ticks = {
        message.tick for message in messages if isinstance(message, Observation | Command | DeadlineMissed)
    }
    killed = Killed(kill.who, kill.tick, kill.point, kill.after, len(ticks))
    with (folder / KILLS).open("ab") as file:
        file.write(msgspec.json.encode(killed) + b"\n")


def kills_in(folder: Path) -> tuple[tuple[Killed, ...], str | None]:
    """Return the processes that were killed in the run recorded in `folder`, in the order of the file.

    If the file cannot be read, there are none, and the second value is a line for the user that says why: the
    recording is complete without it.
    """
    path, found = folder / KILLS, []
    try:
        lines = files.read_bytes(path, MOST_KILLS_BYTES).split(b"\n")[:-1]
        for number, line in enumerate(lines, 1):  # a line without an end is being written
            try:
                found.append(documents.json_value(line, Killed))
            except msgspec.MsgspecError as error:
                raise CorruptJournal(f"line {number}: {error}") from None
    except FileNotFoundError:
        return (), None
    except (OSError, CorruptJournal) as error:
        why = getattr(error, "strerror", None) or error
        return (), f"{path}: {why}; the recording is read without the processes that were killed"
    return tuple(found), None
