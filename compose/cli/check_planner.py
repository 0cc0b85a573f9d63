"""`tandem check-planner`: check a planner of the user against its contract, docs/own-planner.md."""

from __future__ import annotations

import argparse

from compose.launch import supervisor
from compose.scenario.scenario_file import setting
from compose.terminal.finding import tell_all


def main(options: argparse.Namespace) -> int:
    """Run all checks, print the result of each, and return VIOLATED if one failed."""
    supervisor.fork_server()  # it imports modules while this process does
    from compose.audit.planner_checks import QuietInbox, check_planner  # noqa: PLC0415  # it imports numpy

    scenario = setting(options.mission, options.fault, options.planner, options.planner_option).seeded(
        options.seed
    )
    return tell_all(check_planner(scenario, QuietInbox("tandem check-planner")))
