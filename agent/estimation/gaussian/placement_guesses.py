"""Initial guesses for the placement of both robots in <W>, from closed forms of a few mutual ranges.

One robot is rotated through all headings, and a mutual range leaves two headings of the other. Each guess is
refined by Gauss-Newton on all mutual ranges. Ticks without a detection are ignored.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from agent.estimation.compiled import address, library
from agent.estimation.elementary import dot, eigh, hypot, product, summed
from agent.estimation.fit import Fit, Start
from agent.estimation.gaussian.anchor_guesses import (
    POLISHINGS,
    SAME_POSITION,
    SEED_RANGES,
    TWINS,
    UNLIKELY,
    spread_out,
)
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.odometry_noise import (
    Array,
    Errors,
    constant_effects,
    effect_covariance,
    pose_effects,
    track,
)
from agent.estimation.gaussian.range_model import SIGMA_FLOOR, mixture
from agent.estimation.gaussian.range_weights import weighted_noise
from agent.estimation.smoother import Singular
from protocol.motion import rotated

SCAN = 72
"""The number of headings that are tried for the robot nearer to its anchor.

With several radii of the other robot's circle, half as many."""

MERGED_WITHIN = 0.1
"""The distance, as a fraction of R, below which placements are merged.

A fit moves by itself along directions that the ranges leave undetermined.
"""

OFFSETS = (0.0, 1.0, -1.0, 2.0, -2.0)
"""The offsets of the far robot from its anchor's circle that are scanned, in sigmas of its radius.

With 0 alone, sweeps have the same results, but of two robots with noise and 90 % of reports damaged
(tests/test_faults.py), one stays undecided for 3 000 ticks.
"""

WIDE = 0.25
"""The sigma of that radius, in steps of the scan, from which on other offsets than 0 are scanned.

Gauss-Newton bridges smaller ones."""

RIDGE_BETWEEN = 2.0
"""The log-likelihood by which two guesses must exceed that between them to be two, however near they are.

Without it, two exact placements 0.01 rad apart are one; with much less, rounding makes one guess two."""

HEADING_DAMPING = 1e-3
"""The damping of headings in the first refinement, as a fraction of their information."""

CROWD = 60
"""The number of guesses that are kept between refinements."""

STARTS = 12
"""The number of placements from which fits begin."""

LEAST_OFFSET = 1e-9
"""The sigma (m, rad) of an offset below which it is not attributed to anything."""

FINER_TURN = 0.2
"""The factor by which the expected error of a heading decreases at each step of the refinement."""

TURN = 0.3
"""The largest change of a heading (rad) in one of these steps."""

SHORTEST_LEVER = 0.03
"""The least lever that is assumed for a heading, as a fraction of R."""


class Encounter(NamedTuple):
    """One robot at the encounter, from the ranges to its own anchor alone.

    Its position relative to its anchor, and its heading, are known up to one offset, which is common to all
    mutual ranges: the uncertainty of the anchor, and the odometry noise since the last range to it.
    """

    x: Array
    """The x (m) at the ticks of the mutual ranges, relative to the anchor, in the frame of the odometry."""
    y: Array
    root: Array
    """A square root of the covariance of the offset in x, y and heading; shape (3, 3)."""
    inverse: Array
    """The transposed pseudo-inverse of `root`; shape (3, 3)."""
    of_anchor: Array
    """The part of that covariance that is due to the anchor; shape (3, 3)."""
    odometry: tuple[Array, Array, Array] | None
    """The effects of v and omega since the last range to the anchor on the offset, (3, 2, k), the variances
    of their white errors, (2, k), and their constant errors since then, (m, 2, k); None if it is exact."""

    def begun(self, own: Fit, z: Array) -> tuple[Array, tuple[Errors, ...]]:
        """Return the anchor (m) and the odometry errors for the whitened offset `z`, shape (3,).

        Sweeps have the same results if fits begin without these errors. But of 1 524 pairs in which a had
        driven 30 m without a range, with a wandering gyro, the search misses the truth of 11 with them, and
        of 26 without.
        """
        weights = product(self.inverse, z[:, None])[:, 0]
        anchor = own.guess[:2] - product(self.of_anchor[:2], weights[:, None])[:, 0]
        if self.odometry is None:
            return anchor, own.start.errors
        effects, white, patterns = self.odometry
        constant = product(constant_effects(effects, patterns), weights[:, None])[:, 0]
        more = white * summed(weights, effects) + summed(constant, patterns)
        (begun,) = own.start.errors
        return anchor, (Errors(begun.v + more[0], begun.omega + more[1], begun.constant),)


class Placed(NamedTuple):
    """A guess for the placement of both robots in <W>, by the mutual ranges."""

    log_likelihood: float
    """The log-likelihood of the mutual ranges used, and of the offsets, up to a constant."""
    rotation: Array
    """The rotations of both frames (rad); shape (2,)."""
    offsets: Array
    """The whitened offsets of both robots (see `Encounter`); shape (2, 3)."""
    robots: tuple[Encounter, ...]
    own: tuple[Fit, Fit]
    """The fits of each robot to the ranges to its anchor."""
    pivots: Array
    """The places (m) of both anchors; shape (2, 2)."""

    @property
    def start(self) -> Start:
        """The start of a fit to all ranges."""
        poses, errors = np.empty((2, 3)), list[Errors]()
        for i, (robot, own) in enumerate(zip(self.robots, self.own, strict=True)):
            (mx, my), more = robot.begun(own, self.offsets[i])
            turn, (at_x, at_y) = float(self.rotation[i]), self.pivots[i]
            dx, dy = rotated(math.cos(turn), math.sin(turn), mx, my)
            poses[i] = at_x - dx, at_y - dy, turn
            errors += more
        return Start(poses, tuple(errors))


@lru_cache(maxsize=16)
def _encounter(own: Fit, base: int, ticks: tuple[int, ...]) -> Encounter:
    """Return the robot of the fit `own` at `ticks`, with its offset at the tick `base`.

    Each fit of one robot is placed with each of the other.
    """
    x, y = np.ascontiguousarray(own.places(0, np.array(ticks)))
    of_anchor = np.zeros((3, 3))
    of_anchor[:2, :2] = own.of_start[:2, :2]
    covariance, odometry = of_anchor, None
    if own.problem.weighing.noisy:
        earlier = own.ticks[own.ticks <= base]
        since = int(earlier[-1]) if len(earlier) else 0
        of, (errors,) = own.problem.measured, own.start.errors
        moved = np.stack((of.v[0], of.omega[0])) + np.stack((errors.v, errors.omega))
        moved += summed(errors.constant, of.patterns[0])
        white = weighted_noise(of, np.full(of.v.shape, 1.0 - own.problem.noise.odometry_strays))[0]
        effects = pose_effects(track(moved[0], moved[1], of.period, of.slip[0]), since, base)
        patterns = of.patterns[0].copy()
        patterns[:, :, :since] = 0.0
        odometry = (effects, white, patterns)
        covariance = of_anchor + effect_covariance(*odometry)
    variances, axes = eigh(covariance)
    sigmas = np.sqrt(np.maximum(variances, 0.0))
    inverse = axes * np.where(sigmas > LEAST_OFFSET, 1.0 / np.maximum(sigmas, LEAST_OFFSET), 0.0)
    return Encounter(x, y, np.ascontiguousarray(axes * sigmas), inverse, of_anchor, odometry)


def placements(own: tuple[Fit, Fit], pair: JointMeasurements) -> list[Placed]:
    """Return the most likely starts of a fit of both robots, given the mutual ranges, the likeliest first.

    `own` contains a fit of each robot to the ranges to its anchor. Their odometry noise before the encounter
    is not noise of each mutual range: it moves all of them at once. The unknowns are therefore the rotations
    of both frames, and one offset of each robot (see `Encounter`).

    The robot nearer to its anchor is rotated through all headings. One mutual range then leaves two headings
    of the other robot, at the intersections of the circles about its anchor and about the first robot
    (Section III.C with one circle rotated). The circle about its anchor is also tried with other radii,
    within its uncertainty. The other mutual ranges determine which guesses are likely.
    """
    mutual = np.flatnonzero(pair.ranges.mutual)
    places = pair.mutual_places if len(pair.mutual_places) >= SEED_RANGES else np.arange(len(mutual))
    some = mutual[places[spread_out(len(places))]]
    ticks, rho = pair.ranges.tick[some], pair.ranges.rho[some]
    sigma = np.sqrt(np.square(pair.ranges.sigma[some]) + pair.loosened[some])
    middle = len(ticks) // 2
    robots = [_encounter(one, int(ticks[middle]), tuple(ticks.tolist())) for one in own]
    radii = [float(np.mean(hypot(one.x, one.y))) for one in robots]
    near, far = (0, 1) if radii[0] < radii[1] else (1, 0)
    sign = 1.0 if far == 0 else -1.0
    between = (pair.pivots[1] - pair.pivots[0]).tolist()
    apart = (sign * between[0], sign * between[1])  # from the far robot's anchor to the near one's
    lever = np.array([max(radii[robot], SHORTEST_LEVER * pair.reach) for robot in (near, far)])
    found = _turned((robots[near], robots[far]), middle, rho, sigma, apart, lever, pair)
    offsets = found[:, 2:8].reshape(-1, 2, 3)
    return [
        Placed(float(one[8]), one[[near, far]], each[[near, far]], tuple(robots), own, pair.pivots)
        for one, each in zip(found, offsets, strict=True)
    ]


def _circles(far: Encounter, i: int, rho: float, lever: float) -> Array:
    """Return the circles of the far robot at the mutual range `rho` (m) with index `i`, as in hypotheses.c.

    `lever` is the distance (m) of the near robot to its anchor; shape (n, 8).
    """
    own = max(math.hypot(far.x[i], far.y[i]), SIGMA_FLOOR)
    outwards = product(np.array(((far.x[i], far.y[i], 0.0),)) / own, far.root)[0]
    uncertainty = math.sqrt(dot(outwards, outwards))
    offsets = OFFSETS if uncertainty > WIDE * math.tau / SCAN * lever else OFFSETS[:1]
    circles = []
    for offset in offsets:
        radius = max(own + offset * uncertainty, SIGMA_FLOOR)
        z = offset * outwards / uncertainty if offset else np.zeros(3)
        turns = SCAN if len(offsets) == 1 else SCAN // 2
        circles.append((i, turns, radius, radius**2, *z.tolist(), rho**2))
    return np.array(circles, np.float64)


def _turned(
    robots: tuple[Encounter, Encounter],
    middle: int,
    rho: Array,
    sigma: Array,
    apart: tuple[float, float],
    lever: Array,
    pair: JointMeasurements,
) -> Array:
    """Return the likeliest rotations and offsets, with their log-likelihoods as a last column; shape (n, 9).

    The guesses of the scan are refined by Gauss-Newton. The noise of the search decreases from the
    resolution of the scan to that of the ranges, because guesses between which the ranges distinguish
    would otherwise be merged. At last, two guesses are merged if the robots' positions differ by less than
    MERGED_WITHIN R, unless the likelihood falls between them. See `hypotheses.c`. Raises Singular.
    """
    ends = sorted({0, len(rho) - 1})
    circles = np.concatenate([_circles(robots[1], i, float(rho[i]), float(lever[0])) for i in ends])
    coarse = 3.0 * math.tau / SCAN * float(lever[0])
    finest = float(np.min(sigma))
    steps = max(POLISHINGS + 1, 1 + math.ceil(math.log(finest / coarse) / math.log(FINER_TURN)))
    finer = np.array([coarse * FINER_TURN**step for step in range(steps + 1)])
    damping = np.array([HEADING_DAMPING * FINER_TURN**step for step in range(steps)])
    near = MERGED_WITHIN * pair.reach + TWINS * float(np.min(hypot(sigma, finer[-1])))
    meeting = [part for one in robots for part in (one.x, one.y, one.root)]
    found = np.empty((STARTS, 9))
    count = library().placements(
        *(
            len(rho),
            middle,
            *map(address, (*meeting, rho, sigma, mixture(pair.noise), np.array(apart), lever)),
        ),
        *(
            len(circles),
            address(circles),
            int(2 * circles[:, 1].sum()),
            steps,
            address(finer),
            address(damping),
        ),
        *(TURN, SAME_POSITION * pair.reach, CROWD, UNLIKELY, near, RIDGE_BETWEEN, STARTS, address(found)),
    )
    if count < 0:
        raise Singular("the mutual ranges do not determine a placement")
    return found[:count]
