"""The peer's reports as they come, until a Observation lists them, or nobody has asked for them for long."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from agent.peer import peer_state
from agent.process.recovery import REPORTS_KEPT
from agent.process.robot import FramedReport
from protocol.messages import Report
from protocol.network.inbox import Arrival, Inbox
from protocol.wire import MAX_REPORT_BYTES, MalformedFrame, decode


class Post:
    """What has come, by the tick in which it was told."""

    def __init__(self, inbox: Inbox, heard: Sequence[FramedReport], *, real_time: bool) -> None:
        """`heard` are those that a process which was started again has on record."""
        self._inbox = inbox
        self._real_time = real_time
        self._reports = {told.report.tick: told for told in heard}
        self._listed = set(self._reports)
        """those of them that a Observation has listed"""
        self.unheard = 0
        """those that went without"""

    def take(self, arrival: Arrival, known: int) -> None:
        """Keep it, or refuse it; `known` is the tick of the latest Observation."""
        try:
            report = decode(arrival.frame, Report, MAX_REPORT_BYTES)
        except MalformedFrame as error:
            self._inbox.refuse(arrival, error)
            return
        wrong = peer_state.contradiction(report)
        if report.robot != arrival.source.robot:
            wrong = f"it says it is from '{report.robot}'"
        if wrong is not None:
            self._inbox.refuse(arrival, wrong)
            return
        if not self._real_time and report.tick > known + 1:
            self._inbox.refuse(arrival, "it is of a tick to come")
        elif abs(report.tick - max(known, 0)) > REPORTS_KEPT:
            self.unheard += 1
        elif (
            self._reports.setdefault(report.tick, FramedReport(report, arrival.frame)).frame != arrival.frame
        ):
            self._inbox.refuse(arrival, "it was told otherwise before")

    def of(self, tick: int) -> FramedReport | None:
        """What was told in `tick`, once it has come."""
        return self._reports.get(tick)

    def waiting(self, known: int) -> list[FramedReport]:
        """What has come and was never heard, of ticks up to `known`, the oldest first."""
        return [
            self._reports[tick]
            for tick in sorted(self._reports)
            if tick <= known and tick not in self._listed
        ]

    def list(self, ticks: Iterable[int]) -> None:
        """A Observation has listed those of these `ticks`."""
        self._listed.update(ticks)

    def forget(self, before: int, asked_for: Collection[int]) -> None:
        """Those of ticks `before`, counting what nobody has `asked_for`, nor listed."""
        for tick in [tick for tick in self._reports if tick < before]:
            del self._reports[tick]
            self.unheard += tick not in self._listed and tick not in asked_for
            self._listed.discard(tick)
