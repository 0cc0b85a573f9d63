"""A whole estimate: from a recording and a user's choices to its rows and its summary."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from compose.errors import NoEstimate, UserError
from compose.recording.estimating.doubtful_units import doubtful_units
from compose.recording.estimating.estimate_epoch import ClaimRule, EstimateEpoch, add_epoch
from compose.recording.estimating.estimate_rows import EstimateSummary, PoseEstimateRow, rows_of, summary_of
from compose.recording.estimating.group_estimate import GroupEstimator
from compose.recording.estimating.group_measurements import (
    check_anchors,
    group_measurements,
)
from compose.recording.estimating.noise_files import ToldNoise, told_noise
from compose.recording.estimating.prepared_steps import Measurements
from compose.recording.estimating.recorded_noise import recorded_noise
from compose.recording.estimating.true_poses import with_bridged_truth
from compose.recording.ranging.range_recording import RangeRecording, RecordedRobot


@contextmanager
def numerics(where: str) -> Iterator[None]:
    """Raise NoEstimate, which begins with `where`, if numbers in the block leave the range of floats.

    They may in a valid recording, with values of 1e7 m or 1e-300 m. Other errors are not hidden.
    """
    try:
        with np.errstate(all="ignore"):
            yield
    except (np.linalg.LinAlgError, ArithmeticError) as error:
        raise NoEstimate(f"{where}: its numbers are too large or small for an estimate ({error})") from None


class EstimationProblem(NamedTuple):
    """The measurements of some robots, and what is known of their source."""

    measured: Measurements
    robots: tuple[RecordedRobot, ...]
    """The robots, with their truth if there is one."""
    source: str
    noise: str
    """The name of the assumed noise."""
    doubt: str = ""
    """The suspicion that parts of the recording are in different units; with one, nothing is estimated."""


class RecordingEstimate(NamedTuple):
    """The result of an estimate."""

    rows: list[PoseEstimateRow]
    epochs: list[EstimateEpoch]
    summary: EstimateSummary


def measurements(
    recording: RangeRecording,
    robots: Sequence[str] | None,
    noise: str | None,
    window: tuple[float, float] | None,
) -> EstimationProblem:
    """Return the measurements of `robots` within `window`, in s from the first odometry on.

    `noise` is the name of a profile or the path of a file; None: what the recording states. Raises UserError.
    """
    told = told_noise(noise) if noise is not None else None
    return measurements_with(recording, robots, told, noise or "", window)


def measurements_with(
    recording: RangeRecording,
    robots: Sequence[str] | None,
    told: ToldNoise | None,
    name: str = "",
    window: tuple[float, float] | None = None,
    *,
    ticks: int | None = None,
    doubtful: bool = True,
) -> EstimationProblem:
    """Return the measurements as `measurements` does, with the noise `told`, whose name is `name`.

    `ticks` is the number of ticks in an epoch; None: by the speed of the robots. The units are examined if
    `doubtful` is set.
    """
    chosen = chosen_robots(recording, robots)
    begin, end = recording.span
    if window is not None:
        begin, end = begin + window[0], min(begin + window[1], end)
        if begin >= end:
            lasts = recording.span[1] - recording.span[0]
            raise UserError(f"--window: {recording.source} has odometry of {lasts:.3f} s")
    part = recording.part(chosen, begin, end)
    assumed = recorded_noise(part, told.noise if told is not None else None, name)
    if told is not None and told.correction is not None:
        part = told.correction.corrected(part)
    with numerics(recording.source):
        measured = group_measurements(part, chosen, assumed, ticks=ticks)
        check_anchors(part, chosen)
        doubt = doubtful_units(part) if doubtful else ""
        true = tuple([with_bridged_truth(one) for one in part.robots])
    return EstimationProblem(measured, true, recording.source, assumed.name, doubt)


def chosen_robots(recording: RangeRecording, robots: Sequence[str] | None) -> Sequence[str]:
    """Return `robots`, or all of the recording. Raises UserError if it has not all of them."""
    known = [one.id for one in recording.robots]
    names = known if robots is None else robots
    for name in names:
        if name not in known:
            raise UserError(f"--robots: {recording.source} has no robot {name}; it has {', '.join(known)}")
    return names


class RecordingEstimator:
    """The estimate of any number of robots, which goes on from epoch to epoch."""

    def __init__(self, rule: ClaimRule) -> None:
        self._estimator = GroupEstimator(rule)

    def epoch(self, problem: EstimationProblem, number: int) -> EstimateEpoch:
        """Return the estimate at the end of the epoch with this `number`, from 1 on, in their order.

        The measurements may have grown since the last call, and are otherwise the same. Raises NoEstimate if
        numbers leave the range of floats (see `numerics`).
        """
        with numerics(f"{problem.source}: at {problem.measured.end(number):.15g} s"):
            epoch = self._estimator.epoch(problem.measured, number)
            known = [i for i, one in enumerate(problem.robots) if one.id not in epoch.undetermined]
            for one in epoch.hypotheses:
                if not np.all(np.isfinite(one.poses[known])):
                    raise FloatingPointError("a pose is not finite")
            return epoch


def estimated(
    problem: EstimationProblem, rule: ClaimRule, done: Callable[[], None] = lambda: None
) -> RecordingEstimate:
    """Return all estimates; `done` is called after each epoch. There are none if the units are doubtful."""
    rows: list[PoseEstimateRow] = []
    epochs: list[EstimateEpoch] = []
    estimator = RecordingEstimator(rule)
    for number in range(1, problem.measured.epochs + 1 if not problem.doubt else 1):
        if not problem.measured.is_silent(number):
            epoch = estimator.epoch(problem, number)
            with numerics(problem.source):
                rows += rows_of(epoch, problem.robots)
            add_epoch(epochs, epoch)
        done()
    return with_summary(problem, rows, epochs, rule)


def with_summary(
    problem: EstimationProblem, rows: list[PoseEstimateRow], epochs: list[EstimateEpoch], rule: ClaimRule
) -> RecordingEstimate:
    """Return the result of all `rows` and `epochs`."""
    last = epochs[-1] if epochs else None
    about = problem.source, problem.noise, problem.doubt
    with numerics(problem.source):
        summary = summary_of(problem.measured, rows, last, rule, *about)
    return RecordingEstimate(rows, epochs, summary)
