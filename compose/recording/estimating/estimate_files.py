"""The files of an estimate: `estimate.csv` and `estimate.json`."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import msgspec

from compose.recording.estimating.estimate_rows import EstimateSummary, PoseEstimateRow
from protocol import files

CSV_NAME, JSON_NAME = "estimate.csv", "estimate.json"
ESTIMATE_COLUMNS = PoseEstimateRow.__struct_fields__
"""The columns of `estimate.csv`."""


def estimate_csv(rows: Sequence[PoseEstimateRow]) -> str:
    """Return the table of `rows`, with a line of column names; numbers are exact."""
    return "\n".join([",".join(ESTIMATE_COLUMNS), *map(csv_line, rows), ""])


def csv_line(row: PoseEstimateRow) -> str:
    """Return one row of the table, without the line break."""
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow([_cell(value) for value in msgspec.structs.astuple(row)])
    return text.getvalue()


def _cell(value: object) -> object:
    if isinstance(value, bool):
        return str(value).lower()
    return "" if value is None else value


def write_estimate(
    folder: Path, rows: Sequence[PoseEstimateRow], summary: EstimateSummary
) -> tuple[Path, Path]:
    """Write both files into `folder`, and return their paths. Raises OSError."""
    table, record = folder / CSV_NAME, folder / JSON_NAME
    files.write(table, estimate_csv(rows))
    files.write(record, msgspec.json.format(msgspec.json.encode(summary), indent=2) + b"\n")
    return table, record
