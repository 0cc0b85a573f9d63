"""Measured facts about several robots, as sets: merging is a union, in any order and any number of times.

A fact is a measurement of one robot in one tick. Conclusions are no facts: each robot draws its own.
Everything that is computed from a set is a function of its facts in the order of their keys, so two robots
with the same facts compute the same numbers to the bit.
"""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from agent.peer.motion_log import MotionLog
from protocol.messages import Observation, Ranged

DROVE = "drove"
"""The kind of a fact that has the measured v (m/s) and omega (rad/s) over [tick - 1, tick]."""
TO_ANCHOR = "to-anchor"
"""The kind of a fact that has the range in m to the robot's own anchor."""
TO_ROBOT = "to-robot/"
"""The beginning of the kind of a fact that has the range in m to the robot whose id follows."""


class Fact(msgspec.Struct, frozen=True, order=True):
    """One measurement, with its key: the robot, the tick and the kind."""

    robot: str
    tick: int
    kind: str
    values: tuple[float, ...]


class FactSet(msgspec.Struct, frozen=True):
    """The facts that a robot knows."""

    facts: frozenset[Fact] = frozenset()

    def merged(self, other: FactSet) -> FactSet:
        """Return the union of both sets. It is commutative, associative and idempotent."""
        return self if other.facts <= self.facts else FactSet(self.facts | other.facts)

    def contradictory(self) -> set[str]:
        """Return the robots of which there are two different facts with the same key."""
        values: dict[tuple[str, int, str], tuple[float, ...]] = {}
        found = set()
        for fact in self.facts:
            if values.setdefault((fact.robot, fact.tick, fact.kind), fact.values) != fact.values:
                found.add(fact.robot)
        return found

    def log(self, robot: str) -> MotionLog:
        """Return the log of `robot` up to the first tick of which no manoeuvre is known.

        It contains no ranges after that tick. Facts must not be contradictory.
        """
        drove = {one.tick: one.values for one in self.facts if one.robot == robot and one.kind == DROVE}
        log = MotionLog()
        while (values := drove.get(log.through + 1)) is not None:
            v, omega = values
            log = log.drove(v, omega)
        ranges = [one for one in self.ranges(robot, TO_ANCHOR) if one.tick <= log.through]
        return MotionLog(log.through, log.runs, tuple(ranges))

    def ranges(self, robot: str, kind: str) -> tuple[Ranged, ...]:
        """Return the ranges of one `kind` that `robot` has measured, in the order of their ticks."""
        found = [one for one in self.facts if one.robot == robot and one.kind == kind]
        return tuple([Ranged(one.tick, one.values[0]) for one in sorted(found)])


def facts_of(observations: Iterable[Observation]) -> FactSet:
    """Return the facts in the `observations` of one robot or of several."""
    found: set[Fact] = set()
    for one in observations:
        if one.executed is not None:
            found.add(Fact(one.robot, one.tick, DROVE, (one.executed.v, one.executed.omega)))
        if one.anchor_range is not None:
            found.add(Fact(one.robot, one.tick, TO_ANCHOR, (one.anchor_range,)))
        for contact in one.contacts:
            if contact.range is not None:
                found.add(Fact(one.robot, one.tick, TO_ROBOT + contact.peer, (contact.range,)))
    return FactSet(frozenset(found))
