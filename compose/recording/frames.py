"""The frames of a recording, each with the tick in which it was journaled."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import msgspec
from msgspec.structs import astuple

from compose.recording.recording_files import KINDS
from compose.recording.run import Run
from protocol.journal.journal_file import message_in
from protocol.messages import (
    Command,
    DeadlineMissed,
    Environment,
    Estimate,
    FinalReport,
    Localised,
    Message,
    MissionEnd,
    Observation,
)
from protocol.wire import body
from world.scenario import Scenario

OfWorld = Environment | Scenario | Command | DeadlineMissed | MissionEnd | FinalReport
"""The kinds of messages in the world's journal."""


class Journaled(msgspec.Struct, frozen=True):
    """A frame of a journal."""

    journal: str
    """File name of the journal."""
    place: int
    """Number of frames before it in the journal."""
    tick: int
    """Tick in which it was journaled; a Report that was received late is of an earlier tick."""
    message: Any
    """Decoded message, one of KINDS."""
    frame: bytes
    """Encoded message."""

    @property
    def kind(self) -> str:
        """The name of the kind of message on the wire, such as "observation"."""
        return kind_of(type(self.message))

    @property
    def body(self) -> bytes:
        """The frame without its head, as msgpack. The head is the version and the CRC of the body."""
        return body(self.frame)

    @property
    def json(self) -> str:
        """The message as JSON, with the names of its fields."""
        return msgspec.json.encode(_named(self.message)).decode()


def _named(value: Any) -> Any:
    """Return a message, or a value in one, with the names of its fields."""
    if isinstance(value, tuple):
        return [_named(one) for one in value]
    if not isinstance(value, msgspec.Struct):
        return value
    named = {
        name: one if type(one) in _PLAIN else _named(one)
        for name, one in zip(value.__struct_encode_fields__, astuple(value), strict=True)
    }
    return {"verdict": "localised", **named} if isinstance(value, Localised) else named


_PLAIN = frozenset((int, float, str, bool, type(None)))
"""The types of values without parts."""


def kind_of(kind: type[msgspec.Struct]) -> str:
    """Return the name of that kind of message on the wire."""
    return str(kind.__struct_config__.tag)


class JournalDecoder:
    """A reader of the frames of one journal, which finds their ticks. They may be given in parts."""

    def __init__(self, name: str) -> None:
        """`name` is the file name of the journal."""
        self._name = name
        self._place = 0
        self._tick = 0

    def of(self, messages: Iterable[Message], frames: Iterable[bytes]) -> Iterator[Journaled]:
        """Yield the next messages of the journal, whose frames are `frames`."""
        for message, frame in zip(messages, frames, strict=False):
            match message:
                case (
                    Observation(tick)
                    | Command(tick)
                    | Estimate(tick)
                    | DeadlineMissed(tick)
                    | MissionEnd(tick)
                ):
                    self._tick = max(self._tick, tick)
            yield Journaled(self._name, self._place, self._tick, message, frame)
            self._place += 1

    def decoded(self, frames: Iterable[bytes]) -> Iterator[Journaled]:
        """Yield the next frames of the journal. Raises CorruptJournal if one cannot be decoded."""
        for frame in frames:
            yield from self.of([message_in(frame, KINDS, self._name)], [frame])


def in_time(run: Run) -> list[Journaled]:
    """Return the messages of all journals by tick, and within a tick in the order of the journals."""
    each = [JournalDecoder(name).of(one.messages, one.frames) for name, one in run.journals.items()]
    return sorted([one for some in each for one in some], key=lambda one: one.tick)
