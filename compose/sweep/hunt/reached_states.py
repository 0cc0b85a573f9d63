"""The states that a run has reached: tasks and transitions, conditions that prevented a claim, messages."""

from __future__ import annotations

from collections.abc import Iterator, Set
from typing import Any, get_args

from agent.estimation import claim
from agent.planning import tasks
from agent.planning.planner import Planner
from compose.launch.planner_loader import planner_of
from compose.recording.run import Run
from protocol.messages import Observation, Report, RobotConfig, Verdict

MESSAGES = (
    "log", "no log", "pose", "ranges", "result",
    "late", "twice", "damaged", "lost", "contact", "drop-out", "anchor",
)  # fmt: skip
"""The kinds of messages and measurements: what a report contains, how it arrives, and what was ranged."""
DISTURBED = frozenset({"late", "twice", "damaged", "lost"})
"""The kinds of messages whose way matters to the processes."""

_unmet: set[str] = set()
"""The conditions that were not met since the last Command."""


class _Noted(claim.Blocked):
    """A Blocked whose condition is noted."""

    def __new__(cls, condition: claim.Condition, reason: str) -> _Noted:
        _unmet.add(condition.name)
        return super().__new__(cls, condition, reason)


def note_conditions() -> None:
    """Let this process note which conditions for a claim are not met."""
    claim.Blocked = _Noted  # type: ignore[misc]


class TooLongError(Exception):
    """The mission lasts beyond the last tick that a WatchedPlanner was given."""


class WatchedPlanner:
    """A planner that notes in `seen` which conditions kept a robot from its claim, and in which task."""

    def __init__(self, config: RobotConfig, seen: set[str], last: float) -> None:
        """Begin with the planner of `config`; after the tick `last`, `command` raises TooLongError."""
        self._planner: Planner[Any, Any] = planner_of(config)
        self._seen, self._last = seen, last
        _unmet.clear()  # what an earlier run has left

    def __getattr__(self, name: str) -> Any:
        return getattr(self._planner, name)

    def command(self, state: Any) -> Any:
        """Return the Command of the planner."""
        command = self._planner.command(state)
        if command.tick > self._last:
            raise TooLongError
        self._seen.update([f"{command.task}/{command.phase} withheld: {one}" for one in _unmet])
        _unmet.clear()
        return command


def reached(run: Run) -> tuple[set[str], tuple[int, ...]]:
    """Return what `run` has reached, and the ticks in which something changed."""
    found: set[str] = set()
    moments: set[int] = set()
    for agent in run.agents.values():
        before, heard = "", set[tuple[str, int]]()
        for step in agent.steps:
            if step.command is None:
                continue
            command = step.command
            place = f"{command.task}/{command.phase}/{_verdict(command.verdict)}"
            if place != before:
                moments.add(command.tick)
                found |= {place, f"{before} -> {place}", f"{command.role}: {command.task}"}
            for kind in _messages(step.observation, [one.report for one in step.received], heard):
                found.add(f"{place}: {kind}")
            before = place
    if run.end is not None:
        found |= {f"end: {one.code}" for one in run.end.causes} | {f"end: {run.end.outcome}"}
        moments.add(run.end.tick)
    return found, tuple(sorted(moments))


def _verdict(verdict: Verdict | None) -> str:
    return type(verdict).__name__.lower() if verdict is not None else "open"


def _messages(observation: Observation, reports: list[Report], heard: set[tuple[str, int]]) -> Iterator[str]:
    """Yield the kinds of what a robot received in one tick; `heard` are the reports of earlier ones."""
    measured = {
        "contact": any(one.range is not None for one in observation.contacts),
        "drop-out": any(one.range is None for one in observation.contacts),
        "damaged": any(one.damaged for one in observation.contacts),
        "lost": bool(observation.lost),
        "anchor": observation.anchor_range is not None or bool(observation.anchors),
    }
    yield from [kind for kind, is_there in measured.items() if is_there]
    for report in reports:
        identity = report.robot, report.tick
        contained = {
            "log" if report.has_log else "no log": True,
            "pose": report.prior is not None,
            "ranges": bool(report.ranges),
            "result": report.verdict is not None,
            f"result {_verdict(report.verdict)}": True,
            "late": report.tick < observation.tick,
            "twice": identity in heard,
        }
        yield from [kind for kind, is_there in contained.items() if is_there]
        heard.add(identity)


def never(reached: Set[str]) -> dict[str, list[str]]:
    """Return the tasks, conditions and kinds of messages of missions that are not among `reached`."""
    named = {one.partition("/")[0] for one in reached}
    conditions = {one.partition("withheld: ")[2] for one in reached}
    messages = {one.rpartition(": ")[2] for one in reached}
    return {
        "tasks": sorted(task_names() - named),
        "conditions": [
            one.name for one in claim.CONDITIONS if one.users - ON_RECORDINGS and one.name not in conditions
        ],
        "messages": [one for one in MESSAGES if one not in messages],
    }


def task_names() -> set[str]:
    """Return the names of all tasks but those of planners of the user, and of meetings that others fill."""
    kinds, names = [*get_args(tasks.Task)], {*OUTCOMES}
    while kinds:
        kind = kinds.pop()
        kinds += kind.__subclasses__()
        names |= {name} if isinstance(name := vars(kind).get("name"), str) else set()
    return names


ON_RECORDINGS = frozenset({"recording"})
"""The users of the conditions that concern no mission."""

OUTCOMES = ("localised", "undecided", "inconsistent")
"""The names of the task of a robot with a result."""
