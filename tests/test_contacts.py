"""A robot without an anchor beside a finder under noise: its pose is no better known than the finder's."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.estimation.gaussian.contact_fit import contact_measurements, estimated
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.odometry_noise import Track, track
from agent.planning.contacted import Contacted
from agent.planning.group import GroupPlanner
from agent.planning.unanchored import UnanchoredPlanner
from compose.recording.claim_errors import nees
from protocol.messages import Contact as Detection
from protocol.messages import (
    Estimate,
    Localised,
    Observation,
    Report,
    ReportedPose,
    RobotConfig,
    Undecided,
)
from protocol.mission import Mission
from protocol.motion import REST, Controls, Covariance, Pose, Segment, step
from protocol.noise import Noise
from protocol.wire import decode, encode
from tests.groups import R
from tests.test_noisy_unanchored import noisy
from tests.test_unanchored import four

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
