"""Initial guesses for an anchor in the frame of the odometry: the intersections of two range circles.

Each guess is refined by Gauss-Newton on all ranges, with odometry noise treated as noise of the ranges. Ticks
without a detection are ignored.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import numpy as np

from agent.estimation.compiled import address, library
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.odometry_noise import (
    Array,
    Places,
    constant_errors,
    expected_variances,
    is_noisy,
    position_variances,
)
from agent.estimation.gaussian.range_model import mixture

SEED_RANGES = 10
"""The largest number of ranges that initial guesses are made from.

With more ranges to the anchor, only the remaining hypotheses about its position are followed.
"""

SAME_POSITION = 0.02
"""The expected error of an initial guess, as a fraction of R; guesses closer than this are merged."""

POLISHINGS = 4
"""The least number of Gauss-Newton steps on an initial guess, after that on the rotations of a placement."""

POSITION_FINER = 0.1
"""The factor by which the expected error of a position decreases at each of these steps."""

TWINS = 0.3
"""The distance in sigmas of a range below which guesses are merged, in addition to the limits above."""

UNLIKELY = 25.0
"""The difference in log-likelihood to the best guess beyond which a guess is dropped."""

MOST_GUESSES = 6
"""The largest number of guesses for an anchor."""


def anchors(own: JointMeasurements, known: Sequence[Sequence[float]] = ()) -> Array:
    """Return initial guesses for the anchor (m) of a robot in the frame of its odometry; shape (n, 2).

    They are the intersections of each two range circles, or points between circles that noise keeps apart,
    and the earlier guesses `known`. All are refined on all ranges (see `hypotheses.c`), the likeliest first.
    """
    path, ranges, near = own.paths[0], own.ranges, SAME_POSITION * own.reach
    sigma = np.sqrt(np.square(ranges.sigma) + _odometry_variance(own) + own.loosened)
    circles = (path.x[ranges.tick], path.y[ranges.tick], ranges.rho, sigma, mixture(own.noise))
    pairs = couples(len(sigma))
    finer = np.array([near * POSITION_FINER**step for step in range(POLISHINGS + 1)])
    same = near * POSITION_FINER + TWINS * float(np.min(sigma, initial=math.inf))
    points = np.empty((len(known) + 2 * len(pairs[0]), 2))
    points[: len(known)] = np.array(known).reshape(-1, 2)
    found = library().anchor_guesses(
        *(len(sigma), *map(address, circles), len(pairs[0]), *map(address, pairs), len(known)),
        *(POLISHINGS, address(finer), 0.5 * own.reach, UNLIKELY, same, MOST_GUESSES, address(points)),
    )
    return points[:found]


def _odometry_variance(own: JointMeasurements) -> Array:
    """Return the approximate variance (m^2) that odometry noise adds to each range, without correlations."""
    path, noise = own.paths[0], own.noise
    if not is_noisy(noise):
        return np.zeros_like(own.ranges.rho)
    v, omega = path.v, path.omega
    white = expected_variances(v, omega, noise, path.period)
    if path.extra is not None:
        white += path.extra
    variances = position_variances(path, white, constant_errors(v, omega, noise))
    along: Array = 0.5 * variances[np.minimum(own.ranges.tick, len(path.v))]
    return along


@cache
def spread_out(count: int, most: int = SEED_RANGES) -> Places:
    """Return at most `most` of the indices below `count`, evenly spaced."""
    # numpy.unique would import numpy.ma in the first search of a mission
    spread = np.linspace(0, count - 1, most).round().astype(np.intp)
    return spread[np.diff(spread, prepend=-1) > 0]


@cache
def couples(count: int, most: int = SEED_RANGES) -> tuple[Places, Places]:
    """Return the first and the second of each two of the indices `spread_out`."""
    chosen = spread_out(count, most)
    i, j = np.triu_indices(len(chosen), 1)
    return chosen[i], chosen[j]
