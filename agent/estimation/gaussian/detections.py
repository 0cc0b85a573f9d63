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
    numbers = (measured.reach, CLEAR, EDGE, measured.noise.drop_outs)
    by, ranges, ticks = address(np.array((*numbers, SILENT))), measured.ranges, []
    for first, second, silent in measured.silent:
        own = [(1.0, len(silent), address(silent))]
        if second < 0:
            ranged = ranges.tick[ranges.to_anchors(first)]
            own.append((-1.0, len(ranged), address(ranged)))
        ticks.append((first, second, own))
    weights = []
    for one in found:
        of, step, robots = one.problem.measured, one.linear.step, len(one.paths)
        at = [address(part) for part in (one.paths, one.start.poses, of.pivot)]
        fit = (robots, one.paths.shape[1], *at, one.level, address(step.inverse), len(step.inverse))
        weight = 0.0
        for first, second, own in ticks:
            weight += sum([library().detections(by, first, second, *some, *fit) for some in own])
        weights.append(weight)
    return weights


EDGE = 0.005
"""The assumed uncertainty of R, as a fraction of R, which is added to the uncertainty of the pose."""

CLEAR = 0.5
"""The fraction of R beyond R from which a tick without a detection contains no information."""


SILENT = 12
"""The maximum number of ticks without a detection that are evaluated, those closest to the beacon."""
