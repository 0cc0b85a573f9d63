"""The measurements of recorded robots: facts, and what the estimator makes of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from agent.estimation.facts import Fact, Facts, Manoeuvre, anchor, anchor_range, manoeuvre, mutual_range
from agent.estimation.gaussian.joint_ranges import joint_measurements
from agent.estimation.gaussian.odometry_noise import Track
from compose.errors import UserError
from compose.recording.estimating.prepared_steps import (
    EPOCH_S,
    Measurements,
    OneRobot,
    PreparedSteps,
    prepared_steps,
)
from compose.recording.estimating.recorded_noise import RecordedNoise
from compose.recording.ranging.range_recording import FixedAnchor, RangeRecording


def group_measurements(
    recording: RangeRecording, robots: Sequence[str], assumed: RecordedNoise, *, ticks: int | None = None
) -> Measurements:
    """Return the measurements of `robots`, with the noise that is `assumed`.

    `ticks` is the number of them in an epoch; None: by the speed of the robots.
    """
    prepared = prepared_steps(recording, robots, assumed, ticks)
    steps = prepared.steps
    members = tuple(
        [prepared.robot(i, prepared.anchors_of(i)[:MOST_USED_ANCHORS]) for i in range(len(robots))]
    )
    anchors = tuple({one.id: one for robot in members for one in robot.anchors}.values())
    ranges = list(_ranges(prepared, members))
    known = [*_anchors(anchors), *ranges]
    for one in members:
        known += _manoeuvres(one.id, one.path)
    joint = joint_measurements(Facts(frozenset(known)), assumed.noise, EPOCH_S / prepared.ticks_per_epoch)
    others = f"to others than the {MOST_USED_ANCHORS} anchors with the most"
    unused = {
        others: len(steps.ranges.t) - len(ranges),
        "within a second after another": steps.thinned,
        "without odometry of all robots": steps.outside,
        "in a gap of the odometry": steps.in_gaps,
    }
    return Measurements(
        sides=members,
        joint=joint,
        t0=float(steps.t[0]),
        ticks_per_epoch=prepared.ticks_per_epoch,
        noise=assumed.noise,
        unused={why: count for why, count in unused.items() if count},
        skipped_s=steps.skipped_s,
        arrivals=prepared.arrivals,
    )


class NoAnchors(UserError):
    """One robot, or two, have no ranges to two anchors with positions at different places."""


def check_anchors(recording: RangeRecording, robots: Sequence[str]) -> None:
    """Raise NoAnchors if one robot, or two, have no ranges to two anchors with positions at different places.

    Of more robots, some may be estimated.
    """
    placed = recording.with_places()
    found = [placed.anchors_of(robot) for robot in range(len(robots))]
    if len(robots) > 2 or len({(one.x, one.y) for own in found for one in own}) > 1:
        return
    heard = [
        f"{name} has ranges to {listed([one.id for one in own]) or 'no anchor'}"
        for name, own in zip(robots, found, strict=True)
    ]
    who = "two robots need" if len(robots) == 2 else "one robot needs"
    raise NoAnchors(
        f"{recording.source}: {who} ranges to two anchors at different places: " + ", ".join(heard)
    )


MOST_LISTED_ANCHORS = 8
"""The largest number of names in a list for a user."""


def listed(names: Sequence[str]) -> str:
    """Return `names` in one line: the first MOST_LISTED_ANCHORS, and the number of the others."""
    more = len(names) - MOST_LISTED_ANCHORS
    return ", ".join(names[:MOST_LISTED_ANCHORS]) + (f" and {more} more" if more > 0 else "")


MOST_USED_ANCHORS = 32
"""The largest number of anchors of a robot that are used. Each has a bias of its own, which a fit learns."""


def _anchors(anchors: Sequence[FixedAnchor]) -> Iterator[Fact]:
    for one in anchors:
        yield anchor(one.id, one.x, one.y, one.sigma)


def _manoeuvres(robot: str, path: Track) -> Iterator[Fact]:
    nothing = np.zeros((2, len(path.v)))
    slip, extra = (
        nothing[0] if path.slip is None else path.slip,
        nothing if path.extra is None else path.extra,
    )
    columns = np.stack((path.v, path.omega, slip, *extra), 1)
    for tick, row in enumerate(columns.tolist()):
        yield manoeuvre(robot, tick, Manoeuvre(*row))


def _ranges(prepared: PreparedSteps, members: Sequence[OneRobot]) -> Iterator[Fact]:
    """Yield the ranges between `members` and to their anchors in the plane, each at the nearest tick."""
    names_of_members = {one.id for one in members}
    used = [names_of_members | {anchor.id for anchor in one.anchors} for one in members]
    part, ranges, radios = prepared.part, prepared.steps.ranges, prepared.part.radios
    rho, sigma = prepared.in_plane(np.arange(len(ranges.t)))
    rows = zip(prepared.ticks, ranges.first, ranges.second, rho, sigma, strict=True)
    for tick, first, second, length, own in rows:
        names = radios[first], radios[second]
        if names[1] not in used[first]:
            continue
        fact = mutual_range if second < len(part.robots) else anchor_range
        yield fact(*names, int(tick), float(length), float(own))
