"""Strays of the odometry: told to the robots, and weighed by the fit."""

from __future__ import annotations

import math

import numpy as np
from msgspec.structs import replace

from agent.estimation.fit import Fit, Start, fits
from agent.estimation.gaussian.consistency import FINISHED
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from compose.recording.estimating.noise_files import AssumedNoise
from protocol.motion import wrap
from protocol.noise import Noise
from tests.moving_groups import NOISE, PERIOD_S, MovingGroup, joint_measurements, moving_group

SHARE = 0.05


def measured(group: MovingGroup, told: float) -> JointMeasurements:
    return joint_measurements(group.facts, replace(NOISE, odometry_strays=told), PERIOD_S)


def fit_of(group: MovingGroup, of: JointMeasurements) -> Fit:
    starts = group.starts.copy()
    starts[:, :2] -= of.origin
    (fit,) = fits(of, [Start(starts)])
    return fit


def ended(seed: int, simulated: float, told: float) -> tuple[list[float], float]:
    """Return the NEES of two robots after 60 ticks, and the root of the trace of their covariance."""
    group = moving_group(2, seed, ticks=60, noise=replace(NOISE, odometry_strays=simulated))
    of = measured(group, told)
    fit = fit_of(group, of)
    off = fit.poses - (group.ends - (*of.origin, 0.0))
    off[:, 2] = [wrap(one) for one in off[:, 2]]
    own = [fit.covariance[k : k + 3, k : k + 3] for k in (0, 3)]
    nees = [float(one @ np.linalg.solve(c, one)) for one, c in zip(off, own, strict=True)]
    assert fit.last_step < FINISHED
    return nees, math.sqrt(np.trace(fit.covariance))


def test_pairs_with_strays_know_their_poses_within_their_sigmas_only_if_they_are_told() -> None:
    untold, told = (np.array([ended(seed, SHARE, one)[0] for seed in range(60)]) for one in (0.0, SHARE))
    assert np.mean(untold) > 5.5
    assert np.mean(told) < 4.3
    beyond = 16.27  # 0.1 % of chi-square
    assert np.mean(told > beyond) <= 0.01
    assert np.mean(untold > beyond) > 0.05


def test_pairs_that_are_told_of_strays_and_have_none_are_about_as_sure() -> None:
    untold, told = ([ended(seed, 0.0, one) for seed in range(40)] for one in (0.0, 0.02))
    assert 2.0 < np.mean([nees for nees, _ in told]) < 3.3
    assert 1.0 < np.mean([sigma for _, sigma in told]) / np.mean([sigma for _, sigma in untold]) < 1.06


def test_a_stray_has_the_noise_of_one_about_its_tick_and_nowhere_else() -> None:
    group = moving_group(2, 3, ticks=60)
    of = measured(group, 0.02)
    omega = of.paths[0].omega.copy()
    omega[25] += 0.3
    strange = replace(of, paths=(of.paths[0]._replace(omega=omega), of.paths[1]))
    fit = fit_of(group, strange)
    kernel = fit.linear.kernel.of
    share = (kernel.white - fit.problem.measured.white)[:, 1] / (kernel.stray - fit.problem.measured.white)[
        :, 1
    ]
    robot, tick = np.nonzero(share > 0.3)
    assert set(robot) == {0}
    assert np.all(np.abs(tick - 25) <= 1), "a neighbour explains the same ranges"
    assert abs(np.sum(fit.start.errors[0].omega[22:29]) + 0.3) < 0.1
    (blind,) = fits(replace(strange, noise=NOISE), [Start(fit.start.poses)])
    assert fit.weight > blind.weight + 5.0, "the evidence contains the strays"


def test_without_a_prior_nothing_is_computed_of_strays() -> None:
    group = moving_group(2, 1)
    fit = fit_of(group, measured(group, 0.0))
    assert fit.linear.step.shocks.size == 0
    assert fit.linear.kernel is fit.problem.kernel


def test_strays_are_noise() -> None:
    assert not Noise(odometry_strays=0.01).exact
    assert Noise(odometry_strays=0.01).as_told.exact


def test_the_rate_of_a_recording_is_that_of_its_increments_whatever_the_step_of_a_fit() -> None:
    assumed = AssumedNoise("told", Noise(odometry_strays=0.04))
    assert assumed.of_fit(4.0).odometry_strays == 0.01
    assert assumed.of_fit(0.5).odometry_strays == 0.04
