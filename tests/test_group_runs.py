"""A group of robots: what the simulator measures, and what records, checks and repeats its runs."""

from __future__ import annotations

import json
import math
import random
import re
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from itertools import combinations
from pathlib import Path
from signal import Signals
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

import tandem
from agent.process.agent_journal import Step
from compose.audit.rules import audit_run, replayed
from compose.errors import UserError
from compose.launch.in_process import run_mission
from compose.launch.processes import free_endpoint
from compose.recording.recording_files import WORLD_JOURNAL, agent_journal
from compose.recording.run import of_frames, read
from compose.recording.summary_json import summary
from compose.scenario.scenario_change import file_table
from compose.scenario.scenario_file import load, parse, scenario_table, setting, validate
from compose.scenario.shipped_files import shipped
from compose.sweep.trial import Trial, row
from compose.terminal.progress import result
from protocol.journal.journal_file import CorruptJournal
from protocol.wire import encode
from tests.commands import OVER, SECTION_IV, TandemProcess, anchored, decided, journals, processes_of, until
from tests.commands import tandem as tandem_command
from tests.missions import kept
from world.near_pairs import near_pairs
from world.scenario import PlannedMeeting, Scenario

places = st.lists(st.tuples(*[st.floats(-50.0, 50.0) | st.integers(-9, 9).map(float)] * 2), max_size=30)


# --- the world ----------------------------------------------------------------------------------------


@given(places, st.floats(0.1, 20.0) | st.sampled_from([1.0, 3.0]))
def test_no_pair_within_reach_is_missed_and_the_order_is_that_of_all_pairs(
    places: list[tuple[float, float]], reach: float
) -> None:
    found = near_pairs(places, reach)
    everything = list(combinations(range(len(places)), 2))
    within = [(i, j) for i, j in everything if math.dist(places[i], places[j]) <= reach]
    assert [pair for pair in everything if pair in set(found)] == found
    assert set(within) <= set(found)


def test_few_pairs_are_near_where_robots_are_spread() -> None:
    draw = random.Random(1)
    side = 30.0 * math.sqrt(100)
    places = [(side * draw.random(), side * draw.random()) for _ in range(100)]
    assert len(near_pairs(places, 3.0)) < 100


# --- the audit ----------------------------------------------------------------------------------------

GROUP = f"""
name = "group"
seed = 3
{SECTION_IV}
{anchored(a=(0.0, 0.0), b=(5.0, 1.0), c=(2.0, 6.0), d=(-4.0, 4.0), e=(-3.0, -5.0))}
"""
Journals = dict[str, list[bytes]]


@pytest.fixture(scope="module")
def group() -> Journals:
    """Return the journals of a group of five."""
    return kept(parse(GROUP, "group"))


def audited(journals: Journals) -> list[tuple[int | None, str | None, str]]:
    """Return the tick, robot and rule of each violation."""
    return [(one.tick, one.robot, one.rule) for one in audit_run(of_frames(journals)).violations]


def several(journals: Journals) -> tuple[str, Step]:
    """Return a robot, and a step in which it reports to two others, not the same to both."""
    for robot, agent in of_frames(journals).agents.items():
        for step in agent.steps:
            if len(step.reports) == 2 and step.reports[0].frame != step.reports[1].frame:
                return robot, step
    raise AssertionError("no robot reports to two others")


def test_the_audit_of_a_group_finds_nothing_where_nothing_is_wrong(group: Journals) -> None:
    assert audited(group) == []


def test_reports_that_are_swapped_between_two_receivers_are_found(group: Journals) -> None:
    robot, step = several(group)
    frames = list(group[agent_journal(robot)])
    i, j = [frames.index(one.frame) for one in step.reports]
    frames[i], frames[j] = frames[j], frames[i]
    tick = step.observation.tick
    found = audited(group | {agent_journal(robot): frames})
    assert (tick, robot, "decision") in found
    assert {one for one in found if one[2] == "report"} == {
        (tick, contact.peer, "report") for contact in step.observation.contacts
    }


def test_a_report_that_was_meant_for_another_robot_is_found(group: Journals) -> None:
    _, step = several(group)
    (to_one, to_other), (one, _) = step.reports, [contact.peer for contact in step.observation.contacts]
    frames = list(group[agent_journal(one)])
    frames[frames.index(to_one.frame)] = to_other.frame
    assert (step.observation.tick, one, "report") in audited(group | {agent_journal(one): frames})


def test_a_second_report_to_the_same_robot_is_found(group: Journals) -> None:
    robot, step = several(group)
    frames = list(group[agent_journal(robot)])
    frames.insert(frames.index(step.reports[1].frame), step.reports[0].frame)
    assert (step.observation.tick, robot, "order") in audited(group | {agent_journal(robot): frames})


def test_a_missing_report_is_found(group: Journals) -> None:
    robot, step = several(group)
    frames = list(group[agent_journal(robot)])
    frames.remove(step.reports[1].frame)
    lonely = step.observation.contacts[1].peer
    found = audited(group | {agent_journal(robot): frames})
    assert (step.observation.tick, robot, "decision") in found
    assert (step.observation.tick, lonely, "report") in found


def with_scenario(journals: Journals, scenario: Scenario) -> Journals:
    """Return `journals` with another scenario in the world's."""
    world = list(journals[WORLD_JOURNAL])
    world[1] = encode(scenario)
    return journals | {WORLD_JOURNAL: world}


def scenario_of(journals: Journals) -> Scenario:
    return of_frames(journals).scenario


def test_a_bound_that_is_not_the_planned_one_is_found(group: Journals) -> None:
    scenario = scenario_of(group)
    later = replace(scenario.meetings[-1], ends=scenario.meetings[-1].ends + 1.0)
    changed = replace(scenario, meetings=(*scenario.meetings[:-1], later))
    assert (None, None, "scenario") in audited(with_scenario(group, changed))
    least = replace(scenario, least_bound=scenario.least_bound + 1.0)
    assert audited(with_scenario(group, least)) == [(None, None, "scenario")]


def test_another_visitor_than_the_planned_one_is_found(group: Journals) -> None:
    scenario = scenario_of(group)
    last = scenario.meetings[-1]
    assert last.visitor in {robot for one in scenario.meetings[:-1] for robot in (one.visitor, one.visited)}
    other = next(one.id for one in scenario.robots if one.id not in (last.visitor, last.visited))
    changed = replace(
        scenario,
        meetings=(*scenario.meetings[:-1], replace(last, visitor=other)),
        robots=tuple(
            [
                replace(one, encounter=replace(one.meeting, peer=other)) if one.id == last.visited else one
                for one in scenario.robots
            ]
        ),
    )
    found = audited(with_scenario(group, changed))
    assert (None, None, "scenario") in found
    assert (None, last.visited, "scenario") in found
    assert (None, last.visited, "config") in found


def test_a_retry_that_is_not_planned_is_found(group: Journals) -> None:
    scenario = scenario_of(group)
    changed = replace(scenario, retries=scenario.retries[:-1])
    assert (None, None, "scenario") in audited(with_scenario(group, changed))
    astray = replace(scenario.retries[0], visited="z")
    with pytest.raises(CorruptJournal, match="the retries are not those of its robots"):
        of_frames(with_scenario(group, replace(scenario, retries=(astray,))))


def test_orbits_that_are_not_the_planned_ones_are_found(group: Journals) -> None:
    scenario = scenario_of(group)
    last = scenario.meetings[-1].visited
    other = replace(scenario.robot(last).rendezvous, bound=1.0)
    robots = [
        replace(one, encounter=replace(one.meeting, rendezvous=other)) if one.id == last else one
        for one in scenario.robots
    ]
    found = audited(with_scenario(group, replace(scenario, robots=tuple(robots))))
    assert {(None, last, "scenario"), (None, last, "config")} <= set(found)


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        (lambda meetings: meetings[:-1], "the meetings are not those of its robots"),
        (lambda meetings: (*meetings, meetings[-1]), "is visited after it has met another robot"),
        (lambda meetings: (*meetings[:-1], replace(meetings[-1], visited="z")), "the meetings are not those"),
        (
            lambda meetings: (*meetings[:-1], replace(meetings[-1], visitor=meetings[-1].visited)),
            "is visited after it has met another robot",
        ),
    ],
)
def test_a_plan_that_is_no_tree_is_refused(
    group: Journals,
    changed: Callable[[tuple[PlannedMeeting, ...]], tuple[PlannedMeeting, ...]],
    why: str,
) -> None:
    scenario = scenario_of(group)
    with pytest.raises(CorruptJournal, match=why):
        of_frames(with_scenario(group, replace(scenario, meetings=changed(scenario.meetings))))


# --- results ------------------------------------------------------------------------------------------


def test_the_summary_has_the_meetings_their_bounds_and_the_truth_at_each_claim() -> None:
    run = run_mission(parse(GROUP, "group"))
    found = summary(run, None, None)
    group = found["group"]
    assert [(one["visitor"], one["visited"]) for one in group["meetings"]] == [
        (one.visitor, one.visited) for one in run.scenario.meetings
    ]
    assert group["bound_s"] == run.scenario.meetings[-1].ends
    assert group["least_bound_s"] == pytest.approx(group["bound_s"])
    claims = {robot: run.claim(robot) for robot in run.robots}
    for one in group["meetings"]:
        both = [claims[one[name]] for name in ("visitor", "visited")]
        assert one["localised_tick"] == max(claim.tick for claim in both if claim is not None)
        assert one["localised_tick"] <= one["bound_ticks"] < one["bound_s"] + 1.0
    assert group["localised_tick"] == found["ticks"] <= group["bound_ticks"]
    for robot in found["robots"].values():
        assert robot["truth_at_claim"] == pytest.approx(robot["estimate"], abs=1e-6)
    moved = [robot for robot in found["robots"].values() if robot["truth"] != robot["truth_at_claim"]]
    assert moved  # the truth at the end is another one


def test_the_summary_of_a_pair_says_nothing_of_groups() -> None:
    found = summary(run_mission(load("paper-1")), None, None)
    assert "group" not in found
    assert "truth_at_claim" not in found["robots"]["a"]


def test_the_result_of_a_group_shows_the_truth_at_the_claims_and_the_bound(
    capsys: pytest.CaptureFixture[str],
) -> None:
    found = summary(run_mission(parse(GROUP, "group")), None, None)
    result(found)
    shown = capsys.readouterr().out
    tick, bound = found["ticks"], found["group"]["bound_ticks"]
    assert "true at the claim" in shown
    assert f"all robots were localised by tick {tick}; the computed bound is {bound} ticks" in shown


def test_the_result_of_a_team_shows_the_true_poses_of_the_ticks_of_the_claims(
    capsys: pytest.CaptureFixture[str],
) -> None:
    found = summary(run_mission(load("relative")), None, None)
    result(found)
    shown = capsys.readouterr().out
    driven_on = [one for one in found["robots"].values() if one["truth"] != one["truth_at_claim"]]
    assert driven_on
    for one in found["robots"].values():
        x, y, heading = one["truth_at_claim"]
        assert f" {one['localised_tick']} " in shown
        assert f"{x:.2f} {y:.2f} {heading:+.2f}" in shown


# --- drawn groups and sweeps --------------------------------------------------------------------------


def test_the_anchors_and_the_plan_of_a_drawn_group_follow_from_the_seed() -> None:
    template = setting("random-group")
    one, again, other = template.seeded(7), load("random-group", seed=7), template.seeded(8)
    assert one == again
    assert {robot.anchor for robot in one.robots}.isdisjoint({robot.anchor for robot in other.robots})
    assert one.meetings != other.meetings
    side = 30.0 * math.sqrt(4)
    assert all(0.0 <= at <= side for robot in one.robots for at in (robot.anchor.x, robot.anchor.y))
    written = validate(file_table(one), "written").scenario
    assert written == one


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"group": {"robots": 2, "spacing": 30.0}}, "group.robots: "),
        ({"group": {"robots": 201, "spacing": 30.0}}, "group.robots: "),
        ({"group": {"robots": 4}}, "group: missing field 'spacing'"),
        ({"group": {"robots": 4, "spacing": 30.0, "dies": [9, 5]}}, "group.dies: the lower bound 9 is above"),
        ({"robot": [{"id": "a", "anchor": [0.0, 0.0]}] * 2}, "group: its robots are drawn"),
        ({"planner": {"name": "paper"}}, "planner.name: robots with the planner paper meet in pairs"),
    ],
)
def test_a_group_that_cannot_be_is_refused_in_one_line(change: dict[str, Any], why: str) -> None:
    table = {**scenario_table("random-group"), **change}
    with pytest.raises(UserError, match=re.escape(why)) as refusal:
        validate(table, "it")
    assert len(str(refusal.value).splitlines()) == 1


@pytest.mark.long
def test_a_sweep_of_groups_has_the_share_of_the_bound_that_each_used(tmp_path: Path) -> None:
    sweep = {
        "name": "few",
        "scenario": "random-group",
        "trials": 2,
        "axis": [{"field": "group.robots", "values": [3, 5]}],
    }
    found = tandem.sweep(sweep, workers=1, out=tmp_path / "few")
    cells, trials = found.cells, found.trials
    assert list(cells["rate"]) == [1.0, 1.0]
    shares = trials["ticks"] / trials["bound_ticks"]
    assert list(cells["bound_share_max"]) == [shares[:2].max(), shares[2:].max()]
    assert (shares <= 1.0).all()
    assert np.isfinite(trials["r3_position_error_m"]).all()
    assert np.isnan(trials["r5_position_error_m"][:2]).all()
    assert np.isfinite(trials["r5_position_error_m"][2:]).all()
    run = tandem.run(found.scenario(1, 1))
    assert run.ticks == trials["ticks"][3]
    assert list(run.meetings["visited"]) == [one.visited for one in run.model.scenario.meetings]


@pytest.mark.long
def test_a_noisy_group_has_a_bound_of_each_claim_that_a_sweep_compares() -> None:
    text = GROUP.replace(
        "[mission]",
        "[mission]\naccuracy = 0.3\nnoise = {anchor_sigma = 0.05, mutual_sigma = 0.05, gyro_bias = 0.0003}",
    )
    scenario = parse(text, "noisy")
    found = row(Trial(0, 0, scenario, processes=False), run_mission(scenario), 1.0)
    assert found.outcome == "localised"
    for one in found.robots.values():
        assert one.bound_m is not None
        assert one.position_sigma_m is not None
        assert 0.2 < one.bound_m / one.position_sigma_m < 5.0


# --- processes ----------------------------------------------------------------------------------------

THREE = GROUP[: GROUP.index('[[robot]]\nid = "d"')]
"""The first three robots: in tick 12 c meets a, and b from tick 25 on."""
LINKS = ("a->c: loss=0.9", "c->b: delay=1..3", "loss=0.3, duplicate=0.2")
"""Faults of one link each, and of all."""


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the scenario file of a group of three."""
    file = tmp_path_factory.mktemp("three") / "three.toml"
    file.write_text(THREE)
    return file


def options(name: str, values: Iterable[str]) -> list[str]:
    return [word for value in values for word in (name, value)]


@pytest.mark.long
@pytest.mark.parametrize(
    ("faults", "kills", "more"),
    [
        ((), (), ("--secure",)),
        ((), ("a@5:observation", "b@9", "world@12:journal", "c@14:command"), ()),
        (LINKS, ("c@14:journal", "world@20:report", "a@25", "b@28:command"), ()),
        (LINKS, ("world@0", "world@13:command", "a@13:journal", "c@13:journal"), ()),
    ],
)
def test_a_group_as_processes_records_what_it_records_in_one_process(
    faults: tuple[str, ...], kills: tuple[str, ...], more: tuple[str, ...], three: Path, tmp_path: Path
) -> None:
    own, out = tmp_path / "own", tmp_path / "out"
    common = ("--no-export", "-q", *options("--fault", faults))
    alone = tandem_command("run", three, "--in-process", "--out", own, *common)
    ended = tandem_command("run", three, "--out", out, *common, *options("--kill", kills), *more)
    assert (ended.status, ended.out) == (alone.status, alone.out) == (0, alone.out), ended
    assert ended.err.count("was killed at tick") == len(kills)
    assert decided(out) == decided(own)
    assert audit_run(read(out)).violations == ()
    assert not processes_of(out)


@pytest.mark.long
def test_a_group_in_real_time_leaves_a_recording_that_repeats(three: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    ended = tandem_command("run", three, "--rate", "20", "--out", out, "--no-export", "-q")
    assert ended.status in OVER, ended
    assert audit_run(read(out)).violations == ()
    assert replayed(read(out)).differences == ()


@pytest.mark.long
def test_any_two_robots_of_a_group_may_talk_with_certificates_and_the_doctor_finds_them_well(
    three: Path, tmp_path: Path
) -> None:
    folder, endpoint, own = tmp_path / "keys", free_endpoint("tls"), tmp_path / "own"
    assert tandem_command("keys", folder, "--robots", "a,b,c").status == 0
    assert tandem_command("run", three, "--in-process", "--out", own, "--no-export", "-q").status == 0
    with ExitStack() as stack:

        def start(name: str, *arguments: str | Path) -> TandemProcess:
            given = (*arguments, "--keys", folder / name, "--out", tmp_path / name)
            return stack.enter_context(TandemProcess(*given))

        clock = start("world", "world", three, "--listen", endpoint)
        clock.until_prints("waiting for")
        first = [start(f"agent-{one}", "agent", one, "--connect", endpoint) for one in "ab"]
        tested = ("--connect", endpoint, "--keys", folder / "agent-a", "--timeout", "1")
        found = tandem_command("doctor", *tested)
        assert found.status == 0, found
        assert "ok  alive: group-" in found.out
        listed = tandem_command("ps", "--connect", endpoint, "--keys", folder / "viewer", "--json")
        [mission] = json.loads(listed.out)["missions"]
        assert {one["robot"] for one in mission["robots"]} == {"a", "b", "c"}
        last = start("agent-c", "agent", "c", "--connect", endpoint)
        for one in (*first, last, clock):
            ended = one.ended()
            assert ended.status == 0, ended
    recorded = {
        name: frames for one in tmp_path.glob("*/*.journal") for name, frames in journals(one.parent).items()
    }
    assert recorded == journals(own)


@pytest.mark.long
def test_a_group_that_is_stopped_leaves_no_process(tmp_path: Path) -> None:
    out = tmp_path / "out"
    file = tmp_path / "eight.toml"
    file.write_text((shipped()["random-group"].read_text()).replace("robots = 4", "robots = 8"))
    with TandemProcess("run", file, "--rate", "5", "--out", out, "--no-export", "-q") as run:
        run.until(lambda: len(list(out.glob("*.journal"))) == 9, "all robots have a journal")
        run.tell(Signals.SIGINT)
        assert run.ended().status == 130
    until(lambda: not processes_of(out), "no process is left")
