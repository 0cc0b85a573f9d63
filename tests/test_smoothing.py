"""Noisy paths and ranges, and the least-squares fit to both, compared with numerical differentiation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from numpy.typing import NDArray

from agent.estimation import smoother
from agent.estimation.fit import Fit, Start, deviation, fits, held_fits
from agent.estimation.gauss_newton import LAST_STEP, Convergence, moved
from agent.estimation.gaussian import joint_ranges
from agent.estimation.gaussian.beacon_guesses import start_of
from agent.estimation.gaussian.claim_rivals import FAR_ANCHOR, _holding
from agent.estimation.gaussian.consistency import FINISHED
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.measured_rows import near_anchors
from agent.estimation.gaussian.odometry_noise import (
    Track,
    effect_covariance,
    pose_effects,
    position_variances,
    track,
)
from agent.estimation.gaussian.range_model import SIGMA_FLOOR
from agent.estimation.problem import MOST_MEASURED_LENGTHS, Problem
from agent.estimation.smoother import dot, effect_of
from protocol.motion import ORIGIN, Pose, rotated, step
from protocol.noise import Noise, VelocityNoise
from tests.hypotheses_by_numpy import position_variances_by_numpy
from tests.pair_starts import alone, kinds, m2, pair_fit, pair_start, with_ranges

Array = NDArray[np.float64]

SMALL = 1e-5
"""The step of a numerical derivative."""

speeds = st.floats(-2.0, 2.0)
turns = st.one_of(st.floats(-4.0, 4.0), st.sampled_from((0.0, 1e-4, -1e-4)))
manoeuvres = st.lists(st.tuples(speeds, turns), min_size=1, max_size=8)
periods = st.floats(0.2, 2.0)
shares = st.floats(0.0, 0.1)
drifts = st.builds(VelocityNoise, shares, shares, shares, shares)
lengths = st.floats(-5.0, 5.0)
seeds = st.integers(0, 2**32 - 1)
some = settings(max_examples=50)
few = settings(max_examples=20)


def derivative(of: Callable[[Array], Array], at: Array) -> Array:
    """Return the derivative by central differences, of shape (rows, unknowns)."""
    sides = [(of(at + one) - of(at - one)) / (2.0 * SMALL) for one in SMALL * np.eye(len(at))]
    return np.stack(sides, -1)


def near(expected: Array) -> object:
    """Return an approximate comparison with the accuracy of numerical differences."""
    return pytest.approx(expected, rel=1e-6, abs=1e-7 * max(1.0, float(np.max(np.abs(expected)))))


def variances(drift: VelocityNoise, measured: Track) -> Array:
    """Return the variances of the noise in v at each tick, then of that in omega."""
    ticks = zip(measured.v.tolist(), measured.omega.tolist(), strict=True)
    return np.array([drift.variances(v, omega) for v, omega in ticks]).T.ravel()


# --- the path -----------------------------------------------------------------------------------------


def track_of(driven: list[tuple[float, float]], period: float) -> Track:
    v, omega = np.array(driven).T
    return track(v, omega, period)


@some
@given(manoeuvres, periods)
def test_a_track_is_where_the_steps_lead(driven: list[tuple[float, float]], period: float) -> None:
    path, poses = track_of(driven, period), [ORIGIN]
    for v, omega in driven:
        poses.append(step(poses[-1], v, omega, period))
    assert np.stack((path.x, path.y, path.heading), 1) == pytest.approx(
        np.array([(pose.x, pose.y, pose.heading) for pose in poses]), abs=1e-9
    )


@some
@given(manoeuvres, periods, st.data())
def test_a_pose_changes_with_the_odometry_as_its_effects_say(
    driven: list[tuple[float, float]], period: float, data: st.DataObject
) -> None:
    path, k = track_of(driven, period), len(driven)
    tick = data.draw(st.integers(0, k))
    since = data.draw(st.integers(0, tick))

    def pose(noise: Array) -> Array:
        other = track(path.v + noise[:k], path.omega + noise[k:], period)
        return np.array((other.x[tick], other.y[tick], other.heading[tick]))

    expected = derivative(pose, np.zeros(2 * k)).reshape(3, 2, k)
    expected[..., :since] = 0.0
    assert pose_effects(path, since, tick) == near(expected)


@some
@given(manoeuvres, periods, drifts, seeds)
def test_noise_of_the_odometry_spreads_along_the_path(
    driven: list[tuple[float, float]], period: float, drift: VelocityNoise, seed: int
) -> None:
    path, k = track_of(driven, period), len(driven)
    patterns, white = np.random.default_rng(seed).normal(size=(3, 2, k)), variances(drift, path)
    of_positions = position_variances(path, white.reshape(2, k), patterns)
    text = position_variances_by_numpy(path, white.reshape(2, k), patterns)
    assert of_positions.tobytes() == text.tobytes()
    for tick in range(k + 1):
        effects = pose_effects(path, 0, tick)
        by_noise, by_constant = effects.reshape(3, 2 * k), np.einsum("mek,iek->im", patterns, effects)
        expected = by_noise @ np.diag(white) @ by_noise.T + by_constant @ by_constant.T
        assert effect_covariance(effects, white.reshape(2, k), patterns) == near(expected)
        assert of_positions[tick] == pytest.approx(expected[0, 0] + expected[1, 1], rel=1e-6, abs=1e-9)


# --- the ranges ---------------------------------------------------------------------------------------


class Told(NamedTuple):
    """The measurements of two robots, and their true values."""

    pair: JointMeasurements
    guess: Array
    """true value of `Fit.guess`"""
    poses: Array
    """true last poses, relative to M1"""

    def ranging(self, rho: Array) -> Told:
        """Return the same robots with other ranges `rho` (m)."""
        return self._replace(pair=with_ranges(self.pair, rho=rho))


K = 10
"""The number of ticks that both robots drive."""
REACH = 10.0
"""The sensing range in m."""


def told(seed: int, noise: Noise) -> Told:
    """Return data of two robots that drive randomly about their anchors, with all ranges in every tick."""
    draw = np.random.default_rng(seed)
    apart = draw.uniform(-4.0, 4.0, 2)
    measured, guess, tracks = [], [], []
    for anchor in (np.zeros(2), apart):
        v, omega = draw.uniform(0.3, 1.5, K), draw.uniform(-2.0, 2.0, K)
        odometry = track(v, omega, 0.8)
        error = np.sqrt(variances(noise.odometry, odometry)) * draw.normal(size=2 * K)
        pose = Pose(draw.uniform(-2.0, 2.0), draw.uniform(-2.0, 2.0), draw.uniform(-3.0, 3.0))
        guess += [*placed(pose), pose.heading]
        driven = [Pose(float(anchor[0]) + pose.x, float(anchor[1]) + pose.y, pose.heading)]
        for rate, turn in (np.stack((v, omega)) + error.reshape(2, K)).T.tolist():
            driven.append(step(driven[-1], rate, turn, odometry.period))
        measured.append(odometry)
        tracks.append(np.array([(one.x, one.y, one.heading) for one in driven]))
    a, b = tracks
    ways = (a[:, :2], b[:, :2] - apart, a[:, :2] - b[:, :2])
    sigmas = (noise.anchor_sigma, noise.anchor_sigma, noise.mutual_sigma)
    first, second, mutual = (
        list(enumerate((np.hypot(*way.T) + sigma * draw.normal(size=K + 1)).tolist()))
        for way, sigma in zip(ways, sigmas, strict=True)
    )
    places = [(0.0, 0.0), (float(apart[0]), float(apart[1]))]
    pair = near_anchors(measured, (first, second), places, noise, REACH, mutual)
    return Told(pair, np.array(guess), np.concatenate((a[-1], b[-1])))


def placed(start: Pose) -> tuple[float, float]:
    """Return the position of the anchor in the odometry frame of a robot that starts at `start`."""
    c, s = math.cos(start.heading), math.sin(start.heading)
    return -c * start.x - s * start.y, s * start.x - c * start.y


def distances(pair: JointMeasurements, guess: Array, paths: Sequence[Track] = ()) -> Array:
    """Return the ranges of `pair` without noise, by its paths or by other ones."""
    at = []
    for path, (mx, my, turn), anchor in zip(
        paths or pair.paths, guess.reshape(2, 3).tolist(), pair.pivots, strict=True
    ):
        x, y = rotated(math.cos(turn), math.sin(turn), path.x - mx, path.y - my)
        at.append(np.stack((x, y), 1) + anchor)
    ways, ranges = (at[0], at[1] - m2(pair), at[0] - at[1]), pair.ranges
    return np.concatenate([np.hypot(*ways[kind][ranges.tick[kinds(pair) == kind]].T) for kind in range(3)])


def clear(told: Told) -> bool:
    """Return true if all distances are differentiable, and the ranges determine both poses."""
    by_guess = derivative(lambda guess: distances(told.pair, guess), told.guess)
    return (
        float(np.min(distances(told.pair, told.guess))) > 0.1
        and float(np.linalg.svd(by_guess, compute_uv=False)[-1]) > 0.3
    )


EXACT = Noise().as_told


def with_other_anchors(pair: JointMeasurements, seed: int) -> JointMeasurements:
    """Return `pair` with every other range of a robot to an anchor at another place."""
    ranges = pair.ranges
    place = np.random.default_rng(seed).uniform(-3.0, 3.0, ranges.place.shape)
    place[::2] = ranges.place[::2]
    place[ranges.second >= 0] = 0.0
    return with_ranges(pair, place=place, radio=np.arange(len(place)))


noises = st.builds(
    Noise,
    st.floats(1e-3, 0.05),
    st.floats(1e-3, 0.05),
    odometry=st.builds(
        VelocityNoise, *[st.sampled_from((0.0, 1e-3, 1e-2))] * 2, *[st.sampled_from((0.0, 1e-3, 5e-3))] * 2
    ),
    range_bias=st.sampled_from((0.0, 0.02, 0.4)),
    pair_bias=st.sampled_from((0.0, 0.01, 0.1)),
    range_scale=st.sampled_from((0.0, 0.005, 0.05)),
    slow_sigma=st.sampled_from((0.0, 0.08)),
    wheel_scale=st.sampled_from((0.0, 0.01)),
    gyro_bias=st.sampled_from((0.0, 0.001)),
    sigma_degrees=st.sampled_from((0.0, 4.0)),
    strays=st.just(0.0),
    range_depth=st.sampled_from((0.0, 0.5)),
)


@pytest.mark.parametrize("anchors", ["one each", "several"])
@few
@given(seed=seeds, noise=noises)
def test_a_range_changes_with_all_unknowns_as_the_linear_model_predicts(
    seed: int, anchors: str, noise: Noise
) -> None:
    one = told(seed, noise)
    assume(clear(one))
    problem = Problem.of(with_other_anchors(one.pair, seed) if anchors == "several" else one.pair)
    of, kernel, begin = problem.measured, problem.kernel, pair_start(one.guess, m2(one.pair))
    draw, poses, white = np.random.default_rng(seed), begin.poses.ravel(), np.zeros(of.white.shape)
    at = np.concatenate((np.zeros(6), draw.normal(size=of.size - 6)))
    parts, rows = (6, 6 + of.common.shape[1]), range(len(of.rho))

    def predicted(unknowns: Array) -> Array:
        change, common, constant = np.split(unknowns, parts)
        walk = kernel.walked(moved(of, poses, change), constant.reshape(2, -1), white)
        off = [dot([effect_of(of, walk, j, e) for e in range(len(common))], common.tolist()) for j in rows]
        return np.asarray(of.rho - walk.residual + off)

    deep = at[6 + of.deep : 8 + of.deep].tolist() if of.deep >= 0 else (0.0, 0.0)
    walk = kernel.walked(poses, at[parts[1] :].reshape(2, -1), white, deep)
    assume(float(np.min(of.rho - walk.residual)) > 0.1)
    effects = smoother.forward(of, walk, poses, np.square(problem.weighing.sigma), update=False).effects
    assert np.array(effects) == pytest.approx(derivative(predicted, at), abs=1e-6)


# --- the fit ------------------------------------------------------------------------------------------


def settled(told: Told) -> Fit:
    """Return the fit from the truth, continued until its linear model is that of its end."""
    found = pair_fit(told.guess, told.pair)
    for _ in range(5):
        (found,) = fits(told.pair, [found.start])
    return found


def nudged(told: Told, seed: int, by: float) -> Array:
    """Return the true parameters with random offsets of scale `by`, in m and rad."""
    guess: Array = told.guess + by * np.random.default_rng(seed).uniform(-1.0, 1.0, 6)
    return guess


def converged(one: Fit) -> bool:
    return one.linear.step.length < LAST_STEP * math.sqrt(one.level)


@some
@given(seeds)
def test_exact_ranges_and_an_exact_odometry_give_the_truth(seed: int) -> None:
    one = told(seed, EXACT)
    assume(clear(one))
    found = pair_fit(nudged(one, seed, 0.02), one.pair)
    assert found.guess == pytest.approx(one.guess, abs=1e-9)
    assert found.poses.ravel() == pytest.approx(one.poses, abs=1e-9)


LOST = Noise(1e-3, 1e-3, odometry=VelocityNoise(omega=0.1, omega_floor=0.1)).as_told


@few
@given(seeds, st.floats(0.0, 0.1))
def test_the_covariance_is_positive_where_ranges_leave_little_of_the_odometry_noise(
    seed: int, by: float
) -> None:
    one = told(seed, LOST)
    assume(clear(one))
    covariance = pair_fit(nudged(one, seed, by), one.pair).covariance
    sigmas = np.sqrt(np.diagonal(covariance))
    assert np.min(np.linalg.eigvalsh(covariance / np.outer(sigmas, sigmas))) > -1e-9


def test_a_fit_that_begins_where_one_ended_ends_there_too() -> None:
    """On a path straight to the anchor the guess is right at once, but the path is still corrected."""
    measured, driven = (track(np.full(8, v), np.zeros(8), 1.0) for v in (1.0, 1.01))
    told = (20.0 - driven.x).tolist()
    noise = Noise(0.01, odometry=VelocityNoise(v=0.05)).as_told
    own = alone(measured, told, noise)
    (first,) = fits(own, [start_of(np.array((20.0, 0.0)))])
    (again,) = fits(own, [start_of(first.guess[:2])])
    assert again.guess == pytest.approx(first.guess, abs=1e-9)
    assert again.poses[0, 0] == pytest.approx(first.poses[0, 0], abs=1e-9)
    assert first.poses[0, 0] == pytest.approx(driven.x[-1] - 20.0, abs=0.01)


DRIFTING = Noise(0.05, 0.05, odometry=VelocityNoise(0.05, 0.05, 0.02, 0.05)).as_told


def cost(told: Told, found: Fit) -> float:
    """Return twice the negative log-density of the residuals and of the odometry errors."""
    total = float(np.sum(np.square(found.residuals / told.pair.ranges.sigma)))
    for error, measured in zip(found.start.errors, told.pair.paths, strict=True):
        white, variance = (
            np.stack((error.v, error.omega)).ravel(),
            variances(told.pair.noise.odometry, measured),
        )
        assert not np.any(white[variance == 0.0])
        total += float(np.sum(np.square(white[variance > 0.0]) / variance[variance > 0.0]))
    return total


@some
@given(seeds, st.sampled_from([Noise(0.05, 0.05).as_told, DRIFTING]), st.floats(0.1, 2.0))
@pytest.mark.long
def test_no_step_of_a_fit_climbs(seed: int, noise: Noise, by: float) -> None:
    one = told(seed, noise)
    guess = nudged(one, seed, by)
    costs = [cost(one, pair_fit(guess, one.pair, Convergence(steps))) for steps in range(7)]
    assert all(later <= earlier + 1e-5 for earlier, later in pairwise(costs)), costs


ROUGH = Noise(
    0.01, 0.01, outliers=0.05, outlier_bias=(0.3, 2.0), odometry=VelocityNoise(0.001, 0.001)
).as_told


@some
@given(seeds, st.integers(0, 3 * K + 2), st.floats(0.3, 2.0))
def test_an_outlier_moves_a_fit_no_farther_than_its_absence(seed: int, which: int, bias: float) -> None:
    one = told(seed, ROUGH)
    assume(clear(one))
    rho = one.pair.ranges.rho.copy()
    rho[which] += bias
    spoilt = pair_fit(nudged(one, seed, 0.2), one.ranging(rho).pair)
    without = pair_fit(one.guess, dropped(one.pair, which))
    assert spoilt.weights[which] < 1e-3
    off = (spoilt.guess - without.guess) / np.sqrt(np.diagonal(without.of_start))
    assert np.max(np.abs(off)) < 0.1, "sigmas"


def dropped(pair: JointMeasurements, which: int) -> JointMeasurements:
    return replace(pair, ranges=pair.ranges.rows(np.arange(len(pair.ranges.rho)) != which))


OF_EXACT_RANGES = Noise(odometry=VelocityNoise(0.02, 0.02)).as_told


def test_a_fit_that_has_converged_explains_exact_ranges() -> None:
    """The guess may be still while the path is not: then residuals are thousands of their sigmas."""
    converged = 0
    for seed in range(80, 160):
        one = told(seed, OF_EXACT_RANGES)
        if not clear(one):
            continue
        found = pair_fit(nudged(one, seed, 0.01), one.pair)
        if found.last_step <= FINISHED:
            converged += 1
            assert np.max(np.abs(found.residuals)) < 10.0 * SIGMA_FLOOR, seed
    assert converged > 5, converged


REST = 4
"""The number of ticks that both robots then stand still."""


def resting(told: Told) -> Told:
    """Return `told` with REST more ticks at rest, in which each range is measured again."""
    paths = [
        track(np.append(path.v, np.zeros(REST)), np.append(path.omega, np.zeros(REST)), path.period)
        for path in told.pair.paths
    ]
    lists = []
    for kind in range(3):
        rho = told.pair.ranges.rho[kinds(told.pair) == kind].tolist()
        lists.append(list(enumerate(rho + REST * rho[-1:])))
    places = ((0.0, 0.0), m2(told.pair))
    return told._replace(pair=near_anchors(paths, lists[:2], places, told.pair.noise, REACH, lists[2]))


@few
@given(seeds, st.sampled_from((0.001, 0.003, 0.01)))
def test_the_distance_from_an_anchor_is_as_accurate_as_exact_ranges_at_rest(seed: int, share: float) -> None:
    one = told(seed, Noise(odometry=VelocityNoise(share, share)).as_told)
    assume(clear(one))
    one = resting(one)
    found = settled(one)
    assume(converged(found))
    for robot, anchor in enumerate(one.pair.pivots):
        own, way = slice(3 * robot, 3 * robot + 2), found.poses[robot, :2] - anchor
        along = way / np.hypot(*way)
        variance = float(along @ found.covariance[own, own] @ along) / found.level
        assert 0.0 < variance < 10.0 * SIGMA_FLOOR**2


def test_a_variance_that_rounding_has_made_negative_is_no_knowledge() -> None:
    assert deviation(-1e-18) == deviation(math.nan) == math.inf
    assert deviation(4.0) == 2.0


def test_exact_ranges_and_strides_of_a_kilometre_leave_a_covariance_that_can_be_inverted() -> None:
    """The odometry noise is 10^7 times the accuracy of the ranges, two of which are from the same place."""
    path = track(np.array([1e3, -1e3, 1e3, 0.0, 0.0]), np.array([0.3, -0.2, 0.4, 0.0, 0.0]), 1.0)
    anchor, noise = np.array((400.0, 300.0)), Noise(odometry=VelocityNoise(0.01, 0.01)).as_told
    rho = np.hypot(path.x - anchor[0], path.y - anchor[1])
    (found,) = fits(alone(path, rho.tolist(), noise), [start_of(anchor + (1.0, -1.0))])
    assert found.guess == pytest.approx([*anchor, 0.0], abs=1e-3)
    assert np.min(np.linalg.eigvalsh(found.of_start[:2, :2])) > 0.0
    assert found.last_step < LAST_STEP


@few
@given(seeds, st.sampled_from([VelocityNoise(), VelocityNoise(2e-4, 2e-4, 1e-4, 2e-4)]))
@pytest.mark.long
def test_the_covariance_has_the_surveying_errors_of_both_anchors(seed: int, odometry: VelocityNoise) -> None:
    noise = Noise(1e-4, 3e-4, odometry=odometry).as_told  # small errors: curvature is left out
    one = told(seed, noise)
    assume(clear(one))

    def placed_if(error: Array) -> Array:
        """Return the poses that the ranges tell if the anchors are off by `error`: x and y of each."""
        (ax, ay, bx, by), (x, y) = error, m2(one.pair)
        place = np.where(kinds(one.pair)[:, None] == 1, (x + bx - ax, y + by - ay), 0.0)
        moved = one._replace(pair=with_ranges(one.pair, place=place))
        return np.asarray(settled(moved).poses.ravel() + (ax, ay, 0.0, ax, ay, 0.0))

    surveyed = one._replace(pair=replace(one.pair, noise=replace(noise, survey_error=0.02)))
    more = settled(surveyed).covariance - settled(one).covariance
    by_error = derivative(placed_if, np.zeros(4))
    expected = 0.02**2 * by_error @ by_error.T
    assert more == pytest.approx(expected, abs=0.01 * float(np.max(np.abs(expected))))


# --- what is held, and the frame of the world -----------------------------------------------------------

ALL_ERRORS = Noise(
    0.02,
    0.02,
    outliers=0.05,
    outlier_bias=(0.3, 2.0),
    odometry=VelocityNoise(0.005, 0.005, 0.001, 0.001),
    range_bias=0.1,
    range_scale=0.02,
    slow_sigma=0.03,
    survey_error=0.01,
)


@few
@given(seeds)
def test_the_heading_of_a_robot_alone_is_held_and_its_evidence_does_not_depend_on_how(seed: int) -> None:
    one, weights, starts = told(seed, ALL_ERRORS), [], []
    for held in (1e22, 1e26):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(joint_ranges, "HELD", held)
            (found,) = fits(one.pair.alone(0), [start_of(nudged(one, seed, 0.05)[:2])])
        assert abs(found.start.poses[0, 2]) < 1e-15
        weights.append(found.weight)
        starts.append(found.guess)
    assert weights[1] == pytest.approx(weights[0], abs=1e-9)
    assert starts[1] == pytest.approx(starts[0], abs=1e-9)


def repeated(pair: JointMeasurements, times: int) -> JointMeasurements:
    """Return `pair` with each range `times` times."""
    rows = np.repeat(np.arange(len(pair.ranges.rho)), times)
    return replace(pair, ranges=pair.ranges.rows(rows))


@pytest.mark.parametrize("times", [1, 8])
@few
@given(seeds, st.sampled_from((-0.5, -0.02, 0.02, 0.5)))
def test_a_range_that_holds_a_coordinate_is_no_outlier_and_has_no_bias(
    times: int, seed: int, offset: float
) -> None:
    """The scale is an error of the measured ranges or, where they are many, of the predicted ones."""
    one = told(seed, ALL_ERRORS)
    assume(clear(one))
    pair = repeated(one.pair, times)
    assert (len(pair.ranges.rho) > MOST_MEASURED_LENGTHS) == (times > 1)
    begun = pair_fit(one.guess, pair)
    along = np.array((math.cos(seed), math.sin(seed)))
    place, sigma = begun.poses[1, :2], 1e-4
    away = FAR_ANCHOR * pair.reach
    measured = _holding(pair, 1, place - away * along, away + offset, sigma)
    (held,) = held_fits(measured, begun, [(away + offset, 5)])
    # a few full steps: each is bounded, and none is made shorter if it does not descend
    assert 0.0 < (held.poses[1, :2] - place) @ along / offset < 1.5
    (whole,) = fits(measured, [begun.start], Convergence(20))
    assert whole.weights[-1] == 1.0
    assume(whole.last_step <= FINISHED)
    assert (whole.poses[1, :2] - place) @ along == pytest.approx(offset, abs=10.0 * sigma)


@few
@given(seeds, st.floats(-3.0, 3.0), lengths, lengths)
def test_a_fit_does_not_depend_on_the_origin_and_the_axes_of_the_world(
    seed: int, turn: float, x: float, y: float
) -> None:
    one = told(seed, ALL_ERRORS)
    assume(clear(one))
    c, s = math.cos(turn), math.sin(turn)
    ranges, start = one.pair.ranges, pair_start(nudged(one, seed, 0.05), m2(one.pair))
    place = np.where(ranges.second[:, None] < 0, np.stack(rotated(c, s, *ranges.place.T), 1) + (x, y), 0.0)
    elsewhere = with_ranges(one.pair, place=place)
    poses = np.column_stack((*rotated(c, s, *start.poses[:, :2].T), start.poses[:, 2])) + (x, y, turn)
    (here,) = fits(one.pair, [start])
    (there,) = fits(elsewhere, [Start(poses)])
    assert there.guess - here.guess == pytest.approx(np.tile((0.0, 0.0, turn), 2), abs=1e-9)
    assert there.weight == pytest.approx(here.weight, abs=1e-9)
    assert there.weights == pytest.approx(here.weights, abs=1e-9)


# --- the score ------------------------------------------------------------------------------------------


@few
@given(seeds, noises)
def test_the_distance_score_is_the_derivative_of_the_likelihood_by_the_distance_of_the_anchors(
    seed: int, noise: Noise
) -> None:
    one = told(seed, noise)
    assume(clear(one))
    score, information = distance_score(settled(one), one.pair)
    small = 0.02 / math.sqrt(information)
    less, more = (likelihood(one, step) for step in (-small, small))
    tolerance = 1e-2 * math.sqrt(information)
    assert score == pytest.approx((more - less) / (2.0 * small), abs=tolerance, rel=1e-2)


def distance_score(found: Fit, pair: JointMeasurements) -> tuple[float, float]:
    """Return the score and its information for M2 farther from M1, and b with it."""
    along = np.array(m2(pair)) / math.hypot(*m2(pair))
    effect = np.where(found.problem.measured.second >= 0, -found.linear.walk.direction @ along, 0.0)
    score, information = found.linear.score(effect)
    assert found.linear.score(1e-3 * effect) == pytest.approx((1e-3 * score, 1e-6 * information), rel=1e-6)
    return score, information


def likelihood(told: Told, farther: float) -> float:
    """Return the log-likelihood at the optimum if the anchors are `farther` (m) apart."""
    place = told.pair.ranges.place * (1.0 + farther / math.hypot(*m2(told.pair)))
    return -0.5 * settled(told._replace(pair=with_ranges(told.pair, place=place))).chi2
