"""The columns of a trial whose robots form a group or a team: its bounds, and how honest robots ended."""

from __future__ import annotations

import math

import msgspec

from compose.recording.claim_errors import Claim
from compose.recording.corrected_bounds import corrected_bounds
from compose.recording.group_localisation import TICK_ROUNDING, meeting_results, search_results
from compose.recording.run import Run
from compose.scenario.group_plan import least_makespan
from compose.scenario.wake_up_tree import MeetingTimes
from protocol.messages import Inconsistent, Localised
from world.referee import mistake
from world.scenario import Scenario


class GroupColumns(msgspec.Struct, frozen=True, array_like=True):
    """The columns of a row that only trials of groups and teams have."""

    bound_ticks: int
    """the computed bound in ticks until all its robots are localised; of a team, with exact sensors"""
    corrected_ticks: int | None
    """the last of the bounds that correct it, if a robot was late"""
    travel_ticks: float | None
    """a lower bound of these ticks, in which robots only travel after the first meetings, which end when they
    did"""
    honest_tick: int | None
    """tick of the last claim of an honest robot: one without an attack that does not die; None if one has no
    claim at the end"""
    honest_localised: int
    """number of honest robots whose claims are right"""
    honest_undecided: int
    """number of honest robots that have no claim at the end"""
    honest_wrong: int
    """number of honest robots whose claims are wrong"""
    attacker_met: int | None
    """number of meetings of honest robots with one that has an attack, or whose ranges have; None if the
    trial was not audited"""
    attacker_found: int | None
    """number of these in which the robot reported that the other's data are inconsistent"""


def group_columns(run: Run) -> GroupColumns | None:
    """Return the columns of the group or team in `run`; None for pairs."""
    scenario = run.scenario
    if scenario.in_pairs:
        return None
    dead = {death.robot for death in scenario.deaths}
    honest = [robot.id for robot in scenario.robots if robot.attack is None and robot.id not in dead]
    claims = {robot: claim for robot in honest if (claim := run.claim(robot)) is not None}
    right = sum([_is_right(run, robot, claim) for robot, claim in claims.items()])
    corrected = corrected_bounds(run)
    bounds = [one.bound_ticks for one in meeting_results(run)]
    bounds += [one.bound_ticks for one in search_results(run)]
    team = math.ceil(scenario.t_max / scenario.mission.period - TICK_ROUNDING)
    met, found = _met_and_found(run, honest) if run.agents and scenario.meetings else (None, None)
    return GroupColumns(
        bound_ticks=max(bounds, default=team),
        corrected_ticks=corrected[-1].bound_ticks if corrected else None,
        travel_ticks=_travel_ticks(run),
        honest_tick=max([claim.tick for claim in claims.values()]) if len(claims) == len(honest) else None,
        honest_localised=right,
        honest_undecided=len(honest) - len(claims),
        honest_wrong=len(claims) - right,
        attacker_met=met,
        attacker_found=found,
    )


def _is_right(run: Run, robot: str, claim: Claim) -> bool:
    """Return whether `claim` of `robot` is right, by the tolerances of the referee."""
    truth = run.truth(robot)[claim.tick]
    return mistake(robot, Localised(claim.pose, claim.covariance), truth, run.scenario.mission) is None


def _met_and_found(run: Run, honest: list[str]) -> tuple[int, int]:
    """Return how many meetings `honest` robots had with attackers, and in how many they rejected these.

    A robot is in a meeting with another one to which it reports its log, and rejects it by a report with the
    verdict that its data are inconsistent.
    """
    attackers = {robot.id for robot in run.scenario.robots if robot.attack is not None}
    link = run.scenario.attacked
    met: set[tuple[str, str]] = set()
    found: set[tuple[str, str]] = set()
    for robot in honest:
        for step in run.agents[robot].steps if robot in run.agents else ():
            for contact, framed in zip(step.observation.contacts, step.reports, strict=False):
                report = framed.report
                if contact.peer not in attackers and not {contact.peer} <= link <= {robot, contact.peer}:
                    continue
                if report.has_log:
                    met.add((robot, contact.peer))
                if isinstance(report.verdict, Inconsistent):
                    found.add((robot, contact.peer))
    return len(met), len(found)


def _travel_ticks(run: Run) -> float | None:
    """Return a lower bound of the ticks until all are localised, from the first meetings as they went.

    They are those of the plan, and end when they did; then robots travel from anchor to anchor, and meetings
    take no time. None if a first meeting has not localised both of its robots, if a robot dies, if one has no
    anchor, or if claims need several meetings; and in a team.
    """
    scenario = run.scenario
    if (
        not scenario.meetings
        or scenario.deaths
        or scenario.planned_sweep is not None
        or scenario.confirmation is not None
    ):
        return None
    place = {robot.id: i for i, robot in enumerate(scenario.robots)}
    hop = tuple(tuple(_way(scenario, i, j) for j in place.values()) for i in place.values())
    seed = [[math.inf] * len(place) for _ in place]
    seen: set[str] = set()
    for one in meeting_results(run):
        if one.visitor not in seen:
            if one.localised_tick is None:
                return None
            seed[place[one.visitor]][place[one.visited]] = one.localised_tick
        seen |= {one.visitor, one.visited}
    return least_makespan(MeetingTimes(tuple(map(tuple, seed)), hop))


def _way(scenario: Scenario, i: int, j: int) -> float:
    """Return the ticks that the straight between two anchors takes."""
    one, other = scenario.robots[i].anchor, scenario.robots[j].anchor
    mission = scenario.mission
    return math.hypot(one.x - other.x, one.y - other.y) / (mission.max_speed * mission.period)
