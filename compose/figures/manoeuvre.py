"""A planned last manoeuvre in the frame of the robot that makes it: Figs. 3(c) and 4(b), with eq. (8)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agent.planning.phase3_last_manoeuvre import Array, Compared, Plan, compared
from agent.planning.tasks import LastManoeuvre
from compose.figures.pair import PairRecord
from compose.figures.sheet import ANCHORS, NO_ENCOUNTER, Absent, Sheet, circle, entry, heading, trace
from compose.figures.style import INK, PALE, PALER, ROLE_MARKERS, SCREEN, Medium
from compose.view.colours import COLOURS
from compose.view.events import with_minus
from protocol.mission import ROLES, Mission, Role
from protocol.motion import ORIGIN, Pose, compose, inverse, rotated, step, travelled

WINDOW_MARGIN = 1.14
"""The half-width of the window, as a multiple of the largest distance from the robot that must be visible."""
ARC_SEGMENTS = 24
"""The number of line segments of the drawn arc of the manoeuvre."""
OTHER: dict[Role, Role] = {"a": "b", "b": "a"}


class Planned(NamedTuple):
    """A last manoeuvre and the tick in which it was planned."""

    tick: int
    plan: Plan


def planned(pair: PairRecord, role: Role) -> Iterator[Planned]:
    """Yield every last manoeuvre of one robot, in order."""
    before = None
    for state in pair.states(role):
        if (plan := state.plan) is not before and plan is not None and isinstance(state.task, LastManoeuvre):
            before = plan
            yield Planned(state.tick, plan)


def draw(pair: PairRecord, medium: Medium = SCREEN) -> dict[str, Figure | Absent]:
    """Return a figure of each plan, by the name "ROBOT-TICK"."""
    found: dict[str, Figure | Absent] = {
        f"{pair.robot(role).id}-{one.tick}": _figure(pair, one, medium)
        for role in ROLES
        for one in planned(pair, role)
    }
    why = pair.unknown or "no last manoeuvre was planned"
    return found or {pair.name: Absent(NO_ENCOUNTER if pair.encounter_tick is None else why)}


class ManoeuvreView(NamedTuple):
    """The compared hypotheses in the moving robot's anchor frame, rotated to put the robot on the x-axis."""

    mover: Pose
    others: tuple[Pose, ...]
    """The pose of the other robot by each hypothesis."""
    spin: float
    """The rotation of the anchor frame, in rad."""

    def turned(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Rotate points of the anchor frame, in m, into this view."""
        return rotated(math.cos(self.spin), math.sin(self.spin), x, y)


def scene(plan: Plan) -> ManoeuvreView:
    """Return the view of `plan`."""
    mover, a, b, placements = plan.question
    own, other = (a, b) if mover == "a" else (b, a)
    spin = -math.atan2(own.y, own.x)
    frame = Pose(0.0, 0.0, spin)
    places = [compose(inverse(one.frame) if mover == "a" else one.frame, other) for one in placements]
    return ManoeuvreView(compose(frame, own), tuple([compose(frame, place) for place in places]), spin)


def _figure(pair: PairRecord, one: Planned, medium: Medium) -> Figure:
    seen, plan, mission = scene(one.plan), one.plan, pair.mission
    assert pair.planner is not None
    assert pair.planner.MANOEUVRES is not None
    ways = compared(plan.question, mission, pair.planner.MANOEUVRES)
    sheet = Sheet(medium, False, [pair.title, _title(pair, one)], [["plane", "value"], ["key", "key"]])
    axes, value = sheet.panels["plane"], sheet.panels["value"]
    away = [travelled(seen.mover, other) for other in seen.others]
    half = WINDOW_MARGIN * max(mission.max_speed * mission.period, *away)
    _hypotheses(sheet, pair, one, seen, half)
    _reach(axes, pair, plan, seen, ways)
    x, y = seen.mover.x, seen.mover.y
    sheet.plane("plane", (x - half, x + half, y - half, y + half))
    _cost(value, plan, ways, mission)
    if value.get_legend_handles_labels()[0]:
        value.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), frameon=False)
    sheet.key(axes)
    return sheet.finished()


def _title(pair: PairRecord, one: Planned) -> str:
    """Return the title. The frame is the mover's own if the planner is `paper` under noise."""
    plan, mover = one.plan, one.plan.question.mover
    robot, own = pair.robot(mover).id, plan.question.a == ORIGIN == plan.question.b
    frame = f"{robot}'s own frame" if own else rf"$\langle\,{mover}({ANCHORS[mover]})\rangle$"
    speed, turn = with_minus(f"{plan.command.v:g}"), with_minus(f"{plan.command.omega:+.4f}")
    chosen = rf"$v_2$ = {speed} m/s, $\omega_2$ = {turn} rad/s"
    count = len(plan.question.placements)
    hypotheses = f"{count} hypotheses" if count > 1 else "1 hypothesis, to be checked"
    value = f", $J$ = {plan.separation_m2:.5g} m$^2$" if plan.separation_m2 is not None else ""
    return f"Plan of {robot} at $k$ = {one.tick}, in {frame}: {hypotheses}; {chosen}{value}"


def _hypotheses(sheet: Sheet, pair: PairRecord, one: Planned, seen: ManoeuvreView, half: float) -> None:
    """Draw where each hypothesis has the other robot, the last range, and the bisectors of all pairs."""
    axes, other = sheet.panels["plane"], OTHER[one.plan.question.mover]
    x, y = seen.mover.x, seen.mover.y
    for (i, p), (j, q) in combinations(enumerate(seen.others, start=1), 2):
        apart = travelled(p, q)
        if apart > 0.0:
            far, middle = 3.0 * half / apart, ((p.x + q.x) / 2, (p.y + q.y) / 2)
            dx, dy = -far * (q.y - p.y), far * (q.x - p.x)
            axes.plot(
                [middle[0] - dx, middle[0] + dx], [middle[1] - dy, middle[1] + dy], "-", lw=0.7, color=PALE,
                zorder=1, gid=f"bisector-{i}-{j}",
            )  # fmt: skip
    if len(seen.others) > 1:
        entry(axes, "bisectors of two hypotheses", "-", color=PALE, lw=0.7)
    rho = pair.mutual[one.tick][1]
    if rho is not None:
        label = f"last range, {rho:.4f} m"
        circle(axes, (x, y), rho, ls=(0, (5, 3)), lw=1.0, color="k", gid="rho", label=label)
    end = step(seen.mover, one.plan.command.v, one.plan.command.omega, pair.mission.period)
    for i, place in enumerate(seen.others, start=1):
        trace(
            axes, [place], ROLE_MARKERS[other]["marker"], ms=7, mfc=COLOURS[other], mec="white", mew=0.6,
            gid=f"hypothesis-{i}", zorder=5, label=f"{i}: predicted range {travelled(end, place):.4f} m",
        )  # fmt: skip
        sheet.label(str(i), (place.x, place.y))
    entry(axes, _after(pair, one), ls="")


def _after(pair: PairRecord, one: Planned) -> str:
    """Return the range measured after the manoeuvre, as text."""
    if one.tick + 1 >= len(pair.mutual):
        return "the recording ends before the next range"
    near, rho = pair.mutual[one.tick + 1]
    measured = f"{rho:.4f} m" if rho is not None else "drop-out" if near else "none, out of range"
    return f"measured at $k$ = {one.tick + 1}: {measured}"


def _reach(axes: Axes, pair: PairRecord, plan: Plan, seen: ManoeuvreView, ways: Compared) -> None:
    """Draw the end positions of all compared manoeuvres, and the chosen manoeuvre."""
    colour, chosen, period = COLOURS[plan.question.mover], _chosen_row(plan, ways), pair.mission.period
    label: str | None = "reachable with another $v_2$"
    for row, (x, y) in enumerate(zip(ways.reach.x, ways.reach.y, strict=True)):
        if row != chosen:
            gid = f"reach-{row}"
            axes.plot(*seen.turned(x, y), "-", lw=0.7, color=PALER, zorder=1.5, gid=gid, label=label)
            label = None
    v, ends = float(ways.reach.v[chosen, 0]), seen.turned(ways.reach.x[chosen], ways.reach.y[chosen])
    label = f"reachable with $v_2$ = {with_minus(f'{v:g}')} m/s"
    axes.plot(*ends, "-", lw=2.0, color="k", zorder=2, gid="reach", label=label)
    times = [period * i / ARC_SEGMENTS for i in range(ARC_SEGMENTS + 1)]
    poses = [step(seen.mover, plan.command.v, plan.command.omega, time) for time in times]
    trace(axes, poses, "-", lw=2.0, color=colour, zorder=4, gid="chosen")
    label, cross = f"chosen manoeuvre of {pair.robot(plan.question.mover).id}", {"ms": 9, "mew": 2.0}
    trace(axes, [poses[0], poses[-1]], "x", color=colour, zorder=5, gid="chosen-ends", label=label, **cross)
    heading(axes, poses[0], 0.42 * max(abs(v) * period, 1e-9), INK)


def _chosen_row(plan: Plan, ways: Compared) -> int:
    """Return the row of `ways` with the chosen speed."""
    return int(np.argmin(abs(ways.reach.v[:, 0] - plan.command.v)))


def _cost(axes: Axes, plan: Plan, ways: Compared, mission: Mission) -> None:
    """Draw the value of eq. (8) over the turn rate."""
    chosen, omega, colour = _chosen_row(plan, ways), ways.reach.omega, COLOURS[plan.question.mover]
    allowed = np.isfinite(ways.value)
    for row, value in enumerate(np.where(allowed, ways.gap, np.nan)):
        look: dict[str, Any] = {"lw": 0.6, "color": PALER, "zorder": 1, "gid": f"cost-{row}"}
        if row == chosen:
            look = {"lw": 1.5, "color": "k", "zorder": 2, "gid": "cost"}
        axes.plot(omega, value, "-", **look)
    if not allowed[chosen].all():
        axes.plot(omega, ways.gap[chosen], ":", lw=1.2, color=PALE, label="excluded: range or separation")
    best = float(ways.gap[chosen, int(np.argmin(abs(omega - plan.command.omega)))])
    axes.plot([plan.command.omega], [best], "x", ms=9, mew=2.0, color=colour, zorder=4, gid="cost-chosen")
    axes.axvline(plan.command.omega, lw=0.8, ls="--", color=colour, zorder=1)
    axes.set_xlim(-mission.max_turn_rate, mission.max_turn_rate)
    if math.isclose(mission.max_turn_rate, math.pi):
        names = [r"$-\pi$", r"$-\pi/2$", "0", r"$\pi/2$", r"$\pi$"]
        axes.set_xticks([half * math.pi / 2 for half in range(-2, 3)], names)
    axes.set_xlabel(r"$\omega_2$ [rad/s]")
    eq_8 = plan.separation_m2 is not None
    axes.set_ylabel(f"{'$J$ of eq. (8), squared ranges' if eq_8 else 'decrease of squared range'} [m$^2$]")
