"""The speed of missions as processes, beside processes that only exchange messages over Zenoh."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from functools import cache
from pathlib import Path
from statistics import median

from compose.launch import in_process, processes
from compose.launch.supervisor import COMMAND, STOP_S, Supervisor
from compose.network import KEYED
from compose.recording.recording_files import WORLD_JOURNAL
from compose.scenario import scenario_file
from compose.security import certificates
from protocol.journal.journal_file import Journal
from protocol.network import access_control, session
from protocol.network.endpoints import Endpoints, configured, listening
from protocol.network.inbox import Inbox
from protocol.wire import encode
from tests.benchmark import zenoh_baseline
from world.process import WorldProcess
from world.scenario import Scenario
from world.simulation import Simulation

LONG_MISSION = "far"
"""A scenario of thousands of ticks, so that the start of the processes does not affect the rate."""
BARRIER_TICKS = 5000
"""The number of ticks of the baseline, about as many as the mission has."""


def ticks_per_second(_: int) -> dict[str, float]:
    """Measure a mission as processes; the baseline only exchanges frames of the same size over Zenoh."""
    scenario = scenario_file.load(LONG_MISSION)
    sizes = _frame_sizes()
    mission = _mission_rate(scenario)
    barrier = _barrier_rate(scenario, sizes)
    return {
        f"a mission ({LONG_MISSION}), with journals, ticks/s": mission,
        f"baseline: frames of {sizes[0]} and {sizes[1]} bytes, ticks/s": barrier,
        "mission / baseline (at least 0.5)": mission / barrier,
        "with journals / without (at least 0.85)": mission / _mission_rate(scenario, journals=False),
        "TLS and access control / without (at least 0.75)": _mission_rate(scenario, secured=True) / mission,
    }


@cache
def _frame_sizes() -> tuple[int, int]:
    """Return the median sizes of an Observation and of a Command of LONG_MISSION (bytes)."""
    scenario = scenario_file.load(LONG_MISSION)
    simulation = Simulation(scenario)
    observations: list[int] = []
    commands: list[int] = []
    for moment in in_process.run_mission(scenario).ticks:
        observations += [len(encode(observation)) for observation in simulation.observations()]
        commands += [len(encode(command)) for command in moment.commands.values()]
        simulation.command(moment.commands)
    return int(median(observations)), int(median(commands))


@contextmanager
def _processes(commands: Sequence[Sequence[str]], main: str = COMMAND) -> Iterator[None]:
    """Run a process that calls `main`, a module:function, with each of `commands`; stop them at the end."""
    children = Supervisor(Inbox("benchmark"))
    try:
        for number, arguments in enumerate(commands):
            children.start(str(number), *arguments, main=main)
        yield
        children.wait(STOP_S)
    finally:
        children.stop()


def _mission_rate(scenario: Scenario, *, journals: bool = True, secured: bool = False) -> float:
    """Return the ticks per second of a mission as processes; with `secured`, all links are encrypted."""
    with ExitStack() as stack:
        endpoints, keyed = _endpoints(scenario, secured, stack)
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        common = ["--connect", str(endpoints), "--quiet", *(["--out", folder] if journals else [])]
        robots = [["agent", robot.id, *keyed(robot.id), *common] for robot in scenario.robots]
        with (
            _processes(robots),
            session.open_router(endpoints) as link,
            Journal(Path(folder) / WORLD_JOURNAL) if journals else nullcontext() as journal,
        ):
            process = WorldProcess(Simulation(scenario, journal), "benchmark", Inbox("benchmark"))
            process.attach(link)
            end = process.run()
            return end.tick / process.running_s


def _endpoints(
    scenario: Scenario, secured: bool, stack: ExitStack
) -> tuple[Endpoints, Callable[[str], list[str]]]:
    """Return the world's endpoints, and a function from a robot's id to the flags with its keys."""
    if not secured:
        return listening(processes.free_endpoint()), lambda _: []
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tandem-keys-")))
    certificates.make(folder, [robot.id for robot in scenario.robots], (), 1)
    endpoints = configured(folder / "world" / KEYED, listen=[processes.free_endpoint("tls")])
    return endpoints, lambda robot: ["--keys", str(folder / access_control.agent(robot))]


def _barrier_rate(scenario: Scenario, sizes: tuple[int, int]) -> float:
    """Return the ticks per second of the baseline, with frames of `sizes` bytes."""
    endpoint = processes.free_endpoint()
    ids = [robot.id for robot in scenario.robots]
    robots = [[endpoint, robot, str(sizes[1]), str(BARRIER_TICKS)] for robot in ids]
    with (
        session.open_router(listening(endpoint)) as link,
        _processes(robots, "tests.benchmark.zenoh_baseline:main"),
    ):
        return BARRIER_TICKS / zenoh_baseline.world(link, ids, sizes[0], BARRIER_TICKS)
