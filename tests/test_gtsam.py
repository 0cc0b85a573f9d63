"""The least-squares fit of a mission is the optimum of the complete factor graph, computed by gtsam.

Fifty missions are run and recorded. The measurements up to the claims are read from the journals twice: into
a RobotState, for the fit that led to the claim, and into a graph of all poses and manoeuvres. The graph
shares only the model with `agent.estimation.fit`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice, product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from msgspec.structs import astuple, replace

from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.mission_measurements import pair_of
from agent.estimation.gaussian.planning_hypotheses import localised, planning_hypothesis, to_second_order
from agent.estimation.gaussian.search import search
from agent.estimation.posterior import Hypothesis
from agent.planning.assured import Assured
from agent.planning.state import RobotState
from agent.planning.tasks import Done
from compose.launch.in_process import run_mission
from compose.scenario.scenario_file import parse
from protocol.journal import journal_file
from protocol.messages import (
    Command,
    Estimate,
    FinalReport,
    Localised,
    MissionEnd,
    Observation,
    Report,
    RobotConfig,
    Undecided,
)
from protocol.motion import Controls, Pose, step
from protocol.noise import Noise, VelocityNoise
from protocol.wire import decode
from tests.pair_starts import m2
from tests.series import series

pytest.importorskip("gtsam", reason="gtsam has no wheel for this platform or this Python")
import gtsam

from tests.factor_graph import Array, Optimum, arc, manoeuvre_of, nudged, optimum, pose_of, wrapped

MISSIONS, SINGULAR = 50, 21
"""The number of missions, and the seed of one whose linear system is too badly conditioned for gtsam."""
AGREED = 0.01
"""The maximum difference of a pose from gtsam's, in standard deviations."""
AGREED_COVARIANCE = 0.01
"""The maximum difference of a covariance element, as a fraction of the product of its two sigmas."""
SIGMAS = ((0.01, 0.01), (0.02, 0.05), (0.1, 0.1))
"""The standard deviations in m of ranges to anchors and between robots."""
DRIFTS = (
    VelocityNoise(),
    VelocityNoise(0.001, 0.001),
    VelocityNoise(0.01, 0.01),
    VelocityNoise(0.001, 0.01, 0.02, 0.005),
)
SETTINGS = tuple(product(SIGMAS, DRIFTS))
"""The settings of the missions, in turn. T_s and v_max are never 1, so a missing factor is detected."""


def noisy(number: int) -> Noise:
    (anchor, mutual), drift = SETTINGS[number % len(SETTINGS)]
    return Noise(anchor, mutual, actuation=drift, odometry=drift).as_told


def accuracy(noise: Noise) -> float:
    """Return an accuracy in m that is reached with this noise within a few ticks."""
    if noise.odometry.omega >= 0.01:
        return 0.3
    return 0.03 if noise.mutual_sigma <= 0.01 else 0.1


TEXT = """
    name = "recorded"
    seed = {seed}
    [mission]
    sensing_range = 3.0
    period = 0.5
    max_speed = 2.0
    max_turn_rate = 6.0
    [[robot]]
    id = "a"
    anchor = [1.0, -2.0]
    [[robot]]
    id = "b"
    anchor = [6.0, 2.0]
    """


# --- the recording ------------------------------------------------------------------------------------


class Measured(NamedTuple):
    """The measurements of one robot."""

    odometry: list[Controls]
    """The odometry of each tick."""
    anchor: list[tuple[int, float]]
    """The ticks and the anchor ranges, in m."""
    mutual: list[tuple[int, float]]


def recorded(number: int, folder: Path) -> None:
    """Run a mission, and write its recording to `folder`."""
    scenario, noise = parse(TEXT.format(seed=number), "recorded"), noisy(number)
    mission = replace(scenario.mission, noise=noise, accuracy=accuracy(noise))
    recording = run_mission(replace(scenario, mission=mission), folder)
    assert recording.end is not None
    assert recording.end.outcome == "localised", recording.end


def said(folder: Path, robot: str) -> Iterator[Observation | Report | Command]:
    """Yield the messages in the journal of `robot` until its claim."""
    frames = journal_file.read(folder / f"agent-{robot}.journal")
    for frame in islice(frames, 2, None):
        match decode(frame, Observation | Report | Command | Estimate | MissionEnd | FinalReport):
            case Observation() | Report() as message:
                yield message
            case Command() as command:
                yield command
                if isinstance(command.verdict, Localised):
                    return
            case _:
                pass


def measured(folder: Path, robot: str) -> Measured:
    observations = [message for message in said(folder, robot) if isinstance(message, Observation)]
    assert [observation.tick for observation in observations] == list(range(len(observations)))
    return Measured(
        [observation.executed for observation in observations if observation.executed is not None],
        [
            (observation.tick, observation.anchor_range)
            for observation in observations
            if observation.anchor_range is not None
        ],
        [
            (observation.tick, contact.range)
            for observation in observations
            for contact in observation.contacts
            if contact.range is not None
        ],
    )


def remembered(folder: Path, robot: str) -> tuple[RobotState, Localised]:
    """Return a RobotState with all data that the robot had when it claimed, and the claim.

    The state has a result from the start, so it makes no decisions, and is computed quickly.
    """
    config = decode(list(journal_file.read(folder / f"agent-{robot}.journal"))[1], RobotConfig)
    state = RobotState(config, task=Done(1, Undecided("was not asked")))
    heard: list[Report] = []
    for message in said(folder, robot):
        match message:
            case Observation():
                state, heard = Assured().observe(state, message), []
            case Report() if message.robot != robot:
                heard.append(message)
            case Command(verdict=verdict):
                state = Assured().decide(state, heard)
                if isinstance(verdict, Localised):
                    return state, verdict
            case _:
                pass
    raise AssertionError(f"{robot} has claimed nothing")


# --- gtsam --------------------------------------------------------------------------------------------


def anchor_of(robot: int) -> int:
    return int(gtsam.symbol("m", robot))


def graph_of(
    robots: Sequence[Measured], noise: Noise, period: float, anchors: Sequence[Array]
) -> gtsam.NonlinearFactorGraph:
    """Return the graph of all poses, manoeuvres and ranges of both robots, without priors on the starts."""
    graph = gtsam.NonlinearFactorGraph()
    for robot, (seen, anchor) in enumerate(zip(robots, anchors, strict=True)):
        graph.add(gtsam.NonlinearEqualityPoint2(anchor_of(robot), anchor))
        for tick, told in enumerate(seen.odometry):
            sigmas = np.sqrt(noise.odometry.variances(told.v, told.omega))
            white = gtsam.noiseModel.Constrained.MixedSigmas(
                1.0, sigmas
            )  # a sigma of 0 makes it a constraint
            key = manoeuvre_of(robot, tick)
            graph.add(gtsam.PriorFactorPoint2(key, np.array((told.v, told.omega)), white))
            graph.add(arc(robot, tick, period))
        to_anchor = gtsam.noiseModel.Isotropic.Sigma(1, noise.anchor_sigma)
        for tick, rho in seen.anchor:
            graph.add(gtsam.RangeFactor2D(pose_of(robot, tick), anchor_of(robot), rho, to_anchor))
    between = gtsam.noiseModel.Isotropic.Sigma(1, noise.mutual_sigma)
    for tick, rho in robots[0].mutual:
        graph.add(gtsam.RangeFactorPose2(pose_of(0, tick), pose_of(1, tick), rho, between))
    return graph


def begun(
    robots: Sequence[Measured], starts: Sequence[Pose], period: float, anchors: Sequence[Array]
) -> gtsam.Values:
    """Return the initial values: exact odometry from `starts`."""
    values = gtsam.Values()
    for robot, (seen, start) in enumerate(zip(robots, starts, strict=True)):
        values.insert(anchor_of(robot), anchors[robot])
        track = [start]
        for tick, told in enumerate(seen.odometry):
            values.insert(manoeuvre_of(robot, tick), np.array((told.v, told.omega)))
            track.append(step(track[-1], told.v, told.omega, period))
        for tick, pose in enumerate(track):
            values.insert(pose_of(robot, tick), gtsam.Pose2(pose.x, pose.y, pose.heading))
    return values


# --- both ---------------------------------------------------------------------------------------------


class Compared(NamedTuple):
    """The results of both methods for one mission."""

    config: RobotConfig
    claimed: Localised
    pair: JointMeasurements
    ours: Hypothesis
    theirs: Optimum


@pytest.fixture(scope="module", params=series([k for k in range(MISSIONS + 1) if k != SINGULAR], 5))
def mission(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Compared:
    folder = tmp_path_factory.mktemp("recorded")
    recorded(request.param, folder)
    state, claimed = remembered(folder, "a")
    pair = pair_of(state)
    ours = search(pair).hypotheses[0]
    robots = [measured(folder, robot) for robot in ("a", "b")]
    assert [len(seen.odometry) for seen in robots] == [state.tick] * 2, "both claim in the same tick"
    anchors = (np.zeros(2), np.array(m2(pair)))
    period = state.config.mission.period
    graph = graph_of(robots, state.config.mission.noise, period, anchors)
    starts = nudged(ours.fit, m2(pair), np.random.default_rng(request.param))
    values = begun(robots, starts, period, anchors)
    theirs = optimum(graph, values, [pose_of(robot, state.tick) for robot in (0, 1)])
    return Compared(state.config, claimed, pair, ours, theirs)


def test_the_claim_came_of_this_fit(mission: Compared) -> None:
    held = planning_hypothesis(mission.ours)
    anchor = mission.config.anchor
    stated = to_second_order(held, m2(mission.pair))
    ours, covariance = astuple(localised(stated, 0, (anchor.x, anchor.y)))
    assert mission.claimed.covariance is not None
    off = np.array(astuple(mission.claimed.pose)) - np.array(astuple(ours))
    sigmas = (covariance.position_sigma, covariance.position_sigma, covariance.heading_sigma)
    assert np.all(np.abs(off) < AGREED * np.array(sigmas)), "it began at what the robot held, this one anew"
    assert mission.claimed.covariance.xx == pytest.approx(covariance.xx, rel=AGREED_COVARIANCE)


def test_both_poses_are_gtsams_within_a_hundredth_of_a_sigma(mission: Compared) -> None:
    sigmas = np.sqrt(np.diagonal(mission.theirs.covariance))
    off = np.abs(wrapped(mission.ours.fit.poses.ravel() - mission.theirs.mean)) / sigmas
    assert off.max() <= AGREED, off


def test_the_covariance_of_both_poses_is_gtsams_within_a_hundredth(mission: Compared) -> None:
    sigmas = np.sqrt(np.diagonal(mission.theirs.covariance))
    off = np.abs(mission.ours.fit.covariance - mission.theirs.covariance) / np.outer(sigmas, sigmas)
    assert off.max() <= AGREED_COVARIANCE, off


def test_chi_square_is_the_sum_of_squares_at_gtsams_optimum(mission: Compared) -> None:
    assert mission.ours.fit.chi2 == pytest.approx(2.0 * mission.theirs.error, rel=1e-4)
