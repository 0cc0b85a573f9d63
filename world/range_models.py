"""The shipped range models."""

from __future__ import annotations

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


RANGE_MODELS: dict[str, type[RangeModel]] = {
    "disc": RangeModel,
    "fading": FadingRange,
    "walls": WalledRange,
}
"""The shipped range models, by name."""
