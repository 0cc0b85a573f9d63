"""The inference and the claims of two robots with noisy sensors.

`tandem estimate` applies the same to recorded robots.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from msgspec.structs import replace

from agent.estimation.gaussian import inference
from agent.estimation.gaussian.claim_rivals import Rival, blocking_rival, rival_reason
from agent.estimation.gaussian.consistency import (
    CLAIM_P_VALUE,
    EARLY_CLAIM_P_VALUE,
    FINISHED,
    INCONSISTENT_SEARCHES,
    rejecting_p_value,
)
from agent.estimation.gaussian.hypotheses import ScoredHypothesis, follow, search
from agent.estimation.gaussian.inference import PlanningHypothesis
from agent.estimation.gaussian.pair_ranges import PairRanges
from agent.estimation.knowledge import Belief, Knowledge
from agent.planning.state import Done, RobotState
from protocol.messages import Localised
from protocol.mission import Mission

FEWEST_FOR_CLAIM = 3
"""The minimum number of mutual ranges for hypotheses, and before a claim.

With fewer, there are too many hypotheses, and no range checks them. How many more a claim needs depends on
their evidence (`inference.with_evidence_check`).
"""

EARLY_RANGES = 16
"""The number of mutual ranges below which EARLY_CLAIM_P_VALUE applies.

Few ranges leave room for a wrong hypothesis that fits by chance. With more, only the p-value of the search
counts. The bound delays one of a hundred right claims by a few ticks."""

PAIR_SEARCHES = frozenset((FEWEST_FOR_CLAIM, *(8 * 2**n for n in range(12))))
"""The numbers of mutual ranges at which the whole plane is searched again for hypotheses.

They only bound how long a missed hypothesis stays missed: the plane is also searched before each claim, and
whenever the best fit still moves. More searches cost time; with fewer, robots plan with too few hypotheses.
"""


def required_mutual_ranges(mission: Mission) -> int:
    """Return the minimum number of mutual ranges before a claim."""
    return inference.MUTUAL_RANGES_WITH_OUTLIERS if mission.noise.outliers else FEWEST_FOR_CLAIM


class PairInference(NamedTuple):
    """The hypotheses about both robots in one tick."""

    scored: tuple[ScoredHypothesis, ...]
    hypotheses: tuple[PlanningHypothesis, ...]
    belief: Belief
    searched: bool
    """True if the hypotheses are from a search of the whole plane."""


def inferred(state: Knowledge, pair: PairRanges) -> PairInference:
    """Return the hypotheses about both robots, from those of the last tick or from a search.

    The whole plane is searched if nothing is known, at the counts PAIR_SEARCHES, if the best fit still moves,
    because it may be on its way to another mode, and before a claim or a suspicion.
    """
    known, mutual = state.belief.pair, pair.ranges.counts[2]
    if known and not any(state.belief.ranges_at_last_search < count <= mutual for count in PAIR_SEARCHES):
        scored = follow(known, pair)
        if scored and scored[0].fit.last_step <= FINISHED:
            followed = weighed(state, pair, scored, searched=False)
            if followed.belief.blocking_reason is not None and not _p_value_below(
                followed.belief, CLAIM_P_VALUE
            ):
                return followed
        known = tuple([one.hypothesis for one in scored])
    return weighed(state, pair, search(pair, known), searched=True)


def weighed(
    state: Knowledge, pair: PairRanges, scored: tuple[ScoredHypothesis, ...], *, searched: bool
) -> PairInference:
    """Return the hypotheses `scored` with the belief that follows from them."""
    mission = state.config.mission
    hypotheses = inference.pair_planning_hypotheses(scored)
    belief = inference.with_pair(state, scored, hypotheses, pair, required_mutual_ranges(mission))
    return PairInference(
        scored, hypotheses, inference.with_evidence_check(belief, scored, pair, mission), searched
    )


def may_claim(belief: Belief, pair: PairRanges) -> bool:
    """Return whether a search has left no reason against a claim."""
    few_ranges = len(pair.places) < EARLY_RANGES
    return belief.blocking_reason is None and not (few_ranges and _p_value_below(belief, EARLY_CLAIM_P_VALUE))


def with_claim(
    state: RobotState,
    scored: Sequence[ScoredHypothesis],
    hypotheses: Sequence[PlanningHypothesis],
    pair: PairRanges,
) -> tuple[RobotState, Rival | None]:
    """Return `state`, and the rival that blocks its claim or None.

    The state has the claim if nothing blocks it. It is Undecided if other profiles of the sensors contradict
    all of its latest claims (`inference.with_doubt_check`).
    """
    mission = state.config.mission
    belief, rival = inference.with_doubt_check(state.belief, scored, pair), None
    if belief.blocking_reason is None:
        robot = 0 if state.config.role == "a" else 1
        robots = (robot,) if isinstance(state.peer_state.verdict, Localised) else (0, 1)
        rival = blocking_rival(scored, hypotheses[0], pair, mission, robots)
        if rival is not None:
            belief = replace(belief, blocking_reason=rival_reason(rival, mission))
    state = replace(state, belief=belief)
    reason = belief.blocking_reason
    if reason is None:
        belief = replace(belief, p_value=_least_p_value(belief))
        claim = Localised(belief.poses[0], belief.covariance)
        return replace(state, mode=Done(3, claim), belief=belief), None
    return state.undecided(reason) if inference.ends_in_doubt(belief) else state, rival


def _p_value_below(belief: Belief, bound: float) -> bool:
    """Return whether the p-value of the consistency test is below `bound`; False without a test."""
    inconsistency = belief.inconsistency
    return inconsistency is not None and inconsistency.p_value < bound


def with_consistency_test(state: RobotState) -> RobotState:
    """Return `state` with the consistency test of a search, and with the verdict if too many tests failed.

    A test fails if its p-value is below `rejecting_p_value`. After INCONSISTENT_SEARCHES consecutive
    failures, the verdict is Inconsistent, or Undecided if the robot's own sensors are not as it was told.
    """
    belief = state.belief
    inconsistency, least = belief.inconsistency, _least_p_value(belief)
    if inconsistency is None:
        return state
    failed = inconsistency.p_value < rejecting_p_value(state.config.mission.noise)
    inconsistent_searches = belief.inconsistent_searches + 1 if failed else 0
    state = replace(state, belief=replace(belief, inconsistent_searches=inconsistent_searches, p_value=least))
    if inconsistent_searches < INCONSISTENT_SEARCHES:
        return state
    doubt = inference.sensor_doubt(state)
    return state.inconsistent(inconsistency.verdict) if doubt is None else state.undecided(doubt.reason)


def _least_p_value(belief: Belief) -> float | None:
    """Return the smallest p-value of all tests that count, and of the latest one; None if there is none."""
    if belief.inconsistency is None:
        return belief.p_value
    return min(belief.inconsistency.p_value, belief.p_value if belief.p_value is not None else 1.0)
