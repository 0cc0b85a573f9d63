"""A whole estimate: from measurements to rows and their summary, of a file or as a stream of rows arrives.

In a stream, an epoch is computed as soon as the odometry of all robots has reached its end. Rows must arrive
in the order of time, as in a file: a range that comes later counts from the next epoch on. A range of a robot
without odometry waits for its first increment. What is awaited for longer than LONG_GAP_S is told.

So that the time of an epoch is bounded, an estimate begins again with the last KEPT_S when it has MOST_S.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from agent.estimation.following import ClaimRule
from agent.estimation.solver import Solver
from compose.errors import UserError
from compose.recording.estimating.estimate_rows import EstimateSummary, PoseEstimateRow
from compose.recording.estimating.estimate_summary import summary_of
from compose.recording.estimating.noise_files import AssumedNoise
from compose.recording.estimating.recorded_measurements import (
    EPOCH_S,
    Measurements,
    NoAnchors,
    longest_possible,
    measurements,
    numerics,
)
from compose.recording.estimating.recording_estimator import EstimateEpoch, RecordingEstimator
from compose.recording.ranging.range_recording import LONG_GAP_S, SAME_TIME_S
from compose.recording.ranging.range_steps import NoSteps
from compose.recording.ranging.recording_builder import RecordingBuilder
from compose.recording.ranging.recording_rows import AnyRow, OdometryRow, PoseRow, SourcePlace
from compose.recording.reasons import listed

STREAM_TICKS = 20
"""The number of ticks in an epoch of a stream. A robot of 0.5 m/s then moves by a quarter of 0.05 m in half a
tick; the speed of the robots is not known before they have moved."""

MOST_S, KEPT_S = 240.0, 120.0
"""The time in s of a stream with which the estimate begins again, and the part that it then begins with.

With less, robots with few ranges do not claim their poses; with more, an epoch takes longer.
"""

LEAST_WAY = 0.25
"""The least extent of a robot's path in that part, as a fraction of the longest range.

Of a robot that stands for long, only older ranges tell the heading: then nothing is forgotten.
"""

EXAMINED_AFTER_S = 4.0
"""The time in s after which the units are examined for the first time, then whenever it has doubled."""


class RecordingEstimate(NamedTuple):
    """The result of an estimate."""

    epochs: list[EstimateEpoch]
    summary: EstimateSummary

    @property
    def rows(self) -> list[PoseEstimateRow]:
        """The rows of all epochs."""
        return [row for epoch in self.epochs for row in epoch.rows]


def estimated(
    measured: Measurements,
    rule: ClaimRule,
    done: Callable[[], None] = lambda: None,
    solver: Solver | None = None,
) -> RecordingEstimate:
    """Return all estimates; `done` is called after each epoch. There are none if the units are doubtful.

    `solver` fits the poses; by default, the smoother does.
    """
    estimator = RecordingEstimator(rule, solver)
    for _ in estimator.epochs(measured, done):
        pass
    return _result(measured, estimator)


def _result(measured: Measurements, estimator: RecordingEstimator) -> RecordingEstimate:
    with numerics(measured.source):
        return RecordingEstimate(estimator.past, summary_of(measured, estimator.past, estimator.rule))


def _may_forget(measured: Measurements) -> bool:
    """Return whether the measurements of the last KEPT_S determine the present poses without the older ones.

    They do not in the frame of a robot, with an anchor that is not surveyed, or if a robot has hardly moved.
    """
    joint = measured.joint
    if measured.relative_to is not None or joint.surveyed:
        return False
    since, least = -round(KEPT_S / joint.period), LEAST_WAY * longest_possible(joint)
    return all(float(np.hypot(*np.ptp(one.place[:, since:], axis=1))) >= least for one in joint.paths)


class StreamEstimate:
    """An estimate that grows with the rows of a stream."""

    def __init__(
        self,
        source: str,
        robots: Sequence[str] | None,
        noise: AssumedNoise | None,
        rule: ClaimRule,
        tell: Callable[[str], None] = lambda _: None,
        solver: Solver | None = None,
        relative: str | None = None,
    ) -> None:
        """Begin the estimate of `robots`, with the `noise` that is told.

        None: all robots of the stream. With each further one, the estimate begins again.
        `tell` is called with what is missing for an estimate, and with the suspicion that parts of the stream
        are in different units; as long as that lasts, nothing is estimated. `solver` fits the poses in place
        of the smoother. `relative` is the robot whose start defines the frame; None: the frame is that of the
        anchors.
        """
        self._builder, self._relative = RecordingBuilder(source), relative
        self._robots, self._noise, self._tell = robots, noise, tell
        self._estimator = RecordingEstimator(rule, solver)
        self._measured: Measurements | None = None
        """The measurements of the last epoch."""
        self._begin_s: float | None = None
        """The time in s from which on there is odometry of all robots in the estimate."""
        self._doubt = ""
        self._lacking = ""
        """The reason why the odometry and ranges so far give no estimate; empty before there is one."""
        self._told: set[str] = set()
        """The missing names, robots and reasons that were told, each once."""
        self._told_s: float | None = None
        """The time in s of the odometry when that was last looked for; None without odometry."""
        self._count = 0
        """The number of robots in the estimate."""
        self._due_after_s, self._examined_after_s = EPOCH_S, EXAMINED_AFTER_S
        """The times after the first odometry of all robots at which there may be an epoch, and an exam."""

    def rows(self, arriving: Iterable[tuple[AnyRow, SourcePlace]]) -> Iterator[PoseEstimateRow]:
        """Yield the estimates that follow from `arriving` rows, as soon as they do. Raises UserError."""
        for row, place in arriving:
            self._builder.add(row, place)
            if type(row) in (OdometryRow, PoseRow):
                yield from self._due()

    def _due(self) -> Iterator[PoseEstimateRow]:
        """Yield the estimates of all epochs whose odometry is complete."""
        spans = self._builder.spans
        names = list(spans) if self._robots is None else self._robots
        self._tell_missing(names, spans)
        if not names or not all(name in spans for name in names):
            return
        if len(names) > self._count:  # the estimates so far are kept, and are of other robots
            self._count, self._begin_s = len(names), None
            self._estimator.begin()
            self._due_after_s, self._examined_after_s = EPOCH_S, EXAMINED_AFTER_S
        lasts = min(spans[name][1] for name in names) - max(spans[name][0] for name in names)
        if lasts < self._due_after_s - SAME_TIME_S * EPOCH_S:
            return
        self._due_after_s = lasts + EPOCH_S  # if there is none, it is not tried with each row
        examined = lasts >= self._examined_after_s
        doubt = None if examined else self._doubt
        try:
            measured = measurements(
                *(self._builder.recording(whole=False), names, self._noise),
                relative=self._relative,
                ticks=STREAM_TICKS,
                doubt=doubt,
            )
        except (NoAnchors, NoSteps) as error:
            self._lacking = str(error)
            return  # there will be ranges and odometry
        if examined:
            self._examined_after_s = 2.0 * lasts
        if measured.doubt and measured.doubt != self._doubt:
            self._tell(f"{measured.source}: {measured.doubt} Nothing is estimated.")
        self._doubt = measured.doubt
        last = measured if self._measured is None or not self._estimator.past else self._measured
        self._measured = replace(last, doubt=measured.doubt)
        if self._begin_s is None:
            self._begin_s = measured.t0
        for epoch in self._estimator.epochs(measured):
            self._measured = measured
            yield from epoch.rows
        self._due_after_s = max([measured.t0, *measured.ends[-1:].tolist()]) - measured.t0 + EPOCH_S
        ticks = len(measured.skipped_s) - 1  # without the time of long gaps
        if (ticks + 1) * measured.joint.period > MOST_S and _may_forget(measured):
            kept = round(KEPT_S / measured.joint.period)
            self._builder.forget(float(measured.time_of(np.array(ticks - kept))))
            self._estimator.begin()
            self._due_after_s, self._examined_after_s = EPOCH_S, MOST_S

    def _tell_missing(self, names: Sequence[str], spans: Mapping[str, tuple[float, float]]) -> None:
        """Tell what is missing for longer than LONG_GAP_S, each once; `spans` are of the odometry."""
        latest_s = max([end for _, end in spans.values()], default=-math.inf)
        self._told_s = latest_s if self._told_s is None else self._told_s
        if latest_s < self._told_s + LONG_GAP_S:
            return
        before_s, self._told_s = self._told_s, latest_s  # all robots may have paused in between
        missing = self._builder.unknown(before_s)
        for name in names:
            end = spans[name][1] if name in spans else -math.inf
            if end < before_s:
                after = f" after {end:.15g} s" if name in spans else ""
                why = f"{self._builder.source}: there is no odometry of {name}{after}. Nothing is estimated."
                missing[f"{name}{after}"] = why
        if self._measured is None and self._lacking:
            missing[""] = f"{self._lacking}. Nothing is estimated."
        for what, why in missing.items():
            if what not in self._told:
                self._tell(why)
        self._told |= missing.keys()

    def result(self) -> tuple[Measurements, RecordingEstimate]:
        """Return all estimates so far. Raises UserError if no epoch is complete."""
        if self._measured is None:
            without = [name for name in self._robots or () if name not in self._builder.spans]
            what = f"no odometry of {listed(without)}" if without else "no second with odometry of all robots"
            raise UserError(self._lacking or f"{self._builder.source}: there is {what}")
        estimate = _result(self._measured, self._estimator)
        begin_s = self._measured.t0 if self._begin_s is None else self._begin_s
        return self._measured, estimate._replace(summary=replace(estimate.summary, begin_s=begin_s))
