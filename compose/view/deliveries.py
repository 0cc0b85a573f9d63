"""Deliveries of reports in one tick: sent, received, damaged or lost."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import msgspec

from compose.recording.run_setup import RunSetup
from compose.view.run_data import Link, TickData
from protocol.messages import Contact

Passing = Literal["sent", "heard", "damaged", "lost"]


class Passage(msgspec.Struct, frozen=True):
    """One event of a report's delivery in one tick. Reports in flight have none."""

    sender: str
    receiver: str
    tick: int
    """The tick in which the report was sent."""
    what: Passing
    """The kind of event. "lost" is known only from the world's journal."""


def passages(setup: RunSetup, before: TickData | None, now: TickData) -> Iterator[Passage]:
    """Yield the deliveries on every link in the tick of `now`, in the order of the senders.

    Each link yields the report sent, then those received, damaged and lost.
    """
    for link in _links(setup, before, now):
        sender, receiver = link
        sent = link in now.reports or contact_of(now, sender, receiver) is not None
        if sent:
            yield Passage(*link, now.tick, "sent")
        contact = contact_of(now, receiver, sender)
        received, damaged = (contact.heard or (), contact.damaged) if contact is not None else ((), ())
        yield from [Passage(*link, tick, "heard") for tick in received]
        yield from [Passage(*link, tick, "damaged") for tick in damaged]
        if link in now.under_way and (before is None or link in before.under_way):
            earlier = before.under_way[link] if before is not None else ()
            accounted = {*received, *damaged, *now.under_way[link]}
            for tick in sorted({*earlier, *((now.tick,) if sent else ())} - accounted):
                yield Passage(*link, tick, "lost")


def _links(setup: RunSetup, before: TickData | None, now: TickData) -> list[Link]:
    """Return the links with a delivery in the tick of `now`, in the order of the senders.

    For pairs, these are all links.
    """
    if not setup.visits:
        return [(robot.id, robot.peer) for robot in setup.robots]
    found = {*now.reports}
    for robot, observation in now.observations.items():
        for contact in observation.contacts:
            found |= {(robot, contact.peer), (contact.peer, robot)}
    for data in (before, now):
        found.update([link for link, ticks in data.under_way.items() if ticks] if data is not None else [])
    place = {robot: i for i, robot in enumerate(setup.ids)}
    return sorted(
        [link for link in found if place.keys() >= {*link}], key=lambda link: (place[link[0]], place[link[1]])
    )


def contact_of(now: TickData, robot: str, peer: str) -> Contact | None:
    """Return the contact with `peer` in `robot`'s observation; None if there is none or it is unknown."""
    observation = now.observations.get(robot)
    return (
        next((one for one in observation.contacts if one.peer == peer), None)
        if observation is not None
        else None
    )
