"""Initial guesses for one robot from its ranges to beacons at known places, which may move.

Beacons are anchors and robots that are located. For each heading of the robot, each range leaves a circle on
which it started, and two circles have two intersections.
"""

from __future__ import annotations

import math

import numpy as np

from agent.estimation.elementary import cos, hypot, product, sin, solve
from agent.estimation.fit import Start
from agent.estimation.gaussian.anchor_guesses import couples
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.odometry_noise import Array, Places
from agent.estimation.gaussian.range_model import SIGMA_FLOOR, inlier_probability, log_likelihood
from agent.estimation.smoother import SMALLEST_DISTANCE
from protocol.motion import rotated, rotated_back

ROTATIONS = 72
"""The number of rotations that are tried. The refinement bridges half of the 5 degrees between them."""

REFINEMENTS = 8
"""The number of Gauss-Newton steps on all guesses."""

COARSE = 0.1
"""The expected error of a guess's ranges at first, as a fraction of the longest range."""

ERROR_FINER = 0.4
"""The factor by which it decreases in each step."""

MOST_DISTINCT = 8
"""The largest number of distinct guesses, from which fits begin."""

APART, TURNED = 0.05, 0.2
"""The distance (as a fraction of the longest range) and the angle (rad) within which guesses are one."""

FEWEST_FOR_POSE = 4
"""The least number of ranges for hypotheses: there are three unknowns, and one range checks them."""

CIRCLES = 6
"""The number of ranges whose circles are intersected, spread over all of them."""

OF_HEADING = 3
"""The number of intersections of each heading that are refined."""


def beacon_guesses(robot: JointMeasurements) -> list[Array]:
    """Return likely guesses for one robot whose beacons are anchors, in the layout of `predicted`."""
    ranges, path = robot.ranges, robot.paths[0]
    px, py = path.x[ranges.tick], path.y[ranges.tick]
    turns = np.linspace(-math.pi, math.pi, ROTATIONS, endpoint=False)
    of_heading: int | None = OF_HEADING
    if np.max(hypot(px - px[-1], py - py[-1])) <= np.max(ranges.sigma):
        turns, of_heading = turns[:1], None  # a robot that stands may have any heading
    c, s = cos(turns)[:, None], sin(turns)[:, None]
    place = ranges.place
    # where the robot would have started if it were at the beacon; shape (turns, N)
    dx, dy = rotated(c, s, px, py)
    x, y = place[:, 0] - dx, place[:, 1] - dy
    i, j = couples(len(px), CIRCLES)
    dx, dy = x[:, j] - x[:, i], y[:, j] - y[:, i]
    apart = np.maximum(hypot(dx, dy), SIGMA_FLOOR)
    along = (apart**2 + ranges.rho[i] ** 2 - ranges.rho[j] ** 2) / (2.0 * apart)
    along = np.clip(along, -ranges.rho[i], ranges.rho[i])
    across = np.sqrt(ranges.rho[i] ** 2 - along**2)
    both = [
        (
            x[:, i] + (along * dx - side * across * dy) / apart,
            y[:, i] + (along * dy + side * across * dx) / apart,
        )
        for side in (1.0, -1.0)
    ]
    sx, sy = np.concatenate([one[0] for one in both], 1), np.concatenate([one[1] for one in both], 1)
    away = hypot(sx[..., None] - x[:, None], sy[..., None] - y[:, None])
    longest = max(float(np.max(ranges.rho)), SIGMA_FLOOR)
    likely = log_likelihood(ranges.rho - away, hypot(ranges.sigma, COARSE * longest), robot.noise)
    best = np.argsort(-likely, 1, kind="stable")[:, :of_heading]
    sx, sy = np.take_along_axis(sx, best, 1), np.take_along_axis(sy, best, 1)
    guesses = np.stack((-(c * sx + s * sy), s * sx - c * sy, np.broadcast_to(turns[:, None], sx.shape)), -1)
    return refined(guesses.reshape(-1, 3), robot)


def start_of(guess: Array) -> Start:
    """Return the pose of a robot at tick 0 from a guess, (3,), in the layout of `predicted`.

    A guess for an anchor in the frame of the odometry, (2,), has no rotation.
    """
    mx, my, turn = (*guess.tolist(), 0.0)[:3]
    x, y = rotated(math.cos(turn), math.sin(turn), mx, my)
    return Start(np.array([[-x, -y, turn]]))


def straight(measured: JointMeasurements) -> float:
    """Return the width (m) of a path up to which ranges hardly tell it from a straight line."""
    return 3.0 * float(np.max(measured.ranges.sigma)) + FINAL * float(np.max(measured.ranges.rho))


def line_of(points: Array) -> tuple[tuple[float, float], float, float]:
    """Return the line nearest to `points` (m), (N, 2): its foot from 0, its course (rad), and their width."""
    x, y = (points - (middle := np.mean(points, 0))).T
    xx, xy, yy = float(np.mean(x * x)), float(np.mean(x * y)), float(np.mean(y * y))
    course = 0.5 * math.atan2(2.0 * xy, xx - yy)
    c, s = math.cos(course), math.sin(course)
    off = c * float(middle[1]) - s * float(middle[0])
    width = math.sqrt(max(0.5 * (xx + yy) - math.hypot(0.5 * (xx - yy), xy), 0.0))
    return (-s * off, c * off), course, width


def refined(guesses: Array, robot: JointMeasurements) -> list[Array]:
    """Return the likeliest of `guesses` after Gauss-Newton steps on all ranges, with measured odometry."""
    ranges, path = robot.ranges, robot.paths[0]
    at = np.stack((path.x[ranges.tick], path.y[ranges.tick]))
    sigma = np.sqrt(np.square(ranges.sigma) + robot.loosened)
    longest = max(float(np.max(ranges.rho)), SIGMA_FLOOR)
    most = np.array((LONGEST_STEP * longest, LONGEST_STEP * longest, LARGEST_TURN))
    for step in range(REFINEMENTS):
        s = hypot(sigma, COARSE * longest * ERROR_FINER**step)
        distance, jacobian = predicted(guesses, at, ranges.place)
        residuals = ranges.rho - distance
        weight = inlier_probability(residuals, s, robot.noise) / np.square(s)
        weighted = np.swapaxes(jacobian * weight[..., None], 1, 2)
        information = product(weighted, jacobian)
        information.reshape(len(guesses), -1)[:, ::4] *= 1.0 + DAMPING
        information.reshape(len(guesses), -1)[:, ::4] += DAMPING / np.square(most)
        change = solve(information, product(weighted, residuals[..., None]))[..., 0]
        guesses = guesses + change / np.maximum(np.max(np.abs(change) / most, 1, keepdims=True), 1.0)
    distance, _ = predicted(guesses, at, ranges.place)
    share = OF_EXACT if robot.only_rounding else 1.0
    likely = log_likelihood(ranges.rho - distance, hypot(sigma, share * FINAL * longest), robot.noise)
    return _distinct(guesses, likely, at, share * APART * longest)


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
"""The damping of these steps, as a fraction of the information, and of that of the largest step."""

LONGEST_STEP, LARGEST_TURN = 0.2, 0.3
"""The largest step, as a fraction of the longest range, and the largest turn, in rad."""

FINAL = 0.02
"""The error of a prediction without a correction of the odometry, as a fraction of the longest range."""

OF_EXACT = 0.02
"""The part of FINAL and APART with exact sensors: two poses that explain three ranges may be nearly one."""


def _distinct(guesses: Array, likely: Array, at: Array, apart: float) -> list[Array]:
    """Return the likeliest of `guesses` that end `apart` (m) on the path `at` (m), or on other headings.

    Headings count only as far as they move the path: those of a robot that stands would leave out the mirror
    image of its place.
    """
    last, extent = at[:, -1], float(np.max(hypot(*(at - at[:, -1:]))))
    c, s = cos(guesses[:, 2]), sin(guesses[:, 2])
    x, y = last[0] - guesses[:, 0], last[1] - guesses[:, 1]
    ends = np.stack(rotated(c, s, x, y), 1)
    left: Places = np.argsort(-likely, kind="stable")
    chosen: list[Array] = []
    while len(left) and len(chosen) < MOST_DISTINCT:
        best = int(left[0])
        chosen.append(guesses[best])
        turn = np.remainder(guesses[left, 2] - guesses[best, 2] + math.pi, math.tau) - math.pi
        far = hypot(*(ends[left] - ends[best]).T) > apart
        left = left[far | ((np.abs(turn) > TURNED) & (np.abs(turn) * extent > apart))]
    return chosen
