"""Tables of a recording: one row per tick and robot with its estimate, and one row per journaled frame."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq
from msgspec.structs import asdict

from compose.recording.claim import nees
from compose.recording.frames import Journaled
from compose.recording.run import Run
from compose.recording.ticks_csv import TickRow
from protocol.messages import Estimate
from protocol.motion import Covariance, Pose
from world.referee import errors

_POSE = pa.struct([(name, pa.float64()) for name in Pose.__struct_fields__])
_TICK_TYPES: dict[str, pa.DataType] = {
    "tick": pa.int32(),
    "time_s": pa.float64(),
    **dict.fromkeys(("robot", "state", "verdict"), pa.string()),
    "phase": pa.int32(),
    **dict.fromkeys(("local", "world"), pa.list_(_POSE)),
    "probability": pa.list_(pa.float64()),
}
"""The types of columns. All others are float64."""
_MEASURES = ["position_error_m", "heading_error_rad", "position_sigma_m", "heading_sigma_rad", "nees"]
_COVARIANCE = [f"cov_{name}" for name in Covariance.__struct_fields__]
TICK_COLUMNS = [
    *("tick", "time_s"),
    *TickRow.__struct_fields__[1:],
    *("verdict", "local", "world", "probability"),
    *("estimate_x", "estimate_y", "estimate_heading"),
    *_COVARIANCE,
    *_MEASURES,
]
"""The columns of `ticks.parquet`."""


def write_ticks(run: Run, rows: Iterable[TickRow], period: float, path: Path) -> None:
    """Write `ticks.parquet` to `path`: the `rows` of `run`, with estimates and their errors.

    `period` is T_s in s.
    """
    estimates = {(robot, one.tick): one for robot, agent in run.agents.items() for one in agent.estimates}
    lines = []
    for row in rows:
        command = run.command(row.robot, row.tick)
        extra = {
            "time_s": row.tick * period,
            "verdict": _tag(command.verdict if command is not None else None),
        }
        lines.append(asdict(row) | extra | _estimate(estimates.get((row.robot, row.tick)), row.pose))
    schema = pa.schema([pa.field(name, _TICK_TYPES.get(name, pa.float64())) for name in TICK_COLUMNS])
    pq.write_table(pa.Table.from_pylist(lines, schema=schema), path)


def _tag(verdict: msgspec.Struct | None) -> str | None:
    return str(verdict.__struct_config__.tag) if verdict is not None else None


def _estimate(held: Estimate | None, truth: Pose | None) -> dict[str, Any]:
    """Return the columns of an estimate, with the errors of its first world pose if the truth is known."""
    if held is None:
        return {}
    columns: dict[str, Any] = {
        "local": [asdict(pose) for pose in held.local],
        "world": [asdict(pose) for pose in held.world],
        "probability": list(held.probabilities),
    }
    if not held.world:
        return columns
    first = held.world[0]
    columns |= {f"estimate_{name}": value for name, value in asdict(first).items()}
    if truth is not None:
        columns["position_error_m"], columns["heading_error_rad"] = errors(first, truth)
    if held.covariance is not None:
        columns |= {f"cov_{name}": value for name, value in asdict(held.covariance).items()}
        columns["position_sigma_m"] = held.covariance.position_sigma
        columns["heading_sigma_rad"] = held.covariance.heading_sigma
        if truth is not None:
            columns["nees"] = nees(first, truth, held.covariance)
    return columns


def frames_csv(frames: Iterable[Journaled], check: Callable[[], object] = lambda: None) -> str:
    """Return the CSV table with one row per frame: its position, tick, kind, size, and message as JSON.

    Calls `check` before each frame, which may raise.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["journal", "place", "tick", "kind", "bytes", "message"])
    for one in frames:
        check()
        writer.writerow([one.journal, one.place, one.tick, one.kind, len(one.frame), one.json])
    return out.getvalue()
