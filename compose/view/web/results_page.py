"""The data of the folder of a sweep or of an estimate for the page."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from typing import Any

import msgspec

from compose.errors import UserError
from compose.sweep import PARTS, SUMMARY_CSV, SWEEP_JSON
from compose.view.web.reruns import TRIALS
from protocol import documents, files

ESTIMATE = "estimate.json"
FIGURES = "figures"


def is_sweep(folder: Path) -> bool:
    """Return whether `folder` contains the results of a sweep."""
    return (folder / SWEEP_JSON).is_file()


def is_estimate(folder: Path) -> bool:
    """Return whether `folder` contains the results of `tandem estimate`."""
    return (folder / ESTIMATE).is_file()


def of_sweep(folder: Path) -> dict[str, Any]:
    """Return the parameters, one row per cell, and the figures. A running sweep has no rows yet.

    Raises UserError if the folder cannot be read.
    """
    with _read(folder, SWEEP_JSON, "a valid sweep manifest") as manifest:
        sweep, rows = manifest["sweep"], []
        if (folder / SUMMARY_CSV).is_file():
            table = files.read_inside(folder, SUMMARY_CSV, most=documents.MOST_DOCUMENT_BYTES)
            rows = list(csv.DictReader(StringIO(table.decode("utf-8-sig"), newline="")))
        return {
            "folder": str(folder),
            **{name: sweep[name] for name in ("name", "trials", "seed")},
            "axes": [
                {"labels": axis.get("labels"), **{name: axis[name] for name in ("name", "fields", "values")}}
                for axis in sweep["axes"]
            ],
            "refused": manifest["refused"],
            "rows": rows,
            "under_way": (folder / PARTS).is_dir(),
            "timed": bool(rows) and (folder / TRIALS).is_file() and find_spec("pyarrow") is not None,
            "figures": figures_of_sweep(folder),
        }


def of_estimate(folder: Path) -> dict[str, Any]:
    """Return the summary and the figures. Raises UserError if the folder cannot be read."""
    kinds = {
        "source": str,
        "noise": str,
        "begin_s": float,
        "robots": dict,
        "ranges": dict,
        "blocking_reason": str,
    }
    with _read(folder, ESTIMATE, "the summary of an estimate") as summary:
        found = {name: kind(summary[name]) for name, kind in kinds.items()}
        found["frame"] = str(summary.get("relative_to") or "")
        return {"folder": str(folder), **found, "figures": figures_of_estimate(folder)}


@contextmanager
def _read(folder: Path, name: str, what: str) -> Iterator[dict[str, Any]]:
    """Yield the JSON document `name` of a folder; whatever is wrong with it becomes a UserError."""
    try:
        content = files.read_inside(folder, name, most=documents.MOST_DOCUMENT_BYTES)
        yield documents.json_value(content, dict[str, Any])
    except OSError as error:
        raise UserError(f"{folder} cannot be read: {error.strerror or error}") from None
    except (msgspec.MsgspecError, LookupError, TypeError, ValueError, AttributeError, csv.Error) as error:
        raise UserError(f"{folder / name} is not {what}: {documents.flaw(error)}") from None


def figures_of_sweep(folder: Path) -> list[str]:
    """Return the file names of the sweep's figures. Links and what is no file are not among them."""
    if (folder / FIGURES).is_symlink():
        return []
    return sorted(files.regular_in(folder / FIGURES, "*.svg"))


def figures_of_estimate(folder: Path) -> list[str]:
    """Return the file names of the estimate's figures, the paths first."""
    return sorted(files.regular_in(folder, "estimate-*.svg"), reverse=True)
