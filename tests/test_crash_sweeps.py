"""Sweeps over kills: each trial equals the mission without kills, and leaves no process running."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from signal import SIGINT, SIGKILL
from typing import Any

import msgspec
import pyarrow.parquet as pq
import pytest
from msgspec.structs import replace

from compose.errors import BadScenario
from compose.launch import in_process
from compose.launch.supervisor import ChildFailed
from compose.recording.recording_files import WORLD_JOURNAL, agent_journal
from compose.recording.run import Run
from compose.scenario.kills import KILL_POINTS, WORLD, KillTable, drawn
from compose.scenario.scenario_file import load, parse, validate
from compose.scenario.toml_file import table_in
from compose.sweep import spec
from compose.sweep.cells import cells
from compose.sweep.trial import Trial, run_trial
from protocol.journal.journal_file import MemoryJournal
from tests.commands import ENDLESS, PAPER_1, TandemProcess, refused, tandem, temporary_in, until
from world.scenario import Scenario

SMALL = """
name = "small"
scenario = "paper-1"
trials = 1
[[axis]]
field = "kill[0].tick"
values = [46, 49]                # of 48
[[axis]]
name = "where"
fields = ["kill[0].who", "kill[0].point"]
labels = ["nobody", "everyone"]
values = [[[], "observation"], [["a", "b", "world"], "report"]]
"""
DRAWN = '[[kill]]\ntick = [3, 40]\npoint = "?"\n[[kill]]\nwho = ["a", "b"]\ntick = [0, 48]\nafter = 0.25\n'
HUNG = 'name = "hung"\nscenario = "endless.toml"\ntrials = 2\ntrial_timeout = '


@pytest.fixture(autouse=True)
def nothing_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Assert that no process of a test remains.

    All temporary folders are in tmp_path, which identifies the processes by their arguments.
    """
    temporary_in(tmp_path, monkeypatch)
    yield
    until(lambda: not left(tmp_path), "no process is left")


def left(tmp_path: Path) -> list[int]:
    """Return the processes with a path in `tmp_path` in their command line."""
    found = []
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().replace("\0", " ").split()
        except OSError:  # the process has ended
            continue
        if any(word.startswith(f"{tmp_path}/") for word in words):
            found.append(int(pid))
    return found


# --- trials -------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_run_with_kills_has_the_recording_of_the_run_without_kills(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL)
    ended = tandem("sweep", "small.toml", "--out", "out", cwd=tmp_path)
    assert ended.status == 0, ended
    assert "audited: 4 of 4 trials, 4 clean" in ended.out
    rows = pq.read_table(tmp_path / "out" / "trials.parquet").to_pylist()
    assert [row["kills"] for row in rows] == [0, 3, 0, 0]
    assert all(row["same_record"] is True and row["ticks"] == 48 for row in rows)
    assert "<!-- wall time [s]" in (tmp_path / "out" / "figures" / "wall-kill-0-tick.svg").read_text()


@pytest.mark.parametrize("name", [WORLD_JOURNAL, agent_journal("a"), agent_journal("b"), "ticks.csv"])
def test_a_trial_with_a_different_recording_fails_and_names_the_difference(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = in_process.played

    def otherwise(scenario: Scenario, sinks: dict[str, MemoryJournal]) -> Run:
        recording = real(scenario, sinks)
        if name == "ticks.csv":
            return Run(replace(recording.history, ticks=recording.ticks[:-1]))
        sinks[name].frames[-1] += b"!"
        return recording

    monkeypatch.setattr(in_process, "played", otherwise)
    found = run_trial(Trial(0, 0, load("paper-1"), processes=False, kills=()))
    assert (found.outcome, found.ticks, found.same_record) == ("failed", 48, False)
    assert found.reason == f"the recording differs from the run in one process: {name}"


def test_a_process_that_is_never_started_again_ends_its_trial() -> None:
    kills = drawn([KillTable("b", 2, after="never")], 1, ("a", "b"))
    with pytest.raises(ChildFailed, match=r"agent b was killed at tick 2 \(--kill b@2:observation\+never\)"):
        run_trial(Trial(0, 0, load("paper-1"), processes=False, kills=kills))


@pytest.mark.long
@pytest.mark.parametrize("how", ["killed, then hung", "sweep stopped", "sweep killed"])
def test_however_a_trial_ends_its_processes_end_with_it(how: str, tmp_path: Path) -> None:
    (tmp_path / "endless.toml").write_text(ENDLESS + '[[kill]]\nwho = "a"\ntick = 1\n')
    (tmp_path / "hung.toml").write_text(HUNG + ("10.0" if "hung" in how else "600.0"))
    with TandemProcess("sweep", "hung.toml", "--out", "out", "--workers", "1", cwd=tmp_path) as command:
        command.until(lambda: list(tmp_path.glob("tmp/*/*/agent-b.journal")), "they play")
        command.until(lambda: len(left(tmp_path)) == 4, "a worker, a world and two agents are there")
        if "hung" in how:
            os.kill(min(left(tmp_path)), SIGKILL)
        else:
            command.tell(SIGINT if "stopped" in how else SIGKILL)
        assert command.ended().status == {"sweep stopped": 130, "sweep killed": -SIGKILL}.get(how, 3)
    until(lambda: not left(tmp_path), "no process is left")
    if "hung" in how:
        rows = pq.read_table(tmp_path / "out" / "trials.parquet").to_pylist()
        killed, hung = [row["error"] for row in rows]
        assert killed.startswith(
            "died: its process was killed by signal 9"
        )  # and its last line of output, if there was one
        assert hung == "hung: no answer within 10 s"


# --- scenarios with kills -----------------------------------------------------------------------------


def test_open_fields_of_a_kill_follow_from_the_seed() -> None:
    setting = validate(table_in(PAPER_1 + DRAWN, "mine"), "mine")
    assert setting.kills(7) == setting.kills(7)
    found = [setting.kills(seed) for seed in range(200)]
    assert {one.tick for one, _, _ in found} == set(range(3, 41))
    assert set(product(("a", "b", WORLD), KILL_POINTS)) == {(one.who, one.point) for one, _, _ in found}
    assert all([(a.who, b.who), a.tick] == [("a", "b"), b.tick] for _, a, b in found)
    assert {(a.point, a.after, a.text) for _, a, _ in found} == {
        ("observation", 0.25, f"a@{tick}:observation+0.250000s") for tick in range(49)
    }


def test_kills_are_not_part_of_the_worlds_scenario() -> None:
    assert parse(PAPER_1 + DRAWN, "mine") == parse(PAPER_1, "mine")


@pytest.mark.long
def test_a_run_takes_the_kills_of_its_file_and_those_of_the_command_line(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(PAPER_1 + '[[kill]]\nwho = "world"\ntick = 5\npoint = "report"\n')
    ended = tandem("run", "mine.toml", "-q", "--kill", "b@900", cwd=tmp_path)
    assert ended.status == 0, ended
    assert [line for line in ended.err.splitlines() if line.startswith("tandem run")] == [
        "tandem run: world was killed at tick 5, and is restarted",
        "tandem run: --kill b@900: not reached",
    ]


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ('who = "z"', "kill[0].who: there is no 'z'; there are a, b, world"),
        ('who = ["a", "z"]', "kill[0].who: there is no 'z'"),
        ("who = 1", "kill[0].who: "),
        ("tick = -1", "kill[0].tick: "),
        ("tick = [5, 2]", "kill[0].tick: the lower bound 5 is above the upper bound 2"),
        ("tick = [5]", "kill[0].tick: "),
        ('tick = "?"', "kill[0].tick: "),
        ('point = "commands"', "kill[0].point: "),
        ("after = -1.0", "kill[0].after: "),
        ('after = "later"', "kill[0].after: "),
        ('where = "observation"', "kill[0]: unknown field 'where'"),
        ("tick = 5\n[[kill]]\ntick = [2, 1]", "kill[1].tick: the lower bound 2 is above the upper bound 1"),
    ],
)
def test_a_kill_that_cannot_be_is_named_with_its_place(table: str, says: str) -> None:
    with pytest.raises(BadScenario) as bad:
        parse(PAPER_1 + f"[[kill]]\n{table}\n", "mine.toml")
    assert str(bad.value).startswith(f"mine.toml: {says}")
    assert "\n" not in str(bad.value)


def test_a_command_that_restarts_no_process_refuses_a_scenario_with_kills(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(PAPER_1 + "[[kill]]\n")
    says = "mine.toml: kill: --in-process has no processes to kill"
    refused(tandem("run", "mine.toml", "--in-process", cwd=tmp_path), says)
    world = tandem("world", "mine.toml", "--listen", "tcp/127.0.0.1:7447", cwd=tmp_path)
    refused(world, "mine.toml: kill: `tandem world` starts no robots; use `tandem run`")


# --- shipped sweeps --------------------------------------------------------------------------------


def killed(name: str, seed: int) -> list[tuple[Any, ...]]:
    """Return the kills of each cell of the sweep: process, tick and point."""
    tables = [msgspec.convert(cell.table["kill"], list[KillTable]) for cell in cells(spec.load(name))]
    return [
        tuple((kill.who, kill.tick, kill.point) for kill in drawn(table, seed, ("a", "b")))
        for table in tables
    ]


def test_the_sweep_of_crashes_kills_everyone_in_every_tick_at_every_point() -> None:
    end = in_process.run_mission(load("paper-1")).end
    assert end is not None
    ticks = range(end.tick + 1)
    everything = {
        ((who, tick, point),) for who in ("a", "b", WORLD) for tick in ticks for point in KILL_POINTS
    }
    assert Counter(killed("crash", 1)) == Counter(everything) + Counter({(): len(ticks)})


def test_the_sweep_of_two_kills_kills_any_two_or_both_robots_in_one_tick() -> None:
    end = in_process.run_mission(load("paper-2")).end
    assert end is not None
    for seed in range(50):
        two, one = killed("crash-twice", seed)
        assert len(two) == 2
        assert all(0 <= tick <= end.tick for _, tick, _ in (*two, *one))
        assert {who for who, _, _ in one} == {"a", "b"}
        assert len({tick for _, tick, _ in one}) == 1
