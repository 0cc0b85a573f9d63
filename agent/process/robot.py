"""A robot between its wires: planner, radio and journal, whatever carries the frames.

The process over Zenoh and the in-process mission drive the same `Robot`, so they journal the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from agent.planning import planner
from agent.planning.state import RobotState
from protocol.journal import environment
from protocol.journal.journal_file import Sink
from protocol.messages import (
    Command,
    DeadlineMissed,
    FinalReport,
    MissionEnd,
    Observation,
    Report,
    RobotConfig,
)
from protocol.wire import encode


class FramedReport(msgspec.Struct, frozen=True):
    """A report and the frame that it came in, or goes out in."""

    report: Report
    frame: bytes


class Robot:
    """One robot's mind, and the record of what went in and came out of it."""

    def __init__(self, config: RobotConfig, journal: Sink | None = None) -> None:
        self.mind = RobotState(config)
        self.told: FramedReport | None = None
        """the report of this tick, if there was anyone to hear it"""
        self.command: Command | None = None
        """the Command of this tick; none before it is decided"""
        self.reports_sent = 0
        self.damaged = 0
        """reports that came damaged"""
        self.unheard: set[int] = set()
        """ticks in which the peer said a report that has not come yet"""
        self.bytes_sent = 0
        self._frame: bytes | None = None
        self._unwritten: bytes | None = None
        """a Observation that nothing has followed from yet; journaled with the Command, before that is sent"""
        self._journal = journal
        if journal is not None:
            journal.write(encode(environment.of_robot()), encode(config))

    def keep(self, journal: Sink | None) -> None:
        """Go on journaling there."""
        self._journal = journal

    @property
    def journaled(self) -> bool:
        """Whether there is a record to keep."""
        return self._journal is not None

    @property
    def drive_frame(self) -> bytes:
        """What to send of this tick's Command, once there is one."""
        if self._frame is None:
            assert self.command is not None
            self._frame = encode(self.command)
        return self._frame

    def observation(self, observation: Observation, frame: bytes | None = None) -> FramedReport | None:
        """Fold in what was sensed (it came in `frame`); the report to send, if anyone is there to hear it."""
        self.mind = planner.observe(self.mind, observation)
        self.told = self.command = self._frame = None
        for contact in observation.contacts:
            self.unheard.add(observation.tick)
            self.unheard.difference_update(contact.heard or (), contact.damaged)
            self.damaged += len(contact.damaged)
        if observation.contacts:
            report = planner.report(self.mind)
            self.told = FramedReport(report, encode(report))
            self.reports_sent += 1
            self.bytes_sent += len(self.told.frame)
            if self._journal is not None:
                self._journal.write(frame or encode(observation), self.told.frame)
        elif self._journal is not None:
            self._unwritten = frame or encode(observation)
        return self.told

    def decide(self, heard: Sequence[FramedReport] = (), missed: Sequence[str] = ()) -> Command:
        """Fold in what was heard; the drive for the tick. `missed` are peers whose report did not come."""
        self.mind = planner.decide(self.mind, [told.report for told in heard])
        self.unheard.difference_update([told.report.tick for told in heard])
        self.command = planner.command(self.mind)
        if self._journal is not None:
            frames = [told.frame for told in heard]
            frames += [encode(DeadlineMissed(self.mind.tick, peer)) for peer in missed]
            if self._unwritten is not None:
                frames.insert(0, self._unwritten)
                self._unwritten = None
            self._journal.write(*frames, self.drive_frame)
        return self.command

    def estimate(self) -> bytes:
        """The frame of what the robot holds possible, for whoever watches; once a tick, after the Command.

        Nobody waits for it, so it is made and journaled when the Command is on its way.
        """
        frame = encode(planner.estimate(self.mind))
        if self._journal is not None:
            self._journal.write(frame)
        return frame

    def final_report(
        self, end: MissionEnd, *, reports_refused: int = 0, reports_unheard: int = 0, frames_refused: int = 0
    ) -> FinalReport:
        """The mission is over: how it went, seen from inside, and what the wire brought that was no use."""
        state, findings = self.mind, self.mind.belief
        plan = findings.plan
        final_report = FinalReport(
            robot=state.config.robot,
            anchor_ranges=len(state.log.ranges),
            mutual_ranges=len(state.mutual),
            branch=findings.branch_kind,
            alpha=findings.branch.alpha if findings.branch is not None else None,
            candidates=findings.candidates,
            last_turn_rate=plan.command.omega if plan is not None else None,
            separation_m2=plan.separation_m2 if plan is not None else None,
            hypotheses=(
                len(findings.pair or findings.placements) if findings.candidates is not None else None
            ),
            probability=findings.pair[0].probability if findings.pair else None,
            blocking_reason=findings.blocking_reason,
            p_value=findings.p_value,
            reports_sent=self.reports_sent,
            reports_heard=state.peer_state.heard,
            reports_refused=reports_refused + self.damaged,
            reports_unheard=reports_unheard,
            reports_lost=len(self.unheard),
            frames_refused=frames_refused,
            bytes_sent=self.bytes_sent,
        )
        if self._journal is not None:
            self._journal.write(encode(end), encode(final_report))
        return final_report
