"""The complete description of a mission from which a world starts. It is the second frame of its journal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from itertools import combinations
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from protocol.attack import Attack
from protocol.coverage_strips import SweptArea
from protocol.messages import (
    MAX_MEMBERS,
    Appointment,
    Member,
    OfPair,
    Pairing,
    RobotConfig,
    Team,
    TeamAnchor,
)
from protocol.mission import Anchor, Mission, Options, PlannerName
from protocol.motion import Pose
from protocol.units import Clearance, RobotId, Tick, Time
from world.faults import Fault
from world.radio_models import RADIO_MODELS
from world.range_models import RANGE_MODELS
from world.sensor_model import SensorModel, sensor_model
from world.world_models import OWN_MODELS, ModelSpec, RadioModel, RangeModel
from world.world_noise import WorldNoise


def model_class(name: str, shipped: Mapping[str, Any]) -> Any:
    """Return the class of a model that is shipped, or that the user has named. Raises LookupError."""
    model = shipped.get(name) or OWN_MODELS.get(name)
    if model is None:
        raise LookupError(f"the world uses the model {name}; to run its code, add --model {name}")
    return model


class RobotSpec(OfPair, msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The specification of one robot."""

    id: RobotId
    """The name of the robot."""
    encounter: Pairing | None
    """The robot that it has to meet; None in a team."""
    given_anchor: Anchor | None
    """The position of its anchor in <W>, in m; None if it has none, as some robots of a group."""
    start: Pose
    """The true pose at tick 0 in <W>, which is unknown to the robot: m, m and rad."""
    attack: Attack | None = None
    """The false data that the robot injects into its Reports; None for an honest robot."""
    ranges: tuple[RobotId, ...] = ()
    """The anchors of a team that it may range."""


GIVES_UP = 0.97
"""The time at which a robot that no meeting has localised gives up, as a fraction of that of `max_ticks`."""


class PlannedMeeting(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A meeting of two robots of a group, after which both are localised."""

    visitor: RobotId
    """The robot that drives to the other one, with the role a."""
    visited: RobotId
    """The robot that waits beside its anchor, with the role b."""
    ends: Time
    """The bound in s of the time at which both are localised."""


class PlannedCoverage(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The search of localised robots for those without an anchor."""

    sweep: SweptArea
    """The area, and the number of its parts."""
    sweepers: tuple[RobotId, ...]
    """The robots that cover it, in the order of the parts that they cover first."""
    ends: Time
    """The bound in s of the time at which all robots without an anchor are localised."""


class PlannedConfirmation(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The meetings after which robots claim poses on which several peers agree."""

    visits: tuple[Appointment, ...]
    """The visits, in the order in which they begin; those of one time are of different robots."""
    ends: Time
    """The bound in s of the time at which all have claimed their poses if no robot reports false data."""


class Death(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A robot that is dead for good: it stands still, and measures, sends and receives nothing."""

    robot: RobotId
    """The robot."""
    tick: Tick
    """The tick from which on it is dead."""


class PlacedAnchor(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """An anchor of a team."""

    told: TeamAnchor
    """The anchor, as the robots know it."""
    place: Anchor
    """The true position in <W>, in m."""


class PlannedTeam(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The anchors of a team, and what its robots are told."""

    anchors: tuple[PlacedAnchor, ...]
    """The anchors, in the order of the scenario."""
    origin: RobotId | None
    """The robot whose pose at tick 0 is the origin of <W>; None if anchors determine <W>."""
    bound: Time
    """The bound in s of the time at which all robots are localised, with exact sensors."""
    survey: Clearance = 0.0
    """The sigma (m) up to which anchors that are not surveyed are measured; 0: robots do not wait for it."""
    diameter: Clearance = 0.0
    """The distance (m) within which the first robot searches for the others; 0: ranges connect all robots."""


class Scenario(
    msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True, tag="scenario", dict=True
):
    """A validated mission. All its random and derived values have been computed."""

    name: str
    """The name of the scenario."""
    seed: int
    """The seed of all random numbers."""
    max_ticks: Tick
    """The tick at which the run ends at the latest."""
    mission: Mission
    """The parameters of the mission."""
    planner_name: PlannerName
    """The name of the planner of all robots."""
    robots: tuple[RobotSpec, ...]
    """The robots, in pairs of peers."""
    faults: tuple[Fault, ...] = ()
    """The fault plan of the radio."""

    world_noise: WorldNoise | None = None
    """The noise of the simulated sensors; None if it is the one that the robots are told."""
    planner_options: Options = {}
    """The options of the planner, by name."""
    range_model: ModelSpec | None = None
    """The model of detection and ranges; None for the disc of R."""
    radio_model: ModelSpec | None = None
    """The model of the delivery of reports; None if all are delivered."""
    meetings: tuple[PlannedMeeting, ...] = ()
    """The meetings of a group, in the order in which they end; empty if the robots form pairs.

    Each robot meets one that is localised, then others that are not.
    """
    retries: tuple[Appointment, ...] = ()
    """The meetings with which a group tries again, in the order in which they begin."""
    deaths: tuple[Death, ...] = ()
    """The robots of a group that die, in the order of the scenario."""
    tolerates: Annotated[int, Meta(ge=0, le=MAX_MEMBERS)] = 0
    """The number of robots of a group that may report false data."""
    planned_sweep: PlannedCoverage | None = None
    """The search for robots without an anchor; None if all robots have one."""
    confirmation: PlannedConfirmation | None = None
    """The meetings that confirm poses; None if robots claim the pose that they know."""
    least_bound: Time = 0.0
    """A lower bound in s of the time that any plan of the meetings allows; 0 if the robots form pairs."""
    team: PlannedTeam | None = None
    """The anchors of robots that share all measurements; None if they form pairs or a group."""

    @cached_property
    def ranging(self) -> RangeModel | None:
        """The range model; None for the disc of R. Raises LookupError if this process does not know it."""
        spec = self.range_model
        return None if spec is None else model_class(spec.model, RANGE_MODELS)(**spec.options)

    @cached_property
    def attacked(self) -> frozenset[str]:
        """The robots that measure the link whose ranges are attacked: two, or one with an anchor."""
        spec, ids = self.range_model, [one.id for one in self.robots]
        link = str(spec.options.get("link")) if spec is not None and spec.model == "attacked" else ""
        pairs, ranged = self.sensors.mutual.items(), self.sensors.anchors.items()
        found = [{ids[i], ids[j]} for (i, j), one in pairs if link == f"mutual/{one.robot}"]
        return frozenset(*found, *[{robot} for (robot, _), one in ranged if link == f"anchor/{one.robot}"])

    @cached_property
    def radio(self) -> RadioModel[Any] | None:
        """The radio model; None if all reports are delivered. Raises LookupError like `ranging`."""
        spec = self.radio_model
        return None if spec is None else model_class(spec.model, RADIO_MODELS)(**spec.options)

    @cached_property
    def sensors(self) -> SensorModel:
        """The sensors of all robots, with everything that is drawn once for the mission."""
        ids = [robot.id for robot in self.robots]
        ranged = [(one, name) for one, known in zip(ids, self.ranged, strict=True) for name, _ in known]
        return sensor_model(
            self.mission, self.world_noise or WorldNoise(), ids, ranged, self.radio_pairs(), self.seed
        )

    @cached_property
    def ranged(self) -> tuple[tuple[tuple[str, Anchor], ...], ...]:
        """The anchors that each robot may range, with their true positions in <W>, in m.

        The name of a robot's own anchor is that of the robot.
        """
        anchors = self.team.anchors if self.team is not None else ()
        return tuple(
            [
                ((one.id, one.given_anchor),)
                if one.given_anchor is not None
                else tuple([(each.told.id, each.place) for each in anchors if each.told.id in one.ranges])
                for one in self.robots
            ]
        )

    def home(self, place: int) -> Anchor:
        """Return the position of a robot's anchor, or of its start if it has none, in <W>, in m."""
        robot = self.robots[place]
        return robot.given_anchor or Anchor(robot.start.x, robot.start.y)

    @property
    def t_max(self) -> float:
        """T_max in s: the largest bound of the meetings of all pairs; in a team, that of its duration."""
        if self.team is not None:
            return self.team.bound
        return max([robot.rendezvous.bound for robot in self.robots])

    @property
    def in_pairs(self) -> bool:
        """True if the robots form pairs: others range all that are in contact, and withdraw claims."""
        return not self.meetings and self.team is None

    @property
    def unanchored(self) -> tuple[str, ...]:
        """The robots without an anchor, in the order of the scenario."""
        return tuple(
            [one.id for one in self.robots if one.given_anchor is None and one.encounter is not None]
        )

    @cached_property
    def _dead_from(self) -> dict[str, int]:
        return {one.robot: one.tick for one in self.deaths}

    def is_dead(self, robot: str, tick: int) -> bool:
        """Return whether `robot` is dead at `tick`."""
        return tick >= self._dead_from.get(robot, tick + 1)

    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Return the pairs that meet as indices into `robots`, with robot a first.

        In a group, they are the meetings, and a robot may be in several of them.
        """
        index = {robot.id: i for i, robot in enumerate(self.robots)}
        if self.meetings:
            return tuple((index[one.visitor], index[one.visited]) for one in self.meetings)
        met = [one for one in self.robots if one.encounter is not None]
        return tuple((index[one.id], index[one.peer]) for one in met if one.role == "a")

    def radio_pairs(self) -> tuple[tuple[int, int], ...]:
        """Return the pairs that measure their range if it is at most R: the peers, or any two of a group."""
        return self.pairs() if self.in_pairs else tuple(combinations(range(len(self.robots)), 2))

    def robot(self, robot: str) -> RobotSpec:
        """Return the specification of `robot`. Raises KeyError if there is no such robot."""
        for spec in self.robots:
            if spec.id == robot:
                return spec
        raise KeyError(robot)

    def is_of(self, config: RobotConfig) -> bool:
        """Return whether `config` is the configuration of one of the robots, with any `tick_s`."""
        has_robot = any(spec.id == config.robot for spec in self.robots)
        return has_robot and self.config(config.robot, config.tick_s) == config

    def config(self, robot: str, tick_s: float | None = None) -> RobotConfig:
        """Return the configuration of `robot`, without its pose. `tick_s` (s) is for real time only.

        Raises KeyError if there is no such robot.
        """
        own = self.robot(robot)
        visits = [one.visited for one in self.meetings if one.visitor == robot and one.visited != own.peer]
        team = self.team
        retries = [one for one in self.retries if robot in (one.visitor, one.visited)]
        confirming = self.confirmation.visits if self.confirmation is not None else ()
        sweep = self.planned_sweep.sweep if self.planned_sweep is not None else None
        sweepers = self.planned_sweep.sweepers if self.planned_sweep is not None else ()
        return RobotConfig(
            robot=own.id,
            encounter=own.encounter,
            given_anchor=own.given_anchor,
            mission=self.mission,
            planner_name=self.planner_name,
            attack=own.attack,
            tick_s=tick_s,
            planner_options=self.planner_options,
            members=self.members,
            visits=tuple(visits),
            retries=tuple(retries),
            gives_up=0.0 if self.in_pairs else self.max_ticks * self.mission.period * GIVES_UP,
            tolerates=self.tolerates,
            confirmations=tuple([one for one in confirming if one.visitor == robot]),
            unanchored=self.unanchored,
            sweep=sweep,
            part=sweepers.index(robot) if robot in sweepers else 0,
            team=None
            if team is None
            else Team(
                tuple([one.id for one in self.robots]),
                tuple([one.told for one in team.anchors]),
                team.origin,
                team.bound,
                team.survey,
                team.diameter,
            ),
            ranges=own.ranges,
        )

    @cached_property
    def members(self) -> tuple[Member, ...]:
        """The robots of the group with an anchor, as they know each other; empty for pairs."""
        ends: dict[str, int] = {}
        for meeting in self.meetings:
            last = _last_tick(meeting.ends, self.mission.period)
            ends.setdefault(meeting.visitor, last)
            ends.setdefault(meeting.visited, last)
        anchored = [one for one in self.robots if one.id in ends]
        return tuple([Member(one.id, one.anchor, ends[one.id]) for one in anchored])


def _last_tick(moment: float, period: float) -> int:
    """Return the last tick that begins at `moment` or before; both times are in s."""
    tick = math.floor(moment / period)  # the quotient is rounded, which can move it over a tick
    while (tick + 1) * period <= moment:
        tick += 1
    while tick * period > moment:
        tick -= 1
    return tick
