"""`tandem replay`: a recorded run once more, held against the record to the bit."""

from __future__ import annotations

import argparse

from compose.audit.findings import Violation
from compose.audit.replay import replay
from compose.errors import CLEAN, VIOLATED
from compose.recording.run import legible
from protocol.output import say


def main(options: argparse.Namespace) -> int:
    """Play it again, and show the first difference."""
    with legible(options.recording):
        played, torn = replay(options.recording)
    if played.differences:
        first, *more = played.differences
        say(f"{played.scenario}: not as recorded")
        say(_difference(first))
        if more:
            say(f"and {len(more)} more, which `tandem audit` tells")
        if played.versions is not None:
            say(f"{played.versions}: that alone can lead to other decisions")
    elif played.rounding:
        say(
            f"{played.scenario}: as recorded but for the last bits, in {played.ticks} ticks: "
            f"{played.rounding} of {played.checks} checks differ by rounding alone"
        )
        say(str(played.versions))
    else:
        say(f"{played.scenario}: as recorded, to the bit, in {played.ticks} ticks ({played.checks} checks)")
    for tear in played.tears:
        say(f"{_where(tear)}: {tear.what}")
    for name, size in torn.items():
        if size:
            say(f"{name} ends with {size} bytes of a torn write")
    return VIOLATED if played.differences else CLEAN


def _where(found: Violation) -> str:
    tick = f"tick {found.tick}" if found.tick is not None else "no tick"
    return f"{tick}, {found.robot or 'the world'}"


def _difference(found: Violation) -> str:
    """Tick, robot, field, recorded and recomputed value; or what else there is to say."""
    one = found.difference
    if one is None:
        return f"{_where(found)}: {found.what}"
    return f"{_where(found)}, {one.kind} {one.field}: recorded {one.found}, recomputed {one.expected}"
