"""How a run ended, judged by the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping

import msgspec

from protocol.messages import Alarm, Localised, Outcome, Undecided, Verdict
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


def tolerances(claim: Localised) -> tuple[float, float]:
    """How far off `claim` may be: m, and rad."""
    if claim.covariance is None:
        return TOLERANCE, TOLERANCE
    return (
        max(TOLERANCE, SIGMAS * claim.covariance.position_sigma),
        max(TOLERANCE, SIGMAS * claim.covariance.heading_sigma),
    )


def mistake(claim: Localised, truth: Pose) -> str | None:
    """How far off `claim` is, in words, if that makes it wrong."""
    position, heading = errors(claim.pose, truth)
    far, askew = tolerances(claim)
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
    is. A robot whose peer has given up cannot localise any more.
    """
    open_cases = [
        robot.id
        for robot in scenario.robots
        if robot.id not in verdicts and not isinstance(verdicts.get(robot.peer), Undecided | Alarm)
    ]
    if open_cases and truth.tick < scenario.max_ticks:
        return None
    for robot, pose in zip(scenario.robots, truth.poses, strict=True):
        verdict = verdicts.get(robot.id)
        if isinstance(verdict, Localised):
            why = mistake(verdict, pose if claimed is None else claimed[robot.id])
            if why is not None:
                return Judgement("wrong", f"{robot.id} claims a pose that is {why}")
    for robot in scenario.robots:
        verdict = verdicts.get(robot.id)
        if isinstance(verdict, Alarm):
            return Judgement("alarm", f"{robot.id}: {robot.peer} tells {verdict.claim}")
    for robot in scenario.robots:
        verdict = verdicts.get(robot.id)
        if isinstance(verdict, Undecided):
            return Judgement("undecided", f"{robot.id}: {verdict.reason}")
    if open_cases:
        return Judgement("undecided", f"max_ticks: {', '.join(open_cases)} not localised by then")
    return Judgement("localised")
