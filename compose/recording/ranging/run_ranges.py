"""The range recording of a run of Tandem: what its robots measured, with the noise that they assume."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from agent.estimation.gaussian.odometry_noise import effect_covariance, pose_effects, track, variances
from compose.errors import BadRecording
from compose.recording.ranging.range_recording import RangeRecording
from compose.recording.ranging.recording_builder import Covariance6, RecordingBuilder
from compose.recording.ranging.recording_rows import AnchorRow, OdometryRow, RangeRow, TruePoseRow
from compose.recording.run import Run
from compose.recording.run_setup import RunSetup
from protocol.messages import Observation
from protocol.mission import Anchor
from protocol.motion import ORIGIN, Controls, step
from protocol.noise import VelocityNoise

ADDED_SIGMA = 1e-6
"""The standard deviation that is added to every one, in m and rad.

With exact sensors those of the robots are 0, and those of odometry are correlated without it, so that their
covariance has no inverse. Estimators need one.
"""


def ranges_of_run(run: Run, given: Sequence[AnchorRow] = ()) -> RangeRecording:
    """Return the odometry, ranges and true poses in `run`, at the times of its ticks.

    Equal anchors are one, with the name of the first robot that has it, and those in `given` replace those of
    the same names. A range between robots that both have measured appears once, and one to a robot
    without a journal is left out. Raises BadRecording if no journal has the parameters of the mission.
    """
    setup = run.setup
    if setup is None or not run.length:
        raise BadRecording(f"{run.source}: no journal has the parameters of the mission and an Observation")
    builder = RecordingBuilder(run.source, given)
    anchors: dict[Anchor, str] = {}
    for one in setup.robots:
        builder.add_robot(one.id)
    for one in setup.anchored:
        if one.anchor not in anchors:
            anchors[one.anchor] = name = f"anchor-{one.id}"
            builder.add(AnchorRow(name, one.anchor.x, one.anchor.y), run.source)
    anchor_of = {one.id: anchors[one.anchor] for one in setup.anchored}
    for each in setup.anchors:
        x, y = (at.x, at.y) if (at := each.position) is not None else (None, None)
        builder.add(AnchorRow(each.id, x, y, sigma=each.sigma), run.source)
    period = setup.mission.period
    for tick in range(run.length):
        observations = [one for robot, one in run.observations[tick].items() if robot in setup.ids]
        _add_tick(builder, observations, anchor_of, setup)
    for robot in setup.ids:
        for tick, pose in enumerate(run.truth(robot)):
            builder.add(TruePoseRow(robot, tick * period, pose.x, pose.y, pose.heading), run.source)
    return builder.recording()._replace(origin=setup.origin, of_mission=True)


def _add_tick(
    builder: RecordingBuilder,
    observations: Sequence[Observation],
    anchor_of: Mapping[str, str],
    setup: RunSetup,
) -> None:
    """Add the increments and the ranges of one tick; a range between two robots once."""
    period, noise = setup.mission.period, setup.mission.noise
    sigma, anchor_sigma = [math.hypot(one, ADDED_SIGMA) for one in (noise.mutual_sigma, noise.anchor_sigma)]
    ranged: set[frozenset[str]] = set()
    for observed in observations:
        robot, t = observed.robot, observed.tick * period
        if (executed := observed.executed) is not None:
            moved = step(ORIGIN, executed.v, executed.omega, period)
            row = OdometryRow(robot, (observed.tick - 1) * period, t, moved.x, moved.y, moved.heading)
            builder.add_odometry(row, increment_covariance(executed, period, noise.odometry), builder.source)
        if (rho := observed.anchor_range) is not None:
            builder.add(RangeRow(t, robot, anchor_of[robot], rho, anchor_sigma), builder.source)
        for measured in observed.anchors:
            builder.add(RangeRow(t, robot, measured.anchor, measured.range, anchor_sigma), builder.source)
        for one in observed.contacts:
            pair = frozenset((robot, one.peer))
            if one.range is not None and one.peer in setup.ids and pair not in ranged:
                ranged.add(pair)
                builder.add(RangeRow(t, robot, one.peer, one.range, sigma), builder.source)


def increment_covariance(executed: Controls, period: float, noise: VelocityNoise) -> Covariance6:
    """Return the covariance of the increment of eq. (1a) over `period` s, for `noise` in v and omega.

    ADDED_SIGMA is added, also to the sideways error, which eq. (1a) does not have by itself.
    """
    v, omega, no_constants = np.array([executed.v]), np.array([executed.omega]), np.zeros((0, 2, 1))
    effects = pose_effects(track(v, omega, period), 0, 1)
    matrix = effect_covariance(effects, variances(v, omega, noise), no_constants) + ADDED_SIGMA**2 * np.eye(3)
    xx, xy, xh, yy, yh, hh = matrix[np.triu_indices(3)].tolist()
    return (xx, xy, xh, yy, yh, hh)
