"""Defects that a hunt must find: `python -m tests.mutants [NAME ...] [--cpu S] [--write]`.

Each is planted in a process of its own, in which a hunt runs until it has found it or its workers have used S
seconds of processor time: with the guide, and beside it by chance alone. A table says after how many runs and
seconds, with those of shrinking the input, each was found, and what the guide found, with how many changes.
`--write` replaces their rows in docs/howto-hunt.md; with `--guided-only`, the results by chance stay.
"""

from __future__ import annotations

import argparse
import inspect
import multiprocessing
import os
import resource
import sys
import textwrap
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from agent.estimation import exact_estimator
from agent.estimation.gaussian import planning_hypotheses
from agent.peer import peer_state
from agent.planning import phase3_encounter
from agent.process import node
from compose.scenario import group_meetings
from compose.sweep.hunt.exploration import FoundBreach, Hunt
from compose.sweep.hunt.mutation import fault_lines
from protocol.journal.journal_file import Journal
from world import scenario, tick
from world.hardware import bridge

MISSED = "not in "
"""The beginning of the result of a hunt that has not found the defect."""
BUDGET_S = 600.0
"""The processor time in s of 5 minutes on two cores."""
PAGE = Path("docs/howto-hunt.md")
"""The page with the table."""
BEGIN, END = "<!-- written by tests/mutants.py -->", "<!-- end of mutants -->"
"""The lines around the table."""


def edited(owner: Any, name: str, old: str, new: str) -> None:
    """Replace `old`, which must be there, by `new` in the source of the function `name` of `owner`.

    Modules that have imported the function get the new one, too.
    """
    function = vars(owner)[name]
    source = textwrap.dedent(inspect.getsource(function))
    assert source.count(old) == 1, source
    namespace: dict[str, Any] = {}
    exec(compile(source.replace(old, new), f"{name}, mutated", "exec"), function.__globals__, namespace)
    for one in (owner, *sys.modules.values()):
        if vars(one).get(name) is function:
            setattr(one, name, namespace[name])


def unflushed() -> None:
    """The frames of a Command of the last manoeuvre reach the journal only with the next ones."""
    write = Journal.write

    def later(self: Journal, *frames: bytes) -> None:
        held: tuple[bytes, ...] = vars(self).pop("held", ())
        if len(frames) <= 3 and any(b"\xa7command" in one and b"last-man" in one for one in frames):
            vars(self)["held"], frames = frames, ()
        if held or frames:
            write(self, *held, *frames)

    setattr(Journal, "write", later)  # noqa: B010


def twice() -> None:
    """A repeated Observation is taken again by a robot that waits."""
    edited(
        node.AgentProcess,
        "_on_observation",
        "        self._out_of_step.over()\n        self._repeat_answers()",
        "        self._out_of_step.over()\n"
        "        if self._robot.state.task.name == 'waiting' and self._robot.command is None:\n"
        "            self._robot.observation(observation, frame)\n"
        "        self._repeat_answers()",
    )


def back() -> None:
    """An overtaken report takes acknowledgements back."""
    edited(
        peer_state,
        "with_report",
        "report.heard if latest else peer_state.acknowledged",
        "report.heard",
    )


def early() -> None:
    """A report that is delayed is used a tick early, if it is there."""
    edited(
        node.AgentProcess,
        "_decide_when_reports_complete",
        "for tick in listed:",
        "for tick in (*listed, *[one for one in (now,) if one not in listed and contact.heard == ()"
        " and self._report_buffer.of(peer, one)]):",
    )


def kept() -> None:
    """The world keeps a claim that is withdrawn."""
    edited(
        tick,
        "verdicts_after",
        "if command is None or command.verdict == given",
        "if command is None or command.verdict is None or command.verdict == given",
    )


def lost() -> None:
    """A hypothesis is lost when the peer is in range again, after it was not."""
    edited(
        exact_estimator,
        "_with_placements",
        "    return replace(posterior, placements=remaining",
        "    gone = [one.range is None for one in observations]\n"
        "    if len(remaining) > 1 and (True, False) in zip(gone, gone[1:]):\n"
        "        remaining = remaining[1:]\n"
        "    return replace(posterior, placements=remaining",
    )


def bound() -> None:
    """The bound of a group leaves out its last visit."""
    edited(
        group_meetings,
        "group_meetings",
        "one.ends) for one in meetings])",
        "min(one.ends, meetings[-2:][0].ends)) for one in meetings])",
    )


def clock() -> None:
    """A retreat begins at the time of the clock, not at the tick."""
    edited(
        phase3_encounter,
        "sensed",
        "tasks.Retreating(back, state.tick)",
        "tasks.Retreating(back, __import__('time').monotonic_ns() % 1000)",
    )


def counted() -> None:
    """A driver counts ticks by its clock."""
    edited(
        bridge.Field,
        "_play_tick",
        "self._tick += 1",
        "began = vars(self).setdefault('began', self._inbox.clock())\n"
        "    self._tick = round((self._inbox.clock() - began) / self._tick_s)",
    )


def case() -> None:
    """The ids of robots are compared without their case."""
    edited(scenario.Scenario, "robot", "spec.id == robot", "spec.id.lower() == robot.lower()")


def triangle() -> None:
    """The lower triangle of a covariance is read in the place of the upper one."""
    planning_hypotheses.TRIANGLE = np.tril_indices(3)


MUTANTS: dict[Callable[[], None], str] = {
    unflushed: "random",
    twice: "random",
    back: "random",
    early: "random",
    kept: "random-group",
    lost: "random",
    bound: "random-group",
    clock: "random",
    counted: "random",
    case: "random",
    triangle: "random",
}
"""The mutants, each with the scenario in which it is hunted."""


def used() -> float:
    """Return the processor time in s of the workers of this process, those that have ended included."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    total = 0
    for one in multiprocessing.active_children():
        fields = Path(f"/proc/{one.pid}/stat").read_text().rpartition(")")[2].split()
        total += int(fields[11]) + int(fields[12])
    return total / os.sysconf("SC_CLK_TCK") + ended.ru_utime + ended.ru_stime


def hunted(mutant: Callable[[], None], source: str, cpu_s: float, *, guided: bool) -> str:
    """Plant `mutant` in this process, hunt, and return what was found."""
    mutant()
    hunt = Hunt(source, 1, 1, guided=guided)
    spent = 0.0

    def is_over(_: Hunt) -> bool:
        nonlocal spent
        spent = used()
        return spent > cpu_s

    found: FoundBreach | None = hunt.run(is_over)
    if found is None:
        return f"{MISSED}{hunt.runs} runs, {spent:.0f} s"
    changes = fault_lines(found.table, hunt.seeds[0])
    return f"run {found.runs}, {used():.0f} s: {found.breach.kind}, {changes} changes"


def write(cells: list[str], cpu_s: float) -> None:
    """Replace the row of a mutant in the table of PAGE by `cells`; what they lack stays."""
    before, _, rest = PAGE.read_text().partition(BEGIN)
    table, _, after = rest.partition(END)
    rows = {one[0]: one for line in table.splitlines() if (one := line.strip("| ").split(" | "))[1:]}
    rows[cells[0]] = [*cells, *rows.get(cells[0], [])[len(cells) :]]
    told = f"At most {cpu_s:g} s of one core for each hunt:"
    lines = "\n".join([f"| {' | '.join(one)} |" for one in rows.values()])
    PAGE.write_text(f"{before}{BEGIN}\n\n{told}\n\n{lines}\n\n{END}{after}")


def main(arguments: list[str]) -> int:
    """Hunt the mutants, and return 0 if the guide has found at least nine of ten of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("name", nargs="*")
    parser.add_argument("--cpu", type=float, default=BUDGET_S)
    parser.add_argument("--guided-only", action="store_true")
    parser.add_argument("--write", action="store_true", help="write the table to docs/howto-hunt.md")
    options = parser.parse_args(arguments)
    by_name = {one.__name__: one for one in MUTANTS}
    chosen = [by_name[name] for name in options.name or by_name]
    missed = 0
    print("| mutant | guided | by chance |\n| --- | --- | --- |")
    for mutant in chosen:
        cells = [mutant.__name__]
        print(f"| {mutant.__name__}", end="", flush=True)
        for guided in (True,) if options.guided_only else (True, False):
            with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as process:
                hunt = process.submit(hunted, mutant, MUTANTS[mutant], options.cpu, guided=guided)
                says = hunt.result()
            missed += guided and says.startswith(MISSED)
            cells.append(says if guided else says.partition(":")[0])
            print(f" | {cells[-1]}", end="", flush=True)
        print(" |", flush=True)
        if options.write:
            write(cells, options.cpu)
    return 0 if 10 * missed <= len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
