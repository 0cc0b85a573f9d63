"""Planners to compare with, which are installed by the names `greedy`, `fisher` and `random`.

Each replaces one method of `Assured`, the manoeuvres of phase 3 with noisy sensors. With exact sensors, they
are `assured`. None keeps a safety distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from tandem.planning import Assured, Controls, Mission, PlanningHypothesis, Pose, step

Array = NDArray[np.float64]
Place = tuple[float, float]
Ways = Sequence[Controls]
NEAR = 0.9
"""The part of R within which a range is certain enough to plan with."""


class Comparing(Assured):
    """The base of planners that take the pair of manoeuvres with the largest `value`."""

    def __init__(self, turns: int = 9) -> None:
        """`turns` is the number of turn rates that are compared."""
        self.turns = turns

    def joint_manoeuvres(
        self, hypotheses: Sequence[PlanningHypothesis], m2: Place, rho: float, mission: Mission
    ) -> tuple[Controls, Controls]:
        """Return the manoeuvres of a and b for the next ticks."""
        del rho  # for a safety distance
        v = mission.first_straight / mission.period
        fastest = min(mission.max_turn_rate, np.pi / mission.period)
        rates = np.linspace(-fastest, fastest, self.turns).tolist()
        ways = [Controls(speed, rate) for speed in (v, 0.5 * v, -0.5 * v, -v) for rate in rates]
        value = self.value(hypotheses[0], ways, m2, mission)
        i, j = divmod(int(np.argmax(value)), len(ways))
        return ways[i], ways[j]

    def value(self, likeliest: PlanningHypothesis, ways: Ways, m2: Place, mission: Mission) -> Array:
        """Return the value of each pair of `ways`, of a and of b: (ways, ways)."""
        raise NotImplementedError


class Greedy(Comparing):
    """Both robots go where the next two ranges alone tell most about the most probable hypothesis."""

    def value(self, likeliest: PlanningHypothesis, ways: Ways, m2: Place, mission: Mission) -> Array:
        """Return the information of the two ranges in nats; below 0 if one is out of range."""
        slopes, outside = ranges_after(1, ways, likeliest.poses, m2, mission)
        slopes[..., (2, 5)] = 0.0  # with headings, it drives to and fro where one range tells most of them
        variance = np.einsum("...i,ij,...j", slopes, likeliest.covariance, slopes)
        return np.where(outside > 0.0, -outside, 0.5 * np.log1p(variance).sum(-1))


class Fisher(Comparing):
    """Both robots go where the next ranges give the largest determinant of the Fisher information.

    It is that of both poses under the most probable hypothesis (D-optimal design): ranges refine poses, and
    tell no hypotheses apart.
    """

    def __init__(self, turns: int = 9, ahead: int = 3) -> None:
        """`turns` is the number of turn rates that are compared, and `ahead` that of ticks with ranges."""
        super().__init__(turns)
        self.ahead = ahead

    def value(self, likeliest: PlanningHypothesis, ways: Ways, m2: Place, mission: Mission) -> Array:
        """Return the logarithm of the determinant; below all of these if the next range is out of range."""
        after = [ranges_after(tick, ways, likeliest.poses, m2, mission) for tick in range(1, self.ahead + 1)]
        slopes = np.concatenate(
            [np.where(outside[..., None, None] > 0.0, 0.0, one) for one, outside in after], 2
        )
        information = np.linalg.inv(likeliest.covariance) + np.swapaxes(slopes, 2, 3) @ slopes
        return np.where(after[0][1] > 0.0, -1e6 * after[0][1], np.linalg.slogdet(information).logabsdet)


class RandomWalk(Comparing):
    """Both robots drive at random. The measurements are the seed, so both draw the same manoeuvres."""

    def value(self, likeliest: PlanningHypothesis, ways: Ways, m2: Place, mission: Mission) -> Array:
        """Return random numbers."""
        del m2, mission
        return np.random.default_rng(crc32(likeliest.poses.tobytes())).random((len(ways), len(ways)))


def ranges_after(ticks: int, ways: Ways, poses: Array, m2: Place, mission: Mission) -> tuple[Array, Array]:
    """Return the derivatives of two ranges by the coordinates of a and b, and their sum if one is too long.

    The ranges are those from a to b and from b to M2 after `ticks` of each pair of `ways`, in sigmas: the
    derivatives are (ways, ways, 2, 6). The sum, (ways, ways), is in m, and 0 if both are NEAR.
    """
    ends = []
    for pose in (Pose(*poses[:3].tolist()), Pose(*poses[3:].tolist())):
        driven = [step(pose, way.v, way.omega, ticks * mission.period) for way in ways]
        ends.append(np.array([(one.x, one.y, pose.y - one.y, one.x - pose.x) for one in driven]))
    a, b, anchor = ends[0][:, None], ends[1][None], np.array((*m2, 0.0, 0.0))
    slopes, beyond, apart = np.zeros((len(ways), len(ways), 2, 6)), False, 0.0
    sigmas = (mission.noise.mutual_sigma, mission.noise.anchor_sigma)
    for i, (beacon, sigma) in enumerate(zip((a, anchor), sigmas, strict=True)):
        towards = b[..., :2] - beacon[..., :2]
        distance = np.maximum(np.hypot(towards[..., 0], towards[..., 1]), 1e-6)
        beyond, apart = beyond | (distance > NEAR * mission.sensing_range), apart + distance
        towards = towards / (distance * max(sigma, 1e-3))[..., None]
        slopes[..., i, 3:5], slopes[..., i, 5] = towards, (towards * b[..., 2:]).sum(-1)
        if beacon is a:
            slopes[..., i, :2], slopes[..., i, 2] = -towards, -(towards * a[..., 2:]).sum(-1)
    return slopes, np.where(beyond, apart, 0.0)
