"""The estimator for exact sensors: closed forms, which all measurements test up to rounding."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import ClassVar

import msgspec
from msgspec.structs import replace

from agent.estimation import precision
from agent.estimation.closed_forms import placements
from agent.estimation.estimator import AnchorEstimate, Estimator, PairEstimate
from agent.estimation.exact import Branch, PairObservation, branches, weigh_branches, weigh_placements
from agent.estimation.knowledge import Knowledge, MeetingPosterior, off_anchor
from protocol.messages import Inconsistent, Localised, Observation, Verdict
from protocol.motion import ORIGIN, REST, travelled
from protocol.rounding import SAME_ANCHORS

ELSEWHERE = 1e-6
"""The distance in m within which two measurement points count as one, so the second range adds nothing."""

B_ON_M1 = 1e-6
"""The ratio of a distance to a's path between two ranges, below which b may be on M1.

Eq. (7) then determines a's rotation about M1 no better than 1e-16 divided by this ratio.
"""


class ExactEstimator(msgspec.Struct, frozen=True):
    """The closed forms of Section III. A solution that contradicts any measurement is ruled out."""

    pose_tolerance: ClassVar[float] = 1e-9
    """The rounding error of the odometry, in rad and in units of A_0."""
    corrects_poses: ClassVar[bool] = False
    """The pose follows from the end of phase 1 by dead reckoning."""
    report_tolerance: ClassVar[float] = 1e-6
    """The rounding error of a report with a margin, in m and rad."""

    def is_informative(self, knowledge: Knowledge, observation: Observation) -> bool:
        """Return False for a range that repeats the last one of a robot that has not moved since.

        It is dropped from the end of phase 1 on.
        """
        return not (
            knowledge.own_anchor.branch is not None
            and observation.executed == REST
            and observation.anchor_range == knowledge.log.ranges[-1].range
        )

    def on_anchor(self, knowledge: Knowledge, rho0: float) -> AnchorEstimate | None:
        """Return the estimate of a robot on its anchor: its heading is radial by definition."""
        if rho0 > SAME_ANCHORS * precision.range_rounding(knowledge, knowledge.log, knowledge.tick):
            return None
        accuracy = precision.anchor(knowledge, ORIGIN, knowledge.log)
        branch = Branch(0.0, ORIGIN)
        return AnchorEstimate(knowledge.own_anchor, (branch,), 0.0, branch, accuracy.error, accuracy.enough)

    def anchor(self, knowledge: Knowledge, allowed: tuple[Branch, ...]) -> AnchorEstimate:
        """Return the branches +alpha and -alpha of eq. (2) that agree with every tick of phase 1."""
        known = knowledge.own_anchor
        if not allowed:
            ranges = knowledge.log.ranges
            allowed = branches(ranges[0].range, knowledge.odometry, ranges[-1].range)
            known = replace(known, possible=allowed)
        mission = knowledge.config.mission
        floor = precision.range_rounding(knowledge, knowledge.log, knowledge.tick)
        margin = precision.margin(mission, floor)
        remaining = weigh_branches(allowed, knowledge.seen(), mission.sensing_range, floor, margin)
        remaining = precision.merged(knowledge, remaining)
        if len(remaining) != 1:
            return AnchorEstimate(known, remaining, margin)
        best, accuracy = precision.fitted(knowledge, remaining[0])
        return AnchorEstimate(known, remaining, margin, best, accuracy.error, accuracy.enough)

    def pair(self, knowledge: Knowledge, first_tick: int, *, second_range: bool) -> PairEstimate | None:
        """Return the placements of eq. (7) that agree with every tick from `first_tick` on.

        The number of ranges does not matter: the claim needs a redundant one that confirms the placement. The
        result is None until a has moved between two ranges while b stood still.
        """
        del second_range
        observations = knowledge.pair_observations(first_tick)
        ranged = [at for at in observations if at.range is not None]
        orbit = knowledge.config.rendezvous.b
        away_from_m2 = [at for at in ranged if off_anchor(at.b, orbit)]
        through = min(knowledge.tick, knowledge.peer_state.peer.through)
        odometry_rounding = precision.odometry_rounding(knowledge, through)
        pair_base = base(away_from_m2, odometry_rounding)
        if pair_base is None:
            return None
        posterior, peers = knowledge.posterior, knowledge.posterior.peer_anchor
        if peers is None:
            peers = precision.peer_anchor(knowledge)
            posterior = replace(posterior, peer_anchor=peers)
        anchor_errors = knowledge.own_anchor.error + peers
        error_bound = anchor_errors + odometry_rounding
        posterior = _with_placements(knowledge, posterior, observations, pair_base, error_bound)
        remaining = posterior.placements
        checked = redundant(ranged, pair_base)
        verdict: Verdict | None = None
        if not remaining:
            verdict = Inconsistent("a path that contradicts the mutual ranges under every placement")
        elif (
            checked
            and len(remaining) == 1
            and precision.pinned_down(knowledge, remaining[0], ranged, anchor_errors, error_bound)
        ):
            verdict = Localised(knowledge.world_pose(remaining[0]))
        failure = "does not select a placement" if checked else "could not be measured: b left a's range"
        latest, failure = observations[-1], f"the third mutual range {failure}"
        return PairEstimate(posterior, verdict, remaining, failure, latest.a, latest.b, checked)


def _with_placements(
    knowledge: Knowledge,
    posterior: MeetingPosterior,
    observations: Sequence[PairObservation],
    pair_base: tuple[PairObservation, PairObservation],
    floor: float,
) -> MeetingPosterior:
    """Return `posterior` with the solutions of eq. (7) that agree with every tick in `observations`.

    A tick without a mutual range rules out the placements that predict both robots in range. `floor` is the
    bound in m on the error of a predicted range.
    """
    reach, solutions = knowledge.config.mission.sensing_range, posterior.placements
    counts = posterior.hypothesis_counts
    if counts is None:
        (first, second), distance = pair_base, knowledge.config.anchor_distance
        assert first.range is not None
        assert second.range is not None
        solutions = tuple(placements(distance, first.b, first.a, second.a, first.range, second.range))
        undetected = [at for at in observations if at.range is None]
        possible = weigh_placements(solutions, undetected, reach, floor)
        counts = (len(solutions), len(possible))
    remaining = weigh_placements(solutions, observations, reach, floor)
    seen = tuple(observations)
    return replace(posterior, placements=remaining, hypothesis_counts=counts, observations=seen)


def base(
    pair_observations: Sequence[PairObservation], floor: float
) -> tuple[PairObservation, PairObservation] | None:
    """Return the two ranges for which eq. (7) is solved: the first two between which only a has moved.

    Robot b has not moved if its two positions are within `floor` m, the rounding error of both odometries.
    Pairs of ranges at which b may be on M1 are skipped: every rotation of a about M1 would solve eq. (7). The
    result is None if there is no such pair.
    """
    ranged: list[PairObservation] = []
    for at in pair_observations:
        has_moved = not ranged or (ranged[-1].a, ranged[-1].b) != (at.a, at.b)
        if at.range is not None and has_moved:
            ranged.append(at)
    for first, second in combinations(ranged, 2):
        if travelled(first.b, second.b) <= floor and travelled(first.a, second.a) > ELSEWHERE:
            near = B_ON_M1 * travelled(first.a, second.a)
            if not (_b_may_be_on_m1(first, near) and _b_may_be_on_m1(second, near)):
                return first, second
    return None


def _b_may_be_on_m1(pair_observation: PairObservation, near: float) -> bool:
    """Return whether a is as far from its own anchor as from b, to `near` m, so that b may be on M1."""
    assert pair_observation.range is not None
    return abs(math.hypot(pair_observation.a.x, pair_observation.a.y) - pair_observation.range) <= near


def redundant(
    pair_observations: Sequence[PairObservation], base: tuple[PairObservation, PairObservation]
) -> bool:
    """Return whether there is a range from another place than the two ranges of `base`."""
    first, second = base
    for one in pair_observations:
        if one.range is not None and _elsewhere(one, first) and _elsewhere(one, second):
            return True
    return False


def _elsewhere(one: PairObservation, other: PairObservation) -> bool:
    """Return whether a robot has moved between two observations."""
    return travelled(one.a, other.a) > ELSEWHERE or travelled(one.b, other.b) > ELSEWHERE


EXACT_ESTIMATOR: Estimator = ExactEstimator()
