"""The plan, turn rates and bounds that follow from the mission parameters, and missions that respect them."""

from __future__ import annotations

import math
from itertools import combinations

import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from agent.estimation.closed_forms import Placement
from agent.planning.assured import Assured
from agent.planning.paper import Paper
from agent.planning.phase1_anchor import third_point
from agent.planning.phase3_last_manoeuvre import LAST_SPEEDS, TURN_RATES, Question, last_manoeuvre
from compose.launch.in_process import run_mission
from compose.recording.run import Run
from compose.scenario.scenario_file import load, parse
from protocol.mission import OPTIMAL_TURN, Mission, PlannerName, third_point_turn_rate
from protocol.motion import Pose, compose, step
from protocol.orbits import rendezvous, tick_budget
from tests.missions import mission_of, outcome, own_ranges
from tests.steps import planner_of, steps
from world.sensors import mutual_ranges
from world.truth import Truth

SECTION_IV = Mission(3.0, 1.0, 1.0, math.pi)
D = 10.0
MANOEUVRES = {"paper": Paper.MANOEUVRES, "assured": Assured.MANOEUVRES}
VARIANTS: tuple[PlannerName, ...] = ("paper", "assured")

missions = st.builds(
    Mission, st.floats(1.0, 8.0), st.floats(0.1, 2.0), st.floats(0.3, 2.0), st.floats(0.3, math.pi)
)
angles = st.floats(-math.pi, math.pi)


# --- the rendezvous -----------------------------------------------------------------------------------


@given(missions, st.floats(5.0, 40.0))
def test_the_papers_orbits_are_eq_6(mission: Mission, distance: float) -> None:
    plan = rendezvous(mission, distance, "paper")
    radius = (distance + mission.sensing_range) / 2
    share = math.acos(distance / (distance + mission.sensing_range)) / math.pi
    assert plan.a.radius == plan.b.radius == pytest.approx(radius)
    assert plan.a.omega == pytest.approx(min(mission.max_turn_rate, mission.max_speed / radius))
    assert plan.b.omega == pytest.approx(-share * plan.a.omega)
    assert plan.a.v == pytest.approx(plan.a.omega * radius)
    assert plan.b.v == pytest.approx(-plan.b.omega * radius)
    assert plan.bound == pytest.approx((2 * math.pi + 2 * math.pi * share) / abs(plan.b.omega))
    assert plan.a.v <= mission.max_speed * (1 + 1e-12)


@given(missions, st.floats(5.0, 40.0), st.sampled_from(VARIANTS))
def test_the_tick_budget_leaves_room_beyond_the_bound(
    mission: Mission, distance: float, planner_name: PlannerName
) -> None:
    plan = rendezvous(mission, distance, planner_name)
    assert tick_budget(mission, plan) > 2 * plan.bound / mission.period


# --- eq. (4) and eq. (5) ------------------------------------------------------------------------------


def test_the_optimum_of_eq_4_is_the_root_that_the_notes_give() -> None:
    assert pytest.approx(2.3311, abs=5e-5) == OPTIMAL_TURN
    assert math.tan(OPTIMAL_TURN / 2) == pytest.approx(OPTIMAL_TURN, abs=1e-12)
    assert math.cos(OPTIMAL_TURN) + OPTIMAL_TURN * math.sin(OPTIMAL_TURN) - 1 == pytest.approx(0.0, abs=1e-12)


@given(missions)
def test_the_turn_rate_of_the_third_point_is_the_optimum_within_omega_max(mission: Mission) -> None:
    assert third_point_turn_rate(mission) == min(OPTIMAL_TURN / mission.period, mission.max_turn_rate)


@st.composite
def second_points(draw: st.DrawFn) -> tuple[Mission, list[Pose]]:
    """Draw a mission and the poses at the second range for +alpha and -alpha, in the anchor's frame."""
    mission = draw(missions)
    alpha = draw(st.floats(0.0, math.pi))
    rho0 = draw(st.floats(0.0, 1.0)) * mission.sensing_range
    places = [step(Pose(rho0, 0.0, side * alpha), mission.first_straight, 0.0, 1.0) for side in (1.0, -1.0)]
    assume(math.hypot(places[0].x, places[0].y) <= mission.sensing_range)
    return mission, places


def after(place: Pose, v: float, omega: float, mission: Mission) -> float:
    end = step(place, v, omega, mission.period)
    return math.hypot(end.x, end.y)


@settings(max_examples=100)
@given(second_points(), st.sampled_from(VARIANTS))
@example((SECTION_IV, [Pose(0.7, 2.8, 1.25), Pose(0.7, -2.8, -1.25)]), "paper")
def test_eq_5_keeps_the_nearer_branch_in_range(
    case: tuple[Mission, list[Pose]], planner_name: PlannerName
) -> None:
    mission, places = case
    controls = third_point(places, mission, MANOEUVRES[planner_name])
    if controls is None:
        assert planner_name == "paper"
        return
    assert 0.0 < abs(controls.v) <= mission.max_speed
    assert abs(controls.omega) <= mission.max_turn_rate
    assert planner_name == "assured" or controls.v > 0.0
    nearer = min(after(place, controls.v, controls.omega, mission) for place in places)
    assert nearer <= mission.sensing_range - 0.9e-6


@given(st.floats(1.0, 8.0), st.floats(0.1, 3.0), st.floats(0.1, 2.0), st.floats(0.3, math.pi))
def test_where_there_is_room_the_third_point_is_the_best_of_eq_4(
    rho0: float, alpha: float, period: float, turn_rate: float
) -> None:
    mission = Mission(20.0, period, 2.0, turn_rate)
    places = [step(Pose(rho0, 0.0, side * alpha), 2.0, 0.0, period) for side in (1.0, -1.0)]
    controls = third_point(places, mission, Paper.MANOEUVRES)
    assert controls is not None
    assert controls.v == mission.max_speed
    assert controls.omega == third_point_turn_rate(mission)
    plus, minus = (after(place, controls.v, controls.omega, mission) ** 2 for place in places)
    for fraction in range(1, 101):
        omega = mission.max_turn_rate * fraction / 100
        one, other = (after(place, mission.max_speed, omega, mission) ** 2 for place in places)
        assert abs(one - other) <= abs(plus - minus) * (1 + 1e-9)


def test_a_branch_on_the_circle_of_range_is_put_inside_it_by_the_margin() -> None:
    """Eq. (5) puts it exactly on R, where rounding would decide if a range is measured."""
    place = step(Pose(1.8337195113037719, 0.0, 0.31233737057044775), 1.0, 0.0, 1.0)
    mirrored = Pose(place.x, -place.y, -place.heading)
    controls = third_point([place, mirrored], SECTION_IV, Paper.MANOEUVRES)
    assert controls is not None
    assert controls.v < 1.0
    nearer = min(after(one, controls.v, controls.omega, SECTION_IV) for one in (place, mirrored))
    assert nearer == pytest.approx(3.0 - 1e-6, abs=1e-9)


def test_branches_that_mirror_across_the_heading_are_told_apart_straight_ahead() -> None:
    """After a circle, one branch can be in front of the anchor and one behind; no turn distinguishes them."""
    places = [Pose(0.5, 1.0, math.pi / 2), Pose(0.5, -1.0, math.pi / 2)]
    controls = third_point(places, SECTION_IV, Paper.MANOEUVRES)
    assert controls is not None
    assert (controls.v, controls.omega) == (1.0, 0.0)


# --- ranges -------------------------------------------------------------------------------------------


def test_a_range_is_taken_up_to_r_and_at_r() -> None:
    scenario = load("paper-1")
    beyond = math.nextafter(3.0, 4.0)

    def at(a: Pose, b: Pose) -> Truth:
        return Truth(0, (a, b), (scenario.robots[0].anchor,) * 2)

    assert own_ranges(at(Pose(3.0, 0.0, 0.0), Pose(10.0, -beyond, 0.0)), scenario) == [3.0, None]
    assert mutual_ranges(at(Pose(0.0, 0.0, 0.0), Pose(0.0, 3.0, 0.0)), scenario, [(0, 1)]) == [(3.0,)]
    assert mutual_ranges(at(Pose(0.0, 0.0, 0.0), Pose(0.0, beyond, 0.0)), scenario, [(0, 1)]) == [None]


# --- missions at the limits of parameters -------------------------------------------------------------------


def turns(recording: Run, state: str) -> list[float]:
    """Return the turns of a on the spot before it meets b."""
    commands = [moment.commands["a"] for moment in recording.ticks if moment.commands["a"].phase < 3]
    assert all(command.v == 0.0 for command in commands if command.task == state)
    return [command.omega for command in commands if command.task == state]


def test_a_small_omega_max_makes_every_turn_take_several_ticks() -> None:
    recording = mission_of((2.4, -1.2, 4.8), turn_rate=0.5, planner_name="paper")
    outward = turns(recording, "turning")
    assert outward == pytest.approx([0.5, 0.5, 0.5, math.pi / 2 - 1.5])
    onto_orbit = turns(recording, "tangent")
    assert onto_orbit == pytest.approx([0.5, 0.5, 0.5, math.pi / 2 - 1.5])
    aligning = turns(recording, "aligning")
    assert len(aligning) > 1
    assert aligning[:-1] == pytest.approx([math.copysign(0.5, aligning[0])] * (len(aligning) - 1))
    assert abs(sum(aligning)) <= math.pi
    assert outcome(recording) == "localised"


@pytest.mark.parametrize(
    ("reach", "speed", "straight"), [(1.0, 1.0, 0.9), (1.0, 0.95, 0.9), (1.0, 0.89, 0.89), (3.0, 1.0, 1.0)]
)
def test_the_first_straight_is_shortened_where_it_would_come_near_the_range(
    reach: float, speed: float, straight: float
) -> None:
    recording = mission_of((0.5, 0.2, 2.0), reach=reach, speed=speed)
    first = recording.ticks[0].commands["a"]
    assert first.task == "straight"
    assert (first.v, first.omega) == pytest.approx((straight, 0.0))
    assert recording.scenario.mission.first_straight == pytest.approx(straight)
    assert outcome(recording) == "localised"


def test_a_robot_released_on_its_anchor_knows_its_branch_at_once() -> None:
    recording = mission_of((0.0, 0.0, 2.0))
    assert recording.final_reports["a"].branch == "on-anchor"
    assert recording.ticks[0].commands["a"].phase == 2
    assert outcome(recording) == "localised"


def test_a_single_hypothesis_is_checked_before_it_is_claimed() -> None:
    """Two mutual ranges and D have no redundancy, so b makes a manoeuvre even with one placement left."""
    second = next(step for step in steps("paper-1") if step.commands["b"].task == "last-manoeuvre")
    state, heard = second.observed["b"], second.heard["b"]
    possible = planner_of(state).decide(state, heard).posterior.placements
    assert len(possible) == 4
    for placement in possible:
        posterior = replace(state.posterior, placements=(placement,), hypothesis_counts=(4, 1))
        decided = planner_of(state).decide(replace(state, posterior=posterior), heard)
        assert decided.verdict is None
        assert planner_of(decided).command(decided).v == 1.0


# --- eq. (8) ------------------------------------------------------------------------------------------


@st.composite
def last_points(draw: st.DrawFn) -> tuple[Pose, Pose, list[Placement]]:
    """Draw the pose of b in <b(M2)>, that of a in <a(M1)>, and placements with a within range of b."""
    b = Pose(6.5 * math.cos(1.0), 6.5 * math.sin(1.0), draw(angles))
    a = Pose(6.5, 0.0, 0.0)
    found = []
    for _ in range(draw(st.integers(2, 4))):
        phi, bearing, rho = draw(angles), draw(angles), draw(st.floats(0.2, 2.9))
        there = compose(Pose(0.0, 0.0, phi), a)
        found.append(
            Placement(phi, b.x + rho * math.cos(bearing) - there.x, b.y + rho * math.sin(bearing) - there.y)
        )
    return b, a, found


def predicted(b: Pose, a: Pose, found: list[Placement], v: float, omega: float) -> list[float]:
    """Return the distances d_i of eq. (8), in m."""
    end = step(b, v, omega, SECTION_IV.period)
    places = [compose(Pose(p.x, p.y, p.phi), a) for p in found]
    return [math.hypot(place.x - end.x, place.y - end.y) for place in places]


def least(distances: list[float]) -> float:
    """Return J of eq. (8), on squared distances, in m^2."""
    return min(abs(one**2 - other**2) for one, other in combinations(distances, 2))


def grid() -> list[float]:
    return [SECTION_IV.max_turn_rate * (2 * i / (TURN_RATES - 1) - 1) for i in range(TURN_RATES)]


@settings(max_examples=25)
@given(last_points())
def test_the_last_manoeuvre_of_the_paper_planner_maximises_eq_8_at_full_speed(
    case: tuple[Pose, Pose, list[Placement]],
) -> None:
    b, a, found = case
    plan = last_manoeuvre(Question("b", a, b, tuple(found)), SECTION_IV, Paper.MANOEUVRES)
    assert plan is not None
    best = max(least(predicted(b, a, found, 1.0, omega)) for omega in grid())
    assert plan.command.v == 1.0
    assert plan.separation_m2 == pytest.approx(best, abs=1e-9)
    attained = least(predicted(b, a, found, plan.command.v, plan.command.omega))
    assert attained == pytest.approx(best, abs=1e-9)


@settings(max_examples=8)
@given(last_points())
def test_the_assured_last_manoeuvre_keeps_as_many_hypotheses_in_range_as_it_can(
    case: tuple[Pose, Pose, list[Placement]],
) -> None:
    """The optimum of eq. (8) among manoeuvres with as many hypotheses in range is chosen."""
    b, a, found = case
    rim = SECTION_IV.sensing_range - 1e-6
    plan = last_manoeuvre(Question("b", a, b, tuple(found)), SECTION_IV, Assured.MANOEUVRES)
    assert plan is not None

    def value(v: float, omega: float) -> tuple[int, float]:
        distances = predicted(b, a, found, v, omega)
        return -sum(distance > rim for distance in distances), least(distances)

    fewest, best = max(value(speed, omega) for speed in LAST_SPEEDS for omega in grid())
    outside, attained = value(plan.command.v, plan.command.omega)
    assert outside == fewest
    assert attained == pytest.approx(best, abs=1e-9)
    assert plan.separation_m2 == pytest.approx(best, abs=1e-9)


def test_a_single_hypothesis_is_checked_from_where_its_range_changes_most() -> None:
    b, a = Pose(0.0, 0.0, 0.0), Pose(6.5, 0.0, 0.0)
    ahead = Placement(0.0, -4.5, 0.0)
    plan = last_manoeuvre(Question("b", a, b, (ahead,)), SECTION_IV, Assured.MANOEUVRES)
    assert plan is not None
    assert plan.command.v == 1.0
    assert plan.command.omega == pytest.approx(0.0, abs=1e-9)
    assert predicted(b, a, [ahead], 1.0, 0.0) == [pytest.approx(1.0)]


# --- anywhere in the plane ----------------------------------------------------------------------------


def test_where_in_the_plane_the_anchors_stand_costs_no_digit() -> None:
    """Far from the origin, coordinates have fewer digits, but measurements and commands are identical."""

    def driven(shift: float) -> list[tuple[float, float, str]]:
        text = f"""
            name = "far-out"
            [mission]
            sensing_range = 3.0
            period = 1.0
            max_speed = 1.0
            max_turn_rate = 3.0
            [[robot]]
            id = "a"
            anchor = [{shift}, {-shift}]
            start = [{shift + 1.5}, {0.75 - shift}, 2.0]
            [[robot]]
            id = "b"
            anchor = [{shift + 10.0}, {-shift}]
            start = [{shift + 9.25}, {1.5 - shift}, 4.0]
            """
        moments = run_mission(parse(text, "far-out")).ticks
        return [(d.v, d.omega, d.task) for moment in moments for d in moment.commands.values()]

    assert driven(2.0**19) == driven(0.0)


@pytest.mark.parametrize("at_rest", [5, 12])
def test_robots_that_stand_still_at_first_are_localised_as_much_later(at_rest: int) -> None:
    """Ranges of a robot that has not moved say nothing new, and must not count as if they did."""
    usual, late = (sum(1 for _ in steps("paper-2", at_rest=ticks)) for ticks in (0, at_rest))
    assert late == usual + at_rest
