"""Hardware mode: robots with their own drivers, each in a process of its own, localise themselves."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from signal import SIGCONT, SIGINT, SIGKILL, SIGSTOP

import pytest
from msgspec.structs import replace

from agent.process.agent_journal import AgentHistory, agent_history
from compose.launch.processes import free_endpoint
from compose.scenario.scenario_file import load
from docs.rover import Rover
from protocol.journal import journal_file
from protocol.messages import Command, OfRobot
from protocol.motion import REST
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from tests.commands import OVER, PAPER_1, Ended, TandemProcess, process_of, processes_of, refused, tandem

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
def pair(out: Path, *more: str | Path, protocol: str = "tcp") -> Iterator[dict[str, TandemProcess]]:
    """Yield both robots of paper-1's geometry, running."""
    (out / "field.toml").write_text(ASSURED)
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
