"""The speed of missions as processes, beside processes that only exchange messages over Zenoh."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from statistics import median

from rich.table import Table

from compose.cli.benchmark.bench_table import add_row, new_table
from compose.launch import in_process, processes, zenoh_baseline
from compose.launch.page_process import serving
from compose.launch.supervisor import COMMAND, STOP_S, Supervisor
from compose.network import KEYED
from compose.recording.recording_files import WORLD_JOURNAL
from compose.scenario import scenario_file
from protocol.journal.journal_file import Journal
from protocol.network import access_control, session
from protocol.network.endpoints import Endpoints, configured, listening
from protocol.network.inbox import Inbox
from protocol.wire import encode
from world.process import WorldProcess
from world.scenario import Scenario
from world.simulation import Simulation

LONG_MISSION = "far"
"""A scenario of thousands of ticks, so that the start of the processes does not affect the rate."""
BARRIER_TICKS = 5000
"""The number of ticks of the baseline, about as many as the mission has."""


def ticks_per_second(rounds: int, done: Callable[[], None]) -> Table:
    """Measure a mission as processes; the baseline only exchanges frames of the same size over Zenoh."""
    scenario = scenario_file.load(LONG_MISSION)
    sizes = _frame_sizes(scenario)
    missions: list[float] = []
    bare: list[float] = []
    watched: list[float] = []
    secured: list[float] = []
    barriers: list[float] = []
    for _ in range(rounds):
        missions.append(_mission_rate(scenario))
        bare.append(_mission_rate(scenario, journals=False))
        watched.append(_mission_rate(scenario, watched=True))
        secured.append(_mission_rate(scenario, secured=True))
        barriers.append(_barrier_rate(scenario, sizes))
        done()
    table = new_table("Ticks/s as processes, two robots")
    add_row(table, f"a mission ({LONG_MISSION}), with journals", missions, "ticks/s")
    add_row(table, "the same, without journals", bare, "ticks/s")
    add_row(table, "the same, with a client of the page", watched, "ticks/s")
    add_row(table, "the same, over TLS with access control", secured, "ticks/s")
    add_row(table, f"baseline: frames of {sizes[0]} and {sizes[1]} bytes", barriers, "ticks/s")
    ratios = [mission / one for mission, one in zip(missions, barriers, strict=True)]
    add_row(table, "mission / baseline (at least 0.5)", ratios, "")
    ratios = [mission / without for mission, without in zip(missions, bare, strict=True)]
    add_row(table, "with journals / without (at least 0.85)", ratios, "")
    ratios = [with_page / mission for with_page, mission in zip(watched, missions, strict=True)]
    add_row(table, "watched / mission (at least 0.6)", ratios, "")
    ratios = [with_keys / mission for with_keys, mission in zip(secured, missions, strict=True)]
    add_row(table, "secured / mission (at least 0.75)", ratios, "")
    return table


def _frame_sizes(scenario: Scenario) -> tuple[int, int]:
    """Return the median sizes of an Observation and of a Command (bytes)."""
    simulation = Simulation(scenario)
    observations: list[int] = []
    commands: list[int] = []
    for moment in in_process.run_mission(scenario).ticks:
        observations += [len(encode(observation)) for observation in simulation.observations()]
        commands += [len(encode(command)) for command in moment.commands.values()]
        simulation.command(moment.commands)
    return int(median(observations)), int(median(commands))


@contextmanager
def _processes(
    commands: Sequence[Sequence[str]], *, main: str = COMMAND, until_ended: bool = False
) -> Iterator[None]:
    """Run a process that calls `main`, a module:function, with each of `commands`, and stop them at the end.

    With `until_ended`, wait at most STOP_S for all to end first.
    """
    children = Supervisor(Inbox("tandem bench"))
    try:
        for number, arguments in enumerate(commands):
            children.start(str(number), *arguments, main=main)
        yield
        if until_ended:
            children.wait(STOP_S)
    finally:
        children.stop()


def _mission_rate(
    scenario: Scenario, *, journals: bool = True, watched: bool = False, secured: bool = False
) -> float:
    """Return the ticks per second of a mission as processes.

    With `watched`, a page is served and a client reads it; with `secured`, all links are encrypted.
    """
    with ExitStack() as stack:
        endpoints, keyed = _endpoints(scenario, secured, stack)
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        clients = []
        if watched:
            page = stack.enter_context(serving(Path(folder), 0, Inbox("tandem bench")))
            clients.append([page.address])
        common = ["--connect", str(endpoints), "--quiet", *(["--out", folder] if journals else [])]
        robots = [["agent", robot.id, *keyed(robot.id), *common] for robot in scenario.robots]
        with (
            _processes(clients, main="compose.view.web.page_client:main"),
            _processes(robots, until_ended=True),
            session.open_router(endpoints) as link,
            Journal(Path(folder) / WORLD_JOURNAL) if journals else nullcontext() as journal,
        ):
            process = WorldProcess(Simulation(scenario, journal), "bench", Inbox("tandem bench"))
            process.attach(link)
            end = process.run()
            return end.tick / process.running_s


def _endpoints(
    scenario: Scenario, secured: bool, stack: ExitStack
) -> tuple[Endpoints, Callable[[str], list[str]]]:
    """Return the world's endpoints, and a function from a robot's id to the flags with its keys."""
    if not secured:
        return listening(processes.free_endpoint()), lambda _: []
    from compose.security import certificates  # noqa: PLC0415  # the library is optional

    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tandem-keys-")))
    certificates.make(folder, [robot.id for robot in scenario.robots], (), 1)
    endpoints = configured(folder / "world" / KEYED, listen=[processes.free_endpoint("tls")])
    return endpoints, lambda robot: ["--keys", str(folder / access_control.agent(robot))]


def _barrier_rate(scenario: Scenario, sizes: tuple[int, int]) -> float:
    """Return the ticks per second of the baseline, with frames of `sizes` bytes."""
    endpoint = processes.free_endpoint()
    ids = [robot.id for robot in scenario.robots]
    robots = [[endpoint, one, str(sizes[1]), str(BARRIER_TICKS)] for one in ids]
    with (
        session.open_router(listening(endpoint)) as link,
        _processes(robots, main="compose.launch.zenoh_baseline:main", until_ended=True),
    ):
        return BARRIER_TICKS / zenoh_baseline.world(link, ids, sizes[0], BARRIER_TICKS)
