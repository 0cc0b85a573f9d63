"""The state of a robot of a group: its present meeting, and its knowledge about the other robots."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
from msgspec.structs import replace

from agent.planning.passing import Bypass
from agent.planning.state import RobotState
from agent.planning.sweep import Looping, Sweeping
from protocol.messages import Localised, Ranged, ReportedPose, RobotConfig, Verdict
from protocol.motion import ORIGIN, Pose, compose, inverse


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

    meetings: tuple[RobotState, ...] = ()
    """The states at the claims in its meetings with different peers, in the order of these meetings."""
    visits: int = 0
    """The number of visits for this that the robot has begun or left out."""
    until: float | None = None
    """The time in s at which the present one ends; None if there is none."""
    ranges: int = 0
    """The number of ranges to its anchor when it has last compared the poses of its meetings."""


class GroupState(msgspec.Struct, frozen=True):
    """The state of a robot of a group."""

    pair: RobotState
    """The state in the present meeting. Its configuration names the peer and the role."""
    visits: int = 0
    """The number of planned visits that the robot has begun or left out."""
    retries: int = 0
    """The number of retries whose time has come."""
    parts: int = 0
    """The number of parts of an area that the robot has begun to sweep for robots without an anchor."""
    part_tick: int = -1
    """The tick in which it began the latest of them."""
    until: float | None = None
    """The time in s at which the search of a retry ends; None if there is none."""
    alone: bool = False
    """True if the robot is at its anchor, or on its way there, and in no meeting until a visitor comes."""
    visiting: bool = False
    """True if the present meeting is a visit: the robot knows its pose already."""
    located: RobotState | None = None
    """The state in the latest meeting in which the robot was localised, at its claim."""
    own_pose: OwnPose = OwnPose()
    """The accuracy of its pose while it sweeps, with noisy sensors."""
    verdict: Verdict | None = None
    """The verdict of the robot: the pose that it claims, or why it claims none.

    It is None again when another meeting contradicts that one.
    """
    fix: Fix | None = None
    """The pose that the robot knows, and by which it drives; None until a meeting has determined it."""
    confirming: Confirming = Confirming()
    """The meetings that confirm that pose, if a claim of it needs several peers."""
    failure: Verdict | None = None
    """The verdict of the latest meeting that has failed before the robot was localised."""
    frame: Pose = ORIGIN
    """The pose in <W> of the odometry's frame, from the latest meeting in which the robot was localised."""
    framed_at: Pose = ORIGIN
    """The odometry where `frame` was determined. An error of its heading turns ways about this place."""
    others: Mapping[str, Other] = {}
    """The knowledge about each robot that this one has been in range of, or heard of."""
    unmet: int = 0
    """The number of consecutive ticks out of range of the peer since this robot's verdict in the meeting."""
    passing: Bypass = Bypass()
    """The way past robots of other meetings, if the mission has a safety distance."""
    lingering: int = 0
    """The number of consecutive ticks in range of the peer since the end of their meeting."""
    silence: int = 0
    """The number of consecutive ticks in range of the peer without a log of it."""

    @property
    def waits(self) -> bool:
        """Return whether the robot meets visitors: it knows no pose yet, or is back at its anchor."""
        if self.fix is None:
            return self.verdict is None
        return not (self.visiting or self.sweeps) and self.pair.verdict is None

    @property
    def meets(self) -> bool:
        """Return whether the robot exchanges logs with its peer, if they are in contact."""
        return not (self.alone or self.sweeps)

    @property
    def sweeps(self) -> bool:
        """Return whether the robot sweeps an area, or has stopped for a robot without an anchor."""
        return isinstance(self.pair.mode, Sweeping | Looping)

    @property
    def config(self) -> RobotConfig:
        """The configuration, with the peer and the role of the present meeting."""
        return self.pair.config

    def with_frame(self, pose: Pose) -> GroupState:
        """Return this state of a robot that has determined its present `pose` in <W>."""
        odometry = self.pair.odometry
        return replace(self, frame=compose(pose, inverse(odometry)), framed_at=odometry)

    def other(self, robot: str) -> Other:
        """Return what the robot knows of `robot`."""
        return self.others.get(robot, Other())

    def with_other(self, robot: str, other: Other) -> GroupState:
        """Return this state with what the robot now knows of `robot`."""
        return replace(self, others={**self.others, robot: other})
