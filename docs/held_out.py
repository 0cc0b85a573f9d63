"""Ranges that no estimate has used, predicted by it and by the true poses: `uv run docs/held_out.py PATH`.

True poses have errors, too. Each anchor in turn is left out of the recording, and its ranges are predicted by
the smoothed path of the estimate from all others, and by the recorded truth. Where the truth misses them by
more than the estimate does, it is the worse of the two, and cannot tell whether a claim is wrong.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from agent.estimation.following import ClaimRule
from compose.errors import UserError
from compose.recording.estimating.estimate_run import estimated
from compose.recording.estimating.radio_errors import PairErrors, range_calibration
from compose.recording.estimating.recorded_measurements import measurements
from compose.recording.estimating.true_poses import true_antenna
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_recording import Numbers, RangeRecording

Window = tuple[float, float]


def without(recording: RangeRecording, anchor: str) -> RangeRecording:
    """Return the recording without the ranges of an anchor."""
    kept = recording.ranges.second != recording.radios.index(anchor)
    return recording._replace(ranges=recording.ranges.rows(kept))


def estimated_path(recording: RangeRecording, robot: str, window: Window, accuracy: float) -> Numbers:
    """Return the time (s), x and y (m) of a robot at each tick, by all measurements; shape (K, 3).

    Raises UserError if they do not locate it.
    """
    measured = measurements(recording, [robot], None, window)
    fitted = estimated(measured, ClaimRule(accuracy)).epochs[-1].fitted
    if fitted is None:
        raise UserError(f"{recording.source}: without an anchor, {robot} has no pose")
    path, origin = fitted.fit.paths[0], fitted.used.origin
    times = measured.time_of(np.arange(len(path)))
    return np.column_stack((times, path[:, 0] + origin[0], path[:, 1] + origin[1]))


def errors_of(
    recording: RangeRecording, anchor: str, robot: str, path: Numbers
) -> tuple[PairErrors, PairErrors]:
    """Return the errors of the ranges of an anchor against the `path` of a robot, and against its truth."""
    radios = recording.radios
    place = next(np.array((one.x, one.y)) for one in recording.anchors if one.id == anchor)
    who = next(one for one in recording.robots if one.id == robot)
    ends = recording.ranges.first == radios.index(robot), recording.ranges.second == radios.index(anchor)
    rows = recording.ranges.rows(ends[0] & ends[1])
    rows = rows.rows((rows.t >= path[0, 0]) & (rows.t <= path[-1, 0]))
    x, y = [np.interp(rows.t, path[:, 0], path[:, axis]) for axis in (1, 2)]
    found = []
    for at in (np.column_stack((x, y)), true_antenna(who, rows.t)[:, :2]):
        error = rows.range - np.hypot(*(at - place).T)
        known = np.isfinite(error)
        found.append(PairErrors(rows.t[known], rows.range[known], error[known]))
    return found[0], found[1]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="ranges of anchors that were left out, predicted")
    parser.add_argument("recording", type=Path)
    parser.add_argument("--seconds", type=float, default=700.0, help="the length of a window")
    parser.add_argument("--accuracy", type=float, default=5.0, help="the accuracy of claims in m")
    options = parser.parse_args(arguments)
    recording = read_ranges(options.recording)
    first, last = recording.span
    print("| begin s | anchor left out | ranges | sigma by the estimate m | sigma by the truth m |")
    print("|---|---|---|---|---|")
    for begin in np.arange(0.0, max(last - first - options.seconds, 0.0) + 1.0, options.seconds).tolist():
        for anchor in [one.id for one in recording.anchors]:
            for robot in [one.id for one in recording.robots]:
                window = (begin, begin + options.seconds)
                path = estimated_path(without(recording, anchor), robot, window, options.accuracy)
                both = errors_of(recording, anchor, robot, path)
                sigmas = [_sigma(one) for one in both]
                print(f"| {begin:g} | {anchor} | {len(both[0].t)} | {sigmas[0]:.2f} | {sigmas[1]:.2f} |")


def _sigma(errors: PairErrors) -> float:
    """Return the standard deviation of errors about their line, without outliers."""
    return range_calibration({("robot", "anchor"): errors}, "either").pairs["robot", "anchor"].sigma


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        raise SystemExit(f"held_out.py: {error}") from None
