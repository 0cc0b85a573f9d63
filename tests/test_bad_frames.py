"""Malformed frames on every key are refused, reported once and counted, and the mission is not affected."""

from __future__ import annotations

import json
import math
import re
import struct
import zlib
from collections.abc import Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh
from msgspec.structs import replace

from compose.launch.processes import free_endpoint
from compose.scenario.scenario_file import load, parse
from protocol.journal.journal_file import read
from protocol.messages import Cause, Command, Contact, FinalReport, Message, MissionEnd, Observation, Report
from protocol.motion import ORIGIN, REST
from protocol.network import inbox, keys, session
from protocol.network.endpoints import listening
from protocol.network.inbox import Arrival, Inbox, Interrupted, Topic
from protocol.wire import VERSION, decode, encode
from tests.commands import (
    BOUND_S,
    LONG,
    LONG_JOURNAL_BYTES,
    LONG_TICKS,
    TandemProcess,
    several_pairs,
    tandem,
    until,
    world,
)
from tests.storm import rage, stranger_at
from tests.test_group_field import FAR

RUN = "mine"
TIMES = 3
"""The number of times that each frame is sent; it must be reported once."""
VOLLEYS = 12
STORM = 3000
SETTLED_MB = 8.0

GENUINE = {
    "observation": (Observation(0, "a", None, 1.0), 1 << 20),
    "command": (Command(0, "a", 0.5, 0.5, 1, "straight"), 1 << 20),
    "report": (Report(0, "b", 1, "straight", ORIGIN, 0, 0, (), 0, (), 0, 0), 4096),
}
"""For each topic, a valid message that robot a receives or sends, and the longest frame in bytes."""

TRUSTED = {
    "observation": keys.observation(RUN, "a"),
    "command": keys.command(RUN, "a"),
    "report": keys.report(RUN, "b", "a"),
}
"""The keys whose frames change the state of a process."""
WATCHED = [keys.truth(RUN), keys.estimate(RUN, "a"), keys.config(RUN, "a")]
"""The keys to which no process of the mission subscribes."""
GHOST, OTHER = keys.command(RUN, "ghost"), keys.command(RUN, "b")
"""The keys of a robot that does not exist, and of one that did not send the Command put there."""


def framed(content: object, version: int = VERSION) -> bytes:
    """Return a frame with a correct CRC and any content."""
    body = content if isinstance(content, bytes) else msgspec.msgpack.encode(content)
    return struct.pack(">BI", version, zlib.crc32(body)) + body


def flipped(frame: bytes, bit: int) -> bytes:
    spoilt = bytearray(frame)
    spoilt[bit // 8] ^= 1 << bit % 8
    return bytes(spoilt)


def bad_frames(topic: str) -> dict[bytes, str]:
    """Return malformed frames of every kind for a key of `topic`, with the pattern of each error message."""
    message, limit = GENUINE[topic]
    frame = encode(message)
    said = msgspec.msgpack.decode(frame[5:])
    assert framed(said) == frame

    def with_field(place: int, value: object) -> bytes:
        return framed([*said[:place], value, *said[place + 1 :]])

    def with_number(value: float) -> bytes:
        field = {"observation": "anchor_range", "command": "v", "report": "start"}[topic]
        place = 1 + message.__struct_fields__.index(field)  # the tag comes first
        return with_field(place, [value, 0.0, 0.0] if topic == "report" else value)

    frames = {
        b"": "0 bytes, outside",
        frame[:4]: "4 bytes, outside",
        bytes(limit + 1): f"{limit + 1} bytes, outside",
        frame[:-1]: "damaged: the CRC does not match",
        flipped(frame, 9): "damaged: the CRC does not match",
        flipped(frame, 8 * len(frame) - 20): "damaged: the CRC does not match",
        framed(said, VERSION - 1): f"protocol version {VERSION - 1} of Tandem 0.2, this is version {VERSION}",
        framed(said, VERSION + 1): f"protocol version {VERSION + 1}, this is version {VERSION}",
        with_number(math.nan): "Expected `float` >= .* - at ",
        with_number(math.inf): "Expected `float` <= .* - at ",
        with_number(-1e300): "Expected `float` >= .* - at ",
        with_field(1, "zero"): re.escape("Expected `int`, got `str` - at `$[1]`"),
        with_field(1, -1): re.escape("Expected `int` >= 0 - at `$[1]`"),
        with_field(0, "teleport"): "Invalid value 'teleport'",
        with_field(2, "stranger"): "'stranger'",
        with_field(2, "no/robot"): "Expected `str` matching regex",
        framed(said[:2]): "Expected `array` of at least length",
        framed([*said, *[None] * 9]): "Expected `array` of at most length",
        framed({"tick": 0}): "Expected `array`, got `object`",
        framed(b"\xc1"): "malformed",
        framed(b"\x91" * 4000): "Expected",
    }
    if topic == "observation":  # it closes the robot's link and never arrives; see below
        del frames[bytes(limit + 1)]
    return frames


def publishers(link: zenoh.Session) -> dict[str, session.Publisher]:
    """Return a publisher for each key, once all subscribers match; an earlier put would be lost."""
    found = {key: session.publisher(link, key) for key in (*TRUSTED.values(), *WATCHED, GHOST, OTHER)}
    heard: set[str] = set()
    for key in (*TRUSTED.values(), GHOST, OTHER):
        session.on_matching(found[key], partial(mark, heard, key))
    until(lambda: len(heard) == len(TRUSTED) + 2, "everyone listens")
    return found


def mark(heard: set[str], key: str, matching: bool) -> None:
    if matching:
        heard.add(key)


def volley(stranger: Mapping[str, session.Publisher], nonsense: Mapping[str, Mapping[bytes, str]]) -> None:
    for key, frames in nonsense.items():
        for frame in frames:
            stranger[key].put(frame)


def complaints(command: TandemProcess, key: str) -> list[str]:
    """Return the messages of `command` about frames on `key`."""
    said = re.findall(rf"refused a frame on {re.escape(key)}: (.*)", command.err)
    return [str(why) for why in said]


def refused_on(key: str, command: TandemProcess, frames: Mapping[bytes, str]) -> None:
    """Assert that `command` reported each kind of frame, and each only once."""
    told = complaints(command, key)
    for frame, pattern in frames.items():
        assert any(re.search(pattern, why) for why in told), (frame[:40], told)
    assert len(told) == len(set(told))


def test_invalid_frames_before_the_first_tick_are_refused_counted_and_reported_once(tmp_path: Path) -> None:
    """Robot d is absent, so the tick does not advance while every other process listens."""
    scenario, out, alone = tmp_path / "pairs.toml", tmp_path / "out", tmp_path / "alone"
    scenario.write_text(several_pairs(2))
    nonsense = {key: bad_frames(topic) for topic, key in TRUSTED.items()}
    with world(scenario, "--run", RUN, "--out", out) as (clock, endpoint), ExitStack() as others:
        agents = [
            others.enter_context(TandemProcess("agent", robot, "--connect", endpoint, "--out", out))
            for robot in ("a", "b", "c")
        ]
        for robot, agent in zip("abc", agents, strict=True):
            agent.until_answered(robot, out)
        link = others.enter_context(stranger_at(endpoint))
        stranger = publishers(link)
        for _ in range(TIMES):
            volley(stranger, nonsense)
            volley(stranger, dict.fromkeys(WATCHED, bad_frames("observation")))
            stranger[GHOST].put(encode(Command(0, "ghost", 1.0, 0.0, 1, "haunting")))
            stranger[OTHER].put(encode(Command(0, "a", 1.0, 0.0, 1, "posing")))
        clock.until_prints(f"refused a frame on {OTHER}")
        assert isinstance(session.ask(link, keys.config(RUN, "*"), 5.0), str)
        agents.append(others.enter_context(TandemProcess("agent", "d", "--connect", endpoint, "--out", out)))
        assert clock.ended().status == 0
        assert [agent.ended().status for agent in agents] == [0] * 4

        refused_on(TRUSTED["command"], clock, nonsense[TRUSTED["command"]])
        for topic in ("observation", "report"):
            refused_on(TRUSTED[topic], agents[0], nonsense[TRUSTED[topic]])
        assert complaints(clock, GHOST) == ["its robot is given as 'ghost'"]
        assert complaints(clock, OTHER) == ["its robot is given as 'a'"]
        assert not any("Traceback" in command.err for command in (clock, *agents))

    assert tandem("run", scenario, "--in-process", "-q", "--out", alone).status == 0
    assert (out / "ticks.csv").read_bytes() == (alone / "ticks.csv").read_bytes()
    robots = json.loads((out / "summary.json").read_text())["robots"]
    observations, reports = (TIMES * len(nonsense[TRUSTED[topic]]) for topic in ("observation", "report"))
    assert [robots[name]["reports_refused"] for name in "abcd"] == [reports, 0, 0, 0]
    assert [robots[name]["frames_refused"] for name in "abcd"] == [observations + reports, 0, 0, 0]


@pytest.mark.long
def test_a_mission_is_not_disturbed_by_invalid_frames(tmp_path: Path) -> None:
    scenario, out, alone = tmp_path / "long.toml", tmp_path / "out", tmp_path / "alone"
    scenario.write_text(LONG)
    nonsense = {key: bad_frames(topic) for topic, key in TRUSTED.items()}
    for key in WATCHED:
        nonsense[key] = bad_frames("observation")
    fired = 0
    with world(scenario, "--run", RUN, "--out", out) as (clock, endpoint), ExitStack() as others:
        agents = [
            others.enter_context(TandemProcess("agent", robot, "--connect", endpoint, "--out", out))
            for robot in ("a", "b")
        ]
        stranger = publishers(others.enter_context(stranger_at(endpoint)))
        while fired < VOLLEYS and clock.running:
            clock.until_written(out / "world.journal", max(200, fired * LONG_JOURNAL_BYTES // VOLLEYS))
            volley(stranger, nonsense)
            fired += 1
            if fired == VOLLEYS // 2:
                stranger[TRUSTED["observation"]].put(bytes((1 << 20) + 1))
        assert fired == VOLLEYS
        assert clock.ended().status == 0
        assert [agent.ended().status for agent in agents] == [0, 0]
        for command in (clock, *agents):
            lines = [line for line in command.err.splitlines() if "the world has gone" not in line]
            assert len(lines) == len(set(lines))
            assert all(re.search("refused (a frame on|[0-9]+ frames in all)", line) for line in lines), lines

    assert tandem("run", scenario, "--in-process", "-q", "--out", alone).status == 0
    assert (out / "ticks.csv").read_bytes() == (alone / "ticks.csv").read_bytes()
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["outcome"], summary["ticks"]) == ("localised", LONG_TICKS)
    assert summary["robots"]["a"]["reports_refused"] > 0
    for robot in ("a", "b"):  # all frames but the FinalReport, which counts refused frames
        path = f"agent-{robot}.journal"
        assert list(read(out / path))[:-1] == list(read(alone / path))[:-1]


@pytest.mark.parametrize("topic", GENUINE)
def test_the_frame_that_is_mutated_is_itself_valid(topic: str) -> None:
    """Otherwise every frame would be refused for the same reason."""
    message, _ = GENUINE[topic]
    assert msgspec.msgpack.decode(encode(message)[5:], type=type(message)) == message


def test_a_storm_of_mutated_frames_on_every_key_disturbs_nothing(tmp_path: Path) -> None:
    """Each process refuses exactly the invalid frames; its memory stops growing in the first half."""
    tally = rage(STORM, seed=7, distance=40.0, folder=tmp_path)
    assert (tally.frames, tally.statuses, tally.outcome, tally.same) == (STORM, [0, 0, 0], "localised", True)
    for process, sizes in tally.memory.items():
        assert tally.accounted(process), (process, tally.treatments, tally.refused)
        assert sizes[-1] - sizes[2] < SETTLED_MB
    assert tally.late >= tally.treatments["world", "passed over"]
    assert "Traceback" not in tally.errors


# --- well-formed frames, with this test as the world and the peer ---------------------------------------


def test_a_robot_refuses_frames_out_of_step_and_uses_a_repeated_report_once(tmp_path: Path) -> None:
    scenario, endpoint, said = load("paper-1"), free_endpoint(), Inbox("test")

    def told(tick: int, **otherwise: object) -> Report:
        return replace(Report(tick, "b", 1, "straight", None, 0, 0, (), 0, (), 0, 0), **otherwise)

    def observation(tick: int) -> Observation:
        return Observation(tick, "a", REST if tick else None, 2.5, (Contact("b", 2.0, (tick,)),))

    with session.open_router(listening(endpoint)) as link:
        session.answer(link, keys.config(RUN, "*"), lambda *_: scenario.config("a"))
        session.subscribe(link, keys.command(RUN, "a"), said, "command")
        session.watch_liveliness(link, keys.robot_alive(RUN, "*"), said)
        world_says = session.publisher(link, keys.observation(RUN, "a"))
        peer_says = session.publisher(link, keys.report(RUN, "b", "a"))

        def play(tick: int, *reports: Report) -> None:
            """Send an Observation and `reports`, and expect the Command of `tick` and no other."""
            for report in reports:
                peer_says.put(encode(report))
            world_says.put(encode(observation(tick)))
            assert answer(said, Command).tick == tick

        _token = session.show_alive(link, keys.world_alive(RUN))
        with TandemProcess("agent", "a", "--connect", endpoint, "--out", tmp_path) as agent:
            assert said.next(BOUND_S).topic == "alive"
            play(0, told(0), told(0), told(0, robot="a"), told(0, robot="c"), told(0, state="otherwise"))
            play(1, told(1), told(2, state="too early"), told(0), told(0))
            play(2, told(2, state="as it is"), told(900), told(0, heard=1))
            for odd in (
                observation(0),
                observation(1),
                observation(4),
                observation(900),
                MissionEnd(1, "failed"),
            ):
                world_says.put(encode(odd))
            world_says.put(encode(replace(observation(2), anchor_range=1.0)))
            world_says.put(encode(MissionEnd(900, "localised")))
            play(3, told(3))
            world_says.put(encode(MissionEnd(3, "undecided", (Cause("dead", ("a",), (1,)),))))
            final_report = answer(said, FinalReport)
            world_says.put(encode(observation(1)))
            world_says.put(encode(final_report))
            assert agent.ended().status == 1
    assert (final_report.reports_heard, final_report.reports_unheard) == (4, 0)
    assert final_report.reports_refused == 6
    assert final_report.frames_refused == 6 + 7


def test_a_robot_of_a_group_refuses_reports_of_itself_and_of_robots_outside_the_mission() -> None:
    """It would store those of any number of senders. In a group, an agent receives the reports of all."""
    scenario, endpoint, said = parse(FAR, "four"), free_endpoint(), Inbox("test")
    with session.open_router(listening(endpoint)) as link:
        session.answer(link, keys.config(RUN, "*"), lambda *_: scenario.config("a"))
        session.subscribe(link, keys.command(RUN, "a"), said, "command")
        session.watch_liveliness(link, keys.robot_alive(RUN, "*"), said)
        world_says = session.publisher(link, keys.observation(RUN, "a"))
        senders = {robot: session.publisher(link, keys.report(RUN, robot, "a")) for robot in "abz"}
        _token = session.show_alive(link, keys.world_alive(RUN))
        with TandemProcess("agent", "a", "--connect", endpoint) as agent:
            assert said.next(BOUND_S).topic == "alive"  # it subscribes before
            world_says.put(encode(Observation(0, "a", None, 2.5)))
            assert answer(said, Command).tick == 0
            for robot, publisher in senders.items():
                publisher.put(encode(Report(0, robot, 1, "straight", None, 0, 0, (), 0, (), 0, 0)))
            agent.until_prints("/robot/z/to/a: its sender is not in this mission")
            world_says.put(encode(MissionEnd(0, "undecided", (Cause("dead", ("a",), (1,)),))))
            final_report = answer(said, FinalReport)
            world_says.put(encode(final_report))
            ended = agent.ended()
    assert ended.status == 1
    assert "/robot/a/to/a: its sender is not in this mission" in ended.err
    assert (final_report.reports_refused, final_report.reports_unheard) == (2, 1)


def answer(said: Inbox, kind: type[Message]) -> Any:
    arrival = said.next(BOUND_S)
    assert arrival.topic == "command"
    return decode(arrival.frame, kind)


# --- a flood of frames --------------------------------------------------------------------------------


def flooded(topic: Topic, key: str, size: int) -> tuple[Inbox, int]:
    """Return an inbox full of frames of `size` bytes on `key`, and the number of refused frames."""
    full = Inbox("test")
    room = inbox.ROOM_BYTES // (size + len(key) + inbox.ARRIVAL_BYTES)
    for _ in range(room + 1000):
        full.put(topic, key, bytes(size))
    return full, 1000


@pytest.mark.parametrize("size", [0, 100, 40_000])
def test_a_flood_of_frames_is_bounded_counted_and_reported_once(
    size: int, capsys: pytest.CaptureFixture[str]
) -> None:
    full, dropped = flooded("report", "some/key", size)
    waiting = 0
    while full.next(0.0) is not inbox.NO_ARRIVAL:
        waiting += 1
    assert inbox.ROOM_BYTES / 2 < waiting * (size + 208) <= inbox.ROOM_BYTES
    assert full.refused == {"report": dropped}
    assert capsys.readouterr().err == "test: refused a frame on some/key: the queue is full\n"
    full.put("report", "some/key", b"again")
    assert full.next(0.0) == Arrival("report", "some/key", b"again")


def test_a_flood_leaves_other_topics_their_room() -> None:
    full, _ = flooded("report", "some/key", 1000)
    full.put("observation", "another", b"needed")
    full.put("stop", "SIGTERM")
    came: list[Arrival] = []
    with pytest.raises(Interrupted, match="SIGTERM"):
        came.extend(iter(partial(full.next, 0.0), inbox.NO_ARRIVAL))
    assert came[-1] == Arrival("observation", "another", b"needed")


def test_a_frame_larger_than_the_inbox_is_reported() -> None:
    alone = Inbox("test")
    alone.put("observation", "key", bytes(inbox.ROOM_BYTES + 1))
    assert len(alone.next(0.0).frame) == inbox.ROOM_BYTES + 1
