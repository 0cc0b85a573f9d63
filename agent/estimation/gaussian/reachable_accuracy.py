"""The accuracy that noise allows: the sigma of a reference mission, and that of a robot that covers an area.

White noise averages out over many ranges, a bias does so only as far as the geometry tells it from distances.
The reference mission has more ranges than a typical one, and no white odometry noise. With an accuracy far
below that, robots would measure for ever.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np
from msgspec.structs import replace

from agent.estimation.elementary import hypot
from agent.estimation.fit import Start, deviation, fits
from agent.estimation.gauss_newton import Convergence
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.measured_rows import near_anchors
from agent.estimation.gaussian.odometry_noise import Array, expected_variances, position_variances, track
from protocol.coverage_strips import Place
from protocol.coverage_ticks import straight_ticks
from protocol.mission import Mission
from protocol.motion import rotated
from protocol.noise import Noise, VelocityNoise

PRIORS = {
    "range_bias": "measure the bias of the radios at known distances",
    "pair_bias": "measure the bias of each pair of radios",
    "range_scale": "measure ranges at two known distances",
    "slow_sigma": "take ranges with a clear line of sight",
    "wheel_scale": "drive a known distance, and a known number of turns",
    "gyro_bias": "measure the gyro at rest, and while a robot drives straight on",
    "survey_error": "survey the anchors more accurately",
    "range_delay": "stamp ranges with the time of their measurement",
}
"""The priors that may forbid an accuracy, and what makes each of them narrower."""

AROUND_ANCHOR = 20
"""The number of ticks in which a robot of the reference mission circles its anchor."""

TOGETHER = 60
"""The number of ticks in which both robots of the reference mission measure mutual ranges."""

ACTIVE = 1.5
"""The factor by which a mission may be more accurate than the reference mission, whose way is not optimal.

Robots choose where to range and may take more ranges, so it is more than 1: the reference mission reaches
0.11 m where all missions of the sweep `noise` localise to 0.1 m (sigma 0.1 m). With 2, the profile `uwb`
would be accepted at 0.1 m, although it reaches 0.19 m.
"""

ACTIVE_SEARCH = 1.25
"""ACTIVE of a group in which robots have no anchor: the error of the robot that finds them adds to theirs.

Of four robots, two of them without an anchor, all were localised at the first passage in 12 of 12 missions
with 0.8 to 1 of the accuracy in the reference mission. With 1 to 1.2, 10 of 12 were localised, 5 of them late
(sigmas of 0.05 and 0.2 m, with and without priors); with 1.4 to 1.5, 0 of 5 were.
"""


@lru_cache(maxsize=64)
def unreachable(mission: Mission, distance: float, active: float) -> str | None:
    """Return why a group cannot reach the accuracy of a noisy `mission`, with the field; None if it can.

    `distance` is that of two anchors in m. A mission may be `active` times as accurate as the reference
    mission. The variance that is due to white noise alone decreases with the number of ranges.
    """
    white = reference_sigma(mission, distance, mission.noise.as_told)
    if not active * mission.accuracy < white < math.inf:
        return forbidding_prior(mission, distance, active)
    ranges = TOGETHER * (white / mission.accuracy) ** 2
    return (
        f"accuracy: {mission.accuracy:.3g} m needs about {ranges:.0f} mutual ranges with noise.mutual_sigma "
        f"= {mission.noise.mutual_sigma:.3g} m, more than the {TOGETHER * active**2:.0f} that a group "
        f"may take: set at least {rounded_up(white / active):g} m"
    )


def rounded_up(value: float) -> float:
    """Return the smallest number with two digits that is not less than `value`, which is positive."""
    digits = 1 - math.floor(math.log10(value))
    return round(math.ceil(value * 10.0**digits) / 10.0**digits, max(digits, 0))


@lru_cache(maxsize=64)
def forbidding_prior(mission: Mission, distance: float, active: float = ACTIVE) -> str | None:
    """Return the field and why a prior forbids the accuracy of a noisy `mission`; None if none does.

    `distance` is that of the anchors in m, and `active` as in `unreachable`. Where white noise alone would
    forbid it, no prior is named.
    """
    noise = mission.noise
    reached = reference_sigma(mission, distance, noise)
    most = active * mission.accuracy
    if not most < reached < math.inf or reference_sigma(mission, distance, noise.as_told) > most:
        return None
    without = {
        name: reference_sigma(mission, distance, replace(noise, **{name: 0.0}))
        for name in PRIORS
        if getattr(noise.priors, name)
    }
    worst = min(without, key=without.__getitem__)
    size = getattr(noise.priors, worst)
    return (
        f"accuracy: the prior noise.{worst} = {size:.3g} forbids {mission.accuracy:.3g} m; "
        f"{TOGETHER} mutual ranges give {reached:.2g} m: {PRIORS[worst]}, and set a smaller prior"
    )


def reference_sigma(mission: Mission, distance: float, noise: Noise) -> float:
    """Return the larger sigma (m) of both positions after the reference mission."""
    reach, period = mission.sensing_range, mission.period
    turn = math.tau / AROUND_ANCHOR
    radius = 0.3 * reach
    anchor, apart = (0.25 * reach, 0.5 * reach), (distance, 0.0)
    paths, starts, lists, places = [], [], [], []
    for way, sign, turned, at in (
        (max(distance - 0.8 * reach, 0.0), 1.0, 0.0, (0.0, 0.0)),
        (0.0, -0.7, 0.7, apart),
    ):
        around = np.full(AROUND_ANCHOR, radius * turn)
        again = np.full(TOGETHER, around[0])
        v = np.concatenate((around, (way,), again)) / period
        omega = (
            np.concatenate((np.full(AROUND_ANCHOR, turn), (0.0,), np.full(TOGETHER, sign * turn))) / period
        )
        path = track(v, omega, period)
        rho = hypot(path.x - anchor[0], path.y - anchor[1])
        lists.append([(tick, float(rho[tick])) for tick in np.flatnonzero(rho <= reach).tolist()])
        c, s = math.cos(turned), math.sin(turned)
        x, y = rotated(c, s, path.x - anchor[0], path.y - anchor[1])
        places.append((at[0] + x, at[1] + y))
        starts.append((places[-1][0][0], places[-1][1][0], turned))
        paths.append(path)
    (ax, ay), (bx, by) = places
    gap = hypot(ax - bx, ay - by)
    together = range(AROUND_ANCHOR + 1, AROUND_ANCHOR + TOGETHER + 2)
    white = replace(
        noise, odometry=VelocityNoise(), outliers=0.0, strays=0.0, odometry_strays=0.0, sigma_degrees=0.0
    )
    mutual = [(tick, float(gap[tick])) for tick in together]
    pair = near_anchors(paths, lists, ((0.0, 0.0), apart), white, reach, mutual)
    return max(position_sigmas(pair, np.array(starts)))


def position_sigmas(pair: JointMeasurements, poses: Array) -> list[float]:
    """Return the sigma (m) of each robot's last position if their `poses` at tick 0, (2, 3), are the truth.

    It is infinite if the ranges do not determine the poses.
    """
    for fit in fits(pair, [Start(poses)], Convergence(0)):
        return [deviation(float(fit.covariance[i, i] + fit.covariance[i + 1, i + 1])) for i in (0, 3)]
    return [math.inf, math.inf]


def covering_sigma(mission: Mission, way: Sequence[Place]) -> float:
    """Return the median sigma (m) of the position of a robot that drives along `way` (m) from a known pose.

    The sigma is that of the white noise of its odometry; the median is over all ticks of the way.
    """
    v, omega = _driven(way, mission)
    white = expected_variances(v, omega, mission.noise, mission.period)
    path, constant = track(v, omega, mission.period), np.zeros((0, 2, len(v)))
    return float(np.median(np.sqrt(position_variances(path, white, constant)[1:])))


def _driven(way: Sequence[Place], mission: Mission) -> tuple[Array, Array]:
    """Return v (m/s) and omega (rad/s) in each tick of a robot that drives along `way` (m)."""
    moves: list[tuple[float, float, int]] = []
    """The length (m) and the angle (rad) of the motion of a tick, and the number of such ticks."""
    heading: float | None = None
    for begin, end in pairwise(way):
        ahead = math.atan2(end[1] - begin[1], end[0] - begin[0])
        turn = 0.0 if heading is None else math.remainder(ahead - heading, math.tau)
        length, heading = math.dist(begin, end), ahead
        turning = math.ceil(abs(turn) / (mission.max_turn_rate * mission.period))
        driving = straight_ticks(length, mission)
        moves += [(0.0, turn / max(turning, 1), turning), (length / max(driving, 1), 0.0, driving)]
    ticks = [count for _, _, count in moves]
    v, omega = (np.repeat([one[i] / mission.period for one in moves], ticks) for i in (0, 1))
    return v, omega
