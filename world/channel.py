"""Which reports reach whom in this tick. Every one in its own tick, as long as the two are in contact."""

from __future__ import annotations


def heard(tick: int) -> tuple[int, ...]:
    """The ticks of the peer's reports that are heard at `tick` by a robot in contact with it, in order.

    A report is heard only if both the tick of sending and the tick of hearing are in contact.
    """
    return (tick,)
