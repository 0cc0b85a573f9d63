"""A stopped process delays the others until it continues, or the run ends and names it."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from signal import SIGCONT, SIGSTOP

import pytest

from agent.process.link import AgentLink
from compose.launch.processes import free_endpoint
from compose.scenario.scenario_file import load
from protocol.network import keys, session
from protocol.network.endpoints import at, listening
from protocol.network.inbox import Inbox
from tests.commands import (
    LONG,
    LONG_TICKS,
    OVER,
    REAL_TIME,
    TandemProcess,
    process_of,
    processes_of,
    size,
    tandem,
    until,
)
from world.process import WorldProcess
from world.simulation import Simulation

NAMES = ("agent a", "agent b", "world")
TIMEOUT_S = 6.0
"""The timeout in s, longer than the lease of Zenoh."""
LOCALISED = f"localised after {LONG_TICKS} ticks\n"


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the scenario file LONG; its recording is in `out` in the same folder."""
    path = tmp_path_factory.mktemp("undisturbed") / "long.toml"
    path.write_text(LONG)
    assert tandem("run", path, "--in-process", "-q", "--out", path.parent / "out").status == 0
    return path


def same(out: Path, undisturbed: Path) -> bool:
    expected = undisturbed.parent / "out"
    ticks = [(folder / "ticks.csv").read_bytes() for folder in (out, expected)]
    return journal_bytes(out) == journal_bytes(expected) and ticks[0] == ticks[1]


def journal_bytes(out: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted(out.glob("*.journal"))]


def give_up() -> None:
    raise AssertionError("the router does not answer")


def states(pid: int) -> set[str]:
    """Return the states of all threads of a process; T means stopped."""
    found = set()
    for task in Path(f"/proc/{pid}/task").iterdir():
        with suppress(FileNotFoundError, ProcessLookupError):  # this thread has ended meanwhile
            found.add((task / "stat").read_text().rpartition(")")[2].split()[0])
    return found


def stop(pid: int) -> None:
    os.kill(pid, SIGSTOP)
    until(lambda: states(pid) == {"T"}, "it has stopped")


@pytest.fixture
def assured(tmp_path: Path) -> Path:
    """Return a scenario of the `assured` planner, which tolerates stops."""
    path = tmp_path / "assured.toml"
    path.write_text(REAL_TIME)
    return path


@contextmanager
def watched(out: Path, name: str) -> Iterator[Inbox]:
    """Yield an inbox with the liveliness of the process `name` as another session observes it."""
    words = next(words for words in processes_of(out).values() if "world" in words)
    option = {word: words[place + 1] for place, word in enumerate(words) if word in ("--listen", "--run")}
    run = option["--run"]
    inbox = Inbox("a bystander")
    with session.open_client(at(option["--listen"]), lambda: None) as link:
        robot = name.removeprefix("agent ")
        key = keys.world_alive(run) if name == "world" else keys.robot_alive(run, robot)
        session.watch_liveliness(link, key, inbox)
        until(lambda: inbox.next(0.0).topic == "alive", f"{name} is alive")
        yield inbox


def given_up(bystander: Inbox) -> bool:
    return bystander.next(0.1).topic == "gone"


# --- lockstep -----------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_run_continues_after_each_process_is_suspended_for_a_moment(
    undisturbed: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with TandemProcess("run", undisturbed, "--out", out, "-q") as run:
        run.until_written(out / "world.journal", 2_000)
        stop(process_of(out, "world"))  # the run waits until its processes are found
        pids = [process_of(out, *name.split()) for name in NAMES]
        os.kill(pids[NAMES.index("world")], SIGCONT)
        for turn in range(9):
            run.until_written(out / "world.journal", 2_000 + 8_000 * turn)
            pid = pids[turn % 3]
            stop(pid)
            written = size(out / "world.journal")
            os.kill(pid, SIGCONT)
            run.until_written(out / "world.journal", written + 1)
        assert run.ended() == (0, LOCALISED, "")
    assert same(out, undisturbed)
    assert not processes_of(out)


@pytest.mark.parametrize("name", ["agent a", "world"])
@pytest.mark.long
def test_a_process_suspended_until_its_link_times_out_continues(
    name: str, undisturbed: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with TandemProcess("run", undisturbed, "--out", out, "-q") as run:
        run.until_written(out / "world.journal", 2_000)
        pid, other = [process_of(out, *one.split()) for one in (name, "agent b")]
        stop(other)  # the run waits until it is watched
        with watched(out, name) as bystander:
            stop(pid)
            os.kill(other, SIGCONT)
            until(lambda: given_up(bystander), "its link is given up")
        written = size(out / "world.journal")
        assert written < size(undisturbed.parent / "out" / "world.journal"), "it was stopped too late"
        os.kill(pid, SIGCONT)
        ended = run.ended()
    assert ended[:2] == (0, LOCALISED), ended
    assert same(out, undisturbed)
    assert not processes_of(out)


@pytest.mark.long
def test_a_world_suspended_for_longer_than_the_timeout_fails_the_run(
    undisturbed: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with TandemProcess("run", undisturbed, "--out", out, "-q", "--timeout", str(TIMEOUT_S)) as run:
        run.until_written(out / "world.journal", 2_000)
        stop(process_of(out, "world"))
        ended = run.ended()
    assert ended.status == 3, ended
    assert f"nothing received from the world for {TIMEOUT_S:g} s" in ended.out + ended.err
    assert not processes_of(out)


@pytest.mark.long
def test_a_link_over_which_nothing_comes_is_replaced_by_another() -> None:
    endpoint, config, inbox = free_endpoint(), load("paper-1").config("a", None), Inbox("a mute world")
    with session.open_router(listening(endpoint)) as link:
        session.watch_liveliness(link, keys.robot_alive("mute", "a"), inbox)
        session.answer(link, keys.config("mute", "*"), lambda *_: config)
        _token = session.show_alive(link, keys.world_alive("mute"))
        with TandemProcess("agent", "a", "--connect", endpoint, "--timeout", "20") as agent:
            for topic in ("alive", "gone", "alive"):
                until(lambda topic=topic: inbox.next(0.1).topic == topic, f"a is {topic}")  # type: ignore[misc]
                assert agent.running


class Unlinked:
    """A switch that makes sessions list no router, as a reconnected one occasionally does for ever."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.on = False
        monkeypatch.setattr(session, "linked", lambda _session: not self.on)


def repeated(put: Callable[[], None], stop: threading.Event) -> None:
    while not stop.wait(0.05):
        put()


@contextmanager
def repeating(put: Callable[[], None]) -> Iterator[None]:
    """Call `put` again and again in another thread."""
    stop = threading.Event()
    thread = threading.Thread(target=repeated, args=(put, stop))
    thread.start()
    yield
    stop.set()
    thread.join()


@pytest.mark.long
def test_an_agent_s_session_that_receives_and_cannot_send_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint, inbox, unlinked = free_endpoint(), Inbox("agent a"), Unlinked(monkeypatch)
    link = AgentLink(load("paper-1").config("a", None), "mute", inbox)
    with (
        session.open_router(listening(endpoint)) as world,
        session.open_client(at(endpoint), give_up) as client,
    ):
        link.attach(client)
        observation = session.publisher(world, keys.observation("mute", "a"))
        with repeating(lambda: observation.put(b"again")):
            over = time.monotonic() + 2.5 * session.LINK_CHECK_S
            while time.monotonic() < over:
                link.next(over)
            unlinked.on = True
            with pytest.raises(session.LinkLost):
                until(lambda: link.next(time.monotonic() + 1.0).topic == "gone", "the session is lost")


def test_a_world_s_session_that_receives_and_cannot_send_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint, inbox, unlinked = free_endpoint(), Inbox("world"), Unlinked(monkeypatch)
    process = WorldProcess(Simulation(load("paper-1")), "mute", inbox)
    with (
        session.open_router(listening(endpoint)) as robot,
        session.open_client(at(endpoint), give_up) as client,
    ):
        process.attach(client, replaceable=True)
        unlinked.on = True
        command = session.publisher(robot, keys.command("mute", "a"))
        with repeating(lambda: command.put(b"again")), pytest.raises(session.LinkLost):
            process.run()


# --- in real time -------------------------------------------------------------------------------------


@pytest.mark.long
def test_in_real_time_a_world_that_is_stopped_goes_on(assured: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with TandemProcess("run", assured, "--rate", "20", "--out", out, "-q") as run:
        run.until_written(out / "world.journal", 1500)
        pid = process_of(out, "world")
        with watched(out, "world") as bystander:
            stop(pid)
            until(lambda: given_up(bystander), "its link is given up")
        os.kill(pid, SIGCONT)
        ended = run.ended()
    assert ended.status in OVER, ended
    assert not processes_of(out)
