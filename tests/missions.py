"""Missions in this process."""

from __future__ import annotations

import math

from compose.launch import in_process
from compose.launch.in_process import run_mission
from compose.recording.run import Run
from compose.scenario.scenario_file import parse
from protocol.journal.journal_file import MemoryJournal
from world.scenario import Scenario
from world.sensors import anchor_ranges
from world.truth import Truth


def mission_of(
    start: tuple[float, float, float],
    *,
    planner_name: str = "assured",
    reach: float = 3.0,
    speed: float = 1.0,
    turn_rate: float = math.pi,
) -> Run:
    """Run a mission in which a starts so, with its anchor at the origin, and b half a metre from its own."""
    text = f"""
        name = "mission"
        planner = {{name = "{planner_name}"}}
        [mission]
        sensing_range = {reach}
        period = 1.0
        max_speed = {speed}
        max_turn_rate = {turn_rate!r}
        [[robot]]
        id = "a"
        anchor = [0.0, 0.0]
        start = {list(start)}
        [[robot]]
        id = "b"
        anchor = [10.0, 0.0]
        start = [10.4, 0.3, 3.6]
        """
    return run_mission(parse(text, "mission"))


def own_ranges(truth: Truth, scenario: Scenario) -> list[float | None]:
    """Return the measured range of each robot to its own anchor in m; None if it has none."""
    return [ranges[0].range if ranges else None for ranges in anchor_ranges(truth, scenario)]


def kept(scenario: Scenario) -> dict[str, list[bytes]]:
    """Return the journals of a run in this process."""
    books = {name: MemoryJournal() for name in in_process.journals(scenario)}
    in_process.played(scenario, books)
    return {name: book.frames for name, book in books.items()}


def outcome(run: Run) -> str:
    """Return the outcome of a run that has ended."""
    assert run.end is not None
    return run.end.outcome
