"""The complete state of one robot as one frozen value, and its mode: one type per state of the paper."""

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
    """The robot has not measured its first anchor range yet."""


class Done(msgspec.Struct, frozen=True):
    """The robot has reached its verdict. It stands still and continues to send reports to its peer."""

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
    """The results of phases 1 and 3: hypotheses, counts and the reasons for and against a claim.

    Fields marked "exact sensors" or "noisy sensors" are set only in that case.
    """

    possible: tuple[Branch, ...] = ()
    """Exact sensors: the branches that the first two anchor ranges allow."""
    branch: Branch | None = None
    """The branch selected at the end of phase 1. With noisy sensors, the most probable branch so far."""
    branch_kind: messages.BranchKind | None = None
    phase1_done_tick: int | None = None
    """The tick in which phase 1 ended for the first time."""
    encounter_tick: int | None = None
    """The tick in which phase 3 began."""
    placements: tuple[Placement, ...] = ()
    """The solutions of eq. (7) that no measurement has ruled out."""
    candidates: tuple[int, int] | None = None
    """The number of candidates at the beginning, and after their evaluation.

    Exact sensors: the solutions of eq. (7), and those that agree with the ticks without detection. Noisy
    sensors: the hypotheses of the first search, and the present ones.
    """
    plan: Plan | None = None
    own_anchor: float = 0.0
    """Exact sensors: the bound in m on the error of the own anchor's position, from the ranges of phase 1."""
    peer_anchor: float | None = None
    """Exact sensors: the same bound in m for the peer and its anchor."""
    own: tuple[Hypothesis, ...] = ()
    """Noisy sensors: the hypotheses about the position of the own anchor, the most probable first."""
    branches: tuple[Branch, ...] = ()
    """The branch that corresponds to each hypothesis in `own`."""
    pair: tuple[Hypothesis, ...] = ()
    """Noisy sensors: the hypotheses about both robots' poses in <W>, the most probable first."""
    poses: tuple[Pose, ...] = ()
    """The robot's pose in <W> under each hypothesis in `pair`."""
    covariance: Covariance | None = None
    """The covariance of the first pose in `poses`."""
    blocking_reason: str | None = None
    """Noisy sensors: the condition that still prevents a claim; None if every condition is met."""
    ranges_at_last_search: int = 0
    """Noisy sensors: the number of mutual ranges at the latest search of the whole plane for hypotheses."""
    inconsistency: Inconsistency | None = None
    """Noisy sensors: the result of the consistency test of the most probable hypothesis."""
    p_value: float | None = None
    """Noisy sensors: the smallest p-value of all searches of the whole plane."""
    inconsistent_searches: int = 0
    """Noisy sensors: the number of consecutive searches whose consistency test failed."""
    returns: int = 0
    """Noisy sensors: the number of times that the robot drove back to its anchor."""


class RobotState(msgspec.Struct, frozen=True):
    """Everything that a robot knows, and what it is doing (`mode`). The planner maps it to the next one."""

    config: RobotConfig
    mode: Mode = Asleep()
    tick: int = -1
    odometry: Pose = ORIGIN
    """The current pose in the frame of the pose at tick 0, by dead reckoning."""
    log: MotionLog = MotionLog()
    mutual: tuple[Ranged, ...] = ()
    belief: Belief = Belief()
    peer_state: PeerState = PeerState()
    in_contact: bool = False
    """True if the peer is in range in this tick."""
    leg: Pose = ORIGIN
    """The odometry at the beginning of the last segment of the log."""

    @property
    def orbit(self) -> Orbit:
        """Return the orbit of this robot in phase 2."""
        return self.config.rendezvous.of(self.config.role)

    @property
    def off_anchor(self) -> bool:
        """Return whether robot b is far enough from its anchor for phase 3 (see `phase2_orbit.off_anchor`).

        Robot b is this robot or the peer. The pose of the peer is known only after its phase 1.
        """
        assert self.peer_state.start is not None
        if self.config.role == "b":
            local = self.local_pose
        else:
            local = self.peer_state.peer.pose(self.peer_state.start, self.tick, self.config.mission.period)
        return off_anchor(local, self.config.rendezvous.b)

    @property
    def phase(self) -> int:
        """Return the phase of the paper: 1, 2 or 3."""
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
        """Return the name of the mode that reports, commands and recordings use."""
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
        """Return the verdict, or None if the robot has not reached one."""
        return self.mode.verdict if isinstance(self.mode, Done) else None

    def undecided(self, reason: str) -> RobotState:
        """Return this state, ended with the verdict Undecided: the robot cannot continue."""
        return replace(self, mode=Done(self.phase, Undecided(reason)))

    def inconsistent(self, contradiction: Inconsistent) -> RobotState:
        """Return this state, ended with the verdict Inconsistent: the peer's reports are contradictory."""
        return replace(self, mode=Done(self.phase, contradiction))

    @property
    def start(self) -> Pose:
        """Return the pose of tick 0 in the frame of the robot's anchor; known from phase 2 on."""
        assert self.belief.branch is not None
        return self.belief.branch.start

    @property
    def local_pose(self) -> Pose:
        """Return the current pose in the frame of the robot's anchor; known from phase 2 on."""
        return compose(self.start, self.odometry)

    def world_pose(self, placement: Placement) -> Pose:
        """Return the current pose in <W> if `placement` is the placement of <a(M1)> in <b(M2)>."""
        own, peer = self.config.anchor, self.config.peer_anchor
        m1, m2 = (own, peer) if self.config.role == "a" else (peer, own)
        turn = math.atan2(m1.y - m2.y, m1.x - m2.x) - math.atan2(placement.y, placement.x)
        if self.config.role == "a":
            turn += placement.phi
        return compose(Pose(own.x, own.y, turn), self.local_pose)

    def seen(self) -> list[tuple[Pose, float | None]]:
        """Return the odometry pose of each tick of phase 1, and the anchor range or None.

        The result is not valid after phase 1: from phase 2 on, the log leaves out anchor ranges that repeat
        the last one.
        """
        ranges = {ranged.tick: ranged.range for ranged in self.log.ranges}
        track = self.log.track(ORIGIN, 0, self.tick, self.config.mission.period)
        return [(pose, ranges.get(tick)) for tick, pose in enumerate(track)]

    def pair_observations(self, first: int) -> list[PairObservation]:
        """Return both poses and the mutual range of each tick from `first` on that both logs cover."""
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
