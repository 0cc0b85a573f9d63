"""What an agent's journal tells: the briefing, then tick after tick what came in and what was answered."""

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
    """One tick, in the order of the journal; what is none or empty did not come, or not any more."""

    observation: Observation
    frame: bytes
    """that the Observation came in"""
    report: FramedReport | None = None
    """to the peer, in contact"""
    heard: tuple[FramedReport, ...] = ()
    missed: tuple[str, ...] = ()
    """peers whose report did not come in time"""
    command: Command | None = None
    estimate: Estimate | None = None


class Past(msgspec.Struct, frozen=True):
    """A journal, whole or up to where it breaks off."""

    config: RobotConfig
    steps: tuple[Step, ...]
    end: MissionEnd | None = None
    final_report: FinalReport | None = None
    environment: Environment | None = None
    """where it was written; none of an older recording"""

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """What the robot held possible, tick by tick."""
        return tuple([step.estimate for step in self.steps if step.estimate is not None])

    @property
    def claim(self) -> tuple[int, Localised] | None:
        """The first that it made, and in which tick."""
        for step in self.steps:
            if step.command is not None and isinstance(step.command.verdict, Localised):
                return step.observation.tick, step.command.verdict
        return None

    @property
    def odometry(self) -> tuple[Pose, ...]:
        """Its poses in the frame of tick 0, dead-reckoned from what it measured itself to have driven."""
        poses, period = [ORIGIN], self.config.mission.period
        for step in self.steps[1:]:
            done = step.observation.executed or REST
            poses.append(motion.step(poses[-1], done.v, done.omega, period))
        return tuple(poses[: len(self.steps)])

    @property
    def path(self) -> tuple[Pose, ...]:
        """Where it was in the plane, by its claim: its odometry, laid through it. Empty, if it made none."""
        claim, odometry = self.claim, self.odometry
        if claim is None:
            return ()
        tick, said = claim
        frame = compose(said.pose, inverse(odometry[tick]))
        return tuple([compose(frame, pose) for pose in odometry])

    def contact(self, tick: int) -> Contact | None:
        """With its peer, as it sensed it at `tick`; none, too, where that is not on record."""
        contacts = self.steps[tick].observation.contacts if tick < len(self.steps) else ()
        return contacts[0] if contacts else None


class OutOfOrder(CorruptJournal):
    """A frame that is sound, and stands where none of its kind can."""

    def __init__(self, message: msgspec.Struct, place: int, source: object) -> None:
        self.place = place
        """how many frames stand before it"""
        self.tick: int | None = getattr(message, "tick", None)
        at = f" of tick {self.tick}" if self.tick is not None else ""
        kind = type(message).__name__
        self.what = f"{'an' if kind[0] in 'AE' else 'a'} {kind}{at} is out of order"
        super().__init__(f"{source}: {self.what}")


def past(frames: Iterable[bytes], source: object) -> Past:
    """What `frames` tell. Raises CorruptJournal, whose text begins with `source`."""
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
            raise CorruptJournal(f"{source}: an agent's journal begins with its Briefing")
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
                onward = _with(steps[-1], message, frame, config.robot)
                if onward is None:
                    raise OutOfOrder(message, place, source)
                steps[-1] = onward
            case _:
                raise OutOfOrder(message, place, source)
    if config is None:
        raise CorruptJournal(f"{source}: there is no RobotConfig in it")
    return Past(config, tuple(steps), end, final_report, environment)


def _answered(steps: Sequence[Step]) -> bool:
    """Whether the latest of them has come to its Command, so that the next may come."""
    return not steps or steps[-1].command is not None


def _message(frame: bytes, source: object) -> Any:
    try:
        return decode(frame, OfRobot, MAX_FRAME_BYTES)
    except MalformedFrame as error:
        raise CorruptJournal(f"{source}: {error}") from None


def _with(step: Step, message: object, frame: bytes, robot: str) -> Step | None:
    """`step`, and what came next in it; none where that cannot come next."""
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
