"""A log as a robot tells it that was told to lie (see `protocol.attack`); its own stays true."""

from __future__ import annotations

import math
from itertools import pairwise

from msgspec.structs import replace

from agent.peer.motion_log import MotionLog
from protocol.attack import Attack
from protocol.messages import Ranged
from protocol.motion import Pose, Segment

STARTS = ("radius", "heading", "reframe")


def told(log: MotionLog, attack: Attack, parted: int | None, met: int | None, period: float) -> MotionLog:
    """`log`, as `attack` has it; phase 1 was over at the tick `phase1_done_tick`, and phase 3 began at `encounter_tick`."""
    if attack.kind == "radius":
        ranges = tuple([Ranged(one.tick, max(0.0, one.range + attack.size)) for one in log.ranges])
        return MotionLog(log.through, log.runs, ranges)
    if attack.kind in STARTS:
        return log
    first, last = _span(attack, log.through, parted, met)
    book = MotionLog(ranges=log.ranges)
    tick = 0
    for run in log.runs:
        for begin, end in _cut(tick, tick + run.ticks, first, last):
            part = _bent(Segment(end - begin, run.v, run.omega), begin, attack, first, last, period)
            book = book.drove(part.v, part.omega, part.ticks)
        tick += run.ticks
    return book


def _span(attack: Attack, through: int, parted: int | None, met: int | None) -> tuple[int, int]:
    """The ticks of the part: the first, and the one after the last; empty while it has not come."""
    end = through + 1
    parted = parted if parted is not None else end
    met = met if met is not None else end
    match attack.part:
        case "phase-1":
            return 0, parted
        case "orbit":
            return parted, max(parted, met)
        case "encounter":
            return met, end
        case _:
            return 0, end


def _cut(begin: int, end: int, first: int, last: int) -> list[tuple[int, int]]:
    """[begin, end), in pieces inside the part, or outside; its first tick, and the one after it, alone."""
    marks = sorted({begin, end, *[mark for mark in (first, first + 1, last, last + 1) if begin < mark < end]})
    return list(pairwise(marks))


def _bent(run: Segment, tick: int, attack: Attack, first: int, last: int, period: float) -> Segment:
    """What is told of a run that begins at `tick`."""
    match attack.kind:
        case "scale" if first <= tick < last:
            return Segment(run.ticks, run.v * attack.size, run.omega)
        case "shift" if tick == first < last:
            return Segment(run.ticks, run.v + attack.size / period, run.omega)
        case "rotate" if tick == first < last:
            return Segment(run.ticks, run.v, run.omega + attack.size / period)
        case "rotate" if tick == last > first:
            return Segment(run.ticks, run.v, run.omega - attack.size / period)
        case _:
            return run


def start(true: Pose, attack: Attack) -> Pose:
    """Where tick 0 of its odometry lies in the frame of its anchor, as `attack` has it."""
    match attack.kind:
        case "radius":
            return replace(true, x=true.x + attack.size)
        case "heading":
            return replace(true, heading=true.heading + attack.size)
        case "reframe":
            c, s = math.cos(attack.size), math.sin(attack.size)
            return Pose(c * true.x - s * true.y, s * true.x + c * true.y, true.heading + attack.size)
        case _:
            return true
