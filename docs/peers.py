"""Tandem beside the estimators that people use today, on recorded ranges: `uv run docs/peers.py`.

It measures all windows of 30 s of the first minute of TIERS, which is in tests/data/uwb, or of recordings
whose paths are given, and writes the results to peers.json, from which `uv run docs/reference.py` makes the
tables of the documentation. Results of other recordings stay as they are.

All estimators get the same facts: the odometry that Tandem has cleaned, the ranges that it uses, the sigmas
of both, and the priors of biases as far as they have biases (see peer_estimators.py). Nobody knows a start.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import lzma
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import msgspec
import numpy as np

from agent.estimation.following import ClaimRule
from compose.recording.estimating.recorded_measurements import Measurements, NoAnchors, measurements
from compose.recording.estimating.recording_estimator import RecordingEstimator
from compose.recording.estimating.true_poses import true_pose
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_recording import RangeRecording
from docs import peer_estimators as peers
from docs import recorded_claims
from docs.peer_tables import RAW, RESULTS, TANDEM, TIERS, Results, Trial, code_hash, results, table
from docs.picture import here
from docs.plaza_csv import convert
from protocol.motion import wrap

WINDOW_S, PLAZA_STEP_S = 30.0, 120.0
SEED = 45
ACCURACY_M = 0.3
ESTIMATORS: Mapping[str, Callable[[peers.Problem, np.random.Generator], peers.Solution]] = {
    "gtsam LM, true start": peers.lm_from_truth,
    "gtsam LM, one random start": peers.lm,
    "gtsam LM Huber, one random start": partial(peers.lm, huber=True),
    "gtsam LM Huber, best of 8": partial(peers.lm, huber=True, starts=peers.RESTARTS),
    "gtsam LM Huber, best of 8, wide sigma": partial(
        peers.lm, huber=True, widened=True, starts=peers.RESTARTS
    ),
    "gtsam iSAM2, one random start": peers.isam2,
    "gtsam iSAM2, best of 8": partial(peers.isam2, starts=peers.RESTARTS),
    "scipy, biases, best of 12": peers.scipy_starts,
    "particle filter, 50 000 particles": peers.particle_filter,
    "EKF, one random start": partial(peers.kalman_filters, count=1),
    "EKF, the likeliest of 4 096": peers.kalman_filters,
}
"""The estimators beside Tandem, by their names in the tables."""


class Window(NamedTuple):
    """A part of a recording, from which an estimate begins anew."""

    recording: str
    """The name of the recording, as in the tables."""
    ranges: str
    """The change that was made to its ranges."""
    source: Path
    robots: tuple[str, ...]
    begin_s: float
    noise: str | None

    @property
    def name(self) -> str:
        """The robots and the beginning."""
        return f"{' '.join(self.robots)} {self.begin_s:g}"


# --- windows ------------------------------------------------------------------------------------------------


PROFILES = {"as recorded": "uwb-calibrated", "+0.35 m": "uwb", "raw radios": "uwb"}
"""The changes of the ranges of TIERS, each with the profile that is assumed."""


def tiers_windows(source: Path, step_s: float = WINDOW_S) -> Iterator[Window]:
    """Yield both halves of the first minute, for each pair of the four robots."""
    for ranges, noise in PROFILES.items():
        for pair in itertools.combinations(
            [one.id for one in recorded_claims.recording_of(source).robots], 2
        ):
            for begin_s in np.arange(0.0, 60.0 - WINDOW_S + 1.0, step_s).tolist():
                yield Window("TIERS", ranges, source, pair, begin_s, noise)


def windows_of(
    name: str,
    source: Path,
    noise: str | None,
    robots: Sequence[tuple[str, ...]] = (),
    step_s: float = WINDOW_S,
) -> Iterator[Window]:
    """Yield the windows of another recording, every `step_s`; of its only robot, if none are named."""
    recording = read_ranges(source)
    first, last = recording.span
    for own in robots or [tuple(one.id for one in recording.robots)]:
        for begin_s in np.arange(0.0, last - first - WINDOW_S, step_s).tolist():
            yield Window(name, "as recorded", source, own, begin_s, noise)


@cache
def _changed(window: Window, raw: Path | None) -> RangeRecording:
    if window.recording != "TIERS":
        return read_ranges(window.source)
    whole = recorded_claims.recording_of(window.source)
    found = recorded_claims.with_second_anchor(whole, window.robots[1])
    match window.ranges:
        case "+0.35 m":
            return recorded_claims.longer(found, bias=0.35)
        case "raw radios" if raw is not None:
            return recorded_claims.with_raw_errors(found, raw)
    return found


def measured_in(window: Window, raw: Path | None) -> Measurements:
    """Return the measurements in a window, with one epoch: all of it."""
    whole = (window.begin_s, window.begin_s + WINDOW_S)
    found = measurements(_changed(window, raw), window.robots, window.noise, whole)
    return msgspec.structs.replace(
        found,
        ends=found.ends[-1:],
        silent=np.zeros(1, bool),
        ticks_per_epoch=found.ticks_per_epoch * len(found.ends),
    )


def true_antenna(measured: Measurements, robot: str, tick: int) -> peers.Array:
    """Return the true pose of a robot's antenna at a tick, relative to the origin of the measurements."""
    recorded = next(one.recorded for one in measured.robots if one.id == robot)
    pose = true_pose(recorded, float(measured.time_of(np.array([tick]))[0]))
    if pose is None:
        return np.full(3, math.nan)
    forward, left, _ = recorded.antenna
    offset = (forward + 1j * left) * np.exp(1j * pose[2])
    origin = measured.joint.origin
    return np.array((pose[0] + offset.real - origin[0], pose[1] + offset.imag - origin[1], pose[2]))


# --- trials -------------------------------------------------------------------------------------------------


def tandem(measured: Measurements) -> tuple[peers.Solution, int]:
    """Return Tandem's first hypothesis, of one search over the window, and how many poses it may claim."""
    epoch = next(RecordingEstimator(ClaimRule(ACCURACY_M)).epochs(measured))
    if epoch.fitted is None:
        raise RuntimeError(epoch.blocking_reason)
    fit = epoch.fitted.fit
    return peers.Solution(fit.poses, fit.covariance), sum(epoch.claims)


def tried(window: Window, raw: Path | None, estimators: Sequence[str]) -> list[Trial]:
    """Return what Tandem and the named `estimators` make of a window; nothing if nobody ranges an anchor."""
    try:
        measured = measured_in(window, raw)
    except NoAnchors:
        return []
    joint = measured.until(0)
    end = min(len(path.v) for path in joint.paths)
    starts, ends = (
        np.array([true_antenna(measured, robot, tick) for robot in joint.robots]) for tick in (0, end)
    )
    problem = peers.Problem(joint, end, starts)
    ranged = all(np.any(joint.ranges.to_anchors(robot)) for robot in problem.robots)
    if not ranged or not np.all(np.isfinite((starts, ends))):
        return []
    draws = [int(hashlib.sha256(f"{SEED} {window.ranges} {window.name}".encode()).hexdigest()[:8], 16)]
    found = []
    for name in (TANDEM, *estimators):
        begun, claims, solution = time.process_time(), 0, None
        try:
            with np.errstate(all="ignore"):
                if name == TANDEM:
                    solution, claims = tandem(measured)
                else:
                    solution = ESTIMATORS[name](problem, np.random.default_rng(draws))
        except (RuntimeError, np.linalg.LinAlgError):
            pass  # singular: no estimate
        cpu_s = time.process_time() - begun
        errors, nees = _judged(solution, ends)
        found.append(
            Trial(
                window.recording,
                window.ranges,
                window.name,
                name,
                errors,
                nees,
                _digits(cpu_s) or 0.0,
                claims,
            )
        )
    return found


def _judged(
    solution: peers.Solution | None, truth: peers.Array
) -> tuple[tuple[float | None, ...], tuple[float | None, ...]]:
    if solution is None:
        return (None,) * len(truth), (None,) * len(truth)
    errors, nees = list[float | None](), list[float | None]()
    for robot, (pose, true) in enumerate(zip(solution.poses, truth, strict=True)):
        off = np.array((*(pose - true)[:2], wrap(float(pose[2] - true[2]))))
        own = slice(3 * robot, 3 * robot + 3)
        errors.append(_digits(math.hypot(off[0], off[1])))
        nees.append(_digits(float(off @ np.linalg.pinv(solution.covariance[own, own]) @ off)))
    return tuple(errors), tuple(nees)


def _digits(value: float) -> float | None:
    return float(f"{value:.4g}") if math.isfinite(value) else None


def unpacked(folder: Path) -> tuple[Path, Path]:
    """Unpack TIERS and RAW into `folder`, and return their paths."""
    for path in (TIERS, RAW):
        (folder / path.stem).write_bytes(lzma.decompress(path.read_bytes()))
    return folder / TIERS.stem, folder / RAW.stem


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all windows and write RESULTS, or print the table of some."""
    parser = argparse.ArgumentParser(description="Tandem beside other estimators, on recorded ranges")
    parser.add_argument("--lias", type=Path, metavar="FOLDER", help="CSV files of LIAS")
    parser.add_argument("--plaza", type=Path, metavar="FILE", help="Plaza1_.mat")
    parser.add_argument("--mrclam", type=Path, metavar="FILE", help="MRCLAM as PyFactorGraph")
    parser.add_argument("--only", help="the windows whose recording, ranges or name contain this text")
    parser.add_argument("--peers", help="the estimators whose names contain this text")
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args(arguments)
    some = options.only is not None or options.peers is not None
    named = [one for one in ESTIMATORS if (options.peers or "") in one]
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        source, raw = unpacked(folder)
        others = options.lias or options.plaza or options.mrclam
        windows = [] if others else list(tiers_windows(source))
        if options.lias is not None:
            windows += windows_of("LIAS", options.lias, "uwb")
        if options.plaza is not None:
            convert(options.plaza, folder / "plaza")
            windows += windows_of("Plaza 1", folder / "plaza", "uwb", step_s=PLAZA_STEP_S)
        if options.mrclam is not None:
            windows += windows_of("MRCLAM 6", options.mrclam, None, [("A", "B"), ("C", "D")])
        windows = [
            one for one in windows if (options.only or "") in f"{one.recording}, {one.ranges}, {one.name}"
        ]
        os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "TBB_NUM_THREADS"), "1")
        with ProcessPoolExecutor(options.workers, multiprocessing.get_context("spawn")) as pool:
            trials = []
            for own in pool.map(partial(tried, raw=raw, estimators=named), windows):
                trials += own
                print(*own[:1], flush=True)
    for row in table(trials):
        print("| " + " | ".join(row) + " |")
    if not some:
        done = {one.recording for one in trials}
        kept = results().trials if RESULTS.exists() else []
        trials = [*trials, *[one for one in kept if one.recording not in done]]
        known = results() if others else None  # of TIERS, which is not measured again
        packages = {one: version(one) for one in ("gtsam", "scipy", "numpy")}
        content = msgspec.to_builtins(Results(known.code if known else code_hash(), here(), packages, trials))
        lines = ",\n".join(json.dumps(one) for one in content.pop("trials"))
        RESULTS.write_text(json.dumps(content)[:-1] + f', "trials": [\n{lines}\n]}}\n')


if __name__ == "__main__":
    main()
