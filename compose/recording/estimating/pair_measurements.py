"""The measurements of two recorded robots as the estimator takes them: paths in short steps, and ranges."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.estimation.gaussian.range_model import PairRanges, Ranges
from compose.errors import UserError
from compose.recording.estimating.prepared_steps import (
    Measurements,
    OneRobot,
    horizon,
    levelled,
    prepared_steps,
)
from compose.recording.estimating.recorded_noise import RecordedNoise
from compose.recording.ranging.range_recording import (
    FixedAnchor,
    Numbers,
    Places,
    RangeRecording,
    locked,
)


class NoAnchors(UserError):
    """The robots have no ranges to two anchors at different places."""


class PairMeasurements(Measurements, frozen=True, kw_only=True):
    """All measurements of two robots."""

    a: OneRobot
    b: OneRobot

    @property
    def sides(self) -> tuple[OneRobot, ...]:
        """Both robots."""
        return self.a, self.b

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """The names of each pair of radios, in the order of `Ranges.pairs`."""
        to_anchors = [(side.id, anchor.id) for side in self.sides for anchor in side.anchors]
        return (*to_anchors, (self.a.id, self.b.id))

    @property
    def anchors(self) -> tuple[FixedAnchor, ...]:
        """The anchors of both robots."""
        return tuple({one.id: one for side in self.sides for one in side.anchors}.values())

    def counts(self, ranges: Ranges) -> tuple[int, ...]:
        """Return the number of `ranges` of each of the `pairs`."""
        if ranges.radio is None:
            return ranges.counts
        return tuple(np.bincount(ranges.radio, minlength=len(self.pairs)).tolist())

    @property
    def apart(self) -> tuple[float, float]:
        """The vector (m) from the anchor of a to that of b."""
        return self.b.anchor.x - self.a.anchor.x, self.b.anchor.y - self.a.anchor.y

    def until(self, epoch: int) -> PairRanges:
        """Return what was measured up to the end of `epoch`; the first is 1."""
        ticks = epoch * self.ticks_per_epoch
        known = self.t <= self.end(epoch)
        counts = tuple([int(np.count_nonzero(known[self.ranges.rows(kind)])) for kind in range(3)])
        first, second, mutual = counts
        place, radio = self.ranges.place, self.ranges.radio
        some = Ranges(
            self.ranges.rho[known],
            self.ranges.tick[known],
            self.ranges.sigma[known],
            (first, second, mutual),
            place[known] if place is not None else None,
            radio[known] if radio is not None else None,
        )
        reach = horizon(some)
        nothing = np.empty(0, np.intp)
        return PairRanges(
            (self.a.path.until(ticks), self.b.path.until(ticks)),
            some.within(reach, self.noise.priors).thinned(self.noise),
            (nothing, nothing, nothing),
            self.apart,
            reach,
            self.noise,
        )


def pair_measurements(
    recording: RangeRecording,
    robots: Sequence[str],
    assumed: RecordedNoise,
    *,
    ticks: int | None = None,
    anchors: tuple[str, str] | None = None,
    all_anchors: bool = False,
) -> PairMeasurements:
    """Return the measurements of two `robots`, with the noise that is `assumed`.

    `ticks` is the number of them in an epoch; None: by the speed of the robots. Each robot ranges to one of
    two `anchors`; None: those with the most ranges. Ranges to other anchors are used only if `all_anchors` is
    set. Raises UserError if there are no two such anchors.
    """
    noise = assumed.noise
    prepared = prepared_steps(recording, robots, assumed, ticks)
    part, steps = prepared.part, prepared.steps
    radios, ranges = part.radios, steps.ranges
    if anchors is None:
        of_anchor = _own_anchors(part, ranges.first, ranges.second, robots)
    else:
        first, second = anchors
        of_anchor = _anchor(part, first), _anchor(part, second)
    mutual = (ranges.first < len(robots)) & (ranges.second < len(robots))
    lists = [
        np.flatnonzero(
            ~mutual & (ranges.first == robot) & (all_anchors | (ranges.second == radios.index(anchor.id)))
        )
        for robot, anchor in enumerate(of_anchor)
    ]
    lists.append(np.flatnonzero(mutual))
    used = np.concatenate(lists)
    of_robot = [_anchors_of(part, ranges.second[lists[i]], one) for i, one in enumerate(of_anchor)]
    heights = np.array([*[one.antenna[2] for one in part.robots], *[one.height for one in part.anchors]])
    rho, ratio = levelled(ranges.range[used], heights[ranges.first[used]] - heights[ranges.second[used]])
    counts = (len(lists[0]), len(lists[1]), len(lists[2]))
    told = np.repeat([noise.anchor_sigma, noise.anchor_sigma, noise.mutual_sigma], counts)
    sigma = prepared.sigmas(told, ranges.sigma[used]) * ratio
    a, b = [prepared.robot(i, own) for i, own in enumerate(of_robot)]
    place, radio = _several(of_robot, [[radios[k] for k in ranges.second[rows]] for rows in lists])
    unused = {
        "to other anchors": len(ranges.t) - len(used),
        "within a second after another": steps.thinned,
        "without odometry of both robots": steps.outside,
        "in a gap of the odometry": steps.in_gaps,
    }
    return PairMeasurements(
        a=a,
        b=b,
        t0=float(steps.t[0]),
        ticks_per_epoch=prepared.ticks_per_epoch,
        ranges=Ranges(locked(rho), locked(prepared.ticks[used]), locked(sigma), counts, place, radio),
        t=locked(ranges.t[used].copy()),
        noise=noise,
        unused={why: count for why, count in unused.items() if count},
        skipped_s=steps.skipped_s,
        arrivals=prepared.arrivals,
    )


def _anchors_of(recording: RangeRecording, ranged: Places, first: FixedAnchor) -> tuple[FixedAnchor, ...]:
    """Return `first`, and then all other anchors among the second radios of ranges, `ranged`."""
    names = {recording.radios[k] for k in set(ranged.tolist())}
    return (first, *[one for one in recording.anchors if one.id in names and one.id != first.id])


def _several(
    anchors: Sequence[tuple[FixedAnchor, ...]], ranged: Sequence[Sequence[str]]
) -> tuple[Numbers | None, Places | None]:
    """Return `place` and `radio` of `Ranges`; None each if both robots have one anchor.

    `anchors` are those of each robot, and `ranged` the names of the second radio of each range: those to the
    anchors of a robot, in the order of the robots, and then the mutual ones.
    """
    if all(len(own) == 1 for own in anchors):
        return None, None
    place, radio, before = [], [], 0
    for own, names in zip(anchors, ranged, strict=False):
        index = {one.id: k for k, one in enumerate(own)}
        place += [(own[index[name]].x - own[0].x, own[index[name]].y - own[0].y) for name in names]
        radio += [before + index[name] for name in names]
        before += len(own)
    mutual = len(ranged[-1])
    return np.array([*place, *[(0.0, 0.0)] * mutual]), np.array([*radio, *[before] * mutual], np.intp)


def _anchor(recording: RangeRecording, name: str) -> FixedAnchor:
    return next(one for one in recording.anchors if one.id == name)


def _own_anchors(
    recording: RangeRecording, first: Places, second: Places, robots: Sequence[str]
) -> tuple[FixedAnchor, FixedAnchor]:
    """Return the anchor of each robot: of all choices of two different places, that with the most ranges."""
    anchors, base = recording.anchors, len(recording.robots)
    counts = [
        np.bincount(second[(first == robot) & (second >= base)] - base, minlength=len(anchors)).tolist()
        for robot in range(2)
    ]
    best: tuple[int, int, int] | None = None
    for i in _most_ranged(anchors, counts[0]):
        for j in _most_ranged(anchors, counts[1]):
            if (anchors[i].x, anchors[i].y) == (anchors[j].x, anchors[j].y):
                continue
            many = counts[0][i] + counts[1][j]
            if best is None or many > best[0]:
                best = (many, i, j)
    if best is None:
        heard = []
        for name, row in zip(robots, counts, strict=True):
            known = [anchors[k].id for k, count in enumerate(row) if count]
            heard.append(f"{name} has ranges to {listed(known) or 'no anchor'}")
        raise NoAnchors(
            f"{recording.source}: two robots need ranges to two anchors at different places: "
            + ", ".join(heard)
        )
    return anchors[best[1]], anchors[best[2]]


def _most_ranged(anchors: Sequence[FixedAnchor], counts: Sequence[int]) -> list[int]:
    """Return the indices of two anchors with ranges, at different places, which have the largest `counts`.

    The anchors of two robots at different places, with the most ranges in all, are among these two of each.
    """
    found: dict[tuple[float, float], int] = {}
    for k in sorted([k for k, count in enumerate(counts) if count], key=lambda k: -counts[k]):
        found.setdefault((anchors[k].x, anchors[k].y), k)
    return sorted(list(found.values())[:2])


MOST_LISTED = 8
"""The largest number of names in a list for a user."""


def listed(names: Sequence[str]) -> str:
    """Return `names` in one line: the first MOST_LISTED, and the number of the others."""
    more = len(names) - MOST_LISTED
    return ", ".join(names[:MOST_LISTED]) + (f" and {more} more" if more > 0 else "")
