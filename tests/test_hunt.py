"""A hunt finds a planted defect, shrinks it to a file that runs, and finds nothing in what is right."""

from __future__ import annotations

import math
import random
import signal
import tomllib
from collections.abc import Callable
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.estimation import claim
from agent.planning import phase3_last_manoeuvre
from agent.process.node import AgentProcess
from compose.audit import rules
from compose.cli import hunt as command
from compose.cli.main import parse
from compose.errors import UserError
from compose.launch import in_process, virtual_processes
from compose.recording import run
from compose.recording.run import of_frames
from compose.scenario import first_meetings, group_meetings
from compose.scenario.kills import KILL_POINTS
from compose.scenario.kills import parse as kill
from compose.scenario.scenario_file import load, scenario_table
from compose.sweep import spec
from compose.sweep.cells import cells
from compose.sweep.hunt import examination, reached_states
from compose.sweep.hunt.examination import (
    MOST_TICKS,
    MOST_WITHOUT_END,
    Examined,
    examined,
    scenario_of,
    watched,
)
from compose.sweep.hunt.exploration import Hunt
from compose.sweep.hunt.mutation import (
    MOST_KILLS,
    Clues,
    fault_lines,
    kills_added,
    mutated,
    robots_of,
    simpler,
)
from compose.sweep.hunt.mutation import seeds as hunted
from protocol.journal.journal_file import CorruptJournal, MemoryJournal, packed
from protocol.messages import Observation
from tests import mutants
from tests.commands import TandemProcess, tandem
from tests.test_safety_distance import NEAR
from world import tick


def ended_after(runs: int) -> Callable[[Hunt], bool]:
    return lambda hunt: hunt.runs >= runs


# --- virtual processes --------------------------------------------------------------------------------


@pytest.mark.parametrize("point", KILL_POINTS)
def test_virtual_processes_that_are_killed_write_the_recording_of_one_process(
    point: str, tmp_path: Path
) -> None:
    mission = load("paper-1")
    kills = [kill(f"{who}@{tick}:{point}") for who in ("a", "b", "world") for tick in (0, 42, 47)]
    ended = virtual_processes.run_mission(mission, tmp_path, kills)
    assert (ended.failures, ended.taken) == ([], 9 if point != "report" else 5)  # no Report without contact
    journals = {name: MemoryJournal() for name in in_process.journals(mission)}
    in_process.played(mission, journals)
    assert {name: packed(one.frames) for name, one in journals.items()} == {
        one.name: one.read_bytes() for one in tmp_path.iterdir()
    }


def test_a_virtual_process_that_is_not_started_again_is_missed(tmp_path: Path) -> None:
    ended = virtual_processes.run_mission(load("paper-1"), tmp_path, [kill("b@5+never")])
    assert (ended.taken, ended.failures) == (1, ["a process that was killed is missing"])


def test_frames_on_one_key_arrive_in_order_however_their_times_are_rounded() -> None:
    """A repeated Observation of tick 0 arrived 1e-18 s after that of tick 1, and counted as refused."""
    table = {**hunted("random")[0], "seed": 1967196612}
    assert examined(table).breaches == ()


# --- the search ---------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_hunt_reaches_the_same_with_any_number_of_workers() -> None:
    hunts = [Hunt("paper-1", 3, workers) for workers in (1, 2)]
    assert [one.run(ended_after(16)) for one in hunts] == [None, None]
    one, other = hunts
    assert (one.runs, one.seen, one.corpus) == (other.runs, other.seen, other.corpus)
    assert len(one.corpus) > 1


def test_what_runs_fast_is_changed_more_often_than_what_runs_long() -> None:
    hunt = Hunt("paper-1", 1, 1)
    for ticks in (2000, 50):
        new = Examined((), frozenset((f"reached in {ticks}",)), Clues(("a", "b"), ticks))
        hunt._keep({"mission": {}, "ticks": ticks}, new)
        hunt._keep({"mission": {}, "ticks": ticks}, new)  # it reaches nothing new
    fast, slow = sorted([one for one in hunt.corpus if "ticks" in one.table], key=lambda one: -one.share)
    assert (fast.known.ticks, slow.known.ticks) == (50, 2000)
    assert fast.share > 20.0 * slow.share


def steps_twice(real: Any) -> Any:
    def on_observation(self: Any, observation: Observation, frame: bytes) -> bool:
        if observation == self._observation and self._robot.state.task.name == "circling":
            self._robot.observation(observation, frame)
        return bool(real(self, observation, frame))

    return on_observation


def test_an_input_is_examined_and_a_defect_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    table = {**scenario_table("paper-1"), "kill": [{"who": "b", "tick": 3, "point": "observation"}]}
    result = examined(table)
    assert (result.breaches, result.refused, result.known.ticks) == ((), None, 48)
    assert {"circling/1/open -> aligning/2/open", "waiting/3/open: log", "end: localised"} <= result.reached
    monkeypatch.setattr(AgentProcess, "_on_observation", steps_twice(AgentProcess._on_observation))
    assert [one.kind for one in examined(table).breaches][:1] == ["the recording differs"]
    assert examined({**table, "seed": -1}).refused is not None


@pytest.fixture
def second_runs(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Return a list to which each run as virtual processes adds an item."""
    runs: list[bool] = []
    again = examination._again

    def counted(*given: Any) -> Any:
        runs.append(True)
        return again(*given)

    monkeypatch.setattr(examination, "_again", counted)
    monkeypatch.setattr(examination, "FULL_EACH", 2**40)
    return runs


def test_an_input_runs_twice_if_its_kills_or_faults_reach_something_new(second_runs: list[bool]) -> None:
    table = scenario_table("paper-1")
    killed = {**table, "kill": [{"who": "b", "tick": 3, "point": "observation"}]}
    elsewhere = {**table, "kill": [{"who": "b", "tick": 40, "point": "observation"}]}
    late = {**table, "fault": [{"delay": [1, 1]}]}
    seen: set[str] = set()
    for one, runs in ((table, 0), (killed, 1), (killed, 1), (elsewhere, 2), (late, 3), (late, 3)):
        result = examined(one, seen)
        assert (result.breaches, len(second_runs)) == ((), runs)
        seen |= result.reached
    assert "arrived: observation" in seen
    assert any(one.endswith(": late") for one in seen)
    examined(late)  # while an input is shrunk, always
    assert len(second_runs) == 4


@pytest.mark.parametrize("rule", ["decision", "scenario"])
def test_an_input_without_faults_that_reaches_something_new_is_replayed(
    rule: str, second_runs: list[bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    applied: list[str] = []
    audit = rules.audit_run

    def noted(run: Any, chosen: Any) -> Any:
        applied.extend([one.__name__ for one in chosen])
        return audit(run, chosen)

    monkeypatch.setattr(rules, "audit_run", noted)
    seen = examined(scenario_table("paper-1"), set()).reached
    assert (rule in applied, second_runs) == (True, [])
    applied.clear()
    examined(scenario_table("paper-1"), seen)
    assert ("claim" in applied, rule in applied) == (True, False)


def test_an_input_names_only_robots_that_it_has() -> None:
    draw, table = random.Random(1), scenario_table("random-group")
    many = {**table, "group": {"robots": 8, "spacing": 30.0}, "kill": [{"who": ["r7", "r2"], "tick": 3}]}
    many |= {"fault": [{"link": "r7->r2", "loss": 0.5}], "clock": [{"who": "r8", "offset": 1.0}]}
    known, reasons = Clues(tuple(robots_of(many))), set[str]()
    for first in [table, many] * 40:
        made = first
        for _ in range(5):
            made = mutated(made, known, draw)
        reasons.add(refused_for(made))
    assert {one for one in reasons if "who" in one or "link" in one} == set()


def refused_for(table: dict[str, Any]) -> str:
    """Return the reason why `table` is no mission; "" if it is one."""
    try:
        scenario_of(table)
    except UserError as error:
        return str(error)
    return ""


def test_a_process_is_killed_at_one_point_of_ticks_in_turn() -> None:
    draw, known = random.Random(1), Clues(("a", "b"), 40, (20,))
    made = [kills_added(scenario_table("random"), known, draw) for _ in range(50)]
    ticks = [[kill["tick"] for kill in one["kill"]] for one in made if one is not None]
    assert any(one == [*range(one[0], one[0] + MOST_KILLS)] for one in ticks if len(one) == MOST_KILLS)


def test_a_mutant_takes_the_place_of_a_function_wherever_it_is_imported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = group_meetings.group_meetings
    for module in (group_meetings, first_meetings):
        monkeypatch.setattr(module, "group_meetings", before)  # restored after the test
    mutants.bound()
    assert vars(first_meetings)["group_meetings"] is group_meetings.group_meetings is not before


def test_an_input_reaches_the_same_after_another_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(claim, "Blocked", claim.Blocked)  # it is the one of before after this test
    reached_states.note_conditions()
    alone = examined(scenario_table("paper-1"))
    examined(scenario_table("noisy"))
    assert examined(scenario_table("paper-1")) == alone


@pytest.mark.parametrize(
    ("module", "name", "kind"),
    [
        (in_process, "played", "a process dies"),
        (examination, "of_frames", "the recording is misread"),
        (rules, "audit_run", "the recording is misread"),
    ],
)
def test_a_mistake_of_a_reader_is_not_reported_as_a_process_that_dies(
    module: object, name: str, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise CorruptJournal("it ends within a frame")

    monkeypatch.setattr(module, name, broken)
    (breach,) = examined(scenario_table("paper-1")).breaches
    assert (breach.kind, breach.what) == (kind, "CorruptJournal: it ends within a frame")


def test_the_parts_of_an_input_are_left_out_one_after_the_other() -> None:
    table = scenario_table("paper-1")
    worse = {**table, "kill": [{"who": "a", "tick": 3, "after": 1.0}, {"who": "b", "tick": 4}]}
    left = [one.get("kill") for one in simpler(worse, table)]
    assert left[:3] == [[], worse["kill"][1:], worse["kill"][:1]]
    assert {"who": "a", "tick": 3} in [kills[0] for kills in left[3:] if kills]
    assert {name for one in simpler(table, {}) for name in table.keys() - one.keys()} == table.keys()
    moved = {**table, "robot": [{**table["robot"][0], "start": [0.0, 1.0, 2.0]}, table["robot"][1]]}
    assert table in list(simpler(moved, table))
    assert (fault_lines(worse, table), fault_lines(table, table)) == (2, 0)


@pytest.mark.parametrize(
    ("source", "link", "ends"),
    [
        ("random", "mutual/a", {"a", "b"}),
        ("random", "anchor/b", {"b"}),
        ("random", "anchor/c", set()),
        ("random-group", "mutual/r1-r3", {"r1", "r3"}),
        ("room", "anchor/a-A2", {"a"}),
    ],
)
def test_the_robots_of_an_attacked_link_are_those_that_measure_it(
    source: str, link: str, ends: set[str]
) -> None:
    table = scenario_table(source)
    table["mission"]["noise"] = {"anchor_sigma": 0.05, "mutual_sigma": 0.05, "gyro_bias": 0.0}
    assert scenario_of(table)[0].attacked == set()
    table["world"] = {"range": {"model": "attacked", "options": {"link": link, "by": 1.0}}}
    assert scenario_of(table)[0].attacked == ends


def test_a_hunt_compares_distances_with_the_safety_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    table = scenario_table("random")
    table["mission"]["safety_distance"] = 1.0
    assert [one.kind for one in examined({**table, "seed": NEAR}).breaches] == []
    monkeypatch.setattr(phase3_last_manoeuvre, "nearest", lambda _, v, *__: np.full(v.shape, math.inf))
    assert "audit: distance" in [one.kind for one in examined({**table, "seed": NEAR}).breaches]


def changed(source: str, **fields: dict[str, Any]) -> dict[str, Any]:
    """Return the table of a shipped scenario with further fields in its tables."""
    table = scenario_table(source)
    return {**table, **{name: {**table.get(name, {}), **one} for name, one in fields.items()}}


def cell(sweep: str, number: int) -> dict[str, Any]:
    """Return the table of a cell of a shipped sweep."""
    return dict(list(cells(spec.load(sweep)))[number].table)


RARE = [
    {**scenario_table("random"), "fault": [{"corrupt": 0.4, "duplicate": 0.4, "delay": [0, 3]}]},
    changed("noisy", mission={"noise": {"anchor_sigma": 0.1, "mutual_sigma": 0.1, "drop_outs": 0.3}}),
    cell("group-unanchored", 0),
    cell("mismatch-uwb", 3),
    cell("noise", 8) | {"seed": 2},
    changed("room", world={"noise": {"outliers": 0.3, "outlier_bias": [0.5, 2.0]}}) | {"max_ticks": 60},
    changed(
        "random-group",
        mission={
            "tolerates": 1,
            "accuracy": 0.3,
            "noise": {"anchor_sigma": 0.05, "mutual_sigma": 0.05, "gyro_bias": 0.0},
        },
        world={"range": {"model": "attacked", "options": {"link": "anchor/r3", "by": -1.0}}},
    )
    | {"seed": 533471434},
]
"""Inputs with what the sweeps of their scenarios do not have."""
SOURCES = ("random-group", "random", "noisy", "room", "relative")
GUARDS = {"hypothesis", "definite covariance", "determined position"}
"""The conditions that no mission was found to reach. tests/test_claim.py has them."""


def test_a_mission_that_lasts_long_and_need_not_localise_is_examined_up_to_a_tick() -> None:
    table = scenario_table("random")
    table["robot"][1]["anchor"] = [100.0, 0.0]
    partition = {**table, "fault": [{"partition": True}]}
    assert MOST_TICKS > scenario_of(partition)[0].max_ticks > MOST_WITHOUT_END
    result = examined(partition)
    assert (result.breaches, result.refused, result.known.ticks) == ((), None, MOST_WITHOUT_END)
    assert "orbiting/2/open: contact" in result.reached
    assert 0 < examined(table).known.ticks < MOST_WITHOUT_END


def test_a_claim_that_the_world_keeps_after_it_is_withdrawn_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    table = cell("group-attacks-noise", 1) | {"seed": 8}
    result = examined(table)
    assert (result.breaches, result.refused) == ((), None)
    assert "localised/3/open -> aligning/2/open" in result.reached
    for module in (tick, run):
        monkeypatch.setattr(module, "verdicts_after", tick.verdicts_after)  # restored after the test
    mutants.kept()
    assert [one.kind for one in examined(table).breaches] == ["withdrawn claim"]


@pytest.mark.long
def test_every_task_condition_and_kind_of_message_is_reached_in_some_mission(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(claim, "Blocked", claim.Blocked)  # it is the one of before after this test
    reached_states.note_conditions()
    seen: set[str] = set()
    left = reached_states.never(seen)
    inputs = [*RARE, *[one for each in zip_longest(*map(hunted, SOURCES)) for one in each if one is not None]]
    for table in inputs:
        scenario, _, _ = scenario_of(table)
        if scenario.max_ticks * len(scenario.robots) <= MOST_TICKS:
            sinks, messages, _ = watched(scenario, seen)
            seen |= reached_states.reached(
                of_frames({name: one.frames for name, one in sinks.items()}, messages=messages)
            )[0]
            left = reached_states.never(seen)
        if not (left["tasks"] or left["messages"] or {*left["conditions"]} - GUARDS):
            break
    assert (left["tasks"], left["messages"], {*left["conditions"]} - GUARDS) == ([], [], set())


@pytest.mark.long
def test_a_hunt_finds_a_defect_and_shrinks_its_input(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(AgentProcess, "_on_observation", steps_twice(AgentProcess._on_observation))
    monkeypatch.chdir(tmp_path)
    assert command.main(parse(["hunt", "paper-1", "--runs", "200", "-q"])) == 1
    text = (tmp_path / "hunt-paper-1.toml").read_text()
    assert text.startswith("# the recording differs: agent-")
    found = tomllib.loads(text)
    assert len(found["kill"]) == 1
    assert fault_lines(found, scenario_table("paper-1")) <= 2
    monkeypatch.undo()
    assert tandem("run", tmp_path / "hunt-paper-1.toml", "-q").status == 0  # without the defect


# --- the command --------------------------------------------------------------------------------------


def test_a_mistake_of_the_user_has_its_own_status(tmp_path: Path) -> None:
    ended = tandem("hunt", "paper-3", cwd=tmp_path)
    assert (ended.status, "paper-3: neither a file nor a shipped scenario" in ended.err) == (2, True)
    (tmp_path / "hunt-paper-1.toml").touch()
    assert tandem("hunt", "paper-1", cwd=tmp_path).status == 2


def test_ctrl_c_ends_a_hunt_with_what_it_has_reached(tmp_path: Path) -> None:
    with TandemProcess("hunt", "paper-1", "--minutes", "9", "--jobs", "1", cwd=tmp_path) as hunting:
        hunting.until_prints("inputs to begin with")
        hunting.tell(signal.SIGINT)
        ended = hunting.ended()
    assert ended.status == 130
    assert "never reached, tasks:" in ended.out
