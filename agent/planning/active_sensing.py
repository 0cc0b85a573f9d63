"""Under noise: where to drive so that the next ranges tell most, alone with the anchor or with the peer.

A manoeuvre is worth what it is expected to leave: the probability of taking the wrong hypothesis (Bhattacharyya's
bound, by how many sigmas apart the ranges are that they predict), and the variance of the positions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian.odometry_noise import Array, Places
from agent.estimation.gaussian.range_model import SIGMA_FLOOR
from agent.planning import separation
from agent.planning.range_seeking import Beacon
from protocol.mission import Mission
from protocol.motion import REST, Controls

STRIDE = 0.25
"""of R: how far a manoeuvre leads at the least, in as many ticks as that takes"""

AHEAD = 3
"""strides that a manoeuvre is looked at: so long would it go on"""

TURNS = 17
"""values of omega that are compared, from -omega_max to omega_max"""

SPEEDS = (1.0, -1.0, 0.5, -0.5)
"""values of v, over A_0 / T_s"""

SLOW = (0.1, -0.1)
"""likewise, where there is a distance to keep and little room"""

FINE = 0.03
"""of the accuracy: what is known better than this need not be known better still"""

CONFUSION = 10.0
"""what taking the wrong hypothesis costs, in variances as large as the accuracy asked for"""

LOSS = 1e3
"""per m: what it costs to be where no range is to be had or none tells, likewise"""

ASTRAY = 10.0
"""per m: the same, alone with the anchor, of which more is known each tick"""


class Surveying(msgspec.Struct, frozen=True):
    """Drives where the next ranges are expected to tell most."""

    beacon: Beacon
    command: Controls = REST


class Listening(msgspec.Struct, frozen=True):
    """Stands in the peer's range, and waits for what it has not been told of it yet."""

    command: Controls = REST


class Retreating(msgspec.Struct, frozen=True):
    """Has left the peer's range: drives back as it came, and as far again, not to do the same once more."""

    command: Controls
    since: int
    """the tick in which it found itself alone"""


def stride(mission: Mission) -> int:
    """Ticks that a manoeuvre lasts: from nearer by, a range tells little more."""
    return max(1, round(STRIDE * mission.sensing_range / mission.first_straight))


class Choice(NamedTuple):
    """Manoeuvres to compare, C of them, and where each leads, relative to where it begins."""

    v: Array
    omega: Array
    along: Array
    """m, in the direction of the heading; (C, AHEAD)"""
    across: Array
    """m, to the left of it"""
    way_along: Array
    """the same at CHORDS times of the first stride; (C, CHORDS)"""
    way_across: Array


@cache
def choice(mission: Mission) -> Choice:
    """All of a robot's; the last is to stand."""
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


class PlanningHypothesis(NamedTuple):
    """A hypothesis, as far as planning needs it."""

    probability: float
    poses: Array
    """x, y in m and heading: (3,) of one robot, relative to its anchor; or (6,) of a and b, relative to M1"""
    covariance: Array
    """of the anchor's place, (2, 2); or of both poses, (6, 6)"""


def alone(held: Sequence[PlanningHypothesis], mission: Mission, within: float | None = None) -> Controls:
    """The manoeuvre whose ranges to the anchor, at the origin, are expected to tell most.

    The covariance is that of the anchor's place. `within` is how far (m) from it the robot may go.
    """
    ways = choice(mission)
    best = held[0]
    reach = mission.sensing_range
    distances = []
    for one in held:
        x, y = _ends(ways, one.poses)
        distances.append(np.maximum(np.hypot(x, y), SIGMA_FLOOR))
        if one is best:
            ux, uy = x / distances[0], y / distances[0]
    sigma = max(mission.noise.anchor_sigma, FINE * mission.accuracy)
    weight = (distances[0] <= reach) / sigma**2
    information = _information(best.covariance, mission)
    xx = information[0, 0] + np.sum(weight * ux * ux, 1)
    xy = information[0, 1] + np.sum(weight * ux * uy, 1)
    yy = information[1, 1] + np.sum(weight * uy * uy, 1)
    cost = (xx + yy) / np.maximum(xx * yy - xy * xy, 1e-300) / mission.accuracy**2
    cost += _confusion(held, distances, sigma, reach)
    limit = within if within is not None else reach
    for one, distance in zip(held, distances, strict=True):
        cost += one.probability * LOSS * np.maximum(0.0, ASIDE * reach - distance[:, 0])
        margin = math.sqrt(max(0.0, float(np.trace(one.covariance)))) if within is None else 0.0
        loss = LOSS if within is not None else ASTRAY
        cost += one.probability * loss * np.maximum(0.0, distance[:, 0] + min(margin, 0.1 * reach) - limit)
    i = int(np.argmin(cost))
    return Controls(float(ways.v[i]), float(ways.omega[i]))


def together(
    held: Sequence[PlanningHypothesis], m2: tuple[float, float], rho: float, mission: Mission
) -> tuple[Controls, Controls]:
    """The manoeuvres of a and b after which both know best where they are.

    The covariance is that of both poses, (6, 6), relative to M1; M2 is at `m2`. First b's is chosen, as if a
    stood; then a's, as b will drive. Neither comes nearer to the other than the safety distance, whichever
    hypothesis is true; `rho` is the latest range between them. If all would, they stand.
    """
    ways = choice(mission)
    stand = len(ways.v) - 1
    still = np.array([stand])
    _, b = _best_of(ways, held, m2, rho, mission, still, np.arange(stand + 1))
    a, _ = _best_of(ways, held, m2, rho, mission, np.arange(stand + 1), np.array([b]))
    return (
        Controls(float(ways.v[a]), float(ways.omega[a])),
        Controls(float(ways.v[b]), float(ways.omega[b])),
    )


def _best_of(
    ways: Choice,
    held: Sequence[PlanningHypothesis],
    m2: tuple[float, float],
    latest: float,
    mission: Mission,
    of_a: Places,
    of_b: Places,
) -> tuple[int, int]:
    """Of the ways `of_a` and `of_b`, one of which is a single one."""
    reach = mission.sensing_range
    own_sigma = max(mission.noise.anchor_sigma, FINE * mission.accuracy)
    sigma = max(mission.noise.mutual_sigma, FINE * mission.accuracy)
    anchors = ((0.0, 0.0), m2)
    count = max(len(of_a), len(of_b))
    distances = []
    cost = np.zeros(count)
    for one in held:
        ax, ay = _ends(ways, one.poses[:3], of_a)
        bx, by = _ends(ways, one.poses[3:], of_b)
        dx, dy = ax - bx, ay - by
        distance = np.maximum(np.hypot(dx, dy), SIGMA_FLOOR)
        distances.append(distance)
        off_anchor = np.hypot(bx[:, 0] - m2[0], by[:, 0] - m2[1])
        for beyond in (
            distance[:, 0] - MARGIN * reach,
            off_anchor - MARGIN * reach,
            APART * reach - np.min(distance, 1),
            ASIDE * reach - off_anchor,
        ):
            cost += one.probability * LOSS * np.maximum(0.0, beyond)
        if one is not held[0]:
            continue
        rows = np.zeros((count, 3 * AHEAD, 6))
        nx, ny = dx / distance, dy / distance
        weight = (distance <= reach) / sigma
        for robot, (x, y), sign in ((0, (ax, ay), 1.0), (1, (bx, by), -1.0)):
            px, py = one.poses[3 * robot : 3 * robot + 2]
            i = 3 * robot
            rows[:, :AHEAD, i] = sign * nx * weight
            rows[:, :AHEAD, i + 1] = sign * ny * weight
            rows[:, :AHEAD, i + 2] = sign * (ny * (x - px) - nx * (y - py)) * weight
            ox, oy = x - anchors[robot][0], y - anchors[robot][1]
            rho = np.maximum(np.hypot(ox, oy), SIGMA_FLOOR)
            own = (rho <= reach) / rho / own_sigma
            own_rows = slice((robot + 1) * AHEAD, (robot + 2) * AHEAD)
            rows[:, own_rows, i] = ox * own
            rows[:, own_rows, i + 1] = oy * own
            rows[:, own_rows, i + 2] = (oy * (x - px) - ox * (y - py)) * own
        left = np.linalg.inv(_information(one.covariance, mission) + np.swapaxes(rows, 1, 2) @ rows)
        for i, (x, y) in ((0, (ax, ay)), (3, (bx, by))):
            dx, dy = x[:, -1] - one.poses[i], y[:, -1] - one.poses[i + 1]
            variance = left[:, i, i] + left[:, i + 1, i + 1] + (dx * dx + dy * dy) * left[:, i + 2, i + 2]
            variance += 2.0 * (dx * left[:, i + 1, i + 2] - dy * left[:, i, i + 2])
            cost += variance / mission.accuracy**2
    cost += _confusion(held, distances, sigma, reach)
    if mission.safety_distance:
        cost[~_keep_apart(ways, held, latest, mission, of_a, of_b)] = np.inf
        cost[-1] = min(cost[-1], STANDING)
    i = int(np.argmin(cost))
    return int(of_a[i if len(of_a) > 1 else 0]), int(of_b[i if len(of_b) > 1 else 0])


def _keep_apart(
    ways: Choice, held: Sequence[PlanningHypothesis], rho: float, mission: Mission, of_a: Places, of_b: Places
) -> NDArray[np.bool]:
    """Which of the ways keep the safety distance: by all of `held`, or too short for any to matter."""
    lengths = np.abs(ways.v) * stride(mission) * mission.period
    together = lengths[of_a] + lengths[of_b]
    kept = np.ones(len(together), dtype=np.bool)
    for one in held:
        (ax, ay), (bx, by) = _way(ways, one.poses[:3], of_a), _way(ways, one.poses[3:], of_b)
        relative = one.covariance[:2, :2] + one.covariance[3:5, 3:5] - 2.0 * one.covariance[:2, 3:5]
        unsure = separation.SIGMAS * math.sqrt(max(0.0, float(np.trace(relative))))
        least = np.min(np.hypot(ax - bx, ay - by), 1) - 0.5 * together / separation.CHORDS - unsure
        kept &= least >= mission.safety_distance
    return kept | (together <= separation.leeway(rho, mission))


STANDING = 1e300
"""what it costs to stand where every way, that one too, might lead too near"""

MARGIN = 0.9
"""of R: how far apart two robots may plan to be, and b from its anchor"""

APART = 0.2
"""of R: how near they may come; nearer, a range tells little of where, and they might touch"""

ASIDE = 0.06
"""of R: how near a robot may come to its anchor; on which side of it, drift would then leave open"""


def _information(covariance: Array, mission: Mission) -> Array:
    """Its inverse; what is hardly known counts as known to 2 R and half a turn."""
    variances, axes = np.linalg.eigh(covariance)
    most = max(4.0 * mission.sensing_range**2, math.pi**2)
    information: Array = axes / (np.clip(variances, 0.0, most) + (FINE * mission.accuracy) ** 2) @ axes.T
    return information


def _confusion(
    held: Sequence[PlanningHypothesis], distances: Sequence[Array], sigma: float, reach: float
) -> Array:
    """What is left of the probability of taking the first hypothesis for another."""
    left = np.zeros(len(distances[0]))
    first = np.minimum(distances[0], RIM * reach)
    for one, distance in zip(held[1:], distances[1:], strict=True):
        gap = np.square((np.minimum(distance, RIM * reach) - first) / (COARSE * sigma))
        left += math.sqrt(held[0].probability * one.probability) * np.exp(
            -np.minimum(np.sum(gap, 1), SURE) / 8.0
        )
    return CONFUSION * left


RIM = 1.2
"""of R: so far off, a silence tells a prediction from one in range, and how far off it was does not matter"""

COARSE = 1.5
"""by how much ranges are taken to be worse than they are, as the poses are not known either"""

SURE = 400.0
"""sigmas, squared: hypotheses that differ by more are told apart; further apart is no better"""


def _way(ways: Choice, pose: Array, some: Places) -> tuple[Array, Array]:
    """m: where the ways lead from `pose` on their first stride, (C, CHORDS)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    along, across = ways.way_along[some], ways.way_across[some]
    return pose[0] + c * along - s * across, pose[1] + s * along + c * across


def _ends(ways: Choice, pose: Array, some: Places | slice = slice(None)) -> tuple[Array, Array]:
    """m: where the ways lead from `pose`, (C, AHEAD)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    along, across = ways.along[some], ways.across[some]
    return pose[0] + c * along - s * across, pose[1] + s * along + c * across
