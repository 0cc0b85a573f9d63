"""Ranges, separation, errors and hypotheses over time."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from compose.figures.pair import PairRecord, error, others
from compose.figures.sheet import ANCHORS, NO_TRUTH, Absent, Sheet
from compose.figures.style import INK, PALE, ROLE_MARKERS, SCREEN, SHADE, Medium
from compose.recording.claim_errors import Claim
from compose.view.colours import COLOURS
from protocol.mission import ROLES, Role
from protocol.motion import Covariance, Pose, wrap
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
Quantity = Literal["position", "heading"]


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


def every(count: int) -> int:
    """Return the number of points from one marker to the next, on a line of `count` points."""
    return max(1, math.ceil(count / MOST_MARKERS))


def ranges(pair: PairRecord, medium: Medium = SCREEN) -> Figure:
    """Return the figure of the measured ranges and of the robots' separation."""
    sheet = Sheet(medium, True, [pair.title], [["ranges"], ["key"]])
    axes = sheet.tall("ranges", TALL + 0.3)
    timed(axes, pair, *ROLES)
    _ranges(axes, pair)
    axes.set_ylabel("distance [m]")
    sheet.key(axes)
    return sheet.finished()


def _ranges(axes: Axes, pair: PairRecord) -> None:
    apart = pair.separations[pair.first : len(pair.mutual)]
    if apart:
        ticks = range(pair.first, pair.first + len(apart))
        axes.plot(
            ticks, apart, "-", lw=1.1, color=INK, zorder=2, gid="separation",
            label="true separation" if pair.true else "separation, from claims",
        )  # fmt: skip
    for role in ROLES:
        one = pair.robot(role)
        _measured(
            axes, one.anchor_ranges, f"anchor-range-{one.id}", COLOURS[role], ROLE_MARKERS[role],
            rf"$\rho$ of {one.id} to ${ANCHORS[role]}$, measured", pair.first,
        )  # fmt: skip
    diamonds = {"marker": "D", "markerfacecolor": INK, "markeredgecolor": INK}
    mutual = [rho for _, rho in pair.mutual]
    _measured(axes, mutual, "mutual-range", INK, diamonds, "mutual range, measured", pair.first)
    reach = pair.mission.sensing_range
    axes.axhline(reach, ls="-.", lw=0.9, color=PALE, gid="reach", label=f"$R$ = {reach:g} m", zorder=1)
    axes.set_ylim(0.0, 1.05 * max([reach, *pair.separations[pair.first :]]))


def _measured(
    axes: Axes,
    values: Sequence[float | None],
    gid: str,
    colour: str,
    mark: dict[str, Any],
    label: str,
    first: int,
) -> None:
    """Draw the measured ranges from tick `first` on."""
    points = [(tick, rho) for tick, rho in enumerate(values) if rho is not None and tick >= first]
    if points:
        ticks, measured_ranges = zip(*points, strict=True)
        axes.plot(
            ticks,
            measured_ranges,
            ls="",
            ms=3.2,
            mew=0.9,
            color=colour,
            gid=gid,
            label=label,
            zorder=3,
            **mark,
        )


def errors(pair: PairRecord, medium: Medium = SCREEN) -> Figure | Absent:
    """Return the figure of the position and heading errors of both robots."""
    if not pair.true:
        return Absent(NO_TRUTH)
    if not any(pair.robot(role).estimates for role in ROLES):
        return Absent("neither robot has an estimate of its pose")
    quantities: tuple[Quantity, ...] = ("position", "heading")
    sheet = Sheet(medium, True, [pair.title], [[*quantities[:1]], [*quantities[1:]], ["key"]])
    for quantity in quantities:
        axes, last = sheet.tall(quantity, TALL), quantity == "heading"
        timed(axes, pair, *ROLES, phases=not last, label=last)
        draw_errors(axes, pair, quantity, *ROLES)
    sheet.key(sheet.panels["position"])
    return sheet.finished()


def draw_errors(axes: Axes, pair: PairRecord, quantity: Quantity, *roles: Role) -> None:
    """Draw the errors of the most probable pose and of the other possible poses, and the claimed sigmas.

    Before the encounter, draw those of the pose relative to the anchor. Of one robot, the claimed sigma is
    drawn too, and the errors within 3 sigma are shaded.
    """
    off = error if quantity == "position" else lambda pose, truth: abs(wrap(pose.heading - truth.heading))
    sigmas: Points = ()
    for role in roles:
        sigmas = _errors(axes, pair, role, quantity, off)
    if pair.exact:
        axes.axhline(TOLERANCE, ls="-.", lw=0.9, color=PALE, gid="tolerance", zorder=1,
                     label=f"tolerance: {TOLERANCE:g}; smaller\nthan {FLOOR:g} is drawn there")  # fmt: skip
    elif quantity == "position":
        required = pair.mission.accuracy
        axes.axhline(required, ls="-.", lw=0.9, color=PALE, gid="accuracy", zorder=1,
                     label=f"required sigma: {required:g} m")  # fmt: skip
    if len(roles) == 1 and sigmas:
        _line(axes, sigmas, lw=0.7, ls="-", color=COLOURS[roles[0]], gid="sigma", label="claimed sigma")
    axes.set_yscale("log")
    if len(roles) == 1 and sigmas:
        low, _ = axes.get_ylim()
        ticks, values = np.array(sigmas).T
        axes.fill_between(
            ticks, low, np.maximum(BAND_SIGMAS * values, low), color=COLOURS[roles[0]], alpha=0.12, lw=0,
            zorder=0, gid="envelope",
        )  # fmt: skip
    axes.set_ylabel(f"{quantity} error [{'m' if quantity == 'position' else 'rad'}]")


def _errors(
    axes: Axes, pair: PairRecord, role: Role, quantity: Quantity, off: Callable[[Pose, Pose], float]
) -> Points:
    """Draw the errors of one robot, and return its claimed sigmas."""
    robot, colour = pair.robot(role), COLOURS[role]
    anchor = robot.anchor
    alone = [
        (one.tick, max(_alone(pose, Pose(truth.x - anchor.x, truth.y - anchor.y, truth.heading))[quantity]
                       for pose in one.local))
        for one, truth in robot.estimates
        if one.local and not one.world
    ]  # fmt: skip
    _line(axes, alone, ls=LONE_LINES[role], lw=1.0, color=colour, gid=f"{quantity}-alone-{robot.id}",
          label=f"{robot.id}, relative to its anchor")  # fmt: skip
    _line(axes, [(one.tick, off(pose, truth)) for one, truth in robot.placed for pose in others(one)],
          ls="", marker="x" if role == "a" else "+", ms=4, mew=0.8, color=colour, alpha=0.75,
          gid=f"{quantity}-others-{robot.id}", label=f"{robot.id}, other possible poses")  # fmt: skip
    likeliest = [(one.tick, off(one.world[0], truth)) for one, truth in robot.likeliest]
    _line(axes, likeliest, lw=1.2, ls=ROLE_LINES[role], ms=3.6, color=colour, gid=f"{quantity}-{robot.id}",
          label=f"{robot.id}, {'pose' if pair.exact else 'most probable pose'}",
          markevery=every(len(likeliest)), **ROLE_MARKERS[role])  # fmt: skip
    sigmas = [(one.tick, _sigma(one.covariance, quantity)) for one, _ in robot.likeliest if one.covariance]
    _line(axes, [(tick, BAND_SIGMAS * sigma) for tick, sigma in sigmas], lw=0.9, ls=CLAIMED[role],
          color=colour, gid=f"{quantity}-sigma-{robot.id}",
          label=rf"{robot.id}, claimed 3 $\sigma$")  # fmt: skip
    if robot.claim is not None:
        axes.plot(
            robot.claim.tick, max(_of_claim(robot.claim, quantity), FLOOR),
            ROLE_MARKERS[role]["marker"], ms=9, mfc="none", mec=INK, mew=1.1, ls="", clip_on=False, zorder=5,
            gid=f"claim-{robot.id}", label=f"claim of {robot.id}, tick {robot.claim.tick}",
        )  # fmt: skip
    return sigmas


def _sigma(covariance: Covariance, quantity: Quantity) -> float:
    return covariance.position_sigma if quantity == "position" else covariance.heading_sigma


def _of_claim(claim: Claim, quantity: Quantity) -> float:
    return claim.position_error if quantity == "position" else claim.heading_error


def _alone(pose: Pose, truth: Pose) -> dict[Quantity, float]:
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
        axes.plot([tick for tick, _ in points], [max(value, FLOOR) for _, value in points], **looks)


def draw_hypotheses(axes: Axes, pair: PairRecord, role: Role) -> None:
    """Draw the probability of each hypothesis, or, with exact sensors, the number of possible poses."""
    robot = pair.robot(role)
    weighed = any(one.probabilities for one, _ in robot.estimates)
    if weighed:
        _probabilities(axes, pair, role)
    else:
        _count(axes, pair, role)
    words: dict[str, Any] = {"transform": axes.transAxes, "color": "0.3"}
    axes.text(0.0, 1.04, "branches in the anchor's frame", **words)
    if robot.placed:
        first = robot.placed[0][0].tick
        axes.axvline(first, color="0.3", lw=0.8, ls=":", gid="placed")
        axes.text(1.0, 1.04, f"from tick {first}: of the pair", ha="right", **words)


def _probabilities(axes: Axes, pair: PairRecord, role: Role) -> None:
    """Draw the probabilities on a logit scale, on which 99 % and 99.99 % are easy to distinguish."""
    confidence = pair.mission.confidence
    edge = max(SUREST, BEYOND * (1.0 - confidence))
    axes.set_yscale("logit")
    for rank in reversed(range(RANKS)):
        for placed in (False, True):
            _rank(axes, pair, role, rank, placed, edge)
    marker, colour = ROLE_MARKERS[role], COLOURS[role]
    axes.plot([], [], "-", ms=3.6, lw=1.2, color=colour, label="most probable hypothesis", **marker)
    if any(len(one.probabilities) > 1 for one, _ in pair.robot(role).estimates):
        axes.plot([], [], "-x", ms=3.6, mew=0.8, lw=0.7, color=colour, alpha=0.5, label="other hypotheses")
    axes.axhline(
        confidence, color=PALE, lw=0.9, ls="-.", gid="confidence", label=f"required: {percent(confidence)}"
    )
    tails = [10.0**-k for k in range(2, 13, 2) if 10.0**-k > edge]
    ticks = [*tails[::-1], 0.5, *[1.0 - tail for tail in tails]]
    axes.set_yticks([edge, *ticks, 1.0 - edge], ["less", *map(percent, ticks), "more"])
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylim(edge, 1.0 - edge)
    axes.set_ylabel("probability of a hypothesis")


def _rank(axes: Axes, pair: PairRecord, role: Role, rank: int, placed: bool, edge: float) -> None:
    """Draw the probability of the hypothesis at `rank`: of placements if `placed`, else of branches."""
    points = [
        (
            one.tick,
            min(max(one.probabilities[rank], edge), 1.0 - edge)
            if rank < len(one.probabilities)
            else math.nan,
        )
        for one, _ in pair.robot(role).estimates
        if bool(one.world) == placed
    ]
    if all(math.isnan(probability) for _, probability in points):
        return
    ticks, probability = zip(*points, strict=True)
    gid = f"probability-{rank + 1}-{'plane' if placed else 'anchor'}"
    if rank:
        axes.plot(ticks, probability, "-x", ms=3.6, mew=0.8, lw=0.7, color=COLOURS[role], alpha=0.5, gid=gid)
    else:
        axes.plot(
            ticks, probability, "-", ms=3.6, lw=1.2, color=COLOURS[role], gid=gid, clip_on=False, zorder=4,
            markevery=every(len(ticks)), **ROLE_MARKERS[role],
        )  # fmt: skip


def percent(probability: float) -> str:
    """Return a probability as a percentage with all its significant digits."""
    return f"{round(100.0 * probability, 10):.12g} %"


def _count(axes: Axes, pair: PairRecord, role: Role) -> None:
    """Draw the number of possible poses. It is undefined while the robot may be anywhere on a circle."""
    counts = [(one.tick, len(one.world or one.local) or math.nan) for one, _ in pair.robot(role).estimates]
    if counts:
        ticks, held = zip(*counts, strict=True)
        axes.plot(
            ticks, held, "-", ms=3.6, lw=1.2, drawstyle="steps-post", color=COLOURS[role], gid="count",
            markevery=every(len(ticks)), label="possible poses", **ROLE_MARKERS[role],
        )  # fmt: skip
    axes.axhline(1.0, color=PALE, lw=0.9, ls="-.", label="one pose")
    known = [count for _, count in counts if not math.isnan(count)]
    axes.set_ylim(0.0, 1.0 + max(known, default=1))
    axes.yaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    axes.set_ylabel("possible poses")
