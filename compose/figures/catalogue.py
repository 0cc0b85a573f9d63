"""The catalogue of the figures of a pair, by kind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

from matplotlib.figure import Figure

from agent.planning.registry import planner
from compose.figures import decisions, manoeuvre, one_robot, over_time, phase_one, steps, trajectory
from compose.figures.pair import PairRecord
from compose.figures.sheet import NO_TRUTH, Absent
from compose.figures.story import Story
from compose.figures.style import look

Picture = tuple[str, Figure | Absent]


def settings(kind: str) -> AbstractContextManager[None]:
    """Return the matplotlib settings for drawing and saving figures of one kind (see `PICTURES`)."""
    return look(symbols=kind != "robot")


def pictures(pair: PairRecord, kind: str) -> Iterator[Picture]:
    """Yield the figures of one kind with their names; none if the journals they need are missing.

    Must be called within the `settings` of that kind.
    """
    return _DRAWN[kind](pair)


def _trajectory(pair: PairRecord) -> Iterator[Picture]:
    yield f"trajectory-{pair.name}", trajectory.draw(pair)


def _phase_one(pair: PairRecord) -> Iterator[Picture]:
    for role in pair.readable:
        yield f"phase-1-{pair.robot(role).id}", phase_one.draw(pair, role)


def _plan(pair: PairRecord) -> Iterator[Picture]:
    """Yield the planned manoeuvres; with active sensing, the hypotheses at its decisions."""
    if pair.readable and planner(pair.planner_name).uses_active_sensing(pair.mission):
        yield f"plan-{pair.name}", decisions.draw(pair)
    elif pair.readable:
        for name, figure in manoeuvre.draw(pair).items():
            yield f"plan-{name}", figure


def _encounter(pair: PairRecord) -> Iterator[Picture]:
    yield f"encounter-{pair.name}", steps.draw(pair)


def _ranges(pair: PairRecord) -> Iterator[Picture]:
    yield f"ranges-{pair.name}", over_time.ranges(pair)


def _errors(pair: PairRecord) -> Iterator[Picture]:
    if pair.readable:
        yield f"errors-{pair.name}", over_time.errors(pair)


def _robot(pair: PairRecord) -> Iterator[Picture]:
    for role in pair.readable:
        name, account = pair.robot(role).id, pair.robot(role).account
        assert account is not None
        if pair.recording is None:
            yield f"robot-{name}", Absent(NO_TRUTH)
            continue
        ids = [one.id for one in pair.recording.scenario.robots]
        yield f"robot-{name}", one_robot.figure_of(Story(pair.recording, ids.index(name), account.held))


_DRAWN: dict[str, Callable[[PairRecord], Iterator[Picture]]] = {
    "trajectory": _trajectory,
    "phase-1": _phase_one,
    "plan": _plan,
    "encounter": _encounter,
    "ranges": _ranges,
    "errors": _errors,
    "robot": _robot,
}
