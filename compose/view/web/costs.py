"""The costs of the faults, attacks and kills of a mission, found by running it without them.

Runs are deterministic, and each draw has a random stream of its own, so nothing else differs.
"""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from msgspec.structs import replace

from compose.errors import UserError
from compose.view.run_data import RunData
from compose.view.web.requested_work import RequestedWork
from protocol.messages import MissionEnd
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from world.scenario import Scenario

MOST_CPU_S = 4
"""The CPU time in s of one mission. What costs more to compute, as with many robots, is left out."""
MOST_WALL_S = 60.0
"""The wall time in s that it may take on a busy machine."""
EFFECTS: dict[str, dict[str, Any]] = {
    "lost reports": {"loss": 0.0, "burst_start": 0.0, "reports_per_tick": None},
    "the partition": {"partition": False},
    "late reports": {"delay": (0, 0), "reorder": 0.0},
    "damaged reports": {"corrupt": 0.0},
    "duplicated reports": {"duplicate": 0.0},
}
"""The fields of a fault without each of its effects."""


def missions_without(scenario: Scenario, known: RunData) -> Iterator[tuple[str, Scenario]]:
    """Yield what a mission has suffered from, with the scenario without it."""
    honest = tuple([replace(robot, attack=None) for robot in scenario.robots])
    if honest != scenario.robots:
        yield "the false data", replace(scenario, robots=honest)
    for what, fields in EFFECTS.items():
        faults = tuple([replace(fault, **fields) for fault in scenario.faults])
        if faults != scenario.faults:
            yield what, replace(scenario, faults=faults)
    if any(data.down for data in known.ticks.values()):
        yield "the kills", scenario
    elif any(data.late for data in known.ticks.values()):
        yield "missed deadlines", scenario


def costs(scenario: Scenario, known: RunData, work: RequestedWork) -> list[str]:
    """Return a sentence on each thing that the mission has suffered from, unless that takes too long."""
    found: list[str] = []
    if (end := known.end) is None:
        return found
    for what, other in missions_without(scenario, known):
        with suppress(UserError):  # it takes too long, or its planner may not be loaded here
            outcome, ticks = work.result(ended, encode(other), within=MOST_WALL_S, late="late")
            found.append(_sentence(what, outcome, ticks, end))
    return found


def _sentence(what: str, outcome: str, ticks: int, end: MissionEnd) -> str:
    if outcome != end.outcome:
        return f"Without {what}, the mission ends {outcome} after {ticks} ticks."
    change = ", too" if ticks == end.tick else f", now {end.tick}"
    return f"Without {what}, it takes {ticks} ticks{change}."


def ended(frame: bytes) -> tuple[str, int]:
    """Run a scenario, and return its outcome and its last tick. The process ends after MOST_CPU_S."""
    from compose.launch.in_process import run_mission  # noqa: PLC0415  # imports numpy

    resource.setrlimit(resource.RLIMIT_CPU, (MOST_CPU_S, MOST_CPU_S))
    end = run_mission(decode(frame, Scenario, MAX_FRAME_BYTES)).end
    assert end is not None
    return end.outcome, end.tick
