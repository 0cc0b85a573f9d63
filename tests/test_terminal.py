"""Text from robots is escaped by every command that prints it on a terminal."""

from __future__ import annotations

import io
import json
import os
import pty
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from compose.launch.processes import free_endpoint
from compose.terminal.tables import console
from protocol.messages import Command, FinalReport, MissionEnd, Observation, Undecided
from protocol.network import keys, session
from protocol.network.endpoints import at
from protocol.network.inbox import Inbox
from protocol.output import one_line, say
from protocol.wire import decode, encode
from tests.commands import BOUND_S, PAPER_1, Ended, TandemProcess, tandem, world
from tests.examples import EXAMPLES

RUN = "mine"
REASON = (
    "\x1b[2J\x1b[1;1Hpaper-1: localised after 48 ticks\n\r\x9b2J\x07\u202e\u2028 [red]said[/red] :smile: $x$"
)
STATE = "\x1b[2J[bold]\n\x7f\x9b1m"
ESCAPED = one_line(REASON)
HARMFUL = ("\x1b[2J", "\x9b", "\x07", "\x7f", "\u202e", "\u2028")


def final_report(robot: str) -> FinalReport:
    [found] = [one for one in EXAMPLES if isinstance(one, FinalReport) and not one.anchor_ranges]
    return FinalReport(robot, *[getattr(found, name) for name in found.__struct_fields__[1:]])


def play_hostile(endpoint: str, pause: Callable[[], object] = lambda: None) -> None:
    """Run robot b, which sends hostile text and gives up in tick 3; call `pause` in tick 2."""
    heard, paused = Inbox("test"), False
    with session.open_client(at(endpoint), lambda: None) as link:
        command = session.publisher(link, keys.command(RUN, "b"))
        session.subscribe(link, keys.observation(RUN, "b"), heard, "observation")
        token = session.show_alive(link, keys.robot_alive(RUN, "b"))
        while True:
            arrival = heard.next(BOUND_S)
            assert arrival.topic == "observation"
            message: Observation | MissionEnd | FinalReport = decode(
                arrival.frame, Observation | MissionEnd | FinalReport
            )
            match message:
                case Observation(tick):
                    verdict = Undecided(REASON) if tick == 3 else None
                    command.put(encode(Command(tick, "b", 0.0, 0.0, 1, STATE, verdict)))
                    if tick == 2 and not paused:
                        paused = True
                        pause()
                case MissionEnd():
                    command.put(encode(final_report("b")))
                case FinalReport():
                    break
        del token


def harmless(said: str) -> bool:
    forged = any(line.startswith("paper-1: localised") for line in said.splitlines())
    return not forged and not any(one in said for one in HARMFUL)


@given(st.text())
def test_a_line_is_one_line_of_printable_characters(text: str) -> None:
    assert one_line(text).isprintable()
    assert one_line(one_line(text)) == one_line(text)


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "ascii"])
def test_what_a_terminal_cannot_show_is_escaped(encoding: str, monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    monkeypatch.setattr(sys, "stdout", out)
    say("caf\xe9 \U0001f600 \udc80", "\x1b[2J")
    monkeypatch.undo()
    assert isinstance(out.buffer, io.BytesIO)
    shown = out.buffer.getvalue().decode(encoding).splitlines()
    assert len(shown) == 2
    assert shown[0].endswith("\\udc80")
    assert shown[1] == "\\x1b[2J"


def test_a_table_shows_markup_literally() -> None:
    page = console(file=io.StringIO(), width=80)
    with page.capture() as capture:
        page.print("[red]said[/red] :smile:")
    assert capture.get() == "[red]said[/red] :smile:\n"


def test_text_of_a_robot_is_escaped_by_world_agent_audit_and_replay(tmp_path: Path) -> None:
    scenario, out = tmp_path / "paper.toml", tmp_path / "out"
    scenario.write_text(PAPER_1)
    with (
        world(scenario, "--run", RUN, "--out", out) as (clock, endpoint),
        TandemProcess("agent", "a", "--connect", endpoint, "--out", out) as agent,
    ):
        play_hostile(endpoint)
        assert (clock.ended().status, agent.ended().status) == (1, 1)
        line = f"undecided after 3 ticks (b: {ESCAPED})"
        assert f"paper-1: {line}\n" in clock.out
        assert f"a: {line}\n" in agent.out
        said = [clock.out, clock.err, agent.out, agent.err]
    for command in ("audit", "replay"):
        ended = tandem(command, out)
        said += [ended.out, ended.err]
    assert all(map(harmless, said))


@pytest.mark.long
def test_text_of_a_robot_is_escaped_by_ps_and_in_its_json(tmp_path: Path) -> None:
    scenario, found = tmp_path / "paper.toml", list[Ended]()
    scenario.write_text(PAPER_1)
    with (
        world(scenario, "--run", RUN) as (clock, endpoint),
        TandemProcess("agent", "a", "--connect", endpoint),
    ):

        def look() -> None:
            for arguments in ((), ("--json",)):
                found.append(tandem("ps", "--connect", endpoint, *arguments))

        play_hostile(endpoint, look)
        assert clock.ended().status == 1
    listed, told = found
    assert harmless(listed.out + listed.err + told.out + told.err)
    [mission] = json.loads(told.out)["missions"]
    [b] = [robot for robot in mission["robots"] if robot["robot"] == "b"]
    assert b["state"] in (STATE, None)
    assert one_line(STATE) in listed.out or b["state"] is None


def test_text_of_a_robot_is_escaped_in_the_live_table_and_the_outcome(tmp_path: Path) -> None:
    scenario, endpoint, shown = tmp_path / "paper.toml", free_endpoint(), b""
    scenario.write_text(PAPER_1)
    ours, theirs = pty.openpty()
    arguments = ("world", scenario, "--run", RUN, "--listen", endpoint)
    with (
        TandemProcess(*arguments, terminal=theirs) as clock,
        TandemProcess("agent", "a", "--connect", endpoint) as agent,
    ):
        os.close(theirs)
        play_hostile(endpoint)
        assert agent.ended().status == 1
        while True:
            try:
                shown += os.read(ours, 65536)
            except OSError:
                break
        os.close(ours)
        assert clock.ended().status == 1
    said = shown.decode()
    assert "[red]said[/red] :smile: $x$" in said
    assert harmless(said)


def test_nothing_prints_but_by_the_one_way() -> None:
    """Ruff's rule T201 enforces it, except in the files that pyproject.toml lists."""
    command = [
        sys.executable,
        "-m",
        "ruff",
        "check",
        "--select",
        "T20",
        "agent",
        "world",
        "protocol",
        "compose",
    ]
    assert (
        subprocess.run(command, cwd=Path(__file__).parents[1], check=False, capture_output=True).returncode
        == 0
    )
