"""One robot without its transport: the planner, the reports and the journal.

The agent process over Zenoh and the run in one process use the same `Robot`, so they journal the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence

from agent.planning.registry import planner
from agent.process.agent_journal import FramedReport
from protocol.journal import environment
from protocol.journal.journal_file import Sink
from protocol.messages import (
    Command,
    DeadlineMissed,
    FinalReport,
    MissionEnd,
    Observation,
    RobotConfig,
)
from protocol.wire import encode


class Robot:
    """The state of one robot, and the journal of its inputs and outputs."""

    def __init__(self, config: RobotConfig, journal: Sink | None = None) -> None:
        self.planner = planner(config.planner_name, config.mission)
        self.state = self.planner.start(config)
        self.report: FramedReport | None = None
        """The report of this tick; None if no peer is in contact."""
        self.command: Command | None = None
        """The Command of this tick; None until it is decided."""
        self.reports_sent = 0
        self.damaged = 0
        """The number of reports that were received damaged."""
        self.unheard: set[int] = set()
        """The ticks of contact from which the peer's report has not been received yet."""
        self.bytes_sent = 0
        self._command_frame: bytes | None = None
        self._unwritten: bytes | None = None
        """An Observation without a report; it is journaled with the Command, before the Command is sent."""
        self._journal = journal
        if journal is not None:
            journal.write(encode(environment.of_robot()), encode(config))

    def append_to(self, journal: Sink | None) -> None:
        """Write all frames from now on to `journal`."""
        self._journal = journal

    @property
    def journaled(self) -> bool:
        """Return whether frames are written to a journal."""
        return self._journal is not None

    @property
    def command_frame(self) -> bytes:
        """Return the frame of this tick's Command, which must have been decided."""
        if self._command_frame is None:
            assert self.command is not None
            self._command_frame = encode(self.command)
        return self._command_frame

    def observation(self, observation: Observation, frame: bytes | None = None) -> FramedReport | None:
        """Update the state with an Observation, and return the report to send; None if no peer is in contact.

        `frame` is the encoded Observation, if it was received as one.
        """
        self.state = self.planner.observe(self.state, observation)
        self.report = self.command = self._command_frame = None
        for contact in observation.contacts:
            self.unheard.add(observation.tick)
            self.unheard.difference_update(contact.heard or (), contact.damaged)
            self.damaged += len(contact.damaged)
        if observation.contacts:
            report = self.planner.report(self.state)
            self.report = FramedReport(report, encode(report))
            self.reports_sent += 1
            self.bytes_sent += len(self.report.frame)
            if self._journal is not None:
                self._journal.write(frame or encode(observation), self.report.frame)
        elif self._journal is not None:
            self._unwritten = frame or encode(observation)
        return self.report

    def decide(self, received: Sequence[FramedReport] = (), missed: Sequence[str] = ()) -> Command:
        """Update the state with the received reports, and return the Command of this tick.

        `missed` names the peers whose reports did not arrive in time.
        """
        reports = [framed.report for framed in received] if received else ()
        self.state = self.planner.decide(self.state, reports)
        if received:
            self.unheard.difference_update([report.tick for report in reports])
        self.command = self.planner.command(self.state)
        if self._journal is not None:
            frames = [framed.frame for framed in received]
            frames += [encode(DeadlineMissed(self.state.tick, peer)) for peer in missed]
            if self._unwritten is not None:
                frames.insert(0, self._unwritten)
                self._unwritten = None
            self._journal.write(*frames, self.command_frame)
        return self.command

    def estimate(self) -> bytes:
        """Return the frame of the Estimate of this tick, for viewers. Call it once a tick, after `decide`.

        No process waits for an Estimate, so it is computed and journaled after the Command has been sent.
        """
        frame = encode(self.planner.estimate(self.state))
        if self._journal is not None:
            self._journal.write(frame)
        return frame

    def final_report(
        self, end: MissionEnd, *, reports_refused: int = 0, reports_unheard: int = 0, frames_refused: int = 0
    ) -> FinalReport:
        """Return the robot's summary of the finished mission, and journal it after `end`.

        The arguments count the frames that the transport refused and the reports that no Observation listed.
        """
        state, belief = self.state, self.state.belief
        plan = state.plan
        final_report = FinalReport(
            robot=state.config.robot,
            anchor_ranges=len(state.log.ranges),
            mutual_ranges=len(state.mutual),
            branch=belief.branch_kind,
            alpha=belief.branch.alpha if belief.branch is not None else None,
            candidates=belief.candidates,
            last_turn_rate=plan.command.omega if plan is not None else None,
            separation_m2=plan.separation_m2 if plan is not None else None,
            hypotheses=(len(belief.pair or belief.placements) if belief.candidates is not None else None),
            probability=belief.pair[0].probability if belief.pair else None,
            blocking_reason=belief.blocking_reason,
            p_value=belief.p_value,
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
