"""Recovery of a robot's state from its journal when its process is restarted.

The planner computes every decision again, and each must equal the recorded one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import msgspec

from agent.planning.planner import Planner
from agent.process.agent_journal import FramedReport, agent_history
from agent.process.robot import REPORTS_KEPT, PlannerReplay, Robot
from protocol.journal import environment
from protocol.journal.resume import ReplayMismatch, Retrace
from protocol.messages import FinalReport, MissionEnd, Observation, RobotConfig
from protocol.wire import encode

OWN_REPORTS_KEPT = REPORTS_KEPT - 4
"""The number of ticks for which a robot can repeat its own reports.

It is smaller than REPORTS_KEPT. Otherwise the peer would count a report twice.
"""


class Memory(msgspec.Struct, frozen=True):
    """A robot, with the state of its process. Only `robot` is set for a new one."""

    robot: Robot
    observation: Observation | None = None
    """The latest Observation."""
    own_reports: tuple[dict[str, FramedReport], ...] = ()
    """The robot's own reports of its latest ticks in contact, by the receiving robot."""
    received: tuple[FramedReport, ...] = ()
    """The latest reports received."""
    end: MissionEnd | None = None
    final_report: FinalReport | None = None
    """The answer to the MissionEnd."""


def remember(recording: Retrace, planner_of: Callable[[RobotConfig], Planner[Any, Any]]) -> Memory | None:
    """Return the state that follows from `recording`, or None if the journal contains no RobotConfig.

    `planner_of` returns the planner of a configuration.

    Raises CorruptJournal if the journal is not that of an agent, or if the recorded decisions differ.
    """
    if len(recording.frames) < 2:  # at most its environment
        return None
    journal = agent_history(recording.frames, recording.path)
    recording.write(encode(journal.environment), encode(journal.config))
    replay = PlannerReplay(journal, planner_of(journal.config), recording)
    robot = replay.robot
    own_reports: deque[dict[str, FramedReport]] = deque(maxlen=OWN_REPORTS_KEPT)
    try:
        for step in replay:
            if robot.reports:  # although their frames may be torn in the journal
                own_reports.append(robot.reports)
            if step.command is not None:
                robot.estimate()
    except ReplayMismatch:
        what = f"decision differs at tick {replay.tick}"
        raise recording.differing(what, journal.environment, environment.of_robot()) from None
    if journal.final_report is not None:  # it also counts received frames, which a replay cannot reproduce
        recording.write(*recording.frames[-2:])
    observation = journal.steps[-1].observation if journal.steps else None
    tick = observation.tick if observation is not None else 0
    latest = journal.steps[-REPORTS_KEPT:]
    return Memory(
        robot,
        observation=observation,
        own_reports=tuple(own_reports),
        received=tuple(
            [one for step in latest for one in step.received if tick - one.report.tick <= REPORTS_KEPT]
        ),
        end=journal.end if journal.final_report is not None else None,
        final_report=journal.final_report,
    )
