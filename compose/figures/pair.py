"""The data of a pair for figures: true paths, measurements, and the planner states of both robots."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from functools import cached_property
from itertools import groupby
from typing import Any, NamedTuple

import msgspec

from agent.planning.planner import Planner
from agent.planning.state import RobotState
from compose.figures.agent_replay import AgentReplay
from compose.recording.claim_errors import Claim
from compose.recording.group_localisation import PastMeeting, past_meetings
from compose.recording.run import Run
from protocol.messages import Command, Estimate
from protocol.mission import ROLES, Anchor, Mission, PlannerName, Role
from protocol.motion import Pose, travelled
from protocol.orbits import Orbit


class Span(NamedTuple):
    """The consecutive ticks `first` to `last` in which a robot is in one of the paper's phases."""

    phase: int
    first: int
    last: int


class Side(msgspec.Struct, frozen=True, dict=True):
    """One robot of a pair, with one entry per tick in each sequence, from tick 0 to the meeting's end."""

    id: str
    anchor: Anchor
    orbit: Orbit
    path: tuple[Pose, ...]
    """The true poses; in hardware mode, those implied by the robot's claim, and empty if it made none."""
    commands: tuple[Command | None, ...]
    """The commands; None in ticks whose Command missed the deadline."""
    anchor_ranges: tuple[float | None, ...]
    """The measured ranges to the robot's anchor, in m; None out of range."""
    replay: AgentReplay | None
    """The recomputed planner states; None if the robot's journal cannot be read."""
    claim: Claim | None = None
    """The robot's standing claim, with its errors; None in hardware mode, and in meetings after it."""
    first: int = 0
    """The tick in which the robot leaves for the meeting; 0 if it waits, or meets on its first orbit."""
    is_new: bool = True
    """True if this is its first meeting; always in pairs."""

    @cached_property
    def estimates(self) -> tuple[tuple[Estimate, Pose], ...]:
        """The journaled estimates of the meeting, each with the pose of `path` in the same tick, if known."""
        known = range(self.first, len(self.path))
        estimates = self.replay.estimates if self.replay is not None else ()
        return tuple([(one, self.path[one.tick]) for one in estimates if one.tick in known])

    @property
    def on_orbit(self) -> bool:
        """True if the robot drives to its orbit in phase 2, and not straight to its peer."""
        return self.first == 0

    @property
    def way(self) -> tuple[Pose, ...]:
        """The poses of the meeting."""
        return self.path[self.first :]

    @cached_property
    def placed(self) -> tuple[tuple[Estimate, Pose], ...]:
        """The estimates with poses in the world frame, which exist only from the encounter on."""
        return tuple([(one, truth) for one, truth in self.estimates if one.world])

    @cached_property
    def likeliest(self) -> tuple[tuple[Estimate, Pose], ...]:
        """The estimates in `placed` whose first pose is the most probable or the only one."""
        return tuple([(one, truth) for one, truth in self.placed if one.probabilities or len(one.world) == 1])

    @cached_property
    def phases(self) -> tuple[int, ...]:
        """The phase in each tick. A tick without a Command has the phase before it."""
        found: list[int] = []
        for command in self.commands:
            found.append(command.phase if command is not None else found[-1] if found else 1)
        return tuple(found)

    def phase(self, tick: int) -> int:
        """Return the phase in `tick`, or the last one known."""
        return self.phases[min(tick, len(self.phases) - 1)] if self.phases else 1


class PairRecord(msgspec.Struct, frozen=True, dict=True):
    """Two robots that are each other's peers; in a group, in one meeting."""

    title: str
    """The name of the run and its outcome."""
    mission: Mission
    """The mission parameters, common to all robots."""
    planner_name: PlannerName
    a: Side
    b: Side
    mutual: tuple[tuple[bool, float | None], ...]
    """One entry per tick: whether the robots were in contact, and the measured range in m.

    In hardware mode, in which both robots measure, it is the range of a, or that of b if a has none.
    """
    run: Run
    """The run; without ground truth in hardware mode."""
    number: int = 1
    """The number of meetings of the two so far, this one included; 1 in pairs."""

    @property
    def name(self) -> str:
        """The name of the pair, or of the meeting, in file names."""
        return f"{self.a.id}-{self.b.id}" + (f"-{self.number}" if self.number > 1 else "")

    @property
    def exact(self) -> bool:
        """True if the sensors are exact."""
        return self.mission.noise.exact

    @property
    def senses_actively(self) -> bool:
        """True if the robots choose their ranges by information, with states that can be drawn."""
        return self.planner is not None and self.planner.ACTIVE_SENSING and not self.exact

    @property
    def true(self) -> bool:
        """True if the paths are the ground truth, and not implied by claims."""
        return self.run.world is not None

    @property
    def placed(self) -> int:
        """The number of ticks, from 0 on, in which the poses of both robots are known or claimed."""
        return min(len(self.a.path), len(self.b.path))

    def robot(self, role: Role) -> Side:
        """Return the robot with `role`."""
        return self.a if role == "a" else self.b

    def command(self, role: Role, tick: int) -> Command | None:
        """Return the command of the robot with `role` at `tick`; None if there is none."""
        commands = self.robot(role).commands
        return commands[tick] if tick < len(commands) else None

    @property
    def unknown(self) -> str | None:
        """The reason why the planner states are incomplete; None if they are complete."""
        sides = [side for side in (self.a, self.b) if side.replay is None or side.replay.broken is not None]
        robots = " and ".join([side.id for side in sides])
        return f"the journal of {robots} is missing or cannot be replayed to its end" if sides else None

    @property
    def planner(self) -> Planner[Any, Any] | None:
        """The planner of a robot whose states are known; None if no figure can show them."""
        replays = [side.replay for side in (self.a, self.b) if side.replay is not None]
        return next((replay.planner for replay in replays if replay.planner is not None), None)

    @property
    def readable(self) -> list[Role]:
        """The roles of the robots whose journals can be read."""
        return [role for role in ROLES if self.robot(role).replay is not None]

    @property
    def newcomers(self) -> list[Role]:
        """The roles of the readable robots whose first meeting this is: for pairs, all."""
        return [role for role in self.readable if self.robot(role).is_new]

    def states(self, role: Role) -> tuple[RobotState, ...]:
        """Return the planner state after each tick, up to the last tick of the recording."""
        one = self.robot(role)
        return one.replay.states[one.first : max(1, len(self.mutual))] if one.replay is not None else ()

    @cached_property
    def separations(self) -> list[float]:
        """The distance between the robots in m, one entry per tick, from 0, in which both poses are known."""
        return list(map(travelled, self.a.path, self.b.path))

    @cached_property
    def contacts(self) -> list[tuple[int, int]]:
        """The first and the last tick of each stretch of contact."""
        ticks = range(self.first, len(self.mutual))
        pieces = [list(piece) for near, piece in groupby(ticks, lambda tick: self.mutual[tick][0]) if near]
        return [(piece[0], piece[-1]) for piece in pieces]

    @cached_property
    def encounter_tick(self) -> int | None:
        """The first tick in which one of the robots is in phase 3; None if there is none."""
        met = [
            side.phases.index(3, self.first) for side in (self.a, self.b) if 3 in side.phases[self.first :]
        ]
        return min([tick for tick in met if tick < len(self.mutual)], default=None)

    @property
    def first(self) -> int:
        """The tick in which the meeting begins; 0 for pairs."""
        return max(self.a.first, self.b.first)

    def spans(self, *roles: Role) -> tuple[Span, ...]:
        """Return the phases of the robots with `roles`, the earlier one where they differ, over all ticks.

        In a group, these are the ticks from which on all these robots are in the meeting.
        """
        sides = [self.robot(role) for role in roles]
        known = [side for side in sides if side.phases] or sides
        first, met = max(side.first for side in sides), self.encounter_tick

        def phase(tick: int) -> int:
            together = met is not None and len(roles) > 1 and tick >= met
            return 3 if together else min(side.phase(tick) for side in known)

        pieces = [(one, list(ticks)) for one, ticks in groupby(range(first, len(self.mutual)), phase)]
        return tuple([Span(one, ticks[0], ticks[-1]) for one, ticks in pieces]) or (Span(1, 0, 0),)


def others(estimate: Estimate) -> tuple[Pose, ...]:
    """Return the possible world poses but the most probable; all of them if none is more probable."""
    return estimate.world[1:] if estimate.probabilities or len(estimate.world) == 1 else estimate.world


def encounters(run: Run) -> list[PastMeeting]:
    """Return the meetings of `run` that have begun; a pair without a group has one, all the time."""
    pairs = [PastMeeting(pair[0], pair[-1], 0, sys.maxsize - 1, 1, frozenset(pair)) for pair in run.pairs]
    return [*past_meetings(run)] or pairs


def pairs_of(run: Run, replays: Mapping[str, AgentReplay]) -> Iterator[PairRecord]:
    """Yield the pairs of `run` that have data; in a group, the meetings that have begun."""
    found = [pair_of(run, meeting, replays) for meeting in encounters(run)]
    yield from [pair for pair in found if pair is not None]


def pair_of(run: Run, meeting: PastMeeting, replays: Mapping[str, AgentReplay]) -> PairRecord | None:
    """Return the pair of a meeting; None in hardware mode if no journal has a configuration.

    `replays` holds the readable journals by robot id.
    """
    robots = dict.fromkeys((meeting.a, meeting.b))
    histories = {one: replays[one].history for one in robots if one in replays}
    known = {robot: history for robot, history in histories.items() if history is not None}
    if run.world is not None:
        config = run.scenario.config(meeting.a)
        ticks = dict.fromkeys(robots, run.length)
    elif known:
        config = next(iter(known.values())).config
        ticks = {robot: len(history.steps) for robot, history in known.items()}
    else:
        return None
    title = run.title(list(known))
    if config.members:
        title += f"; meeting of {meeting.a} and {meeting.b}, ticks {meeting.first} to {meeting.last}"
        role: Role = "a" if config.robot == meeting.a else "b"
        peer = meeting.b if role == "a" else meeting.a
        config = config if config.peer == peer else config.in_meeting(peer, role)
    ticks = {robot: min(count, meeting.last + 1) for robot, count in ticks.items()}
    peers = {config.robot: config.peer, config.peer: config.robot}
    mutual: list[tuple[bool, float | None]] = []
    for tick in range(max(ticks.values())):
        contacts = [one for robot in ticks if (one := run.contact(robot, tick, peers[robot])) is not None]
        mutual.append((bool(contacts), next((one.range for one in contacts if one.range is not None), None)))

    def side(role: Role) -> Side:
        own = config.role == role
        robot = config.robot if own else config.peer
        claim, is_new = run.claim(robot), robot in meeting.newcomers or not config.members
        if claim is not None and not is_new and not meeting.first <= claim.tick <= meeting.last:
            claim = None
        if run.world is not None:
            path = run.truth(robot) or (run.scenario.robot(robot).start,)
        else:
            path = known[robot].path if robot in known else ()
        seen = range(ticks.get(robot, 0))
        return Side(
            id=robot,
            anchor=config.anchor if own else config.peer_anchor,
            orbit=config.rendezvous.of(role),
            path=path[: meeting.last + 1],
            commands=tuple([run.command(robot, tick) for tick in seen]),
            anchor_ranges=tuple([run.observations[tick][robot].anchor_range for tick in seen]),
            replay=replays.get(robot),
            claim=claim,
            first=meeting.first if role == "a" else 0,
            is_new=is_new,
        )

    a, b = side("a"), side("b")
    if run.world is None and a.path and b.path:
        title += "; positions from claims"
    return PairRecord(title, config.mission, config.planner_name, a, b, tuple(mutual), run, meeting.number)
