"""The comparison of two recordings: the first tick in which they differ."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from compose.recording.reasons import ended, outcome_after
from compose.recording.run import Run


class Comparison(msgspec.Struct, frozen=True):
    """The comparison of two runs."""

    line: str
    """The result in one line."""
    identical: bool
    """True if all compared values are equal to the bit, and both runs have the same end."""
    outcomes: tuple[str, str]
    """The outcome of each run and its last tick."""


def comparison(one: Run, other: Run) -> Comparison:
    """Return how the commands, the true poses and the reports of two runs compare, in the order of time.

    Poses are compared if both runs have a ground truth, and the reports of each robot whose journal is in
    both recordings.
    """
    outcomes = (_outcome(one), _outcome(other))
    found = _first_difference(one, other)
    if found is not None:
        return Comparison(found, False, outcomes)
    *all_but_last, last = _compared(one, other)
    what = f"{', '.join(all_but_last)} and {last}" if all_but_last else last
    return Comparison(f"identical: the same {what} in all ticks, 0 to {one.length - 1}", True, outcomes)


def _outcome(run: Run) -> str:
    end = run.end
    return ended(None, run.length - 1) if end is None else outcome_after(end.outcome, end.tick, None)


def _compared(one: Run, other: Run) -> Iterator[str]:
    """Yield the names of what both runs have of all robots."""
    yield "commands"
    if one.world is not None and other.world is not None:
        yield "poses"
    if all(robot in run.agents for run in (one, other) for robot in one.robots):
        yield "reports"


def _first_difference(one: Run, other: Run) -> str | None:
    """Return the first difference in one line; None if there is none."""
    if one.robots != other.robots:
        return f"the robots differ: {', '.join(one.robots)} | {', '.join(other.robots)}"
    truths = [{robot: run.truth(robot) for robot in one.robots} for run in (one, other)]
    both_true = one.world is not None and other.world is not None
    for tick in range(min(one.length, other.length)):
        moved = [
            robot for robot in one.robots if both_true and truths[0][robot][tick] != truths[1][robot][tick]
        ]
        reports = [_report_difference(one, other, robot, tick) for robot in one.robots]
        commanded = [robot for robot in one.robots if one.command(robot, tick) != other.command(robot, tick)]
        found = [
            *[f"{robot}'s pose" for robot in moved],
            *[what for what in reports if what is not None],
            *[f"{robot}'s command" for robot in commanded],
        ]
        if found:
            return _at(tick, found[0])
    if one.length != other.length:
        side = "left" if one.length < other.length else "right"
        shorter = min(one.length, other.length)
        return _at(shorter, f"the {side} recording has ended")
    if one.end != other.end:
        return _at(one.length - 1, "the end of the mission")
    return None


def _at(tick: int, what: str) -> str:
    return f"the first difference is in tick {tick}: {what}"


def _report_difference(one: Run, other: Run, robot: str, tick: int) -> str | None:
    """Return which reports of `robot` differ at `tick`: the one it sent or those it received."""
    if robot not in one.agents or robot not in other.agents:
        return None
    steps = [run.agents[robot].steps for run in (one, other)]
    if any(tick >= len(of_run) for of_run in steps):
        return None
    left, right = steps[0][tick], steps[1][tick]
    if left.reports != right.reports:
        return f"{robot}'s report{'s' if len(left.reports) > 1 else ''}"
    if (left.received, left.missed) != (right.received, right.missed):
        return f"the reports that {robot} received"
    return None
