"""Hypotheses under noise: the true one is kept, symmetric ones stay equal, and probabilities sum to 1."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.estimation import closed_forms
from agent.estimation.closed_forms import Placement, same_placement
from agent.estimation.gaussian.hypotheses import (
    ScoredHypothesis,
    missing,
    no_detection_log_likelihood,
    of_anchor,
    search,
)
from agent.estimation.gaussian.least_squares import fit, poses
from agent.estimation.gaussian.odometry_noise import Array, track
from agent.estimation.gaussian.range_model import PairRanges, Ranges
from protocol.motion import Pose, step, wrap
from protocol.noise import Noise, VelocityNoise

REACH = 3.0
NONE = np.array([], np.intp)
"""An empty array of ticks."""


# --- no detection -------------------------------------------------------------------------------------


def by_quadrature(beyond: Sequence[float], sigma: float, drop_outs: float) -> float:
    """Return the mean over the common error. In ticks that it moves into range, there is a drop-out."""
    error = np.linspace(-9.0, 9.0, 40_001)
    density = np.exp(-0.5 * error**2) / math.sqrt(2.0 * math.pi)
    out = np.array(beyond)[:, None] + sigma * error > 0.0
    return float(np.sum(density * np.prod(np.where(out, 1.0, drop_outs), 0)) * (error[1] - error[0]))


margins = st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=8)


@given(margins, st.floats(0.05, 1.0), st.sampled_from([0.0, 0.01, 0.1, 0.5]))
def test_the_likelihood_of_no_detection_is_a_mean_over_the_common_error(
    beyond: list[float], sigma: float, drop_outs: float
) -> None:
    mean = by_quadrature(beyond, sigma, drop_outs)
    assert math.exp(no_detection_log_likelihood(np.array(beyond), sigma, drop_outs)) == pytest.approx(
        mean, rel=1e-2, abs=1e-3
    )


def test_no_detection_far_out_of_range_has_probability_one() -> None:
    assert no_detection_log_likelihood(np.array([]), 0.1, 0.1) == 0.0
    assert no_detection_log_likelihood(np.array([5.0, 7.0]), 0.1, 0.0) == pytest.approx(0.0, abs=1e-12)
    assert no_detection_log_likelihood(np.array([5.0, 7.0]), 0.1, 0.1) == pytest.approx(0.0, abs=1e-12)


def test_no_detection_in_range_has_the_probability_of_its_drop_outs() -> None:
    assert no_detection_log_likelihood(np.array([-1.0, -2.0, 3.0]), 0.1, 0.1) == pytest.approx(
        2.0 * math.log(0.1)
    )
    assert no_detection_log_likelihood(np.array([-10.0]), 0.1, 0.0) == pytest.approx(-5000.0, rel=2e-3)
    falling = [
        no_detection_log_likelihood(np.array([-0.1 * sigmas]), 0.1, 0.0)
        for sigmas in np.linspace(-5.0, 60.0, 131)
    ]
    assert all(later < earlier for earlier, later in pairwise(falling)), "down to the farthest tail"


# --- one robot and its anchor -------------------------------------------------------------------------

SIGMA = 0.02
RANGES = Noise(anchor_sigma=SIGMA, mutual_sigma=SIGMA)


def alone(
    commands: Sequence[tuple[float, float]], anchor: tuple[float, float], seed: int
) -> tuple[ScoredHypothesis, ...]:
    """Return the hypotheses of a robot that has driven so from the origin, with its anchor there."""
    v, omega = np.array(commands).T
    path = track(v, omega, 1.0)
    true = np.hypot(path.x - anchor[0], path.y - anchor[1])
    measured = true + SIGMA * np.random.default_rng(seed).standard_normal(len(true))
    assert np.max(true) < REACH
    ranges = Ranges.of_lists(list(enumerate(measured.tolist())), (), (), RANGES)
    return of_anchor((), path, ranges, NONE, REACH, RANGES)


@pytest.mark.parametrize("seed", range(10))
def test_mirror_images_are_equally_likely_until_a_range_differs(seed: int) -> None:
    """On a straight path, a robot cannot distinguish the sides of its anchor."""
    anchor = (1.2, 0.9)
    straight = [(0.5, 0.0)] * 4
    one, other = alone(straight, anchor, seed)
    assert one.hypothesis.probability == pytest.approx(0.5, abs=1e-6)
    assert one.hypothesis.probability + other.hypothesis.probability == pytest.approx(1.0)
    assert one.fit.guess[:2] == pytest.approx(other.fit.guess[:2] * (1.0, -1.0), abs=1e-6)
    turned = alone([*straight, (0.0, math.pi / 2), (0.5, 0.0)], anchor, seed)
    assert turned[0].hypothesis.probability > 0.9999
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


def drawn(seed: int, noise: Noise) -> tuple[PairRanges, Array]:
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
    ranges = Ranges.of_lists(of_a, of_b, told(between, noise.mutual_sigma, draws), noise)
    silent = [missing(ranges.tick[ranges.rows(kind)], 13) for kind in range(3)]
    pair = PairRanges((a.track, b.track), ranges, (silent[0], silent[1], silent[2]), APART, REACH, noise)
    return pair, np.array([*a.guess((0.0, 0.0)), *b.guess(APART)])


def sigmas(one: ScoredHypothesis, other: Array) -> float:
    """Return the distance of the two, in standard deviations of the first."""
    error = one.fit.guess - other
    error[2::3] = np.remainder(error[2::3] + math.pi, math.tau) - math.pi
    return math.sqrt(float(error @ one.fit.information @ error))


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
        if min(pair.ranges.counts) < ENOUGH:
            continue
        found = search(pair)
        probability = [one.hypothesis.probability for one in found]
        assert sum(probability) == pytest.approx(1.0)
        assert probability == sorted(probability, reverse=True)
        best = fit(truth, pair.paths, pair.ranges, pair.noise, pair.apart)
        off = [sigmas(one, best.guess) for one in found]
        assert min(off) < 1.0, (seed, off, probability)
        tried, first = tried + 1, first + (off[0] < 1.0)
    assert first >= 0.8 * tried > 8


ENOUGH = 4
"""The number of ranges of each kind."""


def test_where_ranges_are_fine_the_truth_is_as_near_as_the_covariance_says() -> None:
    off = [
        min(sigmas(one, truth) for one in search(pair))
        for pair, truth in (drawn(n, RANGES) for n in range(15))
    ]
    assert max(off) < 6.0
    assert float(np.mean(np.square(off))) == pytest.approx(6.0, abs=3.5), "a chi-square of 6 degrees"


def test_a_range_that_is_too_long_is_ignored() -> None:
    rho = REACH + 6.0 * SIGMA
    few, many = [(0, 1.0), (1, 1.5)], [(2, 2.0)]
    without = Ranges.of_lists(few, many, many, RANGES)
    beyond = (3, rho + 1e-9)
    within = Ranges.of_lists([*few, beyond], [*many, beyond], [*many, beyond], RANGES).within(
        REACH, RANGES.as_told.priors
    )
    assert within.counts == without.counts == (2, 1, 1)
    for one, other in zip(within[:3], without[:3], strict=True):
        assert np.array_equal(one, other)
    kept = Ranges.of_lists([*few, (3, rho - 1e-9)], many, many, RANGES)
    assert kept.within(REACH, RANGES.as_told.priors) is kept


# --- the limit of exact sensors -----------------------------------------------------------------------

EXACT = 1e-6
"""The smallest sigma in m that the robots assume for an exact range."""


def met(corner: bool, start: Pose, standing: Pose) -> tuple[PairRanges, list[Placement]]:
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
    ranges = Ranges.of_lists(
        told([distance(pose, 0.0, 0.0) for pose in a.poses], 0.0, draws),
        told([distance(pose, 10.0, 0.0) for pose in b.poses], 0.0, draws),
        list(zip(ticks, looks, strict=True)),
        noise,
    )
    pair = PairRanges((a.track, b.track), ranges, (NONE, NONE, NONE), (10.0, 0.0), REACH, noise)
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
    for one in search(pair):
        ax, ay, heading, bx, by, b_heading = poses(one.fit, pair.apart)[0].tolist()
        found.append(seen(Pose(ax, ay, heading), Pose(bx, by, b_heading)))
    assert len(found) == len(exact) == (2 if corner else 4)
    for placement in exact:
        assert any(same_placement(placement, one, 1e-4) for one in found), placement
