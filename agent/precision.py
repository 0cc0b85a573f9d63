"""How exactly a robot knows poses where sensors are exact: by the bounds of `protocol.rounding`.

Both robots of a pair compute the same from the same logs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
from msgspec.structs import replace

from agent.belief import FITTED, Branch, Sighting, anchor_error, polished, turn_error
from agent.geometry import Placement
from agent.logbook import Logbook
from agent.mind import Mind
from protocol.mission import RANGE_MARGIN, Mission
from protocol.motion import ORIGIN, Pose, Run, follow
from protocol.rounding import BETTER, OUT_AND_BACK, SAME, SURE, WELL, foothold, rounding


def size(mind: Mind) -> float:
    """Return D + R in m: the largest coordinate that either robot, or the world, computes with."""
    return mind.briefing.anchor_distance + mind.briefing.mission.sensing_range


def drifted(mind: Mind, log: Logbook, tick: int) -> float:
    """Return how far, in m, rounding may have put the odometry of `log` off by `tick`."""
    return _rounded(size(mind), log.until(tick), mind.briefing.mission.period)


def _rounded(extent: float, runs: Sequence[Run], period: float) -> float:
    """Return by how much, in m, driving `runs` may put a range off; `extent` is `size`."""
    path = turned = 0.0
    for run in runs:
        path += abs(run.v) * run.ticks
        turned += abs(run.omega) * run.ticks
    return rounding(extent, len(runs), path * period, turned * period)


def margin(mission: Mission, floor: float) -> float:
    """Return how far inside R, in m, a point must lie in phase 1 to count on its range.

    Two ranges on a radius, A_0 apart and off by a floor, leave a heading open to sqrt(2 floor / A_0), so the
    range of a point anywhere to R times that.
    """
    return max(RANGE_MARGIN, mission.sensing_range * math.sqrt(2.0 * floor / mission.first_straight))


class Known(msgspec.Struct, frozen=True):
    """How well the first of its anchor ranges tell a robot where its anchor is."""

    error: float
    """m: how far off it may be"""
    ranges: int
    """by how many of them it is known so well"""
    enough: bool = False
    """whether phase 1 may end"""


def anchor(mind: Mind, start: Pose, log: Logbook) -> Known:
    """Return how well the robot of `log` knows its anchor, by those ranges that tell it best.

    Phase 1 may end once that is well; or well enough, and the last range made it hardly any better. It must
    once a way out and back made it no better: rounding then grows faster than what ranges tell, and whether
    it will do is found where the robots meet, by `pinned_down`. Later ranges are not looked at: both robots
    of a pair, which know the same ranges, find the same.
    """
    mission, extent = mind.briefing.mission, size(mind)
    enough = foothold(extent, mind.briefing.anchor_distance, mission.sensing_range)
    known = least = error = math.inf
    ranges = 0
    ranged: list[tuple[Pose, float, float]] = []
    for one in log.ranges:
        if one.tick > log.through:
            break
        runs = log.until(one.tick)
        floor = _rounded(extent, runs, mission.period)
        ranged.append((follow(ORIGIN, runs, mission.period), one.range, floor))
        if len(ranged) == 1 and start.x > enough:
            continue  # a range from the start alone tells nothing of the heading
        before, error = error, anchor_error(start, ranged)
        if error < least or len(ranged) <= FITTED:
            least, ranges = error, len(ranged)
        # what `weigh_branches` merged after them, it put off farther
        known = least + SAME * (floor - ranged[ranges - 1][2])
        stalled = len(ranged) >= FITTED and error > BETTER * before
        spent = len(ranged) - ranges == OUT_AND_BACK
        if known <= WELL * enough or (stalled and known <= enough) or spent:
            return Known(known, ranges, enough=True)
    return Known(known, ranges)


def fitted(mind: Mind, branch: Branch) -> tuple[Branch, Known]:
    """Return `branch` as those ranges have it that tell it best, and how well they do."""
    known = anchor(mind, branch.start, mind.log)
    if known.ranges == len(mind.log.ranges):
        return branch, known
    ranged = [(pose, rho) for pose, rho in mind.seen() if rho is not None]
    branch = polished(branch, ranged[: known.ranges])
    return branch, replace(known, error=anchor(mind, branch.start, mind.log).error)


def peer_anchor(mind: Mind) -> float:
    """Return the error of `anchor` of the peer, in m."""
    assert mind.radio.start is not None
    return anchor(mind, mind.radio.start, mind.radio.peer).error


def apart(mind: Mind) -> float:
    """Return how far off, in m, the anchors may be together, relative to where the robots are now."""
    return _apart(mind, min(mind.tick, mind.radio.peer.through))


def _apart(mind: Mind, tick: int) -> float:
    own, peers = mind.findings.own_anchor, mind.findings.peer_anchor
    assert peers is not None
    return own + peers + drifted(mind, mind.log, tick) + drifted(mind, mind.radio.peer, tick)


def pinned_down(mind: Mind, placement: Placement, ranged: Sequence[Sighting], off: float) -> bool:
    """Return whether the sightings in `ranged` fix `placement` well enough for a claim; `off` is `apart`.

    What was driven between the first and the last of them is all that puts one range off against another;
    what was driven before moves all of them alike, with the anchors.
    """
    first, last = ranged[0].tick, ranged[-1].tick
    period, extent = mind.briefing.mission.period, size(mind)
    floor = 0.0
    for log in (mind.log, mind.radio.peer):
        floor += 0.5 * _rounded(extent, log.between(first, last), period)
    turned = turn_error(placement, ranged, floor, _apart(mind, first))
    return off + turned * max(1.0, extent) <= SURE
