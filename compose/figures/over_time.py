"""Ranges, separation and errors over time, for the whole mission and enlarged for the encounter."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatterMathtext, LogLocator, MaxNLocator, NullLocator

from compose.figures.pair import ROLES, PairRecord
from compose.figures.sheet import ANCHORS, NO_TRUTH, ROW, SMALL, Absent, Sheet
from compose.figures.style import COLOURS, INK, MARKS, PALE, SHADE
from compose.recording.claim import Claim
from protocol.messages import Estimate
from protocol.mission import Role
from protocol.motion import Pose, wrap
from protocol.rounding import TOLERANCE

WHOLE, NEAR = 4.4, 2.2
"""The widths of the panels of the mission and of the encounter, in inches."""
APART = 0.5
TALL, BETWEEN, LEFT = 2.2, 0.2, 0.75
BEFORE = 3
"""The number of ticks shown before the encounter."""
MARKED = 90
"""The maximum number of markers on a line."""
LEAST = 1e-16
"""The smallest error drawn, in m or rad. Smaller errors are drawn at this value."""
LINES: dict[Role, Any] = {"a": "-", "b": (0, (4, 1.5))}
ALONE: dict[Role, Any] = {"a": "-.", "b": (0, (1, 1))}
CLAIMED: dict[Role, Any] = {"a": (0, (6, 1.5, 1, 1.5, 1, 1.5)), "b": (0, (1, 3))}
"""Line styles by role: LINES of the most probable pose, ALONE before the encounter, CLAIMED of sigmas.

No two are the same, so the lines differ without colour.
"""
SIGMAS = 3.0
ROOM = 4.0
"""The factor by which the error scale extends beyond the drawn values."""
KEY_ROWS = 4
"""The maximum number of rows in the key of the errors."""

Points = list[tuple[int, float]]


def ranges(pair: PairRecord) -> Figure:
    """Return the figure of the measured ranges and of the robots' separation."""
    tall, key = TALL + 0.4, 2 * ROW + 0.05
    sheet = Sheet(_width(), 0.53 + tall + key, [pair.title])
    panels = _panels(sheet, pair, key + 0.45, tall)
    for axes in panels:
        _shade(axes, pair)
        _ranges(axes, pair)
    for axes in panels[1:]:
        highest = max(pair.separations[max(0, (pair.encounter_tick or 0) - BEFORE) :], default=0.0)
        axes.set_ylim(0.0, 1.1 * max(pair.mission.sensing_range, highest))
    panels[0].set_ylabel("distance [m]")
    sheet.key(panels[0], LEFT, key, columns=3)
    return sheet.figure


def _width() -> float:
    return LEFT + WHOLE + APART + NEAR + 0.15


def _panels(sheet: Sheet, pair: PairRecord, bottom: float, tall: float, *, named: bool = True) -> list[Axes]:
    """Return the panel of all ticks, and the panel of the encounter if there was one."""
    width = WHOLE if pair.encounter_tick is not None else WHOLE + APART + NEAR
    panels = [sheet.panel(LEFT, bottom, width, tall)]
    panels[0].set_xlim(-0.5, pair.last + 0.5)
    if pair.encounter_tick is not None:
        near = sheet.panel(LEFT + WHOLE + APART, bottom, NEAR, tall)
        near.set_xlim(max(0, pair.encounter_tick - BEFORE) - 0.4, pair.last + 0.4)
        panels.append(near)
    for i, axes in enumerate(panels):
        axes.tick_params(labelsize=SMALL)
        axes.xaxis.set_major_locator(MaxNLocator(8 if i == 0 else 5, integer=True, min_n_ticks=1))
        axes.xaxis.set_minor_locator(NullLocator())
        if named:
            period = pair.mission.period
            axes.set_xlabel(f"tick $k$ ({period:g} s)" if i == 0 else "encounter")
        else:
            axes.tick_params(labelbottom=False)
    return panels


def _shade(axes: Axes, pair: PairRecord) -> None:
    """Shade the ticks in contact."""
    for i, (first, last) in enumerate(pair.contacts):
        axes.axvspan(
            first - 0.5, last + 0.5, color=SHADE, lw=0, zorder=-2, gid=f"contact-{first}-{last}",
            label="in contact" if i == 0 else None,
        )  # fmt: skip


def _ranges(axes: Axes, pair: PairRecord) -> None:
    apart = pair.separations[: len(pair.mutual)]
    if apart:
        axes.plot(
            range(len(apart)), apart, "-", lw=1.2, color=INK, zorder=2, gid="separation",
            label="true separation" if pair.true else "separation, from claims",
        )  # fmt: skip
    for role in ROLES:
        _measured(
            axes, pair.robot(role).anchor_ranges, f"anchor-range-{role}", COLOURS[role], MARKS[role],
            rf"$\rho$ of {pair.robot(role).id} to ${ANCHORS[role]}$, measured",
        )  # fmt: skip
    diamonds = {"marker": "D", "markerfacecolor": INK, "markeredgecolor": INK}
    mutual = [rho for _, rho in pair.mutual]
    _measured(axes, mutual, "mutual-range", INK, diamonds, "mutual range, measured")
    reach = pair.mission.sensing_range
    axes.axhline(reach, ls="-.", lw=0.9, color=PALE, gid="reach", label=f"$R$ = {reach:g} m", zorder=1)
    axes.set_ylim(0.0, 1.05 * max([reach, *pair.separations]))


def _measured(
    axes: Axes, values: Sequence[float | None], gid: str, colour: str, mark: dict[str, Any], label: str
) -> None:
    points = [(tick, rho) for tick, rho in enumerate(values) if rho is not None]
    if not points:
        return
    axes.plot(
        [tick for tick, _ in points], [rho for _, rho in points], ls="", ms=4, mew=1.0, color=colour, gid=gid,
        markevery=max(1, math.ceil(len(points) / (2 * MARKED))), label=label, zorder=3, **mark,
    )  # fmt: skip


# --- errors -------------------------------------------------------------------------------------------


def errors(pair: PairRecord) -> Figure | Absent:
    """Return the figure of the position and heading errors of both robots."""
    if not pair.true:
        return Absent(NO_TRUTH)
    if not any(_held(pair, role) for role in ROLES):
        return Absent("neither robot has an estimate of its pose")
    key = KEY_ROWS * ROW + 0.05
    sheet = Sheet(_width(), 0.53 + 2 * TALL + BETWEEN + key, [pair.title])
    rows: list[tuple[str, str, Callable[[Pose, Pose], float], Callable[[Claim], float]]] = [
        ("position", "position error [m]", _position_error, lambda claim: claim.position_error),
        ("heading", "heading error [rad]", _heading_error, lambda claim: claim.heading_error),
    ]
    for i, (name, label, off, of_claim) in enumerate(rows):
        bottom = key + 0.45 + (1 - i) * (TALL + BETWEEN)
        panels = _panels(sheet, pair, bottom, TALL, named=i == 1)
        for axes in panels:
            _shade(axes, pair)
            for role in ROLES:
                _errors(axes, pair, role, name, off)
                _claimed(axes, pair, role, of_claim)
        panels[0].set_ylabel(label)
        _scale(panels, pair, name)
        if i == 0:
            sheet.key(panels[0], LEFT, key, columns=3)
    return sheet.figure


def _position_error(pose: Pose, truth: Pose) -> float:
    return math.hypot(pose.x - truth.x, pose.y - truth.y)


def _heading_error(pose: Pose, truth: Pose) -> float:
    return abs(wrap(pose.heading - truth.heading))


def _held(pair: PairRecord, role: Role) -> list[tuple[Estimate, Pose]]:
    """Return each estimate with the true pose in the same tick."""
    account, truth = pair.robot(role).account, pair.robot(role).path
    held = account.held if account is not None else ()
    return [(one, truth[one.tick]) for one in held if one.tick < len(truth)]


def _errors(axes: Axes, pair: PairRecord, role: Role, name: str, off: Callable[[Pose, Pose], float]) -> None:
    """Draw the errors of the most probable pose and of the other possible poses.

    Before the encounter, draw those of the pose relative to the anchor.
    """
    held, robot, colour = _held(pair, role), pair.robot(role), COLOURS[role]
    anchor = robot.anchor
    alone = [
        (one.tick, max(_alone(pose, Pose(truth.x - anchor.x, truth.y - anchor.y, truth.heading))[name]
                       for pose in one.local))
        for one, truth in held
        if one.local and not one.world
    ]  # fmt: skip
    _line(axes, alone, ls=ALONE[role], lw=1.1, color=colour, gid=f"{name}-alone-{role}",
          label=f"{robot.id}, relative to its anchor")  # fmt: skip
    single = [one for one in held if one[0].world and (one[0].probabilities or len(one[0].world) == 1)]
    others = [
        (one.tick, off(pose, truth))
        for one, truth in held
        for pose in (one.world[1:] if one.probabilities or len(one.world) == 1 else one.world)
    ]
    _line(axes, others, ls="", marker="x" if role == "a" else "+", ms=5, mew=0.9, color=colour, alpha=0.75,
          gid=f"{name}-others-{role}", label=f"{robot.id}, other possible poses")  # fmt: skip
    most_probable = [(one.tick, off(one.world[0], truth)) for one, truth in single]
    _line(axes, most_probable, lw=1.3, ls=LINES[role], ms=4.5, color=colour, gid=f"{name}-{role}",
          label=f"{robot.id}, {'pose' if pair.exact else 'most probable pose'}",
          markevery=max(1, math.ceil(len(most_probable) / MARKED)), **MARKS[role])  # fmt: skip
    sigmas = [
        (one.tick, SIGMAS * (c.position_sigma if name == "position" else c.heading_sigma))
        for one, _ in single
        if (c := one.covariance) is not None
    ]
    _line(axes, sigmas, lw=0.9, ls=CLAIMED[role], color=colour, gid=f"{name}-sigma-{role}",
          label=rf"{robot.id}, claimed 3 $\sigma$")  # fmt: skip


def _alone(pose: Pose, truth: Pose) -> dict[str, float]:
    """Return the errors that are defined before the encounter, for two poses in the anchor's frame.

    These are the error of the distance to the anchor, in m, and that of mu, the heading relative to the line
    from the anchor, in rad.
    """
    mu, true = (one.heading - math.atan2(one.y, one.x) for one in (pose, truth))
    return {
        "position": abs(math.hypot(pose.x, pose.y) - math.hypot(truth.x, truth.y)),
        "heading": abs(wrap(mu - true)),
    }


def _line(axes: Axes, points: Points, **looks: Any) -> None:
    """Plot `points`, if there are any; a single point gets a marker."""
    if len(points) == 1:
        looks = {"marker": ".", **looks}
    if points:
        axes.plot([tick for tick, _ in points], [max(value, LEAST) for _, value in points], **looks)


def _claimed(axes: Axes, pair: PairRecord, role: Role, of_claim: Callable[[Claim], float]) -> None:
    claim = pair.robot(role).claim
    if claim is not None:
        axes.plot(
            claim.tick, max(of_claim(claim), LEAST), MARKS[role]["marker"], ms=11, mfc="none", mec=INK,
            mew=1.2,
            ls="", clip_on=False, gid=f"claim-{role}",
            label=f"claim of {pair.robot(role).id}, $k$ = {claim.tick}",
        )  # fmt: skip


def _scale(panels: Sequence[Axes], pair: PairRecord, name: str) -> None:
    """Set one scale for both panels, and draw the limit: the tolerance, or with noise the required sigma."""
    for axes in panels:
        axes.set_yscale("log")
        if pair.exact:
            axes.axhline(TOLERANCE, ls="-.", lw=0.9, color=PALE, gid=f"{name}-tolerance", zorder=1,
                         label="tolerance: $10^{-6}$")  # fmt: skip
        elif name == "position":
            required = pair.mission.accuracy
            axes.axhline(required, ls="--", lw=0.9, color=PALE, gid="accuracy", zorder=1,
                         label=rf"required $\sigma$: {required:g} m")  # fmt: skip
    values = [float(y) for axes in panels for one in axes.lines for y in np.ravel(one.get_ydata()) if y > 0.0]
    for axes in panels:
        if values:
            axes.set_autoscaley_on(False)
            axes.set_ylim(min(values) / ROOM, max(values) * ROOM)
        axes.yaxis.set_major_locator(LogLocator(numticks=8))
        axes.yaxis.set_major_formatter(LogFormatterMathtext())
        axes.yaxis.set_minor_locator(NullLocator())
