"""The suspicion that parts of a recording are in different units, such as ranges in mm and odometry in m.

Over a part of its path, a robot's ranges to an anchor determine where the anchor is in the frame of the
odometry, and the factor between ranges and odometry. The places of two anchors in that frame give the factor
between ranges and positions of anchors. Nothing is converted: a user is told what the data suggest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np

from compose.recording.estimating.prepared_steps import levelled
from compose.recording.estimating.sound_odometry import at_antenna, sound
from compose.recording.ranging.range_recording import Numbers, Places, RangeRecording, locked
from compose.recording.ranging.range_steps import NEARLY_ALL, dead_reckoned, speeds

PART_S, PARTS_OF_PATH = 40.0, 3
"""The length in s of a part, in which odometry hardly drifts, and the largest number that are examined."""

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

SAME_FIT = 1e-3
"""The residuals below which fits do not differ, as a fraction of the ranges."""

SLOW_TURN = 0.5
"""The turn rate (rad/s) of nearly all motion below which turns are not suspected to be in degrees."""

UNITS = {1000.0: "mm", 100.0: "cm", 39.37: "inches", 3.281: "feet"}
"""The units that are suspected, by the number of them in a metre."""

NEAR_UNIT = 1.35
"""The largest factor between what is measured and the unit that is named."""

BEARINGS, STEPS = 8, 25
"""The number of bearings from which a fit begins, and that of its steps."""

DEGREES = "the turns of odometry agree with the ranges only as degrees: are they in degrees?"


@np.errstate(all="ignore")  # where numbers overflow, nothing is suspected
def doubtful_units(recording: RangeRecording) -> str:
    """Return which data of `recording` seem to be in another unit, and in which; an empty text if none do."""
    recording, robots = recording.with_places(), {}
    for robot in range(len(recording.robots)):
        if one := _of_robot(recording, robot):
            robots[recording.robots[robot].id] = one
    between = _between_robots(recording)
    if between and not any(one.doubt(1.0) for one in robots.values()):
        return between
    bound = _by_polygon(recording)
    doubts = {name: doubt for name, one in robots.items() if (doubt := one.doubt(bound))}
    factors = [one.odometry for one in robots.values()]
    alike = (
        len(set(doubts.values())) == 1 or max(factors, default=0.0) - min(factors, default=0.0) < LOG_ALIKE
    )
    if len(doubts) == len(robots) and alike:
        return _Factors.of_all(list(robots.values())).doubt(bound)
    return "; ".join(f"{name}: {doubt}" for name, doubt in doubts.items())


class _Factors(NamedTuple):
    """The factors between units that the ranges of robots to anchors tell."""

    degrees: bool
    """True if the turns of odometry are in degrees."""
    by_odometry: list[float]
    """The logarithms of the factors of ranges to odometry."""
    by_anchors: list[float]
    """The logarithms of the factors of ranges to positions of anchors."""

    @classmethod
    def of_all(cls, robots: list[_Factors]) -> _Factors:
        """Return what `robots` tell together."""
        return cls(
            any(one.degrees for one in robots),
            [factor for one in robots for factor in one.by_odometry],
            [factor for one in robots for factor in one.by_anchors],
        )

    @property
    def odometry(self) -> float:
        """The median of the logarithms of the factors of ranges to odometry.

        Odometry that slips, or has a gap, looks like any factor of the ranges to one anchor: alone, these
        tell only that of a unit.
        """
        if len(self.by_odometry) == 1 and not _near_unit(_factor(self.by_odometry[0])):
            return 0.0
        return float(np.median(self.by_odometry)) if self.by_odometry else 0.0

    def doubt(self, bound: float) -> str:
        """Return the suspicion; `bound` is that of `_by_polygon`."""
        if self.degrees:
            return DEGREES
        anchors = _factor(float(np.median(self.by_anchors))) if self.by_anchors else bound
        return _suspicion(_factor(self.odometry), anchors, bool(self.by_anchors))


def _of_robot(recording: RangeRecording, robot: int) -> _Factors | None:
    """Return what the ranges of one robot tell; None if it has not enough of them."""
    groups = list(_groups(recording, robot))
    fits = _fits(recording, robot, groups, 1.0)
    if not fits:
        return None
    degrees = 0
    if float(np.percentile(speeds(recording.robots[robot].odometry)[1], NEARLY_ALL)) > SLOW_TURN:
        converted = _fits(recording, robot, groups, math.pi / 180.0)
        degrees = sum(one.cost > DECISIVE * other.cost for one, other in zip(fits, converted, strict=True))
    by_anchors = []
    for one, other in combinations(fits, 2):
        apart = abs(one.anchor - other.anchor)
        if one.part == other.part and apart > 0.0:
            by_anchors.append(math.log(_to_anchors(one, other, apart)))
    return _Factors(2 * degrees > len(fits), [math.log(one.factor) for one in fits], by_anchors)


def _factor(logarithm: float) -> float:
    """Return the exponential of a logarithm; 1 if that is not a number."""
    return math.exp(min(max(-MOST_LOG, logarithm), MOST_LOG)) if math.isfinite(logarithm) else 1.0


def doubtful_lengths(lengths: Mapping[tuple[str, str], tuple[Numbers, Numbers]], others: str) -> str:
    """Return the suspicion that the ranges of some pairs of radios are in another unit than `others`.

    `lengths` has the measured and the true ranges of each pair, in m. An empty text if none are doubtful.
    """
    doubts = {pair: factor for pair, both in lengths.items() if (factor := _doubtful_factor(*both))}
    logarithms = [math.log(factor) for factor in doubts.values()]
    if len(doubts) == len(lengths) > 0 and max(logarithms) - min(logarithms) < LOG_ALIKE:
        return _sentence("ranges", math.exp(float(np.median(logarithms))), others)
    return "; ".join(
        _sentence(f"ranges of {' and '.join(pair)}", factor, others) for pair, factor in doubts.items()
    )


def _doubtful_factor(measured: Numbers, true: Numbers) -> float:
    """Return the factor of the ranges of a pair to true ones; 0 unless it explains them better than a bias.

    Where both explain them alike, as those of radios that stand, the difference decides.
    """
    length, off = float(np.median(measured)), measured - true
    factor = max(length, TINY) / max(float(np.median(true)), TINY)
    if max(factor, 1.0 / factor) <= LEAST_FACTOR:
        return 0.0
    bias = float(np.median(off))
    by_bias = float(np.median(np.abs(off - bias))) + SAME_FIT * length
    by_factor = float(np.median(np.abs(measured - factor * true))) + SAME_FIT * length
    decided = by_bias > DECISIVE * by_factor
    return factor if decided or (abs(bias) > MOST_BIAS and by_factor < DECISIVE * by_bias) else 0.0


MOST_BIAS = 10.0
"""The largest bias in m that is taken for one of radios at any distance.

It is thirty times that of UWB radios. If ranges are all alike, a factor may explain a larger one."""


def _suspicion(by_odometry: float, by_anchors: float, located: bool) -> str:
    """Return the sentence for the factors of ranges to odometry, and of ranges to positions of anchors.

    `located` is true if the second is measured; otherwise it is 1, or a bound.
    """
    doubtful = [max(one, 1.0 / one) > LEAST_FACTOR for one in (by_odometry, by_anchors)]
    if doubtful == [True, True] and (by_odometry > 1.0) == (by_anchors > 1.0):
        return _sentence("ranges", by_odometry, "odometry and anchors")
    if doubtful == [True, False] and by_odometry > 1.0 and not located:
        return _sentence("ranges", by_odometry, "odometry")
    if doubtful[0]:
        return _sentence("odometry", 1.0 / by_odometry, "ranges and anchors" if located else "ranges")
    if doubtful[1]:
        return _sentence("positions of anchors", 1.0 / by_anchors, "ranges and odometry")
    return ""


def _sentence(subject: str, factor: float, others: str, near_unit: float = NEAR_UNIT) -> str:
    """Return the sentence that `subject` is `factor` times what `others` allow."""
    unit = _near_unit(factor, near_unit)
    number = unit or float(f"{max(factor, 1.0 / factor):.2g}")
    many = f"{round(number, 1 if number < 10.0 else 0):,.15g}".replace(",", " ")
    name = UNITS[unit] if unit else "another unit"
    verb, allow = "is" if subject == "odometry" else "are", "allows" if others == "odometry" else "allow"
    if factor > 1.0:
        pronoun = "it" if subject == "odometry" else "they"
        return f"{subject} {verb} about {many} times what {others} {allow}: {verb} {pronoun} in {name}?"
    doubted = "is" if others == "odometry" else "are"
    return f"{subject} {verb} about 1/{many} of what {others} {allow}: {doubted} {others} in {name}?"


def _near_unit(factor: float, near_unit: float = NEAR_UNIT) -> float:
    """Return the number of units in a metre that is near a factor or its inverse; 0 if there is none."""
    ratio = max(factor, 1.0 / factor)
    unit = min(UNITS, key=lambda one: abs(math.log(ratio / one)))
    return unit if max(ratio / unit, unit / ratio) < near_unit else 0.0


# --- the ranges of one robot to one anchor ------------------------------------------------------------------


class _Group(NamedTuple):
    """Some ranges of a robot to one anchor within a part of its path."""

    part: int
    anchor: complex
    """The position of the anchor in m."""
    t: Numbers
    rho: Numbers


class _Fit(NamedTuple):
    """The place of an anchor in the frame of the odometry, by the ranges of a group."""

    part: int
    anchor: complex
    path: Numbers
    """The places of the robot at the ranges, as complex numbers."""
    rho: Numbers
    factor: float
    """The factor of ranges to odometry; 1 unless the ranges decide that it is another."""
    place: complex
    cost: float
    """The mean absolute residual, in the unit of ranges, and the rounding."""


def _groups(recording: RangeRecording, robot: int) -> Iterator[_Group]:
    """Yield the ranges of `robot` in at most PARTS_OF_PATH parts of its path."""
    ranges, base, own = recording.ranges, len(recording.robots), recording.robots[robot]
    if not len(own.odometry.t0):
        return
    begin, end = float(own.odometry.t0[0]), float(own.odometry.t1[-1])
    rows = np.flatnonzero((ranges.first == robot) & (ranges.second >= base))
    starts = np.linspace(
        begin, max(end - PART_S, begin), PARTS_OF_PATH if end - begin > PARTS_OF_PATH * PART_S else 1
    )
    for part, start in enumerate(starts.tolist()):
        inside = rows[(ranges.t[rows] >= start) & (ranges.t[rows] <= min(start + PART_S, end))]
        counts = np.bincount(ranges.second[inside] - base, minlength=len(recording.anchors))
        for k in np.argsort(-counts, kind="stable")[:MOST_EXAMINED_ANCHORS].tolist():
            if counts[k] < FEWEST:
                continue
            some: Places = inside[ranges.second[inside] == base + k]
            some = some[np.unique(np.linspace(0, len(some) - 1, MOST).astype(np.intp))]
            anchor = recording.anchors[k]
            rho = levelled(ranges.range[some], np.full(len(some), own.antenna[2] - anchor.height))[0]
            yield _Group(part, complex(anchor.x, anchor.y), ranges.t[some], rho)


def _fits(recording: RangeRecording, robot: int, groups: list[_Group], turn_unit: float) -> list[_Fit]:
    """Return the fits of `groups` with the turns of odometry multiplied by `turn_unit`."""
    if not groups:
        return []
    own = recording.robots[robot]
    increments = own.odometry.increments * np.array((1.0, 1.0, turn_unit))
    odometry = sound(own.odometry._replace(increments=locked(increments))).odometry
    at = dead_reckoned(at_antenna(odometry, *own.antenna[:2]), np.concatenate([one.t for one in groups]))
    ends = np.cumsum([len(one.t) for one in groups])[:-1]
    paths = np.split(at[:, 0] + 1j * at[:, 1], ends)
    return [_fit(one, path) for one, path in zip(groups, paths, strict=True)]


def _fit(group: _Group, path: Numbers) -> _Fit:
    """Return the fit of a group whose robot is at `path`, complex numbers, in the frame of the odometry."""
    half, rho, usual = len(path) // 2, group.rho, float(np.mean(group.rho))
    moved, change = np.abs(path[half:] - path[:-half]), np.abs(rho[half:] - rho[:-half])
    slope = _factor(math.log(max(TINY, float(np.sum(change)))) - math.log(max(TINY, float(np.sum(moved)))))
    plain, plain_cost = _least(partial(_ranges_to_one, path), _around(path, usual), rho)
    starts = [
        np.insert(_around(path, usual / scale), 2, math.log(scale), 1)
        for scale in (1.0, slope, 2.0 * slope, 4.0 * slope)
    ]
    free, free_cost = _least(partial(_ranges_to_one, path), np.concatenate(starts), rho)
    factor = _factor(float(free[2]))
    if plain_cost > DECISIVE * free_cost and max(factor, 1.0 / factor) > LEAST_FACTOR:
        return _Fit(group.part, group.anchor, path, rho, factor, complex(free[0], free[1]), free_cost)
    return _Fit(group.part, group.anchor, path, rho, 1.0, complex(plain[0], plain[1]), plain_cost)


def _to_anchors(one: _Fit, other: _Fit, apart: float) -> float:
    """Return the factor of ranges to positions of anchors; 1 unless the ranges decide that it is another.

    The two anchors are `apart` by their positions.
    """
    scale = math.sqrt(one.factor * other.factor)
    found = max(TINY, scale * abs(one.place - other.place) / apart)
    if max(found, 1.0 / found) <= LEAST_FACTOR:
        return 1.0
    around = _around(one.path, float(np.mean(one.rho)) / scale)
    turns = math.tau * np.arange(BEARINGS) / BEARINGS
    starts = np.column_stack((np.repeat(around, BEARINGS, 0), np.tile(turns, BEARINGS)))
    model = partial(_ranges_to_two, one.path, other.path, scale, apart)
    _, cost = _least(model, starts, np.concatenate((one.rho, other.rho)))
    return found if cost > DECISIVE * max(one.cost, other.cost) else 1.0


def _around(path: Numbers, distance: float) -> Numbers:
    """Return the places at `distance` from the middle of `path` in all BEARINGS; shape (n, 2)."""
    places = np.mean(path) + distance * np.exp(2j * math.pi * np.arange(BEARINGS) / BEARINGS)
    return np.stack((places.real, places.imag), 1)


_Model = Callable[[Numbers], tuple[Numbers, Numbers]]
"""The predicted ranges, (n, N), for n starts, (n, unknowns), and their derivatives, (n, N, unknowns)."""


def _ranges_to_one(path: Numbers, unknowns: Numbers) -> tuple[Numbers, Numbers]:
    """Return the ranges to an anchor at x and y, multiplied by the exponential of a third unknown."""
    away = path - unknowns[:, :1] - 1j * unknowns[:, 1:2]
    scale = np.exp(np.clip(unknowns[:, 2:], -MOST_LOG, MOST_LOG)) if unknowns.shape[1] == 3 else 1.0
    distance = np.maximum(np.abs(away), TINY)
    columns = [-scale * away.real / distance, -scale * away.imag / distance, scale * distance]
    return columns[2], np.stack(columns[: unknowns.shape[1]], 2)


def _ranges_to_two(
    path: Numbers, other: Numbers, scale: float, apart: float, unknowns: Numbers
) -> tuple[Numbers, Numbers]:
    """Return the ranges from `path` to an anchor, and from `other` to one `apart` from it in a direction."""
    first, jacobian = _ranges_to_one(path, unknowns[:, :2])
    vector = apart / scale * np.exp(1j * unknowns[:, 2:])
    moved = np.stack((unknowns[:, 0] + vector[:, 0].real, unknowns[:, 1] + vector[:, 0].imag), 1)
    second, more = _ranges_to_one(other, moved)
    turned = more[..., 0] * -vector.imag + more[..., 1] * vector.real
    by_turn = np.concatenate((np.zeros_like(first), turned), 1)[..., None]
    both = np.concatenate((np.concatenate((jacobian, more), 1), by_turn), 2)
    return scale * np.concatenate((first, second), 1), scale * both


def _least(model: _Model, unknowns: Numbers, rho: Numbers) -> tuple[Numbers, float]:
    """Return the unknowns that explain the ranges `rho` best, and their cost (see `_Fit`)."""
    usual = max(float(np.mean(rho)), TINY)
    for _ in range(STEPS):
        predicted, jacobian = model(unknowns)
        residuals = rho - predicted
        width = 2.0 * np.median(np.abs(residuals), 1, keepdims=True) + SAME_FIT * usual
        weighted = (jacobian / (1.0 + np.square(residuals / width))[..., None]).mT
        information = weighted @ jacobian
        diagonal = np.einsum("...ii->...i", information)
        diagonal += DAMPING * diagonal + TINY
        change = np.linalg.solve(information, weighted @ residuals[..., None])[..., 0]
        effect = np.sqrt(np.mean(np.square(jacobian), 1)) * np.abs(change) / (LONGEST_STEP * usual)
        unknowns = unknowns + change / np.maximum(np.max(effect, 1, keepdims=True), 1.0)
    cost = np.mean(np.abs(rho - model(unknowns)[0]), 1)
    best = int(np.argmin(cost))
    return unknowns[best], float(cost[best]) + SAME_FIT * usual


DAMPING, LONGEST_STEP = 1e-3, 0.5
"""The damping of a step, as a fraction of the information, and its longest effect, as one of the ranges."""

TINY, MOST_LOG = 1e-12, 20.0
"""The least length in m, and the largest logarithm of a factor."""


# --- ranges between robots ----------------------------------------------------------------------------------


class _Polygon(NamedTuple):
    """Two robots beside one anchor each: the corners of a polygon.

    No side is longer than all others together.
    """

    pair: tuple[str, str]
    """The names of the robots."""
    apart: float
    """The distance in m of the anchors by their positions."""
    lengths: Numbers
    """Ranges between the robots, and at those times of each to its anchor, in m; shape (3, N)."""


def _polygons(recording: RangeRecording) -> Iterator[_Polygon]:
    """Yield a polygon of each pair of robots with that anchor of each that has the most ranges."""
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
            yield _Polygon((a, b), apart, np.stack(sides)[:, together])


def _by_polygon(recording: RangeRecording) -> float:
    """Return a bound on the factor of ranges to positions of anchors; 1 if all polygons close."""
    for _, apart, lengths in _polygons(recording):
        whole = float(np.median(np.sum(lengths, 0)))
        excess = float(np.median(2.0 * np.max(lengths, 0) - np.sum(lengths, 0)))
        if apart > LEAST_FACTOR * whole > 0.0:
            return max(TINY, whole / apart)
        if excess > LEAST_FACTOR * apart > 0.0:
            return excess / apart
    return 1.0


def _between_robots(recording: RangeRecording) -> str:
    """Return the suspicion that ranges between two robots are in a larger or a smaller unit than all others.

    It takes that the ranges to anchors, and the positions of these, are right.
    """
    doubts = []
    for (a, b), apart, lengths in _polygons(recording):
        between, first, second = lengths
        most = first + second + apart
        least = 2.0 * np.maximum(np.maximum(first, second), apart) - most
        if (
            max(np.median(between - LEAST_FACTOR * most), np.median(least - LEAST_FACTOR * between))
            > LEAST_GAP
        ):
            usual = np.sqrt(np.square(first) + np.square(second) + apart**2)
            factor = float(np.median(np.maximum(between, TINY) / np.maximum(usual, TINY)))
            doubts.append(
                _sentence(f"ranges of {a} and {b}", factor, "ranges to anchors", NEAR_UNIT_OF_USUAL)
            )
    return "; ".join(doubts)


NEAR_UNIT_OF_USUAL = 3.0
"""As NEAR_UNIT, for a factor to the usual distance of two robots, which is about as far from the true one."""

LEAST_GAP = 1.0
"""The length in m by which ranges between robots must be off: below it, motion and biases count."""

SAME_PLACE_S = 1.0
"""The time in s between two ranges in which a robot hardly moves."""
