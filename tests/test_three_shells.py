"""`tandem world` and `tandem agent`, started separately in any order, with any number of pairs."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest
import zenoh

from agent.process import discovery
from agent.process.discovery import Search, Unwelcome, join
from compose.launch.processes import free_endpoint
from compose.scenario.scenario_file import load
from protocol.network import keys, session
from protocol.network.endpoints import at, listening
from protocol.network.inbox import Inbox
from protocol.wire import encode
from tests.commands import (
    BOUND_S,
    TandemProcess,
    decided,
    in_one_process,
    journals,
    processes_of,
    several_pairs,
    tandem,
    until,
    world,
)
from tests.series import series

NOBODY = "nothing listens there; check the address, and that the router runs"


def unanswered() -> None:
    raise AssertionError("nothing listens there")


@pytest.mark.skipif(sys.platform != "linux", reason="a reserved port could not be listened on elsewhere")
def test_an_endpoint_is_not_given_to_two_even_if_nothing_listens_there_yet() -> None:
    """A process that connects again after a crash would reach another run."""
    endpoint = free_endpoint()
    with socket.socket() as other, pytest.raises(OSError, match="in use"):
        other.bind(("127.0.0.1", int(endpoint.rpartition(":")[2])))
    with session.open_router(listening(endpoint)):  # the reservation does not prevent this
        pass


# --- any order ----------------------------------------------------------------------------------------


ORDERS = [("world", "a", "b"), ("world", "b", "a"), ("a", "world", "b"), ("b", "a", "world")]
"""The world first, between the robots, and last."""


@pytest.mark.parametrize("order", series(ORDERS), ids="-".join)
def test_any_order_of_starting_gives_the_same_recording(
    order: tuple[str, ...], undisturbed: Path, tmp_path: Path
) -> None:
    endpoint, out = free_endpoint(), tmp_path / "out"
    with ExitStack() as shells:
        started: dict[str, TandemProcess] = {}
        for name in order:
            if name == "world":
                for agent in started.values():  # it prints this after 5 s
                    agent.until_prints(f"no world at {endpoint} yet")
                part = ("world", "paper-1", "--listen", endpoint)
            else:
                part = ("agent", name, "--connect", endpoint)
            started[name] = shells.enter_context(TandemProcess(*part, "--out", out))
            if name == "world":
                started[name].until_prints("waiting for a, b")
            if "world" in started and len(started) == 2:
                for robot in started.keys() - {"world"}:
                    started[robot].until_answered(robot, out)
        ended = {name: command.ended() for name, command in started.items()}
    assert {name: end.status for name, end in ended.items()} == {"world": 0, "a": 0, "b": 0}, ended
    for name in ("a", "b"):
        assert f"{name}: localised after 48 ticks" in ended[name].out
    assert "localised after 48 ticks" in ended["world"].out
    assert decided(out) == decided(undisturbed)
    assert not processes_of(endpoint)


@pytest.mark.long
def test_each_shell_may_write_its_journal_to_its_own_folder(undisturbed: Path, tmp_path: Path) -> None:
    with world("paper-1", "--out", tmp_path / "world") as (clock, endpoint), ExitStack() as shells:
        for robot in ("a", "b"):
            agent = TandemProcess("agent", robot, "--connect", endpoint, "--out", tmp_path / robot)
            shells.enter_context(agent)
        assert clock.ended().status == 0
    found = {name: data for part in ("world", "a", "b") for name, data in journals(tmp_path / part).items()}
    assert found == journals(undisturbed)


@pytest.mark.parametrize("pairs", series([2, 3], 0))
def test_several_pairs_localise_side_by_side_in_one_world(pairs: int, tmp_path: Path) -> None:
    scenario, out = tmp_path / "pairs.toml", tmp_path / "out"
    scenario.write_text(several_pairs(pairs))
    robots = "abcdef"[: 2 * pairs]
    with world(scenario, "--out", out) as (clock, endpoint), ExitStack() as shells:
        agents = [
            shells.enter_context(TandemProcess("agent", robot, "--connect", endpoint, "--out", out))
            for robot in reversed(robots)
        ]
        assert clock.ended().status == 0
        assert [agent.ended().status for agent in agents] == [0] * len(agents)
    again = in_one_process(scenario, tmp_path / "again")
    assert sorted(journals(out)) == sorted([*(f"agent-{robot}.journal" for robot in robots), "world.journal"])
    assert journals(out) == journals(again)


# --- no world -----------------------------------------------------------------------------------------


@pytest.mark.long
def test_an_agent_without_a_world_reports_it_and_gives_up(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    ended = tandem("agent", "a", "--connect", endpoint, "--connect-timeout", "6", "--out", tmp_path / "out")
    assert ended.status == 3
    assert ended.err.splitlines() == [
        f"tandem agent a: no world at {endpoint} yet; searching for up to 6 s: {NOBODY}",
        f"tandem agent a: no world at {endpoint}; gave up after 6 s: {NOBODY}",
    ]
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_an_agent_finds_no_world_where_its_run_is_not_alive() -> None:
    with world("paper-1", "--run", "mine") as (_, endpoint):
        ended = tandem("agent", "a", "--connect", endpoint, "--run", "yours", "--connect-timeout", "1")
    assert ended.status == 3
    assert "gave up after 1 s" in ended.err


# --- who may join -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def waiting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Yield the endpoint of a world of run "mine" that has robot a and waits for b."""
    out = tmp_path_factory.mktemp("waiting") / "out"
    with (
        world("paper-1", "--run", "mine", "--timeout", "100") as (_, endpoint),
        TandemProcess("agent", "a", "--connect", endpoint, "--out", out) as agent,
    ):
        agent.until_answered("a", out)
        yield endpoint


def test_an_unknown_robot_is_refused_with_the_known_ones(waiting: str) -> None:
    ended = tandem("agent", "z", "--connect", waiting)
    assert ended == (2, "", "tandem agent: this world has no robot 'z'; it has a, b\n")


def test_an_agent_waits_until_the_robot_s_former_process_has_disappeared(
    waiting: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It does so for longer than it searches through one session."""
    monkeypatch.setattr(discovery, "SESSION_S", 0.1)
    with (
        session.open_client(at(waiting), unanswered) as former,
        session.open_client(at(waiting), unanswered) as link,
    ):
        token: Any = session.show_alive(former, keys.robot_alive("mine", "b"))
        until(
            lambda: session.alive(link, keys.robot_alive("mine", "b"), BOUND_S), "the former process appears"
        )

        class LongSearch(Search):
            pauses = 0

            def pause(self) -> None:
                super().pause()
                self.pauses += 1
                if self.pauses == 20:  # at ASK_AGAIN_S each
                    token.undeclare()

        search = LongSearch("world", at(waiting), BOUND_S, Inbox("agent"))
        joined = join(link, "mine", "b", search)
    assert joined is not None
    assert (joined[0], joined[1].robot) == ("mine", "b")
    assert search.pauses >= 20


@pytest.mark.long
def test_a_second_agent_of_the_same_robot_is_refused(waiting: str) -> None:
    ended = tandem("agent", "a", "--connect", waiting)
    assert ended == (2, "", "tandem agent: robot 'a' is in run 'mine' already: another process is a\n")


def test_of_two_processes_that_join_at_once_one_is_the_robot(
    waiting: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If it ends before it appears, the other one can be the robot."""
    with (
        session.open_client(at(waiting), unanswered) as first,
        session.open_client(at(waiting), unanswered) as second,
    ):

        def joined(link: zenoh.Session) -> bool:
            return join(link, "mine", "b", Search("world", at(waiting), BOUND_S, Inbox("agent"))) is not None

        assert joined(first)
        with monkeypatch.context() as hasty:
            hasty.setattr(discovery, "REFUSED_S", 0.2)
            with pytest.raises(Unwelcome, match="'b' is in run 'mine' already: another process is b"):
                joined(second)
        assert joined(second)


def test_an_agent_that_was_not_ready_in_time_is_refused_if_another_is_the_robot(
    waiting: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(discovery, "REFUSED_S", 0.2)
    with (
        session.open_client(at(waiting), unanswered) as first,
        session.open_client(at(waiting), unanswered) as second,
    ):
        slow, fast = [Search("world", at(waiting), BOUND_S, Inbox("agent")) for _ in range(2)]

        def joins(link: zenoh.Session, search: Search) -> bool:
            with suppress(Unwelcome):
                return join(link, "mine", "b", search) is not None
            return False

        until(lambda: joins(first, slow), "the reservation of another test has ended")
        until(lambda: joins(second, fast), "the reservation has ended")
        discovery.confirm(second, "mine", "b", fast)
        with pytest.raises(Unwelcome, match="'b' is in run 'mine' already: another process is b"):
            discovery.confirm(first, "mine", "b", slow)


@pytest.mark.long
def test_of_two_agents_that_start_at_once_one_is_refused_and_the_mission_is_not_disturbed(
    undisturbed: Path, tmp_path: Path
) -> None:
    patient = ("--timeout", "100", "--out", tmp_path)
    with world("paper-1", "--run", "mine", *patient) as (clock, endpoint), ExitStack() as open_ones:
        agent = ("agent", "a", "--connect", endpoint)
        twice = [open_ones.enter_context(TandemProcess(*agent)) for _ in range(2)]
        until(lambda: not all(one.running for one in twice), "one of them has ended")
        assert tandem("agent", "b", "--connect", endpoint, "--out", tmp_path).status == 0
        assert clock.ended().status == 0
        refused, localised = sorted([one.ended() for one in twice], key=lambda ended: -ended.status)
    assert refused == (2, "", "tandem agent: robot 'a' is in run 'mine' already: another process is a\n")
    assert localised == (0, "a: in run mine, with b\na: localised after 48 ticks\n", "")
    assert (tmp_path / "world.journal").read_bytes() == (undisturbed / "world.journal").read_bytes()


@pytest.mark.long
def test_a_second_agent_that_waits_when_the_world_ends_is_refused() -> None:
    with world("paper-1", "--run", "mine") as (_, endpoint), ExitStack() as open_ones:
        agent = open_ones.enter_context(TandemProcess("agent", "a", "--connect", endpoint))
        agent.until_prints("a: in run mine")

        class WaitingSearch(Search):
            waits = False

            def pause(self) -> None:
                if not self.waits:
                    open_ones.enter_context(TandemProcess("agent", "b", "--connect", endpoint))
                self.waits = True
                super().pause()

        search = WaitingSearch("world", at(endpoint), BOUND_S, Inbox("agent"))
        with (
            session.open_client(at(endpoint), unanswered) as link,
            pytest.raises(Unwelcome, match="robot 'a' is in run 'mine' already: another process is a"),
        ):
            join(link, None, "a", search)
        assert search.waits


@pytest.mark.long
def test_an_agent_that_is_refused_does_not_disturb_the_mission(undisturbed: Path, tmp_path: Path) -> None:
    with world("paper-1", "--out", tmp_path) as (clock, endpoint):
        with TandemProcess("agent", "a", "--connect", endpoint, "--out", tmp_path) as a:
            a.until_answered("a", tmp_path)
            for refused in ("a", "z"):
                assert tandem("agent", refused, "--connect", endpoint).status == 2
            assert tandem("agent", "b", "--connect", endpoint, "--out", tmp_path).status == 0
        assert clock.ended().status == 0
    assert journals(tmp_path) == journals(undisturbed)


@pytest.mark.parametrize(
    "stranger", series(["answers for another", "shows a world", "answers nonsense", "refuses"], 2)
)
def test_whatever_a_stranger_answers_an_agent_finds_its_world(stranger: str) -> None:
    with (
        world("paper-1", "--run", "mine") as (_, endpoint),
        session.open_client(at(endpoint), unanswered) as link,
    ):
        key = keys.config("*", "*")

        def reply(query: zenoh.Query) -> None:
            if stranger == "refuses":
                query.reply_err(b"go away", encoding=session.REFUSAL)
            else:
                frame = b"junk" if stranger == "answers nonsense" else encode(load("paper-1").config("b"))
                query.reply(query.key_expr, frame)

        if stranger == "shows a world":
            _tokens = [session.show_alive(link, keys.world_alive(run)) for run in ("a", "yours", "z")]
        else:
            link.declare_queryable(key, reply)
        with TandemProcess("agent", "a", "--connect", endpoint) as agent:
            agent.until_prints("a: in run mine, with b")


def test_an_agent_that_gets_only_invalid_answers_keeps_searching_and_prints_the_reason() -> None:
    with session.open_router(listening(endpoint := free_endpoint())) as link:
        _token = session.show_alive(link, keys.world_alive("mine"))
        link.declare_queryable(keys.config("mine", "*"), lambda query: query.reply(query.key_expr, b"junk"))
        ended = tandem("agent", "a", "--connect", endpoint, "--connect-timeout", "1")
    assert ended.status == 3
    assert "gave up after 1 s: the world's RobotConfig cannot be decoded: 4 bytes" in ended.err


def test_an_agent_that_finds_several_runs_requires_the_run_flag() -> None:
    with (
        world("paper-1", "--run", "mine") as (_, endpoint),
        session.open_client(at(endpoint), unanswered) as link,
    ):
        _token = session.show_alive(link, keys.world_alive("yours"))
        session.answer(link, keys.config("yours", "a"), lambda *_: load("paper-1").config("a"))
        ended = tandem("agent", "a", "--connect", endpoint)
        says = "tandem agent: several runs are alive: mine, yours; choose one with --run\n"
        assert ended == (2, "", says)
        with TandemProcess("agent", "a", "--connect", endpoint, "--run", "mine") as agent:
            agent.until_prints("a: in run mine, with b")
