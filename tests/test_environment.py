"""The versions in a journal, and the message of a replay that differs because of them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from msgspec.structs import replace

from agent.process.recovery import remember
from compose.launch import in_process
from compose.launch.planner_loader import planner_of
from compose.scenario.scenario_file import load
from protocol.journal import environment, journal_file
from protocol.journal.journal_file import CorruptJournal
from protocol.journal.resume import Retrace
from protocol.messages import Command, Environment, Estimate
from protocol.wire import VERSION, MalformedFrame, decode, encode
from tests.commands import tandem

A, WORLD = "agent-a.journal", "world.journal"
OLDER = "0.0.9"


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    in_process.run_mission(load("paper-1"), tmp_path)
    return tmp_path


def changed(path: Path, kind: type, change: Callable[..., object | None], first: int = 0) -> None:
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
    changed(path, Environment, lambda one: replace(one, tandem=OLDER))


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
    changed(recording / A, Estimate, turned(1e-13), first=20)
    ended = tandem(command, recording)
    assert ended.status == 0, ended
    assert f"recorded with tandem {OLDER}; here is tandem {environment.of_robot().tandem}" in ended.out
    assert "by rounding alone" in ended.out
    assert "not as recorded" not in ended.out


@pytest.mark.parametrize("command", ["replay", "audit"])
def test_last_bits_under_the_same_versions_are_a_difference(command: str, recording: Path) -> None:
    changed(recording / A, Estimate, turned(1e-13), first=20)
    ended = tandem(command, recording)
    assert ended.status == 1
    assert "rounding" not in ended.out


@pytest.mark.parametrize("command", ["replay", "audit"])
def test_more_than_last_bits_is_a_difference_whatever_the_versions(command: str, recording: Path) -> None:
    elsewhere(recording / A)
    changed(recording / A, Estimate, turned(1e-3), first=20)
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
    changed(path, Command, lambda one: replace(one, omega=one.omega + 1e-15), first=20)
    again = f"at tick 20: recorded with tandem {OLDER}; here is tandem"
    with closing(Retrace(path)) as retrace, pytest.raises(CorruptJournal, match=again):
        remember(retrace, planner_of)
