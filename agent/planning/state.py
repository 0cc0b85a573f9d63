"""Everything that one robot knows, as one value; and what it is doing, as one of the states of the paper."""

from __future__ import annotations

import math

import msgspec
from msgspec.structs import replace

from agent.estimation.closed_forms import Placement
from agent.estimation.exact import Branch, PairObservation
from agent.estimation.gaussian.consistency import Inconsistency
from agent.estimation.gaussian.hypotheses import Hypothesis
from agent.peer.motion_log import MotionLog
from agent.peer.peer_state import PeerState
from agent.planning.active_sensing import Listening, Retreating, Surveying
from agent.planning.phase1_anchor import ThirdPoint
from agent.planning.phase2_orbit import Aligning, Orbiting, Radial, Tangent, off_anchor
from agent.planning.phase3_last_manoeuvre import LastManoeuvre, Plan, Returning, Standing, Waiting
from agent.planning.range_seeking import Backing, Circling, Homing, Straight, Turning
from protocol import messages
from protocol.messages import Inconsistent, Localised, Ranged, RobotConfig, Undecided
from protocol.motion import ORIGIN, Covariance, Pose, compose
from protocol.orbits import Orbit


class Asleep(msgspec.Struct, frozen=True):
    """Has not sensed anything yet."""


class Done(msgspec.Struct, frozen=True):
    """Has come to its verdict; stands, and keeps telling the peer."""

    phase: int
    verdict: messages.Verdict


Phase1 = Straight | Backing | Turning | Circling | ThirdPoint | Surveying | Homing
Phase2 = Aligning | Radial | Tangent | Orbiting
Phase3 = Straight | Backing | Turning | Circling | Standing | Waiting | LastManoeuvre | Returning
Noisy3 = Surveying | Listening | Retreating
Mode = Asleep | Phase1 | Phase2 | Phase3 | Noisy3 | Done

MODE_NAMES: dict[type, str] = {
    Asleep: "asleep",
    Straight: "straight",
    Backing: "backing",
    Turning: "turning",
    Circling: "circling",
    ThirdPoint: "third-point",
    Surveying: "surveying",
    Homing: "homing",
    Listening: "listening",
    Aligning: "aligning",
    Radial: "radial",
    Tangent: "tangent",
    Orbiting: "orbiting",
    Standing: "standing",
    Waiting: "waiting",
    LastManoeuvre: "last-manoeuvre",
    Returning: "returning",
    Retreating: "retreating",
}


class Belief(msgspec.Struct, frozen=True):
    """What phases 1 and 3 have found out, beside the state."""

    possible: tuple[Branch, ...] = ()
    """where sensors are exact: what the first two ranges left, before silence was weighed"""
    branch: Branch | None = None
    """the one that is left after phase 1"""
    branch_kind: messages.BranchKind | None = None
    phase1_done_tick: int | None = None
    """the tick in which phase 1 was over, for the first time"""
    encounter_tick: int | None = None
    """the tick in which phase 3 began"""
    placements: tuple[Placement, ...] = ()
    """those of eq. (7) that are left"""
    candidates: tuple[int, int] | None = None
    """how many there were at first: all of them, and what silence left"""
    plan: Plan | None = None
    own_anchor: float = 0.0
    """where sensors are exact: how far off, in m, its anchor may be, by the ranges of phase 1"""
    peer_anchor: float | None = None
    """the same of its peer's"""
    own: tuple[Hypothesis, ...] = ()
    """under noise: of where its anchor is"""
    branches: tuple[Branch, ...] = ()
    """by each of these"""
    pair: tuple[Hypothesis, ...] = ()
    """under noise: of how both lie in <W>"""
    poses: tuple[Pose, ...] = ()
    """in <W>, by each of these"""
    covariance: Covariance | None = None
    """of the first"""
    blocking_reason: str | None = None
    """under noise: what there is to know yet, before it can claim"""
    ranges_at_last_search: int = 0
    """under noise: how many mutual ranges there were when the whole plane was last searched"""
    against: Inconsistency | None = None
    """under noise: what most speaks against the first"""
    p_value: float | None = None
    """under noise: the least of all searches of the whole plane"""
    doubts: int = 0
    """under noise: how often on end the ranges have spoken against what the peer tells"""
    returns: int = 0
    """under noise: how often it went back to its anchor"""


class RobotState(msgspec.Struct, frozen=True):
    """Everything that a robot knows."""

    config: RobotConfig
    mode: Mode = Asleep()
    tick: int = -1
    odometry: Pose = ORIGIN
    """now, in the frame of tick 0"""
    log: MotionLog = MotionLog()
    mutual: tuple[Ranged, ...] = ()
    belief: Belief = Belief()
    peer_state: PeerState = PeerState()
    in_contact: bool = False
    """whether the peer is in range in this tick"""
    leg: Pose = ORIGIN
    """the odometry when the last run of the log began"""

    @property
    def orbit(self) -> Orbit:
        """This robot's part of the rendezvous."""
        return self.config.rendezvous.of(self.config.role)

    @property
    def off_anchor(self) -> bool:
        """Whether b, be it this robot or the peer, is where it can be met; phase 1 is done by both."""
        assert self.peer_state.start is not None
        if self.config.role == "b":
            local = self.local_pose
        else:
            local = self.peer_state.peer.pose(self.peer_state.start, self.tick, self.config.mission.period)
        return off_anchor(local, self.config.rendezvous.b)

    @property
    def phase(self) -> int:
        """The paper's: 1, 2 or 3."""
        match self.mode:
            case Orbiting() | Aligning() | Radial() | Tangent():
                return 2
            case Asleep() | ThirdPoint():
                return 1
            case Straight("anchor") | Backing("anchor") | Turning("anchor") | Circling("anchor"):
                return 1
            case Surveying("anchor") | Homing():
                return 1
            case Done(phase, _):
                return phase
            case _:
                return 3

    @property
    def mode_name(self) -> str:
        """The state in a word."""
        match self.mode:
            case Done(_, Localised()):
                return "localised"
            case Done(_, Inconsistent()):
                return "inconsistent"
            case Done(_, Undecided()):
                return "undecided"
            case mode:
                return MODE_NAMES[type(mode)]

    @property
    def verdict(self) -> messages.Verdict | None:
        """What it has come to, if it has."""
        return self.mode.verdict if isinstance(self.mode, Done) else None

    def undecided(self, reason: str) -> RobotState:
        """It cannot go on, and does not guess."""
        return replace(self, mode=Done(self.phase, Undecided(reason)))

    def alarmed(self, alarm: Inconsistent) -> RobotState:
        """The peer tells what cannot be so."""
        return replace(self, mode=Done(self.phase, alarm))

    @property
    def start(self) -> Pose:
        """Where tick 0 lies in the frame of its anchor; known from phase 2 on."""
        assert self.belief.branch is not None
        return self.belief.branch.start

    @property
    def local_pose(self) -> Pose:
        """Where it is in the frame of its anchor; known from phase 2 on."""
        return compose(self.start, self.odometry)

    def world_pose(self, placement: Placement) -> Pose:
        """Where it is in <W>, if that is how <a(M1)> lies in <b(M2)>."""
        own, peer = self.config.anchor, self.config.peer_anchor
        m1, m2 = (own, peer) if self.config.role == "a" else (peer, own)
        turn = math.atan2(m1.y - m2.y, m1.x - m2.x) - math.atan2(placement.y, placement.x)
        if self.config.role == "a":
            turn += placement.phi
        return compose(Pose(own.x, own.y, turn), self.local_pose)

    def seen(self) -> list[tuple[Pose, float | None]]:
        """Every tick of phase 1: the odometry, and the anchor's range or its silence.

        Not beyond: from phase 2 on the log leaves out the ranges that say nothing new.
        """
        ranges = {ranged.tick: ranged.range for ranged in self.log.ranges}
        track = self.log.track(ORIGIN, 0, self.tick, self.config.mission.period)
        return [(pose, ranges.get(tick)) for tick, pose in enumerate(track)]

    def pair_observations(self, first: int) -> list[PairObservation]:
        """Every tick from `first` on that both robots' logs cover: where both were, and the range between."""
        last = min(self.tick, self.peer_state.peer.through)
        if self.peer_state.start is None or last < first:
            return []
        period = self.config.mission.period
        own = self.log.track(self.start, first, last, period)
        peer = self.peer_state.peer.track(self.peer_state.start, first, last, period)
        a, b = (own, peer) if self.config.role == "a" else (peer, own)
        ranges = {ranged.tick: ranged.range for ranged in self.mutual}
        return [
            PairObservation(tick, at_a, at_b, ranges.get(tick))
            for tick, at_a, at_b in zip(range(first, last + 1), a, b, strict=True)
        ]
