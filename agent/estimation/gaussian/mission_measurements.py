"""The measurements of a robot of a mission with noisy sensors, for fits: its own, and those of its pair."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from operator import attrgetter

import numpy as np
from msgspec.structs import replace

from agent.estimation.gaussian.joint_ranges import JointMeasurements, Silence
from agent.estimation.gaussian.measured_rows import Listed, near_anchors
from agent.estimation.gaussian.odometry_noise import Places, Track, track, variances
from agent.estimation.knowledge import Knowledge
from protocol.messages import Ranged
from protocol.mission import Mission
from protocol.motion import Segment

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


@lru_cache(maxsize=4)
def path_of(runs: tuple[Segment, ...], first: int, through: int, mission: Mission) -> Track:
    """Return the odometry of `runs` up to tick `through`, as if it had not moved until `first`.

    Robots ask for it several times in a tick.
    """
    ticks = [run.ticks for run in runs]
    v, omega = (
        np.repeat(one, ticks)[:through] for one in ([run.v for run in runs], [run.omega for run in runs])
    )
    v[:first] = omega[:first] = 0.0
    # -0.0 and 0.0 are the same to the cache
    path = track(v + 0.0, omega + 0.0, mission.period)
    if first == 0:
        return path
    extra = np.zeros((2, len(v)))
    extra[:, :first] = -variances(v[:first], omega[:first], mission.noise.odometry)
    return path._replace(extra=extra)


def _within(ranges: Sequence[Ranged], first: int, through: int) -> tuple[Listed, Places]:
    """Return tick and range in m of each of `ranges` in the ticks [first, through], and those without one."""
    listed = [(one.tick, one.range) for one in ranges if first <= one.tick <= through]
    silent = np.ones(through + 1, bool)
    silent[:first] = False
    silent[[tick for tick, _ in listed]] = False
    return listed, np.flatnonzero(silent)


def own_measurements(knowledge: Knowledge) -> JointMeasurements:
    """Return the odometry of the robot and its ranges to its anchor: those that count, thinned."""
    mission, now = knowledge.config.mission, knowledge.tick
    first = beginning(knowledge, now) if knowledge.config.role == "a" else 0
    ranges, silent = _within(knowledge.log.ranges, first, now)
    own = near_anchors(
        [path_of(knowledge.log.runs, first, now, mission)],
        *([ranges], [(0.0, 0.0)], mission.noise, mission.sensing_range),
        silent=(Silence(0, -1, silent),),
    )
    return replace(own.alone(0), solver=knowledge.solver).thinned(mission.sensing_range)


def pair_of(knowledge: Knowledge) -> JointMeasurements:
    """Return the ranges and odometry of both robots; the first is robot a, and M1 is the origin.

    The own data reach up to now, and the peer's up to the last tick that both logs cover.
    """
    peer, config = knowledge.peer_state.peer, knowledge.config
    mission, last = config.mission, knowledge.known_through
    first = beginning(knowledge, last)
    (a, a_end), (b, b_end) = (knowledge.log, knowledge.tick), (peer, last)
    if config.role == "b":
        (a, a_end), (b, b_end) = (b, b_end), (a, a_end)
    of_a, a_silent = _within(a.ranges, first, a_end)
    of_b, b_silent = _within(b.ranges, 0, b_end)
    mutual, both_silent = _within(knowledge.mutual, first, last)
    measured = near_anchors(
        (path_of(a.runs, first, a_end, mission), path_of(b.runs, 0, b_end, mission)),
        *((of_a, of_b), ((0.0, 0.0), knowledge.m2), mission.noise, mission.sensing_range, mutual),
        silent=(Silence(0, -1, a_silent), Silence(1, -1, b_silent), Silence(0, 1, both_silent)),
    )
    measured = replace(measured, origin=(config.m1.x, config.m1.y), solver=knowledge.solver)
    return measured.thinned(mission.sensing_range)
