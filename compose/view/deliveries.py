"""What becomes of reports on their way, in one tick."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import msgspec

from compose.view.cast import Stage
from compose.view.facts import Facts
from protocol.messages import Contact

Passing = Literal["sent", "heard", "damaged", "lost"]


class Passage(msgspec.Struct, frozen=True):
    """What becomes of a report in this tick; a report that is under way is nowhere."""

    sender: str
    receiver: str
    tick: int
    """in which it was sent"""
    what: Passing
    """`lost` is told by the world's journal only"""


def passages(stage: Stage, before: Facts | None, now: Facts) -> Iterator[Passage]:
    """Of every link, in the order of its sender: what is sent, what comes, and what is lost."""
    for seat in stage.robots:
        link = seat.id, seat.peer
        sent = seat.id in now.reports or contact_of(now, seat.id, seat.peer) is not None
        if sent:
            yield Passage(*link, now.tick, "sent")
        contact = contact_of(now, seat.peer, seat.id)
        heard, damaged = (contact.heard or (), contact.damaged) if contact is not None else ((), ())
        yield from [Passage(*link, tick, "heard") for tick in heard]
        yield from [Passage(*link, tick, "damaged") for tick in damaged]
        if link in now.under_way and (before is None or link in before.under_way):
            earlier = before.under_way[link] if before is not None else ()
            left = {*heard, *damaged, *now.under_way[link]}
            for tick in sorted({*earlier, *((now.tick,) if sent else ())} - left):
                yield Passage(*link, tick, "lost")


def contact_of(now: Facts, robot: str, peer: str) -> Contact | None:
    """With `peer`, of `robot`, if they are in range and that is known."""
    observation = now.observations.get(robot)
    return (
        next((one for one in observation.contacts if one.peer == peer), None)
        if observation is not None
        else None
    )
