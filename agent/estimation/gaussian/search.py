"""The search of the whole plane for hypotheses: pairs that two anchors locate, and one robot after another.

A robot is located by its ranges to beacons, which are anchors and robots that are located already. What its
ranges leave open (often a mirror image) becomes several hypotheses. Then all robots are fitted jointly, and
the evidence of the joint fits determines their probabilities. A pair is located by the hypotheses of each of
the two about its own anchor, and by the ranges between them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from agent.estimation.fit import Fit, Start, deviation, fits
from agent.estimation.gauss_newton import Convergence
from agent.estimation.gaussian.anchor_guesses import SEED_RANGES, UNLIKELY, anchors
from agent.estimation.gaussian.beacon_guesses import beacon_guesses, line_of, start_of, straight
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.odometry_noise import Array, Places
from agent.estimation.gaussian.placement_guesses import STARTS, placements
from agent.estimation.posterior import (
    MOST_JOINT,
    MOST_POSES,
    NEGLIGIBLE_PROBABILITY,
    NO_HYPOTHESES,
    WARM_STEPS,
    Hypothesis,
    Posterior,
    hypotheses_of,
    merged,
    same,
)
from agent.estimation.problem import Problem

FEWEST_DECISIVE = 3
"""The least number of decisive ranges with which a robot or a pair is located, and of ranges to each anchor.

A claim needs 8.
"""

FEWEST_TO_LOCATE_ANCHOR = 8
"""The least number of ranges of located robots to an anchor without a position with which it is located.

As many as for a claim: with fewer, it may stand in many places, and each would be a hypothesis.
"""

STARTS_WITHOUT_OUTLIERS = 4
"""The number of the likeliest starts whose outliers are left out of a second fit."""

OPEN = 0.5
"""The sigma of a position from which on a robot has no pose, as a fraction of the longest range.

One hypothesis would stand for many places, and further ranges would lead it to any of them.
"""

FOLLOWED_RANGES = 6
"""The number of ranges to an anchor from which on its hypotheses are followed only, without outliers.

Two circles have two intersections, so a few ranges from different places leave nothing that a search would
find. With outliers it takes SEED_RANGES."""

OFF_IMAGE = 0.3
"""The RMS residual of an image, as a fraction of the longest range, above which no fit begins there.

Images of robots that have turned do not fit: such a fit takes all its steps, and mostly leads back.
"""

COARSE_STILL = 0.05
"""The `Convergence.shortest` of fits on which only the robot's way depends.

No claim does: each search fits all ranges again. With LAST_STEP, such a fit takes twice as long.
"""

WARM_DECREASE = 0.1
"""The expected decrease of the first step of a fit that begins at the last one, which has one range less."""


class Locatable(NamedTuple):
    """Robots that may be located next."""

    decisive: int
    """The number of ranges that decide: those between a pair, or those to other beacons than the first."""
    robots: tuple[int, ...]
    """One robot, or a pair."""


@lru_cache(maxsize=8)
def search(
    measured: JointMeasurements, known: Posterior = NO_HYPOTHESES, fewest: int = FEWEST_DECISIVE
) -> Posterior:
    """Return the hypotheses of a search of the whole plane, and those `known`.

    A pair is located from `fewest` ranges of each pair of radios on. Where both robots of a pair run in one
    process, they mostly search with the same measurements in the same tick.
    """
    return merged(known, from_nothing(measured, fewest), measured)


@lru_cache(maxsize=16)
def from_nothing(measured: JointMeasurements, fewest: int) -> Posterior:
    """Return the hypotheses about all robots that their ranges locate, by these alone.

    A robot of a team that is located for the first time searches in the same tick, as it may claim its pose.
    If all run in one process, some of up to 16 robots have the same measurements.
    """
    return extended(NO_HYPOTHESES, measured, fewest=fewest)


def extended(
    known: Posterior,
    measured: JointMeasurements,
    failed: Sequence[Locatable] = (),
    fewest: int = FEWEST_DECISIVE,
) -> Posterior:
    """Return the hypotheses `known` with all further robots that their ranges locate.

    Those in `failed` are not tried. If none are known, those of robots with a prior come first.
    """
    tried, known = set(failed), known if known.hypotheses else begun(measured)
    while left := [one for one in locatable(known.located, measured, fewest) if one not in tried]:
        tried.add(left[0])
        more = _with(known, left[0].robots, measured, fewest)
        known = more if more.hypotheses else known
    return known


def begun(measured: JointMeasurements) -> Posterior:
    """Return the hypothesis about the robots whose poses at tick 0 have a prior; none without one."""
    if not measured.started:
        return NO_HYPOTHESES
    alone = measured.some(measured.started)
    assert alone.prior is not None
    found = hypotheses_of(fits(alone, [Start(alone.prior.mean)]), alone)
    return Posterior(measured.started, found) if found else NO_HYPOTHESES


def locatable(
    located: Sequence[int], measured: JointMeasurements, fewest: int = FEWEST_DECISIVE
) -> list[Locatable]:
    """Return which robots may be located next, those with the most decisive ranges first."""
    measured = measured.as_surveyed
    found = [*_single(located, measured), *_paired(located, measured, fewest)]
    return sorted(found, key=lambda one: (-one.decisive, -len(one.robots), one.robots))


def _single(located: Sequence[int], measured: JointMeasurements) -> Iterator[Locatable]:
    ranges = measured.ranges
    for robot in range(len(measured.robots)):
        if robot in located or robot in measured.placed:
            continue
        rows = beacons(robot, located, measured)
        fixed = rows[ranges.second[rows] < 0]
        places = [tuple(one) for one in ranges.place[fixed].tolist()]
        decisive = len(rows) - max([places.count(one) for one in set(places)], default=0)
        if decisive >= (FEWEST_TO_LOCATE_ANCHOR if measured.is_anchor(robot) else FEWEST_DECISIVE):
            yield Locatable(decisive, (robot,))


def beacons(robot: int, located: Sequence[int], measured: JointMeasurements) -> Places:
    """Return the rows of the ranges of `robot` to anchors and to robots that are `located`."""
    ranges = measured.ranges
    other = np.where(ranges.first == robot, ranges.second, ranges.first)
    return np.flatnonzero(ranges.of(robot) & ((other < 0) | np.isin(other, np.array(located, np.intp))))


def _paired(located: Sequence[int], measured: JointMeasurements, fewest: int) -> Iterator[Locatable]:
    for (a, b), rows in measured.ranges.pairs:
        if b < 0 or a in located or b in located or len(rows) < fewest:
            continue
        if _anchors_of_pair(a, b, measured, fewest) is not None:
            yield Locatable(len(rows), (a, b))


def _anchors_of_pair(
    a: int, b: int, measured: JointMeasurements, fewest: int
) -> tuple[Places, Places] | None:
    """Return the ranges of each robot to its anchor: those with the most ranges, at different places."""
    place, rows_of = measured.ranges.place, measured.ranges.of_anchors
    own = [[rows for rows in rows_of.get(robot, ()) if len(rows) >= fewest] for robot in (a, b)]
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


# --- locating ---------------------------------------------------------------------------------------------


def _with(known: Posterior, robots: tuple[int, ...], measured: JointMeasurements, fewest: int) -> Posterior:
    """Return the hypotheses with `robots`; none if their ranges do not locate them."""
    located = tuple(sorted((*known.located, *robots)))
    part, before = measured.some(located), known.hypotheses or (None,)
    found = []
    for i, one in enumerate(before):
        alone = _alone(robots, one, known.located, measured, fewest)
        if whole := alone == part:
            alone = part  # which has its problem
        new = _of_pair(alone) if len(robots) == 2 else _of_robot(alone)
        if part.started and len(robots) == 1:
            new = _determined(new, alone)
        if whole:
            return Posterior(located, new)
        log_weight = math.log(one.probability) if one is not None else 0.0
        found += [
            (min(i, k), log_weight + math.log(other.probability), one, other.fit.start)
            for k, other in enumerate(new)
        ]
    least = max([weight for _, weight, _, _ in found], default=0.0) + math.log(NEGLIGIBLE_PROBABILITY)
    # all poses of the new robots under the first hypothesis, and the first pose under all others
    found.sort(key=lambda each: (each[0] > 0, -each[1]))
    order = np.argsort([*known.located, *robots])
    count = len(known.located)
    anchors = np.zeros((0, 3)) if part.prior is None else part.prior.mean[len(located) :]
    starts = []
    for rank, (others, weight, one, start) in enumerate(found[:MOST_POSES]):
        if weight >= least and (others == 0 or rank < MOST_JOINT):
            begun = one.fit.start if one is not None else Start(anchors)
            poses = np.concatenate((begun.poses[:count], start.poses))[order]
            errors = [*begun.errors[:count], *start.errors]
            with_anchors = np.concatenate((poses, begun.poses[count:]))
            starts.append(Start(with_anchors, tuple([errors[k] for k in order])))
    return Posterior(located, _with_images(hypotheses_of(fits(part, starts), part), part))


def _with_images(found: tuple[Hypothesis, ...], part: JointMeasurements) -> tuple[Hypothesis, ...]:
    """Return the hypotheses with their images in the line on which the robots with a prior have driven."""
    starts = []
    for one in found if part.started and bool(np.all(part.ranges.mutual)) else ():
        foot, course, width = line_of(np.concatenate([one.fit.paths[k, :, :2] for k in part.started]))
        if width <= straight(part):
            poses, (c, s) = one.fit.start.poses.copy(), (math.cos(2.0 * course), math.sin(2.0 * course))
            others = [k for k in range(len(poses)) if k not in part.started]
            x, y, heading = poses[others].T
            poses[others] = np.stack(
                (c * x + s * y + 2.0 * foot[0], s * x - c * y + 2.0 * foot[1], 2.0 * course - heading), 1
            )
            if _off(poses, part) <= OFF_IMAGE * float(np.max(part.ranges.rho)):
                starts.append(Start(poses))
    return _with_more(found, starts, part)


def _off(poses: Array, part: JointMeasurements) -> float:
    """Return the root mean square (m) of what ranges are off from start `poses` by the measured odometry."""
    of = (problem := Problem.of(part)).measured
    found = problem.kernel.walked(poses.ravel(), np.zeros(of.patterns.shape[:2]), np.zeros(of.white.shape))
    return float(np.sqrt(np.mean(np.square(found.residual))))


def _with_more(
    found: tuple[Hypothesis, ...], starts: list[Start], measured: JointMeasurements
) -> tuple[Hypothesis, ...]:
    """Return the hypotheses with the fits from `starts` that none of them is already."""
    more = [fit for fit in fits(measured, starts) if not any(all(same(fit, known.fit)) for known in found)]
    return hypotheses_of([*[known.fit for known in found], *more], measured) if more else found


def _alone(
    robots: tuple[int, ...],
    one: Hypothesis | None,
    located: tuple[int, ...],
    measured: JointMeasurements,
    fewest: int,
) -> JointMeasurements:
    """Return the measurements by which `robots` are located under the hypothesis `one`."""
    measured = measured.as_surveyed
    if len(robots) == 1:
        return among_beacons(robots[0], one, located, measured)
    (a, b), ranges = robots, measured.ranges
    own = _anchors_of_pair(a, b, measured, fewest)
    assert own is not None
    mutual = np.flatnonzero((ranges.first == a) & (ranges.second == b))
    rows = ranges.rows(np.sort(np.concatenate((*own, mutual))))
    return replace(measured, ranges=rows, prior=None, surveyed=()).some((a, b))


def among_beacons(
    robot: int,
    one: Hypothesis | None,
    located: tuple[int, ...],
    measured: JointMeasurements,
) -> JointMeasurements:
    """Return a robot with its ranges to anchors and to located robots, as if all of these were anchors.

    The sigma of a position of a robot, at the end of its path, adds to that of each range to it.
    """
    ranges = measured.ranges.rows(beacons(robot, located, measured))
    place, variance = ranges.place.copy(), np.square(ranges.sigma)
    other = np.where(ranges.first == robot, ranges.second, ranges.first)
    for k, beacon in enumerate(located):
        own = np.flatnonzero(other == beacon)
        if one is not None and len(own):
            place[own] = one.fit.places(k, ranges.tick[own]).T
            spread = one.fit.covariance[3 * k : 3 * k + 2, 3 * k : 3 * k + 2]
            variance[own] += min(0.5 * float(np.trace(spread)), measured.reach**2)
    by_second = ranges.by_second ^ (ranges.second == robot)
    ends = {"first": np.zeros_like(ranges.first), "second": np.full_like(ranges.second, -1)}
    ranges = replace(ranges, sigma=np.sqrt(variance), place=place, by_second=by_second, **ends)
    path = measured.paths[robot]
    return replace(measured, robots=("",), paths=(path,), ranges=ranges, prior=None, surveyed=(), silent=())


# --- one robot, and two --------------------------------------------------------------------------------


def _of_robot(robot: JointMeasurements) -> tuple[Hypothesis, ...]:
    """Return the hypotheses about one robot whose beacons are anchors."""
    return hypotheses_of(fits(robot, map(start_of, beacon_guesses(robot))), robot)


def _determined(found: tuple[Hypothesis, ...], robot: JointMeasurements) -> tuple[Hypothesis, ...]:
    """Return the hypotheses about one robot with their images; none if the first leaves its place OPEN."""
    starts = []
    for one in found:
        foot, _, width = line_of(one.fit.places(0, robot.ranges.tick).T - robot.ranges.place)
        if width <= straight(robot):  # it may be on the other side, with the same heading
            starts.append(Start(one.fit.start.poses - 2.0 * np.array([[*foot, 0.0]])))
    found = _with_more(found, starts, robot)
    return found if found and position_sigma(found[0].fit, 0) <= OPEN * robot.reach else ()


def position_sigma(fit: Fit, robot: int) -> float:
    """Return the sigma (m) of the position of a robot at the end; infinite if ranges leave it open."""
    return deviation(float(np.trace(fit.covariance[3 * robot : 3 * robot + 2, 3 * robot : 3 * robot + 2])))


def _of_pair(pair: JointMeasurements) -> tuple[Hypothesis, ...]:
    """Return the hypotheses about two robots with one anchor each.

    The starts combine the hypotheses of the first about its anchor, those of the second and their placements.
    """
    of_a, of_b = (_until_now(pair, robot) for robot in (0, 1))
    found = [
        (placed.log_likelihood + math.log(a.probability * b.probability), placed)
        for a in of_a
        for b in of_b
        for placed in placements((a.fit, b.fit), pair)
    ]
    found.sort(key=lambda one: -one[0])
    starts = [placed.start for weight, placed in found[:STARTS] if weight > found[0][0] - UNLIKELY]
    return hypotheses_of(fits(pair, starts, doubted=STARTS_WITHOUT_OUTLIERS), pair)


def _until_now(pair: JointMeasurements, robot: int) -> list[Hypothesis]:
    """Return the hypotheses about one robot's anchor in the frame of its odometry, by its own ranges."""
    own = pair.alone(robot)
    found = _up_to_last_range(replace(own.until(int(np.max(own.ranges.tick, initial=0))), silent=()))
    return [one._replace(fit=one.fit.continued(own)) for one in found]


@lru_cache(maxsize=8)
def _up_to_last_range(own: JointMeasurements) -> tuple[Hypothesis, ...]:
    """Return the hypotheses about one robot's anchor up to the last range to it.

    A robot that has left its anchor has the same in each tick.
    """
    return hypotheses_of(fits(own, map(start_of, anchors(own))), own)


def of_anchor(before: Iterable[Hypothesis], own: JointMeasurements) -> tuple[Hypothesis, ...]:
    """Return the hypotheses about a robot's anchor in the frame of its odometry, in phase 1.

    `before` contains the hypotheses of the previous tick.
    """
    known = [one.fit.start for one in before]
    lost = any(len(one.ticks) and one.ticks[-1] == len(own.paths[0].v) for one in own.silent)
    enough = SEED_RANGES if own.noise.outliers else FOLLOWED_RANGES
    if known and len(own.ranges.rho) > enough and not lost:
        warm = Convergence(WARM_STEPS, COARSE_STILL, WARM_DECREASE)
        return hypotheses_of(fits(own, known, warm), own)
    starts = map(start_of, anchors(own, [(-one.poses[0, :2]).tolist() for one in known]))
    return hypotheses_of(fits(own, starts, Convergence(shortest=COARSE_STILL)), own)
