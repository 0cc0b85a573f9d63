"""The Cramér-Rao bound of a pair's poses, for the trajectories that it drove.

The bound is the covariance of the robots' own least-squares fit, evaluated at the ground truth: with true
controls, true distances and no iteration. It is the inverse of the Fisher information, with the odometry
noise marginalised out.
"""

from __future__ import annotations

import numpy as np

from agent.estimation.gaussian.measured_rows import near_anchors
from agent.estimation.gaussian.odometry_noise import Track, track
from agent.estimation.gaussian.reachable_accuracy import position_sigmas
from compose.recording.run import Run
from protocol.motion import REST, Pose, travelled
from world.sensors import anchor_ranges


def position_bounds(run: Run, pair: tuple[int, int], tick: int) -> tuple[float, float] | None:
    """Return the square root in m of the trace of the bound on each robot's position at `tick`.

    The result is None if sensors are exact, or if their noise is not white and Gaussian: with outliers, and
    with anything of `[world.noise]` that robots cannot assume.
    """
    scenario = run.scenario
    noise = scenario.sensors.noise
    if (
        not scenario.sensors.shared
        or noise.exact
        or noise.outliers
        or noise.anchor_sigma == noise.mutual_sigma == 0.0
    ):
        return None
    ticks = run.ticks[: tick + 1]
    anchors = [scenario.robots[place].anchor for place in pair]
    own: list[list[tuple[int, float]]] = [[], []]
    mutual: list[tuple[int, float]] = []
    for at in ticks:
        truth = at.truth
        ranges = anchor_ranges(truth, scenario)
        for k, (place, anchor) in enumerate(zip(pair, anchors, strict=True)):
            if ranges[place]:
                own[k].append((truth.tick, travelled(truth.poses[place], Pose(anchor.x, anchor.y, 0.0))))
        contact = at.world.contacts.get((min(pair), max(pair)))
        if contact is not None and contact.range is not None:
            mutual.append((truth.tick, travelled(truth.poses[pair[0]], truth.poses[pair[1]])))
    apart = (anchors[1].x - anchors[0].x, anchors[1].y - anchors[0].y)
    measured = near_anchors(
        [_driven(run, place, tick) for place in pair],
        own,
        ((0.0, 0.0), apart),
        noise.as_told,
        scenario.mission.sensing_range,
        mutual,
    )
    starts = [ticks[0].truth.poses[place] for place in pair]
    relative = [(pose.x - anchors[0].x, pose.y - anchors[0].y, pose.heading) for pose in starts]
    a, b = position_sigmas(measured, np.array(relative))
    return a, b


def _driven(run: Run, place: int, tick: int) -> Track:
    """Return the track of the controls that a robot executed until `tick`."""
    driven = [run.driven(run.robots[place], k) or REST for k in range(tick)]
    v, omega = np.array([one.v for one in driven]), np.array([one.omega for one in driven])
    return track(v, omega, run.scenario.mission.period)
