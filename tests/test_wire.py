"""A frame is decoded completely, or refused with MalformedFrame, also by several threads at first."""

from __future__ import annotations

import math
import struct
import subprocess
import sys
import zlib
from collections.abc import Iterator
from functools import reduce
from operator import or_
from typing import Any

import msgpack
import msgspec
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from compose.launch import in_process
from compose.scenario.scenario_file import load
from protocol.coverage_strips import SweptArea
from protocol.messages import (
    MAX_REPORT_RANGES,
    MAX_REPORT_RUNS,
    Command,
    Estimate,
    FinalReport,
    Member,
    Message,
    MissionEnd,
    Observation,
    Report,
    RobotConfig,
)
from protocol.mission import Mission
from protocol.wire import MAX_FRAME_BYTES, VERSION, MalformedFrame, decode, encode
from tests.examples import CONFIG, EXAMPLES
from world.scenario import Scenario

KINDS = {*Message.__subclasses__()}
ANY: Any = reduce(or_, sorted(KINDS, key=lambda kind: kind.__name__))
OPTIONS = ("step", "gain", "way", "on")
"""The options in an example of a RobotConfig."""
BODY = (1 + Report.__struct_fields__.index("body"),)
"""The path of the body in a Report."""
HEAD = 5
"""The number of bytes before the body: the version and the CRC-32."""

by_message = pytest.mark.parametrize(
    "message", EXAMPLES, ids=[f"{i}-{type(message).__name__}" for i, message in enumerate(EXAMPLES)]
)


def framed(body: bytes, version: int = VERSION) -> bytes:
    """Return a frame with `body` in place of a message."""
    return struct.pack(">BI", version, zlib.crc32(body)) + body


def packed(value: object) -> bytes:
    body: bytes = msgpack.packb(value)
    return body


def plain(message: Message) -> Any:
    """Return the message as any msgpack library decodes it."""
    return msgpack.unpackb(encode(message)[HEAD:])


def refuses(frame: bytes, kind: Any = ANY) -> None:
    with pytest.raises(MalformedFrame):
        decode(frame, kind)


# --- encoding ----------------------------------------------------------------------------------------


def test_there_is_an_example_of_every_message() -> None:
    assert {type(message) for message in EXAMPLES} == KINDS


@by_message
def test_a_message_comes_back_as_it_was_sent(message: Message) -> None:
    assert decode(encode(message), type(message)) == message
    assert decode(encode(message), ANY) == message


@pytest.mark.parametrize("name", ["paper-1", "paper-2", "random"])
def test_a_scenario_comes_back_as_it_was_journaled(name: str) -> None:
    scenario = load(name)
    assert decode(encode(scenario), Scenario) == scenario


@by_message
def test_any_msgpack_library_reads_what_we_send(message: Message) -> None:
    frame = encode(message)
    assert frame[0] == VERSION
    assert frame[1:HEAD] == zlib.crc32(frame[HEAD:]).to_bytes(4, "big")
    if getattr(message, "body", None) is None:  # JSON has no bytes
        assert plain(message) == msgspec.json.decode(msgspec.json.encode(message))
    assert plain(message)[0] == type(message).__struct_config__.tag
    assert decode(framed(packed(plain(message))), ANY) == message


# --- refusals ----------------------------------------------------------------------------------------


@by_message
def test_a_truncated_frame_is_refused(message: Message) -> None:
    frame = encode(message)
    for length in range(len(frame)):
        refuses(frame[:length])
        if length > HEAD:  # the CRC is valid, and the message is truncated
            refuses(framed(frame[HEAD:length]))


@by_message
def test_a_frame_with_any_bit_flipped_is_refused(message: Message) -> None:
    frame = encode(message)
    for i in range(len(frame)):
        for bit in range(8):
            refuses(frame[:i] + bytes([frame[i] ^ 1 << bit]) + frame[i + 1 :])


@by_message
def test_a_frame_with_something_behind_it_is_refused(message: Message) -> None:
    frame = encode(message)
    refuses(frame + b"\x00")
    refuses(framed(frame[HEAD:] + b"\xc0"))
    refuses(framed(frame[HEAD:] * 2))


@pytest.mark.parametrize("version", [0, VERSION + 1, 255])
def test_another_version_is_refused_and_named(version: int) -> None:
    body = encode(EXAMPLES[0])[HEAD:]
    with pytest.raises(MalformedFrame, match=f"version {version}, this is version {VERSION}"):
        decode(framed(body, version), ANY)


def test_an_oversized_frame_is_refused_even_if_it_is_sound() -> None:
    frame = encode(EXAMPLES[1])
    assert decode(frame, ANY, len(frame)) == EXAMPLES[1]
    with pytest.raises(MalformedFrame, match=f"{len(frame)} bytes"):
        decode(frame, ANY, len(frame) - 1)
    refuses(framed(packed(["command", 3, "b" * MAX_FRAME_BYTES, 0.5, 0.25, 3, "localised", None]), VERSION))


@pytest.mark.parametrize("tag", ["teleport", "Sense", "", 3, None, ["observation"]])
def test_an_unknown_tag_is_refused(tag: object) -> None:
    refuses(framed(packed([tag, *plain(EXAMPLES[1])[1:]])))


@by_message
def test_a_message_of_another_kind_is_refused(message: Message) -> None:
    for kind in (Observation | MissionEnd, Command | FinalReport, Report):
        if not isinstance(message, kind):
            refuses(encode(message), kind)


Path = tuple[object, ...]


def parts(value: Any, path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """Yield every value in a msgpack tree with its path, except for the tag at the top."""
    yield path, value
    if isinstance(value, list):
        for i, item in enumerate(value):
            if path or i:
                yield from parts(item, (*path, i))
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from parts(item, (*path, key))


def changed(value: Any, path: Path, new: object) -> Any:
    """Return a copy of the tree with `new` at `path`."""
    if not path:
        return new
    step, *rest = path
    if isinstance(value, dict):
        return value | {step: changed(value[step], tuple(rest), new)}
    return [changed(item, tuple(rest), new) if i == step else item for i, item in enumerate(value)]


def is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


@by_message
def test_what_is_no_finite_number_within_bounds_is_refused(message: Message) -> None:
    tree = plain(message)
    for path, value in parts(tree):
        if is_number(value):
            for bad in (math.nan, math.inf, -math.inf, 1e300, -1e300, -(2**63), 2**64 - 1):
                refuses(framed(packed(changed(tree, path, bad))))
        if is_number(value) and isinstance(value, int) and path[-1] not in OPTIONS:
            refuses(framed(packed(changed(tree, path, -1))))
            refuses(framed(packed(changed(tree, path, 0.5))))


@by_message
def test_a_value_of_the_wrong_type_is_refused(message: Message) -> None:
    tree = plain(message)
    for path, value in parts(tree):
        if (tree[0] == "report" and path == BODY) or (path and path[-1] in OPTIONS):
            continue  # the body of a report, and the value of an option, may be of several types
        wrong: list[object] = [b"\x00", {1: 1}, [[[]]], msgpack.ExtType(5, b"")]
        if not isinstance(value, bool):
            wrong.append(True)
        if is_number(value) or isinstance(value, list | dict):
            wrong.append("1.0")
        if isinstance(value, str):
            wrong.append(1.0)
        for bad in wrong:
            refuses(framed(packed(changed(tree, path, bad))))


def _understood(frame: bytes) -> object:
    """Return the message; None if it is refused. Other errors are failures."""
    try:
        return decode(frame, ANY)
    except MalformedFrame:
        return None


@by_message
def test_an_extra_field_is_refused_wherever_it_stands(message: Message) -> None:
    tree = plain(message)
    for path, value in parts(tree):
        if isinstance(value, list):
            refuses(framed(packed(changed(tree, path, [*value, {}]))))
        if isinstance(value, dict):
            refuses(framed(packed(changed(tree, path, value | {"no field": 1.0}))))


@pytest.mark.parametrize("robot", ["", "a/b", "a b", "*", "a" * 33, "a\n", "ä", "a\x00", "$"])
def test_a_robot_that_is_no_single_chunk_of_a_key_is_refused(robot: str) -> None:
    refuses(framed(packed(["deadline-missed", 8, robot])))


def test_an_estimate_whose_probabilities_are_not_those_of_its_poses_is_refused() -> None:
    """Readers of recordings and viewers of live missions count on it."""
    sound = next(one for one in EXAMPLES if isinstance(one, Estimate) and one.probabilities)
    local, probabilities = 3, 6
    assert len(sound.probabilities) == len(sound.local) == 1
    refuses(framed(packed(changed(plain(sound), (probabilities,), [0.5, 0.5]))))
    refuses(framed(packed(changed(plain(sound), (local,), []))))


def test_too_many_entries_and_too_long_words_are_refused() -> None:
    sound = plain(EXAMPLES[3])
    runs, ranges, state = 8, 9, 4
    assert sound[runs] == [[4, 1.0, 0.0], [3, 0.5, -0.25]]
    refuses(framed(packed(changed(sound, (runs,), [[1, 1.0, 0.0]] * (MAX_REPORT_RUNS + 1)))))
    refuses(framed(packed(changed(sound, (ranges,), [[1, 1.0]] * (MAX_REPORT_RANGES + 1)))))
    refuses(framed(packed(changed(sound, (state,), "x" * 33))))
    refuses(framed(packed(["end", 48, "failed", "x" * 301])))


@pytest.mark.parametrize(
    "body",
    [
        b"\xc1",
        b"\x91" * 100_000,
        b"\x81\x01" * 100_000,
        b"\x93\xa6missed\x08\xa1\xff",
        b"\xdd\xff\xff\xff\xff",
        b"\xdf\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\x93\xa6missed\xcf\xff\xff\xff\xff\xff\xff\xff\xff\xa1a",
    ],
    ids=["reserved", "deep", "deep map", "not UTF-8", "huge array", "huge map", "huge bytes", "huge tick"],
)
def test_a_hostile_body_is_refused(body: bytes) -> None:
    refuses(framed(body))
    refuses(framed(body), Observation | MissionEnd)
    refuses(framed(body), Scenario)


@settings(max_examples=200)
@given(st.binary(max_size=300))
@example(b"")
def test_random_bytes_are_refused(frame: bytes) -> None:
    refuses(frame)
    refuses(bytes([VERSION]) + frame)


msgpack_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=8)
    | st.sampled_from([str(kind.__struct_config__.tag) for kind in Message.__subclasses__()]),
    lambda inner: (
        st.lists(inner, max_size=12)
        | st.dictionaries(st.text(max_size=8) | st.integers(0, 9), inner, max_size=4)
    ),
    max_leaves=20,
)


@settings(max_examples=60)
@given(st.binary(max_size=60) | msgpack_values.map(packed))
def test_any_body_is_a_message_or_refused(body: bytes) -> None:
    assert isinstance(_understood(framed(body)), Message | None)


@settings(max_examples=200)
@given(st.sampled_from(EXAMPLES), st.data(), msgpack_values)
@pytest.mark.long
def test_a_message_with_anything_anywhere_is_a_message_or_refused(
    message: Message, data: st.DataObject, value: object
) -> None:
    tree = plain(message)
    path, _ = data.draw(st.sampled_from(list(parts(tree))))
    understood = _understood(framed(packed(changed(tree, path, value))))
    assert isinstance(understood, Message | None)
    if understood is not None:
        assert decode(encode(understood), ANY) == understood


def test_a_mission_without_one_of_its_parameters_is_refused() -> None:
    """The accuracy and the noise are optional."""
    tree = plain(EXAMPLES[0])
    path, mission = next((path, value) for path, value in parts(tree) if isinstance(value, dict))
    assert tuple(mission) == Mission.__struct_fields__
    for parameter in msgspec.structs.fields(Mission):
        kept = {name: value for name, value in mission.items() if name != parameter.name}
        if parameter.required:
            refuses(framed(packed(changed(tree, path, kept))))
        else:
            assert decode(framed(packed(changed(tree, path, kept))), ANY) == EXAMPLES[0]


# --- one class of each kind --------------------------------------------------------------------------


def test_a_configuration_whose_fields_contradict_each_other_is_refused() -> None:
    area = SweptArea(-1.0, -1.0, 1.0, 1.0, 2)
    members = (Member("b", CONFIG.peer_anchor, 9),)
    alone = {"given_anchor": None, "unanchored": ("a",), "sweep": area, "members": members}
    sound = replace(CONFIG, **alone)
    assert decode(encode(sound), RobotConfig) == sound
    with pytest.raises(LookupError, match="a has no anchor"):
        _ = sound.anchor
    for name, value in {"unanchored": ("c",), "sweep": None, "members": ()}.items():
        position = 1 + RobotConfig.__struct_fields__.index(name)
        refuses(framed(packed(changed(plain(sound), (position,), msgspec.to_builtins(value)))), RobotConfig)
    refuses(framed(packed(changed(plain(sound), (4,), [0.0, 0.0]))), RobotConfig)


def test_the_reports_of_a_pair_are_at_most_a_tenth_larger_than_in_version_2() -> None:
    run, before = in_process.run_mission(load("paper-1")), 1266
    sent = sum(report.bytes_sent for report in run.final_reports.values())
    assert before < sent <= 1.1 * before


@pytest.mark.parametrize(
    "cause",
    [
        ["wrong", ["a"], [], None],
        ["wrong", ["a"], [1.0, 1.0, 1.0], None],
        ["dead", ["a", "b"], [1], None],
        ["max-ticks", [], [], None],
        ["inconsistent", [], [], "x"],
        ["failed", ["a"], [], "x"],
    ],
)
def test_a_cause_without_what_its_text_needs_is_refused(cause: list[object]) -> None:
    """The viewers make the text of causes that anyone may have sent."""
    refuses(framed(packed(["mission-end", 48, "failed", [cause]])))


# --- several threads: by itself, msgspec crashes the process if several first decode a type ---------------

AT_ONCE = """
import sys, threading
sys.setswitchinterval(1e-7)
begin, ended = threading.Barrier(4), []

def first():
    begin.wait()
    decode_all()
    ended.append(True)

threads = [threading.Thread(target=first) for _ in range(4)]
for one in threads:
    one.start()
for one in threads:
    one.join()
print(len(ended))
"""
FRAMES = """
from protocol.wire import decode, encode
from tests.examples import EXAMPLES

frames = [(encode(one), type(one)) for one in EXAMPLES]

def decode_all():
    for frame, kind in frames:
        decode(frame, kind)
"""


def of_four_threads(code: str) -> tuple[int, str]:
    """Return the exit status of a new process, and how many of its threads could run `decode_all`."""
    ended = subprocess.run(
        [sys.executable, "-c", code + AT_ONCE], stdout=subprocess.PIPE, check=False, timeout=60.0
    )
    return ended.returncode, ended.stdout.decode().strip()


def test_several_threads_can_be_the_first_that_decode_messages() -> None:
    for _ in range(3):
        assert of_four_threads(FRAMES) == (0, "4")
