"""The content of a world's journal: the scenario, and for each tick the true poses and the Commands."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import msgspec

from protocol.journal.journal_file import CorruptJournal, JournalReading, UnexpectedFrame, take_all
from protocol.messages import Command, DeadlineMissed, Environment, FinalReport, MissionEnd
from protocol.mission import Role
from protocol.wire import MalformedFrame
from world.scenario import PlannedTeam, Scenario
from world.tick import World, advance, release
from world.truth import Truth


class Tick(msgspec.Struct, frozen=True):
    """A tick with all its recorded Commands."""

    world: World
    """The state at this tick, before the Commands are executed."""
    commands: dict[str, Command]
    """The Commands, by robot. A robot that missed the deadline has none."""

    @property
    def truth(self) -> Truth:
        """The true poses at this tick."""
        return self.world.truth


class WorldHistory(msgspec.Struct, frozen=True):
    """The content of a journal, complete or up to where it breaks off."""

    environment: Environment
    """The environment of the world's process."""
    scenario: Scenario
    """The scenario."""
    ticks: tuple[Tick, ...]
    """The complete ticks."""
    ahead: World | None
    """The state at the tick after these; None if the last of them ended the run."""
    recomputed_end: MissionEnd | None
    """The recomputed end; None if the Commands did not end the run."""
    end: MissionEnd | None = None
    """The recorded end; None if the journal breaks off before."""
    final_reports: dict[str, FinalReport] = {}
    """The recorded FinalReports, by robot."""
    unexpected: UnexpectedFrame | None = None
    """The first frame out of order, if any."""

    @property
    def worlds(self) -> tuple[World, ...]:
        """The states at all ticks, that of `ahead` included."""
        return (*[tick.world for tick in self.ticks], *([] if self.ahead is None else [self.ahead]))


def world_history(frames: Iterable[bytes], source: object) -> WorldHistory:
    """Return the content of the journal with these frames, with the true poses recomputed from the Commands.

    Raises CorruptJournal, with `source` as the journal's name.
    """
    reading = WorldJournalReading()
    problem = take_all(reading, frames, source)
    if problem is not None:
        raise problem
    content = reading.content()
    if content is None:
        raise CorruptJournal(f"{source}: it contains no scenario")
    return content


class WorldJournalReading(JournalReading):
    """A reader of a world's journal."""

    KINDS = Environment | Scenario | Command | DeadlineMissed | MissionEnd | FinalReport

    def __init__(self, shared: dict[bytes, Any] | None = None) -> None:
        """The `shared` messages are those of JournalReading."""
        super().__init__(shared)
        self.world: World | None = None
        """The state at the tick after the last complete one, or at the last tick of the run.

        None until the scenario has been read.
        """
        self.ticks: list[Tick] = []
        """The complete ticks."""
        self.recomputed_end: MissionEnd | None = None
        """The recomputed end."""
        self.end: MissionEnd | None = None
        """The recorded end."""
        self.final_reports: dict[str, FinalReport] = {}
        """The recorded FinalReports, by robot."""
        self._ids: list[str] = []
        self._answers: dict[str, Command | DeadlineMissed] = {}
        """The frames of the incomplete tick, by robot."""

    def _fits(self, message: Any, frame: bytes) -> bool:
        del frame
        if self.world is None:
            return self._begins(message)
        tick = self.world.truth.tick
        match message:
            case Command() | DeadlineMissed() if (
                self.end is None
                and self.recomputed_end is None
                and message.tick == tick
                and message.robot == self._ids[len(self._answers)]
            ):
                self._answers[message.robot] = message
                if len(self._answers) == len(self._ids):
                    self._advance(self.world)
            case MissionEnd() if message.tick == tick and self.end is None and not self._answers:
                self.end = message
            case FinalReport() if self.end is not None and message.robot in _still_to_come(
                self._ids, self.final_reports
            ):
                self.final_reports[message.robot] = message
            case _:
                return False
        return True

    def _begins(self, message: object) -> bool:
        """Add the environment, and then the scenario, which must be one of pairs, a group or a team."""
        match message:
            case Environment() if self.environment is None:
                self.environment = message
            case Scenario() if self.environment is not None:
                if (problem := _unpaired(message)) is not None:
                    raise MalformedFrame(problem)
                try:
                    _ = message.ranging, message.radio
                except (LookupError, TypeError, ValueError) as error:
                    raise MalformedFrame(error.args[0] if error.args else type(error).__name__) from None
                self._ids = [robot.id for robot in message.robots]
                self.world = release(message)
            case _:
                raise MalformedFrame("a world's journal must begin with its environment and a scenario")
        return True

    def _advance(self, world: World) -> None:
        commands = {
            robot: command for robot, command in self._answers.items() if isinstance(command, Command)
        }
        self.ticks.append(Tick(world, commands))
        self._answers = {}
        onward = advance(world, commands)
        if isinstance(onward, MissionEnd):
            self.recomputed_end = onward
        else:
            self.world = onward

    def content(self) -> WorldHistory | None:
        """Return the content that has been read so far; None if there is no scenario."""
        if self.environment is None or self.world is None:
            return None
        return WorldHistory(
            self.environment,
            self.world.scenario,
            tuple(self.ticks),
            self.world if self.recomputed_end is None else None,
            self.recomputed_end,
            self.end,
            dict(self.final_reports),
            self.unexpected,
        )


def _unpaired(scenario: Scenario) -> str | None:
    """Return why the robots of `scenario` do not form pairs, for a user; None if they do."""
    robots = {robot.id: robot for robot in scenario.robots}
    if not robots or len(robots) != len(scenario.robots):
        return "its scenario has no robots, or several of the same name"
    if scenario.team is not None:
        return _unequal(scenario, scenario.team)
    if scenario.meetings:
        return _unplanned(scenario)
    if scenario.retries or scenario.deaths or scenario.planned_sweep or scenario.confirmation:
        return "its scenario has the plan of a group, and no meetings"
    if scenario.unanchored:
        return f"in its scenario {scenario.unanchored[0]} has no anchor"
    for robot in scenario.robots:
        peer = robots.get(robot.encounter.peer) if robot.encounter is not None else None
        if peer is None or peer.encounter is None or peer.peer != robot.id or peer.role == robot.role:
            return f"in its scenario {robot.id} has no peer"
    return None


def _unequal(scenario: Scenario, team: PlannedTeam) -> str | None:
    """Return which robot of a team has what only a robot of a pair or a group has, for a user."""
    anchors = [one.told.id for one in team.anchors]
    if scenario.meetings or scenario.retries or scenario.planned_sweep or scenario.confirmation:
        return "its scenario has the plan of a group, and a team"
    if len(set(anchors)) != len(anchors):
        return "in its scenario two anchors have the same name"
    for robot in scenario.robots:
        if robot.encounter is not None or robot.given_anchor is not None:
            return f"in its scenario {robot.id} of a team has a peer or an anchor of its own"
        if not {*anchors}.issuperset(robot.ranges):
            return f"in its scenario {robot.id} may range an anchor that is not there"
    if team.origin is not None and team.origin not in {robot.id for robot in scenario.robots}:
        return f"in its scenario there is no robot {team.origin}, in whose frame the poses are"
    return None


def _unplanned(scenario: Scenario) -> str | None:
    """Return which robot of a group does not meet another one as planned, for a user; None if all do."""
    first: dict[str, tuple[str, Role]] = {}
    for one in scenario.meetings:
        first.setdefault(one.visitor, (one.visited, "a"))
        if one.visited in first:
            return f"in its scenario {one.visited} is visited after it has met another robot"
        first[one.visited] = (one.visitor, "b")
    unanchored = scenario.unanchored
    if first.keys() != {robot.id for robot in scenario.robots} - set(unanchored):
        return "in its scenario the meetings are not those of its robots"
    confirming = scenario.confirmation.visits if scenario.confirmation is not None else ()
    for retry in (*scenario.retries, *confirming):
        if retry.visitor == retry.visited or not {retry.visitor, retry.visited} <= first.keys():
            return "in its scenario the retries are not those of its robots"
    sweep = scenario.planned_sweep
    if bool(unanchored) != (sweep is not None) or (sweep is not None and set(sweep.sweepers) != first.keys()):
        return "in its scenario the robots that search are not those with an anchor"
    for robot in scenario.robots:
        if robot.peer not in first:
            return f"in its scenario {robot.id} has no peer"
        if robot.id in first and first[robot.id] != (robot.peer, robot.role):
            return f"in its scenario {robot.id} has another peer than in its first meeting"
    return None


def _still_to_come(ids: list[str], final_reports: Iterable[str]) -> list[str]:
    """Return the robots whose FinalReport may be next. Those that sent one are in the scenario's order."""
    last = [ids.index(robot) for robot in final_reports][-1:]
    return ids[last[0] + 1 :] if last else ids
