"""`tandem hunt`: search for an input of a scenario that breaks an invariant."""

from __future__ import annotations

import argparse
import os
import shlex
import time
from collections.abc import Callable
from pathlib import Path

from compose.errors import ENDED, STOPPED_STATUS, VIOLATED, UserError, writing
from compose.extras import need
from compose.launch.signals import StoppedBySignal
from compose.scenario.scenario_file import setting
from compose.terminal.invocation import program
from compose.terminal.text_width import tell

PROGRESS_S = 10.0
"""The time in s between two lines about the progress."""


def main(options: argparse.Namespace) -> int:
    """Hunt, say what was reached, write the input that was found, and return the exit status."""
    setting(options.scenario)  # a mistake in it is the user's
    need("tomli_w")
    from compose.sweep.hunt.mutation import fault_lines  # noqa: PLC0415  # it imports numpy
    from compose.sweep.hunt.search import Hunt, Reach  # noqa: PLC0415  # likewise

    out: Path = options.out if options.out is not None else Path(f"hunt-{Path(options.scenario).stem}.toml")
    if out.exists():
        raise UserError(f"--out: {out} already exists; choose another file")
    hunt = Hunt(options.scenario, options.seed, options.jobs or os.cpu_count() or 1)
    began = told = time.monotonic()
    if not options.quiet:
        tell(f"{options.scenario}: {len(hunt.seeds)} inputs to begin with; Ctrl-C ends the hunt")

    def progress(reach: Reach) -> None:
        nonlocal told
        if time.monotonic() > told + PROGRESS_S and not options.quiet:
            told = time.monotonic()
            tell(f"{reach.runs} runs, {len(reach.seen)} states and transitions, {reach.corpus} inputs kept")

    try:
        found = hunt.run(_end(options, began), progress)
    except StoppedBySignal:
        _say_reached(hunt.reach(), options.scenario, time.monotonic() - began)
        return STOPPED_STATUS
    _say_reached(hunt.reach(), options.scenario, time.monotonic() - began)
    if found is None:
        tell("no invariant was broken")
        return ENDED
    import tomli_w  # noqa: PLC0415  # the library is optional

    lines = [
        f"# {found.breach.kind}: {found.breach.what}",
        f"# Found by {_command(options)}, run {found.runs}.",
    ]
    with writing(f"--out {out}"):
        out.write_text("\n".join([*lines, tomli_w.dumps(found.table)]))
    tell(f"{found.breach.kind}: {found.breach.what}")
    count = fault_lines(found.table, hunt.seeds[0])
    tell(f"{out}: {count} changes of {options.scenario}; {program('tandem')} run {shlex.quote(str(out))}")
    return VIOLATED


def _end(options: argparse.Namespace, began: float) -> Callable[[int], bool]:
    """Return when the hunt is over, given the number of its runs."""
    if options.runs is not None:
        most: int = options.runs
        return lambda runs: runs >= most
    seconds: float = 60.0 * options.minutes
    return lambda _: time.monotonic() >= began + seconds


def _say_reached(reach: object, scenario: str, seconds: float) -> None:
    from compose.sweep.hunt.coverage import never  # noqa: PLC0415  # it imports numpy
    from compose.sweep.hunt.search import Reach  # noqa: PLC0415  # likewise

    assert isinstance(reach, Reach)
    tell(
        f"{scenario}: {reach.runs} runs in {seconds:.0f} s, {reach.processes} also as processes; "
        f"{reach.refused} inputs are no mission; {len(reach.seen)} states and transitions reached"
    )
    for kind, names in never(set(reach.seen)).items():
        if names:
            tell(f"never reached, {kind}: {', '.join(names)}")


def _command(options: argparse.Namespace) -> str:
    return f"tandem hunt {shlex.quote(options.scenario)} --seed {options.seed}"
