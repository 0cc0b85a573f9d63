"""False data injection: the log and the start pose that an attacker reports (see `protocol.attack`).

The attacker's own log is not changed. It drives, measures and plans with the true data.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

from msgspec.structs import replace

from agent.peer.motion_log import MotionLog
from agent.peer.team_log import Entry
from protocol.attack import OF_THE_START, Attack
from protocol.messages import Ranged
from protocol.motion import Controls, Pose, Segment, rotated


def falsified_log(
    log: MotionLog, attack: Attack, phase1_done_tick: int | None, encounter_tick: int | None, period: float
) -> MotionLog:
    """Return `log` as falsified by `attack`.

    Phase 1 ended at `phase1_done_tick`, and phase 3 began at `encounter_tick`; None if that has not happened.
    `period` is T_s in s.
    """
    if attack.kind == "radius":
        ranges = tuple([Ranged(one.tick, max(0.0, one.range + attack.size)) for one in log.ranges])
        return MotionLog(log.through, log.runs, ranges)
    if attack.kind in OF_THE_START:
        return log
    first, last = _attacked_span(attack, log.through, phase1_done_tick, encounter_tick)
    falsified = MotionLog(ranges=log.ranges)
    tick = 0
    for run in log.runs:
        for begin, end in _pieces(tick, tick + run.ticks, first, last):
            piece = _falsified(Segment(end - begin, run.v, run.omega), begin, attack, first, last, period)
            falsified = falsified.drove(piece.v, piece.omega, piece.ticks)
        tick += run.ticks
    return falsified


def falsified_entries(entries: Sequence[Entry], attack: Attack, period: float) -> tuple[Entry, ...]:
    """Return the log of a robot of a team, as falsified by `attack`. `period` is T_s in s."""
    found = []
    for tick, entry in enumerate(entries):
        if attack.kind == "radius":
            ranges = [replace(one, range=max(0.0, one.range + attack.size)) for one in entry.anchors]
            entry = replace(entry, anchors=tuple(ranges))  # noqa: PLW2901  # the falsified one
        elif (moved := entry.executed) is not None:
            told = _falsified(Segment(1, moved.v, moved.omega), tick - 1, attack, 0, len(entries), period)
            entry = replace(entry, executed=Controls(told.v, told.omega))  # noqa: PLW2901
        found.append(entry)
    return tuple(found)


def _attacked_span(
    attack: Attack, through: int, phase1_done_tick: int | None, encounter_tick: int | None
) -> tuple[int, int]:
    """Return the first tick of the attacked part of the log, and the tick after its last.

    `through` is the last tick of the log. Phase 1 ended at `phase1_done_tick`, and phase 3 began at
    `encounter_tick`; None if that has not happened. The span is empty if the part has not begun.
    """
    end = through + 1
    phase1_done_tick = phase1_done_tick if phase1_done_tick is not None else end
    encounter_tick = encounter_tick if encounter_tick is not None else end
    match attack.part:
        case "phase-1":
            return 0, phase1_done_tick
        case "orbit":
            return phase1_done_tick, max(phase1_done_tick, encounter_tick)
        case "encounter":
            return encounter_tick, end
        case _:
            return 0, end


def _pieces(begin: int, end: int, first: int, last: int) -> list[tuple[int, int]]:
    """Return [begin, end) in pieces that lie completely inside or outside the attacked part.

    The first tick of the part, and the first one after it, are pieces of their own.
    """
    marks = sorted({begin, end, *[mark for mark in (first, first + 1, last, last + 1) if begin < mark < end]})
    return list(pairwise(marks))


def _falsified(run: Segment, tick: int, attack: Attack, first: int, last: int, period: float) -> Segment:
    """Return the reported segment instead of `run`, which begins at `tick`."""
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
    """Return the reported pose of tick 0 in the frame of the anchor, instead of the true one."""
    match attack.kind:
        case "radius":
            return replace(true, x=true.x + attack.size)
        case "heading":
            return replace(true, heading=true.heading + attack.size)
        case "reframe":
            c, s = math.cos(attack.size), math.sin(attack.size)
            return Pose(*rotated(c, s, true.x, true.y), true.heading + attack.size)
        case _:
            return true
