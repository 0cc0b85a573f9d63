"""One Gauss-Newton step of a fit for n robots, as a Kalman filter over the ticks and a backward pass.

The start poses and all constant errors are unknowns, whose effects U on the state are carried along (the
augmented filter of P. de Jong, "The diffuse Kalman filter", 1991). White odometry noise is process noise, and
the covariance P of the state is 0 at the start. So the cost is linear in ticks and ranges. The backward pass
(B. M. Bell, "The iterated Kalman smoother as a Gauss-Newton method", 1994) gives the white errors, and for
each range the precision with which all others predict it.

The state is x, y and heading of each robot, and then the slow error of each pair of radios. An unknown is a
coordinate of a start pose, or a constant error in units of its prior's standard deviation. A start pose is
expressed by its heading and by the position of a pivot, such as the robot's anchor, in the frame of the
robot: then one of the three unknowns is a rotation about the pivot, of which ranges to it tell nothing. The
constant errors are relative to 0, and the poses to the point at which the step begins.

This is the text of `smoother.c`, which is what a fit calls (see `kernel`): both do the same operations in the
same order, and their results are equal to the bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Places = NDArray[np.int64]
Vector = list[float]
Matrix = list[list[float]]
Deep = Sequence[float] | Array
"""The shares of depth and of what is aside, in sigmas."""

NO_DEPTH: Deep = (0.0, 0.0)
"""The shares of ranges that are distances."""

SLIGHT = 1e-4
"""The half turn in rad below which the series of a chord and of its derivative are used."""
SMALLEST_DISTANCE = 1e-12
"""The distance in m below which a direction is not defined."""

LARGEST_TURN = 1.0
"""The largest change of a heading in a step, in rad."""


class Measured(NamedTuple):
    """The measurements, and the priors of their errors: all that does not change during a fit.

    n robots, K ticks, N ranges in the order of their ticks, c constant errors of ranges, m of each odometry.
    """

    period: float
    """length of a tick in s"""
    v: Array
    """forward velocities in m/s, (n, K); a shorter path goes on at rest, without noise"""
    omega: Array
    """angular velocities in rad/s; (n, K)"""
    slip: Array
    """angles in rad from the chord of eq. (1a) to the displacements; (n, K)"""
    white: Array
    """variances of v and omega; (n, 2, K)"""
    stray: Array
    """the variances in a tick whose odometry is a stray; (n, 2, K), or (n, 2, 0) if there are none"""
    patterns: Array
    """effects of one sigma of each constant error on v and omega; (n, m, 2, K)"""
    begin: Places
    """number of ranges before each tick; (K + 2,)"""
    first: Places
    """the robot of each range, or the first of two; (N,)"""
    second: Places
    """the second robot of each range; -1 for a range to an anchor; (N,)"""
    place: Array
    """position of the anchor of each range in m; (N, 2)"""
    rho: Array
    """ranges in m; (N,)"""
    common: Array
    """effects in m of one sigma of each constant error on each range; (N, c)"""
    scaled: int
    """the one of them that is proportional to the predicted range, where it is not 0; -1: none"""
    scale: float
    """its effect on a range of 1 m"""
    delayed: int
    """the one of them that is a delay, whose `common` is its sigma in s, 0 where there is none; -1: none"""
    deep: int
    """the one before the last that is the share of depth, whose `common` is its sigma; -1: none

    The last one is the share of what is aside: of a camera that does not look along the heading.
    """
    observer: Places
    """the robot that has measured each range: a depth is along its heading; (N,)"""
    anchor: Places
    """the anchor of each range, among those that are not surveyed exactly; -1 for any other; (N,)"""
    anchors: int
    """number of these anchors"""
    survey: float
    """standard deviation of each coordinate of them in m: considered, not estimated (Schmidt, 1966)"""
    radio: Places
    """pair of radios of each range, whose slow errors are correlated; -1 of a range without; (N,)"""
    radios: int
    """number of pairs of radios with slow errors; 0 without them"""
    slow: float
    """variance of a slow error in m^2"""
    decay: float
    """factor by which its correlation falls in a tick"""
    mean: Array
    """expected start poses in m and rad; (3 n,)"""
    information: Array
    """inverse of their covariance, 0 for what is not known; (3 n, 3 n)"""
    pivot: Array
    """the place of each robot's pivot in m; NaN for its start; (n, 2)"""

    @property
    def robots(self) -> int:
        """The number of robots."""
        return len(self.v)

    @property
    def ticks(self) -> int:
        """The number of ticks."""
        return int(self.v.shape[1])

    @property
    def strays(self) -> int:
        """1 if the odometry of a tick may be a stray, else 0."""
        return int(self.stray.size > 0)

    @property
    def size(self) -> int:
        """The number of unknowns that are estimated."""
        return int(3 * self.robots + self.common.shape[1] + self.robots * self.patterns.shape[1])


class Walk(NamedTuple):
    """The paths of all robots with their errors at a point, and the ranges that they predict."""

    place: Array
    """x, y and heading at each tick; (n, K + 1, 3)"""
    moves: Array
    """displacement of each tick per unit of v, the displacement, its derivative with respect to omega, and
    the errors of v and omega; (n, K, 8)"""
    direction: Array
    """derivatives of the ranges by the position of the first robot; without depth unit vectors; (N, 2)"""
    residual: Array
    """measured ranges minus distances in m; (N,)"""
    rate: Array
    """range rates in m/s, at the end of the tick before; 0 at tick 0, and without a delay; (N,)"""
    by_heading: Array
    """derivatives of the ranges by the heading of their observer in m; without depth 0; (N,)"""
    to_depth: Array
    """depths along that heading minus distances in m; 0 if no range may be a depth; (N,)"""
    aside: Array
    """distances to the left of it in m; 0 if no range may be a depth; (N,)"""


class FitStep(NamedTuple):
    """The result of a step; p unknowns are estimated."""

    change: Array
    """change of the pivots in the robots' frames and of the headings, and the constant errors; (p,)"""
    limited: Array
    """the same with a change of no coordinate by more than a bound; (p,)"""
    inverse: Array
    """covariance of the unknowns; (p, p)"""
    white: Array
    """white errors of v and omega after the limited step; (n, 2, K)"""
    own: Array
    """innovations that remain after the limited step, times their inverse covariance; (N,)"""
    slow: Array
    """slow error of each range in m, after the limited step; (N,)"""
    multipliers: Array
    """innovations that remain after the whole step, times their inverse covariance; (N,)"""
    alone: Array
    """diagonal of the inverse covariance of all ranges in 1 / m^2; (N,)"""
    explained: Array
    """the part of it that the unknowns explain; (N,)"""
    ends: Array
    """covariance of the poses at the last tick; (3 n, 3 n)"""
    shocks: Array
    """what all data tell of the errors of v and omega in each tick, which have the variances `white`: the
    derivatives of the log-likelihood, and the information vv, v omega and omega omega; (n, K, 5), or
    (n, 0, 5) if there are no strays"""
    chi2: float
    """least sum of squares of all errors in their sigmas"""
    length: float
    """length of the change of the start poses in sigmas"""
    volume: float
    """logarithm of the determinants of the covariance of ranges and of the information of unknowns"""
    of_start: float
    """logarithm of the determinant of the covariance of the start poses"""


class Singular(ArithmeticError):
    """The information of the unknowns is not positive definite."""


def walked(of: Measured, poses: Array, constants: Array, white: Array, deep: Deep = NO_DEPTH) -> Walk:
    """Return the paths from start `poses`, (3 n,), with constant and white errors, (n, m) and (n, 2, K).

    `deep` are the shares of depth and of what is aside in sigmas: they change the derivatives of the ranges,
    not their residuals.
    """
    place, moves = _driven(of, poses, constants, white)
    ranges = [(j, k) for k in range(of.ticks + 1) for j in range(of.begin[k], of.begin[k + 1])]
    rows = np.array([_predicted(of, place, moves, j, k, deep) for j, k in ranges]).reshape(-1, 7)
    moved = np.array(moves).reshape(of.robots, of.ticks, 8)
    return Walk(np.array(place), moved, rows[:, :2], *np.ascontiguousarray(rows[:, 2:].T))


def _driven(of: Measured, poses: Array, constants: Array, white: Array) -> tuple[list[Matrix], list[Matrix]]:
    """Return x, y and heading of each robot at each tick, and the `moves` of each tick (see Walk)."""
    place = [[poses[3 * i : 3 * i + 3].tolist()] for i in range(of.robots)]
    moves: list[Matrix] = [[] for _ in range(of.robots)]
    for i in range(of.robots):
        for k in range(of.ticks):
            error_v, error_omega = white[i, 0, k], white[i, 1, k]
            for j, pattern in enumerate(of.patterns[i]):
                error_v += constants[i, j] * pattern[0, k]
                error_omega += constants[i, j] * pattern[1, k]
            v, omega = of.v[i, k] + error_v, of.omega[i, k] + error_omega
            half = 0.5 * of.period * omega
            if abs(half) < SLIGHT:
                unit = of.period * (1.0 - half * half / 6.0)
                slope = -0.5 * of.period * half / 3.0
            else:
                unit = of.period * math.sin(half) / half
                slope = 0.5 * of.period * (1.0 / math.tan(half) - 1.0 / half)
            x, y, heading = place[i][k]
            course = heading + half + of.slip[i, k]
            sx, sy = unit * math.cos(course), unit * math.sin(course)
            dx, dy = v * sx, v * sy
            gx = v * slope * sx - 0.5 * of.period * dy
            gy = v * slope * sy + 0.5 * of.period * dx
            moves[i].append([sx, sy, dx, dy, gx, gy, error_v, error_omega])
            place[i].append([x + dx, y + dy, heading + of.period * omega])
    return place, moves


def _predicted(of: Measured, place: list[Matrix], moves: list[Matrix], j: int, k: int, deep: Deep) -> Vector:
    """Return what Walk has of range `j`, at tick `k`: from `direction` on."""
    at, other = place[of.first[j]][k], of.place[j]
    if of.second[j] >= 0:
        other = place[of.second[j]][k]
    dx, dy = at[0] - other[0], at[1] - other[1]
    distance = max(math.sqrt(dx * dx + dy * dy), SMALLEST_DISTANCE)
    x, y, rate, by_heading, to_depth, left = dx / distance, dy / distance, 0.0, 0.0, 0.0, 0.0
    if of.deep >= 0:
        share, side = deep[0] * of.common[j, of.deep], deep[1] * of.common[j, of.deep + 1]
        heading, rest = place[of.observer[j]][k][2], 1.0 - share
        sign = 1.0 if of.observer[j] == of.second[j] else -1.0
        c, s = sign * math.cos(heading), sign * math.sin(heading)
        ahead, left = dx * c + dy * s, dy * c - dx * s
        to_depth, by_heading = ahead - distance, share * left - side * ahead
        x, y = rest * x + share * c - side * s, rest * y + share * s + side * c
    if of.delayed >= 0 and k > 0:
        vx, vy = _velocity(of, place, moves, of.first[j], k)
        if of.second[j] >= 0:
            other_vx, other_vy = _velocity(of, place, moves, of.second[j], k)
            vx, vy = vx - other_vx, vy - other_vy
        omega = of.omega[of.observer[j], k - 1] + moves[of.observer[j]][k - 1][7]
        rate = x * vx + y * vy + by_heading * omega
    return [x, y, of.rho[j] - distance, rate, by_heading, to_depth, left]


def _velocity(of: Measured, place: list[Matrix], moves: list[Matrix], i: int, k: int) -> tuple[float, float]:
    """Return the velocity of robot `i` in m/s at the end of the tick before `k`."""
    v, course = of.v[i, k - 1] + moves[i][k - 1][6], place[i][k][2] + of.slip[i, k - 1]
    return v * math.cos(course), v * math.sin(course)


class Passed(NamedTuple):
    """The result of the forward pass; q unknowns, of which the considered ones are the last."""

    innovation: Vector
    """difference of each range from its prediction without any error in m; shape (N,)"""
    variance: Vector
    """variance of the innovations in m^2; shape (N,)"""
    effects: Matrix
    """effects of the unknowns on the innovations; shape (N, q)"""
    gain: Matrix
    """effects of the innovations on the state; shape (N, s)"""
    state: Vector
    """the last state with all unknowns 0; shape (s,)"""
    u: Matrix
    """effects of the unknowns on it; shape (s, q)"""
    p: Matrix
    """its covariance, given the unknowns; shape (s, s)"""
    information: Matrix
    """the inverse covariance of the unknowns: its lower triangle; shape (q, q)"""
    gradient: Vector
    """the product of the information and the solution; shape (q,)"""


def forward(of: Measured, walk: Walk, poses: Array, variance: Array, *, update: bool = True) -> Passed:
    """Return the forward pass; without `update`, ranges are predicted only, and change nothing.

    Raises Singular if rounding has left an innovation without a variance.
    """
    n3 = 3 * of.robots
    s, q = n3 + of.radios, of.size + 2 * of.anchors
    u, p, information = zeros(s, q), zeros(s, s), zeros(q, q)
    gradient = [0.0] * q
    _begun(of, poses, u, information, gradient)
    for a in range(n3, s):
        p[a][a] = of.slow
    for a in range(n3, q):
        information[a][a] = 1.0
    found = Passed([], [], [], [], [0.0] * s, u, p, information, gradient)
    for k in range(of.ticks + 1):
        if k > 0:
            for i in range(of.robots):
                _moved(of, walk, i, k - 1, found)
            _decayed(of, found)
        for j in range(of.begin[k], of.begin[k + 1]):
            _measured(of, walk, j, variance[j], found)
            if update:
                _updated(found, j)
    return found


def basis_of(of: Measured, poses: Array, i: int) -> Matrix:
    """Return the derivatives of the start pose of robot `i` with respect to its unknowns."""
    x, y, heading = poses[3 * i : 3 * i + 3].tolist()
    x, y = x - of.pivot[i, 0], y - of.pivot[i, 1]
    if math.isnan(x):
        x, y = 0.0, 0.0
    c, s = math.cos(heading), math.sin(heading)
    return [[-c, s, -y], [-s, -c, x], [0.0, 0.0, 1.0]]


def _begun(of: Measured, poses: Array, u: Matrix, information: Matrix, gradient: Vector) -> None:
    """Set the effects of the unknowns of the start poses on them, and what their priors tell."""
    n3 = 3 * of.robots
    off = [of.mean[e] - poses[e] for e in range(n3)]
    told = [dot(of.information[a].tolist(), off) for a in range(n3)]
    for i in range(0, n3, 3):
        for a, row in enumerate(basis_of(of, poses, i // 3)):
            u[i + a][i : i + 3] = row
    for a in range(n3):
        row, i = [0.0] * n3, a - a % 3
        for d in range(i, i + 3):
            gradient[a] += u[d][a] * told[d]
            add(row, u[d][a], of.information[d].tolist())
        for e in range(n3):
            for d in range(e - e % 3, e - e % 3 + 3):
                information[a][e] += row[d] * u[d][e]


def _moved(of: Measured, walk: Walk, i: int, k: int, found: Passed) -> None:
    """Move the state by the odometry of robot `i` in tick `k`."""
    sx, sy, dx, dy, gx, gy, error_v, error_omega = walk.moves[i, k]
    state, u, p = found.state, found.u, found.p
    x, y, h = 3 * i, 3 * i + 1, 3 * i + 2
    state[x] += -dy * state[h] - sx * error_v - gx * error_omega
    state[y] += dx * state[h] - sy * error_v - gy * error_omega
    state[h] -= of.period * error_omega
    add(u[x], -dy, u[h])
    add(u[y], dx, u[h])
    column = of.size - (of.robots - i) * len(of.patterns[i])
    for of_v, of_omega in of.patterns[i]:
        u[x][column] += sx * of_v[k] + gx * of_omega[k]
        u[y][column] += sy * of_v[k] + gy * of_omega[k]
        u[h][column] += of.period * of_omega[k]
        column += 1
    add(p[x], -dy, p[h])
    add(p[y], dx, p[h])
    for row in p:
        row[x] += -dy * row[h]
        row[y] += dx * row[h]
    v, omega = of.white[i, :, k]
    noise = ((x, sx, gx), (y, sy, gy), (h, 0.0, of.period))
    for a, by_v, by_omega in noise:
        for e, other_v, other_omega in noise:
            p[a][e] += v * by_v * other_v + omega * by_omega * other_omega


def _decayed(of: Measured, found: Passed) -> None:
    """Let the slow errors decay by a tick."""
    for a in range(3 * of.robots, len(found.p)):
        found.state[a] *= of.decay
        scale(found.u[a], of.decay)
        scale(found.p[a], of.decay)
        for row in found.p:
            row[a] *= of.decay
        found.p[a][a] += (1.0 - of.decay * of.decay) * of.slow


def _row(of: Measured, walk: Walk, j: int) -> list[tuple[int, float]]:
    """Return the derivatives of range `j` with respect to the state, by their places."""
    x, y = walk.direction[j].tolist()
    row = [(3 * of.first[j], x), (3 * of.first[j] + 1, y)]
    if of.deep >= 0:
        row.append((3 * of.observer[j] + 2, float(walk.by_heading[j])))
    if of.second[j] >= 0:
        row += [(3 * of.second[j], -x), (3 * of.second[j] + 1, -y)]
    if of.radios and of.radio[j] >= 0:
        row.append((3 * of.robots + of.radio[j], 1.0))
    return row


def effect_of(of: Measured, walk: Walk, j: int, e: int) -> float:
    """Return the effect in m of one sigma of the constant error `e` on range `j`."""
    told = float(of.common[j, e])
    if e == of.delayed:
        return -told * float(walk.rate[j])
    if 0 <= of.deep <= e:
        return told * float((walk.to_depth if e == of.deep else walk.aside)[j])
    if e == of.scaled and told != 0.0:
        return of.scale * float(of.rho[j] - walk.residual[j])
    return told


def _measured(of: Measured, walk: Walk, j: int, variance: float, found: Passed) -> None:
    """Predict range `j` from the state: its innovation, and the gain before division by its variance."""
    row = _row(of, walk, j)
    innovation, effect, gain = walk.residual[j], [0.0] * len(found.gradient), [0.0] * len(found.p)
    for a, h in row:
        innovation -= h * found.state[a]
        add(effect, h, found.u[a])
        add(gain, h, found.p[a])
    for e in range(len(of.common[j])):
        effect[3 * of.robots + e] += effect_of(of, walk, j, e)
    if of.anchor[j] >= 0:
        for e in range(2):
            effect[of.size + 2 * of.anchor[j] + e] -= of.survey * walk.direction[j, e]
    for a, h in row:
        variance += h * gain[a]
    if not variance > 0.0:
        raise Singular("the errors of the odometry are too large for a float")
    found.innovation.append(innovation)
    found.variance.append(variance)
    found.effects.append(effect)
    found.gain.append(gain)


def _updated(found: Passed, j: int) -> None:
    """Update the state and the information of the unknowns by range `j`."""
    innovation, weight, effect, gain = (
        found.innovation[j],
        1.0 / found.variance[j],
        found.effects[j],
        found.gain[j],
    )
    for a in range(len(found.p)):
        found.state[a] += gain[a] * weight * innovation
        add(found.u[a], -(gain[a] * weight), effect)
        add(found.p[a], -(gain[a] * weight), gain)
    scale(gain, weight)
    for a in range(len(effect)):
        found.gradient[a] += effect[a] * weight * innovation
        add(found.information[a], effect[a] * weight, effect[: a + 1])


def loosened(of: Measured, walk: Walk, poses: Array, variance: Array) -> Array:
    """Return the variance of each range in m^2 before any fit, if the start `poses` are right."""
    passed = forward(of, walk, poses, variance, update=False)
    for j, effect in enumerate(passed.effects):
        for e in range(3 * of.robots, of.size):
            passed.variance[j] += effect[e] * effect[e]
    return np.array(passed.variance)


def step(of: Measured, walk: Walk, poses: Array, variance: Array, ridge: float, largest: float) -> FitStep:
    """Return a Gauss-Newton step from `poses`; `variance` is the own variance of each range in m^2.

    `ridge` is a share of the information of each pose that is added to it, so that what the ranges leave open
    has a large variance; `largest` bounds the change of each start position in m. Raises Singular.
    """
    n3, size = 3 * of.robots, of.size
    passed = forward(of, walk, poses, variance)
    information = passed.information
    for a in range(n3):
        information[a][a] += ridge + ridge * information[a][a]
    lower = cholesky(information, 0, size)
    change = solved(lower, passed.gradient[:size])
    inverse, whitening = inverted(lower), whitening_of(lower)
    inner = cholesky(inverse, 0, n3)
    in_sigmas = substituted(inner, change[:n3])
    limited = _limited(passed, change, n3, largest)
    misfits = [_misfits(passed, one) for one in (change, limited)]
    white, own, multipliers, alone, explained, shocks = _backward(of, walk, passed, whitening, *misfits)
    volume = 0.0
    for one in passed.variance:
        volume += math.log(one)
    for a in range(size):
        volume += 2.0 * math.log(lower[a][a])
    of_start = 0.0
    for a in range(n3):
        of_start += 2.0 * math.log(inner[a][a])
    return FitStep(
        np.array(change),
        np.array(limited),
        np.array(inverse),
        np.array(white),
        np.array(own),
        np.array(_slow_errors(of, own)),
        np.array(multipliers),
        np.array(alone),
        np.array(explained),
        np.array(_ends(of, passed, lower, whitening)),
        np.array(shocks).reshape(of.robots, of.ticks * of.strays, 5),
        _chi2(of, passed, poses, change, misfits[0]),
        math.sqrt(dot(in_sigmas, in_sigmas)),
        volume,
        of_start,
    )


def _limited(passed: Passed, change: Vector, n3: int, largest: float) -> Vector:
    """Return a change of at most `largest` and LARGEST_TURN, with the best constant errors beside it."""
    most = 0.0
    for a in range(n3):
        most = max(most, abs(change[a]) / (LARGEST_TURN if a % 3 == 2 else largest))
    if most <= 1.0:
        return change
    poses = [one / most for one in change[:n3]]
    left = [passed.gradient[a] - dot(passed.information[a][:n3], poses) for a in range(n3, len(change))]
    return poses + solved(cholesky(passed.information, n3, len(change)), left)


def _misfits(passed: Passed, change: Vector) -> Vector:
    """Return what remains of the innovations after a `change` of the unknowns, in m."""
    pairs = zip(passed.innovation, passed.effects, strict=True)
    return [innovation - dot(effect, change) for innovation, effect in pairs]


def _chi2(of: Measured, passed: Passed, poses: Array, change: Vector, misfits: Vector) -> float:
    """Return the least sum of squares, of all errors in their sigmas."""
    n3, chi2 = 3 * of.robots, 0.0
    for misfit, variance in zip(misfits, passed.variance, strict=True):
        chi2 += misfit * misfit / variance
    chi2 += dot(change[n3:], change[n3:])
    off = []
    for i in range(of.robots):
        for a, row in enumerate(basis_of(of, poses, i), 3 * i):
            off.append(of.mean[a] - poses[a] - dot(row, change[3 * i : 3 * i + 3]))
    for a in range(n3):
        chi2 += off[a] * dot(of.information[a].tolist(), off)
    return chi2


def _backward(
    of: Measured, walk: Walk, passed: Passed, whitening: Matrix, misfits: Vector, of_limited: Vector
) -> tuple[list[Matrix], Vector, Vector, Vector, Vector, list[Matrix]]:
    """Return the white errors, the vectors own, multipliers, alone and explained, and shocks of a step.

    `misfits` remain after the whole step, and those `of_limited` after the limited one.
    """
    s, count = len(passed.p), len(of.rho)
    adjoint = Adjoint([0.0] * s, [0.0] * s, zeros(s, of.size), zeros(s, s))
    white = [zeros(2, of.ticks) for _ in range(of.robots)]
    own, multipliers, alone, explained = ([0.0] * count for _ in range(4))
    shocks = [zeros(of.ticks * of.strays, 5) for _ in range(of.robots)]
    for k in range(of.ticks, -1, -1):
        for j in range(of.begin[k + 1] - 1, of.begin[k] - 1, -1):
            gain, spread = passed.gain[j], passed.variance[j]
            multipliers[j] = misfits[j] / spread - dot(gain, adjoint.vector)
            own[j] = of_limited[j] / spread - dot(gain, adjoint.limited)
            effect, alone[j] = _weighed_in(of, walk, passed, j, adjoint, multipliers[j], own[j])
            in_sigmas = whitened(whitening, effect)
            explained[j] = dot(in_sigmas, in_sigmas)
        if k > 0:
            for i in range(of.robots):
                if of.strays:
                    shocks[i][k - 1] = _shock(of, walk, i, k - 1, adjoint, whitening)
                _attributed(of, walk, i, k - 1, adjoint, white[i])
            for a in range(3 * of.robots, s):
                adjoint.vector[a] *= of.decay
                adjoint.limited[a] *= of.decay
                scale(adjoint.by_unknowns[a], of.decay)
                scale(adjoint.weight[a], of.decay)
                for row in adjoint.weight:
                    row[a] *= of.decay
    return white, own, multipliers, alone, explained, shocks


class Adjoint(NamedTuple):
    """The adjoint variables of the backward pass: the information of later ranges about the state."""

    vector: Vector
    """the derivative of the log-likelihood by the state, after the whole step; shape (s,)"""
    limited: Vector
    """that after the limited step; shape (s,)"""
    by_unknowns: Matrix
    """the effect of the unknowns on it; shape (s, p)"""
    weight: Matrix
    """the information; shape (s, s)"""


def _weighed_in(
    of: Measured, walk: Walk, passed: Passed, j: int, adjoint: Adjoint, multiplier: float, own: float
) -> tuple[Vector, float]:
    """Add the information of range `j` to `adjoint`.

    Return the effects of the unknowns on it, multiplied by the inverse covariance of all ranges, and the
    diagonal of that.
    """
    gain, spread = passed.gain[j], passed.variance[j]
    effect = [one / spread for one in passed.effects[j][: of.size]]
    for a in range(len(gain)):
        add(effect, -gain[a], adjoint.by_unknowns[a])
    weighted = [dot(row, gain) for row in adjoint.weight]
    precision = 1.0 / spread + dot(gain, weighted)
    row = _row(of, walk, j)
    for a, h in row:
        adjoint.vector[a] += h * multiplier
        adjoint.limited[a] += h * own
        add(adjoint.by_unknowns[a], h, effect)
        add(adjoint.weight[a], -h, weighted)
        for e in range(len(gain)):
            adjoint.weight[e][a] -= h * weighted[e]
    for a, h in row:
        for e, other in row:
            adjoint.weight[a][e] += h * other * precision
    return effect, precision


def _shock(of: Measured, walk: Walk, i: int, k: int, adjoint: Adjoint, whitening: Matrix) -> Vector:
    """Return the row of `shocks` of robot `i` in tick `k`, by the `adjoint` of the state after it."""
    sx, sy, _, _, gx, gy, _, _ = walk.moves[i, k]
    effects = ((sx, sy), (gx, gy, of.period))
    shock: Vector = []
    by_unknowns: Matrix = []
    for e in range(2):
        slope, by = 0.0, [0.0] * of.size
        for a, h in enumerate(effects[e], 3 * i):
            slope += h * adjoint.vector[a]
            add(by, h, adjoint.by_unknowns[a])
        shock.append(slope)
        by_unknowns.append(whitened(whitening, by))
    for e, f in ((0, 0), (0, 1), (1, 1)):
        information = 0.0
        for a, h in enumerate(effects[e], 3 * i):
            for b, g in enumerate(effects[f], 3 * i):
                information += h * g * adjoint.weight[a][b]
        shock.append(information - dot(by_unknowns[e], by_unknowns[f]))
    return shock


def _attributed(of: Measured, walk: Walk, i: int, k: int, adjoint: Adjoint, white: Matrix) -> None:
    """Set the `white` errors of robot `i` in tick `k`, and move `adjoint` to the state before it."""
    sx, sy, dx, dy, gx, gy, _, _ = walk.moves[i, k]
    x, y, h = 3 * i, 3 * i + 1, 3 * i + 2
    vector, limited, by_unknowns, weight = adjoint
    white[0][k] = of.white[i, 0, k] * (sx * limited[x] + sy * limited[y])
    white[1][k] = of.white[i, 1, k] * (gx * limited[x] + gy * limited[y] + of.period * limited[h])
    vector[h] += -dy * vector[x] + dx * vector[y]
    limited[h] += -dy * limited[x] + dx * limited[y]
    add(by_unknowns[h], -dy, by_unknowns[x])
    add(by_unknowns[h], dx, by_unknowns[y])
    add(weight[h], -dy, weight[x])
    add(weight[h], dx, weight[y])
    for row in weight:
        row[h] += -dy * row[x] + dx * row[y]


def _slow_errors(of: Measured, own: Vector) -> Vector:
    """Return the slow error of each range: the covariance of slow errors times `own`, in two passes."""
    found = [0.0] * len(own)
    before, after = [0.0] * of.radios, [0.0] * of.radios
    if not of.radios:
        return found
    for k in range(of.ticks + 1):
        for j in range(of.begin[k], of.begin[k + 1]):
            if of.radio[j] >= 0:
                before[of.radio[j]] += own[j]
                found[j] += of.slow * before[of.radio[j]]
        scale(before, of.decay)
    for k in range(of.ticks, -1, -1):
        for j in range(of.begin[k + 1] - 1, of.begin[k] - 1, -1):
            if of.radio[j] >= 0:
                found[j] += of.slow * after[of.radio[j]]
                after[of.radio[j]] += own[j]
        scale(after, of.decay)
    return found


def _ends(of: Measured, passed: Passed, lower: Matrix, whitening: Matrix) -> Matrix:
    """Return the covariance of the last poses, with that of the surveying errors that are considered."""
    n3, size = 3 * of.robots, of.size
    u = [row[:size] for row in passed.u[:n3]]
    by = [whitened(whitening, row) for row in u]
    ends = [[passed.p[a][e] + dot(by[a], by[e]) for e in range(n3)] for a in range(n3)]
    for c in range(size, size + 2 * of.anchors):
        by_error = solved(lower, passed.information[c][:size])
        effect = [passed.u[a][c] - dot(u[a], by_error) for a in range(n3)]
        for a in range(n3):
            add(ends[a], effect[a], effect)
    return ends


# --- linear algebra ---------------------------------------------------------------------------------------


def zeros(rows: int, columns: int) -> Matrix:
    """Return a matrix of zeros."""
    return [[0.0] * columns for _ in range(rows)]


def add(to: Vector, factor: float, what: Vector) -> None:
    """Add a multiple of `what` to the first elements of `to`."""
    for e in range(len(what) if factor else 0):
        to[e] += factor * what[e]


def scale(vector: Vector, factor: float) -> None:
    """Multiply a vector by a factor."""
    for e in range(len(vector)):
        vector[e] *= factor


def dot(one: Vector, other: Vector) -> float:
    """Return the product of two vectors, summed in their order."""
    total = 0.0
    for e in range(len(other)):
        total += one[e] * other[e]
    return total


def cholesky(matrix: Matrix, begin: int, end: int) -> Matrix:
    """Return the lower triangular factor of the rows and columns from `begin` to `end`. Raises Singular."""
    lower = zeros(end - begin, end - begin)
    for a in range(end - begin):
        for e in range(a + 1):
            left = matrix[begin + a][begin + e] - dot(lower[a], lower[e][:e])
            if e < a:
                lower[a][e] = left / lower[e][e]
            elif left > 0.0:
                lower[a][a] = math.sqrt(left)
            else:
                raise Singular("the ranges do not determine all unknowns")
    return lower


def substituted(lower: Matrix, right: Vector) -> Vector:
    """Return the solution x of lower x = right."""
    found: Vector = []
    for a in range(len(lower)):
        found.append((right[a] - dot(lower[a], found)) / lower[a][a])
    return found


def solved(lower: Matrix, right: Vector) -> Vector:
    """Return the solution x of lower lower' x = right."""
    found = substituted(lower, right)
    for a in range(len(lower) - 1, -1, -1):
        found[a] /= lower[a][a]
        add(found, -found[a], lower[a][:a])
    return found


def whitening_of(lower: Matrix) -> Matrix:
    """Return the transposed inverse of `lower`."""
    size = len(lower)
    return [substituted(lower, [1.0 if a == e else 0.0 for a in range(size)]) for e in range(size)]


def whitened(whitening: Matrix, vector: Vector) -> Vector:
    """Return the inverse of a triangular factor times a vector; `whitening` is that inverse, transposed."""
    found = [0.0] * len(vector)
    for factor, row in zip(vector, whitening, strict=True):
        add(found, factor, row)
    return found


def inverted(lower: Matrix) -> Matrix:
    """Return the inverse of lower lower', which is symmetric."""
    size = len(lower)
    columns = [solved(lower, [1.0 if a == e else 0.0 for a in range(size)]) for e in range(size)]
    return [[columns[max(a, e)][min(a, e)] for e in range(size)] for a in range(size)]
