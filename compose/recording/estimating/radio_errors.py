"""The errors of recorded ranges by pair of radios: against the true distances, or against a fit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian.range_weights import MEDIAN
from compose.recording.estimating.true_poses import true_antenna, true_pose, with_bridged_truth
from compose.recording.ranging.range_recording import Numbers, Places, RangeRecording

OUTLIER_SIGMAS = 4.0
"""The distance from the line, in sigmas, from which on an error is an outlier.

A Gaussian error is so far off once in 16 000. With less, honest errors become outliers; with more, outliers
make the sigma larger.
"""

STRAY_SIGMAS = 20.0
"""The distance from the median, in sigmas, from which on an error has no part in the first line.

With less, the errors of radios with a scale would be left out; with more, strays would turn the line."""

ROUNDS = 20
"""The largest number of rounds in which outliers are found. Most recordings need five."""

FEWEST_ERRORS = 8
"""The least number of ranges of a pair from which its errors are determined."""

LEAST_SPREAD, LEAST_RANGE_SIGMA = 0.5, 1e-4
"""The least spread (m, one sigma) of a pair's ranges from which its own scale follows, and the least sigma of
ranges in m."""

SCALE_PRIOR = 0.05
"""The prior of the common scale: ranges of one length do not tell it from a bias."""

TOLD_SCALE = 0.5 * SCALE_PRIOR
"""The largest sigma of a scale that is told from a bias. With more, most of it would be the prior."""

SLOW_LAG_S = 1.0
"""The least lag in s at which the correlation of errors is measured; of rare ranges, it is their interval.

Errors within a second are correlated by 0.2 to 0.7 on UWB radios, white ones are not.
"""

SLOW_TIME = 2.0
"""The least time, in such lags, in which the correlation is taken to fall to 1 / e.

With less, the slow part at no lag would be extrapolated from noise."""

LAG_SHARE, MOST_SLOW = 0.25, 0.8
"""The tolerance of the lag, as a fraction, and the largest part of the variance that is slow."""

FAINT = 0.05
"""The least correlation from which the time follows, as a fraction of that at the first lag."""

MOST_BIAS, MOST_BIAS_SHARE, MOST_SCALE = 10.0, 0.25, 0.25
"""The largest bias in m and as a fraction of the longest range, and the largest scale that are taken for a
radio's.

Radios and sonars without any calibration are off by less than a tenth. With less, short ranges would be
refused; with more, wrong stamps, positions or units are taken for errors of radios.
"""


class PairErrors(NamedTuple):
    """The measured ranges of one pair with their errors."""

    t: Numbers
    """The times in s; shape (N,)."""
    measured: Numbers
    """The ranges in m; shape (N,)."""
    error: Numbers
    """Measured minus reference in m; shape (N,)."""


class RadioErrors(NamedTuple):
    """The errors of the ranges of one pair of radios: measured minus true is bias + scale x measured."""

    ranges: int
    """The number of ranges."""
    bias: float
    """The bias in m, at the common scale."""
    bias_sigma: float
    """The standard deviation in m."""
    scale: float | None
    """The relative error by this pair alone; None if its ranges are too similar to tell."""
    scale_sigma: float
    """The standard deviation of that; 0 if it is not told."""
    sigma: float
    """The standard deviation in m of the errors without outliers."""
    slow_sigma: float
    """The part of it in m that varies slowly."""
    outliers: float
    """The fraction of outliers."""

    @property
    def sure_scale(self) -> float:
        """The part of the pair's own scale beyond its noise."""
        size = max(abs(self.scale or 0.0) - OUTLIER_SIGMAS * self.scale_sigma, 0.0)
        return math.copysign(size, self.scale or 0.0)


class RangeCalibration(NamedTuple):
    """The errors of all pairs of radios."""

    pairs: dict[tuple[str, str], RadioErrors]
    """The errors of each pair, by the names of the radios."""
    scale: float
    """The relative error that all ranges have in common."""
    scale_sigma: float
    """The standard deviation."""
    source: str
    """The reference: the truth, or the fit."""
    scale_spread: float
    """The standard deviation of the scales of pairs about the common one, beyond what noise explains.

    It is 0 if fewer than two tell theirs.
    """
    scale_told: bool
    """False if the distances of each pair are too much alike to tell a scale from a bias: it is 0 then."""
    bias_sigma: float = 0.0
    """The standard deviation (m) of what all biases have in common, if it is more than the lines tell."""
    unused: int = 0
    """The number of ranges of which no errors follow."""
    slow_time: float = SLOW_TIME * SLOW_LAG_S
    """The time (s) in which the correlation of the slow errors falls to 1 / e."""


def absurd_error(bias: float, scale: float, longest: float) -> str:
    """Return which of these, a bias (m) or a scale, no radio has whose ranges are up to `longest` (m)."""
    most = max(MOST_BIAS, MOST_BIAS_SHARE * longest)
    if not abs(bias) <= most:  # it may be NaN
        return f"a bias of {bias:+.4g} m, and at most {most:.4g} m are taken for one of radios"
    if not abs(scale) <= MOST_SCALE:
        return f"a scale of {scale:+.4g}, and at most {MOST_SCALE:g} is taken for one of radios"
    return ""


def true_errors(recording: RangeRecording) -> dict[tuple[str, str], PairErrors]:
    """Return the errors of all ranges whose both ends have a true position, by pair of radios."""
    found = {}
    robots = {one.id: with_bridged_truth(one) for one in recording.robots}
    fixed = {one.id: np.array((one.x, one.y, one.height)) for one in recording.anchors}
    for pair, rows in recording.pairs().items():
        t, measured = recording.ranges.t[rows], recording.ranges.range[rows]
        ends = [true_antenna(robots[name], t) if name in robots else fixed[name] for name in pair]
        distance = np.sqrt(np.sum(np.square(ends[0] - ends[1]), 1))
        known = np.isfinite(distance)
        if np.count_nonzero(known) >= FEWEST_ERRORS:
            found[pair] = PairErrors(t[known], measured[known], (measured - distance)[known])
    return found


DEPTH_RATIO = 0.5
"""The ratio of the spread of ranges about depths to that about distances from which on they are depths.

Those of MRCLAM, which are depths of cameras, have 0.39; radios have 20 and more. With more, radios of robots
that only drive towards what they range would be taken for cameras.
"""

DEPTHS_OF_PAIR = 50
"""The largest number of ranges of a pair of which depths are computed."""


def are_depths(recording: RangeRecording) -> bool:
    """Return whether ranges are rather depths, along the heading of the robot that measured, than distances.

    The spreads about both are the medians of those of the pairs whose ends have true poses.
    """
    robots = {one.id: with_bridged_truth(one) for one in recording.robots}
    fixed = {one.id: np.array((one.x, one.y)) for one in recording.anchors}
    spreads = []
    for rows in recording.pairs().values():
        part = recording.ranges.rows(rows[:: -(-len(rows) // DEPTHS_OF_PAIR)])
        off = []
        for t, first, second, measured in zip(*[column.tolist() for column in part[:4]], strict=True):
            names = recording.radios[first], recording.radios[second]
            observer = true_pose(robots[names[0]], t)
            seen = fixed[names[1]] if names[1] in fixed else true_pose(robots[names[1]], t)
            if observer is not None and seen is not None:
                x, y = (seen[:2] - observer[:2]).tolist()
                depth = x * math.cos(observer[2]) + y * math.sin(observer[2])
                off.append((measured - depth, measured - math.hypot(x, y)))
        if len(off) >= FEWEST_ERRORS:
            spreads.append([_robust_sigma(one) for one in np.array(off).T])
    depth, distance = np.median(spreads, 0).tolist() if spreads else (math.inf, 0.0)
    return bool(depth < DEPTH_RATIO * distance)


def range_calibration(errors: Mapping[tuple[str, str], PairErrors], source: str) -> RangeCalibration:
    """Return a line through the errors of each pair, with one slope for all, and what is off the lines."""
    each = list(errors.values())
    which = np.repeat(np.arange(len(each)), [len(one.t) for one in each])
    error = np.concatenate([one.error for one in each])
    reference = np.concatenate([one.measured for one in each]) - error
    # the ranges of a second tell as much as one of them; a stray would turn the first line to itself
    repeated = np.array([len(one.t) / len(np.unique(np.floor(one.t / SLOW_LAG_S))) for one in each])
    first = np.concatenate(
        [np.abs(own - np.median(own)) <= STRAY_SIGMAS * _robust_sigma(own) for _, _, own in each]
    )
    line, covariance, off, good = _lines(which, reference, error, repeated, first)
    told = bool(covariance[-1, -1] <= TOLD_SCALE**2)
    if not told:
        line, covariance, off, good = _lines(which, np.zeros_like(reference), error, repeated, first)
    inlying = [(one.t[good[which == i]], off[good & (which == i)]) for i, one in enumerate(each)]
    lag = max(SLOW_LAG_S, float(np.median(np.concatenate([np.diff(one.t) for one in each]))))
    slow_time = _slow_time(inlying, lag)
    pairs = {}
    for i, (name, one) in enumerate(errors.items()):
        inliers = (which == i) & good
        pairs[name] = RadioErrors(
            len(one.t),
            float(line[i]),
            math.sqrt(covariance[i, i]),
            *_own_scale(reference[inliers], error[inliers], repeated[i]),
            float(np.std(off[inliers])),
            _slow_sigma(*inlying[i], lag, slow_time),
            1.0 - float(np.count_nonzero(inliers)) / len(one.t),
        )
    common = float(line[-1])
    beyond = [
        (one.scale - common) ** 2 - one.scale_sigma**2 for one in pairs.values() if one.scale is not None
    ]
    spread = math.sqrt(max(sum(beyond) / (len(beyond) - 1), 0.0)) if len(beyond) > 1 else 0.0
    return RangeCalibration(
        pairs, common, math.sqrt(covariance[-1, -1]), source, spread, told, slow_time=slow_time
    )


def _lines(
    which: Places, reference: Numbers, error: Numbers, repeated: Numbers, good: NDArray[np.bool_]
) -> tuple[Numbers, Numbers, Numbers, NDArray[np.bool_]]:
    """Return the bias (m) of each pair and the scale, their covariance, and what is off the lines.

    `good` is False for the errors without a part in the first line. The last result is False for outliers.
    The line is one of the reference, since noise in measured ranges would look like a scale.
    """
    count = len(repeated)
    variance, design = np.ones(count), np.zeros((len(error), count + 1))
    design[np.arange(len(error)), which], design[:, -1] = 1.0, reference
    for step in range(ROUNDS):
        weight = np.where(good, 1.0, 0.0) / (variance * repeated)[which]
        information = design.T @ (weight[:, None] * design)
        information[-1, -1] += 1.0 / SCALE_PRIOR**2
        covariance = np.asarray(np.linalg.inv(information), np.float64)
        line = covariance @ (design.T @ (weight * error))
        off = error - line[which] - line[-1] * reference
        variance = np.square([_robust_sigma(off[which == i]) for i in range(count)])
        before, good = good, np.square(off) <= OUTLIER_SIGMAS**2 * variance[which]
        if step and np.array_equal(before, good):
            break
    return line / (1.0 + line[-1]), covariance, off / (1.0 + line[-1]), good


def _robust_sigma(off: Numbers) -> float:
    """Return the standard deviation by the median of the absolute values, in m."""
    return max(float(np.median(np.abs(off - np.median(off)))) / MEDIAN, LEAST_RANGE_SIGMA)


def _own_scale(reference: Numbers, error: Numbers, repeated: float) -> tuple[float | None, float]:
    """Return the scale of one pair by its own line, and its standard deviation; None and 0 if not told."""
    if np.std(reference) < LEAST_SPREAD:
        return None, 0.0
    slope, bias = np.polyfit(reference, error, 1).tolist()
    off = error - bias - slope * reference
    variance = float(np.var(off)) * repeated / (len(off) * float(np.var(reference)))
    return slope / (1.0 + slope), math.sqrt(variance)


def _common(errors: Sequence[tuple[Numbers, Numbers]], lag: float) -> float:
    """Return the mean product (m^2) of errors that are `lag` s apart; NaN if there are too few."""
    products = []
    for t, off in errors:
        after = np.searchsorted(t, t + lag)
        first = np.flatnonzero(after < len(t))
        second = after[first]
        near = np.abs(t[second] - t[first] - lag) <= LAG_SHARE * lag
        centred = off - np.mean(off)
        products.append(centred[first[near]] * centred[second[near]])
    found = np.concatenate(products)
    return float(np.mean(found)) if len(found) >= FEWEST_ERRORS else math.nan


def _slow_time(errors: Sequence[tuple[Numbers, Numbers]], lag: float) -> float:
    """Return the time (s) in which the correlation of all `errors` falls to 1 / e after `lag` s."""
    at_first, longer = _common(errors, lag), 2.0 * lag
    while at_first > 0.0 and not math.isnan(common := _common(errors, longer)):
        if common < at_first / math.e:
            falls = math.log(at_first / max(common, FAINT * at_first))
            return max((longer - lag) / falls, SLOW_TIME * lag)
        longer *= 2.0
    return SLOW_TIME * lag


def _slow_sigma(t: Numbers, off: Numbers, lag: float, slow_time: float) -> float:
    """Return the sigma (m) of what errors `lag` s apart have in common; 0 if that is not known."""
    common = _common([(t, off)], lag)
    if math.isnan(common):
        return 0.0
    return math.sqrt(min(max(common * math.exp(lag / slow_time), 0.0), MOST_SLOW * float(np.var(off))))
