"""The measurements of n robots as the arrays of a fit: paths, ranges, and the errors that they may have."""

from __future__ import annotations

import math

import msgspec
import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian.joint_ranges import JointMeasurements, JointRanges
from agent.estimation.gaussian.odometry_noise import Array, Places, Track, constant_errors, variances
from agent.estimation.gaussian.range_model import SIGMA_FLOOR
from agent.estimation.smoother import Measured
from protocol.motion import rotated, rotated_back
from protocol.noise import Noise

MOST_MEASURED_LENGTHS = 200
"""The most ranges of a fit whose scale error multiplies the measured ranges; of more, the predicted ones.

A measured range that is too long by chance is multiplied by more, so a fit gains by shrinking all ranges, and
gains more with each of them. Ranges as told, of 0.05 m and 300 from each robot to its anchor, had a log
evidence of 16 for the profile `uwb`, whose scale shrank them by a quarter; with 500, it was 102. By predicted
ranges, it is -11 to -12 with any number. Up to 200 ranges it differs by 2, which decides nothing.
"""

SCALE_AFTER_BIAS = 1
"""The column of the scale error in `Ranges.common_errors` if there is a bias of all ranges."""


class Problem(msgspec.Struct, frozen=True, eq=False):
    """The part of a fit that does not change during it. Ranges are in the order of their ticks."""

    measured: Measured
    noise: Noise
    back: Places
    """The ranges of the fit in the order of the measurements; shape (N,)."""
    sigma: Array
    """The standard deviation of each range in m; shape (N,)."""
    longest: float
    """The longest range in m: the size of the geometry."""
    holding: NDArray[np.bool]
    """True for a range that has no error but a white one: see `JointRanges.radio`; shape (N,)."""
    lengths: tuple[int, ...]
    """The number of ticks of each path."""
    free: int
    """The number of unknowns of the start poses that only the ranges determine."""
    log_information: float
    """The logarithm of the determinant of what the prior tells; see `PosePrior`."""
    by_radio: Places
    """The ranges of the fit, those of each pair of radios together; shape (N,)."""
    ends: tuple[int, ...]
    """The place in `by_radio` after the last one of each pair of radios."""
    ticks: Places
    """The tick of each range, in the order of the measurements; shape (N,)."""

    @staticmethod
    def of(measured: JointMeasurements) -> Problem:
        """Return the problem of all robots in `measured`."""
        noise, priors, ranges = measured.noise, measured.noise.priors, measured.ranges
        n, lengths = len(measured.paths), tuple([len(path.v) for path in measured.paths])
        ticks = max(lengths, default=0)
        tick = np.minimum(ranges.tick, ticks)
        order = np.argsort(tick, kind="stable")
        back = np.empty_like(order)
        back[order] = np.arange(len(order))
        radios, holding = sorted(set(ranges.radio.tolist()) - {-1}), ranges.radio[order] < 0
        radio = np.where(holding, -1, np.searchsorted(radios, ranges.radio[order]))  # without gaps
        common = ranges.single.common_errors(priors)[order]
        common[holding] = 0.0
        by_radio = np.argsort(radio, kind="stable")
        v, omega, slip = _velocities(measured.paths, ticks)
        anchor, anchors = _unsure_anchors(ranges) if priors.survey_error else (np.full(len(order), -1), 0)
        prior, few = measured.prior, len(order) <= MOST_MEASURED_LENGTHS
        return Problem(
            Measured(
                period=measured.period,
                v=v,
                omega=omega,
                slip=slip,
                white=_variances(measured.paths, v, omega, noise),
                patterns=constant_errors(v, omega, noise),
                begin=np.searchsorted(tick[order], np.arange(ticks + 2)),
                first=ranges.first[order],
                second=ranges.second[order],
                place=ranges.place[order],
                rho=ranges.rho[order],
                common=common,
                scaled=-1 if not priors.range_scale or few else SCALE_AFTER_BIAS * bool(priors.range_bias),
                scale=priors.range_scale,
                delayed=common.shape[1] - 1 if priors.range_delay else -1,
                anchor=anchor[order],
                anchors=anchors,
                survey=priors.survey_error,
                radio=radio,
                radios=int(radio.max(initial=-1)) + 1 if priors.slow_sigma else 0,
                slow=priors.slow_sigma**2,
                decay=math.exp(-measured.period / priors.slow_time),
                mean=np.zeros(3 * n) if prior is None else prior.mean.ravel(),
                information=np.zeros((3 * n, 3 * n)) if prior is None else prior.information,
                pivot=_pivots(n, ranges),
            ),
            noise,
            back,
            ranges.sigma[order],
            max(float(np.max(ranges.rho[order[~holding]], initial=0.0)), SIGMA_FLOOR),
            holding,
            lengths,
            3 * n - (0 if prior is None else prior.rank),
            0.0 if prior is None else prior.log_information,
            by_radio,
            tuple((np.flatnonzero(np.diff(radio[by_radio])) + 1).tolist()),
            ranges.tick,
        )

    def guess(self, poses: Array) -> Array:
        """Return the pivots in the robots' frames (m) and the headings (rad) of `poses`; (3 n,) each."""
        found = poses.copy()
        for i, (at_x, at_y) in enumerate(self.measured.pivot.tolist()):
            x, y, heading = poses[3 * i : 3 * i + 3].tolist()
            away = (0.0, 0.0) if math.isnan(at_x) else (at_x - x, at_y - y)
            found[3 * i : 3 * i + 2] = rotated_back(math.cos(heading), math.sin(heading), *away)
        return found

    def moved(self, poses: Array, change: Array) -> Array:
        """Return the start `poses` with a `change` of the pivots in the robots' frames and of the headings.

        All have the shape (3 n,); see `smoother`.
        """
        after, found = self.guess(poses) + change, np.empty(len(poses))
        for i, pivot in enumerate(self.measured.pivot.tolist()):
            start = slice(3 * i, 3 * i + 3)
            mx, my, heading = after[start].tolist()
            x, y, _ = poses[start].tolist() if math.isnan(pivot[0]) else (*pivot, 0.0)
            dx, dy = rotated(math.cos(heading), math.sin(heading), mx, my)
            found[start] = x - dx, y - dy, heading
        return found

    @property
    def noisy(self) -> bool:
        """True if odometry may differ from the executed motion."""
        return bool(self.measured.patterns.shape[1]) or bool(self.measured.white.any())

    @property
    def robust(self) -> bool:
        """True if a range may be an outlier."""
        return bool(self.noise.outliers or self.noise.strays)


def _velocities(paths: tuple[Track, ...], ticks: int) -> tuple[Array, Array, Array]:
    """Return v, omega and slip of all paths, shape (n, K); a shorter one goes on at rest."""
    v, omega, slip = np.zeros((3, len(paths), ticks))
    for i, path in enumerate(paths):
        known = len(path.v)
        v[i, :known], omega[i, :known] = path.v, path.omega
        if path.slip is not None:
            slip[i, :known] = path.slip
    return v, omega, slip


def _variances(paths: tuple[Track, ...], v: Array, omega: Array, noise: Noise) -> Array:
    """Return the variances of v and omega of all paths, (n, 2, K): those of the noise, and the extra ones."""
    white = variances(v, omega, noise.odometry)
    for i, path in enumerate(paths):
        known = len(path.v)
        white[i, :, known:] = 0.0
        if path.extra is not None:
            white[i, :, :known] += path.extra
    return white


def _pivots(robots: int, ranges: JointRanges) -> Array:
    """Return the pivot of each robot: the mean place of its anchors; NaN, without any, for its start."""
    pivots = np.full((robots, 2), math.nan)
    for i in range(robots):
        own = (ranges.first == i) & (ranges.second < 0) & (ranges.radio >= 0)
        places = dict.fromkeys([tuple(place) for place in ranges.place[own].tolist()])
        if places:
            pivots[i] = [math.fsum(axis) / len(places) for axis in zip(*places, strict=True)]
    return pivots


def _unsure_anchors(ranges: JointRanges) -> tuple[Places, int]:
    """Return the anchor of each range, -1 of one between robots, and the number of anchors."""
    number: dict[tuple[float, ...], int] = {}
    anchor = np.full(len(ranges.rho), -1)
    for row in np.flatnonzero((ranges.second < 0) & (ranges.radio >= 0)).tolist():
        anchor[row] = number.setdefault(tuple(ranges.place[row].tolist()), len(number))
    return anchor, len(number)
