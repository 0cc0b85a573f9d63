"""Audit rules that recompute the parts of a scenario that follow from the rest of it."""

from __future__ import annotations

import math

from compose.audit.findings import Checks, Violation, difference
from compose.launch import planner_loader
from compose.recording.run import Run
from compose.scenario.scenario_file import NEAREST_ANCHORS
from protocol.attack import OF_THE_START
from protocol.messages import RobotConfig
from protocol.mission import (
    Anchor,
    Mission,
    infeasibility,
    noise_infeasibility,
    safety_infeasibility,
)
from protocol.orbits import Rendezvous
from world.scenario import RobotSpec, Scenario
from world.world_noise import world_noise_infeasibility, world_noise_mistake


def scenario(run: Run) -> Checks:
    """Check that `tandem run` accepts the scenario, and that its orbits follow from the rest of it."""
    found = run.scenario
    for why in (noise_infeasibility(found.mission), safety_infeasibility(found.mission)):
        yield _violation(None, why and f"mission.{why}")
    yield _violation(None, _off_world_noise(found))
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


def config(run: Run) -> Checks:
    """Check that the orbits in each RobotConfig follow from the mission and the anchors in it.

    This is for hardware mode. Otherwise, `journal_rules.config` compares the RobotConfig with the scenario.
    """
    for robot, agent in run.agents.items():
        found = agent.config
        why = _off_plan(found.rendezvous, found, found.anchor, found.peer_anchor)
        yield Violation("config", None, robot, why) if why is not None else None


def _off_world_noise(found: Scenario) -> str | None:
    told = found.mission.noise
    pairs = [(found.robots[i].id, found.robots[j].id) for i, j in found.pairs()]
    mistake = world_noise_mistake(found.world_noise, told, pairs)
    if mistake is not None:
        return f"world.noise.{mistake[0]}: {mistake[1]}"
    why = world_noise_infeasibility(found.world_noise, told)
    return why and f"world.noise: {why}"


def _off_role(robot: RobotSpec, *, first: bool) -> str | None:
    expected = "a" if first else "b"
    return None if robot.role == expected else f"role is {robot.role}, expected {expected}"


def _off_range(robot: RobotSpec, mission: Mission) -> str | None:
    rho0 = math.dist((robot.start.x, robot.start.y), (robot.anchor.x, robot.anchor.y))
    reach = mission.sensing_range
    return f"it starts {rho0:.12g} m from its anchor, outside R = {reach:.12g} m" if rho0 > reach else None


def _off_attack(robot: RobotSpec) -> str | None:
    early = robot.attack is not None and robot.attack.kind in OF_THE_START and robot.attack.part != "all"
    return "its attack changes the start, and its part is not all" if early else None


def _off_plan(found: Rendezvous, given: Scenario | RobotConfig, anchor: Anchor, peer: Anchor) -> str | None:
    """Return why `found` are not the orbits of the planner for these anchors; None if they are."""
    mission = given.mission
    distance = math.dist((anchor.x, anchor.y), (peer.x, peer.y))
    if distance < NEAREST_ANCHORS:
        return f"its anchor is {distance:.3g} m from its peer's, expected at least {NEAREST_ANCHORS:g} m"
    if (why := infeasibility(mission, distance)) is not None:
        return f"mission: {why}"
    expected = planner_loader.orbits(given.planner_name, given.planner_options, mission, distance)
    return None if found == expected else f"rendezvous.{difference(found, expected)}"


def _violation(robot: str | None, what: str | None) -> Violation | None:
    return Violation("scenario", None, robot, what) if what is not None else None
