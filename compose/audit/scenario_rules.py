"""Audit rules for the part of a scenario that follows from the rest of it: the audit recomputes it."""

from __future__ import annotations

import math

from compose.audit.evidence import Evidence, Testified
from compose.audit.findings import Checks, Violation, difference
from compose.scenario.scenario_file import NEAREST_ANCHORS
from protocol.attack import OF_THE_START
from protocol.mission import (
    Anchor,
    Mission,
    PlannerName,
    infeasibility,
    noise_infeasibility,
    safety_infeasibility,
)
from protocol.orbits import Rendezvous, rendezvous
from world.scenario import RobotSpec


def scenario(case: Evidence) -> Checks:
    """Check that `tandem run` accepts the scenario, and that its orbits follow from the rest of it."""
    told = case.history.scenario
    for why in (noise_infeasibility(told.mission), safety_infeasibility(told.mission)):
        yield _violation(None, why and f"mission.{why}")
    place = {robot.id: place for place, robot in enumerate(told.robots)}
    for robot in told.robots:
        peer = told.robots[place[robot.peer]]
        for why in (
            _off_role(robot, first=place[robot.id] < place[robot.peer]),
            _off_range(robot, told.mission),
            _off_lie(robot),
            _off_plan(robot.rendezvous, told.mission, told.planner_name, robot.anchor, peer.anchor),
        ):
            yield _violation(robot.id, why)


def config(case: Testified) -> Checks:
    """Check that the orbits in each robot's briefing follow from the mission and the anchors in it.

    This is for hardware mode. With a world, `journals.config` compares the briefing with the scenario.
    """
    for robot, past in case.pasts.items():
        told = past.config
        why = _off_plan(told.rendezvous, told.mission, told.planner_name, told.anchor, told.peer_anchor)
        yield Violation("config", None, robot, why) if why is not None else None


def _off_role(robot: RobotSpec, *, first: bool) -> str | None:
    return None if (robot.role == "a") == first else f"role is {robot.role}: the first of a pair is a"


def _off_range(robot: RobotSpec, mission: Mission) -> str | None:
    rho0 = math.dist((robot.start.x, robot.start.y), (robot.anchor.x, robot.anchor.y))
    reach = mission.sensing_range
    return f"it starts {rho0:.12g} m from its anchor, outside R = {reach:.12g} m" if rho0 > reach else None


def _off_lie(robot: RobotSpec) -> str | None:
    early = robot.attack is not None and robot.attack.kind in OF_THE_START and robot.attack.part != "all"
    return "its lie is of the start, and not of all" if early else None


def _off_plan(
    found: Rendezvous, mission: Mission, planner_name: PlannerName, anchor: Anchor, peer: Anchor
) -> str | None:
    """Return why `found` is not the plan for these anchors; None if it is."""
    distance = math.dist((anchor.x, anchor.y), (peer.x, peer.y))
    if distance < NEAREST_ANCHORS:
        return f"its anchor is {distance:.3g} m from its peer's, expected {NEAREST_ANCHORS:g} m at the least"
    if (why := infeasibility(mission, distance)) is not None:
        return f"mission: {why}"
    expected = rendezvous(mission, distance, planner_name)
    return None if found == expected else f"rendezvous.{difference(found, expected)}"


def _violation(robot: str | None, what: str | None) -> Violation | None:
    return Violation("scenario", None, robot, what) if what is not None else None
