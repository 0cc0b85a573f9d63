"""The complete state of one robot as one frozen value."""

from __future__ import annotations

from typing import Any

from msgspec.structs import replace

from agent.estimation.estimator import Estimator
from agent.estimation.exact_estimator import EXACT_ESTIMATOR
from agent.estimation.gaussian.gaussian_estimator import GAUSSIAN
from agent.estimation.knowledge import Knowledge
from agent.planning.agenda import Agenda, Other
from agent.planning.phase3_last_manoeuvre import Plan
from agent.planning.tasks import Asleep, Covering, Done, Looping, Task
from protocol.messages import Localised, Undecided, Verdict
from protocol.motion import ORIGIN, Pose, compose, inverse


class RobotState(Knowledge, frozen=True):
    """Everything that a robot knows, and what it is doing (`task`). The planner maps it to the next one."""

    task: Task = Asleep()
    in_contact: bool = False
    """True if the peer is in range in this tick."""
    leg: Pose = ORIGIN
    """The odometry at the beginning of the last segment of the log."""
    plan: Plan | None = None
    """The latest plan of a last manoeuvre of this robot."""
    agenda: Agenda = Agenda()
    """The knowledge beyond the present meeting: only a robot of a group has more than one."""

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
        if self.agenda.fix is None:
            return self.agenda.robot_verdict is None
        return not (self.agenda.visiting or self.covers) and self.verdict is None

    @property
    def meets(self) -> bool:
        """Return whether the robot exchanges logs with its peer, if they are in contact."""
        return not (self.agenda.alone or self.covers)

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

    def with_agenda(self, **fields: Any) -> RobotState:
        """Return this state with other values of some fields of its agenda."""
        return replace(self, agenda=replace(self.agenda, **fields))

    def with_frame(self, pose: Pose) -> RobotState:
        """Return this state of a robot that has determined its present `pose` in <W>."""
        return self.with_agenda(frame=compose(pose, inverse(self.odometry)), framed_at=self.odometry)

    def other(self, robot: str) -> Other:
        """Return what the robot knows of `robot`."""
        return self.agenda.others.get(robot, Other())

    def with_other(self, robot: str, **fields: Any) -> RobotState:
        """Return this state with other values of some fields of what the robot knows of `robot`."""
        return self.with_agenda(others={**self.agenda.others, robot: replace(self.other(robot), **fields)})
