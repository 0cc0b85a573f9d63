"""Ranges, separation, errors and hypotheses over time."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from compose.figures.pair import PairRecord, others
from compose.figures.sheet import ANCHORS, NO_TRUTH, Absent, Sheet, entry
from compose.figures.style import INK, PALE, ROLE_MARKERS, SCREEN, SHADE, Medium
from compose.view.colours import COLOURS
from protocol.mission import ROLES, Role
from protocol.motion import Pose, compose, inverse, travelled, wrap
from protocol.rounding import TOLERANCE

TALL = 1.9
"""The height of a panel over time, in inches."""
SHADES = {1: "0.93", 2: "1.0", 3: "0.97"}
NAME_SHARE = 0.15
"""The fraction of the width below which only the number of a phase is written above the panel."""
MOST_MARKERS = 60
"""The maximum number of markers on a line."""
FLOOR = 0.1 * TOLERANCE
"""The smallest error drawn, in m or rad: smaller ones are rounding errors, and are drawn at this value."""
ROLE_LINES: dict[Role, Any] = {"a": "-", "b": (0, (4, 1.5))}
LONE_LINES: dict[Role, Any] = {"a": "-.", "b": (0, (1, 1))}
CLAIMED: dict[Role, Any] = {"a": (0, (6, 1.5, 1, 1.5, 1, 1.5)), "b": (0, (1, 3))}
"""Line styles by role: ROLE_LINES of the likeliest pose, LONE_LINES before the encounter, CLAIMED of sigmas.

No two are the same, so the lines differ without colour. The phase is that of the axis.
"""
BAND_SIGMAS = 3.0
RANKS = 6
"""The number of hypotheses drawn as lines."""
BEYOND = 0.05
"""The end of the probability scale, as a fraction of 1 - confidence."""
SUREST = 1e-12
"""The smallest distance of the probability scale's ends from 0 and 1."""

Points = Sequence[tuple[int, float]]


def position_alone(pose: Pose, truth: Pose) -> float:
    """Return the error of the distance to the anchor, in m, for two poses in the anchor's frame."""
    return abs(math.hypot(pose.x, pose.y) - math.hypot(truth.x, truth.y))


def heading_alone(pose: Pose, truth: Pose) -> float:
    """Return the error in rad of mu, the heading relative to the line from the anchor, likewise."""
    mu, true = (one.heading - math.atan2(one.y, one.x) for one in (pose, truth))
    return abs(wrap(mu - true))


class Quantity(NamedTuple):
    """A quantity whose errors are drawn. Sigmas and errors of claims have its name in theirs."""

    unit: str
    error: Callable[[Pose, Pose], float]
    """The error of a pose, given the true one."""
    alone: Callable[[Pose, Pose], float]
    """The error that is defined before the encounter, for two poses in the anchor's frame."""


QUANTITIES = {
    "position": Quantity("m", travelled, position_alone),
    "heading": Quantity("rad", lambda pose, truth: abs(wrap(pose.heading - truth.heading)), heading_alone),
}


def timed(axes: Axes, pair: PairRecord, *roles: Role, phases: bool = True, label: bool = True) -> None:
    """Set up the time axis of `axes`, in ticks: phases of the robots with `roles`, and contact.

    `phases` writes their names above the panel, and `label` that of the axis below it.
    """
    spans = pair.spans(*roles)
    first, end = spans[0].first - 0.5, spans[-1].last + 0.5
    axes.set_xlim(first, end)
    for span in spans:
        left, right = span.first - 0.5, span.last + 0.5
        axes.axvspan(left, right, color=SHADES[span.phase], lw=0, zorder=-3, gid=f"phase-{span.phase}")
        if left > first:
            axes.axvline(left, color="0.6", lw=0.6, zorder=-1)
        if phases:
            name = f"phase {span.phase}" if right - left > NAME_SHARE * (end - first) else str(span.phase)
            axes.text(
                (left + right) / 2, 1.03, name, transform=axes.get_xaxis_transform(), ha="center", color="0.3"
            )
    for i, (begin, last) in enumerate(pair.contacts):
        axes.axvspan(
            begin - 0.5, last + 0.5, color=SHADE, lw=0, zorder=-2, gid=f"contact-{begin}-{last}",
            label="in contact" if i == 0 else None,
        )  # fmt: skip
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if label:
        axes.set_xlabel(f"tick ({pair.mission.period:g} s)")
    else:
        axes.tick_params(labelbottom=False)


def _every(points: Points) -> int:
    """Return the number of points from one marker to the next."""
    return max(1, math.ceil(len(points) / MOST_MARKERS))


def ranges(pair: PairRecord, medium: Medium = SCREEN) -> Figure:
    """Return the figure of the measured ranges and of the robots' separation."""
    sheet = Sheet(medium, True, [pair.title], [["ranges"], ["key"]])
    axes, reach, first = sheet.tall("ranges", TALL + 0.3), pair.mission.sensing_range, pair.first
    timed(axes, pair, *ROLES)
    apart = pair.separations[first : len(pair.mutual)]
    label = "true separation" if pair.true else "separation, from claims"
    _line(axes, list(enumerate(apart, first)), lw=1.1, color=INK, zorder=2, gid="separation", label=label)
    for role in ROLES:
        one, label = pair.robot(role), rf"$\rho$ of {pair.robot(role).id} to ${ANCHORS[role]}$, measured"
        look = {"color": COLOURS[role], "gid": f"anchor-range-{one.id}", "label": label, **ROLE_MARKERS[role]}
        _measured(axes, one.anchor_ranges, first, look)
    look = {"color": INK, "gid": "mutual-range", "label": "mutual range, measured", "marker": "D"}
    _measured(axes, [rho for _, rho in pair.mutual], first, look)
    axes.axhline(reach, ls="-.", lw=0.9, color=PALE, gid="reach", label=f"$R$ = {reach:g} m", zorder=1)
    axes.set_ylim(0.0, 1.05 * max([reach, *apart]))
    axes.set_ylabel("distance [m]")
    sheet.key(axes)
    return sheet.finished()


def _measured(axes: Axes, values: Sequence[float | None], first: int, look: dict[str, Any]) -> None:
    """Draw the measured ranges from tick `first` on."""
    points = [(tick, rho) for tick, rho in enumerate(values) if rho is not None and tick >= first]
    _line(axes, points, ls="", ms=3.2, mew=0.9, zorder=3, **look)


def errors(pair: PairRecord, medium: Medium = SCREEN) -> Figure | Absent:
    """Return the figure of the position and heading errors of both robots."""
    if not pair.true:
        return Absent(NO_TRUTH)
    if not any(pair.robot(role).estimates for role in ROLES):
        return Absent("neither robot has an estimate of its pose")
    sheet = Sheet(medium, True, [pair.title], [[name] for name in (*QUANTITIES, "key")])
    for name in QUANTITIES:
        axes, last = sheet.tall(name, TALL), name == "heading"
        timed(axes, pair, *ROLES, phases=not last, label=last)
        draw_errors(axes, pair, name, *ROLES)
    sheet.key(sheet.panels["position"])
    return sheet.finished()


def draw_errors(axes: Axes, pair: PairRecord, name: str, *roles: Role) -> None:
    """Draw the errors of the most probable pose and of the other hypotheses, and the claimed sigmas.

    Before the encounter, draw those of the pose relative to the anchor. Of one robot, the claimed sigma is
    drawn too, and the errors within 3 sigma are shaded. `name` is one of QUANTITIES.
    """
    sigmas: Points = ()
    for role in roles:
        sigmas = _errors(axes, pair, role, name)
    limit: dict[str, Any] = {"ls": "-.", "lw": 0.9, "color": PALE, "zorder": 1}
    if pair.exact:
        label = f"tolerance: {TOLERANCE:g}; smaller\nthan {FLOOR:g} is drawn there"
        axes.axhline(TOLERANCE, gid="tolerance", label=label, **limit)
    elif name == "position":
        label = f"required sigma: {pair.mission.accuracy:g} m"
        axes.axhline(pair.mission.accuracy, gid="accuracy", label=label, **limit)
    axes.set_yscale("log")
    if len(roles) == 1 and sigmas:
        colour = COLOURS[roles[0]]
        _line(axes, sigmas, lw=0.7, color=colour, gid="sigma", label="claimed sigma")
        low, _ = axes.get_ylim()
        ticks, values = np.array(sigmas).T
        high = np.maximum(BAND_SIGMAS * values, low)
        axes.fill_between(ticks, low, high, color=colour, alpha=0.12, lw=0, zorder=0, gid="envelope")
    axes.set_ylabel(f"{name} error [{QUANTITIES[name].unit}]")


def _errors(axes: Axes, pair: PairRecord, role: Role, name: str) -> Points:
    """Draw the errors of one robot, and return its claimed sigmas."""
    robot, quantity, look = pair.robot(role), QUANTITIES[name], {"color": COLOURS[role]}
    at = inverse(Pose(robot.anchor.x, robot.anchor.y, 0.0))
    before = [(one, compose(at, truth)) for one, truth in robot.estimates if one.local and not one.world]
    alone = [(one.tick, max(quantity.alone(pose, truth) for pose in one.local)) for one, truth in before]
    label = f"{robot.id}, relative to its anchor"
    _line(axes, alone, ls=LONE_LINES[role], lw=1.0, gid=f"{name}-alone-{robot.id}", label=label, **look)
    ghosts = [(one.tick, quantity.error(pose, true)) for one, true in robot.placed for pose in others(one)]
    label, marker = f"{robot.id}, other hypotheses", "x" if role == "a" else "+"
    gid = f"{name}-others-{robot.id}"
    _line(axes, ghosts, ls="", marker=marker, ms=4, mew=0.8, alpha=0.75, gid=gid, label=label, **look)
    likeliest = [(one.tick, quantity.error(one.world[0], truth)) for one, truth in robot.likeliest]
    label, every = f"{robot.id}, {'pose' if pair.exact else 'most probable pose'}", _every(likeliest)
    marks = {**ROLE_MARKERS[role], "ms": 3.6, "markevery": every, **look}
    _line(axes, likeliest, lw=1.2, ls=ROLE_LINES[role], gid=f"{name}-{robot.id}", label=label, **marks)
    sigmas = [
        (one.tick, getattr(one.covariance, f"{name}_sigma")) for one, _ in robot.likeliest if one.covariance
    ]
    bounds, label = [(tick, BAND_SIGMAS * sigma) for tick, sigma in sigmas], f"{robot.id}, claimed 3 sigma"
    _line(axes, bounds, lw=0.9, ls=CLAIMED[role], gid=f"{name}-sigma-{robot.id}", label=label, **look)
    if (claim := robot.claim) is not None:
        axes.plot(
            claim.tick, max(getattr(claim, f"{name}_error"), FLOOR), ROLE_MARKERS[role]["marker"], ms=9,
            mfc="none", mec=INK, mew=1.1, clip_on=False, zorder=5, gid=f"claim-{robot.id}",
            label=f"claim of {robot.id}, tick {claim.tick}",
        )  # fmt: skip
    return sigmas


def _line(axes: Axes, points: Points, **looks: Any) -> None:
    """Plot `points`, if there are any; a single point gets a marker."""
    if len(points) == 1:
        looks = {"marker": ".", **looks}
    if points:
        axes.plot([tick for tick, _ in points], [max(value, FLOOR) for _, value in points], **looks)


def draw_hypotheses(axes: Axes, pair: PairRecord, role: Role) -> None:
    """Draw the probability of each hypothesis, or, with exact sensors, the number of hypotheses."""
    robot = pair.robot(role)
    weighed = any(one.probabilities for one, _ in robot.estimates)
    (_probabilities if weighed else _count)(axes, pair, role)
    words: dict[str, Any] = {"transform": axes.transAxes, "color": "0.3"}
    axes.text(0.0, 1.04, "hypotheses in the anchor's frame", **words)
    if robot.placed:
        first = robot.placed[0][0].tick
        axes.axvline(first, color="0.3", lw=0.8, ls=":", gid="placed")
        axes.text(1.0, 1.04, f"from tick {first}: of the pair", ha="right", **words)


def _probabilities(axes: Axes, pair: PairRecord, role: Role) -> None:
    """Draw the probabilities on a logit scale, on which 99 % and 99.99 % are easy to distinguish."""
    confidence, held = pair.mission.confidence, [one for one, _ in pair.robot(role).estimates]
    edge = max(SUREST, BEYOND * (1.0 - confidence))
    axes.set_yscale("logit")
    first = {"ms": 3.6, "lw": 1.2, "color": COLOURS[role], **ROLE_MARKERS[role]}
    other = {"ms": 3.6, "mew": 0.8, "lw": 0.7, "color": COLOURS[role], "alpha": 0.5, "marker": "x"}
    for rank in reversed(range(RANKS)):
        for placed in (False, True):
            points = [
                (one.tick, min(max(one.probabilities[rank], edge), 1.0 - edge))
                if rank < len(one.probabilities)
                else (one.tick, math.nan)
                for one in held
                if bool(one.world) == placed
            ]
            if any(not math.isnan(probability) for _, probability in points):
                look = (
                    other if rank else {**first, "clip_on": False, "zorder": 4, "markevery": _every(points)}
                )
                gid = f"probability-{rank + 1}-{'plane' if placed else 'anchor'}"
                axes.plot(*zip(*points, strict=True), gid=gid, **look)
    entry(axes, "most probable hypothesis", **first)
    if any(len(one.probabilities) > 1 for one in held):
        entry(axes, "other hypotheses", **other)
    label = f"required: {percent(confidence)}"
    axes.axhline(confidence, color=PALE, lw=0.9, ls="-.", gid="confidence", label=label)
    tails = [10.0**-k for k in range(2, 13, 2) if 10.0**-k > edge]
    ticks = [*tails[::-1], 0.5, *[1.0 - tail for tail in tails]]
    axes.set_yticks([edge, *ticks, 1.0 - edge], ["less", *map(percent, ticks), "more"])
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylim(edge, 1.0 - edge)
    axes.set_ylabel("probability of a hypothesis")


def percent(probability: float) -> str:
    """Return a probability as a percentage with all its significant digits."""
    return f"{round(100.0 * probability, 10):.12g} %"


def _count(axes: Axes, pair: PairRecord, role: Role) -> None:
    """Draw the number of hypotheses. It is undefined while the robot may be anywhere on a circle."""
    counts = [(one.tick, len(one.world or one.local) or math.nan) for one, _ in pair.robot(role).estimates]
    look = {"drawstyle": "steps-post", "markevery": _every(counts), **ROLE_MARKERS[role]}
    _line(axes, counts, ms=3.6, lw=1.2, color=COLOURS[role], gid="count", label="hypotheses", **look)
    axes.axhline(1.0, color=PALE, lw=0.9, ls="-.", label="one pose")
    axes.set_ylim(0.0, 1.0 + max([count for _, count in counts if not math.isnan(count)], default=1))
    axes.yaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    axes.set_ylabel("hypotheses")
