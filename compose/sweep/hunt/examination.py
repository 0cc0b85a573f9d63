"""The examination of one input: its run, what that reaches, and the invariants that it breaks."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Set
from pathlib import Path
from typing import Any, cast
from zlib import crc32

import msgspec

from compose.errors import UserError
from compose.launch import in_process, virtual_hardware, virtual_processes
from compose.recording.run import Run, of_frames
from compose.scenario.kills import Kill
from compose.scenario.scenario_file import validate
from compose.sweep.hunt.invariants import Breach, bounds, breaches, guaranteed
from compose.sweep.hunt.mutation import Clues
from compose.sweep.hunt.reached_states import DISTURBED, TooLongError, WatchedPlanner, reached
from protocol.journal.journal_file import MemoryJournal, packed
from protocol.network.clock import ClockError
from protocol.wire import EncodedMessages
from world.scenario import Scenario

MOST_TICKS = 120_000
"""The largest product of `max_ticks` and robots of a mission that must localise them; others are refused."""
MOST_WITHOUT_END = 750
"""The largest number of ticks that are examined of a mission that need not localise its robots.

A robot that waits for what was lost waits until `max_ticks`, and each restart would replay all of it.
"""
FULL_EACH = 32
"""The number of inputs that reach nothing new of which one is examined in full all the same.

A run as virtual processes with kills takes the time of ten missions with exact sensors.
"""
BOUND_PARTS = 50
"""The parts of a computed bound: a run that takes a part that none took before has reached a new state."""


class Examined(msgspec.Struct, frozen=True):
    """The result of one input."""

    breaches: tuple[Breach, ...] = ()
    reached: frozenset[str] = frozenset()
    known: Clues = Clues(())
    bound_share: float = 0.0
    """The largest share of a computed bound that something took."""
    refused: str | None = None
    """The reason why the input was not run; None if it was."""


def scenario_of(table: dict[str, Any]) -> tuple[Scenario, tuple[Kill, ...], dict[str, ClockError]]:
    """Return the scenario, the kills and the errors of clocks of `table`. Raises UserError."""
    template = validate(table, "the input")
    return template.scenario, template.kills(template.scenario.seed), template.clocks


def examined(table: dict[str, Any], seen: Set[str] | None = None) -> Examined:
    """Run the input `table`, in one process and as virtual processes, and examine the run.

    `seen` is what earlier runs have reached. Most inputs whose kills, faults and clocks reach nothing else do
    not run a second time, and most that reach nothing else at all are not replayed.
    """
    try:
        scenario, kills, clocks = scenario_of(table)
    except UserError as error:
        return Examined(refused=str(error))
    if guaranteed(scenario) and scenario.max_ticks * len(scenario.robots) > MOST_TICKS:
        return Examined(refused="it could last too long")
    conditions: set[str] = set()
    try:
        sinks, messages, is_cut = watched(scenario, conditions)
    except Exception as error:  # noqa: BLE001  # no input may make a planner or the world raise anything
        return Examined((Breach("a process dies", f"{type(error).__name__}: {error}"),))
    again: list[Breach] = []
    try:
        run = of_frames({name: one.frames for name, one in sinks.items()}, messages=messages)
        found, moments = reached(run)
        events = {one for one in found if one.rpartition(": ")[2] in DISTURBED}
        events |= {f"killed: {kill.who == 'world'} {kill.point} {_task(run, kill)}" for kill in kills}
        alone = not (kills or scenario.faults or scenario.deaths)  # then it also runs in hardware mode
        events |= {
            f"clock: {alone} {who == 'world'} {sorted({by for _, by in one.jumps})}"
            for who, one in clocks.items()
        }
        parts = [(ticks, bound) for _, ticks, bound in bounds(run) if ticks is not None and bound]
        near = {
            f"{i} of {len(parts)} bounds: {BOUND_PARTS * one[0] // one[1]}" for i, one in enumerate(parts)
        }
        found |= conditions | events
        known = seen or frozenset()
        in_turn = seen is None or crc32(msgspec.json.encode(table)) % FULL_EACH == 0
        twice = not is_cut and (in_turn or not events <= known)
        if twice:
            again, orders = _again(scenario, kills, clocks, sinks)
            found |= orders
        every = [*again, *breaches(run, in_full=twice or in_turn or not found <= known, replayed=twice)]
    except Exception as error:  # noqa: BLE001  # nor a reader of the recording, or a rule of the audit
        return Examined((*again, Breach("the recording is misread", f"{type(error).__name__}: {error}")))
    ids = tuple([one.id for one in scenario.robots])
    used = max([ticks / bound for ticks, bound in parts], default=0.0)
    return Examined(tuple(every), frozenset(found | near), Clues(ids, run.length - 1, moments), used)


def watched(scenario: Scenario, seen: set[str]) -> tuple[dict[str, MemoryJournal], EncodedMessages, bool]:
    """Return the journals of a run of `scenario` in this process, its messages, and whether it is cut.

    It is cut after MOST_WITHOUT_END ticks if nothing must end it. `seen` are the conditions not met.
    """
    last = math.inf if guaranteed(scenario) else MOST_WITHOUT_END
    sinks, messages = {name: MemoryJournal() for name in in_process.journals(scenario)}, EncodedMessages()
    try:
        in_process.played(
            scenario,
            sinks,
            lambda config: cast(Any, WatchedPlanner(config, seen, last)),
            messages.encode,
        )
    except TooLongError:
        return sinks, messages, True
    return sinks, messages, False


def _task(run: Run, kill: Kill) -> str:
    """Return the task of the killed robot, or of the first one, in the tick of `kill`; and if in contact."""
    robot = kill.who if kill.who in run.robots else run.robots[0]
    command = run.command(robot, kill.tick) if kill.tick < run.length else None
    if command is None:
        return "over"
    return command.task if run.contact(robot, kill.tick) is None else f"{command.task} in contact"


def _again(
    scenario: Scenario,
    kills: tuple[Kill, ...],
    clocks: dict[str, ClockError],
    sinks: dict[str, MemoryJournal],
) -> tuple[list[Breach], set[str]]:
    """Return how a run as virtual processes differs from `sinks`, or fails in hardware mode with `clocks`.

    The second value has the orders in which frames arrived.
    """
    if clocks and not (kills or scenario.faults or scenario.deaths):
        with tempfile.TemporaryDirectory(prefix="tandem-hunt-") as folder:
            hardware = virtual_hardware.run_hardware(scenario, Path(folder), clocks)
        failed = [one.causes[0].text or "" for one in hardware.ends.values() if one.outcome == "failed"]
        if failed or hardware.failures:
            return [Breach("a process dies", "; ".join((*hardware.failures, *failed)))], set()
        if hardware.wrong and not any(one.attack for one in scenario.robots):
            return [Breach("a wrong claim", f"in hardware mode: {hardware.wrong[0].robots[0]}")], set()
    with tempfile.TemporaryDirectory(prefix="tandem-hunt-") as folder:
        ended = virtual_processes.run_mission(scenario, Path(folder), kills, clocks)
        if ended.failures:
            return [Breach("a process dies", "; ".join(ended.failures))], set()
        differing = [
            Breach(
                "the recording differs", f"{name}, from frame {_first(one.frames, Path(folder) / name)} on"
            )
            for name, one in sinks.items()
            if (Path(folder) / name).read_bytes() != packed(one.frames)
        ]
        return differing[:1], {f"arrived: {order}" for order in ended.orders}


def _first(frames: list[bytes], path: Path) -> int:
    """Return the number of the first frame of the journal at `path` that differs from `frames`."""
    data = path.read_bytes()
    return next((i for i in range(len(frames)) if not data.startswith(packed(frames[: i + 1]))), len(frames))
