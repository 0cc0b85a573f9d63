"""`tandem export`: convert a recording to the file formats of other tools."""

from __future__ import annotations

import argparse
from pathlib import Path

from compose.cli.arguments import add_closing, add_recording, folder
from compose.cli.export_bar import MODULES, exported
from compose.errors import ENDED, FAILED, STOPPED
from compose.extras import need
from compose.launch.signals import stop_by_signal
from protocol.network.inbox import Inbox, Interrupted
from protocol.output import say


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `tandem export`."""
    add_recording(parser)
    parser.add_argument(
        "--out",
        type=folder,
        metavar="DIR",
        help="folder for run.mcap, frames.csv and ticks.parquet [default: the recording's]",
    )
    add_closing(parser, "tandem export recording --out exported", "docs/recordings.md")


def main(options: argparse.Namespace) -> int:
    """Write the files, and return FAILED if a robot's journal is missing.

    The export then contains only what the other journals hold about that robot.
    """
    need(*MODULES)
    out: Path = options.out or options.recording
    inbox = Inbox("tandem export")
    stop_by_signal(inbox)
    try:
        done = exported(options.recording, out, inbox)
    except Interrupted as signal_name:
        inbox.say(f"stopped by {signal_name}")
        return STOPPED
    for path in done.files:
        say(str(path))
    for name, size in done.torn.items():
        say(f"{name} ends with {size} bytes of a torn write", error=True)
    for name in done.missing:
        say(f"{name} is missing", error=True)
    return FAILED if done.missing else ENDED
