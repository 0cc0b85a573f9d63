"""The measurements of n robots as the arrays of a fit: paths, ranges, and the errors that they may have."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from agent.estimation.gaussian.joint_ranges import JointMeasurements, JointRanges, range_errors
from agent.estimation.gaussian.odometry_noise import (
    Array,
    Places,
    Track,
    constant_errors,
    stray_variances,
    variances,
)
from agent.estimation.gaussian.range_model import SIGMA_FLOOR
from agent.estimation.gaussian.range_weights import Weighing
from agent.estimation.kernel import Kernel
from agent.estimation.smoother import Measured
from protocol.noise import Noise

MOST_MEASURED_LENGTHS = 200
"""The most ranges of a fit whose scale error multiplies the measured ranges; of more, the predicted ones.

A measured range that is too long by chance is multiplied by more, so a fit gains by shrinking all ranges, and
gains more with each of them. Ranges as told, of 0.05 m and 300 from each robot to its anchor, had a log
evidence of 16 for the profile `uwb`, whose scale shrank them by a quarter; with 500, it was 102. By predicted
ranges, it is -11 to -12 with any number. Up to 200 ranges it differs by 2, which decides nothing.
"""


class Problem(msgspec.Struct, frozen=True, eq=False):
    """The part of a fit that does not change during it. Ranges are in the order of their ticks."""

    measured: Measured
    weighing: Weighing
    kernel: Kernel
    noise: Noise
    order: Places
    """The ranges of the measurements in the order of the fit; shape (N,)."""
    back: Places
    """The ranges of the fit in the order of the measurements; shape (N,)."""
    lengths: tuple[int, ...]
    """The number of ticks of each path."""
    log_information: float
    """The logarithm of the determinant of what the prior tells; see `PosePrior`."""
    ticks: Places
    """The tick of each range, in the order of the measurements; shape (N,)."""

    @staticmethod
    def of(measured: JointMeasurements) -> Problem:
        """Return the problem of all robots in `measured`, which keep it."""
        known: dict[str, Problem] = measured.__dict__
        if "problem" in known:
            return known["problem"]
        noise, priors, ranges = measured.noise, measured.noise.priors, measured.ranges
        n, lengths = len(measured.paths), tuple([len(path.v) for path in measured.paths])
        ticks = max(lengths, default=0)
        tick = np.minimum(ranges.tick, ticks)
        in_order = not (tick[1:] < tick[:-1]).any()  # as those of a robot alone are
        order = back = np.arange(len(tick))
        rows: slice | Places = slice(None)
        if not in_order:
            rows = order = tick.argsort(kind="stable")
            back = np.empty_like(order)
            back[order] = np.arange(len(order))
        tick, radio, rho = tick[rows], ranges.radio[rows], ranges.rho[rows]
        holding, common = radio < 0, ranges.common_errors(priors)[rows]
        common[holding] = 0.0
        radios = ranges.radios
        column = {name: number for number, name in enumerate(range_errors(priors, len(radios)))}
        if radios != list(range(len(radios))):
            radio = np.where(holding, -1, np.searchsorted(radios, radio))  # without gaps
        v, omega, slip = _velocities(measured.paths, ticks)
        anchor, anchors = _unsure_anchors(ranges) if priors.survey_error else (np.full(len(order), -1), 0)
        white = _variances(measured, v, omega)
        stray = np.empty((n, 2, 0))
        if noise.odometry_strays:
            stray = white + stray_variances(v, omega, noise, measured.period)
        prior, few = measured.prior, len(order) <= MOST_MEASURED_LENGTHS
        of = Measured(
            period=measured.period,
            v=v,
            omega=omega,
            slip=slip,
            white=white,
            stray=stray,
            patterns=constant_errors(v, omega, noise),
            begin=tick.searchsorted(np.arange(ticks + 2)),
            first=ranges.first[rows],
            second=ranges.second[rows],
            place=ranges.place[rows],
            rho=rho,
            common=common,
            scaled=-1 if few else column.get("range_scale", -1),
            scale=priors.range_scale,
            delayed=column.get("range_delay", -1),
            deep=column.get("range_depth", -1),
            observer=np.where(ranges.by_second & (ranges.second >= 0), ranges.second, ranges.first)[rows],
            anchor=anchor[rows],
            anchors=anchors,
            survey=priors.survey_error,
            radio=radio,
            radios=len(radios) if priors.slow_sigma else 0,
            slow=priors.slow_sigma**2,
            decay=math.exp(-measured.period / priors.slow_time),
            mean=np.zeros(3 * n) if prior is None else prior.mean.ravel(),
            information=np.zeros((3 * n, 3 * n)) if prior is None else prior.information,
            pivot=measured.pivots,
        )
        by = Weighing.of(
            noise,
            ranges.sigma[rows],
            holding.astype(np.intp),
            radio.argsort(kind="stable"),
            float(rho[~holding].max(initial=SIGMA_FLOOR)),
            free=3 * n - (0 if prior is None else prior.rank),
            noisy=bool(of.patterns.shape[1]) or bool(of.white.any()) or bool(of.stray.any()),
        )
        log_information = 0.0 if prior is None else prior.log_information
        kept = (noise, order, back, lengths, log_information, ranges.tick)
        return known.setdefault("problem", Problem(of, by, Kernel(of, by), *kept))


def _velocities(paths: tuple[Track, ...], ticks: int) -> tuple[Array, Array, Array]:
    """Return v, omega and slip of all paths, shape (n, K); a shorter one goes on at rest."""
    v, omega, slip = np.zeros((3, len(paths), ticks))
    for i, path in enumerate(paths):
        known = len(path.v)
        v[i, :known], omega[i, :known] = path.v, path.omega
        if path.slip is not None:
            slip[i, :known] = path.slip
    return v, omega, slip


def _variances(measured: JointMeasurements, v: Array, omega: Array) -> Array:
    """Return the variances of v and omega of all paths, (n, 2, K): those of the noise, and the extra ones.

    An anchor stands still.
    """
    white = variances(v, omega, measured.noise.odometry)
    for i, path in enumerate(measured.paths):
        known = 0 if measured.is_anchor(i) else len(path.v)
        white[i, :, known:] = 0.0
        if path.extra is not None:
            white[i, :, :known] += path.extra[:, :known]
    return white


def _unsure_anchors(ranges: JointRanges) -> tuple[Places, int]:
    """Return the anchor of each range, -1 of one between robots, and the number of anchors."""
    number: dict[tuple[float, ...], int] = {}
    anchor = np.full(len(ranges.rho), -1)
    for row in np.flatnonzero((ranges.second < 0) & (ranges.radio >= 0)).tolist():
        anchor[row] = number.setdefault(tuple(ranges.place[row].tolist()), len(number))
    return anchor, len(number)
