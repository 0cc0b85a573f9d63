"""`tandem bench`: measure speed, and compare each figure with a baseline measured in the same run.

Absolute times depend on the machine and its load; ratios depend on them much less. All measurements are
interleaved (A B A B), and their medians are compared.
"""

from __future__ import annotations

import argparse
import math
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from statistics import median

from msgspec.structs import replace
from rich.console import Console
from rich.table import Table

from agent.process.robot import Robot
from compose.cli.arguments import add_closing, count
from compose.errors import LOCALISED
from compose.extras import need
from compose.launch import in_process, processes, zenoh_baseline
from compose.launch.planner_loader import planner_of
from compose.launch.supervisor import COMMAND, STOP_S, Supervisor
from compose.launch.viewers import page, viewing
from compose.network import KEYED
from compose.recording import run
from compose.recording.recording_files import WORLD_JOURNAL
from compose.scenario import scenario_file
from compose.sweep.trial_mission import run_in_process
from compose.terminal.outcome import counting
from protocol.journal.journal_file import Journal
from protocol.messages import RobotConfig
from protocol.network import access_control, session
from protocol.network.endpoints import Endpoints, configured, listening
from protocol.network.inbox import Inbox
from protocol.noise import Noise
from protocol.orbits import rendezvous, tick_budget
from protocol.wire import encode
from world.process import WorldProcess
from world.scenario import Scenario
from world.simulation import Simulation

MISSION = "far"
"""A scenario of thousands of ticks, so that the start of the processes does not affect the rate."""
BARRIER_TICKS = 5000
"""The number of ticks of the baseline, about as many as the mission has."""
MISSIONS = 200
"""The number of random missions per round, in one process."""
SEED = 1000
"""The seed of the first of them."""
NOISY_SIGMA = 0.1
"""The standard deviation of all ranges in the noisy missions (m)."""
NOISY_MISSIONS = 20
"""The number of random missions with such ranges per round, in one process."""
RANGES = 322
"""The number of ranges of each kind in the measured search."""
ROBOTS = 200
"""The number of robots in the scenario of many pairs."""
STARTED = 20
"""The number of robots from whose start and end the CPU time of one robot is computed."""
MANY_MISSION = """
[mission]
sensing_range = 3.0
period = 1.0
max_speed = 1.0
max_turn_rate = 3.141592653589793
"""
"""The mission of section IV of the paper, as TOML."""
COMMAND_S = 300.0
"""The maximum wall time of a whole command (s). The longest takes some seconds on a quiet machine."""
BARE_IMPORTS = "import zenoh, numpy, scipy.optimize, msgspec"
"""The program whose run time is the baseline of `tandem run`: the imports of Tandem's dependencies."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `tandem bench`."""
    parser.add_argument(
        "--rounds",
        type=count,
        default=5,
        metavar="N",
        help="repetitions of each measurement, 1 to 1000 [default: %(default)s]",
    )
    add_closing(parser, "tandem bench --rounds 10", "README.md")


def main(options: argparse.Namespace) -> int:
    """Run all measurements, and print one table for each group."""
    need("cryptography", extra="deploy")
    rounds = options.rounds
    parts = (_ticks, _missions, _noisy, _start, _many)
    with counting("tandem bench", len(parts) * rounds) as done:
        tables = [part(rounds, done) for part in parts]
    for table in tables:
        Console().print(table)
    return LOCALISED


# --- ticks/s over Zenoh -----------------------------------------------------------------------------


def _ticks(rounds: int, done: Callable[[], None]) -> Table:
    """Measure a mission as processes; the baseline only exchanges frames of the same size over Zenoh."""
    scenario = scenario_file.load(MISSION)
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
    table = _table("Ticks/s as processes, two robots")
    _row(table, f"a mission ({MISSION}), with journals", missions, "ticks/s")
    _row(table, "the same, without journals", bare, "ticks/s")
    _row(table, "the same, with a client of the page", watched, "ticks/s")
    _row(table, "the same, over TLS with access control", secured, "ticks/s")
    _row(table, f"baseline: frames of {sizes[0]} and {sizes[1]} bytes", barriers, "ticks/s")
    ratios = [mission / one for mission, one in zip(missions, barriers, strict=True)]
    _row(table, "mission / baseline (at least 0.5)", ratios, "")
    ratios = [mission / without for mission, without in zip(missions, bare, strict=True)]
    _row(table, "with journals / without (at least 0.85)", ratios, "")
    ratios = [with_page / mission for with_page, mission in zip(watched, missions, strict=True)]
    _row(table, "watched / mission (at least 0.6)", ratios, "")
    ratios = [with_keys / mission for with_keys, mission in zip(secured, missions, strict=True)]
    _row(table, "secured / mission (at least 0.75)", ratios, "")
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
            (viewer,) = stack.enter_context(viewing([page(Path(folder), 0)], Inbox("tandem bench")))
            clients.append([viewer.address])
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


# --- missions/s in one process ----------------------------------------------------------------------


def _missions(rounds: int, done: Callable[[], None]) -> Table:
    """Measure random missions in one process on one core, the world's share of them, and their audit."""
    scenarios = [scenario_file.load("random", seed=SEED + i) for i in range(MISSIONS)]
    whole: list[float] = []
    world_part: list[float] = []
    audited: list[float] = []
    ticks = sum(len(in_process.run_mission(one).ticks) for one in scenarios)
    for _ in range(rounds):
        began = time.perf_counter()
        for one in scenarios:
            in_process.run_mission(one)
        whole.append(time.perf_counter() - began)
        world_part.append(sum(_world_s(in_process.run_mission(one)) for one in scenarios))
        began = time.perf_counter()
        for one in scenarios:
            run_in_process(one, audit=True)
        audited.append(time.perf_counter() - began)
        done()
    table = _table("In-process, one core")
    _row(table, f"{MISSIONS} random missions (at least 300)", [MISSIONS / s for s in whole], "missions/s")
    _row(table, f"one tick ({ticks / MISSIONS:.1f} per mission)", [1e6 * s / ticks for s in whole], "us")
    _row(table, "of that, the world", [1e6 * s / ticks for s in world_part], "us")
    _row(table, "the same missions, audited", [MISSIONS / s for s in audited], "missions/s")
    _row(table, "audited / not audited", [plain / s for plain, s in zip(whole, audited, strict=True)], "")
    return table


def _world_s(recording: run.Run) -> float:
    """Return the time (s) that the world takes to run `recording` again with the recorded Commands."""
    began = time.perf_counter()
    simulation = Simulation(recording.scenario)
    for moment in recording.ticks:
        simulation.observations()
        simulation.command(moment.commands)
    return time.perf_counter() - began


# --- missions under noise ---------------------------------------------------------------------------


def _noisy(rounds: int, done: Callable[[], None]) -> Table:
    """Measure random missions with range noise of NOISY_SIGMA in one process on one core, by their parts."""
    noise = Noise(anchor_sigma=NOISY_SIGMA, mutual_sigma=NOISY_SIGMA)
    scenarios = [
        _with_noise(scenario_file.load("random", seed=SEED + i), noise) for i in range(NOISY_MISSIONS)
    ]
    exact = [scenario_file.load("random", seed=SEED + i) for i in range(NOISY_MISSIONS)]
    parts: list[tuple[float, float, float]] = []
    baseline: list[float] = []
    searches: list[float] = []
    for draw in range(rounds):
        baseline.append(sum(_parts(exact)))
        parts.append(_parts(scenarios))
        searches.append(_search_s(draw))
        done()
    table = _table(f"In-process, one core, ranges of sigma {NOISY_SIGMA:g} m")
    scale = 1e3 / NOISY_MISSIONS
    _row(table, "one mission, both robots (at most 150)", [scale * sum(part) for part in parts], "ms")
    for k, what in enumerate(
        ("observations (phases 1 and 2)", "decisions in contact (phase 3)", "the world")
    ):
        _row(table, f"of that, {what}", [scale * part[k] for part in parts], "ms")
    ratios = [sum(part) / s for part, s in zip(parts, baseline, strict=True)]
    _row(table, "the same with exact ranges (baseline)", [scale * s for s in baseline], "ms")
    _row(table, "noisy / exact", ratios, "")
    _row(table, f"a search over {3 * RANGES} ranges (at most 200)", [1e3 * s for s in searches], "ms")
    return table


def _search_s(draw: int) -> float:
    """Return the time (s) of a search with RANGES ranges of each kind, between robots that circle.

    Ranges that were searched before are not searched again, so each `draw` has others.
    """
    import numpy as np  # noqa: PLC0415  # the command line starts without it

    from agent.estimation.gaussian.hypotheses import search  # noqa: PLC0415  # likewise
    from agent.estimation.gaussian.odometry_noise import track  # noqa: PLC0415  # likewise
    from agent.estimation.gaussian.range_model import PairRanges, Ranges, predict  # noqa: PLC0415  # likewise

    noise = Noise(anchor_sigma=NOISY_SIGMA, mutual_sigma=NOISY_SIGMA)
    every, ticks = [(tick, 0.0) for tick in range(RANGES)], np.arange(RANGES - 1)
    paths = [track(np.full(RANGES - 1, 0.5), turn + 0.2 * np.sin(ticks), 1.0) for turn in (0.5, -0.35)]
    ranges = Ranges.of_lists(every, every, every, noise)
    apart, none = (1.5, 0.0), np.empty(0, np.intp)
    true = predict(np.array((0.4, 0.9, 0.3, -0.2, 1.0, -0.8)), paths, ranges, apart).distance
    errors = NOISY_SIGMA * np.random.default_rng(draw).normal(size=3 * RANGES)
    pair = PairRanges(
        (paths[0], paths[1]), ranges._replace(rho=true + errors), (none, none, none), apart, 10.0, noise
    )
    began = time.perf_counter()
    search(pair)
    return time.perf_counter() - began


def _with_noise(exact: Scenario, noise: Noise) -> Scenario:
    """Return `exact` with `noise`, and with the orbits and the tick budget that follow from it."""
    mission = replace(exact.mission, noise=noise)
    first, second = (robot.anchor for robot in exact.robots)
    plan = rendezvous(mission, math.dist((first.x, first.y), (second.x, second.y)), exact.planner_name)
    robots = tuple([replace(robot, rendezvous=plan) for robot in exact.robots])
    return replace(exact, mission=mission, robots=robots, max_ticks=tick_budget(mission, plan))


def _parts(scenarios: Sequence[Scenario]) -> tuple[float, float, float]:
    """Return the time (s) of the robots' observations, of their decisions, and of the world."""
    sensing = deciding = world = 0.0
    for one in scenarios:
        simulation = Simulation(one)
        robots = {robot.id: _robot(one.config(robot.id)) for robot in one.robots}
        end = None
        while end is None:
            began = time.perf_counter()
            observations = simulation.observations()
            sensed = time.perf_counter()
            own_reports = {
                observation.robot: robots[observation.robot].observation(observation)
                for observation in observations
            }
            observed = time.perf_counter()
            commands = {}
            for observation in observations:
                commands[observation.robot] = robots[observation.robot].decide(
                    [
                        own_reports[contact.peer][observation.robot]
                        for contact in observation.contacts
                        for _ in contact.heard or ()
                    ]
                )
            decided = time.perf_counter()
            end = simulation.command(commands)
            world += sensed - began + time.perf_counter() - decided
            sensing += observed - sensed
            deciding += decided - observed
    return sensing, deciding, world


def _robot(config: RobotConfig) -> Robot:
    return Robot(config, planner_of(config))


# --- starting ---------------------------------------------------------------------------------------


def _start(rounds: int, done: Callable[[], None]) -> Table:
    """Measure `tandem run paper-1 -q`; the baseline is a process that only imports the dependencies."""
    command = [sys.executable, "-P", "-m", "compose.cli", "run", "paper-1", "-q"]
    bare = [sys.executable, "-c", BARE_IMPORTS]
    runs: list[float] = []
    imports: list[float] = []
    for _ in range(rounds):
        runs.append(_wall(command))
        imports.append(_wall(bare))
        done()
    table = _table("Wall time of a whole command")
    _row(table, "tandem run paper-1 -q", runs, "s")
    _row(table, f"python -c '{BARE_IMPORTS}'", imports, "s")
    _row(table, "run / imports (at most 4)", [a / b for a, b in zip(runs, imports, strict=True)], "")
    return table


def _wall(command: Sequence[str]) -> float:
    """Return the wall time (s) of a command.

    Raises CalledProcessError if it fails, and TimeoutError after COMMAND_S.
    """
    began = time.perf_counter()
    _run(command, check=True)
    return time.perf_counter() - began


def _run(command: Sequence[str], *, check: bool) -> None:
    """Run a command without its output, for at most COMMAND_S.

    Raises TimeoutError after that, and with `check` CalledProcessError if the command fails.
    """
    try:
        subprocess.run(command, check=check, stdout=subprocess.DEVNULL, timeout=COMMAND_S)
    except subprocess.TimeoutExpired:
        raise TimeoutError(f"{' '.join(command)} has not ended after {COMMAND_S:g} s") from None


# --- many robots ------------------------------------------------------------------------------------


def _many(rounds: int, done: Callable[[], None]) -> Table:
    """Measure `tandem run` with ROBOTS robots, as processes and in one, and the CPU time of one robot."""
    many_processes: list[float] = []
    one: list[float] = []
    starts: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        many, some, two = [Path(folder, f"{name}.toml") for name in ("many", "some", "two")]
        many.write_text(_pairs(ROBOTS))
        some.write_text(f"max_ticks = 1\n{_pairs(STARTED)}")
        two.write_text(f"max_ticks = 1\n{_pairs(2)}")
        for _ in range(rounds):
            many_processes.append(_used(["run", str(many), "-q"])[0])
            one.append(_used(["run", str(many), "-q", "--in-process"])[0])
            more_s = _used(["run", str(some), "-q"])[1] - _used(["run", str(two), "-q"])[1]
            starts.append(1e3 * more_s / (STARTED - 2))
            done()
    table = _table(f"Wall time of a whole command, {ROBOTS} robots")
    _row(table, "tandem run, as processes (at most 6)", many_processes, "s")
    _row(table, "the same with --in-process", one, "s")
    _row(table, "as processes / in-process", [a / b for a, b in zip(many_processes, one, strict=True)], "")
    _row(table, "CPU of a robot's start, first tick and end", starts, "ms")
    return table


def _pairs(robots: int) -> str:
    """Return a scenario file of so many robots, in which each pair has its own line in the plane."""
    tables = [
        f'[[robot]]\nid = "r{i}"\npeer = "r{i ^ 1}"\nanchor = [{10.0 * (i % 2)}, {40.0 * (i // 2)}]\n'
        for i in range(robots)
    ]
    return f'name = "pairs"\nseed = {SEED}\n{MANY_MISSION}' + "".join(tables)


def _used(arguments: Sequence[str]) -> tuple[float, float]:
    """Return the wall time and the CPU time (s) of a `tandem` command with all its processes.

    Raises TimeoutError after COMMAND_S.
    """
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-P", "-m", "compose.cli", *arguments]
    _run(command, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - began, cpu


# --- tables -----------------------------------------------------------------------------------------


def _table(title: str) -> Table:
    """Return an empty table with columns for the median, the least and the greatest value, and the unit."""
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for heading in ("median", "from", "to"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    return table


def _row(table: Table, what: str, values: Sequence[float], unit: str) -> None:
    """Add the row `what` to `table`."""
    table.add_row(what, *[f"{value:.4g}" for value in (median(values), min(values), max(values))], unit)
