"""Missions with random settings and starts: each localises, or is refused before any robot moves."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

import tandem
from compose.errors import BadSpec, Unworkable
from compose.scenario.scenario_file import ScenarioTemplate, validate
from compose.scenario.toml_file import table_in
from compose.sweep import spec
from compose.sweep.cells import cells, trial_seed, trial_table
from protocol.mission import Mission, infeasibility
from protocol.rounding import TOLERANCE
from tests.test_random_starts import assert_localised

ANYWHERE = spec.load("anywhere")
(CELL,) = cells(ANYWHERE)


def scenario_of(trial: int, **changed: Any) -> tandem.Scenario | None:
    """Return the scenario of a trial of the sweep, with `changed` tables; None if it is refused."""
    try:
        return tandem.Scenario.from_dict({**trial_table(ANYWHERE, CELL, trial), **changed})
    except Unworkable:
        return None


def played(trial: int) -> str:
    """Return the outcome of a trial of the sweep, with the reason if there is one, or "refused"."""
    scenario = scenario_of(trial)
    if scenario is None:
        return "refused"
    run = tandem.run(scenario)
    return run.outcome if run.reason is None else f"trial {trial}: {run.outcome}: {run.reason}"


@pytest.mark.long
def test_missions_in_any_setting_from_any_start_localise_or_are_refused() -> None:
    outcomes = Counter(played(trial) for trial in range(100))
    assert set(outcomes) <= {"localised", "refused"}, outcomes
    assert outcomes["refused"] < 20


@pytest.mark.long
@pytest.mark.parametrize("first", range(100, 1260, 290))
def test_a_thousand_missions_in_any_setting_localise_or_are_refused(first: int) -> None:
    outcomes = Counter(played(trial) for trial in range(first, first + 290))
    assert set(outcomes) <= {"localised", "refused"}, outcomes
    assert outcomes["refused"] < 0.12 * outcomes.total()


def released(mission: str, a: str, b: str) -> ScenarioTemplate:
    text = f'name = "case"\n[mission]\n{mission}\n[[robot]]\nid = "a"\n{a}\n[[robot]]\nid = "b"\n{b}\n'
    return validate(table_in(text, "case"), "case")


CASES = {
    "long manoeuvres in a range of 300 m": (
        "sensing_range = 300\nperiod = 1\nmax_speed = 400\nmax_turn_rate = 4",
        "anchor = [0, 0]\nstart = [167.7493981800512, -248.71698657319453, 2.1641742058076265]",
        "anchor = [-600, -300]\nstart = [-600, -300, -0.6]",
    ),
    "anchors a millimetre apart": (
        "sensing_range = 0.6\nperiod = 1\nmax_speed = 0.2\nmax_turn_rate = 3",
        "anchor = [0, 0]\nstart = [0, 0, 3]",
        "anchor = [0.001, 0]\nstart = [-0.02, 0.2, 2]",
    ),
    "nanometres off the anchor": (
        "sensing_range = 0.5\nperiod = 1\nmax_speed = 0.0129\nmax_turn_rate = 0.006",
        "anchor = [0, 0]\nstart = [0, 0, 0]",
        "anchor = [0.13913123, 0]\nstart = [0.1391312285, 3e-9, 3.14]",
    ),
    "both on one anchor, to picometres": (
        "sensing_range = 0.010889374966960848\nperiod = 0.31906386173409196\n"
        "max_speed = 0.008814358457046392\nmax_turn_rate = 0.6593553924539348",
        "anchor = [0, 0]\nstart = [2.3238060930841313e-12, 3.920699790629796e-12, 3.1415926535857297]",
        "anchor = [0.010160225251060194, 0]\n"
        "start = [2.3238060930841313e-12, 3.920699790629796e-12, 3.1415926535857297]",
    ),
    "a heading of a hundred thousand turns": (
        "sensing_range = 3\nperiod = 1\nmax_speed = 1\nmax_turn_rate = 3.14",
        "anchor = [0, 0]\nstart = [1, 1, 628318.7]",
        "anchor = [10, 0]\nstart = [10, 1, -999999.0]",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_a_mission_that_rounding_once_misled_localises(case: str) -> None:
    assert_localised(released(*CASES[case]).scenario)


ONCE_LOST = {
    "b stood where a's anchor is, and eq. (7) was solved from there": 22897,
    "b stood a little beside a's anchor, and eq. (7) was solved from there": 24366,
    "a range nearly nothing beside the others": 30968,
    "the same, with anchors close to each other": 45622,
    "a third point out of range left one branch, not known well enough": 6593,
    "two placements nearly one, with anchors close to each other": 38287,
    "ranges told less of b's anchor than the way to them cost, before it was known well": 67711,
    "the same of both anchors, close to each other": 56289,
    "b drove past where it had been ranged, a micrometre aside, and eq. (7) took it to have stood": 4540,
    "two branches that no range could distinguish were followed to and fro on the rim": 82152,
}


@pytest.mark.parametrize("case", ONCE_LOST)
def test_a_trial_that_was_once_lost_localises(case: str) -> None:
    scenario = scenario_of(ONCE_LOST[case])
    assert scenario is not None
    run = tandem.run(scenario)
    assert run.outcome == "localised", run.reason
    assert not run.audit().violations


def test_the_paper_is_never_wrong_either() -> None:
    """The planner `paper` may also end undecided."""
    for trial in range(60):
        scenario = scenario_of(trial, planner={"name": "paper"})
        if scenario is not None and scenario.template.scenario.max_ticks < 3000:
            run = tandem.run(scenario)
            assert run.outcome in ("localised", "undecided"), (trial, run.reason)


@pytest.mark.parametrize(
    ("mission", "distance"),
    [
        (Mission(1e4, 1.0, 100.0, 1.0), 3e5),
        (Mission(1e4, 1.0, 9e3, 3.0), 10.0),
        (Mission(100.0, 1.0, 1.0, 0.02), 0.1),
    ],
)
def test_a_mission_beyond_double_precision_is_infeasible(mission: Mission, distance: float) -> None:
    why = infeasibility(mission, distance)
    assert why is not None
    assert "to a micrometre in double precision" in why


@pytest.mark.parametrize(
    ("reach", "distance"), [(1e4, 1e4), (300.0, 600.0), (0.01, 1e-5), (0.01, 0.3), (3.0, 10.0)]
)
def test_a_mission_within_double_precision_is_feasible(reach: float, distance: float) -> None:
    assert infeasibility(Mission(reach, 1.0, 0.9 * reach, 3.0), distance) is None


# --- random draws -------------------------------------------------------------------------------------


def test_a_trial_follows_from_its_seed_and_number_alone() -> None:
    one, other = trial_table(ANYWHERE, CELL, 17), trial_table(spec.load("anywhere", trials=18), CELL, 17)
    assert one == other
    assert one["seed"] == trial_seed(ANYWHERE.seed, CELL.key, 17)
    assert trial_table(ANYWHERE, CELL, 18) != one
    assert trial_table(spec.load("anywhere", seed=2), CELL, 17) != one


def test_what_is_drawn_is_within_its_interval_and_starts_are_within_range() -> None:
    least: dict[str, float] = {}
    most: dict[str, float] = {}
    special: Counter[str] = Counter()
    for trial in range(600):
        table = trial_table(ANYWHERE, CELL, trial)
        mission, (a, b) = table["mission"], table["robot"]
        reach, period = mission["sensing_range"], mission["period"]
        drawn = {
            "R": reach,
            "D/R": b["anchor"][0] / reach,
            "v T/R": mission["max_speed"] * period / reach,
            "omega T": mission["max_turn_rate"] * period,
        }
        for name, value in drawn.items():
            least[name], most[name] = min(least.get(name, value), value), max(most.get(name, value), value)
        for robot in (a, b):
            rho = math.dist(robot["start"][:2], robot["anchor"])
            assert rho <= reach
            special["on"] += rho == 0.0
            special["near"] += 0.0 < rho < TOLERANCE
            special["rim"] += rho > reach * (1.0 - 1e-9)
        special["coincident"] += a["start"] == b["start"]
    for name, (low, high) in {
        "R": (1e-2, 1e4), "D/R": (1e-3, 30.0), "v T/R": (0.01, 1.5), "omega T": (0.02, math.tau)
    }.items():  # fmt: skip
        assert low * (1 - 1e-12) <= least[name] < 1.1 * low, name
        assert 0.9 * high < most[name] <= high * (1 + 1e-12), name
    assert min(special.values()) > 10, special


@pytest.mark.parametrize(
    ("draw", "says"),
    [
        ('field = "mission.period"', "draw[0]: needs exactly one of 'uniform' and 'log_uniform'"),
        ('field = "mission"\nuniform = [1, 2]', "draw[0].field: 'mission' is not a floating-point field"),
        ('field = "robot"\nuniform = [1, 2]', "draw[0].field: 'robot' is not a floating-point field"),
        ('field = "name"\nuniform = [1, 2]', "draw[0].field: 'name' is not a floating-point field"),
        ('field = "max_ticks"\nuniform = [1, 2]', "draw[0].field: 'max_ticks' is not a floating-point"),
        (
            'field = "mission.period"\nuniform = [1, 2]\nover = ["robot.a.anchor[0]"]',
            "draw[0].over: 'robot.a.anchor[0]' is 0",
        ),
        ('field = "mission.period"\nuniform = [-1e308, 1e308]', "draw[0]: -1e+308 to 1e+308 is not"),
        ('field = "mission.period"\nlog_uniform = [1e-308, 1e308]', "draw[0]: the interval 1e-308 to"),
        ('field = "mission.period"\nuniform = [2, 1]', "draw[0]: 2 to 1 is not an interval"),
        ('field = "mission.period"\nlog_uniform = [0, 1]', "draw[0]: 0 to 1 is not an interval above 0"),
        (
            'field = "mission.peroid"\nuniform = [1, 2]',
            "'mission.peroid': mission: unknown field 'peroid'; did you mean 'period'?",
        ),
        (
            'field = "mission.period"\nuniform = [1, 2]\ntimes = ["max_ticks"]',
            "is neither set by the scenario",
        ),
        ('field = "mission.period"\nuniform = [1, 2]\nover = ["robot.a.id"]', "'robot.a.id' is not a number"),
    ],
)
def test_a_draw_that_makes_no_sense_is_one_line(draw: str, says: str, tmp_path: Path) -> None:
    file = tmp_path / "drawn.toml"
    file.write_text(f'name = "drawn"\nscenario = "random"\ntrials = 1\n[[draw]]\n{draw}\n')
    with pytest.raises(BadSpec) as refused:
        spec.load(str(file))
    assert says in str(refused.value)
