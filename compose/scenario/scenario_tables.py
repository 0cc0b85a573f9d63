"""The tables of a scenario file: their fields, types, bounds and defaults."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from compose.scenario.fault_syntax import FaultTable
from compose.scenario.kills import KillTable
from protocol.attack import Attack
from protocol.mission import Mission, Options, PlannerName
from protocol.network.clock import ClockError
from protocol.units import NAME, Clearance, RobotId, Tick
from world.world_models import ModelSpec
from world.world_noise import WorldNoise

MAX_TICKS = 10**9
"""The largest number of ticks of a run."""
MAX_ROBOTS = 200
"""The largest number of robots, so that a GroundTruth message of all of them fits a frame."""
MAX_TEAM = 16
"""The largest number of robots of a team: each of them estimates the poses of all."""
Place = Annotated[float, Meta(ge=-1e6, le=1e6)]
"""A coordinate in m. No robot can drive so far from it that it leaves the range of `units.Coordinate`."""


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table of the file. Unknown fields are errors, because they are typing mistakes."""


class PlannerTable(_Table, frozen=True):
    """The `[planner]` table."""

    name: PlannerName = "assured"
    """The planner of all robots: `assured`, `paper`, an installed one, or MODULE:CLASS."""
    options: Options = {}
    """The options of a planner of your own: the keyword arguments of its class."""


class WorldTable(_Table, frozen=True):
    """The `[world]` table: what the simulator does and the robots are not told."""

    noise: WorldNoise = WorldNoise()
    """The `[world.noise]` table: the noise that the sensors have."""
    range: ModelSpec | None = None
    """The `[world.range]` table: the model of detection and ranges."""
    radio: ModelSpec | None = None
    """The `[world.radio]` table: the model of the delivery of reports."""


Area = tuple[Place, Place, Place, Place]
"""The smallest x and y and the largest x and y of an area, in m."""


class MissionTable(Mission, frozen=True, forbid_unknown_fields=True):
    """The `[mission]` table."""

    area: Area | None = None
    """x_min, y_min, x_max, y_max in m: the area in which robots without an anchor are."""
    frame: Literal["relative"] | None = None
    """`relative`: without anchors, in the frame of the first robot's start. None: anchors determine <W>."""
    survey: Clearance = 0.0
    """The sigma in m up to which robots measure anchors that are not surveyed before they claim their poses.

    0: they do not wait for it.
    """
    diameter: Clearance = 0.0
    """The largest distance in m of a start from that of the first robot, which searches for the others; with
    `frame`.

    0: ranges connect all starts.
    """
    tolerates: Annotated[int, Meta(ge=0, le=MAX_ROBOTS)] = 0
    """The number of robots that may report false data: one more must agree before a claim.

    In a team, a robot also claims what its own measurements tell. In groups, with exact sensors, that holds
    for robots without an anchor. With noisy ones, it holds for all robots, and all have an anchor.
    """

    @property
    def plain(self) -> Mission:
        """The mission without the area, which is not part of it."""
        return Mission(*[getattr(self, field) for field in Mission.__struct_fields__])


class RobotTable(_Table, frozen=True):
    """A `[[robot]]` table."""

    id: RobotId
    """The robot's name."""
    anchor: tuple[Place, Place] | None = None
    """x, y of the robot's anchor, in m. Robots of a group may have none."""
    anchors: list[RobotId] | None = None
    """The `[[anchor]]` that it may range; None: all."""
    start: tuple[Place, Place, Annotated[float, Meta(ge=-1e6, le=1e6)]] | None = None
    """Start pose x, y in m and heading in rad; None: drawn from the seed, within range of the anchor.

    Without an anchor, it is drawn in `mission.area`.
    """
    peer: RobotId | None = None
    """Id of the peer. More than two robots without one form a group, which meets in turn."""
    attack: Attack | None = None
    """False data injection: the falsification of the reports that this robot sends to its peer."""
    dies: Tick | None = None
    """The tick from which on it is dead, in a group or a team: it stands still, and measures, sends and
    receives nothing."""


class AnchorTable(_Table, frozen=True):
    """An `[[anchor]]` table: an anchor that every robot may range, unless it has `anchors` of its own."""

    id: RobotId
    """The anchor's name."""
    position: tuple[Place, Place] | None = None
    """x, y in m, as the robots are told; None: they do not know it, and estimate it."""
    sigma: Clearance = 0.0
    """The standard deviation of each coordinate of `position` in m, as the robots are told. The true position
    is drawn with it."""
    stands: tuple[Place, Place] | None = None
    """The true x, y in m; None: at `position`, or drawn from the seed in `mission.area` without one."""


DeathTick = Tick | Annotated[list[Tick], Meta(min_length=2, max_length=2)]
"""A tick, or the bounds between which it is drawn, both included."""


class TeamTable(_Table, frozen=True):
    """The `[team]` table: a room whose anchors and robots are drawn from the seed."""

    robots: Annotated[int, Meta(ge=1, le=MAX_TEAM)]
    """The number n of robots, which are r1 to rn."""
    side: Annotated[float, Meta(gt=0.0, le=1e5)]
    """The anchors and the starts are uniform in a square with this side in m."""
    anchors: Annotated[int, Meta(ge=0, le=MAX_ROBOTS)] = 0
    """The number m of anchors, which are A1 to Am; none with `mission.frame`."""
    unknown: Annotated[int, Meta(ge=0, le=MAX_ROBOTS)] = 0
    """The number of anchors whose position the robots do not know, the last ones."""
    attack: Attack | None = None
    """False data injection by the robot r1."""
    dies: DeathTick | None = None
    """The tick from which on the robot r2 is dead, or the bounds between which it is drawn, both included."""


class GroupTable(_Table, frozen=True):
    """The `[group]` table: robots whose anchors are drawn from the seed, instead of `[[robot]]`."""

    robots: Annotated[int, Meta(ge=3, le=MAX_ROBOTS)]
    """The number n of robots, which are r1 to rn."""
    spacing: Annotated[float, Meta(gt=0.0, le=1e5)]
    """The anchors are uniform in a square, whose side in m is this times the square root of n."""
    without_anchor: Annotated[int, Meta(ge=0, le=MAX_ROBOTS)] = 0
    """The number of robots without an anchor, the last ones. By default, `mission.area` is the square."""
    attack: Attack | None = None
    """False data injection by the robot r1."""
    dies: DeathTick | None = None
    """The tick from which on the robot r2 is dead, or the bounds between which it is drawn, both included."""


class ClockTable(ClockError, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A `[[clock]]` table: the error of the clock of a robot's processes, or of the world."""

    who: RobotId
    """The id of a robot, or `world`."""


LONGEST_NAME = 48
"""The maximum number of characters of the name of a scenario."""


class ScenarioFile(_Table, frozen=True):
    """The content of a scenario file."""

    name: Annotated[str, Meta(pattern=NAME, max_length=LONGEST_NAME)]
    """The name of the scenario, and the beginning of the names of its runs."""
    mission: MissionTable
    """The `[mission]` table."""
    robot: Annotated[list[RobotTable], Meta(max_length=MAX_ROBOTS)] = []
    """One `[[robot]]` for each robot; required without `[group]` and `[team]`."""
    group: GroupTable | None = None
    """The `[group]` table."""
    anchor: Annotated[list[AnchorTable], Meta(max_length=MAX_ROBOTS)] = []
    """One `[[anchor]]` for each anchor of a team."""
    team: TeamTable | None = None
    """The `[team]` table."""
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 0
    """The seed of all random draws, starts included."""
    max_ticks: Annotated[int, Meta(ge=1, le=MAX_TICKS)] | None = None
    """The last tick of an undecided run; computed from the mission by default."""
    planner: PlannerTable = PlannerTable()
    """The `[planner]` table."""
    world: WorldTable = WorldTable()
    """The `[world]` table."""
    fault: list[FaultTable] = []
    """Faults of the radio, applied to each report one after the other."""
    kill: list[KillTable] = []
    """Kills of processes. They are not part of the Scenario and do not appear in the recording."""
    clock: list[ClockTable] = []
    """Errors of clocks, in real time and in hardware mode. They are not part of the Scenario, either."""
