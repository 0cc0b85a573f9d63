"""What a robot remembers when its process is started again: its journal, folded.

The planner decides everything once more, and what it decides must be what is on record.
"""

from __future__ import annotations

from collections import deque

import msgspec

from agent.process.agent_journal import past
from agent.process.robot import FramedReport, Robot
from protocol.journal import environment
from protocol.journal.journal_file import CorruptJournal
from protocol.journal.resume import ReplayMismatch, Retrace
from protocol.messages import FinalReport, MissionEnd, Observation, RobotConfig
from protocol.wire import encode

REPORTS_KEPT = 64
"""ticks for which a report of the peer is kept that no Observation has listed yet"""
REPORTS_TOLD = REPORTS_KEPT - 4
"""ticks for which a robot can say its own again; less, or the peer would count them twice"""


class Memory(msgspec.Struct, frozen=True):
    """A robot and what its process must know beside its mind; of a new robot, nothing."""

    config: RobotConfig
    robot: Robot
    observation: Observation | None = None
    """the latest"""
    told: tuple[FramedReport, ...] = ()
    """its latest reports"""
    heard: tuple[FramedReport, ...] = ()
    """the peer's latest"""
    end: MissionEnd | None = None
    final_report: FinalReport | None = None
    """what it has answered to the MissionEnd"""


def remember(recording: Retrace) -> Memory | None:
    """What `recording` tells; None if there is nothing in it.

    Raises CorruptJournal if it tells no mission, or one in which other decisions were taken.
    """
    if environment.is_blank(recording.frames):
        return None
    named = environment.named_in(recording.frames)
    lived = past(recording.frames, recording.path)
    robot = Robot(lived.config)
    robot.keep(recording)
    recording.write(*[encode(one) for one in (named, lived.config) if one is not None])
    told: deque[FramedReport] = deque(maxlen=REPORTS_TOLD)
    for step in lived.steps:
        try:
            report = robot.observation(step.observation, step.frame)
            if report is not None:  # though it be torn on record
                told.append(report)
            if step.command is not None:
                robot.decide(step.heard, step.missed)
                robot.estimate()
        except ReplayMismatch:
            raise CorruptJournal(
                f"{recording.path}: on record it decided otherwise at tick {step.observation.tick}: "
                + (environment.otherwise(named, environment.of_robot()) or "the journal is another version's")
            ) from None
    if lived.final_report is not None:  # counts what the wire brought, too, which no fold can
        recording.write(*recording.frames[-2:])
    observation = lived.steps[-1].observation if lived.steps else None
    now = observation.tick if observation is not None else 0
    latest = lived.steps[-REPORTS_KEPT:]
    return Memory(
        config=lived.config,
        robot=robot,
        observation=observation,
        told=tuple(told),
        heard=tuple([one for step in latest for one in step.heard if now - one.report.tick <= REPORTS_KEPT]),
        end=lived.end if lived.final_report is not None else None,
        final_report=lived.final_report,
    )
