"""The claims of all pairs of recorded robots, as a table: `uv run docs/recorded_claims.py tiers.pyfg`.

The recording has true poses and one anchor. Every ordered pair of its robots is estimated from four starts.
The second robot of a pair ranges to a second anchor, which is made from the truth and from the residuals of
its ranges to the first: the errors are those of a radio. The rows of the table change the ranges further,
with a bias, a scale, outliers, or the errors of raw radios (`--raw FILE`, a CSV file with the columns
`node1`, `node2`, `uwb_range` and `mocap_range`). A wrong claim is off by more than 5 of its sigmas.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from agent.estimation.following import ClaimRule
from compose.recording.estimating.calibration import calibrated, profile_toml
from compose.recording.estimating.estimate_rows import PoseEstimate
from compose.recording.estimating.estimate_summary import summary_of
from compose.recording.estimating.recorded_measurements import measurements
from compose.recording.estimating.recording_estimator import RecordingEstimator
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_recording import (
    FixedAnchor,
    Numbers,
    Places,
    RangeRecording,
    RangeSeries,
    locked,
)

SECOND_ANCHOR = "LC1"
STARTS_S = (0.0, 10.0, 20.0, 30.0)
"""The starts in s."""
LAST_S = 60.0
"""The end of all estimates in s."""
WITHIN_S = 30.0
REGION = 11.34
"""The NEES that 99 % of right covariances do not exceed: chi-square of three degrees of freedom."""
WRONG_SIGMAS = 5.0
SEED = 18
OUTLIERS, OUTLIER_BIAS = 0.05, (0.3, 2.0)
"""The rate of outliers, and the interval (m) of their bias."""


# --- the second anchor --------------------------------------------------------------------------------------


def truth_of(recording: RangeRecording, robot: str) -> tuple[Numbers, Numbers]:
    """Return the times in s, (N,), and the true poses, (N, 3)."""
    truth = recording.robot(robot).truth
    assert truth is not None
    return truth.t, truth.poses


def second_place(recording: RangeRecording) -> tuple[float, float]:
    """Return the place (m) of the second anchor: the first, mirrored at the middle of all true positions."""
    middle = np.mean([np.mean(truth_of(recording, one.id)[1][:, :2], 0) for one in recording.robots], 0)
    anchor = recording.anchors[0]
    return 2.0 * float(middle[0]) - anchor.x, 2.0 * float(middle[1]) - anchor.y


def second_ranges(
    recording: RangeRecording, robot: str, place: tuple[float, float], anchor: int = 0
) -> tuple[Places, Numbers]:
    """Return the rows of the ranges of `robot` to an anchor (its index), and those (m) to one at `place`."""
    first, radios = recording.anchors[anchor], recording.radios
    ranges = recording.ranges
    rows = np.flatnonzero((ranges.first == radios.index(robot)) & (ranges.second == radios.index(first.id)))
    t, poses = truth_of(recording, robot)
    x, y = (np.interp(ranges.t[rows], t, poses[:, axis]) for axis in (0, 1))
    residuals = ranges.range[rows] - np.hypot(x - first.x, y - first.y)
    return rows, np.hypot(x - place[0], y - place[1]) + residuals


def with_second_anchor(recording: RangeRecording, robot: str) -> RangeRecording:
    """Return `recording` with a second anchor, to which `robot` ranges instead of to the first."""
    place, ranges = second_place(recording), recording.ranges
    rows, measured = second_ranges(recording, robot, place)
    second, lengths = ranges.second.copy(), ranges.range.copy()
    second[rows], lengths[rows] = len(recording.radios), measured
    anchors = (*recording.anchors, FixedAnchor(SECOND_ANCHOR, *place))
    series = RangeSeries(ranges.t, ranges.first, locked(second), locked(lengths), ranges.sigma)
    return recording._replace(anchors=anchors, ranges=series)


# --- other errors of ranges ---------------------------------------------------------------------------------


Change = Callable[[RangeRecording], RangeRecording]


def _with(recording: RangeRecording, lengths: Numbers) -> RangeRecording:
    return recording._replace(ranges=recording.ranges._replace(range=lengths))


def unchanged(recording: RangeRecording) -> RangeRecording:
    """Return the recording."""
    return recording


def longer(recording: RangeRecording, bias: float = 0.0, scale: float = 1.0) -> RangeRecording:
    """Return the recording with ranges multiplied by `scale` and with a `bias` (m)."""
    return _with(recording, recording.ranges.range * scale + bias)


def with_outliers(recording: RangeRecording) -> RangeRecording:
    """Return the recording with OUTLIERS of its ranges too long."""
    draws, count = np.random.default_rng(SEED), len(recording.ranges.t)
    stray = draws.random(count) < OUTLIERS
    return _with(recording, recording.ranges.range + stray * draws.uniform(*OUTLIER_BIAS, count))


def with_raw_errors(recording: RangeRecording, raw: Path) -> RangeRecording:
    """Return the recording with errors of raw radios in place of its own: those at the nearest distances.

    Each pair of radios has those of a pair of the file, in the order of both.
    """
    pairs, draws = raw_errors(raw), np.random.default_rng(SEED)
    lengths = recording.ranges.range.copy()
    for i, rows in enumerate(recording.pairs().values()):
        distance, error = pairs[i % len(pairs)]
        near = np.searchsorted(distance, lengths[rows]) + draws.integers(-NEAREST, NEAREST + 1, len(rows))
        lengths[rows] = np.maximum(lengths[rows] + error[np.clip(near, 0, len(error) - 1)], 0.0)
    return _with(recording, lengths)


NEAREST = 20
"""The number of raw ranges to either side, by their distance, of which one gives its error."""


@cache
def raw_errors(raw: Path) -> list[tuple[Numbers, Numbers]]:
    """Return for each pair of radios of the file its true distances (m), sorted, and errors (m)."""
    with raw.open() as file:
        rows = list(csv.DictReader(file))
    found = []
    for pair in dict.fromkeys((row["node1"], row["node2"]) for row in rows):
        own = [row for row in rows if (row["node1"], row["node2"]) == pair]
        values = np.array(sorted([(float(row["mocap_range"]), float(row["uwb_range"])) for row in own]))
        values = values[np.all(np.isfinite(values), 1)]
        found.append((values[:, 0], values[:, 1] - values[:, 0]))
    return found


# --- the table ----------------------------------------------------------------------------------------------


class Trial(NamedTuple):
    """One pair from one start."""

    source: Path
    robots: tuple[str, str]
    start_s: float
    change: Change
    noise: str
    """The name of a profile, or OTHERS."""
    accuracy: float


OTHERS = "calibrated on others"
"""A profile that `tandem calibrate` makes from the ranges between the other robots."""


class Claimed(NamedTuple):
    """The result of a trial."""

    after_s: float
    """The time in s until both robots could claim; infinite if they never could."""
    claims: tuple[PoseEstimate, ...]
    cpu_s: float


@cache
def recording_of(source: Path) -> RangeRecording:
    """Return the recording at `source`; with ranges to the first anchor in place of a second."""
    whole = read_ranges(source)
    first, *others = whole.anchors
    if [one.id for one in others] != [SECOND_ANCHOR]:
        return whole
    second, lengths = whole.ranges.second.copy(), whole.ranges.range.copy()
    for robot in whole.robots:
        rows, measured = second_ranges(whole, robot.id, (first.x, first.y), anchor=1)
        second[rows], lengths[rows] = len(whole.robots), measured
    ranges = whole.ranges._replace(second=locked(second), range=locked(lengths))
    return whole._replace(anchors=(first,), ranges=ranges)


def claimed(trial: Trial) -> Claimed:
    """Return when both robots of a trial could claim, and which poses."""
    whole = recording_of(trial.source)
    recording = trial.change(with_second_anchor(whole, trial.robots[1]))
    with TemporaryDirectory() as folder:
        noise = trial.noise
        if noise == OTHERS:
            noise = str(Path(folder) / "others.toml")
            others = [one.id for one in whole.robots if one.id not in trial.robots]
            Path(noise).write_text(_profile(trial.change(whole), others))
        problem = measurements(recording, trial.robots, noise, (trial.start_s, LAST_S))
    rule, begun = ClaimRule(trial.accuracy), time.process_time()
    claiming = (one for one in RecordingEstimator(rule).epochs(problem) if all(one.claims))
    epoch = next(claiming, None)
    cpu_s = time.process_time() - begun
    if epoch is None:
        return Claimed(math.inf, (), cpu_s)
    summary = summary_of(problem, [epoch], rule)
    claims = tuple([one.final for one in summary.robots.values() if one.final is not None])
    return Claimed(epoch.t - problem.t0, claims, cpu_s)


def _profile(recording: RangeRecording, robots: Sequence[str]) -> str:
    found = calibrated(recording, robots, None)
    anchors = frozenset([one.id for one in recording.anchors])
    return profile_toml(found, anchors, "the truth")


def row_of(name: str, trials: Sequence[Trial], results: Sequence[Claimed]) -> str:
    """Return one line of the table."""
    after = np.array([one.after_s for one in results])
    claims = [claim for one in results for claim in one.claims]
    errors = np.array([one.position_error_m for one in claims] or [math.nan])
    nees = np.array([one.nees for one in claims] or [math.nan])
    sigmas = np.array([math.sqrt(one.covariance[0][0] + one.covariance[1][1]) for one in claims] or [1.0])
    headings = np.array([one.heading_error_rad or 0.0 for one in claims] or [0.0])
    of_heading = np.array([math.sqrt(one.covariance[2][2]) for one in claims] or [1.0])
    off = (errors > WRONG_SIGMAS * sigmas) | (np.abs(headings) > WRONG_SIGMAS * of_heading)
    done = np.isfinite(after)
    median = float(np.median(after[done])) if np.any(done) else math.nan
    cells = (
        name,
        trials[0].noise,
        f"{trials[0].accuracy:g}",
        f"{np.count_nonzero(done)} of {len(results)}",
        f"{100.0 * np.mean(after <= WITHIN_S):.0f}",
        f"{median:.1f}",
        f"{np.percentile(errors, 50):.2f}",
        f"{np.percentile(errors, 90):.2f}",
        f"{100.0 * np.mean(nees <= REGION):.1f}",
        str(int(np.count_nonzero(off))),
        f"{np.mean([one.cpu_s for one in results]):.2f}",
    )
    return "| " + " | ".join(cells) + " |"


HEAD = (
    "ranges", "noise", "accuracy m", "claims", "within 30 s %", "median s", "error p50 m", "p90 m",
    "truth in 99 % region %", "wrong", "CPU s",
)  # fmt: skip


def rows_to_make(raw: Path | None) -> list[tuple[str, Change, str, float]]:
    """Return the name, the change, the noise and the accuracy (m) of each row."""
    bias, scale = partial(longer, bias=0.35), partial(longer, scale=1.07)
    rows: list[tuple[str, Change, str, float]] = [
        ("as recorded", unchanged, "uwb-calibrated", accuracy) for accuracy in (0.3, 0.25)
    ]
    for accuracy in (0.5, 0.3):
        rows += [("+0.35 m", bias, "uwb", accuracy), ("x 1.07", scale, "uwb", accuracy)]
        rows += [("5 % outliers", with_outliers, "uwb", accuracy)]
        if raw is not None:
            rows.append(("raw radios", partial(with_raw_errors, raw=raw), "uwb", accuracy))
    rows += [("+0.35 m", bias, OTHERS, 0.3), ("x 1.07", scale, OTHERS, 0.3)]
    if raw is not None:
        rows.append(("raw radios", partial(with_raw_errors, raw=raw), OTHERS, 0.3))
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="claims of all pairs of recorded robots")
    parser.add_argument("recording", type=Path)
    parser.add_argument("--raw", type=Path)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    print("| " + " | ".join(HEAD) + " |\n|" + "---|" * len(HEAD))
    with ProcessPoolExecutor(options.workers) as pool:
        for name, change, noise, accuracy in rows_to_make(options.raw):
            trials = trials_of(options.recording, change, noise, accuracy)
            print(row_of(name, trials, list(pool.map(claimed, trials, chunksize=4))), flush=True)


def trials_of(
    source: Path, change: Change, noise: str, accuracy: float, starts_s: Sequence[float] = STARTS_S
) -> list[Trial]:
    """Return the trials of one row: all ordered pairs of robots, from all starts."""
    pairs = itertools.permutations([one.id for one in recording_of(source).robots], 2)
    return [Trial(source, pair, start_s, change, noise, accuracy) for pair in pairs for start_s in starts_s]


if __name__ == "__main__":
    main()
