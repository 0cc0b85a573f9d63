"""What became of each report that was sent."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import msgspec

from compose.view.scene import Scene
from world.faults import LATEST

Fate = Literal["heard", "late", "damaged", "lost", "under way"]
"""`late` is heard in a later tick than it was sent in; `lost` never came, `under way` may come yet"""


class Flight(msgspec.Struct, frozen=True):
    """One report, from the tick in which it was sent on."""

    sender: str
    receiver: str
    tick: int
    fate: Fate
    """that of its first copy that was heard; if none was, of the first that came"""
    heard: tuple[int, ...]
    """the ticks in which it was; two where it came twice"""
    damaged: tuple[int, ...]
    """the ticks in which it came damaged"""


def fates(scenes: Iterable[Scene], over: bool) -> tuple[Flight, ...]:
    """Of all reports that were sent in `scenes`, in their order; `over` is whether nothing more will come."""
    sent: dict[tuple[str, str, int], tuple[list[int], list[int]]] = {}
    last = 0
    for one in scenes:
        last = one.tick
        for passage in one.passages:
            heard, damaged = sent.setdefault((passage.sender, passage.receiver, passage.tick), ([], []))
            if passage.what == "heard":
                heard.append(one.tick)
            elif passage.what == "damaged":
                damaged.append(one.tick)
    flights = []
    for (sender, receiver, tick), (heard, damaged) in sent.items():
        fate: Fate = "lost" if over or last - tick >= LATEST else "under way"
        if heard:
            fate = "heard" if heard[0] == tick else "late"
        elif damaged:
            fate = "damaged"
        flights.append(Flight(sender, receiver, tick, fate, tuple(heard), tuple(damaged)))
    return tuple(flights)
