"""The measurements of pairs, and starts of their fits from where each anchor is in the robot's odometry."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.estimation.fit import TO_THE_END, Fit, Start, fits
from agent.estimation.gauss_newton import Convergence
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.known_anchors import start_of
from agent.estimation.gaussian.odometry_noise import Array, Errors
from agent.estimation.gaussian.pair_ranges import PairRanges
from agent.estimation.gaussian.range_model import Ranges


def pair_start(guess: Array, apart: tuple[float, float], errors: Sequence[Errors] = ()) -> Start:
    """Return the start whose `Fit.guess` is `guess`, shape (6,), where M2 is `apart` (m) from M1."""
    poses = np.concatenate([start_of(own).poses for own in guess.reshape(2, 3)])
    poses[1, :2] += apart
    return Start(poses, tuple(errors))


def pair_fit(guess: Array, pair: PairRanges, ending: Convergence = TO_THE_END) -> Fit:
    """Return the fit to all ranges of `pair` that begins at `guess`, shape (6,)."""
    (found,) = fits(pair.measured, [pair_start(guess, pair.apart)], ending)
    return found


def pair_of(used: JointMeasurements, reach: float) -> PairRanges:
    """Return the measurements of two robots with one anchor each, whose ranges have the same order."""
    ranges, nothing = used.ranges, np.empty(0, np.intp)
    kind = np.where(ranges.second < 0, ranges.first, 2)
    first, second, mutual = np.bincount(kind, minlength=3).tolist()
    of_a, of_b = ranges.place[0], ranges.place[first]
    assert not of_a.any(), "the origin is the anchor of the first robot"
    return PairRanges(
        (used.paths[0], used.paths[1]),
        Ranges(ranges.rho, ranges.tick, ranges.sigma, (first, second, mutual)),
        (nothing, nothing, nothing),
        (float(of_b[0]), float(of_b[1])),
        reach,
        used.noise,
    )
