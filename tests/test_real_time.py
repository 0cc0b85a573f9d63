"""`--rate`: the world does not wait, and a robot whose Command is late stops for that tick."""

from __future__ import annotations

import csv
import json
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from signal import SIGCONT, SIGINT, SIGSTOP

import pytest
import zenoh

from protocol.journal import journal_file
from protocol.messages import Command, DeadlineMissed, Environment, FinalReport, MissionEnd, Observation
from protocol.network import keys, session
from protocol.network.endpoints import LEASE_S, at
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from tests.commands import (
    ASSURED,
    BOUND_S,
    ENDLESS,
    OVER,
    PAPER_1,
    REAL_TIME,
    TandemProcess,
    process_of,
    tandem,
    world,
)
from tests.planted import audit, checks
from world.scenario import Scenario

AWAY = 3 * round(LEASE_S * 20)
"""The number of ticks at a rate of 20 in which Zenoh gives up the link of a process that stands."""


def missed(path: Path, robot: str) -> int:
    """Return the number of ticks without a Command of `robot`."""
    kinds = Environment | Scenario | Command | DeadlineMissed | MissionEnd | FinalReport
    messages = [decode(frame, kinds, MAX_FRAME_BYTES) for frame in journal_file.read(path)]
    return sum(isinstance(message, DeadlineMissed) and message.robot == robot for message in messages)


def test_a_rate_that_cannot_be_kept_can_still_be_stopped(tmp_path: Path) -> None:
    scenario = tmp_path / "endless.toml"
    scenario.write_text(ENDLESS)
    with TandemProcess("run", scenario, "--rate", "2000", "--out", tmp_path / "out", "-q") as run:
        run.until_written(tmp_path / "out" / "world.journal", 10_000)
        os.kill(run.pid, SIGINT)
        ended = run.ended()
    assert ended.status == 130
    assert "Traceback" not in ended.err


@contextmanager
def robots_at(endpoint: str, answers: Callable[[Observation], bool]) -> Iterator[ExitStack]:
    """Yield robots a and b of run r, which answer ticks that `answers` selects; closing the stack ends b."""
    with session.open_client(at(endpoint), lambda: None) as a, ExitStack() as leaves:
        b = leaves.enter_context(session.open_client(at(endpoint), lambda: None))
        commands = {one: session.publisher(a, keys.command("r", one)) for one in "ab"}

        def answer(sample: zenoh.Sample) -> None:
            observation = decode(sample.payload.to_bytes(), Observation | MissionEnd)
            if isinstance(observation, Observation) and answers(observation):
                commands[observation.robot].put(
                    encode(Command(observation.tick, observation.robot, 0.0, 0.0, 1, "straight"))
                )

        subscribed = [a.declare_subscriber(keys.observation("r", one), answer) for one in "ab"]
        tokens = [session.show_alive(link, keys.robot_alive("r", one)) for link, one in ((a, "a"), (b, "b"))]
        yield leaves
        assert subscribed
        assert tokens


@pytest.mark.long
def test_a_tick_may_last_longer_than_the_timeout(tmp_path: Path) -> None:
    scenario = tmp_path / "slow.toml"
    scenario.write_text("max_ticks = 2\n" + PAPER_1)
    with (
        world(scenario, "--rate", "0.5", "--timeout", "1", "--run", "r") as (clock, endpoint),
        robots_at(endpoint, lambda _: True),
    ):
        ended = clock.ended()
    assert ended.status == 1
    assert "undecided after 2 ticks (max_ticks: a, b not localised by then)" in " ".join(ended.out.split())


@pytest.mark.parametrize(("rate", "lasts"), [("1e-8", "1e+08"), ("1e8", "1e-08")])
def test_a_rate_out_of_bounds_is_refused(rate: str, lasts: str) -> None:
    ended = tandem("run", "paper-1", "--rate", rate)
    assert ended.status == 2
    assert ended.err.startswith(f"tandem run: --rate: {float(rate):g} makes a tick of 1 s last {lasts} s")
    assert ended.err.count("\n") == 1


@pytest.mark.long
def test_a_robot_whose_agent_is_suspended_stands_still_and_the_mission_violates_no_rule(
    tmp_path: Path,
) -> None:
    out = tmp_path / "out"
    (tmp_path / "assured.toml").write_text(REAL_TIME)
    with TandemProcess("run", tmp_path / "assured.toml", "--rate", "20", "--out", out) as run:
        run.until_written(out / "world.journal", 3000)
        stopped = process_of(out, "agent", "a")
        os.kill(stopped, SIGSTOP)
        run.until(lambda: missed(out / "world.journal", "a") >= AWAY, "its link has been given up")
        os.kill(stopped, SIGCONT)
        ended = run.ended()
    assert ended.status in OVER
    assert "late: ticks in which the robot stopped" in ended.out
    told = json.loads((out / "summary.json").read_text())
    with (out / "ticks.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["robot"] == "a" and row["state"] == ""]
    assert len(rows) == missed(out / "world.journal", "a")
    rows = [row for row in rows if int(row["tick"]) < told["ticks"]]
    assert told["robots"]["a"]["deadlines_missed"] == len(rows) >= AWAY
    assert {(row["v"], row["omega"]) for row in rows} == {("0.0", "0.0")}
    findings = audit(out)
    assert [one for one in findings.violations if not one.breaks_off] == []
    assert all(made for rule, made in checks(findings).items() if rule not in ("claim", "distance", "bound"))


@pytest.mark.long
def test_a_world_prints_the_reason_for_a_missing_final_report(tmp_path: Path) -> None:
    """Both answer only the first tick, which lasts long enough for a busy machine; then b ends."""
    out = tmp_path / "out"
    (tmp_path / "short.toml").write_text("max_ticks = 3\n" + ASSURED.partition("\n")[2])
    second = threading.Event()

    def answers(observation: Observation) -> bool:
        if observation.tick:
            second.set()
        return observation.tick == 0

    with (
        world(tmp_path / "short.toml", "--rate", "1", "--run", "r", "--out", out) as (clock, endpoint),
        robots_at(endpoint, answers) as leaves,
    ):
        assert second.wait(BOUND_S)
        leaves.close()
        ended = clock.ended()
    assert ended.status == 1
    behind, gone = [line for line in ended.err.splitlines() if "no FinalReport" in line]
    assert behind.startswith(
        "tandem world: no FinalReport of a: behind, at tick 0 of 3; a lower --rate leaves"
    )
    assert gone == "tandem world: no FinalReport of b: gone; the last Command was of tick 0"
    assert "deadlines missed, of 3: a 2, b 2; a lower --rate, such as --rate 0.5, gives" in ended.out
    robots = json.loads((out / "summary.json").read_text())["robots"]
    assert robots["a"]["no_farewell"] == "its last Command that arrived in time is of tick 0 of 3"
