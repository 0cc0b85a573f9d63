"""Results of the mission parameters: the plan, turn rates, bounds, and the time until orbits meet."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from numpy.typing import NDArray

from agent.estimation.closed_forms import Placement
from agent.planning.assured import Assured
from agent.planning.paper import Paper
from agent.planning.phase1_anchor import third_point
from agent.planning.phase3_last_manoeuvre import LAST_SPEEDS, TURN_RATES, Question, last_manoeuvre
from compose.launch.in_process import run_mission
from compose.recording.run import Run
from compose.scenario.scenario_file import load, parse
from protocol.mission import OPTIMAL_TURN, RANGE_MARGIN, Mission, PlannerName, third_point_turn_rate
from protocol.motion import TAU, Pose, compose, step
from protocol.orbits import WAITING_PLACE, Orbit, half_passage, rendezvous, tick_budget
from tests.missions import mission_of, outcome, own_ranges
from tests.series import series
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
    beyond = 3.0 * (1.0 + 1e-9)  # nearer ones may be at R, but for rounding

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


Setting = tuple[float, float, float, float, float]
"""A setting: D, R, T_s, v_max, omega_max."""

AT_SECTION_IV: Setting = (10.0, 3.0, 1.0, 1.0, math.pi)
SETTINGS: tuple[Setting, ...] = (
    AT_SECTION_IV,
    *((distance, 3.0, 1.0, 1.0, math.pi) for distance in (7.0, 8.0, 15.0, 30.0)),
    *((10.0, reach, 1.0, 1.0, math.pi) for reach in (1.5, 5.0)),
    *((10.0, 3.0, 1.0, speed, math.pi) for speed in (0.3, 0.5, 2.0, 5.0)),
    (10.0, 3.0, 1.0, 1.0, 0.5),
    *((10.0, 3.0, period, 1.0, math.pi) for period in (0.1, 0.5)),
    *((10.0, 1.0, period, 1.0, turn_rate) for period in (0.05, 1.0) for turn_rate in (0.2, math.pi)),
)
ALWAYS_IN_RANGE: tuple[Setting, ...] = tuple(
    (10.0, 15.0, period, 1.0, turn_rate) for period in (0.05, 1.0) for turn_rate in (0.2, math.pi)
)

FINE = (8192, 128)
"""The number of sampled phases of a and b. Those of a are finer because a moves.

The phases of b include the nearest to M1 and the farthest from it.
"""
COARSE = (120, 120)
ROUNDING = 1e-9
"""The tolerance in s, m and rad, above the rounding error of sums of this size."""

Array = NDArray[np.float64]


def drawn(least: float, most: float) -> st.SearchStrategy[Setting]:
    """Return a strategy for settings with R / D from `least` to `most`."""
    ranges = st.floats(least, most), st.floats(0.05, 1.0), st.floats(0.3, 5.0), st.floats(0.2, math.pi)
    return st.tuples(st.floats(1.0, 40.0), *ranges).map(lambda of: (of[0], of[0] * of[1], *of[2:]))


def mission_at(setting: Setting) -> Mission:
    return Mission(*setting[1:])


def pairs(phases: tuple[int, int]) -> tuple[Array, Array]:
    """Return all pairs of starting phases of a and b."""
    alpha, beta = np.meshgrid(*(np.arange(n) * (TAU / n) for n in phases))
    return alpha.ravel(), beta.ravel()


def apart(distance: float, a: Orbit, alpha: Array, b: Orbit, beta: Array) -> Array:
    """Return the distance in m of robots at the phases alpha and beta; M1 is at (0, 0) and M2 at (D, 0)."""
    x = distance + b.radius * np.cos(beta) - a.radius * np.cos(alpha)
    y = b.radius * np.sin(beta) - a.radius * np.sin(alpha)
    return np.hypot(x, y)


def meeting(setting: Setting, a: Orbit, b: Orbit, phases: tuple[int, int]) -> Array:
    """Return the ticks until the robots are first in range, for every pair of starting phases.

    Distances are sampled once per tick, as by the robots. Ticks in which the robots cannot have closed the
    gap are skipped. Fails if a pair of phases never leads to a meeting.
    """
    distance, reach, period, _, _ = setting
    alpha, beta = pairs(phases)
    most = 2.0 * rendezvous(mission_at(setting), distance, "paper").bound / period
    ticks, left = np.zeros_like(alpha), np.arange(alpha.size)
    while left.size:
        time = ticks[left] * period
        gap = apart(distance, a, alpha[left] + a.omega * time, b, beta[left] + b.omega * time) - reach
        left, gap = left[gap > 0.0], gap[gap > 0.0]
        ticks[left] += np.maximum(1.0, np.floor(gap / ((a.v + b.v) * period)))
        assert np.all(ticks[left] <= most)
    return ticks


# --- time to meet -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "setting", series(SETTINGS[::3] + SETTINGS[1::3] + SETTINGS[2::3], len(SETTINGS[::9]))
)
@pytest.mark.long
def test_they_meet_within_the_bound_from_all_phases_and_no_sooner_from_some(setting: Setting) -> None:
    distance, _, period, _, _ = setting
    plan = rendezvous(mission_at(setting), distance, "assured")
    longest = np.max(meeting(setting, plan.a, plan.b, FINE)) * period
    assert longest <= plan.bound + ROUNDING
    assert longest >= plan.bound - period - ROUNDING


@given(drawn(0.1, 1.5))
@pytest.mark.long
def test_the_bound_holds_in_every_setting(setting: Setting) -> None:
    plan = rendezvous(mission_at(setting), setting[0], "assured")
    assume(plan.bound > 0.0)
    assert np.max(meeting(setting, plan.a, plan.b, (240, 24))) * setting[2] <= plan.bound + ROUNDING


def paper_orbits(setting: Setting) -> tuple[Orbit, Orbit]:
    """Return the orbits of eq. (6), smaller than (D + R) / 2 by the margin that sampled orbits need."""
    distance, reach, period, speed, turn_rate = setting
    share = math.acos(distance / (distance + reach)) / math.pi
    radius = 0.5 * (distance + reach) - (speed * period * (1.0 - share)) ** 2 / (16.0 * reach)
    omega = min(turn_rate, speed / radius)
    return Orbit(radius, radius * omega, omega), Orbit(radius, radius * share * omega, -share * omega)


def compared(setting: Setting) -> tuple[float, float]:
    """Return the ratio of the time to meet to that on the paper's orbits: mean and maximum."""
    plan = rendezvous(mission_at(setting), setting[0], "assured")
    ours = meeting(setting, plan.a, plan.b, COARSE)
    theirs = meeting(setting, *paper_orbits(setting), COARSE)
    return float(np.mean(ours) / np.mean(theirs)), float(np.max(ours) / np.max(theirs))


def test_at_section_ivs_parameters_they_meet_in_well_under_the_time_that_the_papers_orbits_take() -> None:
    mean, worst = compared(AT_SECTION_IV)
    assert mean <= 0.6
    assert worst <= 0.6


@pytest.mark.parametrize("setting", SETTINGS)
def test_they_meet_sooner_than_on_the_papers_orbits(setting: Setting) -> None:
    mean, _ = compared(setting)
    assert mean <= 0.75


# --- orbits always in range ---------------------------------------------------------------------------


@given(drawn(1.1, 1.5))
@example(ALWAYS_IN_RANGE[0])
@example(ALWAYS_IN_RANGE[1])
@example(ALWAYS_IN_RANGE[2])
@example(ALWAYS_IN_RANGE[3])
def test_where_they_are_in_range_wherever_they_wait_both_wait(setting: Setting) -> None:
    distance, reach, *_ = setting
    assume(distance + WAITING_PLACE * reach < reach - 2.0 * RANGE_MARGIN)
    plan = rendezvous(mission_at(setting), distance, "assured")
    assert plan.bound == plan.a.v == plan.a.omega == plan.b.v == plan.b.omega == 0.0
    assert plan.a.radius > 0.0
    assert np.max(apart(distance, plan.a, pairs(COARSE)[0], plan.b, pairs(COARSE)[1])) <= reach


# --- limits of orbits ---------------------------------------------------------------------------------


@given(drawn(0.1, 1.5))
def test_b_waits_near_its_anchor_and_a_orbits_within_what_it_can_drive(setting: Setting) -> None:
    distance, reach, _, speed, turn_rate = setting
    plan = rendezvous(mission_at(setting), distance, "assured")
    assert plan.b == Orbit(reach / 8.0, 0.0, 0.0)
    assert 0.0 <= plan.a.v <= speed * (1.0 + 1e-12)
    assert 0.0 <= plan.a.omega <= turn_rate
    assert plan.a.v == pytest.approx(plan.a.omega * plan.a.radius)


lengths = st.floats(0.1, 40.0)


@given(lengths, lengths, lengths)
def test_half_a_passage_ends_where_the_range_does(distance: float, radius: float, reach: float) -> None:
    half = half_passage(distance, radius, reach)
    if reach <= abs(distance - radius):
        assert half == pytest.approx(0.0, abs=1e-6)
    elif reach >= distance + radius:
        assert half == pytest.approx(math.pi, abs=1e-6)
    else:
        end = math.hypot(distance - radius * math.cos(half), radius * math.sin(half))
        assert end == pytest.approx(reach, abs=ROUNDING)


@given(lengths, st.floats(0.01, 0.99), lengths, lengths)
def test_a_passage_is_shortest_where_b_waits_nearest_to_as_anchor_or_farthest(
    distance: float, share: float, radius: float, reach: float
) -> None:
    waiting = share * distance
    places = np.linspace(distance - waiting, distance + waiting, 101)
    halves = [half_passage(float(place), radius, reach) for place in places]
    assert min(halves) >= min(halves[0], halves[-1]) - ROUNDING
