"""The hypotheses and the chosen manoeuvre at each decision of phase 3, under noise; in place of Fig. 3(c)."""

from __future__ import annotations

import math
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agent.planning.state import RobotState
from agent.planning.strides import stride
from agent.planning.tasks import Surveying
from compose.figures.pair import PairRecord
from compose.figures.sheet import NO_ENCOUNTER, Absent, Window, circle, series, some, square
from compose.figures.style import INK, PALE, PALER, ROLE_MARKERS, SCREEN, Medium
from compose.view.colours import COLOURS
from protocol.mission import ROLES, Role
from protocol.motion import Pose, step

SEGMENTS_PER_TICK = 12
"""The number of line segments per tick of a drawn manoeuvre."""
SHOWN_PROBABILITY = 1e-3
"""The minimum probability of a hypothesis that the panels' window must contain."""
FARTHEST_SHOWN = 4.0
"""The maximum distance of such a hypothesis from the second anchor, in units of D + R.

The first fit of a meeting after a long way may be farther off, with a sigma as large.
"""


class PairDecision(NamedTuple):
    """A tick in which at least one robot scored hypotheses of both poses and chose a manoeuvre."""

    tick: int
    states: dict[Role, RobotState]
    """The states of the robots that decided in this tick."""


def decisions(pair: PairRecord) -> list[PairDecision]:
    """Return the decisions of phase 3, in order."""
    found: dict[int, dict[Role, RobotState]] = {}
    for role in ROLES:
        before: object = ()
        for state in pair.states(role):
            hypotheses = state.belief.pair
            surveys = isinstance(state.task, Surveying) and state.phase == 3
            if hypotheses and hypotheses is not before and (surveys or state.verdict is not None):
                found.setdefault(state.tick, {})[role] = state
            before = hypotheses
    return [PairDecision(tick, found[tick]) for tick in sorted(found)]


def draw(pair: PairRecord, medium: Medium = SCREEN) -> Figure | Absent:
    """Return the figure, with one panel per decision for up to `sheet.PANELS` decisions."""
    found = decisions(pair)
    if not found:
        why = pair.unknown or "no robot scored hypotheses of the pair"
        return Absent(NO_ENCOUNTER if pair.encounter_tick is None else why)
    shown = some(found)
    many = (
        f"{len(shown)} of {len(found)} decisions"
        if len(shown) < len(found)
        else f"all {len(found)} decisions"
    )
    title = f"Hypotheses of the pair and chosen manoeuvres: {many}"
    captions = [_caption(one, i + 1) for i, one in enumerate(shown)]
    sheet, panels = series(medium, [pair.title, title], captions, _window(pair, shown))
    for axes, one in zip(panels, shown, strict=True):
        _panel(axes, pair, one)
    _key(panels[-1], pair)
    sheet.key(panels[-1])
    return sheet.finished()


def _window(pair: PairRecord, shown: list[PairDecision]) -> Window:
    points = [
        (pose.x, pose.y)
        for one in shown
        for state in one.states.values()
        for pose, held in zip(state.belief.poses, state.belief.pair, strict=True)
        if held.probability >= SHOWN_PROBABILITY
    ]
    for one in shown:
        ends = list(_places(pair, one.tick).values())
        ends += [end for state in one.states.values() for end in _ends(state, pair)]
        points += [(end.x, end.y) for end in ends]
    a, b = [(pair.robot(role).anchor.x, pair.robot(role).anchor.y) for role in ROLES]
    farthest = FARTHEST_SHOWN * (math.dist(a, b) + pair.mission.sensing_range)
    points = [point for point in points if math.dist(point, b) <= farthest]
    return square(points, 0.16, 0.5 * pair.mission.sensing_range)


def _caption(one: PairDecision, number: int) -> str:
    state = next(iter(one.states.values()))
    count, probability = len(state.belief.pair), state.belief.pair[0].probability
    hypotheses = f"{count} hypotheses" if count > 1 else "1 hypothesis"
    first = f"{math.floor(1e4 * probability) / 100:g} %"
    claim = ", claim" if any(state.verdict is not None for state in one.states.values()) else ""
    return (
        f"({number}) $k$ = {one.tick}, {len(state.mutual)} mutual ranges\n{hypotheses}, first {first}{claim}"
    )


def _panel(axes: Axes, pair: PairRecord, one: PairDecision) -> None:
    for role in ROLES:
        anchor = pair.robot(role).anchor
        axes.plot(anchor.x, anchor.y, "x", color="k", ms=5, mew=1.2, zorder=2)
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
                pose.x, pose.y, ROLE_MARKERS[role]["marker"], ms=2.5 + 4.5 * math.sqrt(held.probability),
                mfc=COLOURS[role] if i == 0 else "white", mec=COLOURS[role], mew=0.9, zorder=4 + (i == 0),
                gid=f"hypothesis-{one.tick}-{role}-{i + 1}",
            )  # fmt: skip
        _drive(axes, pair, role, state)
    for role, truth in _places(pair, one.tick).items():
        axes.plot(truth.x, truth.y, "+", ms=9, mew=1.2, color=INK, zorder=6, gid=f"truth-{one.tick}-{role}")


def _places(pair: PairRecord, tick: int) -> dict[Role, Pose]:
    """Return the true pose of each robot; in hardware mode, the pose implied by its claim, if it has one."""
    paths = {role: pair.robot(role).path for role in ROLES}
    return {role: path[tick] for role, path in paths.items() if tick < len(path)}


def _ties(axes: Axes, one: PairDecision) -> None:
    """Join the poses of a and b that belong to one hypothesis, if both robots have the same hypotheses."""
    held = [
        [hypothesis.fit.poses.tolist() for hypothesis in state.belief.pair] for state in one.states.values()
    ]
    if len(held) < 2 or held[0] != held[1]:
        return
    for p, q in zip(one.states["a"].belief.poses, one.states["b"].belief.poses, strict=True):
        axes.plot([p.x, q.x], [p.y, q.y], "-", lw=0.7, color=PALER, zorder=3)


def _drive(axes: Axes, pair: PairRecord, role: Role, state: RobotState) -> None:
    """Draw the chosen manoeuvre from the most probable pose."""
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
    """Return poses along the chosen manoeuvre from the most probable pose; empty if none was chosen."""
    if not isinstance(state.task, Surveying) or not state.belief.poses:
        return []
    command, ticks = state.task.command, stride(pair.mission)
    pieces = SEGMENTS_PER_TICK * ticks
    period = ticks * pair.mission.period
    return [
        step(state.belief.poses[0], command.v, command.omega, period * i / pieces) for i in range(pieces + 1)
    ]


def _key(axes: Axes, pair: PairRecord) -> None:
    for role in ROLES:
        axes.plot(
            [], [], ROLE_MARKERS[role]["marker"], ls="", ms=7, color=COLOURS[role],
            label=f"{pair.robot(role).id}, most probable",
        )  # fmt: skip
    axes.plot([], [], "o", ls="", ms=4, mfc="white", mec=PALE, label="less probable")
    axes.plot([], [], "x-", ms=6, mew=1.5, lw=1.6, color=PALE, label="chosen manoeuvre")
    known = "true" if pair.true else "from the claim"
    axes.plot([], [], "+", ls="", ms=9, mew=1.2, color=INK, label=known)
    axes.plot([], [], "x", ls="", ms=6, mew=1.4, color="k", label="anchor")
