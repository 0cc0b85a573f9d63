"""A whole estimate: from measurements to rows and their summary, of a file or as a stream of rows arrives.

In a stream, an epoch is computed as soon as the odometry of all robots has reached its end. Rows must arrive
in the order of time, as in a file: a range that comes later counts from the next epoch on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

from msgspec.structs import replace

from agent.estimation.solver import Solver, UnusableSolution
from compose.errors import UserError
from compose.recording.estimating.estimate_rows import EstimateSummary, PoseEstimateRow, rows_of
from compose.recording.estimating.estimate_summary import summary_of
from compose.recording.estimating.noise_files import AssumedNoise
from compose.recording.estimating.recorded_measurements import (
    EPOCH_S,
    Measurements,
    NoAnchors,
    measurements,
    numerics,
)
from compose.recording.estimating.recording_estimator import ClaimRule, EstimateEpoch, RecordingEstimator
from compose.recording.ranging.range_recording import SAME_TIME_S
from compose.recording.ranging.range_steps import NoSteps
from compose.recording.ranging.recording_rows import AnyRow, OdometryRow, RecordingBuilder, SourcePlace

STREAM_TICKS = 20
"""The number of ticks in an epoch of a stream. A robot of 0.5 m/s then moves by a quarter of 0.05 m in half a
tick; the speed of the robots is not known before they have moved."""

EXAMINED_AFTER_S = 4.0
"""The time in s after which the units are examined for the first time, then whenever it has doubled."""


class RecordingEstimate(NamedTuple):
    """The result of an estimate."""

    rows: list[PoseEstimateRow]
    epochs: list[EstimateEpoch]
    summary: EstimateSummary


class _Estimate:
    """An estimate that grows with its measurements."""

    def __init__(self, rule: ClaimRule, solver: Solver | None) -> None:
        self.rule, self._solver = rule, solver
        self.begin()
        self.measured: Measurements | None = None
        """The measurements of the last epoch."""
        self.rows: list[PoseEstimateRow] = []
        self.epochs: list[EstimateEpoch] = []

    def begin(self) -> None:
        """Begin the estimate of all further measurements again."""
        self.estimator = RecordingEstimator(self.rule, self._solver)

    def advanced(
        self, measured: Measurements, done: Callable[[], None] = lambda: None
    ) -> Iterator[PoseEstimateRow]:
        """Yield the rows of all further epochs; `done` is called after each."""
        if self.measured is None or not self.epochs:
            self.measured = measured
        self.measured = replace(self.measured, doubt=measured.doubt)
        for epoch in self._epochs(measured, done):
            with numerics(measured.source):
                rows = rows_of(epoch, measured.robots)
            self.measured = measured
            self.rows += rows
            self.epochs[-1:] = [one._replace(fitted=None) for one in self.epochs[-1:]]  # fits are large
            self.epochs.append(epoch)
            yield from rows

    def _epochs(self, measured: Measurements, done: Callable[[], None]) -> Iterator[EstimateEpoch]:
        """Yield all further epochs. Raises UserError if a solution of the user's solver cannot be used."""
        try:
            yield from self.estimator.epochs(measured, done, self.epochs[-1].t if self.epochs else -math.inf)
        except UnusableSolution as error:
            raise UserError(f"{self._solver}: {error}") from None

    def result(self, measured: Measurements) -> RecordingEstimate:
        """Return all estimates, the last of which follow from what was `measured`."""
        with numerics(measured.source):
            summary = summary_of(measured, self.rows, self.epochs, self.rule)
        return RecordingEstimate(self.rows, self.epochs, summary)


def estimated(
    measured: Measurements,
    rule: ClaimRule,
    done: Callable[[], None] = lambda: None,
    solver: Solver | None = None,
) -> RecordingEstimate:
    """Return all estimates; `done` is called after each epoch. There are none if the units are doubtful.

    `solver` fits the poses; by default, the smoother does.
    """
    estimate = _Estimate(rule, solver)
    for _ in estimate.advanced(measured, done):
        pass
    return estimate.result(measured)


class StreamEstimate:
    """An estimate that grows with the rows of a stream."""

    def __init__(
        self,
        source: str,
        robots: Sequence[str] | None,
        noise: AssumedNoise | None,
        rule: ClaimRule,
        doubted: Callable[[str], None] = lambda _: None,
        solver: Solver | None = None,
    ) -> None:
        """Begin the estimate of `robots`, with the `noise` that is told.

        None: all robots of the stream. With each further one, the estimate begins again.
        `doubted` is called with the suspicion that parts of the stream are in different units; as long as it
        lasts, nothing is estimated. `solver` fits the poses in place of the smoother.
        """
        self._builder = RecordingBuilder(source)
        self._robots, self._noise, self._doubted = robots, noise, doubted
        self._estimate = _Estimate(rule, solver)
        self._doubt = ""
        self._spans: dict[str, tuple[float, float]] = {}
        """The first and the last time in s of the odometry of each robot."""
        self._count = 0
        """The number of robots in the estimate."""
        self._due_after_s, self._examined_after_s = EPOCH_S, EXAMINED_AFTER_S
        """The times after the first odometry of all robots at which there may be an epoch, and an exam."""

    def rows(self, arriving: Iterable[tuple[AnyRow, SourcePlace]]) -> Iterator[PoseEstimateRow]:
        """Yield the estimates that follow from `arriving` rows, as soon as they do. Raises UserError."""
        for row, place in arriving:
            self._builder.add(row, place)
            if isinstance(row, OdometryRow):
                self._spans[row.robot] = self._spans.get(row.robot, (row.t0,))[0], row.t1
                yield from self._due()

    def _due(self) -> Iterator[PoseEstimateRow]:
        """Yield the estimates of all epochs whose odometry is complete."""
        names = list(self._spans) if self._robots is None else self._robots
        if not names or not all(name in self._spans for name in names):
            return
        if len(names) > self._count:  # the estimates so far are kept, and are of other robots
            self._count = len(names)
            self._estimate.begin()
            self._due_after_s, self._examined_after_s = EPOCH_S, EXAMINED_AFTER_S
        lasts = min(self._spans[name][1] for name in names) - max(self._spans[name][0] for name in names)
        if lasts < self._due_after_s - SAME_TIME_S * EPOCH_S:
            return
        self._due_after_s = lasts + EPOCH_S  # if there is none, it is not tried with each row
        examined = lasts >= self._examined_after_s
        doubt = None if examined else self._doubt
        try:
            measured = measurements(
                self._builder.recording(), names, self._noise, ticks=STREAM_TICKS, doubt=doubt
            )
        except (NoAnchors, NoSteps):
            return  # there will be ranges and odometry
        if examined:
            self._examined_after_s = 2.0 * lasts
        if measured.doubt and measured.doubt != self._doubt:
            self._doubted(measured.doubt)
        self._doubt = measured.doubt
        yield from self._estimate.advanced(measured)
        self._due_after_s = max([measured.t0, *measured.ends[-1:].tolist()]) - measured.t0 + EPOCH_S

    def result(self) -> tuple[Measurements, RecordingEstimate]:
        """Return all estimates so far. Raises UserError if no epoch is complete."""
        measured = self._estimate.measured
        if measured is None:
            what = "no second with odometry of all robots and ranges to two anchors"
            raise UserError(f"{self._builder.source}: there is {what}")
        return measured, self._estimate.result(measured)
