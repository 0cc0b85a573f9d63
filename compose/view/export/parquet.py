"""`ticks.parquet`: one row per tick and robot, with its estimate."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from msgspec.structs import asdict

from compose.recording.frames import verdict_name
from compose.recording.rows import TickRow, hypotheses
from compose.recording.run import Run
from protocol.messages import Estimate
from protocol.motion import Covariance, Pose

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


def write_ticks(run: Run, ticks: Iterable[TickRow], period: float, path: Path) -> None:
    """Write `ticks.parquet` to `path`: the rows of `ticks.csv`, with estimates and their errors.

    `period` is T_s in s.
    """
    estimates = {(robot, one.tick): one for robot, agent in run.agents.items() for one in agent.estimates}
    lines = []
    for row in ticks:
        line = asdict(row) | {"time_s": row.tick * period}
        line["verdict"] = verdict_name(run.command(row.robot, row.tick))
        held = estimates.get((row.robot, row.tick))
        if held is not None:
            truth = None
            if row.x is not None and row.y is not None and row.heading is not None:
                truth = Pose(row.x, row.y, row.heading)
            line |= _estimate(held, truth, period)
        lines.append(line)
    schema = pa.schema([pa.field(name, _TICK_TYPES.get(name, pa.float64())) for name in TICK_COLUMNS])
    pq.write_table(pa.Table.from_pylist(lines, schema=schema), path)


def _estimate(held: Estimate, truth: Pose | None, period: float) -> dict[str, Any]:
    """Return the columns of an estimate, with the errors of its first world pose if the truth is known."""
    columns: dict[str, Any] = {name: list(map(asdict, getattr(held, name))) for name in ("local", "world")}
    columns["probability"] = list(held.probabilities)
    if held.world:
        first = next(hypotheses(held, truth, period))
        columns |= {f"estimate_{name}": value for name, value in asdict(held.world[0]).items()}
        columns |= {name: getattr(first, name) for name in _MEASURES}
        if held.covariance is not None:
            columns |= {f"cov_{name}": value for name, value in asdict(held.covariance).items()}
    return columns
