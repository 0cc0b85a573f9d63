"""The catalogue of the figures of a pair, by kind."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from matplotlib.figure import Figure

from compose.figures import (
    decisions,
    manoeuvre,
    one_robot,
    over_time,
    phase_one,
    spread,
    steps,
    trajectory,
)
from compose.figures.pair import PairRecord
from compose.figures.sheet import Absent
from compose.figures.style import SCREEN, Medium
from compose.recording.group_localisation import past_meetings

Picture = tuple[str, Figure | Absent]


def pictures(pair: PairRecord, kind: str, medium: Medium = SCREEN) -> Iterator[Picture]:
    """Yield the figures of one kind (see `PICTURES`) with their names; none if their journals are missing.

    Must be called within the `look` of the medium.
    """
    return _DRAWN[kind](pair, medium)


def _meetings(pair: PairRecord, medium: Medium) -> Iterator[Picture]:
    """Yield the figure of the whole group with its first meeting; none for pairs."""
    run = pair.run
    meetings = past_meetings(run)
    if meetings and (meetings[0].a, meetings[0].b) == (pair.a.id, pair.b.id):
        yield "meetings", spread.draw(run, medium)


def _trajectory(pair: PairRecord, medium: Medium) -> Iterator[Picture]:
    yield f"trajectory-{pair.name}", trajectory.draw(pair, medium)


def _phase_one(pair: PairRecord, medium: Medium) -> Iterator[Picture]:
    for role in pair.newcomers:
        name = f"phase-1-{pair.robot(role).id}"
        yield name, phase_one.draw(pair, role, medium) if pair.planner is not None else _foreign(pair)


def _plan(pair: PairRecord, medium: Medium) -> Iterator[Picture]:
    """Yield the planned manoeuvres; with active sensing, the hypotheses at its decisions."""
    if pair.readable and pair.planner is None:
        yield f"plan-{pair.name}", _foreign(pair)
    elif pair.planner is not None and pair.planner.ACTIVE_SENSING:
        yield f"plan-{pair.name}", decisions.draw(pair, medium)
    elif pair.readable:
        for name, figure in manoeuvre.draw(pair, medium).items():
            yield f"plan-{name}", figure


def _foreign(pair: PairRecord) -> Absent:
    return Absent(f"the states of the planner {pair.planner_name} cannot be drawn")


def _encounter(pair: PairRecord, medium: Medium) -> Iterator[Picture]:
    yield f"encounter-{pair.name}", steps.draw(pair, medium)


def _ranges(pair: PairRecord, medium: Medium) -> Iterator[Picture]:
    yield f"ranges-{pair.name}", over_time.ranges(pair, medium)


def _errors(pair: PairRecord, medium: Medium) -> Iterator[Picture]:
    if pair.readable:
        yield f"errors-{pair.name}", over_time.errors(pair, medium)


def _robot(pair: PairRecord, medium: Medium) -> Iterator[Picture]:
    for role in pair.newcomers:
        yield f"robot-{pair.robot(role).id}", one_robot.draw(pair, role, medium)


_DRAWN: dict[str, Callable[[PairRecord, Medium], Iterator[Picture]]] = {
    "meetings": _meetings,
    "trajectory": _trajectory,
    "phase-1": _phase_one,
    "plan": _plan,
    "encounter": _encounter,
    "ranges": _ranges,
    "errors": _errors,
    "robot": _robot,
}
