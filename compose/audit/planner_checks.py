"""The checks of a planner of the user against its contract."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from agent.planning.planner import Planner
from compose.audit.planner_probe import BreaksContract, HostilityProbe, PurityProbe, Watched
from compose.audit.rules import audit_run
from compose.errors import PlannerFailed, UserError
from compose.launch import in_process, planner_loader
from compose.launch.supervisor import ChildFailed
from compose.recording import run as recorded
from compose.recording.comparison import comparison
from compose.recording.reasons import reason_for
from compose.recording.recording_files import WORLD_JOURNAL
from compose.recording.run import Run
from compose.scenario.kills import KILL_POINTS, Kill, parse
from compose.sweep.trial_mission import as_processes
from compose.terminal.finding import Finding, checked, ok
from protocol.journal.journal_file import MemoryJournal
from protocol.messages import RobotConfig
from protocol.network.inbox import Inbox
from world.scenario import Scenario


class QuietInbox(Inbox):
    """An inbox that prints nothing: kills and restarts are part of a check."""

    def say(self, line: str) -> None:
        """Print nothing."""


Journals = dict[str, list[bytes]]


def check_planner(scenario: Scenario, inbox: Inbox) -> Iterator[Finding]:
    """Yield the results of all checks of the planner of `scenario`, which has been loaded before.

    If it cannot complete the mission in one process, the checks after that one are left out.
    """
    what = "it completes a mission, with answers that can be sent"
    try:
        first, run = _journals(scenario)
    except UserError as error:
        yield checked(what, str(error))
        return
    yield ok(what)
    yield checked("two runs in one process are the same", _other(first, _journals(scenario)[0]))
    for rule, probe in (
        ("equal arguments give equal answers, and are not changed", PurityProbe),
        ("no report can make it fail", HostilityProbe),
    ):
        yield checked(rule, _probed(scenario, probe))
    yield checked("a verdict is final", _taken_back(run))
    yield _audited(run)
    for rule, kills in (
        ("it decides the same as processes over the network", ()),
        ("killed processes resume and decide the same", _kills(scenario, run)),
    ):
        yield checked(rule, _as_processes(scenario, kills, inbox))


def _journals(
    scenario: Scenario,
    planner_of: Callable[[RobotConfig], Planner[Any, Any]] = planner_loader.planner_of,
) -> tuple[Journals, Run]:
    """Run the mission in this process, and return the frames of its journals, and the run."""
    sinks = {name: MemoryJournal() for name in in_process.journals(scenario)}
    in_process.played(scenario, sinks, planner_of)
    frames = {name: sinks[name].frames for name in (WORLD_JOURNAL, *sorted({*sinks} - {WORLD_JOURNAL}))}
    return frames, recorded.of_frames(frames, scenario.name)


def _probed(scenario: Scenario, probe: type[Watched]) -> str | None:
    """Return what `probe` finds in a mission in this process."""

    def watched(config: RobotConfig) -> Watched:
        def fresh() -> Planner[Any, Any]:
            return planner_loader.unguarded_planner_of(config)

        return probe(config.planner_name, fresh)

    try:
        _journals(scenario, watched)
    except (BreaksContract, PlannerFailed) as error:
        return str(error)
    return None


def _other(one: Mapping[str, list[bytes]], other: Mapping[str, list[bytes]]) -> str | None:
    """Return where two recordings differ first; None if they are the same."""
    name = next((name for name in one if one[name] != other[name]), None)
    if name is None:
        return None
    found = comparison(recorded.of_frames(one), recorded.of_frames(other))
    return f"{name} has other bytes" if found.identical else found.line


def _taken_back(run: Run) -> str | None:
    for robot in run.robots:
        verdict = None
        for tick in range(run.length):
            command = run.command(robot, tick)
            if verdict is not None and command is not None and command.verdict != verdict:
                return f"{robot} has another verdict at tick {tick} than at the tick before"
            verdict = command.verdict if command is not None else verdict
    return None


def _audited(run: Run) -> Finding:
    what = f"the audit finds nothing (outcome: {run.end.outcome if run.end is not None else 'none'})"
    violations = audit_run(run).violations
    return checked(what, violations[0].line if violations else None)


def _kills(scenario: Scenario, run: Run) -> tuple[Kill, ...]:
    """Return kills of each robot and of the world, spread over the mission and the points of a tick."""
    names = [*[robot.id for robot in scenario.robots], "world"]
    found = []
    for i, name in enumerate(names * 2):
        tick = run.length * (i + 1) // (2 * len(names) + 1)
        point = KILL_POINTS[i % len(KILL_POINTS)] if tick in _contact(run, name) else "journal"
        if tick > 0:
            found.append(parse(f"{name}@{tick}:{point}"))
    return tuple(found)


def _contact(run: Run, name: str) -> set[int]:
    """Return the ticks in which a process sends reports: there, a kill at any point happens."""
    if name == "world":
        return set(range(run.length))
    return {tick for tick in range(run.length) if run.contact(name, tick) is not None}


def _as_processes(scenario: Scenario, kills: tuple[Kill, ...], inbox: Inbox) -> str | None:
    """Return how a run as processes differs from one in this process; None if it does not."""
    try:
        ran = as_processes(scenario, audit=False, kills=kills, inbox=inbox)
    except ChildFailed as error:
        return str(error)
    if kills and not ran.kills:
        return "no kill took place"
    if ran.differing and ran.run.end is not None and ran.run.end.outcome == "failed":
        return f"the mission failed: {reason_for(ran.run.end)}"
    return f"{ran.differing[0]} has other bytes" if ran.differing else None
