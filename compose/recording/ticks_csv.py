"""`ticks.csv`: one row per tick and robot."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator

import msgspec
from msgspec.structs import astuple

from compose.recording.run import Run
from protocol.motion import Pose, wrap


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
    """Measured range to the peer in m; in a group, to the nearest robot."""
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


def rows(run: Run) -> Iterator[TickRow]:
    """Yield one row per tick and robot, from tick 0. A robot whose journal ends earlier has no later rows."""
    truths = {robot: run.truth(robot) for robot in run.robots}
    for tick in range(run.length):
        for robot, observation in run.observations[tick].items():
            pose = truths[robot][tick] if truths[robot] else None
            contact = run.contact(robot, tick)
            driven = run.driven(robot, tick)
            command = run.command(robot, tick)
            yield TickRow(
                tick,
                robot,
                x=pose.x if pose is not None else None,
                y=pose.y if pose is not None else None,
                heading=wrap(pose.heading) if pose is not None else None,
                v=driven.v if driven is not None else None,
                omega=driven.omega if driven is not None else None,
                anchor_range=observation.anchor_range,
                mutual_range=contact.range if contact is not None else None,
                phase=command.phase if command is not None else None,
                state=command.task if command is not None else None,
            )


def ticks_csv(run: Run) -> str:
    """Return the text of `ticks.csv`."""
    return table(rows(run))


def table(rows: Iterable[TickRow]) -> str:
    """Return `rows` in the format of `ticks.csv`, with floats in their shortest exact form."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(TickRow.__struct_fields__)
    writer.writerows([["" if one is None else one for one in astuple(row)] for row in rows])
    return out.getvalue()
