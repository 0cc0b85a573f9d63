"""The summary of an estimate, and its files: `estimate.csv`, `estimate.json`, `anchors.csv`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np

from agent.estimation.fit import Fit
from agent.estimation.following import ClaimRule
from agent.estimation.gaussian.joint_claims import Displacement, displaced_anchor, displacements
from agent.estimation.gaussian.joint_ranges import JointMeasurements, range_errors
from agent.estimation.gaussian.noise_level import INLIER
from compose.recording.estimating.estimate_rows import (
    EstimatedAnchor,
    EstimateSummary,
    LearnedError,
    LearnedErrors,
    PoseEstimate,
    PoseEstimateRow,
    RobotEstimate,
    estimate_csv,
)
from compose.recording.estimating.recorded_measurements import MeasuredRobot, Measurements
from compose.recording.estimating.recording_estimator import EpochFit, EstimateEpoch
from compose.recording.reasons import listed
from compose.recording.rows import csv_table
from protocol import files

MOST_STRAYS, FEWEST_OF_ANCHOR = 0.5, 8
"""The share of ranges that fit no other above which an anchor is doubted, and the least number of ranges."""


def summary_of(measured: Measurements, epochs: Sequence[EstimateEpoch], rule: ClaimRule) -> EstimateSummary:
    """Return the summary of all `epochs`."""
    pairs, robots = ["-".join(pair) for pair in measured.joint.radios], measured.robots
    nothing = EstimateEpoch(
        *(math.nan, [], [], (0,) * len(pairs), (False,) * len(robots), "there is no epoch", None, {})
    )
    last = epochs[-1] if epochs else nothing
    rows = [row for epoch in epochs for row in epoch.rows]
    claims = dict(zip([one.id for one in robots], last.claims, strict=True))
    if measured.doubt:
        claims = dict.fromkeys(claims, False)
    standing = _standing([name for name, claim in claims.items() if not claim], measured)
    counts = dict(zip(pairs, last.ranges, strict=True))
    displaced = list(displacements(*last.fitted)) if last.fitted is not None else []
    return EstimateSummary(
        measured.source,
        measured.noise,
        measured.t0,
        measured.relative_to,
        *(rule.accuracy, rule.confidence),
        {
            one.id: _of_robot(one, [row for row in rows if row.robot == one.id], claims[one.id], last.t)
            for one in robots
        },
        last.hypotheses,
        learned_errors(last.fitted, [name for name, count in counts.items() if count]),
        counts,
        measured.unused,
        measured.doubt or standing or last.blocking_reason,
        last.undetermined,
        dict(_anchors(*last.fitted, measured)) if last.fitted is not None else {},
        _doubtful(*last.fitted, displaced) if last.fitted is not None else {},
        {one.anchor: why for one in displaced if (why := one.unverified(rule.accuracy))},
    )


def _of_robot(
    robot: MeasuredRobot, rows: Sequence[PoseEstimateRow], claim: bool, end_s: float
) -> RobotEstimate:
    """Return the estimates of one robot, which may `claim` its pose at the end, by its `rows`."""
    claimed = [i for i, row in enumerate(rows) if row.claim]
    later = rows[claimed[-1] + 1 :] if claimed else ()
    return RobotEstimate(
        [one.id for one in robot.anchors],
        _pose(rows[claimed[0]]) if claimed else None,
        _pose(rows[-1]) if rows else None,
        len(robot.sound.gross),
        len(robot.recorded.odometry.gaps),
        len(robot.sound.whole_turns),
        None if claim or not claimed else later[0].t_s if later else end_s,
    )


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


def learned_errors(fitted: EpochFit | None, pairs: Sequence[str]) -> LearnedErrors | None:
    """Return the errors that a fit has learned; `pairs` of radios have ranges. None without a fit."""
    if fitted is None:
        return None
    fit, names = fitted.fit, fitted.used.driving
    priors = fit.problem.noise.priors
    constants = iter(zip(fit.constants.tolist(), fit.constant_sigmas.tolist(), strict=True))

    def next_of(prior: float) -> LearnedError:
        mean, sigma = next(constants)
        return LearnedError(prior * mean, prior * sigma)

    learned: dict[str, list[LearnedError]] = {}
    for name in range_errors(priors, len(pairs)):
        learned.setdefault(name, []).append(next_of(getattr(priors, name)))
    alike = ("range_bias", "range_scale", "range_delay", "range_depth", "range_aside")
    bias, scale, delay, depth, aside = [learned[name][0] if name in learned else None for name in alike]
    of_pairs = dict(zip(pairs, learned.get("pair_bias", ()), strict=False))
    odometry = (priors.wheel_scale, priors.wheel_scale, priors.gyro_bias)
    own = {name: [next_of(prior) for prior in odometry] for name in names if priors.of_odometry}
    wheels, turns, gyros = [{name: each[k] for name, each in own.items()} for k in range(3)]
    return LearnedErrors(fit.level**0.5, bias, scale, of_pairs, delay, depth, aside, wheels, turns, gyros)


def _anchors(
    fit: Fit, used: JointMeasurements, measured: Measurements
) -> Iterator[tuple[str, EstimatedAnchor]]:
    """Yield the estimates of the anchors that are not surveyed, by name."""
    given = {one.id: one for one in measured.anchors}
    for i, name in enumerate(used.robots):
        if not used.is_anchor(i):
            continue
        one, (x, y) = given[name], (fit.poses[i, :2] + used.origin).tolist()
        (xx, xy), (_, yy) = fit.covariance[3 * i : 3 * i + 2, 3 * i : 3 * i + 2].tolist()
        place, sigma = ((one.x, one.y), one.sigma) if one.sigma < math.inf else (None, None)
        yield name, EstimatedAnchor((x, y), ((xx, xy), (xy, yy)), place, sigma, one.height)


def _doubtful(fit: Fit, used: JointMeasurements, displaced: Sequence[Displacement]) -> dict[str, str]:
    """Return why anchors seem to stand elsewhere: by a test, or since most of their ranges fit no other."""
    most = displaced_anchor(displaced)
    doubtful = {most.anchor: most.what} if most is not None else {}
    anchors = np.array([pair[1] for pair in used.radios])[used.ranges.radio]
    for name in dict.fromkeys(anchors[np.isin(anchors, used.anchors)].tolist()):
        strays = fit.weights[anchors == name] <= INLIER
        count, total = int(np.count_nonzero(strays)), len(strays)
        if total >= FEWEST_OF_ANCHOR and count > MOST_STRAYS * total:
            doubtful.setdefault(name, f"{count} of {total} of its ranges fit no other")
    return doubtful


def _standing(names: Sequence[str], measured: Measurements) -> str:
    """Return a sentence about the robots whose paths are shorter than the sigma of ranges; empty if none."""
    sigma, paths = measured.joint.noise.anchor_sigma, {name: measured.path(name) for name in names}
    stand = [name for name, path in paths.items() if math.hypot(np.ptp(path.x), np.ptp(path.y)) <= sigma]
    if not stand:
        return ""
    verb, whose = ("does", "its") if len(stand) == 1 else ("do", "their")
    return (
        f"{listed(stand)} {verb} not move, by {whose} odometry: ranges do not tell the heading of a robot "
        "that stands"
    )


# --- files ------------------------------------------------------------------------------------------------


def write_estimate(folder: Path, rows: Sequence[PoseEstimateRow], summary: EstimateSummary) -> list[Path]:
    """Write the files into `folder`, and return their paths. Raises OSError.

    `anchors.csv` has those that are not surveyed, if there are some; `--anchors` reads it: each is surveyed
    with the sigma of its estimate.
    """
    texts = {
        "estimate.csv": estimate_csv(rows),
        "estimate.json": msgspec.json.format(msgspec.json.encode(summary), indent=2).decode() + "\n",
    }
    if summary.anchors:
        names = ("anchor", "x", "y", "height", "sigma")
        anchors = [(name, *one.position, one.height, one.sigma) for name, one in summary.anchors.items()]
        texts["anchors.csv"] = csv_table(names, anchors)
    for name, text in texts.items():
        files.write(folder / name, text)
    return [folder / name for name in texts]
