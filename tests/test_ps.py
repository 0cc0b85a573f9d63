"""`tandem ps`: its list of missions that run, wait or have ended, which it does not disturb."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from signal import Signals
from typing import Any

import pytest
import zenoh

from compose.launch.processes import free_endpoint
from compose.scenario.scenario_file import load
from protocol.messages import Cause, Command, MissionEnd, Observation
from protocol.network import keys, session
from protocol.network.endpoints import at, listening
from protocol.wire import VERSION, encode
from tests.commands import BOUND_S, ENDLESS, TandemProcess, several_pairs, tandem, until, world
from tests.test_topologies import Router, routing


def listed(endpoint: str, *flags: str | Path) -> list[str]:
    """Return the lines of a successful listing."""
    ended = tandem("ps", "--connect", endpoint, *flags)
    assert (ended.status, ended.err) == (0, "")
    return ended.out.splitlines()


def told(endpoint: str, *flags: str | Path) -> list[dict[str, Any]]:
    """Return a successful listing as JSON."""
    found: list[dict[str, Any]] = json.loads("\n".join(listed(endpoint, "--json", *flags)))["missions"]
    return found


def test_a_mission_is_a_line_and_so_is_each_robot_there_or_not(tmp_path: Path) -> None:
    with world("paper-1", "--run", "mine") as (_, endpoint), ExitStack() as stack:
        assert listed(endpoint) == [
            f"mine at {endpoint}, tick 0, missing: a, b",
            "  a  not connected",
            "  b  not connected",
        ]
        a = stack.enter_context(TandemProcess("agent", "a", "--connect", endpoint, "--out", tmp_path))
        a.until_answered("a", tmp_path)
        assert listed(endpoint) == [
            f"mine at {endpoint}, tick 0, missing: b",
            "  a  tick 0, phase 1, straight",
            "  b  not connected",
        ]


@pytest.mark.long
def test_a_running_mission_is_listed_as_json_with_all_known_values(tmp_path: Path) -> None:
    (tmp_path / "endless.toml").write_text(ENDLESS)
    with world(tmp_path / "endless.toml", "--run", "mine") as (_, endpoint), ExitStack() as stack:
        for robot in "ab":
            stack.enter_context(TandemProcess("agent", robot, "--connect", endpoint, "--out", tmp_path))
        until(lambda: all(one["tick"] for one in told(endpoint)), "it runs")
        (mission,) = told(endpoint)
    assert {name: mission[name] for name in ("run", "at", "world", "outcome", "versions", "missing")} == {
        "run": "mine",
        "at": endpoint,
        "world": True,
        "outcome": None,
        "versions": [VERSION],
        "missing": [],
    }
    assert mission["tick"] > 0
    assert [one["robot"] for one in mission["robots"]] == ["a", "b"]
    for one in mission["robots"]:
        assert one["there"] is True
        assert one["tick"] > 0
        assert one["phase"] in (1, 2, 3)
        assert one["state"]


def test_robots_of_all_pairs_are_named_though_none_is_there(tmp_path: Path) -> None:
    (tmp_path / "pairs.toml").write_text(several_pairs(3))
    with world(tmp_path / "pairs.toml") as (_, endpoint):
        (mission,) = told(endpoint)
    assert [one["robot"] for one in mission["robots"]] == list("abcdef")
    assert mission["missing"] == list("abcdef")


@pytest.mark.long
def test_missions_of_several_endpoints_are_listed() -> None:
    with world("paper-1", "--run", "one") as (_, here), world("paper-1", "--run", "other") as (_, there):
        missions = told(here, "--connect", there)
    assert [(mission["run"], mission["at"]) for mission in missions] == [("one", here), ("other", there)]


@pytest.mark.long
def test_robots_whose_world_has_gone_are_listed_and_it_is_missing(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    with routing(Router(endpoint), tmp_path), ExitStack() as stack:
        part = stack.enter_context(TandemProcess("world", "paper-1", "--connect", endpoint, "--run", "mine"))
        a = stack.enter_context(TandemProcess("agent", "a", "--connect", endpoint, "--out", tmp_path))
        a.until_answered("a", tmp_path)
        part.tell(Signals.SIGKILL)
        a.until_prints("the world has gone")
        assert listed(endpoint) == [
            f"mine at {endpoint}, no tick within 2 s, missing: its world",
            "  a  connected, no message within 2 s",
        ]


def test_a_network_without_a_mission_is_reported() -> None:
    endpoint = free_endpoint()
    with session.open_router(listening(endpoint)):
        assert listed(endpoint) == [f"no mission at {endpoint}"]
        assert told(endpoint) == []


@pytest.mark.long
def test_an_endpoint_without_an_answer_is_reported_next_to_one_with_an_answer() -> None:
    nowhere = free_endpoint()
    with world("paper-1", "--run", "mine") as (_, endpoint):
        ended = tandem("ps", "--connect", nowhere, "--connect", endpoint)
    assert ended.status == 3
    why = "nothing listens there; check the address, and that the router runs"
    assert ended.err == f"tandem ps: no router at {nowhere}: {why}\n"
    assert ended.out.startswith(f"mine at {endpoint}, tick 0")


def test_a_viewer_lists_over_tls_what_there_is(tmp_path: Path) -> None:
    folder, endpoint = tmp_path / "keys", free_endpoint("tls")
    assert tandem("keys", folder, "--robots", "a,b").status == 0
    arguments = ("world", "paper-1", "--run", "mine", "--listen", endpoint, "--keys", folder / "world")
    with TandemProcess(*arguments) as part:
        part.until_prints("waiting for")
        assert listed(endpoint, "--keys", folder / "viewer")[0] == (
            f"mine at {endpoint}, tick 0, missing: a, b"
        )
        ended = tandem("ps", "--connect", endpoint, "--keys", folder / "agent-a")
    assert ended.status == 2
    assert ended.err.endswith("is the folder of agent-a, not of viewer\n")


# --- simulated worlds -----------------------------------------------------------------------------------


class Played:
    """A simulated world and agent of robot a, both in this process."""

    def __init__(self, link: zenoh.Session) -> None:
        self.link = link
        self.frames: dict[str, bytes] = {}
        """frames by key, which are sent repeatedly"""
        self.tokens: list[zenoh.LivelinessToken] = []
        self.wanted = threading.Event()
        """set when a subscriber for the truth or an estimate exists"""


@contextmanager
def played(start: Callable[[Played], None]) -> Iterator[tuple[Played, str]]:
    """Yield a mission run by an unrelated program, and its endpoint."""
    endpoint = free_endpoint()
    with session.open_router(listening(endpoint)) as link:
        mission, over = Played(link), threading.Event()
        start(mission)
        costly = [session.publisher(link, key) for key in (keys.truth("r"), keys.estimate("r", "a"))]
        for one in costly:
            session.on_matching(one, lambda wanted: mission.wanted.set() if wanted else None)

        def say() -> None:
            while not over.wait(0.02):
                for key, frame in mission.frames.items():
                    link.put(key, frame)

        saying = threading.Thread(target=say)
        saying.start()
        try:
            yield mission, endpoint
        finally:
            over.set()
            saying.join()


def alive(mission: Played) -> None:
    for key in (keys.world_alive("r"), keys.robot_alive("r", "a")):
        mission.tokens.append(session.show_alive(mission.link, key))


def running(mission: Played) -> None:
    alive(mission)
    mission.frames = {
        keys.observation("r", "a"): encode(Observation(7, "a", None, None)),
        keys.command("r", "a"): encode(Command(7, "a", 0.0, 0.0, 2, "orbiting")),
    }


def over(mission: Played) -> None:
    alive(mission)
    mission.frames = {
        keys.observation("r", "a"): encode(MissionEnd(9, "undecided", (Cause("dead", ("a",), (1,)),))),
        keys.command("r", "a"): encode(Command(9, "a", 0.0, 0.0, 3, "undecided")),
    }


def driven(mission: Played) -> None:
    """Run the mission as in hardware mode for a: only the RobotConfig names b."""
    running(mission)
    session.answer(mission.link, keys.config("r", "a"), lambda *_: load("paper-1").config("a"))


def foreign(mission: Played) -> None:
    running(mission)
    mission.frames = {key: bytes([VERSION + 1]) + frame[1:] for key, frame in mission.frames.items()}


@pytest.mark.parametrize(
    ("start", "timeout", "lines"),
    [
        (running, "60", ["tick 7", "tick 7, phase 2, orbiting"]),
        (over, "60", ["tick 9, over: undecided", "tick 9, phase 3, undecided"]),
        (alive, "0.5", ["no tick within 0.5 s", "connected, no message within 0.5 s"]),
        (
            foreign,
            "2",
            [
                f"no tick within 2 s, protocol version {VERSION + 1} instead of {VERSION}",
                "connected, no message within 2 s",
            ],
        ),
    ],
)
def test_published_values_are_listed_and_others_are_reported_as_unknown(
    start: Callable[[Played], None], timeout: str, lines: list[str]
) -> None:
    with played(start) as (_, endpoint):
        assert listed(endpoint, "--timeout", timeout) == [
            f"r at {endpoint}, {lines[0]}",
            f"  a  {lines[1]}",
        ]


def test_a_peer_that_sends_nothing_is_missing() -> None:
    with played(driven) as (_, endpoint):
        assert listed(endpoint) == [
            f"r at {endpoint}, tick 7, missing: b",
            "  a  tick 7, phase 2, orbiting",
            "  b  not connected",
        ]


def test_ps_does_not_subscribe_to_the_truth_or_to_estimates() -> None:
    with played(running) as (mission, endpoint):
        assert "tick 7" in listed(endpoint)[0]
        assert not mission.wanted.is_set()
        with session.open_client(at(endpoint), unreachable) as page:  # which does
            listens = page.declare_subscriber(keys.truth("r"))  # until it is forgotten
            assert mission.wanted.wait(BOUND_S)
            del listens


def unreachable() -> None:
    raise AssertionError("the router does not answer")
