"""`ticks.csv`: one row per tick and robot."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import astuple

from compose.recording.run import Recording
from protocol.motion import Pose, wrap
from world.scenario import Scenario
from world.sensors import anchor_ranges, executed, mutual_ranges
from world.truth import Truth, limited_controls

if TYPE_CHECKING:
    from agent.process.agent_journal import Past


class TickRow(msgspec.Struct, frozen=True):
    """One row of `ticks.csv`: one robot in one tick. None is an empty field of the file."""

    tick: int
    """The tick k."""
    robot: str
    """The robot's name."""
    x: float | None
    """True x in m; None in hardware mode."""
    y: float | None
    """True y in m; None in hardware mode."""
    heading: float | None
    """True heading in rad, in (-pi, pi]; None in hardware mode."""
    v: float | None
    """Speed in m/s executed until the next tick, measured in hardware mode; None in the last tick."""
    omega: float | None
    """Turn rate in rad/s, like `v`."""
    anchor_range: float | None
    """Measured range to the anchor in m."""
    mutual_range: float | None
    """Measured range to the peer in m."""
    phase: int | None
    """Phase of the Command; None if the Command was late."""
    state: str | None
    """Planner state of the Command; None if the Command was late."""

    @property
    def pose(self) -> Pose | None:
        """The true pose; None in hardware mode."""
        if self.x is None or self.y is None or self.heading is None:
            return None
        return Pose(self.x, self.y, self.heading)


def rows(recording: Recording) -> Iterator[TickRow]:
    """Yield one row per tick and robot, from tick 0."""
    scenario = recording.scenario
    last = recording.ticks[-1].truth.tick if recording.ticks else 0
    for moment in recording.ticks:
        tick = moment.truth.tick
        anchor = anchor_ranges(moment.truth, scenario)
        mutual = _mutual(scenario, moment.truth)
        for i, (robot, pose) in enumerate(zip(scenario.robots, moment.truth.poses, strict=True)):
            command = moment.commands.get(robot.id)
            v = omega = None
            if tick != last:
                driven = executed(limited_controls(command, scenario.mission), scenario, robot.id, tick)
                v, omega = driven.v, driven.omega
            yield TickRow(
                *(tick, robot.id, pose.x, pose.y, wrap(pose.heading), v, omega),
                *(anchor[i], mutual.get(robot.id)),
                *((command.phase, command.state) if command is not None else (None, None)),
            )


def rows_of(pasts: Mapping[str, Past]) -> Iterator[TickRow]:
    """Yield one row per tick and robot of hardware mode, with measured speeds and without true poses."""
    for tick in range(max([len(past.steps) for past in pasts.values()], default=0)):
        for robot, past in pasts.items():
            if tick >= len(past.steps):
                continue
            observation, command = past.steps[tick].observation, past.steps[tick].command
            after = past.steps[tick + 1].observation.executed if tick + 1 < len(past.steps) else None
            contact = past.contact(tick)
            yield TickRow(
                tick,
                robot,
                x=None,
                y=None,
                heading=None,
                v=after.v if after is not None else None,
                omega=after.omega if after is not None else None,
                anchor_range=observation.anchor_range,
                mutual_range=contact.range if contact is not None else None,
                phase=command.phase if command is not None else None,
                state=command.state if command is not None else None,
            )


def ticks_csv(recording: Recording) -> str:
    """Return the text of `ticks.csv`."""
    return table(rows(recording))


def table(rows: Iterable[TickRow]) -> str:
    """Return `rows` in the format of `ticks.csv`, with floats in their shortest exact form."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(TickRow.__struct_fields__)
    writer.writerows([["" if one is None else one for one in astuple(row)] for row in rows])
    return out.getvalue()


def _mutual(scenario: Scenario, truth: Truth) -> dict[str, float]:
    """Return the measured range in m to the peer, for each robot that has one."""
    pairs = scenario.pairs()
    return {
        scenario.robots[i].id: mutual.range
        for pair, mutual in zip(pairs, mutual_ranges(truth, scenario, pairs), strict=True)
        if mutual is not None and mutual.range is not None
        for i in pair
    }
