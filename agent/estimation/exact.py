"""What a robot still holds possible: branches in phase 1, placements in phase 3.

Closed forms make the candidates, measurements weigh them. The sensors are exact here, so weighing is an
exact test with a floor in m, of `protocol.rounding`, and a candidate that passes is only polished: where
the closed form is well conditioned that is the identity, and next to a double root it restores the digits
lost there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

import msgspec

from agent.estimation.closed_forms import Placement, included_angle, same_placement
from protocol.motion import Pose, compose, wrap
from protocol.rounding import SAME, same_turn

POLISHING_STEPS = 12
"""Gauss-Newton steps at the most; they end when the fit gets no better, mostly after one"""

FITTED = 3
"""anchor ranges from which on the heading is fitted to all of them; two are met exactly"""

DAMPING = 1e-9
"""of a fit's curvature, added to it: so a step goes only where the ranges tell something"""

CLOSEST = 1e-12
"""of D: a shorter range weighs no more than this one"""

SINGULAR = 1e-14
"""how nearly parallel two columns may be before they count as one (the sine of their angle, squared)"""


class Branch(msgspec.Struct, frozen=True):
    """One of the two trajectories +-alpha that two ranges leave possible (Section III.A)."""

    alpha: float
    """rad, of eq. (2), signed"""
    start: Pose
    """where tick 0 of the odometry lies in the frame of the anchor: (rho_0, 0, heading)"""

    @property
    def anchor(self) -> tuple[float, float]:
        """Where the anchor lies in the frame of the odometry, in m."""
        c, s = math.cos(self.start.heading), math.sin(self.start.heading)
        return -self.start.x * c, self.start.x * s

    def distance(self, odometry: Pose) -> float:
        """From the anchor, in m."""
        place = compose(self.start, odometry)
        return math.hypot(place.x, place.y)


def branches(rho0: float, measured_at: Pose, rho: float) -> tuple[Branch, ...]:
    """The trajectories that fit the range `rho0` at tick 0 and `rho` at the odometry pose `measured_at`.

    Two, mirror images of each other; one where the motion was radial; none where the ranges contradict
    the odometry (eq. (2)).
    """
    alpha = included_angle(rho0, rho, math.hypot(measured_at.x, measured_at.y))
    if alpha is None:
        return ()
    bearing = math.atan2(measured_at.y, measured_at.x)
    sides = (alpha, -alpha) if 0.0 < alpha < math.pi else (alpha,)
    return tuple(Branch(side, Pose(rho0, 0.0, side - bearing)) for side in sides)


def weigh_branches(
    candidates: Iterable[Branch],
    seen: Iterable[tuple[Pose, float | None]],
    sensing_range: float,
    floor: float,
    margin: float,
) -> tuple[Branch, ...]:
    """Those of `candidates` that explain every odometry pose in `seen` with its range, or its silence.

    `floor` is by how much (m) rounding may put a predicted range off. `margin` is how far inside the range a
    point must lie to count on it: half of that is left for what two ranges leave open of a heading.

    Two that put the anchor in the same place are one: so near the anchor, or so nearly radial, they are.
    """
    seen = tuple(seen)
    ranged = [(pose, rho) for pose, rho in seen if rho is not None]
    silent = [pose for pose, rho in seen if rho is None]
    left: list[Branch] = []
    for candidate in candidates:
        branch = polished(candidate, ranged)
        if (
            all(_meets(branch.distance(pose), rho, branch.start.x, floor) for pose, rho in ranged)
            and all(branch.distance(pose) > sensing_range - 0.5 * margin for pose in silent)
            and not any(math.dist(branch.anchor, other.anchor) < SAME * floor for other in left)
        ):
            left.append(branch)
    return tuple(left)


def anchor_error(start: Pose, ranged: Sequence[tuple[Pose, float, float]]) -> float:
    """Return how far (m) the anchor may be from where the branch that begins at `start` puts it.

    To first order, by the odometry and the range of each in `ranged`, and by how much (m) rounding may
    put that range off, its floor. They are fitted in squares: at a point that lies y off the line from
    the anchor through p_0, the slope of the squared range by the heading is 2 rho_0 y, and its error 2
    floor (rho + rho_0), with that of rho_0. Whatever the heading, the anchor is rho_0 away: no more than
    2 rho_0 of error is left, on the anchor none. What `weigh_branches` merges, it puts off, too.
    """
    rho0 = start.x
    c, s = math.cos(start.heading), math.sin(start.heading)
    moment = across = 0.0
    for pose, rho, floor in ranged:
        y = abs(s * pose.x + c * pose.y)
        moment += y * y
        across += floor * y * (rho + rho0)
    turned = across / moment if moment > 0.0 else math.inf
    return (1.0 + SAME) * ranged[-1][2] + min(2.0 * rho0, turned)


def _meets(predicted: float, rho: float, rho0: float, floor: float) -> bool:
    """Return whether `rho` may be `predicted`; nearer than rho_0 in squares, as it is fitted."""
    return abs(predicted - rho) * (predicted + rho) <= 2.0 * floor * max(rho, rho0)


def polished(branch: Branch, ranged: Sequence[tuple[Pose, float]]) -> Branch:
    """The same branch with the heading that fits all ranges best, in squares (Gauss-Newton).

    Two ranges are met exactly by construction, and near a radial heading they say nothing more.
    """
    if len(ranged) < FITTED:
        return branch
    rho0, heading = branch.start.x, branch.start.heading
    best, fitted = math.inf, heading
    for _ in range(POLISHING_STEPS):
        c, s = math.cos(heading), math.sin(heading)
        cost = gradient = curvature = 0.0
        for pose, rho in ranged:
            x, y = rho0 + c * pose.x - s * pose.y, s * pose.x + c * pose.y
            error = x * x + y * y - rho * rho
            slope = -2.0 * rho0 * y
            cost += error * error
            gradient += slope * error
            curvature += slope * slope
        if cost >= best or curvature == 0.0:
            break
        best, fitted = cost, heading
        heading -= gradient / curvature
    return Branch(wrap(branch.alpha + fitted - branch.start.heading), Pose(rho0, 0.0, fitted))


class PairObservation(msgspec.Struct, frozen=True):
    """One tick of an encounter: both robots in the frames of their own anchors, and the range between."""

    tick: int
    a: Pose
    b: Pose
    range: float | None


RangedPair = tuple[Pose, Pose, float]
"""where a and b were, each in its anchor's frame, and the range (m) between them"""


def weigh_placements(
    candidates: Iterable[Placement],
    pair_observations: Sequence[PairObservation],
    sensing_range: float,
    floor: float,
) -> tuple[Placement, ...]:
    """Return those of `candidates` that explain every sighting, be it a range or silence.

    `floor` is by how much (m) rounding, that of phase 1 included, may put a predicted range off.
    """
    left: list[Placement] = []
    ranged = [(seen.a, seen.b, seen.range) for seen in pair_observations if seen.range is not None]
    silent = [(seen.a, seen.b) for seen in pair_observations if seen.range is None]
    for candidate in candidates:
        placement = _polished_placement(candidate, ranged) if len(ranged) > 2 else candidate
        same = same_turn(math.hypot(placement.x, placement.y) + sensing_range)
        if (
            _explains_ranges(placement, ranged, floor)
            and _explains_silence(placement, silent, sensing_range - floor)
            and not any(same_placement(placement, other, same) for other in left)
        ):
            left.append(placement)
    return tuple(left)


def _explains_ranges(placement: Placement, ranged: Iterable[RangedPair], floor: float) -> bool:
    x, y = placement.x, placement.y
    c, s = math.cos(placement.phi), math.sin(placement.phi)
    for a, b, rho in ranged:
        if abs(math.hypot(x + c * a.x - s * a.y - b.x, y + s * a.x + c * a.y - b.y) - rho) > floor:
            return False
    return True


def _explains_silence(placement: Placement, silent: Iterable[tuple[Pose, Pose]], reach: float) -> bool:
    x, y = placement.x, placement.y
    c, s = math.cos(placement.phi), math.sin(placement.phi)
    hypot = math.hypot
    for a, b in silent:
        ax, ay = a.x, a.y
        if hypot(x + c * ax - s * ay - b.x, y + s * ax + c * ay - b.y) <= reach:
            return False
    return True


def turn_error(
    placement: Placement, pair_observations: Sequence[PairObservation], floor: float, anchors: float
) -> float:
    """Return how far (rad), at the most, either robot may be turned about its anchor off `placement`.

    To first order, of least squares over all ranges in `pair_observations`: each is off by `floor` m on its own,
    and all of them together by the two anchors, which are off by `anchors` m in all. Infinite where they
    leave a turn open, next to a double root of eq. (7).
    """
    slopes = tuple(_slopes(placement, pair_observations))
    pp, pq, qq = _information(slopes)
    determinant = pp * qq - pq * pq
    if determinant <= SINGULAR * pp * qq:
        return math.inf
    alone_a = alone_b = ax = ay = bx = by = 0.0
    for p, q, ux, uy in slopes:
        of_psi = pp * q - pq * p
        of_a = qq * p - pq * q - of_psi  # in <W>, b is turned by -psi and a by phi - psi
        alone_a, alone_b = alone_a + abs(of_a), alone_b + abs(of_psi)
        ax, ay, bx, by = ax + of_a * ux, ay + of_a * uy, bx + of_psi * ux, by + of_psi * uy
    turned_a = floor * alone_a + anchors * math.hypot(ax, ay)
    turned_b = floor * alone_b + anchors * math.hypot(bx, by)
    return max(turned_a, turned_b) / determinant


def information(
    placement: Placement, pair_observations: Sequence[PairObservation]
) -> tuple[float, float, float]:
    """What the ranges in `pair_observations` tell of phi and of psi, the bearing of M1 in <b(M2)>.

    The Fisher information for ranges of 1 m standard deviation, in 1 / rad^2: of phi, mixed, of psi.
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
    """Yield, for each range, its derivatives by phi and by psi (m / rad), and the direction from b to a."""
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


def _polished_placement(placement: Placement, measured: Sequence[RangedPair]) -> Placement:
    """The placement nearby that fits all ranges best; M1 stays D from M2 (Gauss-Newton).

    The squares are weighed so that an error is one of the range: a tiny one would not count beside others.

    The unknowns are phi and the bearing psi of M1 in <b(M2)>. Two ranges determine them exactly; more
    of them tell apart what eq. (7) alone gives as a double root.
    """
    distance = math.hypot(placement.x, placement.y)
    closest = CLOSEST * distance
    ranged = [(a, b, rho, 0.5 / max(rho, closest)) for a, b, rho in measured]
    phi, psi = placement.phi, math.atan2(placement.y, placement.x)
    best, fitted = math.inf, placement
    for _ in range(POLISHING_STEPS):
        c, s = math.cos(phi), math.sin(phi)
        tx, ty = distance * math.cos(psi), distance * math.sin(psi)
        cost = pp = pq = qq = gp = gq = 0.0
        for a, b, rho, weight in ranged:
            ax, ay = c * a.x - s * a.y, s * a.x + c * a.y
            x, y = tx + ax - b.x, ty + ay - b.y
            error = weight * (x * x + y * y - rho * rho)
            by_phi = weight * 2.0 * (y * ax - x * ay)
            by_psi = weight * 2.0 * (y * tx - x * ty)
            cost += error * error
            pp += by_phi * by_phi
            pq += by_phi * by_psi
            qq += by_psi * by_psi
            gp += by_phi * error
            gq += by_psi * error
        if cost >= best:
            break
        best, fitted = cost, Placement(wrap(phi), tx, ty)
        pp, qq = pp * (1.0 + DAMPING), qq * (1.0 + DAMPING)
        determinant = pp * qq - pq * pq
        if determinant == 0.0:
            break
        phi -= (qq * gp - pq * gq) / determinant
        psi -= (pp * gq - pq * gp) / determinant
    return fitted
