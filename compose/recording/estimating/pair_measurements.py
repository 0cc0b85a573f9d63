"""The measurements of two recorded robots as the estimator takes them: paths in short steps, and ranges."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.estimation.gaussian.pair_ranges import PairRanges
from agent.estimation.gaussian.range_model import Ranges
from compose.errors import UserError
from compose.recording.estimating.prepared_steps import (
    Measurements,
    OneRobot,
    horizon,
    prepared_steps,
)
from compose.recording.estimating.recorded_noise import RecordedNoise
from compose.recording.ranging.range_recording import (
    FixedAnchor,
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
        return (self.a.id, self.a.anchor.id), (self.b.id, self.b.anchor.id), (self.a.id, self.b.id)

    @property
    def anchors(self) -> tuple[FixedAnchor, ...]:
        """The anchors of both robots."""
        return self.a.anchor, self.b.anchor

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
        some = Ranges(
            self.ranges.rho[known],
            self.ranges.tick[known],
            self.ranges.sigma[known],
            (first, second, mutual),
        )
        reach = horizon(some)
        nothing = np.empty(0, np.intp)
        return PairRanges(
            (self.a.path.until(ticks), self.b.path.until(ticks)),
            some.within(reach, self.noise.priors, 0.0).thinned(self.noise),
            (nothing, nothing, nothing),
            self.apart,
            reach,
            self.noise,
        )


def pair_measurements(
    recording: RangeRecording,
    robots: Sequence[str],
    assumed: RecordedNoise,
    of_anchor: Sequence[FixedAnchor],
    *,
    ticks: int | None = None,
) -> PairMeasurements:
    """Return the measurements of two `robots`, with the noise that is `assumed`.

    Each robot has ranges to one anchor, that in `of_anchor`; they are at different places. `ticks` is the
    number of ticks in an epoch; None: by the speed of the robots.
    """
    prepared = prepared_steps(recording, robots, assumed, ticks)
    ranges = prepared.steps.ranges
    mutual = ranges.second < len(robots)
    lists = [*[np.flatnonzero(~mutual & (ranges.first == robot)) for robot in (0, 1)], np.flatnonzero(mutual)]
    used = np.concatenate(lists)
    rho, sigma = prepared.in_plane(used)
    counts = (len(lists[0]), len(lists[1]), len(lists[2]))
    a, b = [prepared.robot(i, (own,)) for i, own in enumerate(of_anchor)]
    return PairMeasurements(
        a=a,
        b=b,
        ranges=Ranges(locked(rho), locked(prepared.ticks[used]), locked(sigma), counts),
        t=locked(ranges.t[used].copy()),
        **prepared.shared(" of both robots"),
    )


def ranged_anchors(recording: RangeRecording, robots: Sequence[str]) -> list[tuple[FixedAnchor, ...]]:
    """Return the anchors to which each of two robots has ranges, that with the most first.

    Raises NoAnchors unless they are at two different places.
    """
    found = [recording.anchors_of(robot) for robot in range(len(robots))]
    if len({(one.x, one.y) for own in found for one in own}) < 2:
        heard = [
            f"{name} has ranges to {listed([one.id for one in own]) or 'no anchor'}"
            for name, own in zip(robots, found, strict=True)
        ]
        raise NoAnchors(
            f"{recording.source}: two robots need ranges to two anchors at different places: "
            + ", ".join(heard)
        )
    return found


MOST_LISTED_ANCHORS = 8
"""The largest number of names in a list for a user."""


def listed(names: Sequence[str]) -> str:
    """Return `names` in one line: the first MOST_LISTED_ANCHORS, and the number of the others."""
    more = len(names) - MOST_LISTED_ANCHORS
    return ", ".join(names[:MOST_LISTED_ANCHORS]) + (f" and {more} more" if more > 0 else "")
