"""The catalogue of the figures of a pair, and of those of a team, by kind."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from matplotlib.figure import Figure

from compose.figures import (
    encounter,
    geometry,
    manoeuvre,
    one_robot,
    over_time,
    phase_one,
    spread,
    team_figures,
    trajectory,
)
from compose.figures.pair import PairRecord
from compose.figures.sheet import Absent
from compose.figures.style import SCREEN, Medium
from compose.recording.group_localisation import past_meetings
from compose.recording.run import Run

Picture = tuple[str, Figure | Absent]
OF_PAIR: dict[str, Callable[[PairRecord, Medium], Figure | Absent]] = {
    "trajectory": trajectory.draw,
    "geometry": geometry.draw,
    "encounter": encounter.draw,
    "ranges": over_time.ranges,
}
"""The figures of a pair that need no planner states."""


def pictures(pair: PairRecord, kind: str, medium: Medium = SCREEN) -> Iterator[Picture]:
    """Yield the figures of one kind (see `PICTURES`) with their names; none if their journals are missing.

    Must be called within the `look` of the medium. That of a whole group is drawn with its first meeting.
    """
    foreign = Absent(f"the states of the planner {pair.planner_name} cannot be drawn")
    match kind:
        case "meetings":
            meetings = past_meetings(pair.run)
            if meetings and (meetings[0].a, meetings[0].b) == (pair.a.id, pair.b.id):
                yield kind, spread.draw(pair.run, medium)
        case "phase-1" | "robot":
            draw = phase_one.draw if kind == "phase-1" else one_robot.draw
            known = kind == "robot" or pair.planner is not None
            for role in pair.newcomers:
                yield f"{kind}-{pair.robot(role).id}", draw(pair, role, medium) if known else foreign
        case "plan" if pair.senses_actively:
            yield f"{kind}-{pair.name}", encounter.draw_decisions(pair, medium)
        case "plan" if pair.readable:
            plans = manoeuvre.draw(pair, medium) if pair.planner is not None else {pair.name: foreign}
            yield from [(f"{kind}-{name}", figure) for name, figure in plans.items()]
        case "phases":
            yield f"{kind}-{pair.name}", trajectory.draw(pair, medium, phases=True)
        case kind if kind in OF_PAIR:
            yield f"{kind}-{pair.name}", OF_PAIR[kind](pair, medium)
        case "errors" if pair.readable:
            yield f"{kind}-{pair.name}", over_time.errors(pair, medium)


def of_team(run: Run, kind: str, medium: Medium = SCREEN) -> Iterator[Picture]:
    """Yield the figure of one kind of the team in `run`. Must be called within the `look` of the medium."""
    if kind in team_figures.DRAWN:
        yield kind, team_figures.DRAWN[kind](run, medium)
