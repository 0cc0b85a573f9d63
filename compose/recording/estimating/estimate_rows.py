"""The results of an estimate: one row for each robot and epoch, and the summary."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from agent.estimation.gaussian.joint_claims import displaced_anchor
from agent.estimation.gaussian.noise_level import INLIER
from compose.recording.estimating.estimate_epoch import ClaimRule, EpochFit, EstimateEpoch
from compose.recording.estimating.group_measurements import listed
from compose.recording.estimating.learned_errors import LearnedErrors, learned_errors
from compose.recording.estimating.prepared_steps import Measurements, OneRobot
from compose.recording.estimating.true_poses import true_pose
from compose.recording.ranging.range_recording import Numbers, RecordedRobot
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


class EstimateSummary(msgspec.Struct, frozen=True):
    """The content of `estimate.json`."""

    source: str
    """The recording."""
    noise: str
    """The assumed noise: a profile, a file, or what the recording states."""
    begin_s: float
    """The time in s, on the clock of the recording, from which on there is odometry of all robots."""
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
    """The anchors that seem to stand elsewhere than the recording says, with the reason."""


def rows_of(epoch: EstimateEpoch, robots: Sequence[RecordedRobot]) -> list[PoseEstimateRow]:
    """Return the rows of all robots at one epoch; none without hypotheses."""
    rows = []
    for i, robot in enumerate(robots):
        if not epoch.hypotheses or robot.id in epoch.undetermined:
            continue
        best = epoch.hypotheses[0]
        pose, covariance = best.poses[i], best.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        x, y, heading = pose.tolist()
        count, probability = epoch.certainties[i]
        row = PoseEstimateRow(
            t_s=epoch.t,
            robot=robot.id,
            hypotheses=count,
            probability=probability,
            x=x,
            y=y,
            heading=heading,
            xx=float(covariance[0, 0]),
            xy=float(covariance[0, 1]),
            xh=float(covariance[0, 2]),
            yy=float(covariance[1, 1]),
            yh=float(covariance[1, 2]),
            hh=float(covariance[2, 2]),
            claim=epoch.claims[i],
        )
        true = true_pose(robot, epoch.t)
        rows.append(row if true is None else _with_truth(row, pose, covariance, true))
    return rows


def _with_truth(row: PoseEstimateRow, pose: Numbers, covariance: Numbers, true: Numbers) -> PoseEstimateRow:
    """Return the row of an estimate with the truth and the errors."""
    error = pose - true
    error[2] = wrap(float(error[2]))
    return msgspec.structs.replace(
        row,
        true_x=float(true[0]),
        true_y=float(true[1]),
        true_heading=wrap(float(true[2])),
        position_error_m=math.hypot(error[0], error[1]),
        heading_error_rad=float(error[2]),
        nees=float(error @ np.linalg.solve(covariance, error)),
    )


def summary_of(
    measured: Measurements,
    rows: Sequence[PoseEstimateRow],
    last: EstimateEpoch | None,
    rule: ClaimRule,
    source: str,
    noise: str,
    doubt: str = "",
) -> EstimateSummary:
    """Return the summary of all `rows`; `last` is the last epoch, and `doubt` that about the units."""
    sides = measured.sides
    claims = last.claims if last is not None and not doubt else (False,) * len(sides)
    robots = {}
    for side, claim in zip(sides, claims, strict=True):
        own = [row for row in rows if row.robot == side.id]
        claimed = [i for i, row in enumerate(own) if row.claim]
        withdrawn_s = None
        if claimed and not claim:
            later = own[claimed[-1] + 1 :]
            withdrawn_s = later[0].t_s if later or last is None else last.t
        robots[side.id] = RobotEstimate(
            [one.id for one in side.anchors],
            _pose(own[claimed[0]]) if claimed else None,
            _pose(own[-1]) if own else None,
            len(side.sound.gross),
            len(side.sound.gaps),
            len(side.sound.whole_turns),
            withdrawn_s,
        )
    reason = doubt or _standing(
        [side for side, claim in zip(sides, claims, strict=True) if not claim], measured
    )
    if not reason:
        reason = last.blocking_reason if last is not None else "there is no epoch"
    pairs = ["-".join(pair) for pair in measured.pairs]
    calibration, anchors, doubtful = None, {}, {}
    if last is not None and last.fitted is not None:
        ranged = [name for name, count in zip(pairs, last.ranges, strict=True) if count]
        calibration = learned_errors(last.fitted.fit, last.fitted.used.driving, ranged)
        anchors = _anchors(last.fitted, measured)
        doubtful = _doubtful(last.fitted)
    hypotheses = [
        FinalHypothesis(
            one.probability,
            {side.id: _triple(one.poses[i]) for i, side in enumerate(sides) if not np.isnan(one.poses[i, 0])},
        )
        for one in (last.hypotheses if last is not None else ())
    ]
    return EstimateSummary(
        source,
        noise,
        measured.t0,
        rule.accuracy,
        rule.confidence,
        robots,
        hypotheses,
        calibration,
        dict(zip(pairs, last.ranges if last is not None else (0,) * len(pairs), strict=True)),
        measured.unused,
        reason,
        dict(last.undetermined) if last is not None else {},
        anchors,
        doubtful,
    )


def _anchors(fitted: EpochFit, measured: Measurements) -> dict[str, EstimatedAnchor]:
    """Return the estimates of the anchors that are not surveyed."""
    fit, used = fitted
    given, found = {one.id: one for one in measured.anchors}, {}
    for i, name in enumerate(used.robots):
        if not used.is_anchor(i):
            continue
        place, one = fit.poses[i, :2] + used.origin, given[name]
        own = fit.covariance[3 * i : 3 * i + 2, 3 * i : 3 * i + 2]
        (xx, xy), (_, yy) = own.tolist()
        surveyed = one.sigma < math.inf
        found[name] = EstimatedAnchor(
            (float(place[0]), float(place[1])),
            ((xx, xy), (xy, yy)),
            (one.x, one.y) if surveyed else None,
            one.sigma if surveyed else None,
            one.height,
        )
    return found


def _doubtful(fitted: EpochFit) -> dict[str, str]:
    """Return why anchors seem to stand elsewhere: by a test, or since most of their ranges fit no other."""
    ranges, displaced = fitted.used.ranges, displaced_anchor(*fitted)
    doubtful = {displaced.anchor: displaced.what} if displaced is not None else {}
    strays: dict[str, list[int]] = {}
    for radio, weight in zip(ranges.radio.tolist(), fitted.fit.weights.tolist(), strict=True):
        name = fitted.used.radios[radio][1]
        if name in fitted.used.anchors:
            counts = strays.setdefault(name, [0, 0])
            counts[0] += weight <= INLIER
            counts[1] += 1
    for name, (count, total) in strays.items():
        if total >= FEWEST_OF_ANCHOR and count > MOST_STRAYS * total:
            doubtful.setdefault(name, f"{count} of {total} of its ranges fit no other")
    return doubtful


MOST_STRAYS, FEWEST_OF_ANCHOR = 0.5, 8
"""The share of ranges that fit no other above which an anchor is doubted, and the least number of ranges."""


def _standing(sides: Sequence[OneRobot], measured: Measurements) -> str:
    """Return a sentence about the robots whose paths are shorter than the sigma of ranges; empty if none."""
    names = [
        side.id
        for side in sides
        if math.hypot(float(np.ptp(side.path.x)), float(np.ptp(side.path.y))) <= measured.noise.anchor_sigma
    ]
    if not names:
        return ""
    verb, whose = ("does", "its") if len(names) == 1 else ("do", "their")
    return (
        f"{listed(names)} {verb} not move, by {whose} odometry: ranges do not tell the heading of a robot "
        "that stands"
    )


def _triple(values: Numbers) -> tuple[float, float, float]:
    first, second, third = values.tolist()
    return first, second, third


def _pose(row: PoseEstimateRow) -> PoseEstimate:
    return PoseEstimate(
        row.t_s,
        (row.x, row.y, row.heading),
        ((row.xx, row.xy, row.xh), (row.xy, row.yy, row.yh), (row.xh, row.yh, row.hh)),
        row.probability,
        row.position_error_m,
        row.heading_error_rad,
        row.nees if row.claim else None,  # hypotheses that are not settled are often all false
    )
