"""Initial guesses for the placement of both robots in <W>, from closed forms of a few mutual ranges.

One robot is rotated through all headings, and a mutual range leaves two headings of the other. Each guess is
refined by Gauss-Newton on all mutual ranges. Ticks without a detection are ignored.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from agent.estimation.elementary import arccos, arctan2, cos, dot, eigh, hypot, product, sin, solve, summed
from agent.estimation.fit import Fit, Start
from agent.estimation.gaussian.anchor_guesses import (
    POLISHINGS,
    SAME_POSITION,
    SEED_RANGES,
    TWINS,
    UNLIKELY,
    spread_out,
)
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.odometry_noise import (
    Array,
    Errors,
    OdometryNoiseModel,
    Places,
    Projection,
    attributed,
    constant_effects,
    corrected,
    spread,
    symmetric,
    wander,
)
from agent.estimation.gaussian.range_model import SIGMA_FLOOR, inlier_probability, log_likelihood
from protocol.motion import rotated, rotated_back

SCAN = 72
"""The number of headings that are tried for the robot nearer to its anchor.

With several radii of the other robot's circle, half as many."""

MERGED_WITHIN = 0.1
"""The distance, as a fraction of R, below which placements are merged.

A fit moves by itself along directions that the ranges leave undetermined.
"""

OFFSETS = (0.0, 1.0, -1.0, 2.0, -2.0)
"""The offsets of the far robot from its anchor's circle that are scanned, in sigmas of its radius."""

WIDE = 0.25
"""The sigma of that radius, in steps of the scan, from which on other offsets than 0 are scanned.

Gauss-Newton bridges smaller ones."""

RIDGE_BETWEEN = 2.0
"""The log-likelihood by which two candidates must exceed that between them to be two, however near they are.

Without it, two exact placements 0.01 rad apart are one; with much less, rounding makes one candidate two."""

HEADING_DAMPING = 1e-3
"""The damping of headings in the first refinement, as a fraction of their information."""

CROWD = 60
"""The number of candidates that are kept between refinements."""

STARTS = 12
"""The number of placements from which fits begin."""

LEAST_OFFSET = 1e-9
"""The sigma (m, rad) of an offset below which it is not attributed to anything."""

FINER_TURN = 0.2
"""The factor by which the expected error of a heading decreases at each step of the refinement."""

TURN = 0.3
"""The largest change of a heading (rad) in one of these steps."""

SHORTEST_LEVER = 0.03
"""The least lever that is assumed for a heading, as a fraction of R."""


class Placed(NamedTuple):
    """A candidate for the placement of both robots in <W>, by the mutual ranges."""

    start: Start
    log_likelihood: float
    """The log-likelihood of the mutual ranges used, and of the offsets, up to a constant."""


class Residuals(NamedTuple):
    """The residuals of n candidates for a placement, with N mutual ranges."""

    residuals: Array
    """The measured minus the predicted ranges (m); shape (n, N)."""
    jacobian: Array
    """The derivatives of the predicted ranges by the first unknowns; shape (n, N, unknowns)."""
    gap: Array
    """The vector (m) between the robots at the middle range; shape (n, 2)."""


class Encounter(NamedTuple):
    """One robot at the encounter, from the ranges to its own anchor alone.

    Its position relative to its anchor, and its heading, are known up to one offset, which is common to all
    mutual ranges: the uncertainty of the anchor, and the odometry noise since the last range to it.
    """

    x: Array
    """The x (m) at the ticks of the mutual ranges, relative to the anchor, in the frame of the odometry."""
    y: Array
    root: Array
    """A square root of the covariance of the offset in x, y and heading; shape (3, 3)."""
    inverse: Array
    """The transposed pseudo-inverse of `root`; shape (3, 3)."""
    of_anchor: Array
    """The part of that covariance that is due to the anchor; shape (3, 3)."""
    odometry: tuple[OdometryNoiseModel, Projection] | None
    """The odometry noise since the last range to the anchor, and the offset as rows; None if it is exact."""
    since: int
    """The tick of that range."""

    def begun(self, own: Fit, z: Array) -> tuple[Array, tuple[Errors, ...]]:
        """Return the anchor (m) and the odometry errors for the whitened offset `z`, shape (3,)."""
        weights = product(self.inverse, z[:, None])[:, 0]
        anchor = own.guess[:2] - product(self.of_anchor[:2], weights[:, None])[:, 0]
        if self.odometry is None:
            return anchor, own.start.errors
        model, rows = self.odometry
        patterns = own.problem.measured.patterns[0].copy()
        patterns[:, :, : self.since] = 0.0
        constant = product(constant_effects(model, rows)[:-1], weights[:, None])[:, 0]
        more = attributed(model, rows, weights) + summed(constant, patterns)
        (begun,) = own.start.errors
        return anchor, (Errors(begun.v + more[0], begun.omega + more[1], begun.constant),)


def _encounter(own: Fit, base: int, ticks: Places) -> Encounter:
    """Return the robot of the fit `own` at `ticks`, with its offset at the tick `base`."""
    x, y = own.places(0, ticks)
    of_anchor = np.zeros((3, 3))
    of_anchor[:2, :2] = own.of_start[:2, :2]
    covariance, odometry, since = of_anchor, None, 0
    if own.problem.weighing.noisy:
        earlier = own.ticks[own.ticks <= base]
        since = int(earlier[-1]) if len(earlier) else 0
        of, (errors,) = own.problem.measured, own.start.errors
        correction = np.stack((errors.v, errors.omega)) + summed(errors.constant, of.patterns[0])
        path = corrected(np.stack((of.v[0], of.omega[0])), correction, of.period, of.slip[0])
        model = wander(path, correction, of.patterns[0], of.white[0]).since(since)
        rows = Projection.pose(path, base)
        odometry = (model, rows)
        constant = constant_effects(model, rows)[:-1]
        covariance = of_anchor + symmetric(*spread(model, rows), rows.ticks) + product(constant.T, constant)
    variances, axes = eigh(covariance)
    sigmas = np.sqrt(np.maximum(variances, 0.0))
    inverse = axes * np.where(sigmas > LEAST_OFFSET, 1.0 / np.maximum(sigmas, LEAST_OFFSET), 0.0)
    return Encounter(x, y, axes * sigmas, inverse, of_anchor, odometry, since)


def placements(own: tuple[Fit, Fit], pair: JointMeasurements) -> list[Placed]:
    """Return the most likely starts of a fit of both robots, given the mutual ranges, the likeliest first.

    `own` contains a fit of each robot to the ranges to its anchor. Their odometry noise before the encounter
    is not noise of each mutual range: it moves all of them at once. The unknowns are therefore the rotations
    of both frames, and one offset of each robot (see `Encounter`).

    The robot nearer to its anchor is rotated through all headings. One mutual range then leaves two headings
    of the other robot, at the intersections of the circles about its anchor and about the first robot
    (Section III.C with one circle rotated). The circle about its anchor is also tried with other radii,
    within its uncertainty. The other mutual ranges determine which candidates are likely.
    """
    mutual = np.flatnonzero(pair.ranges.mutual)
    places = pair.mutual_places if len(pair.mutual_places) >= SEED_RANGES else np.arange(len(mutual))
    some = mutual[places[spread_out(len(places))]]
    ticks, rho = pair.ranges.tick[some], pair.ranges.rho[some]
    sigma = np.sqrt(np.square(pair.ranges.sigma[some]) + pair.loosened[some])
    middle = len(ticks) // 2
    robots = [_encounter(one, int(ticks[middle]), ticks) for one in own]
    radii = [float(np.mean(hypot(one.x, one.y))) for one in robots]
    near, far = (0, 1) if radii[0] < radii[1] else (1, 0)
    sign = 1.0 if far == 0 else -1.0
    between = (pair.pivots[1] - pair.pivots[0]).tolist()
    apart = (sign * between[0], sign * between[1])  # from the far robot's anchor to the near one's
    lever = np.array([max(radii[robot], SHORTEST_LEVER * pair.reach) for robot in (near, far)])
    ends = sorted({0, len(ticks) - 1})
    z = np.concatenate([_scanned(robots[near], robots[far], i, float(rho[i]), apart, lever) for i in ends])
    z, likely = _turned(z, (robots[near], robots[far]), middle, rho, sigma, apart, lever, pair)
    found = []
    for one, likelihood in zip(z, likely.tolist(), strict=True):
        poses, errors = np.empty((2, 3)), []
        for i, robot in enumerate((near, far)):
            (mx, my), more = robots[robot].begun(own[robot], one[2 + 3 * i : 5 + 3 * i])
            turn, (at_x, at_y) = float(one[i]), pair.pivots[robot]
            dx, dy = rotated(math.cos(turn), math.sin(turn), mx, my)
            poses[robot] = at_x - dx, at_y - dy, turn
            errors.append(more)
        in_order = errors if near == 0 else errors[::-1]
        found.append(Placed(Start(poses, tuple([one for more in in_order for one in more])), likelihood))
    return found


def _scanned(
    near: Encounter, far: Encounter, i: int, rho: float, apart: tuple[float, float], lever: Array
) -> Array:
    """Return the candidates from the mutual range `rho` (m) with index `i`; shape (n, 8).

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
    bearing = arctan2(y, x) - math.atan2(far.y[i], far.x[i])
    candidates = []
    for offset in offsets:
        radius = max(own + offset * uncertainty, SIGMA_FLOOR)
        opening = arccos(np.clip((gap**2 + radius**2 - rho**2) / (2.0 * gap * radius), -1.0, 1.0))
        for way in (1.0, -1.0):
            z = np.zeros((len(turn), 8))
            z[:, 0], z[:, 1] = turn, bearing + way * opening
            if offset:
                z[:, 5:8] = offset * outwards / uncertainty
            candidates.append(z)
    return np.concatenate(candidates)


def _turned(
    z: Array,
    robots: tuple[Encounter, Encounter],
    middle: int,
    rho: Array,
    sigma: Array,
    apart: tuple[float, float],
    lever: Array,
    pair: JointMeasurements,
) -> tuple[Array, Array]:
    """Return the most likely of `z` after refinement by Gauss-Newton, with their log-likelihoods.

    The noise of the search decreases from the resolution of the scan to that of the ranges, because
    candidates between which the ranges distinguish would otherwise be merged.
    """
    residuals_at = partial(_residuals_at, robots=robots, middle=middle, rho=rho, apart=apart)
    coarse = 3.0 * math.tau / SCAN * float(lever[0])
    finest = float(np.min(sigma))
    steps = max(POLISHINGS + 1, 1 + math.ceil(math.log(finest / coarse) / math.log(FINER_TURN)))
    for step in range(steps):
        s = hypot(sigma, coarse * FINER_TURN**step)
        unknowns = 8 if len(z) <= CROWD else 2  # of the many candidates of the scan, only the rotations
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
    return _likeliest(z, hypot(sigma, coarse * FINER_TURN**steps), residuals_at, lever, pair)


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


def _likeliest(
    z: Array,
    sigma: Array,
    residuals_at: Callable[..., Residuals],
    lever: Array,
    pair: JointMeasurements,
) -> tuple[Array, Array]:
    """Return the most likely of `z`, at most STARTS, and their log-likelihoods, the likeliest first.

    Two candidates are merged if the robots' positions differ by less than MERGED_WITHIN R, unless the
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
