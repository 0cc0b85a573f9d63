"""The measurements of a team as those of a joint fit."""

from __future__ import annotations

import math

import msgspec

from agent.estimation import facts
from agent.estimation.facts import Fact, Facts, Manoeuvre
from agent.estimation.gaussian.joint_ranges import JointMeasurements, joint_measurements
from agent.peer.team_log import TeamLog
from protocol.messages import Team
from protocol.mission import Mission


def team_measurements(log: TeamLog, team: Team, mission: Mission) -> JointMeasurements:
    """Return the measurements in `log`: those of all robots of which there are some.

    Exact sensors have no sigmas that could be larger than told.
    """
    known: list[Fact] = []
    for anchor in team.anchors:
        place, sigma = anchor.position, anchor.sigma
        known.append(
            facts.anchor(anchor.id, place.x, place.y, sigma)
            if place is not None
            else facts.anchor(anchor.id, 0.0, 0.0, math.inf)
        )
    noise = mission.noise
    for robot, entries in zip(team.robots, log.logs, strict=True):
        if robot == team.origin:
            known.append(facts.start_pose(robot, 0.0, 0.0, 0.0))
        for tick, entry in enumerate(entries):
            if entry.executed is not None:
                moved = Manoeuvre(entry.executed.v, entry.executed.omega)
                known.append(facts.manoeuvre(robot, tick - 1, moved))
            known += [
                facts.anchor_range(robot, team.anchors[one.to].id, tick, one.range, noise.anchor_sigma)
                for one in entry.anchors
                if one.to < len(team.anchors)
            ]
    count = len(team.robots)
    known += [
        facts.mutual_range(team.robots[one], team.robots[other], tick, rho, noise.mutual_sigma)
        for one, other, tick, rho in log.mutual()
        if one != other and other < count
    ]
    measured = joint_measurements(Facts(frozenset(known)), noise, mission.period, mission.sensing_range)
    if measured.only_rounding:
        measured = msgspec.structs.replace(measured, noise=noise.as_told)
    return measured.thinned(mission.sensing_range)
