"""The closest approach of two robots after their first mutual range."""

from __future__ import annotations

import math

from compose.recording.run import Recording, TickRecord
from protocol.motion import Pose, step
from world.sensors import executed, mutual_ranges
from world.truth import limited_controls

INSTANTS = 32
"""The number of equal parts of a tick, at whose ends the distance is computed."""


def nearest(recording: Recording) -> float | None:
    """Return the smallest distance in m of any pair from its first mutual range on, also between ticks.

    The result is None if no pair had a mutual range.
    """
    scenario = recording.scenario
    found = [_of_pair(recording, pair) for pair in scenario.pairs()]
    return min([one for one in found if one is not None], default=None)


def _of_pair(recording: Recording, pair: tuple[int, int]) -> float | None:
    scenario, least = recording.scenario, None
    for moment in recording.ticks:
        (mutual,) = mutual_ranges(moment.truth, scenario, [pair])
        if least is None and (mutual is None or mutual.range is None):
            continue
        paths = [_path(recording, moment, i) for i in pair]
        apart = [math.hypot(one.x - other.x, one.y - other.y) for one, other in zip(*paths, strict=True)]
        least = min([*apart, least if least is not None else math.inf])
    return least


def _path(recording: Recording, moment: TickRecord, place: int) -> list[Pose]:
    """Return INSTANTS + 1 poses of a robot from this tick to the next; in the last tick, it is at rest."""
    scenario, pose = recording.scenario, moment.truth.poses[place]
    if moment is recording.ticks[-1]:
        return [pose] * (INSTANTS + 1)
    robot = scenario.robots[place].id
    command = moment.commands.get(robot)
    driven = executed(limited_controls(command, scenario.mission), scenario, robot, moment.truth.tick)
    period = scenario.mission.period
    return [step(pose, driven.v, driven.omega, period * i / INSTANTS) for i in range(INSTANTS + 1)]
