"""The suspicion that parts of a recording are in different units, such as ranges in mm and odometry in m.

Over a part of its path, a robot's ranges to an anchor determine where the anchor is in the frame of the
odometry, and the factor between ranges and odometry. The places of two anchors in that frame give the factor
between ranges and positions of anchors; those of three tell left from right. Nothing is converted: a user is
told what the data suggest.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from compose.recording.estimating.sound_odometry import at_antenna, levelled, sound
from compose.recording.ranging.range_recording import Numbers, RangeRecording, locked
from compose.recording.ranging.range_steps import NEARLY_ALL, dead_reckoned, speeds

PART_S, PARTS_OF_PATH = 40.0, 3
"""The length in s of a part, in which odometry errors are small, and the largest number that are examined."""

FEWEST, MOST = 8, 48
"""The least number of ranges of a robot to an anchor in a part, and the largest that is used."""

MOST_EXAMINED_ANCHORS = 3
"""The largest number of anchors of a robot that are examined in a part: those with the most ranges."""

LEAST_FACTOR = 2.5
"""The least factor that is suspicious: a foot is 0.3 m.

With 2, a window of 10 s of a real recording whose odometry slips was suspected; with more, feet would not be.
"""

LOG_ALIKE = math.log(LEAST_FACTOR)
"""The difference of the logarithms of two robots' factors below which they are of one unit."""

DECISIVE = 3.0
"""The factor by which another unit must reduce the residuals.

With less, noise and slip would be taken for units; with more, robots that hardly move would be let pass."""

MIRRORED = 2.0
"""The factor by which exchanging left and right must reduce the residuals.

In windows of real recordings, it reduces them by up to 1.27, where a robot drives nearly straight.
"""

SAME_FIT = 1e-3
"""The residuals below which fits do not differ, as a fraction of the ranges."""

SLOW_TURN = 0.5
"""The turn rate (rad/s) of nearly all motion below which turns are not suspected to be in degrees."""

UNITS = {1000.0: "mm", 100.0: "cm", 39.37: "inches", 3.281: "feet"}
"""The units that are suspected, by the number of them in a metre."""

NEAR_UNIT, NEAR_UNIT_OF_USUAL = 1.35, 3.0
"""The largest factor between what is measured and the unit that is named; if it is measured against the usual
distance of two robots, which is about as far from the true one."""

LEAST_GAP, SAME_PLACE_S = 0.1, 1.0
"""The part of the longest other side by which ranges between robots must be off: below it, motion and biases
count; and the time in s between two ranges in which a robot hardly moves."""

BEARINGS, STEPS = 8, 25
"""The number of bearings from which a fit begins, and that of its steps."""

DAMPING, LONGEST_STEP = 1e-3, 0.5
"""The damping of a step, as a fraction of the information, and its longest effect, as one of the ranges."""

TINY, MOST_LOG = 1e-12, 20.0
"""The least length in m, and the largest logarithm of a factor."""


@np.errstate(all="ignore")  # where numbers overflow, nothing is suspected
def doubtful_units(recording: RangeRecording) -> str:
    """Return which data of `recording` seem to be in another unit, and in which; an empty text if none do."""
    recording = recording.with_places()
    names = [one.id for one in recording.robots]
    robots = {name: one for i, name in enumerate(names) if (one := _of_robot(recording, i))}
    between, bound = _between_robots(recording)
    if between and not any(_doubt([one], 1.0) for one in robots.values()):
        return between
    doubts = {name: doubt for name, one in robots.items() if (doubt := _doubt([one], bound))}
    factors = [_by_odometry([one]) for one in robots.values()]
    alike = max(factors, default=0.0) - min(factors, default=0.0) < LOG_ALIKE
    if len(doubts) == len(robots) and (alike or len(set(doubts.values())) == 1):
        return _doubt(list(robots.values()), bound)
    return "; ".join(f"{name}: {doubt}" for name, doubt in doubts.items())


class _Factors(NamedTuple):
    """The logarithms of the factors between units that the ranges of a robot to anchors tell."""

    degrees: bool
    """True if the turns of odometry are in degrees."""
    clockwise: bool
    """True if they are clockwise: three anchors are mirrored in the frame of the odometry."""
    by_odometry: list[float]
    """The logarithms of the factors of ranges to odometry."""
    by_anchors: list[float]
    """The logarithms of the factors of ranges to positions of anchors."""


def _by_odometry(robots: Sequence[_Factors]) -> float:
    """Return the median of the logarithms of the factors of ranges to odometry.

    Odometry that slips, or has a gap, looks like any factor of the ranges to one anchor: alone, these tell
    only that of a unit.
    """
    factors = [factor for one in robots for factor in one.by_odometry]
    if not factors or (len(factors) == 1 and not _near_unit(_factor(factors[0]), NEAR_UNIT)):
        return 0.0
    return float(np.median(factors))


def _doubt(robots: Sequence[_Factors], bound: float) -> str:
    """Return the suspicion that `robots` tell together.

    `bound` is that on the factor of ranges to positions of anchors, if none of them tells it.
    """
    if any(one.degrees for one in robots):
        return "the turns of odometry agree with the ranges only as degrees: are they in degrees?"
    if any(one.clockwise for one in robots):
        return "odometry and ranges agree only if left and right are exchanged: are turns clockwise?"
    located = [factor for one in robots for factor in one.by_anchors]
    by_odometry = _factor(_by_odometry(robots))
    by_anchors = _factor(float(np.median(located))) if located else bound
    match [max(one, 1.0 / one) > LEAST_FACTOR for one in (by_odometry, by_anchors)]:
        case [True, True] if (by_odometry > 1.0) == (by_anchors > 1.0):
            return _sentence("ranges", by_odometry, "odometry and anchors")
        case [True, False] if by_odometry > 1.0 and not located:
            return _sentence("ranges", by_odometry, "odometry")
        case [True, _]:
            return _sentence("odometry", 1.0 / by_odometry, "ranges and anchors" if located else "ranges")
        case [False, True]:
            return _sentence("positions of anchors", 1.0 / by_anchors, "ranges and odometry")
    return ""


def _sentence(subject: str, factor: float, others: str, near: float = NEAR_UNIT) -> str:
    """Return the sentence that `subject` is `factor` times what `others` allow."""
    unit = _near_unit(factor, near)
    number = unit or float(f"{max(factor, 1.0 / factor):.2g}")
    many = f"{round(number, 1 if number < 10.0 else 0):,.15g}".replace(",", " ")
    verb, pronoun = ("is", "it") if subject == "odometry" else ("are", "they")
    their_verb, allow = ("is", "allows") if others == "odometry" else ("are", "allow")
    times = f"{many} times" if factor > 1.0 else f"1/{many} of"
    asked = f"{verb} {pronoun}" if factor > 1.0 else f"{their_verb} {others}"
    name = UNITS.get(unit, "another unit")
    return f"{subject} {verb} about {times} what {others} {allow}: {asked} in {name}?"


def _near_unit(factor: float, near: float) -> float:
    """Return the number of units in a metre that is near a factor or its inverse; 0 if there is none."""
    ratio = max(factor, 1.0 / factor)
    unit = min(UNITS, key=lambda one: abs(math.log(ratio / one)))
    return unit if max(ratio / unit, unit / ratio) < near else 0.0


def _factor(logarithm: float) -> float:
    """Return the exponential of a logarithm; 1 if that is not a number."""
    return math.exp(min(max(-MOST_LOG, logarithm), MOST_LOG)) if math.isfinite(logarithm) else 1.0


# --- the ranges of one robot to its anchors -----------------------------------------------------------------


class _Group(NamedTuple):
    """Some ranges of a robot to one anchor within a part of its path, and their fit."""

    part: int
    anchor: complex
    """The position of the anchor in m."""
    t: Numbers
    rho: Numbers
    path: Numbers
    """The places of the robot at the ranges, in the frame of the odometry, as complex numbers."""
    factor: float = 1.0
    """The factor of ranges to odometry; 1 unless the ranges decide that it is another."""
    place: complex = 0j
    """The place of the anchor in the frame of the odometry."""
    cost: float = 0.0
    """The mean absolute residual, in the unit of ranges, and the rounding."""


def _of_robot(recording: RangeRecording, robot: int) -> _Factors | None:
    """Return what the ranges of one robot tell; None if it has not enough of them."""
    odometry = recording.robots[robot].odometry
    fits = list(map(_fitted, _groups(recording, robot, 1.0)))
    if not fits:
        return None
    degrees = 0
    if float(np.percentile(speeds(odometry)[1], NEARLY_ALL)) > SLOW_TURN:
        converted = map(_fitted, _groups(recording, robot, math.pi / 180.0))
        degrees = sum(one.cost > DECISIVE * other.cost for one, other in zip(fits, converted, strict=True))
    by_anchors = [
        math.log(_to_anchors(one, other))
        for one, other in combinations(fits, 2)
        if one.part == other.part and one.anchor != other.anchor
    ]
    triples = [three for three in combinations(fits, 3) if len({one.part for one in three}) == 1]
    mirrored = [_is_mirrored(*three) for three in triples]
    clockwise = 2 * sum(mirrored) > len(mirrored)
    return _Factors(2 * degrees > len(fits), clockwise, [math.log(one.factor) for one in fits], by_anchors)


def _is_mirrored(*three: _Group) -> bool:
    """Return whether the ranges to three anchors decide that the path is the mirror image of the true one."""
    path, rho = np.concatenate([one.path for one in three]), np.concatenate([one.rho for one in three])
    lever = np.concatenate([np.full(len(one.path), one.anchor - three[0].anchor) for one in three])
    turns = np.arange(0.0, math.tau, math.tau / BEARINGS).tolist()

    def cost(path: Numbers) -> float:
        starts = _starts(path[: len(three[0].path)], three[0].rho, turns=turns)
        return _least(path, lever, rho, starts, [0, 1, 2])[1]

    alone = np.average([one.cost for one in three], weights=[len(one.path) for one in three])
    told = cost(path)  # the mirror image cannot fit better than each anchor for itself
    return bool(told > MIRRORED * alone and told > MIRRORED * cost(np.conj(path)))


def _groups(recording: RangeRecording, robot: int, turn_unit: float) -> Iterator[_Group]:
    """Yield the ranges of `robot` in at most PARTS_OF_PATH parts of its path.

    The turns of its odometry are multiplied by `turn_unit`.
    """
    ranges, base, own = recording.ranges, len(recording.robots), recording.robots[robot]
    if not len(own.odometry.t0):
        return
    increments = own.odometry.increments * np.array((1.0, 1.0, turn_unit))
    odometry = sound(own.odometry._replace(increments=locked(increments))).odometry
    odometry = at_antenna(odometry, *own.antenna[:2])
    begin, end = float(own.odometry.t0[0]), float(own.odometry.t1[-1])
    rows = np.flatnonzero((ranges.first == robot) & (ranges.second >= base))
    count = PARTS_OF_PATH if end - begin > PARTS_OF_PATH * PART_S else 1
    for part, start in enumerate(np.linspace(begin, max(end - PART_S, begin), count).tolist()):
        inside = rows[(ranges.t[rows] >= start) & (ranges.t[rows] <= min(start + PART_S, end))]
        counts = np.bincount(ranges.second[inside] - base, minlength=len(recording.anchors))
        for k in np.argsort(-counts, kind="stable")[:MOST_EXAMINED_ANCHORS].tolist():
            if counts[k] < FEWEST:
                continue
            some, anchor = inside[ranges.second[inside] == base + k], recording.anchors[k]
            some = some[np.unique(np.linspace(0, len(some) - 1, MOST).astype(np.intp))]
            rho = levelled(ranges.range[some], np.full(len(some), own.antenna[2] - anchor.height))[0]
            at = dead_reckoned(odometry, ranges.t[some])
            yield _Group(part, complex(anchor.x, anchor.y), ranges.t[some], rho, at[:, 0] + 1j * at[:, 1])


def _fitted(group: _Group) -> _Group:
    """Return `group` with its fit."""
    path, rho, half = group.path, group.rho, len(group.path) // 2
    moved, change = np.abs(path[half:] - path[:-half]), np.abs(rho[half:] - rho[:-half])
    slope = _factor(math.log(max(TINY, float(np.sum(change)))) - math.log(max(TINY, float(np.sum(moved)))))
    scales = (1.0, slope, 2.0 * slope, 4.0 * slope)
    plain, cost = _least(path, 0.0, rho, _starts(path, rho), [0, 1])
    free, free_cost = _least(path, 0.0, rho, _starts(path, rho, scales), [0, 1, 3])
    factor = _factor(float(free[3]))
    if cost > DECISIVE * free_cost and max(factor, 1.0 / factor) > LEAST_FACTOR:
        return group._replace(factor=factor, place=complex(free[0], free[1]), cost=free_cost)
    return group._replace(place=complex(plain[0], plain[1]), cost=cost)


def _to_anchors(one: _Group, other: _Group) -> float:
    """Return the factor of ranges to positions of two anchors; 1 unless the ranges decide it is another."""
    scale, apart = math.sqrt(one.factor * other.factor), abs(one.anchor - other.anchor)
    found = max(TINY, scale * abs(one.place - other.place) / apart)
    if max(found, 1.0 / found) <= LEAST_FACTOR:
        return 1.0
    starts = _starts(one.path, one.rho, (scale,), np.arange(0.0, math.tau, math.tau / BEARINGS).tolist())
    lever = np.repeat((0.0, apart / scale), (len(one.path), len(other.path)))
    both = np.concatenate((one.path, other.path)), lever, np.concatenate((one.rho, other.rho))
    _, cost = _least(*both, starts, [0, 1, 2])
    return found if cost > DECISIVE * max(one.cost, other.cost) else 1.0


def _starts(
    path: Numbers, rho: Numbers, scales: Sequence[float] = (1.0,), turns: Sequence[float] = (0.0,)
) -> Numbers:
    """Return the unknowns of `_least` at the usual distance from the middle of `path`, in all BEARINGS."""
    bearings = np.exp(2j * math.pi * np.arange(BEARINGS) / BEARINGS)
    around = [(scale, np.mean(path) + np.mean(rho) / scale * bearings) for scale in scales]
    rows = [(at.real, at.imag, turn, math.log(scale)) for scale, at in around for at in at for turn in turns]
    return np.array(rows)


def _least(
    path: Numbers, lever: Numbers | float, rho: Numbers, unknowns: Numbers, free: list[int]
) -> tuple[Numbers, float]:
    """Return the unknowns that explain the ranges `rho` from `path` best, and their cost (see `_Group`).

    They are x and y of an anchor, the direction in which another is `lever` (m) from it, which ranges with a
    lever are to, and the logarithm of the factor of all ranges; shape (n, 4), of n starts. Those in `free`
    are varied. Levers to several anchors are complex: their directions are relative to a common one.
    """
    usual = max(float(np.mean(rho)), TINY)
    for step in range(STEPS + 1):
        x, y, turn, logarithm = unknowns.T[..., None]
        arm, scale = lever * np.exp(1j * turn), np.exp(np.clip(logarithm, -MOST_LOG, MOST_LOG))
        away = path - x - 1j * y - arm
        predicted = scale * np.maximum(np.abs(away), TINY)
        residuals = rho - predicted
        if step == STEPS:
            break
        unit = scale * away / np.maximum(np.abs(away), TINY)
        by_turn = np.imag(np.conj(unit) * arm)
        jacobian = np.stack((-unit.real, -unit.imag, by_turn, predicted), 2)[:, :, free]
        width = 2.0 * np.median(np.abs(residuals), 1, keepdims=True) + SAME_FIT * usual
        weighted = (jacobian / (1.0 + np.square(residuals / width))[..., None]).mT
        information = weighted @ jacobian
        diagonal = np.einsum("...ii->...i", information)
        diagonal += DAMPING * diagonal + TINY
        change = np.linalg.solve(information, weighted @ residuals[..., None])[..., 0]
        effect = np.sqrt(np.mean(np.square(jacobian), 1)) * np.abs(change) / (LONGEST_STEP * usual)
        unknowns[:, free] += change / np.maximum(np.max(effect, 1, keepdims=True), 1.0)
    cost = np.mean(np.abs(residuals), 1)
    best = int(np.argmin(cost))
    return unknowns[best], float(cost[best]) + SAME_FIT * usual


# --- ranges between robots ----------------------------------------------------------------------------------


def _polygons(recording: RangeRecording) -> Iterator[tuple[tuple[str, str], float, Numbers]]:
    """Yield the polygons of two robots beside one anchor each: no side is longer than all others together.

    Each has the names of the robots, the distance (m) of those of their anchors that have the most ranges,
    and the ranges (m) between the robots, and at those times of each to its anchor; shape (3, N).
    """
    pairs, ranges = recording.pairs(), recording.ranges
    anchors = {one.id: np.array((one.x, one.y, one.height)) for one in recording.anchors}
    most = {pair[0]: pair[1] for pair in sorted(pairs, key=lambda one: len(pairs[one])) if pair[1] in anchors}
    for (a, b), rows in pairs.items():
        if a not in most or b not in most:
            continue
        sides, together = [ranges.range[rows]], np.ones(len(rows), bool)
        for robot in (a, b):
            own = pairs[robot, most[robot]]
            after = np.clip(np.searchsorted(ranges.t[own], ranges.t[rows]), 1, max(len(own) - 1, 1))
            nearest = own[np.minimum(after, len(own) - 1)]
            together &= np.abs(ranges.t[nearest] - ranges.t[rows]) <= SAME_PLACE_S
            sides.append(ranges.range[nearest])
        if np.count_nonzero(together) >= FEWEST:
            apart = float(np.linalg.norm(anchors[most[a]] - anchors[most[b]]))
            yield (a, b), apart, np.stack(sides)[:, together]


def _between_robots(recording: RangeRecording) -> tuple[str, float]:
    """Return what the ranges between robots tell.

    First, the suspicion that those of two robots are in a larger or a smaller unit than all others, if ranges
    to anchors and the positions of these are right; then, a bound on the factor of ranges to positions of
    anchors, which is 1 if all polygons close.
    """
    doubts, bounds = [], []
    for pair, apart, lengths in _polygons(recording):
        whole = float(np.median(np.sum(lengths, 0)))
        excess = float(np.median(2.0 * np.max(lengths, 0) - np.sum(lengths, 0)))
        if apart > LEAST_FACTOR * whole > 0.0:
            bounds.append(max(TINY, whole / apart))
        elif excess > LEAST_FACTOR * apart > 0.0:
            bounds.append(excess / apart)
        between, others = lengths[0], np.stack((*lengths[1:], np.full(lengths.shape[1], apart)))
        most, usual = np.sum(others, 0), np.sqrt(np.sum(np.square(others), 0))
        least = 2.0 * (longest := np.max(others, 0)) - most
        off = np.median(between - LEAST_FACTOR * most), np.median(least - LEAST_FACTOR * between)
        if max(off) > LEAST_GAP * np.median(longest):
            factor = float(np.median(np.maximum(between, TINY) / np.maximum(usual, TINY)))
            who = f"ranges of {' and '.join(pair)}"
            doubts.append(_sentence(who, factor, "ranges to anchors", NEAR_UNIT_OF_USUAL))
    return "; ".join(doubts), bounds[0] if bounds else 1.0
