"""A mission is the same through routers, and stopped processes delay it, or the run ends and names them."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from signal import SIGCONT, SIGSTOP
from typing import Any, NamedTuple

import pytest

from agent.process.link import AgentLink
from compose.launch.processes import free_endpoint
from compose.network import KEYED
from compose.scenario.scenario_file import load
from protocol.network import keys, session
from protocol.network.endpoints import Endpoints, at, listening, zenoh_config
from protocol.network.inbox import Inbox
from tests.commands import (
    BOUND_S,
    LONG,
    LONG_JOURNAL_BYTES,
    LONG_TICKS,
    OVER,
    PAPER_1,
    REAL_TIME,
    TandemProcess,
    decided,
    in_one_process,
    process_of,
    processes_of,
    size,
    tandem,
    until,
)
from tests.series import series
from world.process import WorldProcess
from world.simulation import Simulation

ROUTER = [sys.executable, "-m", "tests.router"]
MESHED = [sys.executable, "-m", "tests.meshed"]


class Router(NamedTuple):
    """The configuration of a router: its endpoints, its links, and its keys."""

    listen: str
    connect: tuple[str, ...] = ()
    keys: Path | None = None


@contextmanager
def routing(router: Router, folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Yield the process of a router that is ready."""
    settings: dict[str, Any] = {"mode": "router"}
    if router.keys is not None:
        text = (router.keys / KEYED).read_text().partition("\n")[2]  # without the comment it is JSON
        settings |= json.loads(text)
        folder = router.keys
    settings |= {
        "listen": {"endpoints": [router.listen]},
        "connect": {"endpoints": router.connect},
    }
    settings.setdefault("scouting", {"multicast": {"enabled": False}})
    file = folder / f"router-{router.listen.rpartition(':')[2]}.json"
    file.write_text(json.dumps(settings))
    process = subprocess.Popen([*ROUTER, str(file)], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "routing\n"
        yield process
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def parts(
    scenario: Path, out: Path, flags: Mapping[str, Sequence[str | Path]], stack: ExitStack
) -> dict[str, TandemProcess]:
    """Yield the processes of the world and the agents, each with its own flags."""
    what: dict[str, list[str | Path]]
    what = {"world": ["world", scenario], "a": ["agent", "a"], "b": ["agent", "b"]}
    return {
        name: stack.enter_context(TandemProcess(*what[name], *flags[name], "--out", out, "-q"))
        for name in what
    }


def record_of(text: str, folder: Path) -> dict[str, bytes]:
    """Return the recording of a mission in one process; write its file scenario.toml."""
    (folder / "scenario.toml").write_text(text)
    return decided(in_one_process(folder / "scenario.toml", folder / "local"))


def same(mission: dict[str, TandemProcess], out: Path, expected: dict[str, bytes]) -> None:
    """Check that all processes succeed, and that the recording is the expected one."""
    ended = {name: part.ended() for name, part in mission.items()}
    assert {name: end.status for name, end in ended.items()} == dict.fromkeys(mission, 0), ended
    assert decided(out) == expected


def connect(*endpoints: str) -> list[str | Path]:
    return [word for endpoint in endpoints for word in ("--connect", endpoint)]


def listen(*endpoints: str) -> list[str | Path]:
    return [word for endpoint in endpoints for word in ("--listen", endpoint)]


TOPOLOGIES = (
    "one router",
    "two routers",
    "a router per robot",
    "all linked",
    "the processes' own",
    "two doors",
)


@pytest.mark.parametrize("topology", series(TOPOLOGIES, 2))
@pytest.mark.long
def test_a_mission_through_routers_has_the_recording_of_one_without_a_network(
    topology: str, tmp_path: Path
) -> None:
    expected, out = record_of(PAPER_1, tmp_path), tmp_path / "out"
    x, y, z = (free_endpoint() for _ in range(3))
    match topology:
        case "one router":
            routers = [Router(x)]
            flags = {"world": connect(x), "a": connect(x), "b": connect(x)}
        case "two routers":
            routers = [Router(x), Router(y, (x,))]
            flags = {"world": connect(x), "a": connect(y), "b": connect(y)}
        case "a router per robot":
            routers = [Router(y, (x,)), Router(z, (x,))]
            flags = {"world": listen(x), "a": connect(y), "b": connect(z)}
        case "all linked":
            routers = [Router(x), Router(y, (x,)), Router(z, (x, y))]
            flags = {"world": connect(x), "a": connect(y), "b": connect(z)}
        case "the processes' own":
            routers = []
            flags = {"world": listen(x), "a": [*listen(y), *connect(x)], "b": [*listen(z), *connect(y)]}
        case _:
            routers = [Router(y, (x,))]
            flags = {
                "world": listen(x, z),
                "a": connect(z, free_endpoint()),
                "b": connect(free_endpoint(), y),
            }
    with ExitStack() as stack:
        for router in routers:
            stack.enter_context(routing(router, tmp_path))
        same(parts(tmp_path / "scenario.toml", out, flags, stack), out, expected)


@pytest.mark.parametrize(
    "topology", series(["a router between", "a router on each robot, by the robot's keys"])
)
@pytest.mark.long
def test_a_mission_through_routers_with_access_rules_has_the_same_recording(
    topology: str, tmp_path: Path
) -> None:
    expected, out, keys = record_of(PAPER_1, tmp_path), tmp_path / "out", tmp_path / "keys"
    assert tandem("keys", keys, "--robots", "a,b").status == 0
    x, y, z = (free_endpoint("tls") for _ in range(3))
    if topology == "a router between":
        routers = [Router(x, (), keys / "router")]
        flags = {"world": connect(x), "a": connect(x), "b": connect(x)}
    else:
        routers = [Router(x, (), keys / "router"), Router(y, (x,), keys / "agent-a")]
        flags = {"world": connect(x), "a": connect(y), "b": [*listen(z), *connect(x)]}
    keyed = {"world": keys / "world", "a": keys / "agent-a", "b": keys / "agent-b"}
    with ExitStack() as stack:
        for router in routers:
            stack.enter_context(routing(router, tmp_path))
        whole = {name: [*flags[name], "--keys", keyed[name]] for name in flags}
        same(parts(tmp_path / "scenario.toml", out, whole, stack), out, expected)


@pytest.mark.long
def test_a_router_that_is_killed_and_started_again_changes_nothing(tmp_path: Path) -> None:
    expected, out, x = record_of(LONG, tmp_path), tmp_path / "out", free_endpoint()
    with ExitStack() as stack:
        flags = dict.fromkeys(("world", "a", "b"), connect(x))
        with routing(Router(x), tmp_path):
            mission = parts(tmp_path / "scenario.toml", out, flags, stack)
            mission["world"].until_written(out / "world.journal", LONG_JOURNAL_BYTES // 4)
        assert all(part.running for part in mission.values())
        with routing(Router(x), tmp_path):
            same(mission, out, expected)


@pytest.mark.long
def test_a_router_may_come_last(tmp_path: Path) -> None:
    expected, out, x = record_of(PAPER_1, tmp_path), tmp_path / "out", free_endpoint()
    flags = {"world": connect(x), "a": connect(x), "b": [*listen(free_endpoint()), *connect(x)]}
    with ExitStack() as stack:
        mission = parts(tmp_path / "scenario.toml", out, flags, stack)
        for part in mission.values():
            part.until_prints("nothing listens there; check the address, and that the router runs")
        stack.enter_context(routing(Router(x), tmp_path))
        same(mission, out, expected)


def test_an_agent_that_is_a_router_names_the_endpoint_it_cannot_listen_on() -> None:
    x = free_endpoint()
    with session.open_router(listening(x)):
        ended = tandem("agent", "a", *listen(x), *connect(free_endpoint()))
    assert ended == (2, "", f"tandem agent: --listen: {x}: already in use\n")


def test_a_world_without_its_router_prints_what_to_check_and_gives_up(tmp_path: Path) -> None:
    x = free_endpoint()
    ended = tandem("world", "paper-1", "--connect", x, "--timeout", "1", "--out", tmp_path / "out")
    what = "nothing listens there; check the address, and that the router runs"
    assert ended == (3, "", f"tandem world: no router at {x}; gave up after 1 s: {what}\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_a_world_that_listens_reports_a_missing_router_and_runs(
    tmp_path: Path,
) -> None:
    x, y = free_endpoint(), free_endpoint()
    with TandemProcess("world", "paper-1", *listen(y), *connect(x), "--out", tmp_path) as world:
        world.until_prints(f"no router at {x} yet: nothing listens there")
        robots = [TandemProcess("agent", robot, *connect(y)) for robot in "ab"]
        for robot in robots:
            with robot:
                assert robot.ended(BOUND_S).status == 0
        assert world.ended().status == 0


@pytest.mark.long
def test_routers_that_connect_to_each_other_at_once_do_not_hang_and_end_silently() -> None:
    """With low latency, some of six hang in about every eighth round. Of those that close, 4 % panic."""
    names = "abcdef"
    for _ in range(25):
        endpoints = [free_endpoint() for _ in names]
        with ExitStack() as stack:
            six = [
                stack.enter_context(meshed(name, endpoints[place], *endpoints[:place]))
                for place, name in enumerate(names)
            ]
            for one in six:
                assert one.stdin is not None
                one.stdin.write(f"{' '.join(names)}\n")
                one.stdin.flush()
            for one in six:
                assert one.stdout is not None
                ready, _, _ = select.select([one.stdout], [], [], BOUND_S)
                assert ready, "no answer"
                assert one.stdout.readline() == "linked\n"
            for one in six:
                assert one.stdin is not None
                one.stdin.close()
                one.stdin = None  # as `communicate` expects


@contextmanager
def meshed(name: str, *endpoints: str) -> Iterator[subprocess.Popen[str]]:
    """Yield a router that connects to all but the first of the endpoints, and end it."""
    process = subprocess.Popen(
        [*MESHED, name, *endpoints],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
        assert process.communicate(timeout=BOUND_S) == ("", "")
        assert process.returncode == 0
    finally:
        process.kill()
        process.wait()


def test_only_a_router_that_connects_to_another_one_has_no_low_latency() -> None:
    def low_latency(*, listen: Sequence[str] = (), connect: Sequence[str] = ()) -> object:
        config = zenoh_config(Endpoints(tuple(connect), tuple(listen)))
        return json.loads(config.get_json("transport/unicast/lowlatency"))

    here, there = "tcp/127.0.0.1:7447", "tcp/127.0.0.1:7448"
    assert low_latency(listen=[here])
    assert low_latency(connect=[there])
    assert not low_latency(listen=[here], connect=[there])


NAMES = ("agent a", "agent b", "world")
TIMEOUT_S = 6.0
"""The timeout in s, longer than the lease of Zenoh."""
LOCALISED = f"localised after {LONG_TICKS} ticks\n"


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the scenario file LONG; its recording is in `out` in the same folder."""
    path = tmp_path_factory.mktemp("undisturbed") / "long.toml"
    path.write_text(LONG)
    in_one_process(path, path.parent / "out")
    return path


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
    assert decided(out) == decided(undisturbed.parent / "out")
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
    assert decided(out) == decided(undisturbed.parent / "out")
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
