"""The agreement of a claim with the poses that follow without parts of the robot's ranges.

The residuals of a fit do not show errors that another pose explains, such as those of ranges that are off
together for some seconds. Parts of the ranges then lead to poses that differ by more than their covariances.
Each part is left out in turn: a fit to one part alone would have few ranges.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from agent.estimation.elementary import eigh, product
from agent.estimation.fit import Fit, Start, fits, with_unscaled_priors
from agent.estimation.gaussian.consistency import chi2_p_value
from agent.estimation.gaussian.joint_claims import decisive_ranges
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.search import FEWEST_DECISIVE
from protocol.motion import wrap

PART_NAMES = {2: "half", 3: "third"}
"""The numbers of parts, each with as many ranges, in the order of time, and their names.

Halves alone overlook errors that reach from one into the other. Quarters and fifths found no more wrong
claims of MRCLAM 6, but a right one.
"""


class Disagreement(NamedTuple):
    """The pose without a part of the ranges that differs most from a claim."""

    what: str
    """The part and the difference, in words."""
    p_value: float
    """The probability of such a difference, if the covariance is right."""


MOST_KNOWN = 0.5
"""The largest fraction of a variance that is subtracted for the variance of a difference.

The covariance of the difference of two poses, with and without a part, is the difference of theirs. That
is uncertain if the part tells little, so at most this share of a variance is subtracted.
"""


def fits_without_parts(fit: Fit, robot: int, measured: JointMeasurements) -> tuple[tuple[str, Fit], ...]:
    """Return the fits to what was `measured` without each part of a robot's ranges, by the name of the part.

    They begin at `fit`. Parts without which the ranges do not locate the robot are not among them.
    """
    ranges, found = measured.ranges, []
    own = np.flatnonzero(ranges.of(robot))
    order, count = own[ranges.tick[own].argsort(kind="stable")], len(own)
    for parts, name in PART_NAMES.items():
        for part in range(parts):
            left = np.ones(len(ranges.rho), bool)
            left[order[part * count // parts : (part + 1) * count // parts]] = False
            start = Start(fit.start.poses, fit.start.errors, fit.weights[left])
            rest = replace(measured, ranges=ranges.rows(left), solver=None)
            if decisive_ranges(robot, rest) < FEWEST_DECISIVE:
                continue
            found += [
                (f"{ORDINALS[part]} {name}", one) for one in map(with_unscaled_priors, fits(rest, [start]))
            ]
    return tuple(found)


ORDINALS = ("first", "second", "third")


def disagreement(fit: Fit, robot: int, measured: JointMeasurements) -> Disagreement:
    """Return by how much the pose of a robot differs without one of the parts of the ranges, the worst.

    A fit without a part counts also if it has not converged: it moves away.
    """
    own, worst, what = slice(3 * robot, 3 * robot + 3), 0.0, "without a part"
    for part, without in fits_without_parts(fit, robot, measured):
        away = without.poses[robot] - fit.poses[robot]
        away[2] = wrap(float(away[2]))
        variances, axes = eigh(without.covariance[own, own])
        if not variances[0] > 0.0:
            continue
        white = axes / np.sqrt(variances)
        shares, turned = eigh(product(product(white.T, fit.covariance[own, own]), white))
        off = np.square(product(product(away[None], white), turned)[0])
        chi2 = float(np.sum(off / (1.0 - np.clip(shares, 0.0, MOST_KNOWN))))
        if chi2 > worst:
            worst, what = chi2, f"without the {part} of the ranges"
    return Disagreement(f"{what}, it is {math.sqrt(worst):.2g} sigmas off", chi2_p_value(worst, 3))
