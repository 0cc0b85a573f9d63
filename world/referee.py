"""The outcome of a run, decided by comparing the robots' results with the true poses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from protocol.messages import Cause, Inconsistent, Localised, MissionEnd, Outcome, Undecided, Verdict
from protocol.mission import HEADING_ACCURACY, Mission
from protocol.motion import Pose, wrap
from protocol.rounding import TOLERANCE
from world.scenario import Death, Scenario
from world.truth import Truth

TOLERATED_SIGMAS = 5.0
"""The number of claimed standard deviations by which a claim may differ from the truth, with noise."""


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


def inaccuracy(robot: str, claim: Localised, mission: Mission) -> Cause | None:
    """Return how the `claim` of `robot` misses the required accuracy; None if it does not."""
    covariance = claim.covariance
    if covariance is None:
        return None
    position, heading = covariance.position_sigma, covariance.heading_sigma
    if position > mission.accuracy:
        return Cause("position", (robot,), (position, mission.accuracy))
    if heading > HEADING_ACCURACY:
        return Cause("heading", (robot,), (heading, HEADING_ACCURACY))
    return None


def mistake(robot: str, claim: Localised, truth: Pose, mission: Mission) -> Cause | None:
    """Return the errors of the `claim` of `robot` if it is wrong; None if it is correct."""
    position, heading = errors(claim.pose, truth)
    far, askew = tolerances(claim, mission)
    if position <= far and heading <= askew:
        return None
    covariance = claim.covariance
    sigmas = () if covariance is None else (covariance.position_sigma, covariance.heading_sigma)
    return Cause("wrong", (robot,), (position, heading, *sigmas))


def shortfall(robot: str, verdict: Verdict | None, mission: Mission, peer: str | None = None) -> Cause | None:
    """Return why `robot` is not localised by its `verdict`, in a meeting with `peer`; None if it is."""
    match verdict:
        case Undecided(reason):
            return Cause("undecided", (robot,), text=reason)
        case Inconsistent(claim):
            return Cause("inconsistent", (robot,) if peer is None else (robot, peer), text=claim)
        case Localised():
            return inaccuracy(robot, verdict, mission)
        case None:
            return None


def main_cause(shortfalls: Sequence[Cause]) -> Cause | None:
    """Return the first contradiction in `shortfalls`, or else the first of them; None if there is none."""
    return next((one for one in shortfalls if one.code == "inconsistent"), next(iter(shortfalls), None))


def mission_end(tick: int, causes: Sequence[Cause]) -> MissionEnd:
    """Return the end of a mission without wrong claims in `tick`, because of `causes`."""
    if not causes:
        return MissionEnd(tick, "localised")
    outcome: Outcome = "inconsistent" if causes[0].code == "inconsistent" else "undecided"
    return MissionEnd(tick, outcome, tuple(causes))


def decide_outcome(
    scenario: Scenario,
    truth: Truth,
    verdicts: Mapping[str, Verdict],
    claimed: Mapping[str, Pose] | None = None,
) -> MissionEnd | None:
    """Return the end once all results are known or `max_ticks` is reached; None before.

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
        and (not scenario.in_pairs or not isinstance(verdicts.get(robot.peer), Undecided | Inconsistent))
    ]
    if open_cases and truth.tick < scenario.max_ticks:
        return None
    for robot, pose in zip(scenario.robots, truth.poses, strict=True):
        verdict = verdicts.get(robot.id)
        if isinstance(verdict, Localised):
            at_claim = pose if claimed is None else claimed[robot.id]
            why = mistake(robot.id, verdict, at_claim, scenario.mission)
            if why is not None:
                return MissionEnd(truth.tick, "wrong", (why,))
    main = main_cause([*_shortfalls(scenario, verdicts).values()])
    if main is None and open_cases:
        main = Cause("max-ticks", tuple(open_cases))
    if main is None:
        main = next((_dead(one) for one in scenario.deaths if one.robot not in verdicts), None)
    causes = [main] if main is not None else []
    if main is not None and not scenario.in_pairs:
        named = open_cases if main.code == "max-ticks" else main.robots[:1]
        causes += _others_not_localised(scenario, verdicts, truth.tick, named)
    return mission_end(truth.tick, causes)


def _shortfalls(scenario: Scenario, verdicts: Mapping[str, Verdict]) -> dict[str, Cause]:
    """Return why robots are not localised by their verdicts, in the order of `scenario`."""
    met = [(one.id, one.encounter.peer if one.encounter else None) for one in scenario.robots]
    causes = [shortfall(one, verdicts.get(one), scenario.mission, peer) for one, peer in met]
    return {one.robots[0]: one for one in causes if one is not None}


def _others_not_localised(
    scenario: Scenario, verdicts: Mapping[str, Verdict], tick: int, named: Sequence[str]
) -> list[Cause]:
    """Return causes of the robots of a group, without those `named`, that are dead or not localised.

    A dead robot that is localised may be the one that was to find the others.
    """
    dead = [one for one in scenario.deaths if one.tick <= tick]
    stated = {*named, *[one.robot for one in dead]}
    left = [robot for robot in not_localised(scenario, verdicts, tick) if robot not in stated]
    causes = [_dead(one) for one in dead if one.robot not in named]
    return [*causes, Cause("others", tuple(left))] if left else causes


def _dead(death: Death) -> Cause:
    return Cause("dead", (death.robot,), (float(death.tick),))


def not_localised(scenario: Scenario, verdicts: Mapping[str, Verdict], tick: int) -> dict[str, Cause]:
    """Return the cause for each robot that is not localised at `tick`, in the order of `scenario`."""
    causes = _shortfalls(scenario, verdicts)
    dead = {one.robot: _dead(one) for one in scenario.deaths if one.tick <= tick}
    missing = [one.id for one in scenario.robots if one.id not in verdicts]
    causes |= {robot: dead.get(robot, Cause("max-ticks", (robot,))) for robot in missing}
    return {one.id: causes[one.id] for one in scenario.robots if one.id in causes}
