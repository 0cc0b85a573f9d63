"""The measurements of all robots of a team, as far as one of them has them, and the reports that share them.

Each robot has a log with one entry a tick. A report has what its receiver has not acknowledged, of all
robots: so measurements also reach robots that are never in contact. Entries are only appended, and the first
one of a tick counts. So a report may be lost, late or repeated, and changes nothing but the time.

If some robots may report false data, a report counts for its sender alone, and there is no hearsay.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from protocol.messages import MAX_MEMBERS, Observation, Team
from protocol.motion import Controls
from protocol.units import Count, Range

MOST_REPORTED_BYTES = 3600
"""The largest estimated size of the entries in one report, so that its body fits in `MAX_BODY_BYTES`."""

ENTRY_BYTES, RANGE_BYTES = 24, 13
"""The largest size of an entry without ranges, and that of a range in it."""


class Ranging(msgspec.Struct, frozen=True, array_like=True, gc=False, forbid_unknown_fields=True):
    """A measured range to an anchor or a robot."""

    to: Count
    """The place of the anchor or the robot in the team."""
    range: Range
    """The measured distance, in m."""


class Entry(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The measurements of a robot in one tick k."""

    executed: Controls | None
    """The odometry over [k - 1, k]; None at tick 0."""
    anchors: tuple[Ranging, ...] = ()
    """The ranges to anchors."""
    robots: tuple[Ranging, ...] = ()
    """The ranges to robots."""

    @property
    def size(self) -> int:
        """The largest size of its encoding in bytes."""
        return ENTRY_BYTES + RANGE_BYTES * (len(self.anchors) + len(self.robots))


class LogPart(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A part of the log of one robot."""

    robot: Count
    """The place of the robot in the team."""
    since: Count
    """The tick of the first entry."""
    entries: tuple[Entry, ...]


class TeamReport(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The body of a report: what the sender knows and the receiver has not acknowledged."""

    sender: Count
    """The place of the sender in the team."""
    parts: Annotated[tuple[LogPart, ...], Meta(max_length=MAX_MEMBERS)]
    known: Annotated[tuple[Count, ...], Meta(max_length=MAX_MEMBERS)]
    """The acknowledgement: the number of entries that the sender has of each robot."""
    done: Annotated[tuple[Count, ...], Meta(max_length=MAX_MEMBERS)] = ()
    """The robots that have a result, as far as the sender knows."""


class TeamLog(msgspec.Struct, frozen=True):
    """The logs of all robots, and what others have acknowledged."""

    logs: tuple[tuple[Entry, ...], ...]
    """The entries of each robot, in the order of the team; that of tick k has the index k."""
    acknowledged: tuple[tuple[int, ...], ...]
    """The number of entries of each robot that each of the others has."""
    done: frozenset[int] = frozenset()
    """The robots that have a result."""
    hearsay: bool = True
    """True if a report also counts for robots other than its sender."""

    @staticmethod
    def of(team: Team, *, hearsay: bool = True) -> TeamLog:
        """Return the logs of a team that has measured nothing yet."""
        count = len(team.robots)
        return TeamLog(((),) * count, ((0,) * count,) * count, hearsay=hearsay)

    def measured(self, own: int, observation: Observation, team: Team) -> TeamLog:
        """Return the logs with an observation of the robot at the place `own`."""
        anchors = {one.id: place for place, one in enumerate(team.anchors)}
        robots = {one: place for place, one in enumerate(team.robots)}
        entry = Entry(
            observation.executed,
            tuple([Ranging(anchors[one.anchor], one.range) for one in observation.anchors]),
            tuple(
                [
                    Ranging(robots[one.peer], one.range)
                    for one in observation.contacts
                    if one.range is not None
                ]
            ),
        )
        return replace(self, logs=_replaced(self.logs, own, (*self.logs[own], entry)))

    def received(self, reports: Sequence[TeamReport], own: int) -> TeamLog:
        """Return the logs with what is new in `reports`, of robots other than the one at the place `own`.

        Nobody else knows its result, and no entry is of a later tick than its latest one.
        """
        logs, acknowledged, done = self.logs, self.acknowledged, self.done
        count = len(logs)
        for report in reports:
            if report.sender >= count or len(report.known) != count or report.sender == own:
                continue  # of no robot of this team
            told = [one for one in range(count) if one != own and (self.hearsay or one == report.sender)]
            done = done.union([one for one in report.done if one in told])
            for part in report.parts:
                if part.robot in told and part.since <= len(logs[part.robot]):
                    new = part.entries[len(logs[part.robot]) - part.since : len(logs[own]) - part.since]
                    logs = _replaced(logs, part.robot, (*logs[part.robot], *new)) if new else logs
            known = tuple(map(max, acknowledged[report.sender], report.known))
            acknowledged = _replaced(acknowledged, report.sender, known)
        return replace(self, logs=logs, acknowledged=acknowledged, done=done)

    def report(self, own: int, peer: int) -> TeamReport:
        """Return the report of the robot at the place `own` to the one at the place `peer`."""
        left, parts, has = MOST_REPORTED_BYTES, [], self.acknowledged[peer]
        others = range(len(self.logs)) if self.hearsay else ()
        for robot in (own, *[one for one in others if one not in (own, peer)]):
            since, chosen = has[robot], []
            for entry in self.logs[robot][since:]:
                if entry.size > left:
                    break
                left -= entry.size
                chosen.append(entry)
            if chosen:
                parts.append(LogPart(robot, since, tuple(chosen)))
        return TeamReport(own, tuple(parts), tuple(map(len, self.logs)), tuple(sorted(self.done)))


def _replaced(values: tuple[tuple, ...], place: int, value: tuple) -> tuple[tuple, ...]:  # type: ignore[type-arg]
    """Return `values` with another `value` at a `place`."""
    return (*values[:place], value, *values[place + 1 :])
