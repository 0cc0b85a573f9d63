"""The closed forms and the motion model, for random true poses."""

from __future__ import annotations

import math
from typing import NamedTuple

import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from agent.estimation.closed_forms import Placement, circle_intersections, included_angle, placements
from agent.estimation.exact import PairObservation, branches, weigh_branches, weigh_placements
from protocol.motion import Pose, Segment, chord, compose, follow, step, wrap

EXACT = 1e-9
FLOOR = 1e-7
"""The maximum rounding error in m of ranges up to 1000 m, and of the values they are computed from."""
ROUNDING = 1e-7
"""The maximum residual in m of any solution, including ill-conditioned ones."""
DOUBLE_ROOT = 1e-1
"""The maximum error in m and rad at a double root: the square root of the square root of rounding."""

angles = st.floats(-math.pi, math.pi)
headings = st.floats(-50.0, 50.0)
coordinates = st.floats(-20.0, 20.0)
lengths = st.floats(0.1, 20.0)
speeds = st.floats(-10.0, 10.0)
turn_rates = st.just(0.0) | st.floats(1e-300, 10.0) | st.floats(-10.0, -1e-300)
periods = st.floats(0.01, 10.0)
poses = st.builds(Pose, coordinates, coordinates, headings)


def apart(one: Pose, other: Pose) -> float:
    return math.hypot(one.x - other.x, one.y - other.y)


def separation(placement: Placement, a: Pose, b: Pose) -> float:
    """Return the distance in m between `a` in <a(M1)> and `b` in <b(M2)>, given this placement."""
    return apart(placement.place(a), b)


def turned(one: float, other: float) -> float:
    return abs(wrap(one - other))


# --- motion -------------------------------------------------------------------------------------------


@given(poses, speeds, turn_rates, periods)
@example(Pose(0.0, 0.0, 0.0), 1.0, 5e-324, 1.0)
@example(Pose(0.0, 0.0, 0.0), 1.0, 1e-300, 1.0)
def test_a_steps_chord_is_a_k_of_eq_1a(pose: Pose, v: float, omega: float, period: float) -> None:
    end = step(pose, v, omega, period)
    assert apart(pose, end) == pytest.approx(abs(chord(v, omega, period)), abs=EXACT)
    assert end.heading == pytest.approx(pose.heading + omega * period, abs=EXACT)


@given(poses, st.floats(0.1, 10.0), st.floats(0.1, 10.0), periods)
def test_a_step_is_an_arc_about_the_point_v_over_omega_to_the_left(
    pose: Pose, v: float, omega: float, period: float
) -> None:
    radius = v / omega
    centre = step(Pose(pose.x, pose.y, pose.heading + math.pi / 2), radius, 0.0, 1.0)
    end = step(pose, v, omega, period)
    assert apart(end, centre) == pytest.approx(radius, abs=EXACT)
    bearing = math.atan2(end.y - centre.y, end.x - centre.x) + math.pi / 2
    assert turned(bearing, end.heading) * radius < EXACT * 10.0


@given(poses, speeds, turn_rates, st.floats(0.01, 1.0), st.integers(1, 50))
def test_following_n_equal_ticks_is_n_steps(
    start: Pose, v: float, omega: float, period: float, ticks: int
) -> None:
    end = start
    for _ in range(ticks):
        end = step(end, v, omega, period)
    followed = follow(start, [Segment(ticks, v, omega)], period)
    assert apart(followed, end) < EXACT
    assert followed.heading == pytest.approx(end.heading, abs=EXACT)


@given(poses, poses, speeds, turn_rates, periods)
def test_a_step_is_the_same_in_every_frame(
    frame: Pose, pose: Pose, v: float, omega: float, period: float
) -> None:
    inside = compose(frame, step(pose, v, omega, period))
    outside = step(compose(frame, pose), v, omega, period)
    assert apart(inside, outside) < EXACT
    assert inside.heading == pytest.approx(outside.heading, abs=EXACT)


@given(st.floats(-1e6, 1e6))
@example(math.pi)
@example(-math.pi)
@example(3 * math.pi)
@example(-3 * math.pi)
def test_a_wrapped_angle_is_in_the_half_open_circle_and_points_the_same_way(angle: float) -> None:
    wrapped = wrap(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


# --- triangles and circles ----------------------------------------------------------------------------


@given(lengths, lengths, st.floats(0.0, math.pi))
def test_the_included_angle_is_that_of_its_triangle(near: float, moved: float, alpha: float) -> None:
    far = math.hypot(near + moved * math.cos(alpha), moved * math.sin(alpha))
    found = included_angle(near, far, moved)
    assert found is not None
    assert 0.0 <= found <= math.pi
    assert math.hypot(near + moved * math.cos(found), moved * math.sin(found)) == pytest.approx(
        far, abs=ROUNDING
    )
    if math.sin(alpha) > 0.05:
        assert found == pytest.approx(alpha, abs=EXACT)


@given(lengths, lengths, st.floats(1e-5, 10.0), st.booleans())
def test_there_is_no_angle_where_there_is_no_triangle(
    near: float, moved: float, excess: float, long: bool
) -> None:
    far = near + moved + excess if long else abs(near - moved) - excess
    assume(far >= 0.0)
    assert included_angle(near, far, moved) is None


@given(lengths)
def test_from_the_beacon_itself_every_direction_is_radial(moved: float) -> None:
    assert included_angle(0.0, moved, moved) == 0.0


@given(coordinates, coordinates, lengths, lengths)
def test_circle_intersections_lie_on_both_circles(x: float, y: float, radius: float, distance: float) -> None:
    assume(math.hypot(x, y) > 0.1)
    found = circle_intersections(x, y, radius, distance)
    for point in found:
        assert math.hypot(*point) == pytest.approx(distance, abs=EXACT)
        assert math.dist(point, (x, y)) == pytest.approx(radius, abs=1.1e-5)
    apart = math.hypot(x, y)
    room = min(radius + distance - apart, apart - abs(radius - distance))
    if room > 1e-3:
        assert len(found) == 2
        assert math.dist(*found) > 0.0
        assert all(math.dist(point, (x, y)) == pytest.approx(radius, abs=EXACT) for point in found)
    elif room < -1e-5:
        assert found == []


def test_a_tangent_point_is_given_once() -> None:
    assert circle_intersections(3.0, 0.0, 1.0, 2.0) == [pytest.approx((2.0, 0.0))]
    assert circle_intersections(1.0, 0.0, 1.0, 2.0) == [pytest.approx((2.0, 0.0))]
    assert circle_intersections(0.0, -4.0, 6.0, 2.0) == [pytest.approx((0.0, 2.0))]


# --- phase 1: branches --------------------------------------------------------------------------------


def local(start: Pose, odometry: Pose) -> float:
    return math.hypot(*_point(compose(start, odometry)))


def _point(pose: Pose) -> tuple[float, float]:
    return pose.x, pose.y


@given(st.floats(0.01, 20.0), poses, angles)
def test_the_branches_contain_the_true_heading(rho0: float, odometry: Pose, heading: float) -> None:
    moved = math.hypot(odometry.x, odometry.y)
    assume(moved > 0.01)
    truth = Pose(rho0, 0.0, heading)
    found = branches(rho0, odometry, local(truth, odometry))
    assert 1 <= len(found) <= 2
    alpha = wrap(heading + math.atan2(odometry.y, odometry.x))
    tame = abs(math.sin(alpha)) > 0.05 and min(rho0, moved) > 0.1
    nearest = min(found, key=lambda branch: turned(branch.start.heading, heading))
    assert turned(nearest.start.heading, heading) < (EXACT if tame else 1e-4)
    assert turned(nearest.alpha, alpha) < (EXACT if tame else 1e-4)
    for branch in found:
        assert branch.distance(odometry) == pytest.approx(local(truth, odometry), abs=ROUNDING)
    if tame:
        assert found[0].alpha == -found[1].alpha


@given(st.floats(0.1, 3.0), st.floats(0.1, 3.0), st.sampled_from([0.0, math.pi]))
def test_a_radial_way_has_one_branch(rho0: float, moved: float, alpha: float) -> None:
    found = branches(rho0, Pose(moved, 0.0, 0.0), abs(rho0 + math.cos(alpha) * moved))
    assert all(turned(branch.alpha, alpha) < 1e-4 for branch in found)
    assert len(found) in (1, 2)
    assert len(branches(2.0, Pose(1.0, 0.0, 0.0), 3.0)) == len(branches(2.0, Pose(1.0, 0.0, 0.0), 1.0)) == 1


@given(st.floats(0.5, 3.0), angles, st.floats(0.3, 2.0))
@example(1.0, -2.75, 2.0)
def test_a_third_range_leaves_the_true_branch_as_it_was(rho0: float, alpha: float, omega: float) -> None:
    """Refinement does not change an exact branch, and the mirrored branch is ruled out."""
    assume(abs(math.sin(alpha)) > 0.3)
    truth = Pose(rho0, 0.0, alpha)
    second = Pose(1.0, 0.0, 0.0)
    third = step(second, 1.0, omega, 1.0)
    seen = [(pose, local(truth, pose)) for pose in (Pose(0.0, 0.0, 0.0), second, third)]
    left = weigh_branches(branches(rho0, second, local(truth, second)), seen, 100.0, FLOOR, FLOOR)
    assert len(left) == 1
    assert turned(left[0].start.heading, alpha) < EXACT
    assert left[0].alpha == pytest.approx(alpha, abs=EXACT)


@given(st.floats(0.5, 3.0), st.floats(0.3, 2.8), st.sampled_from([1.0, -1.0]), st.floats(0.3, 2.0))
def test_no_detection_where_a_branch_predicts_one_rules_it_out(
    rho0: float, angle: float, side: float, omega: float
) -> None:
    """There is no detection, and R is between the two ranges that the branches predict."""
    alpha = side * angle
    truth = Pose(rho0, 0.0, alpha)
    second = Pose(1.0, 0.0, 0.0)
    third = step(second, 1.0, side * -omega, 1.0)
    mirrored = local(Pose(rho0, 0.0, -alpha), third)
    true = local(truth, third)
    far = max(true, mirrored)
    assume(far - min(true, mirrored) > 1e-3)
    seen = [(second, local(truth, second)), (third, None)]
    left = weigh_branches(
        branches(rho0, second, local(truth, second)), seen, 0.5 * (true + mirrored), FLOOR, FLOOR
    )
    assert len(left) == 1
    assert left[0].distance(third) == pytest.approx(far, abs=ROUNDING)


# --- eq. (7) ------------------------------------------------------------------------------------------


class Encounter(NamedTuple):
    """True poses for eq. (7), with the measurements."""

    truth: Placement
    p1b: Pose
    p1a: Pose
    p2a: Pose
    rho1: float
    rho2: float

    @property
    def distance(self) -> float:
        return math.hypot(self.truth.x, self.truth.y)

    def solutions(self) -> list[Placement]:
        return placements(self.distance, self.p1b, self.p1a, self.p2a, self.rho1, self.rho2)

    def residual(self, placement: Placement) -> float:
        """Return the residual of the three equations in m."""
        return max(
            abs(math.hypot(placement.x, placement.y) - self.distance),
            abs(separation(placement, self.p1a, self.p1b) - self.rho1),
            abs(separation(placement, self.p2a, self.p1b) - self.rho2),
        )

    @property
    def is_tame(self) -> bool:
        """Return whether all solutions are separate, and no side of a triangle is short."""
        moved, reach = (
            apart(self.p1a, self.p2a),
            math.hypot(self.truth.x - self.p1b.x, self.truth.y - self.p1b.y),
        )
        far = math.hypot(self.p1b.x, self.p1b.y)
        return (
            min(moved, reach, far, self.rho1, self.rho2, self.distance) > 0.3
            and _height(self.rho1, self.rho2, moved) > 0.1
            and _height(self.distance, reach, far) > 0.1
        )


def _height(one: float, other: float, base: float) -> float:
    """Return the height of the triangle over `base`, in m."""
    along = (one * one - other * other + base * base) / (2.0 * base)
    return math.sqrt(max(one * one - along * along, 0.0))


def _to(placement: Placement, pose: Pose) -> Pose:
    return compose(Pose(placement.x, placement.y, placement.phi), pose)


def _from(placement: Placement, pose: Pose) -> Pose:
    dx, dy = pose.x - placement.x, pose.y - placement.y
    c, s = math.cos(placement.phi), math.sin(placement.phi)
    return Pose(c * dx + s * dy, c * dy - s * dx, pose.heading - placement.phi)


@st.composite
def encounters(draw: st.DrawFn) -> Encounter:
    """Draw an encounter of two robots at any positions, including ones that are impossible in phase 3."""
    distance, bearing = draw(st.floats(0.5, 20.0)), draw(angles)
    truth = Placement(draw(angles), distance * math.cos(bearing), distance * math.sin(bearing))
    p1b, p1a = draw(poses), draw(poses)
    p2a = step(p1a, draw(st.floats(0.05, 10.0)), 0.0, 1.0)
    rho1, rho2 = separation(truth, p1a, p1b), separation(truth, p2a, p1b)
    return Encounter(truth, p1b, p1a, p2a, rho1, rho2)


def nearest(found: list[Placement] | tuple[Placement, ...], truth: Placement) -> float:
    return min(max(turned(p.phi, truth.phi), math.hypot(p.x - truth.x, p.y - truth.y)) for p in found)


@given(encounters())
def test_eq_7s_placements_contain_the_truth(encounter: Encounter) -> None:
    assume(min(encounter.rho1, encounter.rho2) > 0.01)
    assume(apart(_to(encounter.truth, Pose(0.0, 0.0, 0.0)), encounter.p1b) > 0.01)
    assume(math.hypot(encounter.p1b.x, encounter.p1b.y) > 0.01)
    found = encounter.solutions()
    assert 1 <= len(found) <= 4
    assert nearest(found, encounter.truth) < (EXACT if encounter.is_tame else DOUBLE_ROOT)


@given(encounters())
def test_each_placement_satisfies_all_of_eq_7(encounter: Encounter) -> None:
    assume(encounter.is_tame)
    for placement in encounter.solutions():
        assert encounter.residual(placement) < EXACT
        assert -math.pi < placement.phi <= math.pi


@given(encounters())
def test_the_placements_are_all_different(encounter: Encounter) -> None:
    found = encounter.solutions()
    for i, one in enumerate(found):
        assert all(nearest([one], other) > EXACT for other in found[:i])


@given(encounters())
def test_a_robot_that_met_its_peer_head_on_is_placed(encounter: Encounter) -> None:
    """With rho_1 = 0, a was at the position of b. The triangle is known from its other end."""
    truth, p1b, p2a = encounter.truth, encounter.p1b, encounter.p2a
    on_b = _from(truth, p1b)
    moved = apart(on_b, p2a)
    met = Encounter(truth, p1b, on_b, p2a, 0.0, separation(truth, p2a, p1b))
    assume(moved > 0.1)
    assume(apart(_to(truth, Pose(0.0, 0.0, 0.0)), p1b) > 0.1)
    assume(math.hypot(p1b.x, p1b.y) > 0.1)
    found = met.solutions()
    assert 1 <= len(found) <= 2 or not met.is_tame
    assert nearest(found, truth) < DOUBLE_ROOT
    assert all(met.residual(placement) < 1e-5 for placement in found)


@given(encounters(), st.sampled_from([1.0, -1.0]))
def test_a_radial_way_has_at_most_two_placements(encounter: Encounter, side: float) -> None:
    """Robot a moves straight away from b or towards it, so the branches +-alpha coincide."""
    assume(encounter.rho1 > 0.5)
    on_b = _from(encounter.truth, encounter.p1b)
    away = math.atan2(encounter.p1a.y - on_b.y, encounter.p1a.x - on_b.x)
    p2a = step(Pose(encounter.p1a.x, encounter.p1a.y, away), side * 0.25, 0.0, 1.0)
    radial = Encounter(
        encounter.truth, encounter.p1b, encounter.p1a, p2a, encounter.rho1, encounter.rho1 + side * 0.25
    )
    assume(apart(_to(encounter.truth, Pose(0.0, 0.0, 0.0)), encounter.p1b) > 0.1)
    assume(math.hypot(encounter.p1b.x, encounter.p1b.y) > 0.1)
    found = radial.solutions()
    assert nearest(found, encounter.truth) < DOUBLE_ROOT
    far = [one for i, one in enumerate(found) if all(nearest([one], two) > 0.2 for two in found[:i])]
    assert len(far) <= 2


def test_touching_circles_and_a_radial_way_have_one_placement() -> None:
    """M2, b, a and M1 are collinear, and a moves along the line: D is the sum of rho_1 and both radii."""
    found = placements(10.0, Pose(4.0, 0.0, 0.0), Pose(-5.0, 0.0, 0.0), Pose(-4.5, 0.0, 0.0), 1.0, 1.5)
    assert found == [pytest.approx((0.0, 10.0, 0.0), abs=EXACT)]


@pytest.mark.parametrize(
    ("rho1", "rho2", "p2a"),
    [
        (1.0, 2.5, Pose(6.0, 0.0, 0.0)),
        (0.0, 0.0, Pose(6.0, 0.0, 0.0)),
        (1.0, 1.0, Pose(5.0, 0.0, 0.0)),
        (30.0, 30.0, Pose(6.0, 0.0, 0.0)),
    ],
    ids=["no triangle", "at b twice", "a has not moved", "b is too far from M2's circle"],
)
def test_nothing_is_placed_where_nothing_fits(rho1: float, rho2: float, p2a: Pose) -> None:
    assert placements(10.0, Pose(5.0, 0.0, 0.0), Pose(5.0, 0.0, 0.0), p2a, rho1, rho2) == []


# --- scoring placements -------------------------------------------------------------------------------


def sightings_of(encounter: Encounter, third: Pose) -> list[PairObservation]:
    """Return the two ranges of `encounter`, and a third one after b has moved to `third`."""
    return [
        PairObservation(0, encounter.p1a, encounter.p1b, encounter.rho1),
        PairObservation(1, encounter.p2a, encounter.p1b, encounter.rho2),
        PairObservation(2, encounter.p2a, third, separation(encounter.truth, encounter.p2a, third)),
    ]


@given(encounters(), st.floats(0.5, 2.0), angles)
def test_a_third_range_leaves_the_true_placement_as_it_was(
    encounter: Encounter, way: float, course: float
) -> None:
    """Refinement does not change an exact placement, and the remaining ones explain every range."""
    assume(encounter.is_tame)
    third = step(Pose(encounter.p1b.x, encounter.p1b.y, course), way, 0.0, 1.0)
    assume(separation(encounter.truth, encounter.p2a, third) > 0.3)
    pair_observations = sightings_of(encounter, third)
    left = weigh_placements([encounter.truth], pair_observations, 1000.0, FLOOR)
    assert len(left) == 1
    assert nearest(left, encounter.truth) < EXACT
    for placement in weigh_placements(encounter.solutions(), pair_observations, 1000.0, FLOOR):
        assert encounter.residual(placement) < 2e-7
        assert separation(placement, encounter.p2a, third) == pytest.approx(
            pair_observations[2].range, abs=2e-7
        )


@given(encounters(), st.floats(0.5, 2.0), angles)
def test_no_detection_rules_out_the_placements_that_predict_one(
    encounter: Encounter, way: float, course: float
) -> None:
    assume(encounter.is_tame)
    third = step(Pose(encounter.p1b.x, encounter.p1b.y, course), way, 0.0, 1.0)
    true = separation(encounter.truth, encounter.p2a, third)
    silent = [*sightings_of(encounter, third)[:2], PairObservation(2, encounter.p2a, third, None)]
    found = encounter.solutions()
    left = weigh_placements(found, silent, true - 1e-3, FLOOR)
    assert nearest(left, encounter.truth) < EXACT
    assert left == tuple(p for p in found if separation(p, encounter.p2a, third) > true - 1e-3)
