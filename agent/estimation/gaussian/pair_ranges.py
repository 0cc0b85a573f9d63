"""The measurements of a robot near its anchor, and of two robots: the facts of a fit in the frame of M1."""

from __future__ import annotations

import math
from functools import cached_property, lru_cache

import msgspec
import numpy as np

from agent.estimation.elementary import hypot
from agent.estimation.gaussian.joint_ranges import JointMeasurements, JointRanges, PosePrior
from agent.estimation.gaussian.odometry_noise import Places, Track
from agent.estimation.gaussian.range_model import Ranges
from protocol.noise import Noise

MOVED = 0.01
"""The fraction of R that a robot must have moved for a range to count as one from another place."""

HELD = 1e24
"""The information (1 / rad^2) of a heading that is held: more than any ranges have."""


def alone(path: Track, ranges: Ranges, noise: Noise) -> JointMeasurements:
    """Return the measurements of one robot, whose anchor is the origin.

    One anchor does not tell the heading at tick 0: it is held at 0, so the axes are those of the odometry.
    Where the anchor should be does not matter, so there is no surveying error.
    """
    told, nothing = msgspec.structs.replace(noise, survey_error=0.0), np.zeros(len(ranges.rho), np.intp)
    own = JointRanges(
        ranges.rho, ranges.tick, ranges.sigma, nothing, nothing - 1, np.zeros((len(nothing), 2)), nothing
    )
    prior = PosePrior(np.zeros((1, 3)), np.diag((0.0, 0.0, HELD)), 1, math.log(HELD))
    return JointMeasurements(("",), (), (), (path,), own, path.period, (0.0, 0.0), told, prior)


class PairRanges(msgspec.Struct, frozen=True, eq=False, dict=True):
    """The measurements of both robots; robot 0 is the paper's a."""

    paths: tuple[Track, Track]
    ranges: Ranges
    silent: tuple[Places, Places, Places]
    """The ticks without a range: of a to its anchor, of b to its anchor, and between the two."""
    apart: tuple[float, float]
    """The vector M2 - M1 (m) in <W>."""
    sensing_range: float
    noise: Noise

    def __eq__(self, other: object) -> bool:
        """Return whether `other` has the same measurements, to the bit."""
        return isinstance(other, PairRanges) and self.content == other.content

    def __hash__(self) -> int:
        """Return the hash of all measurements."""
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash(self.content)

    @cached_property
    def content(self) -> tuple[object, ...]:
        """All measurements as values that can be compared."""
        silent = tuple([ticks.tobytes() for ticks in self.silent])
        paths = tuple([path.content for path in self.paths])
        return paths, self.ranges.content, silent, self.apart, self.sensing_range, self.noise

    @cached_property
    def places(self) -> Places:
        """The indices of the first mutual range, and of each that follows a motion of a robot."""
        ticks = self.ranges.tick[self.ranges.rows(2)]
        moved = np.zeros(len(ticks), bool)
        moved[:1] = True
        for path in self.paths:
            x, y = path.x[ticks], path.y[ticks]
            moved[1:] |= hypot(np.diff(x), np.diff(y)) > MOVED * self.sensing_range
        return np.flatnonzero(moved)

    @property
    def anchors(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The places (m) of M1 and M2 relative to M1."""
        return (0.0, 0.0), self.apart

    @property
    def measured(self) -> JointMeasurements:
        """All measurements for a fit; M1 is the origin."""
        return _measured(self)

    def of(self, robot: int) -> JointMeasurements:
        """Return the path of one robot (0 or 1) and its ranges to its own anchor alone."""
        return alone(self.paths[robot], self.ranges.only(robot), self.noise)


@lru_cache(maxsize=4)
def _measured(pair: PairRanges) -> JointMeasurements:
    """Return the measurements for a fit: the same object for both robots, whose claims have the same fits."""
    ranges, kind = pair.ranges, np.repeat(np.arange(3), pair.ranges.counts)
    place = np.zeros((len(kind), 2))
    place[kind == 1] = pair.apart
    second = np.where(kind == 2, 1, -1)
    own = JointRanges(ranges.rho, ranges.tick, ranges.sigma, kind % 2, second, place, kind)
    period = pair.paths[0].period
    return JointMeasurements(("a", "b"), (), (), pair.paths, own, period, (0.0, 0.0), pair.noise)
