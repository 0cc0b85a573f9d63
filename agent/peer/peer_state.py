"""The state of the exchange between two robots: received data and acknowledgements, as pure functions."""

from __future__ import annotations

import msgspec

from agent.peer.motion_log import MotionLog
from protocol.messages import MAX_REPORT_RANGES, Report, Verdict
from protocol.motion import Pose


class PeerState(msgspec.Struct, frozen=True):
    """Everything received from the peer, and how much of the own log the peer has acknowledged."""

    peer: MotionLog = MotionLog()
    start: Pose | None = None
    """The pose of the peer at tick 0 in the frame of the peer's anchor; None before the peer's phase 2."""
    phase: int = 1
    state: str = ""
    """The name of the peer's task, like `phase` from the latest report."""
    verdict: Verdict | None = None
    """The verdict of the peer in the latest report."""
    latest: int = -1
    """The tick of the latest report received; -1 if there is none."""
    acknowledged: int = 0
    """The last tick of this robot's manoeuvres that the peer has acknowledged."""
    ranges_acknowledged: int = 0
    """The number of this robot's anchor ranges that the peer has acknowledged."""
    ranges_through: int = -1
    """The tick through which the peer's anchor ranges are complete: a tick without one had no detection."""


def contradiction(report: Report) -> str | None:
    """Return the reason why `report` is malformed, or None if it is well-formed.

    The checks concern the report alone, and do not depend on earlier reports.
    """
    if report.body is not None:
        return "a body, and this robot's planner has none"
    if report.heard > report.tick:
        return f"tick {report.heard} acknowledged at tick {report.tick}"
    if report.ranges_heard > report.tick + 1:
        return f"{report.ranges_heard} ranges acknowledged at tick {report.tick}, at most one per tick"
    if report.through > report.tick or report.since > report.through:
        return f"a log over [{report.since}, {report.through}] reported at tick {report.tick}"
    if sum(run.ticks for run in report.runs) != report.through - report.since:
        return f"manoeuvres that do not fill [{report.since}, {report.through}]"
    earliest = report.ranges_since - 1  # at most one range per tick
    for ranged in report.ranges:
        if not earliest < ranged.tick <= report.tick:
            return f"a range of tick {ranged.tick} outside ({earliest}, {report.tick}]"
        earliest = ranged.tick
    return None


def with_report(peer_state: PeerState, report: Report) -> PeerState:
    """Return `peer_state` with the data of `report`.

    An overtaken report adds at most a missing part of the log. Acknowledgements are those of the latest
    report, and may decrease: a peer that begins another meeting has none of this robot's log.
    """
    newer, latest = report.tick > peer_state.latest, report.tick >= peer_state.latest
    continues = len(peer_state.peer.ranges) >= report.ranges_since
    whole = len(report.ranges) < MAX_REPORT_RANGES
    ranges_through = report.tick if whole else report.ranges[-1].tick
    return PeerState(
        peer=peer_state.peer.extended(
            report.since, report.ranges_since, MotionLog(report.through, report.runs, report.ranges)
        ),
        start=peer_state.start or report.start,
        phase=report.phase if newer else peer_state.phase,
        state=report.state if newer else peer_state.state,
        verdict=report.verdict if newer else peer_state.verdict,
        latest=max(report.tick, peer_state.latest),
        acknowledged=report.heard if latest else peer_state.acknowledged,
        ranges_acknowledged=report.ranges_heard if latest else peer_state.ranges_acknowledged,
        ranges_through=max(ranges_through, peer_state.ranges_through)
        if continues
        else peer_state.ranges_through,
    )
