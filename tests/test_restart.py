"""Processes that are killed at any point of a tick are restarted, and the recording has the same bytes."""

from __future__ import annotations

import csv
import os
import re
import shutil
from contextlib import ExitStack, closing
from pathlib import Path
from queue import Empty, SimpleQueue
from signal import SIGKILL

import msgpack
import pytest
import zenoh
from msgspec.structs import replace

from agent.process.agent_journal import agent_history
from agent.process.recovery import remember
from agent.process.robot import Robot
from compose.errors import BadKill
from compose.launch.in_process import run_mission
from compose.launch.planner_loader import planner_of
from compose.launch.processes import free_endpoint
from compose.scenario.kills import parse
from compose.scenario.scenario_file import load
from protocol.journal import journal_file
from protocol.journal.journal_file import CorruptJournal
from protocol.journal.resume import Retrace
from protocol.messages import (
    Cause,
    Command,
    Contact,
    DeadlineMissed,
    Environment,
    FinalReport,
    MissionEnd,
    Observation,
    Report,
)
from protocol.network import keys, session
from protocol.network.endpoints import listening
from protocol.network.inbox import Inbox
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from tests.commands import (
    BOUND_S,
    OVER,
    PAPER_1,
    REAL_TIME,
    TandemProcess,
    decided,
    journals,
    processes_of,
    refused,
    tandem,
    world,
)
from tests.series import series
from world.scenario import Scenario
from world.simulation import resumed
from world.world_journal import world_history

PARTS = ("agent-a", "agent-b", "world")
LOCALISED = "localised after 48 ticks\n"
REPEAT_S = 0.25


def options(kills: str) -> list[str]:
    return [word for kill in kills.split() for word in ("--kill", kill)]


# --- killed and restarted ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kills",
    series(
        [
            "a@7 a@46:report a@20:journal a@31:command",
            "b@0:command b@47:report b@33 b@48:journal",
            "world@0 world@46:report world@30:command world@48:journal",
            "a@47:report b@47:report",
            "a@12 world@12:report b@48:command",
            "b@46 b@46 b@46:command",
            "a@48:journal b@48:command world@48:command",
        ]
    ),
)
def test_a_run_whose_processes_are_killed_ends_with_the_same_recording(
    kills: str, undisturbed: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    ended = tandem("run", "paper-1", "-q", "--out", out, *options(kills))
    assert ended[:2] == (0, LOCALISED), ended
    killed = re.findall(
        r"^tandem run: (?:agent )?(\w+) was killed at tick (\d+), and", ended.err, re.MULTILINE
    )
    assert sorted("@".join(one) for one in killed) == sorted(re.findall(r"\w+@\d+", kills))
    assert len(re.findall(r": back, replayed \d+ ticks?, identical$", ended.err, re.MULTILINE)) == len(killed)
    assert "the world has gone" not in ended.err
    assert decided(out) == decided(undisturbed)
    assert not processes_of(out)


def test_a_robot_that_comes_back_later_is_waited_for_even_after_the_last_tick(
    undisturbed: Path, tmp_path: Path
) -> None:
    ended = tandem("run", "paper-1", "-q", "--out", tmp_path / "out", "--kill", "a@48:command+0.5s")
    said = "tandem run: agent a was killed at tick 48, and is restarted in 0.5 s\n"
    said += "tandem agent a: back, replayed 49 ticks, identical\n"
    assert ended == (0, LOCALISED, said)
    assert decided(tmp_path / "out") == decided(undisturbed)


def test_a_kill_point_that_is_never_reached_is_reported(undisturbed: Path, tmp_path: Path) -> None:
    kills = options("b@900 a@3:report world@49:command+never")
    ended = tandem("run", "paper-1", "-q", "--out", tmp_path / "out", *kills)
    assert ended[:2] == (0, LOCALISED)
    assert sorted(ended.err.splitlines()) == [
        "tandem run: --kill a@3:report: not reached",
        "tandem run: --kill b@900: not reached",
        "tandem run: --kill world@49:command+never: not reached",
    ]
    assert decided(tmp_path / "out") == decided(undisturbed)


@pytest.mark.parametrize("who", ["b", "world"])
def test_a_process_that_is_never_started_again_ends_the_run_at_once(who: str, tmp_path: Path) -> None:
    ended = tandem("run", "paper-1", "-q", "--out", tmp_path / "out", "--kill", f"{who}@17+never")
    name = "world" if who == "world" else f"agent {who}"
    assert ended == (3, "", f"tandem run: failed: {name} was killed at tick 17 (--kill {who}@17+never)\n")
    assert not processes_of(tmp_path / "out")


@pytest.mark.long
def test_a_robot_that_returns_after_the_timeout_fails_the_run(tmp_path: Path) -> None:
    kill = ("--kill", "a@17+600s", "--timeout", "5")
    ended = tandem("run", "paper-1", "-q", "--out", tmp_path / "out", *kill)
    assert ended[:2] == (3, "failed after 16 ticks (no answer from a (not connected) at tick 17 for 5 s)\n")
    assert not processes_of(tmp_path / "out")


@pytest.mark.long
def test_an_absent_robot_stands_still_in_real_time_and_learns_what_it_missed(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (tmp_path / "assured.toml").write_text(REAL_TIME.replace("600", "200"))
    kills = options("a@20+0.5s world@60:report")  # ten periods: a process is back in less than one
    ended = tandem("run", tmp_path / "assured.toml", "--rate", "20", "-q", "--out", out, *kills)
    assert ended.status in OVER, ended
    with (out / "ticks.csv").open(newline="") as file:
        away = [row for row in csv.DictReader(file) if row["state"] == ""]
    assert "a" in {row["robot"] for row in away}
    assert {(row["v"], row["omega"]) for row in away} == {("0.0", "0.0")}
    kinds = Environment | Scenario | Command | DeadlineMissed | MissionEnd | FinalReport
    messages = [decode(frame, kinds, MAX_FRAME_BYTES) for frame in journal_file.read(out / "world.journal")]
    assert sum(isinstance(message, DeadlineMissed) for message in messages) == len(away)
    for robot in ("a", "b"):
        lived = agent_history(journal_file.read(out / f"agent-{robot}.journal"), robot)
        assert [step.observation.tick for step in lived.steps] == list(range(len(lived.steps)))


# --- options ------------------------------------------------------------------------------------------


def test_a_kill_is_read_as_it_is_written() -> None:
    fields = [(kill.who, kill.tick, kill.point, kill.after) for kill in map(parse, (
        "a@17", "b-2@0:report", "world@30:journal+5s", "a@1:command+never", "a@1+0.25s"
    ))]  # fmt: skip
    assert fields == [
        ("a", 17, "observation", 0.0),
        ("b-2", 0, "report", 0.0),
        ("world", 30, "journal", 5.0),
        ("a", 1, "command", None),
        ("a", 1, "observation", 0.25),
    ]


@pytest.mark.parametrize(
    "text",
    ["", "a", "a@", "@17", "a17", "a@-1", "a@1.5", "a@17:", "a@17:drives", "a@17+", "a@17+5", "a@17+5m"]
    + [
        "a@17+-1s",
        "a@17+nans",
        "a@17+never:command",
        " a@17",
        "a@17\n",
        "a b@17",
        "a@²",
        "a@17:observation:observation",
    ],
)
def test_a_mistyped_kill_is_none(text: str) -> None:
    with pytest.raises(BadKill, match="is not a kill"):
        parse(text)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--kill", "a17"], "--kill: 'a17' is not a kill"),
        (["--kill"], "--kill"),
        (["--kill", "z@17"], "--kill: z@17: there is no 'z'; there are a, b, world"),
        (["--kill", "a@17", "--in-process"], "--kill: --in-process has no processes to kill"),
    ],
)
def test_a_mistake_about_kills_is_one_line(arguments: list[str], says: str, tmp_path: Path) -> None:
    ended = tandem("run", "paper-1", "--out", "out", *arguments, cwd=tmp_path)
    refused(ended, says)
    assert list(tmp_path.iterdir()) == []


# --- incomplete recordings ----------------------------------------------------------------------------


def cuts(data: bytes) -> list[int]:
    """Return sizes to which a journal is truncated: all over it, and denser in its last ticks."""
    return [*range(0, len(data), 211), *range(len(data) - 1200, len(data) + 1, 7), len(data)]


@pytest.mark.parametrize("robot", ["a", "b"])
def test_an_agents_journal_torn_anywhere_is_finished_with_the_same_bytes(
    robot: str, undisturbed: Path, tmp_path: Path
) -> None:
    data = (undisturbed / f"agent-{robot}.journal").read_bytes()
    whole = agent_history(journal_file.read(undisturbed / f"agent-{robot}.journal"), robot)
    assert whole.end is not None
    torn = tmp_path / "torn.journal"
    for cut in cuts(data):
        torn.write_bytes(data[:cut])
        old = Retrace(torn)
        memory = remember(old, planner_of)
        assert torn.stat().st_size == cut
        book, lost = old.open_for_append()
        assert torn.stat().st_size >= cut - lost
        with book:
            body = Robot(whole.config, planner_of(whole.config), book) if memory is None else memory.robot
            body.append_to(book)
            known = memory.observation.tick if memory is not None and memory.observation is not None else -1
            for step in whole.steps[max(known, 0) :]:
                if step.observation.tick > known:
                    body.observation(step.observation, step.frame)
                if body.command is None:
                    body.decide(step.received)
                    body.estimate()
            if memory is None or memory.final_report is None:
                body.final_report(whole.end)
        assert torn.read_bytes() == data, cut


def test_a_worlds_journal_torn_anywhere_is_finished_with_the_same_bytes(
    undisturbed: Path, tmp_path: Path
) -> None:
    data = (undisturbed / "world.journal").read_bytes()
    whole = world_history(journal_file.read(undisturbed / "world.journal"), "world")
    torn = tmp_path / "torn.journal"
    for cut in cuts(data):
        torn.write_bytes(data[:cut])
        old = Retrace(torn)
        simulation = resumed(load("paper-1"), old)
        assert torn.stat().st_size == cut
        book, _ = old.open_for_append()
        with book:
            simulation.append_to(book)
            for tick in whole.ticks[simulation.tick :]:
                if simulation.mission_end is None:
                    simulation.command(tick.commands)
            simulation.journal_final_reports(whole.final_reports.values())
        assert torn.read_bytes() == data, cut


def shells(out: Path, endpoint: str, folder: ExitStack) -> dict[str, TandemProcess]:
    parts = {
        "world": ("world", "paper-1", "--listen", endpoint),
        "a": ("agent", "a", "--connect", endpoint),
        "b": ("agent", "b", "--connect", endpoint),
    }
    return {name: folder.enter_context(TandemProcess(*part, "--out", out)) for name, part in parts.items()}


def at_tick(frames: list[bytes], tick: int) -> int:
    """Return the number of bytes of a journal before the first frame of `tick`, without the file header."""
    for place, frame in enumerate(frames):
        if place and msgpack.unpackb(frame[5:])[1] == tick:
            return len(journal_file.packed(frames[:place]))
    raise AssertionError(f"no tick {tick}")


@pytest.mark.parametrize("tick", [20, 47])
def test_a_truncated_tail_is_removed_and_reported(tick: int, undisturbed: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    for name, more in zip(PARTS, (23, 9, 11), strict=True):
        path = undisturbed / f"{name}.journal"
        keep = at_tick(list(journal_file.read(path)), tick) + more
        (out / path.name).write_bytes(path.read_bytes()[:keep])
    with ExitStack() as folder:
        ended = {name: shell.ended() for name, shell in shells(out, free_endpoint(), folder).items()}
    assert {name: end.status for name, end in ended.items()} == {"world": 0, "a": 0, "b": 0}, ended
    for name, end in ended.items():
        part = "world" if name == "world" else f"agent {name}"
        file = re.escape(f"{out / part.replace(' ', '-')}.journal")
        said = rf"tandem {part}: {file}: the last \d+ bytes are of a torn write and are cut off"
        assert re.search(said, end.err, re.MULTILINE), ended
    assert f", resumed at tick {tick}: waiting for a, b" in ended["world"].out
    assert decided(out) == decided(undisturbed)


def test_a_world_and_an_agent_that_are_killed_go_on_by_the_same_commands(
    undisturbed: Path, tmp_path: Path
) -> None:
    endpoint = free_endpoint()
    clock = ("world", "paper-1", "--listen", endpoint, "--out", tmp_path)
    a, b = (("agent", robot, "--connect", endpoint, "--out", tmp_path) for robot in ("a", "b"))
    with ExitStack() as folder:
        first = folder.enter_context(TandemProcess(*clock))
        first.until_prints("waiting for a, b")
        agent = folder.enter_context(TandemProcess(*a))
        agent.until_answered("a", tmp_path)
        agent.tell(SIGKILL)
        agent = folder.enter_context(TandemProcess(*a))
        agent.until_prints("resumed at tick 0")
        first.tell(SIGKILL)
        agent.until_prints("the world has gone; waiting 30 s for it")
        second = folder.enter_context(TandemProcess(*clock))
        second.until_prints("waiting for a, b")
        last = folder.enter_context(TandemProcess(*b))
        assert [part.ended().status for part in (second, agent, last)] == [0, 0, 0]
    assert decided(tmp_path) == decided(undisturbed)


def test_a_process_that_has_ended_prints_its_outcome_again(undisturbed: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    for name, data in journals(undisturbed).items():
        (out / name).write_bytes(data)
    endpoint = free_endpoint()
    agent = tandem("agent", "a", "--connect", endpoint, "--out", out, "--connect-timeout", "0.2")
    assert agent == (0, "a: localised after 48 ticks\n", "")
    clock = tandem("world", "paper-1", "--listen", endpoint, "--out", out, "-q")
    assert clock == (0, LOCALISED, "")
    assert decided(out) == decided(undisturbed)


def test_a_world_killed_after_its_mission_end_collects_the_final_reports(
    undisturbed: Path, tmp_path: Path
) -> None:
    for name, data in journals(undisturbed).items():
        (tmp_path / name).write_bytes(data)
    frames = list(journal_file.read(undisturbed / "world.journal"))
    (tmp_path / "world.journal").write_bytes(journal_file.packed(frames[:-2]))
    frames = list(journal_file.read(undisturbed / "agent-b.journal"))
    (tmp_path / "agent-b.journal").write_bytes(journal_file.packed(frames[:-2]))
    with ExitStack() as folder:
        ended = {name: shell.ended() for name, shell in shells(tmp_path, free_endpoint(), folder).items()}
    assert {name: end.status for name, end in ended.items()} == {"world": 0, "a": 0, "b": 0}, ended
    assert decided(tmp_path) == decided(undisturbed)


def test_an_agent_repeats_its_final_report_until_a_world_has_recorded_it(tmp_path: Path) -> None:
    scenario, endpoint, run = load("paper-1"), free_endpoint(), "mine"
    there = Inbox("test")

    def final_report_of(link: zenoh.Session) -> bytes:
        session.subscribe(link, keys.command(run, "a"), there, "command")
        session.watch_liveliness(link, keys.robot_alive(run, "*"), there)
        publisher = session.publisher(link, keys.observation(run, "a"))
        _token = session.show_alive(link, keys.world_alive(run))
        while True:
            arrival = there.next(REPEAT_S)
            if arrival.topic == "command":
                assert isinstance(decode(arrival.frame, FinalReport), FinalReport)
                return arrival.frame
            publisher.put(encode(MissionEnd(0, "undecided", (Cause("dead", ("a",), (1,)),))))

    with ExitStack() as folder:
        with session.open_router(listening(endpoint)) as link:
            session.answer(link, keys.config(run, "*"), lambda *_: scenario.config("a"))
            _token = session.show_alive(link, keys.world_alive(run))
            agent = folder.enter_context(
                TandemProcess("agent", "a", "--connect", endpoint, "--out", tmp_path, "--timeout", "600")
            )
            first = final_report_of(link)
        agent.until_prints("the world has gone after its MissionEnd; waiting 600 s for it")
        there = Inbox("test")
        with session.open_router(listening(endpoint), BOUND_S) as link:
            assert final_report_of(link) == first
            assert agent.running
            session.publisher(link, keys.observation(run, "a")).put(first)
            assert agent.ended().status == 1


# --- repeated messages --------------------------------------------------------------------------------


def test_a_repeated_observation_makes_an_agent_repeat_its_latest_reports(tmp_path: Path) -> None:
    scenario, endpoint, run = load("paper-1"), free_endpoint(), "mine"
    reports: SimpleQueue[int] = SimpleQueue()
    there = Inbox("test")
    observations = [Observation(tick, "a", None, 2.5, (Contact("b", 2.0, ()),)) for tick in range(70)]
    observations[1:] = [replace(observation, executed=None) for observation in observations[1:]]
    latest = list(range(69 - 59, 70))

    def heard(ticks: list[int]) -> None:
        assert [next_of(reports) for _ in ticks] == ticks

    with session.open_router(listening(endpoint)) as link:
        session.answer(link, keys.config(run, "*"), lambda *_: scenario.config("a"))
        session.watch_liveliness(link, keys.robot_alive(run, "*"), there)
        link.declare_subscriber(
            keys.report(run, "a", "b"),
            lambda sample: reports.put(decode(sample.payload.to_bytes(), Report).tick),
        )
        publisher = session.publisher(link, keys.observation(run, "a"))
        _token = session.show_alive(link, keys.world_alive(run))
        part = ("agent", "a", "--connect", endpoint, "--out", tmp_path)
        with TandemProcess(*part) as agent:
            assert there.next(BOUND_S).topic == "alive"
            for observation in observations:
                publisher.put(encode(observation))
            heard(list(range(70)))
            publisher.put(encode(observations[-1]))
            heard(latest)
            os.kill(agent.pid, SIGKILL)
        assert there.next(BOUND_S).topic == "gone"
        with TandemProcess(*part):
            assert there.next(BOUND_S).topic == "alive"
            publisher.put(encode(observations[-1]))
            heard(latest)
    assert reports.empty()


def next_of(queue: SimpleQueue[int]) -> int:
    try:
        return queue.get(timeout=BOUND_S)
    except Empty:
        raise AssertionError("nothing more came") from None


# --- refused ------------------------------------------------------------------------------------------


@pytest.fixture
def recording(undisturbed: Path, tmp_path: Path) -> Path:
    """Return a copy of the undisturbed recording without its end, which the test may change."""
    for name in PARTS:
        frames = list(journal_file.read(undisturbed / f"{name}.journal"))
        (tmp_path / f"{name}.journal").write_bytes(journal_file.packed(frames[:60]))
    return tmp_path


def refuses(out: Path, *arguments: str, says: str) -> None:
    before = journals(out)
    refused(tandem(*arguments, "--out", out), "--out: ", says, "choose another folder")
    assert journals(out) == before


def spoil(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)


def test_a_corrupt_journal_is_refused(recording: Path) -> None:
    for name in ("agent-a", "world"):
        spoil(recording / f"{name}.journal")
    unused = free_endpoint()
    file = f"{recording / 'agent-a.journal'}: "
    refuses(recording, "agent", "a", "--connect", unused, says=file)
    refuses(recording, "world", "paper-1", "--listen", unused, says=f"{recording / 'world.journal'}: ")


def test_a_journal_that_is_damaged_anywhere_is_not_mistaken_for_a_torn_one(
    recording: Path, tmp_path: Path
) -> None:
    good = (recording / "agent-b.journal").read_bytes()
    frames = list(journal_file.read(recording / "agent-b.journal"))
    last = len(journal_file.packed(frames[:-1]))
    path = tmp_path / "damaged.journal"
    for place in range(0, last, 11):
        for bit in (0, 1, 5, 7):
            data = bytearray(good)
            data[place] ^= 1 << bit
            path.write_bytes(data)
            with pytest.raises(CorruptJournal, match=r"damaged\.journal: "):
                _remembered(path)
            assert path.read_bytes() == data


def _remembered(path: Path) -> None:
    with closing(Retrace(path)) as old:
        remember(old, planner_of)


def test_a_worlds_journal_of_another_scenario_is_refused(recording: Path) -> None:
    says = f"{recording / 'world.journal'}: a recording of another scenario, paper-1"
    refuses(recording, "world", "paper-2", "--listen", free_endpoint(), says=says)


def test_an_agents_journal_of_another_configuration_is_refused(recording: Path, tmp_path: Path) -> None:
    scenario = tmp_path / "farther.toml"
    scenario.write_text(PAPER_1.replace("anchor = [10.0", "anchor = [10.5"))
    path = recording / "agent-a.journal"
    says = f"{path}: belongs to another run: its configuration does not match the world's"
    with world(scenario) as (_, endpoint):
        refuses(recording, "agent", "a", "--connect", endpoint, says=says)


@pytest.mark.long
def test_an_agents_journal_with_another_observation_is_refused(recording: Path) -> None:
    path = recording / "agent-a.journal"
    path.write_bytes(journal_file.packed(list(journal_file.read(path))[:4]))
    with world("paper-2") as (_, endpoint), TandemProcess("agent", "b", "--connect", endpoint):
        # its RobotConfigs are those of paper-1
        ended = tandem("agent", "a", "--connect", endpoint, "--out", recording)
    said = "the recording belongs to another run: its Observation of a at tick 0 differs"
    assert (ended.status, ended.err) == (3, f"tandem agent a: {said}\n")


def test_a_journal_with_another_decision_is_refused(recording: Path) -> None:
    path = recording / "agent-a.journal"
    frames = list(journal_file.read(path))
    place = next(i for i, frame in enumerate(frames) if frame[5:].find(b"command\x0c") > 0)
    command = decode(frames[place], Command)
    assert command.tick == 12
    frames[place] = encode(replace(command, v=command.v / 2.0))
    path.write_bytes(journal_file.packed(frames))
    says = f"{path}: the recorded decision differs at tick 12: the journal was written by another version"
    refuses(recording, "agent", "a", "--connect", free_endpoint(), says=says)


def test_a_journal_that_another_process_has_is_refused(recording: Path) -> None:
    with closing(Retrace(recording / "agent-a.journal")), closing(Retrace(recording / "world.journal")):
        for name, part in (
            ("agent-a", ("agent", "a", "--connect", free_endpoint())),
            ("world", ("world", "paper-1", "--listen", free_endpoint())),
        ):
            refuses(recording, *part, says=f"{recording / name}.journal is in use by another process")


@pytest.mark.long
def test_an_agent_refuses_a_world_that_has_lost_its_journal(recording: Path) -> None:
    with world("paper-1") as (_, endpoint), TandemProcess("agent", "b", "--connect", endpoint):
        ended = tandem("agent", "a", "--connect", endpoint, "--out", recording)
    tick = agent_history(journal_file.read(recording / "agent-a.journal"), "a").steps[-1].observation.tick
    assert ended.status == 3
    said = f"the world was restarted without its recording: the world is at tick 0, a at tick {tick}"
    assert ended.err.splitlines()[-1] == f"tandem agent a: {said}"  # it may have told of a torn write before


@pytest.mark.long
def test_a_mission_under_noise_is_folded_to_the_bit(tmp_path: Path) -> None:
    scenario = load("noisy")
    run_mission(scenario, tmp_path)
    for robot in ("a", "b"):
        with closing(Retrace(tmp_path / f"agent-{robot}.journal")) as old:
            memory = remember(old, planner_of)
            assert memory is not None
            assert memory.final_report is not None
    with closing(Retrace(tmp_path / "world.journal")) as old:
        assert resumed(scenario, old).final_reports.keys() == {"a", "b"}


@pytest.mark.long
def test_an_agent_that_has_ended_does_not_wait_for_a_world_that_has_gone(
    undisturbed: Path, tmp_path: Path
) -> None:
    shutil.copy(undisturbed / "agent-a.journal", tmp_path)
    with ExitStack() as stack:
        playing, endpoint = stack.enter_context(world("paper-1"))
        reach = ("--connect", endpoint, "--out", tmp_path, "--timeout", "600")
        agent = stack.enter_context(TandemProcess("agent", "a", *reach))
        agent.until_prints("resumed at tick 48")
        playing.tell(SIGKILL)
        ended = agent.ended()
    assert (ended.status, ended.out.splitlines()[-1]) == (0, f"a: {LOCALISED.strip()}")
