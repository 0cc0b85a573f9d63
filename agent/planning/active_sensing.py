"""Active sensing with noisy sensors: the manoeuvre whose next ranges are expected to be most informative.

The cost of a manoeuvre is the sum of two expectations after it: the probability of confusing the most
probable hypothesis with another (Bhattacharyya bound, from the differences of the predicted ranges), and the
variance of the positions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache, lru_cache
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian.inference import PlanningHypothesis
from agent.estimation.gaussian.odometry_noise import Array, Places
from agent.estimation.gaussian.range_model import SIGMA_FLOOR
from agent.planning import separation
from agent.planning.range_seeking import Beacon
from protocol.mission import Mission, Role
from protocol.motion import REST, Controls

STRIDE_LENGTH = 0.25
"""The minimum length of a manoeuvre, as a fraction of R. A manoeuvre lasts as many ticks as that takes."""

AHEAD = 3
"""The number of strides over which a manoeuvre is evaluated, as if it were continued."""

TURNS = 17
"""The number of values of omega that are compared, from -omega_max to omega_max."""

SPEEDS = (1.0, -1.0, 0.5, -0.5)
"""The values of v that are compared, in units of A_0 / T_s."""

SLOW = (0.1, -0.1)
"""Additional values of v in the same units, for small gaps when there is a safety distance."""

NEGLIGIBLE = 0.03
"""The standard deviation below which a further improvement has no value, as a fraction of the accuracy."""

CONFUSION_COST = 10.0
"""The cost of taking a wrong hypothesis, in variances as large as the required accuracy."""

OUTSIDE_COST = 1e3
"""The cost per m in a place without informative ranges, in variances as large as the required accuracy."""

OUTSIDE_COST_ALONE = 10.0
"""The OUTSIDE_COST of a robot that plans for its anchor alone; each tick improves its position estimate.

It also is that of stalled robots, to which a missing range tells which hypothesis is false.
"""

STALLED_COST = 1e9
"""The cost of standing still for a stalled robot (see `stalls`)."""


class Surveying(msgspec.Struct, frozen=True):
    """The robot drives to where its next ranges are expected to be most informative."""

    beacon: Beacon
    command: Controls = REST
    since: int = 0
    """The tick of the first of the consecutive plans of which this is the last."""


class Listening(msgspec.Struct, frozen=True):
    """The robot stands still in range of the peer, and waits for the missing part of the peer's log."""

    command: Controls = REST


class Retreating(msgspec.Struct, frozen=True):
    """The robot has left the peer's range. It drives back the same way, and as far again.

    The second half prevents that it takes the same decision, and leaves the range, once more.
    """

    command: Controls
    since: int
    """The tick in which the peer was out of range for the first time."""


def stride(mission: Mission) -> int:
    """Return the number of ticks of a manoeuvre. Ranges from nearer points are hardly more informative."""
    return max(1, round(STRIDE_LENGTH * mission.sensing_range / mission.first_straight))


class Choice(NamedTuple):
    """The C manoeuvres that are compared, with end points relative to the starting pose."""

    v: Array
    omega: Array
    along: Array
    """The distance in m along the initial heading after each stride; (C, AHEAD)."""
    across: Array
    """The distance in m to the left of it; (C, AHEAD)."""
    way_along: Array
    """The distance in m along the initial heading at CHORDS times during the first stride; (C, CHORDS)."""
    way_across: Array


@cache
def choice(mission: Mission) -> Choice:
    """Return all manoeuvres of a robot. The last one is to stand still."""
    period = stride(mission) * mission.period
    fastest = min(mission.max_turn_rate, math.pi / period)
    speeds = SPEEDS + SLOW if mission.safety_distance else SPEEDS
    omega, speed = np.meshgrid(
        np.linspace(-fastest, fastest, TURNS), mission.first_straight / mission.period * np.array(speeds)
    )
    v = np.append(speed.ravel(), 0.0)
    turn = np.append(omega.ravel(), 0.0)
    half = 0.5 * period * turn
    chord = period * v * np.sinc(half / math.pi)
    course = half[:, None] * (2.0 * np.arange(AHEAD) + 1.0)
    share = half[:, None] * np.arange(1, separation.CHORDS + 1) / separation.CHORDS
    way = (
        period
        * v[:, None]
        * np.arange(1, separation.CHORDS + 1)
        / separation.CHORDS
        * np.sinc(share / math.pi)
    )
    return Choice(
        v,
        turn,
        np.cumsum(chord[:, None] * np.cos(course), 1),
        np.cumsum(chord[:, None] * np.sin(course), 1),
        way * np.cos(share),
        way * np.sin(share),
    )


def _choice(mission: Mission, stalled: bool) -> Choice:
    """Return the manoeuvres to compare; for stalled robots with the first stride alone."""
    ways = choice(mission)
    return ways._replace(along=ways.along[:, :1], across=ways.across[:, :1]) if stalled else ways


def plan_alone(
    hypotheses: Sequence[PlanningHypothesis],
    mission: Mission,
    within: float | None = None,
    *,
    stalled: bool = False,
) -> Controls:
    """Return the manoeuvre whose ranges to the anchor are expected to be most informative.

    The anchor is the origin, and the covariance of each hypothesis is that of the anchor's position. `within`
    is the largest allowed distance from the anchor in m. A `stalled` robot moves, and counts one stride only.
    """
    ways = _choice(mission, stalled)
    best = hypotheses[0]
    reach = mission.sensing_range
    distances = []
    for one in hypotheses:
        x, y = _ends(ways, one.poses)
        distances.append(np.maximum(np.hypot(x, y), SIGMA_FLOOR))
        if one is best:
            ux, uy = x / distances[0], y / distances[0]
    sigma = max(mission.noise.anchor_sigma, NEGLIGIBLE * mission.accuracy)
    weight = (distances[0] <= reach) / sigma**2
    information = _information(best.covariance, mission)
    xx = information[0, 0] + np.sum(weight * ux * ux, 1)
    xy = information[0, 1] + np.sum(weight * ux * uy, 1)
    yy = information[1, 1] + np.sum(weight * uy * uy, 1)
    cost = (xx + yy) / np.maximum(xx * yy - xy * xy, 1e-300) / mission.accuracy**2
    cost += _confusion(hypotheses, distances, sigma, reach)
    if stalled:
        cost[-1] += STALLED_COST
    limit = within if within is not None else reach
    for one, distance in zip(hypotheses, distances, strict=True):
        cost += one.probability * OUTSIDE_COST * np.maximum(0.0, NEAREST_TO_ANCHOR * reach - distance[:, 0])
        margin = math.sqrt(max(0.0, float(np.trace(one.covariance)))) if within is None else 0.0
        loss = OUTSIDE_COST if within is not None else OUTSIDE_COST_ALONE
        cost += one.probability * loss * np.maximum(0.0, distance[:, 0] + min(margin, 0.1 * reach) - limit)
    i = int(np.argmin(cost))
    return Controls(float(ways.v[i]), float(ways.omega[i]))


def plan_together(
    hypotheses: Sequence[PlanningHypothesis],
    m2: tuple[float, float],
    rho: float,
    mission: Mission,
    *,
    stalled: bool = False,
    resting: Role | None = None,
) -> tuple[Controls, Controls]:
    """Return the manoeuvres of a and b after which both poses are expected to be known best.

    The covariance of each hypothesis is that of both poses, (6, 6), relative to M1. M2 is at `m2`. First, b's
    manoeuvre is selected as if a stood still, then a's, given b's. Neither robot comes nearer to the other
    than the safety distance under any hypothesis; `rho` is the latest range between them in m. If no
    manoeuvre meets this condition, both stand still. Of `stalled` robots, b moves, one stride alone counts,
    and to leave the range costs little. A robot that is `resting` has claimed its pose, and stands still; the
    other one moves.
    """
    return _planned_together(tuple(hypotheses), m2, rho, mission, stalled, resting)


@lru_cache(maxsize=2)
def _planned_together(
    hypotheses: tuple[PlanningHypothesis, ...],
    m2: tuple[float, float],
    rho: float,
    mission: Mission,
    stalled: bool,
    resting: Role | None,
) -> tuple[Controls, Controls]:
    """Return the manoeuvres of `plan_together`, which both robots of one process ask for."""
    ways = _choice(mission, stalled)
    stand = len(ways.v) - 1
    still, every = np.array([stand]), np.arange(stand + 1)
    outside, standing = (OUTSIDE_COST_ALONE, STALLED_COST) if stalled else (OUTSIDE_COST, 0.0)
    a = b = stand
    if resting != "b":
        _, b = _best_of(ways, hypotheses, m2, rho, mission, still, every, outside, standing)
    if resting != "a":
        of_a = standing if resting == "b" else 0.0
        a, _ = _best_of(ways, hypotheses, m2, rho, mission, every, np.array([b]), outside, of_a)
    return (
        Controls(float(ways.v[a]), float(ways.omega[a])),
        Controls(float(ways.v[b]), float(ways.omega[b])),
    )


def _best_of(
    ways: Choice,
    hypotheses: Sequence[PlanningHypothesis],
    m2: tuple[float, float],
    latest: float,
    mission: Mission,
    of_a: Places,
    of_b: Places,
    outside: float,
    standing: float = 0.0,
) -> tuple[int, int]:
    """Return the best pair of manoeuvres from `of_a` and `of_b`, one of which contains a single manoeuvre.

    `outside` is the cost per m out of range, and `standing` that of the last pair, in which both stand still.
    """
    reach = mission.sensing_range
    own_sigma = max(mission.noise.anchor_sigma, NEGLIGIBLE * mission.accuracy)
    sigma = max(mission.noise.mutual_sigma, NEGLIGIBLE * mission.accuracy)
    anchors = ((0.0, 0.0), m2)
    count = max(len(of_a), len(of_b))
    distances = []
    cost = np.zeros(count)
    for one in hypotheses:
        ax, ay = _ends(ways, one.poses[:3], of_a)
        bx, by = _ends(ways, one.poses[3:], of_b)
        dx, dy = ax - bx, ay - by
        distance = np.maximum(np.hypot(dx, dy), SIGMA_FLOOR)
        distances.append(distance)
        off_anchor = np.hypot(bx[:, 0] - m2[0], by[:, 0] - m2[1])
        for beyond, loss in (
            (distance[:, 0] - FARTHEST * reach, outside),
            (off_anchor - FARTHEST * reach, outside),
            (NEAREST * reach - np.min(distance, 1), OUTSIDE_COST),
            (NEAREST_TO_ANCHOR * reach - off_anchor, OUTSIDE_COST),
        ):
            cost += one.probability * loss * np.maximum(0.0, beyond)
        if one is not hypotheses[0]:
            continue
        ahead = distance.shape[1]
        rows = np.zeros((count, 3 * ahead, 6))
        nx, ny = dx / distance, dy / distance
        weight = (distance <= reach) / sigma
        for robot, (x, y), sign in ((0, (ax, ay), 1.0), (1, (bx, by), -1.0)):
            px, py = one.poses[3 * robot : 3 * robot + 2]
            i = 3 * robot
            rows[:, :ahead, i] = sign * nx * weight
            rows[:, :ahead, i + 1] = sign * ny * weight
            rows[:, :ahead, i + 2] = sign * (ny * (x - px) - nx * (y - py)) * weight
            ox, oy = x - anchors[robot][0], y - anchors[robot][1]
            rho = np.maximum(np.hypot(ox, oy), SIGMA_FLOOR)
            own = (rho <= reach) / rho / own_sigma
            own_rows = slice((robot + 1) * ahead, (robot + 2) * ahead)
            rows[:, own_rows, i] = ox * own
            rows[:, own_rows, i + 1] = oy * own
            rows[:, own_rows, i + 2] = (oy * (x - px) - ox * (y - py)) * own
        covariance_after = np.linalg.inv(
            _information(one.covariance, mission) + np.swapaxes(rows, 1, 2) @ rows
        )
        for i, (x, y) in ((0, (ax, ay)), (3, (bx, by))):
            dx, dy = x[:, -1] - one.poses[i], y[:, -1] - one.poses[i + 1]
            variance = (
                covariance_after[:, i, i]
                + covariance_after[:, i + 1, i + 1]
                + (dx * dx + dy * dy) * covariance_after[:, i + 2, i + 2]
            )
            variance += 2.0 * (dx * covariance_after[:, i + 1, i + 2] - dy * covariance_after[:, i, i + 2])
            cost += variance / mission.accuracy**2
    cost += _confusion(hypotheses, distances, sigma, reach)
    cost[-1] += standing
    if mission.safety_distance:
        cost[~_keep_apart(ways, hypotheses, latest, mission, of_a, of_b)] = np.inf
        cost[-1] = min(cost[-1], STANDING_COST)
    i = int(np.argmin(cost))
    return int(of_a[i if len(of_a) > 1 else 0]), int(of_b[i if len(of_b) > 1 else 0])


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
        (ax, ay), (bx, by) = _way(ways, one.poses[:3], of_a), _way(ways, one.poses[3:], of_b)
        relative = one.covariance[:2, :2] + one.covariance[3:5, 3:5] - 2.0 * one.covariance[:2, 3:5]
        uncertainty = separation.SIGMAS * math.sqrt(max(0.0, float(np.trace(relative))))
        least = (
            np.min(np.hypot(ax - bx, ay - by), 1) - 0.5 * lengths_of_both / separation.CHORDS - uncertainty
        )
        allowed &= least >= mission.safety_distance
    return allowed | (lengths_of_both <= separation.leeway(rho, mission))


STANDING_COST = 1e300
"""The cost of standing still where every manoeuvre, this one included, might violate the safety distance."""

FARTHEST = 0.9
"""The largest planned distance between the robots, and from b to its anchor, as a fraction of R."""

NEAREST = 0.2
"""The smallest planned distance between the robots, as a fraction of R.

From nearer points, a range contains little information about the direction, and the robots might collide.
"""

NEAREST_TO_ANCHOR = 0.06
"""The smallest planned distance from the anchor, as a fraction of R.

From nearer points, odometry noise would leave open on which side of the anchor the robot is.
"""


def _information(covariance: Array, mission: Mission) -> Array:
    """Return the inverse of `covariance`, with variances limited to those of 2 R and half a turn."""
    variances, axes = np.linalg.eigh(covariance)
    most = max(4.0 * mission.sensing_range**2, math.pi**2)
    information: Array = (
        axes / (np.clip(variances, 0.0, most) + (NEGLIGIBLE * mission.accuracy) ** 2) @ axes.T
    )
    return information


def _confusion(
    hypotheses: Sequence[PlanningHypothesis], distances: Sequence[Array], sigma: float, reach: float
) -> Array:
    """Return the expected cost of confusing the first hypothesis with another."""
    remaining = np.zeros(len(distances[0]))
    first = np.minimum(distances[0], FARTHEST_PREDICTION * reach)
    for one, distance in zip(hypotheses[1:], distances[1:], strict=True):
        gap = np.square((np.minimum(distance, FARTHEST_PREDICTION * reach) - first) / (SIGMA_FACTOR * sigma))
        remaining += math.sqrt(hypotheses[0].probability * one.probability) * np.exp(
            -np.minimum(np.sum(gap, 1), LARGEST_GAP) / 8.0
        )
    return CONFUSION_COST * remaining


FARTHEST_PREDICTION = 1.2
"""The largest predicted range that is distinguished from others, as a fraction of R. It is out of range."""

SIGMA_FACTOR = 1.5
"""The factor by which ranges count as noisier than they are, because the poses are uncertain too."""

LARGEST_GAP = 400.0
"""The largest squared difference of predictions in sigmas^2. Larger ones do not distinguish better."""


def _way(ways: Choice, pose: Array, some: Places) -> tuple[Array, Array]:
    """Return the positions in m along the first stride of the manoeuvres `some` from `pose`; (C, CHORDS)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    along, across = ways.way_along[some], ways.way_across[some]
    return pose[0] + c * along - s * across, pose[1] + s * along + c * across


def _ends(ways: Choice, pose: Array, some: Places | slice = slice(None)) -> tuple[Array, Array]:
    """Return the positions in m after each stride of the manoeuvres `some` from `pose`; (C, AHEAD)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    along, across = ways.along[some], ways.across[some]
    return pose[0] + c * along - s * across, pose[1] + s * along + c * across
