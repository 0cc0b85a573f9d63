"""What there is to tell of a pair: the truth, what each robot held possible, and each robot's mind."""

from __future__ import annotations

import math
from functools import cached_property
from pathlib import Path

import msgspec

from agent.mind import Mind
from agent.past import Past
from agent.robot import Robot
from compose.record import Record, past_of
from protocol.messages import Drive, Estimate
from protocol.mission import Mission, Role
from protocol.motion import Pose
from protocol.wire import encode
from world.scenario import Placed
from world.sensors import anchor_ranges, mutual_ranges


class Account(msgspec.Struct, frozen=True):
    """One robot's own record."""

    held: tuple[Estimate, ...]
    """what it held possible, as it journaled"""
    minds: tuple[Mind, ...]
    """after each tick, from 0 on, as far as it decided in it"""
    broken: str | None = None
    """why minds end before the record does, if they do"""


class Pair(msgspec.Struct, frozen=True, dict=True):
    """Two robots of a record that are each other's peers."""

    record: Record
    a: int
    """where it stands in the scenario"""
    b: int
    accounts: dict[str, Account]
    """of those robots whose journal can be read"""

    @property
    def name(self) -> str:
        """Of the pair, in names of files."""
        return f"{self.robot('a').id}-{self.robot('b').id}"

    @property
    def mission(self) -> Mission:
        """What is known of the mission by all."""
        return self.record.scenario.mission

    @property
    def exact(self) -> bool:
        """Whether its sensors are."""
        return self.mission.noise.exact

    @property
    def variant(self) -> str:
        """Of the planner."""
        return self.record.scenario.variant

    @property
    def last(self) -> int:
        """The last tick on record."""
        return max(0, len(self.record.moments) - 1)

    def place(self, role: Role) -> int:
        """In the scenario."""
        return self.a if role == "a" else self.b

    def robot(self, role: Role) -> Placed:
        """Who plays it."""
        return self.record.scenario.robots[self.place(role)]

    def truth(self, role: Role) -> list[Pose]:
        """Where it was in every tick; at least where it was released."""
        place = self.place(role)
        return [moment.truth.poses[place] for moment in self.record.moments] or [self.robot(role).start]

    def drive(self, role: Role, tick: int) -> Drive | None:
        """What it set out to do then; none, if that did not come."""
        return self.record.moments[tick].drives.get(self.robot(role).id)

    def account(self, role: Role) -> Account | None:
        """None where its journal cannot be read."""
        return self.accounts.get(self.robot(role).id)

    @property
    def told(self) -> list[Role]:
        """Those whose journal can be read."""
        return [role for role in ROLES if self.account(role) is not None]

    def minds(self, role: Role) -> tuple[Mind, ...]:
        """After each tick, as far as both its own record and the world's go."""
        account = self.account(role)
        return account.minds[: max(1, len(self.record.moments))] if account is not None else ()

    @cached_property
    def separations(self) -> list[float]:
        """m: how far apart the two truly were, tick by tick."""
        return [
            math.hypot(p.x - q.x, p.y - q.y) for p, q in zip(self.truth("a"), self.truth("b"), strict=True)
        ]

    @cached_property
    def mutual(self) -> list[tuple[bool, float | None]]:
        """Whether the two were in contact, and the range that was measured, tick by tick."""
        scenario = self.record.scenario
        told = [mutual_ranges(one.truth, scenario, [(self.a, self.b)])[0] for one in self.record.moments]
        return [(one is not None, one.range if one is not None else None) for one in told]

    def anchor_ranges(self, role: Role) -> list[float | None]:
        """m, as measured, tick by tick."""
        place, scenario = self.place(role), self.record.scenario
        return [anchor_ranges(one.truth, scenario)[place] for one in self.record.moments]

    @cached_property
    def contacts(self) -> list[tuple[int, int]]:
        """The first and the last tick of each stretch of contact."""
        spans: list[tuple[int, int]] = []
        for tick, (near, _) in enumerate(self.mutual):
            if near and spans and spans[-1][1] == tick - 1:
                spans[-1] = (spans[-1][0], tick)
            elif near:
                spans.append((tick, tick))
        return spans

    @cached_property
    def met(self) -> int | None:
        """The first tick in which one of them is in phase 3."""
        for tick in range(len(self.record.moments)):
            drives = [self.drive(role, tick) for role in ROLES]
            if any(drive is not None and drive.phase == 3 for drive in drives):
                return tick
        return None


ROLES: tuple[Role, Role] = ("a", "b")


def account(folder: Path, robot: str) -> Account:
    """What `robot` journaled, and its planner run again on it.

    Raises OSError if there is no journal, CorruptJournal if it is damaged before its end, or another's.
    """
    told = past_of(folder, robot)
    return _again(told) if told is not None else Account((), ())


def _again(told: Past) -> Account:
    """Every decision once more, which must be the one on record."""
    held, robot = told.estimates, Robot(told.briefing)
    minds: list[Mind] = []
    for step in told.steps:
        tick = step.sense.tick
        try:
            robot.sense(step.sense, step.frame)
            if step.drive is None:
                break
            robot.decide(step.heard, step.missed)
        except Exception as error:  # noqa: BLE001  # whatever the inputs on record do to it
            why = f"the planner cannot go on from its inputs of tick {tick}: {type(error).__name__}: {error}"
            return Account(held, tuple(minds), why)
        if robot.drive_frame != encode(step.drive):
            why = f"on record it decided otherwise at tick {tick}: the journal is another version's"
            return Account(held, tuple(minds), why)
        minds.append(robot.mind)
    return Account(held, tuple(minds))
