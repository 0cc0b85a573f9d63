"""What a robot has told its peer, heard from it and acknowledged: pure bookkeeping."""

from __future__ import annotations

import msgspec

from agent.peer.motion_log import MotionLog
from protocol.messages import MAX_REPORT_RANGES, Report, Verdict
from protocol.motion import Pose


class PeerState(msgspec.Struct, frozen=True):
    """All that is known of the peer, and how much of its own log a robot need not repeat."""

    peer: MotionLog = MotionLog()
    start: Pose | None = None
    """where tick 0 of the peer's odometry lies in the frame of the peer's anchor"""
    phase: int = 1
    state: str = ""
    """where in the mission the peer was when last heard, and what it did"""
    verdict: Verdict | None = None
    """the peer's"""
    latest: int = -1
    """the tick of the newest report heard"""
    acknowledged: int = 0
    """the peer knows this robot's manoeuvres through this tick"""
    ranges_acknowledged: int = 0
    """and so many of its ranges"""
    heard: int = 0
    """reports, repeats included"""
    ranges_through: int = -1
    """the peer's ranges are known through this tick; what is not among them was silent"""


def contradiction(report: Report) -> str | None:
    """What in `report` no well-formed log could say, or None."""
    if report.heard > report.tick:
        return f"tick {report.heard} acknowledged at tick {report.tick}"
    if report.ranges_heard > report.tick + 1:
        return f"{report.ranges_heard} ranges acknowledged at tick {report.tick}, one a tick at the most"
    if report.through > report.tick or report.since > report.through:
        return f"a log over [{report.since}, {report.through}] told at tick {report.tick}"
    if sum(run.ticks for run in report.runs) != report.through - report.since:
        return f"manoeuvres that do not fill [{report.since}, {report.through}]"
    earliest = report.ranges_since - 1  # one a tick at the most
    for ranged in report.ranges:
        if not earliest < ranged.tick <= report.tick:
            return f"a range of tick {ranged.tick} outside ({earliest}, {report.tick}]"
        earliest = ranged.tick
    return None


def hear(radio: PeerState, report: Report) -> PeerState:
    """Late, repeated and overtaken reports change nothing but the count."""
    newer = report.tick > radio.latest
    known = len(radio.peer.ranges) >= report.ranges_since
    whole = len(report.ranges) < MAX_REPORT_RANGES
    told_through = report.tick if whole else report.ranges[-1].tick
    return PeerState(
        peer=radio.peer.extended(
            report.since, report.ranges_since, MotionLog(report.through, report.runs, report.ranges)
        ),
        start=radio.start or report.start,
        phase=report.phase if newer else radio.phase,
        state=report.state if newer else radio.state,
        verdict=report.verdict if newer else radio.verdict,
        latest=max(report.tick, radio.latest),
        acknowledged=max(report.heard, radio.acknowledged),
        ranges_acknowledged=max(report.ranges_heard, radio.ranges_acknowledged),
        heard=radio.heard + 1,
        ranges_through=max(told_through, radio.ranges_through) if known else radio.ranges_through,
    )
