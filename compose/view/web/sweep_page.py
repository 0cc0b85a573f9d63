"""The folder of a sweep, as the page shows it: what was asked, a row a cell, and the figures."""

from __future__ import annotations

import csv
from io import StringIO
from pathlib import Path
from typing import Any

import msgspec

from compose.errors import UserError
from protocol import files

SWEEP = "sweep.json"
SUMMARY = "summary.csv"
PARTS = "parts"
FIGURES = "figures"


def is_sweep(folder: Path) -> bool:
    """Whether a sweep has left it."""
    return (folder / SWEEP).is_file()


def told(folder: Path) -> dict[str, Any]:
    """What there is to see, now: a sweep that is under way has no summary yet. Raises UserError."""
    try:
        asked = msgspec.json.decode(files.read_bytes(folder / SWEEP))
        sweep = asked["sweep"]
        axes = [
            {
                "name": axis["name"],
                "fields": axis["fields"],
                "labels": axis.get("labels"),
                "values": axis["values"],
            }
            for axis in sweep["axes"]
        ]
        rows: list[dict[str, str]] = []
        if (folder / SUMMARY).is_file():
            rows = list(csv.DictReader(StringIO(files.read_text(folder / SUMMARY), newline="")))
        return {
            "folder": str(folder),
            "name": sweep["name"],
            "trials": sweep["trials"],
            "seed": sweep["seed"],
            "axes": axes,
            "refused": asked["refused"],
            "rows": rows,
            "under_way": (folder / PARTS).is_dir(),
            "figures": figures(folder),
        }
    except OSError as error:
        raise UserError(f"{folder} cannot be read: {error.strerror or error}") from None
    except (msgspec.MsgspecError, KeyError, TypeError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{folder / SWEEP} is no sweep's: {error!r}") from None


def figures(folder: Path) -> list[str]:
    """Their names."""
    return sorted(path.name for path in (folder / FIGURES).glob("*.svg"))
