"""Robots without an anchor: their localisation and coverage, and what a finder tells them under noise."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from agent.estimation.gaussian.contact_fit import contact_measurements, estimated
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.odometry_noise import Track, track
from agent.estimation.resection import RangedPlace, is_certain, is_fixed, poses, positions
from agent.planning import coverage, drive
from agent.planning.contacted import Contacted
from agent.planning.group import GroupPlanner
from agent.planning.state import RobotState
from agent.planning.tasks import Covering, Looping
from agent.planning.unanchored import UnanchoredPlanner
from compose.recording.claim_errors import nees
from compose.scenario.scenario_file import load
from protocol.coverage_strips import SIDE, STRIP_REACH, SweptArea
from protocol.coverage_ticks import way_ticks
from protocol.messages import Contact as Detection
from protocol.messages import Estimate, Localised, Observation, Report, ReportedPose, RobotConfig, Undecided
from protocol.mission import Mission
from protocol.motion import ORIGIN, REST, Controls, Covariance, Pose, Segment, compose, step
from protocol.noise import Noise
from protocol.wire import decode, encode
from tests.groups import R
from tests.test_noisy_unanchored import noisy
from tests.test_unanchored import four

FLOOR = 1e-9
"""The rounding error in m of the places in these tests."""
FAR = SIDE * R
SQUARE = [Pose(FAR, 0.0, 0.0), Pose(FAR, FAR, 0.0), Pose(0.0, FAR, 0.0)]
"""The places of a small square, which a robot drives from the origin."""
ROOM = Mission(R, 1.0, 1.0, math.pi)

Ranges = tuple[list[RangedPlace], list[RangedPlace]]


def measured(found: Pose, finder: Pose, error: float = 0.0) -> Ranges:
    """Return the ranges while the finder drives a square, then while the robot that it has found does.

    The finder reports its places with its path scaled by 1 + `error`.
    """

    def ranged(of_finder: Pose, of_found: Pose) -> RangedPlace:
        there, here = compose(finder, of_finder), compose(found, of_found)
        told = compose(finder, Pose((1.0 + error) * of_finder.x, (1.0 + error) * of_finder.y, 0.0))
        return RangedPlace((told.x, told.y), of_found, math.hypot(here.x - there.x, here.y - there.y))

    return [ranged(one, ORIGIN) for one in (ORIGIN, *SQUARE)], [ranged(ORIGIN, one) for one in SQUARE]


ANGLES = st.floats(-math.pi, math.pi)


@given(ANGLES, ANGLES, ANGLES, st.floats(0.05 * R, STRIP_REACH * R))
@example(-2.1953125, 0.0, 3.0, 1.25)  # the other heading leads to it slowly
def test_two_squares_leave_one_pose_which_is_the_true_one(
    own: float, other: float, bearing: float, apart: float
) -> None:
    true = Pose(40.0 + apart * math.cos(bearing), -7.0 + apart * math.sin(bearing), own)
    standing, moved = measured(true, Pose(40.0, -7.0, other))
    found = poses(standing, moved, FLOOR)
    assert is_certain(standing, moved, found)
    assert math.dist((found[0].x, found[0].y), (true.x, true.y)) < 1e-9
    assert abs(math.remainder(found[0].heading - own, math.tau)) < 1e-9


@given(ANGLES, st.floats(0.1 * R, STRIP_REACH * R))
def test_no_pose_explains_the_ranges_to_a_robot_that_scales_its_path(bearing: float, apart: float) -> None:
    true = Pose(apart * math.cos(bearing), apart * math.sin(bearing), 1.0)
    assert poses(*measured(true, ORIGIN, error=0.1), FLOOR) == ()


def test_a_straight_path_leaves_a_mirror_image() -> None:
    standing = [RangedPlace((x, 0.0), ORIGIN, math.hypot(1.0 - x, 2.0)) for x in (0.0, 0.5, 1.5)]
    assert sorted(y for _, y in positions(standing, FLOOR)) == pytest.approx([-2.0, 2.0])


def test_ranges_from_a_line_through_the_robot_do_not_fix_its_position() -> None:
    """A rounding error of the ranges moves it far aside."""
    standing = [RangedPlace((x, 0.0), ORIGIN, 2.0 - x) for x in (0.0, 0.05, 0.1, 0.15)]
    found = positions(standing, FLOOR)
    assert found
    assert not any(is_fixed(standing, place) for place in found)


def test_ranges_along_one_straight_do_not_determine_a_heading_on_the_line_of_sight() -> None:
    standing, _ = measured(Pose(1.0, 0.0, math.pi), ORIGIN)
    moved = [RangedPlace((0.0, 0.0), Pose(x, 0.0, 0.0), 1.0 - x) for x in (0.05, 0.1, 0.15)]
    found = poses(standing, moved, FLOOR)
    assert len(found) == 1
    assert not is_certain(standing, moved, found)


# --- the coverage ----------------------------------------------------------------------------------------

LENGTHS = st.floats(0.0, 40.0)


def driven(places: tuple[tuple[float, float], ...], start: Pose, mission: Mission = ROOM) -> list[Pose]:
    """Return the poses of each tick of a robot that drives to `places`, one after the other."""
    path, config = [start], replace(load("paper-1").config("a"), mission=mission)
    task: Covering | Looping = Covering(places)
    while True:
        state = RobotState(config, odometry=path[-1])
        task = coverage.onward(state, task)
        if not task.places:
            return path
        driven = drive.controls(state.doing(task))
        path.append(step(path[-1], driven.v, driven.omega, mission.period))


@given(LENGTHS, LENGTHS, st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.sampled_from([0.4, 1.0, 20.0]))
def test_a_sweep_comes_near_each_place_of_the_area_in_a_tick(
    wide: float, high: float, x: float, y: float, speed: float
) -> None:
    area = SweptArea(5.0, -3.0, 5.0 + wide, -3.0 + high, 1)
    path = driven(area.path(area.strips_of(0, R), R), Pose(0.0, 0.0, 1.0), Mission(R, 1.0, speed, 0.7))
    place = (5.0 + x * wide, -3.0 + y * high)
    # the robot may be on a square of its own, because another one has passed
    assert min(math.dist((pose.x, pose.y), place) for pose in path) <= STRIP_REACH * R - math.sqrt(2.0) * FAR


@given(LENGTHS, LENGTHS, st.floats(0.1, 7.0), st.floats(0.1, 7.0))
def test_a_sweep_takes_no_more_ticks_than_its_bound(
    wide: float, high: float, speed: float, turn_rate: float
) -> None:
    mission = Mission(R, 1.0, speed, turn_rate)
    area = SweptArea(5.0, -3.0, 5.0 + wide, -3.0 + high, 1)
    places = area.path(area.strips_of(0, R), R)
    path = driven(places, Pose(0.0, 0.0, 1.0), mission)
    assert len(path) - 1 <= way_ticks([(0.0, 0.0), *places], mission)


@pytest.mark.parametrize("parts", [1, 2, 3, 7, 30])
def test_the_strips_are_split_into_parts_without_a_gap(parts: int) -> None:
    area = SweptArea(0.0, 0.0, 30.0, 25.0, parts)
    whole = area.path((0, area.strips(R)), R)
    split = [area.path(area.strips_of(part, R), R) for part in range(parts)]
    assert [place for part in split for place in part] == list(whole)
    assert max(map(len, split)) - min(map(len, split)) <= 2


MISSION = Mission(
    sensing_range=R,
    period=1.0,
    max_speed=1.0,
    max_turn_rate=math.pi,
    accuracy=0.3,
    noise=Noise(anchor_sigma=0.05, mutual_sigma=0.05, gyro_bias=0.0002),
)


FINDER = [(0.0, 1.57), (0.6, 1.57), (1.0, 0.0), (0.8, 1.57), (0.6, 1.57), (0.9, 0.0), (0.9, -1.57)]


OWN = [(0.0, 1.57), (0.6, 1.57), (0.6, 0.0), (0.0, 1.57), (0.6, 1.57), (0.6, -1.57), (0.6, 0.3)]
"""The manoeuvres of both robots in m/s and rad/s; each is repeated."""


def path_of(manoeuvres: list[tuple[float, float]]) -> Track:
    v, omega = np.array(manoeuvres).T
    return track(v, omega, 1.0)


def poses_of(pose: Pose, manoeuvres: list[tuple[float, float]]) -> list[Pose]:
    found = [pose]
    for v, omega in manoeuvres:
        found.append(step(found[-1], v, omega, 1.0))
    return found


def contact_with(
    sigma: float, seed: int, times: int = 3, x: float | None = None
) -> tuple[JointMeasurements, Pose]:
    """Return a contact with a finder whose position has this sigma (m), and the true pose at its end.

    The finder reports another `x` (m), if there is one.
    """
    rng = np.random.default_rng(seed)
    covariance = Covariance(0.5 * sigma**2, 0.0, 0.0, 0.5 * sigma**2, 0.0, 0.01**2)
    finder, angle = Pose(10.0, 20.0, rng.uniform(-3.0, 3.0)), rng.uniform(-math.pi, math.pi)
    own = Pose(10.0 + 1.8 * math.cos(angle), 20.0 + 1.8 * math.sin(angle), rng.uniform(-3.0, 3.0))
    there, here = poses_of(finder, FINDER * times), poses_of(own, OWN * times)
    errors = rng.normal(0.0, np.sqrt(np.diagonal(np.array(covariance.matrix)))).tolist()
    told = Pose(finder.x + errors[0] if x is None else x, finder.y + errors[1], finder.heading + errors[2])
    ranges = [
        (tick, math.hypot(one.x - other.x, one.y - other.y) + rng.normal(0.0, 0.05))
        for tick, (one, other) in enumerate(zip(there, here, strict=True))
    ]
    paths = path_of(FINDER * times), path_of(OWN * times)
    return contact_measurements(told, covariance, paths, ranges, MISSION), here[-1]


@given(st.integers(0, 10**6), st.floats(0.01, 0.28))
@settings(max_examples=12, deadline=None)
def test_no_robot_knows_its_position_better_than_its_finder(seed: int, sigma: float) -> None:
    measured, truth = contact_with(sigma, seed)
    found = estimated(measured, MISSION)
    assert found is not None
    assert found.covariance.position_sigma >= sigma
    if not found.blocking_reason:
        assert nees(found.poses[0], truth, found.covariance) < 25.0


def test_a_finder_that_is_less_accurate_than_the_mission_asks_leads_to_no_claim() -> None:
    found = estimated(contact_with(0.4, 1)[0], MISSION)
    assert found is not None
    assert found.blocking_reason.startswith("the sigma of the position is 0.4")


def test_a_reference_at_the_bounds_of_messages_gives_no_estimate_beyond_them() -> None:
    """An estimate beyond them could be sent and recorded, but not be read again."""
    found = [estimated(contact_with(0.1, 1, x=x)[0], MISSION) for x in (1e7, -1e7)]
    assert None in found
    for one in found:
        if one is not None:
            frame = encode(Estimate(0, "u", (), one.poses, False, one.probabilities, one.covariance))
            assert decode(frame, Estimate).world == one.poses


@pytest.mark.long
def test_the_covariances_of_contacts_are_right() -> None:
    scores = []
    for seed in range(200):
        measured, truth = contact_with(0.1, seed)
        found = estimated(measured, MISSION)
        assert found is not None
        scores.append(nees(found.poses[0], truth, found.covariance))
    assert 2.4 < np.mean(scores) < 3.7


def config() -> RobotConfig:
    return noisy(four()).config("u")


def met(sigma: float, ticks: int = 40) -> Any:
    """Return the state of a robot after a contact with a finder whose position has this sigma, in m."""
    planner, pose = GroupPlanner(UnanchoredPlanner()), Pose(5.0, 4.0, 0.7)
    finder, driven = Pose(6.5, 5.0, 0.2), [(v, omega) for v, omega in FINDER * 8]
    state, executed = planner.start(config()), None
    runs: list[Segment] = []
    covariance = Covariance(0.5 * sigma**2, 0.0, 0.0, 0.5 * sigma**2, 0.0, 1e-4)
    told = finder
    for tick in range(ticks):
        range_ = math.hypot(finder.x - pose.x, finder.y - pose.y)
        state = planner.observe(
            state, Observation(tick, "u", executed, None, (Detection("b", range_, (tick,)),))
        )
        prior = ReportedPose(0, told, covariance)
        report = Report(tick, "b", 2, "looping", through=tick, runs=tuple(runs), prior=prior)
        assert planner.malformed(report) is None
        state = planner.decide(state, [report])
        command = planner.command(state)
        executed = Controls(command.v, command.omega)
        if command.verdict is not None:
            break
        pose = step(pose, executed.v, executed.omega, 1.0)
        finder, runs = step(finder, *driven[tick], 1.0), [*runs, Segment(1, *driven[tick])]
    return state, pose


def test_a_robot_claims_its_pose_in_a_contact() -> None:
    state, pose = met(0.05)
    assert isinstance(state.verdict, Localised)
    assert state.verdict.covariance is not None
    assert nees(state.verdict.pose, pose, state.verdict.covariance) < 16.3
    assert GroupPlanner(UnanchoredPlanner()).report_to(state, "b").heard > 0


def test_a_robot_stands_still_for_a_finder_that_is_too_inaccurate_and_ends_undecided() -> None:
    planner = GroupPlanner(UnanchoredPlanner())
    state, _ = met(0.4)
    assert state.odometry == Pose(0.0, 0.0, 0.0)
    late = math.ceil(state.config.gives_up / state.config.mission.period)
    state = planner.observe(state, Observation(late, "u", REST, None))
    state = planner.decide(state)
    assert state.verdict == Undecided("b knows its position to 0.4 m, required 0.3")


def test_a_robot_that_reports_another_reference_in_each_tick_costs_an_estimate_in_three_ticks() -> None:
    planner = GroupPlanner(UnanchoredPlanner())
    state = planner.start(config())
    covariance = Covariance(0.01, 0.0, 0.0, 0.01, 0.0, 1e-4)
    estimates = set()
    for tick in range(60):
        seen = (Detection("b", 1.0 + 0.01 * tick, (tick,)),)
        state = planner.observe(state, Observation(tick, "u", REST, None, seen))
        here = max(0, tick - 20)
        runs = (Segment(tick - here, 0.1, 0.0),) if tick > here else ()
        prior = ReportedPose(here, Pose(0.1 * here, 0.0, 0.0), covariance)
        report = Report(tick, "b", 2, "looping", since=here, through=tick, runs=runs, prior=prior)
        assert planner.malformed(report) is None
        state = planner.decide(state, [report])
        assert isinstance(state.found, Contacted)
        estimates.add(state.found.estimated_tick)
    assert 5 <= len(estimates) <= 20
