"""The estimate of a stream of rows, at the rate of their arrival.

An epoch is computed as soon as the odometry of all robots has reached its end. Rows must arrive in the order
of time, as in a file: a range that comes later counts from the next epoch on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence

from compose.errors import UserError
from compose.recording.estimating.estimate_epoch import ClaimRule, EstimateEpoch, add_epoch
from compose.recording.estimating.estimate_rows import PoseEstimateRow, rows_of
from compose.recording.estimating.estimate_run import (
    EstimationProblem,
    RecordingEstimate,
    RecordingEstimator,
    measurements_with,
    numerics,
    with_summary,
)
from compose.recording.estimating.group_measurements import NoAnchors
from compose.recording.estimating.noise_files import ToldNoise
from compose.recording.estimating.prepared_steps import EPOCH_S
from compose.recording.ranging.range_recording import SAME_TIME_S
from compose.recording.ranging.range_steps import NoSteps
from compose.recording.ranging.recording_rows import (
    AnyRow,
    OdometryRow,
    RecordingBuilder,
    SourcePlace,
)

STREAM_TICKS = 20
"""The number of ticks in an epoch of a stream. A robot of 0.5 m/s then moves by a quarter of 0.05 m in half a
tick; the speed of the robots is not known before they have moved."""

EXAMINED_AFTER_S = 4.0
"""The time in s after which the units are examined for the first time, then whenever it has doubled."""


class StreamEstimate:
    """An estimate that grows with the rows of a stream."""

    def __init__(
        self,
        source: str,
        robots: Sequence[str] | None,
        noise: tuple[ToldNoise, str] | None,
        rule: ClaimRule,
        doubted: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Begin the estimate of `robots`, with the noise and its name.

        None: all robots of the stream. With each further one, the estimate begins again.
        `doubted` is called with the suspicion that parts of the stream are in different units; as long as it
        lasts, nothing is estimated.
        """
        self._doubted, self._doubt, self._examined_after_s = doubted, "", EXAMINED_AFTER_S
        self._builder = RecordingBuilder(source)
        self._robots = robots
        self._told = noise[0] if noise is not None else None
        self._name = noise[1] if noise is not None else ""
        self._rule = rule
        self._estimator = RecordingEstimator(rule)
        self._begins: dict[str, float] = {}
        self._ends: dict[str, float] = {}
        self._next = 1
        self._due_after_s = EPOCH_S
        """The time after the first odometry of all robots at which there may be an epoch."""
        self._count = 0
        """The number of robots in the estimate."""
        self._problem: EstimationProblem | None = None
        """That of the last epoch."""
        self._rows: list[PoseEstimateRow] = []
        self._epochs: list[EstimateEpoch] = []

    def rows(self, arriving: Iterable[tuple[AnyRow, SourcePlace]]) -> Iterator[PoseEstimateRow]:
        """Yield the estimates that follow from `arriving` rows, as soon as they do. Raises UserError."""
        for row, place in arriving:
            self._builder.add(row, place)
            if isinstance(row, OdometryRow):
                self._begins.setdefault(row.robot, row.t0)
                self._ends[row.robot] = row.t1
                yield from self._due()

    def _due(self) -> Iterator[PoseEstimateRow]:
        """Yield the estimates of all epochs whose odometry is complete."""
        names = list(self._begins) if self._robots is None else self._robots
        if not names or not all(name in self._begins for name in names):
            return
        if len(names) > self._count:
            self._count = len(names)
            self._begin_again()
        begin = max(self._begins[name] for name in names)
        end = min(self._ends[name] for name in names)
        if end - begin < self._due_after_s - SAME_TIME_S * EPOCH_S:
            return
        self._due_after_s = end - begin + EPOCH_S  # if there is none, it is not tried with each row
        examined = end - begin >= self._examined_after_s
        try:
            problem = measurements_with(
                self._builder.recording(),
                names,
                self._told,
                self._name,
                ticks=STREAM_TICKS,
                doubtful=examined,
            )
        except (NoAnchors, NoSteps):
            return  # there will be ranges and odometry
        if examined:
            self._examined_after_s = 2.0 * (end - begin)
            if problem.doubt and problem.doubt != self._doubt:
                self._doubted(problem.doubt)
            self._doubt = problem.doubt
        self._problem = (self._problem if self._problem and self._epochs else problem)._replace(
            doubt=self._doubt
        )
        measured = problem.measured
        if self._doubt:
            self._next = measured.epochs + 1
        while self._next <= measured.epochs:
            number = self._next
            self._next += 1
            before = self._epochs[-1].t if self._epochs else -math.inf
            if measured.is_silent(number) or measured.end(number) <= before:
                continue
            epoch = self._estimator.epoch(problem, number)
            self._problem = problem
            with numerics(problem.source):
                found = rows_of(epoch, problem.robots)
            self._rows += found
            add_epoch(self._epochs, epoch)
            yield from found
        self._due_after_s = measured.end(measured.epochs) - measured.t0 + EPOCH_S

    def _begin_again(self) -> None:
        """Forget what follows from the rows so far, but not the estimates: they are of other robots."""
        self._estimator = RecordingEstimator(self._rule)
        self._next, self._due_after_s, self._examined_after_s = 1, EPOCH_S, EXAMINED_AFTER_S

    def result(self) -> tuple[EstimationProblem, RecordingEstimate]:
        """Return all estimates so far. Raises UserError if no epoch is complete."""
        if self._problem is None:
            what = "no second with odometry of all robots and ranges to two anchors"
            raise UserError(f"{self._builder.source}: there is {what}")
        return self._problem, with_summary(self._problem, self._rows, self._epochs, self._rule)
