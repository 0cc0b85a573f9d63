"""The configurations of a pair in a scene are those that its planner compares."""

from __future__ import annotations

from pathlib import Path

import pytest
from msgspec.structs import replace

from compose.figures.agent_replay import agent_replay
from compose.launch import in_process
from compose.recording.run import Run, read
from compose.scenario.scenario_file import load, parse
from compose.scenario.shipped_files import shipped
from compose.view.configurations import Configurations, configurations
from compose.view.recorded import run_data, scenes_of
from protocol.attack import Attack
from protocol.motion import REST
from tests.series import series
from world.scenario import Scenario


def recorded(scenario: Scenario, folder: Path) -> Run:
    in_process.run_mission(scenario, folder)
    return read(folder)


def shown(run: Run) -> dict[int, Configurations]:
    return {scene.tick: scene.configurations[0] for scene in scenes_of(run) if scene.configurations}


@pytest.mark.parametrize("case", series(["paper-1", "random 3", "paper-2", "random 4", "random 7"], 2))
def test_the_shown_value_of_a_last_manoeuvre_is_that_of_its_planner(case: str, tmp_path: Path) -> None:
    name, _, seed = case.partition(" ")
    run = recorded(load(name, seed=int(seed) if seed else None), tmp_path)
    planned = {
        (state.tick, robot): state.plan.separation_m2
        for robot in run.robots
        for state in agent_replay(run, robot).states
        if state.task.name == "last-manoeuvre" and state.plan and state.plan.separation_m2 is not None
    }
    found = {
        (tick, one.manoeuvre.robot): one.manoeuvre
        for tick, one in shown(run).items()
        if one.manoeuvre is not None
    }
    assert found.keys() == planned.keys()
    for key, manoeuvre in found.items():
        assert manoeuvre.separation_m2 == pytest.approx(planned[key], rel=1e-6)
        assert len(manoeuvre.reachable) > 50


def test_the_configurations_of_paper_1_are_four_and_then_one(tmp_path: Path) -> None:
    assert {tick: one.count for tick, one in shown(recorded(load("paper-1"), tmp_path)).items()} == {
        47: 4,
        48: 1,
    }


def test_exact_poses_that_do_not_fit_the_range_are_not_joined(tmp_path: Path) -> None:
    run = recorded(load("paper-1"), tmp_path)
    ticks = run_data(run).ticks
    assert run.setup is not None
    before, now = ticks[46], ticks[47]
    assert [one.count for one in configurations(run.setup, before, now)] == [4]
    b = now.estimates["b"]
    turned = now.estimates | {"b": replace(b, world=b.world[1:] + b.world[:1])}
    assert not list(configurations(run.setup, before, replace(now, estimates=turned)))


def test_thousands_of_poses_are_no_configurations(tmp_path: Path) -> None:
    """Their last manoeuvre would take gigabytes to compare."""
    run = recorded(load("paper-1"), tmp_path)
    ticks = run_data(run).ticks
    assert run.setup is not None
    counts = []
    for times in (15, 10_000):
        held = {robot: replace(one, world=one.world * times) for robot, one in ticks[47].estimates.items()}
        now = replace(ticks[47], estimates=held)
        counts.append([one.count for one in configurations(run.setup, ticks[46], now)])
    assert counts == [[60], []]


def test_a_late_robot_begins_its_last_manoeuvre_once(tmp_path: Path) -> None:
    run = recorded(load("paper-1"), tmp_path)
    ticks = run_data(run).ticks
    assert run.setup is not None
    stands = {robot: replace(one, tick=48, executed=REST) for robot, one in ticks[47].observations.items()}
    late = replace(ticks[47], tick=48, observations=stands)
    again = replace(late, observations=ticks[48].observations)
    begun = [
        [one.manoeuvre is not None for one in configurations(run.setup, before, now)]
        for before, now in ((ticks[46], ticks[47]), (ticks[47], late), (ticks[47], again))
    ]
    assert begun == [[True], [False], [True]]


@pytest.mark.long
def test_under_noise_configurations_have_no_last_manoeuvre(tmp_path: Path) -> None:
    found = shown(recorded(load("noisy", seed=8), tmp_path))
    assert max(one.count for one in found.values()) > 1
    assert all(one.manoeuvre is None for one in found.values())


def test_what_only_one_robot_holds_joins_nothing(tmp_path: Path) -> None:
    run = recorded(load("random", seed=3, faults=["loss=0.5, delay=0..3"]), tmp_path)
    held = {
        tick: (len(run.estimates("a")[tick].world), len(run.estimates("b")[tick].world)) for tick in range(58)
    }
    assert held[52] == (2, 0)
    assert held[55] == (2, 2)
    assert held[56] == (2, 1)
    assert {tick: one.count for tick, one in shown(run).items()} == {54: 2, 55: 2, 57: 1}


@pytest.mark.long
def test_an_attacker_and_its_victim_hold_no_configurations_in_common(tmp_path: Path) -> None:
    text = (
        shipped()["random"].read_text().replace("[mission]\n", "[mission]\nnoise = {mutual_sigma = 0.05}\n")
    )
    scenario = parse(text, "random", seed=2)
    attacks = {"a": Attack("scale", 0.9)}
    robots = tuple([replace(one, attack=attacks.get(one.id)) for one in scenario.robots])
    run = recorded(replace(scenario, robots=robots, max_ticks=100), tmp_path)
    held = [[tick for tick, one in enumerate(run.estimates(robot)) if one.world] for robot in run.robots]
    assert min(len(ticks) for ticks in held) > 5
    assert not shown(run)
