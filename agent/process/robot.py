"""One robot without its transport: the planner, the reports and the journal.

The agent process over Zenoh and the run in one process use the same `Robot`, so they journal the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from agent.planning.planner import Planner, Summary, body_of, report_of
from agent.process.agent_journal import AgentHistory, FramedReport, Step
from protocol.journal import environment
from protocol.journal.journal_file import Sink
from protocol.messages import (
    Command,
    DeadlineMissed,
    FinalReport,
    Message,
    MissionEnd,
    Observation,
    RobotConfig,
    Verdict,
)
from protocol.wire import encode

REPORTS_KEPT = 64
"""The number of ticks for which a received report is stored that no Observation has listed yet."""


class Robot:
    """The state of one robot, and the journal of its inputs and outputs."""

    def __init__(
        self,
        config: RobotConfig,
        planner: Planner[Any, Any],
        journal: Sink | None = None,
        encode: Callable[[Message], bytes] = encode,
    ) -> None:
        """`planner` is the one that `config` names, with its options, for the noise of the mission.

        `encode` returns the frame of a message.
        """
        self._encode = encode
        self.config = config
        self.planner = planner
        self.state: Any = planner.start(config)
        self.reports: dict[str, FramedReport] = {}
        """The reports of this tick, by the robot in contact to which each is sent."""
        self.command: Command | None = None
        """The Command of this tick; None until it is decided."""
        self.tick = 0
        """The tick of the latest Observation."""
        self.anchor_ranges = self.mutual_ranges = 0
        """The numbers of ranges that were measured."""
        self.reports_received = 0
        self._heard: dict[str, int] = {}
        """The tick of the latest report received from each robot."""
        self._verdict: Verdict | None = None
        """The verdict in the latest Command."""
        self.reports_sent = 0
        self.damaged = 0
        """The number of reports that were received damaged."""
        self.contacts: dict[int, list[str]] = {}
        """The robots in contact, by tick, as long as reports of that tick are stored."""
        self.lost: set[tuple[str, int]] = set()
        """The sender and the tick of each report that was lost, as the Observations say.

        In hardware mode, where they do not, of each that did not arrive.
        """
        self._unlisted: set[str] = set()
        """The robots in contact in this tick whose reports no Observation lists, in hardware mode."""
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
            self._command_frame = self._encode(self.command)
        return self._command_frame

    def observation(self, observation: Observation, frame: bytes | None = None) -> dict[str, FramedReport]:
        """Update the state with an Observation, and return the reports to send, by the receiving robot.

        `frame` is the encoded Observation, if it was received as one.
        """
        self.tick = observation.tick
        self.state = self.planner.observe(self.state, observation)
        self.anchor_ranges += observation.anchor_range is not None
        self.command = self._command_frame = None
        self.reports = {}
        self.lost.update([(one.sender, one.tick) for one in observation.lost])
        self._unlisted = {contact.peer for contact in observation.contacts if contact.heard is None}
        self.contacts[self.tick] = [contact.peer for contact in observation.contacts]
        self.contacts.pop(self.tick - REPORTS_KEPT - 2, None)
        for contact in observation.contacts:
            peer = contact.peer
            self.damaged += len(contact.damaged)
            self.mutual_ranges += contact.range is not None
            body = self.planner.report_to(self.state, peer)
            report = report_of(body, self.tick, self.config.robot, self._heard.get(peer, 0), self._verdict)
            framed = self.reports[peer] = FramedReport(report, self._encode(report))
            self.reports_sent += 1
            self.bytes_sent += len(framed.frame)
        if self._journal is not None:
            if self.reports:
                frames = [framed.frame for framed in self.reports.values()]
                self._journal.write(frame or self._encode(observation), *frames)
            else:
                self._unwritten = frame or self._encode(observation)
        return self.reports

    def decide(self, received: Sequence[FramedReport] = (), missed: Sequence[str] = ()) -> Command:
        """Update the state with the received reports, and return the Command of this tick.

        `missed` names the peers whose reports did not arrive in time.
        """
        self.state = self.planner.decide(self.state, [body_of(one.report, self.planner) for one in received])
        self.lost.update([(peer, self.tick) for peer in missed if peer in self._unlisted])
        if received:
            self.reports_received += len(received)
            for framed in received:
                sender, tick = framed.report.robot, framed.report.tick
                self._heard[sender] = max(self._heard.get(sender, 0), tick)
                self.lost.discard((sender, tick))
        self.command = self.planner.command(self.state)
        self._verdict = self.command.verdict
        if self._journal is not None:
            frames = [framed.frame for framed in received]
            frames += [self._encode(DeadlineMissed(self.tick, peer)) for peer in missed]
            if self._unwritten is not None:
                frames.insert(0, self._unwritten)
                self._unwritten = None
            self._journal.write(*frames, self.command_frame)
        return self.command

    def estimate(self) -> bytes:
        """Return the frame of the Estimate of this tick, for viewers. Call it once a tick, after `decide`.

        No process waits for an Estimate, so it is computed and journaled after the Command has been sent.
        """
        frame = self._encode(self.planner.estimate(self.state))
        if self._journal is not None:
            self._journal.write(frame)
        return frame

    def final_report(
        self, end: MissionEnd, *, reports_refused: int = 0, reports_unheard: int = 0, frames_refused: int = 0
    ) -> FinalReport:
        """Return the robot's summary of the finished mission, and journal it after `end`.

        The arguments count the frames that the transport refused and the reports that no Observation listed.
        """
        summary = self.planner.summary(self.state)
        stated = {name: getattr(summary, name) for name in Summary.__struct_fields__}
        for name, counted in (
            ("anchor_ranges", self.anchor_ranges),
            ("mutual_ranges", self.mutual_ranges),
            ("reports_heard", self.reports_received),
        ):
            stated[name] = counted if stated[name] is None else stated[name]
        final_report = FinalReport(
            **stated,
            robot=self.config.robot,
            reports_sent=self.reports_sent,
            reports_refused=reports_refused + self.damaged,
            reports_unheard=reports_unheard,
            reports_lost=len(self.lost),
            frames_refused=frames_refused,
            bytes_sent=self.bytes_sent,
        )
        if self._journal is not None:
            self._journal.write(self._encode(end), self._encode(final_report))
        return final_report


class PlannerReplay:
    """The planner of one robot, run again tick by tick on the inputs in its journal.

    Iterate over it once. After each step, `robot` has the recomputed state and frames of that tick. An error
    of the planner is raised as it is, and `tick` is then the tick in which it occurred.
    """

    def __init__(
        self, history: AgentHistory, planner: Planner[Any, Any], journal: Sink | None = None
    ) -> None:
        """Prepare the replay of `history` with `planner`, which its configuration names.

        Everything that the robot recomputes is written to `journal`.
        """
        self.robot = Robot(history.config, planner)
        self.robot.append_to(journal)
        self.tick: int | None = None
        """The tick of the current step; None before the first."""
        self._steps = history.steps

    def __iter__(self) -> Iterator[Step]:
        """Yield each step after the robot has observed it and, if its Command is recorded, has decided."""
        for step in self._steps:
            self.tick = step.observation.tick
            self.robot.observation(step.observation, step.frame)
            if step.command is not None:
                self.robot.decide(step.received, step.missed)
            yield step
