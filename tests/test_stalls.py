"""Stalls: robots that measure at the same places for ever notice it, and measure elsewhere."""

from __future__ import annotations

import math

import numpy as np
import pytest

import tandem
from agent.estimation.gaussian.odometry_noise import Array, Track, track
from agent.estimation.gaussian.planning_hypotheses import PlanningHypothesis
from agent.planning.active_sensing import STALLED, plan_alone, plan_together
from agent.planning.strides import PLANS, choice, is_stalled, stride
from compose.launch.in_process import run_mission
from protocol.mission import Mission, Role
from protocol.motion import REST
from protocol.noise import Noise
from tests.series import series
from tests.surveys import SIGMA, assert_localised, scenario_of

MISSION = Mission(1.5, 1.0, 1.0, math.pi, noise=Noise(0.1, 0.1))
AT_REST = [0.0] * (2 * PLANS)
TO_AND_FRO = [0.5, -0.5] * PLANS
ONWARD = [0.5] * (2 * PLANS)


def path_of(velocities: list[float]) -> Track:
    return track(np.array(velocities), np.zeros(len(velocities)), MISSION.period)


def held(probability: float, poses: list[float], covariance: Array) -> PlanningHypothesis:
    return PlanningHypothesis(probability, np.array(poses), covariance)


@pytest.mark.parametrize("velocities", [AT_REST, TO_AND_FRO], ids=["at rest", "to and fro"])
def test_a_robot_that_reaches_no_further_place_is_stalled(velocities: list[float]) -> None:
    assert is_stalled([path_of(velocities)], 0, 1, MISSION)
    assert is_stalled([path_of(velocities), path_of(AT_REST)], 0, 1, MISSION)


def test_a_robot_that_moves_on_is_not_stalled_nor_is_its_peer() -> None:
    assert not is_stalled([path_of(ONWARD)], 0, 1, MISSION)
    assert not is_stalled([path_of(AT_REST), path_of(ONWARD)], 0, 1, MISSION)


def test_a_robot_that_has_just_begun_to_plan_is_not_stalled() -> None:
    began = len(AT_REST) - PLANS + 1
    assert not is_stalled([path_of(AT_REST)], began, 1, MISSION)
    assert is_stalled([path_of(AT_REST)], began - 1, 1, MISSION)


def test_a_stalled_robot_moves_to_where_its_next_range_differs() -> None:
    """Continued, each manoeuvre would leave the range under one of the two hypotheses."""
    known = np.eye(2) * 0.05**2
    hypotheses = [held(0.9, [1.24, 0.48, -1.19], known), held(0.1, [1.18, -0.38, 0.83], known)]
    command = plan_alone(hypotheses, MISSION, objective=STALLED)
    assert command != REST
    ranges = []
    for x, y, heading in (one.poses for one in hypotheses):
        ways = choice(MISSION)
        (i,) = np.flatnonzero((ways.v == command.v) & (ways.omega == command.omega))
        c, s = math.cos(heading), math.sin(heading)
        along, across = ways.along[i, 0], ways.across[i, 0]
        ranges.append(math.hypot(x + c * along - s * across, y + s * along + c * across))
    assert abs(ranges[0] - ranges[1]) > 3.0 * MISSION.noise.anchor_sigma


def test_a_stalled_pair_does_not_stand_still() -> None:
    """The poses are those of a mission in which both stood still for 130 ticks."""
    known = np.diag([0.05**2, 0.05**2, 0.05**2] * 2)
    mirrored = (
        held(0.26, [9.63, -1.30, -0.13, 9.97, -0.06, -2.03], known),
        held(0.26, [9.66, -1.19, -0.11, 9.97, 0.06, 2.04], known),
        held(0.24, [9.62, 1.31, 0.15, 9.98, 0.07, 1.89], known),
        held(0.24, [9.65, 1.18, 0.13, 9.98, -0.07, -1.88], known),
    )
    assert plan_together(mirrored, (10.0, 0.0), 1.3, MISSION) == (REST, REST)
    _, b = plan_together(mirrored, (10.0, 0.0), 1.3, MISSION, objective=STALLED)
    assert b != REST


@pytest.mark.parametrize("resting", ["a", "b"])
def test_beside_a_peer_that_has_claimed_only_the_other_robot_moves(resting: Role) -> None:
    known = np.diag([0.05**2, 0.05**2, 0.05**2] * 2)
    hypotheses = (held(1.0, [9.6, -1.0, 0.0, 10.0, -0.3, 2.0], known),)
    plan = plan_together(hypotheses, (10.0, 0.0), 1.0, MISSION, objective=STALLED, resting=resting)
    at_rest, mover = (plan[0], plan[1]) if resting == "a" else (plan[1], plan[0])
    assert at_rest == REST
    assert mover != REST


@pytest.mark.parametrize("seed", series([8091567773304338074, 3571630859253287996, 6725030068727122292], 0))
def test_a_robot_whose_peer_has_claimed_first_localises_too(seed: int) -> None:
    """It waited for manoeuvres of its peer, which stood still; in the last one, for a better claim of it."""
    fields = {"mission.noise.anchor_sigma": 0.05, "mission.noise.mutual_sigma": 0.05, "mission.accuracy": 0.1}
    scenario = tandem.Scenario.load("random").with_({**fields, "world.noise.outliers": 0.1}, seed=seed)
    assert tandem.run(scenario).outcome == "localised"


@pytest.mark.parametrize("seed", series([694, 455, 1102, 1198]))
def test_a_mission_that_once_stalled_localises(seed: int) -> None:
    """In 455 and 1102 both stood still in phase 3, in 694 and 1198 b measured at two places in phase 1."""
    assert stride(scenario_of(SIGMA, seed, reach=1.5).mission) == 1
    assert_localised(run_mission(scenario_of(SIGMA, seed, reach=1.5)))
