"""The shipped radio models."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from world.range_models import crosses, walls_of
from world.world_models import RadioModel, Transmission


class FadingRadio(RadioModel[None]):
    """Loss that grows with distance: `near` at 0 m, `far` at R."""

    def __init__(self, near: float = 0.0, far: float = 1.0, exponent: float = 2.0) -> None:
        """`near` and `far` are probabilities, and the loss grows with the power `exponent` of distance."""
        if not (0.0 <= near <= 1.0 and 0.0 <= far <= 1.0 and exponent > 0.0):
            raise ValueError("near and far are probabilities, and exponent is positive")
        self.near, self.far, self.exponent = near, far, exponent

    def sent(self, state: None, transmission: Transmission) -> tuple[None, int | None]:
        """Return the delay: 0, or None for a lost report."""
        radios = transmission.radios
        share = min(1.0, radios.distance / transmission.reach)
        loss = self.near + (self.far - self.near) * share**self.exponent
        return state, 0 if radios.uniform("loss") >= loss else None


class LogDistanceRadio(RadioModel[None]):
    """Log-distance path loss with shadowing (Rappaport, Wireless Communications, section 4.9.2).

    The margin of the received power at distance d is -10 n log10(d / (half R)) dB, plus a Gaussian shadowing
    that is constant on each link, plus a Gaussian fading in each tick. A report is received if the margin is
    positive, so half of the reports are received at `half` R.
    """

    def __init__(
        self, exponent: float = 3.0, half: float = 0.8, shadowing_db: float = 4.0, fading_db: float = 3.0
    ) -> None:
        """`exponent` is n; `half` is a fraction of R; the others are standard deviations in dB."""
        if not (exponent > 0.0 and half > 0.0 and shadowing_db >= 0.0 and fading_db >= 0.0):
            raise ValueError("exponent and half are positive, and the sigmas are not negative")
        self.exponent, self.half = exponent, half
        self.shadowing_db, self.fading_db = shadowing_db, fading_db

    def sent(self, state: None, transmission: Transmission) -> tuple[None, int | None]:
        """Return the delay: 0, or None for a lost report."""
        radios = transmission.radios
        share = max(radios.distance, 1e-9) / (self.half * transmission.reach)
        margin = -10.0 * self.exponent * math.log10(share)
        margin += self.shadowing_db * radios.fixed_gaussian("shadowing")
        margin += self.fading_db * radios.gaussian("fading")
        return state, 0 if margin > 0.0 else None


class WalledRadio(RadioModel[None]):
    """Walls through which no report is received."""

    def __init__(self, segments: Sequence[Sequence[float]] = ()) -> None:
        """`segments` are [x1, y1, x2, y2] in m."""
        self.segments = walls_of(segments)

    def sent(self, state: None, transmission: Transmission) -> tuple[None, int | None]:
        """Return the delay: 0, or None through a wall."""
        one, other = transmission.radios.one, transmission.radios.other
        blocked = any(crosses(one, other, wall) for wall in self.segments)
        return state, None if blocked else 0


class ByteRateRadio(RadioModel[float]):
    """A link with a limited byte rate: reports queue, and are late.

    The state is the time in s at which the link is free.
    """

    def __init__(
        self, bytes_per_s: float = 200.0, report_bytes: float = 300.0, longest_queue: int = 8
    ) -> None:
        """Each report takes `report_bytes`; one that would be later than `longest_queue` ticks is lost."""
        if not (bytes_per_s > 0.0 and report_bytes > 0.0 and 0 <= longest_queue <= MAX_QUEUE):
            raise ValueError(f"the sizes are positive, and longest_queue is from 0 to {MAX_QUEUE}")
        self.bytes_per_s, self.report_bytes, self.longest_queue = bytes_per_s, report_bytes, longest_queue

    def start(self) -> float:
        """Return the time 0: the link is free."""
        return 0.0

    def sent(self, state: float | None, transmission: Transmission) -> tuple[float | None, int | None]:
        """Return when the link is free again, and the delay in ticks."""
        now = transmission.radios.tick * transmission.period
        free = max(state or 0.0, now) + self.report_bytes / self.bytes_per_s
        delay = int((free - now) / transmission.period)
        return (state, None) if delay > self.longest_queue else (free, delay)


MAX_QUEUE = 50
"""The largest `longest_queue` in ticks."""


class CollidingRadio(RadioModel[None]):
    """Slotted ALOHA: each sender takes one of `slots` per tick, and two in the same slot destroy each other.

    Only senders within `interference` R of the receiver count.
    """

    def __init__(self, slots: int = 4, interference: float = 2.0) -> None:
        """`slots` is the number of slots of a tick; `interference` is a multiple of R."""
        if not (slots >= 1 and interference > 0.0):
            raise ValueError("slots and interference are positive")
        self.slots, self.interference = slots, interference

    def sent(self, state: None, transmission: Transmission) -> tuple[None, int | None]:
        """Return the delay: 0, or None after a collision."""
        radios, reach = transmission.radios, self.interference * transmission.reach
        own = self._slot(transmission, transmission.sender)
        for robot, place in transmission.senders:
            near = math.dist(place, radios.other) <= reach
            if robot != transmission.sender and near and self._slot(transmission, robot) == own:
                return state, None
        return state, 0

    def _slot(self, transmission: Transmission, robot: str) -> int:
        """Return the slot of a robot, which all links of the tick agree on."""
        return int(transmission.radios._replace(name=robot).uniform("slot") * self.slots)


RADIO_MODELS: dict[str, type[RadioModel[Any]]] = {
    "disc": RadioModel,
    "fading": FadingRadio,
    "log-distance": LogDistanceRadio,
    "walls": WalledRadio,
    "byte-rate": ByteRateRadio,
    "collisions": CollidingRadio,
}
"""The shipped radio models, by name."""
