"""What there is to tell of a pair: where both were, what each measured, and each robot's own account."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property

import msgspec
from msgspec.structs import replace

from agent.planning.state import RobotState
from compose.figures.account import Account
from compose.recording.claim import Claim
from compose.recording.robots import outcome
from compose.recording.run import Recording
from compose.recording.summary_json import broken_off, ended, first_claim
from protocol.messages import Command
from protocol.mission import Anchor, Mission, PlannerName, Role
from protocol.motion import Pose
from protocol.orbits import Orbit
from world.sensors import anchor_ranges, mutual_ranges

ROLES: tuple[Role, Role] = ("a", "b")


class Side(msgspec.Struct, frozen=True):
    """One of the two, tick by tick."""

    id: str
    anchor: Anchor
    orbit: Orbit
    path: tuple[Pose, ...]
    """where it was; without a world, as it claims, and empty if it never did"""
    commands: tuple[Command | None, ...]
    """what it set out to do; none, where that did not come"""
    anchor_ranges: tuple[float | None, ...]
    """m, as measured"""
    account: Account | None
    """none where its journal cannot be read"""
    claim: Claim | None = None
    """the first that it made, held against the truth; none without a world"""


class PairRecord(msgspec.Struct, frozen=True, dict=True):
    """Two robots that are each other's peers."""

    title: str
    """which run it is of, and how that ended"""
    mission: Mission
    """what is known of the mission by all"""
    planner_name: PlannerName
    a: Side
    b: Side
    mutual: tuple[tuple[bool, float | None], ...]
    """whether the two were in contact, and the range that was measured, tick by tick; where the two measured
    it each for itself, a's, or where a has none, b's"""
    recording: Recording | None
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
    def true(self) -> bool:
        """Whether paths are true, and not what the robots claim."""
        return self.recording is not None

    @property
    def placed(self) -> int:
        """Ticks, from 0 on, in which it is known, or claimed, where both were."""
        return min(len(self.a.path), len(self.b.path))

    def robot(self, role: Role) -> Side:
        """Who plays it."""
        return self.a if role == "a" else self.b

    def command(self, role: Role, tick: int) -> Command | None:
        """What it set out to do then; none, if that did not come."""
        commands = self.robot(role).commands
        return commands[tick] if tick < len(commands) else None

    @property
    def unknown(self) -> str | None:
        """The reason why what the two planned is not known to the end; none if it is."""
        robots = [
            side.id
            for side in (self.a, self.b)
            if side.account is None or side.account.broken is not None
        ]  # fmt: skip
        if not robots:
            return None
        return f"the journal of {' and '.join(robots)} is missing, or cannot be followed to its end"

    @property
    def told(self) -> list[Role]:
        """Those whose journal can be read."""
        return [role for role in ROLES if self.robot(role).account is not None]

    def states(self, role: Role) -> tuple[RobotState, ...]:
        """After each tick, as far as the rest of the record goes."""
        account = self.robot(role).account
        return account.states[: max(1, len(self.mutual))] if account is not None else ()

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
    def encounter_tick(self) -> int | None:
        """The first tick in which one of them is in phase 3."""
        for tick in range(len(self.mutual)):
            commands = [self.command(role, tick) for role in ROLES]
            if any(command is not None and command.phase == 3 for command in commands):
                return tick
        return None


def of_record(recording: Recording, places: tuple[int, int], accounts: Mapping[str, Account]) -> PairRecord:
    """The robots at those places of the scenario, a first; `accounts` are those that can be read."""
    scenario, moments = recording.scenario, recording.moments
    last = len(moments) - 1
    how = (
        ended(recording.end.outcome, last, recording.end.reason)
        if recording.end is not None
        else broken_off(last)
    )
    ranges = [anchor_ranges(one.truth, scenario) for one in moments]
    mutual = [mutual_ranges(one.truth, scenario, [places])[0] for one in moments]

    def side(role: Role, place: int) -> Side:
        robot = scenario.robots[place]
        return Side(
            id=robot.id,
            anchor=robot.anchor,
            orbit=robot.rendezvous.of(role),
            path=tuple([one.truth.poses[place] for one in moments] or [robot.start]),
            commands=tuple([one.commands.get(robot.id) for one in moments]),
            anchor_ranges=tuple([each[place] for each in ranges]),
            account=accounts.get(robot.id),
            claim=first_claim(recording, place),
        )

    return PairRecord(
        title=f"{scenario.name}, seed {scenario.seed}, {scenario.planner_name}: {how}",
        mission=scenario.mission,
        planner_name=scenario.planner_name,
        a=side("a", places[0]),
        b=side("b", places[1]),
        mutual=tuple([(one is not None, one.range if one is not None else None) for one in mutual]),
        recording=recording,
    )


def of_robots(accounts: Mapping[str, Account]) -> PairRecord:
    """Without a world: of one or both of a pair, each of whom was briefed."""
    told = {robot: one.past for robot, one in accounts.items() if one.past is not None}
    config = next(iter(told.values())).config
    in_order = sorted(told.values(), key=lambda past: past.config.role)
    mutual: list[tuple[bool, float | None]] = []
    for tick in range(max([len(past.steps) for past in told.values()])):
        met = [one for past in in_order if (one := past.contact(tick)) is not None]
        mutual.append((bool(met), next((one.range for one in met if one.range is not None), None)))

    def side(role: Role) -> Side:
        own = config.role == role
        robot = config.robot if own else config.peer
        past = told.get(robot)
        steps = past.steps if past is not None else ()
        return Side(
            id=robot,
            anchor=config.anchor if own else config.peer_anchor,
            orbit=config.rendezvous.of(role),
            path=past.path if past is not None else (),
            commands=tuple([step.command for step in steps]),
            anchor_ranges=tuple([step.observation.anchor_range for step in steps]),
            account=accounts.get(robot),
        )

    pair = PairRecord(
        title=f"{' and '.join(told)} without a world, {config.planner_name}: {outcome(told)}",
        mission=config.mission,
        planner_name=config.planner_name,
        a=side("a"),
        b=side("b"),
        mutual=tuple(mutual),
        recording=None,
    )
    return replace(pair, title=f"{pair.title}; places by their claims") if pair.placed else pair
