"""The messages of a run, collected by tick from a recording or the network, in any order."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import msgspec

from compose.recording.kills_file import Killed
from compose.recording.run_setup import Meetings, RunSetup, meetings_after
from compose.scenario.kills import WORLD
from protocol.messages import (
    Command,
    DeadlineMissed,
    Estimate,
    FinalReport,
    GroundTruth,
    Message,
    MissionEnd,
    Observation,
    Report,
    RobotConfig,
)
from protocol.motion import Pose
from world.tick import World, observations
from world.world_journal import Tick

if TYPE_CHECKING:
    from agent.peer.motion_log import MotionLog

Link = tuple[str, str]
"""A directed link: sender and receiver."""


class TickData(msgspec.Struct, frozen=True):
    """The data of one tick that is known so far."""

    tick: int
    truth: dict[str, Pose] = msgspec.field(default_factory=dict)
    observations: dict[str, Observation] = msgspec.field(default_factory=dict)
    reports: set[Link] = msgspec.field(default_factory=set)
    """The links on which a report was sent."""
    commands: dict[str, Command] = msgspec.field(default_factory=dict)
    estimates: dict[str, Estimate] = msgspec.field(default_factory=dict)
    late: set[str] = msgspec.field(default_factory=set)
    """Robots whose Command missed the deadline."""
    without: set[str] = msgspec.field(default_factory=set)
    """Robots that decided without their peer's report because it missed the deadline."""
    down: set[str | None] = msgspec.field(default_factory=set)
    """Robots whose process ended in this tick; None is the world. Observed by viewers, never journaled."""
    back: set[str | None] = msgspec.field(default_factory=set)
    """Robots in `down` whose process was seen again in the same tick."""
    replayed: dict[str | None, int] = msgspec.field(default_factory=dict)
    """The number of ticks that the process of a robot in `back` replayed, if it was killed on purpose.

    A number that cannot be right is left out: the launcher's list is not part of the journals."""


class RunData:
    """The data of a run, collected while messages arrive."""

    def __init__(self) -> None:
        self.ticks: dict[int, TickData] = {}
        self.configs: dict[str, RobotConfig] = {}
        self.reported_logs: dict[str, MotionLog] = {}
        """The manoeuvres that each robot with an attack has reported so far."""
        self.final_reports: dict[str, FinalReport] = {}
        self.end: MissionEnd | None = None
        self.last = -1
        """The latest tick with any data; -1 if there is none."""
        self.costs: tuple[str, ...] = ()
        """The costs of the faults, attacks and kills, as sentences; empty until they are known."""
        self.has_truth = False
        """True once the ground truth of any tick is known."""
        self._seen: set[str | None] = set()
        self.gone: set[str | None] = set()
        """Robots whose process was seen and has ended; None is the world."""
        self._meetings: dict[int, Meetings] = {}
        """The latest meeting of each robot of a group by tick, in the order of the ticks."""
        self._setup_at: tuple[RunSetup, Meetings, RunSetup] | None = None
        """The latest arguments and result of `setup_at`: setup, meetings, and the setup with these."""
        self._written: dict[str, tuple[int, int]] = {}
        """The latest tick of the reports in the journal of each sender, and their number."""
        self.touched: int | None = None
        """The earliest tick that has changed since the user of this object last set this to None."""

    def at(self, tick: int) -> TickData:
        """Return the data of `tick` for modification, created if needed; marks the tick as changed."""
        self._touch(tick)
        found = self.ticks.get(tick)
        if found is None:
            found = self.ticks[tick] = TickData(tick, down=set(self.gone if tick > self.last else ()))
            self.last = max(self.last, tick)
        return found

    def between(self, first: int, last: int) -> list[int]:
        """Return the ticks from `first` to `last` with data, in order.

        The time that it takes is bounded by the number of ticks with data: a frame may have any tick.
        """
        if last - first < len(self.ticks):
            return [tick for tick in range(first, last + 1) if tick in self.ticks]
        return sorted([tick for tick in [*self.ticks] if first <= tick <= last])

    def _touch(self, tick: int) -> None:
        if self.touched is None or tick < self.touched:
            self.touched = tick
        while self._meetings and next(reversed(self._meetings)) >= tick:
            self._meetings.popitem()

    def setup_at(self, setup: RunSetup, tick: int) -> RunSetup:
        """Return `setup` with the latest meeting of each robot of a group in `tick`; for pairs, `setup`."""
        if not setup.visits:
            return setup
        latest = next(reversed(self._meetings), -1)
        for later in self.between(latest + 1, tick):
            self._meetings[later] = meetings_after(self._meetings.get(latest, {}), self.ticks[later].commands)
            latest = later
        present = self._meetings.get(tick, {})
        if self._setup_at is None or self._setup_at[:2] != (setup, present):
            self._setup_at = setup, present, setup.in_meetings(present)
        return self._setup_at[2]

    def conclude(self, end: MissionEnd) -> None:
        """Set the end of the mission, which changes its last tick, unless it is known already."""
        if self.end is None:
            self.end = end
            if end.tick in self.ticks:
                self._touch(end.tick)

    def add_costs(self, costs: Iterable[str]) -> None:
        """Add what faults have cost to the last tick of a mission that has ended."""
        self.costs = tuple(costs)
        if self.costs and self.end is not None:
            self._touch(self.end.tick)

    def add_world(self, world: World) -> None:
        """Add the ground truth of the world's current tick."""
        ids = [robot.id for robot in world.scenario.robots]
        data = self.at(world.truth.tick)
        data.truth.update(zip(ids, world.truth.poses, strict=True))
        self.has_truth = True

    def add_tick(self, tick: Tick) -> None:
        """Add a complete tick of the world's journal. A robot without a Command is late."""
        self.add_world(tick.world)
        data = self.at(tick.truth.tick)
        for robot, command in tick.commands.items():
            data.commands.setdefault(robot, command)
        data.late.update({robot.id for robot in tick.world.scenario.robots} - tick.commands.keys())

    def add_kills(self, kills: Iterable[Killed]) -> None:
        """Add processes that were killed, once the journals are complete; others than theirs are ignored."""
        found = {(None if one.who == WORLD else one.who, one.tick): one for one in kills}
        for (robot, tick), killed in found.items():
            if tick in self.ticks and (robot is None or robot in self.ticks[tick].truth):
                self._add_absence(robot, killed, {tick for who, tick in found if who == robot})

    def _add_absence(self, robot: str | None, killed: Killed, ticks: set[int]) -> None:
        """Add the absence of a process in the tick of its kill, and in those after it that it was late for.

        It ends before the next of the `ticks` of its kills. The process is back if it answers the next tick,
        or at the end: it goes on only if what it replayed is identical to its journal.
        """
        last = killed.tick
        self.at(last).down.add(robot)
        while last + 1 not in ticks and last + 1 in self.ticks and robot in self.ticks[last + 1].late:
            last += 1
            self.at(last).down.add(robot)
        following = self.ticks.get(last + 1)
        answers = following is not None and (robot is None or robot in following.commands)
        ends = self.end is not None and (robot is None or robot in self.final_reports)
        if killed.after is not None and (answers or ends):
            self.ticks[last].back.add(robot)
            if killed.replayed_ticks <= killed.tick + 1:
                self.ticks[last].replayed[robot] = killed.replayed_ticks

    def add_observations(self, worlds: Iterable[World]) -> None:
        """Add the Observations that are still missing in the ticks of `worlds`."""
        for world in worlds:
            data = self.ticks.get(world.truth.tick)
            if data is None or len(data.observations) < len(world.scenario.robots):
                known = self.at(world.truth.tick).observations
                known.update({one.robot: one for one in observations(world) if one.robot not in known})

    def present(self, robot: str | None, there: bool) -> None:
        """Record that the process of `robot`, or of the world if None, is present or absent now.

        A process counts as gone only if it was seen before, the mission has not ended, and the robot has
        sent no FinalReport. Calls before the first tick have no effect.
        """
        if self.last < 0:
            return
        if there:
            self._seen.add(robot)
            if robot in self.gone:
                self.gone.remove(robot)
                self.at(self.last).back.add(robot)
        elif robot in self._seen - self.gone and self.end is None and robot not in self.final_reports:
            self.gone.add(robot)
            now = self.at(self.last)
            now.down.add(robot)
            now.back.discard(robot)

    def add(self, message: Message, journal_owner: str | None = None, receiver: str | None = None) -> None:
        """Add `message`. Data that is already known is not replaced.

        `journal_owner` is the robot whose journal holds the message; None for the world's journal and for
        the network. `receiver` is that of a report from the network.
        """
        match message:
            case Observation(tick, robot):
                self.at(tick).observations.setdefault(robot, message)
            case Command(tick, robot):
                self.at(tick).commands.setdefault(robot, message)
            case Estimate(tick, robot):
                self.at(tick).estimates.setdefault(robot, message)
            case Report(tick, robot):
                to = receiver or (
                    self._receiver(robot, tick) if journal_owner in (None, robot) else journal_owner
                )
                self.at(tick).reports.add((robot, to))
                self._add_reported(message)
            case GroundTruth(tick, poses):
                self.at(tick).truth.update(poses)
                self.has_truth = True
            case DeadlineMissed(tick, robot):
                data = self.at(tick)
                (data.late if journal_owner is None else data.without).add(journal_owner or robot)
            case RobotConfig(robot):
                self.configs.setdefault(robot, message)
            case FinalReport(robot):
                self.final_reports.setdefault(robot, message)
            case MissionEnd():
                self.conclude(message)

    def _receiver(self, sender: str, tick: int) -> str:
        """Return the receiver of the next report in its sender's journal: one for each contact, in order."""
        latest, count = self._written.get(sender, (-1, 0))
        count = count if latest == tick else 0
        self._written[sender] = tick, count + 1
        observation = self.ticks[tick].observations.get(sender) if tick in self.ticks else None
        contacts = observation.contacts if observation is not None else ()
        if count < len(contacts):
            return contacts[count].peer
        config = self.configs.get(sender)
        return config.others[0] if config is not None and config.others else ""

    def _add_reported(self, report: Report) -> None:
        """Extend the reported log of an attacker; a report may change earlier ticks than its own."""
        config = self.configs.get(report.robot)
        if config is None or config.attack is None or report.body is not None:
            return
        if report.through > report.tick:  # nobody can report what has not been yet
            return
        from agent.peer.motion_log import MotionLog  # noqa: PLC0415  # the agent's code, for attackers only

        log = self.reported_logs.get(report.robot, MotionLog())
        self.reported_logs[report.robot] = log.extended(
            report.since, 0, MotionLog(report.through, report.runs)
        )
        self._touch(min(report.tick, log.through + 1))
