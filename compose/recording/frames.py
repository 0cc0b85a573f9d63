"""Every frame of a record, each with when it was journaled."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from heapq import merge
from typing import Any

import msgspec

from compose.recording.run import JournalFile
from protocol.journal.journal_file import CorruptJournal
from protocol.messages import (
    Command,
    DeadlineMissed,
    Environment,
    Estimate,
    FinalReport,
    Message,
    MissionEnd,
    Observation,
    OfRobot,
)
from protocol.wire import MAX_FRAME_BYTES, MalformedFrame, body, decode
from world.scenario import Scenario

OfWorld = Environment | Scenario | Command | DeadlineMissed | MissionEnd | FinalReport
"""what stands in a world's journal"""
KINDS = Scenario | OfRobot
"""what stands in a journal"""


class Journaled(msgspec.Struct, frozen=True):
    """One frame."""

    journal: str
    """the name of its file"""
    place: int
    """how many frames stand before it there"""
    tick: int
    """in which it was journaled; a Report that was heard late is of an earlier one"""
    message: Any
    """one of KINDS"""
    frame: bytes

    @property
    def kind(self) -> str:
        """Such as "observation"."""
        return kind_of(type(self.message))

    @property
    def body(self) -> bytes:
        """The frame without its head: msgpack. What is left out follows: the version, and the CRC of this."""
        return body(self.frame)


def kind_of(kind: type[msgspec.Struct]) -> str:
    """What messages of that kind are called on the wire."""
    return str(kind.__struct_config__.tag)


class Telling:
    """A journal's frames, as they are read. Raises CorruptJournal where one cannot be understood."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._place = 0
        self._tick = 0

    def of(self, frames: Iterable[bytes]) -> Iterator[Journaled]:
        """Those that come next."""
        for frame in frames:
            try:
                message: Message = decode(frame, KINDS, MAX_FRAME_BYTES)
            except MalformedFrame as error:
                raise CorruptJournal(f"{self._name}: {error}") from None
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


def in_time(books: Mapping[str, JournalFile]) -> Iterator[Journaled]:
    """Those of all journals, tick by tick; within one, journal by journal. Raises CorruptJournal."""
    each = [Telling(name).of(book.frames) for name, book in books.items()]
    return merge(*each, key=lambda one: one.tick)
