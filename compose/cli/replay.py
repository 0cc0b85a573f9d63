"""`tandem replay`: run a recording again, and compare it with the original to the last bit."""

from __future__ import annotations

import argparse

from compose.audit.findings import Violation
from compose.audit.replay import replay
from compose.cli.arguments import add_closing, add_recording, add_trusted_planner
from compose.errors import CLEAN, VIOLATED
from compose.launch.planner_loader import trust
from compose.recording.recording_files import user_errors
from protocol.output import say


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `tandem replay`."""
    add_recording(parser)
    add_trusted_planner(parser)
    add_closing(parser, "tandem replay recording", "docs/recordings.md")


def main(options: argparse.Namespace) -> int:
    """Replay the recording, print the first difference, and return VIOLATED if there is one."""
    for name in options.planner:
        trust(name)
    with user_errors(options.recording):
        replayed, torn = replay(options.recording)
    if replayed.differences:
        first, *more = replayed.differences
        say(f"{replayed.scenario}: not as recorded")
        say(_difference(first))
        if more:
            say(f"and {len(more)} more, which `tandem audit` lists")
        if replayed.versions is not None:
            say(f"{replayed.versions}: that alone can lead to other decisions")
    elif replayed.rounding:
        say(
            f"{replayed.scenario}: as recorded but for the last bits, over {replayed.ticks} ticks: "
            f"{replayed.rounding} of {replayed.checks} checks differ by rounding alone"
        )
        say(str(replayed.versions))
    else:
        counts = f"{replayed.ticks} ticks ({replayed.checks} checks)"
        say(f"{replayed.scenario}: as recorded, to the bit, over {counts}")
    for tear in replayed.tears:
        say(f"{_where(tear)}: {tear.what}")
    for name, size in torn.items():
        if size:
            say(f"{name} ends with {size} bytes of a torn write")
    return VIOLATED if replayed.differences else CLEAN


def _where(found: Violation) -> str:
    tick = f"tick {found.tick}" if found.tick is not None else "no tick"
    return f"{tick}, {found.robot or 'the world'}"


def _difference(found: Violation) -> str:
    """Return a line with the tick, the robot, and the recorded and the recomputed value where they differ."""
    one = found.difference
    if one is None:
        return f"{_where(found)}: {found.what}"
    return f"{_where(found)}, {one.kind} {one.field}: recorded {one.found}, recomputed {one.expected}"
