"""The frames of a recording, each with the tick in which it was journaled."""

from __future__ import annotations

from typing import Any

import msgspec
from msgspec.structs import astuple

from compose.recording.run import Run
from protocol.messages import Command, DeadlineMissed, Estimate, Localised, MissionEnd, Observation


class Journaled(msgspec.Struct, frozen=True):
    """A frame of a journal."""

    journal: str
    """File name of the journal."""
    place: int
    """Number of frames before it in the journal."""
    tick: int
    """Tick in which it was journaled; a Report that was received late is of an earlier tick."""
    message: Any
    """Decoded message."""
    frame: bytes
    """Encoded message."""

    @property
    def kind(self) -> str:
        """The name of the kind of message on the wire, such as "observation"."""
        return kind_of(type(self.message))

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


def verdict_name(command: Command | None) -> str | None:
    """Return `localised`, `undecided` or `inconsistent`; None without a Command, or one without a verdict."""
    return kind_of(type(command.verdict)) if command is not None and command.verdict is not None else None


def in_time(run: Run) -> list[Journaled]:
    """Return the messages of all journals by tick, and within a tick in the order of the journals."""
    found = []
    for name, journal in run.journals.items():
        latest = 0
        for place, (message, frame) in enumerate(zip(journal.messages, journal.frames, strict=False)):
            match message:
                case (
                    Observation(tick)
                    | Command(tick)
                    | Estimate(tick)
                    | DeadlineMissed(tick)
                    | MissionEnd(tick)
                ):
                    latest = max(latest, tick)
            found.append(Journaled(name, place, latest, message, frame))
    return sorted(found, key=lambda one: one.tick)
