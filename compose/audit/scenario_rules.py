"""Audit rules that recompute the parts of a scenario that follow from the rest of it."""

from __future__ import annotations

import math
from itertools import combinations

from compose.audit.findings import Checks, Violation, difference
from compose.errors import Unworkable
from compose.launch import planner_loader
from compose.recording.run import Run
from compose.scenario.first_meetings import NEAREST_ANCHORS, plan_of
from compose.scenario.group_meetings import FirstMeeting, GroupMeetings
from compose.scenario.scenario_tables import PlannerTable, RobotTable
from protocol.attack import OF_THE_START
from protocol.messages import RobotConfig
from protocol.mission import Anchor, Mission, infeasibility, noise_infeasibility, safety_infeasibility
from protocol.orbits import Orbit, Rendezvous, visiting
from world.scenario import RobotSpec, Scenario
from world.world_noise import world_noise_infeasibility, world_noise_mistake


def scenario(run: Run) -> Checks:
    """Check that `tandem run` accepts the scenario, and that its meetings and orbits follow from the rest."""
    found = run.scenario
    for why in (noise_infeasibility(found.mission), safety_infeasibility(found.mission)):
        yield _violation(None, why and f"mission.{why}")
    yield _violation(None, _off_world_noise(found))
    if found.meetings:
        yield from _group(found)
        return
    place = {robot.id: place for place, robot in enumerate(found.robots)}
    for robot in found.robots:
        peer = found.robots[place[robot.peer]]
        for why in (
            _off_role(robot, first=place[robot.id] < place[robot.peer]),
            _off_range(robot, found.mission),
            _off_attack(robot),
            _off_plan(robot.rendezvous, found, robot.anchor, peer.anchor),
        ):
            yield _violation(robot.id, why)


def _group(found: Scenario) -> Checks:
    """Check that the meetings of a group are those that are planned for its anchors."""
    anchored = [robot for robot in found.robots if robot.given_anchor is not None]
    for one, other in combinations(anchored, 2):
        yield _violation(other.id, _off_distance(found.mission, one.anchor, other.anchor, one.id))
    try:
        planned = planned_meetings(found)
    except Unworkable as error:
        yield Violation("scenario", None, None, str(error))
        return
    for name in ("meetings", "retries"):
        some, others = getattr(found, name), getattr(planned, name)
        if len(some) != len(others):
            yield _violation(None, f"{len(some)} {name} are planned, expected {len(others)}")
        for i, (given, expected) in enumerate(zip(some, others, strict=False)):
            off = None if given == expected else f"{name}[{i}].{difference(given, expected)}"
            yield _violation(None, off)
    for name in ("planned_sweep", "confirmation"):
        given, expected = getattr(found, name), getattr(planned, name)
        yield _violation(None, None if given == expected else f"{name}.{difference(given, expected)}")
    if found.least_bound != planned.least_bound:
        yield _violation(None, f"least_bound is {found.least_bound}, expected {planned.least_bound}")
    for robot in found.robots:
        first = planned.first[robot.id]
        for why in (
            _off_first(robot, first),
            _off_area(robot, found) if robot.given_anchor is None else _off_range(robot, found.mission),
            _off_attack(robot),
        ):
            yield _violation(robot.id, why)


def planned_meetings(found: Scenario) -> GroupMeetings:
    """Return the meetings of the group in a scenario. Raises Unworkable if its planner has none."""
    anchors = [(robot.id, robot.given_anchor) for robot in found.robots]
    robots = [RobotTable(robot, (at.x, at.y) if at is not None else None) for robot, at in anchors]
    planner = PlannerTable(found.planner_name, found.planner_options)
    sweep = found.planned_sweep
    return plan_of(
        robots,
        found.mission,
        planner,
        found.faults,
        area=sweep.sweep.bounds if sweep is not None else None,
        tolerates=found.tolerates,
    )


def _off_first(robot: RobotSpec, first: FirstMeeting) -> str | None:
    """Return how the first meeting of `robot` differs from the planned one; None if it does not."""
    if (robot.peer, robot.role) != (first.peer, first.role):
        return f"its peer is {robot.peer} in role {robot.role}, expected {first.peer} in role {first.role}"
    if robot.rendezvous == first.rendezvous:
        return None
    return f"rendezvous.{difference(robot.rendezvous, first.rendezvous)}"


def config(run: Run) -> Checks:
    """Check that the orbits in each RobotConfig follow from the mission and the anchors in it.

    This is for hardware mode. Otherwise, `journal_rules.config` compares the RobotConfig with the scenario.
    In a group, a robot that waits is told the orbits of a pair, or of a visitor that is localised.
    """
    for robot, agent in run.agents.items():
        found = agent.config
        why = _off_config(found)
        yield Violation("config", None, robot, why) if why is not None else None


def _off_world_noise(found: Scenario) -> str | None:
    told, noise = found.mission.noise, found.world_noise
    if noise is None:
        return None
    pairs = [(found.robots[i].id, found.robots[j].id) for i, j in found.pairs()]
    mistake = world_noise_mistake(noise, found.mission, pairs)
    if mistake is not None:
        return f"world.noise.{mistake[0]}: {mistake[1]}"
    why = world_noise_infeasibility(noise, told)
    return why and f"world.noise: {why}"


def _off_role(robot: RobotSpec, *, first: bool) -> str | None:
    expected = "a" if first else "b"
    return None if robot.role == expected else f"role is {robot.role}, expected {expected}"


def _off_range(robot: RobotSpec, mission: Mission) -> str | None:
    rho0 = math.dist((robot.start.x, robot.start.y), (robot.anchor.x, robot.anchor.y))
    reach = mission.sensing_range
    return f"it starts {rho0:.12g} m from its anchor, outside R = {reach:.12g} m" if rho0 > reach else None


def _off_area(robot: RobotSpec, found: Scenario) -> str | None:
    """Return why a robot without an anchor may not start where it does; None if it may."""
    assert found.planned_sweep is not None
    inside = found.planned_sweep.sweep.contains(robot.start.x, robot.start.y)
    return None if inside else "it has no anchor, and starts outside the area that is swept"


def _off_attack(robot: RobotSpec) -> str | None:
    early = robot.attack is not None and robot.attack.kind in OF_THE_START and robot.attack.part != "all"
    return "its attack changes the start, and its part is not all" if early else None


def _off_config(found: RobotConfig) -> str | None:
    """Return why the orbits in the configuration of a robot are not those of its first meeting.

    A robot without an anchor has none: it waits.
    """
    if found.given_anchor is None:
        waits = found.rendezvous.a == found.rendezvous.b == Orbit(0.0, 0.0, 0.0)
        return None if waits else "rendezvous: it has an orbit and no anchor"
    why = _off_plan(found.rendezvous, found, found.anchor, found.peer_anchor)
    visited = bool(found.members) and found.role == "b"
    if visited and found.rendezvous == visiting(found.mission, found.anchor_distance):
        return None
    return why


def _off_plan(found: Rendezvous, given: Scenario | RobotConfig, anchor: Anchor, peer: Anchor) -> str | None:
    """Return why `found` are not the orbits of the planner for these anchors; None if they are."""
    mission = given.mission
    if (why := _off_distance(mission, anchor, peer, "its peer")) is not None:
        return why
    distance = math.dist((anchor.x, anchor.y), (peer.x, peer.y))
    expected = planner_loader.orbits(given.planner_name, given.planner_options, mission, distance)
    return None if found == expected else f"rendezvous.{difference(found, expected)}"


def _off_distance(mission: Mission, anchor: Anchor, other: Anchor, whose: str) -> str | None:
    """Return why robots with these anchors, the other one of `whose`, cannot meet; None if they can."""
    distance = math.dist((anchor.x, anchor.y), (other.x, other.y))
    if distance < NEAREST_ANCHORS:
        return f"its anchor is {distance:.3g} m from {whose}'s, expected at least {NEAREST_ANCHORS:g} m"
    why = infeasibility(mission, distance)
    return why and f"mission: {why}"


def _violation(robot: str | None, what: str | None) -> Violation | None:
    return Violation("scenario", None, robot, what) if what is not None else None
