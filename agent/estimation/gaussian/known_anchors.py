"""One robot with ranges to beacons at known places: guesses of its pose that are refined, and its fits.

The unknowns of a guess are the place of the origin in the frame of the odometry, and the rotation of this
frame, which several beacons determine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from agent.estimation.elementary import cos, hypot, product, sin, solve
from agent.estimation.fit import Start, fits
from agent.estimation.gaussian.joint_ranges import JointMeasurements, JointRanges
from agent.estimation.gaussian.odometry_noise import Array, Places, Track
from agent.estimation.gaussian.range_model import SIGMA_FLOOR, Ranges, mixture
from agent.estimation.posterior import JointHypothesis, with_probability
from agent.estimation.smoother import SMALLEST_DISTANCE
from protocol.motion import rotated, rotated_back
from protocol.noise import Noise

ROTATIONS = 72
"""The number of rotations that are tried. The refinement bridges half of the 5 degrees between them."""

REFINEMENTS = 8
"""The number of Gauss-Newton steps on all candidates."""

COARSE = 0.1
"""The expected error of a candidate's ranges at first, as a fraction of the longest range."""

ERROR_FINER = 0.4
"""The factor by which it decreases in each step."""

CANDIDATES = 8
"""The number of candidates from which fits begin."""

APART, TURNED = 0.05, 0.2
"""The distance (as a fraction of the longest range) and the angle (rad) within which candidates are one."""

FEWEST_FOR_POSE = 4
"""The least number of ranges for hypotheses: there are three unknowns, and one range checks them."""


class AnchoredRobot(NamedTuple):
    """The measurements of one robot with several anchors."""

    path: Track
    ranges: Ranges
    """The ranges, with the places of their anchors."""
    sensing_range: float
    """The longest range (m) that is expected."""
    noise: Noise

    @property
    def measured(self) -> JointMeasurements:
        """The measurements for a fit; positions are relative to the same point as those of the anchors."""
        ranges = self.ranges
        count = len(ranges.rho)
        assert ranges.place is not None
        assert ranges.radio is not None
        own = JointRanges(
            ranges.rho,
            ranges.tick,
            ranges.sigma,
            np.zeros(count, np.intp),
            np.full(count, -1),
            ranges.place,
            ranges.radio,
        )
        return JointMeasurements(("",), (), (), (self.path,), own, self.path.period, (0.0, 0.0), self.noise)


def scored_fits(robot: AnchoredRobot, starts: Sequence[Start]) -> tuple[JointHypothesis, ...]:
    """Return the hypotheses of the fits that begin at `starts`, the likeliest first."""
    return with_probability(fits(robot.measured, starts))


def start_of(guess: Array) -> Start:
    """Return the pose of a robot at tick 0 from a guess, (3,), in the layout of `predicted`."""
    mx, my, turn = guess.tolist()
    x, y = rotated(math.cos(turn), math.sin(turn), mx, my)
    return Start(np.array([[-x, -y, turn]]))


def ranges_places(robot: AnchoredRobot) -> Array:
    """Return the place (m) of each range's anchor; shape (N, 2)."""
    assert robot.ranges.place is not None
    return robot.ranges.place


def refined(guesses: Array, robot: AnchoredRobot) -> list[Array]:
    """Return the likeliest of `guesses` after Gauss-Newton steps on all ranges, with measured odometry."""
    ranges, path = robot.ranges, robot.path
    at = np.stack((path.x[ranges.tick], path.y[ranges.tick]))
    loose = ranges.loosened(robot.noise.priors, path.speeds(ranges.tick))
    sigma = np.sqrt(np.square(ranges.sigma) + loose)
    longest = max(float(np.max(ranges.rho)), SIGMA_FLOOR)
    for step in range(REFINEMENTS):
        s = hypot(sigma, COARSE * longest * ERROR_FINER**step)
        distance, jacobian = predicted(guesses, at, ranges_places(robot))
        residuals = ranges.rho - distance
        weight = mixture(residuals, s, robot.noise)[1] / np.square(s)
        weighted = np.swapaxes(jacobian * weight[..., None], 1, 2)
        information = product(weighted, jacobian)
        information.reshape(len(guesses), -1)[:, ::4] *= 1.0 + DAMPING
        information.reshape(len(guesses), -1)[:, ::4] += DAMPING
        change = solve(information, product(weighted, residuals[..., None]))[..., 0]
        most = np.array((LONGEST_STEP * longest, LONGEST_STEP * longest, LARGEST_TURN))
        guesses = guesses + change / np.maximum(np.max(np.abs(change) / most, 1, keepdims=True), 1.0)
    distance, _ = predicted(guesses, at, ranges_places(robot))
    likely = mixture(ranges.rho - distance, hypot(sigma, FINAL * longest), robot.noise)[0]
    return _distinct(guesses, likely, at[:, -1], longest)


def predicted(guesses: Array, at: Array, place: Array) -> tuple[Array, Array]:
    """Return the N ranges (m) that `guesses` predict, (n, N), and their derivatives, (n, N, 3).

    A guess has the x and y (m) of the origin in the frame of the odometry, and the rotation (rad) of this
    frame in <W>; shape (n, 3). `at` are the places (m) of the robot in its frame, (2, N), and `place` those
    of the anchors, (N, 2).
    """
    c, s = cos(guesses[:, 2:]), sin(guesses[:, 2:])
    x, y = at[0] - guesses[:, :1], at[1] - guesses[:, 1:2]
    wx, wy = rotated(c, s, x, y)
    dx, dy = wx - place[:, 0], wy - place[:, 1]
    distance = np.maximum(hypot(dx, dy), SMALLEST_DISTANCE)
    nx, ny = dx / distance, dy / distance
    along, across = rotated_back(c, s, nx, ny)
    return distance, np.stack((-along, -across, ny * wx - nx * wy), -1)


DAMPING = 1e-6
"""The damping of these steps, as a fraction of the information, and its least value."""

LONGEST_STEP, LARGEST_TURN = 0.2, 0.3
"""The largest step, as a fraction of the longest range, and the largest turn, in rad."""

FINAL = 0.02
"""The error of a prediction without a correction of the odometry, as a fraction of the longest range."""


def _distinct(guesses: Array, likely: Array, last: Array, longest: float) -> list[Array]:
    """Return the likeliest of `guesses` at different poses at the place `last` (m) of the path."""
    c, s = cos(guesses[:, 2]), sin(guesses[:, 2])
    x, y = last[0] - guesses[:, 0], last[1] - guesses[:, 1]
    ends = np.stack(rotated(c, s, x, y), 1)
    left: Places = np.argsort(-likely, kind="stable")
    chosen: list[Array] = []
    while len(left) and len(chosen) < CANDIDATES:
        best = int(left[0])
        chosen.append(guesses[best])
        turn = np.remainder(guesses[left, 2] - guesses[best, 2] + math.pi, math.tau) - math.pi
        far = hypot(*(ends[left] - ends[best]).T) > APART * longest
        left = left[far | (np.abs(turn) > TURNED)]
    return chosen
