"""The shipped range models."""

from __future__ import annotations

import math
from collections.abc import Sequence

from world.world_models import Point, Radios, RangeModel


def crosses(one: Point, other: Point, wall: Sequence[float]) -> bool:
    """Return whether the line between two points crosses the segment `wall`: x1, y1, x2, y2 in m."""
    x1, y1, x2, y2 = wall
    begin, end = (x1, y1), (x2, y2)
    return (
        _side(one, other, begin) * _side(one, other, end) < 0.0
        and _side(begin, end, one) * _side(begin, end, other) <= 0.0
    )


def _side(one: Point, other: Point, point: Point) -> float:
    return (other[0] - one[0]) * (point[1] - one[1]) - (other[1] - one[1]) * (point[0] - one[0])


def walls_of(segments: Sequence[Sequence[float]]) -> tuple[tuple[float, ...], ...]:
    """Return segments as tuples. Raises ValueError unless each has four numbers."""
    for place, wall in enumerate(segments):
        if len(wall) != 4:
            raise ValueError(f"segments[{place}] has {len(wall)} numbers, expected x1, y1, x2, y2")
    return tuple([tuple(wall) for wall in segments])


class FadingRange(RangeModel):
    """Detection with a probability that falls with distance: 1 up to `full` R, then to 0 at R."""

    def __init__(self, full: float = 0.5, exponent: float = 2.0) -> None:
        """`full` is a fraction of R; `exponent` is the power of the fall, 1 for a straight line."""
        if not 0.0 <= full < 1.0 or not exponent > 0.0:
            raise ValueError(f"full {full:g} is not from 0 to 1, or exponent {exponent:g} is not positive")
        self.full, self.exponent = full, exponent

    def detects(self, radios: Radios, reach: float) -> bool:
        """Return whether the two radios detect each other."""
        share = radios.distance / reach
        if share > 1.0:
            return False
        missed: float = (max(0.0, share - self.full) / (1.0 - self.full)) ** self.exponent
        return radios.uniform("detection") >= missed


class WalledRange(RangeModel):
    """A disc with walls, through which no range is measured."""

    def __init__(self, segments: Sequence[Sequence[float]] = (), contact: bool = False) -> None:
        """`segments` are [x1, y1, x2, y2] in m. With `contact`, robots stay in contact through a wall."""
        self.segments, self.contact = walls_of(segments), contact

    def detects(self, radios: Radios, reach: float) -> bool:
        """Return whether the two radios detect each other."""
        return radios.distance <= reach and (self.contact or not self._blocked(radios))

    def measured(self, radios: Radios, rho: float) -> float | None:
        """Return the range; None through a wall."""
        return None if self.contact and self._blocked(radios) else rho

    def _blocked(self, radios: Radios) -> bool:
        return any(crosses(radios.one, radios.other, wall) for wall in self.segments)


class AttackedRange(RangeModel):
    """A disc in which somebody attacks the ranges of one link. `link` is the name of its `Radios`."""

    def __init__(
        self,
        link: str,
        by: float = 0.0,
        relay: float = 0.0,
        jam: bool = False,
        begins: int = 0,
        ends: int = 10**9,
    ) -> None:
        """The attack lasts from tick `begins` until before `ends`.

        Ranges are longer by `by` m, or shorter if it is negative. A relay makes the radios detect each other
        up to `relay` m beyond R. With `jam`, no range is measured.
        """
        if not (math.isfinite(by) and 0.0 <= relay <= LONGEST_RELAY):
            raise ValueError(
                f"by {by:g} is not a number, or relay {relay:g} not from 0 to {LONGEST_RELAY:g} m"
            )
        self.link, self.by, self.relay, self.jam = link, by, relay, jam
        self.begins, self.ends = begins, ends

    def detects(self, radios: Radios, reach: float) -> bool:
        """Return whether the two radios detect each other."""
        return radios.distance <= reach + (self.relay if self._attacks(radios) else 0.0)

    def measured(self, radios: Radios, rho: float) -> float | None:
        """Return the range that the attack leaves of `rho`; None if it is jammed."""
        if not self._attacks(radios):
            return rho
        return None if self.jam else max(0.0, rho + self.by)

    def _attacks(self, radios: Radios) -> bool:
        return radios.name == self.link and self.begins <= radios.tick < self.ends


LONGEST_RELAY = 1e5
"""The longest distance in m beyond R of a relay."""

RANGE_MODELS: dict[str, type[RangeModel]] = {
    "attacked": AttackedRange,
    "disc": RangeModel,
    "fading": FadingRange,
    "walls": WalledRange,
}
"""The shipped range models, by name."""
