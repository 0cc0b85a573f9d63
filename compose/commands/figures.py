"""`tandem figures`: pictures of a record."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from compose.lab import need
from compose.record import agent_journal, estimates, legible, read
from compose.status import ENDED, FAILED, UserError
from protocol.inbox import one_line
from protocol.journal import CorruptJournal
from protocol.messages import Estimate


def main(options: argparse.Namespace) -> int:
    """Draw each robot of the record; FAILED if one of them has left no journal that can be read."""
    need("matplotlib")
    with legible(options.record):
        record = read(options.record)
    from compose.figures import robot  # noqa: PLC0415  # slow, and there may be no extra

    folder = options.record / "figures"
    status = ENDED
    for place, placed in enumerate(record.scenario.robots):
        held = _estimates(options.record, placed.id)
        if held is None:
            status = FAILED
            continue
        try:
            for path in robot.draw(robot.Story(record, place, held), folder):
                print(path, flush=True)
        except BrokenPipeError:
            raise
        except OSError as error:
            raise UserError(f"{folder} cannot be written: {error.strerror or error}") from None
    return status


def _estimates(folder: Path, robot: str) -> tuple[Estimate, ...] | None:
    """None, and a line that says why, where they cannot be read."""
    try:
        return estimates(folder, robot)
    except FileNotFoundError:
        why = f"{agent_journal(robot)} is missing"
    except OSError as error:
        why = f"{agent_journal(robot)} cannot be read: {error.strerror or error}"
    except CorruptJournal as error:
        why = str(error)
    print(one_line(f"tandem figures: no picture of {robot}: {why}"), file=sys.stderr)
    return None
