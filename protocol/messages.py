"""The messages of the protocol: every frame on the network, and every frame in the journal of an agent.

The journal of a world also contains its scenario (`world/scenario.py`), and that of a driver its marks
(`world/hardware/driver_journal.py`).

A message is a frozen struct. It is encoded as a msgpack array: first the tag (the class name in kebab case,
such as "robot-config"), then the fields in the order in which they are declared here. An optional field that
is not set takes one byte. `protocol/wire.py` adds the version and the checksum. `protocol/network/keys.py`
defines the key on which each message is sent.

Units are SI: m, s, rad, and their quotients. Positions and headings are given either in <W>, the world
frame, or in a robot's anchor frame, which has its origin at the robot's anchor. Tick k begins at k T_s.
Decoding checks the type and the bounds of every field, which are part of the types in `protocol/units.py`.

============== ====================================== ==========================================
Message        Direction                              When
============== ====================================== ==========================================
RobotConfig    world -> robot                         once, in answer to the robot's query
Observation    world -> robot                         every tick
Report         robot -> its peer                      every tick in which the two are in contact
Command        robot -> world                         every tick
Estimate       robot -> viewers                       every tick
GroundTruth    world -> viewers                       every tick with a subscriber
MissionEnd     world -> robot                         once, after the last tick
FinalReport    robot -> world, and back as an         once, in answer to MissionEnd
               acknowledgement
TickStart      driver -> driver of the peer; in a     every tick, in hardware mode
               group, to all drivers
DeadlineMissed journals only                          each missed deadline, in real time
Environment    journals only                          once, as the first frame
============== ====================================== ==========================================

In hardware mode, the driver's process takes the place of the world. All messages are repeated if needed,
and receiving one twice has no effect.
"""

from __future__ import annotations

import math
import re
from functools import cached_property
from typing import Annotated, ClassVar, Literal, TypeVar

import msgspec
from msgspec import Meta
from msgspec.structs import force_setattr

from protocol.attack import Attack
from protocol.coverage_strips import SweptArea, widest_distance
from protocol.mission import HEADING_ACCURACY, Anchor, Mission, Options, PlannerName, Role
from protocol.motion import Controls, Covariance, Pose, Segment
from protocol.orbits import Orbit, Rendezvous, visiting
from protocol.units import (
    Angle,
    AngularVelocity,
    Clearance,
    Count,
    Finite,
    Range,
    RobotId,
    Tick,
    Time,
    Velocity,
)

T = TypeVar("T")

Outcome = Literal["localised", "undecided", "inconsistent", "wrong", "failed"]
"""The outcome of a run. Only `localised` is a success.

- `localised`: all robots claim poses, and all claims are correct.
- `undecided`: a robot has no claim when it stops or at `max_ticks`, or one below the required accuracy.
- `inconsistent`: the measurements and reports of a robot contradict each other.
- `wrong`: a claimed pose differs from the true one by more than its tolerance.
- `failed`: a process did not answer within the timeout, or a driver raised an error.
"""

BranchKind = Literal["three-ranges", "three-ranges-virtual", "circle", "on-anchor"]
"""The observation by which phase 1 distinguished the branches +alpha and -alpha (Section III.A).

- `three-ranges`: a third range to the anchor.
- `three-ranges-virtual`: no detection at the third point, where one branch predicts a range.
- `circle`: no detection along the circle that led back into range, where one branch predicts ranges.
- `on-anchor`: none was needed. The robot started on its anchor, where both branches are the same.
"""

Probability = Annotated[float, Meta(ge=0.0, le=1.0)]
"""The probability of a hypothesis, given all measurements so far."""

MAX_TEXT = 300
"""The maximum number of characters (Unicode code points) of a Text."""
Text = Annotated[str, Meta(max_length=MAX_TEXT)]
"""A message for a user. The struct that contains one cuts longer text with `_cut`."""
Phase = Annotated[int, Meta(ge=1, le=3)]
"""The phase of the planning algorithm (Section III): 1 anchor, 2 orbit, 3 last manoeuvres."""
Word = Annotated[str, Meta(max_length=32)]
"""The name of a planner's state, such as "orbiting"."""

MAX_REPORT_RUNS = 70
"""The maximum number of segments in a Report, so that its frame fits in `wire.MAX_REPORT_BYTES`."""
MAX_REPORT_RANGES = 70
"""The maximum number of ranges in a Report, for the same reason."""

MOST_UNVERIFIED = 100
"""The most anchors that a FinalReport says no range tells about; it has to fit into a frame."""
MAX_MEMBERS = 1000
"""The maximum number of robots of a group."""

MAX_BODY_BYTES = 3890
"""The maximum size of the body of a Report, so that its frame fits in `wire.MAX_REPORT_BYTES`."""


def _cut(struct: msgspec.Struct, field: str) -> None:
    """Cut the text in `field` to MAX_TEXT characters. Escape lone surrogates, which UTF-8 cannot encode."""
    text: str | None = getattr(struct, field)
    if text is not None:
        force_setattr(struct, field, text.encode("utf-8", "backslashreplace").decode()[:MAX_TEXT])


def _tag(name: str) -> str:
    """Return the tag of a message on the wire: "robot-config" for RobotConfig."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "-", name).lower()


class Message(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True, tag=_tag):
    """The base class of all messages."""


# --- parts of messages ---


class Ranged(msgspec.Struct, frozen=True, array_like=True, gc=False, forbid_unknown_fields=True):
    """A measured range with the tick of its measurement."""

    tick: Tick
    """The tick of the measurement."""
    range: Range
    """The measured distance, in m."""


class NamedRange(msgspec.Struct, frozen=True, array_like=True, gc=False, forbid_unknown_fields=True):
    """A measured range to one of the anchors of a team."""

    anchor: RobotId
    """The anchor."""
    range: Range
    """The measured distance, in m."""


class Contact(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The contact with a robot within range R in this tick."""

    peer: RobotId
    """The other robot."""
    range: Range | None
    """The measured mutual distance, in m; None for a drop-out. Both robots get the same value."""
    heard: tuple[Tick, ...] | None
    """The ticks of the peer's Reports that are received in this tick, in the order of their arrival.

    The agent waits for exactly these. None in hardware mode, where the Reports that arrive during the tick
    count.
    """
    damaged: tuple[Tick, ...] = ()
    """The ticks of the peer's Reports that arrive damaged in this tick, and are refused."""


class LostReport(msgspec.Struct, frozen=True, array_like=True, gc=False, forbid_unknown_fields=True):
    """A Report that the channel has lost: it never arrives."""

    sender: RobotId
    """The robot that sent it."""
    tick: Tick
    """The tick in which it was sent."""


class Localised(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True, tag="localised"):
    """The claim of a robot that its pose is known."""

    pose: Pose
    """The claimed pose in <W>: m, m and rad."""
    covariance: Covariance | None = None
    """The covariance of the error of `pose`; None with exact sensors, where only rounding errors remain."""


class Undecided(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True, tag="undecided"):
    """The result of a robot that stops without a claim."""

    reason: Text
    """The reason, for a user."""

    def __post_init__(self) -> None:
        _cut(self, "reason")


class Inconsistent(
    msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True, tag="inconsistent"
):
    """The result of a robot whose measurements contradict its peer's reports, or these each other."""

    claim: Text
    """The content of the peer's reports that is contradicted, for a user."""
    residual: Annotated[float, Meta(ge=0.0, le=1e15)] | None = None
    """The size of the contradiction: in m, m/s or rad with exact sensors, and in standard deviations with
    noise; None if no hypothesis gives a residual."""
    p_value: Probability = 0.0
    """The probability of a residual at least as large if the peer's reports are true."""

    def __post_init__(self) -> None:
        _cut(self, "claim")


Verdict = Localised | Undecided | Inconsistent
"""The final result of a robot. It does not change once it has been sent in a Command or Report."""


CauseCode = Literal[
    "wrong", "inconsistent", "undecided", "position", "heading", "max-ticks", "dead", "others", "waiting",
    "no-result", "failed",
]  # fmt: skip
"""A condition that keeps a mission from ending `localised`.

- `wrong`: the robot's claim is off by the position (m) and heading (rad) in `values`; with noise, the claimed
  sigmas follow.
- `inconsistent`: the robot found the contradiction `text` in the reports of its peer, the second robot.
- `undecided`: the robot gave up, because of `text`.
- `position`, `heading`: the robot claims it with the first sigma in `values` (m or rad), and the second is
  required.
- `max-ticks`: the robots have no result at `max_ticks`.
- `dead`: the robot is dead from the tick in `values` on.
- `others`: the robots are not localised either.
- `waiting`: the robot is localised, but others are not, as far as it knows.
- `no-result`: no result of the robots was received.
- `failed`: a process or a driver has failed: `text`.
"""


VALUES_OF_CAUSES = {"wrong": (2, 4), "position": (2,), "heading": (2,), "dead": (1,)}
"""The possible numbers of values of the causes that have values."""
OF_SEVERAL = ("max-ticks", "others", "no-result")
"""The causes of one or more robots. All others are of one, or with its peer of two, and `failed` of none."""


class Cause(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A reason for the outcome of a mission. `compose/recording/reasons.py` makes the text for a user."""

    code: CauseCode
    """The condition."""
    robots: Annotated[tuple[RobotId, ...], Meta(max_length=MAX_MEMBERS)] = ()
    """The robots concerned."""
    values: Annotated[tuple[Finite, ...], Meta(max_length=4)] = ()
    """The quantities of the condition; see CauseCode."""
    text: Text | None = None
    """The statement of a planner, or of an error; None if the condition has none."""

    def __post_init__(self) -> None:
        _cut(self, "text")
        robots, values = len(self.robots), len(self.values)
        most = {"failed": 0, "inconsistent": 2}.get(
            self.code, max(1, robots) if self.code in OF_SEVERAL else 1
        )
        if not min(1, most) <= robots <= most or values not in VALUES_OF_CAUSES.get(self.code, (0,)):
            raise ValueError(f"a cause {self.code} with {robots} robots and {values} values")


Version = Annotated[str, Meta(max_length=64)]
"""The version of a library, or the name of an instruction set."""


# --- journals only ---


class Environment(Message, frozen=True):
    """The first frame of a journal: the versions on which the last bits of the recorded numbers depend."""

    tandem: Version
    """The version of Tandem."""
    c_library: Version
    """The name and version of the C library."""
    instruction_set: Version
    """The instruction set of the processor, such as "x86-64-v3"."""
    numpy: Version | None = None
    """The version of numpy and the instructions that it uses; None in the journal of a world, which does not
    use it."""
    linear_algebra: Version | None = None
    """The name and version of numpy's linear algebra library; None in the journal of a world."""


class DeadlineMissed(Message, frozen=True):
    """A placeholder in a journal for a message that did not arrive before the deadline, in real time only."""

    tick: Tick
    """The tick of the missing message."""
    robot: RobotId
    """The sender of the missing message: of a Command in a world's journal, of a Report in an agent's."""


# --- from the world to a robot ---


class Member(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A robot of a group, as all of them know it."""

    robot: RobotId
    """The robot."""
    anchor: Anchor
    """The position of its anchor in <W>, in m."""
    ends: Tick
    """The last tick within the planned bound of the time at which it is localised."""


class Appointment(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A meeting of two robots of a group at a given time, which repeats a failed one or confirms a pose."""

    visitor: RobotId
    """The robot that drives to the other one or searches for it, with the role a."""
    visited: RobotId
    """The robot that waits beside its anchor, with the role b."""
    rendezvous: Rendezvous
    """The orbits of both robots."""
    begins: Time
    """The time in s at which it begins."""
    lasts: Time
    """The bound in s of the time until both are localised."""

    def peer_of(self, robot: str) -> str:
        """Return the other one of the two robots."""
        return self.visited if robot == self.visitor else self.visitor


MOST_ASIDE = 1.25
"""The sigma of the place of a visitor at the end of its way, across it, in units of R.

Five sigmas are within reach of its search.
"""


class Pairing(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The robot that another one has to meet, and how: in a group, its first meeting.

    A robot of a group without an anchor is in no meeting: `peer` is the first of those that search for it.
    """

    peer: RobotId
    """The robot that it has to meet."""
    role: Role
    """The role of this robot in the pair; its peer has the other one."""
    peer_anchor: Anchor
    """The position of the peer's anchor in <W>, in m."""
    rendezvous: Rendezvous
    """The orbits of both robots in phase 2."""


class OfPair:
    """The anchor and the meeting of a robot, whose name is its first field. In a team, it has neither."""

    __slots__ = ()
    __struct_fields__: ClassVar[tuple[str, ...]]
    given_anchor: Anchor | None
    encounter: Pairing | None

    def _known(self, value: T | None, what: str) -> T:
        if value is None:
            raise LookupError(f"{getattr(self, self.__struct_fields__[0])} has no {what}")
        return value

    @property
    def anchor(self) -> Anchor:
        """The position of the robot's own anchor in <W>, in m. Raises LookupError if it has none."""
        return self._known(self.given_anchor, "anchor")

    @property
    def meeting(self) -> Pairing:
        """The robot that it has to meet. Raises LookupError if there is none."""
        return self._known(self.encounter, "peer")

    @property
    def peer(self) -> RobotId:
        """The robot that it has to meet."""
        return self.meeting.peer

    @property
    def role(self) -> Role:
        """The role of this robot in the pair."""
        return self.meeting.role

    @property
    def rendezvous(self) -> Rendezvous:
        """The orbits of both robots in phase 2."""
        return self.meeting.rendezvous


class TeamAnchor(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """An anchor of a team, as its robots know it."""

    id: RobotId
    """The anchor."""
    position: Anchor | None = None
    """The position in <W>, in m; None if it is unknown."""
    sigma: Clearance = 0.0
    """The standard deviation of each coordinate of `position` in m; 0 if it is surveyed."""


class Team(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The robots that share all measurements, and the anchors that they may range: all know the same."""

    robots: Annotated[tuple[RobotId, ...], Meta(max_length=MAX_MEMBERS)]
    """All robots, in the order of the scenario."""
    anchors: Annotated[tuple[TeamAnchor, ...], Meta(max_length=MAX_MEMBERS)] = ()
    """All anchors, in the order of the scenario."""
    origin: RobotId | None = None
    """The robot whose pose at tick 0 is the origin of <W>; None if anchors determine <W>."""
    bound: Time = 0.0
    """The bound in s of the time at which all robots are localised, with exact sensors."""
    survey: Clearance = 0.0
    """The sigma (m) of an anchor's position up to which robots measure before they claim their poses, of
    anchors that are not surveyed and that they have ranged; 0: they do not wait for it."""
    diameter: Clearance = 0.0
    """The largest distance (m) of a robot from the first one at the start. The others stand until that one
    has found them; 0: ranges connect all robots."""


class RobotConfig(OfPair, Message, frozen=True, dict=True):
    """The configuration of a robot: everything that its agent needs to start.

    It has either an `encounter`, in a pair or a group, or a `team`.
    """

    robot: RobotId
    """The robot that is configured."""
    encounter: Pairing | None
    """The robot that it has to meet; None in a team."""
    given_anchor: Anchor | None = msgspec.field(name="anchor")
    """The position of the robot's own anchor in <W>, in m; None if it has none."""
    mission: Mission
    """The parameters of the mission, the same for all robots."""
    planner_name: PlannerName
    """The name of the planner."""
    attack: Attack | None = None
    """The false data that the robot injects into its Reports; None for an honest robot."""
    tick_s: Annotated[float, Meta(gt=0.0, le=1e6)] | None = None
    """The duration of a tick in s of wall time; None in lockstep, where a tick has no deadline."""
    planner_options: Options = {}
    """The options of the planner, by name."""
    members: Annotated[tuple[Member, ...], Meta(max_length=MAX_MEMBERS)] = ()
    """All robots of the group that have an anchor, in the order of the scenario; empty in a pair."""
    visits: Annotated[tuple[RobotId, ...], Meta(max_length=MAX_MEMBERS)] = ()
    """The robots that this one visits after its first meeting, in their order."""
    retries: Annotated[tuple[Appointment, ...], Meta(max_length=MAX_MEMBERS)] = ()
    """The meetings in which it tries again if it is not localised by then, in their order."""
    gives_up: Time = 0.0
    """The time in s after which a robot of a group gives up if it is not localised."""
    tolerates: Annotated[int, Meta(ge=0, le=MAX_MEMBERS)] = 0
    """The number of robots that may report false data: one more must agree on a pose before it is claimed."""
    confirmations: Annotated[tuple[Appointment, ...], Meta(max_length=3 * MAX_MEMBERS)] = ()
    """The visits that it makes for this, in their order. Each lasts until the robot is back at its anchor."""
    unanchored: Annotated[tuple[RobotId, ...], Meta(max_length=MAX_MEMBERS)] = ()
    """The robots of the group without an anchor, in the order of the scenario."""
    sweep: SweptArea | None = None
    """The area in which they are, and the number of its parts; None if there are none."""
    part: Count = 0
    """The part that this robot covers first, after its visits."""
    team: Team | None = None
    """The robots with which it shares all measurements; None in a pair or a group."""
    ranges: Annotated[tuple[RobotId, ...], Meta(max_length=MAX_MEMBERS)] = ()
    """The anchors of the team that this robot may range."""

    def __post_init__(self) -> None:
        """Raise ValueError if the fields contradict each other; a frame with such fields is refused."""
        if (self.team is None) == (self.encounter is None):
            raise ValueError("team: a robot has an encounter, or it is one of a team")
        if self.team is not None:
            known = {one.id for one in self.team.anchors}
            if self.robot not in self.team.robots or not known.issuperset(self.ranges):
                raise ValueError("team: without the robot, or without an anchor that it may range")
            if self.given_anchor is not None or self.members or self.unanchored:
                raise ValueError("team: its robots have no anchor of their own, and form no group")
            return
        if (self.given_anchor is None) != (self.robot in self.unanchored):
            raise ValueError("anchor: only the robots in unanchored have none")
        if bool(self.unanchored) != (self.sweep is not None) or (self.unanchored and not self.members):
            raise ValueError("unanchored: such robots need members, and an area in which they are found")

    @property
    def peer_anchor(self) -> Anchor:
        """The position of the peer's anchor in <W>, in m."""
        return self.meeting.peer_anchor

    @property
    def m1(self) -> Anchor:
        """The anchor M1 of robot a in <W>, in m: the origin of the poses in a fit of the pair."""
        return self.anchor if self.role == "a" else self.peer_anchor

    @cached_property
    def anchor_distance(self) -> float:
        """The distance D between the two anchors, in m."""
        return math.hypot(self.anchor.x - self.peer_anchor.x, self.anchor.y - self.peer_anchor.y)

    @cached_property
    def widest_distance(self) -> float:
        """The largest distance in m between the anchors of two robots that may meet.

        The corners of the covered area count, too: the poses of robots in it follow from those of robots with
        an anchor.
        """
        places = [(one.anchor.x, one.anchor.y) for one in self.members]
        if self.sweep is not None:
            places += self.sweep.corners
        return widest_distance(tuple(places)) if len(places) > 1 else self.anchor_distance

    @property
    def group(self) -> tuple[str, ...]:
        """All robots that this one may be in contact with, and itself, in the order of the mission.

        Robots without an anchor are last.
        """
        if self.team is not None:
            return self.team.robots
        if self.members:
            return (*[member.robot for member in self.members], *self.unanchored)
        return (self.robot, self.peer) if self.role == "a" else (self.peer, self.robot)

    @property
    def others(self) -> tuple[str, ...]:
        """The robots that this one may be in contact with, in the order of the mission."""
        return tuple([robot for robot in self.group if robot != self.robot])

    @cached_property
    def orbit(self) -> Orbit:
        """The orbit of this robot in phase 2."""
        return self.rendezvous.of(self.role)

    @property
    def begins_again(self) -> bool:
        """True if a robot a that has not met b begins again at phase 1; False if the plan of a group says."""
        return not self.members and self.rendezvous.a_searches

    @property
    def confirms(self) -> bool:
        """True if the robots meet to confirm poses: some may report false data, and all have an anchor."""
        return self.tolerates > 0 and not self.unanchored

    @cached_property
    def heading_accuracy(self) -> float:
        """The largest sigma (rad) of its heading with which this robot claims its pose.

        On the way to its next planned visit, three sigmas move it aside by no more than its search reaches.
        """
        left = self.visits[self.visits.index(self.peer) + 1 :] if self.peer in self.visits else self.visits
        if not left:
            return HEADING_ACCURACY
        here, there = self.peer_anchor if self.role == "a" else self.anchor, self.member(left[0]).anchor
        way = math.hypot(here.x - there.x, here.y - there.y)
        return min(HEADING_ACCURACY, MOST_ASIDE * self.mission.sensing_range / way)

    def member(self, robot: str) -> Member:
        """Return the robot of the group with this id. Raises KeyError if there is none."""
        for member in self.members:
            if member.robot == robot:
                return member
        raise KeyError(robot)

    def in_meeting(self, peer: str, role: Role, orbits: Rendezvous | None = None) -> RobotConfig:
        """Return the configuration for a meeting with `peer` of the group, in which this robot has `role`.

        Without `orbits`, the robot of role a knows its pose, and visits the other one. Raises KeyError if
        there is no such peer.
        """
        anchor = self.member(peer).anchor
        if orbits is None:
            distance = math.hypot(self.anchor.x - anchor.x, self.anchor.y - anchor.y)
            orbits = visiting(self.mission, distance)
        return msgspec.structs.replace(self, encounter=Pairing(peer, role, anchor, orbits))


class Observation(Message, frozen=True):
    """The measurements of one robot at tick k."""

    tick: Tick
    """The tick k."""
    robot: RobotId
    """The robot that receives this."""
    executed: Controls | None
    """The odometry: measured v in m/s and omega in rad/s over [k - 1, k]; None at tick 0."""
    anchor_range: Range | None
    """The measured distance to the robot's own anchor, in m; None out of range, and for a drop-out."""
    contacts: tuple[Contact, ...] = ()
    """The contacts at tick k; empty if no robot is within range R."""
    lost: tuple[LostReport, ...] = ()
    """The Reports to this robot that are lost at tick k; empty in hardware mode, where nobody knows."""
    anchors: tuple[NamedRange, ...] = ()
    """The measured distances to anchors of the team, in their order, of those in range."""

    @property
    def nearest_anchor_range(self) -> float | None:
        """The measured distance to the nearest anchor, in m; None if there is none."""
        ranges = [one.range for one in self.anchors]
        return min(ranges, default=None) if self.anchor_range is None else self.anchor_range


class MissionEnd(Message, frozen=True):
    """The end of the mission, sent in place of the next Observation."""

    tick: Tick
    """The last tick."""
    outcome: Outcome
    """The outcome of the run."""
    causes: tuple[Cause, ...] = ()
    """The reasons for the outcome, the main one first; empty if it is `localised`."""


# --- from a robot ---


class ReportedPose(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The pose that a localised robot tells one that has no anchor, and cannot compute it itself."""

    tick: Tick
    """The tick of `pose`."""
    pose: Pose
    """The sender's pose at that tick in <W>: m, m and rad."""
    covariance: Covariance | None = None
    """The covariance of the error of `pose`; None with exact sensors."""


class Report(Message, frozen=True):
    """The part of a robot's motion log, up to tick k, that its peer has not acknowledged.

    Manoeuvres and ranges are acknowledged separately, so that a long backlog of ranges never delays the
    manoeuvres, from which the peer computes where this robot is.

    To a robot without an anchor it has a `prior` instead; with noisy sensors also the manoeuvres since its
    tick, which stays the same while the two are in contact. So the error of the pose at that tick is one
    unknown, which counts once.

    With a planner that has reports of its own, it has a `body`, and of the other fields only the verdict and
    the acknowledgement.
    """

    tick: Tick
    """The tick k in which this is sent."""
    robot: RobotId
    """The sender."""
    phase: Phase = 1
    """The phase of the sender's planner."""
    state: Word = ""
    """The state of the sender's planner."""
    start: Pose | None = None
    """The sender's pose at tick 0 in its anchor frame: m, m and rad; None until phase 1 is done."""
    since: Tick = 0
    """The tick at which `runs` begins."""
    through: Tick = 0
    """The tick at which `runs` ends: it contains the manoeuvres over [since, through]."""
    runs: Annotated[tuple[Segment, ...], Meta(max_length=MAX_REPORT_RUNS)] = ()
    """The measured manoeuvres over [since, through], run-length encoded, in m/s and rad/s."""
    ranges_since: Count = 0
    """The number of the sender's anchor ranges that precede `ranges`."""
    ranges: Annotated[tuple[Ranged, ...], Meta(max_length=MAX_REPORT_RANGES)] = ()
    """The sender's ranges to its own anchor, in m, in increasing order of their ticks."""
    heard: Tick = 0
    """The acknowledgement of manoeuvres: the sender has the receiver's manoeuvres over [0, heard].

    With a `body`, it is the tick of the receiver's latest report that the sender has received.
    """
    ranges_heard: Count = 0
    """The acknowledgement of ranges: the sender has this many of the receiver's anchor ranges."""
    verdict: Verdict | None = None
    """The sender's final result; None until it has one. With a `body`, that of the tick before, its reason
    cut short."""
    prior: ReportedPose | None = None
    """The sender's pose, for a receiver without an anchor; None to others."""
    strips: tuple[Count, Count] | None = None
    """The strips that the sender has still to begin: the first, and the one after the last. None if it leaves
    none to other robots: under noise, where robots may report false data, and where it covers no area."""
    body: Annotated[bytes, Meta(max_length=MAX_BODY_BYTES)] | None = None
    """The value that `Planner.report` returns, in msgpack; None from the shipped planners."""

    @property
    def has_log(self) -> bool:
        """True if this contains the log of the sender, or a body; False to a robot that it does not meet."""
        logs = self.start is not None or self.through > 0 or self.body is not None
        return logs and self.prior is None


class Command(Message, frozen=True):
    """The controls of a robot over [k, k + 1], and its final result."""

    tick: Tick
    """The tick k of the Observation that this answers."""
    robot: RobotId
    """The sender."""
    v: Velocity
    """The forward velocity, in m/s. The world limits it to +-v_max."""
    omega: AngularVelocity
    """The angular velocity, in rad/s, counter-clockwise. The world limits it to +-omega_max."""
    phase: Phase
    """The phase of the sender's task."""
    task: Word
    """The name of what the sender is doing, as its planner calls it; the column `state` of files."""
    verdict: Verdict | None = None
    """The sender's final result; None until it has one. The world keeps the first."""
    peer: RobotId | None = None
    """The robot that the sender meets, waits for or drives to; None if there is none."""
    role: Role | None = None
    """The role of the sender in the meeting with `peer`; None without one."""
    rests: bool = False
    """True if the sender has its result, and no robot or area to drive to: it stays where it is."""


class SurveyedAnchor(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The estimate of an anchor of a team that is not surveyed."""

    id: RobotId
    """The anchor."""
    position: Anchor
    """The position in <W> by the most probable hypothesis, in m."""
    sigma: Clearance
    """The root of the trace of the covariance of `position` in m."""


class Estimate(Message, frozen=True):
    """The hypotheses of a robot at tick k."""

    tick: Tick
    """The tick k."""
    robot: RobotId
    """The sender."""
    local: tuple[Pose, ...]
    """The hypotheses in the robot's anchor frame, in a team in that of its start: m, m and rad."""
    world: tuple[Pose, ...]
    """The hypotheses in <W>: m, m and rad; empty before there are any."""
    localised: bool
    """True if the robot claims its pose."""
    probabilities: tuple[Probability, ...] = ()
    """The probabilities of the poses in `world`, or of those in `local` while `world` is empty.

    They are in the order of the poses, most probable first, and sum to 1. Empty where they are not known, and
    with exact sensors, where all remaining poses are equally probable.
    """
    covariance: Covariance | None = None
    """The covariance of the error of the first pose in `world`; None with exact sensors."""
    anchors: Annotated[tuple[SurveyedAnchor, ...], Meta(max_length=MAX_MEMBERS)] = ()
    """The anchors of a team that are not surveyed, as far as they are located."""

    def __post_init__(self) -> None:
        """Raise ValueError if there are probabilities, and not one for each pose; a frame is refused then."""
        poses, probabilities = len(self.world or self.local), len(self.probabilities)
        if probabilities not in (0, poses):
            raise ValueError(f"probabilities: {probabilities} of {poses} poses")


class FinalReport(Message, frozen=True):
    """The statistics of a robot about its mission, in answer to MissionEnd.

    The world sends it back to the robot to acknowledge that it is in the recording.
    """

    robot: RobotId
    """The sender."""
    anchor_ranges: Count
    """The number of ranges measured to the robot's own anchor."""
    mutual_ranges: Count
    """The number of ranges measured to the peer."""
    branch: BranchKind | None
    """The observation that decided the branch in phase 1; None if phase 1 was not finished."""
    alpha: Angle | None
    """The signed angle alpha of eq. (2), in rad; None if phase 1 was not finished."""
    candidates: tuple[Count, Count] | None
    """The number of solutions of eq. (7): all of them, and those that predict no detection where there was
    none. With noise, the number of hypotheses at first and last. None if the robots did not meet."""
    last_turn_rate: AngularVelocity | None
    """The latest planned omega_2 of eq. (8), in rad/s; None if none was planned. Robot a plans one only
    if that of b did not decide."""
    separation_m2: Annotated[float, Meta(ge=0.0, le=1e15)] | None
    """The cost J of eq. (8) for `last_turn_rate`, with squared ranges, in m^2; None if no manoeuvre was
    planned, or if there was only one hypothesis."""
    hypotheses: Count | None
    """The number of remaining hypotheses about the poses of both robots; None if the robots did not meet."""
    probability: Probability | None
    """The probability of the most probable hypothesis; None with exact sensors."""
    blocking_reason: Text | None
    """The condition that still prevents a claim, for a user; None if there is none, or with exact sensors."""
    p_value: Probability | None
    """The smallest p-value of all consistency tests; None with exact sensors, and if there was no test."""
    reports_sent: Count
    """The number of Reports sent."""
    reports_heard: Count
    """The number of the peer's Reports received and used."""
    reports_refused: Count
    """The number of the peer's Reports refused: damaged, malformed, or not from their stated sender."""
    reports_unheard: Count
    """The number of the peer's Reports that arrived from out of contact, or too late to be used."""
    reports_lost: Count
    """The number of the peer's Reports that were lost; in hardware mode, of those that did not arrive."""
    frames_refused: Count
    """The number of refused frames of all kinds."""
    bytes_sent: Count
    """The total size of the Reports sent, in bytes."""
    unverified_anchors: Annotated[dict[RobotId, Text], Meta(max_length=MOST_UNVERIFIED)] = {}
    """The anchors of a team of which no range tells whether they stand as far off as `accuracy`, with the
    direction: across the line of the only two, for instance. Empty for others, and before a claim."""

    def __post_init__(self) -> None:
        _cut(self, "blocking_reason")
        cut = {name: text[:MAX_TEXT] for name, text in [*self.unverified_anchors.items()][:MOST_UNVERIFIED]}
        force_setattr(self, "unverified_anchors", cut)


# --- to viewers, and between drivers ---


class GroundTruth(Message, frozen=True):
    """The true poses of all robots at tick k."""

    tick: Tick
    """The tick k."""
    poses: dict[RobotId, Pose]
    """The true pose of each robot in <W>: m, m and rad."""


class TickStart(Message, frozen=True):
    """The start of tick k at one robot's driver, from which the peer's driver sets its clock.

    It also contains what ends the mission of others. A driver also sends it to its own agent, while it waits
    for other robots and tick k cannot begin yet.
    """

    tick: Tick
    """The tick k."""
    robot: RobotId
    """The robot of the sending driver."""
    verdict: Verdict | None = None
    """The final result of the robot; None until it has one."""
    complete: bool = False
    """True if the robot has its result, and waits for no other robot."""


OfRobot = (
    Environment
    | RobotConfig
    | Observation
    | Report
    | Command
    | Estimate
    | DeadlineMissed
    | MissionEnd
    | FinalReport
)
"""The messages in the journal of an agent."""
