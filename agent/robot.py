"""A robot between its wires: planner, radio and journal, whatever carries the frames.

The process over Zenoh and the in-process mission drive the same `Robot`, so they journal the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from agent import planner
from agent.mind import Mind
from protocol.journal import Journal
from protocol.messages import Briefing, Drive, End, Estimate, Farewell, Missed, Report, Sense
from protocol.wire import encode


class Told(msgspec.Struct, frozen=True):
    """A report and the frame that it came in, or goes out in."""

    report: Report
    frame: bytes


class Robot:
    """One robot's mind, and the record of what went in and came out of it."""

    def __init__(self, briefing: Briefing, journal: Journal | None = None) -> None:
        self.mind = Mind(briefing)
        self.reports_sent = 0
        self.bytes_sent = 0
        self.refused = 0
        """frames that were malformed, or not from whom they said"""
        self._journal = journal
        if journal is not None:
            journal.write(encode(briefing))

    def sense(self, sense: Sense) -> Told | None:
        """Fold in what was sensed; the report to send, if there is anyone to hear it."""
        self.mind = planner.observe(self.mind, sense)
        told = None
        if sense.contacts:
            report = planner.report(self.mind)
            told = Told(report, encode(report))
            self.reports_sent += 1
            self.bytes_sent += len(told.frame)
        if self._journal is not None:
            frames = [encode(sense)]
            if told is not None:
                frames.append(told.frame)
            self._journal.write(*frames)
        return told

    def decide(self, heard: Sequence[Told] = (), missed: Sequence[str] = ()) -> Drive:
        """Fold in what was heard; the drive for the tick. `missed` are peers whose report did not come."""
        if self._journal is not None and (heard or missed):
            silent = [encode(Missed(self.mind.tick, peer)) for peer in missed]
            self._journal.write(*[told.frame for told in heard], *silent)
        self.mind = planner.decide(self.mind, [told.report for told in heard])
        drive = planner.drive(self.mind)
        if self._journal is not None:
            self._journal.write(encode(drive), encode(self.estimate()))
        return drive

    def estimate(self) -> Estimate:
        """What the robot holds possible, for whoever watches."""
        return planner.estimate(self.mind)

    def farewell(self, end: End) -> Farewell:
        """The mission is over: how it went, seen from inside."""
        mind, findings = self.mind, self.mind.findings
        plan = findings.plan
        farewell = Farewell(
            robot=mind.briefing.robot,
            anchor_ranges=len(mind.log.ranges),
            mutual_ranges=len(mind.mutual),
            branch=findings.branch_by,
            alpha=findings.branch.alpha if findings.branch is not None else None,
            placements=findings.solutions,
            last_turn_rate=plan.drive.omega if plan is not None else None,
            separation_m2=plan.separation_m2 if plan is not None else None,
            reports_sent=self.reports_sent,
            reports_heard=mind.radio.heard,
            reports_refused=self.refused,
            bytes_sent=self.bytes_sent,
        )
        if self._journal is not None:
            self._journal.write(encode(end), encode(farewell))
        return farewell
