"""The knowledge of a robot of a group besides its present meeting: of others, and by earlier meetings."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from agent.estimation.gaussian.contact_fit import ContactEstimate
from agent.estimation.knowledge import Knowledge
from agent.estimation.resection import RangedPlace
from agent.peer.motion_log import MotionLog
from protocol.messages import Localised, Ranged, ReportedPose
from protocol.motion import ORIGIN, Covariance, Pose


class Other(msgspec.Struct, frozen=True):
    """The knowledge of a robot about another one of its group, besides the logs of their present meeting."""

    mutual: tuple[Ranged, ...] = ()
    """The ranges to it."""
    localised: bool = False
    """True once it has reported that it is localised."""
    failed: bool = False
    """True once a meeting with it has failed: this robot does not meet it again."""
    served: bool = False
    """True once it has no anchor, and has reported that it knows its pose by this robot, and waits for others
    to confirm it."""
    travels: bool = False
    """True if it drives to another robot, by its latest report. It counts only with a safety distance."""
    missed: int | None = None
    """The latest tick in which this robot has not found it where it should wait; None if there is none."""
    acknowledged: int = 0
    """The last tick of this robot's manoeuvres that it has acknowledged, if it has no anchor."""


class OwnPose(msgspec.Struct, frozen=True):
    """The latest estimates of its own pose that a sweeping robot with noisy sensors has made."""

    estimated_tick: int | None = None
    """The tick of the latest estimate; None if the next one is due at once."""
    ranges: int = 0
    """The number of ranges in the latest estimate, to its anchor and to its peer."""
    sigma: float = 0.0
    """The sigma of its position in the latest estimate, in m."""
    ranges_when_lost: int | None = None
    """The number of ranges that it had when sigma was last too large and further ones came; None if never."""
    searched_tick: int | None = None
    """The tick of the latest search of the whole plane, when a contact began; None before the first."""
    reference: ReportedPose | None = None
    """The pose when this contact with robots without an anchor began, which it reports to them; None if it
    reports none."""


class Fix(msgspec.Struct, frozen=True):
    """The pose that a robot knows, by its latest meeting that agrees with the earlier ones."""

    tick: int
    """The tick in which it claimed the pose in that meeting."""
    claim: Localised
    """That claim."""
    peers: tuple[str, ...]
    """The robots whose meetings agree, in their order."""


class Confirming(msgspec.Struct, frozen=True):
    """The meetings that confirm the pose of a robot, if robots of its group may report false data."""

    meetings: tuple[Knowledge, ...] = ()
    """The knowledge at the claims in its meetings with different peers, in the order of these meetings."""
    visits: int = 0
    """The number of visits for this that the robot has begun or left out."""
    until: float | None = None
    """The time in s at which the present one ends; None if there is none."""
    ranges: int = 0
    """The number of ranges to its anchor when it has last compared the poses of its meetings."""


# --- a robot without an anchor --------------------------------------------------------------------------


class Resected(msgspec.Struct, frozen=True):
    """The knowledge of a robot without an anchor, exact sensors: ranges to robots that report their poses."""

    base: Pose = ORIGIN
    """The odometry at the place where it stands, or stood before its square."""
    ranges: Mapping[tuple[str, int], tuple[float, Pose]] = {}
    """The ranges without a reported pose yet, with the own pose relative to `base`, by robot and tick."""
    places: Mapping[tuple[str, int], RangedPlace] = {}
    """The ranges to robots that have reported their poses in those ticks, by robot and tick."""
    possible: tuple[Pose, ...] = ()
    """The poses of `base` in <W> that agree with the ranges; empty before the heading can be determined."""
    candidates: Mapping[str, Pose] = {}
    """The pose in <W> of the frame of the odometry, by the robot from whose reports it follows."""


class Finder(msgspec.Struct, frozen=True):
    """The localised robot that has found one without an anchor, as far as the latter knows it."""

    robot: str
    reference: int
    """The tick of `pose`."""
    pose: Pose
    """The pose of the finder at that tick in <W>, as it has estimated it."""
    covariance: Covariance
    """The covariance of the error of `pose`."""
    log: MotionLog
    """The manoeuvres of that robot from the reference tick on."""
    latest: int
    """The tick of its latest report."""


class Contacted(msgspec.Struct, frozen=True):
    """The knowledge of a robot without an anchor with noisy sensors: by the robot that has found it."""

    finder: Finder | None = None
    """The robot that has found it; None while there is none."""
    estimate: ContactEstimate | None = None
    """The latest estimate of the pose; None without one."""
    estimated_tick: int = -1
    """The tick of the latest estimate; -1 before the first."""
    ranges_at_estimate: int = 0
    """The number of ranges to the finder at the latest estimate."""
    failure: str = "no localised robot has found it"
    """The reason for which it has no claim yet."""
