"""Hypotheses about the poses of one robot or of both, with their probabilities, under noise.

Each hypothesis begins at an initial guess (see `anchor_guesses` and `placement_guesses`) and is fitted to all
ranges. Ranges and ticks without a detection determine its probability. A hypothesis is dropped when its
probability becomes small, and no single measurement excludes it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from agent.estimation.elementary import dot, solve
from agent.estimation.fit import Fit, Start, fits, without_outliers
from agent.estimation.gauss_newton import Convergence
from agent.estimation.gaussian.anchor_guesses import MOST_FOLLOWED, SEED_RANGES, UNLIKELY, anchors
from agent.estimation.gaussian.consistency import FINISHED
from agent.estimation.gaussian.detections import anchor_log_likelihood, detection_log_likelihood
from agent.estimation.gaussian.odometry_noise import Array, Errors, Places, Track
from agent.estimation.gaussian.pair_ranges import PairRanges, alone
from agent.estimation.gaussian.placement_guesses import STARTS, placements
from agent.estimation.gaussian.range_model import Ranges
from protocol.noise import Noise

NEGLIGIBLE_PROBABILITY = 1e-7
"""The probability, relative to the likeliest hypothesis, below which a hypothesis is dropped."""

SAME_SIGMAS = 1.0
"""The distance in sigmas below which two fits are the same hypothesis."""

FOLLOWED_RANGES = 6
"""The number of ranges to an anchor from which on its hypotheses are followed only, without outliers.

Two circles have two intersections, so a few ranges from different places leave nothing that a search would
find. With outliers it takes SEED_RANGES."""

WARM_STEPS = 2
"""The Gauss-Newton steps from the fit of the previous tick.

Where the best fit has not converged by then, it may be on its way to another mode, and the plane is searched.
With one step, that is every third tick; with more, each tick takes longer."""


COARSE_STILL = 0.05
"""The `Convergence.shortest` of fits on which only the robot's way depends.

No claim does: each search fits all ranges again. With LAST_STEP, such a fit takes twice as long.
"""

WARM_DECREASE = 0.1
"""The expected decrease of the first step of a fit that begins at the last one, which has one range less."""


class Hypothesis(NamedTuple):
    """One possible explanation of all measurements."""

    poses: tuple[tuple[float, ...], ...]
    """The fitted pose of each robot at tick 0 in m and rad, relative to M1."""
    probability: float
    """The probability that this hypothesis is true; the probabilities of all remaining ones sum to 1."""
    errors: tuple[tuple[tuple[float, ...], ...], ...] = ()
    """The odometry errors of each robot by its fit, in the order of `Errors`, where the next one begins.

    A fit that began on the measured path again could end in another mode.
    """
    covariance: tuple[tuple[float, ...], ...] = ()
    """The covariance of `Fit.guess`."""

    @property
    def start(self) -> Start:
        """Return where the next fit begins."""
        errors = [Errors(*map(np.array, error)) for error in self.errors]
        return Start(np.array(self.poses), tuple(errors))

    @staticmethod
    def of_fit(one: Fit, probability: float) -> Hypothesis:
        """Return the hypothesis of a fit."""
        errors = [tuple([tuple(part.tolist()) for part in error]) for error in one.start.errors]
        covariance = tuple([tuple(row) for row in one.of_start.tolist()])
        poses = tuple([tuple(pose) for pose in one.start.poses.tolist()])
        return Hypothesis(poses, probability, tuple(errors), covariance)


class ScoredHypothesis(NamedTuple):
    """A hypothesis with its fit."""

    hypothesis: Hypothesis
    fit: Fit
    detection_log_likelihood: float
    """The log-likelihood of the detections and of the ticks without one, given this fit."""


def with_probability(found: Sequence[tuple[Fit, float]]) -> tuple[ScoredHypothesis, ...]:
    """Return the hypotheses for `found`, likeliest first, without duplicates and without improbable ones.

    Each fit is paired with the log-likelihood of its detections and of its ticks without one.
    """
    scored = [(one.weight + max(silent, LEAST_EVIDENCE), one, silent) for one, silent in found]
    scored.sort(key=lambda one: -one[0])
    left: list[tuple[float, Fit, float]] = []
    for weight, one, silent in scored:
        if scored[0][0] - weight > -math.log(NEGLIGIBLE_PROBABILITY) or len(left) == MOST_FOLLOWED:
            break
        if not any(_same(one, other) for _, other, _ in left):
            left.append((math.exp(weight - scored[0][0]), one, silent))
    total = sum([probability for probability, _, _ in left])
    return tuple(
        ScoredHypothesis(Hypothesis.of_fit(one, probability / total), one, silent)
        for probability, one, silent in left
    )


LEAST_EVIDENCE = -math.log(100.0)
"""The least log-likelihood of detections and of ticks without one that counts for a probability.

R may not be as it was told, and detection may fade with range. So they never suffice for a claim.
"""


def _same(one: Fit, other: Fit) -> bool:
    change = one.guess - other.guess
    change[2::3] = np.remainder(change[2::3] + math.pi, math.tau) - math.pi
    return dot(change, solve(one.of_start, change[:, None])[:, 0]) < SAME_SIGMAS**2


# --- one robot and its anchor -------------------------------------------------------------------------


def of_anchor(
    before: Iterable[Hypothesis],
    path: Track,
    ranges: Ranges,
    silent: Places,
    sensing_range: float,
    noise: Noise,
) -> tuple[ScoredHypothesis, ...]:
    """Return the hypotheses about a robot's anchor in the frame of its odometry, in phase 1.

    `before` contains the hypotheses of the previous tick. `silent` contains the ticks without a range.
    """
    known = tuple(before)
    lost = bool(len(silent)) and silent[-1] == len(path.x) - 1
    enough = SEED_RANGES if noise.outliers else FOLLOWED_RANGES
    warm = bool(known) and len(ranges.rho) > enough and not lost
    if warm:
        starts = [one.start for one in known]
    else:
        places = [(-x, -y) for (x, y, _), *_ in [one.poses for one in known]]
        starts = starts_about(anchors(path, ranges, sensing_range, noise, places))
    until = (
        Convergence(WARM_STEPS, COARSE_STILL, WARM_DECREASE) if warm else Convergence(shortest=COARSE_STILL)
    )
    found = fits(alone(path, ranges, noise), starts, until)
    return with_probability(
        [(one, anchor_log_likelihood(one, 0, silent, ranges.tick, sensing_range, noise)) for one in found]
    )


def starts_about(points: Iterable[Array]) -> list[Start]:
    """Return starts of one robot, whose anchor is the origin and at `points` (m) in its own frame."""
    return [Start(np.array([[-x, -y, 0.0]])) for x, y in points]


def missing(ticks: Places, end: int, first: int = 0) -> Places:
    """Return the ticks from `first` on and before `end` that are not among `ticks`."""
    silent = np.ones(end, bool)
    silent[:first] = False
    silent[ticks] = False
    return np.flatnonzero(silent)


# --- the pair -----------------------------------------------------------------------------------------


@lru_cache(maxsize=2)
def search(pair: PairRanges, known: tuple[Hypothesis, ...] = ()) -> tuple[ScoredHypothesis, ...]:
    """Return the hypotheses about both robots in <W>: of a search of the whole plane, and those `known`.

    The search combines the branches of a, the branches of b and their placements. Where both robots run in
    one process, they mostly search with the same measurements in the same tick.
    """
    of_a, of_b = (_alone(pair, robot) for robot in (0, 1))
    found = [
        (placed.log_likelihood + math.log(a.hypothesis.probability * b.hypothesis.probability), placed.start)
        for a in of_a
        for b in of_b
        for placed in placements((a.fit, b.fit), pair)
    ]
    found.sort(key=lambda one: -one[0])
    starts = [start for weight, start in found[:STARTS] if weight > found[0][0] - UNLIKELY]
    starts += without_outliers(pair.measured, starts[:STARTS_WITHOUT_OUTLIERS])
    starts = [*[one.start for one in known], *starts]
    return _scored(fits(pair.measured, starts), pair)


STARTS_WITHOUT_OUTLIERS = 4
"""The number of the likeliest starts whose outliers are left out of a second fit."""


def _alone(pair: PairRanges, robot: int) -> tuple[ScoredHypothesis, ...]:
    """Return the hypotheses about one robot's anchor in the frame of its odometry, by its own ranges."""
    path, ranges = pair.paths[robot], pair.ranges.only(robot)
    last = int(ranges.tick[-1]) if len(ranges.tick) else 0
    found = _up_to_last_range(_OwnRanges(path.until(last), ranges, pair.sensing_range, pair.noise))
    return tuple([one._replace(fit=one.fit.continued(pair.of(robot))) for one in found])


class _OwnRanges(NamedTuple):
    """The ranges of one robot to its anchor, and its path up to the last of them."""

    path: Track
    ranges: Ranges
    sensing_range: float
    noise: Noise

    @property
    def content(self) -> tuple[object, ...]:
        """Return all measurements as values that can be compared."""
        return self.path.content, self.ranges.content, self.sensing_range, self.noise

    def __eq__(self, other: object) -> bool:
        """Return whether `other` has the same measurements, to the bit."""
        return isinstance(other, _OwnRanges) and self.content == other.content

    def __hash__(self) -> int:
        """Return the hash of all measurements."""
        return hash(self.content)


@lru_cache(maxsize=8)
def _up_to_last_range(own: _OwnRanges) -> tuple[ScoredHypothesis, ...]:
    """Return the hypotheses about one robot's anchor up to the last range to it.

    A robot that has left its anchor has the same in each tick.
    """
    points = anchors(own.path, own.ranges, own.sensing_range, own.noise)
    found = fits(alone(own.path, own.ranges, own.noise), starts_about(points))
    return with_probability([(one, 0.0) for one in found])


@lru_cache(maxsize=2)
def follow(before: tuple[Hypothesis, ...], pair: PairRanges) -> tuple[ScoredHypothesis, ...]:
    """Return the hypotheses that follow from those of the previous tick, `before`."""
    starts = [one.start for one in before]
    return _scored(fits(pair.measured, starts, Convergence(WARM_STEPS)), pair)


def settled(before: tuple[Hypothesis, ...], pair: PairRanges) -> tuple[ScoredHypothesis, ...]:
    """Return the hypotheses that follow from those of some time ago: until the likeliest has converged."""
    scored: tuple[ScoredHypothesis, ...] = ()
    for _ in range(MOST_FITS):
        scored = follow(before, pair)
        before = tuple([one.hypothesis for one in scored])
        if not scored or scored[0].fit.last_step <= FINISHED:
            break
    return scored


MOST_FITS = 4
"""The most fits in a tick: after a long way, the steps of one do not suffice to correct the path."""


def _scored(found: Sequence[Fit], pair: PairRanges) -> tuple[ScoredHypothesis, ...]:
    return with_probability([(one, detection_log_likelihood(one, pair)) for one in found])
