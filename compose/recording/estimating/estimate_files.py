"""The files of an estimate: `estimate.csv`, `estimate.json`, and `anchors.csv` with estimated anchors."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from compose.recording.estimating.estimate_rows import EstimatedAnchor, EstimateSummary, PoseEstimateRow
from protocol import files

CSV_NAME, JSON_NAME, ANCHORS_NAME = "estimate.csv", "estimate.json", "anchors.csv"
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


def anchors_csv(anchors: Mapping[str, EstimatedAnchor]) -> str:
    """Return the table of anchors that `--anchors` reads: each is surveyed with the sigma of its estimate."""
    rows = [
        f"{name},{one.position[0]!r},{one.position[1]!r},{one.height!r},{one.sigma!r}"
        for name, one in anchors.items()
    ]
    return "\n".join(["anchor,x,y,height,sigma", *rows, ""])


def write_estimate(folder: Path, rows: Sequence[PoseEstimateRow], summary: EstimateSummary) -> list[Path]:
    """Write the files into `folder`, and return their paths. Raises OSError.

    That of the anchors is written if some are not surveyed.
    """
    table, record, anchors = [folder / name for name in (CSV_NAME, JSON_NAME, ANCHORS_NAME)]
    files.write(table, estimate_csv(rows))
    files.write(record, msgspec.json.format(msgspec.json.encode(summary), indent=2) + b"\n")
    if not summary.anchors:
        return [table, record]
    files.write(anchors, anchors_csv(summary.anchors))
    return [table, record, anchors]
