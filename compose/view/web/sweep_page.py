"""The data of a sweep's folder for the page: parameters, one row per cell, and figures."""

from __future__ import annotations

import csv
from io import StringIO
from pathlib import Path
from typing import Any

import msgspec

from compose.errors import UserError
from compose.sweep import PARTS, SUMMARY_CSV, SWEEP_JSON
from protocol import documents, files

FIGURES = "figures"


def is_sweep(folder: Path) -> bool:
    """Return whether `folder` contains the results of a sweep."""
    return (folder / SWEEP_JSON).is_file()


def contents(folder: Path) -> dict[str, Any]:
    """Return the data for the page. A running sweep has no rows yet.

    Raises UserError if the folder cannot be read.
    """
    try:
        manifest = documents.json_value(
            files.read_inside(folder, SWEEP_JSON, most=documents.MOST_DOCUMENT_BYTES)
        )
        sweep = manifest["sweep"]
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
        if (folder / SUMMARY_CSV).is_file():
            text = files.read_inside(folder, SUMMARY_CSV, most=documents.MOST_DOCUMENT_BYTES).decode(
                "utf-8-sig"
            )
            rows = list(csv.DictReader(StringIO(text, newline="")))
        return {
            "folder": str(folder),
            "name": sweep["name"],
            "trials": sweep["trials"],
            "seed": sweep["seed"],
            "axes": axes,
            "refused": manifest["refused"],
            "rows": rows,
            "under_way": (folder / PARTS).is_dir(),
            "figures": figures(folder),
        }
    except OSError as error:
        raise UserError(f"{folder} cannot be read: {error.strerror or error}") from None
    except (msgspec.MsgspecError, KeyError, TypeError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(
            f"{folder / SWEEP_JSON} is not a valid sweep manifest: {documents.flaw(error)}"
        ) from None


def figures(folder: Path) -> list[str]:
    """Return the file names of the sweep's figures. Links and what is no file are not among them."""
    if (folder / FIGURES).is_symlink():
        return []
    return sorted(files.regular_in(folder / FIGURES, "*.svg"))
