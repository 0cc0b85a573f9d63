"""Frames, tokens and queries under any key end no process and change no decision."""

from __future__ import annotations

import inspect
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
from hypothesis import example, given
from hypothesis import strategies as st

from compose.scenario.scenario_file import load
from protocol.messages import Command, Observation, Report
from protocol.motion import ORIGIN
from protocol.network import keys, session
from protocol.network.endpoints import listening
from protocol.network.inbox import COMPLAINTS, NO_ARRIVAL, Arrival, Inbox, Interrupted
from protocol.wire import encode
from tests.commands import BOUND_S, TandemProcess, several_pairs, tandem, until, world
from tests.storm import stranger_at

RUN = "mine"
NAMED = {"run": RUN, "robot": "a", "peer": "b"}
KEYS = {
    kind.__name__: kind(*[NAMED[name] for name in inspect.signature(kind).parameters])
    for kind in keys.KEY_RULES
}

by_kind = pytest.mark.parametrize("kind", keys.KEY_RULES, ids=lambda kind: str(kind.__name__))


# --- the parser ---------------------------------------------------------------------------------------


@by_kind
def test_a_key_names_its_kind_run_robot_and_peer(kind: Callable[..., str]) -> None:
    named = {name: NAMED[name] for name in inspect.signature(kind).parameters}
    assert keys.parse(kind(**named)) == keys.Key(kind, **named)


def spoilt(key: str) -> Iterator[str]:
    """Yield invalid keys that resemble `key`."""
    chunks = key.split("/")
    for i, chunk in enumerate(chunks):
        for other in (
            "*",
            "**",
            f"{chunk[:1]}$*",
            "",
            " ",
            "@x",
            "ä",
            "\u202e",
            "a\n",
            "-a",
            "a.b",
            "a" * 65,
        ):
            yield "/".join([*chunks[:i], other, *chunks[i + 1 :]])
        yield "/".join([*chunks[:i], *chunks[i + 1 :]])
        yield "/".join([*chunks[:i], chunk, chunk, *chunks[i + 1 :]])
    yield from (
        f"/{key}",
        f"{key}/",
        f"{key}\n",
        f" {key}",
        key.upper(),
        f"{key}/**",
        f"{key}/{'x' * 60_000}",
    )


@by_kind
def test_a_wildcard_or_a_wrong_number_of_chunks_is_not_a_key_of_tandem(kind: Callable[..., str]) -> None:
    named = {name: NAMED[name] for name in inspect.signature(kind).parameters}
    for key in spoilt(kind(**named)):
        assert keys.parse(key) is None, key
    for name in named.keys() - {"run"}:
        assert keys.parse(kind(**named | {name: "a" * 32})) is not None
        assert keys.parse(kind(**named | {name: "a" * 33})) is None


@given(
    st.text(max_size=300)
    | st.lists(st.sampled_from(["tandem", "r", "a", "*", "robot", "world", "to", ""])).map("/".join)
)
@example("**")
@example("tandem/**")
def test_any_text_is_either_a_key_of_tandem_or_rejected(text: str) -> None:
    found = keys.parse(text)
    if found is not None:
        assert found.kind is not None
        named = {name: getattr(found, name) for name in inspect.signature(found.kind).parameters}
        assert found.kind(**named) == text


# --- processes ----------------------------------------------------------------------------------------

WILD = [
    *("**", "tandem/**", "*/**", f"tandem/{RUN}/**", "tandem/*/robot/*/command", "*/*/*/*/*", "**/command"),
    *(f"tandem/{RUN}/robot/*/*", f"tandem/{RUN}/robot/*/to/*", f"tandem/{RUN}/robot/a/**", "tandem/r$*/**"),
    *("tandem/*/alive/**", f"tandem/{RUN}/alive/*", "tandem/*/alive/robot/*", "tandem/*/world/**"),
]
ODD = [
    *("tandem", "a", f"tandem/{RUN}", f"tandem/{RUN}/robot", f"tandem/{RUN}/robot/a", f"tandem/{RUN}/alive"),
    *(f"tandem/{RUN}/robot/ä\u202e/command", f"tandem/{RUN}/robot/{'x' * 5000}/command"),
    *(f"{key}/more" for key in KEYS.values()),
]
FRAMES = [
    b"",
    b"\xff" * 40,
    encode(Command(0, "a", 1.0, 1.0, 1, "forged")),
    encode(Observation(0, "a", None, 1.0)),
    encode(Report(0, "b", 1, "forged", ORIGIN, 0, 0, (), 0, (), 0, 0)),
]


def attack(link: zenoh.Session) -> list[zenoh.LivelinessToken]:
    """Put, delete, query and show tokens under every wildcard and malformed key.

    Some tokens appear and disappear. Every frame is delivered; by default Zenoh drops a frame if the receiver
    is busy.
    """
    all_of_it = zenoh.CongestionControl.BLOCK
    for key in (*WILD, *ODD):
        for frame in FRAMES:
            link.put(
                key, frame, encoding="text/plain", attachment=b"\xff" * 100, congestion_control=all_of_it
            )
        link.delete(key, congestion_control=all_of_it)
    for key in KEYS.values():
        link.delete(key, congestion_control=all_of_it)
    shown = [link.liveliness().declare_token(key) for key in (*WILD, *ODD)]
    gone: list[Any] = [link.liveliness().declare_token(key) for key in WILD]
    for token in gone:
        token.undeclare()
    for key in (*WILD, *ODD):
        for reply in link.get(key, timeout=BOUND_S):
            assert reply.ok is None
    return shown


@pytest.mark.long
def test_wildcards_odd_keys_and_deletions_end_no_process_and_change_nothing(tmp_path: Path) -> None:
    """Robot d is absent, so the tick does not advance while every process listens."""
    scenario, out, alone = tmp_path / "pairs.toml", tmp_path / "out", tmp_path / "alone"
    scenario.write_text(several_pairs(2))
    with world(scenario, "--run", RUN, "--out", out) as (clock, endpoint), ExitStack() as others:

        def start(*arguments: str | Path) -> TandemProcess:
            return others.enter_context(TandemProcess(*arguments, "--connect", endpoint))

        watch = start("watch", "--port", "0")
        watch.until_prints("http://")
        agents = {robot: start("agent", robot, "--out", out) for robot in "abc"}
        for robot, agent in agents.items():
            agent.until_answered(robot, out)
        stranger = others.enter_context(stranger_at(endpoint))
        shown = attack(stranger)
        for process in (clock, *agents.values()):
            process.until_prints("not a key of one mission and robot")
            process.until_prints("a deletion" if process is not agents["c"] else "not a key")
        listed = tandem("ps", "--connect", endpoint, "--json", "--timeout", "1")
        doctor = tandem("doctor", "--connect", endpoint, "--timeout", "1")
        assert (listed.status, doctor.status) == (0, 0), listed.err + doctor.out
        [mission] = json.loads(listed.out)["missions"]
        assert [robot["robot"] for robot in mission["robots"]] == ["a", "b", "c", "d"]
        agents["d"] = start("agent", "d", "--out", out)
        assert [process.ended().status for process in (clock, *agents.values())] == [0] * 5
        assert watch.running
        assert not any("Traceback" in process.err for process in (watch, clock, *agents.values()))
        del shown
    assert tandem("run", scenario, "--in-process", "-q", "--out", alone).status == 0
    assert (out / "ticks.csv").read_bytes() == (alone / "ticks.csv").read_bytes()


def test_an_answer_under_a_wildcard_key_is_not_accepted_as_a_configuration() -> None:
    config = load("paper-1").config("a")
    with session.open_router(listening("tcp/127.0.0.1:0")) as link:
        declared: list[Any] = []

        def answers(key: str, reply: Callable[[zenoh.Query], None]) -> bytes | str | None:
            declared.append(link.declare_queryable(key, reply))
            try:
                return session.ask(link, keys.config(RUN, "a"), BOUND_S)
            finally:
                declared.pop().undeclare()

        asked = keys.config(RUN, "a")
        assert answers("tandem/**", lambda query: query.reply("tandem/**", encode(config))) is None
        assert answers(asked, lambda query: query.reply(asked, encode(config))) == encode(config)
        refusal = answers(asked, lambda query: query.reply_err(b"\xff\xfe" * 1000, encoding=session.REFUSAL))
        assert isinstance(refusal, str)
        assert len(refusal) <= 300


def test_a_flood_of_invalid_keys_is_counted_and_reported_a_bounded_number_of_times(
    capsys: pytest.CaptureFixture[str],
) -> None:
    inbox = Inbox("test")
    for number in range(10 * COMPLAINTS):
        inbox.turn_away("command", f"tandem/*/{number}/{'x' * 1000}", session.NO_KEY)
    assert inbox.next(0.0) is NO_ARRIVAL
    assert inbox.refused == {"command": 10 * COMPLAINTS}
    said = capsys.readouterr().err.splitlines()
    assert len(said) <= COMPLAINTS
    assert max(map(len, said)) < 500


def test_a_frame_under_a_wildcard_key_is_not_delivered(capsys: pytest.CaptureFixture[str]) -> None:
    inbox = Inbox("test")
    with session.open_router(listening("tcp/127.0.0.1:0")) as link:
        session.subscribe(link, keys.command(RUN, "*"), inbox, "command")
        session.watch_liveliness(link, keys.robot_alive(RUN, "*"), inbox)
        link.put("tandem/**", FRAMES[2])
        link.delete(keys.command(RUN, "a"))
        token: Any = link.liveliness().declare_token("**")
        link.put(keys.command(RUN, "a"), FRAMES[2])
        arrival = inbox.next(BOUND_S)
        assert (arrival.topic, arrival.source, arrival.frame) == (
            "command",
            keys.Key(keys.command, RUN, "a"),
            FRAMES[2],
        )
        token.undeclare()
        until(
            lambda: inbox.next(0.0) is NO_ARRIVAL and inbox.refused == {"command": 2, "alive": 1, "gone": 1},
            "all told",
        )
    assert "tandem/**: not a key of one mission and robot" in capsys.readouterr().err


@contextmanager
def taking_from_a_line() -> Iterator[tuple[Inbox, zenoh.Session]]:
    """Yield an inbox that takes Commands from a session, and the session."""
    inbox = Inbox("test")
    with session.open_router(listening("tcp/127.0.0.1:0")) as link:
        session.subscribe_directly(link, keys.command(RUN, "*"), inbox, "command")
        yield inbox, link


def test_a_wait_for_a_line_ends_with_a_frame_another_event_or_the_timeout() -> None:
    with taking_from_a_line() as (inbox, link):
        for timeout in (0.0, 0.01, 0.3, 0.02):
            began = time.monotonic()
            assert inbox.next(timeout) is NO_ARRIVAL
            assert time.monotonic() >= began + timeout
        threading.Timer(0.01, link.put, (keys.command(RUN, "a"), FRAMES[2])).start()
        assert inbox.next(None).frame == FRAMES[2]
        threading.Timer(0.01, inbox.put, ("ended", "agent a")).start()
        assert inbox.next(BOUND_S) == Arrival("ended", "agent a")
        threading.Timer(0.01, inbox.put, ("stop", "SIGTERM")).start()
        with pytest.raises(Interrupted, match="SIGTERM"):
            inbox.next(BOUND_S)
    inbox.put("ended", "agent b")
    assert inbox.next(BOUND_S) == Arrival("ended", "agent b"), "without a session"
    assert inbox.next(0.01) is NO_ARRIVAL


def test_what_comes_over_a_line_under_a_wildcard_is_refused() -> None:
    with taking_from_a_line() as (inbox, link):
        link.put("tandem/**", FRAMES[2])
        link.delete(keys.command(RUN, "a"))
        link.put(keys.command(RUN, "a"), FRAMES[2], attachment=b"\xff" * 100)
        assert inbox.next(BOUND_S).frame == FRAMES[2]
        assert inbox.refused == {"command": 2}
