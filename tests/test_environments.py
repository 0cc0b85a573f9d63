"""The PettingZoo environment: policies drive the robots, and the estimator of teams claims their poses."""

from __future__ import annotations

import time
from collections.abc import Mapping
from statistics import median
from typing import Any

import numpy as np
import pytest

import tandem
from tandem.environments import NO_RANGE, MissionEnvironment

pettingzoo_test = pytest.importorskip("pettingzoo.test")


def driven(env: MissionEnvironment, run: tandem.Run) -> tuple[list[dict[str, Any]], Mapping[str, Any]]:
    """Return the observations of all ticks with the commands of `run`, and then rest; and the last infos."""
    infos: Mapping[str, Any]
    first, infos = env.reset(seed=run.seed)
    seen, rows = [first], run.commands
    actions: dict[int, dict[str, tuple[float, float]]] = {}
    for tick, robot, v, omega in zip(*[rows[name] for name in ("tick", "robot", "v", "omega")], strict=True):
        actions.setdefault(int(tick), {})[robot] = (v, omega)
    while env.agents:
        robots = list(env.agents)
        last, rewards, ended, late, infos = env.step(actions.get(env.world.tick, {}))
        seen.append(last)
        assert rewards == dict.fromkeys(robots, -1.0)
        assert len({*ended.values()}) == len({*late.values()}) == 1, "all end together"
        assert not (ended["a"] and late["a"])
        assert (env.agents == []) is (ended["a"] or late["a"])
    return seen, infos


@pytest.mark.parametrize("scenario", ["random", "room"])
def test_the_environment_passes_the_tests_of_pettingzoo(
    scenario: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Their warnings are errors here."""
    pettingzoo_test.parallel_api_test(tandem.parallel_env(scenario), num_cycles=40)
    assert "Passed" in capsys.readouterr().out
    pettingzoo_test.parallel_seed_test(lambda: tandem.parallel_env(scenario), num_cycles=20)


def test_robots_that_drive_as_assured_does_claim_right_poses_at_about_its_time() -> None:
    run = tandem.run("noisy", seed=3)
    env = tandem.parallel_env("noisy")
    seen, infos = driven(env, run)
    assert infos["a"] == infos["b"] == {"outcome": "localised", "reason": None}
    assert env.world.outcome == "localised"
    assert abs(env.world.tick - run.ticks) < 5
    rows = run.observations
    for k, tick in enumerate(rows["tick"][: 2 * run.ticks]):
        robot = rows["robot"][k]
        one = seen[tick][robot]
        assert one in env.observation_space(robot)
        measured = (rows["v"][k], rows["omega"][k], rows["anchor_range"][k], rows["mutual_range"][k])
        shown = np.where(np.isnan(measured), (0.0, 0.0, NO_RANGE, NO_RANGE), measured)
        assert one[[0, 1, 7, 8]] == pytest.approx(shown, rel=1e-6)


def test_robots_that_hear_nothing_of_each_other_claim_nothing() -> None:
    """The estimator knows what the reports that are received have told, and no more."""
    lossy = tandem.Scenario.load("noisy").with_({"max_ticks": 40}).with_faults("a->b: loss=1.0")
    env = tandem.parallel_env(lossy)
    _, infos = driven(env, tandem.run("noisy", seed=3))
    assert infos["a"]["outcome"] == "undecided"
    assert {*env.claims} == {"a"}


def test_the_mission_ends_at_max_ticks_and_further_ones_have_the_next_seeds() -> None:
    env = tandem.parallel_env(tandem.Scenario.load("random").with_(max_ticks=3), seed=5)
    for seed in (5, 6, 7):
        env.reset()
        assert env.world.scenario.seed == seed
        assert env.world.truth == tandem.World("random", seed=seed).truth
        for late in (False, False, True):
            assert env.step({})[3] == {"a": late, "b": late}
        assert env.world.outcome == "undecided"
        with pytest.raises(tandem.UserError, match=r"over: call reset\(\)"):
            env.step({})


@pytest.mark.parametrize("action", [(1.0,), (np.nan, 0.0), "fast", 1.0])
def test_an_action_that_is_none_is_refused_in_one_line(action: Any) -> None:
    env = tandem.parallel_env("random")
    env.reset()
    with pytest.raises(tandem.UserError, match=r"^actions: b: not \(v, omega\) in m/s and rad/s: .*$"):
        env.step({"a": (0.0, 0.0), "b": action})


def test_an_action_of_no_robot_is_refused_with_the_robots_that_there_are() -> None:
    env = tandem.parallel_env("random")
    env.reset()
    with pytest.raises(tandem.UserError, match=r"^actions: there is no 'c'; there are a, b"):
        env.step({"c": (0.0, 0.0)})


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["random", "noisy", "room", "group-8"])
def test_a_step_without_an_estimate_takes_little_more_than_that_of_the_world(scenario: str) -> None:
    """The world steps and is observed; medians of steps of the same run."""
    env, rng = tandem.parallel_env(scenario), np.random.default_rng(1)
    env._estimate = lambda *_: None  # type: ignore[method-assign]
    alone, within = [], []
    for seed in range(10):
        env.reset(seed=seed)
        while env.agents and env.world.tick < 40:
            actions = {robot: np.array((0.1, rng.uniform(-0.5, 0.5))) for robot in env.agents}
            times = [time.perf_counter()]
            env.world.step(actions).observe()
            times.append(time.perf_counter())
            env.step(actions)
            times.append(time.perf_counter())
            alone.append(times[1] - times[0])
            within.append(times[2] - times[1])
    assert median(within) < 1.5 * median(alone)
