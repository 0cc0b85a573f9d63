"""Reader of an agent's journal: the RobotConfig, then the inputs and answers of each tick."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import msgspec

from protocol import motion
from protocol.journal.journal_file import CorruptJournal, JournalReading, UnexpectedFrame, take_all
from protocol.messages import (
    Command,
    DeadlineMissed,
    Environment,
    Estimate,
    FinalReport,
    Localised,
    MissionEnd,
    Observation,
    OfRobot,
    Report,
    RobotConfig,
)
from protocol.motion import ORIGIN, REST, Pose, compose, inverse
from protocol.wire import MalformedFrame


class FramedReport(msgspec.Struct, frozen=True):
    """A report together with the frame in which it was received or is sent."""

    report: Report
    frame: bytes


class Step(msgspec.Struct, frozen=True):
    """One tick of the journal. A field is None or empty if the journal contains no such frame."""

    observation: Observation
    frame: bytes
    """The frame of the Observation."""
    reports: tuple[FramedReport, ...] = ()
    """The robot's reports, in the order of the contacts in `observation`."""
    received: tuple[FramedReport, ...] = ()
    missed: tuple[str, ...] = ()
    """The peers whose report did not arrive in time."""
    command: Command | None = None
    command_frame: bytes | None = None
    estimate: Estimate | None = None
    estimate_frame: bytes | None = None

    def sent_to(self, peer: str) -> FramedReport | None:
        """Return the robot's report to `peer`; None without contact, or if the journal lacks it."""
        for contact, framed in zip(self.observation.contacts, self.reports, strict=False):
            if contact.peer == peer:
                return framed
        return None


class AgentHistory(msgspec.Struct, frozen=True):
    """The content of a journal, complete or up to the point where it ends."""

    environment: Environment
    """The environment in which the journal was written."""
    config: RobotConfig
    steps: tuple[Step, ...]
    end: MissionEnd | None = None
    final_report: FinalReport | None = None
    unexpected: UnexpectedFrame | None = None
    """The first frame out of order, if any."""

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """Return the estimates, in the order of the ticks."""
        return tuple([step.estimate for step in self.steps if step.estimate is not None])

    @property
    def standing_claim(self) -> tuple[int, Localised] | None:
        """The claim that the robot has made and not withdrawn, and its tick; None if there is none."""
        made = None
        for step in self.steps:
            if step.command is None:
                continue
            if not isinstance(step.command.verdict, Localised):
                made = None
            elif made is None:
                made = step.observation.tick, step.command.verdict
        return made

    @property
    def odometry(self) -> tuple[Pose, ...]:
        """Return the pose at each tick in the frame of tick 0, by dead reckoning from the odometry."""
        poses, period = [ORIGIN], self.config.mission.period
        for step in self.steps[1:]:
            executed = step.observation.executed or REST
            poses.append(motion.step(poses[-1], executed.v, executed.omega, period))
        return tuple(poses[: len(self.steps)])

    @property
    def path(self) -> tuple[Pose, ...]:
        """Return the pose at each tick in the plane: the odometry, aligned with the claimed pose.

        Empty if the robot claimed no pose.
        """
        claim, odometry = self.standing_claim, self.odometry
        if claim is None:
            return ()
        tick, verdict = claim
        frame = compose(verdict.pose, inverse(odometry[tick]))
        return tuple([compose(frame, pose) for pose in odometry])


class AgentJournalReading(JournalReading):
    """A reader of an agent's journal."""

    KINDS = OfRobot

    def __init__(self, shared: dict[bytes, Any] | None = None) -> None:
        """The `shared` messages are those of JournalReading."""
        super().__init__(shared)
        self.config: RobotConfig | None = None
        """The configuration; None until it has been read."""
        self._steps: list[Step] = []
        self._step: dict[str, Any] = {}
        """The fields of the latest step, to which frames can be added; empty before the first."""
        self._end: MissionEnd | None = None
        self._final_report: FinalReport | None = None

    def _fits(self, message: Any, frame: bytes) -> bool:
        if self.config is None:
            return self._begins(message)
        step = self._step
        match message:
            case _ if self._end is not None:
                if not isinstance(message, FinalReport) or self._final_report is not None:
                    return False
                self._final_report = message
            case Observation() if message.tick == len(self._steps) + bool(step):
                if step:
                    if "command" not in step:
                        return False
                    self._steps.append(Step(**step))
                self._step = {"observation": message, "frame": frame}
            case Command() | Estimate() | Report() | DeadlineMissed():
                return bool(step) and self._answers(message, frame, step)
            case MissionEnd():
                self._end = message
            case _:
                return False
        return True

    def _answers(
        self, message: Command | Estimate | Report | DeadlineMissed, frame: bytes, step: dict[str, Any]
    ) -> bool:
        """Add `message` to `step`, and return True if it may be next."""
        assert self.config is not None
        is_open, is_now = "command" not in step, message.tick == step["observation"].tick
        match message:
            case Command() if is_open and is_now:
                step["command"], step["command_frame"] = message, frame
            case Estimate() if not is_open and is_now and "estimate" not in step:
                step["estimate"], step["estimate_frame"] = message, frame
            case Report() if message.robot != self.config.robot and is_open:
                step["received"] = (*step.get("received", ()), FramedReport(message, frame))
            case Report() if (
                message.robot == self.config.robot
                and is_now
                and len(step.get("reports", ())) < max(1, len(step["observation"].contacts))
            ):
                step["reports"] = (*step.get("reports", ()), FramedReport(message, frame))
            case DeadlineMissed() if is_open and is_now:
                step["missed"] = (*step.get("missed", ()), message.robot)
            case _:
                return False
        return True

    def _begins(self, message: object) -> bool:
        """Add the environment, and then the configuration."""
        match message:
            case Environment() if self.environment is None:
                self.environment = message
            case RobotConfig() if self.environment is not None:
                self.config = message
            case _:
                raise MalformedFrame("an agent's journal must begin with its environment and a RobotConfig")
        return True

    def content(self) -> AgentHistory | None:
        """Return the content that has been read so far; None if there is no RobotConfig."""
        if self.environment is None or self.config is None:
            return None
        steps = [*self._steps, Step(**self._step)] if self._step else self._steps
        return AgentHistory(
            self.environment, self.config, tuple(steps), self._end, self._final_report, self.unexpected
        )


def agent_history(frames: Iterable[bytes], source: object) -> AgentHistory:
    """Return the content of a journal's `frames`.

    Raises CorruptJournal, with a text that begins with `source`.
    """
    reading = AgentJournalReading()
    problem = take_all(reading, frames, source)
    if problem is not None:
        raise problem
    if reading.unexpected is not None:
        raise CorruptJournal(f"{source}: {reading.unexpected.what}")
    content = reading.content()
    if content is None:
        raise CorruptJournal(f"{source}: it contains no RobotConfig")
    return content
