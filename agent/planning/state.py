"""The complete state of one robot as one frozen value."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from msgspec.structs import replace

from agent.estimation.estimator import Estimator
from agent.estimation.exact_estimator import EXACT_ESTIMATOR
from agent.estimation.gaussian.gaussian_estimator import GAUSSIAN
from agent.estimation.knowledge import Knowledge
from agent.planning.group_knowledge import Confirming, Contacted, Fix, Other, OwnPose, Resected
from agent.planning.passing import Bypass
from agent.planning.phase3_last_manoeuvre import Plan
from agent.planning.tasks import Asleep, Done, Looping, Sweeping, Task
from protocol import messages
from protocol.messages import Inconsistent, Undecided
from protocol.motion import ORIGIN, Pose, compose, inverse
from protocol.orbits import Orbit


class RobotState(Knowledge, frozen=True):
    """Everything that a robot knows, and what it is doing (`task`). The planner maps it to the next one."""

    task: Task = Asleep()
    in_contact: bool = False
    """True if the peer is in range in this tick."""
    leg: Pose = ORIGIN
    """The odometry at the beginning of the last segment of the log."""
    plan: Plan | None = None
    """The latest plan of a last manoeuvre of this robot."""

    # --- beyond the present meeting: only a robot of a group has more than one ---

    meeting: int = 0
    """The number of the present meeting; that of the first is 0."""
    own: Any = None
    """The number of the meeting, and the state in it, of a planner of the user; None with `assured`."""
    robot_verdict: messages.Verdict | None = None
    """The verdict over all meetings: the pose that the robot claims, or why it claims none.

    It is None again when another meeting contradicts that one.
    """
    fix: Fix | None = None
    """The pose that the robot knows, and by which it drives; None until a meeting has determined it."""
    located: Knowledge | None = None
    """The knowledge at its claim in the latest meeting in which it was localised."""
    confirming: Confirming = Confirming()
    """The meetings that confirm that pose, if a claim of it needs several peers."""
    found: Resected | Contacted | None = None
    """The knowledge of a robot without an anchor by those that are localised; None with an anchor."""
    failure: messages.Verdict | None = None
    """The verdict of the latest meeting that has failed before the robot was localised."""
    frame: Pose = ORIGIN
    """The pose in <W> of the odometry's frame, from the latest meeting in which the robot was localised."""
    framed_at: Pose = ORIGIN
    """The odometry where `frame` was determined. An error of its heading turns ways about this place."""
    own_pose: OwnPose = OwnPose()
    """The accuracy of its pose while it sweeps, with noisy sensors."""
    others: Mapping[str, Other] = {}
    """The knowledge about each robot that this one has been in range of, or heard of."""
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
    unmet: int = 0
    """The number of consecutive ticks out of range of the peer since this robot's verdict in the meeting."""
    lingering: int = 0
    """The number of consecutive ticks in range of the peer since the end of their meeting."""
    silence: int = 0
    """The number of consecutive ticks in range of the peer without a log of it."""
    passing: Bypass = Bypass()
    """The way past robots of other meetings, if the mission has a safety distance."""

    @property
    def estimator(self) -> Estimator:
        """Return the estimator for the noise of the mission."""
        return EXACT_ESTIMATOR if self.config.mission.noise.exact else GAUSSIAN

    @property
    def orbit(self) -> Orbit:
        """Return the orbit of this robot in phase 2."""
        return self.config.orbit

    @property
    def phase(self) -> int:
        """Return the phase of the paper: 1, 2 or 3."""
        return self.task.phase

    @property
    def verdict(self) -> messages.Verdict | None:
        """Return the verdict of the present meeting, or None if the robot has not reached one."""
        return self.task.verdict if isinstance(self.task, Done) else None

    def undecided(self, reason: str) -> RobotState:
        """Return this state, ended with the verdict Undecided: the robot cannot continue."""
        return replace(self, task=Done(self.phase, Undecided(reason)))

    def inconsistent(self, contradiction: Inconsistent) -> RobotState:
        """Return this state, ended with the verdict Inconsistent: the peer's reports are contradictory."""
        return replace(self, task=Done(self.phase, contradiction))

    @property
    def waits(self) -> bool:
        """Return whether the robot meets visitors: it knows no pose yet, or is back at its anchor."""
        if self.fix is None:
            return self.robot_verdict is None
        return not (self.visiting or self.sweeps) and self.verdict is None

    @property
    def meets(self) -> bool:
        """Return whether the robot exchanges logs with its peer, if they are in contact."""
        return not (self.alone or self.sweeps)

    @property
    def sweeps(self) -> bool:
        """Return whether the robot sweeps an area, or has stopped for a robot without an anchor."""
        return isinstance(self.task, Sweeping | Looping)

    @property
    def elapsed(self) -> float:
        """Return the time since tick 0 in s."""
        return self.tick * self.config.mission.period

    def with_frame(self, pose: Pose) -> RobotState:
        """Return this state of a robot that has determined its present `pose` in <W>."""
        return replace(self, frame=compose(pose, inverse(self.odometry)), framed_at=self.odometry)

    def other(self, robot: str) -> Other:
        """Return what the robot knows of `robot`."""
        return self.others.get(robot, Other())

    def with_other(self, robot: str, other: Other) -> RobotState:
        """Return this state with what the robot now knows of `robot`."""
        return replace(self, others={**self.others, robot: other})
