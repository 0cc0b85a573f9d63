"""The kernel of a fit and elementary functions do what their texts say, to the bit, on every machine."""

from __future__ import annotations

import ast
import math
import os
import subprocess
import sys
from collections.abc import Sequence
from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from numpy.typing import NDArray

import agent
from agent.estimation import elementary, gauss_newton, smoother
from agent.estimation.compiled import address, library
from agent.estimation.fit import Start, fits
from agent.estimation.gauss_newton import Convergence, Fitted, Point, point_at
from agent.estimation.gaussian.joint_ranges import PosePrior
from agent.estimation.gaussian.measured_rows import near_anchors
from agent.estimation.gaussian.odometry_noise import track
from agent.estimation.kernel import Kernel
from agent.estimation.problem import Problem
from agent.estimation.smoother import LARGEST_TURN, Array, Measured, Singular, Walk, effect_of
from protocol.motion import Pose, step
from protocol.noise import Noise, VelocityNoise
from tests.moving_groups import NOISE, PERIOD_S, joint_measurements, moving_group


def problem_of(
    seed: int,
    robots: int,
    ticks: int,
    *,
    slow: float,
    survey: float,
    prior: bool,
    delay: float = 0.0,
    depth: float = 0.0,
    strays: float = 0.0,
) -> Problem:
    """Return the problem of a random group: with slow and surveying errors, a prior, a delay and strays.

    `depth` is the prior of the share of depth in all ranges.
    """
    errors = {"slow_sigma": slow, "survey_error": survey, "range_delay": delay, "range_depth": depth}
    noise = replace(NOISE, odometry_strays=strays, **errors)
    measured = joint_measurements(moving_group(robots, seed, ticks=ticks, noise=noise).facts, noise, PERIOD_S)
    if prior:
        root = np.random.default_rng(seed).normal(size=(3 * robots, 3 * robots))
        about = PosePrior(np.zeros((robots, 3)), root @ root.T, 3 * robots)
        measured = replace(measured, prior=about)
    return Problem.of(measured)


def point_of(of: Measured, seed: int) -> tuple[Array, Array, Array]:
    """Return start poses, constant errors and white errors at random."""
    rng = np.random.default_rng(seed)
    white = np.sqrt(of.white) * rng.normal(size=of.white.shape)
    return rng.uniform(-5.0, 5.0, 3 * of.robots), rng.normal(size=of.patterns.shape[:2]), white


@settings(max_examples=12, deadline=None)
@given(
    st.integers(0, 10**6),
    st.integers(1, 3),
    st.integers(1, 7),
    st.sampled_from([0.0, 0.08]),
    st.sampled_from([0.0, 0.1]),
    st.booleans(),
    st.sampled_from([1e-3, 1.0, 1e9]),
    st.sampled_from([-1, 1]),
    st.sampled_from([0.0, 0.2]),
    st.sampled_from([0.0, 0.5]),
    st.sampled_from([0.0, 0.1]),
)
def test_the_kernel_equals_its_text_to_the_bit(
    seed: int,
    robots: int,
    ticks: int,
    slow: float,
    survey: float,
    prior: bool,
    largest: float,
    scaled: int,
    delay: float,
    depth: float,
    strays: float,
) -> None:
    given_errors = {"slow": slow, "survey": survey, "delay": delay, "depth": depth, "strays": strays}
    problem = problem_of(seed, robots, ticks, prior=prior, **given_errors)
    of, variance = problem.measured._replace(scaled=scaled), np.square(problem.weighing.sigma)
    of.radio[::3] = -1
    of.common[::4] = 0.0
    poses, constant, white = point_of(of, seed)
    kernel = Kernel(of, problem.weighing)
    at = (poses, constant, white, (1.7, -0.8))
    walk, text = kernel.walked(*at), smoother.walked(of, *at)
    for one, other in zip(walk, text, strict=True):
        assert one.tobytes() == other.tobytes()
    given = (walk, poses, variance, 1e-12, largest)
    for name, one in kernel.step(*given)._asdict().items():
        expected = getattr(smoother.step(of, *given), name)
        assert np.asarray(one).tobytes() == np.asarray(expected).tobytes(), name


# --- a step, by the solution for all unknowns at once -----------------------------------------------------

TINY = 1e-5
"""The step of a numerical derivative, in m, rad and their rates."""


def start_of(of: Measured, guess: Array) -> Array:
    """Return the start poses with these pivots in the robots' frames, and headings; see `Kernel.guess`."""
    poses = guess.copy()
    for i, pivot in enumerate(of.pivot):
        c, s = np.cos(guess[3 * i + 2]), np.sin(guess[3 * i + 2])
        poses[3 * i : 3 * i + 2] = pivot - np.array(((c, -s), (s, c))) @ guess[3 * i : 3 * i + 2]
    return poses


def derivatives(
    kernel: Kernel, at: Sequence[Array], deep: Sequence[float]
) -> tuple[list[Array], list[Array]]:
    """Return those of the ranges and of the last poses, by start poses, constant and white errors.

    `at` are the guess of the poses, and the errors; `deep` are the shares of depth.
    """
    of, here = kernel.of, np.concatenate([one.ravel() for one in at])
    parts = np.cumsum([one.size for one in at])[:-1]

    def predicted(unknowns: Array) -> Array:
        guess, constant, white = np.split(unknowns, parts)
        errors = constant.reshape(at[1].shape), white.reshape(at[2].shape)
        walk = kernel.walked(start_of(of, guess), *errors, deep)
        distances = of.rho - walk.residual
        if of.deep >= 0:
            shares = of.common[:, of.deep :] * deep
            distances = distances + shares[:, 0] * walk.to_depth + shares[:, 1] * walk.aside
        return np.concatenate((distances, walk.place[:, -1].ravel()))

    sides = [predicted(here + one) - predicted(here - one) for one in TINY * np.eye(len(here))]
    both = np.stack(sides, -1) / (2.0 * TINY)
    return np.split(both[: len(of.rho)], parts, axis=1), np.split(both[len(of.rho) :], parts, axis=1)


def common_effects(of: Measured, walk: Walk) -> Array:
    """Return the effects (m) of one sigma of each constant error on the ranges; shape (N, c)."""
    effects = of.common.copy()
    if of.scaled >= 0:
        predicted = of.scale * (of.rho - walk.residual)
        effects[:, of.scaled] = np.where(of.common[:, of.scaled] == 0.0, 0.0, predicted)
    if of.delayed >= 0:
        effects[:, of.delayed] = -of.common[:, of.delayed] * walk.rate
    if of.deep >= 0:
        effects[:, of.deep :] = of.common[:, of.deep :] * np.stack((walk.to_depth, walk.aside), -1)
    return effects


def slow_covariance(of: Measured) -> Array:
    """Return the covariance (m^2) of the slow errors of all ranges; shape (N, N)."""
    tick = np.searchsorted(of.begin, np.arange(len(of.rho)), side="right") - 1
    alike = (of.radio[:, None] == of.radio) & (of.radio >= 0) & (of.radios > 0)
    return np.asarray(alike * of.slow * of.decay ** np.abs(tick[:, None] - tick))


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 10**6),
    st.integers(1, 3),
    st.integers(4, 9),
    st.sampled_from([0.0, 0.08]),
    st.sampled_from([0.0, 0.1]),
    st.booleans(),
    st.sampled_from([-1, 1]),
    st.sampled_from([0.0, 0.2]),
    st.sampled_from([0.0, 0.5]),
    st.sampled_from([0.3, 1e9]),
)
def test_a_step_is_the_solution_for_all_unknowns_at_once(
    seed: int,
    robots: int,
    ticks: int,
    slow: float,
    survey: float,
    prior: bool,
    scaled: int,
    delay: float,
    depth: float,
    largest: float,
) -> None:
    """It has no filter and no backward pass: white and slow errors are a dense covariance of the ranges."""
    errors = {"slow": slow, "survey": survey, "delay": delay, "depth": depth, "strays": 0.05}
    problem = problem_of(seed, robots, ticks, prior=prior, **errors)
    of, variance = problem.measured._replace(scaled=scaled), np.square(problem.weighing.sigma)
    assume(not np.isnan(of.pivot).any())
    of.radio[::3] = -1
    n3, count, deep = 3 * of.robots, len(of.rho), (0.7, -0.4)
    kernel, (poses, constant, white) = Kernel(of, problem.weighing), point_of(of, seed)
    walk = kernel.walked(poses, constant, white, deep)
    assume(float(np.min(of.rho - walk.residual)) > 0.2)
    at = kernel.guess(poses), constant, white
    (by_start, by_constant, by_white), last_by = derivatives(kernel, at, deep)
    effects, noise = common_effects(of, walk), np.diag(of.white.ravel())
    of_slow = slow_covariance(of)
    covariance = np.diag(variance) + of_slow + by_white @ noise @ by_white.T
    inverse, by_unknown = np.linalg.inv(covariance), np.hstack((by_start, effects, by_constant))
    basis = np.stack([(start_of(of, at[0] + e) - start_of(of, at[0] - e)) for e in TINY * np.eye(n3)], -1)
    basis /= 2.0 * TINY
    information = by_unknown.T @ inverse @ by_unknown
    information[:n3, :n3] += basis.T @ of.information @ basis
    information[n3:, n3:] += np.eye(len(information) - n3)
    assume(np.linalg.cond(information) < 1e7)
    step = kernel.step(walk, poses, variance, 0.0, largest)
    # the errors of the odometry are relative to 0, the poses to the point
    left = walk.residual + by_constant @ constant.ravel() + by_white @ white.ravel()
    gradient, weighted, spread = (
        by_unknown.T @ inverse @ left,
        inverse @ by_unknown,
        np.linalg.inv(information),
    )
    gradient[:n3] += basis.T @ of.information @ (of.mean - poses)
    change = spread @ gradient
    misfit = inverse @ (left - by_unknown @ change)

    def near(expected: NDArray[np.floating]) -> object:
        return pytest.approx(
            expected, rel=1e-4, abs=1e-5 * max(1.0, float(np.abs(expected).max(initial=0.0)))
        )

    assert step.change == near(change)
    assert step.inverse == near(spread)
    assert step.multipliers == near(misfit)
    assert step.alone == near(np.diagonal(inverse))
    assert step.explained == near(np.einsum("ja,ab,jb->j", weighted, spread, weighted))
    off = of.mean - poses - basis @ change[:n3]
    chi2 = misfit @ covariance @ misfit + change[n3:] @ change[n3:] + off @ of.information @ off
    assert step.chi2 == pytest.approx(chi2, rel=1e-4, abs=1e-6)
    determinants = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(information)[1]
    assert step.volume == pytest.approx(determinants, rel=1e-4, abs=1e-3)
    assert step.of_start == pytest.approx(np.linalg.slogdet(spread[:n3, :n3])[1], rel=1e-4, abs=1e-3)
    length = change[:n3] @ np.linalg.solve(spread[:n3, :n3], change[:n3])
    assert step.length == pytest.approx(math.sqrt(length), rel=1e-4)
    # the limited step, with the best constant errors beside it
    shares = np.abs(change[:n3]) / np.tile((largest, largest, LARGEST_TURN), of.robots)
    limited = change[:n3] / max(1.0, float(shares.max()))
    beside = np.linalg.solve(information[n3:, n3:], gradient[n3:] - information[n3:, :n3] @ limited)
    assert step.limited == near(np.concatenate((limited, beside)))
    own = inverse @ (left - by_unknown @ step.limited)
    assert step.own == near(own)
    assert step.white.ravel() == near(noise @ by_white.T @ own)
    assert step.slow == near(of_slow @ own)
    # what all data tell of the errors in a tick
    remaining = inverse - weighted @ spread @ weighted.T
    by_ticks = by_white.reshape(count, of.robots, 2, of.ticks)
    for i, k in np.ndindex(of.robots, of.ticks):
        both = by_ticks[:, i, :, k]
        (vv, mixed), (_, omega) = both.T @ remaining @ both
        assert step.shocks[i, k] == near(np.array((*(both.T @ misfit), vv, mixed, omega)))
    # the last poses, with the errors of surveying, which are considered
    attributed = last_by[2] @ noise @ by_white.T @ inverse
    last = np.hstack((last_by[0], np.zeros((n3, effects.shape[1])), last_by[1])) - attributed @ by_unknown
    surveyed = np.zeros((count, 2 * of.anchors))
    for j in np.flatnonzero(of.anchor >= 0):
        surveyed[j, 2 * of.anchor[j] : 2 * of.anchor[j] + 2] = of.survey * walk.direction[j]
    by_survey = (attributed + last @ spread @ weighted.T) @ surveyed
    known = noise - noise @ by_white.T @ inverse @ by_white @ noise
    expected = last @ spread @ last.T + last_by[2] @ known @ last_by[2].T + by_survey @ by_survey.T
    assert step.ends == near(expected)


def bits(of: Fitted | Point | tuple[object, ...]) -> list[bytes]:
    """Return all numbers of a fit."""
    return [b for one in of for b in (bits(one) if isinstance(one, tuple) else [np.asarray(one).tobytes()])]


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 10**6),
    st.integers(1, 2),
    st.sampled_from([0.0, 0.08]),
    st.booleans(),
    st.booleans(),
    st.sampled_from([(0.0, 0.0), (0.2, 0.0), (0.0, 1e-3), (0.2, 1e-3)]),
    st.sampled_from([0.0, 4.0]),
    st.sampled_from([Convergence(), Convergence(2, 0.05, 0.1), Convergence(0)]),
    st.booleans(),
    st.sampled_from([0.0, 0.2]),
)
def test_the_loop_of_a_fit_equals_its_text_to_the_bit(
    seed: int,
    robots: int,
    slow: float,
    delayed: bool,
    deep: bool,
    shares: tuple[float, float],
    degrees: float,
    until: Convergence,
    weighed: bool,
    odometry_strays: float,
) -> None:
    noise = replace(
        NOISE,
        slow_sigma=slow,
        range_delay=0.2 * delayed,
        range_depth=0.5 * deep,
        outliers=shares[0],
        strays=shares[1],
        sigma_degrees=degrees,
        odometry_strays=odometry_strays,
    )
    group = moving_group(robots, seed, ticks=7, noise=noise)
    measured = joint_measurements(group.facts, noise, PERIOD_S)
    problem = Problem.of(measured)
    of, by, rng = problem.measured, problem.weighing, np.random.default_rng(seed)
    by.holding[-1] = 1
    of.radio[-1] = -1
    kernel = Kernel(of, by)
    poses = (group.starts - (*measured.origin, 0.0)).ravel() + rng.normal(size=3 * robots)
    _, constant, white = point_of(of, seed)
    nothing, zero = np.zeros(len(of.rho)), np.zeros(of.common.shape[1])
    white[:, 1, 1::3] += 0.4 * (rng.uniform(size=of.v[:, 1::3].shape) < odometry_strays)
    begun = point_at(of, poses, zero, constant, white, nothing, nothing)
    weights = rng.uniform(size=len(of.rho))
    given = weights if weighed else None
    for found, text in (
        (
            partial(kernel.fitted, poses, constant, white, given, until),
            partial(gauss_newton.fitted, of, by, begun, given, until),
        ),
        (
            partial(kernel.held, poses, constant, white, weights, 3),
            partial(gauss_newton.held, of, by, begun, weights, 3),
        ),
    ):
        try:
            expected = text()
        except Singular:
            with pytest.raises(Singular):
                found()
            continue
        for name, one in found()._asdict().items():
            assert bits((one,)) == bits((getattr(expected, name),)), name
    assert kernel.guess(poses).tobytes() == gauss_newton.guess(of, poses).tobytes()


def test_fits_with_the_sizes_of_missions_equal_their_text_to_the_bit() -> None:
    noise = Noise(
        anchor_sigma=0.1, mutual_sigma=0.1, outliers=0.05, odometry=VelocityNoise(0.01, 0.01, 0.0, 0.0)
    )
    turns = np.sin(np.arange(9.0))
    paths = [track(np.full(9, 0.4), turn * turns, 1.0) for turn in (0.7, -0.9)]
    own = [[(tick, 1.0 + 0.1 * tick + 0.05 * (tick % 3)) for tick in range(robot, 9)] for robot in (0, 1)]
    pair = near_anchors(
        paths, own, ((0.0, 0.0), (3.0, 0.0)), noise, 3.0, [(tick, 1.5) for tick in range(2, 10)]
    )
    for measured, sizes in ((pair, (2, 5, 3)), (pair.alone(1), (1, 3, 3))):
        problem = Problem.of(measured)
        of, by, kernel = problem.measured, problem.weighing, problem.kernel
        assert (of.robots, of.common.shape[1], of.patterns.shape[1]) == sizes
        poses, constant, white = np.arange(1.0, 1.0 + 3 * of.robots), *point_of(of, 3)[1:]
        nothing = np.zeros(len(of.rho))
        begun = point_at(of, poses, np.zeros(sizes[1]), constant, white, nothing, nothing)
        expected = gauss_newton.fitted(of, by, begun, None, Convergence())
        assert bits(kernel.fitted(poses, constant, white, None, Convergence())) == bits(expected)


def test_the_effect_of_a_delay_is_the_derivative_of_the_ranges_by_it() -> None:
    problem, small = problem_of(5, 3, 6, slow=0.0, survey=0.0, prior=False, delay=0.2), 1e-6
    of = problem.measured
    of.common[1] = 0.0
    walk = problem.kernel.walked(*point_of(of, 5))
    v, omega = of.v + walk.moves[..., 6], of.omega + walk.moves[..., 7]

    def late(i: int, k: int, delay: float) -> Array:
        pose = step(Pose(*walk.place[i, k]), -v[i, k - 1], -omega[i, k - 1], delay)
        return np.array((pose.x, pose.y))

    def distance(j: int, k: int, delay: float) -> float:
        other = late(of.second[j], k, delay) if of.second[j] >= 0 else of.place[j]
        return float(np.hypot(*(late(of.first[j], k, delay) - other)))

    ticks = np.searchsorted(of.begin, np.arange(len(of.rho)), side="right") - 1
    slopes = [(distance(j, k, small) - distance(j, k, -small)) / (2.0 * small) for j, k in enumerate(ticks)]
    expected = 0.2 * np.array(slopes) * (ticks > 0)  # robots were at rest before
    expected[1] = 0.0
    effects = [effect_of(of, walk, j, of.delayed) for j in range(len(ticks))]
    np.testing.assert_allclose(effects, expected, atol=1e-7)
    assert np.ptp(expected) > 0.05


@pytest.mark.parametrize(("prior", "size", "most"), [("range_delay", 0.3, 0.3), ("range_depth", 0.15, 0.1)])
def test_a_delay_and_the_share_of_depth_are_estimated_within_their_sigma_whoever_has_measured(
    prior: str, size: float, most: float
) -> None:
    noise, off = replace(NOISE, **{prior: size}), []
    for seed in range(20):
        group = moving_group(2, seed, ticks=60, noise=noise)
        measured = joint_measurements(group.facts, noise, PERIOD_S)
        assert 0 < np.count_nonzero(measured.ranges.by_second) < len(measured.ranges.rho)
        starts = group.starts.copy()
        starts[:, :2] -= measured.origin
        (fit,) = fits(measured, [Start(starts)])
        of, delays = fit.problem.measured, prior == "range_delay"
        column, true = (of.delayed, group.delay) if delays else (of.deep, group.share)
        assert fit.constant_sigmas[column] < most
        off.append((true / size - fit.constants[column]) / fit.constant_sigmas[column])
    assert max(map(abs, off)) < 4.0
    assert 6.0 < np.sum(np.square(off)) < 42.0  # chi-square of 20 degrees of freedom: 0.2 and 99.7 %


def test_each_range_is_weighed_by_the_prediction_from_all_others() -> None:
    problem = problem_of(3, 2, 5, slow=0.05, survey=0.0, prior=False)
    of = problem.measured
    poses, constant, white = point_of(of, 3)
    kernel, variance = problem.kernel, np.square(problem.weighing.sigma)
    walk = kernel.walked(poses, constant, white)
    step = kernel.step(walk, poses, variance, 0.0, np.inf)
    for j in (0, 4, len(variance) - 1):
        without = variance.copy()
        without[j] = 1e12
        alone = kernel.step(walk, poses, without, 0.0, np.inf)
        error = step.multipliers[j] / (step.alone[j] - step.explained[j])
        assert error == pytest.approx(1e12 * alone.multipliers[j], rel=1e-4)


def test_the_estimator_without_memory_raises_memory_error() -> None:
    """No machine has the memory for these numbers of ranges, guesses and ticks."""
    many, none = 1 << 50, address(np.zeros(0))
    problem = problem_of(1, 1, 4, slow=0.0, survey=0.0, prior=False)
    poses, constants, white = point_of(problem.measured, 1)
    kernel = Kernel(problem.measured, problem.weighing)
    walk = kernel.walked(poses, constants, white)
    kernel._measured._obj.ranges = many  # type: ignore[attr-defined]
    ticks = address(np.array([[0, -1, 1, many]]))
    for without in (
        lambda: kernel.step(walk, poses, np.ones(1), 0.0, 1.0),
        lambda: kernel.fitted(poses, constants, white, None, Convergence(1, 1e-3, 0.0)),
        lambda: library().anchor_guesses(
            *(many, none, none, none, none, none, 0, none, none, 0, 1, none, 1.0, 1.0, 1.0, 1, none)
        ),
        lambda: library().placements(
            *(2, 1, *[none] * 11, 0, none, many, 1, none, none, 1.0, 1.0, 1, 1.0, 1.0, 1.0, 1, none)
        ),
        lambda: library().detections(none, 1, ticks, none, 1, 1, none, none, none, 1.0, none, 3, none),
    ):
        with pytest.raises(MemoryError, match="no memory"):
            without()


def test_ranges_that_determine_no_pose_are_singular() -> None:
    measured = joint_measurements(moving_group(1, 1, ticks=3).facts, NOISE, PERIOD_S).until(0)
    problem = Problem.of(measured)
    kernel = problem.kernel
    poses, constant, white = point_of(problem.measured, 1)
    with pytest.raises(Singular, match="do not determine"):
        kernel.step(kernel.walked(poses, constant, white), poses, np.square(problem.weighing.sigma), 0.0, 1.0)


def test_a_fit_in_which_rounding_leaves_no_variance_is_singular_and_is_left_out() -> None:
    measured = joint_measurements(moving_group(2, 1, ticks=5).facts, NOISE, PERIOD_S)
    problem = Problem.of(measured)
    of = problem.measured
    for white in (1e308, np.nan):
        wide = of._replace(white=np.full(of.white.shape, white))
        kernel, poses = Kernel(wide, problem.weighing), np.zeros(6)
        walk = kernel.walked(poses, np.zeros(wide.patterns.shape[:2]), np.zeros(of.white.shape))
        given = (walk, poses, np.full(len(of.rho), 0.01), 1e-12, 1.0)
        for one_step in (kernel.step, partial(smoother.step, wide)):
            with pytest.raises(Singular), np.errstate(all="ignore"):
                one_step(*given)
    paths = tuple([path._replace(extra=np.full((2, 5), np.nan)) for path in measured.paths])
    assert fits(replace(measured, paths=paths), [Start(np.zeros((2, 3)))]) == []


def test_many_ranges_are_scaled_by_the_predicted_ones_which_noise_does_not_change() -> None:
    """By the measured ranges, whose sigma is 0.5 m, the scale would be 9 % in the mean; it is exact."""
    noise = replace(
        NOISE, anchor_sigma=0.5, mutual_sigma=0.5, range_scale=0.05, range_bias=0.0, pair_bias=0.0
    )
    scales = []
    for seed in range(6):
        group = moving_group(2, seed, ticks=200, noise=noise)
        measured = joint_measurements(group.facts, noise, PERIOD_S)
        starts = group.starts.copy()
        starts[:, :2] -= measured.origin
        (fit,) = fits(measured, [Start(starts)])
        scales.append(0.05 * fit.constants[0])
    assert abs(np.mean(scales)) < 0.05  # two standard deviations of the mean


def test_a_pair_of_radios_without_a_range_is_no_part_of_a_fit() -> None:
    noise = replace(NOISE, slow_sigma=0.05)
    measured = joint_measurements(moving_group(2, 1, ticks=5, noise=noise).facts, noise, PERIOD_S)
    sparse = replace(measured, ranges=replace(measured.ranges, radio=10**6 * measured.ranges.radio))
    one, other = Problem.of(measured).measured, Problem.of(sparse).measured
    assert one.radios == other.radios == len(measured.ranges.pairs)
    np.testing.assert_array_equal(one.radio, other.radio)


Matrix = list[list[float]]
NUMPY_ALONE = {
    *("linalg", "exp", "log", "log1p", "expm1", "log10", "log2", "power", "logaddexp", "hypot", "sinc"),
    *("cos", "sin", "tan", "arccos", "arcsin", "arctan", "arctan2", "tanh"),
    *("dot", "vdot", "inner", "matmul", "tensordot", "einsum", "convolve", "polyfit"),
}
"""The functions of numpy whose last bits differ between its versions, libraries or processors."""
TEXTS = {"smoother.py", "gauss_newton.py"}
"""The modules that no mission calls: the texts of the kernel."""

numbers = st.floats(-1e3, 1e3, allow_subnormal=False)
matrices = st.integers(1, 6).flatmap(
    lambda n: st.lists(st.lists(st.floats(-10.0, 10.0), min_size=n, max_size=n), min_size=n, max_size=n)
)


def test_the_estimator_and_active_sensing_call_no_function_of_numpy_whose_bits_differ() -> None:
    folder = Path(agent.__file__).parent
    modules = [*folder.glob("estimation/**/*.py"), *folder.glob("planning/*.py")]
    exact = {"separation.py", "phase3_last_manoeuvre.py"}  # of exact sensors, which the kernel does not serve
    found = [
        f"{module.name}: {ast.unparse(node)}"
        for module in modules
        if module.name not in TEXTS | exact
        for node in ast.walk(ast.parse(module.read_text()))
        if _differs(node)
    ]
    assert len(modules) > 60
    assert found == []


def _differs(node: ast.AST) -> bool:
    match node:
        case ast.BinOp(op=ast.MatMult()):
            return True
        case ast.Attribute(value=ast.Name("np"), attr=name):
            return name in NUMPY_ALONE
        case _:
            return False


@given(st.lists(numbers, min_size=1, max_size=9))
def test_each_function_is_that_of_the_c_library(values: list[float]) -> None:
    x = np.array(values)
    for name in ("exp", "cos", "sin", "tan"):
        of_each = [getattr(math, name)(min(value, 700.0)) for value in values]
        assert getattr(elementary, name)(np.minimum(x, 700.0)).tolist() == of_each
    assert elementary.log(np.abs(x) + 1.0).tolist() == [math.log(abs(value) + 1.0) for value in values]
    both = elementary.logaddexp(x, x[::-1])
    assert np.allclose(both, np.logaddexp(x, x[::-1]), rtol=1e-14)


@given(matrices, st.integers(1, 3), st.integers(0, 10**6))
def test_a_product_sums_in_the_order_of_the_columns(rows: Matrix, columns: int, seed: int) -> None:
    left = np.array(rows)
    right = np.random.default_rng(seed).normal(size=(2, len(rows), columns))
    found = elementary.product(left, right)
    for one, product in zip(right, found, strict=True):
        for a, row in enumerate(rows):
            for c in range(columns):
                total = 0.0
                for factor, other in zip(row, one[:, c].tolist(), strict=True):
                    total += factor * other
                assert product[a, c] == total
    assert np.array_equal(elementary.product(right.mT, left.T), found.mT)
    assert elementary.quadratic(left, left[0]) == pytest.approx(float(left[0] @ left @ left[0]))


@given(matrices)
def test_a_solution_is_that_of_exact_fractions(rows: Matrix) -> None:
    matrix, right = np.array(rows) + 40.0 * np.eye(len(rows)), np.arange(1.0, len(rows) + 1.0)[:, None]
    found = elementary.solve(matrix, right)
    exact = _solved([[Fraction(value) for value in row] for row in matrix.tolist()], right[:, 0].tolist())
    assert found[:, 0].tolist() == pytest.approx([float(value) for value in exact], rel=1e-10, abs=1e-12)
    several = elementary.solve(np.stack((matrix, matrix.T)), np.stack((right, right)))
    assert np.array_equal(several[0], found)
    assert np.allclose(elementary.inverted(matrix) @ matrix, np.eye(len(rows)), atol=1e-10)


def _solved(rows: list[list[Fraction]], right: list[float]) -> list[Fraction]:
    """Return the exact solution by Gauss-Jordan elimination."""
    augmented = [[*row, Fraction(value)] for row, value in zip(rows, right, strict=True)]
    for a in range(len(rows)):
        pivot = next(b for b in range(a, len(rows)) if augmented[b][a])
        augmented[a], augmented[pivot] = augmented[pivot], augmented[a]
        augmented[a] = [value / augmented[a][a] for value in augmented[a]]
        for b in range(len(rows)):
            if b != a:
                factor = augmented[b][a]
                augmented[b] = [x - factor * y for x, y in zip(augmented[b], augmented[a], strict=True)]
    return [row[-1] for row in augmented]


@pytest.mark.parametrize("matrix", [np.zeros((2, 2)), np.ones((3, 3)), np.array([[math.nan]])])
def test_a_singular_matrix_has_no_solution(matrix: Array) -> None:
    with pytest.raises(Singular):
        elementary.solve(matrix, np.ones((len(matrix), 1)))


@given(matrices)
def test_eigenvectors_make_the_matrix_again_and_are_orthogonal(rows: Matrix) -> None:
    matrix = np.array(rows) + np.array(rows).T
    values, vectors = elementary.eigh(matrix)
    size = max(float(np.max(np.abs(matrix))), 1e-12)
    assert np.allclose(vectors * values @ vectors.T, matrix, atol=1e-12 * size)
    assert np.allclose(vectors.T @ vectors, np.eye(len(rows)), atol=1e-12)
    assert np.all(np.diff(values) >= 0.0)
    assert np.allclose(values, np.linalg.eigvalsh(matrix), atol=1e-12 * size)


DECISIONS = """
import tandem
from tests.expected.playing import decisions
print(*[decisions(tandem.run("noisy", seed=seed).model) for seed in range(1, 5)])
"""


@pytest.mark.long
def test_noisy_missions_are_the_same_to_the_bit_with_the_linear_algebra_of_another_processor() -> None:
    def decided(**changed: str) -> str:
        command = [sys.executable, "-c", DECISIONS]
        ended = subprocess.run(
            command, env={**os.environ, **changed}, capture_output=True, text=True, check=True, timeout=120
        )
        return ended.stdout

    here = decided()
    assert len(here.split()) == 4
    assert decided(OPENBLAS_CORETYPE="Prescott") == here
    assert decided(NPY_DISABLE_CPU_FEATURES="X86_V4 X86_V3 AVX512_SKX AVX2 FMA3") == here
