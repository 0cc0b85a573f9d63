"""The paths of robots under noise: feasible, in range, with the most information, and out of stalls."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

import tandem
from agent.estimation.exact_estimator import EXACT_ESTIMATOR
from agent.estimation.gaussian.gaussian_estimator import GAUSSIAN
from agent.estimation.gaussian.odometry_noise import Array, Track, track
from agent.estimation.gaussian.planning_hypotheses import PlanningHypothesis, to_second_order
from agent.planning.active_sensing import (
    CONTINUED,
    STALLED,
    _information,
    joint_costs,
    own_costs,
    plan_alone,
    plan_together,
)
from agent.planning.drive import pursuit, towards
from agent.planning.strides import PLANS, STRIDES_AHEAD, choice, is_stalled, stride
from compose.launch.in_process import run_mission
from protocol.mission import Mission, Role
from protocol.motion import REST, Controls, Pose, step
from protocol.noise import Noise, VelocityNoise
from protocol.orbits import Orbit, clearance, rendezvous
from tests.hypotheses_by_numpy import joint_costs_by_numpy, own_costs_by_numpy, second_order_by_numpy
from tests.series import series
from tests.surveys import SIGMA, assert_localised, scenario_of

SIGMA_M = 0.1
MISSION = Mission(3.0, 1.0, 1.0, math.pi, noise=Noise(SIGMA_M, SIGMA_M))
REACH = MISSION.sensing_range
SETTLED = np.eye(2) * 0.05**2
"""The covariance in m^2 of an anchor that is known as well as phase 1 requires."""
BOTH_SETTLED = np.diag([0.05**2, 0.05**2, 0.02**2] * 2)

angles = st.floats(-math.pi, math.pi)
missions = st.builds(
    Mission,
    st.floats(0.5, 20.0),
    st.floats(0.05, 2.0),
    st.floats(0.1, 3.0),
    st.floats(0.1, 4.0),
    noise=st.just(Noise(SIGMA_M, SIGMA_M)),
)


def after(pose: Pose, command: Controls, mission: Mission = MISSION) -> Pose:
    """Return the pose after a manoeuvre of the usual duration."""
    for _ in range(stride(mission)):
        pose = step(pose, command.v, command.omega, mission.period)
    return pose


def held(pose: Pose, probability: float = 1.0, covariance: Array = SETTLED) -> PlanningHypothesis:
    return PlanningHypothesis(probability, np.array([pose.x, pose.y, pose.heading]), covariance)


# --- manoeuvres ---------------------------------------------------------------------------------------


@given(missions)
def test_no_manoeuvre_is_faster_than_the_robot(mission: Mission) -> None:
    ways = choice(mission)
    assert np.max(np.abs(ways.v)) <= mission.max_speed * (1.0 + 1e-12)
    assert np.max(np.abs(ways.omega)) <= mission.max_turn_rate
    assert Controls(float(ways.v[-1]), float(ways.omega[-1])) == REST


@given(missions)
def test_a_manoeuvre_leads_a_quarter_of_the_range_however_short_the_tick(mission: Mission) -> None:
    ticks, straight = stride(mission), mission.first_straight
    assert ticks >= 1
    assert ticks == 1 or abs(ticks * straight - 0.25 * mission.sensing_range) <= 0.5 * straight + 1e-9


@given(missions, st.integers(0, 68))
def test_a_manoeuvre_leads_where_the_motion_model_says(mission: Mission, way: int) -> None:
    ways, pose = choice(mission), Pose(0.0, 0.0, 0.0)
    for k in range(ways.along.shape[1]):
        pose = after(pose, Controls(float(ways.v[way]), float(ways.omega[way])), mission)
        assert (ways.along[way, k], ways.across[way, k]) == pytest.approx((pose.x, pose.y), abs=1e-9)


# --- one robot --------------------------------------------------------------------------------------------


@given(st.floats(0.3, 1.0), angles, angles, st.floats(0.4, 3.0))
def test_a_robot_alone_stays_within_the_given_distance_of_its_anchor(
    part: float, bearing: float, heading: float, within: float
) -> None:
    rho = part * within
    pose = Pose(rho * math.cos(bearing), rho * math.sin(bearing), heading)
    there = after(pose, plan_alone([held(pose)], MISSION, within))
    assert math.hypot(there.x, there.y) <= within + 0.02


@given(st.floats(-1.5, 1.5), st.floats(0.4, 1.8))
def test_of_mirror_images_a_robot_drives_where_their_ranges_differ(along: float, aside: float) -> None:
    """Ahead, behind and at rest, both mirror images predict the same ranges."""
    one, other = Pose(along, aside, 0.0), Pose(along, -aside, 0.0)
    tight = np.eye(2) * 1e-6
    command = plan_alone([held(one, 0.5, tight), held(other, 0.5, tight)], MISSION)
    gaps = []
    for _ in range(STRIDES_AHEAD):
        one, other = after(one, command), after(other, command)
        gaps.append(math.hypot(one.x, one.y) - math.hypot(other.x, other.y))
    assert math.hypot(*gaps) > 4.0 * SIGMA_M


# --- two robots -----------------------------------------------------------------------------------------

M2 = (10.0, 0.0)


@given(st.floats(0.3, 0.85), angles, angles, st.floats(0.3, 0.85), angles, angles)
def test_together_robots_keep_in_range_and_apart(
    off: float, bearing: float, b_heading: float, between: float, towards: float, heading: float
) -> None:
    b = Pose(M2[0] + off * REACH * math.cos(bearing), off * REACH * math.sin(bearing), b_heading)
    a = Pose(b.x + between * REACH * math.cos(towards), b.y + between * REACH * math.sin(towards), heading)
    poses = np.array([a.x, a.y, a.heading, b.x, b.y, b.heading])
    by_a, by_b = plan_together((PlanningHypothesis(1.0, poses, BOTH_SETTLED),), M2, between * REACH, MISSION)
    there, peer = after(a, by_a), after(b, by_b)
    assert 0.15 * REACH < math.hypot(there.x - peer.x, there.y - peer.y) < 0.95 * REACH
    assert math.hypot(peer.x - M2[0], peer.y - M2[1]) < 0.95 * REACH


@pytest.mark.parametrize("seed", range(30))
def test_compiled_costs_of_manoeuvres_are_those_of_their_text_to_the_bit(seed: int) -> None:
    draw = np.random.default_rng(seed)
    mission = replace(
        MISSION, noise=Noise(*draw.choice([0.0, 1e-3, 0.1], 2)), accuracy=draw.uniform(0.01, 0.3)
    )
    objective, within = (CONTINUED, STALLED)[seed % 2], (None, 0.7)[seed // 2 % 2]
    ways, m2 = choice(mission, objective.strides), (float(draw.uniform(1.0, 9.0)), float(draw.normal()))
    of_both, of_one = [], []
    for probability in draw.dirichlet(np.ones(draw.integers(1, 6))).tolist():
        root, poses = draw.normal(size=(6, 6)) * 10.0 ** draw.uniform(-3.0, 0.0), draw.normal(size=6)
        poses[3:5] += m2
        of_both.append(PlanningHypothesis(probability, poses, root @ root.T))
        of_one.append(PlanningHypothesis(probability, poses[:3], (root @ root.T)[:2, :2]))
        mean, covariance = second_order_by_numpy(of_both[-1], m2)
        found = to_second_order(of_both[-1], m2)
        assert np.array_equal(found.poses, mean)
        assert np.array_equal(found.covariance, covariance)
    given = (ways, of_one, mission, within, objective)
    assert np.array_equal(own_costs(*given), own_costs_by_numpy(*given))
    information = _information(of_both[0].covariance, mission)
    for moving, other in ((0, 5), (1, len(ways.v) - 1)):
        costs = joint_costs(ways, moving, other, of_both, m2, 1.0, mission, information, objective)
        text = joint_costs_by_numpy(ways, moving, other, of_both, m2, mission, objective)
        assert np.array_equal(costs, text)


# --- the circle ---------------------------------------------------------------------------------------


@given(st.floats(2.0, 20.0), angles, st.sampled_from([1.0, -1.0]))
def test_from_the_circle_itself_pursuit_is_eq_6(radius: float, bearing: float, observation: float) -> None:
    orbit = Orbit(radius, 1.0, observation / radius)
    local = Pose(radius * math.cos(bearing), radius * math.sin(bearing), bearing + observation * math.pi / 2)
    command = pursuit(local, orbit, MISSION)
    assert (command.v, command.omega) == pytest.approx((orbit.v, orbit.omega), abs=1e-9)


@given(st.floats(4.0, 20.0), st.floats(-0.8, 0.8), st.floats(-0.5, 0.5), st.sampled_from([1.0, -1.0]))
def test_from_beside_the_circle_pursuit_leads_back_to_it(
    radius: float, off: float, askew: float, observation: float
) -> None:
    orbit = Orbit(radius, 1.0, observation / radius)
    local = Pose(radius + off, 0.0, observation * math.pi / 2 + askew)
    for _ in range(40):
        command = pursuit(local, orbit, MISSION)
        assert command.v == orbit.v
        assert abs(command.omega) <= MISSION.max_turn_rate
        local = step(local, command.v, command.omega, MISSION.period)
    assert math.hypot(local.x, local.y) == pytest.approx(radius, abs=1e-3)


# --- return to the anchor -----------------------------------------------------------------------------


@given(missions, st.booleans(), st.floats(-30.0, 30.0), st.floats(-30.0, 30.0), angles)
def test_from_anywhere_a_robot_finds_home(
    mission: Mission, exact: bool, x: float, y: float, heading: float
) -> None:
    if exact:
        mission = replace(mission, noise=Noise())
    tolerance = (EXACT_ESTIMATOR if mission.noise.exact else GAUSSIAN).pose_tolerance
    pose = Pose(x, y, heading)
    far = math.hypot(x - 1.0, y + 2.0)
    legs = far / (mission.max_speed * mission.period) + math.pi / (mission.max_turn_rate * mission.period)
    for _ in range(math.ceil(1.2 * legs) + 10):
        command = towards((1.0, -2.0), pose, mission, tolerance, backward=True)
        if command is None:
            break
        assert abs(command.v) <= mission.max_speed
        assert abs(command.omega) <= mission.max_turn_rate
        pose = step(pose, command.v, command.omega, mission.period)
    assert math.hypot(pose.x - 1.0, pose.y + 2.0) <= tolerance * mission.first_straight


# --- detours ------------------------------------------------------------------------------------------


def test_exact_sensors_need_no_clearance_and_the_plan_is_as_it_was() -> None:
    exact = replace(MISSION, noise=Noise())
    careless = replace(exact, accuracy=1.0, confidence=0.5)
    assert clearance(exact, 10.0) == clearance(careless, 10.0) == 0.0
    assert rendezvous(exact, 10.0, "assured") == rendezvous(careless, 10.0, "assured")


def test_uncertainty_makes_the_detour_longer() -> None:
    exact, coarse = replace(MISSION, noise=Noise()), MISSION
    drifting = replace(MISSION, noise=Noise(SIGMA_M, SIGMA_M, odometry=VelocityNoise(0.02, 0.02)))
    assert 0.0 < clearance(coarse, 10.0) < clearance(drifting, 10.0) < 0.5 * REACH
    bounds = [rendezvous(one, 10.0, "assured").bound for one in (exact, coarse, drifting)]
    assert bounds == sorted(set(bounds))


NEAR = Mission(1.5, 1.0, 1.0, math.pi, noise=Noise(0.1, 0.1))
AT_REST = [0.0] * (2 * PLANS)
TO_AND_FRO = [0.5, -0.5] * PLANS
ONWARD = [0.5] * (2 * PLANS)


def path_of(velocities: list[float]) -> Track:
    return track(np.array(velocities), np.zeros(len(velocities)), NEAR.period)


def maybe(probability: float, poses: list[float], covariance: Array) -> PlanningHypothesis:
    return PlanningHypothesis(probability, np.array(poses), covariance)


@pytest.mark.parametrize("velocities", [AT_REST, TO_AND_FRO], ids=["at rest", "to and fro"])
def test_a_robot_that_reaches_no_further_place_is_stalled(velocities: list[float]) -> None:
    assert is_stalled([path_of(velocities)], 0, 1, NEAR)
    assert is_stalled([path_of(velocities), path_of(AT_REST)], 0, 1, NEAR)


def test_a_robot_that_moves_on_is_not_stalled_nor_is_its_peer() -> None:
    assert not is_stalled([path_of(ONWARD)], 0, 1, NEAR)
    assert not is_stalled([path_of(AT_REST), path_of(ONWARD)], 0, 1, NEAR)


def test_a_robot_that_has_just_begun_to_plan_is_not_stalled() -> None:
    began = len(AT_REST) - PLANS + 1
    assert not is_stalled([path_of(AT_REST)], began, 1, NEAR)
    assert is_stalled([path_of(AT_REST)], began - 1, 1, NEAR)


def test_a_stalled_robot_moves_to_where_its_next_range_differs() -> None:
    """Continued, each manoeuvre would leave the range under one of the two hypotheses."""
    known = np.eye(2) * 0.05**2
    hypotheses = [
        maybe(0.9, [1.24, 0.48, -1.19], known),
        maybe(0.1, [1.18, -0.38, 0.83], known),
    ]
    command = plan_alone(hypotheses, NEAR, objective=STALLED)
    assert command != REST
    ranges = []
    for x, y, heading in (one.poses for one in hypotheses):
        ways = choice(NEAR)
        (i,) = np.flatnonzero((ways.v == command.v) & (ways.omega == command.omega))
        c, s = math.cos(heading), math.sin(heading)
        along, across = ways.along[i, 0], ways.across[i, 0]
        ranges.append(math.hypot(x + c * along - s * across, y + s * along + c * across))
    assert abs(ranges[0] - ranges[1]) > 3.0 * NEAR.noise.anchor_sigma


def test_a_stalled_pair_does_not_stand_still() -> None:
    """The poses are those of a mission in which both stood still for 130 ticks."""
    known = np.diag([0.05**2, 0.05**2, 0.05**2] * 2)
    mirrored = (
        maybe(0.26, [9.63, -1.30, -0.13, 9.97, -0.06, -2.03], known),
        maybe(0.26, [9.66, -1.19, -0.11, 9.97, 0.06, 2.04], known),
        maybe(0.24, [9.62, 1.31, 0.15, 9.98, 0.07, 1.89], known),
        maybe(0.24, [9.65, 1.18, 0.13, 9.98, -0.07, -1.88], known),
    )
    assert plan_together(mirrored, (10.0, 0.0), 1.3, NEAR) == (REST, REST)
    _, b = plan_together(mirrored, (10.0, 0.0), 1.3, NEAR, objective=STALLED)
    assert b != REST


@pytest.mark.parametrize("resting", ["a", "b"])
def test_beside_a_peer_that_has_claimed_only_the_other_robot_moves(resting: Role) -> None:
    known = np.diag([0.05**2, 0.05**2, 0.05**2] * 2)
    hypotheses = (maybe(1.0, [9.6, -1.0, 0.0, 10.0, -0.3, 2.0], known),)
    plan = plan_together(hypotheses, (10.0, 0.0), 1.0, NEAR, objective=STALLED, resting=resting)
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
