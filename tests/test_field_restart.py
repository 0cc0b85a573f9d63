"""`tandem robot`, killed at any moment, goes on from its record by the same command."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from signal import SIGKILL

import msgpack
import pytest

from compose.local import free_endpoint
from protocol import journal
from protocol.messages import Sense
from protocol.wire import MalformedFrame, decode
from tests.commands import Command, processes_of, size, tandem, until
from tests.test_field import ASSURED, STARTS, beacon, both_localised, messages, told


class Pair:
    """Both robots, and how to start one of them again by the same command."""

    def __init__(self, out: Path, open_ones: ExitStack) -> None:
        self._out = out
        self._open = open_ones
        self._endpoint = free_endpoint()
        self._air = open_ones.enter_context(beacon())
        (out / "field.toml").write_text(ASSURED)
        self.robots = {name: self._started(name) for name in "ba"}

    def _started(self, name: str) -> Command:
        return self._open.enter_context(
            Command(
                *("robot", name, "--mission", self._out / "field.toml", "--driver", "docs.rover:Rover"),
                *("--rate", "4", "--listen" if name == "a" else "--connect", self._endpoint),
                *("--out", self._out / name, "--option", f"state={self._out / f'body-{name}'}"),
                *("--option", f"start={STARTS[name]}", "--option", f"beacon={self._air}"),
                *("--option", "patience=60"),
            )
        )

    def path(self, name: str, whose: str = "agent") -> Path:
        return self._out / name / f"{whose}-{name}.journal"

    def kill(self, *names: str) -> None:
        """All processes of these robots, at once."""
        for name in names:
            self.robots[name].tell(SIGKILL)  # unless it has ended
        for name in names:
            self.robots[name].ended()

    def again(self, *names: str) -> None:
        for name in names:
            self.robots[name] = self._started(name)

    def nobody_is_left(self, name: str) -> None:
        until(lambda: not processes_of((self._out / name).resolve()), f"{name}'s agent has ended")


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    with ExitStack() as open_ones:
        yield Pair(tmp_path, open_ones)


def is_sense(frame: bytes) -> bool:
    try:
        decode(frame, Sense)
    except MalformedFrame:
        return False
    return True


def cut_agent(path: Path, tick: int) -> None:
    """Leave nothing of `tick`, nor after it, in an agent's journal."""
    frames = list(journal.read(path))
    place = next(i for i, one in enumerate(messages(frames)) if isinstance(one, Sense) and one.tick == tick)
    path.write_bytes(journal.packed(frames[:place]))


def all_is_well(out: Path, pair: Pair) -> None:
    """Both localise, each tick is on record once, and neither the audit nor a replay finds anything."""
    both_localised(out, pair.robots)
    for name in "ab":
        assert [step.sense.tick for step in told(out, name).steps] == list(range(len(told(out, name).steps)))
    both = out / "both"
    both.mkdir()
    for name in "ab":
        shutil.copy(pair.path(name), both)
    audited = tandem("audit", both)
    assert audited.status == 0, audited.out


@pytest.mark.parametrize("killed", ["a", "b"])
def test_a_robot_that_is_killed_goes_on_from_its_record(pair: Pair, killed: str, tmp_path: Path) -> None:
    pair.robots[killed].until_written(pair.path(killed), 2500)
    pair.kill(killed)
    before = len(told(tmp_path, killed).steps)
    pair.again(killed)
    all_is_well(tmp_path, pair)
    assert f"{killed}: in run field, again, from tick " in pair.robots[killed].out
    assert len(told(tmp_path, killed).steps) > before


def test_both_robots_that_lose_power_at_once_go_on_from_what_is_left_of_their_records(
    pair: Pair, tmp_path: Path
) -> None:
    """Of each journal the last write is torn: the driver's, as its Sense was never sent; the agent's, too."""
    for name in "ab":
        pair.robots[name].until_written(pair.path(name), 3000)
    pair.kill("a", "b")
    for name in "ab":
        pair.nobody_is_left(name)
        agents, drivers = pair.path(name), pair.path(name, "driver")
        torn = agents.read_bytes()
        agents.write_bytes(torn[:-7])
        with drivers.open("ab") as file:
            file.write(msgpack.packb(b"x" * 40)[:20])
    pair.again("b", "a")
    all_is_well(tmp_path, pair)
    for name in "ab":
        assert "bytes were torn, and are cut off" in pair.robots[name].err


def test_a_robot_whose_last_sense_was_lost_with_the_power_takes_it_again(pair: Pair, tmp_path: Path) -> None:
    """The reading was taken, and neither journal has it: what was driven before it is told once."""
    pair.robots["a"].until_written(pair.path("a"), 2500)
    pair.kill("a")
    pair.nobody_is_left("a")
    known = len(told(tmp_path, "a").steps)
    frames = list(journal.read(pair.path("a", "driver")))
    while frames and not is_sense(frames[-1]):
        frames.pop()
    latest = decode(frames[-1], Sense).tick
    if latest == known - 1:  # the agent had it
        cut_agent(pair.path("a"), latest)
    pair.path("a", "driver").write_bytes(journal.packed(frames[:-1]))
    pair.again("a")
    all_is_well(tmp_path, pair)


def test_a_robot_that_has_ended_says_so_again(pair: Pair, tmp_path: Path) -> None:
    all_is_well(tmp_path, pair)
    before = {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()}
    outcome = pair.robots["a"].out.splitlines()[-1]
    pair.again("a")
    ended = pair.robots["a"].ended()
    assert (ended.status, ended.out.splitlines()[-1]) == (0, outcome)
    assert {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()} == before


def test_a_robot_that_is_killed_before_it_knows_its_mission_begins_it(pair: Pair, tmp_path: Path) -> None:
    pair.robots["b"].until(lambda: pair.path("b", "driver").exists(), "b has opened its journal")
    pair.kill("b")
    pair.again("b")
    all_is_well(tmp_path, pair)


def test_what_a_robot_drives_as_it_goes_down_is_told_and_no_more_than_was_asked_for(
    pair: Pair, tmp_path: Path
) -> None:
    """Its body drives the manoeuvre that had begun to its end at the most; then it stands."""
    pair.robots["a"].until_written(pair.path("a"), 2500)
    pair.kill("a")
    pair.again("a")
    all_is_well(tmp_path, pair)  # where it is follows from all that it has told
    steps = told(tmp_path, "a").steps
    for before, step in pairwise(steps):
        assert before.drive is not None
        assert step.sense.executed is not None
        assert abs(step.sense.executed.v) <= abs(before.drive.v) + 1e-12
        assert abs(step.sense.executed.omega) <= abs(before.drive.omega) + 1e-12


def test_a_record_of_another_mission_is_refused(pair: Pair, tmp_path: Path) -> None:
    pair.robots["a"].until_written(pair.path("a"), 1500)
    pair.kill("a", "b")
    other = tandem(
        *("robot", "a", "--mission", "paper-2", "--driver", "docs.rover:Rover", "--rate", "4"),
        *("--out", tmp_path / "a"),
    )
    assert other.status == 2
    assert "another run's: its briefing is not this mission's; choose another folder" in other.err


def test_a_driver_that_cannot_resume_is_refused_and_not_moved(pair: Pair, tmp_path: Path) -> None:
    pair.robots["a"].until_written(pair.path("a"), 1500)
    pair.kill("a", "b")
    pair.nobody_is_left("a")
    before = {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()}
    ended = tandem(
        *(
            "robot",
            "a",
            "--mission",
            tmp_path / "field.toml",
            "--driver",
            "tests.broken_drivers:CannotResume",
        ),
        *("--rate", "4", "--out", tmp_path / "a"),
    )
    assert ended.status == 2
    assert "has no resume() for it; choose another folder" in ended.err
    assert {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()} == before


@pytest.mark.long
@pytest.mark.parametrize("amount", range(200, 8000, 600))
@pytest.mark.parametrize("killed", ["a", "b", "ab"])
def test_a_robot_that_is_killed_at_any_moment_goes_on(
    pair: Pair, killed: str, amount: int, tmp_path: Path
) -> None:
    for name in killed:
        path, robot = pair.path(name), pair.robots[name]
        until(lambda path=path, robot=robot: size(path) >= amount or not robot.running, "it is far on")  # type: ignore[misc]
    pair.kill(*killed)
    pair.again(*killed)
    all_is_well(tmp_path, pair)
