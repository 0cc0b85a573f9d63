"""`tandem sweep`: run a sweep, on this machine or on the workers of a Dask scheduler."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from compose.errors import FAILED, LOCALISED, NOT_LOCALISED, STOPPED_STATUS, UserError
from compose.extras import need
from compose.launch.signals import INTERRUPTION, stop_by_signal
from compose.sweep import spec
from compose.sweep.cells import cell_at, trial_table
from compose.sweep.spec import Sweep
from protocol.network.inbox import Inbox
from protocol.output import say

if TYPE_CHECKING:
    from compose.sweep.execution import Results


def main(options: argparse.Namespace) -> int:
    """Run the trials that have no result yet, and write tables and figures."""
    sweep = spec.load(options.spec, trials=options.trials, seed=options.seed)
    need("distributed", "matplotlib", "pyarrow", "tomli_w")
    if options.print_trial is not None:
        if options.trials is not None and options.print_trial[1] >= options.trials:
            raise UserError(
                f"--print-trial: with --trials {options.trials}, trials are 0 to {options.trials - 1}"
            )
        return print_trial(sweep, *options.print_trial)
    from compose.sweep import axis_figures, execution, report  # noqa: PLC0415  # slow to import, and optional

    out = options.out if options.out is not None else Path(f"sweep-{sweep.name}")
    chosen = {"workers": options.workers} if options.workers is not None else {}
    means = execution.ExecutionOptions(
        scheduler=options.scheduler,
        processes=options.processes,
        audit=options.audit,
        retry=options.retry,
        **chosen,
    )
    inbox = Inbox("tandem sweep")
    visible = sys.stdout.isatty() and not options.quiet
    with report.progress(sweep.name, inbox.say, visible) as progress:
        results = execution.sweep(sweep, out, means, inbox, progress, partial(stop_by_signal, inbox))
    if results.stopped is not None:
        inbox.say(
            f"{results.stopped}: {len(results.table)} of {results.trials} trials are done; "
            "the same command resumes the sweep"
        )
        if len(results.table) == results.trials:
            report.show(results, out, quiet=True)
        return STOPPED_STATUS if results.interrupted else FAILED
    INTERRUPTION.begin("tandem sweep")
    try:
        axis_figures.draw(results, out / "figures")
    finally:
        report.show(results, out, quiet=options.quiet)
    return status_of(results)


def print_trial(sweep: Sweep, cell: int, trial: int) -> int:
    """Print the scenario file of a trial. Raises UserError if there is no such cell."""
    import tomli_w  # noqa: PLC0415  # the library is optional

    found = cell_at(sweep, cell)
    if found is None:
        raise UserError(f"--print-trial: {sweep.source} has no cell {cell}")
    say(*tomli_w.dumps(trial_table(sweep, found, trial)).splitlines())
    return LOCALISED


def status_of(results: Results) -> int:
    """Return FAILED if a trial failed or violated an audit rule, LOCALISED if all were localised.

    Return NOT_LOCALISED otherwise.
    """
    counts = [cell.failed + cell.violations for cell in results.figures.values()]
    if any(counts):
        return FAILED
    localised = sum([cell.localised for cell in results.figures.values()])
    finished = sum([cell.trials for cell in results.figures.values()])
    return LOCALISED if localised == finished else NOT_LOCALISED
