"""The estimates of two robots over time, by the inference and the claim rule of the missions."""

from __future__ import annotations

from msgspec.structs import replace

from agent.estimation.gaussian import inference
from agent.estimation.gaussian.hypotheses import follow, search
from agent.estimation.gaussian.inference import to_second_order
from agent.estimation.gaussian.pair_ranges import PairRanges
from agent.estimation.knowledge import Belief, Knowledge
from agent.planning.pair_claim import (
    FEWEST_FOR_CLAIM,
    PAIR_SEARCHES,
    PairInference,
    inferred,
    may_claim,
    weighed,
)
from compose.recording.estimating.estimate_epoch import (
    GIVEN_UP,
    MOST_SEARCHES,
    ClaimRule,
    EpochFit,
    EstimateEpoch,
    doubted,
    of_centres,
)
from compose.recording.estimating.pair_measurements import PairMeasurements
from compose.recording.estimating.prepared_steps import OneRobot
from compose.recording.ranging.range_recording import Numbers
from protocol.messages import RobotConfig
from protocol.mission import ROLES, Anchor, Mission, Role
from protocol.orbits import Orbit, Rendezvous

FREE_SPEED = 10.0
"""The speed (m/s) and turn rate (rad/s) of the mission that stands for a recording; nothing is planned."""

FEW_RANGES = "few ranges, and a small p-value"

NO_ORBIT = Orbit(0.0, 0.0, 0.0)


class PairEstimator:
    """The estimate of two robots, which goes on from epoch to epoch.

    Until both robots have claimed their poses, the plane is searched whenever it is in a mission. After that,
    the hypotheses are only followed.
    """

    def __init__(self, rule: ClaimRule) -> None:
        self._rule = rule
        self._belief = Belief()
        self._claimed = False
        self._searched = self._searches = 0

    def epoch(self, measured: PairMeasurements, number: int) -> EstimateEpoch:
        """Return the estimate at the end of the epoch with this `number`, from 1 on, in their order.

        `measured` may have grown since the last call, and is otherwise the same.
        """
        pair, t = measured.until(number), measured.end(number)
        known = [_knowledge(measured, role, self._belief, pair, self._rule) for role in ROLES]
        mutual = pair.ranges.counts[2]
        due = any(self._searched < count <= mutual for count in PAIR_SEARCHES)
        spent = self._searches >= MOST_SEARCHES and not due
        if spent and not self._belief.pair:
            return EstimateEpoch(t, pair.ranges.counts, (), (False, False), GIVEN_UP, None)
        found, beliefs = _inferred(known, pair, follow_only=self._claimed or spent)
        if found is not None and found.searched:
            self._searched, self._searches = mutual, self._searches + 1
        if found is None or not found.scored:
            reason = "no hypothesis explains the ranges" if found is not None else "too few mutual ranges"
            return EstimateEpoch(t, pair.ranges.counts, (), (False, False), reason, None)
        self._belief = beliefs[0]
        settled = self._claimed or not spent
        claims = [settled and may_claim(one, pair) for one in beliefs]
        self._claimed = self._claimed or all(claims)
        reasons = [one.blocking_reason for one in beliefs if one.blocking_reason is not None]
        return EstimateEpoch(
            t,
            pair.ranges.counts,
            tuple([of_centres(*one, measured.sides, measured.origin) for one in _second_order(found, pair)]),
            (claims[0], claims[1]),
            reasons[0] if reasons else "" if all(claims) else FEW_RANGES if settled else GIVEN_UP,
            EpochFit(found.scored[0].fit, pair),
        )


def _knowledge(
    measured: PairMeasurements, role: Role, belief: Belief, pair: PairRanges, rule: ClaimRule
) -> Knowledge:
    """Return what the robot with this role would know."""
    sides: tuple[OneRobot, OneRobot] = (measured.a, measured.b)
    own, peer = sides if role == "a" else sides[::-1]
    mission = Mission(
        sensing_range=pair.sensing_range,
        period=measured.period,
        max_speed=FREE_SPEED,
        max_turn_rate=FREE_SPEED,
        accuracy=rule.accuracy,
        confidence=rule.confidence,
        noise=measured.noise,
    )
    config = RobotConfig(
        robot=own.id,
        peer=peer.id,
        role=role,
        given_anchor=Anchor(own.anchor.x, own.anchor.y),
        peer_anchor=Anchor(peer.anchor.x, peer.anchor.y),
        mission=mission,
        planner_name="assured",
        rendezvous=Rendezvous(NO_ORBIT, NO_ORBIT, 0.0),
    )
    return Knowledge(config, belief=belief)


def _inferred(
    known: list[Knowledge], pair: PairRanges, *, follow_only: bool
) -> tuple[PairInference | None, list[Belief]]:
    """Return the hypotheses about both robots, and what each of the two makes of them."""
    mutual = pair.ranges.counts[2]
    if mutual < FEWEST_FOR_CLAIM:
        return None, []
    before = known[0].belief.pair
    if follow_only and before:
        found = weighed(known[0], pair, follow(before, pair), searched=False)
    else:
        found = inferred(known[0], pair)
    beliefs = _tested(known, pair, found)
    if not follow_only and not found.searched and any(may_claim(one, pair) for one in beliefs):
        found = weighed(known[0], pair, search(pair, found.belief.pair), searched=True)
        beliefs = _tested(known, pair, found)
    return found, beliefs


def _tested(known: list[Knowledge], pair: PairRanges, found: PairInference) -> list[Belief]:
    """Return the beliefs of both robots, with every reason against a claim."""
    own = found.belief
    if found.searched:
        own = replace(own, ranges_at_last_search=pair.ranges.counts[2])
    peer = weighed(known[1], pair, found.scored, searched=found.searched).belief
    beliefs = [inference.with_convergence_check(one, found.scored) for one in (own, peer)]
    if not any(may_claim(one, pair) for one in beliefs):
        return beliefs
    doubt = doubted(found.scored[0].fit, pair.measured) or None
    return [replace(one, blocking_reason=one.blocking_reason or doubt) for one in beliefs]


def _second_order(found: PairInference, pair: PairRanges) -> list[tuple[float, Numbers, Numbers]]:
    """Return the probability, the mean, (6,), and the covariance, (6, 6), of each hypothesis."""
    return [(one.probability, *to_second_order(one, pair.apart)) for one in found.hypotheses]
