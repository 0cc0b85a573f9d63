"""The fit of a mission is the optimum of the whole factor graph, as gtsam finds it.

Fifty missions are played and recorded. What both robots had measured when they claimed is read back from
their journals, twice: into a mind, for the fit that the claim came of; and into a graph of every pose and
every manoeuvre, which has nothing in common with `agent.estimation.gaussian.least_squares` but the model.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import islice, product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from agent.estimation.gaussian.hypotheses import ScoredHypothesis, search
from agent.estimation.gaussian.least_squares import Fit, poses
from agent.estimation.gaussian.range_model import PairRanges
from agent.planning import inference, planner
from agent.planning.state import Done, RobotState
from compose.launch.in_process import play
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
from protocol.motion import Controls, Pose, compose, step
from protocol.noise import Noise, VelocityNoise
from protocol.wire import decode
from tests.series import series

pytest.importorskip("gtsam", reason="gtsam has no wheel for this platform or this Python")
import gtsam

Array = NDArray[np.float64]

MISSIONS = 50
AGREED = 0.01
"""sigmas: how far a pose may be from gtsam's"""
AGREED_COVARIANCE = 0.01
"""of the product of the two sigmas: how far an entry of the covariance may be from gtsam's"""
STILL = 1e-7
"""m, m/s and rad: gtsam's Gauss-Newton ends where a step changes all poses and manoeuvres by less"""
STEPS = 200
"""until then, at the most"""

SIGMAS = ((0.01, 0.01), (0.02, 0.05), (0.1, 0.1))
"""m, of ranges to anchors and between robots"""
DRIFTS = (
    VelocityNoise(),
    VelocityNoise(0.001, 0.001),
    VelocityNoise(0.01, 0.01),
    VelocityNoise(0.001, 0.01, 0.02, 0.005),
)
SETTINGS = tuple(product(SIGMAS, DRIFTS))
"""missions go through them in turn; neither T_s nor v_max is 1 in any, so that none can be forgotten"""


def noisy(number: int) -> Noise:
    (anchor, mutual), drift = SETTINGS[number % len(SETTINGS)]
    return Noise(anchor, mutual, actuation=drift, odometry=drift)


def accuracy(noise: Noise) -> float:
    """m: what can be had with such noise in a few ticks."""
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


# --- the record ---------------------------------------------------------------------------------------


class Measured(NamedTuple):
    """What one robot had sensed."""

    odometry: list[Controls]
    """over each tick"""
    anchor: list[tuple[int, float]]
    """the ticks and the ranges, in m"""
    mutual: list[tuple[int, float]]


def recorded(number: int, folder: Path) -> None:
    """Play a mission; its record goes to `folder`."""
    scenario, noise = parse(TEXT.format(seed=number), "recorded"), noisy(number)
    mission = replace(scenario.mission, noise=noise, accuracy=accuracy(noise))
    recording = play(replace(scenario, mission=mission), folder)
    assert recording.end is not None
    assert recording.end.outcome == "localised", recording.end


def said(folder: Path, robot: str) -> Iterator[Observation | Report | Command]:
    """What the journal of `robot` has in and out, until it claims."""
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
    """A mind that has sensed and heard what the robot had when it claimed, and the claim.

    It has come to a verdict before it began, so it decides nothing, and takes no time.
    """
    config = decode(list(journal_file.read(folder / f"agent-{robot}.journal"))[1], RobotConfig)
    state = RobotState(config, Done(1, Undecided("was not asked")))
    heard: list[Report] = []
    for message in said(folder, robot):
        match message:
            case Observation():
                state, heard = planner.observe(state, message), []
            case Report() if message.robot != robot:
                heard.append(message)
            case Command(verdict=verdict):
                state = planner.decide(state, heard)
                if isinstance(verdict, Localised):
                    return state, verdict
            case _:
                pass
    raise AssertionError(f"{robot} has claimed nothing")


# --- gtsam --------------------------------------------------------------------------------------------


class Optimum(NamedTuple):
    """What gtsam makes of the graph."""

    mean: Array
    """of both poses in the last tick, as `smoothing.poses` has them"""
    covariance: Array
    error: float
    """half the sum of squares"""


def pose_of(robot: int, tick: int) -> int:
    return int(gtsam.symbol("ab"[robot], tick))


def manoeuvre_of(robot: int, tick: int) -> int:
    """The key of the v and omega that were driven over [tick, tick + 1]."""
    return int(gtsam.symbol("vw"[robot], tick))


def anchor_of(robot: int) -> int:
    return int(gtsam.symbol("m", robot))


def arc(robot: int, tick: int, period: float) -> gtsam.CustomFactor:
    """The unicycle's exact step: over a tick the pose goes along an exponential of SE(2)."""
    keys = [pose_of(robot, tick), manoeuvre_of(robot, tick), pose_of(robot, tick + 1)]

    def broken(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        v, omega = values.atPoint2(keys[1])
        twist = np.array((v * period, 0.0, omega * period))
        driven = gtsam.Pose2.Expmap(twist)
        ahead = values.atPose2(keys[2]).between(values.atPose2(keys[0]).compose(driven))
        if jacobians is not None:
            by_end = gtsam.Pose2.LogmapDerivative(ahead)
            jacobians[0] = by_end @ driven.inverse().AdjointMap()
            jacobians[1] = by_end @ gtsam.Pose2.ExpmapDerivative(twist)[:, [0, 2]] * period
            jacobians[2] = -by_end @ ahead.inverse().AdjointMap()
        return np.asarray(gtsam.Pose2.Logmap(ahead))

    return gtsam.CustomFactor(gtsam.noiseModel.Constrained.All(3), keys, broken)


def graph_of(
    robots: Sequence[Measured], noise: Noise, period: float, anchors: Sequence[Array]
) -> gtsam.NonlinearFactorGraph:
    """Every pose, every manoeuvre, every range of both; no prior on where they began."""
    graph = gtsam.NonlinearFactorGraph()
    for robot, (seen, anchor) in enumerate(zip(robots, anchors, strict=True)):
        graph.add(gtsam.NonlinearEqualityPoint2(anchor_of(robot), anchor))
        for tick, told in enumerate(seen.odometry):
            sigmas = np.sqrt(noise.odometry.variances(told.v, told.omega))
            white = gtsam.noiseModel.Constrained.MixedSigmas(
                1.0, sigmas
            )  # where one is 0, it is a constraint
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
    """As if the odometry were exact, from `starts`."""
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


def optimum(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, last: Sequence[int]) -> Optimum:
    """By gtsam's Gauss-Newton. Step by step, for its `optimize` ends where the error grows for once."""
    for _ in range(STEPS):
        optimiser = gtsam.GaussNewtonOptimizer(graph, values)
        optimiser.iterate()
        change = values.localCoordinates(optimiser.values()).norm()
        values = optimiser.values()
        if change < STILL:
            break
    else:
        raise AssertionError("gtsam has found no optimum")
    local = gtsam.Marginals(graph, values).jointMarginalCovariance(last).fullMatrix()
    mean, turn = np.empty(6), np.zeros((6, 6))
    for robot, key in enumerate(last):  # gtsam's covariance is along the robot's own axes
        pose, i = values.atPose2(key), 3 * robot
        mean[i : i + 3] = pose.x(), pose.y(), pose.theta()
        turn[i : i + 2, i : i + 2] = pose.rotation().matrix()
        turn[i + 2, i + 2] = 1.0
    return Optimum(mean, turn @ local @ turn.T, graph.error(values))


# --- both ---------------------------------------------------------------------------------------------


class Compared(NamedTuple):
    """One mission."""

    config: RobotConfig
    claimed: Localised
    pair: PairRanges
    ours: ScoredHypothesis
    theirs: Optimum


@pytest.fixture(scope="module", params=series(range(MISSIONS), 5))
def mission(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Compared:
    folder = tmp_path_factory.mktemp("recorded")
    recorded(request.param, folder)
    state, claimed = remembered(folder, "a")
    pair = inference.pair_of(state)
    ours = search(pair)[0]
    robots = [measured(folder, robot) for robot in ("a", "b")]
    assert [len(seen.odometry) for seen in robots] == [state.tick] * 2, "both claim in the same tick"
    m1, m2 = state.config.anchor, state.config.peer_anchor
    anchors = (np.zeros(2), np.array((m2.x - m1.x, m2.y - m1.y)))
    period = state.config.mission.period
    graph = graph_of(robots, state.config.mission.noise, period, anchors)
    starts = nudged(ours.fit, anchors, np.random.default_rng(request.param))
    values = begun(robots, starts, period, anchors)
    theirs = optimum(graph, values, [pose_of(robot, state.tick) for robot in (0, 1)])
    return Compared(state.config, claimed, pair, ours, theirs)


def nudged(fit: Fit, anchors: Sequence[Array], draw: np.random.Generator) -> list[Pose]:
    """Where both may have begun instead, by what we hold to be known of it."""
    guess = draw.multivariate_normal(fit.guess, fit.covariance)
    starts = []
    for (mx, my, turn), (x, y) in zip(guess.reshape(2, 3).tolist(), anchors, strict=True):
        starts.append(compose(Pose(float(x), float(y), turn), Pose(-mx, -my, 0.0)))
    return starts


def wrapped(change: Array) -> Array:
    """A difference of two means, with headings between -pi and pi."""
    change = change.copy()
    change[2::3] = np.remainder(change[2::3] + math.pi, math.tau) - math.pi
    return change


def test_the_claim_came_of_this_fit(mission: Compared) -> None:
    (held,) = inference.pair_planning_hypotheses([mission.ours], mission.pair)
    pose, covariance = inference.claim(held, 0, mission.pair)
    anchor = mission.config.anchor
    assert mission.claimed == Localised(Pose(anchor.x + pose.x, anchor.y + pose.y, pose.heading), covariance)


def test_both_poses_are_gtsams_within_a_hundredth_of_a_sigma(mission: Compared) -> None:
    mean, _ = poses(mission.ours.fit, mission.pair.apart)
    sigmas = np.sqrt(np.diagonal(mission.theirs.covariance))
    off = np.abs(wrapped(mean - mission.theirs.mean)) / sigmas
    assert off.max() <= AGREED, off


def test_the_covariance_of_both_poses_is_gtsams_within_a_hundredth(mission: Compared) -> None:
    _, covariance = poses(mission.ours.fit, mission.pair.apart)
    sigmas = np.sqrt(np.diagonal(mission.theirs.covariance))
    off = np.abs(covariance - mission.theirs.covariance) / np.outer(sigmas, sigmas)
    assert off.max() <= AGREED_COVARIANCE, off


def test_chi_square_is_the_sum_of_squares_at_gtsams_optimum(mission: Compared) -> None:
    assert mission.ours.fit.chi2 == pytest.approx(2.0 * mission.theirs.error, rel=1e-4)
