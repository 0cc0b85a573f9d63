"""What a world's journal tells: the scenario, then tick after tick where everyone was and set out to do."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import msgspec
from msgspec.structs import replace

from protocol.journal.environment import named_in
from protocol.journal.journal_file import CorruptJournal
from protocol.messages import Command, DeadlineMissed, Environment, FinalReport, MissionEnd
from protocol.wire import MAX_FRAME_BYTES, MalformedFrame, decode
from world.referee import Judgement
from world.scenario import Scenario
from world.tick import World, advance, release


class Tick(msgspec.Struct, frozen=True):
    """One tick of which every robot's Command is on record."""

    world: World
    commands: dict[str, Command]
    """none of a robot whose Command did not come in time"""


class UnexpectedFrame(msgspec.Struct, frozen=True):
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
    end: MissionEnd | None = None
    final_reports: dict[str, FinalReport] = {}
    disorder: UnexpectedFrame | None = None
    environment: Environment | None = None
    """where it was written; none of an older recording"""

    @property
    def worlds(self) -> tuple[World, ...]:
        """At every tick of which anything follows."""
        return (*[tick.world for tick in self.ticks], *([] if self.ahead is None else [self.ahead]))


def history(frames: Iterable[bytes], source: object) -> History:
    """What `frames` tell, the world moved by their Commands. Raises CorruptJournal, which names `source`."""
    scenario, named, rest = opened(list(frames), source)
    reading = JournalReading(scenario)
    try:
        for frame in rest:
            if not reading.take(frame):
                break
    except MalformedFrame as error:
        raise CorruptJournal(f"{source}: {error}") from None
    return replace(reading.told(), environment=named)


def opened(frames: Sequence[bytes], source: object) -> tuple[Scenario, Environment | None, Sequence[bytes]]:
    """What a world's journal begins with, and the frames after it.

    Raises CorruptJournal, which names `source`.
    """
    named = named_in(frames)
    rest = frames if named is None else frames[1:]
    return _scenario_of(rest[0] if rest else b"", source), named, rest[1:]


class JournalReading:
    """A world's journal after its scenario, frame by frame: as much of it as there is yet."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._ids = [robot.id for robot in scenario.robots]
        self._said: dict[str, Command | DeadlineMissed] = {}
        self.world: World = release(scenario)
        """at the tick after the last one on record; at that one, once it has been judged"""
        self.ticks: list[Tick] = []
        self.judgement: Judgement | None = None
        self.end: MissionEnd | None = None
        self.final_reports: dict[str, FinalReport] = {}
        self.disorder: UnexpectedFrame | None = None

    def take(self, frame: bytes) -> bool:
        """Whether `frame` can come next; none is to be taken after one that cannot. Raises MalformedFrame."""
        message = decode(frame, Command | DeadlineMissed | MissionEnd | FinalReport)
        going_on = self.end is None and self.judgement is None
        tick = self.world.truth.tick
        match message:
            case Command() | DeadlineMissed() if (
                going_on and message.tick == tick and message.robot == self._ids[len(self._said)]
            ):
                self._said[message.robot] = message
                if len(self._said) == len(self._ids):
                    self._go_on()
            case MissionEnd() if message.tick == tick and self.end is None and not self._said:
                self.end = message
            case FinalReport() if self.end is not None and message.robot in _still_to_come(
                self._ids, self.final_reports
            ):
                self.final_reports[message.robot] = message
            case _:
                self.disorder = UnexpectedFrame(getattr(message, "tick", None), _named(message))
                return False
        return True

    def _go_on(self) -> None:
        commands = {robot: command for robot, command in self._said.items() if isinstance(command, Command)}
        self.ticks.append(Tick(self.world, commands))
        self._said = {}
        onward = advance(self.world, commands)
        if isinstance(onward, Judgement):
            self.judgement = onward
        else:
            self.world = onward

    def told(self) -> History:
        """What it has told so far."""
        ahead = self.world if self.judgement is None else None
        return History(
            self._scenario,
            tuple(self.ticks),
            ahead,
            self.judgement,
            self.end,
            dict(self.final_reports),
            self.disorder,
        )


def _scenario_of(frame: bytes, source: object) -> Scenario:
    """The scenario that a world's journal begins with. Raises CorruptJournal, which names `source`."""
    if not frame:
        raise CorruptJournal(f"{source}: there is no scenario in it")
    try:
        scenario = decode(frame, Scenario, MAX_FRAME_BYTES)
    except MalformedFrame as error:
        raise CorruptJournal(f"{source}: {error}") from None
    obstacle = _unpaired(scenario)
    if obstacle is not None:
        raise CorruptJournal(f"{source}: {obstacle}")
    return scenario


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


def _still_to_come(ids: list[str], final_reports: Iterable[str]) -> list[str]:
    """Who may say FinalReport next: they stand in the order of the scenario, and some may be lacking."""
    last = [ids.index(robot) for robot in final_reports][-1:]
    return ids[last[0] + 1 :] if last else ids


def _named(message: Command | DeadlineMissed | MissionEnd | FinalReport) -> str:
    whose = "" if isinstance(message, MissionEnd) else f" of {message.robot}"
    tick = "" if isinstance(message, FinalReport) else f" of tick {message.tick}"
    return f"a {type(message).__name__}{whose}{tick} is out of order"
