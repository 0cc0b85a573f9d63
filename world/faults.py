"""What may befall the reports on their way: a fault plan, of which every accident follows from the seed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import msgspec
from msgspec import Meta

from protocol.units import RobotId, Tick

MAX_DELAY = 50
"""ticks, of all the faults on a link together"""
MAX_FAULTS = 8
"""on a link: each may double what those before it have doubled"""
LATEST = MAX_DELAY + MAX_FAULTS
"""ticks after which no report is heard, each fault having reordered it, too; agents keep it longer"""

Chance = Annotated[float, Meta(ge=0.0, le=1.0)]
Delay = Annotated[int, Meta(ge=0, le=MAX_DELAY)]
Window = tuple[Tick, Tick]
"""ticks, the first inside and the last outside"""


class LinkSelector(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """From one robot to its peer, or both ways."""

    sender: RobotId
    receiver: RobotId
    both: bool

    def leads(self, sender: str, receiver: str) -> bool:
        """Whether a report from `sender` to `receiver` takes it."""
        if (self.sender, self.receiver) == (sender, receiver):
            return True
        return self.both and (self.sender, self.receiver) == (receiver, sender)


class Fault(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """What may befall a report on a link; several faults befall it one after the other."""

    link: LinkSelector | None = None
    """all of them, where there is none"""
    loss: Chance = 0.0
    """the probability that it is lost"""
    burst_start: Chance = 0.0
    """per tick in contact, the probability that a burst begins (Gilbert and Elliott's chain)"""
    burst_end: Chance = 1.0
    """and that it ends: the mean length of a burst is 1 / burst_end"""
    burst_loss: Chance = 1.0
    """the probability that a report is lost in a burst"""
    partition: bool = False
    """all are lost"""
    delay: tuple[Delay, Delay] = (0, 0)
    """ticks until it is heard, uniform between these, both included"""
    duplicate: Chance = 0.0
    """the probability that it comes twice, each with a delay of its own"""
    reorder: Chance = 0.0
    """the probability that it comes a tick later still, after what was sent then"""
    corrupt: Chance = 0.0
    """the probability that it comes damaged, and is refused"""
    reports_per_tick: Annotated[float, Meta(gt=0.0, le=1e3)] | None = None
    """how many may come in a tick, in the mean; what is more is lost"""
    ticks: Window | None = None
    """when the fault is there; always, where neither window is given"""
    contact_ticks: Window | None = None
    """likewise, counted in ticks in which the two have been in contact"""

    def on(self, sender: str, receiver: str) -> bool:
        """Whether it is on the way from `sender` to `receiver`."""
        return self.link is None or self.link.leads(sender, receiver)

    def active(self, tick: int, contacts: int) -> bool:
        """Whether it is there in `tick`, before which the two have been in contact in `contacts` ticks."""
        return _inside(self.ticks, tick) and _inside(self.contact_ticks, contacts)

    @property
    def bursty(self) -> float:
        """The share of ticks in contact that are in a burst."""
        return self.burst_start / (self.burst_start + self.burst_end) if self.burst_start else 0.0

    @property
    def let_through(self) -> float:
        """The share of reports that it lets through where it is always there."""
        share = (1.0 - self.loss) * (1.0 - self.corrupt) * (1.0 - self.bursty * self.burst_loss)
        return share * min(1.0, self.reports_per_tick or 1.0)


def delivery_time_bound(plan: Sequence[Fault]) -> int:
    """Ticks within which a report gets through that is told again every tick; hardly ever it takes more.

    Windows of no contact are counted whole; what never lets anything through is not waited for.
    """
    through, burst, ticks = 1.0, 1.0, 0
    for fault in plan:
        window = fault.ticks or fault.contact_ticks
        ticks += fault.delay[1] + (fault.reorder > 0.0)
        if window is not None and (fault.partition or not fault.let_through):
            ticks += window[1] - window[0]
        elif not fault.partition and fault.let_through:
            through *= fault.let_through
            burst = max(burst, 1.0 / fault.burst_end if fault.burst_start else 1.0)
    return ticks + math.ceil(UNLUCKY * max(burst, 1.0 / through))


UNLUCKY = 20.0
"""times its mean: a wait so long has the probability e^-20"""


def _inside(window: Window | None, tick: int) -> bool:
    return window is None or window[0] <= tick < window[1]
