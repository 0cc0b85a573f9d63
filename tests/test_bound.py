"""The Cramér-Rao bound of a driven trajectory equals the Fisher information's, and claims are as wide."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import geometric_mean

import numpy as np
import pytest
from msgspec.structs import replace

from agent.estimation.gaussian.odometry_noise import Array
from compose.recording.cramer_rao import position_bounds
from compose.recording.run import Run
from compose.recording.summary_json import summary
from protocol.motion import Controls, Pose, step
from protocol.noise import Noise
from tests.surveys import ODOMETRY, SIGMA, WHEELS, survey
from world.sensors import executed

PAIR = (0, 1)
SEEDS = range(4, 9)


def bounds(recording: Run, tick: int | None = None) -> tuple[float, float]:
    found = position_bounds(recording, PAIR, recording.ticks[-1].truth.tick if tick is None else tick)
    assert found is not None
    return found


def with_noise(recording: Run, noise: Noise) -> Run:
    """Return the same trajectories, with the noise of other sensors."""
    scenario = recording.scenario
    mission = replace(scenario.mission, noise=noise)
    return Run(replace(recording.history, scenario=replace(scenario, mission=mission)))


def ends_and_ranges(recording: Run, starts: Sequence[float]) -> tuple[Array, Array]:
    """Return the final x, y of a and b and all true ranges, for other starts and the same commands."""
    scenario = recording.scenario
    poses = [[Pose(*starts[:3])], [Pose(*starts[3:])]]
    for moment in recording.ticks[:-1]:
        for path, robot in zip(poses, scenario.robots, strict=True):
            asked = moment.commands[robot.id]
            done = executed(Controls(asked.v, asked.omega), scenario, robot.id, moment.truth.tick)
            path.append(step(path[-1], done.v, done.omega, scenario.mission.period))
    reach, ranges = scenario.mission.sensing_range, []
    for moment, a, b in zip(recording.ticks, *poses, strict=True):
        true = moment.truth.poses
        (m1, m2) = (robot.anchor for robot in scenario.robots)
        for seen, now in (
            (math.hypot(true[0].x - m1.x, true[0].y - m1.y), math.hypot(a.x - m1.x, a.y - m1.y)),
            (math.hypot(true[1].x - m2.x, true[1].y - m2.y), math.hypot(b.x - m2.x, b.y - m2.y)),
            (math.hypot(true[0].x - true[1].x, true[0].y - true[1].y), math.hypot(a.x - b.x, a.y - b.y)),
        ):
            if seen <= reach:
                ranges.append(now)
    (a, b) = (path[-1] for path in poses)
    return np.array([a.x, a.y, b.x, b.y]), np.array(ranges)


def by_differences(recording: Run, sigma: float) -> tuple[float, float]:
    """Return the bound from the Fisher information of the six unknowns, by finite differences."""
    starts = np.array(
        [value for pose in recording.ticks[0].truth.poses for value in (pose.x, pose.y, pose.heading)]
    )
    ends, ranges = [], []
    for i in range(6):
        there = [
            ends_and_ranges(recording, list(starts + sign * 1e-5 * np.eye(6)[i])) for sign in (1.0, -1.0)
        ]
        ends.append((there[0][0] - there[1][0]) / 2e-5)
        ranges.append((there[0][1] - there[1][1]) / 2e-5)
    rows = np.array(ranges).T / sigma
    moved = np.array(ends).T
    covariance = moved @ np.linalg.inv(rows.T @ rows) @ moved.T
    a, b = (math.sqrt(covariance[i, i] + covariance[i + 1, i + 1]) for i in (0, 2))
    return a, b


@pytest.mark.long
def test_the_bound_is_that_of_the_fisher_information_of_all_ranges() -> None:
    for seed in SEEDS:
        recording = survey(SIGMA, seed)
        assert bounds(recording) == pytest.approx(by_differences(recording, 0.1), rel=1e-3)


@pytest.mark.long
def test_the_bound_shrinks_as_sigma_does() -> None:
    for seed in SEEDS:
        recording = survey(SIGMA, seed)
        at_first = bounds(recording)
        for part in (0.5, 0.1, 0.01):
            finer = with_noise(recording, Noise(0.1 * part, 0.1 * part))
            assert bounds(finer) == pytest.approx([part * one for one in at_first], rel=1e-3)


def test_the_bound_grows_with_the_odometrys_noise() -> None:
    recording = survey(SIGMA, 4)
    drifting = with_noise(recording, survey(f"{SIGMA}\n{ODOMETRY}", 4).scenario.mission.noise)
    assert all(one > other for one, other in zip(bounds(drifting), bounds(recording), strict=True))


@pytest.mark.parametrize("noise", [SIGMA, f"{SIGMA}\n{WHEELS}\n{ODOMETRY}"], ids=["ranges", "odometry"])
@pytest.mark.long
def test_claims_are_as_wide_as_the_bound(noise: str) -> None:
    """In the mean: the noise level, which robots learn from a dozen ranges, varies by a fifth."""
    ratios = []
    for seed in range(4, 16):
        recording = survey(noise, seed)
        robots = summary(recording, "in-process", None)["robots"]
        claimed = [robots[robot]["position_sigma_m"] for robot in ("a", "b")]
        ratios += [one / bound for one, bound in zip(claimed, bounds(recording), strict=True)]
    assert geometric_mean(ratios) == pytest.approx(1.0, abs=0.15)
    assert 0.5 < min(ratios) < max(ratios) < 2.0


def test_exact_sensors_and_outliers_have_no_bound() -> None:
    recording = survey(SIGMA, 4)
    for noise in (Noise(), Noise(0.1, 0.1, outliers=0.05)):
        assert position_bounds(with_noise(recording, noise), PAIR, 10) is None
