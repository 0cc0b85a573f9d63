"""Active sensing with noisy sensors: the manoeuvre whose next ranges are expected to be most informative.

The cost of a manoeuvre is the sum of two expectations after it: the probability of confusing the most
probable hypothesis with another (Bhattacharyya bound, from the differences of the predicted ranges), and the
variance of the positions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.estimation.compiled import address, library
from agent.estimation.elementary import eigh, exp, hypot, inverted, product
from agent.estimation.gaussian.odometry_noise import Array, Places, Track
from agent.estimation.gaussian.planning_hypotheses import PlanningHypothesis
from agent.estimation.gaussian.range_model import SIGMA_FLOOR
from agent.estimation.smoother import Singular
from agent.planning import separation
from agent.planning.state import RobotState
from agent.planning.strides import STRIDES_AHEAD, Choice, choice, is_stalled, stride
from agent.planning.tasks import Beacon, Surveying
from protocol.mission import HEADING_ACCURACY, Mission, Role
from protocol.motion import Controls

NEGLIGIBLE_GAIN = 0.03
"""The standard deviation below which a further improvement has no value, as a fraction of the accuracy."""

CONFUSION_COST = 10.0
"""The cost of taking a wrong hypothesis, in variances as large as the required accuracy."""

OUTSIDE_COST = 1e3
"""The cost per m in a place without informative ranges, in variances as large as the required accuracy."""

OUTSIDE_COST_ALONE = 10.0
"""The OUTSIDE_COST of a robot that plans for its anchor alone; each tick improves its position estimate.

It is also that of stalled robots, to which a missing range tells which hypothesis is false.
"""

STALLED_COST = 1e9
"""The cost of standing still for a stalled robot (see `strides`)."""


class Objective(NamedTuple):
    """The values by which manoeuvres are compared, apart from what their ranges tell."""

    strides: int
    """The number of strides over which a manoeuvre is evaluated, as if it were continued."""
    outside_cost: float
    """The cost per m out of range of the peer, or of b out of range of its anchor; see OUTSIDE_COST."""
    standing_cost: float
    """The cost of standing still."""


CONTINUED = Objective(STRIDES_AHEAD, OUTSIDE_COST, 0.0)
"""The objective of robots that get further with each plan."""

STALLED = Objective(1, OUTSIDE_COST_ALONE, STALLED_COST)
"""The objective of stalled robots: the next stride counts alone, and they move (see `strides`)."""


def next_objective(state: RobotState, beacon: Beacon, paths: Sequence[Track]) -> tuple[int, Objective]:
    """Return the tick of the first of the consecutive plans about `beacon`, and the next objective.

    `paths` are those of the robots that plan together.
    """
    match state.task:
        case Surveying(before, _, since) if before == beacon:
            mission = state.config.mission
            return since, STALLED if is_stalled(paths, since, stride(mission), mission) else CONTINUED
        case _:
            return state.tick, CONTINUED


def plan_alone(
    hypotheses: Sequence[PlanningHypothesis],
    mission: Mission,
    within: float | None = None,
    objective: Objective = CONTINUED,
) -> Controls:
    """Return the manoeuvre whose ranges to the anchor are expected to be most informative.

    The anchor is the origin, and the covariance of each hypothesis is that of the anchor's position. `within`
    is the largest allowed distance from the anchor in m. The `outside_cost` of the objective does not count:
    that of a robot alone is OUTSIDE_COST_ALONE, or OUTSIDE_COST beyond `within`.
    """
    ways = choice(mission, objective.strides)
    return ways.controls(int(np.argmin(own_costs(ways, hypotheses, mission, within, objective))))


def own_costs(
    ways: Choice,
    hypotheses: Sequence[PlanningHypothesis],
    mission: Mission,
    within: float | None,
    objective: Objective,
) -> Array:
    """Return the cost of each manoeuvre of a robot alone, (C,); see `plan_alone`."""
    reach, limit = mission.sensing_range, within
    sigma = max(mission.noise.anchor_sigma, NEGLIGIBLE_GAIN * mission.accuracy)
    margins, loss = np.zeros(len(hypotheses)), OUTSIDE_COST
    if limit is None:
        sigmas = [math.sqrt(max(0.0, float(np.trace(one.covariance)))) for one in hypotheses]
        margins, loss, limit = np.minimum(sigmas, 0.1 * reach), OUTSIDE_COST_ALONE, reach
    by = _weighed(mission, sigma, sigma, limit, loss, objective.standing_cost)
    information, cost = _information(hypotheses[0].covariance, mission), np.empty(len(ways.v))
    given = map(address, (margins, information, cost))
    library().own_costs(by, *_ways(ways), *_poses(hypotheses), *given)
    return cost


@lru_cache(maxsize=2)  # both robots of one process ask for it
def plan_together(
    hypotheses: tuple[PlanningHypothesis, ...],
    m2: tuple[float, float],
    rho: float,
    mission: Mission,
    *,
    objective: Objective = CONTINUED,
    resting: Role | None = None,
) -> tuple[Controls, Controls]:
    """Return the manoeuvres of a and b after which both poses are expected to be known best.

    The covariance of each hypothesis is that of both poses, (6, 6), relative to M1. M2 is at `m2`. First, b's
    manoeuvre is selected as if a stood still, then a's, given b's. Neither robot comes nearer to the other
    than the safety distance under any hypothesis; `rho` is the latest range between them in m. If no
    manoeuvre meets this condition, both stand still. The robot in the role `resting` has claimed its pose and
    stands still: only the manoeuvre of the other one is selected. The `standing_cost` of the objective counts
    for b; for a only if b is resting.
    """
    ways = choice(mission, objective.strides)
    stand = len(ways.v) - 1
    a = b = stand
    given = (hypotheses, m2, rho, mission, _information(hypotheses[0].covariance, mission))
    if resting != "b":
        b = int(np.argmin(joint_costs(ways, 1, stand, *given, objective)))
    if resting != "a":
        of_a = objective if resting == "b" else objective._replace(standing_cost=0.0)
        a = int(np.argmin(joint_costs(ways, 0, b, *given, of_a)))
    return ways.controls(a), ways.controls(b)


def joint_costs(
    ways: Choice,
    moving: int,
    other: int,
    hypotheses: Sequence[PlanningHypothesis],
    m2: tuple[float, float],
    rho: float,
    mission: Mission,
    information: Array,
    objective: Objective,
) -> Array:
    """Return the cost of each manoeuvre of the robot `moving` (0 or 1), (C,); see `plan_together`.

    The other one executes the manoeuvre with the index `other`, and `information` is that on both poses. The
    cost is infinite if the safety distance might be violated, except that of the last one, which is to stand.
    """
    own_sigma = max(mission.noise.anchor_sigma, NEGLIGIBLE_GAIN * mission.accuracy)
    sigma = max(mission.noise.mutual_sigma, NEGLIGIBLE_GAIN * mission.accuracy)
    farthest, outside = FARTHEST_PLANNED * mission.sensing_range, objective.outside_cost
    by = _weighed(mission, sigma, own_sigma, farthest, outside, objective.standing_cost)
    cost = np.empty(len(ways.v))
    arrays = map(address, (np.array((0.0, 0.0, *m2)), information, cost))
    if not library().joint_costs(by, *_ways(ways), moving, other, *_poses(hypotheses), *arrays):
        raise Singular("the information on the poses is singular")
    if mission.safety_distance:
        every, given = np.arange(len(cost)), np.array([other])
        pairs = (given, every) if moving else (every, given)
        cost[~_keep_apart(ways, hypotheses, rho, mission, *pairs)] = np.inf
        cost[-1] = min(cost[-1], STANDING_COST)
    return cost


def _keep_apart(
    ways: Choice,
    hypotheses: Sequence[PlanningHypothesis],
    rho: float,
    mission: Mission,
    of_a: Places,
    of_b: Places,
) -> NDArray[np.bool]:
    """Return which pairs of manoeuvres keep the safety distance under all hypotheses.

    A pair is also allowed if it is too short to violate the distance under any hypothesis.
    """
    lengths = np.abs(ways.v) * stride(mission) * mission.period
    lengths_of_both = lengths[of_a] + lengths[of_b]
    allowed = np.ones(len(lengths_of_both), dtype=np.bool)
    for one in hypotheses:
        (ax, ay), (bx, by) = ways.way(one.poses[:3], of_a), ways.way(one.poses[3:], of_b)
        relative = one.covariance[:2, :2] + one.covariance[3:5, 3:5] - 2.0 * one.covariance[:2, 3:5]
        uncertainty = separation.LARGEST_ERROR_SIGMAS * math.sqrt(max(0.0, float(np.trace(relative))))
        least = np.min(hypot(ax - bx, ay - by), 1) - 0.5 * lengths_of_both / separation.CHORDS - uncertainty
        allowed &= least >= mission.safety_distance
    return allowed | (lengths_of_both <= separation.leeway(rho, mission))


def _weighed(
    mission: Mission, sigma: float, anchor_sigma: float, farthest: float, outside: float, standing: float
) -> Any:
    """Return `Weighed` of hypotheses.c."""
    reach = mission.sensing_range
    sigmas = (sigma, anchor_sigma, anchor_sigma**2)
    of_confusion = (FARTHEST_PREDICTION * reach, SIGMA_FACTOR * sigma, LARGEST_GAP, CONFUSION_COST)
    lengths = (farthest, NEAREST * reach, NEAREST_TO_ANCHOR * reach)
    costs = (outside, OUTSIDE_COST, standing)
    return address(np.array((reach, *sigmas, mission.accuracy**2, *of_confusion, *lengths, *costs)))


def _ways(ways: Choice) -> tuple[Any, ...]:
    """Return the manoeuvres as arguments of hypotheses.c."""
    return (*ways.along.shape, address(ways.along), address(ways.across))


def _poses(hypotheses: Sequence[PlanningHypothesis]) -> tuple[Any, ...]:
    """Return the number of hypotheses, their probabilities and their poses as arguments of hypotheses.c."""
    poses = np.concatenate([one.poses for one in hypotheses])
    return len(hypotheses), address(np.array([one.probability for one in hypotheses])), address(poses)


STANDING_COST = 1e300
"""The cost of standing still where every manoeuvre, this one included, might violate the safety distance."""

FARTHEST_PLANNED = 0.9
"""The largest planned distance between the robots, and from b to its anchor, as a fraction of R."""

NEAREST = 0.2
"""The smallest planned distance between the robots, as a fraction of R.

From nearer points, a range contains little information about the direction, and the robots might collide.
"""

NEAREST_TO_ANCHOR = 0.06
"""The smallest planned distance from the anchor, as a fraction of R.

From nearer points, odometry noise would leave open on which side of the anchor the robot is.
"""


def _effects(nx: Array, ny: Array, lx: Array, ly: Array) -> tuple[Array, Array, Array]:
    """Return the derivatives of ranges along (nx, ny) by a pose, after a motion (lx, ly) from it, in m."""
    return nx, ny, ny * lx - nx * ly


def _after(covariance: Array, rows: Array, mission: Mission) -> Array:
    """Return the `covariance` after ranges whose derivatives in their sigmas are `rows`, (C, N, n)."""
    return inverted(_information(covariance, mission) + product(np.swapaxes(rows, 1, 2), rows))


def _position_variance(covariance: Array, i: int, dx: Array, dy: Array) -> Array:
    """Return the variance (m^2) of a position after a motion (dx, dy) from the pose at `i`, (C,)."""
    variance = covariance[:, i, i] + covariance[:, i + 1, i + 1]
    variance += (dx * dx + dy * dy) * covariance[:, i + 2, i + 2]
    variance += 2.0 * (dx * covariance[:, i + 1, i + 2] - dy * covariance[:, i, i + 2])
    return np.asarray(variance, np.float64)


def _information(covariance: Array, mission: Mission) -> Array:
    """Return the inverse of `covariance`, with variances limited to those of 2 R and half a turn."""
    variances, axes = eigh(covariance)
    most = max(4.0 * mission.sensing_range**2, math.pi**2)
    limited = np.clip(variances, 0.0, most) + (NEGLIGIBLE_GAIN * mission.accuracy) ** 2
    return product(axes / limited, axes.T)


def _confusion(
    hypotheses: Sequence[PlanningHypothesis], distances: Sequence[Array], sigma: float, reach: float
) -> Array:
    """Return the expected cost of confusing the first hypothesis with another."""
    remaining = np.zeros(len(distances[0]))
    first = np.minimum(distances[0], FARTHEST_PREDICTION * reach)
    for one, distance in zip(hypotheses[1:], distances[1:], strict=True):
        gap = np.square((np.minimum(distance, FARTHEST_PREDICTION * reach) - first) / (SIGMA_FACTOR * sigma))
        remaining += math.sqrt(hypotheses[0].probability * one.probability) * exp(
            -np.minimum(np.sum(gap, 1), LARGEST_GAP) / 8.0
        )
    return CONFUSION_COST * remaining


FARTHEST_PREDICTION = 1.2
"""The largest predicted range that is distinguished from others, as a fraction of R. It is out of range."""

SIGMA_FACTOR = 1.5
"""The factor by which ranges count as noisier than they are, because the poses are uncertain too."""

LARGEST_GAP = 400.0
"""The largest squared difference of predictions in sigmas^2. Larger ones do not distinguish better."""


# --- among several beacons ------------------------------------------------------------------------------


class AmongBeacons(NamedTuple):
    """A hypothesis about a robot among several beacons: anchors, and robots that are located."""

    planned: PlanningHypothesis
    """The pose of the robot, (3,)."""
    beacons: Array
    """The places (m) of the anchors and robots that it may range; (m, 2)."""
    near: Array
    """The places (m) of those of which it has to stay in range of one; (k, 2)."""
    surveyed: bool = False
    """True if the place of the first beacon is asked for; the covariance is that of the pose and of it."""


def plan_among(
    hypotheses: Sequence[AmongBeacons], sigma: float, mission: Mission, turned: float = 0.0
) -> Controls:
    """Return the manoeuvre of a robot whose ranges to several beacons are expected to be most informative.

    The most probable of the `hypotheses` is the first one; `sigma` (m) is that of a range. Without anchors,
    `turned` (rad) is the sigma of the rotation of all poses about the origin.
    """
    ways, reach = choice(mission), mission.sensing_range
    sigma = max(sigma, NEGLIGIBLE_GAIN * mission.accuracy)
    cost, distances = np.zeros(len(ways.v)), []
    for one, places, near, surveyed in hypotheses:
        x, y = ways.ends(one.poses)
        dx, dy = x[:, :, None] - places[:, 0], y[:, :, None] - places[:, 1]
        distance = np.maximum(hypot(dx, dy), SIGMA_FLOOR)
        distances.append(distance.reshape(len(cost), -1))
        nearest = np.min(distance[:, 0], 1)
        away = np.min(hypot(x[:, :1] - near[:, 0], y[:, :1] - near[:, 1]), 1)
        cost += one.probability * OUTSIDE_COST * np.maximum(0.0, away - FARTHEST_PLANNED * reach)
        cost += one.probability * OUTSIDE_COST * np.maximum(0.0, NEAREST_TO_ANCHOR * reach - nearest)
        if one is not hypotheses[0].planned:
            continue
        nx, ny, weight = dx / distance, dy / distance, (distance <= reach) / sigma
        lx, ly = x[:, :, None] - one.poses[0], y[:, :, None] - one.poses[1]
        effects = [effect * weight for effect in _effects(nx, ny, lx, ly)]
        if surveyed:
            first = np.arange(len(places)) == 0
            effects += [-effects[0] * first, -effects[1] * first]
        rows = np.stack(effects, -1).reshape(len(cost), -1, len(effects))
        after = _after(one.covariance, rows, mission)
        if surveyed:
            variance = after[:, 3, 3] + after[:, 4, 4]
        else:
            variance = _position_variance(after, 0, lx[:, -1, 0], ly[:, -1, 0])
        variance += turned**2 * (x[:, -1] ** 2 + y[:, -1] ** 2)
        cost += variance / mission.accuracy**2 + after[:, 2, 2] / HEADING_ACCURACY**2
    cost += _confusion([one.planned for one in hypotheses], distances, sigma, reach)
    cost[-1] += STALLED_COST
    return ways.controls(int(np.argmin(cost)))
