"""Starts of the fits of pairs, from where each robot's anchor is in the frame of its odometry."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.estimation.fit import TO_THE_END, Ending, Fit, Start, fits
from agent.estimation.gaussian.known_anchors import start_of
from agent.estimation.gaussian.odometry_noise import Array, Errors
from agent.estimation.gaussian.pair_ranges import PairRanges


def pair_start(guess: Array, apart: tuple[float, float], errors: Sequence[Errors] = ()) -> Start:
    """Return the start whose `Fit.guess` is `guess`, shape (6,), where M2 is `apart` (m) from M1."""
    poses = np.concatenate([start_of(own).poses for own in guess.reshape(2, 3)])
    poses[1, :2] += apart
    return Start(poses, tuple(errors))


def pair_fit(guess: Array, pair: PairRanges, ending: Ending = TO_THE_END) -> Fit:
    """Return the fit to all ranges of `pair` that begins at `guess`, shape (6,)."""
    (found,) = fits(pair.measured, [pair_start(guess, pair.apart)], ending)
    return found
