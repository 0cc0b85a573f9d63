"""The data of an estimate's folder for the page: its summary and its figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from compose.errors import UserError
from protocol import documents, files

ESTIMATE = "estimate.json"


def is_estimate(folder: Path) -> bool:
    """Return whether `folder` contains the results of `tandem estimate`."""
    return (folder / ESTIMATE).is_file()


def contents(folder: Path) -> dict[str, Any]:
    """Return the summary and the figures for the page. Raises UserError if the folder cannot be read."""
    try:
        summary = documents.json_value(
            files.read_inside(folder, ESTIMATE, most=documents.MOST_DOCUMENT_BYTES), dict[str, Any]
        )
        return {
            "folder": str(folder),
            "source": str(summary["source"]),
            "noise": str(summary["noise"]),
            "begin_s": float(summary["begin_s"]),
            "robots": dict(summary["robots"]),
            "ranges": dict(summary["ranges"]),
            "blocking_reason": str(summary["blocking_reason"]),
            "figures": figures(folder),
        }
    except OSError as error:
        raise UserError(f"{folder} cannot be read: {error.strerror or error}") from None
    except (msgspec.MsgspecError, KeyError, TypeError, ValueError) as error:
        why = documents.flaw(error)
        raise UserError(f"{folder / ESTIMATE} is not the summary of an estimate: {why}") from None


def figures(folder: Path) -> list[str]:
    """Return the file names of the estimate's figures, the paths first."""
    return sorted(files.regular_in(folder, "estimate-*.svg"), reverse=True)
