"""The run of a mission, in this process or as processes."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from compose.errors import UserError
from compose.launch import in_process
from compose.launch.class_loader import need_module
from compose.recording import run as recorded
from compose.recording.recording_files import folder_for
from compose.scenario.kills import Kill, parse
from compose.scenario.run_settings import check_rate, run_name
from protocol.network.inbox import Inbox
from tandem.results import Run
from tandem.scenarios import Faults, Scenario, scenario_of

if TYPE_CHECKING:
    from tandem.planning import Planner

TIMEOUT_S = 30.0
"""The default time in s without an answer before a run as processes fails, as that of `--timeout`."""


def run(
    scenario: Scenario | str | Path | Mapping[str, Any],
    *,
    seed: int | None = None,
    planner: str | type[Planner[Any, Any]] | None = None,
    planner_options: Mapping[str, Any] | None = None,
    faults: Faults = (),
    kills: str | Sequence[str] = (),
    processes: bool = False,
    rate: float | None = None,
    timeout: float = TIMEOUT_S,
) -> Run:
    """Run a mission, and return it with everything that its recording holds.

    `scenario` is a Scenario, the name of one that ships with Tandem, the path of a file, or the content of
    one as a dict. `seed` replaces its seed, `planner` its planner (a name, or a class: see
    `Scenario.with_planner`) with `planner_options`, and `faults` are added to its own.

    With `processes`, the world and each robot are processes that communicate over Zenoh; decisions are the
    same. Only then, `kills` are processes to kill and restart, in the syntax of `--kill`, `rate` is the speed
    relative to real time (by default, lockstep), and `timeout` in s ends a run without answers.

    Raises UserError for invalid arguments, and ChildFailed if a process is lost.

    >>> import tandem
    >>> tandem.run("random", seed=7, faults="a->b: loss=0.3").outcome
    'localised'
    >>> tandem.run("papr-1")
    Traceback (most recent call last):
    ...
    compose.errors.BadScenario: papr-1: neither a file nor a shipped scenario (...); did you mean 'paper-1'?
    """
    chosen = scenario_of(scenario)
    if seed is not None:
        chosen = chosen.with_(seed=seed)
    if planner is not None:
        chosen = chosen.with_planner(planner, **(planner_options or {}))
    elif planner_options:
        raise UserError("planner_options: they need planner")
    chosen = chosen.with_faults(faults)
    given = [parse(one) for one in ([kills] if isinstance(kills, str) else kills)]
    found = chosen.template.kills(chosen.seed, given)
    if processes:
        return _as_processes(chosen, found, rate, timeout)
    if found:
        where = "kills" if given else f"{chosen.source}: kill"
        raise UserError(f"{where}: a run in one process has no processes to kill; set processes=True")
    if rate is not None:
        raise UserError("rate: a run in one process cannot run in real time; set processes=True")
    began = time.perf_counter()
    model = in_process.recorded(chosen.template.scenario, chosen.source)
    return Run(model, "in-process", round(time.perf_counter() - began, 6))


def _as_processes(chosen: Scenario, kills: Sequence[Kill], rate: float | None, timeout: float) -> Run:
    from compose.launch import processes  # noqa: PLC0415  # not needed by a run in one process

    for name, value in (("rate", rate), ("timeout", timeout)):
        if value is not None and not 0.0 < value < 1e9:
            raise UserError(f"{name}: {value} is not a positive number")
    scenario = chosen.template.scenario
    need_module(scenario.planner_name)
    check_rate(scenario, rate)
    inbox = Inbox("tandem.run")
    began = time.perf_counter()
    with folder_for(None) as folder:
        spared = processes.run_mission(
            scenario, folder, inbox, run=run_name(scenario), rate=rate, timeout=timeout, kills=kills
        )
        wall_s = round(time.perf_counter() - began, 6)
        for kill in spared:
            inbox.say(f"--kill {kill.text}: not reached")
        model = replace(recorded.read(folder), source=chosen.source)
        return Run(model, "processes", wall_s)
