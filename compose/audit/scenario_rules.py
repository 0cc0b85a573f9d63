"""Audit rules that recompute the parts of a scenario that follow from the rest of it."""

from __future__ import annotations

from msgspec.structs import replace

from compose.audit.findings import Checks, Violation, unlike
from compose.errors import BadScenario
from compose.launch import planner_loader
from compose.recording.run import Run
from compose.scenario.scenario_change import file_table
from compose.scenario.scenario_file import template_of
from protocol.messages import RobotConfig
from protocol.mission import infeasibility
from protocol.orbits import Orbit, visiting


def scenario(run: Run) -> Checks:
    """Check that `tandem run` makes this scenario of a file with its content.

    So it is one that can be run, and its meetings and orbits follow from the rest.
    """
    found = run.scenario
    if not planner_loader.is_shipped(found.planner_name):
        planner_loader.planner_class(found.planner_name)  # without the permission, this is no violation
    try:
        expected = template_of(file_table(found)).scenario
    except BadScenario as error:
        yield Violation("scenario", None, None, str(error))
        return
    rest = replace(found, robots=()), replace(expected, robots=())
    robots = zip([one.id for one in found.robots], found.robots, expected.robots, strict=True)
    for robot, one, other in (*robots, (None, *rest)):
        yield unlike("scenario", None, robot, one, other) if one != other else None


def config(run: Run) -> Checks:
    """Check that the orbits in each RobotConfig follow from the mission and the anchors in it.

    This is for hardware mode. Otherwise, `journal_rules.config` compares the RobotConfig with the scenario.
    In a group, a robot that waits is told the orbits of a pair, or of a visitor that is localised. A robot
    without an anchor has none: it waits. A team has no orbits.
    """
    for robot, agent in run.agents.items():
        yield _off_orbits(robot, agent.config) if agent.config.team is None else None


def _off_orbits(robot: str, found: RobotConfig) -> Violation | None:
    mission, given = found.mission, found.rendezvous
    if found.given_anchor is None:
        if given.a == given.b == Orbit(0.0, 0.0, 0.0):
            return None
        return Violation("config", None, robot, "rendezvous: it has an orbit and no anchor")
    if (why := infeasibility(mission, found.anchor_distance)) is not None:
        return Violation("config", None, robot, f"mission: {why}")
    if found.members and found.role == "b" and given == visiting(mission, found.anchor_distance):
        return None
    planner, options = found.planner_name, found.planner_options
    expected = planner_loader.orbits(planner, options, mission, found.anchor_distance)
    return unlike("config", None, robot, given, expected, "rendezvous.") if given != expected else None
