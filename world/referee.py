"""The outcome of a run, decided by comparing the robots' results with the true poses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec

from protocol.messages import Inconsistent, Localised, Outcome, Undecided, Verdict
from protocol.mission import HEADING_ACCURACY, Mission
from protocol.motion import Pose, wrap
from protocol.rounding import TOLERANCE
from world.scenario import Death, Scenario
from world.truth import Truth

TOLERATED_SIGMAS = 5.0
"""The number of claimed standard deviations by which a claim may differ from the truth, with noise."""

MOST_NAMED = 4
"""The most robots that are named at the end of a reason; the summary of a run has all of them."""


class MissionOutcome(msgspec.Struct, frozen=True):
    """The outcome of a run."""

    outcome: Outcome
    """The outcome."""
    reason: str | None = None
    """The reason, for a user; None if the outcome is `localised`."""


def errors(claim: Pose, truth: Pose) -> tuple[float, float]:
    """Return the error of the position in m, and of the heading in rad."""
    return math.hypot(claim.x - truth.x, claim.y - truth.y), abs(wrap(claim.heading - truth.heading))


def tolerances(claim: Localised, mission: Mission) -> tuple[float, float]:
    """Return the maximum errors of a correct claim: of the position in m, and of the heading in rad.

    They are 5 claimed standard deviations, of at most the required accuracy, and at least TOLERANCE.
    """
    if claim.covariance is None or mission.noise.exact:
        return TOLERANCE, TOLERANCE
    return (
        max(TOLERANCE, TOLERATED_SIGMAS * min(claim.covariance.position_sigma, mission.accuracy)),
        max(TOLERANCE, TOLERATED_SIGMAS * min(claim.covariance.heading_sigma, HEADING_ACCURACY)),
    )


def inaccuracy(claim: Localised, mission: Mission) -> str | None:
    """Return how `claim` misses the required accuracy, for a user; None if it does not."""
    covariance = claim.covariance
    if covariance is None:
        return None
    position, heading = covariance.position_sigma, covariance.heading_sigma
    if position > mission.accuracy:
        return f"claims a position known to {position:.3g} m, required {mission.accuracy:g}"
    if heading > HEADING_ACCURACY:
        return f"claims a heading known to {heading:.3g} rad, required {HEADING_ACCURACY:g}"
    return None


def mistake(claim: Localised, truth: Pose, mission: Mission) -> str | None:
    """Return the errors of `claim`, for a user, if it is wrong; None if it is correct."""
    position, heading = errors(claim.pose, truth)
    far, askew = tolerances(claim, mission)
    if position <= far and heading <= askew:
        return None
    off, covariance = f"{position:.3g} m and {heading:.3g} rad off", claim.covariance
    if covariance is None:
        return off
    return f"{off}, with sigmas {covariance.position_sigma:.3g} m and {covariance.heading_sigma:.3g} rad"


def decide_outcome(
    scenario: Scenario,
    truth: Truth,
    verdicts: Mapping[str, Verdict],
    claimed: Mapping[str, Pose] | None = None,
) -> MissionOutcome | None:
    """Return the outcome once all results are known or `max_ticks` is reached; None before.

    A claim is compared with the true pose at the tick of the claim, which is in `claimed`, or with the
    current one if `claimed` is None. The run does not wait for a robot whose peer is undecided or
    inconsistent, because it can no longer be localised; in a group, another robot may still come. It does not
    wait for a dead robot, which leaves it undecided. A claim below the required accuracy does not count as
    localised.
    """
    open_cases = [
        robot.id
        for robot in scenario.robots
        if robot.id not in verdicts
        and not scenario.is_dead(robot.id, truth.tick)
        and (scenario.meetings or not isinstance(verdicts.get(robot.peer), Undecided | Inconsistent))
    ]
    if open_cases and truth.tick < scenario.max_ticks:
        return None
    for robot, pose in zip(scenario.robots, truth.poses, strict=True):
        verdict = verdicts.get(robot.id)
        if isinstance(verdict, Localised):
            why = mistake(verdict, pose if claimed is None else claimed[robot.id], scenario.mission)
            if why is not None:
                return MissionOutcome("wrong", f"{robot.id} claims a pose that is {why}")
    found, named = _outcome_of_right_claims(scenario, verdicts, open_cases)
    if not scenario.meetings or found.reason is None:
        return found
    clauses = _others_not_localised(scenario, verdicts, truth.tick, named)
    return MissionOutcome(found.outcome, "; ".join((found.reason, *clauses)))


def _outcome_of_right_claims(
    scenario: Scenario, verdicts: Mapping[str, Verdict], open_cases: Sequence[str]
) -> tuple[MissionOutcome, Sequence[str]]:
    """Return the outcome of a run without a wrong claim, and the robots that its reason names."""
    for robot in scenario.robots:
        verdict = verdicts.get(robot.id)
        if isinstance(verdict, Inconsistent):
            what = f"{robot.id}: {robot.peer} reports {verdict.claim}"
            return MissionOutcome("inconsistent", what), (robot.id,)
    for robot in scenario.robots:
        match verdicts.get(robot.id):
            case Undecided(reason):
                return MissionOutcome("undecided", f"{robot.id}: {reason}"), (robot.id,)
            case Localised() as claim if (vague := inaccuracy(claim, scenario.mission)) is not None:
                return MissionOutcome("undecided", f"{robot.id} {vague}"), (robot.id,)
    if open_cases:
        what = f"max_ticks: {', '.join(open_cases)} not localised by then"
        return MissionOutcome("undecided", what), open_cases
    for death in scenario.deaths:
        if death.robot not in verdicts:
            return MissionOutcome("undecided", _dead(death)), (death.robot,)
    return MissionOutcome("localised"), ()


def _others_not_localised(
    scenario: Scenario, verdicts: Mapping[str, Verdict], tick: int, named: Sequence[str]
) -> list[str]:
    """Return clauses about the robots of a group, without those `named`, that are dead or not localised.

    A dead robot that is localised may be the one that was to find the others.
    """
    dead = [one for one in scenario.deaths if one.tick <= tick]
    found = [_dead(one) for one in dead if one.robot not in named]
    known = {*named, *[one.robot for one in dead]}
    left = [robot for robot in not_localised(scenario, verdicts, tick) if robot not in known]
    if left:
        found.append(either(left))
    return found


def either(robots: Sequence[str]) -> str:
    """Return the clause that `robots` are not localised either, which names some of them."""
    more = len(robots) - MOST_NAMED
    names = ", ".join(robots[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
    return f"{names} {'is' if len(robots) == 1 else 'are'} not localised either"


def _dead(death: Death) -> str:
    return f"{death.robot} is dead from tick {death.tick} on"


def not_localised(scenario: Scenario, verdicts: Mapping[str, Verdict], tick: int) -> dict[str, str]:
    """Return the reason for each robot that is not localised at `tick`, in the order of `scenario`."""
    found = {}
    deaths = {one.robot: one for one in scenario.deaths if one.tick <= tick}
    for robot in scenario.robots:
        match verdicts.get(robot.id):
            case Undecided(reason):
                found[robot.id] = reason
            case Inconsistent(contradiction):
                found[robot.id] = f"its peer reports {contradiction}"
            case Localised() as claim:
                if (vague := inaccuracy(claim, scenario.mission)) is not None:
                    found[robot.id] = f"it {vague}"
            case None if robot.id in deaths:
                found[robot.id] = f"it is dead from tick {deaths[robot.id].tick} on"
            case None:
                found[robot.id] = "it has no result by then"
    return found
