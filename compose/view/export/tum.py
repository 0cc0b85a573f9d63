"""Trajectories as TUM files, which evo reads: lines of `timestamp tx ty tz qx qy qz qw`, in s and m.

`truth-ROBOT.tum` has true poses, `estimate-ROBOT.tum` those of the most probable hypothesis,
`claim-ROBOT.tum` those of them that the robot claims, and `poses-ROBOT.tum` those of its odometry alone,
from the origin on. There is no file without poses.
"""

from __future__ import annotations

import csv
import io
import math
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import msgspec
import numpy as np

from compose.errors import BadRecording
from compose.recording.estimating.estimate_rows import PoseEstimateRow
from compose.recording.ranging.range_steps import dead_reckoned
from compose.recording.ranging.run_ranges import ranges_of_run
from compose.recording.recording_files import ESTIMATE_CSV
from compose.recording.rows import estimate_rows
from compose.recording.run import Run
from protocol import files


def tum_of_run(run: Run) -> dict[str, str]:
    """Return the contents of the files of `run`, by name. Raises BadRecording."""
    tracks: dict[str, list[Iterable[float]]] = defaultdict(list)
    for robot in ranges_of_run(run).robots:
        times = np.concatenate((robot.odometry.t0[:1], robot.odometry.t1))
        tracks[f"poses-{robot.id}"] += np.column_stack((times, dead_reckoned(robot.odometry, times))).tolist()
        if robot.truth is not None:
            tracks[f"truth-{robot.id}"] += np.column_stack(robot.truth).tolist()
    for row in estimate_rows(run, run.setup.mission.period if run.setup is not None else math.nan):
        if row.frame == "world" and not row.hypothesis:
            for kind in ("estimate", *["claim"] * row.localised):
                tracks[f"{kind}-{row.robot}"].append((row.time_s, row.x, row.y, row.heading))
    return _texts(tracks)


def tum_of_estimate(folder: Path) -> dict[str, str]:
    """Return the contents of the files of the estimate in `folder`, by name.

    Raises OSError, and BadRecording, which names the line.
    """
    tracks: dict[str, list[Iterable[float]]] = defaultdict(list)
    lines = csv.DictReader(io.StringIO(files.read_text(folder / ESTIMATE_CSV)))
    try:
        for line in lines:
            given = {name: value for name, value in line.items() if value}
            row = msgspec.convert(given, PoseEstimateRow, strict=False)
            for kind in ("estimate", *["claim"] * row.claim):
                tracks[f"{kind}-{row.robot}"].append((row.t_s, row.x, row.y, row.heading))
            if row.true_x is not None and row.true_y is not None and row.true_heading is not None:
                tracks[f"truth-{row.robot}"].append((row.t_s, row.true_x, row.true_y, row.true_heading))
    except (msgspec.ValidationError, csv.Error) as error:
        raise BadRecording(f"{folder / ESTIMATE_CSV}, line {lines.line_num}: {error}") from None
    return _texts(tracks)


def _texts(tracks: dict[str, list[Iterable[float]]]) -> dict[str, str]:
    """Return the TUM files of `tracks`, rows of t (s), x, y (m) and heading (rad); floats are exact."""
    head = "# timestamp tx ty tz qx qy qz qw\n"
    return {
        f"{name}.tum": head
        + "".join(
            f"{t!r} {x!r} {y!r} 0 0 0 {math.sin(0.5 * heading)!r} {math.cos(0.5 * heading)!r}\n"
            for t, x, y, heading in rows
        )
        for name, rows in sorted(tracks.items())
        if rows
    }
