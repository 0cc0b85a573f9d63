"""The final estimates of one recorded robot in all windows: `uv run docs/recorded_windows.py plaza1`.

The recording has several anchors and true poses. It is cut into windows of 120 s (`--seconds`), each of which
is estimated for itself, from an unknown pose. The noise is the profile `uwb` (`--noise`).
"""

from __future__ import annotations

import argparse
import math
import time
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from agent.estimation.following import ClaimRule
from compose.recording.estimating.estimate_run import estimated
from compose.recording.estimating.recorded_measurements import measurements
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_recording import RangeRecording

REGION = 11.34
"""The NEES that 99 % of right covariances do not exceed: chi-square of three degrees of freedom."""
SURE, FAR_M = 0.9999, 5.0


class WindowResult(NamedTuple):
    """The final estimate of one window."""

    error_m: float
    nees: float
    probability: float
    claim: bool
    cpu_s: float


@cache
def recording_of(source: Path) -> RangeRecording:
    """Return the recording at `source`."""
    return read_ranges(source)


def result_of(begin_s: float, source: Path, seconds: float, noise: str, accuracy: float) -> WindowResult:
    """Return the final estimate of the window that begins at `begin_s` s."""
    begun = time.process_time()
    problem = measurements(recording_of(source), None, noise, (begin_s, begin_s + seconds))
    rows = estimated(problem, ClaimRule(accuracy)).rows
    cpu_s = time.process_time() - begun
    if not rows or rows[-1].position_error_m is None or rows[-1].nees is None:
        return WindowResult(math.nan, math.nan, 0.0, False, cpu_s)
    last = rows[-1]
    assert last.position_error_m is not None
    assert last.nees is not None
    return WindowResult(last.position_error_m, last.nees, last.probability, last.claim, cpu_s)


def main() -> None:
    """Print one line for each window, and the figures of all."""
    parser = argparse.ArgumentParser(description="final estimates of one recorded robot in all windows")
    parser.add_argument("recording", type=Path)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--noise", default="uwb")
    parser.add_argument("--accuracy", type=float, default=1.5)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    first, last = recording_of(options.recording).span
    begins = np.arange(0.0, last - first - options.seconds + 1.0, options.seconds).tolist()
    of = partial(
        result_of,
        source=options.recording,
        seconds=options.seconds,
        noise=options.noise,
        accuracy=options.accuracy,
    )
    results = []
    with ProcessPoolExecutor(options.workers) as pool:
        for begin_s, one in zip(begins, pool.map(of, begins), strict=True):
            results.append(one)
            claim = "claim" if one.claim else ""
            error = f"error {one.error_m:6.2f} m  NEES {one.nees:8.1f}"
            print(f"{begin_s:6.0f} s  {error}  probability {one.probability:.5f} {claim}", flush=True)
    errors, nees = np.array([one.error_m for one in results]), np.array([one.nees for one in results])
    sure = np.array([one.probability >= SURE for one in results])
    print(
        f"{len(results)} windows: median error {np.nanmedian(errors):.2f} m, truth in the 99 % region in "
        f"{100.0 * np.mean(nees <= REGION):.0f} %, sure and more than {FAR_M:g} m off "
        f"{np.count_nonzero(sure & (errors > FAR_M))}, CPU {np.mean([one.cpu_s for one in results]):.1f} s"
    )


if __name__ == "__main__":
    main()
