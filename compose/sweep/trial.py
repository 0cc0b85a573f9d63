"""One trial, played, and the row that it leaves."""

from __future__ import annotations

import math
from typing import Literal, TypeVar

import msgspec
from msgspec.structs import replace

from compose.audit.findings import Findings
from compose.recording.claim import Claim
from compose.recording.closest_approach import nearest
from compose.recording.run import Recording
from compose.recording.summary_json import first_claim, first_contact
from compose.scenario.kills import Kill
from compose.sweep.trial_mission import as_processes, run_in_process
from protocol.messages import FinalReport
from protocol.motion import Covariance
from world.scenario import Scenario

TrialOutcome = Literal["localised", "undecided", "inconsistent", "wrong", "failed", "refused"]
"""a mission's, or `refused`: no mission can be played in the setting that the trial has drawn"""
N = TypeVar("N", int, float)
WITHIN = 3.0
"""times mission.accuracy"""
ROUNDING = 1e-6
"""ticks by which a quotient may miss a whole number"""


class Trial(msgspec.Struct, frozen=True):
    """What is to be played."""

    cell: int
    number: int
    """within the cell"""
    scenario: Scenario
    processes: bool
    """over Zenoh, instead of in this process"""
    audit: bool = False
    """whether its journals are judged, as soon as it is over"""
    kills: tuple[Kill, ...] | None = None
    """of its processes; none where it is no trial of kills, and no processes are needed for them"""


class RobotRow(msgspec.Struct, frozen=True, array_like=True):
    """What a row says of one robot; what does not apply is None."""

    branch: str | None = None
    alpha: float | None = None
    """rad"""
    candidates: int | None = None
    candidates_left: int | None = None
    position_error_m: float | None = None
    heading_error_rad: float | None = None
    hypotheses: int | None = None
    """left, about the poses of both"""
    probability: float | None = None
    """of the likeliest of them"""
    p_value: float | None = None
    """the least with which the ranges spoke against what its peer told"""
    position_sigma_m: float | None = None
    """as claimed: the root of the trace of the position's part of the covariance"""
    nees: float | None = None
    """of the claim"""
    bound_m: float | None = None
    """the Cramér-Rao bound on the position, root of the trace, of the trajectories driven until the claim"""
    cov_xx: float | None = None
    """as claimed, in m^2, m rad and rad^2; h is the heading"""
    cov_xy: float | None = None
    cov_xh: float | None = None
    cov_yy: float | None = None
    cov_yh: float | None = None
    cov_hh: float | None = None


class TrialRow(msgspec.Struct, frozen=True, array_like=True):
    """A trial that was played, or was lost; what does not apply is None."""

    cell: int
    trial: int
    seed: int
    """of the scenario"""
    outcome: TrialOutcome
    reason: str | None = None
    """why the outcome is no better"""
    error: str | None = None
    """why there is none"""
    ticks: int | None = None
    first_contact_tick: int | None = None
    """two peers in range of each other"""
    orbiting_tick: int | None = None
    """both of a pair orbit; of several pairs the last; none if they meet before"""
    meeting_tick: int | None = None
    """phase 3 begins; of several pairs the last"""
    period_s: float | None = None
    """T_s: what a tick lasts"""
    t_max_s: float | None = None
    t_max_ticks: int | None = None
    candidates: int | None = None
    """the most of any robot, before silence"""
    candidates_left: int | None = None
    """and after"""
    position_error_m: float | None = None
    """of the robot that is farthest off"""
    heading_error_rad: float | None = None
    hypotheses: int | None = None
    """left: the most of any robot"""
    nearest_m: float | None = None
    """two peers, from their first mutual range on; where there is a safety distance"""
    claims: int | None = None
    """robots that claimed to be localised"""
    claims_within: int | None = None
    """of these, how many were off by no more than 3 times mission.accuracy"""
    nees: float | None = None
    """the mean of those that claimed a covariance"""
    reports_sent: int | None = None
    """by all"""
    reports_heard: int | None = None
    reports_refused: int | None = None
    reports_lost: int | None = None
    """sent in contact, and never heard"""
    bytes_sent: int | None = None
    """of reports, by all"""
    violations: int | None = None
    """that the audit found; none if there was none"""
    first_violation: str | None = None
    kills: int | None = None
    """that were taken; none where the scenario asks for none"""
    same_record: bool | None = None
    """whether the record is, to the byte, that of the same in one process without kills"""
    wall_s: float | None = None
    robots: dict[str, RobotRow] = {}
    drawn: dict[str, float] = {}
    """fields that the trial drew, by their paths"""


def refused(cell: int, trial: int, seed: int, reason: str, drawn: dict[str, float]) -> TrialRow:
    """Return the row of a trial in whose setting no mission can be played."""
    return TrialRow(cell, trial, seed, "refused", reason, drawn=drawn)


def lost(cell: int, trial: int, seed: int, error: str, wall_s: float | None) -> TrialRow:
    """The row of a trial that was not played to an end."""
    return TrialRow(
        cell, trial, seed, "failed", error=error, wall_s=None if wall_s is None else round(wall_s, 6)
    )


def play(trial: Trial) -> TrialRow:
    """Play it. What it raises becomes a row with that error."""
    if trial.processes or trial.kills is not None:
        played = as_processes(trial.scenario, audit=trial.audit, kills=trial.kills)
    else:
        played = run_in_process(trial.scenario, audit=trial.audit)
    found = row(trial, played.recording, played.wall_s, played.belief)
    if played.kills is None:
        return found
    found = replace(found, kills=played.kills, same_record=not played.otherwise)
    if not played.otherwise:
        return found
    why = f"another record than in one process: {', '.join(played.otherwise)}"
    return replace(found, outcome="failed", reason=why)


def row(trial: Trial, recording: Recording, wall_s: float, findings: Findings | None = None) -> TrialRow:
    """What is kept of a record, and of what its audit found."""
    scenario, end = recording.scenario, recording.end
    if end is None:
        return lost(trial.cell, trial.number, scenario.seed, "the record breaks off", wall_s)
    robots = {robot.id: _robot_row(recording, i) for i, robot in enumerate(scenario.robots)}
    for pair in scenario.pairs():
        robots |= _bounded(robots, recording, pair)
    t_max_s = max(robot.rendezvous.bound for robot in scenario.robots)
    met = [_meeting(recording, scenario.robots[a].id, scenario.robots[b].id) for a, b in scenario.pairs()]
    said = recording.final_reports.values()
    errors = [robot.position_error_m for robot in robots.values() if robot.position_error_m is not None]
    nees = [robot.nees for robot in robots.values() if robot.nees is not None]
    return TrialRow(
        cell=trial.cell,
        trial=trial.number,
        seed=scenario.seed,
        outcome=end.outcome,
        reason=end.reason,
        ticks=end.tick,
        first_contact_tick=first_contact(recording),
        orbiting_tick=_last([orbiting for orbiting, _ in met]),
        meeting_tick=_last([meeting for _, meeting in met]),
        period_s=scenario.mission.period,
        t_max_s=t_max_s,
        t_max_ticks=math.ceil(t_max_s / scenario.mission.period - ROUNDING),
        candidates=_most([robot.candidates for robot in robots.values()]),
        candidates_left=_most([robot.candidates_left for robot in robots.values()]),
        position_error_m=_most([robot.position_error_m for robot in robots.values()]),
        heading_error_rad=_most([robot.heading_error_rad for robot in robots.values()]),
        hypotheses=_most([robot.hypotheses for robot in robots.values()]),
        nearest_m=nearest(recording) if scenario.mission.safety_distance else None,
        claims=len(errors),
        claims_within=sum([error <= WITHIN * scenario.mission.accuracy for error in errors]),
        nees=sum(nees) / len(nees) if nees else None,
        reports_sent=sum([final_report.reports_sent for final_report in said]),
        reports_heard=sum([final_report.reports_heard for final_report in said]),
        reports_refused=sum([final_report.reports_refused for final_report in said]),
        reports_lost=sum([final_report.reports_lost for final_report in said]),
        bytes_sent=sum([final_report.bytes_sent for final_report in said]),
        violations=len(findings.violations) if findings is not None else None,
        first_violation=findings.violations[0].line if findings is not None and findings.violations else None,
        wall_s=round(wall_s, 6),
        robots=robots,
    )


def _robot_row(recording: Recording, place: int) -> RobotRow:
    robot = recording.scenario.robots[place].id
    return _claimed(_said(recording.final_reports.get(robot)), first_claim(recording, place))


def _said(final_report: FinalReport | None) -> RobotRow:
    """What the robot says of itself in the end."""
    if final_report is None:
        return RobotRow()
    before, left = final_report.candidates if final_report.candidates is not None else (None, None)
    return RobotRow(
        branch=final_report.branch,
        alpha=final_report.alpha,
        candidates=before,
        candidates_left=left,
        hypotheses=final_report.hypotheses,
        probability=final_report.probability,
        p_value=final_report.p_value,
    )


def _claimed(row: RobotRow, claim: Claim | None) -> RobotRow:
    """`row`, with what became of the robot's claim."""
    if claim is None:
        return row
    row = replace(row, position_error_m=claim.position_error, heading_error_rad=claim.heading_error)
    covariance = claim.covariance
    if covariance is None:
        return row
    return replace(
        row,
        position_sigma_m=covariance.position_sigma,
        nees=claim.nees,
        **{f"cov_{name}": getattr(covariance, name) for name in Covariance.__struct_fields__},
    )


def _bounded(robots: dict[str, RobotRow], recording: Recording, pair: tuple[int, int]) -> dict[str, RobotRow]:
    """The rows of a pair that has claimed covariances, with the bounds on them."""
    names = [recording.scenario.robots[place].id for place in pair]
    claims = [first_claim(recording, place) for place in pair]
    if any(robots[name].position_sigma_m is None for name in names):
        return {}
    from compose.recording.cramer_rao import position_bounds  # noqa: PLC0415  # where sensors are exact, it takes no numpy

    bounds = position_bounds(recording, pair, max([one.tick for one in claims if one is not None]))
    if bounds is None:
        return {}
    return {name: replace(robots[name], bound_m=bound) for name, bound in zip(names, bounds, strict=True)}


def _meeting(recording: Recording, a: str, b: str) -> tuple[int | None, int | None]:
    """The tick from which both of a pair orbit, and that at which their phase 3 begins."""
    orbiting = None
    for moment in recording.moments:
        commands = [
            command for command in (moment.commands.get(a), moment.commands.get(b)) if command is not None
        ]
        if any(command.phase == 3 for command in commands):
            return orbiting, moment.truth.tick
        if (
            orbiting is None
            and len(commands) == 2
            and all(command.state == "orbiting" for command in commands)
        ):
            orbiting = moment.truth.tick
    return orbiting, None


def _last(ticks: list[int | None]) -> int | None:
    """The last of several, once all are there."""
    known = [tick for tick in ticks if tick is not None]
    return max(known) if len(known) == len(ticks) else None


def _most(values: list[N | None]) -> N | None:
    return max([value for value in values if value is not None], default=None)
