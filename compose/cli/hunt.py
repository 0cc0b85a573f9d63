"""`tandem hunt`: search for an input of a scenario that breaks an invariant."""

from __future__ import annotations

import argparse
import os
import shlex
import time
from pathlib import Path

from compose.errors import ENDED, STOPPED_STATUS, VIOLATED, UserError, writing
from compose.extras import need
from compose.launch.signals import StoppedBySignal
from compose.scenario.scenario_file import setting
from compose.sweep.hunt.exploration import FoundBreach, Hunt
from compose.sweep.hunt.mutation import fault_lines
from compose.sweep.hunt.reached_states import never
from compose.terminal.invocation import program
from compose.terminal.text_width import tell
from protocol.output import one_line

PROGRESS_S = 10.0
"""The time in s between two lines about the progress."""


def main(options: argparse.Namespace) -> int:
    """Hunt, say what was reached, write the input that was found, and return the exit status."""
    setting(options.scenario)  # a mistake in it is the user's
    need("tomli_w")
    out: Path = options.out if options.out is not None else Path(f"hunt-{Path(options.scenario).stem}.toml")
    if out.exists():
        raise UserError(f"--out: {out} already exists; choose another file")
    hunt = Hunt(options.scenario, options.seed, options.workers or os.cpu_count() or 1)
    began = told = time.monotonic()

    def is_over(hunt: Hunt) -> bool:
        nonlocal told
        if (now := time.monotonic()) > told + PROGRESS_S and not options.quiet:
            told = now
            tell(f"{hunt.runs} runs, {len(hunt.seen)} states and transitions, {len(hunt.corpus)} inputs kept")
        return bool(hunt.runs >= options.runs if options.runs else now >= began + 60.0 * options.minutes)

    found, stopped = None, False
    try:
        if not options.quiet:
            tell(f"{options.scenario}: {len(hunt.seeds)} inputs to begin with; Ctrl-C ends the hunt")
        found = hunt.run(is_over)
    except StoppedBySignal:
        stopped = True
    _say_reached(hunt, options.scenario, time.monotonic() - began)
    if stopped:
        return STOPPED_STATUS
    if found is None:
        tell("no invariant was broken")
        return ENDED
    _write(found, out, f"tandem hunt {shlex.quote(options.scenario)} --seed {options.seed}")
    count = fault_lines(found.table, hunt.seeds[0])
    tell(f"{found.breach.kind}: {found.breach.what}")
    tell(f"{out}: {count} changes of {options.scenario}; {program('tandem')} run {shlex.quote(str(out))}")
    return VIOLATED


def _say_reached(hunt: Hunt, scenario: str, seconds: float) -> None:
    tell(
        f"{scenario}: {hunt.runs} runs in {seconds:.0f} s, {hunt.processes} also as processes; "
        f"{hunt.refused} inputs are no mission, or last too long; "
        f"{len(hunt.seen)} states and transitions reached"
    )
    for kind, names in never(hunt.seen).items():
        if names:
            tell(f"never reached, {kind}: {', '.join(names)}")


def _write(found: FoundBreach, out: Path, command: str) -> None:
    import tomli_w  # noqa: PLC0415  # the library is optional

    lines = [
        f"# {found.breach.kind}: {one_line(found.breach.what)}",
        f"# Found by {command}, run {found.runs}.",
    ]
    with writing(f"--out {out}"):
        out.write_text("\n".join([*lines, tomli_w.dumps(found.table)]))
