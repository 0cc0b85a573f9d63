"""The measurements of pairs, and starts of their fits from where each anchor is in the robot's odometry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from msgspec.structs import replace

from agent.estimation.fit import TO_THE_END, Fit, Start, fits
from agent.estimation.gauss_newton import Convergence
from agent.estimation.gaussian.beacon_guesses import start_of
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.measured_rows import near_anchors
from agent.estimation.gaussian.odometry_noise import Array, Errors, Places, Track
from protocol.noise import Noise


def pair_start(guess: Array, apart: Sequence[float], errors: Sequence[Errors] = ()) -> Start:
    """Return the start whose `Fit.guess` is `guess`, shape (6,), where M2 is `apart` (m) from M1."""
    poses = np.concatenate([start_of(own).poses for own in guess.reshape(2, 3)])
    poses[1, :2] += apart
    return Start(poses, tuple(errors))


def pair_fit(guess: Array, pair: JointMeasurements, ending: Convergence = TO_THE_END) -> Fit:
    """Return the fit to all ranges of `pair` that begins at `guess`, shape (6,)."""
    (found,) = fits(pair, [pair_start(guess, m2(pair))], ending)
    return found


def m2(pair: JointMeasurements) -> tuple[float, float]:
    """Return the place (m) of M2 relative to M1."""
    x, y = (pair.pivots[1] - pair.pivots[0]).tolist()
    return x, y


def kinds(pair: JointMeasurements) -> Places:
    """Return 0 for each range of a to M1, 1 for one of b to M2, and 2 for one between the robots; (N,)."""
    return np.where(pair.ranges.mutual, 2, pair.ranges.first)


def with_ranges(pair: JointMeasurements, **changes: Any) -> JointMeasurements:
    """Return `pair` with changed columns of its ranges."""
    return replace(pair, ranges=replace(pair.ranges, **changes))


def alone(path: Track, rho: Sequence[float], noise: Noise, reach: float = 3.0) -> JointMeasurements:
    """Return the measurements of a robot that has measured `rho` (m) to its anchor in the first ticks."""
    return near_anchors([path], [list(enumerate(rho))], [(0.0, 0.0)], noise, reach).alone(0)
