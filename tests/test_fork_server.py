"""Robots and worlds are forked from one process, and behave like processes that are started separately."""

from __future__ import annotations

import ctypes
import gc
import os
import re
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from signal import SIGKILL, SIGSTOP, SIGTERM

import pytest

from compose.errors import UserError
from compose.launch import forked, supervisor
from compose.launch.forked import ForkServer
from compose.launch.processes import free_endpoint
from compose.launch.supervisor import Supervisor
from protocol.network import keys, session
from protocol.network.endpoints import at, listening
from protocol.network.inbox import Inbox
from tests.commands import (
    BOUND_S,
    OVER,
    TandemProcess,
    journals,
    process_of,
    processes_of,
    several_pairs,
    tandem,
    until,
    world,
)
from tests.series import series

ON_LINUX = pytest.mark.skipif(sys.platform != "linux", reason="a feature of Linux")
CAP_SYS_ADMIN, CAP_SYS_RESOURCE = 21, 24
"""<linux/capability.h>"""
PR_CAPBSET_DROP = 24
"""<sys/prctl.h>"""
NAMES = ("world", "agent a", "agent b")


def children_of(process: int) -> list[str]:
    return Path(f"/proc/{process}/task/{process}/children").read_text().split()


def parent_of(pid: int) -> int:
    stat = Path(f"/proc/{pid}/stat").read_text()
    return int(stat.rpartition(")")[2].split()[1])


def fork_servers_of(launcher: int) -> list[int]:
    """Return the ids of the launcher's fork servers, including those that are still importing."""
    found = []
    for pid in map(int, filter(str.isdigit, os.listdir("/proc"))):
        try:
            words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace")
            if re.search("fork.server", words) and parent_of(pid) == launcher:
                found.append(pid)
        except OSError:  # it has ended meanwhile
            continue
    return found


def gone(pid: int) -> bool:
    return not Path(f"/proc/{pid}").exists()


# --- separate processes ---------------------------------------------------------------------------------


@pytest.mark.long
def test_each_has_its_own_session_and_group_and_is_named_in_ps(endless: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with TandemProcess("run", endless, "--out", out, "-q") as run:
        run.until_written(out / "world.journal", 5_000)
        (server,) = fork_servers_of(run.pid)
        for name in NAMES:
            pid = process_of(out, "tandem", *name.split())
            assert pid == os.getpgid(pid) == os.getsid(pid)
            assert parent_of(pid) == server
            assert os.readlink(f"/proc/{pid}/fd/1") == os.devnull
            assert not [
                link
                for link in Path(f"/proc/{pid}/fd").iterdir()
                if link.name == "0" and not os.readlink(link).startswith("socket:")
            ]
    assert not processes_of(out)


def test_each_forked_process_has_its_own_status_and_output() -> None:
    server = ForkServer("compose.cli.warm_up:missions")
    try:
        ended: list[int] = []
        wrong = server.start("compose.cli.main:main", "tandem", "agent", "?", on_end=lambda: ended.append(1))
        mute = server.start(
            "compose.cli.main:main", "tandem", "agent", "a", "--connect", free_endpoint(), "--launched"
        )
        assert wrong.wait(BOUND_S)
        until(lambda: ended, "its end is told")
        mute.signal(SIGKILL)
        assert mute.wait(BOUND_S)
        assert not mute.running
        assert wrong.stderr_text.startswith("tandem agent: argument ID: '?'")
        assert mute.stderr_text == ""
        assert (wrong.end(), mute.end()) == (2, -SIGKILL)
    finally:
        server.close()


# --- no process is left running -------------------------------------------------------------------------


def test_a_run_whose_fork_server_is_killed_reports_it_and_leaves_no_process(
    endless: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with TandemProcess("run", endless, "--out", out, "-q") as run:
        run.until_written(out / "world.journal", 5_000)
        (server,) = fork_servers_of(run.pid)
        os.kill(server, SIGKILL)
        ended = run.ended()
    assert ended.status == 3
    said = r"tandem run: failed: (world|agent [ab]) was killed: the fork server was killed by signal 9\n"
    assert re.fullmatch(said, ended.err), ended
    assert not processes_of(out)


@pytest.mark.long
def test_a_run_whose_fork_server_is_stopped_can_be_stopped_all_the_same(
    endless: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with TandemProcess("run", endless, "--out", out, "-q") as run:
        run.until_written(out / "world.journal", 5_000)
        (server,) = fork_servers_of(run.pid)
        os.kill(server, SIGSTOP)
        run.tell(signal.SIGINT)
        assert run.ended().status == 130
    assert not processes_of(out)


@pytest.mark.long
def test_a_run_whose_fork_server_is_suspended_comes_to_its_end() -> None:
    with TandemProcess("run", "paper-1", "--rate", "20") as run:
        until(lambda: fork_servers_of(run.pid), "there is a fork server")
        (server,) = fork_servers_of(run.pid)
        until(lambda: len(children_of(server)) == 3, "all processes run")
        os.kill(server, SIGSTOP)
        ended = run.ended()
    assert ended.status in OVER
    assert "paper-1: " in ended.out


@pytest.mark.parametrize("server_too", [False, pytest.param(True, marks=ON_LINUX)])
@pytest.mark.long
def test_processes_that_are_stopped_end_too_when_their_launcher_is_killed(
    server_too: bool, endless: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with TandemProcess("run", endless, "--out", out, "-q") as run:
        run.until_written(out / "world.journal", 5_000)
        (server,) = fork_servers_of(run.pid)
        for name in NAMES:
            os.kill(process_of(out, *name.split()), SIGSTOP)
        if server_too:
            os.kill(server, SIGSTOP)
        os.kill(run.pid, SIGKILL)
        until(lambda: not processes_of(out) and gone(server), "all have ended")


@pytest.mark.parametrize("number", series([signal.SIGKILL, signal.SIGTERM]), ids=["SIGKILL", "SIGTERM"])
def test_a_fork_server_that_still_imports_ends_with_its_launcher(
    number: signal.Signals, endless: Path, tmp_path: Path
) -> None:
    with TandemProcess("run", endless, "--out", tmp_path / "out", "-q") as run:
        run.until(lambda: fork_servers_of(run.pid), "it has a fork server")
        servers = fork_servers_of(run.pid)
        os.kill(run.pid, number)
        until(lambda: all(map(gone, servers)), "the fork server has ended")
    assert not processes_of(tmp_path / "out")


def never_end() -> None:
    """Warm up a fork server that imports for ever."""
    threading.Event().wait()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL], ids=["SIGTERM", "SIGKILL"])
def test_a_process_whose_fork_server_still_imports_can_be_stopped_at_once(number: signal.Signals) -> None:
    server = ForkServer("tests.test_fork_server:never_end")
    try:
        first, second = (server.start("os:abort", name) for name in ("first", "second"))
        first.signal(number)
        assert not first.running
        with pytest.raises(EOFError):
            first.receive(BOUND_S)
        assert first.end() == -number
        assert second.running
        assert not server.gone
    finally:
        second.signal(signal.SIGKILL)
        second.end()
        server.close()


def test_a_process_that_was_stopped_before_it_began_does_not_begin_later() -> None:
    server = ForkServer("compose.cli.warm_up:missions")
    try:
        os.kill(server.pid, SIGSTOP)
        unborn = server.start("threading:main_thread", "unborn")
        unborn.terminate()
        assert unborn.end() == -signal.SIGTERM
        os.kill(server.pid, signal.SIGCONT)
        assert server.start("threading:main_thread", "next").end(BOUND_S) == 0
        until(lambda: not children_of(server.pid), "no process is left")
        assert not server.gone
    finally:
        server.close()


@pytest.mark.long
def test_no_fork_server_outlasts_a_run() -> None:
    with TandemProcess("run", "paper-1", "-q") as run:
        run.until(lambda: fork_servers_of(run.pid), "it has a fork server")
        servers = fork_servers_of(run.pid)
        assert run.ended().status == 0
        assert all(map(gone, servers))


def let_another_thread_take_signals() -> None:
    """Warm up a fork server whose main thread no signal on the end of a child interrupts."""
    threading.Thread(target=threading.Event().wait, daemon=True).start()
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGCHLD])


def test_the_end_of_a_process_is_reported_whichever_thread_takes_the_signal() -> None:
    server = ForkServer("tests.test_fork_server:let_another_thread_take_signals")
    for _ in range(3):
        process = server.start("os:getpid", "one that ends at once")
        assert process.wait(BOUND_S)
        assert process.end() == 0
    assert not server.gone
    server.close()


@pytest.mark.filterwarnings("error::ResourceWarning")
def test_a_fork_server_that_takes_the_place_of_another_leaves_nothing_open() -> None:
    first = forked.fork_server("os:getpid")
    first.kill()
    until(partial(getattr, first, "gone"), "its end is noticed")
    second = forked.fork_server("os:getpid")
    assert second is not first
    assert forked.fork_server("os:getpid") is second
    del first
    gc.collect()
    second.kill()
    until(lambda: second.gone, "its end is noticed")


def test_a_fork_server_that_cannot_start_prints_the_reason_in_one_line() -> None:
    server = ForkServer("nowhere:nothing")
    process = server.start("compose.cli.main:main", "tandem")
    assert process.wait(BOUND_S)
    assert process.status == -SIGKILL
    assert server.gone
    assert server.why_gone() == (
        "the fork server ended with status 1: ModuleNotFoundError: No module named 'nowhere'"
    )
    server.close()


CROWD = """
import os, resource, signal, socket, threading
from compose.launch.forked import ForkServer

server = ForkServer("os:getpid")
resource.setrlimit(resource.RLIMIT_NOFILE, (70, 70))
os.kill(server.pid, signal.SIGSTOP)
ours, its = socket.socketpair()
socket.send_fds(ours, [b"others"], [0] * 60)
threading.Timer(0.5, its.close).start()
crowd = [server.start("os:getpid", "one of a crowd") for _ in range(15)]
print({process.end(30.0) for process in crowd})
server.close()
"""


def without_privileges() -> None:
    """Drop the two capabilities that exempt a process from the limit of descriptors in flight."""
    for capability in (CAP_SYS_ADMIN, CAP_SYS_RESOURCE):
        ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)  # fails if there is none to drop


@ON_LINUX
def test_no_process_is_forgotten_where_its_user_may_have_no_more_descriptors_under_way() -> None:
    ran = subprocess.run(
        [sys.executable, "-c", CROWD],
        preexec_fn=without_privileges,
        capture_output=True,
        text=True,
        timeout=100.0,
        check=False,
    )
    assert (ran.stdout, ran.stderr) == ("{0}\n", "")


# --- many robots ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("pairs", [10, pytest.param(100, marks=pytest.mark.long)])
def test_as_many_robots_as_you_like_localise_as_processes_as_they_do_in_one(
    pairs: int, tmp_path: Path
) -> None:
    path = tmp_path / "pairs.toml"
    path.write_text(several_pairs(pairs))
    assert tandem("run", path, "-q", "--out", tmp_path / "processes").status == 0
    assert tandem("run", path, "-q", "--out", tmp_path / "one", "--in-process").status == 0
    assert len(journals(tmp_path / "one")) == 2 * pairs + 1
    assert journals(tmp_path / "processes") == journals(tmp_path / "one")


@pytest.mark.long
def test_a_robot_that_has_answered_gets_fewer_repetitions(tmp_path: Path) -> None:
    path = tmp_path / "pairs.toml"
    path.write_text(several_pairs(2))
    heard: Counter[str] = Counter()
    with (
        world(path, "--run", "mine") as (_, endpoint),
        session.open_client(at(endpoint), lambda: None) as link,
        TandemProcess("agent", "c", "--connect", endpoint, "--out", tmp_path / "c") as c,
        TandemProcess("agent", "d", "--connect", endpoint, "--out", tmp_path / "d") as d,
    ):
        c.until_answered("c", tmp_path / "c")
        d.until_answered("d", tmp_path / "d")
        inbox = Inbox("a bystander")
        session.subscribe(link, keys.observation("mine", "*"), inbox, "observation")
        while heard["a"] < 12:
            heard[inbox.next(10.0).source.robot] += 1
    assert heard["b"] >= 11
    assert 1 <= heard["c"] <= 5
    assert 1 <= heard["d"] <= 5


def test_a_question_that_nobody_answers_in_time_is_not_refused() -> None:
    endpoint = free_endpoint()
    asked: list[object] = []
    with (
        session.open_router(listening(endpoint)) as router,
        session.open_client(at(endpoint), lambda: None) as link,
    ):
        router.declare_queryable("tandem/slow", asked.append)
        until(lambda: session.ask(link, "tandem/slow", 0.2) is None and asked, "it is asked, in vain")
        assert session.ask(link, "tandem/slow", 0.2) is None


def test_a_process_whose_arguments_are_too_long_is_refused_and_the_server_goes_on() -> None:
    server = forked.fork_server("os:getpid")
    with pytest.raises(
        UserError, match=r"^agent a: its arguments have \d+ bytes; at most 131072 are passed$"
    ):
        server.start("os:getpid", "tandem", "agent", "a", *["--kill", "journal@1"] * 10_000)
    assert not server.gone


SLEEPS = "signal:pause"
"""The function of a child that does nothing until a signal ends it."""


@pytest.fixture
def children() -> Iterator[Supervisor]:
    """Yield a supervisor, whose children do not outlast the test."""
    supervised = Supervisor(Inbox("test"))
    yield supervised
    supervised.stop()


def test_children_end_by_one_sigterm_and_one_that_ignores_it_is_killed(
    children: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    obedient = children.start("obedient", main=SLEEPS)
    monkeypatch.setattr(supervisor, "STOP_S", BOUND_S)
    children.stop()
    assert obedient.status == -SIGTERM
    stubborn = children.start("stubborn", main="tests.misbehaving:stubborn")
    assert stubborn.receive(BOUND_S) == b"ready"
    monkeypatch.setattr(supervisor, "STOP_S", 0.2)
    children.stop()
    assert stubborn.status == -SIGKILL


def test_a_child_that_does_not_read_what_it_is_sent_is_killed(
    children: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forked, "SEND_S", 0.2)
    deaf = children.start("deaf", main=SLEEPS)
    deaf.send(bytes(1 << 20))  # more than a socket holds
    assert deaf.wait(BOUND_S)
    assert deaf.status == -SIGKILL


def test_a_child_is_restarted_when_it_is_due_and_its_end_is_reported_by_name(children: Supervisor) -> None:
    children.start("a", main=SLEEPS).kill()
    assert children.next_end(BOUND_S) == "a"
    children.start_later(0.01, lambda: children.start("a", main="os:getpid"))
    assert children.next_end(BOUND_S) == "a"
    assert children["a"].status == 0
    assert children.next_end(0.0) is None


def test_a_start_that_is_cancelled_does_not_happen(children: Supervisor) -> None:
    children.start_later(0.0, lambda: children.start("a", main="os:getpid"))
    children.cancel_starts()
    assert children.next_end(0.1) is None
