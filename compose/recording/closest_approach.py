"""How near two robots came to each other once they knew of each other."""

from __future__ import annotations

import math

from compose.recording.run import Recording, TickRecord
from protocol.motion import Pose, step
from world.sensors import executed, mutual_ranges
from world.truth import asked

INSTANTS = 32
"""of a tick that are looked at"""


def nearest(recording: Recording) -> float | None:
    """m, from the first mutual range of a pair on, between ticks too; of several pairs the nearest."""
    scenario = recording.scenario
    found = [_of_pair(recording, pair) for pair in scenario.pairs()]
    return min([one for one in found if one is not None], default=None)


def _of_pair(recording: Recording, pair: tuple[int, int]) -> float | None:
    scenario, least = recording.scenario, None
    for moment in recording.moments:
        (mutual,) = mutual_ranges(moment.truth, scenario, [pair])
        if least is None and (mutual is None or mutual.range is None):
            continue
        ways = [_way(recording, moment, i) for i in pair]
        apart = [math.hypot(one.x - other.x, one.y - other.y) for one, other in zip(*ways, strict=True)]
        least = min([*apart, least if least is not None else math.inf])
    return least


def _way(recording: Recording, moment: TickRecord, place: int) -> list[Pose]:
    """Where the robot is from this tick to the next."""
    scenario, pose = recording.scenario, moment.truth.poses[place]
    if moment is recording.moments[-1]:
        return [pose] * (INSTANTS + 1)
    robot = scenario.robots[place].id
    command = moment.commands.get(robot)
    done = executed(asked(command, scenario.mission), scenario, robot, moment.truth.tick)
    period = scenario.mission.period
    return [step(pose, done.v, done.omega, period * i / INSTANTS) for i in range(INSTANTS + 1)]
