"""The facts about any number of robots, from which every joint estimate follows.

A fact is something that was measured or told once: the motion of a robot in a tick, a range, the position of
an anchor. Estimates are functions of all facts in the order of names and ticks. So neither the order in which
facts arrive, nor how often and by which way, changes an estimate by a bit, and none counts twice. No number
of a fact is -0.0, which is equal to 0.0, and not the same.
"""

from __future__ import annotations

from typing import NamedTuple


class Manoeuvre(NamedTuple):
    """The measured motion of a robot from a tick to the next."""

    v: float
    """The forward velocity in m/s."""
    omega: float
    """The angular velocity in rad/s."""
    slip: float = 0.0
    """The angle in rad from the chord of eq. (1a) to the displacement."""
    v_variance: float = 0.0
    """The variance of v in (m/s)^2 beyond that of the noise model."""
    omega_variance: float = 0.0
    """The variance of omega in (rad/s)^2 beyond that of the noise model."""


class MeasuredRange(NamedTuple):
    """A measured range."""

    range: float
    """The range in m."""
    sigma: float
    """The standard deviation of the range in m."""
    by_second: bool = False
    """True if the second robot of its key has measured it, whose name is the larger one; else the first."""


class AnchorPlace(NamedTuple):
    """The position of an anchor in <W>."""

    x: float
    """The x coordinate in m."""
    y: float
    """The y coordinate in m."""
    sigma: float = 0.0
    """The standard deviation of each coordinate in m. 0: surveyed; infinite: unknown."""


class StartPose(NamedTuple):
    """The pose of a robot at tick 0, which is exact: without anchors, it defines the frame."""

    x: float
    """The x coordinate in m."""
    y: float
    """The y coordinate in m."""
    heading: float
    """The heading in rad."""


class MeasuredRow(NamedTuple):
    """A range with the names of its radios. There is at most one of two radios in a tick."""

    mutual: bool
    first: str
    """The robot. Of two robots, the one with the smaller name."""
    second: str
    """The anchor, or the other robot."""
    tick: int
    measured: MeasuredRange
