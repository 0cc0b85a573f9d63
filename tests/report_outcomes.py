"""The delivery outcome of each report that was sent."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import msgspec

from compose.view.scene import Scene
from world.faults import LATEST

ReportOutcome = Literal["heard", "late", "damaged", "lost", "under way"]
"""The outcome of a report.

"heard" means received in the tick in which it was sent, "late" received in a later tick, "lost" never
received, and "under way" not received yet.
"""


class Flight(msgspec.Struct, frozen=True):
    """One report and its deliveries."""

    sender: str
    receiver: str
    tick: int
    """The tick in which the report was sent."""
    outcome: ReportOutcome
    """The outcome of its first copy received intact, or, if there is none, of its first copy."""
    heard: tuple[int, ...]
    """The ticks in which a copy was received intact."""
    damaged: tuple[int, ...]
    """The ticks in which a damaged copy was received."""


def flights_of(scenes: Iterable[Scene], over: bool) -> tuple[Flight, ...]:
    """Return the outcomes of all reports in `scenes`, in the order in which they were sent.

    `over` is true if the run is complete, so that no report is under way.
    """
    sent: dict[tuple[str, str, int], tuple[list[int], list[int]]] = {}
    last = 0
    for one in scenes:
        last = one.tick
        for passage in one.passages:
            received, damaged = sent.setdefault((passage.sender, passage.receiver, passage.tick), ([], []))
            if passage.what == "heard":
                received.append(one.tick)
            elif passage.what == "damaged":
                damaged.append(one.tick)
    flights = []
    for (sender, receiver, tick), (received, damaged) in sent.items():
        outcome: ReportOutcome = "lost" if over or last - tick >= LATEST else "under way"
        if received:
            outcome = "heard" if received[0] == tick else "late"
        elif damaged:
            outcome = "damaged"
        flights.append(Flight(sender, receiver, tick, outcome, tuple(received), tuple(damaged)))
    return tuple(flights)
