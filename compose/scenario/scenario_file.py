"""A TOML file -> a validated scenario, or one line that names the file and the field."""

from __future__ import annotations

import hashlib
import math
import platform
import random
import secrets
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, get_args

import msgspec
from msgspec import Meta

from compose.errors import BadFault, BadKill, BadScenario, Unworkable, UserError
from compose.scenario.fault_syntax import FaultTable, added, table_of
from compose.scenario.kills import DRAWN, POINTS, Kill, KillTable, drawn
from compose.scenario.toml_file import field_first, read_text, table_in
from protocol.attack import OF_THE_START, Attack, Kind, Part
from protocol.messages import RobotConfig
from protocol.mission import (
    Anchor,
    Mission,
    PlannerName,
    Role,
    infeasibility,
    noise_infeasibility,
    safety_infeasibility,
)
from protocol.motion import TAU, Pose, wrap
from protocol.orbits import Rendezvous, rendezvous, tick_budget
from protocol.rounding import TOLERANCE
from protocol.spelling import did_you_mean
from protocol.units import NAME, RobotId
from protocol.wire import MalformedFrame, decode, encode
from world.faults import Fault, delivery_time_bound
from world.scenario import RobotSpec, Scenario

MAX_TICKS = 10**9
MAX_ROBOTS = 200
"""so many that the truth about all of them fits a frame"""
Place = Annotated[float, Meta(ge=-1e6, le=1e6)]
"""m: nobody gets so far from there that `units.Coordinate` would not hold it"""
EXCHANGES = 20
"""reports for which a mission may have to wait as long as they hardly ever take"""
NEAREST_ANCHORS = TOLERANCE
"""m: two that are nearer are in one place, as exactly as poses are claimed"""
TICK_S = (5e-4, 3600.0)
"""s of wall time that a tick in real time may last"""
WITHIN = 1.0 - 1e-9
"""of R: how far out a start is drawn at the most, so that rounding does not carry it outside"""


CHOICES: dict[str, tuple[str, ...]] = {
    "name": get_args(PlannerName),
    "kind": get_args(Kind),
    "part": get_args(Part),
    "point": (*POINTS, DRAWN),
}
"""of the fields that take one of a few words"""


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table of the file: a field that it does not know is a typo."""


class PlannerTable(_Table, frozen=True):
    """[planner]"""

    name: PlannerName = "assured"


class RobotTable(_Table, frozen=True):
    """[[robot]]"""

    id: RobotId
    anchor: tuple[Place, Place]
    start: tuple[Place, Place, Annotated[float, Meta(ge=-1e6, le=1e6)]] | None = None
    """x, y in m, heading in rad; drawn from the seed inside the sensing range where it is left out"""
    peer: RobotId | None = None
    """needed only with more than two robots"""
    attack: Attack | None = None
    """what it tells its peer instead of the truth"""


class ScenarioFile(_Table, frozen=True):
    """What a scenario file may say."""

    name: Annotated[str, Meta(pattern=NAME, max_length=48)]
    mission: Mission
    robot: Annotated[list[RobotTable], Meta(min_length=2, max_length=MAX_ROBOTS)]
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 0
    max_ticks: Annotated[int, Meta(ge=1, le=MAX_TICKS)] | None = None
    planner: PlannerTable = PlannerTable()
    fault: list[FaultTable] = []
    """of the radio, one befalling a report after the other"""
    kill: list[KillTable] = []
    """of processes: the world knows nothing of it, and no record tells"""


class ScenarioTemplate(msgspec.Struct, frozen=True):
    """A scenario file found good, and the scenario that it makes; another draw from it is cheap."""

    file: ScenarioFile
    scenario: Scenario
    """with the seed of the file"""

    def seeded(self, seed: int | None) -> Scenario:
        """The same, with what the file leaves open drawn from `seed`, if there is one."""
        if seed is None:
            return self.scenario
        reach = self.file.mission.sensing_range
        return msgspec.structs.replace(
            self.scenario,
            seed=seed,
            robots=tuple(
                [
                    msgspec.structs.replace(placed, start=_start(robot, reach, seed))
                    for placed, robot in zip(self.scenario.robots, self.file.robot, strict=True)
                ]
            ),
        )

    def kills(self, seed: int) -> tuple[Kill, ...]:
        """Who is killed, and when; what the file leaves open is drawn from `seed`. Raises BadKill."""
        return drawn(self.file.kill, seed, [robot.id for robot in self.file.robot])


def shipped(package: str = "scenario") -> dict[str, Path]:
    """The scenarios that come with Tandem, by name; or the sweeps, for the package `sweep`."""
    path = Path(str(resources.files("compose") / package / "shipped"))
    return {file.stem: file for file in sorted(path.glob("*.toml"))}


SHIPPED = {"scenario": ("scenario", "run"), "sweep": ("sweep", "sweep")}
"""of each folder: what a file in it is, and the command that plays it"""


def unknown(source: str, folder: str) -> str:
    """Return why there is nothing called `source` to be read, where a file of `folder` was expected."""
    names = {one: shipped(one) for one in SHIPPED}
    for other, (kind, command) in SHIPPED.items():
        if other != folder and source in names[other]:
            return f"{source} is a {kind}: `tandem {command} {source}` plays it"
    near = did_you_mean(source, [name for found in names.values() for name in found])
    ships = ", ".join(names[folder])
    return f"{source}: neither a file nor a {SHIPPED[folder][0]} that ships ({ships}){near}"


def run_name(scenario: Scenario, out: Path | None = None) -> str:
    """A name for a run of it that no other run has; the same again for one that goes on in `out`."""
    mark = secrets.token_hex(3)
    if out is not None:
        mark = hashlib.blake2s(f"{platform.node()}:{out.resolve()}".encode(), digest_size=3).hexdigest()
    return f"{scenario.name}-{mark}"


def check_rate(scenario: Scenario, rate: float | None) -> None:
    """Raises UserError where `rate` makes a tick last no sensible time."""
    shortest, longest = TICK_S
    if rate is not None and not shortest <= scenario.mission.period / rate <= longest:
        period = scenario.mission.period
        raise UserError(
            f"--rate: {rate:g} makes a tick of {period:g} s last {period / rate:g} s, "
            f"outside {shortest:g} to {longest:g} s"
        )


def load(source: str, *, seed: int | None = None, faults: Sequence[str] = ()) -> Scenario:
    """The scenario of that name, or in the file at that path; `seed` overrides its own.

    `faults` are added to its own. Raises UserError: NotToml or BadScenario.
    """
    return setting(source, faults).seeded(seed)


def setting(source: str, faults: Sequence[str] = ()) -> ScenarioTemplate:
    """That of the scenario of that name, or in the file at that path, with `faults`.

    Raises NotToml and BadScenario.
    """
    path = shipped().get(source, Path(source))
    try:
        text = read_text(path)
    except FileNotFoundError:
        raise BadScenario(unknown(source, "scenario")) from None
    except ValueError as error:
        raise BadScenario(f"{source}: {error}") from None
    return validate(table_in(text, source), source, faults)


def parse(text: str, source: str, *, seed: int | None = None, faults: Sequence[str] = ()) -> Scenario:
    """The scenario in `text`, with `faults`.

    Raises NotToml and BadScenario, whose texts begin with `source`.
    """
    return validate(table_in(text, source), source, faults).seeded(seed)


def validate(table: Mapping[str, Any], source: str, faults: Sequence[str] = ()) -> ScenarioTemplate:
    """The setting that the table of a scenario file describes, with `faults`.

    Raises BadScenario and Unworkable.
    """
    try:
        file = msgspec.convert(table, ScenarioFile)
    except msgspec.ValidationError as error:
        raise BadScenario(f"{source}: {field_first(str(error), CHOICES)}") from None
    found = ScenarioTemplate(file, _validated(file, source, faults))
    try:
        found.kills(file.seed)
    except BadKill as error:
        raise BadScenario(f"{source}: {error}") from None
    return found


def _validated(file: ScenarioFile, source: str, told: Sequence[str]) -> Scenario:
    _check_noise(file.mission, source)
    peers = _peers(file.robot, source)
    place = {robot.id: i for i, robot in enumerate(file.robot)}
    placed: list[RobotSpec] = []
    plans: dict[str, Rendezvous] = {}
    for i, robot in enumerate(file.robot):
        peer = peers[robot.id]
        role: Role = "a" if i < place[peer] else "b"
        if role == "a":
            plans[robot.id] = plans[peer] = _plan(file, i, place[peer], source)
        start = _start(robot, file.mission.sensing_range, file.seed)
        rho0 = math.dist((start.x, start.y), robot.anchor)
        if rho0 > file.mission.sensing_range:
            raise BadScenario(
                f"{source}: robot[{i}].start: '{robot.id}' is {rho0:.9g} m from its anchor, "
                f"outside mission.sensing_range = {file.mission.sensing_range:.9g} m"
            )
        if robot.attack is not None and robot.attack.kind in OF_THE_START and robot.attack.part != "all":
            raise BadScenario(
                f"{source}: robot[{i}].attack.part: a lie of the {robot.attack.kind} is of the beginning, "
                "and so of all"
            )
        placed.append(
            RobotSpec(robot.id, peer, role, Anchor(*robot.anchor), start, plans[robot.id], robot.attack)
        )
    faults = _faults(file, told, list(peers.items()), source)
    budget = max(tick_budget(file.mission, plan) for plan in plans.values())
    held_up = EXCHANGES * delivery_time_bound(faults) if faults else 0
    if file.max_ticks is None and budget + held_up > MAX_TICKS:
        what = "mission: to meet" if budget > MAX_TICKS else "fault: what befalls the reports"
        raise Unworkable(f"{source}: {what} could take {budget + held_up} ticks, more than {MAX_TICKS}")
    scenario = Scenario(
        name=file.name,
        seed=file.seed,
        max_ticks=file.max_ticks if file.max_ticks is not None else budget + held_up,
        mission=file.mission,
        planner_name=file.planner.name,
        robots=tuple(placed),
        faults=faults,
    )
    try:
        for one in scenario.robots:
            decode(encode(scenario.config(one.id)), RobotConfig)
    except MalformedFrame as error:
        raise Unworkable(f"{source}: mission: no robot could be told of it: {error}") from None
    return scenario


def _faults(
    file: ScenarioFile, told: Sequence[str], pairs: Sequence[tuple[str, str]], source: str
) -> tuple[Fault, ...]:
    """The plan: those of the file, then those of the command line; `pairs` both ways."""
    plan: tuple[Fault, ...] = ()
    for i, table in enumerate(file.fault):
        try:
            plan = added(plan, table, pairs)
        except BadFault as error:
            raise BadScenario(f"{source}: fault[{i}].{error}") from None
    for text in told:
        try:
            plan = added(plan, msgspec.convert(table_of(text), FaultTable), pairs)
        except BadFault as error:
            raise BadScenario(f"--fault '{text}': {error}") from None
    return plan


def _check_noise(mission: Mission, source: str) -> None:
    """Raises BadScenario, and Unworkable where there is so much of it that no robot could be sure."""
    least, most = mission.noise.outlier_bias
    if least > most:
        raise BadScenario(
            f"{source}: mission.noise.outlier_bias: the least, {least:.6g} m, is more than the most, "
            f"{most:.6g} m"
        )
    why = noise_infeasibility(mission) or safety_infeasibility(mission)
    if why is not None:
        raise Unworkable(f"{source}: mission.{why}")


def _plan(file: ScenarioFile, first: int, second: int, source: str) -> Rendezvous:
    """How the two are to meet."""
    distance = math.dist(file.robot[first].anchor, file.robot[second].anchor)
    if distance < NEAREST_ANCHORS:
        raise BadScenario(
            f"{source}: robot[{second}].anchor: less than {NEAREST_ANCHORS:g} m from that of its peer "
            f"'{file.robot[first].id}'"
        )
    why = infeasibility(file.mission, distance)
    if why is not None:
        raise Unworkable(f"{source}: mission: {why}")
    return rendezvous(file.mission, distance, file.planner.name)


def _peers(robots: list[RobotTable], source: str) -> dict[str, str]:
    """Everyone's peer. Two robots are each other's; more of them have to say it."""
    for name, count in Counter(robot.id for robot in robots).items():
        if count > 1:
            raise BadScenario(f"{source}: robot.id: {count} robots are called '{name}'")
    ids = [robot.id for robot in robots]
    if len(robots) == 2 and all(robot.peer is None for robot in robots):
        return {ids[0]: ids[1], ids[1]: ids[0]}
    peers = {}
    for i, robot in enumerate(robots):
        if robot.peer is None:
            raise BadScenario(
                f"{source}: robot[{i}].peer: '{robot.id}' needs one: of {len(ids)} robots, two are a pair"
            )
        if robot.peer not in ids:
            near = did_you_mean(robot.peer, ids)
            raise BadScenario(f"{source}: robot[{i}].peer: there is no robot '{robot.peer}'{near}")
        peers[robot.id] = robot.peer
    for i, robot in enumerate(robots):
        if peers[robot.id] == robot.id or peers[peers[robot.id]] != robot.id:
            raise BadScenario(
                f"{source}: robot[{i}].peer: '{robot.id}' names '{robot.peer}', whose peer is "
                f"'{peers[peers[robot.id]]}'; robots come in pairs"
            )
    return peers


def _start(robot: RobotTable, sensing_range: float, seed: int) -> Pose:
    """Where the robot is released: as the file says, or uniform in its anchor's range, any heading."""
    if robot.start is not None:
        x, y, heading = robot.start
        return Pose(x, y, heading if abs(heading) <= TAU else wrap(heading))  # many turns would cost digits
    draw = random.Random(f"{seed}/start/{robot.id}").random
    radius = WITHIN * sensing_range * math.sqrt(draw())
    bearing, heading = TAU * draw(), TAU * draw()
    return Pose(
        robot.anchor[0] + radius * math.cos(bearing), robot.anchor[1] + radius * math.sin(bearing), heading
    )
