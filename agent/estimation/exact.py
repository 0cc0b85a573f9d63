"""Estimation with exact sensors: the possible branches in phase 1, and the possible placements in phase 3.

Closed forms yield the solutions, and all measurements test them. The sensors are exact, so the test has a
fixed tolerance in m, the floor of `protocol.rounding`. A solution that passes is refined by Gauss-Newton.
This changes nothing where the closed form is well conditioned, and restores the digits that are lost next to
a double root.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

import msgspec

from agent.estimation.closed_forms import Placement, included_angle, same_placement
from protocol.motion import Pose, compose, wrap
from protocol.rounding import SAME_ANCHORS, same_turn

POLISHING_STEPS = 12
"""The maximum number of Gauss-Newton steps; most fits stop improving after one."""

FITTED = 3
"""The number of anchor ranges from which the heading is fitted to all of them; two are met exactly."""

ADDED_CURVATURE = 1e-9
"""The fraction of a fit's curvature that is added to it, so that a step stays within what is determined."""

NEAR_DOUBLE_ROOT = 1e-6
"""The part of ADDED_CURVATURE near a double root."""

CLOSEST = 1e-12
"""The fraction of D below which a range is weighted like a range of that length."""

SINGULAR = 1e-14
"""The squared sine of the angle between two columns below which they are treated as parallel."""


class Branch(msgspec.Struct, frozen=True):
    """One of the two trajectories +-alpha that are consistent with two ranges (Section III.A)."""

    alpha: float
    """The signed angle alpha of eq. (2) in rad."""
    start: Pose
    """The pose of tick 0 of the odometry in the frame of the anchor: (rho_0, 0, heading)."""

    @property
    def anchor(self) -> tuple[float, float]:
        """Return the position (m) of the anchor in the frame of the odometry."""
        c, s = math.cos(self.start.heading), math.sin(self.start.heading)
        return -self.start.x * c, self.start.x * s

    def distance(self, odometry: Pose) -> float:
        """Return the distance (m) from the anchor at the pose `odometry`."""
        place = compose(self.start, odometry)
        return math.hypot(place.x, place.y)


def branches(rho0: float, measured_at: Pose, rho: float) -> tuple[Branch, ...]:
    """Return the trajectories with the range `rho0` at tick 0 and `rho` at the odometry pose `measured_at`.

    There are two, mirror images of each other. There is one if the motion was radial, and none if the ranges
    contradict the odometry (eq. (2)).
    """
    alpha = included_angle(rho0, rho, math.hypot(measured_at.x, measured_at.y))
    if alpha is None:
        return ()
    bearing = math.atan2(measured_at.y, measured_at.x)
    sides = (alpha, -alpha) if 0.0 < alpha < math.pi else (alpha,)
    return tuple(Branch(side, Pose(rho0, 0.0, side - bearing)) for side in sides)


def weigh_branches(
    solutions: Iterable[Branch],
    seen: Iterable[tuple[Pose, float | None]],
    sensing_range: float,
    floor: float,
    margin: float,
) -> tuple[Branch, ...]:
    """Return those of `solutions` that are consistent with every pose in `seen`, ranged or not detected.

    `floor` is the largest error (m) of a predicted range from rounding. `margin` is how far (m) inside R a
    point must be for a detection to be certain. Half of it is reserved for the error of a heading from two
    ranges.

    Two branches with the anchor at the same position are merged. This happens very close to the anchor, or if
    the motion is almost radial.
    """
    ranged: list[tuple[Pose, float]] = []
    undetected: list[Positions] = []
    for pose, rho in seen:
        if rho is None:
            undetected.append((pose.x, pose.y, 0.0, 0.0))
        else:
            ranged.append((pose, rho))
    left: list[Branch] = []
    for solution in solutions:
        branch = polished(solution, ranged)
        frame = Placement(branch.start.heading, branch.start.x, branch.start.y)
        if (
            _branch_meets(branch, ranged, floor)
            and _explains_no_detection(frame, undetected, sensing_range - 0.5 * margin)
            and not any(math.dist(branch.anchor, other.anchor) < SAME_ANCHORS * floor for other in left)
        ):
            left.append(branch)
    return tuple(left)


def anchor_error(start: Pose, ranged: Sequence[tuple[Pose, float, float]]) -> float:
    """Return how far (m) the anchor may be from its position in the branch that begins at `start`.

    Each element of `ranged` is an odometry pose, a range, and that range's floor: its largest error (m) from
    rounding. The bound is of first order. The fit uses squared ranges. At a point y off the line from the
    anchor through p_0, the derivative of the squared range with respect to the heading is 2 rho_0 y, and its
    error is 2 floor (rho + rho_0), including the error of rho_0. The anchor is rho_0 away at any heading, so
    the error is at most 2 rho_0, and zero on the anchor. The merging in `weigh_branches` adds to it.
    """
    rho0 = start.x
    c, s = math.cos(start.heading), math.sin(start.heading)
    moment = across = 0.0
    for pose, rho, floor in ranged:
        y = abs(s * pose.x + c * pose.y)
        moment += y * y
        across += floor * y * (rho + rho0)
    turned = across / moment if moment > 0.0 else math.inf
    return (1.0 + SAME_ANCHORS) * ranged[-1][2] + min(2.0 * rho0, turned)


def _branch_meets(branch: Branch, ranged: Iterable[tuple[Pose, float]], floor: float) -> bool:
    """Return whether `branch` predicts all ranges. Those below rho_0 are compared in squares, as fitted."""
    rho0 = branch.start.x
    c, s = math.cos(branch.start.heading), math.sin(branch.start.heading)
    for pose, rho in ranged:
        predicted = math.hypot(rho0 + c * pose.x - s * pose.y, s * pose.x + c * pose.y)
        if abs(predicted - rho) * (predicted + rho) > 2.0 * floor * max(rho, rho0):
            return False
    return True


def polished(branch: Branch, ranged: Sequence[tuple[Pose, float]]) -> Branch:
    """Return the branch with the heading that fits all squared ranges best (Gauss-Newton).

    Two ranges are met exactly by construction. Near a radial heading they contain no further information.
    """
    if len(ranged) < FITTED:
        return branch
    rho0, heading = branch.start.x, branch.start.heading
    measured = [(pose.x, pose.y, rho * rho) for pose, rho in ranged]
    best, fitted = math.inf, heading
    for _ in range(POLISHING_STEPS):
        c, s = math.cos(heading), math.sin(heading)
        cost = gradient = curvature = 0.0
        for pose_x, pose_y, squared in measured:
            x, y = rho0 + c * pose_x - s * pose_y, s * pose_x + c * pose_y
            error = x * x + y * y - squared
            slope = -2.0 * rho0 * y
            cost += error * error
            gradient += slope * error
            curvature += slope * slope
        if cost >= best or curvature == 0.0:
            break
        best, fitted = cost, heading
        heading -= gradient / curvature
    return Branch(wrap(branch.alpha + fitted - branch.start.heading), Pose(rho0, 0.0, fitted))


class PairObservation(msgspec.Struct, frozen=True, gc=False):
    """One tick of an encounter: each pose in the frame of the robot's anchor, and the mutual range (m)."""

    tick: int
    a: Pose
    b: Pose
    range: float | None


Positions = tuple[float, float, float, float]
"""The positions of a and of b, each in the frame of its own anchor: x and y in m."""


def weigh_placements(
    solutions: Iterable[Placement],
    pair_observations: Sequence[PairObservation],
    sensing_range: float,
    floor: float,
) -> tuple[Placement, ...]:
    """Return those of `solutions` that are consistent with every observation, ranged or not detected.

    `floor` is the largest error (m) of a predicted range from rounding, that of phase 1 included.
    """
    ranged: list[tuple[Positions, float]] = []
    undetected: list[Positions] = []
    for seen in pair_observations:
        a, b, rho = seen.a, seen.b, seen.range
        if rho is None:
            undetected.append((a.x, a.y, b.x, b.y))
        else:
            ranged.append(((a.x, a.y, b.x, b.y), rho))
    if len(ranged) <= 2:
        return _consistent(solutions, ranged, undetected, sensing_range, floor)
    every = tuple(solutions)
    for near_double_root in (False, True):
        polished = [_polished_placement(one, ranged, near_double_root) for one in every]
        if left := _consistent(polished, ranged, undetected, sensing_range, floor):
            break
    return left


def _consistent(
    solutions: Iterable[Placement],
    ranged: Sequence[tuple[Positions, float]],
    undetected: Sequence[Positions],
    sensing_range: float,
    floor: float,
) -> tuple[Placement, ...]:
    """Return the different ones of `solutions` that explain all ranges, and all ticks without one."""
    left: list[Placement] = []
    for placement in solutions:
        same = same_turn(math.hypot(placement.x, placement.y) + sensing_range)
        if (
            _explains_ranges(placement, ranged, floor)
            and _explains_no_detection(placement, undetected, sensing_range - floor)
            and not any(same_placement(placement, other, same) for other in left)
        ):
            left.append(placement)
    return tuple(left)


def _explains_ranges(placement: Placement, ranged: Iterable[tuple[Positions, float]], floor: float) -> bool:
    x, y = placement.x, placement.y
    c, s = math.cos(placement.phi), math.sin(placement.phi)
    for (ax, ay, bx, by), rho in ranged:
        if abs(math.hypot(x + c * ax - s * ay - bx, y + s * ax + c * ay - by) - rho) > floor:
            return False
    return True


def _explains_no_detection(placement: Placement, undetected: Iterable[Positions], reach: float) -> bool:
    """Return whether a is farther than `reach` m from b, or a robot from its anchor, at all positions."""
    x, y = placement.x, placement.y
    c, s = math.cos(placement.phi), math.sin(placement.phi)
    hypot = math.hypot
    for ax, ay, bx, by in undetected:
        along = x + c * ax - s * ay - bx  # a distance is at least as long as its part along an axis
        if -reach <= along <= reach and hypot(along, y + s * ax + c * ay - by) <= reach:
            return False
    return True


def turn_error(
    placement: Placement, pair_observations: Sequence[PairObservation], floor: float, anchors: float
) -> float:
    """Return the largest angle (rad) by which either robot may be rotated about its anchor from `placement`.

    The bound is of first order, for a least-squares fit to all ranges in `pair_observations`. Each range has
    its own error of at most `floor` m. The two anchors add an error of at most `anchors` m that is common to
    all ranges. The result is infinite if a rotation is undetermined, next to a double root of eq. (7).
    """
    slopes = tuple(_slopes(placement, pair_observations))
    pp, pq, qq = _information(slopes)
    determinant = pp * qq - pq * pq
    if determinant <= SINGULAR * pp * qq:
        return math.inf
    alone_a = alone_b = ax = ay = bx = by = 0.0
    for p, q, ux, uy in slopes:
        of_psi = pp * q - pq * p
        of_a = qq * p - pq * q - of_psi  # in <W>, b is rotated by -psi and a by phi - psi
        alone_a, alone_b = alone_a + abs(of_a), alone_b + abs(of_psi)
        ax, ay, bx, by = ax + of_a * ux, ay + of_a * uy, bx + of_psi * ux, by + of_psi * uy
    turned_a = floor * alone_a + anchors * math.hypot(ax, ay)
    turned_b = floor * alone_b + anchors * math.hypot(bx, by)
    return max(turned_a, turned_b) / determinant


def information(
    placement: Placement, pair_observations: Sequence[PairObservation]
) -> tuple[float, float, float]:
    """Return the Fisher information (1 / rad^2) about phi and psi, where psi is the bearing of M1 in <b(M2)>.

    The ranges have a standard deviation of 1 m. The elements are (phi, phi), (phi, psi) and (psi, psi).
    """
    return _information(_slopes(placement, pair_observations))


def _information(slopes: Iterable[tuple[float, float, float, float]]) -> tuple[float, float, float]:
    pp = pq = qq = 0.0
    for by_phi, by_psi, _, _ in slopes:
        pp += by_phi * by_phi
        pq += by_phi * by_psi
        qq += by_psi * by_psi
    return pp, pq, qq


def _slopes(
    placement: Placement, pair_observations: Sequence[PairObservation]
) -> Iterator[tuple[float, float, float, float]]:
    """Yield the derivatives of each range by phi and psi (m / rad), and the direction from b to a."""
    tx, ty = placement.x, placement.y
    for pair_observation in pair_observations:
        if pair_observation.range is None:
            continue
        there = placement.place(pair_observation.a)
        x, y = there.x - pair_observation.b.x, there.y - pair_observation.b.y
        apart = math.hypot(x, y)
        if apart > 0.0:
            ux, uy = x / apart, y / apart
            yield uy * (there.x - tx) - ux * (there.y - ty), uy * tx - ux * ty, ux, uy


def _polished_placement(
    placement: Placement, measured: Sequence[tuple[Positions, float]], near_double_root: bool
) -> Placement:
    """Return the placement near `placement` that fits all ranges best, with M1 at D from M2 (Gauss-Newton).

    The fit uses squared ranges, weighted so that a residual is an error of the range itself. Otherwise a
    short range would have no influence beside longer ones.

    The unknowns are phi and the bearing psi of M1 in <b(M2)>. Two ranges determine them exactly. More ranges
    separate solutions that eq. (7) alone yields as a double root. Near one, two ranges curve the fit by 1e-14
    of what a third one does, and a step may lead too far: with `near_double_root`, less curvature is added,
    and steps are halved.
    """
    distance = math.hypot(placement.x, placement.y)
    closest = CLOSEST * distance
    ranged = [
        (ax, ay, bx, by, rho * rho, weight, weight * 2.0)
        for (ax, ay, bx, by), rho in measured
        for weight in (0.5 / max(rho, closest),)
    ]
    phi, psi = placement.phi, math.atan2(placement.y, placement.x)
    best, fitted, to_phi, to_psi = math.inf, placement, 0.0, 0.0
    added = 1.0 + ADDED_CURVATURE * (NEAR_DOUBLE_ROOT if near_double_root else 1.0)
    for _ in range(POLISHING_STEPS):
        c, s = math.cos(phi), math.sin(phi)
        tx, ty = distance * math.cos(psi), distance * math.sin(psi)
        cost = pp = pq = qq = gp = gq = 0.0
        for own_x, own_y, bx, by, squared, weight, double in ranged:
            ax, ay = c * own_x - s * own_y, s * own_x + c * own_y
            x, y = tx + ax - bx, ty + ay - by
            error = weight * (x * x + y * y - squared)
            by_phi = double * (y * ax - x * ay)
            by_psi = double * (y * tx - x * ty)
            cost += error * error
            pp += by_phi * by_phi
            pq += by_phi * by_psi
            qq += by_psi * by_psi
            gp += by_phi * error
            gq += by_psi * error
        if cost >= best and not near_double_root:
            break
        if cost >= best:
            to_phi, to_psi = 0.5 * to_phi, 0.5 * to_psi
            phi, psi = phi + to_phi, psi + to_psi
            continue
        best, fitted = cost, Placement(wrap(phi), tx, ty)
        pp, qq = pp * added, qq * added
        determinant = pp * qq - pq * pq
        if determinant == 0.0:
            break
        to_phi, to_psi = (qq * gp - pq * gq) / determinant, (pp * gq - pq * gp) / determinant
        phi, psi = phi - to_phi, psi - to_psi
    return fitted
