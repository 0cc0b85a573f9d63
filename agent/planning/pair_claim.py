"""The inference and the claims of two robots with noisy sensors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from agent.estimation.claim import BEFORE_SEARCH, Blocked, blocked, claim, early_consistency, profiles, rivals
from agent.estimation.gaussian import inference
from agent.estimation.gaussian.claim_rivals import Rival
from agent.estimation.gaussian.consistency import CLAIM_P_VALUE, INCONSISTENT_SEARCHES, rejecting_p_value
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.own_sensors import DOUBTFUL_CLAIMS
from agent.estimation.gaussian.search import search
from agent.estimation.judged import FEWEST_FOR_CLAIM, Judged, of_pair
from agent.estimation.knowledge import Belief, Knowledge
from agent.estimation.posterior import PAIR, Posterior, settled
from agent.planning.state import RobotState
from agent.planning.tasks import Done
from protocol.messages import Localised

PAIR_SEARCHES = frozenset((FEWEST_FOR_CLAIM, *(8 * 2**n for n in range(12))))
"""The numbers of mutual ranges at which the whole plane is searched again for hypotheses.

They only bound how long a missed hypothesis stays missed: the plane is also searched before each claim, and
where the best fit does not converge. More searches cost time; with fewer, robots plan with too few
hypotheses.
"""


class PairInference(NamedTuple):
    """The hypotheses about both robots in one tick."""

    belief: Belief
    judged: Judged | None
    """The first hypothesis, as the conditions for a claim see it; None if there is none."""
    searched: bool
    """True if the hypotheses are from a search of the whole plane."""


def inferred(state: Knowledge, pair: JointMeasurements) -> PairInference:
    """Return the hypotheses about both robots, from those of the last tick or from a search.

    The whole plane is searched if nothing is known, at the counts PAIR_SEARCHES, if the best fit does not
    converge, and before a claim or a suspicion.
    """
    known = settled(Posterior(PAIR, state.belief.pair), pair)
    mutual = int(np.count_nonzero(pair.ranges.mutual))
    due = any(state.belief.ranges_at_last_search < count <= mutual for count in PAIR_SEARCHES)
    if known.hypotheses and known.has_converged and not due:
        followed = _inference(state, pair, known, searched=False)
        blocking, test = followed.belief.blocking_reason, followed.belief.inconsistency
        if blocking is not None and (test is None or test.p_value >= CLAIM_P_VALUE):
            return followed
    return _inference(state, pair, search(pair, known), searched=True)


def _inference(
    state: Knowledge, pair: JointMeasurements, found: Posterior, *, searched: bool
) -> PairInference:
    """Return the hypotheses that were `found`, with the belief that follows from them."""
    judged = of_pair("assured", state.config, found.hypotheses, pair)
    if judged is not None and not isinstance(state.peer_state.verdict, Localised):
        judged = judged._replace(rivals_of=(0, 1))
    blocking = blocked(judged, BEFORE_SEARCH)
    reason = blocking.reason if blocking is not None else None
    belief = inference.with_pair(state, found.hypotheses, judged and judged.inconsistency, reason)
    return PairInference(belief, judged, searched)


def with_claim(state: RobotState, judged: Judged | None) -> tuple[RobotState, Rival | None]:
    """Return `state`, and the rival that blocks its claim or None.

    The state has the claim if no condition blocks it. It is Undecided if other profiles of the sensors
    contradict all of its latest claims: then more ranges have not helped.
    """
    match claim(judged):
        case Localised() as claimed:
            belief = replace(state.belief, doubtful_claims=0, p_value=_least_p_value(state.belief))
            return replace(state, task=Done(3, claimed), belief=belief), None
        case Blocked(condition, reason):
            doubtful = state.belief.doubtful_claims
            if condition != early_consistency:
                doubtful = doubtful + 1 if condition == profiles else 0
            belief = replace(state.belief, blocking_reason=reason, doubtful_claims=doubtful)
            state = replace(state, belief=belief)
            if doubtful >= DOUBTFUL_CLAIMS:
                return state.undecided(reason), None
            return state, judged.rival if judged and condition == rivals else None


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
    return state.inconsistent(inconsistency) if doubt is None else state.undecided(doubt.reason())


def _least_p_value(belief: Belief) -> float | None:
    """Return the smallest p-value of all tests that count, and of the latest one; None if there is none."""
    if belief.inconsistency is None:
        return belief.p_value
    return min(belief.inconsistency.p_value, belief.p_value if belief.p_value is not None else 1.0)
