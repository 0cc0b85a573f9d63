"""`tandem sweep`: a campaign, on this machine or wherever a Dask scheduler has workers."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from compose.campaign import spec
from compose.lab import need
from compose.status import FAILED, LOCALISED, NOT_LOCALISED, STOPPED
from compose.stop import stop_by_signal
from protocol.inbox import Inbox

if TYPE_CHECKING:
    from compose.campaign.run import Results


def main(options: argparse.Namespace) -> int:
    """Play the campaign, or what is left of it."""
    campaign = spec.load(options.spec, trials=options.trials, seed=options.seed)
    need("distributed", "matplotlib", "pyarrow", "tomli_w")
    inbox = Inbox("tandem sweep")
    stop_by_signal(inbox)
    from compose.campaign import figures, report, run  # noqa: PLC0415  # slow, and there may be no extra

    out = options.out if options.out is not None else Path(f"sweep-{campaign.name}")
    chosen = {"workers": options.workers} if options.workers is not None else {}
    means = run.Means(
        scheduler=options.scheduler,
        processes=options.processes,
        audit=options.audit,
        retry=options.retry,
        **chosen,
    )
    visible = sys.stdout.isatty() and not options.quiet
    with report.progress(campaign.name, inbox.say, visible) as progress:
        results = run.sweep(campaign, out, means, inbox, progress)
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
    figures.draw(results, out / "figures")
    return status_of(results)


def status_of(results: Results) -> int:
    """As of a mission: localised only where all are; failed where any is, or breaks a rule."""
    counts = [figures.failed + figures.violations for figures in results.figures.values()]
    if any(counts):
        return FAILED
    localised = sum([figures.localised for figures in results.figures.values()])
    return LOCALISED if localised == len(results.table) else NOT_LOCALISED
