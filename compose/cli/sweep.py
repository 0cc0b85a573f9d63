"""`tandem sweep`: a sweep, on this machine or wherever a Dask scheduler has workers."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from compose.errors import FAILED, LOCALISED, NOT_LOCALISED, STOPPED, UserError
from compose.extras import need
from compose.launch.signals import stop_by_signal
from compose.sweep import spec
from compose.sweep.cells import cells, trial_table
from compose.sweep.spec import Sweep
from protocol.network.inbox import Inbox
from protocol.output import say

if TYPE_CHECKING:
    from compose.sweep.execution import Results


def main(options: argparse.Namespace) -> int:
    """Play the sweep, or what is left of it."""
    sweep = spec.load(options.spec, trials=options.trials, seed=options.seed)
    need("distributed", "matplotlib", "pyarrow", "tomli_w")
    if options.print_trial is not None:
        return print_trial(sweep, *options.print_trial)
    inbox = Inbox("tandem sweep")
    stop_by_signal(inbox)
    from compose.sweep import axis_figures, execution, report  # noqa: PLC0415  # slow, and there may be no extra

    out = options.out if options.out is not None else Path(f"sweep-{sweep.name}")
    chosen = {"workers": options.workers} if options.workers is not None else {}
    means = execution.ExecutionOptions(
        scheduler=options.scheduler,
        processes=options.processes,
        audit=options.audit,
        retry=options.retry,
        **chosen,
    )
    visible = sys.stdout.isatty() and not options.quiet
    with report.progress(sweep.name, inbox.say, visible) as progress:
        results = execution.sweep(sweep, out, means, inbox, progress)
    if results.stopped is not None:
        inbox.say(
            f"{results.stopped}: {len(results.table)} of {results.trials} trials are done; "
            "the same command goes on from there"
        )
        if len(results.table) == results.trials:
            report.show(results, out, quiet=True)
        return STOPPED if results.interrupted else FAILED
    report.show(results, out, quiet=options.quiet)
    sys.stdout.flush()
    axis_figures.draw(results, out / "figures")
    return status_of(results)


def print_trial(sweep: Sweep, cell: int, trial: int) -> int:
    """Print the scenario file of a trial."""
    import tomli_w  # noqa: PLC0415  # there may be no extra

    found = next((one for one in cells(sweep) if one.index == cell), None)
    if found is None:
        raise UserError(f"--print-trial: {sweep.source} has no cell {cell}")
    say(*tomli_w.dumps(trial_table(sweep, found, trial)).splitlines())
    return LOCALISED


def status_of(results: Results) -> int:
    """As of a mission: localised only where all are; failed where any is, or breaks a rule."""
    counts = [cell.failed + cell.violations for cell in results.figures.values()]
    if any(counts):
        return FAILED
    localised = sum([cell.localised for cell in results.figures.values()])
    played = sum([cell.trials for cell in results.figures.values()])
    return LOCALISED if localised == played else NOT_LOCALISED
