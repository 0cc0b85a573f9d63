"""The claims of recorded robots in all windows, as a table: `uv run docs/recorded_windows.py --lias FOLDER`.

Each recording is cut into windows, which are estimated for themselves, from unknown poses. There is a row for
each recording, group of robots and noise. A claim is a pose that a robot may claim at an epoch; it is wrong
if it is off by more than 5 of its sigmas, in position or heading. TIERS has a table with other errors of its
ranges as well: `recorded_claims.py`.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from agent.estimation.following import ClaimRule
from compose.recording.estimating.estimate_rows import PoseEstimateRow
from compose.recording.estimating.estimate_run import estimated
from compose.recording.estimating.recorded_measurements import NoAnchors, measurements
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_recording import RangeRecording
from docs import recorded_claims
from docs.plaza_csv import convert
from docs.recorded_claims import REGION, WRONG_SIGMAS


class Series(NamedTuple):
    """Windows of a recording, and what is estimated in them."""

    name: str
    noise: str | None
    """The name of a profile; None: what the recording states."""
    accuracy: float
    """The accuracy (m) of claims."""
    seconds: float
    """The length of a window in s."""
    step_s: float
    """The time in s from the begin of a window to that of the next."""
    robots: int | None = None
    """The size of the groups of robots; None: all of them are one."""


SERIES = {
    "tiers": (Series("TIERS, pairs", "uwb-calibrated", 0.3, 30.0, 15.0, 2),),
    "lias": (Series("LIAS", "uwb", 0.3, 30.0, 15.0),),
    "plaza": (Series("Plaza 1", "uwb", 1.5, 120.0, 120.0),),
    "mrclam": (
        Series("MRCLAM 6, one robot", None, 0.3, 90.0, 90.0, 1),
        Series("MRCLAM 6, three robots", None, 0.3, 90.0, 90.0, 3),
    ),
    "goats": (Series("GOATS 14", None, 5.0, 700.0, 700.0),),
    "late": (
        Series("late ranges", None, 0.3, 60.0, 60.0),
        Series("late ranges", "uwb", 0.3, 60.0, 60.0),
    ),
}
"""The series by the option that has the path of the recording."""


class Window(NamedTuple):
    """A part of a recording, from which an estimate begins anew."""

    series: Series
    source: Path
    robots: tuple[str, ...]
    begin_s: float


class WindowResult(NamedTuple):
    """The poses of a window."""

    robots: tuple[str, ...]
    rows: tuple[PoseEstimateRow, ...]
    """All poses whose truth is known."""
    first_claim_s: float
    """The time in s until the first claim; NaN without one."""
    cpu_s: float


@cache
def recording_of(source: Path) -> RangeRecording:
    """Return the recording at `source`."""
    return read_ranges(source)


def windows_of(series: Series, source: Path) -> Iterator[Window]:
    """Yield all windows of a series for which the recording is long enough, but for 1 s; at least one."""
    recording = recording_of(source)
    first, last = recording.span
    names = [one.id for one in recording.robots]
    for robots in itertools.combinations(names, series.robots or len(names)):
        begins = np.arange(0.0, max(last - first - series.seconds, 0.0) + 1.0, series.step_s)
        for begin_s in begins.tolist():
            yield Window(series, source, robots, begin_s)


def result_of(window: Window) -> WindowResult | None:
    """Return the poses of a window; None if one or two robots range too few anchors."""
    series, source, robots, begin_s = window
    recording = recording_of(source)
    if series.robots and len(recording.anchors) == 1:
        recording = recorded_claims.with_second_anchor(recording, robots[-1])
    begun = time.process_time()
    try:
        measured = measurements(recording, robots, series.noise, (begin_s, begin_s + series.seconds))
    except NoAnchors:
        return None
    found = [row for row in estimated(measured, ClaimRule(series.accuracy)).rows if row.nees is not None]
    first = min([row.t_s - measured.t0 for row in found if row.claim], default=math.nan)
    return WindowResult(robots, tuple(found), first, time.process_time() - begun)


def is_wrong(row: PoseEstimateRow) -> bool:
    """Return whether a pose is off by more than WRONG_SIGMAS of its sigmas."""
    assert row.position_error_m is not None
    assert row.heading_error_rad is not None
    far = row.position_error_m > WRONG_SIGMAS * math.sqrt(row.xx + row.yy)
    return far or abs(row.heading_error_rad) > WRONG_SIGMAS * math.sqrt(row.hh)


HEAD = (
    "recording", "noise", "accuracy m", "windows", "with a claim", "first claim median s", "claims", "wrong",
    "of robots", "claims in 99 % region %", "poses", "poses in it %", "error of poses p50 m", "CPU s",
)  # fmt: skip


def row_of(series: Series, results: Sequence[WindowResult]) -> str:
    """Return one line of the table."""
    poses = [row for one in results for row in one.rows]
    claims = [row for row in poses if row.claim]
    wrong = [" ".join(one.robots) for one in results if any(row.claim and is_wrong(row) for row in one.rows)]
    firsts = [one.first_claim_s for one in results if math.isfinite(one.first_claim_s)]
    cells = (
        *(series.name, series.noise or "stated", f"{series.accuracy:g}", len(results), len(firsts)),
        f"{np.median(firsts):.1f}" if firsts else "-",
        *(len(claims), sum(is_wrong(row) for row in claims)),
        ", ".join(dict.fromkeys(wrong)) or "-",
        *(_held(claims), len(poses), _held(poses)),
        f"{np.median([row.position_error_m for row in poses]):.2f}" if poses else "-",
        f"{sum(one.cpu_s for one in results):.0f}",
    )
    return "| " + " | ".join(map(str, cells)) + " |"


def _held(rows: Sequence[PoseEstimateRow]) -> str:
    """Return the percentage of poses whose 99 % region holds the truth."""
    held = [row.nees is not None and row.nees <= REGION for row in rows]
    return f"{100.0 * np.mean(held):.0f}" if held else "-"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="claims of recorded robots in all windows")
    for option, (first, *_) in SERIES.items():
        parser.add_argument(f"--{option}", type=Path, metavar="PATH", help=first.name)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args(arguments)
    print("| " + " | ".join(HEAD) + " |\n|" + "---|" * len(HEAD))
    with TemporaryDirectory() as folder, ProcessPoolExecutor(options.workers) as pool:
        for option, several in SERIES.items():
            source = getattr(options, option)
            if source is not None and source.suffix == ".mat":
                convert(source, Path(folder) / option)
                source = Path(folder) / option
            for series in several if source is not None else ():
                results = pool.map(result_of, windows_of(series, source))
                print(row_of(series, [one for one in results if one is not None]), flush=True)


if __name__ == "__main__":
    main()
