"""`tandem check-planner`: check a planner of the user against its contract, docs/own-planner.md."""

from __future__ import annotations

import argparse

from compose.cli.arguments import SEED_HELP, add_closing, natural, planner_option
from compose.errors import CLEAN, VIOLATED
from compose.launch import supervisor
from compose.scenario.scenario_file import setting
from compose.terminal import text_width
from protocol.output import one_line, say


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `tandem check-planner`."""
    parser.add_argument("planner", metavar="MODULE:CLASS", help="planner of your own, or an installed one")
    parser.add_argument(
        "--planner-option",
        type=planner_option,
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="option of the planner; may be repeated",
    )
    parser.add_argument(
        "--mission",
        default="random",
        metavar="FILE",
        help="scenario in which it is tried: a name or a TOML file [default: %(default)s]",
    )
    parser.add_argument("--seed", type=natural, metavar="N", help=f"{SEED_HELP} [default: the scenario's]")
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="FAULT",
        help="fault of the radio, such as 'a->b: loss=0.3, delay=0..3'; may be repeated",
    )
    add_closing(parser, "tandem check-planner mine:Greedy --mission noisy", "docs/own-planner.md")


def main(options: argparse.Namespace) -> int:
    """Run all checks, print the result of each, and return VIOLATED if one failed."""
    supervisor.fork_server()  # it imports modules while this process does
    from compose.audit.planner_checks import QuietInbox, check_planner  # noqa: PLC0415  # it imports numpy

    scenario = setting(options.mission, options.fault, options.planner, options.planner_option).seeded(
        options.seed
    )
    failed = False
    for one in check_planner(scenario, QuietInbox("tandem check-planner")):
        line = f"wrong  {one.what}: {one.wrong}" if one.wrong else f"ok     {one.what}"
        say(*text_width.wrapped(one_line(line), text_width.MARKED))
        failed |= one.wrong is not None
    return VIOLATED if failed else CLEAN
