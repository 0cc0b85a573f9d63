"""A planned last manoeuvre in the frame of the robot that makes it: Figs. 3(c) and 4(b), with eq. (8)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agent.estimation.closed_forms import Placement
from agent.planning.phase3_last_manoeuvre import Array, Compared, Plan, compared
from agent.planning.tasks import LastManoeuvre
from compose.figures.pair import PairRecord
from compose.figures.sheet import ANCHORS, LABEL, NO_ENCOUNTER, Absent, Sheet, circle
from compose.figures.style import INK, PALE, PALER, ROLE_MARKERS, SCREEN, Medium
from compose.figures.trajectory import heading
from compose.view.colours import COLOURS
from protocol.mission import ROLES, Mission, Role
from protocol.motion import ORIGIN, Pose, compose, step

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
    found: dict[str, Figure | Absent] = {}
    for role in ROLES:
        for one in planned(pair, role):
            found[f"{pair.robot(role).id}-{one.tick}"] = _figure(pair, one, medium)
    if not found:
        why = pair.unknown or "no last manoeuvre was planned"
        found[pair.name] = Absent(NO_ENCOUNTER if pair.encounter_tick is None else why)
    return found


class ManoeuvreView(NamedTuple):
    """The compared candidates in the moving robot's anchor frame, rotated to put the robot on the x-axis."""

    mover: Pose
    others: tuple[Pose, ...]
    """The pose of the other robot for each candidate."""
    spin: float
    """The rotation of the anchor frame, in rad."""

    def turned(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Rotate points of the anchor frame, in m, into this view."""
        c, s = math.cos(self.spin), math.sin(self.spin)
        return c * x - s * y, s * x + c * y


def scene(plan: Plan) -> ManoeuvreView:
    """Return the view of `plan`."""
    mover, a, b, candidates = plan.question
    own, other = (a, b) if mover == "a" else (b, a)
    spin = -math.atan2(own.y, own.x)
    frame = Pose(0.0, 0.0, spin)
    places = [
        compose(_inverse(one), other) if mover == "a" else one.place(other) for one in candidates
    ]  # fmt: skip
    return ManoeuvreView(compose(frame, own), tuple([compose(frame, place) for place in places]), spin)


def _inverse(placement: Placement) -> Pose:
    """Return the inverse of a placement as the pose of frame <b(M2)> in frame <a(M1)>."""
    c, s = math.cos(placement.phi), math.sin(placement.phi)
    return Pose(
        -c * placement.x - s * placement.y, s * placement.x - c * placement.y, -placement.phi
    )  # fmt: skip


def _figure(pair: PairRecord, one: Planned, medium: Medium) -> Figure:
    seen, plan, mission = scene(one.plan), one.plan, pair.mission
    assert pair.planner is not None
    assert pair.planner.MANOEUVRES is not None
    ways = compared(plan.question, mission, pair.planner.MANOEUVRES)
    sheet = Sheet(medium, False, [pair.title, _title(pair, one)], [["plane", "value"], ["key", "key"]])
    axes, value = sheet.panels["plane"], sheet.panels["value"]
    half = WINDOW_MARGIN * max(
        mission.max_speed * mission.period,
        *[math.hypot(p.x - seen.mover.x, p.y - seen.mover.y) for p in seen.others],
    )
    _candidates(axes, pair, one, seen, half)
    _reach(axes, pair, plan, seen, ways)
    x, y = seen.mover.x, seen.mover.y
    sheet.plane("plane", (x - half, x + half, y - half, y + half))
    draw_cost(value, plan, ways, mission)
    if value.get_legend_handles_labels()[0]:
        value.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), frameon=False)
    sheet.key(axes)
    return sheet.finished()


def _title(pair: PairRecord, one: Planned) -> str:
    mover = one.plan.question.mover
    robot = pair.robot(mover).id
    frame = (
        f"{robot}'s own frame"
        if _framed_by_itself(one.plan)
        else rf"$\langle\,{mover}({ANCHORS[mover]})\rangle$"
    )
    v, omega = one.plan.command.v, one.plan.command.omega
    chosen = rf"$v_2$ = {v:g} m/s, $\omega_2$ = {omega:+.4f} rad/s"
    count = len(one.plan.question.candidates)
    candidates = f"{count} candidates" if count > 1 else "1 candidate, to be checked"
    value = f", $J$ = {one.plan.separation_m2:.5g} m$^2$" if one.plan.separation_m2 is not None else ""
    return f"Plan of {robot} at $k$ = {one.tick}, in {frame}: {candidates}; {chosen}{value}"


def _framed_by_itself(plan: Plan) -> bool:
    """Return whether candidates are given in the mover's own frame, as by the `paper` planner under noise."""
    return plan.question.a == ORIGIN == plan.question.b


def _candidates(axes: Axes, pair: PairRecord, one: Planned, seen: ManoeuvreView, half: float) -> None:
    """Draw the candidate positions of the other robot, the last range, and the bisectors of all pairs."""
    mover: Role = one.plan.question.mover
    other = OTHER[mover]
    x, y = seen.mover.x, seen.mover.y
    for i, j in combinations(range(len(seen.others)), 2):
        _bisector(axes, seen.others[i], seen.others[j], 3.0 * half, f"bisector-{i + 1}-{j + 1}")
    if len(seen.others) > 1:
        axes.plot([], [], "-", color=PALE, lw=0.7, label="bisectors of two candidates")
    rho = pair.mutual[one.tick][1]
    if rho is not None:
        circle(
            axes, (x, y), rho, ls=(0, (5, 3)), lw=1.0, color="k", gid="rho", label=f"last range, {rho:.4f} m"
        )
    after = _after(pair, one)
    end = step(seen.mover, one.plan.command.v, one.plan.command.omega, pair.mission.period)
    for i, place in enumerate(seen.others, start=1):
        away = math.hypot(place.x - x, place.y - y) or 1.0
        axes.plot(
            place.x, place.y, ROLE_MARKERS[other]["marker"], ms=7, mfc=COLOURS[other], mec="white", mew=0.6,
            ls="", gid=f"candidate-{i}", zorder=5,
            label=f"{i}: predicted range {math.hypot(place.x - end.x, place.y - end.y):.4f} m",
        )  # fmt: skip
        axes.annotate(
            str(i), (place.x, place.y), xytext=(-13 * (place.x - x) / away, -13 * (place.y - y) / away),
            textcoords="offset points", ha="center", va="center", zorder=6, bbox=LABEL,
        )  # fmt: skip
    axes.plot([], [], ls="", label=after)


def _after(pair: PairRecord, one: Planned) -> str:
    """Return the range measured after the manoeuvre, as text."""
    if one.tick + 1 >= len(pair.mutual):
        return "the recording ends before the next range"
    near, rho = pair.mutual[one.tick + 1]
    measured = f"{rho:.4f} m" if rho is not None else "drop-out" if near else "none, out of range"
    return f"measured at $k$ = {one.tick + 1}: {measured}"


def _bisector(axes: Axes, one: Pose, other: Pose, length: float, gid: str) -> None:
    """Draw the perpendicular bisector of the segment between two positions."""
    dx, dy = other.x - one.x, other.y - one.y
    apart = math.hypot(dx, dy)
    if apart == 0.0:
        return
    x, y, ux, uy = (one.x + other.x) / 2, (one.y + other.y) / 2, -dy / apart, dx / apart
    axes.plot(
        [x - length * ux, x + length * ux], [y - length * uy, y + length * uy], "-", lw=0.7, color=PALE,
        zorder=1, gid=gid,
    )  # fmt: skip


def _reach(axes: Axes, pair: PairRecord, plan: Plan, seen: ManoeuvreView, ways: Compared) -> None:
    """Draw the end positions of all compared manoeuvres, and the chosen manoeuvre."""
    mover = plan.question.mover
    colour = COLOURS[mover]
    chosen = chosen_row(plan, ways)
    first = True
    for row in range(len(ways.reach.v)):
        if row == chosen:
            continue
        axes.plot(
            *seen.turned(ways.reach.x[row], ways.reach.y[row]), "-", lw=0.7, color=PALER, zorder=1.5,
            gid=f"reach-{row}", label="reachable with another $v_2$" if first else None,
        )  # fmt: skip
        first = False
    v = float(ways.reach.v[chosen, 0])
    axes.plot(
        *seen.turned(ways.reach.x[chosen], ways.reach.y[chosen]), "-", lw=2.0, color="k", zorder=2,
        gid="reach", label=f"reachable with $v_2$ = {v:g} m/s",
    )  # fmt: skip
    ends = [
        step(seen.mover, plan.command.v, plan.command.omega, pair.mission.period * i / ARC_SEGMENTS)
        for i in range(ARC_SEGMENTS + 1)
    ]
    axes.plot([p.x for p in ends], [p.y for p in ends], "-", lw=2.0, color=colour, zorder=4, gid="chosen")
    axes.plot(
        [ends[0].x, ends[-1].x], [ends[0].y, ends[-1].y], "x", ms=9, mew=2.0, color=colour, zorder=5, ls="",
        gid="chosen-ends", label=f"chosen manoeuvre of {pair.robot(mover).id}",
    )  # fmt: skip
    heading(axes, ends[0], 0.42 * max(abs(v) * pair.mission.period, 1e-9), INK)


def chosen_row(plan: Plan, ways: Compared) -> int:
    """Return the row of `ways` with the chosen speed."""
    return int(np.argmin(abs(ways.reach.v[:, 0] - plan.command.v)))


def draw_cost(axes: Axes, plan: Plan, ways: Compared, mission: Mission) -> None:
    """Draw the value of eq. (8) over the turn rate."""
    chosen = chosen_row(plan, ways)
    omega = ways.reach.omega
    allowed = np.isfinite(ways.value)
    for row in range(len(ways.reach.v)):
        if row != chosen:
            axes.plot(
                omega, np.where(allowed[row], ways.gap[row], np.nan), "-", lw=0.6, color=PALER, zorder=1,
                gid=f"cost-{row}",
            )  # fmt: skip
    if not allowed[chosen].all():
        axes.plot(omega, ways.gap[chosen], ":", lw=1.2, color=PALE, label="excluded: range or separation")
    axes.plot(
        omega,
        np.where(allowed[chosen], ways.gap[chosen], np.nan),
        "-",
        lw=1.5,
        color="k",
        gid="cost",
        zorder=2,
    )
    best = float(ways.gap[chosen, int(np.argmin(abs(omega - plan.command.omega)))])
    colour = COLOURS[plan.question.mover]
    axes.plot([plan.command.omega], [best], "x", ms=9, mew=2.0, color=colour, zorder=4, gid="cost-chosen")
    axes.axvline(plan.command.omega, lw=0.8, ls="--", color=colour, zorder=1)
    axes.set_xlim(-mission.max_turn_rate, mission.max_turn_rate)
    if math.isclose(mission.max_turn_rate, math.pi):
        axes.set_xticks(
            [-math.pi, -math.pi / 2, 0.0, math.pi / 2, math.pi],
            [r"$-\pi$", r"$-\pi/2$", "0", r"$\pi/2$", r"$\pi$"],
        )
    axes.set_xlabel(r"$\omega_2$ [rad/s]")
    axes.set_ylabel(
        "$J$ of eq. (8), squared ranges [m$^2$]"
        if plan.separation_m2 is not None
        else "decrease of squared range [m$^2$]"
    )
