"""The likelihood of detections, and of ticks without one, under a fit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.estimation.compiled import address, library
from agent.estimation.fit import Fit
from agent.estimation.gaussian.joint_ranges import JointMeasurements


def detection_log_likelihoods(found: Sequence[Fit], measured: JointMeasurements) -> list[float]:
    """Return the log-likelihood of all detections and of the ticks without one, given each fit.

    It is 0 if a missing range says nothing. The error of a prediction is common to all ticks, because they
    lie on one path: that of the tick in which the beacon was nearest, or in which it was farthest and
    detected. A tick within R has no detection with the probability of drop-outs.
    """
    if not measured.silent:
        return [0.0] * len(found)
    by = address(np.array((measured.reach, CLEAR, EDGE, measured.noise.drop_outs, SILENT)))
    terms, ticks, ranges = [], [], measured.ranges
    for first, second, silent in measured.silent:
        terms.append((first, second, 1, len(silent)))
        ticks.append(silent)
        if second < 0:
            ticks.append(ranges.tick[ranges.to_anchors(first)])
            terms.append((first, second, -1, len(ticks[-1])))
    given = (by, len(terms), address(np.array(terms)), address(np.concatenate(ticks)))
    weights = np.empty((len(found), 1))
    for one, weight in zip(found, weights, strict=True):
        pivot, inverse = one.problem.measured.pivot, one.linear.step.inverse
        at = [address(part) for part in (one.paths, one.start.poses, pivot)]
        fit = (len(one.paths), one.paths.shape[1], *at, one.level, address(inverse), len(inverse))
        library().detections(*given, *fit, address(weight))
    return list(weights[:, 0].tolist())


EDGE = 0.005
"""The assumed uncertainty of R, as a fraction of R, which is added to the uncertainty of the pose."""

CLEAR = 0.5
"""The fraction of R beyond R from which a tick without a detection contains no information."""


SILENT = 12
"""The maximum number of ticks without a detection that are evaluated, those closest to the beacon."""
