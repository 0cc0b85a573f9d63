"""Everything that a robot has measured and received, and what it has inferred from that."""

from __future__ import annotations

import math
from collections.abc import Mapping

import msgspec

from agent.estimation.closed_forms import Placement
from agent.estimation.exact import Branch, PairObservation
from agent.estimation.posterior import Hypothesis
from agent.estimation.solver import Solver
from agent.peer.motion_log import MotionLog
from agent.peer.peer_state import PeerState
from protocol import messages
from protocol.messages import Ranged, RobotConfig
from protocol.motion import ORIGIN, Covariance, Pose, compose, inverse
from protocol.orbits import Orbit


class OwnAnchor(msgspec.Struct, frozen=True):
    """The results of phase 1: the pose relative to the own anchor. They hold in all meetings."""

    branch: Branch | None = None
    """The branch selected at the end of phase 1. With noisy sensors, the most probable branch so far."""
    kind: messages.BranchKind | None = None
    """The observation that decided the branch."""
    done_tick: int | None = None
    """The tick in which phase 1 ended for the first time."""
    possible: tuple[Branch, ...] = ()
    """Exact sensors: the branches that the first two anchor ranges allow."""
    error: float = 0.0
    """Exact sensors: the bound in m on the error of the anchor's position, from the ranges of phase 1."""
    hypotheses: tuple[Hypothesis, ...] = ()
    """Noisy sensors: the hypotheses about the position of the anchor, the most probable first."""
    branches: tuple[Branch, ...] = ()
    """The branch that corresponds to each of them."""
    ranges_at_last_fit: int = 0
    """Noisy sensors: the number of anchor ranges at their latest fit."""


class Attempt(msgspec.Struct, frozen=True):
    """The searches and the returns of a robot with noisy sensors in a meeting since `beginning`."""

    beginning: int = 0
    """The first tick whose measurements of a count: that in which a has last begun phase 1 again, or 0."""
    ranges_at_last_search: int = 0
    """The number of mutual ranges at the latest search of the whole plane for hypotheses."""
    p_value: float | None = None
    """The smallest p-value of all searches of the whole plane, and of the claim."""
    inconsistent_searches: int = 0
    """The number of consecutive searches whose consistency test failed."""
    doubtful_claims: int = 0
    """The number of consecutive claims withheld because a profile contradicts them."""
    returns: int = 0
    """The number of times that the robot drove back to its anchor."""


class MeetingPosterior(msgspec.Struct, frozen=True):
    """The posterior of phase 3 in one meeting: hypotheses, their counts, and what prevents a claim.

    Fields marked "exact sensors" or "noisy sensors" are set only in that case.
    """

    encounter_tick: int | None = None
    """The tick in which phase 3 began."""
    placements: tuple[Placement, ...] = ()
    """The solutions of eq. (7) that no measurement has ruled out."""
    hypothesis_counts: tuple[int, int] | None = None
    """The number of hypotheses at the beginning, and after their evaluation.

    Exact sensors: the solutions of eq. (7), and those that agree with the ticks without detection. Noisy
    sensors: the hypotheses of the first search, and the present ones.
    """
    peer_anchor: float | None = None
    """Exact sensors: the bound in m on the error of the peer's anchor, as `OwnAnchor.error`."""
    observations: tuple[PairObservation, ...] = ()
    """Exact sensors: the ticks from which the placements follow."""
    pair: tuple[Hypothesis, ...] = ()
    """Noisy sensors: the hypotheses about both robots' poses in <W>, the most probable first."""
    poses: tuple[Pose, ...] = ()
    """The robot's pose in <W> under each hypothesis in `pair`, at the latest estimate of both poses."""
    odometry: Pose = ORIGIN
    """Noisy sensors: the pose by dead reckoning at that estimate, in the frame of the pose at tick 0."""
    covariance: Covariance | None = None
    """The covariance of the first pose in `poses`."""
    blocking_reason: str | None = None
    """Noisy sensors: the condition that still prevents a claim; None if every condition is met."""
    attempt: Attempt = Attempt()
    """Noisy sensors: the searches for `pair`."""
    earlier_ranges: int = 0
    """Noisy sensors: the number of mutual ranges with the peer before this meeting (groups)."""


class Knowledge(msgspec.Struct, frozen=True):
    """The measurements and the reports that a robot has, and what follows from them for an `Estimator`."""

    config: RobotConfig
    tick: int = -1
    odometry: Pose = ORIGIN
    """The current pose in the frame of the pose at tick 0, by dead reckoning."""
    log: MotionLog = MotionLog()
    ranges: Mapping[str, tuple[Ranged, ...]] = {}
    """The ranges to each other robot."""
    own_anchor: OwnAnchor = OwnAnchor()
    posterior: MeetingPosterior = MeetingPosterior()
    peer_state: PeerState = PeerState()
    solver: Solver | None = None
    """Noisy sensors: the solver that the planner has chosen; None for the smoother."""

    @property
    def knowledge(self) -> Knowledge:
        """Return this knowledge alone, without what a subclass adds to it."""
        return Knowledge(**{name: getattr(self, name) for name in Knowledge.__struct_fields__})

    @property
    def mutual(self) -> tuple[Ranged, ...]:
        """Return the ranges to the peer."""
        return self.ranges.get(self.config.peer, ())

    @property
    def m2(self) -> tuple[float, float]:
        """Return the place (m) of M2 relative to M1, the same bits for both robots."""
        config = self.config
        m1, m2 = config.m1, config.peer_anchor if config.role == "a" else config.anchor
        return m2.x - m1.x, m2.y - m1.y

    @property
    def start(self) -> Pose:
        """Return the pose of tick 0 in the frame of the robot's anchor; known from phase 2 on."""
        assert self.own_anchor.branch is not None
        return self.own_anchor.branch.start

    @property
    def local_pose(self) -> Pose:
        """Return the current pose in the frame of the robot's anchor; known from phase 2 on."""
        return compose(self.start, self.odometry)

    def world_pose(self, placement: Placement) -> Pose:
        """Return the current pose in <W> if `placement` is the placement of <a(M1)> in <b(M2)>."""
        own_anchor, peer = self.config.anchor, self.config.peer_anchor
        m1, m2 = (own_anchor, peer) if self.config.role == "a" else (peer, own_anchor)
        turn = math.atan2(m1.y - m2.y, m1.x - m2.x) - math.atan2(placement.y, placement.x)
        if self.config.role == "a":
            turn += placement.phi
        return compose(Pose(own_anchor.x, own_anchor.y, turn), self.local_pose)

    @property
    def poses(self) -> tuple[Pose, ...]:
        """Return `posterior.poses`, moved by the odometry since the latest estimate."""
        if self.posterior.odometry == self.odometry:
            return self.posterior.poses
        moved = compose(inverse(self.posterior.odometry), self.odometry)
        return tuple([compose(pose, moved) for pose in self.posterior.poses])

    @property
    def known_through(self) -> int:
        """Return the last tick that both logs cover, with the ranges to the anchors."""
        return min(self.tick, self.peer_state.peer.through, self.peer_state.ranges_through)

    def seen(self) -> list[tuple[Pose, float | None]]:
        """Return the odometry pose of each tick of phase 1, and the anchor range or None.

        The result is not valid after phase 1: from phase 2 on, the log leaves out anchor ranges that repeat
        the last one.
        """
        ranges = {ranged.tick: ranged.range for ranged in self.log.ranges}
        track = self.log.track(ORIGIN, 0, self.tick, self.config.mission.period)
        return [(pose, ranges.get(tick)) for tick, pose in enumerate(track)]

    def pair_observations(self, first: int) -> tuple[PairObservation, ...]:
        """Return both poses and the mutual range of each tick from `first` on that both logs cover.

        Those in `posterior.observations` are not computed again: logs are only extended.
        """
        last = min(self.tick, self.peer_state.peer.through)
        if self.peer_state.start is None or last < first:
            return ()
        observations = self.posterior.observations
        if observations and observations[0].tick != first:
            observations = ()
        a_known, b_known = [at.a for at in observations], [at.b for at in observations]
        a_start, a_log, b_start, b_log = self.start, self.log, self.peer_state.start, self.peer_state.peer
        if self.config.role == "b":
            a_start, a_log, b_start, b_log = b_start, b_log, a_start, a_log
        period, new = self.config.mission.period, len(observations)
        a = a_log.track(a_start, first, last, period, a_known)
        b = b_log.track(b_start, first, last, period, b_known)
        ranges = {ranged.tick: ranged.range for ranged in self.mutual}
        ticks = range(first + new, last + 1)
        return (*observations, *map(PairObservation, ticks, a[new:], b[new:], map(ranges.get, ticks)))

    @property
    def off_anchor(self) -> bool:
        """Return whether robot b is far enough from its anchor for phase 3 (see `off_anchor`).

        Robot b is this robot or the peer. The pose of the peer is known only after its phase 1.
        """
        assert self.peer_state.start is not None
        if self.config.role == "b":
            local = self.local_pose
        else:
            local = self.peer_state.peer.pose(self.peer_state.start, self.tick, self.config.mission.period)
        return off_anchor(local, self.config.rendezvous.b)


def off_anchor(local: Pose, orbit: Orbit) -> bool:
    """Return whether robot b, at `local` in its anchor's frame, is far enough from its anchor for phase 3.

    If b is on its anchor, the mutual ranges do not depend on its heading, and eq. (7) has a continuum of
    solutions. Half the distance to its waiting place is far enough.
    """
    return math.hypot(local.x, local.y) >= 0.5 * orbit.radius
