"""Reader of an agent's journal: the RobotConfig, then the inputs and answers of each tick."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import msgspec
from msgspec.structs import replace

from agent.process.robot import FramedReport
from protocol import motion
from protocol.journal.environment import named_in
from protocol.journal.journal_file import CorruptJournal
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
    estimate: Estimate | None = None


class Past(msgspec.Struct, frozen=True):
    """The content of a journal, complete or up to the point where it ends."""

    config: RobotConfig
    steps: tuple[Step, ...]
    end: MissionEnd | None = None
    final_report: FinalReport | None = None
    environment: Environment | None = None
    """The environment in which the journal was written; None for older recordings."""

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


class OutOfOrder(CorruptJournal):
    """A well-formed frame at a position where its kind is not allowed."""

    def __init__(self, message: msgspec.Struct, place: int, source: object) -> None:
        self.place = place
        """The number of frames before it."""
        self.tick: int | None = getattr(message, "tick", None)
        at = f" of tick {self.tick}" if self.tick is not None else ""
        kind = type(message).__name__
        self.what = f"{'an' if kind[0] in 'AEIO' else 'a'} {kind}{at} is out of order"
        super().__init__(f"{source}: {self.what}")


def past(frames: Iterable[bytes], source: object) -> Past:
    """Return the content of a journal's `frames`.

    Raises CorruptJournal, with a text that begins with `source`.
    """
    frames = list(frames)
    environment = named_in(frames)
    first = int(environment is not None)
    config: RobotConfig | None = None
    steps: list[Step] = []
    end: MissionEnd | None = None
    final_report: FinalReport | None = None
    for place, frame in enumerate(frames[first:], first):
        message = _message(frame, source)
        if place == first and not isinstance(message, RobotConfig):
            raise CorruptJournal(f"{source}: an agent's journal must begin with a RobotConfig")
        match message:
            case RobotConfig() if place == first:
                config = message
            case MissionEnd() if end is None:
                end = message
            case FinalReport() if end is not None and final_report is None:
                final_report = message
            case Observation(tick) if end is None and tick == len(steps) and _answered(steps):
                steps.append(Step(message, frame))
            case Report() | DeadlineMissed() | Command() | Estimate() if steps and end is None:
                assert config is not None
                extended = _extended(steps[-1], message, frame, config.robot)
                if extended is None:
                    raise OutOfOrder(message, place, source)
                steps[-1] = extended
            case _:
                raise OutOfOrder(message, place, source)
    if config is None:
        raise CorruptJournal(f"{source}: it contains no RobotConfig")
    return Past(config, tuple(steps), end, final_report, environment)


def _answered(steps: Sequence[Step]) -> bool:
    """Return whether the latest step has its Command, so that the next tick may follow."""
    return not steps or steps[-1].command is not None


def _message(frame: bytes, source: object) -> Any:
    try:
        return decode(frame, OfRobot, MAX_FRAME_BYTES)
    except MalformedFrame as error:
        raise CorruptJournal(f"{source}: {error}") from None


def _extended(step: Step, message: object, frame: bytes, robot: str) -> Step | None:
    """Return `step` extended by `message`, or None if `message` cannot follow."""
    match message:
        case Estimate(tick=step.observation.tick) if step.command is not None and step.estimate is None:
            return replace(step, estimate=message)
        case Command(tick=step.observation.tick) if step.command is None:
            return replace(step, command=message)
        case DeadlineMissed(tick=step.observation.tick) if step.command is None:
            return replace(step, missed=(*step.missed, message.robot))
        case Report(tick=step.observation.tick) if message.robot == robot and step.report is None:
            return replace(step, report=FramedReport(message, frame))
        case Report() if message.robot != robot and step.command is None:
            return replace(step, heard=(*step.heard, FramedReport(message, frame)))
        case _:
            return None
