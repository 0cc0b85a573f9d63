"""`tandem replay`: run a recording again, and compare it with the original to the last bit."""

from __future__ import annotations

import argparse

from compose.audit.findings import Violation
from compose.audit.rules import replayed
from compose.cli.recording import read_noted
from compose.errors import ENDED, VIOLATED
from compose.recording.recording_files import user_errors
from compose.terminal.text_width import tell


def main(options: argparse.Namespace) -> int:
    """Replay the recording, print the first difference, and return VIOLATED if there is one."""
    with user_errors(options.recording):
        run = read_noted(options.recording, "replay", audited=True)
        found = replayed(run)
    if found.differences:
        first, *more = found.differences
        tell(f"{found.scenario}: not as recorded")
        tell(_difference(first))
        if more:
            tell(f"and {len(more)} more, which `tandem audit` lists")
        if found.versions is not None:
            tell(f"{found.versions}: that alone can lead to other decisions")
    elif found.rounding:
        tell(
            f"{found.scenario}: as recorded but for the last bits, over {found.ticks} ticks: "
            f"{len(found.rounding)} of {found.checks} checks differ by rounding alone"
        )
        tell(str(found.versions))
    else:
        counts = f"{found.ticks} ticks ({found.checks} checks)"
        tell(f"{found.scenario}: as recorded, to the bit, over {counts}")
    for tear in found.tears:
        tell(f"{_where(tear)}: {tear.what}")
    for name, journal in run.journals.items():
        if journal.torn:
            tell(f"{name} ends with {journal.torn} bytes of a torn write")
    return VIOLATED if found.differences else ENDED


def _where(found: Violation) -> str:
    tick = f"tick {found.tick}" if found.tick is not None else "no tick"
    return f"{tick}, {found.robot or 'the world'}"


def _difference(found: Violation) -> str:
    """Return a line with the tick, the robot, and the recorded and the recomputed value where they differ."""
    one = found.difference
    if one is None:
        return f"{_where(found)}: {found.what}"
    return f"{_where(found)}, {one.kind} {one.field}: recorded {one.found}, recomputed {one.expected}"
