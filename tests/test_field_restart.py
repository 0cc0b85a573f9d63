"""`tandem robot`, killed at any moment, resumes from its journals with the same command."""

from __future__ import annotations

import json
import re
import shutil
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from signal import SIGKILL
from types import SimpleNamespace
from typing import Any

import msgpack
import pytest

from compose.hardware.driver_recording import recorded
from compose.launch.processes import free_endpoint
from compose.scenario.scenario_file import load
from docs.rover import Rover
from protocol.journal.journal_file import CorruptJournal
from protocol.messages import Localised, Observation, TickStart
from protocol.motion import ORIGIN, REST
from protocol.network import keys, session
from protocol.network.inbox import Inbox
from protocol.wire import encode
from tests.broken_drivers import LosesAReading
from tests.commands import BOUND_S, TandemProcess, processes_of, size, tandem, until
from tests.storm import stranger_at
from tests.test_field import ASSURED, STARTS, beacon, both_have_ended, told
from world.hardware import driver_journal
from world.hardware.driver_journal import DriverHistory


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
def pair(tmp_path: Path) -> Iterator[Pair]:
    with ExitStack() as open_ones:
        yield Pair(tmp_path, open_ones)


def all_is_well(out: Path, pair: Pair) -> None:
    """Assert that both robots end, each tick is journaled once, and audit and replay find nothing."""
    both_have_ended(out, pair.robots)
    for name in "ab":
        assert [step.observation.tick for step in told(out, name).steps] == list(
            range(len(told(out, name).steps))
        )
    both = out / "both"
    both.mkdir()
    for name in "ab":
        shutil.copy(pair.path(name), both)
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
def test_two_robots_that_lose_power_at_once_resume_from_their_journals(pair: Pair, tmp_path: Path) -> None:
    """The last write of each journal is torn. The driver's Observation was never sent."""
    for name in "ab":
        pair.robots[name].until_written(pair.path(name), 3000)
    pair.kill("a", "b")
    for name in "ab":
        pair.nobody_is_left(name)
        agents, drivers = pair.path(name), pair.path(name, "driver")
        torn = agents.read_bytes()
        agents.write_bytes(torn[:-7])
        with drivers.open("ab") as file:
            file.write(msgpack.packb(b"x" * 40)[:20])
    pair.again("b", "a")
    all_is_well(tmp_path, pair)
    for name in "ab":
        assert "bytes are of a torn write and are cut off" in pair.robots[name].err


@pytest.mark.long
def test_a_reading_that_is_lost_with_the_process_is_taken_again(tmp_path: Path) -> None:
    """Neither journal contains it, so it was never sent. The motion before it is reported once."""
    with ExitStack() as open_ones:
        pair = Pair(tmp_path, open_ones, "tests.broken_drivers:LosesAReading")
        assert pair.robots["a"].ended().status == -SIGKILL
        pair.nobody_is_left("a")
        assert len(told(tmp_path, "a").steps) == LosesAReading.TICK
        pair.again("a")
        all_is_well(tmp_path, pair)
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
    pair: Pair, tmp_path: Path
) -> None:
    pair.robots["b"].until(lambda: pair.path("b", "driver").exists(), "b has opened its journal")
    pair.kill("b")
    pair.again("b")
    all_is_well(tmp_path, pair)
    before = {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()}
    outcome = pair.robots["a"].out.splitlines()[-1]
    pair.again("a")
    ended = pair.robots["a"].ended()
    assert (ended.status, ended.out.splitlines()[-1]) == (0, outcome)
    assert {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()} == before


@pytest.mark.long
def test_a_killed_robot_resumes_and_reports_a_motion_within_its_last_command(
    pair: Pair, tmp_path: Path
) -> None:
    """The robot at most completes the current manoeuvre, and then rests."""
    pair.robots["a"].until_written(pair.path("a"), 2500)
    pair.kill("a")
    measured = len(told(tmp_path, "a").steps)
    pair.again("a")
    all_is_well(tmp_path, pair)  # the peer computes its position from all its Reports
    assert "a: in run field, resumed at tick " in pair.robots["a"].out
    steps = told(tmp_path, "a").steps
    assert len(steps) > measured
    for before, step in pairwise(steps):
        assert before.command is not None
        assert step.observation.executed is not None
        assert abs(step.observation.executed.v) <= abs(before.command.v) + 1e-12
        assert abs(step.observation.executed.omega) <= abs(before.command.omega) + 1e-12


@pytest.mark.long
def test_a_recording_of_another_mission_is_refused(pair: Pair, tmp_path: Path) -> None:
    pair.robots["a"].until_written(pair.path("a"), 1500)
    pair.kill("a", "b")
    other = tandem(
        *("robot", "a", "--mission", "paper-2", "--driver", "docs.rover:Rover", "--rate", "4"),
        *("--out", tmp_path / "a"),
    )
    assert other.status == 2
    assert "it belongs to another mission: its RobotConfig differs; choose another folder" in other.err


@pytest.mark.long
def test_a_driver_that_cannot_resume_is_refused_and_not_moved(pair: Pair, tmp_path: Path) -> None:
    pair.robots["a"].until_written(pair.path("a"), 1500)
    pair.kill("a", "b")
    pair.nobody_is_left("a")
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
def test_a_rover_whose_body_is_not_on_file_is_not_made_up_elsewhere(pair: Pair, tmp_path: Path) -> None:
    pair.robots["a"].until_written(pair.path("a"), 1500)
    pair.kill("a", "b")
    pair.nobody_is_left("a")
    mission = ("--mission", tmp_path / "field.toml", "--driver", "docs.rover:Rover", "--rate", "4")
    ended = tandem("robot", "a", *mission, "--out", tmp_path / "a")
    assert ended.status == 2
    assert "where the body was is not known without --option state=FILE" in ended.err


@pytest.mark.long
@pytest.mark.parametrize("turn", range(3))
def test_a_robot_that_is_killed_at_any_moment_goes_on(pair: Pair, turn: int, tmp_path: Path) -> None:
    """Again and again: each time, once the journals of those that are killed have that number of bytes."""
    for number, amount in enumerate(range(200 + 600 * turn, 8000, 1800)):
        killed = ("a", "b", "ab")[(number + turn) % 3]
        for name in killed:
            path, robot = pair.path(name), pair.robots[name]
            until(lambda: size(path) >= amount or not robot.running, pair.said)  # noqa: B023
        pair.kill(*killed)
        pair.again(*killed)
    all_is_well(tmp_path, pair)


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
