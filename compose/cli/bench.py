"""`tandem bench`: measure speed, and compare each figure with a baseline measured in the same run.

Absolute times depend on the machine and its load; ratios depend on them much less. All measurements are
interleaved (A B A B), and their medians are compared.
"""

from __future__ import annotations

import argparse

from rich.console import Console

from compose.cli.arguments import add_closing, count
from compose.cli.benchmark.api_missions import missions_by_api
from compose.cli.benchmark.exact_missions import missions_per_second
from compose.cli.benchmark.group_missions import missions_of_groups
from compose.cli.benchmark.noisy_missions import noisy_missions
from compose.cli.benchmark.over_zenoh import ticks_per_second
from compose.cli.benchmark.whole_commands import many_robots, start_of_a_command
from compose.errors import LOCALISED
from compose.extras import need
from compose.terminal.outcome import counting


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `tandem bench`."""
    parser.add_argument(
        "--rounds",
        type=count,
        default=5,
        metavar="N",
        help="repetitions of each measurement, 1 to 1000 [default: %(default)s]",
    )
    add_closing(parser, "tandem bench --rounds 10", "README.md")


def main(options: argparse.Namespace) -> int:
    """Run all measurements, and print one table for each group."""
    need("cryptography", extra="deploy")
    rounds = options.rounds
    parts = (
        ticks_per_second,
        missions_per_second,
        missions_by_api,
        noisy_missions,
        missions_of_groups,
        start_of_a_command,
        many_robots,
    )
    with counting("tandem bench", len(parts) * rounds) as done:
        tables = [part(rounds, done) for part in parts]
    for table in tables:
        Console().print(table)
    return LOCALISED
