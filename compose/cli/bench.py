"""`tandem bench`: speed, each figure against the bare thing in the same run.

Absolute times depend on the machine and its mood; the ratios much less. Everything is repeated in turns,
A B A B, and the medians are compared.
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
from compose.errors import LOCALISED
from compose.extras import need
from compose.launch import in_process, processes, zenoh_baseline
from compose.launch.viewers import beside
from compose.launch.viewers import page as page_on
from compose.network import KEYED
from compose.recording import run
from compose.scenario import scenario_file
from compose.sweep.trial_mission import run_in_process
from compose.terminal.outcome import counting
from protocol.journal.journal_file import Journal
from protocol.network import access_control, session
from protocol.network.endpoints import Endpoints, configured, listening
from protocol.network.inbox import Inbox
from protocol.noise import Noise
from protocol.orbits import rendezvous, tick_budget
from protocol.wire import encode
from world.process import WorldProcess
from world.scenario import Scenario
from world.simulation import Course

MISSION = "far"
"""thousands of ticks, so that starting is no part of what is timed"""
BARRIER_TICKS = 5000
"""about as many as the mission's"""
MISSIONS = 200
"""random missions a round, in-process"""
SEED = 1000
"""of the first of them"""
NOISY_SIGMA = 0.1
"""m"""
NOISY_MISSIONS = 20
"""random missions with such ranges a round, in-process"""
ROBOTS = 200
"""in many pairs"""
STARTED = 20
"""robots that only start, and end: enough for the CPU of one"""
MANY_MISSION = """
[mission]
sensing_range = 3.0
period = 1.0
max_speed = 1.0
max_turn_rate = 3.141592653589793
"""
"""that of the paper's section IV"""
BARE_IMPORTS = "import zenoh, numpy, scipy.optimize, msgspec"


def main(options: argparse.Namespace) -> int:
    """Measure and print."""
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
    """A mission as processes, against the bare barrier."""
    played = scenario_file.load(MISSION)
    sizes = _frame_sizes(played)
    missions: list[float] = []
    bare: list[float] = []
    watched: list[float] = []
    secured: list[float] = []
    barriers: list[float] = []
    for _ in range(rounds):
        missions.append(_mission_rate(played))
        bare.append(_mission_rate(played, journals=False))
        watched.append(_mission_rate(played, watched=True))
        secured.append(_mission_rate(played, secured=True))
        barriers.append(_barrier_rate(played, sizes))
        done()
    table = _table("Ticks/s as processes, two robots")
    _row(table, f"a mission ({MISSION}), with journals", missions, "ticks/s")
    _row(table, "the same, without journals", bare, "ticks/s")
    _row(table, "the same, and somebody watches the page", watched, "ticks/s")
    _row(table, "the same, over TLS with access control", secured, "ticks/s")
    _row(table, f"the bare barrier, frames of {sizes[0]} and {sizes[1]} bytes", barriers, "ticks/s")
    ratios = [mission / one for mission, one in zip(missions, barriers, strict=True)]
    _row(table, "mission / barrier (at least 0.5)", ratios, "")
    ratios = [mission / without for mission, without in zip(missions, bare, strict=True)]
    _row(table, "with journals / without (at least 0.85)", ratios, "")
    ratios = [with_page / mission for with_page, mission in zip(watched, missions, strict=True)]
    _row(table, "watched / mission (at least 0.6)", ratios, "")
    ratios = [with_keys / mission for with_keys, mission in zip(secured, missions, strict=True)]
    _row(table, "secured / mission (at least 0.75)", ratios, "")
    return table


def _frame_sizes(played: Scenario) -> tuple[int, int]:
    """Bytes of a typical Observation, and of a typical Command."""
    course = Course(played)
    observations: list[int] = []
    commands: list[int] = []
    for moment in in_process.play(played).moments:
        observations += [len(encode(observation)) for observation in course.observations()]
        commands += [len(encode(command)) for command in moment.commands.values()]
        course.command(moment.commands)
    return int(median(observations)), int(median(commands))


@contextmanager
def _processes(arguments: Sequence[Sequence[str]], *, until_ended: bool = False) -> Iterator[None]:
    """Processes, for as long as it takes."""
    command = [sys.executable, "-P", "-m"]
    children = [subprocess.Popen([*command, *one], stdout=subprocess.DEVNULL) for one in arguments]
    try:
        yield
        for child in children if until_ended else ():
            child.wait(processes.STOP_S)
    finally:
        for child in children:
            child.kill()
            child.wait()


def _mission_rate(
    played: Scenario, *, journals: bool = True, watched: bool = False, secured: bool = False
) -> float:
    """As processes; `watched`: beside a page, and somebody who looks at it."""
    with ExitStack() as stack:
        endpoints, keyed = _endpoints(played, secured, stack)
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        visitors = []
        if watched:
            page = stack.enter_context(beside(*page_on(Path(folder), 0)))
            visitors.append(["compose.view.web.page_client", page.address])
        common = ["--connect", str(endpoints), "--quiet", *(["--out", folder] if journals else [])]
        robots = [["compose.cli", "agent", robot.id, *keyed(robot.id), *common] for robot in played.robots]
        with (
            _processes(visitors),
            _processes(robots, until_ended=True),
            session.open_router(endpoints) as link,
            Journal(Path(folder) / run.WORLD_JOURNAL) if journals else nullcontext() as journal,
        ):
            process = WorldProcess(Course(played, journal), "bench", Inbox("tandem bench"))
            process.attach(link)
            end = process.play()
            return end.tick / process.playing_s


def _endpoints(
    played: Scenario, secured: bool, stack: ExitStack
) -> tuple[Endpoints, Callable[[str], list[str]]]:
    """Where the world listens, and by which flags a robot reaches it."""
    if not secured:
        return listening(processes.free_endpoint()), lambda _: []
    from compose.security import certificates  # noqa: PLC0415  # there may be no such library

    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tandem-keys-")))
    certificates.make(folder, [robot.id for robot in played.robots], (), 1)
    endpoints = configured(folder / "world" / KEYED, listen=[processes.free_endpoint("tls")])
    return endpoints, lambda robot: ["--keys", str(folder / access_control.agent(robot))]


def _barrier_rate(played: Scenario, sizes: tuple[int, int]) -> float:
    endpoint = processes.free_endpoint()
    ids = [robot.id for robot in played.robots]
    robots = [
        ["compose.launch.zenoh_baseline", endpoint, one, str(sizes[1]), str(BARRIER_TICKS)] for one in ids
    ]
    with session.open_router(listening(endpoint)) as link, _processes(robots, until_ended=True):
        return BARRIER_TICKS / zenoh_baseline.world(link, ids, sizes[0], BARRIER_TICKS)


# --- missions/s in one process ----------------------------------------------------------------------


def _missions(rounds: int, done: Callable[[], None]) -> Table:
    """Random missions in-process on one core, and how much of them is the world's."""
    scenarios = [scenario_file.load("random", seed=SEED + i) for i in range(MISSIONS)]
    whole: list[float] = []
    world_part: list[float] = []
    audited: list[float] = []
    ticks = sum(len(in_process.play(one).moments) for one in scenarios)
    for _ in range(rounds):
        began = time.perf_counter()
        for one in scenarios:
            in_process.play(one)
        whole.append(time.perf_counter() - began)
        world_part.append(sum(_world_alone(in_process.play(one)) for one in scenarios))
        began = time.perf_counter()
        for one in scenarios:
            run_in_process(one, audit=True)
        audited.append(time.perf_counter() - began)
        done()
    table = _table("In-process, one core")
    _row(table, f"{MISSIONS} random missions (at least 300)", [MISSIONS / s for s in whole], "missions/s")
    _row(table, f"a tick, of {ticks / MISSIONS:.1f} a mission", [1e6 * s / ticks for s in whole], "us")
    _row(table, "of which the world", [1e6 * s / ticks for s in world_part], "us")
    _row(table, "the same missions, audited", [MISSIONS / s for s in audited], "missions/s")
    _row(table, "of those without", [plain / s for plain, s in zip(whole, audited, strict=True)], "")
    return table


def _world_alone(played: run.Recording) -> float:
    """Seconds that the same run takes with the robots' answers given."""
    began = time.perf_counter()
    course = Course(played.scenario)
    for moment in played.moments:
        course.observations()
        course.command(moment.commands)
    return time.perf_counter() - began


# --- missions under noise ---------------------------------------------------------------------------


def _noisy(rounds: int, done: Callable[[], None]) -> Table:
    """Random missions with ranges of NOISY_SIGMA in-process on one core, and where their time goes."""
    noise = Noise(anchor_sigma=NOISY_SIGMA, mutual_sigma=NOISY_SIGMA)
    scenarios = [
        _with_noise(scenario_file.load("random", seed=SEED + i), noise) for i in range(NOISY_MISSIONS)
    ]
    parts: list[tuple[float, float, float]] = []
    for _ in range(rounds):
        parts.append(_parts(scenarios))
        done()
    table = _table(f"In-process, one core, ranges of sigma {NOISY_SIGMA:g} m")
    scale = 1e3 / NOISY_MISSIONS
    _row(table, "a mission, both robots (at most 150)", [scale * sum(part) for part in parts], "ms")
    for k, what in enumerate(("phases 1 and 2, each with its anchor", "phase 3, with the peer", "the world")):
        _row(table, f"of which {what}", [scale * part[k] for part in parts], "ms")
    return table


def _with_noise(exact: Scenario, noise: Noise) -> Scenario:
    mission = replace(exact.mission, noise=noise)
    first, second = (robot.anchor for robot in exact.robots)
    plan = rendezvous(mission, math.dist((first.x, first.y), (second.x, second.y)), exact.planner_name)
    robots = tuple([replace(robot, rendezvous=plan) for robot in exact.robots])
    return replace(exact, mission=mission, robots=robots, max_ticks=tick_budget(mission, plan))


def _parts(scenarios: Sequence[Scenario]) -> tuple[float, float, float]:
    """s: that the robots take to fold in what they sense, and to decide once in contact; and the world."""
    sensing = deciding = world = 0.0
    for one in scenarios:
        course = Course(one)
        robots = {robot.id: Robot(one.config(robot.id)) for robot in one.robots}
        end = None
        while end is None:
            began = time.perf_counter()
            observations = course.observations()
            sensed = time.perf_counter()
            told = {
                observation.robot: robots[observation.robot].observation(observation)
                for observation in observations
            }
            heard = time.perf_counter()
            commands = {}
            for observation in observations:
                reports = [
                    told[contact.peer] for contact in observation.contacts for _ in contact.heard or ()
                ]
                commands[observation.robot] = robots[observation.robot].decide(
                    [one for one in reports if one is not None]
                )
            decided = time.perf_counter()
            end = course.command(commands)
            world += sensed - began + time.perf_counter() - decided
            sensing += heard - sensed
            deciding += decided - heard
    return sensing, deciding, world


# --- starting ---------------------------------------------------------------------------------------


def _start(rounds: int, done: Callable[[], None]) -> Table:
    """The whole of `tandem run paper-1 -q`, against a process that only imports what it stands on."""
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
    began = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - began


# --- many robots ------------------------------------------------------------------------------------


def _many(rounds: int, done: Callable[[], None]) -> Table:
    """The whole of `tandem run` with ROBOTS robots, against one process; and what a robot's start costs."""
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
    """A scenario of so many robots, each pair on a line of its own."""
    tables = [
        f'[[robot]]\nid = "r{i}"\npeer = "r{i ^ 1}"\nanchor = [{10.0 * (i % 2)}, {40.0 * (i // 2)}]\n'
        for i in range(robots)
    ]
    return f'name = "pairs"\nseed = {SEED}\n{MANY_MISSION}' + "".join(tables)


def _used(arguments: Sequence[str]) -> tuple[float, float]:
    """Seconds of wall time and of CPU that the command takes, with all its processes."""
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-P", "-m", "compose.cli", *arguments]
    subprocess.run(command, check=False, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - began, cpu


# --- tables -----------------------------------------------------------------------------------------


def _table(title: str) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for heading in ("median", "from", "to"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    return table


def _row(table: Table, what: str, values: Sequence[float], unit: str) -> None:
    table.add_row(what, *[f"{value:.4g}" for value in (median(values), min(values), max(values))], unit)
