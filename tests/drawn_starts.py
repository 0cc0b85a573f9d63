"""The share of drawn starts that are admitted: `uv run python -m tests.drawn_starts [ROOMS]` prints it.

A start that is not admitted is drawn again. In a room, a robot is admitted in range of an anchor whose
position it knows; it needs a second one, which it may have to find. Without anchors, a robot after the first
is admitted in range of one before it. Each cell is over ROOMS squares of 10 m, 200 by default.
"""

from __future__ import annotations

import sys
from unittest import mock

from compose.scenario import team_plan
from compose.scenario.scenario_file import parse
from tests.plans import table

RANGES = (3.0, 5.0, 8.0, 12.0, 15.0)


def share(robots: int, reach: float, rooms: int, *, anchors: int) -> str:
    """Return the share of the drawn starts that are admitted, and the most draws in a room."""
    within, counts = team_plan._within, []  # each draw of a start calls it once
    for seed in range(1, rooms + 1):
        frame = "" if anchors else 'frame = "relative"'
        drawn = f"anchors = {anchors}" if anchors else ""
        text = f"""
            name = "rooms"
            seed = {seed}
            [mission]
            sensing_range = {reach}
            period = 1.0
            max_speed = 0.5
            max_turn_rate = 1.0
            {frame}
            [team]
            robots = {robots}
            side = 10.0
            {drawn}
            """
        with mock.patch.object(team_plan, "_within", side_effect=within) as draws:
            parse(text, "rooms")
        counts.append(draws.call_count - (not anchors))
    return f"{100 * (robots - (not anchors)) * rooms / sum(counts):.0f} % ({max(counts)})"


def main(rooms: int) -> None:
    """Print both tables."""
    head = [f"R {reach:g} m" for reach in RANGES]
    rows = [[str(count), *[share(1, reach, rooms, anchors=count) for reach in RANGES]] for count in (3, 5, 8)]
    print(table(["anchors", *head], rows), end="\n\n")
    sizes = (2, 3, 4, 8)
    rows = [[str(count), *[share(count, reach, rooms, anchors=0) for reach in RANGES]] for count in sizes]
    print(table(["robots, no anchor", *head], rows))


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 200)
