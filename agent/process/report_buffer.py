"""A buffer for received reports, which stores each until an Observation lists it or it is too old."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

from agent.process.agent_journal import FramedReport
from agent.process.robot import REPORTS_KEPT
from protocol.messages import Report
from protocol.network.inbox import Arrival, Inbox
from protocol.wire import MAX_REPORT_BYTES


class ReportBuffer:
    """The received reports, by their sender and tick."""

    def __init__(
        self,
        inbox: Inbox,
        received: Sequence[FramedReport],
        malformed: Callable[[Report], str | None],
        *,
        real_time: bool,
    ) -> None:
        """Start with `received`, the reports in the journal of a restarted process.

        `malformed` returns why the planner's decoder refuses a report, None if it does not.
        """
        self._malformed = malformed
        self._inbox = inbox
        self._real_time = real_time
        self._reports = {(framed.report.robot, framed.report.tick): framed for framed in received}
        self._listed = set(self._reports)
        """The senders and ticks of the reports that an Observation has listed."""
        self.unheard = 0
        """The number of reports that were received, but never listed."""

    def take(self, arrival: Arrival, latest: int) -> None:
        """Store the report in `arrival`, or refuse it. `latest` is the tick of the latest Observation."""
        report: Report | None = self._inbox.accepted(arrival, Report, MAX_REPORT_BYTES)
        if report is None:
            return
        if (wrong := self._malformed(report)) is not None:
            self._inbox.refuse(arrival, wrong)
            return
        if not self._real_time and report.tick > latest + 1:
            self._inbox.refuse(arrival, "its tick is in the future")
            return
        if abs(report.tick - max(latest, 0)) > REPORTS_KEPT:
            self.unheard += 1
            return
        framed = FramedReport(report, arrival.frame)
        if self._reports.setdefault((report.robot, report.tick), framed).frame != arrival.frame:
            self._inbox.refuse(arrival, "it differs from an earlier report of this tick")

    def of(self, sender: str, tick: int) -> FramedReport | None:
        """Return the report that `sender` sent in `tick`, or None if it has not arrived."""
        return self._reports.get((sender, tick))

    def waiting(self, sender: str, latest: int) -> list[FramedReport]:
        """Return the reports of `sender` from ticks up to `latest` that were never listed, oldest first."""
        return [
            self._reports[one]
            for one in sorted(self._reports)
            if one[0] == sender and one[1] <= latest and one not in self._listed
        ]

    def list(self, reports: Iterable[tuple[str, int]]) -> None:
        """Mark the reports with these senders and ticks as listed by an Observation."""
        self._listed.update(reports)

    def forget(self, before: int, contacts: Mapping[int, Collection[str]]) -> None:
        """Delete the reports of ticks below `before`, and count those neither listed nor in `contacts`."""
        for one in [one for one in self._reports if one[1] < before]:
            del self._reports[one]
            self.unheard += one not in self._listed and one[0] not in contacts.get(one[1], ())
            self._listed.discard(one)
