"""The errors of recorded ranges by pair of radios: against the true distances, or against a fit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian.range_weights import MEDIAN
from compose.recording.estimating.doubtful_units import MOST_BIAS
from compose.recording.estimating.true_poses import true_antenna, with_bridged_truth
from compose.recording.ranging.range_recording import Numbers, Places, RangeRecording

OUTLIER_SIGMAS = 4.0
"""The distance from the line, in sigmas, from which on an error is an outlier.

A Gaussian error is so far off once in 16 000. With less, honest errors become outliers; with more, outliers
make the sigma larger.
"""


ROUNDS = 20
"""The largest number of rounds in which outliers are found. Most recordings need five."""

FEWEST_ERRORS = 8
"""The least number of ranges of a pair from which its errors are determined."""

LEAST_SPREAD = 0.5
"""The least spread (m, one sigma) of a pair's ranges from which its own scale follows."""

SLOW_LAG_S, SLOW_TIME_S = 1.0, 2.0
"""The lag in s at which the correlation of errors is measured, and the time in s in which it is taken to fall
to 1 / e. Errors within a second are correlated by 0.2 to 0.7 on UWB radios, white ones are not."""

LAG_SHARE = 0.25
"""The tolerance of the lag, as a fraction."""


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
    bias_sigma: float = 0.0
    """The standard deviation (m) of what all biases have in common, if it is more than the lines tell."""
    scale_spread: float = 0.0
    """The standard deviation of the scales of pairs about the common one, beyond what noise explains."""
    unused: int = 0
    """The number of ranges of which no errors follow."""
    scale_told: bool = True
    """False if the distances of each pair are too much alike to tell a scale from a bias: it is 0 then."""


MOST_BIAS_SHARE, MOST_SCALE = 0.25, 0.25
"""The largest bias, as a fraction of the longest range, and the largest scale that are taken for a radio's.

Radios and sonars without any calibration are off by less than a tenth. With less, short ranges would be
refused; with more, wrong stamps, positions or units are taken for errors of radios.
"""


def absurd_error(bias: float, scale: float, longest: float) -> str:
    """Return which of these, a bias (m) or a scale, no radio has whose ranges are up to `longest` (m)."""
    most = max(MOST_BIAS, MOST_BIAS_SHARE * longest)
    if abs(bias) > most:
        return f"a bias of {bias:+.4g} m, and at most {most:.4g} m are taken for one of radios"
    if abs(scale) > MOST_SCALE:
        return f"a scale of {scale:+.4g}, and at most {MOST_SCALE:g} is taken for one of radios"
    return ""


class PairErrors(NamedTuple):
    """The measured ranges of one pair with their errors."""

    t: Numbers
    """The times in s; shape (N,)."""
    measured: Numbers
    """The ranges in m; shape (N,)."""
    error: Numbers
    """Measured minus reference in m; shape (N,)."""


def true_errors(recording: RangeRecording) -> dict[tuple[str, str], PairErrors]:
    """Return the errors of all ranges whose both ends have a true position, by pair of radios."""
    found = {}
    robots = {one.id: with_bridged_truth(one) for one in recording.robots}
    fixed = {one.id: one for one in recording.anchors}
    for pair, rows in recording.pairs().items():
        t, measured = recording.ranges.t[rows], recording.ranges.range[rows]
        ends = []
        for name in pair:
            if name in robots:
                ends.append(true_antenna(robots[name], t))
            else:
                one = fixed[name]
                ends.append(np.tile(np.array((one.x, one.y, one.height)), (len(t), 1)))
        distance = np.sqrt(np.sum(np.square(ends[0] - ends[1]), 1))
        known = np.isfinite(distance)
        if np.count_nonzero(known) >= FEWEST_ERRORS:
            found[pair] = PairErrors(t[known], measured[known], (measured - distance)[known])
    return found


def range_calibration(errors: Mapping[tuple[str, str], PairErrors], source: str) -> RangeCalibration:
    """Return a line through the errors of each pair, with one slope for all, and what is off the lines."""
    names = list(errors)
    which = np.concatenate([np.full(len(errors[name].t), i, np.intp) for i, name in enumerate(names)])
    measured = np.concatenate([errors[name].measured for name in names])
    error = np.concatenate([errors[name].error for name in names])
    repeated = np.array([_repeated(errors[name].t) for name in names])
    first = np.concatenate([_no_strays(errors[name].error) for name in names])
    reference = measured - error
    found, covariance, off, good = _lines(which, reference, error, repeated, first)
    told = bool(covariance[-1, -1] <= TOLD_SCALE**2)
    if not told:
        found, covariance, off, good = _lines(which, np.zeros_like(reference), error, repeated, first)
    pairs = {}
    for i, name in enumerate(names):
        own = which == i
        inliers = own & good
        pairs[name] = RadioErrors(
            int(np.count_nonzero(own)),
            float(found[i]),
            math.sqrt(covariance[i, i]),
            *_own_scale(reference[inliers], error[inliers], repeated[i]),
            float(np.std(off[inliers])),
            _slow_sigma(errors[name].t[good[own]], off[inliers]),
            1.0 - float(np.count_nonzero(inliers)) / float(np.count_nonzero(own)),
        )
    return RangeCalibration(
        pairs,
        float(found[-1]),
        math.sqrt(covariance[-1, -1]),
        source,
        scale_spread=_scale_spread(list(pairs.values()), float(found[-1])),
        scale_told=told,
    )


def _lines(
    which: Places, reference: Numbers, error: Numbers, repeated: Numbers, good: NDArray[np.bool_]
) -> tuple[Numbers, Numbers, Numbers, NDArray[np.bool_]]:
    """Return the bias of each pair and the scale, their covariance, and what is off the lines.

    `good` is False for the errors without a part in the first line. The last result is False for outliers.
    The line is one of the reference, since noise in measured ranges would look like a scale.
    """
    count = len(repeated)
    variance = np.ones(count)
    for step in range(ROUNDS):
        design = _Design(which, reference, np.where(good, 1.0, 0.0) / (variance * repeated)[which])
        line, covariance = design.solve(error, count)
        off = error - line[which] - line[-1] * reference
        variance = np.square([_robust_sigma(off[which == i]) for i in range(count)])
        before, good = good, np.square(off) <= OUTLIER_SIGMAS**2 * variance[which]
        if step and np.array_equal(before, good):
            break
    return line / (1.0 + line[-1]), covariance, off / (1.0 + line[-1]), good


def _no_strays(error: Numbers) -> NDArray[np.bool_]:
    """Return True for the errors from which the first line is drawn: a stray would turn it to itself."""
    return np.abs(error - np.median(error)) <= STRAY_SIGMAS * _robust_sigma(error)


STRAY_SIGMAS = 20.0
"""The distance from the median, in sigmas, from which on an error has no part in the first line.

With less, the errors of radios with a scale would be left out; with more, strays would turn the line."""


def _repeated(t: Numbers) -> float:
    """Return the number of ranges in a second in which there are some: together they tell as much as one."""
    return len(t) / len(np.unique(np.floor(t / SLOW_LAG_S)))


class _Design(NamedTuple):
    """The linear model of all errors: a bias for each pair, and a common scale."""

    which: Places
    reference: Numbers
    weight: Numbers
    """The inverse variance (1 / m^2) of each error; 0 for outliers."""

    def solve(self, error: Numbers, count: int) -> tuple[Numbers, Numbers]:
        """Return the bias (m) of each pair and the scale, (count + 1,), and their covariance."""
        design = np.zeros((len(error), count + 1))
        design[np.arange(len(error)), self.which] = 1.0
        design[:, -1] = self.reference
        information = design.T @ (self.weight[:, None] * design)
        information[-1, -1] += 1.0 / SCALE_PRIOR**2
        covariance = np.asarray(np.linalg.inv(information), np.float64)
        return covariance @ (design.T @ (self.weight * error)), covariance


SCALE_PRIOR = 0.05
"""The prior of the common scale: ranges of one length do not tell it from a bias."""

TOLD_SCALE = 0.5 * SCALE_PRIOR
"""The largest sigma of a scale that is told from a bias. With more, most of it would be the prior."""


def _robust_sigma(off: Numbers) -> float:
    """Return the standard deviation by the median of the absolute values, in m."""
    return max(float(np.median(np.abs(off - np.median(off)))) / MEDIAN, LEAST_RANGE_SIGMA)


LEAST_RANGE_SIGMA = 1e-4
"""The least sigma of ranges in m."""


def _own_scale(reference: Numbers, error: Numbers, repeated: float) -> tuple[float | None, float]:
    """Return the scale of one pair by its own line, and its standard deviation; None and 0 if not told."""
    if np.std(reference) < LEAST_SPREAD:
        return None, 0.0
    slope, bias = np.polyfit(reference, error, 1).tolist()
    off = error - bias - slope * reference
    variance = float(np.var(off)) * repeated / (len(off) * float(np.var(reference)))
    return slope / (1.0 + slope), math.sqrt(variance)


def _scale_spread(pairs: list[RadioErrors], common: float) -> float:
    """Return the standard deviation of the scales of `pairs` about the common one, beyond their noise.

    It is 0 if fewer than two tell theirs.
    """
    scales = [(one.scale - common) ** 2 - one.scale_sigma**2 for one in pairs if one.scale is not None]
    return math.sqrt(max(sum(scales) / (len(scales) - 1), 0.0)) if len(scales) > 1 else 0.0


def _slow_sigma(t: Numbers, off: Numbers) -> float:
    """Return the sigma (m) of what errors a second apart have in common; 0 if that is not known."""
    after = np.searchsorted(t, t + SLOW_LAG_S)
    inside = after < len(t)
    first, second = np.flatnonzero(inside), after[inside]
    near = np.abs(t[second] - t[first] - SLOW_LAG_S) <= LAG_SHARE * SLOW_LAG_S
    if np.count_nonzero(near) < FEWEST_ERRORS:
        return 0.0
    centred = off - np.mean(off)
    common = float(np.mean(centred[first[near]] * centred[second[near]])) * math.exp(SLOW_LAG_S / SLOW_TIME_S)
    return math.sqrt(min(max(common, 0.0), MOST_SLOW * float(np.var(off))))


MOST_SLOW = 0.8
"""The largest part of the variance that is slow."""
