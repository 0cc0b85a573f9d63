"""Under noise a may miss b on its orbit, or leave it undecided.

It then begins again at its anchor, and forgets what it measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from agent.estimation.gaussian.mission_measurements import beginning, path_of
from agent.estimation.gaussian.odometry_noise import variances
from agent.estimation.knowledge import Knowledge, MeetingPosterior
from agent.peer.motion_log import MotionLog
from agent.peer.peer_state import PeerState
from agent.planning.assured import Assured
from agent.planning.state import RobotState
from compose.launch.in_process import played, run_mission
from compose.recording.run import read
from compose.view.recorded import scenes_of
from protocol.messages import Member, Ranged, Report, RobotConfig
from protocol.mission import Mission
from protocol.noise import Noise
from protocol.orbits import pair_ticks, rendezvous, tick_budget
from protocol.team_motion import next_on_spiral
from tests.commands import tandem
from tests.series import series
from tests.surveys import assert_localised, scenario_of, states
from world.scenario import Scenario

DRIFT = "anchor_sigma = 0.05\nmutual_sigma = 0.05\nodometry = {omega_floor = 0.02}"
"""Noise with which one of twenty robots a misses b: the heading drifts by 0.15 rad on an orbit."""
MISSED = (
    4555997949307862513,
    1723396742918998267,
    787813770569954228,
    6283387047437257040,
    3408464632754983231,
    6689259541481075102,
)
"""Seeds of DRIFT in which a misses b at first."""
WHEELS = """anchor_sigma = 0.05
mutual_sigma = 0.05
odometry = {v = 0.05, omega = 0.05}
actuation = {v = 0.05, omega = 0.05}"""
"""Noise with which one of sixteen robots a meets b, and cannot claim after 60 mutual ranges."""
UNSETTLED = (
    411770278714326748,
    5187163166335705732,
    1178032213966879813,
)
"""Seeds of WHEELS, three of the first that were drawn, in which a leaves b after a meeting."""
PASSED = 49
"""The number of ticks of T_max in these missions."""


def missed(seed: int) -> Scenario:
    return scenario_of(DRIFT, seed, accuracy=0.3)


@pytest.mark.parametrize("seed", series(MISSED, 2))
def test_a_robot_that_has_missed_its_peer_begins_again_and_both_localise(seed: int) -> None:
    recording = run_mission(missed(seed))
    of_a = states(recording, "a")
    back = of_a.index("homing")
    assert of_a[back - 1] == "orbiting"
    assert "straight" in of_a[back:], "phase 1 begins as at the start"
    assert "orbiting" in of_a[back:]
    assert "homing" not in states(recording, "b")
    assert_localised(recording)


def test_a_recording_with_a_missed_encounter_is_audited_replayed_and_told(tmp_path: Path) -> None:
    run_mission(missed(MISSED[0]), tmp_path)
    assert tandem("audit", str(tmp_path)).status == 0
    assert tandem("replay", str(tmp_path)).status == 0
    told = [caption.text for scene in scenes_of(read(tmp_path)) for caption in scene.captions]
    assert "a has not met b on its circle. It drives back to its anchor to measure its pose again." in told


def unsettled(seed: int) -> Scenario:
    return scenario_of(WHEELS, seed, accuracy=0.3)


@pytest.mark.parametrize("seed", series(UNSETTLED))
def test_a_robot_that_leaves_its_peer_undecided_begins_again_and_both_localise(seed: int) -> None:
    recording = run_mission(unsettled(seed))
    of_a = states(recording, "a")
    back = of_a.index("homing")
    assert set(of_a[back - 58 : back]) <= {"surveying", "listening", "retreating"}
    assert "straight" in of_a[back:], "phase 1 begins as at the start"
    assert "surveying" in of_a[back:]
    assert "homing" not in states(recording, "b")
    assert_localised(recording)


@pytest.mark.long
def test_a_recording_in_which_a_left_b_is_audited_replayed_and_told(tmp_path: Path) -> None:
    run_mission(unsettled(UNSETTLED[0]), tmp_path)
    assert tandem("audit", str(tmp_path)).status == 0
    assert tandem("replay", str(tmp_path)).status == 0
    told = [caption.text for scene in scenes_of(read(tmp_path)) for caption in scene.captions]
    failed = "a has not found out where it is from its distances to b."
    assert f"{failed} It drives back to its anchor to measure its pose again." in told


@pytest.mark.long
def test_neither_robot_keeps_hypotheses_of_the_meeting_that_a_left() -> None:
    known: dict[str, list[MeetingPosterior]] = {"a": [], "b": []}

    class Watched(Assured):
        def decide(self, state: RobotState, reports: Sequence[Report] = ()) -> RobotState:
            decided = super().decide(state, reports)
            known[state.config.robot].append(decided.posterior)
            return decided

    played(unsettled(UNSETTLED[0]), {}, planner_of=lambda _: Watched())
    for posteriors in known.values():
        again = [
            now for before, now in pairwise(posteriors) if now.attempt.beginning != before.attempt.beginning
        ]
        assert len(again) == 1
        assert (again[0].pair, again[0].attempt.ranges_at_last_search, again[0].attempt.p_value) == (
            (),
            0,
            None,
        )
        assert posteriors[-1].pair, "the second meeting gives new ones"
    assert known["a"][-1].attempt.beginning == known["b"][-1].attempt.beginning > 60


# --- what a measured before it began again -------------------------------------------------------------


def knowledge(config: RobotConfig, ticks: list[int], mutual: tuple[int, ...] = ()) -> Knowledge:
    """Return what a robot of the role in `config` knows if a was ranged by its anchor at `ticks`."""
    log = MotionLog(200, (), tuple([Ranged(tick, 1.0) for tick in ticks]))
    known = Knowledge(config, tick=200, ranges={config.peer: tuple([Ranged(tick, 2.0) for tick in mutual])})
    return replace(known, log=log) if config.role == "a" else replace(known, peer_state=PeerState(peer=log))


BEGINNINGS = {
    "before the orbit": ([0, 1, 5], (), 0),
    "a gap of T_max": ([0, 5, 5 + PASSED], (), 0),
    "a longer gap": ([0, 5, 6 + PASSED, 60], (), 6 + PASSED),
    "two longer gaps": ([0, 5, 60, 64, 130, 133], (), 130),
    "ranges to b before": ([0, 5, 60, 64], (40, 41, 42), 0),
    "hardly any range to b before": ([0, 5, 60, 64], (40, 41, 80), 60),
    "a gap after ranges to b": ([0, 5, 60, 130], (40, 41, 42), 130),
    "59 ranges to b before": ([0, 5, 80, 84], tuple(range(6, 65)), 0),
    "60 ranges to b before": ([0, 5, 80, 84], tuple(range(6, 66)), 80),
    "60 ranges to b before, but some to the anchor between them": ([0, 5, 40, 80], tuple(range(6, 70)), 0),
}


@pytest.mark.parametrize("role", ["a", "b"])
@pytest.mark.parametrize("case", BEGINNINGS)
def test_both_robots_know_from_which_tick_on_the_measurements_of_a_count(role: str, case: str) -> None:
    ticks, mutual, first = BEGINNINGS[case]
    config = missed(1).config(role)
    assert config.rendezvous.bound == PASSED
    assert beginning(knowledge(config, ticks, mutual), 200) == first


def test_in_a_group_all_measurements_count_as_its_plan_has_the_retries() -> None:
    config = missed(1).config("a")
    members = (Member("a", config.anchor, 100), Member("b", config.peer_anchor, 100))
    assert beginning(knowledge(replace(config, members=members), [0, 5, 60]), 200) == 0


def test_until_that_tick_the_robot_counts_as_at_rest_without_noise() -> None:
    log, mission = MotionLog().drove(1.0, 0.1, 6).drove(0.5, -0.2, 4), missed(1).mission
    path, whole = path_of(log.runs, 6, 10, mission), path_of(log.runs, 0, 10, mission)
    assert path.x[:7].tolist() == path.y[:7].tolist() == path.heading[:7].tolist() == [0.0] * 7
    moved = [math.hypot(one.x[10] - one.x[6], one.y[10] - one.y[6]) for one in (path, whole)]
    assert moved[0] == pytest.approx(moved[1])
    assert len(path.v) == len(whole.v)
    assert path.extra is not None
    variance = variances(path.v, path.omega, mission.noise.odometry) + path.extra
    assert variance[1].tolist() == [0.0] * 6 + [0.02**2] * 4


# --- the search for the anchor, and the time -----------------------------------------------------------


@given(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_a_spiral_of_twelve_sides_comes_into_range_of_all_within_twice_the_range(x: float, y: float) -> None:
    mission, place, nearest = Mission(1.0, 1.0, 1.0, math.pi), (0.0, 0.0), math.inf
    for side in range(12):
        end = next_on_spiral(place, side, mission)
        for step in range(101):
            part = step / 100
            at = (place[0] + part * (end[0] - place[0]), place[1] + part * (end[1] - place[1]))
            nearest = min(nearest, math.dist(at, (x, y)))
        place = end
    assert nearest <= mission.sensing_range


def test_noise_gives_the_time_for_a_second_attempt() -> None:
    exact = Mission(3.0, 1.0, 1.0, math.pi)
    noisy = replace(exact, noise=Noise(0.05, 0.05))
    for mission, planner, attempts in (
        (exact, "assured", 1),
        (noisy, "assured", 2),
        (noisy, "paper", 1),
    ):
        plan = rendezvous(mission, 10.0, planner)
        ticks = math.ceil(plan.bound / mission.period) + attempts * pair_ticks(mission, plan)
        assert tick_budget(mission, plan) == ticks
