"""Hypotheses about the poses of n robots: pairs that two anchors locate, and then one robot after another.

A robot is located by its ranges to beacons, which are anchors and robots that are located already. What its
ranges leave open (often a mirror image) becomes several hypotheses. Then all robots are fitted jointly, and
the evidence of the joint fits determines their probabilities.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from agent.estimation.fit import Start, fits
from agent.estimation.gauss_newton import Convergence
from agent.estimation.gaussian import hypotheses
from agent.estimation.gaussian.beacon_guesses import beacon_guesses
from agent.estimation.gaussian.hypotheses import (
    NEGLIGIBLE_PROBABILITY,
    WARM_STEPS,
)
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.known_anchors import AnchoredRobot, scored_fits, start_of
from agent.estimation.gaussian.odometry_noise import Places
from agent.estimation.gaussian.pair_ranges import PairRanges
from agent.estimation.gaussian.range_model import Ranges
from agent.estimation.posterior import (
    MOST_JOINT,
    MOST_POSES,
    NO_HYPOTHESES,
    JointHypotheses,
    JointHypothesis,
    with_probability,
)

FEWEST_TO_ANCHORS = 3
"""The least number of ranges of each robot of a pair to its anchor."""


FEWEST_DECISIVE = 3
"""The least number of decisive ranges with which a robot or a pair is located, as in a pair.

A claim needs 8.
"""


FEWEST_TO_LOCATE_ANCHOR = 8
"""The least number of ranges of located robots to an anchor without a position with which it is located.

As many as for a claim: with fewer, it may stand in many places, and each would be a hypothesis.
"""


class Candidate(NamedTuple):
    """Robots that may be located next."""

    decisive: int
    """The number of ranges that decide: those between a pair, or those to other beacons than the first."""
    robots: tuple[int, ...]
    """One robot, or a pair."""


def search(measured: JointMeasurements, reach: float) -> JointHypotheses:
    """Return the hypotheses of a search of the whole plane; `reach` (m) bounds the ranges."""
    return extended(NO_HYPOTHESES, measured, reach)


def follow(known: JointHypotheses, measured: JointMeasurements, steps: int = WARM_STEPS) -> JointHypotheses:
    """Return the hypotheses that follow from those `known` before the latest facts."""
    part = measured.some(known.located)
    found = fits(part, [one.fit.start for one in known.scored], Convergence(steps))
    return JointHypotheses(known.located, with_probability(found))


def extended(
    known: JointHypotheses, measured: JointMeasurements, reach: float, failed: Sequence[Candidate] = ()
) -> JointHypotheses:
    """Return the hypotheses `known` with all further robots that their ranges locate.

    Those in `failed` are not tried.
    """
    tried = set(failed)
    while left := [one for one in candidates(known.located, measured) if one not in tried]:
        tried.add(left[0])
        more = _with(known, left[0], measured, reach)
        known = more if more.scored else known
    return known


def merged(found: JointHypotheses, other: JointHypotheses) -> JointHypotheses:
    """Return the hypotheses of both, or those of `other` alone if it locates more robots.

    Both are fitted to the same facts. If `other` does not locate all robots, `found` is returned.
    """
    if found.located == other.located:
        return JointHypotheses(
            found.located, with_probability([one.fit for one in (*found.scored, *other.scored)])
        )
    return other if set(found.located) < set(other.located) else found


def candidates(located: Sequence[int], measured: JointMeasurements) -> list[Candidate]:
    """Return which robots may be located next, those with the most decisive ranges first."""
    measured = measured.as_surveyed
    found = [*_single(located, measured), *_paired(located, measured)]
    return sorted(found, key=lambda one: (-one.decisive, -len(one.robots), one.robots))


def _single(located: Sequence[int], measured: JointMeasurements) -> Iterator[Candidate]:
    ranges = measured.ranges
    for robot in range(len(measured.robots)):
        if robot in located or robot in measured.placed:
            continue
        rows = beacons(robot, located, measured)
        fixed = rows[ranges.second[rows] < 0]
        places = [tuple(one) for one in ranges.place[fixed].tolist()]
        decisive = len(rows) - max([places.count(one) for one in set(places)], default=0)
        if decisive >= (FEWEST_TO_LOCATE_ANCHOR if measured.is_anchor(robot) else FEWEST_DECISIVE):
            yield Candidate(decisive, (robot,))


def beacons(robot: int, located: Sequence[int], measured: JointMeasurements) -> Places:
    """Return the rows of the ranges of `robot` to anchors and to robots that are `located`."""
    ranges = measured.ranges
    other = np.where(ranges.first == robot, ranges.second, ranges.first)
    return np.flatnonzero(ranges.of(robot) & ((other < 0) | np.isin(other, np.array(located, np.intp))))


def _paired(located: Sequence[int], measured: JointMeasurements) -> Iterator[Candidate]:
    ranges = measured.ranges
    for own in ranges.pairs:
        row = int(np.argmax(own))
        a, b = int(ranges.first[row]), int(ranges.second[row])
        if b < 0 or a in located or b in located:
            continue
        count = int(np.count_nonzero(own))
        if count >= FEWEST_DECISIVE and _anchors_of_pair(a, b, measured) is not None:
            yield Candidate(count, (a, b))


def _anchors_of_pair(a: int, b: int, measured: JointMeasurements) -> tuple[Places, Places] | None:
    """Return the ranges of each robot to its anchor: those with the most ranges, at different places."""
    own = [
        [rows for rows in _of_anchors(robot, measured) if len(rows) >= FEWEST_TO_ANCHORS] for robot in (a, b)
    ]
    place = measured.ranges.place
    choices = [
        (len(one) + len(other), one, other)
        for one in own[0]
        for other in own[1]
        if place[one[0]].tolist() != place[other[0]].tolist()
    ]
    if not choices:
        return None
    _, one, other = max(choices, key=lambda choice: choice[0])
    return one, other


def _of_anchors(robot: int, measured: JointMeasurements) -> list[Places]:
    """Return the rows of the ranges of `robot` to each of its anchors."""
    ranges = measured.ranges
    fixed = (ranges.first == robot) & (ranges.second < 0)
    return [np.flatnonzero(own & fixed) for own in ranges.pairs if np.any(own & fixed)]


# --- locating ---------------------------------------------------------------------------------------------


class _Located(NamedTuple):
    """The start poses of new robots under one hypothesis about the others."""

    log_weight: float
    start: Start


def _with(
    known: JointHypotheses, candidate: Candidate, measured: JointMeasurements, reach: float
) -> JointHypotheses:
    """Return the hypotheses with the robots of `candidate`; none if their ranges do not locate them."""
    located = tuple(sorted((*known.located, *candidate.robots)))
    before = known.scored or (None,)
    found = [
        (min(i, k), (math.log(one.probability) if one is not None else 0.0) + new.log_weight, one, new)
        for i, one in enumerate(before)
        for k, new in enumerate(_new(one, known.located, candidate, measured, reach))
    ]
    least = max([weight for _, weight, _, _ in found], default=0.0) + math.log(NEGLIGIBLE_PROBABILITY)
    # all poses of the new robots under the first hypothesis, and the first pose under all others
    found.sort(key=lambda each: (each[0] > 0, -each[1]))
    part, order = measured.some(located), np.argsort([*known.located, *candidate.robots])
    count = len(known.located)
    anchors = np.zeros((0, 3)) if part.prior is None else part.prior.mean[len(located) :]
    starts = []
    for rank, (others, weight, one, new) in enumerate(found[:MOST_POSES]):
        if weight >= least and (others == 0 or rank < MOST_JOINT):
            begun = one.fit.start if one is not None else Start(anchors)
            poses = np.concatenate((begun.poses[:count], new.start.poses))[order]
            errors = [*begun.errors[:count], *new.start.errors]
            with_anchors = np.concatenate((poses, begun.poses[count:]))
            starts.append(Start(with_anchors, tuple([errors[k] for k in order])))
    return JointHypotheses(located, with_probability(fits(part, starts)))


def _new(
    one: JointHypothesis | None,
    located: tuple[int, ...],
    candidate: Candidate,
    measured: JointMeasurements,
    reach: float,
) -> list[_Located]:
    """Return the start poses of the robots of `candidate` under the hypothesis `one`."""
    measured = measured.as_surveyed
    match candidate.robots:
        case (robot,):
            return _of_robot(among_beacons(robot, one, located, measured, reach))
        case (a, b):
            return _of_pair(a, b, measured, reach)
    raise AssertionError(candidate)


def _of_robot(robot: AnchoredRobot) -> list[_Located]:
    scored = scored_fits(robot, list(map(start_of, beacon_guesses(robot))))
    return [_Located(math.log(one.probability), one.fit.start) for one in scored]


def among_beacons(
    robot: int,
    one: JointHypothesis | None,
    located: tuple[int, ...],
    measured: JointMeasurements,
    reach: float,
) -> AnchoredRobot:
    """Return a robot with its ranges to anchors and to located robots, as if all of these were anchors.

    The sigma of a position of a robot, at the end of its path, adds to that of each range to it.
    """
    ranges, rows = measured.ranges, beacons(robot, located, measured)
    place, variance = ranges.place[rows].copy(), np.square(ranges.sigma[rows])
    other = np.where(ranges.first[rows] == robot, ranges.second[rows], ranges.first[rows])
    for k, beacon in enumerate(located):
        own = np.flatnonzero(other == beacon)
        if one is not None and len(own):
            place[own] = one.fit.places(k, ranges.tick[rows[own]]).T
            spread = one.fit.covariance[3 * k : 3 * k + 2, 3 * k : 3 * k + 2]
            variance[own] += min(0.5 * float(np.trace(spread)), reach**2)
    counts = (len(rows), 0, 0)
    as_anchors = Ranges(
        ranges.rho[rows], ranges.tick[rows], np.sqrt(variance), counts, place, ranges.radio[rows]
    )
    return AnchoredRobot(measured.paths[robot], as_anchors, reach, measured.noise)


def _of_pair(a: int, b: int, measured: JointMeasurements, reach: float) -> list[_Located]:
    own = _anchors_of_pair(a, b, measured)
    assert own is not None
    ranges = measured.ranges
    mutual = np.flatnonzero((ranges.first == a) & (ranges.second == b))
    rows = np.concatenate((*own, mutual))
    m1, m2 = [ranges.place[one[0]].tolist() for one in own]
    nothing = np.empty(0, np.intp)
    pair = PairRanges(
        (measured.paths[a], measured.paths[b]),
        Ranges(
            ranges.rho[rows], ranges.tick[rows], ranges.sigma[rows], (len(own[0]), len(own[1]), len(mutual))
        ),
        (nothing, nothing, nothing),
        (m2[0] - m1[0], m2[1] - m1[1]),
        reach,
        measured.noise,
    )
    return [
        _Located(
            math.log(one.hypothesis.probability),
            one.fit.start._replace(poses=one.fit.start.poses + (*m1, 0.0)),
        )
        for one in hypotheses.search(pair)
    ]
