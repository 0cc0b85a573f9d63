"""What a world's journal tells: the scenario, then everyone's Drive, tick after tick, and how it ended."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from protocol.journal import CorruptJournal
from protocol.messages import Drive, End, Farewell, Missed
from protocol.wire import MAX_FRAME_BYTES, MalformedFrame, decode
from world.scenario import Scenario


class Past(msgspec.Struct, frozen=True):
    """A journal, whole or up to where it breaks off."""

    scenario: Scenario
    ticks: tuple[dict[str, Drive], ...]
    """those of which everything is on record; a robot that is not in one did not answer in time"""
    end: End | None = None
    farewells: tuple[Farewell, ...] = ()


def past(frames: Sequence[bytes], source: object) -> Past:
    """What `frames` tell. Raises CorruptJournal, whose text begins with `source`."""
    ticks: list[dict[str, Drive]] = []
    drives: dict[str, Drive] = {}
    place = 0
    end: End | None = None
    farewells: list[Farewell] = []
    try:
        scenario = decode(frames[0] if frames else b"", Scenario, MAX_FRAME_BYTES)
        ids = [robot.id for robot in scenario.robots]
        for frame in frames[1:]:
            message = decode(frame, Drive | Missed | End | Farewell)
            match message:
                case Drive() | Missed() if (
                    end is None and message.tick == len(ticks) and message.robot == ids[place]
                ):
                    if isinstance(message, Drive):
                        drives[message.robot] = message
                    place += 1
                case End() if end is None and not place:
                    end = message
                case Farewell() if end is not None:
                    farewells.append(message)
                case _:
                    raise CorruptJournal(f"{source}: a {type(message).__name__} is out of order")
            if place == len(ids):
                ticks.append(drives)
                drives, place = {}, 0
    except MalformedFrame as error:
        raise CorruptJournal(f"{source}: {error}") from None
    return Past(scenario, tuple(ticks), end, tuple(farewells))
