"""Time: clocks that are off, drift and jump do no harm, and with `--rate` the world waits for nobody."""

from __future__ import annotations

import csv
import json
import os
import random
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from signal import SIGCONT, SIGINT, SIGSTOP
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zenoh

from agent.process.node import AgentProcess
from agent.process.recovery import Memory
from agent.process.robot import Robot
from compose.errors import BadScenario
from compose.launch.planner_loader import planner_of
from compose.launch.virtual_hardware import HardwareEnd, _Body, run_hardware
from compose.scenario.scenario_file import load, parse
from protocol.journal import journal_file
from protocol.messages import Command, DeadlineMissed, Environment, FinalReport, MissionEnd, Observation
from protocol.network import keys, session
from protocol.network.clock import Clock, ClockError
from protocol.network.endpoints import LEASE_S, at
from protocol.network.inbox import NO_ARRIVAL, Arrival, Inbox
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from tests import test_field
from tests.commands import ASSURED as TOLERANT
from tests.commands import (
    BOUND_S,
    ENDLESS,
    OVER,
    PAPER_1,
    REAL_TIME,
    TandemProcess,
    process_of,
    tandem,
    world,
)
from tests.planted import audit, checks
from tests.series import series
from tests.test_field import ASSURED, both_have_ended, pair
from world.hardware.bridge import Field
from world.hardware.driver import Reading
from world.scenario import Scenario


def errors(scenario: Scenario, seed: int) -> dict[str, ClockError]:
    """Return bad clocks of all robots: off by 1 s, with a drift of 100 ppm, and up to three jumps of 10 s."""
    found, draw = {}, random.Random(f"{seed}/clocks")
    for robot in scenario.robots:
        jumps = [(draw.uniform(0.0, 40.0), draw.choice((-10.0, 10.0))) for _ in range(draw.randrange(4))]
        found[robot.id] = ClockError(draw.choice((-1.0, 1.0)), draw.choice((-100.0, 100.0)), tuple(jumps))
    return found


def run(name: str, seed: int, folder: Path) -> HardwareEnd:
    folder.mkdir()
    scenario = load(name, seed=seed)
    return run_hardware(scenario, folder, errors(scenario, seed))


def all_well(end: HardwareEnd, robots: int) -> bool:
    """Return whether every robot is localised, no claim is wrong and no process has failed."""
    outcomes = [one.outcome for one in end.ends.values()]
    return outcomes == ["localised"] * robots and not end.wrong and not end.failures


def files(folder: Path) -> Mapping[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# --- the clock ----------------------------------------------------------------------------------------


def test_a_clock_shows_its_error_and_never_goes_back() -> None:
    true = {"now": 500.0}
    clock = Clock(ClockError(1.0, 100.0, ((10.0, 5.0), (20.0, -7.0))), 500.0, lambda: true["now"])
    shown = []
    for now in (500.0, 509.0, 510.0, 519.0, 520.0, 521.0):
        true["now"] = now
        shown.append(clock() - 500.0)
    assert shown == pytest.approx([1.0, 10.0009, 16.001, 25.0019, 25.0019, 26.002])


MANY = 10
"""More waits than any rounding of times needs."""


class Silence(Inbox):
    """An inbox in which nothing arrives, with a clock that shows the time until which was waited last."""

    def __init__(self) -> None:
        self.now, self.waits = 0.0, 0
        super().__init__("a", Clock(true=lambda: self.now))

    def next(self, timeout: float | None) -> Arrival:
        assert timeout is not None
        self.now, self.waits = self.now + max(timeout, 0.0), self.waits + 1
        assert self.waits < MANY, "it waits for a time that has come"
        return NO_ARRIVAL


@pytest.mark.parametrize(
    ("now", "suspended"),
    [(9.838689737846808, 10.115657822298358), (10.142627495997335, 21.40739787269734)],
)
def test_an_agent_gives_up_on_the_answer_to_its_last_message_when_its_wait_is_over(
    now: float, suspended: float
) -> None:
    """A clock in memory, which only waits advance, would otherwise stand still for ever."""
    config, inbox = load("paper-1").config("a", None), Silence()
    process = AgentProcess(Memory(Robot(config, planner_of(config))), "silent", inbox)
    link = SimpleNamespace(command=len, next=lambda until: inbox.next(until - inbox.clock()))
    process._link = cast(Any, link)
    inbox.now, inbox._asleep = now, suspended  # the sum of both is rounded
    process._conclude(MissionEnd(0, "failed"))
    process._answer_end(MissionEnd(0, "failed"))
    assert 0 < inbox.waits < MANY


# --- hardware mode in virtual time --------------------------------------------------------------------


@pytest.mark.parametrize("case", series([("random", 5), ("random", 36), ("noisy", 0), ("room", 1)]))
def test_robots_with_bad_clocks_localise_and_write_the_same_bytes_again(
    case: tuple[str, int], tmp_path: Path
) -> None:
    name, seed = case
    ends = [run(name, seed, tmp_path / one) for one in ("one", "other")]
    assert all_well(ends[0], len(load(name, seed=seed).robots))
    assert ends[0] == ends[1]
    assert files(tmp_path / "one") == files(tmp_path / "other") != {}


@pytest.mark.long
@pytest.mark.parametrize("name", ["random", "noisy", "random-group", "relative"])
def test_robots_with_bad_clocks_are_never_wrong_or_stuck(name: str, tmp_path: Path) -> None:
    for seed in range(20):
        end = run(name, seed, tmp_path / str(seed))
        assert all_well(end, len(load(name, seed=seed).robots)), (seed, end)


def test_a_manoeuvre_that_a_jump_seems_to_end_is_over_before_the_next_reading(tmp_path: Path) -> None:
    """Otherwise the ranges are of a moving robot, which the peer finds inconsistent."""
    scenario = load("random", seed=36)
    for i in range(8):
        folder = tmp_path / str(i)
        folder.mkdir()
        clock = ClockError(jumps=((12.5 + 0.2 * i, 10.0),))
        assert all_well(run_hardware(scenario, folder, {"a": clock}), 2)


@pytest.mark.parametrize("at", series([10.3, 5.0, 12.0, 17.4]))
def test_a_jump_that_is_longer_than_the_timeout_is_no_silence_of_others(at: float, tmp_path: Path) -> None:
    clock = ClockError(jumps=((at, 40.0),))
    assert all_well(run_hardware(load("random", seed=36), tmp_path, {"a": clock}), 2)


def test_clocks_may_start_anywhere(tmp_path: Path) -> None:
    """Also below zero, where a time of 0 s is in the future."""
    scenario, found = load("random", seed=3), []
    for offset in (0.0, -1e3, 1e6):
        folder = tmp_path / str(offset)
        folder.mkdir()
        clocks = {one.id: ClockError(offset) for one in scenario.robots}
        found.append(run_hardware(scenario, folder, clocks).ends)
    assert found[0] == found[1] == found[2]


def test_a_robot_that_waited_for_another_one_does_not_make_up_the_time(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """It would do so in ticks that are too short for a Command: all would rest in them."""
    scenario, real = load("random", seed=36), _Body.sense

    def sense(body: _Body, tick: int) -> Reading:
        network = body._ground.network
        until = network.now + (waits if (body._id, tick) == ("b", 5) else 0.0)
        while network.now < until:
            body.process.wait(until)
        return real(body, tick)

    monkeypatch.setattr(_Body, "sense", sense)
    found = []
    for waits in (0.0, 10.0):
        folder = tmp_path / str(waits)
        folder.mkdir()
        end = run_hardware(scenario, folder)
        assert all_well(end, 2)
        found.append(max(one.tick for one in end.ends.values()))
    assert found[0] <= found[1] <= found[0] + 1, "all rest in the tick in which they waited"


def test_a_clock_in_place_of_the_tick_is_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    real, began = Field._play_tick, dict[str, float]()

    def by_clock(field: Field) -> MissionEnd | None:
        now = field._inbox.clock()
        passed = now - began.setdefault(field._id, now)
        field._tick = round(passed / field._tick_s) - 1
        return real(field)

    monkeypatch.setattr(Field, "_play_tick", by_clock)
    scenario = load("random", seed=36)
    assert all_well(run_hardware(scenario, tmp_path), 2)
    began.clear()
    (tmp_path / "bad").mkdir()
    assert not all_well(run_hardware(scenario, tmp_path / "bad", {"a": ClockError(jumps=((8.0, 10.0),))}), 2)


# --- the scenario's field -----------------------------------------------------------------------------

CLOCKS = """
[[clock]]
who = "a"
offset = 1.0
drift = -100.0
jumps = [[3.0, 10.0], [4.5, -10.0]]
[[clock]]
who = "b"
jumps = [[4.0, -10.0]]
"""


def test_two_robots_whose_clocks_jump_localise_as_processes_in_hardware_mode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(test_field, "ASSURED", ASSURED.replace("= 120", "= 240") + CLOCKS)
    with pair(tmp_path) as robots:
        both_have_ended(tmp_path, robots)


@pytest.mark.long
def test_robots_whose_clocks_jump_localise_in_real_time(tmp_path: Path) -> None:
    world = '[[clock]]\nwho = "world"\njumps = [[3.0, 10.0], [4.0, -10.0]]\n'
    (tmp_path / "it.toml").write_text(ASSURED + CLOCKS + world)
    ended = tandem("run", tmp_path / "it.toml", "--rate", "10", "--out", tmp_path / "out")
    assert ended.status in OVER, ended.err
    assert tandem("audit", tmp_path / "out").status == 0


def test_a_clock_of_nobody_is_a_mistake(tmp_path: Path) -> None:
    with pytest.raises(BadScenario, match=r"^it: clock\[0\]\.who: there is no 'c'; there are a, b, world"):
        parse(PAPER_1 + '[[clock]]\nwho = "c"\n', "it")
    with pytest.raises(BadScenario, match=r"^it: clock\[1\]\.who: 'a' has another \[\[clock\]\] already"):
        parse(PAPER_1 + 2 * '[[clock]]\nwho = "a"\n', "it")
    (tmp_path / "it.toml").write_text(PAPER_1 + CLOCKS)
    refused = tandem("world", tmp_path / "it.toml", "--listen", "tcp/127.0.0.1:0")
    assert (refused.status, "clock: `tandem world` starts no robots" in refused.err) == (2, True)


@pytest.mark.parametrize(
    ("clocks", "says"),
    [
        ('[[clock]]\nwho = "a"\n[[clock]]\nwho = "a"\n', "clock[1].who: 'a' has another [[clock]] already"),
        (f'[[clock]]\nwho = "a"\njumps = {[[1.0, 1.0]] * 1001}\n', "clock[0]: jumps: more than 1000"),
    ],
    ids=["two of one robot", "too many jumps"],
)
def test_a_clock_that_no_process_could_have_is_a_mistake(clocks: str, says: str) -> None:
    with pytest.raises(BadScenario) as bad:
        parse(PAPER_1 + clocks, "mine.toml")
    assert str(bad.value).startswith(f"mine.toml: {says}")


AWAY = 3 * round(LEASE_S * 20)
"""The number of ticks at a rate of 20 in which Zenoh gives up the link of a process that stands."""


def missed(path: Path, robot: str) -> int:
    """Return the number of ticks without a Command of `robot`."""
    kinds = Environment | Scenario | Command | DeadlineMissed | MissionEnd | FinalReport
    messages = [decode(frame, kinds, MAX_FRAME_BYTES) for frame in journal_file.read(path)]
    return sum(isinstance(message, DeadlineMissed) and message.robot == robot for message in messages)


def test_a_rate_that_cannot_be_kept_can_still_be_stopped(tmp_path: Path) -> None:
    scenario = tmp_path / "endless.toml"
    scenario.write_text(ENDLESS)
    with TandemProcess("run", scenario, "--rate", "2000", "--out", tmp_path / "out", "-q") as run:
        run.until_written(tmp_path / "out" / "world.journal", 10_000)
        os.kill(run.pid, SIGINT)
        ended = run.ended()
    assert ended.status == 130
    assert "Traceback" not in ended.err


@contextmanager
def robots_at(endpoint: str, answers: Callable[[Observation], bool]) -> Iterator[ExitStack]:
    """Yield robots a and b of run r, which answer ticks that `answers` selects; closing the stack ends b."""
    with session.open_client(at(endpoint), lambda: None) as a, ExitStack() as leaves:
        b = leaves.enter_context(session.open_client(at(endpoint), lambda: None))
        commands = {one: session.publisher(a, keys.command("r", one)) for one in "ab"}

        def answer(sample: zenoh.Sample) -> None:
            observation = decode(sample.payload.to_bytes(), Observation | MissionEnd)
            if isinstance(observation, Observation) and answers(observation):
                commands[observation.robot].put(
                    encode(Command(observation.tick, observation.robot, 0.0, 0.0, 1, "straight"))
                )

        subscribed = [a.declare_subscriber(keys.observation("r", one), answer) for one in "ab"]
        tokens = [session.show_alive(link, keys.robot_alive("r", one)) for link, one in ((a, "a"), (b, "b"))]
        yield leaves
        assert subscribed
        assert tokens


@pytest.mark.long
def test_a_tick_may_last_longer_than_the_timeout(tmp_path: Path) -> None:
    scenario = tmp_path / "slow.toml"
    scenario.write_text("max_ticks = 2\n" + PAPER_1)
    with (
        world(scenario, "--rate", "0.5", "--timeout", "1", "--run", "r") as (clock, endpoint),
        robots_at(endpoint, lambda _: True),
    ):
        ended = clock.ended()
    assert ended.status == 1
    assert "undecided after 2 ticks (max_ticks: a, b not localised by then)" in " ".join(ended.out.split())


@pytest.mark.parametrize(("rate", "lasts"), [("1e-8", "1e+08"), ("1e8", "1e-08")])
def test_a_rate_out_of_bounds_is_refused(rate: str, lasts: str) -> None:
    ended = tandem("run", "paper-1", "--rate", rate)
    assert ended.status == 2
    assert ended.err.startswith(f"tandem run: --rate: {float(rate):g} makes a tick of 1 s last {lasts} s")
    assert ended.err.count("\n") == 1


@pytest.mark.long
def test_a_robot_whose_agent_is_suspended_stands_still_and_the_mission_violates_no_rule(
    tmp_path: Path,
) -> None:
    out = tmp_path / "out"
    (tmp_path / "assured.toml").write_text(REAL_TIME)
    with TandemProcess("run", tmp_path / "assured.toml", "--rate", "20", "--out", out) as run:
        run.until_written(out / "world.journal", 3000)
        stopped = process_of(out, "agent", "a")
        os.kill(stopped, SIGSTOP)
        run.until(lambda: missed(out / "world.journal", "a") >= AWAY, "its link has been given up")
        os.kill(stopped, SIGCONT)
        ended = run.ended()
    assert ended.status in OVER
    assert "late: ticks in which the robot stopped" in ended.out
    told = json.loads((out / "summary.json").read_text())
    with (out / "ticks.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["robot"] == "a" and row["state"] == ""]
    assert len(rows) == missed(out / "world.journal", "a")
    rows = [row for row in rows if int(row["tick"]) < told["ticks"]]
    assert told["robots"]["a"]["deadlines_missed"] == len(rows) >= AWAY
    assert {(row["v"], row["omega"]) for row in rows} == {("0.0", "0.0")}
    findings = audit(out)
    assert [one for one in findings.violations if not one.breaks_off] == []
    assert all(made for rule, made in checks(findings).items() if rule not in ("claim", "distance", "bound"))


@pytest.mark.long
def test_a_world_prints_the_reason_for_a_missing_final_report(tmp_path: Path) -> None:
    """Both answer only the first tick, which lasts long enough for a busy machine; then b ends."""
    out = tmp_path / "out"
    (tmp_path / "short.toml").write_text("max_ticks = 3\n" + TOLERANT.partition("\n")[2])
    second = threading.Event()

    def answers(observation: Observation) -> bool:
        if observation.tick:
            second.set()
        return observation.tick == 0

    with (
        world(tmp_path / "short.toml", "--rate", "1", "--run", "r", "--out", out) as (clock, endpoint),
        robots_at(endpoint, answers) as leaves,
    ):
        assert second.wait(BOUND_S)
        leaves.close()
        ended = clock.ended()
    assert ended.status == 1
    behind, gone = [line for line in ended.err.splitlines() if "no FinalReport" in line]
    assert behind.startswith(
        "tandem world: no FinalReport of a: behind, at tick 0 of 3; a lower --rate leaves"
    )
    assert gone == "tandem world: no FinalReport of b: gone; the last Command was of tick 0"
    assert "deadlines missed, of 3: a 2, b 2; a lower --rate, such as --rate 0.5, gives" in ended.out
    robots = json.loads((out / "summary.json").read_text())["robots"]
    assert robots["a"]["no_farewell"] == "its last Command that arrived in time is of tick 0 of 3"
