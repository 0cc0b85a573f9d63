"""The mutual ranges for which eq. (7) is solved, and those that check its solutions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

from agent.estimation.closed_forms import Placement, placements
from agent.estimation.exact import PairObservation
from protocol.motion import travelled

ELSEWHERE = 1e-6
"""The distance in m within which two measurement points count as one, so the second range adds nothing."""

B_ON_M1 = 1e-6
"""The ratio of a distance to a's path between two ranges, below which b may be on M1.

Eq. (7) then determines a's rotation about M1 no better than 1e-16 divided by this ratio.
"""


def base(
    pair_observations: Sequence[PairObservation], floor: float
) -> tuple[PairObservation, PairObservation] | None:
    """Return the two ranges for which eq. (7) is solved: the first two between which only a has moved.

    Robot b has not moved if its two positions are within `floor` m, the rounding error of both odometries.
    Pairs of ranges at which b may be on M1 are skipped: every rotation of a about M1 would solve eq. (7). The
    result is None if there is no such pair.
    """
    ranged: list[PairObservation] = []
    for pair_observation in pair_observations:
        if pair_observation.range is not None and not (
            ranged
            and (ranged[-1].a, ranged[-1].b)
            == (pair_observation.a, pair_observation.b)  # neither robot has moved in between
        ):
            ranged.append(pair_observation)
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


def solve(distance: float, base: tuple[PairObservation, PairObservation]) -> list[Placement]:
    """Return the solutions of eq. (7) for the two ranges `base`; `distance` is D in m."""
    first, second = base
    assert first.range is not None
    assert second.range is not None
    return placements(distance, first.b, first.a, second.a, first.range, second.range)


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
