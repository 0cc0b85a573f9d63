"""The robot whose ticks another one counts, in hardware mode.

All robots must count the same ticks. Each sets its clock from the first robot, in the order of the mission,
that it hears: in a pair, b from a. If a robot falls silent, the next one takes its place without an
agreement, and no robot waits.

In a group that tolerates f false robots, no robot is followed alone: each keeps its clock between those of
the others, without the f that are furthest ahead and the f that are furthest behind.
"""

from __future__ import annotations

from protocol.messages import RobotConfig

UNHEARD = 4.0
"""The number of ticks within which a running robot sends a TickStart."""
APART = 0.05
"""The part of a tick by which a clock may be ahead of all. Frames take time, so clocks look late."""


class TickSource:
    """The robots before this one in the mission, and when each was heard."""

    def __init__(self, config: RobotConfig, tick_s: float) -> None:
        """`tick_s` is the duration of a tick in s of wall time."""
        self.joins = bool(config.members)
        """True if a robot that has not begun does so in the tick of any other one that has: in a group."""
        self.tolerates = config.tolerates
        """The number of robots that may send false TickStarts, and are in a group."""
        self._before = config.group[: config.group.index(config.robot)]
        self._tick_s, self._unheard_s = tick_s, UNHEARD * tick_s
        self._heard: dict[str, tuple[float, int]] = {}
        """The time at which each of them was heard last, by the robot's clock, and its tick."""

    @property
    def is_first(self) -> bool:
        """True if this robot is the first of the mission."""
        return not self._before

    def leads(self, robot: str, now: float) -> bool:
        """Return whether this one sets its clock from `robot`, unless it is only to catch up."""
        for one in self._before:
            if one == robot:
                return True
            if self._is_heard(one, now):
                return False
        return False

    def _is_heard(self, robot: str, now: float) -> bool:
        return robot in self._heard and now - self._heard[robot][0] < self._unheard_s

    def is_newer(self, robot: str, tick: int, now: float) -> bool:
        """Return whether `robot` may be in `tick` now: one that runs sends each TickStart once."""
        return not self._is_heard(robot, now) or tick > self._heard[robot][1]

    def hear(self, robot: str, tick: int, now: float) -> None:
        """Note that a TickStart of `robot` fits this robot's ticks."""
        self._heard[robot] = now, tick

    def agreed(self, began: float | None, now: float) -> float | None:
        """Return the time of tick 0 by the clocks of others, as near to this robot's, `began`, as they admit.

        None: it has none yet. With at most as many false clocks as are tolerated, the result is `began`, or
        lies between those of honest robots. One that is ahead only waits for more than twice as many others.
        """
        f, heard = self.tolerates, [self._heard[one] for one in self._heard if self._is_heard(one, now)]
        others = sorted([at - tick * self._tick_s for at, tick in heard])
        if len(others) <= f:
            return began
        if began is None:
            return others[f]
        if len(others) <= 2 * f:
            return min(began, others[f])
        return min(max(began, others[f] - APART * self._tick_s), others[-1 - f])
