"""The rivals of a claim: the likeliest poses that are so far from it that it would be wrong.

The covariance of a fit describes the likelihood near its maximum. Where the possible poses lie along a bent
valley, or where an outlier passes as an inlier because the fit has moved towards it, poses many sigmas away
may be nearly as likely as the claimed ones. They are found by fits in which one coordinate of a robot is held
there and everything else is free, the weights of the ranges included (a profile likelihood).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian.fitted import Fit
from agent.estimation.gaussian.fitted_poses import last_poses
from agent.estimation.gaussian.hypotheses import ScoredHypothesis
from agent.estimation.gaussian.inference import PlanningHypothesis, to_second_order
from agent.estimation.gaussian.least_squares import HeldFit, held_fits
from agent.estimation.gaussian.linear_model import Problem
from agent.estimation.gaussian.odometry_noise import Array
from agent.estimation.gaussian.range_model import PairRanges, Ranges
from protocol.mission import Mission

WRONG_SIGMAS = 5.0
"""The number of claimed sigmas from which on the referee calls a claim wrong."""

HELD_STEPS = 5
"""The Gauss-Newton steps of a fit with a held coordinate.

The first one leads to the held place, and the weights of the ranges follow within two or three.
"""

FAR_ANCHOR = 1e3
"""The distance of an anchor to which a range holds a coordinate, in R: it measures along one direction."""

HOLDING_SIGMA = 1e-3
"""The sigma of that range, as a fraction of the distance from the claim at which it holds a coordinate."""


class Rival(NamedTuple):
    """The likeliest poses that would make a claim wrong."""

    robot: int
    """The robot whose claim they would make wrong: 0 or 1."""
    log_likelihood_ratio: float
    """The log-likelihood of all ranges under these poses, less that under the claimed ones."""
    hypothesis: PlanningHypothesis
    """The poses of both robots, for planning, with the covariance of the claimed ones.

    The probability is the likelihood ratio, and at most 1.
    """


@lru_cache(maxsize=2)
def likeliest_rival(
    fitted: Fit, pair: PairRanges, claimed: PlanningHypothesis, robots: tuple[int, ...]
) -> Rival:
    """Return the likeliest rival of the claims of `robots` (0 and 1), which follow from `fitted`.

    `claimed` contains the poses and the covariance of both robots. The coordinate that is held is that along
    the longest axis of the ellipse of a robot's position.
    """
    _, covariance = to_second_order(claimed, pair.apart)
    rivals = []
    for robot in robots:
        i = 3 * robot
        variances, axes = np.linalg.eigh(covariance[i : i + 2, i : i + 2])
        along, far = axes[:, 1], WRONG_SIGMAS * math.sqrt(float(np.sum(variances)))
        place = claimed.poses[i : i + 2] - robot * np.array(pair.apart)
        anchor = place - FAR_ANCHOR * pair.sensing_range * along
        held, row = _holding(pair, robot, anchor, math.hypot(*(place - anchor)), HOLDING_SIGMA * far)
        (here,) = held_fits(held, fitted, row, np.zeros(1), 0)
        there = held_fits(held, fitted, row, np.array((far, -far)), HELD_STEPS)
        best = max(there, key=lambda one: one.log_likelihood)
        rivals.append(_rival(robot, best, best.log_likelihood - here.log_likelihood, claimed, pair))
    return max(rivals, key=lambda one: one.log_likelihood_ratio)


def _rival(
    robot: int, held: HeldFit, log_likelihood_ratio: float, claimed: PlanningHypothesis, pair: PairRanges
) -> Rival:
    """Return the rival of the claim of `robot` whose poses are those of the fit `held`."""
    mean = last_poses(held.guess, held.paths, pair.apart)
    probability = math.exp(min(log_likelihood_ratio, 0.0))
    return Rival(robot, log_likelihood_ratio, PlanningHypothesis(probability, mean, claimed.covariance))


def _holding(pair: PairRanges, robot: int, anchor: Array, rho: float, sigma: float) -> tuple[Problem, int]:
    """Return the problem of `pair` with one more range, which holds a coordinate of a robot, and its row.

    It is one of the last tick to an `anchor` far away, whose position (m) is relative to the robot's own. No
    error that ranges have in common affects it.
    """
    ranges, noise = pair.ranges, pair.noise
    row = sum(ranges.counts[: robot + 1])
    first, second, mutual = [count + (kind == robot) for kind, count in enumerate(ranges.counts)]
    anchors = np.zeros((len(ranges.rho) + 1, 2))
    anchors[row] = anchor
    held = Ranges(
        np.insert(ranges.rho, row, rho),
        np.insert(ranges.tick, row, len(pair.paths[robot].v)),
        np.insert(ranges.sigma, row, sigma),
        (first, second, mutual),
        anchors,
        np.insert(np.repeat(np.arange(3), ranges.counts), row, 3),
    )
    problem = Problem.of(pair.paths, held, noise, pair.apart)
    common, slow = np.insert(ranges.common_errors(noise.priors), row, 0.0, 0), problem.slow
    scale = problem.scale
    if scale is not None:
        scale[row] = 0.0
    if slow is not None:
        slow = slow.copy()
        slow[row] = slow[:, row] = 0.0
    return problem._replace(common=common, scale=scale, slow=slow), row


def blocking_rival(
    scored: Sequence[ScoredHypothesis],
    claimed: PlanningHypothesis,
    pair: PairRanges,
    mission: Mission,
    robots: tuple[int, ...],
) -> Rival | None:
    """Return the likeliest rival of the claims of `robots` if it is too likely for a claim, else None.

    A rival may be as likely as other hypotheses may be probable: 1 - confidence.
    """
    rival = likeliest_rival(scored[0].fit, pair, claimed, robots)
    return rival if rival.log_likelihood_ratio > _allowed_ratio(mission) else None


def _allowed_ratio(mission: Mission) -> float:
    """Return the largest log-likelihood ratio that a rival of a claim may have."""
    return math.log1p(-mission.confidence)


def rival_reason(rival: Rival, mission: Mission) -> str:
    """Return why `rival` blocks a claim."""
    ratio, allowed = rival.log_likelihood_ratio, _allowed_ratio(mission)
    return (
        f"poses {WRONG_SIGMAS:g} sigmas away explain the ranges nearly as well: "
        f"their log-likelihood ratio is {ratio:.3g}, allowed {allowed:.3g}"
    )
