"""The range recording of a run of Tandem: what its robots measured, with the noise that they assume."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np

from compose.errors import BadRecording
from compose.recording.ranging.range_recording import RangeRecording
from compose.recording.ranging.recording_rows import (
    AnchorRow,
    Covariance6,
    OdometryRow,
    RangeRow,
    RecordingBuilder,
    TruePoseRow,
)
from compose.recording.run import Run
from protocol.messages import Observation
from protocol.mission import Anchor, Mission
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
    ids = set(setup.ids)
    for tick in range(run.length):
        observations = {robot: one for robot, one in run.observations[tick].items() if robot in ids}
        for row, covariance in _moved(observations, setup.mission):
            builder.add_odometry(row, covariance, run.source)
        for ranged in _ranged(observations, anchor_of, ids, setup.mission):
            builder.add(ranged, run.source)
    for robot in setup.ids:
        for tick, pose in enumerate(run.truth(robot)):
            t = tick * setup.mission.period
            builder.add(TruePoseRow(robot, t, pose.x, pose.y, pose.heading), run.source)
    return builder.recording()


def _moved(
    observations: Mapping[str, Observation], mission: Mission
) -> Iterator[tuple[OdometryRow, Covariance6]]:
    """Yield the increment of each robot in one tick, and its covariance."""
    period = mission.period
    for robot, observation in observations.items():
        if (executed := observation.executed) is not None:
            moved = step(ORIGIN, executed.v, executed.omega, period)
            t0, t1 = (observation.tick - 1) * period, observation.tick * period
            row = OdometryRow(robot, t0, t1, moved.x, moved.y, moved.heading)
            yield row, increment_covariance(executed, period, mission.noise.odometry)


def _ranged(
    observations: Mapping[str, Observation],
    anchor_of: Mapping[str, str],
    ids: Collection[str],
    mission: Mission,
) -> Iterator[RangeRow]:
    """Yield the ranges of one tick; those between two robots once."""
    sigma = math.hypot(mission.noise.mutual_sigma, ADDED_SIGMA)
    anchor_sigma = math.hypot(mission.noise.anchor_sigma, ADDED_SIGMA)
    seen: set[frozenset[str]] = set()
    for robot, observation in observations.items():
        t = observation.tick * mission.period
        if observation.anchor_range is not None:
            yield RangeRow(t, robot, anchor_of[robot], observation.anchor_range, anchor_sigma)
        for contact in observation.contacts:
            pair = frozenset((robot, contact.peer))
            if contact.range is not None and contact.peer in ids and pair not in seen:
                seen.add(pair)
                yield RangeRow(t, robot, contact.peer, contact.range, sigma)


def increment_covariance(executed: Controls, period: float, noise: VelocityNoise) -> Covariance6:
    """Return the covariance of the increment of eq. (1a) over `period` s, for `noise` in v and omega.

    ADDED_SIGMA is added, also to the sideways error, which eq. (1a) does not have by itself.
    """
    turn = executed.omega * period
    if abs(turn) < SMALL_TURN:
        ahead, left = 1.0 - turn * turn / 6.0, turn / 2.0
        ahead_by_turn, left_by_turn = -turn / 3.0, 0.5 - turn * turn / 8.0
    else:
        ahead, left = math.sin(turn) / turn, (1.0 - math.cos(turn)) / turn
        ahead_by_turn, left_by_turn = (math.cos(turn) - ahead) / turn, (math.sin(turn) - left) / turn
    by_v = np.array([ahead, left, 0.0]) * period
    by_omega = (
        np.array([executed.v * period * ahead_by_turn, executed.v * period * left_by_turn, 1.0]) * period
    )
    q_v, q_omega = noise.variances(executed.v, executed.omega)
    matrix = q_v * np.outer(by_v, by_v) + q_omega * np.outer(by_omega, by_omega) + ADDED_SIGMA**2 * np.eye(3)
    xx, xy, xh, yy, yh, hh = [float(value) for value in matrix[np.triu_indices(3)]]
    return (xx, xy, xh, yy, yh, hh)


SMALL_TURN = 1e-4
"""The turn in rad below which series are used."""
