"""A mission is the same through one router, two, one per robot, an external one, or its own."""

from __future__ import annotations

import json
import select
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from compose.launch.processes import free_endpoint
from compose.network import KEYED
from protocol.network import session
from protocol.network.endpoints import Endpoints, listening, zenoh_config
from tests.commands import BOUND_S, LONG, LONG_JOURNAL_BYTES, PAPER_1, TandemProcess, journals, tandem
from tests.series import series

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
    assert (
        tandem("run", folder / "scenario.toml", "--in-process", "-q", "--out", folder / "local").status == 0
    )
    return journals(folder / "local") | {"ticks.csv": (folder / "local/ticks.csv").read_bytes()}


def same(mission: dict[str, TandemProcess], out: Path, expected: dict[str, bytes]) -> None:
    """Check that all processes succeed, and that the recording is the expected one."""
    ended = {name: part.ended() for name, part in mission.items()}
    assert {name: end.status for name, end in ended.items()} == dict.fromkeys(mission, 0), ended
    assert journals(out) | {"ticks.csv": (out / "ticks.csv").read_bytes()} == expected


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
