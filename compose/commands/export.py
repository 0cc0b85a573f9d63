"""`tandem export`: a record in the formats of other people's tools."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from compose.lab import need
from compose.record import legible
from compose.status import ENDED, FAILED


def main(options: argparse.Namespace) -> int:
    """Write the files; FAILED if a robot's journal is missing, of whom there is only what the world knows."""
    need("foxglove", "pyarrow")
    from compose.export.folder import export  # noqa: PLC0415  # slow, and there may be no extra

    out: Path = options.out or options.record
    with legible(options.record):
        done = export(options.record, out)
    for path in done.files:
        print(path)
    for name, size in done.torn.items():
        print(f"{name} ends with {size} bytes of a torn write", file=sys.stderr)
    for name in done.missing:
        print(f"{name} is missing", file=sys.stderr)
    return FAILED if done.missing else ENDED
