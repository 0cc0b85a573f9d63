"""One fit to all facts about n robots: the optimum with the right covariance, in any order of facts."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from numpy.typing import NDArray
from scipy.optimize import least_squares  # type: ignore[import-untyped]
from scipy.stats import binom, chi2  # type: ignore[import-untyped]

from agent.estimation.claim import BEFORE_SEARCH, blocked
from agent.estimation.facts import AnchorPlace, Manoeuvre
from agent.estimation.fit import Fit, Start, fits
from agent.estimation.gauss_newton import Convergence
from agent.estimation.gaussian.joint_claims import (
    decisive_ranges,
    displaced_anchor,
    displacements,
    undetermined,
)
from agent.estimation.gaussian.joint_ranges import MOST_MUTUAL_RANGES, JointMeasurements
from agent.estimation.gaussian.odometry_noise import constant_errors, track, variances
from agent.estimation.gaussian.search import search
from agent.estimation.judged import of_joint
from agent.estimation.posterior import Certainty, Posterior, certainties
from protocol.noise import Noise
from tests.moving_groups import (
    NOISE,
    PERIOD_S,
    MovingGroup,
    anchor,
    anchor_range,
    joint_measurements,
    manoeuvre,
    moving_group,
    mutual_range,
    start_pose,
)

Array = NDArray[np.float64]

REACH = 20.0
SURE = 0.9999


def measured_of(group: MovingGroup) -> JointMeasurements:
    return joint_measurements(group.facts, group.noise, PERIOD_S, REACH)


def at_truth(group: MovingGroup, measured: JointMeasurements) -> Start:
    starts = group.starts.copy()
    starts[:, :2] -= measured.origin
    return Start(starts)


def errors_of(fit: Fit, group: MovingGroup, measured: JointMeasurements) -> Array:
    """Return the errors of the poses at the end; shape (n, 3)."""
    errors = fit.poses - group.ends
    errors[:, :2] += measured.origin
    errors[:, 2] = np.remainder(errors[:, 2] + math.pi, math.tau) - math.pi
    return errors


def nees_of(fit: Fit, errors: Array) -> list[float]:
    blocks = [fit.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(len(errors))]
    return [float(error @ np.linalg.solve(own, error)) for error, own in zip(errors, blocks, strict=True)]


# --- the optimum --------------------------------------------------------------------------------------------


class Reference:
    """A joint problem with all white errors as unknowns, for scipy."""

    def __init__(self, measured: JointMeasurements) -> None:
        self.measured, self.noise = measured, measured.noise
        v, omega = (np.stack([getattr(path, part) for path in measured.paths]) for part in ("v", "omega"))
        self.v, self.omega = v, omega
        self.sigmas = np.sqrt(variances(v, omega, self.noise.odometry))
        self.patterns = constant_errors(v, omega, self.noise)
        self.common = measured.ranges.common_errors(self.noise.priors)
        self.n, self.k = v.shape
        self.m = self.patterns.shape[1]

    def split(self, x: Array) -> tuple[Array, Array, Array, Array]:
        ends = np.cumsum([3 * self.n, self.common.shape[1], self.n * self.m])
        starts, common, constant, white = np.split(x, ends)
        return (
            starts.reshape(-1, 3),
            common,
            constant.reshape(self.n, self.m),
            white.reshape(self.n, 2, self.k),
        )

    def poses_at(self, x: Array) -> Array:
        """Return the poses at all ticks; shape (n, 3, k + 1)."""
        starts, _, constant, white = self.split(x)
        found = []
        for i in range(self.n):
            more = np.einsum("m,mck->ck", constant[i], self.patterns[i]) + white[i] * self.sigmas[i]
            path = track(self.v[i] + more[0], self.omega[i] + more[1], self.measured.period)
            c, s = math.cos(starts[i, 2]), math.sin(starts[i, 2])
            x_y = starts[i, 0] + c * path.x - s * path.y, starts[i, 1] + s * path.x + c * path.y
            found.append(np.stack((*x_y, starts[i, 2] + path.heading)))
        return np.stack(found)

    def residuals(self, x: Array) -> Array:
        ranges, at = self.measured.ranges, self.poses_at(x)
        _, common, constant, white = self.split(x)
        own = at[ranges.first, :2, ranges.tick]
        other = np.where(ranges.second[:, None] < 0, ranges.place, at[ranges.second, :2, ranges.tick])
        off = ranges.rho - np.hypot(*(own - other).T) - self.common @ common
        return np.concatenate((off / ranges.sigma, common, constant.ravel(), white.ravel()))

    def optimum(self, starts: Array) -> tuple[Array, Array]:
        """Return the poses at the end, (n, 3), and their covariance."""
        begin = np.zeros(3 * self.n + self.common.shape[1] + self.n * (self.m + 2 * self.k))
        begin[: 3 * self.n] = starts.ravel()
        found = least_squares(self.residuals, begin, "3-point", xtol=1e-14, ftol=1e-14, gtol=1e-14)
        inverse = np.linalg.inv(found.jac.T @ found.jac)
        ends, small = self.poses_at(found.x)[:, :, -1], 1e-6
        turn = np.stack(
            [
                (self.poses_at(found.x + step)[:, :, -1] - self.poses_at(found.x - step)[:, :, -1]).ravel()
                / (2.0 * small)
                for step in small * np.eye(len(begin))
            ],
            1,
        )
        return ends, turn @ inverse @ turn.T


@pytest.mark.parametrize("unanchored", [[], [2]])
def test_the_joint_fit_is_the_optimum_that_scipy_finds(unanchored: list[int]) -> None:
    noise = replace(NOISE, strays=0.0, sigma_degrees=0.0)
    group = moving_group(3, 5, ticks=14, noise=noise, unanchored=unanchored)
    measured = measured_of(group)
    (fit,) = fits(measured, [at_truth(group, measured)], Convergence(20))
    ends, covariance = Reference(measured).optimum(at_truth(group, measured).poses)
    sigmas = np.sqrt(np.diagonal(covariance))
    assert np.max(np.abs((fit.poses - ends).ravel()) / sigmas) < 0.01
    assert np.max(np.abs(fit.covariance - covariance) / np.outer(sigmas, sigmas)) < 0.02


# --- accuracy -----------------------------------------------------------------------------------------------


def blocking_reason(robot: int, found: Posterior, certainty: Certainty, measured: JointMeasurements) -> str:
    """Return what blocks the claim of a robot, but for other profiles."""
    judged = of_joint("recording", robot, found, certainty, measured, 0.3, SURE)
    blocking = blocked(judged, BEFORE_SEARCH)
    return blocking.reason if blocking is not None else ""


class Scores:
    """The errors and the NEES of many groups."""

    def __init__(self, robots: int, seeds: range, unanchored: list[int], outliers: float = 0.0) -> None:
        noise = replace(NOISE, outliers=outliers, outlier_bias=(0.3, 2.0))
        self.nees: list[float] = []
        self.errors: list[float] = []
        self.wrong = 0
        for seed in seeds:
            group = moving_group(robots, seed, noise=noise, unanchored=unanchored, outliers=outliers)
            measured = measured_of(group)
            found = search(measured)
            assert len(found.located) == robots
            fit = found.hypotheses[0].fit
            errors = errors_of(fit, group, measured)
            sure = certainties(found)
            for i, nees in enumerate(nees_of(fit, errors)):
                if not blocking_reason(i, found, sure[i], measured):
                    self.nees.append(nees)
                    self.errors.append(math.hypot(*errors[i, :2]))
                    self.wrong += nees > 5.0**2 + 3.0

    def assert_in_band(self) -> None:
        """Assert that NEES has its mean and its 99 % bound, each in a band of 99.9 %."""
        count = len(self.nees)
        # the poses of a group are correlated: the band is that of half as many
        low, high = chi2.ppf((0.0005, 0.9995), 1.5 * count) / (0.5 * count)
        assert low < np.mean(self.nees) < high
        beyond = sum(nees > chi2.ppf(0.99, 3) for nees in self.nees)
        assert beyond <= binom.ppf(0.9995, count, 0.01)


@pytest.mark.long
@pytest.mark.parametrize(
    ("robots", "unanchored", "seeds"),
    [(4, [3], range(20)), (4, [], range(20)), (3, [], range(1000, 1060)), (6, [1, 4], range(1000, 1060))],
)
def test_the_covariances_of_groups_are_right(robots: int, unanchored: list[int], seeds: range) -> None:
    scores = Scores(robots, seeds, unanchored)
    assert len(scores.nees) >= 0.95 * len(seeds) * robots
    assert not scores.wrong
    scores.assert_in_band()


def test_outliers_do_not_move_a_group() -> None:
    scores = Scores(4, range(10), [3], outliers=0.1)
    assert len(scores.nees) >= 36
    assert not scores.wrong
    assert np.median(scores.errors) < 0.08


def pairwise_errors(group: MovingGroup) -> list[float]:
    """Return the error (m) of each robot, estimated together with the next one alone."""
    names, found = group.robots, []
    for i, name in enumerate(names):
        j = (i + 1) % len(names)
        two = {name, names[j]}
        some = [
            one
            for one in group.facts
            if one.key.kind == "anchor"
            or {one.key.robot, one.key.other} - {f"M{each}" for each in two} <= two | {""}
        ]
        measured = joint_measurements(some, group.noise, PERIOD_S, REACH)
        of_two = search(measured)
        order = sorted((i, j))
        part = group._replace(ends=group.ends[order])
        errors = errors_of(of_two.hypotheses[0].fit, part, measured)
        found.append(math.hypot(*errors[order.index(i), :2]))
    return found


def test_a_joint_fit_is_at_least_as_accurate_as_pairs() -> None:
    joint, pairwise = [], []
    for seed in range(12):
        group = moving_group(4, seed)
        measured = measured_of(group)
        fit = search(measured).hypotheses[0].fit
        joint += [math.hypot(*error[:2]) for error in errors_of(fit, group, measured)]
        pairwise += pairwise_errors(group)
    assert np.median(joint) <= np.median(pairwise)


# --- anchors that are not surveyed -------------------------------------------------------------------------


def with_anchors(
    group: MovingGroup, sigmas: dict[str, float], seed: int = 0
) -> tuple[JointMeasurements, dict[str, Array]]:
    """Return the measurements with some anchors told with errors of their sigmas, and their true places."""
    draw, known, true = np.random.default_rng(seed), [], {}
    for one in group.facts:
        name, value = one.key.robot, one.value
        if isinstance(value, AnchorPlace) and name in sigmas:
            true[name] = np.array((value.x, value.y))
            off = draw.normal(size=2) * (sigmas[name] if sigmas[name] < math.inf else 0.0)
            x, y = (true[name] + off).tolist()
            known.append(anchor(name, x, y, sigmas[name]))
        else:
            known.append(one)
    return joint_measurements(known, group.noise, PERIOD_S, REACH), true


def anchor_errors(fit: Fit, used: JointMeasurements, true: dict[str, Array]) -> tuple[Array, list[float]]:
    """Return the errors (m) of the anchors in `true`, (n, 2), and their normalised squares."""
    errors, nees = [], []
    for i, name in enumerate(used.robots):
        if used.is_anchor(i):
            error = fit.poses[i, :2] + used.origin - true[name]
            errors.append(error)
            own = fit.covariance[3 * i : 3 * i + 2, 3 * i : 3 * i + 2]
            nees.append(float(error @ np.linalg.solve(own, error)))
    return np.array(errors), nees


def test_an_anchor_without_a_position_is_located_by_located_robots() -> None:
    measured, true = with_anchors(moving_group(3, 4), {"Mr00": math.inf})
    found = search(measured)
    assert [measured.robots[one] for one in found.located] == ["r00", "r01", "r02", "Mr00"]
    fit = found.hypotheses[0].fit
    errors, nees = anchor_errors(fit, measured.some(found.located), true)
    assert float(np.hypot(*errors[0])) < 0.5
    assert nees[0] < chi2.isf(1e-3, 2)


@pytest.mark.long
def test_covariances_of_anchors_that_are_not_surveyed_are_right() -> None:
    of_anchors, of_robots = [], []
    for seed in range(30):
        group = moving_group(4, seed)
        sigmas = {"Mr00": math.inf, "Mr01": 0.5, "Mr02": 0.1, "Mr03": 0.1}
        measured, true = with_anchors(group, sigmas, seed)
        found = search(measured)
        part, fit = measured.some(found.located), found.hypotheses[0].fit
        assert len(part.driving) == 4
        of_anchors += anchor_errors(fit, part, true)[1]
        errors = errors_of(fit._replace(poses=fit.poses[:4]), group, measured)
        of_robots += nees_of(fit, errors)
    assert len(of_anchors) == 120
    for nees, free in ((of_anchors, 2), (of_robots, 3)):
        assert np.mean(nees) < 1.15 * free
        outside = int(np.count_nonzero(np.array(nees) > chi2.isf(0.01, free)))
        assert binom.sf(outside - 1, len(nees), 0.01) > 1e-3


@pytest.mark.parametrize("sigma", [0.0, 0.1])
def test_an_anchor_that_stands_elsewhere_than_surveyed_is_named(sigma: float) -> None:
    group = moving_group(4, 5)
    moved = [
        anchor(one.key.robot, one.value.x + 2.0, one.value.y, sigma)
        if isinstance(one.value, AnchorPlace) and one.key.robot == "Mr02"
        else one
        for one in group.facts
    ]
    for known, name in ((group.facts, None), (moved, "Mr02")):
        measured = joint_measurements(known, group.noise, PERIOD_S, REACH)
        found = search(measured)
        displaced = displaced_anchor(displacements(found.hypotheses[0].fit, measured.some(found.located)))
        assert (displaced.anchor if displaced is not None else None) == name


# --- without anchors, in the frame of a robot ---------------------------------------------------------------


def relative(robots: int, seed: int, sigma: float) -> tuple[MovingGroup, JointMeasurements]:
    """Return a group without anchors, of which the start of r00 is known; ranges have the `sigma` (m)."""
    noise = NOISE if sigma == NOISE.mutual_sigma else Noise(sigma, sigma)
    group = moving_group(robots, seed, noise=noise, unanchored=range(robots))
    group = group._replace(facts=[*group.facts, start_pose("r00", *group.starts[0].tolist())])
    return group, measured_of(group)


@settings(max_examples=10)
@given(st.integers(2, 5), st.integers(0, 10**6), st.sampled_from((1e-6, 0.05)))
def test_robots_without_anchors_have_poses_in_the_frame_of_the_first(
    robots: int, seed: int, sigma: float
) -> None:
    group, measured = relative(robots, seed, sigma)
    found = search(measured)
    assert found.located == tuple(range(robots))
    errors = errors_of(found.hypotheses[0].fit, group, measured)
    for i, nees in enumerate(nees_of(found.hypotheses[0].fit, errors)):
        if certainties(found)[i].probability > SURE:
            assert nees < 5.0**2 + 3.0
    for i, sure in enumerate(certainties(found)):
        reason = blocking_reason(i, found, sure, measured)
        assert not reason or "sigma of the position" in reason or "probability" in reason


Way = tuple[float, float, float, float, float]
"""The pose of a robot at tick 0, and its constant v and omega."""


def driven(
    ways: list[Way], ticks: int, pairs: tuple[tuple[int, int], ...], noise: Noise = NOISE
) -> tuple[JointMeasurements, Array]:
    """Return robots that drive on arcs, on lines or not at all, and their poses at the end; r0 is known."""
    draw, known, paths = np.random.default_rng(ticks), [start_pose("r0", *ways[0][:3])], []
    for i, (x, y, heading, v, omega) in enumerate(ways):
        known += [manoeuvre(f"r{i}", tick, Manoeuvre(v, omega)) for tick in range(ticks)]
        path = track(np.full(ticks, v), np.full(ticks, omega), PERIOD_S)
        c, s = math.cos(heading), math.sin(heading)
        paths.append(np.stack((x + c * path.x - s * path.y, y + s * path.x + c * path.y)))
    for i, j in pairs:
        errors = draw.normal(0.0, noise.mutual_sigma, ticks + 1)
        for tick, rho in enumerate(np.abs(np.hypot(*(paths[i] - paths[j])) + errors).tolist()):
            known.append(mutual_range(f"r{i}", f"r{j}", tick, rho, noise.mutual_sigma))
    measured = joint_measurements(known, noise, PERIOD_S, REACH)
    return measured, np.array(paths)[:, :, -1]


def test_the_headings_of_a_robot_that_stands_do_not_hide_its_mirror_image() -> None:
    found = search(driven([(0.0, 0.0, 0.0, 0.3, 0.0), (3.0, 1.0, 0.0, 0.0, 0.0)], 20, ((0, 1),))[0])
    assert sorted([round(float(one.fit.poses[1, 1])) for one in found.hypotheses]) == [-1, 1]


def test_no_robot_is_located_by_its_ranges_to_one_that_stands() -> None:
    ways = [(0.0, 0.0, 0.0, 0.3, 0.2), (3.0, 1.0, 0.0, 0.0, 0.0), (5.0, 1.0, 0.0, 0.3, 0.1)]
    measured, _ = driven(ways, 20, ((0, 1), (1, 2)))
    found = search(measured)
    assert found.located == (0, 1)
    assert undetermined(2, found.located, measured).startswith("too few of its ranges are from different")


def test_of_two_robots_on_straight_lines_all_four_images_are_found() -> None:
    ways = [(2.0, 0.3, -1.9, 0.3, 0.0), (2.8, 0.6, 0.0, 0.5, 0.0)]
    measured, ends = driven(ways, 14, ((0, 1),), Noise(1e-6, 1e-6))
    found = search(measured).hypotheses
    assert len(found) == 4
    assert min([math.dist(one.fit.poses[1, :2], ends[1]) for one in found]) < 1e-4


def test_a_robot_without_ranges_to_the_frame_has_no_pose_and_says_why() -> None:
    group, _ = relative(2, 7, 0.05)
    known = [*group.facts, mutual_range("r00", "w", 1, 3.0, 0.05)]
    for tick in range(20):
        known += [manoeuvre(name, tick, Manoeuvre(0.2, 0.2)) for name in ("u", "v", "w")]
        known.append(mutual_range("u", "v", tick, 3.0, 0.05))
    measured = joint_measurements(known, group.noise, PERIOD_S, REACH)
    found = search(measured)
    assert [measured.robots[one] for one in found.located] == ["r00", "r01"]
    u, w = [undetermined(measured.robots.index(name), found.located, measured) for name in "uw"]
    assert u == "no range connects it with r00, in whose frame poses are estimated"
    assert w == "1 of 3 required ranges to robots with a pose"


@pytest.mark.long
@pytest.mark.parametrize(("robots", "sigma"), [(2, 0.05), (5, 0.05), (3, 1e-6)])
def test_covariances_in_the_frame_of_a_robot_are_right(robots: int, sigma: float) -> None:
    claimed: list[float] = []
    first: list[float] = []
    for seed in range(2000, 2060):
        group, measured = relative(robots, seed, sigma)
        found = search(measured)
        errors = errors_of(found.hypotheses[0].fit, group, measured)
        for i, nees in enumerate(nees_of(found.hypotheses[0].fit, errors)):
            if not blocking_reason(i, found, certainties(found)[i], measured):
                (claimed if i else first).append(nees)
    assert len(claimed) >= 0.6 * 60 * (robots - 1)
    assert len(first) >= 54
    low, high = chi2.ppf((0.0005, 0.9995), 90) / 30.0  # the poses of a group are correlated
    assert low < np.mean(claimed) < high
    assert max(claimed) < chi2.isf(1e-6, 3)
    assert low < np.mean(first) < high if sigma == NOISE.mutual_sigma else max(first) < 0.1


# --- what is not determined ---------------------------------------------------------------------------------


def ambiguous() -> tuple[JointMeasurements, Posterior]:
    """Return a group in which r02 drives straight, and has ranges to two anchors alone."""
    group = moving_group(2, 7)
    known = [*group.facts, anchor("P", 20.0, 0.0), anchor("Q", 26.0, 0.0)]
    for tick in range(41):
        x, y = 21.0 + 0.1 * tick, 3.0 + 0.02 * tick
        known.append(manoeuvre("r02", tick, Manoeuvre(math.hypot(0.1, 0.02), 0.0)))
        for name, at in (("P", 20.0), ("Q", 26.0)):
            if tick % 2 == 0:
                known.append(anchor_range("r02", name, tick, math.hypot(x - at, y), 0.05))
    measured = joint_measurements(known, group.noise, PERIOD_S, REACH)
    return measured, search(measured)


def test_only_the_robot_with_a_mirror_image_is_uncertain() -> None:
    measured, found = ambiguous()
    assert found.located == (0, 1, 2)
    assert len(found.hypotheses) == 2
    sure = certainties(found)
    assert [one.poses for one in sure] == [1, 1, 2]
    assert sure[0].probability == sure[1].probability == 1.0
    assert 0.3 < sure[2].probability < 0.7
    reasons = [blocking_reason(i, found, sure[i], measured) for i in range(3)]
    assert reasons[:2] == ["", ""]
    assert reasons[2].startswith("the most probable of 2 hypotheses has probability 0.")


def test_ranges_among_robots_do_not_add_to_those_that_connect_them_with_the_frame() -> None:
    """Three ranges admit several places of a and all that know where a is: in one of 300 teams, a claimed."""
    known = [start_pose("o", 0.0, 0.0, 0.0)]
    for tick in range(6):
        known += [manoeuvre(name, tick, Manoeuvre(0.5, 0.2)) for name in "oabc"]
        known += [
            mutual_range(one, other, tick, 3.0, 0.05) for one, other in (("a", "b"), ("b", "c"), ("a", "c"))
        ]
        known += [mutual_range("o", "a", tick, 2.0, 0.05)] if tick < 3 else []
    measured = joint_measurements(known, NOISE, PERIOD_S, REACH)
    assert measured.robots == ("a", "b", "c", "o")
    assert [decisive_ranges(robot, measured) for robot in range(4)] == [3, 3, 3, 3]
    more = [*known, *[mutual_range("o", "c", tick, 2.0, 0.05) for tick in range(5)]]
    measured = joint_measurements(more, NOISE, PERIOD_S, REACH)
    assert [decisive_ranges(robot, measured) for robot in range(4)] == [8, 8, 8, 8]


def test_a_component_without_two_anchors_has_no_pose_and_says_why() -> None:
    group = moving_group(2, 7)
    known = [*group.facts, anchor("P", 20.0, 0.0)]
    for tick in range(20):
        known += [manoeuvre(name, tick, Manoeuvre(0.2, 0.2)) for name in ("u", "v", "w")]
        known += [mutual_range("u", "v", tick, 3.0, 0.05), anchor_range("u", "P", tick, 2.0, 0.05)]
    measured = joint_measurements(known, group.noise, PERIOD_S, REACH)
    found = search(measured)
    assert [measured.robots[one] for one in found.located] == ["r00", "r01"]
    u, v, w = [undetermined(measured.robots.index(name), found.located, measured) for name in "uvw"]
    ends = "ranges to one anchor; two at different places are needed"
    assert u == f"it and the robots with which it has ranges (v) have {ends}"
    assert v == f"it and the robots with which it has ranges (u) have {ends}"
    assert w == "it has no range to an anchor; two at different places are needed"


def test_no_fit_weighs_more_ranges_between_robots_than_it_can_afford() -> None:
    group = moving_group(12, 1, ticks=60)
    measured = measured_of(group)
    thinned = measured.thinned(REACH)
    mutual = int(np.count_nonzero(thinned.ranges.second >= 0))
    assert np.count_nonzero(measured.ranges.second >= 0) == 66 * 30
    assert MOST_MUTUAL_RANGES // 2 < mutual <= MOST_MUTUAL_RANGES
    to_anchors = [np.count_nonzero(one.ranges.second < 0) for one in (thinned, measured)]
    assert to_anchors[0] == to_anchors[1]


def test_a_fit_weighs_as_many_ranges_to_anchors_without_a_position_as_to_surveyed_ones() -> None:
    names, ticks = [f"A{k}" for k in range(8)], 200
    known = [manoeuvre("r", tick, Manoeuvre(0.2, 0.2)) for tick in range(ticks)]
    known += [anchor_range("r", name, tick, 3.0, 0.05) for name in names for tick in range(ticks)]
    for sigma in (0.0, math.inf):
        measured = joint_measurements(
            [*known, *[anchor(one, 1.0, 2.0, sigma) for one in names]], Noise(0.05, 0.05), PERIOD_S, REACH
        )
        assert len(measured.thinned(REACH).ranges.rho) == len(names) * ticks > MOST_MUTUAL_RANGES


def bits(measured: JointMeasurements) -> tuple[object, ...]:
    ranges, paths = measured.ranges, [path.content for path in measured.paths]
    parts = (ranges.rho, ranges.tick, ranges.sigma, ranges.first, ranges.second, ranges.place, ranges.radio)
    return *[part.tobytes() for part in parts], paths, measured.robots, measured.radios, measured.origin


def bits_of_fit(fit: Fit) -> tuple[bytes, bytes, float]:
    return fit.poses.tobytes(), fit.covariance.tobytes(), fit.weight


def test_a_hundred_orders_of_the_same_facts_give_the_same_bits() -> None:
    group = moving_group(3, 2, ticks=20, unanchored=[2])
    measured = joint_measurements(group.facts, group.noise, PERIOD_S, REACH)
    expected, fit = bits(measured), bits_of_fit(search(measured).hypotheses[0].fit)
    for seed in range(100):
        facts = random.Random(seed).sample(group.facts, len(group.facts))
        measured = joint_measurements(facts, group.noise, PERIOD_S, REACH)
        assert bits(measured) == expected
        if seed % 10 == 0:
            assert bits_of_fit(search(measured).hypotheses[0].fit) == fit


def test_ranges_after_the_path_of_a_robot_or_to_an_anchor_without_a_place_are_not_used() -> None:
    known = [manoeuvre("a", tick, Manoeuvre(1.0, 0.0)) for tick in (0, 1, 3, 4)]
    known += [anchor("M", 0.0, 0.0), *[anchor_range("a", "M", tick, 1.0 + tick, 0.1) for tick in range(5)]]
    known.append(anchor_range("a", "unknown", 1, 2.0, 0.1))
    measured = joint_measurements(known, NOISE, PERIOD_S, REACH)
    assert len(measured.paths[0].v) == 2
    assert measured.ranges.tick.tolist() == [0, 1, 2]
    assert measured.anchors == ("M",)
