"""One trial: its input, its run, and its row of results."""

from __future__ import annotations

import math
from typing import Any, Literal

import msgspec
from msgspec.structs import asdict, replace

from compose.audit.findings import Findings
from compose.recording.closest_approach import nearest
from compose.recording.group_localisation import TICK_ROUNDING
from compose.recording.reasons import reason_for
from compose.recording.run import Run
from compose.recording.summary_json import first_contact
from compose.scenario.kills import Kill
from compose.sweep.group_columns import GroupColumns, group_columns
from compose.sweep.trial_mission import as_processes, run_in_process
from world.scenario import Scenario

TrialOutcome = Literal["localised", "undecided", "inconsistent", "wrong", "failed", "refused"]
"""The outcome of a mission, or `refused`: the scenario with the drawn values is infeasible."""
LARGEST = ("candidates", "candidates_left", "position_error_m", "heading_error_rad", "hypotheses")
"""The columns with the largest value of any robot."""
TOTALS = ("reports_sent", "reports_heard", "reports_refused", "reports_lost", "bytes_sent")
"""The columns with the sum of a count of the FinalReports."""
REPORTED = ("branch", "alpha", "hypotheses", "probability", "p_value")
"""The columns of a robot that its FinalReport has."""
CLAIMS_WITHIN = 3.0
"""The factor of mission.accuracy within which a position error counts in `claims_within`."""


class Trial(msgspec.Struct, frozen=True):
    """One trial to run."""

    cell: int
    number: int
    """index of the trial within its cell"""
    scenario: Scenario
    processes: bool
    """true to run the mission as processes over Zenoh, false to run it in this process"""
    audit: bool = False
    """true to audit its journals after the run"""
    kills: tuple[Kill, ...] | None = None
    """kills of its processes; None if the scenario has no kills, so that it can run in one process"""


class RobotRow(msgspec.Struct, frozen=True, array_like=True):
    """The columns of a row for one robot. A value that does not apply is None."""

    branch: str | None = None
    """branch of phase 1 that the robot took"""
    alpha: float | None = None
    """signed angle alpha of eq. (2), in rad"""
    candidates: int | None = None
    """number of solutions of eq. (7)"""
    candidates_left: int | None = None
    """number of these that are consistent with the ticks without a detection"""
    position_error_m: float | None = None
    """position error of the claim, in its tick; a claim that the robot has withdrawn does not count"""
    heading_error_rad: float | None = None
    """heading error of that claim"""
    hypotheses: int | None = None
    """number of hypotheses about the poses of the pair at the end"""
    probability: float | None = None
    """probability of the most probable hypothesis"""
    p_value: float | None = None
    """least p-value of the consistency tests of the ranges against the peer's reports"""
    position_sigma_m: float | None = None
    """square root of the trace of the claimed position covariance"""
    nees: float | None = None
    """normalised estimation error squared of the claim"""
    truth_held: bool | None = None
    """true if the true pose was among the robot's hypotheses at that claim, with noisy sensors"""
    bound_m: float | None = None
    """Cramér-Rao bound on the position (square root of the trace), for the trajectories up to the last claim
    of the pair"""
    cov_xx: float | None = None
    """claimed covariance of (x, y, heading h), in m^2, m rad and rad^2"""
    cov_xy: float | None = None
    """likewise"""
    cov_xh: float | None = None
    """likewise"""
    cov_yy: float | None = None
    """likewise"""
    cov_yh: float | None = None
    """likewise"""
    cov_hh: float | None = None
    """likewise"""


class TrialRow(msgspec.Struct, frozen=True, array_like=True):
    """The row of a trial that has run, was lost or was refused. A value that does not apply is None."""

    cell: int
    """the number of the cell"""
    trial: int
    """the number of the trial in its cell"""
    seed: int
    """seed of the scenario"""
    outcome: TrialOutcome
    """the outcome of the mission, or `refused`"""
    reason: str | None = None
    """reason for an outcome other than `localised`"""
    error: str | None = None
    """error because of which the trial has no result"""
    ticks: int | None = None
    """number of ticks until the mission ended"""
    first_contact_tick: int | None = None
    """first tick at which two peers are within sensing range of each other"""
    orbiting_tick: int | None = None
    """first tick at which both robots of a pair orbit, the last of several pairs; None if a pair
    reaches phase 3 earlier"""
    meeting_tick: int | None = None
    """tick at which phase 3 begins, the last of several pairs"""
    period_s: float | None = None
    """T_s, the duration of a tick in s"""
    t_max_s: float | None = None
    """T_max in s, the bound on the time in orbit until two robots meet; the largest of all robots; in a team,
    the bound of the time at which all robots are localised with exact sensors"""
    t_max_ticks: int | None = None
    """T_max in ticks, rounded up"""
    group: GroupColumns | None = None
    """columns of a group, in this place"""
    candidates: int | None = None
    """largest number of solutions of eq. (7) of any robot"""
    candidates_left: int | None = None
    """largest number of these that are consistent with the ticks without a detection"""
    position_error_m: float | None = None
    """largest position error of any robot's claim, without those that were withdrawn"""
    heading_error_rad: float | None = None
    """largest heading error of any robot's claim, likewise"""
    hypotheses: int | None = None
    """largest number of hypotheses of any robot at the end"""
    nearest_m: float | None = None
    """least distance in m of two peers, from their first mutual range on; None without a safety distance"""
    claims: int | None = None
    """number of robots that claimed to be localised, and have not withdrawn the claim"""
    claims_within: int | None = None
    """number of claims with a position error of at most 3 times mission.accuracy"""
    nees: float | None = None
    """mean NEES of the robots that claimed a covariance"""
    truth_held: bool | None = None
    """true if every robot that claimed with noisy sensors held the true hypothesis"""
    reports_sent: int | None = None
    """number of reports that all robots sent"""
    reports_heard: int | None = None
    """number of reports that all robots received and used"""
    reports_refused: int | None = None
    """number of reports that all robots rejected"""
    reports_lost: int | None = None
    """number of reports sent in contact and never received"""
    bytes_sent: int | None = None
    """number of bytes of all reports sent"""
    violations: int | None = None
    """number of violations that the audit found; None if the trial was not audited"""
    first_violation: str | None = None
    """description of the first violation"""
    kills: int | None = None
    """number of kills that took place; None if the scenario has no kills"""
    same_record: bool | None = None
    """true if the recording has the same bytes as that of the same mission in one process without kills"""
    wall_s: float | None = None
    """wall time in s, with the audit"""
    robots: dict[str, RobotRow] = {}
    """columns of each robot, by its id"""
    drawn: dict[str, float] = {}
    """values drawn for this trial, by the paths of their fields"""


def refused(cell: int, trial: int, seed: int, reason: str, drawn: dict[str, float]) -> TrialRow:
    """Return the row of a trial whose scenario is infeasible."""
    return TrialRow(cell, trial, seed, "refused", reason, drawn=drawn)


def lost(cell: int, trial: int, seed: int, error: str, wall_s: float | None) -> TrialRow:
    """Return the row of a trial that did not complete."""
    return TrialRow(
        cell, trial, seed, "failed", error=error, wall_s=None if wall_s is None else round(wall_s, 6)
    )


def run_trial(trial: Trial) -> TrialRow:
    """Run the trial, and return its row.

    The outcome is `failed` if kills changed the recording. The caller turns exceptions into lost trials.
    """
    if trial.processes or trial.kills is not None:
        played = as_processes(trial.scenario, audit=trial.audit, kills=trial.kills)
    else:
        played = run_in_process(trial.scenario, audit=trial.audit)
    found = row(trial, played.run, played.wall_s, played.findings)
    if played.kills is None:
        return found
    found = replace(found, kills=played.kills, same_record=not played.differing)
    if not played.differing:
        return found
    why = f"the recording differs from the run in one process: {', '.join(played.differing)}"
    return replace(found, outcome="failed", reason=why)


def row(trial: Trial, run: Run, wall_s: float, findings: Findings | None = None) -> TrialRow:
    """Return the row of a trial, from its run and its audit findings.

    A recording without a mission end gives the row of a lost trial.
    """
    scenario, end = run.scenario, run.end
    if end is None:
        return lost(trial.cell, trial.number, scenario.seed, "the recording is incomplete", wall_s)
    robots = {robot: _robot_row(run, robot) for robot in run.robots}
    for pair in scenario.pairs():
        # a robot of a group claims after its first meeting, so its bound is that of this one
        bounded = _bounded(robots, run, pair)
        robots |= {name: one for name, one in bounded.items() if robots[name].bound_m is None}
    t_max_s = scenario.t_max
    encounters = [_meeting(run, a, b, in_group=bool(scenario.meetings)) for a, b in run.pairs]
    final_reports = run.final_reports.values()
    known: dict[str, list[Any]] = {
        name: [value for robot in robots.values() if (value := getattr(robot, name)) is not None]
        for name in (*LARGEST, "nees", "truth_held")
    }
    largest: dict[str, Any] = {name: max(known[name], default=None) for name in LARGEST}
    errors, nees, held = known["position_error_m"], known["nees"], known["truth_held"]
    return TrialRow(
        cell=trial.cell,
        trial=trial.number,
        seed=scenario.seed,
        outcome=end.outcome,
        reason=reason_for(end),
        ticks=end.tick,
        first_contact_tick=first_contact(run),
        orbiting_tick=_last([orbiting for orbiting, _ in encounters]),
        meeting_tick=_last([meeting for _, meeting in encounters]),
        period_s=scenario.mission.period,
        t_max_s=t_max_s,
        t_max_ticks=math.ceil(t_max_s / scenario.mission.period - TICK_ROUNDING),
        group=group_columns(run),
        **largest,
        nearest_m=nearest(run) if scenario.mission.safety_distance else None,
        claims=len(errors),
        claims_within=sum([error <= CLAIMS_WITHIN * scenario.mission.accuracy for error in errors]),
        nees=sum(nees) / len(nees) if nees else None,
        truth_held=all(held) if held else None,
        **{name: sum([getattr(report, name) for report in final_reports]) for name in TOTALS},
        violations=len(findings.violations) if findings is not None else None,
        first_violation=findings.violations[0].line if findings is not None and findings.violations else None,
        wall_s=round(wall_s, 6),
        robots=robots,
    )


def _robot_row(run: Run, robot: str) -> RobotRow:
    """Return the columns of a robot: what it reports at the end, and its standing claim with the errors."""
    found: dict[str, Any] = {"truth_held": run.truth_held(robot)}
    if (final_report := run.final_reports.get(robot)) is not None:
        found |= {name: getattr(final_report, name) for name in REPORTED}
        if final_report.candidates is not None:
            found["candidates"], found["candidates_left"] = final_report.candidates
    if (claim := run.claim(robot)) is not None:
        found |= {"position_error_m": claim.position_error, "heading_error_rad": claim.heading_error}
        if (covariance := claim.covariance) is not None:
            found |= {"position_sigma_m": covariance.position_sigma, "nees": claim.nees}
            found |= {f"cov_{name}": one for name, one in asdict(covariance).items()}
    return RobotRow(**found)


def _bounded(robots: dict[str, RobotRow], run: Run, pair: tuple[int, int]) -> dict[str, RobotRow]:
    """Return the rows of a pair with their Cramér-Rao bounds; none unless both claimed covariances."""
    names = [run.robots[place] for place in pair]
    claims = [run.claim(name) for name in names]
    if any(robots[name].position_sigma_m is None for name in names):
        return {}
    # imports numpy, which trials with exact sensors do not need
    from compose.recording.cramer_rao import position_bounds  # noqa: PLC0415

    bounds = position_bounds(run, pair, max([one.tick for one in claims if one is not None]))
    if bounds is None:
        return {}
    return {name: replace(robots[name], bound_m=bound) for name, bound in zip(names, bounds, strict=True)}


def _meeting(run: Run, a: str, b: str, *, in_group: bool) -> tuple[int | None, int | None]:
    """Return the first tick at which both robots of a pair orbit, and the tick at which phase 3 begins.

    The first is None if phase 3 begins earlier, and each is None if it never happens. In a group, where a may
    have been in phase 3 before, the tick is that of b, and the first is None.
    """
    orbiting = None
    for tick in run.ticks:
        both = [tick.commands[robot] for robot in (a, b) if robot in tick.commands]
        if any(one.phase == 3 and (one.robot == b or not in_group) for one in both):
            return orbiting, tick.truth.tick
        if orbiting is None and not in_group and [one.task for one in both] == ["orbiting"] * 2:
            orbiting = tick.truth.tick
    return orbiting, None


def _last(ticks: list[int | None]) -> int | None:
    """Return the largest of `ticks`; None if any is None, or there are none."""
    known = [tick for tick in ticks if tick is not None]
    return max(known, default=None) if len(known) == len(ticks) else None
