"""Several missions of `tandem run`, one after the other, with one table at the end."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from compose.errors import FAILED, STOPPED_STATUS, UserError
from compose.launch.interruption import INTERRUPTION
from compose.recording.summary_json import outcome_line
from compose.scenario.scenario_file import setting
from protocol.output import say

Mission = tuple[str, int | None]
"""The scenario as the user named it, and the seed; None is that of the scenario."""


def run_all(
    options: argparse.Namespace,
    missions: Sequence[Mission],
    run_one: Callable[[argparse.Namespace], int],
) -> int:
    """Run all `missions`, print a line for each or a table, and return the largest of the exit statuses.

    Nothing runs if a scenario is invalid. The recording of each is in a folder of its own in `--out`.
    """
    for flag in ("watch", "export"):
        if getattr(options, flag):
            raise UserError(f"--{flag}: it needs a single mission")
    named = [_named(options, *mission) for mission in missions]
    for place, name in enumerate(named):
        if name in named[:place]:
            raise UserError(f"{missions[place][0]}: another mission has the name and the seed of {name}")
    rows: list[list[str]] = []
    statuses = []
    for (source, seed), name in zip(missions, named, strict=True):
        results: list[Mapping[str, Any]] = []
        out: Path | None = options.out / name if options.out is not None else None
        one = {"scenario": source, "seed": seed, "out": out, "results": results, "export": False}
        INTERRUPTION.begin("tandem run")
        statuses.append(run_one(argparse.Namespace(**{**vars(options), **one})))
        if options.quiet:
            say(*[f"{name}: {outcome_line(result)}" for result in results])
        rows.append(_row(name, results[0] if results else None, statuses[-1]))
        if statuses[-1] == STOPPED_STATUS:
            break
    if not options.quiet:
        _show(rows)
    return max(statuses)


def _named(options: argparse.Namespace, source: str, seed: int | None) -> str:
    """Return the name of a mission in the table, which is that of its folder. Raises UserError."""
    found = setting(source, options.fault, options.planner, options.planner_option)
    scenario = found.seeded(seed)
    return f"{scenario.name}-{scenario.seed}"


def _row(name: str, result: Mapping[str, Any] | None, status: int) -> list[str]:
    if result is None:
        return [name, "failed" if status == FAILED else "stopped", "", "", "", "", ""]
    robots = result["robots"].values()
    errors = [robot["position_error_m"] for robot in robots if robot["position_error_m"] is not None]
    return [
        name,
        result["outcome"],
        result["reason"] or "",
        str(result["ticks"]),
        f"{max(errors):.1e}" if errors else "-",
        str(sum(robot["mutual_ranges"] or 0 for robot in robots)),
        f"{result['wall_s']:.1f}",
    ]


def _show(rows: Sequence[Sequence[str]]) -> None:
    from compose.terminal import tables, text_width  # noqa: PLC0415  # rich is slow to import

    made = tables.table(["mission", "outcome", "reason"], ["ticks", "error m", "ranges", "wall s"], rows)
    say(*tables.lines(made, text_width.room()), "")
    notes = "mission: scenario and seed; error: of the worse claim; ranges: mutual, of all robots"
    say(*text_width.wrapped(notes))
