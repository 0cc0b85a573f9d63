"""The paper's statements on indistinguishability (Sections II.A and III.C), checked by brute force.

A robot drives through points p_k (complex numbers) that it knows in its own frame. The rotation phi and the
shift T of that frame in the plane are unknown. Two initial states are indistinguishable if they put every
point at the measured range from its anchor (Definition 1), so the tests count pairs (phi, T). They use the
closed forms of `agent` only for comparison.
"""

from __future__ import annotations

import cmath
import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.estimation.closed_forms import placements
from agent.estimation.exact import branches
from protocol.motion import ORIGIN, TAU, Controls, Pose, step, wrap

Reals = NDArray[np.float64]
Three = tuple[complex, complex, complex]
PERIOD = 1.0
COARSE, FINER, FINEST = 256, 32, 3
"""The initial cells of a scan, the parts into which an undecided cell is cut, and the number of cuts."""
ROUND = COARSE * FINER**FINEST
STEP = TAU / ROUND
"""The width of the finest cells, in rad. Edges are multiples of it, so neighbours share them to the bit."""
BISECTIONS = 45
FITS = 1e-7
"""The largest residual of a satisfied equation, in m^2 or m."""
DRAWS = 500
"""The number of draws of each seeded count."""

angles = st.floats(-math.pi, math.pi)
coordinates = st.floats(-5.0, 5.0)
points = st.builds(complex, coordinates, coordinates)
forwards = st.builds(Controls, st.floats(0.3, 1.0), st.floats(-3.0, 3.0))
straights = st.builds(
    Controls, st.floats(0.3, 1.0) | st.floats(-1.0, -0.3), st.sampled_from([0.0, TAU / PERIOD])
)
"""Manoeuvres on a line: forward, backward, or a full circle, which ends at its start."""


# --- brute force --------------------------------------------------------------------------------------


class Scan(NamedTuple):
    """The zeros of a trigonometric polynomial of phi."""

    zeros: list[float]
    is_complete: bool
    """true if there are no nearly double zeros, so that none is missed"""


def scan(f: Callable[[Reals], Reals], degree: int) -> Scan:
    """Return all sign changes of `f` around the circle, by bisection.

    By Bernstein's inequality, |f''| <= degree^2 max|f|. If a cell of width h had two zeros, f would be
    stationary between them, and at most degree^2 h^2 max|f| at both ends of the cell. A cell with a larger
    value at one end therefore has one zero if the sign changes, else none. Other cells are cut.
    """
    cells = np.arange(COARSE) * FINER**FINEST
    size = np.abs(f(STEP * cells)).max()
    low, high = np.array([], dtype=int), np.array([], dtype=int)
    for level in range(FINEST, -1, -1):
        width = FINER**level
        left, right = f(STEP * cells), f(STEP * ((cells + width) % ROUND))
        certain = np.maximum(np.abs(left), np.abs(right)) > (degree * STEP * width) ** 2 * size
        crossed = cells[certain & ((left > 0.0) != (right > 0.0))]
        low, high = np.append(low, crossed), np.append(high, crossed + width)
        finer = np.arange(FINER) * (width // FINER)
        cells = np.add.outer(cells[~certain], finer).ravel() if level else cells[~certain]
    below, above = STEP * low, STEP * high
    side = f(below) > 0.0
    for _ in range(BISECTIONS if low.size else 0):
        middle = 0.5 * (below + above)
        before = (f(middle) > 0.0) == side
        below, above = np.where(before, middle, below), np.where(before, above, middle)
    return Scan([float(zero) for zero in below], cells.size == 0)


class Setting(NamedTuple):
    """Three ranges from the points p_k of a robot to the anchors m_k, of which two may be the same."""

    p: Three
    m: Three
    rho: tuple[float, float, float]

    @classmethod
    def of(cls, p: Three, m: Three, phi: float, shift: complex) -> Setting:
        """Return the ranges of a robot whose frame is rotated by `phi`, then shifted."""
        q = cmath.rect(1.0, phi) * np.array(p) + shift
        first, second, third = (float(rho) for rho in np.abs(q - np.array(m)))
        return cls(p, m, (first, second, third))

    def system(self, phi: Reals) -> tuple[NDArray[np.complex128], Reals]:
        """Return numerator and determinant of t, the first point relative to its anchor (their quotient).

        By Section III.C, subtract the first equation |t| = rho_0 from the others,
        |t - u_k| = rho_k with u_k = (m_k - m_0) - e^{i phi} (p_k - p_0). That leaves two linear equations
        u_k . t = w_k, by Cramer's rule.
        """
        z = np.exp(1j * phi)
        u1, u2 = ((self.m[k] - self.m[0]) - z * (self.p[k] - self.p[0]) for k in (1, 2))
        w1 = 0.5 * (self.rho[0] ** 2 - self.rho[1] ** 2 + np.abs(u1) ** 2)
        w2 = 0.5 * (self.rho[0] ** 2 - self.rho[2] ** 2 + np.abs(u2) ** 2)
        return 1j * (w2 * u1 - w1 * u2), (u1.conj() * u2).imag

    def residual(self, phi: Reals) -> Reals:
        """Return the residual of the first equation, |t|^2 = rho_0^2, times the determinant squared.

        Each solution (phi, T) is a zero; a phi that leaves two T is a double one, as numerator and
        determinant both vanish there.
        """
        numerator, determinant = self.system(phi)
        return np.asarray(np.abs(numerator) ** 2 - (self.rho[0] * determinant) ** 2)

    def harmonics(self) -> Reals:
        """Return the amplitudes of e^{i n phi}, n = 0 ... 8, of the scaled residual."""
        spectrum = np.abs(np.fft.rfft(self.residual(np.linspace(0.0, TAU, 16, endpoint=False))))
        return np.asarray(spectrum / spectrum.max())

    def solve(self) -> tuple[list[tuple[float, complex]], bool]:
        """Return all solutions (phi, T) found, and true if they are complete."""
        zeros, is_complete = scan(self.residual, 3)
        if not is_complete:
            return [], False
        found: list[tuple[float, complex]] = []
        for phi in zeros:
            numerator, determinant = self.system(np.array([phi]))
            first = complex(numerator[0] / determinant[0])
            found.append((phi, self.m[0] + first - cmath.rect(1.0, phi) * self.p[0]))
        return found, True


def command(start: Pose, controls: Sequence[Controls]) -> list[Pose]:
    """Return Q: the start, and the pose after each manoeuvre."""
    poses = [start]
    for control in controls:
        poses.append(step(poses[-1], control.v, control.omega, PERIOD))
    return poses


def place(pose: Pose) -> complex:
    return complex(pose.x, pose.y)


def headings_that_fit(
    rho0: float, odometry: Sequence[complex], rho: Sequence[float]
) -> tuple[list[float], bool]:
    """Return the headings that fit one anchor with q_0 at (rho_0, 0), and true if they are complete."""

    def misses(k: int) -> Callable[[Reals], Reals]:
        return lambda phi: np.asarray(np.abs(rho0 + np.exp(1j * phi) * odometry[k]) ** 2 - rho[k] ** 2)

    zeros, is_complete = scan(misses(1), 1)
    fitting = [
        phi for phi in zeros if all(abs(misses(k)(np.array([phi]))[0]) < FITS for k in range(len(rho)))
    ]
    return fitting, is_complete


def off_the_line(odometry: Sequence[complex]) -> float:
    """Return the largest distance in m of a point from the line through the first two."""
    chord = odometry[1] - odometry[0]
    return max(abs(((point - odometry[0]) / chord).imag) * abs(chord) for point in odometry)


# --- one anchor: Proposition 1 ------------------------------------------------------------------------


@settings(max_examples=100)
@given(
    st.floats(0.5, 3.0),
    angles,
    st.lists(forwards, min_size=1, max_size=1)
    | st.builds(
        lambda first, more: [Controls(first, 0.0), *more],
        st.floats(0.3, 1.0),
        st.lists(straights, max_size=4),
    ),
)
@pytest.mark.long
def test_two_points_or_collinear_ones_leave_the_mirror_image_too_and_nothing_else(
    rho0: float, heading: float, controls: list[Controls]
) -> None:
    """Proposition 1 (2); the two solutions are the branches +-alpha of eq. (2).

    A rotation about q_0 mirrors the points: the path of the robot between them is rotated.
    """
    poses = command(ORIGIN, controls)
    odometry = [place(pose) for pose in poses]
    truth = [place(pose) for pose in command(Pose(rho0, 0.0, heading), controls)]
    rho = [abs(point) for point in truth]
    found, is_complete = headings_that_fit(rho0, odometry, rho)
    assume(is_complete)
    assert len(found) == 2
    true, other = sorted(found, key=lambda phi: abs(wrap(phi - heading)))
    assert wrap(true - heading) == pytest.approx(0.0, abs=FITS)
    mirrored = [rho0 + cmath.rect(1.0, other) * point for point in odometry]
    assert mirrored == pytest.approx([point.conjugate() for point in truth], abs=FITS)

    closed = branches(rho0, poses[1], rho[1])
    assert len(closed) == 2
    for branch in closed:
        assert min(abs(wrap(branch.start.heading - phi)) for phi in found) < FITS


# --- several anchors -------------------------------------------------------------------------------------


@settings(max_examples=100)
@given(st.tuples(points, points, points), st.floats(1.0, 10.0), points, angles)
@pytest.mark.long
def test_3_plus_1_leaves_two_trajectories(
    odometry: tuple[complex, complex, complex], distance: float, start: complex, heading: float
) -> None:
    """Section II.A.2: q_3 is an intersection of the circles about M_1 and M_2, the other is its image."""
    ways = (0j, *odometry)
    q2, q3 = (start + cmath.rect(1.0, heading) * way for way in ways[2:])
    assume(min(abs(start), abs(odometry[0]), abs(q3)) > 0.3)
    assume(off_the_line(ways[:3]) > 0.1)
    setting = Setting.of((ways[0], ways[1], ways[3]), (0j, 0j, distance + 0j), heading, start)
    fits, is_complete = setting.solve()
    assume(is_complete)
    left = [(phi, t) for phi, t in fits if abs(abs(t + cmath.rect(1.0, phi) * ways[2]) - abs(q2)) < FITS]
    assert len(left) == 2
    one, other = (t + cmath.rect(1.0, phi) * ways[3] for phi, t in left)
    assert one == pytest.approx(other.conjugate(), abs=1e-6)


@settings(max_examples=100)
@given(st.tuples(points, points), st.floats(1.0, 10.0), points, angles)
@pytest.mark.long
def test_2_plus_1_leaves_two_trajectories_for_each_distance_of_q_2_from_m_1(
    odometry: tuple[complex, complex], distance: float, start: complex, heading: float
) -> None:
    """Section II.A.2: two ranges give two distances (branches of eq. (2)), of which one can be infeasible."""
    ways = (0j, *odometry)
    q2 = start + cmath.rect(1.0, heading) * ways[2]
    assume(min(abs(start), abs(odometry[0]), abs(q2)) > 0.3)
    setting = Setting.of(ways, (0j, 0j, distance + 0j), heading, start)
    fits, is_complete = setting.solve()
    assume(is_complete)
    first, last = (Pose(way.real, way.imag, 0.0) for way in odometry)
    distances = [branch.distance(last) for branch in branches(setting.rho[0], first, setting.rho[1])]
    assume(len(distances) == 2 and abs(distances[0] - distances[1]) > 1e-3)
    reached = [abs(t + cmath.rect(1.0, phi) * ways[2]) for phi, t in fits]
    there = [sum(abs(one - far) < 1e-6 for one in reached) for far in distances]
    assert sum(there) == len(fits)
    assert sorted(there) in ([0, 2], [2, 2])


@settings(max_examples=100)
@given(st.floats(0.5, 12.0), points, st.tuples(points, points), angles, angles)
@pytest.mark.long
def test_eq_7_has_exactly_the_placements_that_brute_force_finds(
    distance: float, p1b: complex, ways: tuple[complex, complex], phi: float, psi: float
) -> None:
    """M_2 and p_1^b act as anchors: D is the range of M_1 to M_2; rho_1m and rho_2m are of a to p_1^b."""
    p1a, p2a = ways
    truth = cmath.rect(distance, psi)
    setting = Setting.of((0j, p1a, p2a), (0j, p1b, p1b), phi, truth)
    assume(min(abs(p1b), abs(p1b - truth), abs(p2a - p1a), *setting.rho) > 0.2)
    fits, is_complete = setting.solve()
    assume(is_complete)
    closed = placements(
        distance,
        Pose(p1b.real, p1b.imag, 0.0),
        Pose(p1a.real, p1a.imag, 0.0),
        Pose(p2a.real, p2a.imag, 0.0),
        setting.rho[1],
        setting.rho[2],
    )
    assert len(closed) == len(fits) in {2, 4}
    for angle, shift in fits:
        assert any(
            abs(wrap(one.phi - angle)) < 1e-6 and abs(complex(one.x, one.y) - shift) < 1e-6 for one in closed
        )


# --- counts: 2+1 against 1+1+1 -----------------------------------------------------------------------


def anywhere(rng: np.random.Generator, *, same: bool) -> Setting:
    """Draw a robot at three points, each ranged from one of three anchors, or of two if `same`."""
    p0, p1, p2, m0, m1, m2, shift = (complex(x, y) for x, y in rng.normal(size=(7, 2)))
    return Setting.of((p0, p1, p2), (m0, m1, m1 if same else m2), rng.uniform(0.0, TAU), shift)


def meeting(rng: np.random.Generator, *, same: bool) -> Setting:
    """Draw an encounter within R on Section IV's orbits, with D and two mutual ranges.

    Robot a drives 1 m between the ranges; b also does, or stops if `same`.
    """
    anchors, sensing = 10.0, 3.0
    orbit = 0.5 * (anchors + sensing)
    while True:
        q1a = orbit + cmath.rect(sensing * math.sqrt(rng.uniform()), rng.uniform(0.0, TAU))
        along = (anchors**2 - orbit**2 + abs(q1a) ** 2) / (2.0 * abs(q1a))
        if along >= anchors:
            continue
        m1 = q1a / abs(q1a) * complex(along, rng.choice([-1.0, 1.0]) * math.sqrt(anchors**2 - along**2))
        p2a = orbit + cmath.rect(1.0, rng.uniform(0.0, TAU))
        p2b = orbit + (0.0 if same else cmath.rect(1.0, rng.uniform(0.0, TAU)))
        setting = Setting.of((0j, orbit, p2a), (0j, orbit, p2b), cmath.phase(q1a - m1), m1)
        if setting.rho[2] <= sensing:
            return setting


@pytest.mark.parametrize("draw", [anywhere, meeting])
@pytest.mark.parametrize(("same", "degree"), [(True, 2), (False, 3)], ids=["2+1", "1+1+1"])
def test_2_plus_1_leaves_four_at_most_and_1_plus_1_plus_1_not_eight_but_six(
    draw: Callable[..., Setting], same: bool, degree: int
) -> None:
    """The bounds of Section III.C, derived: without T, phi is a zero of a trigonometric polynomial, and one
    of degree n has no more than 2n zeros (2n roots e^{i phi}).

    u_k = const + const e^{i phi}, so |u_k|^2 and w_k are of degree 1, and so is the determinant
    Im(conj(u_1) u_2), as e^{-i phi} e^{i phi} = 1: the residual is of degree 3. That is the direct
    kinematics of a planar 3-RPR platform, known to have six solutions at most, and they are computed
    as easily as here. If two anchors are the same, count from the first point of theirs: one of |u_k| and
    w_k is constant, which leaves degree 2. (From which point one counts changes nothing: the residual is
    the Cayley-Menger determinant of three circles with a common point.)
    """
    rng = np.random.default_rng(2)
    harmonics = np.array([draw(rng, same=same).harmonics() for _ in range(DRAWS)])
    assert harmonics[:, degree + 1 :].max() < 1e-12
    assert harmonics[:, degree].min() > 1e-9


def counted(draw: Callable[..., Setting], *, same: bool, draws: int = DRAWS) -> Counter[int]:
    """Return the number of draws by their number of solutions, for complete scans."""
    rng = np.random.default_rng(1)
    scans = [scan(draw(rng, same=same).residual, 3) for _ in range(draws)]
    return Counter(len(one.zeros) for one in scans if one.is_complete)


@pytest.mark.parametrize(
    ("draw", "same", "numbers"),
    [
        (anywhere, True, {2, 4}),
        pytest.param(anywhere, False, {2, 4, 6}, marks=pytest.mark.long),
        pytest.param(meeting, True, {4}, marks=pytest.mark.long),
        pytest.param(meeting, False, {2, 4, 6}, marks=pytest.mark.long),
    ],
    ids=["2+1 anywhere", "1+1+1 anywhere", "2+1 of the pair", "1+1+1 of the pair"],
)
@pytest.mark.long
def test_both_bounds_are_reached(draw: Callable[..., Setting], same: bool, numbers: set[int]) -> None:
    """At least 99.6 % of the scans of 100 000 draws each were complete, and none had a seventh solution:

    2+1, anywhere:     2 in 34.0 %, 4 in 66.0 %
    1+1+1, anywhere:   2 in 48.9 %, 4 in 46.3 %, 6 in 4.8 %
    2+1, the pair:     4 in all
    1+1+1, the pair:   2 in 27.0 %, 4 in 60.6 %, 6 in 12.4 %

    The 2+1 of the pair always has four, because M_1, seen from p_1^b, is at most R nearer or farther than the
    orbit's radius (D+R)/2, on either branch: between (D-R)/2 and (D+3R)/2, where Section III.C finds two
    intersections. Only ticks without a detection leave fewer.
    """
    counts = counted(draw, same=same)
    assert set(counts) == numbers
    assert counts.total() > 0.99 * DRAWS
