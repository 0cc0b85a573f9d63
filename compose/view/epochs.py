"""The estimate from a range recording, made into what the page plays."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np

from compose.recording.estimating.estimate_run import RecordingEstimate
from compose.recording.estimating.recorded_measurements import EPOCH_S, Measurements
from compose.recording.estimating.true_poses import true_pose
from compose.recording.run_setup import ESTIMATED, AnchorSetup, RobotSetup, RunSetup
from compose.view.estimated import PLAYER_JSON, Epoch, PlayedEstimate
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
from protocol.motion import Controls, Covariance, Pose
from protocol.noise import Noise


def played(problem: Measurements, estimate: RecordingEstimate) -> PlayedEstimate:
    """Return an estimate as a run."""
    ids, ranges = [one.id for one in problem.robots], problem.joint.ranges
    anchors = {one.id: one for one in problem.anchors}
    setup = RunSetup(
        problem.source.rpartition("/")[2],
        tuple([RobotSetup(robot) for robot in ids]),
        Mission(
            max(float(np.max(ranges.rho, initial=0.0)), 1e-3), EPOCH_S, 1.0, math.pi,
            noise=Noise(anchor_sigma=float(np.median(ranges.sigma)) if len(ranges.sigma) else 1.0),
        ),
        "assured",
        max((one.t - problem.t0 for one in estimate.epochs), default=0.0),
        mode=ESTIMATED,
        team=True,
        anchors=tuple(
            [
                AnchorSetup(name, Anchor(one.x, one.y) if math.isfinite(one.x) else None, min(one.sigma, 1e3))
                for name, one in anchors.items()
            ]
        ),
        origin=problem.relative_to,
    )  # fmt: skip
    epochs = [_epoch(problem, 0, [], {}, {}, problem.t0)]
    for one in estimate.epochs:
        tick = max(round((one.t - problem.t0) / EPOCH_S), epochs[-1].tick + 1)
        held = {row.robot: row for row in one.rows}
        poses = {
            robot: [(each.probability, Pose(*each.poses[robot])) for each in one.hypotheses] for robot in held
        }
        covariances = {
            row.robot: Covariance(row.xx, row.xy, row.xh, row.yy, row.yh, row.hh) for row in one.rows
        }
        claims = [row.robot for row in one.rows if row.claim]
        epochs.append(_epoch(problem, tick, claims, poses, covariances, one.t))
    localised = len(estimate.epochs) > 0 and all(estimate.epochs[-1].claims)
    why = () if localised else (Cause("failed", text=estimate.summary.blocking_reason or None),)
    return PlayedEstimate(
        setup, epochs, MissionEnd(epochs[-1].tick, "localised" if localised else "undecided", why)
    )


def _epoch(
    problem: Measurements,
    tick: int,
    claims: list[str],
    poses: dict[str, list[tuple[float, Pose]]],
    covariances: dict[str, Covariance],
    t: float,
) -> Epoch:
    """Return an epoch that ends at `t` s, with the hypotheses of each robot, the most probable first."""
    joint, per = problem.joint, problem.ticks_per_epoch
    inside = (
        (joint.ranges.tick > (tick - 1) * per) & (joint.ranges.tick <= tick * per) & (joint.ranges.radio >= 0)
    )
    latest = {
        joint.radios[int(joint.ranges.radio[i])]: float(joint.ranges.rho[i]) for i in np.flatnonzero(inside)
    }
    observations, commands, estimates = [], [], []
    for one in problem.robots:
        robot, anchors, contacts = one.id, [], []
        for (first, second), rho in latest.items():
            if robot in (first, second):
                other = second if robot == first else first
                if any(each.id == other for each in problem.robots):
                    contacts.append(Contact(other, rho, None))
                else:
                    anchors.append(NamedRange(other, rho))
        observations.append(
            Observation(tick, robot, _driven(problem, robot, tick), None, tuple(contacts), (), tuple(anchors))
        )
        held, claimed = poses.get(robot, []), robot in claims
        total = sum([probability for probability, _ in held]) or 1.0
        verdict = Localised(held[0][1], covariances[robot]) if claimed else None
        state = "localised" if claimed else "doubtful" if held else "unlocated"
        commands.append(Command(tick, robot, 0.0, 0.0, 3 if held else 1, state, verdict))
        estimates.append(
            Estimate(
                tick, robot, (), tuple([pose for _, pose in held]), claimed,
                tuple([min(probability / total, 1.0) for probability, _ in held]), covariances.get(robot),
            )
        )  # fmt: skip
    truth = {
        one.id: Pose(*true.tolist())
        for one in problem.robots
        if (true := true_pose(one.recorded, t)) is not None
    }
    return Epoch(tick, truth, observations, commands, estimates)


def _driven(problem: Measurements, robot: str, tick: int) -> Controls | None:
    """Return the speed and the turn rate over the epoch before `tick`, by the odometry; None at tick 0."""
    path, per = problem.path(robot), problem.ticks_per_epoch
    before, now = (tick - 1) * per, min(tick * per, len(path.heading) - 1)
    if not 0 <= before < now:
        return None
    distance = float(np.sum(path.v[before:now])) * problem.joint.period
    turned = float(path.heading[now] - path.heading[before])
    return Controls(distance / EPOCH_S, turned / EPOCH_S)


def write_player(folder: Path, problem: Measurements, estimate: RecordingEstimate) -> Path:
    """Write the file into `folder`, and return its path. Raises OSError."""
    files.write(folder / PLAYER_JSON, msgspec.json.encode(played(problem, estimate)).decode() + "\n")
    return folder / PLAYER_JSON
