"""The results of an estimate: one row for each robot and epoch, and the summary."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from agent.estimation.posterior import Certainty
from compose.recording.estimating.true_poses import true_pose
from compose.recording.ranging.range_recording import Numbers, RecordedRobot
from compose.recording.rows import csv_text
from protocol.motion import wrap


class PoseEstimateRow(msgspec.Struct, frozen=True):
    """The estimate of one robot at one time, by the most probable hypothesis."""

    t_s: float
    """The time in s, on the clock of the recording."""
    robot: str
    """The robot."""
    hypotheses: int
    """The number of hypotheses that differ in the pose of this robot."""
    probability: float
    """The probability of the most probable one."""
    x: float
    """The x coordinate in m."""
    y: float
    """The y coordinate in m."""
    heading: float
    """The heading in rad, from -pi to pi."""
    xx: float
    """The variance of x in m^2."""
    xy: float
    """The covariance of x and y in m^2."""
    xh: float
    """The covariance of x and the heading in m rad."""
    yy: float
    """The variance of y in m^2."""
    yh: float
    """The covariance of y and the heading in m rad."""
    hh: float
    """The variance of the heading in rad^2."""
    claim: bool
    """True if the robot may claim this pose."""
    true_x: float | None = None
    """The true x coordinate in m; empty without truth."""
    true_y: float | None = None
    """The true y coordinate in m."""
    true_heading: float | None = None
    """The true heading in rad."""
    position_error_m: float | None = None
    """The distance of the estimate from the true position in m."""
    heading_error_rad: float | None = None
    """The error of the heading in rad, with its sign."""
    nees: float | None = None
    """The normalised error squared: 3 on average if covariances are right."""


class PoseEstimate(msgspec.Struct, frozen=True):
    """The pose of a robot at one time."""

    t_s: float
    """The time in s, on the clock of the recording."""
    pose: tuple[float, float, float]
    """x and y in m, and the heading in rad."""
    covariance: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    """The covariance of x, y and the heading."""
    probability: float
    """The probability of the hypothesis."""
    position_error_m: float | None = None
    """The distance from the true position in m; null without truth."""
    heading_error_rad: float | None = None
    """The error of the heading in rad; null without truth."""
    nees: float | None = None
    """The normalised error squared; null without truth, and for a pose that the robot may not claim."""


class RobotEstimate(msgspec.Struct, frozen=True):
    """The estimates of one robot."""

    anchors: list[str]
    """The anchors whose ranges are used."""
    first_claim: PoseEstimate | None
    """The first pose that the robot may claim; null if there is none."""
    final: PoseEstimate | None
    """The pose at the end; null if there was never a hypothesis."""
    gross_increments: int
    """The number of increments of its odometry that were replaced, because no robot moves like that."""
    gaps: int
    """The number of gaps in its odometry."""
    whole_turns: int
    """The number of increments of its odometry from which a whole turn was removed (2 pi, or several)."""
    withdrawn_s: float | None
    """The time in s from which on the robot may no longer claim its pose; null if it may at the end."""


class FinalHypothesis(msgspec.Struct, frozen=True):
    """One hypothesis at the end."""

    probability: float
    """The probability of the hypothesis."""
    poses: dict[str, tuple[float, float, float]]
    """The pose of each robot: x and y in m, and the heading in rad."""


class EstimatedAnchor(msgspec.Struct, frozen=True):
    """The estimated position of an anchor that is not surveyed, by the likeliest hypothesis at the end."""

    position: tuple[float, float]
    """x and y in m."""
    covariance: tuple[tuple[float, float], tuple[float, float]]
    """The covariance of x and y in m^2."""
    given: tuple[float, float] | None
    """The position in the recording; null without one."""
    given_sigma: float | None
    """The standard deviation of each of its coordinates in m."""
    height: float
    """The height in m, which is not estimated."""

    @property
    def sigma(self) -> float:
        """The standard deviation of each coordinate in m, on average."""
        return math.sqrt(0.5 * (self.covariance[0][0] + self.covariance[1][1]))


class LearnedError(msgspec.Struct, frozen=True):
    """A constant error by the fit, and how well the measurements determine it."""

    value: float
    """The estimate."""
    sigma: float
    """The standard deviation; that of the prior if the measurements tell nothing."""


class LearnedErrors(msgspec.Struct, frozen=True):
    """The constant errors of all sensors. Errors with a prior of 0 are left out."""

    noise_level: float
    """The factor by which the sigmas of ranges differ from the assumed ones."""
    range_bias_m: LearnedError | None
    """The bias that all ranges have in common, in m."""
    range_scale: LearnedError | None
    """The relative error of all ranges: the part by which they are too long."""
    pair_bias_m: dict[str, LearnedError]
    """The further bias of each pair of radios, in m."""
    range_delay_s: LearnedError | None
    """The delay of all ranges in s: the time by which their stamps are late."""
    range_depth: LearnedError | None
    """The share of depth in all ranges: 0 for radios, which measure distances, 1 for a camera."""
    range_aside: LearnedError | None
    """The share of what is to the left: for a camera, the tangent of the angle of its axis to the heading."""
    wheel_scale: dict[str, LearnedError]
    """The relative error of the distance of each robot: the part by which its odometry is too short."""
    turn_scale: dict[str, LearnedError]
    """The relative error of its turns: the part by which its odometry is too small."""
    gyro_bias_rad_s: dict[str, LearnedError]
    """The bias of the turn rate of each robot while it moves, in rad/s, to be added to the measured one."""


class EstimateSummary(msgspec.Struct, frozen=True):
    """The content of `estimate.json`."""

    source: str
    """The recording."""
    noise: str
    """The assumed noise: a profile, a file, or what the recording states."""
    begin_s: float
    """The time in s, on the clock of the recording, from which on there is odometry of all robots."""
    relative_to: str | None
    """The robot whose pose at `begin_s` is the origin of all poses; null: in the frame of the anchors."""
    accuracy: float
    """The accuracy in m that a claim needs."""
    confidence: float
    """The probability that a claim needs."""
    robots: dict[str, RobotEstimate]
    """The estimates of each robot."""
    hypotheses: list[FinalHypothesis]
    """All hypotheses at the end, the most probable first."""
    calibration: LearnedErrors | None
    """The constant errors that the most probable hypothesis implies at the end."""
    ranges: dict[str, int]
    """The number of used ranges of each pair of radios, at the end."""
    unused_ranges: dict[str, int]
    """The number of ranges that are not used, by the reason."""
    blocking_reason: str
    """The condition for a claim that is not met at the end; empty if all are."""
    undetermined: dict[str, str]
    """The robots without a pose at the end, with the reason; none if all are estimated as one hypothesis."""
    anchors: dict[str, EstimatedAnchor]
    """The estimated positions of anchors that are not surveyed; those of which none follows are left out."""
    doubtful_anchors: dict[str, str]
    """The anchors that seem to stand elsewhere than the recording or the estimate says, with the reason."""
    unverified_anchors: dict[str, str]
    """The anchors of which no range tells whether they stand as far off as `accuracy`, with the direction."""


def pose_row(
    robot: RecordedRobot,
    t: float,
    certainty: Certainty,
    pose: tuple[float, float, float],
    covariance: Numbers,
    *,
    claim: bool,
) -> PoseEstimateRow:
    """Return the row of a robot at `t` s, with its errors if the true pose is known."""
    values: list[Any] = [t, robot.id, *certainty, *pose, *covariance[np.triu_indices(3)].tolist(), claim]
    if (true := true_pose(robot, t)) is not None:
        error, (x, y, heading) = pose - true, true.tolist()
        error[2] = wrap(float(error[2]))
        nees = float(error @ np.linalg.solve(covariance, error))
        values += [x, y, wrap(heading), math.hypot(error[0], error[1]), float(error[2]), nees]
    return PoseEstimateRow(*values)


def estimate_csv(rows: Sequence[PoseEstimateRow]) -> str:
    """Return the table of `rows`, with a line of column names."""
    return csv_text(PoseEstimateRow, rows)
