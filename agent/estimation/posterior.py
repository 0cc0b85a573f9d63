"""The hypotheses about the poses of n robots, with their probabilities by the evidence for their fits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from agent.estimation.elementary import eigh, product
from agent.estimation.fit import Fit
from agent.estimation.gaussian.hypotheses import NEGLIGIBLE_PROBABILITY, SAME_SIGMAS
from agent.estimation.smoother import Array

MOST_JOINT = 12
"""The largest number of joint hypotheses whose poses are all in more probable ones, too.

Robots that are each one of two mirror images have as many joint hypotheses as there are combinations. Only
the most probable ones are fitted; see `_representative`.
"""

MOST_POSES = 24
"""The largest number of joint hypotheses. The time of an estimate is proportional to it."""


class JointHypothesis(NamedTuple):
    """One possible explanation of all ranges of the located robots."""

    probability: float
    fit: Fit


class JointHypotheses(NamedTuple):
    """The hypotheses about all robots that are located."""

    located: tuple[int, ...]
    """The indices of the robots to which the fits belong, ascending."""
    scored: tuple[JointHypothesis, ...] = ()
    """The hypotheses, the most probable first."""


NO_HYPOTHESES = JointHypotheses(())


def with_probability(fits: Sequence[Fit]) -> tuple[JointHypothesis, ...]:
    """Return the hypotheses for `fits`, likeliest first, without duplicates and without improbable ones."""
    best = max([one.weight for one in fits], default=0.0)
    probable = [one for one in fits if one.weight >= best + math.log(NEGLIGIBLE_PROBABILITY)]
    left = _representative(sorted(probable, key=lambda one: -one.weight))
    total = sum([math.exp(one.weight - best) for one in left])
    return tuple([JointHypothesis(math.exp(one.weight - best) / total, one) for one in left])


def _representative(fits: Sequence[Fit]) -> list[Fit]:
    """Return the different ones of `fits`, the likeliest first: all in which a robot has a pose of its own.

    Of the others, which combine poses of likelier fits, they are the first ones. So no ambiguity of a robot
    is lost to the number of combinations of those of others.
    """
    left: list[Fit] = []
    for one in fits:
        agreed = [same(one, other) for other in left]
        if any(all(each) for each in agreed):
            continue
        novel = not all(any(own) for own in zip(*agreed, strict=True)) if agreed else True
        if len(left) < (MOST_POSES if novel else MOST_JOINT):
            left.append(one)
    return left


def same(one: Fit, other: Fit) -> list[bool]:
    """Return for each robot whether two fits to the same facts have the same pose, within SAME_SIGMAS."""
    change = one.poses - other.poses
    change[:, 2] = np.remainder(change[:, 2] + math.pi, math.tau) - math.pi
    blocks = [slice(3 * i, 3 * i + 3) for i in range(len(change))]
    return [
        _squared_sigmas(moved, other.covariance[own, own]) < SAME_SIGMAS**2
        for moved, own in zip(change, blocks, strict=True)
    ]


def _squared_sigmas(change: Array, covariance: Array) -> float:
    """Return change' covariance^+ change: directions without variance are left out."""
    variances, axes = eigh(covariance)
    some = variances > NO_VARIANCE * max(float(np.max(np.abs(variances))), 0.0)
    along = product(change[None], axes[:, some])[0]
    return float(np.add.reduce(np.square(along) / variances[some]))


NO_VARIANCE = 1e-15
"""The fraction of the largest variance up to which a variance is 0 by rounding."""


class Certainty(NamedTuple):
    """The joint hypotheses as far as they concern one robot."""

    poses: int
    """The number of different poses."""
    probability: float
    """The probability of the pose in the most probable hypothesis."""


def certainties(found: JointHypotheses) -> list[Certainty]:
    """Return the certainty of each located robot.

    Hypotheses that differ in others only count as one, the most probable of them. That is exact for
    ambiguities that are independent of each other, of which not all combinations are known.
    """
    result = []
    for i in range(len(found.located)):
        poses: list[JointHypothesis] = []
        for one in found.scored:
            if not any(same(one.fit, other.fit)[i] for other in poses):
                poses.append(one)
        total = sum([one.probability for one in poses])
        result.append(Certainty(len(poses), poses[0].probability / total))
    return result
