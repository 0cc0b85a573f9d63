"""`tandem arena`: planners compared on the same missions."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

from compose.cli.sweep import status_of
from compose.errors import FAILED, STOPPED_STATUS
from compose.extras import need
from compose.launch.signals import stop_by_signal
from compose.recording.recording_files import folder_for
from compose.scenario.scenario_file import scenario_table
from compose.sweep.spec import Sweep
from compose.terminal.text_width import tell
from protocol.network.inbox import Inbox
from protocol.output import say


def main(options: argparse.Namespace) -> int:
    """Run the missions that have no result yet, print the table, and write it with the figure."""
    need("distributed", "matplotlib", "pyarrow", "tomli_w")
    from compose.sweep import arena, execution, report  # noqa: PLC0415  # slow to import, and optional

    chosen = {"workers": options.workers} if options.workers is not None else {}
    means = execution.ExecutionOptions(audit=False, **chosen)
    inbox, visible = Inbox("tandem arena"), sys.stdout.isatty() and not options.quiet

    def play(sweep: Sweep, folder: Path) -> execution.Results:
        with report.progress(sweep.source, inbox.say, visible) as progress:
            return execution.sweep(sweep, folder, means, inbox, progress, partial(stop_by_signal, inbox))

    scenarios = [(one, scenario_table(one)) for one in options.scenario or ["noisy"]]
    sweeps = arena.sweeps(options.planners, scenarios, options.trials, options.seed)
    with folder_for(options.out) as out:
        rows, results = arena.run(sweeps, out, play)
    if results[-1].stopped is not None:
        how = "the same command resumes" if options.out is not None else "with --out, it could be resumed"
        inbox.say(f"{results[-1].stopped}: {how}")
        return STOPPED_STATUS if results[-1].interrupted else FAILED
    say(*arena.lines(rows))
    if not options.quiet:
        say("")
        tell(*arena.reasons(results), arena.NOTE)
        if options.out is not None:
            say("", f"results: {options.out}")
    return max(map(status_of, results))
