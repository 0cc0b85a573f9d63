"""The faults of the radio: a fault plan, from which the channel draws all losses with the scenario's seed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import msgspec
from msgspec import Meta

from protocol.units import RobotId, Tick

MAX_DELAY = 50
"""The maximum delay in ticks, of all faults on a link together."""
MAX_FAULTS = 8
"""The maximum number of faults on a link. Each may duplicate the copies that the previous ones made."""
LATEST = MAX_DELAY + MAX_FAULTS
"""The maximum delay in ticks, with reordering by each fault. Agents store Reports for longer."""

Chance = Annotated[float, Meta(ge=0.0, le=1.0)]
"""A probability."""
Delay = Annotated[int, Meta(ge=0, le=MAX_DELAY)]
"""A delay, in ticks."""
Window = tuple[Tick, Tick]
"""An interval of ticks, which includes the first and excludes the second."""


class LinkSelector(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The link from one robot to its peer, or the links in both directions."""

    sender: RobotId
    """The robot that sends."""
    receiver: RobotId
    """The robot that receives."""
    both: bool
    """True to select the opposite link, too."""

    def leads(self, sender: str, receiver: str) -> bool:
        """Return whether the link from `sender` to `receiver` is selected."""
        if (self.sender, self.receiver) == (sender, receiver):
            return True
        return self.both and (self.sender, self.receiver) == (receiver, sender)


class Fault(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A fault of the radio. Several faults on a link are applied to each Report, in their order."""

    link: LinkSelector | None = None
    """The affected links; None for all links."""
    loss: Chance = 0.0
    """The probability that a Report is lost."""
    burst_start: Chance = 0.0
    """The probability per tick in contact that a burst of losses begins, in a Gilbert-Elliott chain."""
    burst_end: Chance = 1.0
    """The probability per tick in contact that a burst ends. The mean length of a burst is 1 / burst_end."""
    burst_loss: Chance = 1.0
    """The probability that a Report is lost during a burst."""
    partition: bool = False
    """True to lose all Reports."""
    delay: tuple[Delay, Delay] = (0, 0)
    """The minimum and maximum of the uniformly distributed delay, in ticks, both inclusive."""
    duplicate: Chance = 0.0
    """The probability that a Report is received twice. The two copies have independent delays."""
    reorder: Chance = 0.0
    """The probability that a Report is received one tick later, after the Reports that are sent then."""
    corrupt: Chance = 0.0
    """The probability that a Report arrives damaged, and is refused."""
    reports_per_tick: Annotated[float, Meta(gt=0.0, le=1e3)] | None = None
    """The mean number of Reports that fit in a tick; None for no limit. Reports beyond it are lost."""
    ticks: Window | None = None
    """The ticks in which the fault is active; None for all ticks."""
    contact_ticks: Window | None = None
    """The ticks in contact in which the fault is active, counted from the first contact; None for all."""

    def on(self, sender: str, receiver: str) -> bool:
        """Return whether the fault affects the link from `sender` to `receiver`."""
        return self.link is None or self.link.leads(sender, receiver)

    def active(self, tick: int, contacts: int) -> bool:
        """Return whether the fault is active at `tick`, after `contacts` earlier ticks in contact."""
        return _inside(self.ticks, tick) and _inside(self.contact_ticks, contacts)

    @property
    def bursty(self) -> float:
        """The mean fraction of ticks in contact that are in a burst."""
        return self.burst_start / (self.burst_start + self.burst_end) if self.burst_start else 0.0

    @property
    def let_through(self) -> float:
        """The mean fraction of Reports that are received undamaged while the fault is active."""
        share = (1.0 - self.loss) * (1.0 - self.corrupt) * (1.0 - self.bursty * self.burst_loss)
        return share * min(1.0, self.reports_per_tick or 1.0)


def delivery_time_bound(plan: Sequence[Fault]) -> int:
    """Return the ticks within which a Report that is sent again in every tick is almost certainly received.

    The whole length of a window without any delivery is added. A fault without a window that never delivers
    anything is not counted: no time would be long enough.
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


def exchange_ticks(plan: Sequence[Fault]) -> tuple[int, int]:
    """Return the ticks by which the faults of `plan` delay each meeting of a group, and all of them once.

    The first is the number of extra ticks within which IN_TURN Reports, each sent again in every tick, are
    received with the probability EXCHANGED. The second is the length of the windows without any delivery. All
    faults count for all links; one that never delivers anything does not count.
    """
    through, each, once = 1.0, 0, 0
    for fault in plan:
        each += IN_TURN * (fault.delay[1] + (fault.reorder > 0.0))
        if fault.partition or not fault.let_through:
            once += fault.ticks[1] - fault.ticks[0] if fault.ticks is not None else 0
            each += fault.contact_ticks[1] - fault.contact_ticks[0] if fault.contact_ticks is not None else 0
        else:
            through *= min(fault.let_through, fault.burst_end if fault.burst_start else 1.0)
    return each + _trials(IN_TURN, through) - IN_TURN, once


IN_TURN = 4
"""The number of Reports that two robots of a group need from each other in their turn.

They are the log up to the encounter, the log up to the last manoeuvre, and the verdicts. The fourth allows
for the slower one of two directions, and for one more manoeuvre.
"""

EXCHANGED = 0.99
"""The probability with which a meeting is over in the time that is planned for its Reports."""


def _trials(successes: int, chance: float) -> int:
    """Return the number of trials that contain so many successes with the probability EXCHANGED."""
    if chance >= 1.0:
        return successes
    least, most = successes - 1, successes
    while _fewer(successes, most, chance) > 1.0 - EXCHANGED:
        least, most = most, 2 * most
    while most - least > 1:
        middle = (least + most) // 2
        if _fewer(successes, middle, chance) > 1.0 - EXCHANGED:
            least = middle
        else:
            most = middle
    return most


def _fewer(successes: int, trials: int, chance: float) -> float:
    """Return the probability of fewer `successes` in so many `trials` (binomial distribution)."""
    return sum([math.comb(trials, k) * chance**k * (1.0 - chance) ** (trials - k) for k in range(successes)])


UNLUCKY = 20.0
"""The factor between the mean waiting time and the bound. A longer wait has the probability e^-20."""


def _inside(window: Window | None, tick: int) -> bool:
    return window is None or window[0] <= tick < window[1]
