"""What there is to tell of a pair: where both were, what each measured, and each robot's own account."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property

import msgspec

from agent.mind import Mind
from compose import worldless
from compose.claim import Claim
from compose.figures.account import Account
from compose.record import Record
from compose.summary import ended, first_claim
from protocol.messages import Drive
from protocol.mission import Anchor, Mission, Role, Variant
from protocol.motion import Pose
from protocol.rendezvous import Orbit
from world.sensors import anchor_ranges, mutual_ranges

ROLES: tuple[Role, Role] = ("a", "b")


class Side(msgspec.Struct, frozen=True):
    """One of the two, tick by tick."""

    id: str
    anchor: Anchor
    orbit: Orbit
    path: tuple[Pose, ...]
    """where it was; without a world, as it claims, and empty if it never did"""
    drives: tuple[Drive | None, ...]
    """what it set out to do; none, where that did not come"""
    anchor_ranges: tuple[float | None, ...]
    """m, as measured"""
    account: Account | None
    """none where its journal cannot be read"""
    claim: Claim | None = None
    """the first that it made, against the truth"""


class Pair(msgspec.Struct, frozen=True, dict=True):
    """Two robots that are each other's peers."""

    title: str
    """which run it is of, and how that ended"""
    mission: Mission
    """what is known of the mission by all"""
    variant: Variant
    a: Side
    b: Side
    mutual: tuple[tuple[bool, float | None], ...]
    """whether the two were in contact, and the range that was measured, tick by tick"""
    record: Record | None
    """of the truth; none without a world"""

    @property
    def name(self) -> str:
        """Of the pair, in names of files."""
        return f"{self.a.id}-{self.b.id}"

    @property
    def exact(self) -> bool:
        """Whether its sensors are."""
        return self.mission.noise.exact

    @property
    def last(self) -> int:
        """The last tick on record."""
        return max(0, len(self.mutual) - 1)

    @property
    def placed(self) -> bool:
        """Whether it is known, or claimed, where both were."""
        return bool(self.a.path and self.b.path)

    def robot(self, role: Role) -> Side:
        """Who plays it."""
        return self.a if role == "a" else self.b

    def drive(self, role: Role, tick: int) -> Drive | None:
        """What it set out to do then; none, if that did not come."""
        drives = self.robot(role).drives
        return drives[tick] if tick < len(drives) else None

    @property
    def told(self) -> list[Role]:
        """Those whose journal can be read."""
        return [role for role in ROLES if self.robot(role).account is not None]

    def minds(self, role: Role) -> tuple[Mind, ...]:
        """After each tick, as far as there is anything else on record."""
        account = self.robot(role).account
        return account.minds[: max(1, len(self.mutual))] if account is not None else ()

    @cached_property
    def separations(self) -> list[float]:
        """m: how far apart the two were, tick by tick, as far as it is known."""
        return [math.hypot(p.x - q.x, p.y - q.y) for p, q in zip(self.a.path, self.b.path, strict=False)]

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
        for tick in range(len(self.mutual)):
            drives = [self.drive(role, tick) for role in ROLES]
            if any(drive is not None and drive.phase == 3 for drive in drives):
                return tick
        return None


def of_record(record: Record, places: tuple[int, int], accounts: Mapping[str, Account]) -> Pair:
    """The robots at those places of the scenario, a first; `accounts` are those that can be read."""
    scenario, moments = record.scenario, record.moments
    last = max(0, len(moments) - 1)
    how = (
        f"the record breaks off after {last} ticks"
        if record.end is None
        else ended(record.end.outcome, last, record.end.reason)
    )
    ranges = [anchor_ranges(one.truth, scenario) for one in moments]
    mutual = [mutual_ranges(one.truth, scenario, [places])[0] for one in moments]

    def side(role: Role, place: int) -> Side:
        robot = scenario.robots[place]
        return Side(
            robot.id,
            robot.anchor,
            robot.rendezvous.of(role),
            tuple([one.truth.poses[place] for one in moments] or [robot.start]),
            tuple([one.drives.get(robot.id) for one in moments]),
            tuple([each[place] for each in ranges]),
            accounts.get(robot.id),
            first_claim(record, place),
        )

    return Pair(
        f"{scenario.name}, seed {scenario.seed}, {scenario.variant}: {how}",
        scenario.mission,
        scenario.variant,
        side("a", places[0]),
        side("b", places[1]),
        tuple([(one is not None, one.range if one is not None else None) for one in mutual]),
        record,
    )


def of_robots(accounts: Mapping[str, Account]) -> Pair:
    """Without a world: of one or both of a pair, each of whom was briefed."""
    told = {robot: one.past for robot, one in accounts.items() if one.past is not None}
    briefing = next(iter(told.values())).briefing
    ticks = min([len(past.steps) for past in told.values()])
    mutual: list[tuple[bool, float | None]] = []
    for tick in range(ticks):
        met = [one for past in told.values() if (one := worldless.contact(past, tick)) is not None]
        mutual.append((bool(met), next((one.range for one in met if one.range is not None), None)))

    def side(role: Role) -> Side:
        own = briefing.role == role
        robot = briefing.robot if own else briefing.peer
        past = told.get(robot)
        steps = past.steps[:ticks] if past is not None else ()
        return Side(
            robot,
            briefing.anchor if own else briefing.peer_anchor,
            briefing.rendezvous.of(role),
            worldless.path(past)[:ticks] if past is not None else (),
            tuple([step.drive for step in steps]),
            tuple([step.sense.anchor_range for step in steps]),
            accounts.get(robot),
        )

    places = "; places by their claims" if all(past.claim is not None for past in told.values()) else ""
    return Pair(
        f"{' and '.join(told)} without a world, {briefing.variant}: {worldless.outcome(told)}{places}",
        briefing.mission,
        briefing.variant,
        side("a"),
        side("b"),
        tuple(mutual),
        None,
    )
