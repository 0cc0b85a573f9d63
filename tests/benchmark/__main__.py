"""The command: run all measurements, and print a table for each part."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from statistics import median

from rich.console import Console
from rich.table import Table

from tests.benchmark import in_process, over_zenoh, whole_commands

Part = Callable[[int], Mapping[str, float]]
"""A function from the number of a round to what it measured, by the text of its row with its unit."""
PARTS: dict[str, Part] = {
    "Ticks/s as processes, two robots": over_zenoh.ticks_per_second,
    "In one process, one core": in_process.exact_missions,
    "In one process, one core, through the Python API": in_process.missions_by_api,
    "In one process, one core, ranges of sigma 0.1 m": in_process.noisy_missions,
    "In one process, one core, groups": in_process.groups,
    "Wall time of a whole command": whole_commands.start_of_a_command,
    "Wall time of a whole command, 200 robots": whole_commands.many_robots,
}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmark")
    parser.add_argument("--rounds", type=int, default=5, help="repetitions of each measurement")
    rounds = parser.parse_args().rounds
    for title, part in PARTS.items():
        Console().print(table(title, part, rounds))


def table(title: str, part: Part, rounds: int) -> Table:
    """Return the median, the least and the greatest value of each row of `part`."""
    shown = Table("", "median", "from", "to", title=title, title_justify="left")
    measured = [part(number) for number in range(rounds)]
    for row in measured[0]:
        values = [values[row] for values in measured]
        shown.add_row(row, *[f"{value:.4g}" for value in (median(values), min(values), max(values))])
    return shown


if __name__ == "__main__":
    main()
