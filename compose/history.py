"""What a world's journal tells: the scenario, then tick after tick where everyone was and set out to do."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from protocol.journal import CorruptJournal
from protocol.messages import Drive, End, Farewell, Missed
from protocol.wire import MAX_FRAME_BYTES, MalformedFrame, decode
from world.referee import Judgement
from world.scenario import Scenario
from world.tick import World, advance, release


class Tick(msgspec.Struct, frozen=True):
    """One tick of which every robot's Drive is on record."""

    world: World
    drives: dict[str, Drive]
    """none of a robot whose Drive did not come in time"""


class Disorder(msgspec.Struct, frozen=True):
    """The first frame that stands where none such can; what comes after it is not read."""

    tick: int | None
    what: str


class History(msgspec.Struct, frozen=True):
    """A journal, whole or up to where it breaks off."""

    scenario: Scenario
    ticks: tuple[Tick, ...]
    ahead: World | None
    """at the tick after these; none once the referee has judged the last of them"""
    judgement: Judgement | None
    """the referee's, by the truth"""
    end: End | None = None
    farewells: dict[str, Farewell] = {}
    disorder: Disorder | None = None


def history(frames: Iterable[bytes], source: object) -> History:
    """What `frames` tell, the world moved by their Drives. Raises CorruptJournal, which names `source`."""
    rest = iter(frames)
    try:
        scenario = decode(next(rest, b""), Scenario, MAX_FRAME_BYTES)
        obstacle = _unpaired(scenario)
        if obstacle is not None:
            raise CorruptJournal(f"{source}: {obstacle}")
        return _told(scenario, rest)
    except MalformedFrame as error:
        raise CorruptJournal(f"{source}: {error}") from None


def _unpaired(scenario: Scenario) -> str | None:
    """Why its robots are no pairs, if they are none."""
    robots = {robot.id: robot for robot in scenario.robots}
    if not robots or len(robots) != len(scenario.robots):
        return "its scenario has not got one robot of each name"
    for robot in scenario.robots:
        peer = robots.get(robot.peer)
        if peer is None or peer.peer != robot.id or peer.role == robot.role:
            return f"in its scenario {robot.id} has no peer"
    return None


def _told(scenario: Scenario, frames: Iterable[bytes]) -> History:
    ids = [robot.id for robot in scenario.robots]
    world: World = release(scenario)
    ticks: list[Tick] = []
    judgement: Judgement | None = None
    end: End | None = None
    said: dict[str, Drive | Missed] = {}
    farewells: dict[str, Farewell] = {}
    disorder: Disorder | None = None
    for frame in frames:
        message = decode(frame, Drive | Missed | End | Farewell)
        going_on = end is None and judgement is None
        match message:
            case Drive(tick=world.truth.tick) | Missed(tick=world.truth.tick) if (
                going_on and message.robot == ids[len(said)]
            ):
                said[message.robot] = message
                if len(said) < len(ids):
                    continue
                drives = {robot: drive for robot, drive in said.items() if isinstance(drive, Drive)}
                ticks.append(Tick(world, drives))
                said = {}
                onward = advance(world, drives)
                if isinstance(onward, Judgement):
                    judgement = onward
                else:
                    world = onward
            case End(tick=world.truth.tick) if end is None and not said:
                end = message
            case Farewell() if end is not None and message.robot in _still_to_come(ids, farewells):
                farewells[message.robot] = message
            case _:
                disorder = Disorder(getattr(message, "tick", None), _named(message))
                break
    ahead = world if judgement is None else None
    return History(scenario, tuple(ticks), ahead, judgement, end, farewells, disorder)


def _still_to_come(ids: list[str], farewells: Iterable[str]) -> list[str]:
    """Who may say Farewell next: they stand in the order of the scenario, and some may be lacking."""
    last = [ids.index(robot) for robot in farewells][-1:]
    return ids[last[0] + 1 :] if last else ids


def _named(message: Drive | Missed | End | Farewell) -> str:
    whose = "" if isinstance(message, End) else f" of {message.robot}"
    tick = "" if isinstance(message, Farewell) else f" of tick {message.tick}"
    return f"a {type(message).__name__}{whose}{tick} is out of order"
