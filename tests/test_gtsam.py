"""The fits of missions and of recordings are the optimum of the complete factor graph, computed by gtsam.

The graph shares the model with the estimator, but no code of it: all poses and manoeuvres, the scale and bias
of each robot's odometry, and the errors that the ranges have in common. A range that may be an outlier has
the weight that the fit gave it. The measurements of missions are also read from the journals.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice, product
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import astuple, replace

from agent.estimation.fit import Fit
from agent.estimation.following import ClaimRule
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.mission_measurements import pair_of
from agent.estimation.gaussian.planning_hypotheses import localised, planning_hypothesis, to_second_order
from agent.estimation.gaussian.search import search
from agent.planning.assured import Assured
from agent.planning.state import RobotState
from agent.planning.tasks import Done
from compose.launch.in_process import run_mission
from compose.recording.estimating.estimate_run import estimated
from compose.recording.estimating.recorded_measurements import measurements
from compose.recording.ranging.range_files import read_ranges
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
from protocol.motion import Pose, step
from protocol.noise import Noise, VelocityNoise
from protocol.wire import decode
from tests.missions import outcome
from tests.pair_starts import kinds, m2
from tests.range_tables import SAMPLE
from tests.series import series

pytest.importorskip("gtsam", reason="gtsam has no wheel for this platform or this Python")
import gtsam

from tests.factor_graph import (
    Array,
    Optimum,
    arc,
    manoeuvre_of,
    nudged,
    optimum,
    optimum_at,
    pose_of,
    wrapped,
)

MISSIONS, SINGULAR = 50, 21
"""The number of missions, and the seed of one whose linear system is too badly conditioned for gtsam."""
WINDOWS = 5
LENGTH_S, APART_S = 20.0, 2.0
"""The length of a window, and the time in s from the beginning of one to that of the next."""
PROFILE = "uwb-calibrated"
MORE = 1.001
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


# --- the recording of a mission -----------------------------------------------------------------------


def recorded(number: int, folder: Path) -> None:
    """Run a mission, and write its recording to `folder`."""
    scenario, noise = parse(TEXT.format(seed=number), "recorded"), noisy(number)
    mission = replace(scenario.mission, noise=noise, accuracy=accuracy(noise))
    recording = run_mission(replace(scenario, mission=mission), folder)
    assert outcome(recording) == "localised"


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


def ranges_in(folder: Path) -> list[tuple[int, int, float]]:
    """Return the kind (see `kinds`), the tick and the length of all ranges that the robots have measured."""
    found = []
    for kind, robot in enumerate("ab"):
        for one in said(folder, robot):
            if isinstance(one, Observation):
                found += [(kind, one.tick, one.anchor_range)] if one.anchor_range is not None else []
                between = [contact.range for contact in one.contacts if contact.range is not None]
                found += [(2, one.tick, rho) for rho in between if robot == "a"]
    return sorted(found)


def odometry_in(folder: Path, robot: str) -> list[tuple[float, float]]:
    seen = [one for one in said(folder, robot) if isinstance(one, Observation)]
    assert [one.tick for one in seen] == list(range(len(seen)))
    return [(one.executed.v, one.executed.omega) for one in seen if one.executed is not None]


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


def constants_of(robot: int) -> int:
    """Return the key of the constant errors of a robot's odometry, in their sigmas."""
    return int(gtsam.symbol("cd"[robot], 0))


COMMON, SLOW = int(gtsam.symbol("e", 0)), int(gtsam.symbol("u", 0))
"""The keys of the constant errors of the ranges, in their sigmas, and of the slow ones, in m."""


def odometry(robot: int, tick: int, told: Array, effects: Array, sigmas: Array) -> gtsam.NoiseModelFactor:
    """Return the factor of the measured v and omega over a tick; `effects` are those of constant errors."""
    white = gtsam.noiseModel.Constrained.MixedSigmas(1.0, sigmas)  # a sigma of 0 makes it a constraint
    keys = [manoeuvre_of(robot, tick), constants_of(robot)]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        if jacobians is not None:
            jacobians[0], jacobians[1] = np.eye(2), -effects.T
        off = values.atPoint2(keys[0]) - told - effects.T @ values.atVector(keys[1])
        return np.asarray(off)

    return gtsam.CustomFactor(white, keys, error)


def measured_range(
    ends: list[tuple[int, Array | None]], rho: float, common: Array, row: int, sigma: float, *, slow: bool
) -> gtsam.NoiseModelFactor:
    """Return the factor of a range between two poses, or between a pose and the place of an anchor.

    `common` are the effects of the constant errors on this range, which is number `row`.
    """
    keys = [key for key, place in ends if place is None]
    errors = [COMMON, SLOW] if slow else [COMMON]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        places = [values.atPose2(key).translation() if place is None else place for key, place in ends]
        away = places[0] - places[1]
        distance = float(np.hypot(*away))
        off = distance - rho + common @ values.atVector(COMMON)
        if slow:
            off += values.atVector(SLOW)[row]
        if jacobians is not None:
            for i, key in enumerate(keys):
                sign = 1.0 if key == ends[0][0] else -1.0
                by_place = sign * away / distance @ values.atPose2(key).rotation().matrix()
                jacobians[i] = np.array([[*by_place, 0.0]])
            jacobians[len(keys)] = common[None, :]
            if slow:
                jacobians[len(keys) + 1] = np.eye(len(values.atVector(SLOW)))[row : row + 1]
        return np.array([off])

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(1, sigma), keys + errors, error)


def graph_of(pair: JointMeasurements, fit: Fit, larger: float = 1.0) -> gtsam.NonlinearFactorGraph:
    """Return the graph of all poses, manoeuvres, ranges and common errors, without priors on the starts.

    The variances of white errors are `larger` than told by this factor.
    """
    graph, ranges = gtsam.NonlinearFactorGraph(), pair.ranges
    unit = gtsam.noiseModel.Unit.Create
    priors, noise = pair.noise.priors, pair.noise.odometry
    for robot, path in enumerate(pair.paths):
        rest = pair.noise.standstill_bound
        for tick, (v, omega) in enumerate(zip(path.v.tolist(), path.omega.tolist(), strict=True)):
            moving = abs(v) > rest[0] or abs(omega) > rest[1]
            effects = np.array(
                (
                    (priors.wheel_scale * v, 0.0),
                    (0.0, priors.wheel_scale * omega),
                    (0.0, priors.gyro_bias * moving),
                )
            )
            white = np.array(noise.variances(v, omega))
            if path.extra is not None:
                white = white + path.extra[:, tick]
            graph.add(odometry(robot, tick, np.array((v, omega)), effects, np.sqrt(larger * white)))
            graph.add(arc(robot, tick, path.period, 0.0 if path.slip is None else float(path.slip[tick])))
        graph.add(gtsam.PriorFactorVector(constants_of(robot), np.zeros(3), unit(3)))
    columns, covariance = common_errors(pair), slow_covariance(pair)
    graph.add(gtsam.PriorFactorVector(COMMON, np.zeros(columns.shape[1]), unit(columns.shape[1])))
    if priors.slow_sigma:
        of_slow = gtsam.noiseModel.Gaussian.Covariance(covariance)
        graph.add(gtsam.PriorFactorVector(SLOW, np.zeros(len(ranges.rho)), of_slow))
    sigmas = ranges.sigma * np.sqrt(larger / fit.weights)
    places = np.zeros(2), np.array(m2(pair))
    for row, (rho, tick, sigma) in enumerate(
        zip(ranges.rho.tolist(), ranges.tick.tolist(), sigmas, strict=True)
    ):
        kind = int(kinds(pair)[row])
        ends: list[tuple[int, Array | None]]
        if kind == 2:
            ends = [(pose_of(0, tick), None), (pose_of(1, tick), None)]
        else:
            ends = [(pose_of(kind, tick), None), (-1, places[kind])]
        graph.add(measured_range(ends, rho, columns[row], row, float(sigma), slow=priors.slow_sigma > 0.0))
    return graph


def common_errors(pair: JointMeasurements) -> Array:
    """Return the effect of one sigma of each constant error on the ranges: common bias, scale, one a pair."""
    priors, ranges = pair.noise.priors, pair.ranges
    kind = kinds(pair)
    columns = [np.full(len(kind), priors.range_bias), priors.range_scale * ranges.rho]
    return np.stack([*columns, *[priors.pair_bias * (kind == one) for one in range(3)]], 1)


def slow_covariance(pair: JointMeasurements) -> Array:
    """Return the covariance (m^2) of the slow errors of the ranges; each pair of radios has its own."""
    priors, ranges = pair.noise.priors, pair.ranges
    kind = kinds(pair)
    apart = pair.paths[0].period * np.abs(ranges.tick[:, None] - ranges.tick)
    correlation = np.exp(-apart / priors.slow_time) * (kind[:, None] == kind)
    return np.asarray(priors.slow_sigma**2 * correlation)


def begun(pair: JointMeasurements, starts: list[Pose]) -> gtsam.Values:
    """Return the initial values: the measured odometry from `starts`, and no constant or slow errors."""
    values = gtsam.Values()
    for robot, (path, start) in enumerate(zip(pair.paths, starts, strict=True)):
        values.insert(constants_of(robot), np.zeros(3))
        track = [start]
        slips = np.zeros(len(path.v)) if path.slip is None else path.slip
        for tick, (v, omega, slip) in enumerate(
            zip(path.v.tolist(), path.omega.tolist(), slips.tolist(), strict=True)
        ):
            values.insert(manoeuvre_of(robot, tick), np.array((v, omega)))
            before = track[-1]
            after = step(Pose(before.x, before.y, before.heading + slip), v, omega, path.period)
            track.append(Pose(after.x, after.y, after.heading - slip))
        for tick, pose in enumerate(track):
            values.insert(pose_of(robot, tick), gtsam.Pose2(pose.x, pose.y, pose.heading))
    values.insert(COMMON, np.zeros(common_errors(pair).shape[1]))
    if pair.noise.priors.slow_sigma:
        values.insert(SLOW, np.zeros(len(pair.ranges.rho)))
    return values


def assert_optimum(ours: Fit, pair: JointMeasurements, seed: int) -> Optimum:
    """Assert that the fit is the optimum of the graph, from a random start, and return that."""
    values = begun(pair, nudged(ours, m2(pair), np.random.default_rng(seed)))
    ends = [pose_of(robot, len(path.v)) for robot, path in enumerate(pair.paths)]
    theirs = optimum(graph_of(pair, ours), values, ends)
    off = np.abs(wrapped(ours.poses.ravel() - theirs.mean)) / np.sqrt(np.diagonal(theirs.covariance))
    assert off.max() <= AGREED, off
    covariance, agreed = theirs.covariance, AGREED_COVARIANCE
    if (
        ours.level < 1.0
    ):  # it multiplies the part of white errors: the derivative by the log of their variance
        more = optimum_at(graph_of(pair, ours, MORE), theirs.values, ends).covariance
        covariance = covariance - (1.0 - ours.level) * (more - covariance) / (MORE - 1.0)
        agreed = (1.0 + AGREED) ** 2 - 1.0
    sigmas = np.sqrt(np.diagonal(covariance))
    off = np.abs(ours.covariance - covariance) / np.outer(sigmas, sigmas)
    assert off.max() <= agreed, off
    return theirs


@pytest.mark.parametrize("number", series([k for k in range(MISSIONS + 1) if k != SINGULAR], 5))
def test_the_fit_of_a_mission_is_gtsams_optimum_and_the_claim_came_of_it(number: int, tmp_path: Path) -> None:
    recorded(number, tmp_path)
    state, claimed = remembered(tmp_path, "a")
    pair = pair_of(state)
    for robot, path in zip("ab", pair.paths, strict=True):
        assert odometry_in(tmp_path, robot) == list(zip(path.v, path.omega, strict=True))
    rows = zip(kinds(pair), pair.ranges.tick, pair.ranges.rho, strict=True)
    assert ranges_in(tmp_path) == sorted(rows)
    ours = search(pair).hypotheses[0]
    theirs = assert_optimum(ours.fit, pair, number)
    assert ours.fit.chi2 == pytest.approx(2.0 * theirs.error, rel=1e-4)
    anchor = state.config.anchor
    stated = to_second_order(planning_hypothesis(ours), m2(pair))
    pose, covariance = astuple(localised(stated, 0, (anchor.x, anchor.y)))
    assert claimed.covariance is not None
    off = np.array(astuple(claimed.pose)) - np.array(astuple(pose))
    sigmas = (covariance.position_sigma, covariance.position_sigma, covariance.heading_sigma)
    assert np.all(np.abs(off) < AGREED * np.array(sigmas)), "it began at what the robot held, this one anew"
    assert claimed.covariance.xx == pytest.approx(covariance.xx, rel=AGREED_COVARIANCE)


@pytest.mark.long
@pytest.mark.parametrize("number", range(WINDOWS))
def test_the_estimate_of_a_recording_is_gtsams_optimum(number: int) -> None:
    window = (APART_S * number, APART_S * number + LENGTH_S)
    last = estimated(measurements(read_ranges(SAMPLE), None, PROFILE, window), ClaimRule()).epochs[-1]
    assert last.fitted is not None
    assert last.fitted.fit.level < 1.0
    assert_optimum(last.fitted.fit, last.fitted.used, number)
