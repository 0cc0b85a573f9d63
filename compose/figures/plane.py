"""The plane: the true paths of both robots, and the estimates of one of them."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_hex, to_rgba
from matplotlib.patches import Circle, Ellipse, FancyArrowPatch, Wedge
from matplotlib.ticker import MaxNLocator
from matplotlib.typing import ColorType

from compose.figures.story import Story, error
from compose.figures.style import COLOURS
from protocol.messages import Estimate
from protocol.motion import ORIGIN, Pose
from protocol.rounding import TOLERANCE
from world.scenario import RobotSpec

Window = tuple[float, float, float, float]
"""Left, right, low and high, in m."""

AGES = LinearSegmentedColormap.from_list("ages", ["#e0a8d8", "#a8459c", "#4a0d52"])
"""The colours of estimates over time, from the first to the last."""
GHOST = "0.55"
SIGMAS = 3.0
ELLIPSES = 5
"""The maximum number of error ellipses."""
SMALLER = 0.75
"""The largest size ratio, later over earlier, at which two overlapping ellipses are both legible."""
AROUND = 2.2
"""The maximum half-width of the enlarged panel, as a multiple of the last ellipse's size."""
EXACTLY = 0.02
"""The minimum half-width of the enlarged panel with exact sensors, as a fraction of the sensing range."""
ARROW = 0.55
"""The length of a heading arrow, as a fraction of that half-width."""
MANY = 400
"""The number of ticks above which a path has no markers."""


def window(story: Story) -> Window:
    """Return the window that contains both paths and both anchors' sensing ranges."""
    reach = story.recording.scenario.mission.sensing_range
    points = [(pose.x, pose.y) for one in (story.own, story.peer) for pose in story.truth(one.id)]
    for one in (story.own, story.peer):
        points += [(one.anchor.x + dx, one.anchor.y + dy) for dx in (-reach, reach) for dy in (-reach, reach)]
    xs, ys = zip(*points, strict=True)
    margin = 0.04 * max(max(xs) - min(xs), max(ys) - min(ys))
    return min(xs) - margin, max(xs) + margin, min(ys) - margin, max(ys) + margin


def draw(axes: Axes, story: Story) -> None:
    """Draw the mission from above."""
    visible = window(story)
    for one in (story.own, story.peer):
        _anchor(axes, one, story)
    _path(axes, story, story.own)
    _path(axes, story, story.peer)
    if story.encounter_tick is not None:
        ends = [story.truth(one.id)[story.encounter_tick] for one in (story.own, story.peer)]
        axes.plot(
            [p.x for p in ends], [p.y for p in ends], ":", color="0.1", lw=1.3, gid="met",
            label=f"encounter, tick {story.encounter_tick}",
        )  # fmt: skip
    _ghosts(axes, story, visible)
    _estimates(axes, story)
    axes.set_aspect("equal", anchor="N")
    axes.set_xlim(*visible[:2])
    axes.set_ylim(*visible[2:])
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def _anchor(axes: Axes, one: RobotSpec, story: Story) -> None:
    """Draw a robot's anchor and its sensing range."""
    place, reach = (one.anchor.x, one.anchor.y), story.recording.scenario.mission.sensing_range
    own = one is story.own
    axes.plot(*place, "+", color="k", ms=9, mew=1.3, gid=f"anchor-{one.id}")
    circle = Circle(place, reach, fill=False, ls="--", lw=0.8, color="0.4", gid=f"range-{one.id}")
    axes.add_patch(circle)
    axes.annotate(
        f"anchor of {one.id}", (one.anchor.x, one.anchor.y - reach), xytext=(0, -3),
        textcoords="offset points", ha="center", va="top", fontsize=8, color="0.2", zorder=4,
        bbox={"facecolor": "white", "alpha": 0.7, "pad": 0.5, "lw": 0},
    )  # fmt: skip
    if own:
        axes.plot([], [], "+", color="k", ms=9, mew=1.3, label="anchor")
        axes.plot([], [], "--", color="0.4", lw=0.8, label=f"sensing range, {reach:g} m")


def _path(axes: Axes, story: Story, one: RobotSpec) -> None:
    """Draw the true path of a robot; that of the peer is pale."""
    truth, own = story.truth(one.id), one is story.own
    colour, alpha = COLOURS[one.role], 1.0 if own else 0.4
    marker = "." if own and len(truth) <= MANY else ""
    axes.plot(
        [p.x for p in truth], [p.y for p in truth], marker=marker, ms=3.5, lw=1.2, color=colour, alpha=alpha,
        label=f"true path of {one.id}", gid=f"path-{one.id}",
    )  # fmt: skip
    axes.plot(truth[0].x, truth[0].y, "s", ms=6, mfc="white", mec=colour, mew=1.3, alpha=alpha)
    if own:
        axes.plot([], [], "s", ms=6, mfc="white", mec=colour, mew=1.3, label="start")


def _ghosts(axes: Axes, story: Story, visible: Window) -> None:
    """Draw the possible poses that are not the most probable."""
    left, right, low, high = visible
    ghosts = [pose for estimate, _ in story.placed for pose in story.others(estimate)]
    within = [pose for pose in ghosts if left <= pose.x <= right and low <= pose.y <= high]
    if within:
        axes.plot(
            [p.x for p in within], [p.y for p in within], "x", ms=4, mew=0.9, color=GHOST, gid="ghosts",
            label=name_of_others(story),
        )  # fmt: skip


def name_of_others(story: Story) -> str:
    """Return the label of the poses in `story.others`."""
    return "other hypotheses" if story.weighed else "possible poses"


def _estimates(axes: Axes, story: Story) -> None:
    """Draw the most probable pose over time, paler with age, with the legible error ellipses."""
    if not story.likeliest:
        return
    colours, label = ages(story), "estimate, 3 sigma" if legible(story) else "estimate"
    poses = [estimate.world[0] for estimate, _ in story.likeliest]
    axes.scatter(
        [p.x for p in poses], [p.y for p in poses], s=7, marker="D", c=list(colours.values()), zorder=3,
        gid="estimates",
    )  # fmt: skip
    for estimate, _ in legible(story):
        _ellipse(axes, estimate, ORIGIN, story, f"ellipse-{estimate.tick}")
    final = poses[-1]
    axes.plot(final.x, final.y, "*", ms=10, mfc=AGES(1.0), mec="white", mew=0.6, zorder=5, gid="final")
    axes.plot([], [], "-" if legible(story) else "", marker="D", ms=3, lw=1.0, color=AGES(0.55), label=label)


def ages(story: Story) -> dict[int, str]:
    """Return the colours of the estimates in `story.likeliest`, by tick."""
    ticks = [estimate.tick for estimate, _ in story.likeliest]
    return {
        tick: to_hex(AGES(i / max(1, len(ticks) - 1) if len(ticks) > 1 else 1.0))
        for i, tick in enumerate(ticks)
    }


def legible(story: Story) -> list[tuple[Estimate, Pose]]:
    """Return the estimates whose ellipses are drawn, with the true poses, in order of time.

    These are the last one and earlier ones that later ellipses do not hide, ELLIPSES at most. Ellipses
    larger than the sensing range R are omitted, because they carry no information.
    """
    chosen: list[tuple[Estimate, Pose]] = []
    largest = story.recording.scenario.mission.sensing_range
    for estimate, truth in reversed(story.likeliest):
        if estimate.covariance is None or len(chosen) == ELLIPSES:
            continue
        if SIGMAS * estimate.covariance.position_sigma > largest:
            continue
        if chosen:
            after = chosen[-1][0]
            assert after.covariance is not None
            sizes = SIGMAS * estimate.covariance.position_sigma, SIGMAS * after.covariance.position_sigma
            apart = error(estimate.world[0], after.world[0])
            if apart < sum(sizes) and sizes[1] > SMALLER * sizes[0]:
                continue
        chosen.append((estimate, truth))
    return chosen[::-1]


def _ellipse(axes: Axes, estimate: Estimate, origin: Pose, story: Story, gid: str) -> None:
    """Draw the error ellipse of the most probable position relative to `origin`; the last one is filled."""
    pose, covariance, last = estimate.world[0], estimate.covariance, estimate is story.likeliest[-1][0]
    if covariance is None:
        return
    variances, directions = np.linalg.eigh([[covariance.xx, covariance.xy], [covariance.xy, covariance.yy]])
    height, width = 2.0 * SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    colour = ages(story)[estimate.tick]
    axes.add_patch(
        Ellipse(
            (pose.x - origin.x, pose.y - origin.y),
            width,
            height,
            angle=math.degrees(math.atan2(directions[1, 1], directions[0, 1])),
            facecolor=to_rgba(colour, 0.12 if last else 0.0),
            edgecolor=colour,
            lw=1.6 if last else 0.9,
            zorder=4,
            gid=gid,
        )
    )


def draw_near(axes: Axes, story: Story) -> None:
    """Draw the estimates relative to the true pose in the same tick, enlarged."""
    axes.set_aspect("equal", adjustable="box", anchor="N")
    if not story.likeliest:
        axes.set_axis_off()
        axes.text(
            0.5, 0.5, "The recording has no\nmost probable pose.",
            transform=axes.transAxes, ha="center", va="center", color="0.3", gid="nothing-near",
        )  # fmt: skip
        return
    axes.set_title("estimates relative to the true pose", fontsize=8, color="0.3")
    axes.set_xlabel("x error [m]")
    axes.set_ylabel("y error [m]")
    colours, (last, truth), half = ages(story), story.likeliest[-1], _half(story)
    _heading(axes, (0.0, 0.0), truth.heading, half, COLOURS[story.own.role])
    axes.plot(0.0, 0.0, "o", ms=6, color=COLOURS[story.own.role], gid="near-truth", label="true")
    for estimate, then in legible(story) or [(last, truth)]:
        pose, marker = estimate.world[0], "*" if estimate is last else "D"
        _ellipse(axes, estimate, then, story, f"near-{estimate.tick}")
        axes.plot(
            pose.x - then.x, pose.y - then.y, marker, ms=10 if estimate is last else 3.5,
            color=colours[estimate.tick], mec="white", mew=0.5, zorder=6, label=str(estimate.tick),
        )  # fmt: skip
    off = last.world[0].x - truth.x, last.world[0].y - truth.y
    _heading(axes, off, last.world[0].heading, half, AGES(1.0))
    if last.covariance is not None:
        spread = math.degrees(min(math.pi, SIGMAS * last.covariance.heading_sigma))
        middle = math.degrees(last.world[0].heading)
        axes.add_patch(
            Wedge(off, ARROW * half, middle - spread, middle + spread, color=AGES(1.0), alpha=0.15, lw=0)
        )
    axes.set_xlim(-half, half)
    axes.set_ylim(-half, half)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.grid(lw=0.4, color="0.9")


def _half(story: Story) -> float:
    """Return the half-width of the enlarged panel, in m."""

    def size(estimate: Estimate, truth: Pose) -> float:
        sigma = estimate.covariance.position_sigma if estimate.covariance is not None else 0.0
        return SIGMAS * sigma + error(estimate.world[0], truth)

    last = size(*story.likeliest[-1])
    most = max([size(*one) for one in legible(story)], default=last)
    least = EXACTLY * story.recording.scenario.mission.sensing_range if story.exact else TOLERANCE
    return max(min(1.1 * most, AROUND * last), least)


def _heading(axes: Axes, at: tuple[float, float], heading: float, half: float, colour: ColorType) -> None:
    tip = at[0] + ARROW * half * math.cos(heading), at[1] + ARROW * half * math.sin(heading)
    axes.add_patch(
        FancyArrowPatch(
            at, tip, arrowstyle="-|>", mutation_scale=9, color=colour, lw=1.2, shrinkA=0, shrinkB=0
        )
    )
