"""The complete state of one robot as one frozen value."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import replace

from agent.estimation.estimator import Estimator
from agent.estimation.exact_estimator import EXACT_ESTIMATOR
from agent.estimation.gaussian.claim_agreement import difference
from agent.estimation.gaussian.gaussian_estimator import GAUSSIAN
from agent.estimation.knowledge import Knowledge
from agent.planning.phase3_last_manoeuvre import Plan
from agent.planning.tasks import Asleep, Covering, Done, Looping, Task
from protocol.messages import Localised, ReportedPose, Undecided, Verdict
from protocol.motion import ORIGIN, Pose, compose, inverse

if TYPE_CHECKING:
    from agent.planning.contacted import Contacted
    from agent.planning.resected import Resected


class Other(msgspec.Struct, frozen=True):
    """The knowledge of a robot about another one of its group, besides its logs and ranges."""

    localised: bool = False
    """True once it has reported that it is localised."""
    failed: bool = False
    """True once a meeting with it has failed: this robot does not meet it again."""
    served: bool = False
    """True once it has no anchor, and has reported that it knows its pose by this robot, and waits for others
    to confirm it."""
    travels: bool = False
    """True if it drives to another robot, by its latest report. It counts only with a safety distance."""
    missed: int = -1
    """The latest tick in which this robot has not found it where it should wait; -1 if there is none."""
    acknowledged: int = 0
    """The last tick of this robot's manoeuvres that it has acknowledged, if it has no anchor."""


class OwnPose(msgspec.Struct, frozen=True):
    """The latest estimates of its own pose that a covering robot with noisy sensors has made."""

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

    known: Knowledge
    """The knowledge in the tick in which it claimed the pose in that meeting."""
    claim: Localised
    """That claim."""
    peers: tuple[str, ...]
    """The robots whose meetings agree, in their order."""

    def contradiction(self, claim: Localised, now: Knowledge) -> str | None:
        """Return in words by how much a present `claim` contradicts this pose; None if it does not.

        The claims of robots with exact sensors have no covariance, and are never wrong.
        """
        if claim.covariance is None:
            return None
        mission = now.config.mission
        off = difference(self.claim, self.known.tick, claim, now.tick, now.log, mission)
        if off.p_value >= 1.0 - mission.confidence:
            return None
        return f"{off.position:.3g} m and {off.heading:.3g} rad (p = {off.p_value:.2g})"


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


class Bypass(msgspec.Struct, frozen=True):
    """The passing of robots of other meetings."""

    leeway: float = math.inf
    """The length in m that the robot may drive in the next tick."""
    blocked: int = 0
    """The number of consecutive ticks in which it has hardly moved on its way."""
    yielded: int = 0
    """The number of ticks in which it has stood still for another one; 0 again without robots in contact."""
    detours: int = 0
    """The number of times that it has driven aside."""
    places: tuple[tuple[float, float], ...] = ()
    """The ends of the straights of the way aside, in m in the frame of the odometry."""


class RobotState(Knowledge, frozen=True):
    """Everything that a robot knows, and what it is doing (`task`). The planner maps it to the next one.

    Only a robot of a group has more than one meeting, and knowledge beyond the present one.
    """

    task: Task = Asleep()
    in_contact: bool = False
    """True if the peer is in range in this tick."""
    leg: Pose = ORIGIN
    """The odometry at the beginning of the last segment of the log."""
    plan: Plan | None = None
    """The latest plan of a last manoeuvre of this robot."""

    # --- beyond the present meeting ---

    meeting: int = 0
    """The number of the present meeting; that of the first is 0."""
    own_state: Any = None
    """The number of the meeting, and the state in it, of a planner of the user; None with `assured`."""
    robot_verdict: Verdict | None = None
    """The verdict over all meetings: the pose that the robot claims, or why it claims none.

    It is None again when another meeting contradicts that one.
    """
    fix: Fix | None = None
    """The pose that the robot knows, and by which it drives; None until a meeting has determined it."""
    confirming: Confirming = Confirming()
    """The meetings that confirm that pose, if a claim of it needs several peers."""
    found: Resected | Contacted | None = None
    """The knowledge of a robot without an anchor by those that are localised; None with an anchor."""
    failure: Verdict | None = None
    """The verdict of the latest meeting that has failed before the robot was localised."""
    frame: Pose = ORIGIN
    """The pose in <W> of the odometry's frame, from the latest meeting in which the robot was localised."""
    framed_at: Pose = ORIGIN
    """The odometry where `frame` was determined. An error of its heading turns ways about this place."""
    own_pose: OwnPose = OwnPose()
    """The accuracy of its pose while it covers an area, with noisy sensors."""
    others: Mapping[str, Other] = {}
    """The knowledge about each robot that this one has been in range of, or heard of."""
    visits: int = 0
    """The number of planned visits that the robot has begun or left out."""
    retries: int = 0
    """The number of retries whose time has come."""
    parts: int = 0
    """The number of parts of an area that the robot has begun to cover for robots without an anchor."""
    part_tick: int = -1
    """The tick in which it began the latest of them."""
    strips_end: int | None = None
    """The strip after the last one of its coverage; None if it does not leave strips to others."""
    until: float | None = None
    """The time in s at which the search of a retry ends; None if there is none."""
    alone: bool = False
    """True if the robot waits at its anchor for a visitor, or drives there to wait, or has no anchor."""
    visiting: bool = False
    """True if the present meeting is a visit: the robot knows its pose already."""
    parting: int = 0
    """The number of consecutive ticks since its verdict in the meeting with contact, or without, as now."""
    silence: int = 0
    """The number of consecutive ticks in range of the peer without a log of it."""
    passing: Bypass = Bypass()
    """The way past robots of other meetings, if the mission has a safety distance."""

    @property
    def estimator(self) -> Estimator:
        """Return the estimator for the noise of the mission."""
        return EXACT_ESTIMATOR if self.config.mission.noise.exact else GAUSSIAN

    @property
    def phase(self) -> int:
        """Return the phase of the paper: 1, 2 or 3."""
        return self.task.phase

    @property
    def verdict(self) -> Verdict | None:
        """Return the verdict of the present meeting, or None if the robot has not reached one."""
        return self.task.verdict if isinstance(self.task, Done) else None

    def ended(self, verdict: Verdict) -> RobotState:
        """Return this state, ended with `verdict`; a pose is claimed in phase 3."""
        return replace(self, task=Done(3 if isinstance(verdict, Localised) else self.phase, verdict))

    def undecided(self, reason: str) -> RobotState:
        """Return this state, ended with the verdict Undecided: the robot cannot continue."""
        return self.ended(Undecided(reason))

    @property
    def waits(self) -> bool:
        """Return whether the robot meets visitors: it knows no pose yet, or is back at its anchor."""
        if self.fix is None:
            return self.robot_verdict is None
        return not (self.visiting or self.covers) and self.verdict is None

    @property
    def meets(self) -> bool:
        """Return whether the robot exchanges logs with its peer, if they are in contact."""
        return not (self.alone or self.covers)

    @property
    def covers(self) -> bool:
        """Return whether the robot covers an area, or has stopped for a robot without an anchor."""
        return isinstance(self.task, Covering | Looping)

    @property
    def elapsed(self) -> float:
        """Return the time since tick 0 in s."""
        return self.tick * self.config.mission.period

    def doing(self, task: Task) -> RobotState:
        """Return this state with the task `task`."""
        return self if task is self.task else replace(self, task=task)

    def with_frame(self, pose: Pose) -> RobotState:
        """Return this state of a robot that has determined its present `pose` in <W>."""
        return replace(self, frame=compose(pose, inverse(self.odometry)), framed_at=self.odometry)

    def other(self, robot: str) -> Other:
        """Return what the robot knows of `robot`."""
        return self.others.get(robot, Other())

    def with_other(self, robot: str, **fields: Any) -> RobotState:
        """Return this state with other values of some fields of what the robot knows of `robot`."""
        return replace(self, others={**self.others, robot: replace(self.other(robot), **fields)})
