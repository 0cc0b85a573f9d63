"""Sweeps of groups: the columns that only groups have, and the sweeps that ship."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from msgspec.structs import replace

from compose.launch.in_process import run_mission
from compose.scenario.scenario_file import load, scenario_table, validate
from compose.sweep import spec
from compose.sweep.cells import cells
from compose.sweep.group_columns import GroupColumns, group_columns
from compose.sweep.statistics import columns_of
from compose.sweep.table import schema_of
from compose.sweep.trial import Trial, run_trial
from protocol.messages import Localised
from tests.commands import tandem
from tests.groups import group_of
from world.scenario import Scenario

SCALED = {"kind": "scale", "part": "phase-1", "size": 0.5}


def trial(scenario: Scenario, *, audit: bool = False) -> Trial:
    return Trial(0, 0, scenario, processes=False, audit=audit)


def test_the_travel_of_three_robots_begins_at_the_end_of_their_first_meeting() -> None:
    scenario = group_of(3, 1)
    first, second = scenario.meetings
    place = {robot.id: robot.anchor for robot in scenario.robots}
    run = run_mission(scenario)
    columns = group_columns(run)
    assert columns is not None
    met = max(claim.tick for one in (first.visitor, first.visited) if (claim := run.claim(one)) is not None)
    there, here = place[second.visited], place[first.visited]
    way = math.hypot(there.x - here.x, there.y - here.y) / scenario.mission.max_speed
    assert columns.travel_ticks == pytest.approx(met + way)
    assert run.end is not None
    assert columns.honest_tick == run.end.tick
    assert columns.bound_ticks == math.ceil(second.ends)
    assert (columns.honest_localised, columns.honest_undecided, columns.honest_wrong) == (3, 0, 0)


def test_a_claim_that_is_off_is_counted_as_wrong() -> None:
    run = run_mission(group_of(3, 1))
    claim = run.claim("r1")
    assert claim is not None
    assert run.world is not None
    tick, verdict = run.ticks[claim.tick], Localised(replace(claim.pose, x=claim.pose.x + 0.1))
    commands = tick.commands | {"r1": replace(tick.commands["r1"], verdict=verdict)}
    moved = replace(tick, commands=commands)
    ticks = (*run.ticks[: claim.tick], moved, *run.ticks[claim.tick + 1 :])
    columns = group_columns(replace(run, world=replace(run.world, ticks=ticks)))
    assert columns is not None
    assert (columns.honest_localised, columns.honest_undecided, columns.honest_wrong) == (2, 0, 1)


def test_honest_robots_and_their_meetings_with_an_attacker_are_counted() -> None:
    scenario = group_of(3, 1, attacker=1, attack=SCALED)
    row = run_trial(trial(scenario, audit=True))
    found = row.group
    assert found is not None
    assert (found.honest_localised, found.honest_undecided, found.honest_wrong) == (2, 0, 0)
    assert found.attacker_met is not None
    assert found.attacker_found is not None
    assert 1 <= found.attacker_found <= found.attacker_met <= 2
    assert found.honest_tick is not None
    assert row.ticks is not None
    assert found.honest_tick < row.ticks  # the attacker is not localised
    unaudited = run_trial(trial(scenario)).group
    assert unaudited is not None
    assert unaudited.attacker_met is None


def test_the_robots_of_a_link_under_attack_count_as_peers_of_each_other() -> None:
    table = scenario_table("random-group")
    table["group"]["robots"] = 3
    noise = {"anchor_sigma": 0.05, "mutual_sigma": 0.05, "gyro_bias": 0.0002}
    table["mission"] |= {"accuracy": 0.3, "noise": noise}
    table["world"] = {"range": {"model": "attacked", "options": {"link": "mutual/r1-r2", "by": -1.0}}}
    found = run_trial(trial(validate(table, "attacked.toml").scenario, audit=True)).group
    assert found is not None
    assert (found.attacker_met, found.attacker_found) == (2, 2)
    assert (found.honest_localised, found.honest_wrong) == (3, 0)


def test_a_robot_that_makes_no_claim_is_counted() -> None:
    scenario = group_of(4, 2)
    columns = group_columns(run_mission(replace(scenario, max_ticks=scenario.max_ticks // 12)))
    assert columns is not None
    assert columns.honest_undecided > 0
    assert columns.honest_localised + columns.honest_undecided == 4
    assert columns.honest_tick is None


def test_the_robot_r1_of_a_drawn_group_may_have_an_attack() -> None:
    table = scenario_table("random-group")
    table["group"] = table["group"] | {"attack": SCALED}
    scenario = validate(table, "it").seeded(3)
    honest = validate(scenario_table("random-group"), "it").seeded(3)
    assert [robot.attack is not None for robot in scenario.robots] == [True, False, False, False]
    assert [robot.anchor for robot in scenario.robots] == [robot.anchor for robot in honest.robots]


@pytest.mark.parametrize(
    ("name", "of_group"),
    [
        ("group", True),
        ("group-attacks", True),
        ("group-attacks-noise", True),
        ("group-attacks-noise-tolerated", True),
        ("anchors", True),
        ("relative", True),
        ("survey", True),
        ("team-attacks", True),
        ("loss", False),
    ],
)
def test_only_sweeps_of_groups_have_the_columns_of_groups(name: str, of_group: bool) -> None:
    sweep = spec.load(name)
    names = set(schema_of(sweep, list(cells(sweep))[:1]).names)
    assert (set(GroupColumns.__struct_fields__) <= names) == of_group
    assert bool(set(GroupColumns.__struct_fields__) & names) == of_group
    assert ("makespan_p50" in columns_of(sweep)) == of_group
    assert ("honest_wrong" in columns_of(sweep)) == of_group


def test_no_pair_has_the_columns_of_groups() -> None:
    assert group_columns(run_mission(load("paper-1"))) is None


def test_the_cases_of_the_sweep_of_groups_have_the_same_groups() -> None:
    sweep = spec.load("group")
    keys: dict[object, set[str]] = {}
    for cell in cells(sweep):
        keys.setdefault(cell.fields["group.robots"], set()).add(cell.key)
    assert all(len(found) == 1 for found in keys.values())
    assert {one.fields["fault"] is not None for one in cells(sweep)} == {True, False}


@pytest.mark.long
def test_a_group_that_is_refused_has_no_numbers_in_the_table(tmp_path: Path) -> None:
    spec_file = tmp_path / "refused.toml"
    axis = '[[axis]]\nname = "tolerates"\nfield = "mission.tolerates"\nvalues = [0, 1]\n'
    spec_file.write_text(f'name = "refused"\nscenario = "random-group"\ntrials = 1\n{axis}', encoding="utf-8")
    ended = tandem("sweep", spec_file, "--no-audit", "--workers", "1", "--out", tmp_path / "out")
    assert "cell 1 cannot run: mission.tolerates: " in ended.out
    assert "4/0/0" in ended.out
    assert "None" not in ended.out
