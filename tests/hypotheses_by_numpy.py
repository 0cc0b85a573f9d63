"""The text of `hypotheses.c` with numpy: initial guesses, detections, and costs of manoeuvres."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from agent.estimation.elementary import cos, dot, hypot, product, quadratic, sin, solve
from agent.estimation.fit import Fit, deviation
from agent.estimation.gaussian.anchor_guesses import (
    MOST_GUESSES,
    POLISHINGS,
    POSITION_FINER,
    SAME_POSITION,
    TWINS,
    UNLIKELY,
    _odometry_variance,
    couples,
)
from agent.estimation.gaussian.evidence import CLEAR, EDGE, SILENT
from agent.estimation.gaussian.joint_ranges import JointMeasurements, Silence
from agent.estimation.gaussian.odometry_noise import Array, Places, Track, rigid_effects
from agent.estimation.gaussian.placement_guesses import (
    CROWD,
    FINER_TURN,
    HEADING_DAMPING,
    MERGED_WITHIN,
    OFFSETS,
    RIDGE_BETWEEN,
    SCAN,
    STARTS,
    TURN,
    WIDE,
    Encounter,
)
from agent.estimation.gaussian.planning_hypotheses import PlanningHypothesis
from agent.estimation.gaussian.range_model import SIGMA_FLOOR, inlier_probability, log_likelihood
from agent.planning.active_sensing import (
    FARTHEST_PLANNED,
    NEAREST,
    NEAREST_TO_ANCHOR,
    NEGLIGIBLE_GAIN,
    OUTSIDE_COST,
    OUTSIDE_COST_ALONE,
    Objective,
    _after,
    _confusion,
    _effects,
    _information,
    _position_variance,
)
from agent.planning.strides import Choice
from protocol.mission import Mission
from protocol.motion import rotated, rotated_back

ARCCOS, ARCTAN2 = np.vectorize(math.acos), np.vectorize(math.atan2)
"""The functions of the C library; those of numpy may differ in the last bit."""


class Residuals(NamedTuple):
    """The residuals of n guesses for a placement, with N mutual ranges."""

    residuals: Array
    """The measured minus the predicted ranges (m); shape (n, N)."""
    jacobian: Array
    """The derivatives of the predicted ranges by the first unknowns; shape (n, N, unknowns)."""
    gap: Array
    """The vector (m) between the robots at the middle range; shape (n, 2)."""


def anchors_by_numpy(own: JointMeasurements, known: Sequence[Sequence[float]] = ()) -> Array:
    """Return the guesses for an anchor; see `anchor_guesses.anchors`."""
    points = np.concatenate((np.array(known).reshape(-1, 2), _crossings(own)))
    if not len(points):
        return points
    variance = np.square(own.ranges.sigma) + _odometry_variance(own) + own.loosened
    return _polished(points, own, np.sqrt(variance))


def position_variances_by_numpy(path: Track, white: Array, patterns: Array) -> Array:
    """Return the variances of positions; see `odometry_noise.position_variances`."""
    effects, rigid = rigid_effects(path), np.zeros((3, 3, len(path.x)))
    by_white = np.add.reduce(effects[:, None] * effects * white, 2)
    np.add.accumulate(by_white, -1, out=rigid[..., 1:])
    for pattern in patterns:
        constant = np.add.accumulate(np.add.reduce(effects * pattern, 1), -1)
        rigid[..., 1:] += constant[:, None] * constant
    x, y, turned = path.x, path.y, rigid[2, 2]
    found: Array = rigid[0, 0] + rigid[1, 1] + 2.0 * (x * rigid[1, 2] - y * rigid[0, 2])
    found += (np.square(x) + np.square(y)) * turned
    return np.maximum(found, 0.0, out=found)


def _crossings(own: JointMeasurements) -> Array:
    """Return the intersections (m) of each two range circles, in the frame of the odometry; shape (n, 2).

    If noise keeps two circles apart, a point between them is used.
    """
    path, ranges = own.paths[0], own.ranges
    if len(ranges.rho) < 2:
        return np.empty((0, 2))
    i, j = couples(len(ranges.rho))
    x, y, rho = path.x[ranges.tick], path.y[ranges.tick], ranges.rho
    dx, dy = x[j] - x[i], y[j] - y[i]
    apart = hypot(dx, dy)
    some = apart > SIGMA_FLOOR
    i, j, dx, dy, apart = i[some], j[some], dx[some], dy[some], apart[some]
    along = (apart**2 + rho[i] ** 2 - rho[j] ** 2) / (2.0 * apart)
    across = np.sqrt(np.maximum(rho[i] ** 2 - along**2, 0.0))
    points = [
        np.stack(
            (
                (x[i] + (along * dx - s * across * dy) / apart),
                (y[i] + (along * dy + s * across * dx) / apart),
            ),
            1,
        )
        for s in (1.0, -1.0)
    ]
    return np.concatenate(points)


def _polished(points: Array, own: JointMeasurements, sigma: Array) -> Array:
    """Return the most likely of `points` after refinement on all ranges, without duplicates; shape (n, 2)."""
    path, ranges, noise, sensing_range = own.paths[0], own.ranges, own.noise, own.reach
    x, y, rho = path.x[ranges.tick], path.y[ranges.tick], ranges.rho
    near = SAME_POSITION * sensing_range

    def residuals_at(points: Array) -> tuple[Array, Array, Array, Array]:
        dx, dy = x - points[:, :1], y - points[:, 1:]
        distance = np.maximum(hypot(dx, dy), SIGMA_FLOOR)
        return rho - distance, dx / distance, dy / distance, distance

    for step in range(POLISHINGS):
        s = hypot(sigma, near * POSITION_FINER**step)
        residual, ux, uy, _ = residuals_at(points)
        weight = inlier_probability(residual, s, noise) / np.square(s)
        wx, wy = weight * ux, weight * uy
        xx, xy, yy = np.add.reduce(wx * ux, 1), np.add.reduce(wx * uy, 1), np.add.reduce(wy * uy, 1)
        gx, gy = -np.add.reduce(wx * residual, 1), -np.add.reduce(wy * residual, 1)
        damping = 1e-6 * (xx + yy) + 1e-12
        xx, yy = xx + damping, yy + damping
        determinant = xx * yy - xy * xy
        change = np.stack(((yy * gx - xy * gy) / determinant, (xx * gy - xy * gx) / determinant), 1)
        longest = np.maximum(np.abs(change).max(1, keepdims=True), 1e-12)
        points = points + change * np.minimum(1.0, 0.5 * sensing_range / longest)
    likely = log_likelihood(residuals_at(points)[0], hypot(sigma, near * POSITION_FINER**POLISHINGS), noise)
    return _best(points, likely, near * POSITION_FINER + TWINS * float(np.min(sigma)))


def _best(points: Array, likely: Array, near: float) -> Array:
    """Return the most likely points, with more than `near` m between any two."""
    left = np.flatnonzero(likely >= np.max(likely) - UNLIKELY)
    left = left[np.argsort(-likely[left], kind="stable")]
    chosen: list[int] = []
    while len(left) and len(chosen) < MOST_GUESSES:
        chosen.append(int(left[0]))
        left = left[np.abs(points[left] - points[left[0]]).sum(1) > near]
    return points[chosen]


def _scanned(
    near: Encounter, far: Encounter, i: int, rho: float, apart: tuple[float, float], lever: Array
) -> Array:
    """Return the guesses from the mutual range `rho` (m) with index `i`; shape (n, 8).

    The columns are the rotations of the near and of the far robot, and the whitened offset of each.
    """
    own = max(math.hypot(far.x[i], far.y[i]), SIGMA_FLOOR)
    outwards = product(np.array(((far.x[i], far.y[i], 0.0),)) / own, far.root)[0]
    uncertainty = math.sqrt(dot(outwards, outwards))
    offsets = OFFSETS if uncertainty > WIDE * math.tau / SCAN * lever[0] else OFFSETS[:1]
    turn = np.linspace(-math.pi, math.pi, SCAN if len(offsets) == 1 else SCAN // 2, endpoint=False)
    c, s = cos(turn), sin(turn)
    x = apart[0] + c * near.x[i] - s * near.y[i]
    y = apart[1] + s * near.x[i] + c * near.y[i]
    gap = np.maximum(hypot(x, y), SIGMA_FLOOR)
    bearing = ARCTAN2(y, x) - math.atan2(far.y[i], far.x[i])
    guesses = []
    for offset in offsets:
        radius = max(own + offset * uncertainty, SIGMA_FLOOR)
        opening = ARCCOS(np.clip((gap**2 + radius**2 - rho**2) / (2.0 * gap * radius), -1.0, 1.0))
        for way in (1.0, -1.0):
            z = np.zeros((len(turn), 8))
            z[:, 0], z[:, 1] = turn, bearing + way * opening
            if offset:
                z[:, 5:8] = offset * outwards / uncertainty
            guesses.append(z)
    return np.concatenate(guesses)


def turned_by_numpy(
    robots: tuple[Encounter, Encounter],
    middle: int,
    rho: Array,
    sigma: Array,
    apart: tuple[float, float],
    lever: Array,
    pair: JointMeasurements,
) -> Array:
    """Return the likeliest rotations and offsets, with their log-likelihoods; see `placement_guesses`."""
    ends = sorted({0, len(rho) - 1})
    z = np.concatenate([_scanned(robots[0], robots[1], i, float(rho[i]), apart, lever) for i in ends])
    residuals_at = partial(_residuals_at, robots=robots, middle=middle, rho=rho, apart=apart)
    coarse = 3.0 * math.tau / SCAN * float(lever[0])
    finest = float(np.min(sigma))
    steps = max(POLISHINGS + 1, 1 + math.ceil(math.log(finest / coarse) / math.log(FINER_TURN)))
    for step in range(steps):
        s = hypot(sigma, coarse * FINER_TURN**step)
        unknowns = 8 if len(z) <= CROWD else 2  # of the many guesses of the scan, only the rotations
        residuals, jacobian, _ = residuals_at(z, unknowns)
        weight = inlier_probability(residuals, s, pair.noise) / np.square(s)
        weighted = np.swapaxes(jacobian * weight[..., None], 1, 2)
        information = product(weighted, jacobian)
        gradient = product(weighted, residuals[..., None])[..., 0]
        gradient[:, 2:] -= z[:, 2:unknowns]
        each = np.arange(unknowns)
        diagonal = information[:, each, each]
        diagonal[:, 2:] += 1.0
        diagonal[:, :2] += HEADING_DAMPING * FINER_TURN**step * diagonal[:, :2].sum(1, keepdims=True) + 1e-12
        information[:, each, each] = diagonal
        change = solve(information, gradient[..., None])[..., 0]
        longest = np.maximum(np.abs(change[:, :2]).max(1, keepdims=True), 1e-12)
        z[:, :unknowns] += change * np.minimum(1.0, TURN / longest)
        if len(z) > CROWD:
            likely, gap = _likelihood(z, hypot(sigma, coarse * FINER_TURN ** (step + 1)), residuals_at, pair)
            z = z[_thinned(z, likely, gap, lever, SAME_POSITION * pair.reach)]
    found = likeliest(z, hypot(sigma, coarse * FINER_TURN**steps), residuals_at, lever, pair)
    return np.column_stack(found)


def _thinned(z: Array, likely: Array, gap: Array, lever: Array, near: float) -> list[int]:
    """Return the indices of the likeliest of `z` in each cell of `near` m, at most CROWD."""
    cells = np.concatenate((np.remainder(z[:, :2], math.tau) * lever, gap), 1) / near
    taken: dict[tuple[int, ...], int] = {}
    order = np.argsort(-likely, kind="stable")
    some = order[likely[order] >= likely[order[0]] - UNLIKELY]
    for i, cell in zip(some.tolist(), np.round(cells[some]).astype(np.intp).tolist(), strict=True):
        if taken.setdefault(tuple(cell), i) == i and len(taken) == CROWD:
            break
    return list(taken.values())


def _likelihood(
    z: Array, sigma: Array, residuals_at: Callable[..., Residuals], pair: JointMeasurements
) -> tuple[Array, Array]:
    """Return the log-likelihood of `z`, (n,), and the vector between the robots, (n, 2), in m."""
    residuals, _, gap = residuals_at(z)
    return log_likelihood(residuals, sigma, pair.noise) - 0.5 * np.sum(np.square(z[:, 2:]), 1), gap


def _residuals_at(
    z: Array,
    unknowns: int = 0,
    *,
    robots: tuple[Encounter, Encounter],
    middle: int,
    rho: Array,
    apart: tuple[float, float],
) -> Residuals:
    """Return the residuals of `z`, and their derivatives by the first `unknowns`: 0, 2 (rotations) or 8."""
    moved = []
    for i, one in enumerate(robots):
        offset = product(z[:, 2 + 3 * i : 5 + 3 * i], one.root.T)
        qx, qy = one.x - one.x[middle], one.y - one.y[middle]
        x = one.x + offset[:, :1] - offset[:, 2:] * qy
        y = one.y + offset[:, 1:2] + offset[:, 2:] * qx
        c, s = cos(z[:, i : i + 1]), sin(z[:, i : i + 1])
        moved.append((*rotated(c, s, x, y), c, s, qx, qy))
    (nx, ny, *_), (fx, fy, *_) = moved
    dx, dy = fx - nx - apart[0], fy - ny - apart[1]
    distance = np.maximum(hypot(dx, dy), SIGMA_FLOOR)
    gap = np.stack((dx[:, middle], dy[:, middle]), 1)
    jacobian = np.empty((*distance.shape, unknowns))
    if not unknowns:
        return Residuals(rho - distance, jacobian, gap)
    ux, uy = dx / distance, dy / distance
    jacobian[..., 0] = ux * ny - uy * nx
    jacobian[..., 1] = uy * fx - ux * fy
    if unknowns == 2:
        return Residuals(rho - distance, jacobian, gap)
    for i, (_, _, c, s, qx, qy) in enumerate(moved):
        sign = 1.0 if i else -1.0
        along, across = (sign * part for part in rotated_back(c, s, ux, uy))
        by_offset = np.stack((along, across, across * qx - along * qy), -1)
        jacobian[..., 2 + 3 * i : 5 + 3 * i] = product(by_offset, robots[i].root)
    return Residuals(rho - distance, jacobian, gap)


def likeliest(
    z: Array,
    sigma: Array,
    residuals_at: Callable[..., Residuals],
    lever: Array,
    pair: JointMeasurements,
) -> tuple[Array, Array]:
    """Return the most likely of `z`, at most STARTS, and their log-likelihoods, the likeliest first.

    Two guesses are merged if the robots' positions differ by less than MERGED_WITHIN R, unless the
    likelihood falls between them.
    """
    likely, gap = _likelihood(z, sigma, residuals_at, pair)
    near = MERGED_WITHIN * pair.reach + TWINS * float(np.min(sigma))
    left = np.flatnonzero(likely >= np.max(likely) - UNLIKELY)
    left = left[np.argsort(-likely[left], kind="stable")]
    chosen: list[int] = []
    while len(left) and len(chosen) < STARTS:
        best = int(left[0])
        chosen.append(best)
        way = z[left] - z[best]
        way[:, :2] = np.remainder(way[:, :2] + math.pi, math.tau) - math.pi
        distance = np.abs(way[:, 0]) * lever[0] + np.abs(way[:, 1]) * lever[1]
        distance += np.abs(gap[left] - gap[best]).sum(1)
        other = distance > near
        close = np.flatnonzero(~other[1:]) + 1
        if len(close):
            between, _ = _likelihood(z[best] + 0.5 * way[close], sigma, residuals_at, pair)
            other[close] = between < likely[left[close]] - RIDGE_BETWEEN
        left = left[other]
    return z[chosen], likely[chosen]


def detections_by_numpy(one: Fit, measured: JointMeasurements) -> float:
    """Return the log-likelihood of all detections and of the ticks without one, given the fit.

    It is 0 if a missing range says nothing.
    """
    weight = 0.0
    for silence in measured.silent:
        if silence.second < 0:
            ranged = measured.ranges.tick[measured.ranges.to_anchors(silence.first)]
            weight += _anchor_log_likelihood(one, silence, ranged, measured)
        else:
            weight += _mutual_log_likelihood(one, silence, measured)
    return weight


def _mutual_log_likelihood(one: Fit, silence: Silence, measured: JointMeasurements) -> float:
    """Return the log-likelihood of no detection between two robots at the ticks without one."""
    first, second, silent = silence
    if not len(silent):
        return 0.0
    (wx, wy), (vx, vy) = (one.places(robot, silent) for robot in (first, second))
    dx, dy = wx - vx, wy - vy
    distance = hypot(dx, dy)
    k = int(np.argmin(distance))
    beyond = distance - measured.reach
    if beyond[k] > CLEAR * measured.reach:
        return 0.0
    nx, ny = dx[k] / max(distance[k], SIGMA_FLOOR), dy[k] / max(distance[k], SIGMA_FLOOR)
    gradient, pivot = np.zeros(one.start.poses.size), one.problem.measured.pivot
    for robot, at, sign in ((first, (wx[k], wy[k]), 1.0), (second, (vx[k], vy[k]), -1.0)):
        x, y = at - pivot[robot]
        theta = one.start.poses[robot, 2]
        c, s = math.cos(theta), math.sin(theta)
        along, across = rotated_back(c, s, nx, ny)
        gradient[3 * robot : 3 * robot + 3] = (-sign * along, -sign * across, sign * (ny * x - nx * y))
    sigma = math.hypot(deviation(quadratic(one.of_start, gradient)), EDGE * measured.reach)
    return _no_detection_log_likelihood(beyond, sigma, measured.noise.drop_outs)


def _anchor_log_likelihood(one: Fit, silence: Silence, ranged: Places, measured: JointMeasurements) -> float:
    """Return the log-likelihood of detections by the anchor at `ranged`, and of none in the `silence`."""
    robot, weight, reach = silence.first, 0.0, measured.reach
    columns = slice(3 * robot, 3 * robot + 2)
    place = one.of_start[columns, columns]
    anchor, turn = one.problem.measured.pivot[robot], one.start.poses[robot, 2]
    c, s = math.cos(turn), math.sin(turn)
    for ticks, sign in ((silence.ticks, 1.0), (ranged, -1.0)):
        if not len(ticks):
            continue
        x, y = one.places(robot, ticks) - anchor[:, None]
        beyond = sign * (hypot(x, y) - reach)
        worst = int(np.argmin(beyond))
        if beyond[worst] > CLEAR * reach:
            continue
        along = np.array(rotated_back(c, s, x[worst], y[worst]))
        u = along / max(math.hypot(x[worst], y[worst]), SIGMA_FLOOR)
        sigma = math.hypot(deviation(quadratic(place, u)), EDGE * reach)
        if sign > 0.0:
            weight += _no_detection_log_likelihood(beyond, sigma, measured.noise.drop_outs)
        else:
            weight += _log_cdf(float(beyond[worst]) / sigma)
    return weight


def _no_detection_log_likelihood(beyond: Array, sigma: float, drop_outs: float) -> float:
    """Return the log-likelihood of no detection at several ticks.

    `beyond` is the predicted distance (m) beyond R at each of these ticks. The prediction has an error of
    standard deviation `sigma` (m), which is common to all ticks because they lie on one path. A tick within R
    has no detection with the probability `drop_outs`.
    """
    if not len(beyond):
        return 0.0
    margins = np.sort(beyond)[:SILENT] / max(sigma, SIGMA_FLOOR)
    if not drop_outs:
        return _log_cdf(float(margins[0]))
    likelihood, below = 0.0, 0.0
    for n, margin in enumerate([*margins.tolist(), math.inf]):
        up_to = 0.5 * math.erfc(-margin / math.sqrt(2.0))
        likelihood += drop_outs**n * (up_to - below)
        below = up_to
    return math.log(max(likelihood, 1e-300))


def _log_cdf(x: float) -> float:
    """Return the logarithm of the standard normal distribution function."""
    if x > -30.0:
        return math.log(0.5 * math.erfc(-x / math.sqrt(2.0)))
    return -0.5 * x * x - math.log(-x * math.sqrt(2.0 * math.pi))


# --- poses to second order ----------------------------------------------------------------------------


def second_order_by_numpy(hypothesis: PlanningHypothesis, m2: tuple[float, float]) -> tuple[Array, Array]:
    """Return the mean and the covariance of both poses; see `planning_hypotheses.to_second_order`."""
    mean, covariance = hypothesis.poses.copy(), hypothesis.covariance
    bx, by = mean[3] - m2[0], mean[4] - m2[1]
    ax, ay = mean[0] - mean[3], mean[1] - mean[4]
    # gradients of range and bearing of b, then of a from b, with respect to the poses
    rows, second = np.zeros((4, 6)), np.zeros((6, 4, 4))
    for k, (x, y), moved in ((0, (bx, by), (3,)), (2, (ax, ay), (0, 3))):
        rho = max(math.hypot(x, y), SIGMA_FLOOR)
        for row, (gx, gy) in ((k, (x / rho, y / rho)), (k + 1, (-y / rho**2, x / rho**2))):
            for i, sign in zip(moved, (1.0, -1.0), strict=False):
                rows[row, i : i + 2] = sign * gx, sign * gy
        for i in (0,) if k else (0, 3):
            second[i, k + 1, k + 1], second[i + 1, k + 1, k + 1] = -x, -y
            second[i, k, k + 1] = second[i, k + 1, k] = -y / rho
            second[i + 1, k, k + 1] = second[i + 1, k + 1, k] = x / rho
    polar, scale = product(product(rows, covariance), rows.T), np.ones(4)
    for k in (1, 3):
        scale[k] = min(1.0, 1.0 / math.sqrt(max(polar[k, k], 1e-300)))
    curved = product(second, polar * scale[:, None] * scale)
    mean += 0.5 * np.trace(curved, axis1=1, axis2=2)
    return mean, covariance + 0.5 * product(curved.reshape(6, 16), curved.mT.reshape(6, 16).T)


# --- the costs of manoeuvres --------------------------------------------------------------------------


def own_costs_by_numpy(
    ways: Choice,
    hypotheses: Sequence[PlanningHypothesis],
    mission: Mission,
    within: float | None,
    objective: Objective,
) -> Array:
    """Return the costs of `active_sensing.own_costs`."""
    best = hypotheses[0]
    reach = mission.sensing_range
    distances = []
    for one in hypotheses:
        x, y = ways.ends(one.poses)
        distances.append(np.maximum(hypot(x, y), SIGMA_FLOOR))
        if one is best:
            ux, uy = x / distances[0], y / distances[0]
    sigma = max(mission.noise.anchor_sigma, NEGLIGIBLE_GAIN * mission.accuracy)
    weight = (distances[0] <= reach) / sigma**2
    information = _information(best.covariance, mission)
    xx = information[0, 0] + np.sum(weight * ux * ux, 1)
    xy = information[0, 1] + np.sum(weight * ux * uy, 1)
    yy = information[1, 1] + np.sum(weight * uy * uy, 1)
    cost: Array = (xx + yy) / np.maximum(xx * yy - xy * xy, 1e-300) / mission.accuracy**2
    cost += _confusion(hypotheses, distances, sigma, reach)
    cost[-1] += objective.standing_cost
    limit = within if within is not None else reach
    for one, distance in zip(hypotheses, distances, strict=True):
        cost += one.probability * OUTSIDE_COST * np.maximum(0.0, NEAREST_TO_ANCHOR * reach - distance[:, 0])
        margin = math.sqrt(max(0.0, float(np.trace(one.covariance)))) if within is None else 0.0
        loss = OUTSIDE_COST if within is not None else OUTSIDE_COST_ALONE
        cost += one.probability * loss * np.maximum(0.0, distance[:, 0] + min(margin, 0.1 * reach) - limit)
    return cost


def joint_costs_by_numpy(
    ways: Choice,
    moving: int,
    other: int,
    hypotheses: Sequence[PlanningHypothesis],
    m2: tuple[float, float],
    mission: Mission,
    objective: Objective,
) -> Array:
    """Return the costs of `active_sensing.joint_costs`."""
    count, given = len(ways.v), np.array([other])
    of_a, of_b = (given, np.arange(count)) if moving else (np.arange(count), given)
    reach = mission.sensing_range
    own_sigma = max(mission.noise.anchor_sigma, NEGLIGIBLE_GAIN * mission.accuracy)
    sigma = max(mission.noise.mutual_sigma, NEGLIGIBLE_GAIN * mission.accuracy)
    anchors = ((0.0, 0.0), m2)
    distances = []
    cost = np.zeros(count)
    for one in hypotheses:
        ax, ay = ways.ends(one.poses[:3], of_a)
        bx, by = ways.ends(one.poses[3:], of_b)
        dx, dy = ax - bx, ay - by
        distance = np.maximum(hypot(dx, dy), SIGMA_FLOOR)
        distances.append(distance)
        off_anchor = hypot(bx[:, 0] - m2[0], by[:, 0] - m2[1])
        for beyond, loss in (
            (distance[:, 0] - FARTHEST_PLANNED * reach, objective.outside_cost),
            (off_anchor - FARTHEST_PLANNED * reach, objective.outside_cost),
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
            moved = x - one.poses[3 * robot], y - one.poses[3 * robot + 1]
            ox, oy = x - anchors[robot][0], y - anchors[robot][1]
            rho = np.maximum(hypot(ox, oy), SIGMA_FLOOR)
            own, own_rows = (rho <= reach) / rho / own_sigma, slice((robot + 1) * ahead, (robot + 2) * ahead)
            effects = zip(_effects(nx, ny, *moved), _effects(ox, oy, *moved), strict=True)
            for i, (of_mutual, of_own) in enumerate(effects, 3 * robot):
                rows[:, :ahead, i], rows[:, own_rows, i] = sign * of_mutual * weight, of_own * own
        after = _after(one.covariance, rows, mission)
        for i, (x, y) in ((0, (ax, ay)), (3, (bx, by))):
            variance = _position_variance(after, i, x[:, -1] - one.poses[i], y[:, -1] - one.poses[i + 1])
            cost += variance / mission.accuracy**2
    cost += _confusion(hypotheses, distances, sigma, reach)
    cost[-1] += objective.standing_cost
    return cost
