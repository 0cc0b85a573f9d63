"""Robots of a group that are dead for good: the world, those that help, and the bounds that are announced."""

from __future__ import annotations

import random
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from compose.audit.rules import audit_run
from compose.errors import BadScenario
from compose.launch.in_process import run_mission
from compose.recording.corrected_bounds import corrected_bounds
from compose.recording.reasons import reason_for
from compose.recording.recording_files import WORLD_JOURNAL, agent_journal
from compose.recording.run import Run, read
from compose.recording.summary_json import summary
from compose.scenario.scenario_change import file_table
from compose.scenario.scenario_file import load, parse, scenario_table, validate
from compose.terminal.progress import result
from protocol.messages import Undecided
from tests.commands import SECTION_IV, anchored
from tests.commands import tandem as tandem_command
from tests.groups import group_of, localised, random_group
from tests.series import series
from world.scenario import Death, Scenario
from world.tick import World, advance

FOUR = f"""
name = "four"
seed = 1
{SECTION_IV}
[[robot]]
id = "a"
anchor = [0.0, 0.0]
dies = 20
{anchored(b=(10.0, 3.0), c=(-4.0, 9.0), d=(5.0, -12.0))}
"""
"""A group in which a should meet d first."""


@pytest.fixture(scope="module")
def four() -> Run:
    """Return the run of FOUR."""
    return run_mission(parse(FOUR, "four"))


def with_death(scenario: Scenario, robot: str, tick: int) -> Scenario:
    return replace(scenario, deaths=(Death(robot, tick),))


# --- the world ----------------------------------------------------------------------------------------


def test_a_dead_robot_stands_still_and_measures_and_receives_nothing(four: Run) -> None:
    path = four.truth("a")
    assert path[18] != path[19]
    assert set(path[20:]) == {path[20]}
    for observations in four.observations[20:]:
        own = observations["a"]
        assert own.anchor_range is None
        assert own.contacts == ()
        assert all(contact.peer != "a" for one in observations.values() for contact in one.contacts)


def test_the_outcome_names_the_dead_robot_once_the_others_are_localised(four: Run) -> None:
    assert localised(four) == {"b", "c", "d"}
    assert four.end is not None
    assert (four.end.outcome, reason_for(four.end)) == ("undecided", "a is dead from tick 20 on")


def test_a_verdict_of_a_dead_robot_does_not_count(four: Run) -> None:
    tick = four.ticks[30]
    given = replace(tick.commands["a"], verdict=Undecided("too late"))
    after = advance(tick.world, {**tick.commands, "a": given})
    assert isinstance(after, World)
    assert "a" not in after.verdicts


def test_a_robot_that_dies_after_its_claim_is_localised() -> None:
    scenario = group_of(4, 1)
    claim = run_mission(scenario).claim("r0")
    assert claim is not None
    run = run_mission(with_death(scenario, "r0", claim.tick + 1))
    assert "r0" in localised(run)


def test_a_scenario_with_a_death_is_written_and_read_again() -> None:
    scenario = parse(FOUR, "four")
    assert scenario.deaths == (Death("a", 20),)
    assert validate(file_table(scenario), "again").scenario == scenario


def test_robots_die_in_groups_only() -> None:
    table: dict[str, Any] = scenario_table("paper-1")
    table["robot"][0]["dies"] = 3
    with pytest.raises(BadScenario, match=r"robot\[0\]\.dies: robots die in groups and teams only"):
        validate(table, "it")


def test_the_tick_in_which_a_robot_of_a_drawn_group_dies_follows_from_the_seed() -> None:
    table = scenario_table("random-group")
    table["group"] = table["group"] | {"dies": [5, 50]}
    template = validate(table, "it")
    found = [template.seeded(seed).deaths for seed in (1, 2, 3, 1)]
    assert found[0] == found[3]
    assert len(set(found)) > 1
    for (death,) in found:
        assert death.robot == "r2"
        assert 5 <= death.tick <= 50


# --- the others ---------------------------------------------------------------------------------------


CASES = [(3, 2), (4, 4), (6, 26), (6, 33), (4, 17), (3, 18), (6, 19), (8, 3), (4, 36), (3, 26), (16, 1)]
"""Groups in which robots orbited in vain, or stood out on their orbits, before they waited at home."""


@pytest.mark.parametrize("group", series(CASES, 3))
def test_all_others_are_localised_within_the_corrected_bound(group: tuple[int, int]) -> None:
    scenario, draw = group_of(*group), random.Random(group[1])
    dead = f"r{draw.randrange(group[0])}"
    run = run_mission(with_death(scenario, dead, draw.randrange(80)))
    assert localised(run) >= set(run.robots) - {dead}
    last = max(claim.tick for robot in run.robots if (claim := run.claim(robot)) is not None)
    corrected = corrected_bounds(run)
    planned = scenario.meetings[-1].ends / scenario.mission.period
    assert last <= max([planned, *[one.bound_ticks for one in corrected]])
    if last > planned:
        assert corrected


@pytest.mark.long
@pytest.mark.parametrize(("robots", "seed"), [(4, 2190611898021423449), (8, 4689520878616184904)])
def test_all_others_are_localised_where_a_robot_meets_the_same_one_twice_under_noise(
    robots: int, seed: int
) -> None:
    """In the second meeting, it did not receive the log from its beginning, and both waited for ever."""
    run = run_mission(random_group(seed, robots=robots, dies=[0, 80]))
    (dead,) = run.scenario.deaths
    assert localised(run) >= set(run.robots) - {dead.robot}


def test_bounds_are_corrected_when_a_robot_is_late_by_what_is_known_then(four: Run) -> None:
    (only,) = corrected_bounds(four)
    ends = {one.robot: one.ends for one in four.scenario.members}
    assert only.tick == min(ends["a"], ends["d"]) + 1
    assert set(only.late) <= {"a", "d"}
    assert only.bound_ticks > max(ends.values())
    known = replace(four, world=replace(four.history, ticks=four.ticks[: only.tick + 2]))
    assert corrected_bounds(known) == (only,)


def test_the_bound_is_corrected_again_when_the_next_pair_could_not_localise_itself() -> None:
    run = run_mission(with_death(group_of(3, 2), "r0", 11))
    first, *others = corrected_bounds(run)
    assert others
    for one, other in pairwise((first, *others)):
        assert one.tick < other.tick
        assert one.bound_ticks < other.bound_ticks


def test_no_bound_is_corrected_where_no_robot_is_late() -> None:
    assert corrected_bounds(run_mission(group_of(8, 1))) == ()
    assert corrected_bounds(run_mission(load("paper-1"))) == ()


def test_the_bound_is_corrected_when_the_localised_robot_is_an_attacker_and_no_help() -> None:
    attack = {"kind": "scale", "size": 0.5, "part": "encounter"}
    run = run_mission(group_of(3, 1, attacker=0, attack=attack))
    corrected = corrected_bounds(run)
    honest = [claim.tick for robot in ("r1", "r2") if (claim := run.claim(robot)) is not None]
    assert len(honest) == 2
    assert min(one.bound_ticks for one in corrected) < max(honest) <= corrected[-1].bound_ticks
    for one, other in pairwise(corrected):
        assert other.tick <= one.bound_ticks + 1


# --- results ------------------------------------------------------------------------------------------


def test_the_corrected_bound_is_shown_with_the_result(four: Run, capsys: pytest.CaptureFixture[str]) -> None:
    found = summary(four, None, None)
    (only,) = corrected_bounds(four)
    assert found["group"]["corrected_bounds"] == [
        {"tick": only.tick, "late": only.late, "bound_ticks": only.bound_ticks}
    ]
    assert found["group"]["deaths"] == {"a": 20}
    result(found)
    shown, were = " ".join(capsys.readouterr().out.split()), "was" if len(only.late) == 1 else "were"
    assert "all robots but a were localised by tick" in shown
    assert (
        f"corrected in tick {only.tick} to {only.bound_ticks}, as {', '.join(only.late)} {were} late" in shown
    )


@pytest.mark.long
def test_a_death_is_the_same_as_processes_and_in_one_and_the_audit_is_clean(
    tmp_path: Path, four: Run
) -> None:
    (tmp_path / "four.toml").write_text(FOUR)
    ended = tandem_command("run", "four.toml", "--out", "recording", cwd=tmp_path)
    assert ended.status == 1
    run_mission(parse(FOUR, "four"), tmp_path / "again")
    names = [WORLD_JOURNAL, *[agent_journal(robot) for robot in four.robots]]
    for name in names:
        assert (tmp_path / "recording" / name).read_bytes() == (tmp_path / "again" / name).read_bytes()
    assert audit_run(read(tmp_path / "recording", audited=True)).violations == ()
