"""Hardware mode: robots with drivers of their own localise, and those that are killed resume."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from signal import SIGCONT, SIGINT, SIGKILL, SIGSTOP
from types import SimpleNamespace
from typing import Any

import msgpack
import pytest
from msgspec.structs import replace

from agent.process.agent_journal import AgentHistory, agent_history
from compose.hardware.driver_recording import recorded
from compose.launch.processes import free_endpoint
from compose.scenario.scenario_file import load
from docs.rover import Rover
from protocol.journal import journal_file
from protocol.journal.journal_file import CorruptJournal
from protocol.messages import Command, Localised, Observation, OfRobot, TickStart
from protocol.motion import ORIGIN, REST
from protocol.network import keys, session
from protocol.network.inbox import Inbox
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from tests.broken_drivers import LosesAReading
from tests.commands import (
    BOUND_S,
    OVER,
    PAPER_1,
    Ended,
    TandemProcess,
    process_of,
    processes_of,
    refused,
    size,
    tandem,
    until,
)
from tests.storm import stranger_at
from world.hardware import driver_journal
from world.hardware.driver_journal import DriverHistory

STARTS = {"a": "2.4,-1.2,4.8", "b": "11.3,-0.4,3.6"}
ASSURED = "max_ticks = 120\n" + PAPER_1.replace('"paper"', '"assured"').replace('"paper-1"', '"field"')
"""A scenario with the planner that tolerates missed ticks. With `--rate 4` it ends after at most 38 s."""


@contextmanager
def beacon(*more: str) -> Iterator[str]:
    """Yield the endpoint of a process that measures the ranges between simulated robots."""
    command = [sys.executable, "-P", "docs/rover.py", "--reach", "3", *more]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": "."}
    ) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().split()[-1]
        finally:
            process.kill()


@contextmanager
def pair(
    out: Path, *more: str | Path, protocol: str = "tcp", text: str = ASSURED
) -> Iterator[dict[str, TandemProcess]]:
    """Yield both robots of paper-1's geometry, running the scenario `text`."""
    (out / "field.toml").write_text(text)
    endpoint = free_endpoint(protocol)
    with beacon() as air:

        def robot(name: str, flag: str) -> TandemProcess:
            return TandemProcess(
                *("robot", name, "--mission", out / "field.toml", "--driver", "docs.rover:Rover"),
                *("--rate", "4", flag, endpoint, *more, "--out", out / name, "--timeout", "20"),
                *("--option", f"start={STARTS[name]}", "--option", f"beacon={air}"),
            )

        with robot("b", "--connect") as b, robot("a", "--listen") as a:  # in any order
            yield {"a": a, "b": b}


def told(out: Path, robot: str) -> AgentHistory:
    path = out / robot / f"agent-{robot}.journal"
    return agent_history(journal_file.read(path), path)


def messages(frames: list[bytes]) -> list[object]:
    return [decode(frame, OfRobot, MAX_FRAME_BYTES) for frame in frames]


def pose(ended: Ended, robot: str, word: str) -> tuple[float, ...]:
    (line,) = [line for line in ended.out.splitlines() if line.startswith(f"{robot}: {word}")]
    return tuple(float(number) for number in line.removeprefix(f"{robot}: {word}").split()[:3])


def both_have_ended(out: Path, robots: dict[str, TandemProcess]) -> None:
    """Assert that no result is inconsistent, each journal can be replayed, and each claim is correct.

    In real time no more is guaranteed. Robots that received every Command in time are localised, too.
    """
    ends = {name: robot.ended() for name, robot in robots.items()}
    late = any(f"{name}: missed the deadline in 0 of" not in ended.out for name, ended in ends.items())
    said = "".join(ended.out + ended.err for ended in ends.values())
    for name, ended in ends.items():
        assert ended.status in OVER, said
        assert f"{name}: localised after" in said or (late and f"{name}: undecided after" in said), said
        if f"{name}: claims" in ended.out:
            claimed, truly = pose(ended, name, "claims"), pose(ended, name, "truly at")
            assert claimed == pytest.approx(truly, abs=1e-6)
        assert not (out / name / "world.journal").exists()
        replayed = tandem("replay", out / name)
        assert replayed.status == 0, replayed.out
        assert f"{name}, hardware mode: as recorded, to the bit, over" in replayed.out
        (ticks,) = re.findall(r"(?:localised|undecided) after (\d+) ticks", ended.out)
        assert f" over {ticks} ticks " in replayed.out


def test_two_robots_localise_in_hardware_mode(tmp_path: Path) -> None:
    with pair(tmp_path) as robots:
        both_have_ended(tmp_path, robots)
    a, b = told(tmp_path, "a"), told(tmp_path, "b")
    for one, other in ((a, b), (b, a)):
        sent = {step.observation.tick for step in other.steps if step.reports}
        heard = [report.report.tick for step in one.steps for report in step.received]
        assert heard
        assert len(heard) == len(set(heard))
        assert set(heard) <= sent
        assert all(
            report.report.tick <= step.observation.tick for step in one.steps for report in step.received
        )
        assert all(step.observation.contacts for step in one.steps if step.received)
        assert one.final_report is not None
        assert one.final_report.reports_heard == len(heard)
        near = {step.observation.tick for step in one.steps if step.observation.contacts}
        assert one.final_report.reports_lost == len(near - set(heard)) < len(near)
        assert all(contact.heard is None for step in one.steps for contact in step.observation.contacts)
    shutil.copy(tmp_path / "b" / "agent-b.journal", tmp_path / "a")
    both = tandem("replay", tmp_path / "a")
    assert both.status == 0
    assert "a and b, hardware mode: as recorded, to the bit" in both.out


@pytest.mark.long
def test_two_robots_localise_over_encrypted_links_in_hardware_mode(tmp_path: Path) -> None:
    assert tandem("keys", tmp_path / "keys", "--robots", "a,b").status == 0
    with pair(tmp_path, "--keys", tmp_path / "keys" / "world", protocol="tls") as robots:
        both_have_ended(tmp_path, robots)


@pytest.mark.long
def test_a_wrong_decision_in_hardware_mode_is_found(tmp_path: Path) -> None:
    with pair(tmp_path) as robots:
        both_have_ended(tmp_path, robots)
    path = tmp_path / "a" / "agent-a.journal"
    frames = list(journal_file.read(path))
    place, command = next(
        (i, one) for i, one in enumerate(messages(frames)) if isinstance(one, Command) and one.v
    )
    frames[place] = encode(replace(command, v=0.5 * command.v))
    path.unlink()
    with journal_file.Journal(path) as changed:
        changed.write(*frames)
    replayed = tandem("replay", tmp_path / "a")
    assert replayed.status == 1
    assert (
        f"tick {command.tick}, a, Command v: recorded {0.5 * command.v}, recomputed {command.v}"
        in replayed.out
    )


@pytest.mark.long
def test_a_robot_whose_agent_is_killed_stands_still_and_resumes(tmp_path: Path) -> None:
    with pair(tmp_path) as robots:
        path = tmp_path / "b" / "agent-b.journal"
        robots["b"].until_written(path, 2500)
        os.kill(process_of(tmp_path / "b", "agent", "b"), SIGKILL)
        robots["b"].until_prints("was killed by signal 9 and is restarted")
        both_have_ended(tmp_path, robots)
    stood = [
        step
        for step in told(tmp_path, "b").steps
        if step.observation.executed == REST and step.observation.tick
    ]
    assert stood
    assert [step.observation.tick for step in told(tmp_path, "b").steps] == list(
        range(len(told(tmp_path, "b").steps))
    )


@pytest.mark.long
def test_a_robot_whose_agent_is_suspended_stands_still_within_a_period_and_resumes(
    tmp_path: Path,
) -> None:
    with pair(tmp_path) as robots:
        path = tmp_path / "a" / "agent-a.journal"
        robots["a"].until_written(path, 2500)
        agent = process_of(tmp_path / "a", "agent", "a")
        os.kill(agent, SIGSTOP)
        before = len(told(tmp_path, "a").steps)
        other = tmp_path / "b" / "agent-b.journal"
        robots["b"].until(lambda: len(told(tmp_path, "b").steps) > before + 6, "b's mission goes on")
        assert other.exists()
        os.kill(agent, SIGCONT)
        both_have_ended(tmp_path, robots)
    steps = told(tmp_path, "a").steps
    assert all(step.observation.executed == REST for step in steps[before + 2 : before + 6])


def test_ctrl_c_ends_a_robot_and_leaves_no_process(tmp_path: Path) -> None:
    with pair(tmp_path) as robots:
        robots["a"].until_written(tmp_path / "a" / "agent-a.journal", 1500)
        for robot in robots.values():
            robot.tell(SIGINT)
        for name, robot in robots.items():
            ended = robot.ended(20.0)
            assert ended.status == 130
            assert "stopped by SIGINT" in ended.err
            assert "Traceback" not in ended.err
            assert processes_of((tmp_path / name).resolve()) == {}


def test_a_robot_without_a_beacon_waits_for_it_idle_and_gives_up() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as nobody:
        nobody.bind(("127.0.0.1", 0))
        where = f"127.0.0.1:{nobody.getsockname()[1]}"
    rover = Rover(load("paper-1").config("a"), 0.25, beacon=where, timeout="1")
    busy = time.process_time()
    with pytest.raises(TimeoutError, match="no answer of the beacon for 1 s"):
        rover.sense(0)
    assert time.process_time() - busy < 0.1
    rover.stop()
    rover.close()


@pytest.mark.long
def test_the_agent_of_a_robot_waits_for_the_peer_as_long_as_its_driver(tmp_path: Path) -> None:
    """That is `--connect-timeout`, however short the time is to wait for an answer."""
    ended = tandem(
        *("robot", "b", "--mission", "paper-1", "--driver", "docs.rover:Rover", "--rate", "10"),
        *("--connect-timeout", "12", "--timeout", "6", "--out", tmp_path / "out"),
    )
    assert ended.status == 3
    assert ended.err == "tandem robot b: a: not connected; no robot has moved\n"


def test_a_robot_whose_peer_does_not_come_has_not_moved(tmp_path: Path) -> None:
    ended = tandem(
        *("robot", "a", "--mission", "paper-1", "--driver", "docs.rover:Rover", "--rate", "10"),
        *("--connect-timeout", "2", "--out", tmp_path / "out"),
    )
    assert ended.status == 3
    assert ended.err.endswith("b: not connected; no robot has moved\n")
    assert ended.err.count("\n") == 1
    assert processes_of(tmp_path / "out") == {}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("c", "--mission", "paper-1"), "paper-1: there is no robot 'c'; there are a, b"),
        (("a", "--mission", "nowhere.toml"), "nowhere.toml: neither a file nor a shipped scenario"),
        (("a", "--mission", "{faults}"), "fault: not available in hardware mode"),
        (("a", "--mission", "paper-1", "--option", "colour"), "--option: 'colour' is not an option"),
        (("a", "--mission", "paper-1", "--rate", "1e8"), "--rate: 1e+08 makes a tick of 1 s last"),
        (("a", "--mission", "paper-1", "--listen", "7447"), "--listen: '7447' is not an endpoint"),
        (
            ("a", "--mission", "paper-1", "--out", "{recording}"),
            "driver-a.journal does not",
        ),
    ],
)
def test_a_mistake_is_one_line(tmp_path: Path, arguments: tuple[str, ...], said: str) -> None:
    (tmp_path / "faults.toml").write_text(f"{PAPER_1}\n[[fault]]\nloss = 0.5\n")
    with journal_file.Journal(tmp_path / "agent-a.journal") as old:
        old.write(encode(load("paper-1").config("a")))
    words = [word.format(faults=tmp_path / "faults.toml", recording=tmp_path) for word in arguments]
    refused(tandem("robot", *words, "--driver", "docs.rover:Rover"), said, "tandem robot: ")


class Pair:
    """Both robots, which can be restarted with the same command."""

    def __init__(self, out: Path, open_ones: ExitStack, driver_of_a: str = "docs.rover:Rover") -> None:
        self._drivers = {"a": driver_of_a, "b": "docs.rover:Rover"}
        self._out = out
        self._open = open_ones
        self._endpoint = free_endpoint()
        self._air = open_ones.enter_context(beacon())
        (out / "field.toml").write_text(ASSURED)
        self.robots = {name: self._started(name) for name in "ba"}

    def _started(self, name: str) -> TandemProcess:
        return self._open.enter_context(
            TandemProcess(
                *("robot", name, "--mission", self._out / "field.toml", "--driver", self._drivers[name]),
                *("--rate", "4", "--listen" if name == "a" else "--connect", self._endpoint),
                *("--out", self._out / name, "--option", f"state={self._out / f'body-{name}'}"),
                *("--option", f"start={STARTS[name]}", "--option", f"beacon={self._air}"),
                *("--option", "timeout=60"),
            )
        )

    def path(self, name: str, whose: str = "agent") -> Path:
        return self._out / name / f"{whose}-{name}.journal"

    def kill(self, *names: str) -> None:
        """Kill all processes of these robots at once."""
        for name in names:
            self.robots[name].tell(SIGKILL)  # if it is still running
        for name in names:
            self.robots[name].ended()

    def again(self, *names: str) -> None:
        for name in names:
            self.robots[name] = self._started(name)

    def said(self) -> str:
        """Return what both robots have printed, and the sizes of their journals in bytes."""
        return "\n".join(
            [
                f"{name}: {size(self.path(name))} bytes\n{one.out}{one.err}"
                for name, one in self.robots.items()
            ]
        )

    def nobody_is_left(self, name: str) -> None:
        until(lambda: not processes_of((self._out / name).resolve()), f"{name}'s agent has ended")


@pytest.fixture
def two(tmp_path: Path) -> Iterator[Pair]:
    with ExitStack() as open_ones:
        yield Pair(tmp_path, open_ones)


def all_is_well(out: Path, two: Pair) -> None:
    """Assert that both robots end, each tick is journaled once, and audit and replay find nothing."""
    both_have_ended(out, two.robots)
    for name in "ab":
        assert [step.observation.tick for step in told(out, name).steps] == list(
            range(len(told(out, name).steps))
        )
    both = out / "both"
    both.mkdir()
    for name in "ab":
        shutil.copy(two.path(name), both)
    audited = tandem("audit", both)
    assert audited.status == 0, audited.out


@pytest.mark.long
def test_a_result_before_tick_0_does_not_keep_a_killed_robot_from_resuming(tmp_path: Path) -> None:
    """The certificate of the peer suffices to send it. The malformed one after it shows that it was read."""
    endpoint = free_endpoint()
    words = ("robot", "a", "--mission", "paper-1", "--driver", "docs.rover:Rover", "--rate", "10")
    robot = (*words, "--listen", endpoint, "--out", tmp_path)
    claim = TickStart(0, "b", Localised(ORIGIN), complete=True)
    with TandemProcess(*robot) as first:
        first.until_prints("a: in run paper-1, waiting for its peer")
        with stranger_at(endpoint) as link:
            key = keys.tick_start("paper-1", "b")
            peer = session.publisher(link, key)
            for frame in (encode(claim), b"malformed"):
                peer.put(frame)
            first.until_prints(f"tandem robot a: refused a frame on {key}")
        first.tell(SIGKILL)
        first.ended()
    again = tandem(*robot, "--connect-timeout", "2")
    said = again.err.splitlines()[-1]  # on a loaded machine, its own agent may still be starting
    assert re.fullmatch("tandem robot a: (a and )?b: not connected; no robot has moved", said)
    assert again.status == 3


@pytest.mark.long
def test_two_robots_that_lose_power_at_once_resume_from_their_journals(two: Pair, tmp_path: Path) -> None:
    """The last write of each journal is torn. The driver's Observation was never sent."""
    for name in "ab":
        two.robots[name].until_written(two.path(name), 3000)
    two.kill("a", "b")
    for name in "ab":
        two.nobody_is_left(name)
        agents, drivers = two.path(name), two.path(name, "driver")
        torn = agents.read_bytes()
        agents.write_bytes(torn[:-7])
        with drivers.open("ab") as file:
            file.write(msgpack.packb(b"x" * 40)[:20])
    two.again("b", "a")
    all_is_well(tmp_path, two)
    for name in "ab":
        assert "bytes are of a torn write and are cut off" in two.robots[name].err


@pytest.mark.long
def test_a_reading_that_is_lost_with_the_process_is_taken_again(tmp_path: Path) -> None:
    """Neither journal contains it, so it was never sent. The motion before it is reported once."""
    with ExitStack() as open_ones:
        two = Pair(tmp_path, open_ones, "tests.broken_drivers:LosesAReading")
        assert two.robots["a"].ended().status == -SIGKILL
        two.nobody_is_left("a")
        assert len(told(tmp_path, "a").steps) == LosesAReading.TICK
        two.again("a")
        all_is_well(tmp_path, two)
        assert len(told(tmp_path, "a").steps) > LosesAReading.TICK


@pytest.mark.parametrize("fsync", [False, True])
def test_a_recording_that_a_power_cut_may_have_shortened_is_refused(
    fsync: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames that were sent may be missing unless each write was synced. A kill loses no frames."""
    config, inbox = load("paper-1").config("a"), Inbox("robot")
    path = tmp_path / "driver-a.journal"
    driver: Any = SimpleNamespace(stop=lambda: None, resume=lambda *_: None)
    field: Any = SimpleNamespace(resume=lambda *_: None)

    def taken_up() -> DriverHistory:
        with recorded(tmp_path, config, inbox, fsync=fsync) as recording:
            recording.take_up(driver, "any", field)
            observation = Observation(
                recording.history.tick + 1, "a", REST if recording.again else None, 1.0, ()
            )
            recording.journal.write(encode(observation))
            return recording.history

    assert [taken_up().tick for _ in range(3)] == [-1, 0, 1]
    monkeypatch.setattr(driver_journal, "BOOT", tmp_path / "boot")
    (tmp_path / "boot").write_text("another\n")
    before = path.read_bytes()
    if fsync:
        assert taken_up().tick == 2
    else:
        with pytest.raises(CorruptJournal, match=r"written without --fsync, and this computer has restarted"):
            taken_up()
        assert path.read_bytes() == before


@pytest.mark.long
def test_a_robot_that_is_killed_before_it_knows_its_mission_begins_it_and_one_that_has_ended_says_so_again(
    two: Pair, tmp_path: Path
) -> None:
    two.robots["b"].until(lambda: two.path("b", "driver").exists(), "b has opened its journal")
    two.kill("b")
    two.again("b")
    all_is_well(tmp_path, two)
    before = {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()}
    outcome = two.robots["a"].out.splitlines()[-1]
    two.again("a")
    ended = two.robots["a"].ended()
    assert (ended.status, ended.out.splitlines()[-1]) == (0, outcome)
    assert {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()} == before


@pytest.mark.long
def test_a_killed_robot_resumes_and_reports_a_motion_within_its_last_command(
    two: Pair, tmp_path: Path
) -> None:
    """The robot at most completes the current manoeuvre, and then rests."""
    two.robots["a"].until_written(two.path("a"), 2500)
    two.kill("a")
    measured = len(told(tmp_path, "a").steps)
    two.again("a")
    all_is_well(tmp_path, two)  # the peer computes its position from all its Reports
    assert "a: in run field, resumed at tick " in two.robots["a"].out
    steps = told(tmp_path, "a").steps
    assert len(steps) > measured
    for before, step in pairwise(steps):
        assert before.command is not None
        assert step.observation.executed is not None
        assert abs(step.observation.executed.v) <= abs(before.command.v) + 1e-12
        assert abs(step.observation.executed.omega) <= abs(before.command.omega) + 1e-12


@pytest.mark.long
def test_a_recording_of_another_mission_is_refused(two: Pair, tmp_path: Path) -> None:
    two.robots["a"].until_written(two.path("a"), 1500)
    two.kill("a", "b")
    other = tandem(
        *("robot", "a", "--mission", "paper-2", "--driver", "docs.rover:Rover", "--rate", "4"),
        *("--out", tmp_path / "a"),
    )
    assert other.status == 2
    assert "it belongs to another mission: its RobotConfig differs; choose another folder" in other.err


@pytest.mark.long
def test_a_driver_that_cannot_resume_is_refused_and_not_moved(two: Pair, tmp_path: Path) -> None:
    two.robots["a"].until_written(two.path("a"), 1500)
    two.kill("a", "b")
    two.nobody_is_left("a")
    before = {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()}
    ended = tandem(
        *(
            "robot",
            "a",
            "--mission",
            tmp_path / "field.toml",
            "--driver",
            "tests.broken_drivers:CannotResume",
        ),
        *("--rate", "4", "--out", tmp_path / "a"),
    )
    assert ended.status == 2
    assert "has no resume() method; choose another folder" in ended.err
    assert {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()} == before


@pytest.mark.long
def test_a_rover_whose_body_is_not_on_file_is_not_made_up_elsewhere(two: Pair, tmp_path: Path) -> None:
    two.robots["a"].until_written(two.path("a"), 1500)
    two.kill("a", "b")
    two.nobody_is_left("a")
    mission = ("--mission", tmp_path / "field.toml", "--driver", "docs.rover:Rover", "--rate", "4")
    ended = tandem("robot", "a", *mission, "--out", tmp_path / "a")
    assert ended.status == 2
    assert "where the body was is not known without --option state=FILE" in ended.err


@pytest.mark.long
@pytest.mark.parametrize("turn", range(3))
def test_a_robot_that_is_killed_at_any_moment_goes_on(two: Pair, turn: int, tmp_path: Path) -> None:
    """Again and again: each time, once the journals of those that are killed have that number of bytes."""
    for number, amount in enumerate(range(200 + 600 * turn, 8000, 1800)):
        killed = ("a", "b", "ab")[(number + turn) % 3]
        for name in killed:
            path, robot = two.path(name), two.robots[name]
            until(lambda: size(path) >= amount or not robot.running, two.said)  # noqa: B023
        two.kill(*killed)
        two.again(*killed)
    all_is_well(tmp_path, two)


def test_a_rover_that_repeats_a_reading_is_where_it_was(tmp_path: Path) -> None:
    """The wheels do not finish the manoeuvre meanwhile: the peer may have been ranged from there already."""
    config, state = load("paper-1").config("a"), str(tmp_path / "body")
    rover = Rover(config, 1000.0, state=state)
    rover.sense(0)
    rover.drive(1000.0, 0.0)
    first = rover.sense(1)
    place = rover.pose
    again = Rover(config, 1000.0, state=state)
    again.resume(0, ())
    assert again.sense(1) == first
    assert again.pose == place


def test_a_rover_is_parked_for_its_peer_only_at_the_end_of_its_mission() -> None:
    """A peer that was ranged to a restarted rover would pass ticks in which the rover still moves."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as air, ThreadPoolExecutor(1) as pool:
        air.bind(("127.0.0.1", 0))
        air.settimeout(BOUND_S)
        rover = Rover(load("paper-1").config("a"), 1.0, beacon=f"127.0.0.1:{air.getsockname()[1]}")
        rover.stop()  # as after a restart
        reading = pool.submit(rover.sense, 0)
        message, sender = air.recvfrom(1024)
        assert not json.loads(message)["parked"]
        air.sendto(json.dumps({"tick": 0, "ranges": {}}).encode(), sender)
        assert reading.result(BOUND_S).mutual_ranges == {}
        rover.stop()
        until(lambda: json.loads(air.recv(1024))["parked"], "it is parked")
        rover.close()


def test_a_rover_that_is_restarted_after_the_end_of_its_mission_is_parked_for_its_peer(
    tmp_path: Path,
) -> None:
    """The peer may still need a range, and no reading of this process follows."""
    config, state = load("paper-1").config("a"), str(tmp_path / "body")
    Rover(config, 1.0, state=state).sense(0)  # killed after the end, before it was parked
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as air:
        air.bind(("127.0.0.1", 0))
        air.settimeout(BOUND_S)
        again = Rover(config, 1.0, state=state, beacon=f"127.0.0.1:{air.getsockname()[1]}")
        again.stop()
        again.resume(0, ())
        again.stop()  # the end of the mission is in the recording
        assert json.loads(air.recv(1024))["parked"]
        again.close()
