"""How a run ended, judged by the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec

from protocol.messages import Inconsistent, Localised, Outcome, Undecided, Verdict
from protocol.mission import HEADING_ACCURACY, Mission
from protocol.motion import Pose, wrap
from protocol.rounding import TOLERANCE
from world.scenario import Scenario
from world.truth import Truth

SIGMAS = 5.0
"""of those that it claims: farther off than this it is wrong where they are not"""


class Judgement(msgspec.Struct, frozen=True):
    """The outcome of a run, and why it is no better."""

    outcome: Outcome
    reason: str | None = None


def errors(claim: Pose, truth: Pose) -> tuple[float, float]:
    """How far off `claim` is: m, and rad."""
    return math.hypot(claim.x - truth.x, claim.y - truth.y), abs(wrap(claim.heading - truth.heading))


def tolerances(claim: Localised, mission: Mission) -> tuple[float, float]:
    """How far off `claim` may be: m, and rad. No sigma counts for more than the mission asks for."""
    if claim.covariance is None or mission.noise.exact:
        return TOLERANCE, TOLERANCE
    return (
        max(TOLERANCE, SIGMAS * min(claim.covariance.position_sigma, mission.accuracy)),
        max(TOLERANCE, SIGMAS * min(claim.covariance.heading_sigma, HEADING_ACCURACY)),
    )


def inaccuracy(claim: Localised, mission: Mission) -> str | None:
    """What `claim` knows less well than the mission asks for, in words; None if there is nothing."""
    covariance = claim.covariance
    if covariance is None:
        return None
    position, heading = covariance.position_sigma, covariance.heading_sigma
    if position > mission.accuracy:
        return f"claims a position known to {position:.3g} m, of {mission.accuracy:g}"
    if heading > HEADING_ACCURACY:
        return f"claims a heading known to {heading:.3g} rad, of {HEADING_ACCURACY:g}"
    return None


def mistake(claim: Localised, truth: Pose, mission: Mission) -> str | None:
    """How far off `claim` is, in words, if that makes it wrong."""
    position, heading = errors(claim.pose, truth)
    far, askew = tolerances(claim, mission)
    if position <= far and heading <= askew:
        return None
    off, covariance = f"{position:.3g} m and {heading:.3g} rad off", claim.covariance
    if covariance is None:
        return off
    return f"{off}, of sigmas {covariance.position_sigma:.3g} m and {covariance.heading_sigma:.3g} rad"


def judge(
    scenario: Scenario,
    truth: Truth,
    verdicts: Mapping[str, Verdict],
    claimed: Mapping[str, Pose] | None = None,
) -> Judgement | None:
    """The judgement once nothing more can come, or time is up; None while the mission goes on.

    A claim is held against where the robot was when it claimed, as `claimed` says; else against where it
    is. A robot whose peer has given up cannot localise any more. A robot that claims a pose and knows it less
    well than the mission asks for is not localised.
    """
    open_cases = [
        robot.id
        for robot in scenario.robots
        if robot.id not in verdicts and not isinstance(verdicts.get(robot.peer), Undecided | Inconsistent)
    ]
    if open_cases and truth.tick < scenario.max_ticks:
        return None
    for robot, pose in zip(scenario.robots, truth.poses, strict=True):
        verdict = verdicts.get(robot.id)
        if isinstance(verdict, Localised):
            why = mistake(verdict, pose if claimed is None else claimed[robot.id], scenario.mission)
            if why is not None:
                return Judgement("wrong", f"{robot.id} claims a pose that is {why}")
    return _no_better(scenario, verdicts, open_cases)


def _no_better(scenario: Scenario, verdicts: Mapping[str, Verdict], open_cases: Sequence[str]) -> Judgement:
    """The judgement where no claim is wrong."""
    for robot in scenario.robots:
        verdict = verdicts.get(robot.id)
        if isinstance(verdict, Inconsistent):
            return Judgement("inconsistent", f"{robot.id}: {robot.peer} tells {verdict.claim}")
    for robot in scenario.robots:
        match verdicts.get(robot.id):
            case Undecided(reason):
                return Judgement("undecided", f"{robot.id}: {reason}")
            case Localised() as claim if (vague := inaccuracy(claim, scenario.mission)) is not None:
                return Judgement("undecided", f"{robot.id} {vague}")
    if open_cases:
        return Judgement("undecided", f"max_ticks: {', '.join(open_cases)} not localised by then")
    return Judgement("localised")
