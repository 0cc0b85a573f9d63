"""The measurements of a team as those of a joint fit. They grow with its log, whose entries are read once."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from typing import NamedTuple

from msgspec.structs import astuple, replace

from agent.estimation.facts import AnchorPlace, Manoeuvre, MeasuredRange, MeasuredRow, StartPose
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.measured_rows import of_rows
from agent.peer.team_log import Entry, TeamLog
from protocol.messages import Team
from protocol.mission import Mission


class TeamMeasurements(NamedTuple):
    """The part of a team's log that has been read."""

    read: tuple[int, ...] = ()
    """The number of entries of each robot."""
    steps: Mapping[str, tuple[Manoeuvre, ...]] = {}
    """The manoeuvres of each robot of which there is a measurement."""
    rows: Mapping[tuple[bool, str, str, int], MeasuredRow] = {}
    """The ranges. Both robots measure the same one between them: that of the first in the team counts."""

    def grown(
        self, log: TeamLog, team: Team, mission: Mission, of: Collection[int] | None = None
    ) -> TeamMeasurements:
        """Return this with the entries in `log` that are new.

        They are those of the robots at the places `of`, which are the same each time, with their ranges to
        anchors and to each other; None: all.
        """
        steps, rows = dict(self.steps), dict(self.rows)
        of = range(len(team.robots)) if of is None else of
        if team.origin is not None:
            steps.setdefault(team.origin, ())
        for i, since in enumerate(self.read or (0,) * len(log.logs)):
            if i not in of:
                continue
            robot = team.robots[i]
            driven: list[Manoeuvre] = []
            for tick, entry in enumerate(log.logs[i][since:], since):
                if entry.executed is not None and tick == len(steps.get(robot, ())) + len(driven) + 1:
                    driven.append(Manoeuvre(entry.executed.v + 0.0, entry.executed.omega + 0.0))
                for row, first in _ranges(i, tick, entry, team, mission, of):
                    if first or row[:4] not in rows:
                        rows[row[:4]] = row
                    for name in (row.first, row.second)[: 1 + row.mutual]:
                        steps.setdefault(name, ())
            if driven:
                steps[robot] = (*steps.get(robot, ()), *driven)
        return TeamMeasurements(tuple(map(len, log.logs)), steps, rows)

    def joint(self, team: Team, mission: Mission) -> JointMeasurements:
        """Return the measurements of all robots of which there are some.

        Exact sensors have no sigmas that could be larger than told.
        """
        places = {
            one.id: AnchorPlace(one.position.x + 0.0, one.position.y + 0.0, one.sigma + 0.0)
            if one.position is not None
            else AnchorPlace(0.0, 0.0, math.inf)
            for one in team.anchors
        }
        starts = {team.origin: StartPose(0.0, 0.0, 0.0)} if team.origin is not None else {}
        noise, reach = mission.noise, mission.sensing_range
        measured = of_rows(places, starts, self.steps, self.rows.values(), noise, mission.period, reach)
        if measured.only_rounding:
            measured = replace(measured, noise=noise.as_told)
        return measured.thinned(reach)


def _ranges(
    i: int, tick: int, entry: Entry, team: Team, mission: Mission, of: Collection[int]
) -> Iterator[tuple[MeasuredRow, bool]]:
    """Yield each range in the entry of robot `i`, and whether it counts before that of the other robot."""
    noise, robot = mission.noise, team.robots[i]
    for to, rho in map(astuple, entry.anchors):
        if to < len(team.anchors):
            measured = MeasuredRange(rho + 0.0, noise.anchor_sigma)
            yield MeasuredRow(False, robot, team.anchors[to].id, tick, measured), True
    for to, rho in map(astuple, entry.robots):
        if to in of and to != i:
            first, second = sorted((robot, team.robots[to]))
            yield MeasuredRow(True, first, second, tick, MeasuredRange(rho + 0.0, noise.mutual_sigma)), i < to
