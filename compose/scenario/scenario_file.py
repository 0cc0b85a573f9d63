"""Scenario files: TOML is read and validated; invalid input is one line with the file and the field."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec

from compose.errors import BadFault, BadKill, BadScenario, Unworkable, no_such, within
from compose.launch import model_loader, planner_loader
from compose.launch.class_loader import trust
from compose.scenario.fault_syntax import FaultTable, added, table_of
from compose.scenario.first_meetings import in_group, linked, meetings_of
from compose.scenario.group_meetings import FirstMeeting
from compose.scenario.kills import WORLD, Kill, drawn
from compose.scenario.scenario_tables import MAX_TICKS, MissionTable, RobotTable, ScenarioFile
from compose.scenario.shipped_files import misplaced, shipped, unknown
from compose.scenario.team_plan import given_start, is_team, planned_team, with_team
from compose.scenario.toml_file import field_first, read_text, table_in
from protocol.attack import OF_THE_START
from protocol.messages import Pairing, RobotConfig
from protocol.mission import Anchor, Mission, noise_infeasibility, safety_infeasibility, too_small
from protocol.motion import TAU, Pose
from protocol.network.clock import ClockError
from protocol.noise import with_profile
from protocol.orbits import tick_budget
from protocol.wire import MalformedFrame, decode, encode
from world.faults import Fault, delivery_time_bound
from world.scenario import Death, RobotSpec, Scenario
from world.world_noise import world_noise_infeasibility, world_noise_mistake

EXCHANGES = 20
"""The number of reports for each of which `max_ticks` allows the full `delivery_time_bound`."""
TEAM_SLOWER = 4
"""The ticks of a team in `max_ticks`, in units of its bound with exact sensors: noise takes more ranges."""
STARTS_WITHIN = 1.0 - 1e-9
"""The part of R within which starts are drawn, so that rounding cannot move one outside."""


class ScenarioTemplate(msgspec.Struct, frozen=True):
    """A validated scenario file with its scenario, from which scenarios of other seeds are drawn cheaply."""

    file: ScenarioFile
    """The content of the file, with the robots that its `[group]` has with the seed of the file."""
    scenario: Scenario
    """Scenario with the seed of the file."""
    source: str
    """The name or path of the file, for errors."""
    faults: tuple[str, ...]
    """The faults of the user that are added to those of the file."""

    def seeded(self, seed: int | None) -> Scenario:
        """Return the scenario with open starts drawn from `seed`; None stands for the seed of the file.

        The anchors of a `[group]` are drawn, too, and its meetings are planned. Raises BadScenario and
        Unworkable if that is not possible, and only then.
        """
        if seed is None:
            return self.scenario
        if self.file.group is not None or is_team(self.file):
            with _naming(self.source):
                return _scenario(_with_robots(msgspec.structs.replace(self.file, seed=seed)), self.faults)
        mission = self.file.mission
        return msgspec.structs.replace(
            self.scenario,
            seed=seed,
            robots=tuple(
                [
                    msgspec.structs.replace(placed, start=_start(robot, mission, seed))
                    for placed, robot in zip(self.scenario.robots, self.file.robot, strict=True)
                ]
            ),
        )

    def reseeded(self, seed: int) -> ScenarioTemplate:
        """Return the template of the same file with another seed, which is valid. Raises like `seeded`."""
        file = _with_robots(msgspec.structs.replace(self.file, seed=seed))
        return msgspec.structs.replace(self, file=file, scenario=self.seeded(seed))

    def kills(self, seed: int, options: Sequence[Kill] = ()) -> tuple[Kill, ...]:
        """Return the kills of the file, with open fields drawn from `seed`, then those of `--kill` options.

        Raises BadKill.
        """
        ids = [robot.id for robot in self.file.robot]
        for kill in options:
            if kill.who not in (*ids, WORLD):
                raise BadKill(f"--kill: {kill.text}: {no_such(kill.who, [*ids, WORLD])}")
        return (*drawn(self.file.kill, seed, ids), *options)

    @property
    def clocks(self) -> dict[str, ClockError]:
        """The errors of the clocks of robots and of the world, by name. Raises BadScenario."""
        anyone = [*[robot.id for robot in self.file.robot], WORLD]
        errors = dict[str, ClockError]()
        for i, one in enumerate(self.file.clock):
            if one.who not in anyone:
                raise BadScenario(f"clock[{i}].who: {no_such(one.who, anyone)}")
            if one.who in errors:
                raise BadScenario(f"clock[{i}].who: '{one.who}' has another [[clock]] already")
            errors[one.who] = ClockError(one.offset, one.drift, one.jumps)
        return errors


def load(source: str, *, seed: int | None = None, faults: Sequence[str] = ()) -> Scenario:
    """Return the shipped scenario named `source`, or the one in the file at that path.

    `seed` replaces the seed of the file; `faults` are added to its faults. Raises NotToml and BadScenario.
    """
    return setting(source, faults).seeded(seed)


def setting(
    source: str,
    faults: Sequence[str] = (),
    planner: str | None = None,
    planner_options: Sequence[tuple[str, Any]] = (),
) -> ScenarioTemplate:
    """Return the template of the shipped scenario named `source`, or of the file at that path, with `faults`.

    `planner` replaces the planner, and `planner_options` are added to the options. Raises NotToml and
    BadScenario.
    """
    table = scenario_table(source)
    if planner is not None or planner_options:
        table["planner"] = with_planner(table.get("planner"), planner, dict(planner_options))
    trust_classes(table)
    return validate(table, source, faults)


CLASSES = (("planner", "name"), ("world", "range", "model"), ("world", "radio", "model"))
"""The paths of the fields of a scenario file that name classes."""


def trust_classes(table: Mapping[str, Any]) -> None:
    """Permit this process to load the classes named by `table`, a scenario file of the user."""
    for path in CLASSES:
        found: Any = table
        for step in path:
            found = found.get(step) if isinstance(found, Mapping) else None
        if isinstance(found, str):
            trust(found)


def with_planner(given: Any, name: str | None, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the `[planner]` table `given` with another planner, or with more options."""
    before: dict[str, Any] = dict(given) if isinstance(given, Mapping) and name is None else {}
    if name is not None:
        before["name"] = name
    if options:
        before["options"] = {**before.get("options", {}), **options}
    return before


def scenario_table(source: str) -> dict[str, Any]:
    """Return the content of the shipped scenario named `source`, or of the file at that path, not validated.

    Raises NotToml and BadScenario.
    """
    path = shipped().get(source, Path(source))
    try:
        text = read_text(path)
    except FileNotFoundError:
        raise BadScenario(unknown(source, "scenario")) from None
    except ValueError as error:
        raise BadScenario(f"{source}: {error}") from None
    table = table_in(text, source)
    if (why := misplaced(source, table, "scenario")) is not None:
        raise BadScenario(why)
    return table


def parse(text: str, source: str, *, seed: int | None = None, faults: Sequence[str] = ()) -> Scenario:
    """Return the scenario in `text`, with `faults` added to its own.

    Raises NotToml and BadScenario, whose texts begin with `source`.
    """
    return validate(table_in(text, source), source, faults).seeded(seed)


def validate(table: Mapping[str, Any], source: str, faults: Sequence[str] = ()) -> ScenarioTemplate:
    """Return the template of the scenario file whose content is `table`, with `faults` added to its own.

    A planner or a model is loaded only if the user has named it (`trust_classes`). Raises BadScenario and
    Unworkable, whose texts begin with `source`.
    """
    with _naming(source):
        return msgspec.structs.replace(template_of(table, faults), source=source)


@contextmanager
def _naming(source: str) -> Iterator[None]:
    """Put `source` in front of a BadScenario of this context; a BadFault is of a flag, which it names."""
    try:
        yield
    except BadScenario as error:
        raise type(error)(f"{source}: {error}") from None
    except BadFault as error:
        raise BadScenario(str(error)) from None


def template_of(table: Mapping[str, Any], faults: Sequence[str] = ()) -> ScenarioTemplate:
    """Return the template like `validate`. The texts of its errors begin with the field."""
    try:
        file = msgspec.convert(_with_profile(table), ScenarioFile)
    except msgspec.ValidationError as error:
        raise BadScenario(field_first(str(error), ScenarioFile)) from None
    if file.group is None and file.team is None and not file.robot:
        raise BadScenario("missing field 'robot'")
    if file.group is not None and file.robot:
        raise BadScenario("group: its robots are drawn, so there can be no [[robot]]")
    if file.team is not None and (file.robot or file.anchor or file.group is not None):
        raise BadScenario("team: its robots and anchors are drawn, so there can be no others")
    file = _with_robots(file)
    found = ScenarioTemplate(file, _scenario(file, faults), "", tuple(faults))
    with within("", BadScenario):
        found.kills(file.seed)
        _ = found.clocks
    return found


def _with_robots(file: ScenarioFile) -> ScenarioFile:
    """Return `file` with the robots of its `[group]` or `[team]`, whose places are drawn from its seed."""
    if file.team is not None:
        return _with_death(with_team(file, file.team), file.team.dies)
    if file.group is None:
        return file
    side = file.group.spacing * math.sqrt(file.group.robots)
    robots = []
    anchored = file.group.robots - file.group.without_anchor
    for i in range(1, file.group.robots + 1):
        draw = random.Random(f"{file.seed}/anchor/r{i}").random
        robots.append(RobotTable(f"r{i}", (side * draw(), side * draw()) if i <= anchored else None))
    robots[0] = msgspec.structs.replace(robots[0], attack=file.group.attack)
    area = file.mission.area or (0.0, 0.0, side, side)
    mission = msgspec.structs.replace(file.mission, area=area)
    return _with_death(msgspec.structs.replace(file, robot=robots, mission=mission), file.group.dies)


def _with_death(file: ScenarioFile, dies: int | list[int] | None) -> ScenarioFile:
    """Return `file` with the tick from which on its second robot is dead, drawn from the seed if open."""
    name = "group" if file.group is not None else "team"
    if dies is None:
        return file
    if len(file.robot) < 2:
        raise BadScenario(f"{name}.dies: it is that of the robot r2, and there is one robot only")
    if isinstance(dies, list):
        if dies[0] > dies[1]:
            raise BadScenario(f"{name}.dies: the lower bound {dies[0]} is above the upper bound {dies[1]}")
        dies = random.Random(f"{file.seed}/dies").randint(dies[0], dies[1])
    dead = msgspec.structs.replace(file.robot[1], dies=dies)
    return msgspec.structs.replace(file, robot=[file.robot[0], dead, *file.robot[2:]])


def _with_profile(table: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the content of a scenario file with the values of the noise profile that it names."""
    mission = table.get("mission")
    if not isinstance(mission, Mapping) or "noise" not in mission:
        return table
    return {**table, "mission": {**mission, "noise": with_profile(mission["noise"])}}


def _scenario(file: ScenarioFile, options: Sequence[str]) -> Scenario:
    """Return the scenario of `file`, with the faults of the `--fault` options added to its own."""
    mission = file.mission
    _check_noise(mission)
    with within("planner.", BadScenario):
        planner_loader.check(file.planner.name, file.planner.options)
    links = linked(file)
    faults = _faults(file, options, links)
    meetings = meetings_of(file, faults, links)
    _check_world_noise(file, links)
    _check_models(file)
    team = None
    if is_team(file):
        team, placed = planned_team(file)
        budget = TEAM_SLOWER * round(team.bound / mission.period)
    elif in_group(file):
        placed = _all_placed(file, meetings.first)
        budget = math.ceil(meetings.latest / mission.period)
    else:
        placed = _all_placed(file, meetings.first)
        budget = max(tick_budget(mission, one.rendezvous) for one in meetings.first.values())
    delay = EXCHANGES * delivery_time_bound(faults) if faults else 0
    if file.max_ticks is None and budget + delay > MAX_TICKS:
        cause = "mission: the rendezvous" if budget > MAX_TICKS else "fault: the delivery of reports"
        raise Unworkable(f"{cause} could take {budget + delay} ticks, more than {MAX_TICKS}")
    noise = file.world.noise
    scenario = Scenario(
        name=file.name,
        seed=file.seed,
        max_ticks=file.max_ticks if file.max_ticks is not None else budget + delay,
        mission=mission.plain,
        planner_name=file.planner.name,
        robots=placed,
        faults=faults,
        world_noise=None if noise.changes_nothing(mission.noise) else noise,
        planner_options=file.planner.options,
        range_model=file.world.range,
        radio_model=file.world.radio,
        meetings=meetings.meetings,
        retries=meetings.retries,
        deaths=tuple([Death(one.id, one.dies) for one in file.robot if one.dies is not None]),
        tolerates=mission.tolerates,
        planned_sweep=meetings.planned_sweep,
        confirmation=meetings.confirmation,
        least_bound=meetings.least_bound,
        team=team,
    )
    try:
        for one in scenario.robots:
            decode(encode(scenario.config(one.id)), RobotConfig)
    except (MalformedFrame, UnicodeEncodeError) as error:
        raise Unworkable(f"mission: a robot's configuration cannot be encoded: {error}") from None
    return scenario


def _all_placed(file: ScenarioFile, first: Mapping[str, FirstMeeting]) -> tuple[RobotSpec, ...]:
    """Return the robots of the file, which have these first meetings. Raises BadScenario."""
    anchors = {one.id: Anchor(*one.anchor) for one in file.robot if one.anchor is not None}
    return tuple([_placed(i, file, first[one.id], anchors) for i, one in enumerate(file.robot)])


def _placed(i: int, file: ScenarioFile, first: FirstMeeting, anchors: Mapping[str, Anchor]) -> RobotSpec:
    """Return robot `i` of the file, whose first meeting is `first`. Raises BadScenario."""
    robot, mission = file.robot[i], file.mission
    start = _start(robot, mission, file.seed)
    rho0 = math.dist((start.x, start.y), robot.anchor) if robot.anchor is not None else 0.0
    if rho0 > mission.sensing_range:
        raise BadScenario(
            f"robot[{i}].start: '{robot.id}' is {rho0:.9g} m from its anchor, "
            f"outside mission.sensing_range = {mission.sensing_range:.9g} m"
        )
    if robot.attack is not None and robot.attack.kind in OF_THE_START and robot.attack.part != "all":
        raise BadScenario(
            f"robot[{i}].attack.part: an attack of kind {robot.attack.kind} changes "
            "the start, so part must be 'all'"
        )
    if robot.dies is not None and not in_group(file):
        raise BadScenario(f"robot[{i}].dies: robots die in groups and teams only")
    encounter = Pairing(first.peer, first.role, anchors[first.peer], first.rendezvous)
    return RobotSpec(robot.id, encounter, anchors.get(robot.id), start, robot.attack)


def _faults(
    file: ScenarioFile, options: Sequence[str], pairs: Sequence[tuple[str, str]]
) -> tuple[Fault, ...]:
    """Return the fault plan: the faults of the file, then those of the `--fault` options.

    `pairs` holds each pair of robots in both orders. Raises BadScenario, and BadFault for an option.
    """
    plan: tuple[Fault, ...] = ()
    for i, table in enumerate(file.fault):
        with within(f"fault[{i}].", BadScenario):
            plan = added(plan, table, pairs)
    for text in options:
        with within(f"--fault '{text}': ", BadFault):
            plan = added(plan, msgspec.convert(table_of(text), FaultTable), pairs)
    return plan


def _check_noise(mission: Mission) -> None:
    """Raise BadScenario if the noise is invalid, Unworkable if robots cannot localise or drive safely."""
    least, most = mission.noise.outlier_bias
    if least > most:
        raise BadScenario(
            f"mission.noise.outlier_bias: the lower bound {least:.6g} m is above the upper bound {most:.6g} m"
        )
    if mission.noise.range_depth:
        raise BadScenario(
            "mission.noise.range_depth: depths, and the profile 'camera', are for recordings only"
        )
    why = too_small(mission.noise) or noise_infeasibility(mission) or safety_infeasibility(mission)
    if why is not None:
        raise Unworkable(f"mission.{why}")


def _check_world_noise(file: ScenarioFile, pairs: Sequence[tuple[str, str]]) -> None:
    """Raise BadScenario if the noise of the sensors is invalid, Unworkable if robots cannot localise.

    `pairs` holds each pair of robots in both orders.
    """
    mistake = world_noise_mistake(file.world.noise, file.mission, pairs)
    if mistake is not None:
        raise BadScenario(f"world.noise.{mistake[0]}: {mistake[1]}")
    why = world_noise_infeasibility(file.world.noise, file.mission.noise)
    if why is not None:
        raise Unworkable(f"world.noise: {why}")


def _check_models(file: ScenarioFile) -> None:
    """Load the models. Raises BadScenario if one cannot be created, Unworkable if robots cannot localise."""
    for name, spec in (("range", file.world.range), ("radio", file.world.radio)):
        if spec is not None:
            with within(f"world.{name}.", BadScenario):
                model_loader.check(name, spec)
    if file.world.range is not None and file.mission.noise.exact:
        raise Unworkable(
            "world.range: the robots are told that all sensors are exact, and cannot localise "
            "themselves with others: set mission.noise"
        )


def _start(robot: RobotTable, mission: MissionTable, seed: int) -> Pose:
    """Return the start pose in the file, or one drawn uniformly from the disc of its anchor's range.

    Without an anchor, it is drawn from the area of the mission. A drawn heading is uniform in [0, 2 pi).
    """
    if robot.start is not None:
        return given_start(robot.start)
    draw = random.Random(f"{seed}/start/{robot.id}").random
    if robot.anchor is None:
        assert mission.area is not None
        x_min, y_min, x_max, y_max = mission.area
        return Pose(x_min + (x_max - x_min) * draw(), y_min + (y_max - y_min) * draw(), TAU * draw())
    radius = STARTS_WITHIN * mission.sensing_range * math.sqrt(draw())
    bearing, heading = TAU * draw(), TAU * draw()
    return Pose(
        robot.anchor[0] + radius * math.cos(bearing), robot.anchor[1] + radius * math.sin(bearing), heading
    )
