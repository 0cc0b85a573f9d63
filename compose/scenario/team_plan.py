"""The team of a scenario file: its anchors, the starts of its robots, and whether they can be localised."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence

from msgspec.structs import replace

from compose.errors import BadScenario, Unworkable
from compose.launch import planner_loader
from compose.scenario.group_meetings import check_gyros
from compose.scenario.scenario_tables import MAX_TEAM, AnchorTable, Area, RobotTable, ScenarioFile, TeamTable
from protocol.messages import TeamAnchor
from protocol.mission import Anchor, Mission
from protocol.motion import ORIGIN, TAU, Pose, relative, wrap
from protocol.spelling import did_you_mean
from protocol.team_motion import nearest_other, search_ticks, team_ticks
from world.random_streams import gaussian
from world.scenario import PlacedAnchor, PlannedTeam, RobotSpec

MOST_DRAWS = 10_000
"""The number of starts that are drawn for one robot until one is admitted."""


def is_team(file: ScenarioFile) -> bool:
    """Return whether the robots share all measurements, and form neither pairs nor a group."""
    return bool(file.anchor) or file.team is not None or file.mission.frame is not None


def with_team(file: ScenarioFile, team: TeamTable) -> ScenarioFile:
    """Return `file` with the anchors and robots of its `team`, whose places are drawn from its seed."""
    if team.unknown > team.anchors:
        raise BadScenario(f"team.unknown: more than team.anchors = {team.anchors}")
    anchors = []
    for i in range(1, team.anchors + 1):
        draw = random.Random(f"{file.seed}/anchor/A{i}").random
        place = team.side * draw(), team.side * draw()
        known = place if i <= team.anchors - team.unknown else None
        anchors.append(AnchorTable(f"A{i}", known, stands=place))
    area = file.mission.area or (0.0, 0.0, team.side, team.side)
    robots = [RobotTable(f"r{i}", attack=team.attack if i == 1 else None) for i in range(1, team.robots + 1)]
    return replace(file, robot=robots, anchor=anchors, mission=replace(file.mission, area=area))


def planned_team(file: ScenarioFile) -> tuple[PlannedTeam, tuple[RobotSpec, ...]]:
    """Return the team and the robots of `file`. Raises BadScenario, and Unworkable if it is not admitted."""
    _check(file)
    mission, ids = file.mission, [one.id for one in file.anchor]
    for name in ids:
        if ids.count(name) > 1:
            raise BadScenario(f"anchor.id: {ids.count(name)} anchors have the id '{name}'")
    anchors = tuple([_placed_anchor(i, file) for i in range(len(file.anchor))])
    robots = []
    for i, robot in enumerate(file.robot):
        if robot.id in ids:
            raise BadScenario(f"robot[{i}].id: an anchor has the id '{robot.id}', too")
        for name in robot.anchors or ():
            if name not in ids:
                raise BadScenario(f"robot[{i}].anchors: there is no anchor '{name}'{did_you_mean(name, ids)}")
        ranges = tuple([name for name in ids if robot.anchors is None or name in robot.anchors])
        robots.append(RobotSpec(robot.id, None, None, ORIGIN, robot.attack, ranges))
    known = [one.told for one in anchors]
    if mission.frame is None:
        for i, one in enumerate(robots):
            robots[i] = _in_range(i, file, one, anchors, [other.start for other in robots[:i]])
        away = [nearest_other(one, known) for one in known]
        farthest = max([one for one in away if one is not None], default=0.0)
    else:
        robots, farthest = _connected(file, robots), 0.0
    ticks = team_ticks(mission, len(robots), farthest) * (1 if mission.frame is None else len(robots))
    if mission.diameter:
        search = search_ticks(mission, len(robots), mission.diameter)
        check_gyros(mission, search * mission.period, "of the search by the first robot")
        ticks += search
    origin = robots[0].id if mission.frame is not None else None
    told = anchors, origin, ticks * mission.period, mission.survey, mission.diameter
    return PlannedTeam(*told), tuple(robots)


def _check(file: ScenarioFile) -> None:
    """Raise BadScenario or Unworkable if `file` has what is not for teams."""
    if file.group is not None:
        raise BadScenario("group: its robots have an anchor each, so there can be no [[anchor]] and no frame")
    if len(file.robot) > MAX_TEAM:
        raise BadScenario(f"robot: {len(file.robot)} robots, and a team has at most {MAX_TEAM}")
    for i, robot in enumerate(file.robot):
        for name in ("anchor", "peer"):
            if getattr(robot, name) is not None:
                raise BadScenario(f"robot[{i}].{name}: it is not for robots that share [[anchor]] or a frame")
    _check_mission(file)
    _check_attacks(file)


def _check_mission(file: ScenarioFile) -> None:
    """Raise BadScenario or Unworkable if the mission or its planner is not one of teams."""
    if not planner_loader.is_for_teams(file.planner.name):
        raise Unworkable(
            f"planner.name: robots with the planner {file.planner.name} form pairs and groups; those that "
            f"share [[anchor]] or a frame have '{planner_loader.GROUP_PLANNER}' or one of your own for teams"
        )
    if file.mission.survey and all(one.position and not one.sigma for one in file.anchor):
        raise BadScenario("mission.survey: all [[anchor]] are surveyed")
    if file.mission.frame is None and file.mission.diameter:
        raise BadScenario("mission.diameter: it is for robots with mission.frame")
    if file.mission.frame is not None:
        if file.anchor:
            raise BadScenario("mission.frame: anchors determine the frame, so there can be no [[anchor]]")
        if len(file.robot) < 2:
            raise Unworkable("mission.frame: the poses of at least two robots are relative to each other")


def _check_attacks(file: ScenarioFile) -> None:
    """Raise BadScenario or Unworkable if attacks are none that a team has, or more than it tolerates.

    What a robot of a tolerant team claims follows from its own measurements, or is the same by one more of
    the others than may report false data. So it needs a frame of its own, and anchors that nobody surveys.
    """
    mission, attacks = file.mission, [i for i, one in enumerate(file.robot) if one.attack is not None]
    for i in attacks:
        attack = file.robot[i].attack
        if attack is not None and (attack.kind in ("heading", "reframe") or attack.part != "all"):
            raise BadScenario(
                f"robot[{i}].attack: robots of a team report no start and have no phases: the kind is "
                "scale, rotate, shift or radius, and the part 'all'"
            )
    believing = [name for name in ("frame", "survey") if getattr(mission, name)]
    if len(attacks) > mission.tolerates:
        remedy = f"set mission.tolerates = {len(attacks)}"
        if believing:
            remedy = f"with mission.{believing[0]}, none may report false data"
        raise Unworkable(
            f"robot[{attacks[mission.tolerates]}].attack: robots of a team believe the measurements of all "
            f"others: {remedy}"
        )
    if mission.tolerates and believing:
        raise Unworkable(f"mission.tolerates: with mission.{believing[0]}, robots have to believe others")


def _placed_anchor(i: int, file: ScenarioFile) -> PlacedAnchor:
    """Return anchor `i` of the file. Raises BadScenario."""
    anchor, seed = file.anchor[i], file.seed
    known = Anchor(*anchor.position) if anchor.position is not None else None
    told = TeamAnchor(anchor.id, known, anchor.sigma)
    if known is None and anchor.sigma:
        raise BadScenario(f"anchor[{i}].sigma: it is that of a position, and '{anchor.id}' has none")
    if anchor.stands is not None:
        return PlacedAnchor(told, Anchor(*anchor.stands))
    if known is None:
        area = _area(file)
        draw = random.Random(f"{seed}/anchor/{anchor.id}").random
        return PlacedAnchor(told, Anchor(*_within(area, draw(), draw())))
    dx, dy = [
        anchor.sigma * gaussian(seed, f"survey-{axis}", anchor.id, 0) if anchor.sigma else 0.0
        for axis in "xy"
    ]
    return PlacedAnchor(told, Anchor(known.x + dx, known.y + dy))


def _area(file: ScenarioFile) -> Area:
    """Return the area in which places are drawn: by default the one that the anchors span."""
    if file.mission.area is not None:
        return file.mission.area
    places = [one.stands or one.position for one in file.anchor]
    known = [one for one in places if one is not None]
    if not known:
        raise BadScenario("mission.area: the area in which starts are drawn is missing")
    x, y = zip(*known, strict=True)
    return min(x), min(y), max(x), max(y)


def _within(area: Area, right: float, up: float) -> tuple[float, float]:
    x_min, y_min, x_max, y_max = area
    return x_min + (x_max - x_min) * right, y_min + (y_max - y_min) * up


def _in_range(
    i: int, file: ScenarioFile, robot: RobotSpec, anchors: Sequence[PlacedAnchor], others: Sequence[Pose]
) -> RobotSpec:
    """Return the robot at its start, in range of an anchor from which it can reach another one."""
    mission, given = file.mission, file.robot[i].start
    known = [one.told for one in anchors if one.told.id in robot.ranges]
    first = {one.id for one in known if nearest_other(one, known) is not None}
    if not first:
        raise Unworkable(
            f"robot[{i}]: '{robot.id}' may range fewer than two anchors at different known positions; "
            "with one, its heading is not determined"
        )
    places = [one.place for one in anchors if one.told.id in first]
    if given is not None:
        start = given_start(given)
        if not _reached(start, places, mission.sensing_range):
            raise BadScenario(
                f"robot[{i}].start: no anchor that '{robot.id}' knows and may range is within "
                f"mission.sensing_range = {mission.sensing_range:.9g} m"
            )
        if near := _too_near(start, others, mission):
            raise BadScenario(f"robot[{i}].start: {near}")
        return replace(robot, start=start)
    return replace(robot, start=_drawn_start(i, file, places, others, f"an anchor of '{robot.id}'"))


def _drawn_start(
    i: int, file: ScenarioFile, beacons: Sequence[Anchor | Pose], others: Sequence[Pose], whose: str
) -> Pose:
    """Return a start in range of one of the `beacons`, which are `whose`; without any, the first one."""
    draw, area = random.Random(f"{file.seed}/start/{file.robot[i].id}").random, _area(file)
    reach = file.mission.diameter or file.mission.sensing_range
    for _ in range(MOST_DRAWS):
        start = Pose(*_within(area, draw(), draw()), TAU * draw())
        if (not beacons or _reached(start, beacons, reach)) and not _too_near(start, others, file.mission):
            return start
    raise Unworkable(f"robot[{i}].start: none of {MOST_DRAWS} places in the area is in range of {whose}")


def given_start(given: tuple[float, float, float]) -> Pose:
    """Return the start of a file. Many turns are removed: functions of large angles lose digits."""
    x, y, heading = given
    return Pose(x, y, heading if abs(heading) <= TAU else wrap(heading))


def _too_near(start: Pose, others: Sequence[Pose], mission: Mission) -> str:
    """Return why a start is too near to one of the `others`; else an empty text.

    Each robot has the way of a tick to the safety distance, with ranges that are too short.
    """
    if not mission.safety_distance:
        return ""
    from agent.planning.separation import LARGEST_ERROR_SIGMAS  # noqa: PLC0415  # it imports numpy

    errors = LARGEST_ERROR_SIGMAS * mission.noise.mutual_sigma
    least = mission.safety_distance + errors + 2.0 * mission.first_straight
    near = any(math.dist((start.x, start.y), (at.x, at.y)) < least for at in others)
    return f"nearer to another one than {least:.3g} m (safety_distance)" if near else ""


def _reached(start: Pose, places: Sequence[Anchor | Pose], reach: float) -> bool:
    return any(math.hypot(start.x - at.x, start.y - at.y) <= reach for at in places)


def _connected(file: ScenarioFile, robots: Sequence[RobotSpec]) -> list[RobotSpec]:
    """Return the robots at their starts in the frame of the first one.

    Ranges connect all of them, or they are within `mission.diameter` of the first one.
    """
    starts: list[Pose] = []
    diameter = file.mission.diameter
    reach = diameter or file.mission.sensing_range
    for i, robot in enumerate(file.robot):
        if robot.start is None:
            others = starts[:1] if diameter else starts
            starts.append(_drawn_start(i, file, others, starts, "another robot"))
            continue
        starts.append(given_start(robot.start))
        if near := _too_near(starts[-1], starts[:-1], file.mission):
            raise BadScenario(f"robot[{i}].start: {near}")
    seen, left = [0], list(range(1, len(starts)))
    for one in seen[:1] if diameter else seen:
        met = [k for k in left if _reached(starts[one], starts[k : k + 1], reach)]
        seen += met
        left = [k for k in left if k not in met]
    if left and diameter:
        raise Unworkable(
            f"robot[{left[0]}].start: it is not within mission.diameter = {diameter:.9g} m of that of "
            f"'{robots[0].id}'"
        )
    if left:
        raise Unworkable(
            f"robot[{left[0]}].start: '{robots[left[0]].id}' is in range of no robot that is connected with "
            f"'{robots[0].id}', in mission.sensing_range = {reach:.9g} m"
        )
    first = starts[0]
    moved = starts if first == ORIGIN else [relative(first, one) for one in starts]
    return [replace(one, start=start) for one, start in zip(robots, moved, strict=True)]
