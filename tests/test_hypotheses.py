"""Hypotheses under noise: the true one is kept, symmetric ones stay equal, and probabilities sum to 1."""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from agent.estimation import closed_forms, posterior
from agent.estimation.closed_forms import Placement, same_placement
from agent.estimation.compiled import address, library
from agent.estimation.fit import fits
from agent.estimation.gauss_newton import Convergence, Fitted
from agent.estimation.gaussian import claim_rivals, evidence, placement_guesses
from agent.estimation.gaussian import search as searching
from agent.estimation.gaussian.anchor_guesses import anchors
from agent.estimation.gaussian.beacon_guesses import start_of
from agent.estimation.gaussian.consistency import FINISHED, consistency_test
from agent.estimation.gaussian.evidence import SILENT, anchor_evidence, detection_log_likelihoods
from agent.estimation.gaussian.joint_ranges import (
    MOST_CORRELATED_RANGES,
    MOST_MUTUAL_RANGES,
    MOST_RANGES_BY_EXACT_ODOMETRY,
    MOVED,
    JointMeasurements,
    Silence,
)
from agent.estimation.gaussian.measured_rows import near_anchors
from agent.estimation.gaussian.odometry_noise import Array, constant_errors, track
from agent.estimation.gaussian.placement_guesses import _encounter, placements
from agent.estimation.gaussian.planning_hypotheses import planning_hypothesis
from agent.estimation.gaussian.search import _until_now, of_anchor, search
from agent.estimation.kernel import Kernel
from agent.estimation.posterior import NO_HYPOTHESES, Hypothesis, Posterior, follow
from agent.estimation.smoother import Singular
from protocol.motion import Pose, step, wrap
from protocol.noise import Noise, VelocityNoise
from tests.hypotheses_by_numpy import anchors_by_numpy, detections_by_numpy, turned_by_numpy
from tests.pair_starts import alone, kinds, pair_fit, with_ranges

REACH = 3.0


# --- no detection -------------------------------------------------------------------------------------


def by_quadrature(beyond: Sequence[float], sigma: float, drop_outs: float) -> float:
    """Return the mean over the common error. In ticks that it moves into range, there is a drop-out."""
    error = np.linspace(-9.0, 9.0, 40_001)
    density = np.exp(-0.5 * error**2) / math.sqrt(2.0 * math.pi)
    out = np.array(beyond)[:, None] + sigma * error > 0.0
    return float(np.sum(density * np.prod(np.where(out, 1.0, drop_outs), 0)) * (error[1] - error[0]))


def no_detection(beyond: list[float], sigma: float, drop_outs: float) -> float:
    """Return the log-likelihood of ticks without a detection `beyond` R (m), by the kernel."""
    return float(library().no_detection(len(beyond), address(np.array(beyond)), sigma, drop_outs, SILENT))


margins = st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=8)


@given(margins, st.floats(0.05, 1.0), st.sampled_from([0.0, 0.01, 0.1, 0.5]))
def test_the_likelihood_of_no_detection_is_a_mean_over_the_common_error(
    beyond: list[float], sigma: float, drop_outs: float
) -> None:
    mean = by_quadrature(beyond, sigma, drop_outs)
    assert math.exp(no_detection(beyond, sigma, drop_outs)) == pytest.approx(mean, rel=1e-2, abs=1e-3)


def test_no_detection_far_out_of_range_has_probability_one() -> None:
    assert no_detection([], 0.1, 0.1) == 0.0
    assert no_detection([5.0, 7.0], 0.1, 0.0) == pytest.approx(0.0, abs=1e-12)
    assert no_detection([5.0, 7.0], 0.1, 0.1) == pytest.approx(0.0, abs=1e-12)


def test_no_detection_in_range_has_the_probability_of_its_drop_outs() -> None:
    assert no_detection([-1.0, -2.0, 3.0], 0.1, 0.1) == pytest.approx(2.0 * math.log(0.1))
    assert no_detection([-10.0], 0.1, 0.0) == pytest.approx(-5000.0, rel=2e-3)
    falling = [no_detection([-0.1 * sigmas], 0.1, 0.0) for sigmas in np.linspace(-5.0, 60.0, 131)]
    assert all(later < earlier for earlier, later in pairwise(falling)), "down to the farthest tail"


# --- one robot and its anchor -------------------------------------------------------------------------

SIGMA = 0.02
RANGES = Noise(anchor_sigma=SIGMA, mutual_sigma=SIGMA)


def survey(
    commands: Sequence[tuple[float, float]], anchor: tuple[float, float], seed: int
) -> tuple[Hypothesis, ...]:
    """Return the hypotheses of a robot that has driven so from the origin, with its anchor there."""
    v, omega = np.array(commands).T
    path = track(v, omega, 1.0)
    true = np.hypot(path.x - anchor[0], path.y - anchor[1])
    measured = true + SIGMA * np.random.default_rng(seed).standard_normal(len(true))
    assert np.max(true) < REACH
    return of_anchor((), alone(path, measured.tolist(), RANGES))


@pytest.mark.parametrize("seed", range(10))
def test_mirror_images_are_equally_likely_until_a_range_differs(seed: int) -> None:
    """On a straight path, a robot cannot distinguish the sides of its anchor."""
    anchor = (1.2, 0.9)
    straight = [(0.5, 0.0)] * 4
    one, other = survey(straight, anchor, seed)
    assert one.probability == pytest.approx(0.5, abs=1e-6)
    assert one.probability + other.probability == pytest.approx(1.0)
    assert one.fit.guess[:2] == pytest.approx(other.fit.guess[:2] * (1.0, -1.0), abs=1e-6)
    turned = survey([*straight, (0.0, math.pi / 2), (0.5, 0.0)], anchor, seed)
    assert turned[0].probability > 0.9999
    assert turned[0].fit.guess[:2] == pytest.approx(anchor, abs=5.0 * SIGMA)


# --- the pair -----------------------------------------------------------------------------------------

APART = (4.0, 0.0)
"""The vector from M1 to M2, in m."""


class Driven:
    """A robot that has driven at random, with its odometry."""

    def __init__(
        self, start: Pose, commands: Array, drift: VelocityNoise, draws: np.random.Generator
    ) -> None:
        self.poses = [start]
        spread = []
        for v, omega in commands.tolist():
            self.poses.append(step(self.poses[-1], v, omega, 1.0))
            spread.append(drift.variances(v, omega))
        measured = commands + np.sqrt(spread) * draws.standard_normal(commands.shape)
        self.track = track(measured[:, 0], measured[:, 1], 1.0)

    def guess(self, anchor: tuple[float, float]) -> list[float]:
        """Return the true pose in the form of a guess."""
        start = self.poses[0]
        c, s = math.cos(start.heading), math.sin(start.heading)
        dx, dy = anchor[0] - start.x, anchor[1] - start.y
        return [c * dx + s * dy, c * dy - s * dx, start.heading]


def told(distances: Sequence[float], sigma: float, draws: np.random.Generator) -> list[tuple[int, float]]:
    """Return the ranges within R, by tick."""
    return [
        (tick, max(0.0, rho + sigma * float(draws.standard_normal())))
        for tick, rho in enumerate(distances)
        if rho <= REACH
    ]


def distance(one: Pose, x: float, y: float) -> float:
    return math.hypot(one.x - x, one.y - y)


def drawn(seed: int, noise: Noise) -> tuple[JointMeasurements, Array]:
    """Return a pair that moves between its anchors, and the truth in the form of a guess."""
    draws = np.random.default_rng(seed)
    robots = []
    for x in (1.2, 2.8):
        start = Pose(x + draws.uniform(-0.8, 0.8), draws.uniform(-0.8, 0.8), draws.uniform(-math.pi, math.pi))
        commands = np.column_stack((draws.choice([-0.6, 0.6, 0.8], 12), draws.uniform(-1.5, 1.5, 12)))
        robots.append(Driven(start, commands, noise.odometry, draws))
    a, b = robots
    own = [[distance(pose, 0.0, 0.0) for pose in a.poses], [distance(pose, *APART) for pose in b.poses]]
    between = [distance(one, other.x, other.y) for one, other in zip(a.poses, b.poses, strict=True)]
    of_a, of_b = (told(one, noise.anchor_sigma, draws) for one in own)
    mutual = told(between, noise.mutual_sigma, draws)
    silent = [
        Silence(*ends, np.setdiff1d(np.arange(13), [tick for tick, _ in ranges]))
        for ends, ranges in (((0, -1), of_a), ((1, -1), of_b), ((0, 1), mutual))
    ]
    places = ((0.0, 0.0), APART)
    pair = near_anchors((a.track, b.track), (of_a, of_b), places, noise, REACH, mutual, tuple(silent))
    return pair, np.array([*a.guess((0.0, 0.0)), *b.guess(APART)])


def sigmas(one: Hypothesis, other: Array) -> float:
    """Return the distance of the two, in standard deviations of the first."""
    error = one.fit.guess - other
    error[2::3] = np.remainder(error[2::3] + math.pi, math.tau) - math.pi
    return math.sqrt(float(error @ np.linalg.solve(one.fit.of_start, error)))


@pytest.mark.parametrize(
    "noise",
    [RANGES, Noise(0.1, 0.1), Noise(0.02, 0.02, odometry=VelocityNoise(0.01, 0.01))],
    ids=["fine", "coarse", "odometry"],
)
def test_the_truth_is_a_hypothesis_and_the_probabilities_sum_to_one(noise: Noise) -> None:
    """The fit that starts at the truth is also found without it, and is usually the first."""
    tried, first = 0, 0
    for seed in range(24):
        pair, truth = drawn(seed, noise)
        if min(np.bincount(kinds(pair), minlength=3)) < ENOUGH:
            continue
        found = search(pair).hypotheses
        probability = [one.probability for one in found]
        assert sum(probability) == pytest.approx(1.0)
        assert probability == sorted(probability, reverse=True)
        best = pair_fit(truth, pair)
        off = [sigmas(one, best.guess) for one in found]
        assert min(off) < 1.0, (seed, off, probability)
        tried, first = tried + 1, first + (off[0] < 1.0)
    assert first >= 0.8 * tried > 8


ENOUGH = 4
"""The number of ranges of each kind."""

GYRO = Noise(0.05, 0.05, odometry=VelocityNoise(omega_floor=0.03))


def after_a_long_way(seed: int, noise: Noise = GYRO) -> tuple[JointMeasurements, Array]:
    """Return a pair whose a has driven 9 m since its last range to its anchor, and the truth as a guess."""
    draws, ticks = np.random.default_rng(seed), 8
    ell = [(0.5, 0.0), (0.5, 0.0), (0.0, math.pi / 2), (0.5, 0.0), (0.0, -math.pi / 2)]
    survey = np.column_stack((np.full(ticks, 0.7), draws.uniform(-1.5, 1.5, ticks)))
    wait = np.column_stack((np.full(ticks, 0.4), draws.uniform(-1.5, 1.5, ticks)))
    a = Driven(Pose(-1.0, -0.6, 0.0), np.array([*ell, *([(0.75, 0.0)] * 12), *survey]), noise.odometry, draws)
    b = Driven(Pose(9.2, 0.3, 1.0), np.array([*ell, *([(0.0, 0.0)] * 12), *wait]), noise.odometry, draws)
    m2 = (10.0, 0.0)
    own = (
        told([distance(pose, 0.0, 0.0) for pose in a.poses[:6]], noise.anchor_sigma, draws),
        told([distance(pose, *m2) for pose in b.poses], noise.anchor_sigma, draws),
    )
    between = [distance(p, q.x, q.y) for p, q in zip(a.poses[17:], b.poses[17:], strict=True)]
    mutual = [(tick + 17, rho) for tick, rho in told(between, noise.mutual_sigma, draws)]
    pair = near_anchors((a.track, b.track), own, ((0.0, 0.0), m2), noise, REACH, mutual)
    return pair, np.array([*a.guess((0.0, 0.0)), *b.guess(m2)])


def test_odometry_noise_before_the_encounter_does_not_hide_the_truth() -> None:
    """It moves all mutual ranges at once by up to a metre, and each is accurate to 0.05 m."""
    tried = 0
    for seed in range(24):
        pair, truth = after_a_long_way(seed)
        if np.count_nonzero(pair.ranges.mutual) < ENOUGH:
            continue
        tried += 1
        best = pair_fit(truth, pair, Convergence(20))
        found = search(pair).hypotheses
        assert min([sigmas(one, best.guess) for one in found]) < 1.0, seed
    assert tried > 12


def test_a_search_keeps_what_is_known_too(monkeypatch: pytest.MonkeyPatch) -> None:
    pair, _ = after_a_long_way(0)
    held = search(pair)
    monkeypatch.setattr(searching, "placements", lambda *_: [])
    searching.from_nothing.cache_clear()
    again = search.__wrapped__(pair, held)
    assert len(again.hypotheses) == len(held.hypotheses)
    assert again.hypotheses[0].fit.guess == pytest.approx(held.hypotheses[0].fit.guess, abs=1e-3)
    assert search.__wrapped__(pair) == NO_HYPOTHESES


def test_a_fit_that_still_moves_is_continued_before_it_is_compared() -> None:
    pair, truth = after_a_long_way(0)
    begun = pair_fit(truth + 0.05, pair, Convergence(1))
    assert begun.last_step > FINISHED
    known = Posterior((0, 1), (Hypothesis(1.0, begun),))
    assert posterior.merged(known, NO_HYPOTHESES, pair).has_converged


def test_a_hypothesis_is_followed_on_the_path_that_it_believes_in() -> None:
    pair, _ = after_a_long_way(0)
    held = search(pair)
    (followed,) = follow(Posterior((0, 1), held.hypotheses[:1]), pair).hypotheses
    assert followed.fit.last_step < 1e-2
    assert followed.fit.guess == pytest.approx(held.hypotheses[0].fit.guess, abs=1e-3)


def test_the_branches_of_a_robot_that_has_left_its_anchor_are_those_of_its_whole_path() -> None:
    """They are fitted up to the last range to the anchor, and continued from there."""
    pair, _ = after_a_long_way(0)
    path, own = pair.paths[0], pair.alone(0)
    assert own.ranges.tick[-1] < len(path.v) - 10
    for branch in _until_now(pair, 0):
        (whole,) = fits(own, [branch.fit.start])
        sigmas = np.sqrt(np.diagonal(whole.of_start)[:2])
        assert np.max(np.abs(branch.fit.guess - whole.guess)[:2] / sigmas) < 0.01
        assert branch.fit.paths.shape[1] - 1 == len(branch.fit.start.errors[0].v) == len(path.v)
        assert branch.fit.poses[0, 0] == pytest.approx(whole.poses[0, 0], abs=1e-3)
        assert branch.fit.weight == pytest.approx(whole.weight, abs=1e-2)


def test_a_search_is_repeated_only_if_a_measurement_differs_in_a_bit() -> None:
    """Both robots of one process have the same measurements in most ticks."""
    pair, _ = after_a_long_way(0)
    again, _ = after_a_long_way(0)
    assert search(again) is search(pair)
    rho = pair.ranges.rho.copy()
    rho[-1] = np.nextafter(rho[-1], 0.0)
    assert search(with_ranges(pair, rho=rho)) is not search(pair)


MIXTURES = {
    "exact odometry": RANGES,
    "outliers": Noise(0.05, 0.1, outliers=0.1, outlier_bias=(0.5, 2.0)),
    "strays": Noise(0.05, 0.1, strays=0.01, odometry=VelocityNoise(0.02, 0.02)),
    "both": Noise(0.05, 0.05, outliers=0.1, strays=0.01, odometry=VelocityNoise(omega_floor=0.03)),
}


@pytest.mark.parametrize("noise", MIXTURES.values(), ids=MIXTURES)
def test_compiled_guesses_are_those_of_their_text_to_the_bit(
    noise: Noise, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The positions of anchors, also from earlier ones, and the placements of pairs."""
    tried = 0
    for seed in range(12):
        pair, _ = after_a_long_way(seed, noise) if seed % 2 else drawn(seed, noise)
        alone = [pair.alone(robot) for robot in (0, 1)]
        for own in alone:
            guesses = anchors(own)
            assert np.array_equal(guesses, anchors_by_numpy(own))
            again = anchors(own, guesses.tolist())
            assert np.array_equal(again, anchors_by_numpy(own, guesses.tolist()))
        found = [fits(own, map(start_of, anchors(own)[:1])) for own in alone]
        if not all(found) or not pair.ranges.mutual.any():
            continue
        tried += 1
        both = (found[0][0], found[1][0])
        compiled = placements(both, pair)
        with monkeypatch.context() as patch:
            patch.setattr(placement_guesses, "_turned", turned_by_numpy)
            text = placements(both, pair)
        assert [(one.log_likelihood, one.start.poses.tolist()) for one in compiled] == [
            (one.log_likelihood, one.start.poses.tolist()) for one in text
        ]
    assert tried > 8


@pytest.mark.parametrize("drop_outs", [0.0, 0.1])
def test_compiled_detections_are_those_of_their_text(drop_outs: float) -> None:
    """Up to the last bits of a hypotenuse, for both anchors and between the robots, in range or not."""
    told = 0
    for seed in range(12):
        pair, truth = drawn(seed, replace(RANGES, drop_outs=drop_outs))
        pair = replace(pair, reach=0.9 * REACH)
        found = [pair_fit(truth, pair)]
        by_text = [detections_by_numpy(one, pair) for one in found]
        assert detection_log_likelihoods(found, pair) == pytest.approx(by_text, rel=1e-12, abs=1e-12)
        told += sum(one < -0.1 for one in by_text)
    assert told > 4


@given(st.integers(0, 40), st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3))
@settings(max_examples=30, deadline=None)
def test_a_fit_begins_on_a_path_that_is_off_by_what_its_placement_assumes(seed: int, z: list[float]) -> None:
    """The offset at the encounter is due to the anchor, and to the odometry since the last range to it."""
    pair, truth = after_a_long_way(seed)
    base = 20
    (own,) = fits(pair.alone(0), [start_of(truth[:2])])
    robot = _encounter(own, base, (base,))
    anchor, (errors,) = robot.begun(own, np.array(z))
    driven = pair.paths[0]
    patterns = constant_errors(driven.v, driven.omega, pair.noise)
    v, omega = np.stack((errors.v, errors.omega)) + np.tensordot(errors.constant, patterns, 1)
    path = track(driven.v + v, driven.omega + omega, driven.period)
    x, _, heading = own.paths[0].T
    off = np.array(
        (
            path.x[base] - anchor[0] - robot.x[0],
            path.y[base] - anchor[1] - robot.y[0],
            path.heading[base] - heading[base],
        )
    )
    assert off == pytest.approx(robot.root @ np.array(z), abs=0.02), "to first order"
    last = int(np.max(own.ticks))
    assert path.x[: last + 1] == pytest.approx(x[: last + 1] - x[0]), "as it was up to the last range"
    assert float(np.linalg.norm(robot.root[:2])) > 0.1


@pytest.mark.parametrize("sigma", [1e-9, 1e-3, 0.1])
def test_ranges_that_have_nothing_to_do_with_each_other_are_no_evidence(sigma: float) -> None:
    draws = np.random.default_rng(1)
    noise = Noise(sigma, sigma)
    path = track(np.full(5, 0.6), draws.uniform(-1.5, 1.5, 5), 1.0)
    found = []
    for _ in range(20):
        own = alone(path, draws.uniform(0.0, REACH, 6).tolist(), noise)
        scored = of_anchor((), own)
        found += [anchor_evidence(scored[0].fit, own)] if scored else []
    assert max(found) < 1.0, "not worth a mention (Jeffreys)"


def test_the_evidence_of_three_ranges_grows_as_they_get_more_accurate() -> None:
    path = track(np.full(2, 0.8), np.array([0.3, 1.2]), 1.0)
    true = np.hypot(path.x - 1.1, path.y - 0.7)
    found = []
    for sigma in (0.3, 0.03, 1e-3, 1e-5):
        own = alone(path, true.tolist(), Noise(sigma, sigma))
        found.append(anchor_evidence(of_anchor((), own)[0].fit, own))
    assert found == sorted(found)
    assert found[0] < 0.0
    assert found[-1] > 7.0


Lists = list[tuple[int, float]]


def at_rest(first: Lists, second: Lists, mutual: Lists, noise: Noise) -> JointMeasurements:
    """Return the measurements of two robots that stand."""
    ticks = max(tick for tick, _ in (*first, *second, *mutual))
    path = track(np.zeros(ticks), np.zeros(ticks), 1.0)
    return near_anchors((path, path), (first, second), ((0.0, 0.0), APART), noise, REACH, mutual)


def test_the_ranges_of_a_fit_are_bounded_and_the_recent_ones_are_all_among_them() -> None:
    many = [(tick, 1.0 + 1e-3 * tick) for tick in range(2 * MOST_RANGES_BY_EXACT_ODOMETRY)]
    for noise, most in ((GYRO, MOST_CORRELATED_RANGES), (RANGES, MOST_RANGES_BY_EXACT_ODOMETRY)):
        for count in (10, most, most + 1, 500, 1000):
            pair = at_rest(many[:count], many[:7], many[:count], noise)
            left = pair.thinned(1e3)
            counts = np.bincount(kinds(left), minlength=3)
            assert max(counts) <= most
            assert counts[1] == 7
            recent = min(count, MOST_MUTUAL_RANGES // 2, most // 2)
            for kind in (0, 2):
                ticks = left.ranges.tick[kinds(left) == kind]
                assert ticks[-recent:].tolist() == list(range(count - recent, count))
                assert ticks[0] == 0
            assert np.array_equal(left.ranges.rho, 1.0 + 1e-3 * left.ranges.tick)


def test_what_is_left_of_old_ranges_seldom_changes() -> None:
    many = [(tick, 1.0) for tick in range(1000)]
    old = [
        {
            tick
            for tick in at_rest(many[:count], [], [], GYRO).thinned(REACH).ranges.tick.tolist()
            if tick < count - MOST_CORRELATED_RANGES
        }
        for count in range(MOST_CORRELATED_RANGES, 1000)
    ]
    assert sum(not before <= after for before, after in pairwise(old)) <= 5, (
        "as often as their number doubles"
    )


def driving(steps: Sequence[float]) -> JointMeasurements:
    """Return the measurements of a robot that drives straight on by `steps` (m), and of one that stands."""
    ranges, own = [(tick, 1.0) for tick in range(len(steps))], np.array(steps)
    paths = track(own, np.zeros(len(own)), 1.0), track(np.zeros(len(own)), np.zeros(len(own)), 1.0)
    return near_anchors(paths, ([], []), ((0.0, 0.0), APART), GYRO, REACH, ranges)


def test_ranges_at_rest_do_not_replace_those_from_other_places() -> None:
    places = MOST_CORRELATED_RANGES // 2
    rested = driving([0.1 * REACH] * places + [0.0] * 1000)
    assert rested.thinned(REACH).ranges.tick[:places].tolist() == list(range(places))


def test_a_robot_that_shuttles_at_one_place_has_ranges_from_one_place_as_one_that_stands() -> None:
    """The way adds up to many places, but it is never farther than MOVED * R from where it began."""
    places = MOST_CORRELATED_RANGES // 2
    shuttled = driving([0.1 * REACH] * places + [0.004 * REACH, -0.004 * REACH] * 500)
    assert shuttled.places_of_pairs == [((0, 1), places + 1)]
    assert shuttled.thinned(REACH).ranges.tick[:places].tolist() == list(range(places))


@pytest.mark.parametrize("slower", [0.3, 1.1])
def test_slow_motion_adds_up_to_another_place(slower: float) -> None:
    slow = replace(driving([slower * MOVED * REACH] * 40), reach=REACH)
    assert slow.mutual_places.tolist() == list(range(0, 40, math.ceil(1.0 / slower)))
    to_and_fro = driving([0.3 * MOVED * REACH, -0.3 * MOVED * REACH] * 20)
    assert replace(to_and_fro, reach=REACH).mutual_places.tolist() == [0]


def test_where_ranges_are_fine_the_truth_is_as_near_as_the_covariance_says() -> None:
    off = [
        min(sigmas(one, truth) for one in search(pair).hypotheses)
        for pair, truth in (drawn(n, RANGES) for n in range(20))
        if min(np.bincount(kinds(pair), minlength=3)) >= ENOUGH
    ]
    assert max(off) < 6.0
    assert float(np.mean(np.square(off))) == pytest.approx(6.0, abs=3.5), "a chi-square of 6 degrees"


def test_a_range_that_is_too_long_is_ignored() -> None:
    rho = REACH + 6.0 * SIGMA
    few, many = [(0, 1.0), (1, 1.5)], [(2, 2.0)]
    noise = RANGES.as_told
    beyond = (3, rho + 1e-9)
    within = at_rest([*few, beyond], [*many, beyond], [*many, beyond], noise).thinned(REACH).ranges
    assert within.rho.tolist() == [1.0, 1.5, 2.0, 2.0]
    kept = at_rest([*few, (3, rho - 1e-9)], many, many, noise)
    assert kept.thinned(REACH).ranges is kept.ranges


# --- the limit of exact sensors -----------------------------------------------------------------------

EXACT = 1e-6
"""The smallest sigma in m that the robots assume for an exact range."""


def met(corner: bool, start: Pose, standing: Pose) -> tuple[JointMeasurements, list[Placement]]:
    """Return three ranges from a to b, which rests, and the solutions of eq. (7) for them in <b(M2)>.

    Both robots know the positions of their anchors, from ranges along an L. M2 is 10 m from M1.
    """
    ell = [(0.5, 0.0), (0.5, 0.0), (0.0, math.pi / 2), (0.5, 0.0)]
    last = [(0.4, 0.0), (0.0, math.pi / 2 if corner else 0.0), (0.4, 0.0)]
    draws = np.random.default_rng(0)
    a = Driven(start, np.array([*ell, *([(0.8, 0.0)] * 9), *last]), VelocityNoise(), draws)
    b = Driven(standing, np.array([*ell, *([(0.0, 0.0)] * 12)]), VelocityNoise(), draws)
    ticks = (13, 14, 16)
    looks = [distance(a.poses[tick], b.poses[tick].x, b.poses[tick].y) for tick in ticks]
    assert max(looks) < REACH
    noise = Noise(EXACT, EXACT).as_told
    own = (
        told([distance(pose, 0.0, 0.0) for pose in a.poses], 0.0, draws),
        told([distance(pose, 10.0, 0.0) for pose in b.poses], 0.0, draws),
    )
    places, mutual = ((0.0, 0.0), (10.0, 0.0)), list(zip(ticks, looks, strict=True))
    pair = near_anchors((a.track, b.track), own, places, noise, REACH, mutual)
    # <a(M1)> has the axes of <W>, and so has <b(M2)>: the true placement is T = -M2
    here = Pose(b.poses[-1].x - 10.0, b.poses[-1].y, b.poses[-1].heading)
    found = closed_forms.placements(10.0, here, a.poses[13], a.poses[14], looks[0], looks[1])
    third = [one for one in found if abs(distance(one.place(a.poses[16]), here.x, here.y) - looks[2]) < 1e-9]
    assert any(same_placement(one, Placement(0.0, -10.0, 0.0), 1e-6) for one in third), "the truth is one"
    return pair, [seen(one.place(a.poses[16]), here) for one in third]


def seen(one: Pose, other: Pose) -> Placement:
    """Return `one` in the frame of `other`."""
    c, s = math.cos(other.heading), math.sin(other.heading)
    dx, dy = one.x - other.x, one.y - other.y
    return Placement(wrap(one.heading - other.heading), c * dx + s * dy, c * dy - s * dx)


@pytest.mark.parametrize("corner", [False, True], ids=["straight", "corner"])
@pytest.mark.parametrize("turn", [0.0, 1.0, -2.5])
def test_nearly_exact_ranges_give_the_placements_of_eq_7(corner: bool, turn: float) -> None:
    start = Pose(0.3, -0.6, 0.1 - math.pi / 2)
    c, s = math.cos(turn), math.sin(turn)
    pair, exact = met(corner, start, Pose(9.2 - c + 0.5 * s, 1.3 - s - 0.5 * c, turn))
    found = []
    for one in search(pair).hypotheses:
        ax, ay, heading, bx, by, b_heading = one.fit.poses.ravel().tolist()
        found.append(seen(Pose(ax, ay, heading), Pose(bx, by, b_heading)))
    assert len(found) == len(exact) == (2 if corner else 4)
    for placement in exact:
        assert any(same_placement(placement, one, 1e-4) for one in found), placement


def test_numbers_beyond_floats_block_a_claim(monkeypatch: pytest.MonkeyPatch) -> None:
    pair, _ = met(True, Pose(0.3, -0.6, 0.1 - math.pi / 2), Pose(9.7, 0.3, 1.0))
    first = search(pair).hypotheses[0]
    one_stray = first.fit._replace(weights=np.append(0.0, first.fit.weights[1:]))

    held = Kernel.held

    def held_after_steps(self: Kernel, *begun: Any) -> Fitted:
        if begun[-1] == 0:
            raise Singular
        return held(self, *begun)

    monkeypatch.setattr(Kernel, "held", held_after_steps)
    claimed = planning_hypothesis(first)
    rival = claim_rivals.likeliest_rival(first.fit, pair, claimed, (0, 1))
    assert rival.log_likelihood_ratio == math.inf
    monkeypatch.setattr(evidence, "fits", lambda *_: [])
    assert consistency_test(one_stray, pair, 0).p_value == 0.0
    assert evidence.mutual_evidence(one_stray, pair) == -math.inf


def test_the_fit_of_a_long_contact_takes_memory_in_proportion_to_its_ranges() -> None:
    noise, ticks = Noise(anchor_sigma=0.1, mutual_sigma=0.1), np.arange(1000)
    a, b = (track(np.full(1000, 0.5), turn + 0.2 * np.sin(ticks), 1.0) for turn in (0.5, -0.35))
    every = [(tick, 0.0) for tick in range(1001)]
    truth = np.array((0.4, 0.9, 0.3, -0.2, 1.0, -0.8))
    pair = near_anchors((a, b), (every, every), ((0.0, 0.0), (1.5, 0.0)), noise, REACH, every)
    there = pair_fit(truth, pair, Convergence(0))
    pair = with_ranges(pair, rho=-there.residuals)
    tracemalloc.start()
    try:
        found = pair_fit(truth, pair)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert found.poses == pytest.approx(there.poses, abs=1e-6)
    assert peak < 0.2 * 8 * len(pair.ranges.rho) ** 2, (
        "as much as a matrix with all ranges in rows and columns"
    )
