"""Robots of pairs and groups keep the safety distance under every remaining hypothesis."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from agent.planning import separation
from agent.planning.state import Bypass
from agent.planning.travelling import BLOCKED_AFTER, MOST_YIELDED, RESERVE, aside, leeway, limited, passed
from compose.audit.claim_rules import distance
from compose.audit.rules import audit_run
from compose.launch.in_process import run_mission
from compose.recording.closest_approach import nearest
from compose.recording.run import of_frames
from compose.scenario.scenario_file import load, validate
from protocol.mission import Mission
from protocol.motion import Controls, Pose, step
from tests.commands import tandem
from tests.groups import localised, table_of
from tests.missions import kept, outcome
from tests.series import series
from world.scenario import Scenario

SAFE = 1.0
SECTION_IV = {"sensing_range": 3.0, "period": 1.0, "max_speed": 1.0, "max_turn_rate": math.pi}
NEAR = 75
"""The seed of a random mission in which b's last manoeuvre ends 0.75 m from a without a safety distance."""


def safe(seed: int, distance: float = SAFE, **noise: float) -> Scenario:
    scenario = load("random", seed=seed)
    mission = scenario.mission
    return replace(
        scenario,
        mission=replace(mission, safety_distance=distance, noise=replace(mission.noise, **noise)),
    )


speeds = st.floats(-1.0, 1.0)
turns = st.floats(-math.pi, math.pi)
places = st.floats(-2.0, 2.0)


@given(speeds, turns, turns, places, places)
def test_the_bound_on_the_distance_of_an_arc_is_safe_and_tight(
    v: float, omega: float, heading: float, x: float, y: float
) -> None:
    pose = Pose(0.3, -0.2, heading)
    told = float(separation.nearest(pose, np.array([v]), np.array([omega]), (x, y), 1.0)[0])
    way = [step(pose, v, omega, i / 2000) for i in range(2001)]
    true = min(math.hypot(at.x - x, at.y - y) for at in way)
    assert told <= true + 1e-12
    assert told >= true - 0.005


@given(speeds, turns, st.floats(0.0, 2.0))
def test_a_robot_goes_the_same_arc_only_not_so_far(v: float, omega: float, metres: float) -> None:
    mission = load("random").mission
    slowed = separation.slowed(Controls(v, omega), metres, mission)
    assert abs(slowed.v) * mission.period <= max(metres, 0.0) + 1e-12
    assert slowed.v * omega == pytest.approx(slowed.omega * v, abs=1e-12)
    if abs(v) * mission.period <= metres:
        assert slowed == Controls(v, omega)


def test_robots_that_may_come_near_do() -> None:
    recording = run_mission(load("random", seed=NEAR))
    found = nearest(recording)
    assert found is not None
    assert found < 0.8


@pytest.mark.parametrize("seed", series([NEAR, *range(1, 40)], 10))
def test_none_comes_nearer_and_both_localise(seed: int) -> None:
    recording = run_mission(safe(seed))
    assert outcome(recording) == "localised"
    found = nearest(recording)
    assert found is not None
    assert found >= SAFE


@pytest.mark.parametrize("seed", series(range(1, 9), 2))
def test_none_comes_nearer_under_noise(seed: int) -> None:
    recording = run_mission(safe(seed, anchor_sigma=0.05, mutual_sigma=0.05))
    assert outcome(recording) == "localised"
    found = nearest(recording)
    assert found is not None
    assert found >= SAFE


def test_what_ranges_cannot_tell_is_no_violation() -> None:
    mission = load("noisy", seed=196).mission
    recording = run_mission(replace(load("noisy", seed=196), mission=replace(mission, safety_distance=0.3)))
    found = nearest(recording)
    assert found is not None
    assert 0.3 - 3.0 * mission.noise.mutual_sigma < found < 0.3
    assert not any(distance(recording))


@settings(max_examples=20)
@given(st.integers(1, 10**6), st.floats(0.0, 0.9), st.integers(0, 8))
def test_none_comes_nearer_however_many_reports_are_lost_or_late(seed: int, loss: float, least: int) -> None:
    faults = [f"a<->b: loss={loss:.3f}", f"b->a: delay={least}..{least + 3}"]
    scenario = load("random", seed=seed, faults=faults)
    recording = run_mission(replace(scenario, mission=replace(scenario.mission, safety_distance=SAFE)))
    assert outcome(recording) == "localised"
    found = nearest(recording)
    assert found is not None
    assert found >= SAFE


@pytest.mark.parametrize("seed", range(1, 30))
def test_robots_that_begin_in_range_of_each_other_come_no_nearer_than_that(seed: int) -> None:
    table = {
        "name": "near",
        "mission": SECTION_IV | {"safety_distance": SAFE},
        "robot": [{"id": "a", "anchor": [0.0, 0.0]}, {"id": "b", "anchor": [3.0, 0.0]}],
        "max_ticks": 60,
    }
    recording = run_mission(validate(table, "near.toml").seeded(seed))
    assert outcome(recording) in ("localised", "undecided")
    a, b = recording.ticks[0].truth.poses
    found = nearest(recording)
    assert found is not None
    assert found >= min(SAFE, math.hypot(a.x - b.x, a.y - b.y)) - 1e-9


def test_the_paper_planner_keeps_the_safety_distance_or_gives_up() -> None:
    outcomes = set()
    for seed in range(1, 40):
        recording = run_mission(replace(safe(seed), planner_name="paper"))
        assert recording.end is not None
        outcomes.add(recording.end.outcome)
        found = nearest(recording)
        assert found is None or found >= SAFE
    assert outcomes <= {"localised", "undecided"}
    assert "localised" in outcomes


def test_b_of_the_paper_planner_does_not_move_before_it_knows_that_a_stands() -> None:
    """A mission in which reports overtook each other: both drove in one tick, and came 0.26 m near."""
    starts = (
        ("a", 0.0, [1.6822396427967417, 0.0, 1.5135455426314672]),
        ("b", 10.0, [7.5343756820837, 0.0003903185466716973, 4.829704187461034]),
    )
    table = {
        "name": "late",
        "planner": {"name": "paper"},
        "mission": SECTION_IV | {"safety_distance": 0.3},
        "fault": [{"reorder": 0.5}],
        "robot": [{"id": name, "anchor": [x, 0.0], "start": start} for name, x, start in starts],
        "max_ticks": 60,
    }
    least = nearest(run_mission(validate(table, "late.toml").seeded(1)))
    assert least is not None
    assert least >= 0.3 - 1e-9


def test_a_begins_phase_3_beside_b_that_has_its_result() -> None:
    """By late reports, a never knew that b stood, and waited to the end."""
    a = [8.830949933827478, 1.7361806548376397, -1.3766703917682876]
    table = {
        "name": "late",
        "mission": SECTION_IV | {"sensing_range": 9.0, "safety_distance": 0.8},
        "fault": [{"delay": [1, 6]}],
        "robot": [{"id": "a", "anchor": [0.0, 0.0], "start": a}, {"id": "b", "anchor": [10.0, 0.0]}],
    }
    run = run_mission(validate(table, "late.toml").seeded(1377329033))
    assert outcome(run) == "localised"
    assert run.length < 60


def test_a_safety_distance_above_that_at_first_contact_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "safe.toml"
    text = (Path("compose/scenario/shipped") / "random.toml").read_text()
    file.write_text(text.replace("[mission]", "[mission]\nsafety_distance = 1.01"))
    ended = tandem("run", file)
    assert ended.status == 2
    assert ended.err == (
        f"tandem run: {file}: mission.safety_distance: 1.01 m, but robots that approach each other at "
        "max_speed may be 1 m apart at their first contact (sensing_range - 2 max_speed period)\n"
    )


MISSION = Mission(3.0, 1.0, 1.0, math.pi, safety_distance=0.5)


def group_apart(robots: int, seed: int, distance: float, sigma: float = 0.0) -> Scenario:
    """Return a group with a safety distance."""
    table = table_of(robots, seed, sigma=sigma)
    table["mission"]["safety_distance"] = distance
    return validate(table, "group.toml").scenario


# --- one tick -----------------------------------------------------------------------------------------


@given(st.floats(0.5, 3.0), st.floats(-math.pi, math.pi), st.floats(-math.pi, math.pi))
def test_two_robots_that_drive_their_leeway_keep_the_distance(
    rho: float, bearing: float, other: float
) -> None:
    free = leeway({"b": rho}, MISSION)
    x = rho + free * (math.cos(other) - math.cos(bearing))
    y = free * (math.sin(other) - math.sin(bearing))
    assert math.hypot(x, y) >= MISSION.safety_distance - 1e-12


def test_robots_out_of_range_limit_nothing() -> None:
    assert leeway({}, MISSION) == math.inf
    assert leeway({"c": 2.5}, MISSION) == pytest.approx(1.0)
    assert leeway({"b": 0.6, "c": 2.5}, MISSION) == pytest.approx(0.05)


def test_a_robot_stands_still_where_a_range_is_missing() -> None:
    assert leeway({"c": None, "d": 2.5}, MISSION) == 0.0


def test_the_way_aside_leads_back_to_one_side_and_past() -> None:
    back, beside, past = aside(Pose(0.0, 0.0, 0.0), MISSION, 1.0)
    assert back[0] == beside[0] < -MISSION.safety_distance
    assert back[1] == 0.0
    assert beside[1] == past[1] > 2.0 * MISSION.safety_distance
    assert past[0] > 2.0 * MISSION.safety_distance
    assert aside(Pose(0.0, 0.0, 0.0), MISSION, -1.0)[1][1] == -beside[1]


LITTLE = 2.0**-7
"""A way (m) so short that a robot is blocked."""


def ticked(passing: Bypass, free: float, v: float = 1.0, *, waits: bool = False) -> Bypass:
    rho = MISSION.safety_distance + 2.0 * free
    before = ["b"] if waits else []
    return passed(passing, {"b": rho}, before, Pose(0.0, 0.0, 0.0), Controls(v, 0.0), MISSION)


def test_a_robot_is_blocked_while_little_way_is_left_that_does_not_grow() -> None:
    passing = Bypass()
    for ticks in range(BLOCKED_AFTER - 1):
        assert passing.blocked == ticks
        passing = ticked(passing, LITTLE)
    assert ticked(passing, 2.0 * LITTLE).blocked == BLOCKED_AFTER - 1
    assert ticked(passing, 0.5).blocked == 0
    assert ticked(passing, LITTLE).places[0][0] < 0.0
    assert ticked(passing, LITTLE, -1.0).places[0][0] > 0.0
    assert ticked(passing, LITTLE, 0.0).places == ()


def test_one_that_waits_for_another_one_drives_aside_after_it() -> None:
    passing = Bypass(leeway=LITTLE, blocked=BLOCKED_AFTER - 1)
    for _ in range(MOST_YIELDED):
        passing = ticked(passing, LITTLE, waits=True)
        assert (passing.leeway, passing.places) == (0.0, ())
    assert ticked(passing, LITTLE, waits=True).places


def test_robots_keep_a_reserve_but_on_a_aside() -> None:
    ahead, least = Controls(1.0, 0.0), RESERVE * MISSION.first_straight
    assert limited(ahead, Bypass(leeway=least), MISSION).v == 0.0
    assert limited(ahead, Bypass(leeway=least, places=((1.0, 0.0),)), MISSION).v == least
    assert limited(ahead, Bypass(), MISSION) == ahead


# --- missions -----------------------------------------------------------------------------------------

CASES = [(4, 20, 1.0), (8, 28, 0.5), (4, 10, 1.0), (8, 34, 0.5), (8, 39, 0.5), (4, 43, 1.0), (16, 1, 0.5)]
"""Groups in which robots blocked each other before visited robots let their visitors leave, before blocked
ones drove aside, or before one of two yielded."""


@pytest.mark.parametrize("case", series(CASES, 2))
def test_all_robots_keep_the_distance_and_are_localised_within_the_bound(
    case: tuple[int, int, float],
) -> None:
    scenario = group_apart(*case)
    run = run_mission(scenario)
    assert localised(run) == set(run.robots)
    least = nearest(run)
    assert least is not None
    assert least >= case[2] - 1e-9
    assert run.end is not None
    assert run.end.tick * scenario.mission.period <= scenario.meetings[-1].ends


DENSE = {"max_turn_rate": math.pi, "safety_distance": 0.5}
NOISE = {"accuracy": 0.3, "noise": {"anchor_sigma": 0.05, "mutual_sigma": 0.05}}
BLOCKED = {
    "on an orbit, by one that waits": (76739130, 4, 30.0, {"sensing_range": 2.1, "period": 0.77}),
    "in phase 1, by one that drives towards it": (82, 6, 15.0, {}),
    "on a circle in phase 1": (9, 4, 10.0, {"max_turn_rate": math.pi}),
    "on a circle in phase 3, by one that is visited": (8, 3, 10.0, DENSE),
    "on a circle in phase 3, by one that blocks a third one": (28, 4, 10.0, DENSE),
    "beside a circle, at the start": (25, 4, 10.0, DENSE),
}
"""Groups in which robots stopped for each other for ever: seed, robots, spacing and mission."""


@pytest.mark.parametrize("name", BLOCKED)
def test_robots_that_block_each_other_make_way(name: str) -> None:
    seed, robots, spacing, mission = BLOCKED[name]
    table = {
        "name": "blocked",
        "seed": seed,
        "mission": {
            "sensing_range": 3.0,
            "period": 1.0,
            "max_speed": 1.0,
            "max_turn_rate": 3.455751918948773,
            "safety_distance": 0.3,
            **mission,
        },
        "group": {"robots": robots, "spacing": spacing},
    }
    run = of_frames(kept(validate(table, "blocked.toml").scenario))
    assert localised(run) == set(run.robots)
    assert audit_run(run).violations == ()
    least = nearest(run)
    assert least is not None
    assert least >= run.scenario.mission.safety_distance - 1e-9


NEAR_STARTS = {
    "held back on the way to a third point": (0.3, 3.528, (1.64, -1.39, 0.15), (2.31, 1.06, -0.92), {}),
    "on a circle, by one that stands": (0.5, 2.408, (0.58, 0.05, -2.66), (-0.39, -0.39, -2.80), {}),
    "by one that stands, under noise": (0.3, 1.595, (0.60, -0.01, 0.74), (-0.64, 1.87, 1.85), NOISE),
}
"""Pairs that ended undecided: the safety distance, the x of b's anchor, the starts, and noise."""


@pytest.mark.parametrize("name", NEAR_STARTS)
def test_two_robots_that_begin_near_each_other_are_localised(name: str) -> None:
    safety, x, a, b, noise = NEAR_STARTS[name]
    table = {
        "name": "near",
        "mission": SECTION_IV | {"safety_distance": safety, **noise},
        "robot": [
            {"id": "a", "anchor": [0.0, 0.0], "start": a},
            {"id": "b", "anchor": [x, 0.0], "start": b},
        ],
    }
    run = run_mission(validate(table, "near.toml").seeded(33))
    assert localised(run) == {"a", "b"}
    least = nearest(run)
    assert least is not None
    assert least >= safety - 1e-9


@pytest.mark.parametrize("seed", [2, 12])
def test_robots_that_noise_has_led_too_near_to_each_other_part(seed: int) -> None:
    """Two robots of a team stood within three sigmas of the safety distance until the end."""
    table = {
        "name": "near",
        "mission": {
            "sensing_range": 5.0,
            "period": 1.0,
            "max_speed": 0.5,
            "safety_distance": 0.8,
            "max_turn_rate": 1.0,
            "accuracy": 0.2,
            "frame": "relative",
            "area": [0.0, 0.0, 6.0, 6.0],
            "noise": NOISE["noise"],
        },
        "team": {"robots": 2, "side": 6.0},
    }
    run = of_frames(kept(validate(table, "near.toml").seeded(seed)))
    assert localised(run) == set(run.robots)
    assert audit_run(run).violations == ()


def test_no_robot_has_to_keep_the_distance_to_a_dead_one_which_it_cannot_range() -> None:
    """Two robots begin 0.45 m apart; after the death of r2, r1 passes it at 0.01 m."""
    table = table_of(5, 0)
    table["mission"] |= {"period": 0.77, "safety_distance": 0.75}
    table |= {"seed": 1518866833, "group": {"robots": 5, "spacing": 6.0, "dies": 54}}
    del table["robot"]
    run = of_frames(kept(validate(table, "dead.toml").seeded(None)))
    least = nearest(run)
    assert least is not None
    assert least >= 0.45
    assert audit_run(run).violations == ()


def test_a_robot_that_was_held_back_takes_no_range_from_its_start_for_a_second_one() -> None:
    """Two robots begin 0.295 m apart, until r2 dies; a hunt has found this mission.

    The range after a turn on the spot told r1 that it faces its anchor. So r3 found r1 inconsistent.
    """
    table = table_of(3, 0)
    table["mission"] |= {"max_turn_rate": math.pi, "safety_distance": 0.3}
    table |= {"seed": 1061111899, "group": {"robots": 3, "spacing": 9.0, "dies": 5}}
    del table["robot"]
    run = of_frames(kept(validate(table, "held.toml").seeded(None)))
    assert localised(run) == {"r1", "r3"}
    assert audit_run(run).violations == ()


def test_no_robot_has_to_keep_a_distance_that_an_outlier_hides() -> None:
    """Two robots begin 0.178 m apart, and their first range is too long; a hunt has found this mission."""
    table = table_of(4, 0)
    table["mission"] |= {"max_turn_rate": math.pi, "safety_distance": 0.3, "noise": {"outliers": 0.2}}
    table |= {"seed": 1810307481, "group": {"robots": 4, "spacing": 30.0}}
    del table["robot"]
    run = of_frames(kept(validate(table, "outliers.toml").seeded(None)))
    assert nearest(run) == pytest.approx(0.173, abs=1e-3)
    assert audit_run(run).violations == ()


@pytest.mark.long
def test_the_audit_of_a_group_with_a_safety_distance_is_clean() -> None:
    found = audit_run(of_frames(kept(group_apart(4, 10, 1.0))))
    assert found.violations == ()


@pytest.mark.long
def test_robots_with_noisy_ranges_keep_the_distance() -> None:
    run = run_mission(group_apart(4, 3, 0.5, sigma=0.05))
    assert localised(run) == set(run.robots)
    least = nearest(run)
    assert least is not None
    assert least >= 0.5
