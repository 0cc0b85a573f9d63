"""Everything that crosses the wire or enters a journal: frozen structs, encoded as tagged msgpack arrays.

Units and bounds are in the types. Each message names its tick and, where one robot says it, the robot;
so a frame explains itself wherever it is found.
"""

from __future__ import annotations

import math
import re
from typing import Annotated, Literal

import msgspec
from msgspec import Meta
from msgspec.structs import force_setattr

from protocol.attack import Attack
from protocol.mission import Anchor, Mission, PlannerName, Role
from protocol.motion import Controls, Covariance, Pose, Segment
from protocol.orbits import Rendezvous
from protocol.units import (
    Angle,
    AngularVelocity,
    Count,
    Range,
    RobotId,
    Tick,
    Velocity,
)

Outcome = Literal["localised", "undecided", "inconsistent", "wrong", "failed"]
"""How a run ended; only the first is a success."""

BranchKind = Literal["three-ranges", "three-ranges-virtual", "circle", "on-anchor"]
"""How phase 1 told +alpha from -alpha."""

Probability = Annotated[float, Meta(ge=0.0, le=1.0)]
"""the probability of a hypothesis, given what has been measured"""

MAX_TEXT = 300
"""characters (Unicode code points)"""
Text = Annotated[str, Meta(max_length=MAX_TEXT)]
"""in words, of what can be of any length; whoever holds one cuts it (`_cut`)"""
Phase = Annotated[int, Meta(ge=1, le=3)]
Word = Annotated[str, Meta(max_length=32)]

MAX_REPORT_RUNS = 70
MAX_REPORT_RANGES = 70
"""so many at the most that a report's frame stays within `wire.MAX_REPORT_BYTES`"""


def _cut(said: msgspec.Struct, field: str) -> None:
    """Cut the text in `field` to its bound, and escape what no frame can hold: half of a surrogate pair."""
    words: str | None = getattr(said, field)
    if words is not None:
        force_setattr(said, field, words.encode("utf-8", "backslashreplace").decode()[:MAX_TEXT])


def _tag(name: str) -> str:
    """Return the tag of a message on the wire: "robot-config" for RobotConfig."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "-", name).lower()


class Message(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True, tag=_tag):
    """A frame's content."""


class Ranged(msgspec.Struct, frozen=True, array_like=True, gc=False, forbid_unknown_fields=True):
    """A range and the tick it was measured in."""

    tick: Tick
    range: Range


class Contact(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A robot within range of this one, now."""

    peer: RobotId
    range: Range | None
    heard: tuple[Tick, ...] | None
    """the ticks of those of the peer's reports that reach this robot now, in order; none without a world:
    what arrives within the tick counts"""
    damaged: tuple[Tick, ...] = ()
    """of those that reach it damaged, and are refused"""


class Localised(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True, tag="localised"):
    """The claim to know one's pose in the world frame."""

    pose: Pose
    covariance: Covariance | None = None
    """of its error; none where sensors are exact, and what is left is rounding"""


class Undecided(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True, tag="undecided"):
    """The robot cannot go on, and does not guess."""

    reason: Text

    def __post_init__(self) -> None:
        _cut(self, "reason")


class Inconsistent(
    msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True, tag="inconsistent"
):
    """The peer tells what cannot be so."""

    claim: Text
    """of the peer"""
    residual: Annotated[float, Meta(ge=0.0, le=1e15)] | None = None
    """by how much it cannot: m, m/s or rad; under noise sigmas; none where nothing comes near it"""
    p_value: Probability = 0.0
    """how probable that much is, if the peer is honest"""

    def __post_init__(self) -> None:
        _cut(self, "claim")


Verdict = Localised | Undecided | Inconsistent


Version = Annotated[str, Meta(max_length=64)]


class Environment(Message, frozen=True):
    """The first frame of a journal: what the last bits of its numbers depend on beside the inputs."""

    tandem: Version
    c_library: Version
    instruction_set: Version
    numpy: Version | None = None
    """and the instructions that it uses; none in a world's journal, which is made without, nor the next"""
    linear_algebra: Version | None = None


class RobotConfig(Message, frozen=True):
    """Everything that a robot needs to start."""

    robot: RobotId
    peer: RobotId
    role: Role
    anchor: Anchor
    """its own"""
    peer_anchor: Anchor
    mission: Mission
    planner_name: PlannerName
    rendezvous: Rendezvous
    attack: Attack | None
    """what it is told to tell its peer, instead of the truth"""
    tick_s: Annotated[float, Meta(gt=0.0, le=1e6)] | None
    """s of wall time that a tick lasts; none in lockstep, where no decision depends on a time-out"""

    @property
    def anchor_distance(self) -> float:
        """D in m."""
        return math.hypot(self.anchor.x - self.peer_anchor.x, self.anchor.y - self.peer_anchor.y)


class Observation(Message, frozen=True):
    """World to one robot: what its sensors say at tick k."""

    tick: Tick
    robot: RobotId
    executed: Controls | None
    """over [k - 1, k]; none at tick 0"""
    anchor_range: Range | None
    contacts: tuple[Contact, ...] = ()


class Report(Message, frozen=True):
    """Robot to robot: what the peer has not acknowledged of this robot's log, up to tick k.

    Manoeuvres and ranges are acknowledged each for themselves: what many ranges there may be to tell must
    not hold up where the robot is.
    """

    tick: Tick
    robot: RobotId
    """who says it"""
    phase: Phase
    state: Word
    start: Pose | None
    """where tick 0 of its odometry lies in the frame of its own anchor; none before phase 1 is done"""
    since: Tick
    through: Tick
    """the log below covers the manoeuvres over [since, through]"""
    runs: Annotated[tuple[Segment, ...], Meta(max_length=MAX_REPORT_RUNS)]
    ranges_since: Count
    """the log below has the ranges after the first so many"""
    ranges: Annotated[tuple[Ranged, ...], Meta(max_length=MAX_REPORT_RANGES)]
    """to its own anchor"""
    heard: Tick
    """the peer's manoeuvres are known through this tick"""
    ranges_heard: Count
    """and so many of the peer's ranges"""
    verdict: Verdict | None = None


class Command(Message, frozen=True):
    """Robot to world: what it does over [k, k + 1], and what it knows of itself."""

    tick: Tick
    robot: RobotId
    v: Velocity
    omega: AngularVelocity
    phase: Phase
    state: Word
    verdict: Verdict | None = None


class Estimate(Message, frozen=True):
    """Robot to viewers: what it holds possible at tick k."""

    tick: Tick
    robot: RobotId
    local: tuple[Pose, ...]
    """its pose in the frame of its own anchor, one for each branch that is left"""
    world: tuple[Pose, ...]
    """its pose in the world frame, one for each placement that is left"""
    localised: bool
    probabilities: tuple[Probability, ...] = ()
    """of each in `world`, or while there is none of each in `local`, the likeliest first; they sum to 1.
    None where sensors are exact: what is possible there is equally so"""
    covariance: Covariance | None = None
    """of the first in `world`"""


class GroundTruth(Message, frozen=True):
    """World to viewers: where everyone really is at tick k."""

    tick: Tick
    poses: dict[RobotId, Pose]


class DeadlineMissed(Message, frozen=True):
    """Only in journals, and only in real time: what tick k did without, for it did not come in time."""

    tick: Tick
    robot: RobotId
    """whose Command (in the world's journal) or Report (in an agent's)"""


class TickStart(Message, frozen=True):
    """Without a world, one robot's driver to its peer's: tick k has begun."""

    tick: Tick
    robot: RobotId


class MissionEnd(Message, frozen=True):
    """World to robots: the mission is over."""

    tick: Tick
    outcome: Outcome
    reason: Text | None

    def __post_init__(self) -> None:
        _cut(self, "reason")


class FinalReport(Message, frozen=True):
    """Robot to world, the answer to MissionEnd: how it went, seen from inside."""

    robot: RobotId
    anchor_ranges: Count
    mutual_ranges: Count
    branch: BranchKind | None
    alpha: Angle | None
    """of eq. (2), signed"""
    candidates: tuple[Count, Count] | None
    """solutions of eq. (7), before and after silence"""
    last_turn_rate: AngularVelocity | None
    """omega_2 of eq. (8), of the latest; a plans one only where b's has not settled it"""
    separation_m2: Annotated[float, Meta(ge=0.0, le=1e15)] | None
    """J of eq. (8); none where one candidate was left, and nothing to be told apart"""
    hypotheses: Count | None
    """about the poses of both, that are left in the end"""
    probability: Probability | None
    """of the likeliest of them; none where sensors are exact"""
    blocking_reason: Text | None
    """under noise: what there was to know yet, before it could claim"""
    p_value: Probability | None
    """under noise: the least with which the ranges spoke against what the peer told"""
    reports_sent: Count
    reports_heard: Count
    reports_refused: Count
    """malformed, or not from whom they said"""
    reports_unheard: Count
    """that arrived, though they were not sent in contact"""
    reports_lost: Count
    """that were sent in contact, and never heard"""
    frames_refused: Count
    """of all kinds"""
    bytes_sent: Count
    """of reports"""

    def __post_init__(self) -> None:
        _cut(self, "blocking_reason")


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
"""what stands in an agent's journal"""
