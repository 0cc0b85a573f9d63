"""Reader of an agent's journal: the RobotConfig, then the inputs and answers of each tick."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import msgspec

from protocol import motion
from protocol.journal.journal_file import CorruptJournal, UnexpectedFrame
from protocol.messages import (
    Command,
    Contact,
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
from protocol.wire import MAX_FRAME_BYTES, MalformedFrame, decode


class FramedReport(msgspec.Struct, frozen=True):
    """A report together with the frame in which it was received or is sent."""

    report: Report
    frame: bytes


class Step(msgspec.Struct, frozen=True):
    """One tick of the journal. A field is None or empty if the journal contains no such frame."""

    observation: Observation
    frame: bytes
    """The frame of the Observation."""
    report: FramedReport | None = None
    """The robot's report to its peer; None without contact."""
    heard: tuple[FramedReport, ...] = ()
    missed: tuple[str, ...] = ()
    """The peers whose report did not arrive in time."""
    command: Command | None = None
    command_frame: bytes | None = None
    estimate: Estimate | None = None
    estimate_frame: bytes | None = None


class Past(msgspec.Struct, frozen=True):
    """The content of a journal, complete or up to the point where it ends."""

    config: RobotConfig
    steps: tuple[Step, ...]
    end: MissionEnd | None = None
    final_report: FinalReport | None = None
    environment: Environment | None = None
    """The environment in which the journal was written; None for older recordings."""
    disorder: UnexpectedFrame | None = None
    """The first frame out of order, if any."""

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """Return the estimates, in the order of the ticks."""
        return tuple([step.estimate for step in self.steps if step.estimate is not None])

    @property
    def claim(self) -> tuple[int, Localised] | None:
        """Return the robot's first claim and its tick, or None."""
        for step in self.steps:
            if step.command is not None and isinstance(step.command.verdict, Localised):
                return step.observation.tick, step.command.verdict
        return None

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
        claim, odometry = self.claim, self.odometry
        if claim is None:
            return ()
        tick, verdict = claim
        frame = compose(verdict.pose, inverse(odometry[tick]))
        return tuple([compose(frame, pose) for pose in odometry])

    def contact(self, tick: int) -> Contact | None:
        """Return the contact with the peer in the Observation of `tick`; None if there is none."""
        contacts = self.steps[tick].observation.contacts if tick < len(self.steps) else ()
        return contacts[0] if contacts else None


class JournalReading:
    """A reader of an agent's journal, frame by frame."""

    def __init__(self) -> None:
        self.environment: Environment | None = None
        self.config: RobotConfig | None = None
        """The configuration; None until it has been read."""
        self.messages: list[Any] = []
        """The messages that have been read, in order."""
        self.disorder: UnexpectedFrame | None = None
        """The first frame out of order."""
        self._steps: list[Step] = []
        self._step: _OpenStep | None = None
        """The latest tick, which may be incomplete."""
        self._end: MissionEnd | None = None
        self._final_report: FinalReport | None = None

    def take(self, frame: bytes) -> bool:
        """Add the next frame, and return whether it is in order. Add no frame after one that is not.

        Raises MalformedFrame, also if the first frame besides the environment is no RobotConfig.
        """
        message = decode(frame, OfRobot, MAX_FRAME_BYTES)
        if not self._fits(message, frame):
            tick: int | None = getattr(message, "tick", None)
            at = f" of tick {tick}" if tick is not None else ""
            kind = type(message).__name__
            what = f"{'an' if kind[0] in 'AEIO' else 'a'} {kind}{at} is out of order"
            self.disorder = UnexpectedFrame(tick, what)
            return False
        self.messages.append(message)
        return True

    def _fits(self, message: object, frame: bytes) -> bool:
        """Add `message`, and return True if it may be next."""
        if self.config is None:
            return self._begins(message)
        step = self._step
        match message:
            case _ if self._end is not None:
                if not isinstance(message, FinalReport) or self._final_report is not None:
                    return False
                self._final_report = message
            case Command() | Estimate() | Report() | DeadlineMissed():
                return step is not None and step.take(message, frame, self.config.robot)
            case Observation(tick) if tick == len(self._steps) + (step is not None):
                if step is not None:
                    if step.command is None:
                        return False
                    self._steps.append(step.closed())
                self._step = _OpenStep(message, frame)
            case MissionEnd():
                self._end = message
            case _:
                return False
        return True

    def _begins(self, message: object) -> bool:
        """Add the environment, which is missing in older recordings, or the configuration."""
        match message:
            case Environment() if not self.messages:
                self.environment = message
            case RobotConfig():
                self.config = message
            case _:
                raise MalformedFrame("an agent's journal must begin with a RobotConfig")
        return True

    def content(self) -> Past | None:
        """Return the content that has been read so far; None if there is no RobotConfig."""
        if self.config is None:
            return None
        steps = [*self._steps, self._step.closed()] if self._step is not None else self._steps
        return Past(self.config, tuple(steps), self._end, self._final_report, self.environment, self.disorder)


class _OpenStep:
    """A tick to which frames can be added."""

    __slots__ = (
        "command",
        "command_frame",
        "estimate",
        "estimate_frame",
        "frame",
        "heard",
        "missed",
        "observation",
        "report",
    )

    def __init__(self, observation: Observation, frame: bytes) -> None:
        self.observation, self.frame = observation, frame
        self.report: FramedReport | None = None
        self.heard: tuple[FramedReport, ...] = ()
        self.missed: tuple[str, ...] = ()
        self.command: Command | None = None
        self.command_frame: bytes | None = None
        self.estimate: Estimate | None = None
        self.estimate_frame: bytes | None = None

    def take(self, message: Report | DeadlineMissed | Command | Estimate, frame: bytes, robot: str) -> bool:
        """Add a message to the journal of `robot`, and return True if it may be next."""
        is_open = self.command is None
        if isinstance(message, Report) and message.robot != robot:
            if is_open:
                self.heard += (FramedReport(message, frame),)
            return is_open
        if message.tick != self.observation.tick:
            return False
        match message:
            case Command() if is_open:
                self.command, self.command_frame = message, frame
            case Estimate() if not is_open and self.estimate is None:
                self.estimate, self.estimate_frame = message, frame
            case Report() if self.report is None:
                self.report = FramedReport(message, frame)
            case DeadlineMissed() if is_open:
                self.missed += (message.robot,)
            case _:
                return False
        return True

    def closed(self) -> Step:
        """Return the tick with all that has been added."""
        return Step(
            self.observation,
            self.frame,
            self.report,
            self.heard,
            self.missed,
            self.command,
            self.command_frame,
            self.estimate,
            self.estimate_frame,
        )


def past(frames: Iterable[bytes], source: object) -> Past:
    """Return the content of a journal's `frames`.

    Raises CorruptJournal, with a text that begins with `source`.
    """
    reading = JournalReading()
    try:
        for frame in frames:
            if not reading.take(frame):
                break
    except MalformedFrame as error:
        raise CorruptJournal(f"{source}: {error}") from None
    if reading.disorder is not None:
        raise CorruptJournal(f"{source}: {reading.disorder.what}")
    content = reading.content()
    if content is None:
        raise CorruptJournal(f"{source}: it contains no RobotConfig")
    return content
