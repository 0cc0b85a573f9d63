"""The content of a world's journal: the scenario, and for each tick the true poses and the Commands."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import msgspec
from msgspec.structs import replace

from protocol.journal.environment import named_in
from protocol.journal.journal_file import CorruptJournal
from protocol.messages import Command, DeadlineMissed, Environment, FinalReport, MissionEnd
from protocol.wire import MAX_FRAME_BYTES, MalformedFrame, decode
from world.referee import MissionOutcome
from world.scenario import Scenario
from world.tick import World, advance, release


class Tick(msgspec.Struct, frozen=True):
    """A tick with all its recorded Commands."""

    world: World
    """The state at this tick, before the Commands are executed."""
    commands: dict[str, Command]
    """The Commands, by robot. A robot that missed the deadline has none."""


class UnexpectedFrame(msgspec.Struct, frozen=True):
    """The first frame that must not be at its place. The frames after it are not read."""

    tick: int | None
    """The tick of the frame; None if it has none."""
    what: str
    """The description of the problem, for a user."""


class History(msgspec.Struct, frozen=True):
    """The content of a journal, complete or up to where it breaks off."""

    scenario: Scenario
    """The scenario."""
    ticks: tuple[Tick, ...]
    """The complete ticks."""
    ahead: World | None
    """The state at the tick after these; None if the last of them ended the run."""
    mission_outcome: MissionOutcome | None
    """The recomputed outcome; None if the Commands did not end the run."""
    end: MissionEnd | None = None
    """The recorded end; None if the journal breaks off before."""
    final_reports: dict[str, FinalReport] = {}
    """The recorded FinalReports, by robot."""
    disorder: UnexpectedFrame | None = None
    """The first frame out of order, if any."""
    environment: Environment | None = None
    """The environment of the world's process; None in an older recording."""

    @property
    def worlds(self) -> tuple[World, ...]:
        """The states at all ticks, that of `ahead` included."""
        return (*[tick.world for tick in self.ticks], *([] if self.ahead is None else [self.ahead]))


def history(frames: Iterable[bytes], source: object) -> History:
    """Return the content of the journal with these frames, with the true poses recomputed from the Commands.

    Raises CorruptJournal, with `source` as the journal's name.
    """
    scenario, named, rest = opened(list(frames), source)
    reading = JournalReading(scenario)
    try:
        for frame in rest:
            if not reading.take(frame):
                break
    except MalformedFrame as error:
        raise CorruptJournal(f"{source}: {error}") from None
    return replace(reading.content(), environment=named)


def opened(frames: Sequence[bytes], source: object) -> tuple[Scenario, Environment | None, Sequence[bytes]]:
    """Return the scenario and the environment at the beginning of a world's journal, and the other frames.

    Raises CorruptJournal, with `source` as the journal's name.
    """
    named = named_in(frames)
    rest = frames if named is None else frames[1:]
    return _scenario_of(rest[0] if rest else b"", source), named, rest[1:]


class JournalReading:
    """A reader of a world's journal after its scenario, frame by frame. The journal may still be growing."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._ids = [robot.id for robot in scenario.robots]
        self._answers: dict[str, Command | DeadlineMissed] = {}
        """The frames of the incomplete tick, by robot."""
        self.world: World = release(scenario)
        """The state at the tick after the last complete one, or at the last tick of the run."""
        self.ticks: list[Tick] = []
        """The complete ticks."""
        self.mission_outcome: MissionOutcome | None = None
        """The recomputed outcome."""
        self.end: MissionEnd | None = None
        """The recorded end."""
        self.final_reports: dict[str, FinalReport] = {}
        """The recorded FinalReports, by robot."""
        self.disorder: UnexpectedFrame | None = None
        """The first frame out of order."""

    def take(self, frame: bytes) -> bool:
        """Add the next frame, and return whether it is in order. Add no frame after one that is not.

        Raises MalformedFrame.
        """
        message = decode(frame, Command | DeadlineMissed | MissionEnd | FinalReport)
        is_running = self.end is None and self.mission_outcome is None
        tick = self.world.truth.tick
        match message:
            case Command() | DeadlineMissed() if (
                is_running and message.tick == tick and message.robot == self._ids[len(self._answers)]
            ):
                self._answers[message.robot] = message
                if len(self._answers) == len(self._ids):
                    self._advance()
            case MissionEnd() if message.tick == tick and self.end is None and not self._answers:
                self.end = message
            case FinalReport() if self.end is not None and message.robot in _still_to_come(
                self._ids, self.final_reports
            ):
                self.final_reports[message.robot] = message
            case _:
                self.disorder = UnexpectedFrame(getattr(message, "tick", None), _named(message))
                return False
        return True

    def _advance(self) -> None:
        commands = {
            robot: command for robot, command in self._answers.items() if isinstance(command, Command)
        }
        self.ticks.append(Tick(self.world, commands))
        self._answers = {}
        onward = advance(self.world, commands)
        if isinstance(onward, MissionOutcome):
            self.mission_outcome = onward
        else:
            self.world = onward

    def content(self) -> History:
        """Return the content that has been read so far."""
        ahead = self.world if self.mission_outcome is None else None
        return History(
            self._scenario,
            tuple(self.ticks),
            ahead,
            self.mission_outcome,
            self.end,
            dict(self.final_reports),
            self.disorder,
        )


def _scenario_of(frame: bytes, source: object) -> Scenario:
    """Return the scenario in `frame`. Raises CorruptJournal, with `source` as the journal's name."""
    if not frame:
        raise CorruptJournal(f"{source}: it contains no scenario")
    try:
        scenario = decode(frame, Scenario, MAX_FRAME_BYTES)
    except MalformedFrame as error:
        raise CorruptJournal(f"{source}: {error}") from None
    problem = _unpaired(scenario)
    if problem is not None:
        raise CorruptJournal(f"{source}: {problem}")
    return scenario


def _unpaired(scenario: Scenario) -> str | None:
    """Return why the robots of `scenario` do not form pairs, for a user; None if they do."""
    robots = {robot.id: robot for robot in scenario.robots}
    if not robots or len(robots) != len(scenario.robots):
        return "its scenario has no robots, or several of the same name"
    for robot in scenario.robots:
        peer = robots.get(robot.peer)
        if peer is None or peer.peer != robot.id or peer.role == robot.role:
            return f"in its scenario {robot.id} has no peer"
    return None


def _still_to_come(ids: list[str], final_reports: Iterable[str]) -> list[str]:
    """Return the robots whose FinalReport may be next. Those that sent one are in the scenario's order."""
    last = [ids.index(robot) for robot in final_reports][-1:]
    return ids[last[0] + 1 :] if last else ids


def _named(message: Command | DeadlineMissed | MissionEnd | FinalReport) -> str:
    whose = "" if isinstance(message, MissionEnd) else f" of {message.robot}"
    tick = "" if isinstance(message, FinalReport) else f" of tick {message.tick}"
    return f"a {type(message).__name__}{whose}{tick} is out of order"
