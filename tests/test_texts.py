"""Texts are cut to their bound in a message, and escaped by every command that prints them."""

from __future__ import annotations

import io
import json
import os
import pty
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.inspect import StrType, StructType, type_info
from msgspec.structs import replace

from agent.process.agent_journal import agent_history
from agent.process.robot import Robot
from compose.launch.planner_loader import planner_of
from compose.launch.processes import free_endpoint
from compose.scenario.scenario_file import load
from compose.terminal.tables import console
from protocol.journal.journal_file import Journal, read
from protocol.journal.resume import Retrace
from protocol.messages import (
    MAX_TEXT,
    Cause,
    Command,
    FinalReport,
    Inconsistent,
    Message,
    MissionEnd,
    Observation,
    OfRobot,
    Undecided,
)
from protocol.network import keys, session
from protocol.network.endpoints import at
from protocol.network.inbox import Inbox
from protocol.output import one_line, say
from protocol.wire import MAX_FRAME_BYTES, MalformedFrame, decode, encode
from tests.commands import BOUND_S, PAPER_1, Ended, TandemProcess, tandem, world
from tests.examples import EXAMPLES
from tests.steps import NAMES
from tests.test_wire import changed, framed, packed, parts, plain
from world.simulation import Simulation, resumed
from world.world_journal import world_history

LONG_TEXTS = {
    "ascii": "x" * (MAX_TEXT + 1),
    "long": "no way " * 1000,
    "wide": "\U0001f600" * (MAX_TEXT + 1),
    "combined": "e\u0301" * MAX_TEXT,
    "surrogates": "\udc80" * MAX_TEXT,
    "mixed": "\x00\x1b[2J\ud83d" + "\u202e" * MAX_TEXT,
}


def structs_in(value: object) -> Iterator[msgspec.Struct]:
    """Yield `value` and every struct in it."""
    if isinstance(value, msgspec.Struct):
        yield value
        for name in value.__struct_fields__:
            yield from structs_in(getattr(value, name))
    elif isinstance(value, tuple | list):
        for one in value:
            yield from structs_in(one)


def text_fields() -> set[tuple[type[msgspec.Struct], str]]:
    """Return every field of a message, and of structs in one, for a text of any length."""
    found: set[tuple[type[msgspec.Struct], str]] = set()
    seen: set[type] = set()

    def visit(info: Any) -> None:
        if isinstance(info, StructType):
            if info.cls in seen:
                return
            seen.add(info.cls)
            for field in info.fields:
                alternatives = getattr(field.type, "types", (field.type,))
                if any(isinstance(one, StrType) and one.max_length == MAX_TEXT for one in alternatives):
                    found.add((info.cls, field.name))
                visit(field.type)
        for name in ("types", "item_types"):
            for one in getattr(info, name, ()):
                visit(one)
        if (item := getattr(info, "item_type", None)) is not None:
            visit(item)

    for message in Message.__subclasses__():
        visit(type_info(message))
    return found


FIELDS = sorted(text_fields(), key=str)


def example_of(kind: type[msgspec.Struct]) -> msgspec.Struct:
    return next(one for message in EXAMPLES for one in structs_in(message) if type(one) is kind)


def test_the_text_fields_are_these() -> None:
    assert set(FIELDS) == {
        (Undecided, "reason"),
        (Inconsistent, "claim"),
        (Cause, "text"),
        (FinalReport, "blocking_reason"),
    }


@pytest.mark.parametrize(("kind", "field"), FIELDS)
@pytest.mark.parametrize("words", LONG_TEXTS.values(), ids=LONG_TEXTS)
def test_what_is_encoded_is_within_its_bound(kind: type[msgspec.Struct], field: str, words: str) -> None:
    made = replace(example_of(kind), **{field: words})
    assert len(getattr(made, field)) == MAX_TEXT
    match made:
        case Message():
            told = made
        case Cause():
            told = MissionEnd(0, "failed", (made,))
        case _:
            assert isinstance(made, Undecided | Inconsistent)
            told = Command(0, "a", 0.0, 0.0, 1, "done", made)
    assert decode(encode(told), type(told)) == told


@pytest.mark.parametrize(("kind", "field"), FIELDS)
@pytest.mark.parametrize("char", ["x", "\xe9", "\U0001f600", "\n"])
def test_a_text_at_its_bound_is_kept_whole(kind: type[msgspec.Struct], field: str, char: str) -> None:
    words = char * MAX_TEXT
    assert getattr(replace(example_of(kind), **{field: words}), field) == words


@pytest.mark.parametrize(
    "message", EXAMPLES, ids=[f"{i}-{type(message).__name__}" for i, message in enumerate(EXAMPLES)]
)
def test_a_decoder_takes_text_up_to_its_bound_in_characters_and_refuses_more(message: Message) -> None:
    """The bound is that of the field: a text, a word or a robot id."""
    tree = plain(message)
    for path, value in parts(tree):
        if isinstance(value, str):
            bounds = [bound for bound in (16, 31, 32, 64, MAX_TEXT) if _taken(message, path, "a" * bound)]
            if not bounds:
                continue  # one of a few literals
            bound = max(bounds)
            assert bound in (32, 64, MAX_TEXT)
            assert not _taken(message, path, "a" * (bound + 1))
            named = not _taken(message, path, "\U0001f600")  # a name of a robot or a planner
            assert named or _taken(message, path, "\U0001f600" * bound)
            assert not _taken(message, path, "\U0001f600" * (bound + 1))


def _taken(message: Message, path: tuple[object, ...], value: str) -> bool:
    try:
        decode(framed(packed(changed(plain(message), path, value))), type(message))
    except MalformedFrame:
        return False
    return True


def test_every_word_for_a_state_is_within_its_bound() -> None:
    for word in (*NAMES, "localised", "undecided", "inconsistent"):
        command = Command(0, "a", 0.0, 0.0, 1, word)
        assert decode(encode(command), Command) == command


# --- journals -----------------------------------------------------------------------------------------


def test_a_world_whose_reason_is_too_long_leaves_a_journal_that_is_read_and_taken_up(tmp_path: Path) -> None:
    scenario, path = load("paper-1"), tmp_path / "world.journal"
    with Journal(path) as journal:
        cause = Cause("failed", text="no answer from " + "robot, " * 200)
        end = Simulation(scenario, journal).end(MissionEnd(0, "failed", (cause,)))
    assert world_history(read(path), path).end == end
    recording = Retrace(path)
    assert resumed(scenario, recording).mission_end == end
    recording.close()


def test_an_agent_that_gives_up_at_length_leaves_a_journal_that_is_read(tmp_path: Path) -> None:
    scenario, path = load("paper-1"), tmp_path / "agent-a.journal"
    with Journal(path) as journal:
        robot = Robot(scenario.config("a"), planner_of(scenario.config("a")), journal)
        robot.observation(Observation(0, "a", None, 1.0))
        robot.state = robot.state.undecided("\U0001f600" * 1000)
        command = robot.decide()
        robot.estimate()
        robot.final_report(MissionEnd(1, "undecided", (Cause("undecided", ("a",), text="x" * 1000),)))
    assert command.verdict == Undecided("\U0001f600" * MAX_TEXT)
    assert agent_history(read(path), path).final_report is not None
    for frame in read(path):
        decode(frame, OfRobot, MAX_FRAME_BYTES)


def test_a_run_that_ends_with_the_longest_verdict_is_read(tmp_path: Path) -> None:
    """The test replaces both robots, which give up at once."""
    scenario, out = tmp_path / "paper.toml", tmp_path / "out"
    scenario.write_text(PAPER_1)
    gives_up = Undecided("\U0001f600" * MAX_TEXT)
    heard = Inbox("test")
    with (
        world(scenario, "--run", RUN, "--out", out) as (clock, endpoint),
        session.open_client(at(endpoint), lambda: None) as link,
    ):
        commands = {robot: session.publisher(link, keys.command(RUN, robot)) for robot in "ab"}
        session.subscribe(link, keys.observation(RUN, "*"), heard, "observation")
        tokens = [session.show_alive(link, keys.robot_alive(RUN, robot)) for robot in "ab"]
        parted = set[str]()
        while len(parted) < 2:
            arrival = heard.next(BOUND_S)
            assert arrival.topic == "observation", clock.err
            robot = arrival.source.robot
            message: Observation | MissionEnd | FinalReport = decode(
                arrival.frame, Observation | MissionEnd | FinalReport
            )
            match message:
                case Observation(tick):
                    commands[robot].put(encode(Command(tick, robot, 0.0, 0.0, 1, "undecided", gives_up)))
                case MissionEnd(_, outcome, causes):
                    assert (outcome, causes) == (
                        "undecided",
                        (Cause("undecided", ("a",), text=gives_up.reason),),
                    )
                    said = replace(example_of(FinalReport), robot=robot)
                    assert isinstance(said, FinalReport)
                    commands[robot].put(encode(said))
                case FinalReport():
                    parted.add(robot)
        assert clock.ended().status == 1, clock.err
        del tokens
    assert world_history(read(out / "world.journal"), out).end is not None
    replayed, audited = tandem("replay", out), tandem("audit", out)
    assert (replayed.status, audited.status) == (0, 1), replayed.err + audited.err
    assert re.search(r"^claim +1 +0$", audited.out, re.MULTILINE), audited.out  # only journals are missing


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
