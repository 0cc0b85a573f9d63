"""Under noise, in place of Fig. 3(c): what was held possible at each decision, and what both then did."""

from __future__ import annotations

import math
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agent.planning.active_sensing import Surveying, stride
from agent.planning.state import RobotState
from compose.figures.pair import ROLES, PairRecord
from compose.figures.series import Series, some, square
from compose.figures.sheet import NO_ENCOUNTER, Absent, Window, circle
from compose.figures.style import COLOURS, INK, MARKS, PALE, PALER
from protocol.mission import Role
from protocol.motion import Pose, step

WIDTH, NARROWEST = 2.3, 5.6
"""inches: of a panel at the most, and of the whole at the least"""
FINE = 12
"""pieces that a manoeuvre is drawn in, a tick"""
LIKELY = 1e-3
"""probability from which on a hypothesis is within what is seen"""


class PairDecision(NamedTuple):
    """A tick in which a robot weighed what it holds possible of both, and chose a manoeuvre."""

    tick: int
    states: dict[Role, RobotState]
    """of those robots that decided in it"""


def decisions(pair: PairRecord) -> list[PairDecision]:
    """Of phase 3, in order."""
    found: dict[int, dict[Role, RobotState]] = {}
    for role in ROLES:
        before: object = ()
        for state in pair.states(role):
            held, surveys = state.belief.pair, isinstance(state.mode, Surveying) and state.phase == 3
            if held and held is not before and (surveys or state.verdict is not None):
                found.setdefault(state.tick, {})[role] = state
            before = held
    return [PairDecision(tick, found[tick]) for tick in sorted(found)]


def draw(pair: PairRecord) -> Figure | Absent:
    """A panel a decision; as many as have room."""
    told = decisions(pair)
    if not told:
        why = pair.unknown or "they never weighed how both lie in the plane"
        return Absent(NO_ENCOUNTER if pair.encounter_tick is None else why)
    shown = some(told)
    many = (
        f"{len(shown)} of {len(told)} decisions" if len(shown) < len(told) else f"all {len(told)} decisions"
    )
    title = f"Hypotheses of how both lie in the plane, and the manoeuvres chosen: {many}"
    series = Series(len(shown), _window(pair, shown), WIDTH, NARROWEST, [pair.title, title])
    for i, one in enumerate(shown):
        axes = series.panel(i, _said(one, i + 1))
        _panel(axes, pair, one)
    _signs(axes, pair)
    series.key(axes)
    return series.figure


def _window(pair: PairRecord, shown: list[PairDecision]) -> Window:
    points = [
        (pose.x, pose.y)
        for one in shown
        for state in one.states.values()
        for pose, held in zip(state.belief.poses, state.belief.pair, strict=True)
        if held.probability >= LIKELY
    ]
    for one in shown:
        ends = list(_places(pair, one.tick).values())
        ends += [end for state in one.states.values() for end in _ends(state, pair)]
        points += [(end.x, end.y) for end in ends]
    return square(points, 0.16, 0.5 * pair.mission.sensing_range)


def _said(one: PairDecision, number: int) -> str:
    state = next(iter(one.states.values()))
    count, probability = len(state.belief.pair), state.belief.pair[0].probability
    held = f"{count} hypotheses" if count > 1 else "one hypothesis"
    surest = f"{math.floor(1e4 * probability) / 100:g} %"
    end = "; claims" if any(state.verdict is not None for state in one.states.values()) else ""
    return f"({number}) $k$ = {one.tick}, {len(state.mutual)} mutual ranges\n{held}, first {surest}{end}"


def _panel(axes: Axes, pair: PairRecord, one: PairDecision) -> None:
    for role in ROLES:
        anchor = pair.robot(role).anchor
        axes.plot(anchor.x, anchor.y, "x", color="k", ms=6, mew=1.4, zorder=2)
        circle(
            axes,
            (anchor.x, anchor.y),
            pair.mission.sensing_range,
            ls=(0, (4, 3)),
            lw=0.8,
            color=PALE,
            zorder=1,
        )
    _ties(axes, one)
    for role, state in one.states.items():
        for i, (pose, held) in enumerate(zip(state.belief.poses, state.belief.pair, strict=True)):
            axes.plot(
                pose.x, pose.y, MARKS[role]["marker"], ms=3.0 + 5.0 * math.sqrt(held.probability),
                mfc=COLOURS[role] if i == 0 else "white", mec=COLOURS[role], mew=0.9, zorder=4 + (i == 0),
                gid=f"hypothesis-{one.tick}-{role}-{i + 1}",
            )  # fmt: skip
        _drive(axes, pair, role, state)
    for role, truth in _places(pair, one.tick).items():
        axes.plot(truth.x, truth.y, "+", ms=9, mew=1.2, color=INK, zorder=6, gid=f"truth-{one.tick}-{role}")


def _places(pair: PairRecord, tick: int) -> dict[Role, Pose]:
    """Where each was; without a world, of those that have claimed to know."""
    paths = {role: pair.robot(role).path for role in ROLES}
    return {role: path[tick] for role, path in paths.items() if tick < len(path)}


def _ties(axes: Axes, one: PairDecision) -> None:
    """Between places of a and b that belong to one hypothesis, where both hold the same."""
    if len(one.states) < 2 or one.states["a"].belief.pair != one.states["b"].belief.pair:
        return
    for p, q in zip(one.states["a"].belief.poses, one.states["b"].belief.poses, strict=True):
        axes.plot([p.x, q.x], [p.y, q.y], "-", lw=0.7, color=PALER, zorder=3)


def _drive(axes: Axes, pair: PairRecord, role: Role, state: RobotState) -> None:
    """Where the manoeuvre leads from the likeliest pose."""
    ends = _ends(state, pair)
    if not ends:
        return
    axes.plot([p.x for p in ends], [p.y for p in ends], "-", lw=1.6, color=COLOURS[role], zorder=3)
    axes.plot(
        ends[-1].x,
        ends[-1].y,
        "x",
        ms=6,
        mew=1.5,
        color=COLOURS[role],
        zorder=5,
        gid=f"chosen-{state.tick}-{role}",
    )


def _ends(state: RobotState, pair: PairRecord) -> list[Pose]:
    """Along the manoeuvre that was chosen, from the likeliest pose; none, where none was."""
    if not isinstance(state.mode, Surveying) or not state.belief.poses:
        return []
    command, ticks = state.mode.command, stride(pair.mission)
    pieces = FINE * ticks
    period = ticks * pair.mission.period
    return [
        step(state.belief.poses[0], command.v, command.omega, period * i / pieces) for i in range(pieces + 1)
    ]


def _signs(axes: Axes, pair: PairRecord) -> None:
    for role in ROLES:
        axes.plot(
            [], [], MARKS[role]["marker"], ls="", ms=7, color=COLOURS[role],
            label=f"{pair.robot(role).id}, likeliest",
        )  # fmt: skip
    axes.plot([], [], "o", ls="", ms=4, mfc="white", mec=PALE, label="less likely")
    axes.plot([], [], "x-", ms=6, mew=1.5, lw=1.6, color=PALE, label="manoeuvre chosen")
    known = "true" if pair.true else "by the claim"
    axes.plot([], [], "+", ls="", ms=9, mew=1.2, color=INK, label=known)
    axes.plot([], [], "x", ls="", ms=6, mew=1.4, color="k", label="anchor")
