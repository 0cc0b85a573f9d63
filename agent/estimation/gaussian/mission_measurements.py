"""The measurements of a robot of a mission with noisy sensors, for fits: its own, and those of its pair."""

from __future__ import annotations

from bisect import bisect_left
from functools import lru_cache
from itertools import pairwise
from operator import attrgetter

import numpy as np
from msgspec.structs import replace

from agent.estimation.gaussian.joint_ranges import JointMeasurements, Silence
from agent.estimation.gaussian.measured_rows import Listed, near_anchors
from agent.estimation.gaussian.odometry_noise import Places, Track, track, variances
from agent.estimation.knowledge import Knowledge
from agent.peer.motion_log import MotionLog
from protocol.messages import RobotConfig
from protocol.mission import Mission
from protocol.motion import Segment
from protocol.noise import VelocityNoise

MANY_MUTUAL_RANGES = 60
"""The number of mutual ranges after which a lack of accuracy is due to too few ranges to the anchor.

Set on the sweep `noise`, whose missions need 10 to 40. With fewer, robots that would have claimed a few ticks
later drive back; with more, robots whose anchor is known too badly range in vain for longer. Missions with
little noise never come near it.
"""

LEAST_RANGES = 3
"""The least number of ranges to an anchor, or between the robots, that may be enough.

Two have no redundancy. The third checks them, if it is accurate: by its evidence against chance.
"""


def beginning(knowledge: Knowledge, through: int) -> int:
    """Return the tick up to `through` from which on the measurements of robot a count: 0, or a later one.

    A robot a that has failed (see `has_failed`) begins phase 1 again with its next range to its anchor.
    Earlier measurements hardly constrain its pose then: the error of its heading has grown to up to a radian,
    and over such an angle no fit is linear. Both robots compute the tick from data that both have: a's log
    and the ranges between them.
    """
    if not knowledge.config.begins_again:
        return 0
    log = knowledge.log if knowledge.config.role == "a" else knowledge.peer_state.peer
    ticks = [ranged.tick for ranged in log.ranges if ranged.tick <= through]
    return max([tick for before, tick in pairwise(ticks) if has_failed(knowledge, before, tick)], default=0)


def has_failed(knowledge: Knowledge, before: int, tick: int) -> bool:
    """Return whether a robot a without a range to its anchor from tick `before` until `tick` has failed.

    It has if it has not met b in more than T_max, or if MANY_MUTUAL_RANGES have not settled the poses. It has
    met b if there are LEAST_RANGES mutual ranges.
    """
    config, at = knowledge.config, attrgetter("tick")
    if (
        tick - before < MANY_MUTUAL_RANGES
        and (tick - before) * config.mission.period <= config.rendezvous.bound
    ):
        return False  # a tick has at most one range between the robots
    count = bisect_left(knowledge.mutual, tick, key=at) - bisect_left(knowledge.mutual, before, key=at)
    if count < LEAST_RANGES:
        return (tick - before) * config.mission.period > config.rendezvous.bound
    return count >= MANY_MUTUAL_RANGES


def path_of(log: MotionLog, first: int, through: int, mission: Mission) -> Track:
    """Return the odometry of `log` up to tick `through`, as if it had not moved until `first`."""
    return _path_of(log.runs, first, through, mission.period, mission.noise.odometry)


@lru_cache(maxsize=4)
def _path_of(
    runs: tuple[Segment, ...], first: int, through: int, period: float, noise: VelocityNoise
) -> Track:
    """Return the path of `path_of`, which robots ask for several times in a tick."""
    ticks = [run.ticks for run in runs]
    v, omega = (
        np.repeat(one, ticks)[:through] for one in ([run.v for run in runs], [run.omega for run in runs])
    )
    v[:first] = omega[:first] = 0.0
    # -0.0 and 0.0 are the same to the cache
    path = track(v + 0.0, omega + 0.0, period)
    if first == 0:
        return path
    extra = np.zeros((2, len(v)))
    extra[:, :first] = -variances(v[:first], omega[:first], noise)
    return path._replace(extra=extra)


def _missing(ranges: Listed, end: int, first: int) -> Places:
    """Return the ticks from `first` on and before `end` without one of `ranges`."""
    silent = np.ones(end, bool)
    silent[:first] = False
    silent[[tick for tick, _ in ranges]] = False
    return np.flatnonzero(silent)


def _ranges_within(log: MotionLog, first: int, through: int) -> list[tuple[int, float]]:
    """Return tick and range in m of each anchor range of `log` over the ticks [first, through]."""
    return [(ranged.tick, ranged.range) for ranged in log.ranges if first <= ranged.tick <= through]


def own_measurements(knowledge: Knowledge) -> JointMeasurements:
    """Return the odometry of the robot and its ranges to its anchor, without those that do not count."""
    mission, now = knowledge.config.mission, knowledge.tick
    first = beginning(knowledge, now) if knowledge.config.role == "a" else 0
    ranges = _ranges_within(knowledge.log, first, now)
    silent = Silence(0, -1, _missing(ranges, now + 1, first))
    own = near_anchors(
        [path_of(knowledge.log, first, now, mission)],
        *([ranges], [(0.0, 0.0)], mission.noise, mission.sensing_range),
        silent=(silent,),
    )
    return replace(own.alone(0), solver=knowledge.solver)


def pair_of(knowledge: Knowledge) -> JointMeasurements:
    """Return the ranges and odometry of both robots; the first is robot a, and M1 is the origin.

    The own data reach up to now, and the peer's up to the last tick that both logs cover.
    """
    peer, config = knowledge.peer_state.peer, knowledge.config
    mission, last = config.mission, knowledge.known_through
    logs, ends = ((knowledge.log, peer), (knowledge.tick, last, last))
    if config.role == "b":
        logs, ends = ((peer, knowledge.log), (last, knowledge.tick, last))
    first = beginning(knowledge, last)
    firsts = (first, 0, first)
    own = [_ranges_within(log, *within) for log, *within in zip(logs, firsts, ends, strict=False)]
    mutual = [(one.tick, one.range) for one in knowledge.mutual if first <= one.tick <= last]
    silent = [
        Silence(*robots, _missing(ranges, end + 1, begin))
        for robots, ranges, end, begin in zip(
            ((0, -1), (1, -1), (0, 1)), (*own, mutual), ends, firsts, strict=True
        )
    ]
    measured = near_anchors(
        (path_of(logs[0], first, ends[0], mission), path_of(logs[1], 0, ends[1], mission)),
        *(own, ((0.0, 0.0), m2_of(config)), mission.noise, mission.sensing_range, mutual, tuple(silent)),
    )
    return replace(measured.thinned(mission.sensing_range), solver=knowledge.solver)


def m2_of(config: RobotConfig) -> tuple[float, float]:
    """Return the place (m) of M2 relative to M1."""
    m1, m2 = config.m1, config.peer_anchor if config.role == "a" else config.anchor
    return m2.x - m1.x, m2.y - m1.y  # the same bits for both robots
