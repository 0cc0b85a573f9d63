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
    """The kind of event."""


def passages(setup: RunSetup, now: TickData) -> Iterator[Passage]:
    """Yield the deliveries on every link in the tick of `now`, in the order of the senders.

    Each link yields the report sent, then those received, damaged and lost.
    """
    for link in _links(setup, now):
        sender, receiver = link
        if link in now.reports or contact_of(now, sender, receiver) is not None:
            yield Passage(*link, now.tick, "sent")
        contact = contact_of(now, receiver, sender)
        received, damaged = (contact.heard or (), contact.damaged) if contact is not None else ((), ())
        yield from [Passage(*link, tick, "heard") for tick in received]
        yield from [Passage(*link, tick, "damaged") for tick in damaged]
        lost = now.observations[receiver].lost if receiver in now.observations else ()
        yield from [Passage(*link, one.tick, "lost") for one in lost if one.sender == sender]


def _links(setup: RunSetup, now: TickData) -> list[Link]:
    """Return the links with a delivery in the tick of `now`, in the order of the senders."""
    found = {*now.reports}
    for robot, observation in now.observations.items():
        found |= {(one.sender, robot) for one in observation.lost}
        for contact in observation.contacts:
            found |= {(robot, contact.peer), (contact.peer, robot)}
    place = {robot: i for i, robot in enumerate(setup.ids)}
    return sorted(
        [link for link in found if place.keys() >= {*link}], key=lambda link: (place[link[0]], place[link[1]])
    )


def contact_of(now: TickData, robot: str, peer: str | None) -> Contact | None:
    """Return the contact with `peer` in `robot`'s observation; None if there is none or it is unknown."""
    observation = now.observations.get(robot)
    return (
        next((one for one in observation.contacts if one.peer == peer), None)
        if observation is not None
        else None
    )
