"""The replay of a recording: identical to the bit; what differs is reported, with the versions behind it."""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from agent.process.recovery import remember
from compose.audit.rules import replayed
from compose.launch import in_process
from compose.launch.planner_loader import planner_of
from compose.recording.recording_files import KINDS, WORLD_JOURNAL, agent_journal
from compose.recording.run import of_frames
from compose.scenario.scenario_file import load, parse
from protocol.journal import environment, journal_file
from protocol.journal.journal_file import CorruptJournal
from protocol.journal.resume import Retrace
from protocol.messages import Command, Environment, Estimate, MissionEnd, Observation, Report
from protocol.wire import MAX_FRAME_BYTES, VERSION, MalformedFrame, decode, encode
from tests.commands import journals, refused, tandem
from tests.missions import kept
from tests.replays import scenario as random_plan
from world.scenario import Scenario

HEAD = 5
"""The number of bytes of a frame before its body."""
TRIES = 100
A, B = agent_journal("a"), agent_journal("b")
UNUSED = {"name", "seed", "max_ticks"}
"""The fields without effect on a recording if starts are given and sensors are exact."""


@pytest.fixture(scope="module")
def paper_1() -> dict[str, list[bytes]]:
    return kept(load("paper-1"))


@pytest.mark.parametrize(
    "played",
    [
        *[pytest.param(load(name), id=name) for name in ("paper-1", "paper-2")],
        *[pytest.param(load("random", seed=seed), id=f"random-{seed}") for seed in range(5)],
        *[
            pytest.param(parse(random_plan(random.Random(seed)), "plan"), id=f"plan-{seed}")
            for seed in range(1, 6)
        ],
    ],
)
def test_a_run_in_one_process_is_replayed_bit_by_bit(played: Scenario) -> None:
    again = replayed(of_frames(kept(played)))
    assert (again.differences, again.tears) == ((), ())
    assert again.checks > 2 * len(played.robots) * again.ticks > 0


def test_a_run_as_processes_is_replayed_bit_by_bit(tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert tandem("run", "random", "--fault", "loss=0.3, delay=0..2", "-q", "--out", out).status == 0
    before = journals(out)
    ended = tandem("replay", out)
    assert (ended.status, ended.err) == (0, "")
    assert ended.out.startswith("random: as recorded, to the bit, over ")
    assert journals(out) == before


def test_run_replay_and_audit_count_the_same_ticks(tmp_path: Path) -> None:
    out = tmp_path / "out"
    ran = tandem("run", "paper-1", "--in-process", "--no-export", "-q", "--out", out).out
    assert ran == "localised after 48 ticks\n"
    assert "as recorded, to the bit, over 48 ticks" in tandem("replay", out).out
    assert "no violations over 48 ticks" in tandem("audit", out).out


# --- one bit --------------------------------------------------------------------------------------------


def flips(recording: dict[str, list[bytes]], tries: int) -> Iterator[tuple[str, int, bytes]]:
    """Yield frames with one flipped bit in their message and a valid CRC, each with its journal and index."""
    draw = random.Random(6)
    places = [(name, i) for name, frames in recording.items() for i in range(len(frames))]
    while tries:
        name, place = draw.choice(places)
        frame = recording[name][place]
        body = bytearray(frame[HEAD:])
        body[draw.randrange(len(body))] ^= 1 << draw.randrange(8)
        flipped = frame[:1] + zlib.crc32(body).to_bytes(4, "big") + bytes(body)
        if _matters(frame, flipped):
            tries -= 1
            yield name, place, flipped


def _matters(frame: bytes, flipped: bytes) -> bool:
    """Return true if `flipped` differs in content that affects the replay or is also in another journal."""
    before = decode(frame, KINDS, MAX_FRAME_BYTES)
    try:
        after = decode(flipped, KINDS, MAX_FRAME_BYTES)
    except MalformedFrame:
        return False  # it cannot be decoded: no journal with it can be read
    if isinstance(before, Scenario) and isinstance(after, Scenario):
        unused = {name: getattr(before, name) for name in UNUSED}
        return encode(replace(after, **unused)) != encode(before)
    return encode(after) != encode(before)


@pytest.mark.parametrize("name", ["paper-1", "paper-2"])
def test_one_flipped_bit_in_any_value_that_matters_is_found(name: str) -> None:
    recording = kept(load(name))
    for book, place, flipped in flips(recording, TRIES // 2):
        frames = [*recording[book][:place], flipped, *recording[book][place + 1 :]]
        again = replayed(of_frames(recording | {book: frames}))
        was, now = (decode(one, KINDS, MAX_FRAME_BYTES) for one in (recording[book][place], flipped))
        assert again.differences, (book, place, was, now)


def planted(folder: Path, name: str, kind: type, tick: int, **fields: Any) -> tuple[Any, Any]:
    """Change a message in a journal, and return the message before and after."""
    frames = list(journal_file.read(folder / name))
    told = [decode(frame, KINDS, MAX_FRAME_BYTES) for frame in frames]
    (place,) = (i for i, one in enumerate(told) if isinstance(one, kind) and getattr(one, "tick", 0) == tick)
    changed = replace(told[place], **fields)
    frames[place] = encode(changed)
    (folder / name).write_bytes(journal_file.packed(frames))
    return told[place], changed


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    in_process.run_mission(load("paper-1"), tmp_path / "record")
    return tmp_path / "record"


def test_the_first_difference_is_shown_with_tick_robot_field_and_both_values(recording: Path) -> None:
    before, after = planted(recording, A, Command, 12, v=0.125)
    ended = tandem("replay", recording)
    assert (ended.status, ended.err) == (1, "")
    lines = ended.out.splitlines()
    assert lines[:2] == [
        "paper-1: not as recorded",
        f"tick 12, a, Command v: recorded {after.v!r}, recomputed {before.v!r}",
    ]
    assert lines[2] == "and 1 more, which `tandem audit` lists"


def test_a_value_is_shown_however_deep_it_stands(recording: Path) -> None:
    told = [decode(frame, KINDS, MAX_FRAME_BYTES) for frame in journal_file.read(recording / A)]
    observation = next(one for one in told if isinstance(one, Observation) and one.contacts)
    (contact,) = observation.contacts
    assert contact.range is not None
    planted(
        recording, A, Observation, observation.tick, contacts=(replace(contact, range=contact.range + 1e-15),)
    )
    (first, *_) = tandem("replay", recording).out.splitlines()[1:]
    assert first == (
        f"tick {observation.tick}, a, Observation contacts[0].range: "
        f"recorded {contact.range + 1e-15!r}, recomputed {contact.range!r}"
    )


def test_a_command_that_differs_in_the_worlds_journal_is_found(recording: Path) -> None:
    frames = list(journal_file.read(recording / WORLD_JOURNAL))
    command = decode(frames[2 + 2 * 20 + 1], Command)
    assert (command.robot, command.tick) == ("b", 20)
    frames[2 + 2 * 20 + 1] = encode(replace(command, omega=command.omega + 1e-9))
    (recording / WORLD_JOURNAL).write_bytes(journal_file.packed(frames))
    ended = tandem("replay", recording)
    assert ended.status == 1
    assert ended.out.splitlines()[1].startswith("tick 20, b, Command omega: recorded ")


def changed(recording: dict[str, list[bytes]], name: str, was: Any, **fields: Any) -> dict[str, list[bytes]]:
    """Return `recording` with changed fields in one message of a journal."""
    frames = [encode(replace(was, **fields)) if one == encode(was) else one for one in recording[name]]
    assert frames != recording[name]
    return recording | {name: frames}


def test_a_report_that_was_received_differently_than_sent_is_found(paper_1: dict[str, list[bytes]]) -> None:
    heard = [decode(frame, KINDS, MAX_FRAME_BYTES) for frame in paper_1[B]]
    told = next(one for one in heard if isinstance(one, Report) and one.robot == "a")
    first, *_ = replayed(of_frames(changed(paper_1, B, told, state="listening"))).differences
    assert (first.rule, first.robot) == ("report", "b")


def test_a_received_report_that_no_observation_lists_is_found(paper_1: dict[str, list[bytes]]) -> None:
    frames = list(paper_1[B])
    heard = [decode(frame, KINDS, MAX_FRAME_BYTES) for frame in frames]
    place = next(i for i, one in enumerate(heard) if isinstance(one, Report) and one.robot == "a")
    frames.insert(place, frames[place])
    assert "contact" in {one.rule for one in replayed(of_frames(paper_1 | {B: frames})).differences}


def test_a_wrong_mission_end_is_found_though_all_journals_agree(
    paper_1: dict[str, list[bytes]],
) -> None:
    end = next(
        one for frame in paper_1[A] if isinstance(one := decode(frame, KINDS, MAX_FRAME_BYTES), MissionEnd)
    )
    recording = paper_1
    for name in paper_1:
        recording = changed(recording, name, end, outcome="undecided")
    assert [(one.rule, one.tick) for one in replayed(of_frames(recording)).differences] == [
        ("claim", end.tick)
    ]


# --- truncation -----------------------------------------------------------------------------------------


def cut(path: Path, size: int) -> int:
    """Truncate a journal to `size` bytes, and return how many of them are an incomplete frame."""
    path.write_bytes(path.read_bytes()[:size])
    return size - len(journal_file.packed(journal_file.read(path)))


@pytest.mark.parametrize("name", [WORLD_JOURNAL, A, B])
def test_a_truncated_recording_is_replayed_up_to_the_truncation(
    name: str, paper_1: dict[str, list[bytes]]
) -> None:
    for count in range(2, len(paper_1[name]), 3):  # after the versions and the scenario, or a RobotConfig
        again = replayed(of_frames(paper_1 | {name: paper_1[name][:count]}))
        assert again.differences == ()
        assert again.tears


def test_the_place_of_a_truncation_is_reported(recording: Path) -> None:
    rest = cut(recording / A, 4000)
    last = [decode(frame, KINDS, MAX_FRAME_BYTES) for frame in journal_file.read(recording / A)][-1]
    (recording / B).unlink()
    ended = tandem("replay", recording)
    assert (ended.status, ended.err) == (0, "")
    as_recorded, *tears = ended.out.splitlines()
    assert as_recorded.startswith("paper-1: as recorded, to the bit, over 48 ticks ")
    assert rest > 0
    assert tears == [
        "no tick, b: its journal is missing",
        f"tick {last.tick}, a: its journal breaks off here, expected MissionEnd and FinalReport",
        f"agent-a.journal ends with {rest} bytes of a torn write",
    ]


def test_a_frame_of_a_wrong_length_is_not_a_truncation(recording: Path) -> None:
    frames = list(journal_file.read(recording / A))
    data = bytearray((recording / A).read_bytes())
    data[len(journal_file.packed(frames[:20])) + 1] = 0xFF
    (recording / A).write_bytes(data)
    refused(tandem("replay", recording), f"tandem replay: {recording / A}: damaged at byte ")


WORLD = "world.journal"
OLDER = "0.0.9"


def rewritten(path: Path, kind: type, change: Callable[..., object | None], first: int = 0) -> None:
    """Rewrite the journal with the first message of `kind` from tick `first` on replaced by `change`."""
    frames: list[bytes] = []
    done = False
    for frame in journal_file.read(path):
        message: object
        try:
            message = decode(frame, kind)
        except MalformedFrame:
            message = None
        if done or message is None or getattr(message, "tick", first) < first:
            frames.append(frame)
            continue
        done = True
        new = change(message)
        frames += [] if new is None else [encode(new)]
    path.write_bytes(journal_file.packed(frames))


def elsewhere(path: Path) -> None:
    rewritten(path, Environment, lambda one: replace(one, tandem=OLDER))


def turned(by: float) -> Callable[[Estimate], Estimate]:
    """Return a function that changes the first pose of an Estimate by the relative amount `by`."""

    def turn(one: Estimate) -> Estimate:
        first, *others = one.local
        return replace(one, local=(replace(first, y=first.y * (1.0 + by)), *others))

    return turn


def test_a_journals_first_frame_names_versions_and_instruction_set(recording: Path) -> None:
    import numpy as np  # noqa: PLC0415

    told = decode(next(journal_file.read(recording / A)), Environment)
    assert told.numpy is not None
    assert told.numpy.startswith(np.__version__)
    assert told.linear_algebra
    assert told.c_library
    assert told.instruction_set
    assert told == environment.of_robot()
    world = decode(next(journal_file.read(recording / WORLD)), Environment)
    assert world == replace(told, numpy=None, linear_algebra=None)


def test_a_robot_names_the_instructions_that_numpy_and_linear_algebra_really_use() -> None:
    told = [
        subprocess.run(
            [sys.executable, "-c", "from protocol.journal import environment; print(environment.of_robot())"],
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1]), **more},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for more in ({}, {"OPENBLAS_CORETYPE": "Prescott"})
    ]
    if "OpenBLAS" not in told[0] or "(one kernel)" in told[0]:
        pytest.skip("numpy has no OpenBLAS that chooses its kernels")
    assert told[0] != told[1]


@pytest.mark.parametrize("command", ["replay", "audit"])
def test_last_bits_that_differ_under_other_versions_are_explained(command: str, recording: Path) -> None:
    elsewhere(recording / A)
    rewritten(recording / A, Estimate, turned(1e-13), first=20)
    ended = tandem(command, recording)
    assert ended.status == 0, ended
    assert f"recorded with tandem {OLDER}; here is tandem {environment.of_robot().tandem}" in ended.out
    assert "by rounding alone" in ended.out
    assert "not as recorded" not in ended.out


@pytest.mark.parametrize("command", ["replay", "audit"])
def test_last_bits_under_the_same_versions_are_a_difference(command: str, recording: Path) -> None:
    rewritten(recording / A, Estimate, turned(1e-13), first=20)
    ended = tandem(command, recording)
    assert ended.status == 1
    assert "rounding" not in ended.out


@pytest.mark.parametrize("command", ["replay", "audit"])
def test_more_than_last_bits_is_a_difference_whatever_the_versions(command: str, recording: Path) -> None:
    elsewhere(recording / A)
    rewritten(recording / A, Estimate, turned(1e-3), first=20)
    ended = tandem(command, recording)
    assert ended.status == 1
    assert f"recorded with tandem {OLDER}" in ended.out
    assert "can lead to other decisions" in ended.out


def of_protocol(version: int, folder: Path) -> None:
    """Rewrite the version byte of all frames of the recording, as another release has it."""
    for path in folder.glob("*.journal"):
        frames = [bytes([version]) + frame[1:] for frame in journal_file.read(path)]
        path.write_bytes(journal_file.packed(frames))


@pytest.mark.parametrize("command", ["replay", "audit", "figures", "export", "watch"])
@pytest.mark.parametrize(
    ("version", "release"), [(1, " of Tandem 0.1"), (2, " of Tandem 0.2"), (VERSION + 1, "")]
)
def test_a_recording_of_another_protocol_is_refused_once_with_the_remedy(
    command: str, version: int, release: str, recording: Path
) -> None:
    of_protocol(version, recording)
    ended = tandem(command, recording)
    assert (ended.status, ended.out, ended.err.count("\n")) == (2, "", 1)
    remedy = "run its scenario again, or read it with the release that wrote it"
    assert ended.err.endswith(f": protocol version {version}{release}, this is version {VERSION}; {remedy}\n")
    assert ended.err.count("protocol version") == 1


@pytest.mark.parametrize(
    ("process", "journal"),
    [
        (("world", "paper-1", "--listen", "tcp/127.0.0.1:7447"), WORLD),
        (("agent", "a", "--connect", "tcp/127.0.0.1:7447"), A),
        (("robot", "a", "--mission", "paper-1", "--driver", "docs.rover:Rover"), "driver-a.journal"),
    ],
)
def test_a_recording_of_another_protocol_is_not_resumed(
    process: tuple[str, ...], journal: str, recording: Path
) -> None:
    shutil.copy(recording / A, recording / "driver-a.journal")
    of_protocol(2, recording)
    ended = tandem(*process, "--out", recording)
    versions = f"protocol version 2 of Tandem 0.2, this is version {VERSION}"
    said = f"--out: {recording / journal}: {versions}; choose another folder\n"
    assert (ended.status, ended.out, ended.err.count("\n")) == (2, "", 1)
    assert ended.err.endswith(said)


def test_a_robot_resumes_on_another_machine_unless_its_decisions_differ(recording: Path) -> None:
    path = recording / A
    elsewhere(path)
    before = path.read_bytes()
    with closing(Retrace(path)) as retrace:
        memory = remember(retrace, planner_of)
        assert memory is not None
        assert memory.end is not None
    assert path.read_bytes() == before
    rewritten(path, Command, lambda one: replace(one, omega=one.omega + 1e-15), first=20)
    again = f"at tick 20: recorded with tandem {OLDER}; here is tandem"
    with closing(Retrace(path)) as retrace, pytest.raises(CorruptJournal, match=again):
        remember(retrace, planner_of)
