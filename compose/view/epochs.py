"""The estimate from a range recording, made into what the page plays."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from agent.estimation.gaussian.odometry_noise import Places
from compose.recording.estimating.estimate_rows import FinalHypothesis, PoseEstimateRow
from compose.recording.estimating.estimate_run import RecordingEstimate
from compose.recording.estimating.recorded_measurements import EPOCH_S, Measurements
from compose.recording.estimating.true_poses import true_pose
from compose.recording.ranging.range_recording import SAME_TIME_S, RecordedRobot
from compose.recording.run_setup import ESTIMATED, AnchorSetup, RobotSetup, RunSetup
from compose.view.played_estimate import PLAYER_JSON, Epoch, PlayedEstimate
from protocol import files
from protocol.messages import (
    Cause,
    Command,
    Contact,
    Estimate,
    Localised,
    MissionEnd,
    NamedRange,
    Observation,
)
from protocol.mission import Anchor, Mission
from protocol.motion import Controls, Covariance, Pose, compose
from protocol.noise import Noise


def played(problem: Measurements, estimate: RecordingEstimate) -> PlayedEstimate:
    """Return an estimate as a run, whose sensing range is the longest range that was measured."""
    ranges = problem.joint.ranges
    order = ranges.tick.argsort(kind="stable")
    of_epoch = -(ranges.tick[order] // -problem.ticks_per_epoch)  # rounded up

    def measured(number: int) -> Places:
        """Return the rows of the ranges that end in the epoch `number`."""
        return np.sort(order[slice(*np.searchsorted(of_epoch, (number, number + 1)))])

    epochs = [_epoch(problem, 0, 0, problem.t0, measured(0), (), ())]
    for one in [each for each in estimate.epochs if each.t > problem.t0]:
        tick = max(round((one.t - problem.t0) / EPOCH_S), epochs[-1].tick + 1)
        number = int(np.searchsorted(problem.ends, one.t - SAME_TIME_S)) + 1
        epochs.append(_epoch(problem, tick, number, one.t, measured(number), one.rows, one.hypotheses))
    last, why = epochs[-1].tick, estimate.summary.blocking_reason
    sigma, longest = (float(np.max(one, initial=1e-3)) for one in (ranges.sigma, ranges.rho))
    localised = bool(estimate.epochs) and all(estimate.epochs[-1].claims)
    anchors = [
        AnchorSetup(one.id, Anchor(one.x, one.y) if math.isfinite(one.x) else None, min(one.sigma, longest))
        for one in problem.anchors
    ]
    setup = RunSetup(
        problem.source.rpartition("/")[2],
        tuple([RobotSetup(one.id) for one in problem.robots]),
        Mission(longest, EPOCH_S, 1.0, math.pi, noise=Noise(anchor_sigma=sigma)),
        planner_name="assured",
        t_max_s=last * EPOCH_S,
        mode=ESTIMATED,
        team=True,
        anchors=tuple(anchors),
        origin=problem.relative_to,
    )
    end = MissionEnd(last, "undecided", (Cause("failed", text=why or "a robot has no claim"),))
    return PlayedEstimate(setup, epochs, MissionEnd(last, "localised") if localised else end)


def _epoch(
    problem: Measurements,
    tick: int,
    number: int,
    t: float,
    measured: Places,
    rows: Sequence[PoseEstimateRow],
    hypotheses: Sequence[FinalHypothesis],
) -> Epoch:
    """Return an epoch that ends at `t` s: what each robot has measured in it, and holds at its end.

    `number` counts the epochs without those that long gaps leave out; `measured` are the rows of its ranges.
    """
    ids, held = [one.id for one in problem.robots], {row.robot: row for row in rows}
    epoch = Epoch(tick, {}, [])
    contacts: dict[str, dict[str, Contact]] = defaultdict(dict)
    anchors: dict[str, dict[str, NamedRange]] = defaultdict(dict)
    ranges = problem.joint.ranges
    for i in measured[ranges.radio[measured] >= 0]:
        first, second = problem.joint.radios[int(ranges.radio[i])]
        for robot, other in ((first, second), (second, first)):
            if robot in ids and other in ids:
                contacts[robot][other] = Contact(other, float(ranges.rho[i]), None)
            elif robot in ids:
                anchors[robot][other] = NamedRange(other, float(ranges.rho[i]))
    for one in problem.robots:
        robot, row = one.id, held.get(one.id)
        way = (_dead_reckoned(problem, one.recorded, number),)
        ranged = (*contacts[robot].values(),), (), (*anchors[robot].values(),)
        poses = tuple([Pose(*each.poses[robot]) for each in hypotheses] if row is not None else [])
        covariance, verdict, state = None, None, "unlocated"
        if row is not None:
            covariance, state = Covariance(row.xx, row.xy, row.xh, row.yy, row.yh, row.hh), "doubtful"
            if row.claim:
                verdict, state = Localised(poses[0], covariance), "localised"
        total = sum([each.probability for each in hypotheses])
        shares = tuple([min(each.probability / total, 1.0) for each in hypotheses] if poses else [])
        epoch.messages.extend(
            [
                Observation(tick, robot, _driven(problem, robot, number), None, *ranged),
                Command(tick, robot, 0.0, 0.0, 3 if poses else 1, state, verdict),
                Estimate(tick, robot, way if poses else (), poses, verdict is not None, shares, covariance),
            ]
        )
        if (true := true_pose(one.recorded, t)) is not None:
            epoch.truth[robot] = Pose(*true.tolist())
    return epoch


def _dead_reckoned(problem: Measurements, robot: RecordedRobot, number: int) -> Pose:
    """Return the pose of the robot's centre at the end of the epoch `number`, by odometry alone."""
    path, (forward, left, _) = problem.path(robot.id), robot.antenna
    k = min(number * problem.ticks_per_epoch, len(path.heading) - 1)
    return compose(
        Pose(float(path.x[k]), float(path.y[k]), float(path.heading[k])), Pose(-forward, -left, 0.0)
    )


def _driven(problem: Measurements, robot: str, number: int) -> Controls | None:
    """Return the speed and the turn rate over the epoch `number`, by the odometry; None of epoch 0."""
    path, per = problem.path(robot), problem.ticks_per_epoch
    before, now = (number - 1) * per, min(number * per, len(path.heading) - 1)
    if not 0 <= before < now:
        return None
    distance = float(np.sum(path.v[before:now])) * problem.joint.period
    return Controls(distance / EPOCH_S, float(path.heading[now] - path.heading[before]) / EPOCH_S)


def write_player(folder: Path, problem: Measurements, estimate: RecordingEstimate) -> Path:
    """Write the file into `folder`, and return its path. Raises OSError."""
    files.write(folder / PLAYER_JSON, msgspec.json.encode(played(problem, estimate)).decode() + "\n")
    return folder / PLAYER_JSON
