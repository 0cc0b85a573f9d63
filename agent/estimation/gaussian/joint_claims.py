"""The ranges that determine the pose of a robot among n, and the reasons why a robot has no pose."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from agent.estimation.elementary import eigh, hypot, product
from agent.estimation.facts import AnchorPlace
from agent.estimation.fit import Fit, Start, fits
from agent.estimation.gaussian.consistency import FINISHED
from agent.estimation.gaussian.joint_ranges import JointMeasurements, prior_of
from agent.estimation.gaussian.odometry_noise import Array, track
from agent.estimation.gaussian.search import FEWEST_DECISIVE, OPEN, beacons, position_sigma


class Displacement(NamedTuple):
    """The distance by which the ranges of an anchor favour another position than the stated one."""

    anchor: str
    vector: tuple[float, float]
    """The vector in m to the position that they favour."""
    sigmas: float
    """The length in sigmas."""
    open_along: tuple[float, float]
    """The direction, of length 1, in which they tell least about the position."""
    open_sigma: float
    """The standard deviation (m) of the position in this direction."""
    others: tuple[str, ...] = ()
    """The anchors of which one may stand elsewhere instead; see AS_LIKELY."""

    @property
    def what(self) -> str:
        """The displacement in words, with the anchors that may stand elsewhere instead."""
        away = f"by its ranges, {math.hypot(*self.vector):.2g} m from its position ({self.sigmas:.1f} sigmas)"
        return f"{away}; instead, it may be {' or '.join(self.others)}" if self.others else away

    def unverified(self, displaced: float) -> str:
        """Return a sentence if `displaced` m in that direction are less than DISPLACED_SIGMAS; else none."""
        if DISPLACED_SIGMAS * self.open_sigma < displaced:
            return ""
        x, y = self.open_along
        return f"no range tells whether it stands {displaced:.2g} m off along ({x:.2f}, {y:.2f}): " + (
            f"its position has a sigma of {self.open_sigma:.2g} m in that direction"
            if math.isfinite(self.open_sigma)
            else "too few ranges determine its position"
        )


DISPLACED_SIGMAS = 4.0
"""The distance, in sigmas, from which on an anchor stands elsewhere than stated.

Honest anchors of LIAS have at most 1.1 after 40 s, and one that is 0.6 m off has 4.3 to 6.1.
"""


AS_LIKELY = 2.0 * math.log(100.0)
"""The difference of squared sigmas up to which ranges do not tell which of two anchors stands elsewhere.

The likelihood ratio is 100. Of two anchors alone, only their distance is known to be wrong.
"""


def displacements(fit: Fit, used: JointMeasurements) -> Iterator[Displacement]:
    """Yield how far each anchor with a told position seems to stand elsewhere (Wald 1943).

    The position of each in turn is estimated as if it were not known: then its ranges are no strays, and do
    not raise the noise level. The length in sigmas is the lesser one by the covariance there and the misfit
    at the told position: where a few ranges admit two places, that covariance is small, too. An anchor
    without ranges is left out.
    """
    ends = [used.radios[one] for one in sorted(set(used.ranges.radio.tolist()))]
    for name in [one for one in used.anchors if one in used.robots or any(one in each for each in ends)]:
        measured, k, told = _estimating(name, used)
        if told.sigma == math.inf:
            continue
        poses, place, own = fit.start.poses, np.array((told.x, told.y)), slice(3 * k, 3 * k + 2)
        starts = poses if k < len(poses) else np.vstack((poses, (*place, 0.0)))
        for free in fits(measured, [Start(starts, fit.start.errors)]):
            away = free.poses[k, :2] - place
            variances, axes = eigh(free.covariance[own, own] + told.sigma**2 * np.eye(2))
            (x, y), along = away.tolist(), tuple(axes[:, 1].tolist())
            if free.last_step > FINISHED or not variances[0] > 0.0:
                yield Displacement(name, (x, y), 0.0, along, math.inf)
                continue
            square = float(np.sum(np.square(product(away[None], axes)[0]) / variances))
            sigmas = math.sqrt(max(min(square, _worse_at(place, k, free, measured)), 0.0))
            yield Displacement(name, (x, y), sigmas, along, math.sqrt(float(variances[1])))


def _worse_at(place: Array, k: int, fit: Fit, measured: JointMeasurements) -> float:
    """Return by how many squared sigmas ranges of anchor `k` fit worse at `place`, on the same paths."""
    rows = measured.ranges.rows(measured.ranges.second == k)
    residual, at = fit.residuals[measured.ranges.second == k], fit.paths[rows.first, rows.tick, :2]
    shorter = hypot(*(at - fit.poses[k, :2]).T) - hypot(*(at - place).T)
    worse = np.square(residual + shorter) - np.square(residual)
    return float(np.sum(worse / np.square(rows.sigma))) / fit.level


def displaced_anchor(tested: Iterable[Displacement]) -> Displacement | None:
    """Return that of the anchor which most seems to stand elsewhere; None if none does."""
    found = sorted(tested, key=lambda one: -one.sigmas)
    if not found or found[0].sigmas <= DISPLACED_SIGMAS:
        return None
    least = found[0].sigmas ** 2 - AS_LIKELY
    return found[0]._replace(others=tuple([one.anchor for one in found[1:] if one.sigmas**2 > least]))


def _estimating(name: str, used: JointMeasurements) -> tuple[JointMeasurements, int, AnchorPlace]:
    """Return the measurements as if an anchor were told to R only, its place in them, and what was told."""
    robots, ranges, n = used.robots, used.ranges, len(used.robots)
    surveyed = used.surveyed or (None,) * n
    k = robots.index(name) if name in robots else n
    told = surveyed[k] if k < n else None
    if told is None:
        radios = np.array([one for one, ends in enumerate(used.radios) if ends[1] == name])
        rows = np.isin(ranges.radio, radios) & (ranges.second < 0)
        told = AnchorPlace(*ranges.place[np.argmax(rows)].tolist())
        still = np.zeros(max([len(path.v) for path in used.paths]))
        ranges = replace(
            ranges, second=np.where(rows, k, ranges.second), place=np.where(rows[:, None], 0.0, ranges.place)
        )
        used = replace(
            used,
            robots=(*robots, name),
            ranges=ranges,
            paths=(*used.paths, track(still, still, used.period)),
            surveyed=(*surveyed, told),
        )
    size = len(used.robots)
    mean, information = np.zeros((size, 3)), np.zeros((3 * size, 3 * size))
    if used.prior is not None:
        mean[:n], information[: 3 * n, : 3 * n] = used.prior.mean, used.prior.information
    mean[k, :2] = told.x, told.y
    information[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = np.diag((used.reach**-2, used.reach**-2, 1.0))
    return replace(used, prior=prior_of(mean, information), solver=None), k, told


def decisive_ranges(robot: int, used: JointMeasurements) -> int:
    """Return the number of ranges of a robot from different places, if it has one anchor without those to it.

    Ranges to one anchor leave a circle. A range counts if one of the two ends has moved since the last. They
    are at most as many as connect it, by any way, with what determines the frame: robots that know all about
    each other, and have three ranges to all others, are where these three admit.
    """
    total, of_anchors = 0, []
    fixed = {-1, *used.placed, *used.started}
    left: dict[int, dict[int, int]] = {k: {} for k in (-1, *range(len(used.robots)))}
    for ends, count in used.places_of_pairs:
        if robot in ends:
            total += count
            of_anchors += [count] if ends[1] < 0 or used.is_anchor(ends[1]) else []
        a, b = [-1 if end in fixed else end for end in ends]
        left[a][b] = left[b][a] = left[a].get(b, 0) + count
    total -= sum(of_anchors) if len(of_anchors) == 1 else 0
    return total if robot in fixed else min(total, _most_flow(left, robot))


def _most_flow(left: dict[int, dict[int, int]], source: int) -> int:
    """Return the largest flow from `source` to -1 by what is `left` of each edge (Edmonds and Karp 1972)."""
    total = 0
    while True:
        before = {source: source}
        for node in (queue := [source]):
            new = [other for other, count in left[node].items() if count and other not in before]
            before.update(dict.fromkeys(new, node))
            queue += new
        if -1 not in before:
            return total
        path = [-1]
        while path[-1] != source:
            path.append(before[path[-1]])
        flow = min(left[a][b] for b, a in pairwise(path))
        for b, a in pairwise(path):
            left[a][b] -= flow
            left[b][a] += flow
        total += flow


def undetermined(robot: int, located: tuple[int, ...], measured: JointMeasurements) -> str:
    """Return why a robot that is not among those `located` has no pose."""
    measured = measured.as_surveyed
    ranges, linked = measured.ranges, _linked(robot, measured)
    anchored = (ranges.second < 0) & np.isin(ranges.first, linked)
    places = {tuple(one) for one in ranges.place[anchored].tolist()}
    others = [measured.robots[one] for one in linked if one != robot and not measured.is_anchor(one)]
    if measured.started and not set(measured.started) & set(linked) and len(places) < 2:
        origins = _listed([measured.robots[one] for one in measured.started])
        return f"no range connects it with {origins}, in whose frame poses are estimated"
    if not measured.started and len(places) < 2:
        with_others = (
            f"it and the robots with which it has ranges ({_listed(others)}) have" if others else "it has"
        )
        ranged = "ranges to one anchor" if places else "no range to an anchor"
        return f"{with_others} {ranged}; two at different places are needed"
    rows = beacons(robot, located, measured)
    if len(rows) < FEWEST_DECISIVE:
        beacon = "robots with a pose" if measured.started else "anchors and robots with a pose"
        return f"{len(rows)} of {FEWEST_DECISIVE} required ranges to {beacon}"
    if len(set(ranges.radio[rows].tolist())) < 2 and bool(np.all(ranges.second[rows] < 0)):
        return "its ranges are to one anchor, and to no robot with a pose"
    return "too few of its ranges are from different places, or no pose explains them"


def open_position(robot: int, fit: Fit, measured: JointMeasurements) -> str:
    """Return why a located robot has no pose: its ranges leave its position open; else an empty text.

    That of a robot whose start is known follows from its odometry, however uncertain.
    """
    sigma = position_sigma(fit, robot)
    if sigma <= OPEN * measured.reach or robot in measured.started:
        return ""
    how = f"to a sigma of {sigma:.3g} m" if math.isfinite(sigma) else "without a bound"
    return f"its ranges leave its position open {how}"


def _linked(robot: int, measured: JointMeasurements) -> list[int]:
    """Return the robots that are connected with `robot` by ranges, itself among them, ascending."""
    ranges, found, left = measured.ranges, {robot}, [robot]
    mutual = ranges.rows(ranges.second >= 0)
    while left:
        one = left.pop()
        others = {*mutual.second[mutual.first == one].tolist(), *mutual.first[mutual.second == one].tolist()}
        left += sorted(others - found)
        found |= others
    return sorted(found)


MOST_LISTED_RIVALS = 6
"""The largest number of robots that a reason names."""


def _listed(names: list[str]) -> str:
    more = len(names) - MOST_LISTED_RIVALS
    return ", ".join(names[:MOST_LISTED_RIVALS]) + (f" and {more} more" if more > 0 else "")
