"""The end of a mission in hardware mode, for one robot, from its own result and those of the others.

The true poses are unknown, so the outcome is never `wrong`. In a group, a Report contains the verdict of a
meeting, and robots are seldom in contact. Therefore the drivers send each other the results of their robots,
with every TickStart.

A robot's own result does not end its mission, because others may need it: it stays until all robots have a
result, and know each other's. A robot that sends nothing may have been killed, and needs the results of the
others when it resumes. So the others wait until it has sent nothing for the timeout. If its result is not
known, those of a group also wait until it should be localised by the plan, and their planners then drive to
it. The mission ends when the planner has nothing more to do, or when this takes as long as the whole plan. In
any case, it ends at max_ticks.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from protocol.coverage_ticks import robots_of_part, straight_ticks, ticks_of_parts
from protocol.messages import Cause, Command, MissionEnd, RobotConfig, TickStart, Verdict
from world.referee import main_cause, mission_end, shortfall

LAST_WORDS = 4
"""The number of ticks in which a robot still sends TickStarts after all know that all have a result."""
PARTING_TICKS = 16
"""A bound on the ticks from the end of a meeting until its robots leave for the next one."""


class Ending:
    """The results of all robots of a mission, as far as they are known to one of them."""

    def __init__(
        self, config: RobotConfig, max_ticks: int, timeout: float, clock: Callable[[], float]
    ) -> None:
        self._clock = clock
        self.verdict: Verdict | None = None
        """The robot's own result; None until it has one."""
        self._me = config.robot
        self._mission = config.mission
        self._max_ticks = max_ticks
        self._timeout = timeout
        self._group, self._others = config.group, {*config.others}
        self._ends = {one.robot: one.ends for one in config.members}
        """The tick until which each robot of a group is localised, by the plan."""
        self._in_pair = not config.members and config.team is None
        self._peers = {config.robot: config.peer, config.peer: config.robot} if self._in_pair else {}
        """The peer of each robot of a pair."""
        planned = max(self._ends.values(), default=0) + _coverage_ticks(config)
        self._plan = max(planned, _confirmed_tick(config))
        """The tick until which all are; a bound of it if some have no anchor. A pair has no plan."""
        self._visits = config.given_anchor is not None
        """True if this robot's planner goes to robots that are late."""
        self._results: dict[str, Verdict] = {}
        """The results that have been received, by robot."""
        self._complete: set[str] = set()
        """The robots that wait for no other one."""
        self._heard = dict.fromkeys(self._others, self._clock())
        """The time at which each robot was heard last, by the robot's clock."""
        self._tick_of: dict[str, int] = {}
        """The tick of the latest TickStart that has been received, by robot."""
        self._is_complete = False
        """True if this robot has its result, and waits for no other one."""
        self._rests = False
        """True if this robot's planner has nothing to do, as its latest Command says."""
        self._said = 0
        """The number of TickStarts in which this process has reported that."""
        self._known: int | None = None
        """The tick in which no robot waited for another one any more."""

    def receive(self, message: TickStart) -> bool:
        """Add the TickStart of another robot, and return whether it changes what is known.

        What a robot has sent in an earlier tick than another one changes nothing.
        """
        if message.robot not in self._others:
            return False
        robot = message.robot
        self._heard[robot] = self._clock()
        if message.tick < self._tick_of.get(robot, 0):
            return False
        self._tick_of[robot] = message.tick
        before = robot in self._results, robot in self._complete
        if message.verdict is not None:
            self._results[robot] = message.verdict
        else:
            self._results.pop(robot, None)  # it has withdrawn its claim
        (self._complete.add if message.complete else self._complete.discard)(robot)
        return (robot in self._results, robot in self._complete) != before

    def tick_start(self, tick: int) -> TickStart:
        """Return the TickStart of `tick`, with this robot's result."""
        self._said += self._is_complete
        return TickStart(tick, self._me, self.verdict, self._is_complete)

    def after(self, tick: int, command: Command | None) -> MissionEnd | None:
        """Return the MissionEnd if `tick`, in which the agent sent `command`, was the last; else None.

        A robot that catches up after a restart sends no TickStarts: it ends when it has sent enough of them.
        """
        if command is not None:
            if self.verdict is None or not self._in_pair:  # a robot of a pair does not withdraw its result
                self.verdict = command.verdict
            self._rests = command.rests
        lost = [robot for robot in self._others if self._is_lost(robot, tick)]
        self._is_complete = self.verdict is not None and self._results.keys() | {*lost} >= self._others
        gone = {robot for robot in self._results if self._is_silent(robot)}
        if self._known is None and self._is_complete and self._complete | gone | {*lost} >= self._others:
            self._known = tick
        told = self._known is not None and tick >= self._known + LAST_WORDS and self._said >= LAST_WORDS
        return self._end(tick) if told or tick >= self._max_ticks else None

    def _is_silent(self, robot: str) -> bool:
        """Return whether nothing has been heard of `robot` for the timeout."""
        return self._clock() - self._heard[robot] > self._timeout

    def _is_lost(self, robot: str, tick: int) -> bool:
        """Return whether this robot does not wait for `robot` any more, of which it has heard nothing."""
        if not self._is_silent(robot):
            return False
        late = tick - self._ends.get(robot, self._plan)
        return late > self._plan or (late > 0 and self._visits and self._rests)

    def _end(self, tick: int) -> MissionEnd:
        """Return the MissionEnd. Its main cause is that of one robot without a pose; others follow."""
        results = self._results if self.verdict is None else {**self._results, self._me: self.verdict}
        missing = tuple([robot for robot in self._group if robot not in results and robot != self._me])
        found = []
        for robot in self._group:
            why = shortfall(robot, results.get(robot), self._mission, self._peers.get(robot))
            found += [why] if why is not None else []
        main = main_cause(found) if self.verdict is not None else Cause("max-ticks", (self._me,))
        if main is None and missing:
            main = Cause("waiting", (self._me,))
        causes = [main] if main is not None else []
        left = tuple([one.robots[0] for one in found if one is not main])
        if left and not self._in_pair:  # in a pair, one cause suffices
            causes.append(Cause("others", left))
        if missing and (not self._in_pair or (main is not None and main.code == "waiting")):
            causes.append(Cause("no-result", missing))
        return mission_end(tick, causes)


def _confirmed_tick(config: RobotConfig) -> int:
    """Return the tick in which the last visit ends by which this robot confirms poses; 0 if there is none."""
    ends = [one.begins + one.lasts for one in config.confirmations]
    return math.ceil(max(ends, default=0.0) / config.mission.period)


def _coverage_ticks(config: RobotConfig) -> int:
    """Return a bound on the ticks in which each robot with an anchor covers its parts; 0 if all have one.

    If robots may report false data, it covers more than one, and goes to the other robots before each.
    """
    if config.sweep is None:
        return 0
    mission, widest = config.mission, config.widest_distance
    once = PARTING_TICKS + max(ticks_of_parts(config.sweep, mission, widest, len(config.unanchored)))
    tour = len(config.members) * straight_ticks(widest, mission)
    return once + (robots_of_part(config.tolerates) - 1) * (once + tour)
