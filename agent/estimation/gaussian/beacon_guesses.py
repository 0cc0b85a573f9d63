"""Initial guesses for one robot from its ranges to beacons at known places, which may move.

Beacons are anchors and robots that are located. For each heading of the robot, each range leaves a circle on
which it started, and two circles have two intersections.
"""

from __future__ import annotations

import math

import numpy as np

from agent.estimation.elementary import cos, hypot, sin
from agent.estimation.gaussian.known_anchors import COARSE, ROTATIONS, AnchoredRobot, ranges_places, refined
from agent.estimation.gaussian.odometry_noise import Array
from agent.estimation.gaussian.range_model import SIGMA_FLOOR, mixture
from protocol.motion import rotated

CIRCLES = 6
"""The number of ranges whose circles are intersected, spread over all of them."""

OF_HEADING = 3
"""The number of intersections of each heading that are refined."""


def beacon_guesses(robot: AnchoredRobot) -> list[Array]:
    """Return likely guesses in the layout of `known_anchors.predicted`, each with shape (3,).

    They contain the place of the origin in the frame of the odometry, and the rotation of this frame in <W>.
    """
    ranges, path = robot.ranges, robot.path
    turns = np.linspace(-math.pi, math.pi, ROTATIONS, endpoint=False)
    c, s = cos(turns)[:, None], sin(turns)[:, None]
    px, py = path.x[ranges.tick], path.y[ranges.tick]
    place = ranges_places(robot)
    # where the robot would have started if it were at the beacon; shape (turns, N)
    dx, dy = rotated(c, s, px, py)
    x, y = place[:, 0] - dx, place[:, 1] - dy
    chosen = np.linspace(0, len(px) - 1, min(CIRCLES, len(px))).round().astype(np.intp)
    i, j = np.triu_indices(len(chosen), 1)
    i, j = chosen[i], chosen[j]
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
    likely = mixture(ranges.rho - away, hypot(ranges.sigma, COARSE * longest), robot.noise)[0]
    best = np.argsort(-likely, 1, kind="stable")[:, :OF_HEADING]
    sx, sy = np.take_along_axis(sx, best, 1), np.take_along_axis(sy, best, 1)
    guesses = np.stack((-(c * sx + s * sy), s * sx - c * sy, np.broadcast_to(turns[:, None], sx.shape)), -1)
    return refined(guesses.reshape(-1, 3), robot)
