"""The sweeps that ship, and the rows and figures of sweeps of faults, attacks and groups."""

from __future__ import annotations

import math
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from compose.errors import NoSuchField, Unworkable
from compose.figures.style import SWEEP_MEDIUM, look
from compose.launch import in_process
from compose.launch.in_process import run_mission
from compose.scenario.scenario_file import load, scenario_table, validate
from compose.sweep import axis_figures, execution, spec
from compose.sweep.cells import cells, setting_of
from compose.sweep.field_paths import steps, with_value
from compose.sweep.group_columns import GroupColumns, group_columns
from compose.sweep.statistics import columns_of
from compose.sweep.table import schema_of
from compose.sweep.trial import Trial, row, run_trial
from protocol.attack import Attack
from protocol.messages import Localised
from protocol.network.inbox import Inbox
from protocol.noise import Noise
from tests.commands import tandem
from tests.groups import group_of
from tests.series import series
from world.faults import Fault
from world.scenario import Scenario
from world.world_noise import WorldNoise


@pytest.mark.parametrize("name", series(sorted(spec.shipped()), 6))
def test_every_shipped_sweep_runs(name: str) -> None:
    sweep = spec.load(name)
    execution.check_columns(sweep, schema_of(sweep, list(cells(sweep))))
    for cell in cells(sweep):
        with suppress(Unworkable):
            assert setting_of(sweep, cell).scenario.name == sweep.base["name"]
    assert f"{name:10} " in tandem("scenarios").out


@pytest.mark.long
def test_the_sweep_of_noise_has_the_same_starts_in_every_cell() -> None:
    sweep = spec.load("noise")
    settings = [setting_of(sweep, cell) for cell in cells(sweep)]
    assert {cell.key for cell in cells(sweep)} == {"{}"}
    assert len(settings) == (15 * 2 + 4) * 2
    missions = set()
    hard = set()
    starts = set()
    for setting in settings:
        scenario = setting.seeded(7)
        starts.add(tuple(robot.start for robot in scenario.robots))
        mission, noise = scenario.mission, scenario.mission.noise
        if noise.drop_outs or noise.odometry.v_floor or noise.odometry.omega_floor:
            hard.add((noise.drop_outs, noise.odometry.v_floor, noise.odometry.omega_floor))
            continue
        fractions = {noise.odometry.v, noise.odometry.omega, noise.actuation.v, noise.actuation.omega}
        (fraction,) = fractions
        assert noise.anchor_sigma == noise.mutual_sigma
        fine = 0.03 if noise.anchor_sigma <= 0.01 else 0.1
        assert mission.accuracy == (0.3 if fraction >= 0.01 else fine)
        missions.add((noise.anchor_sigma, fraction, noise.outliers, scenario.planner_name))
    assert len(starts) == 1
    planners = ("paper", "assured")
    known = product((0, 0.001, 0.01, 0.05, 0.1), (0, 0.001, 0.01), (0, 0.05), planners)
    assert missions == {*known, *product((0.05,), (0.05,), (0,), planners)}
    assert hard == {(0.3, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, 0.02)}


@pytest.mark.parametrize(("name", "told"), [("mismatch", 1), ("mismatch-uwb", 2)])
def test_the_sensors_of_each_row_of_mismatch_differ_whatever_robots_are_told(name: str, told: int) -> None:
    sweep = spec.load(name)
    scenarios = [setting_of(sweep, cell).scenario for cell in cells(sweep)]
    labels = [sweep.axes[-1].label(cell.place[-1]) for cell in cells(sweep)]
    informed = [place for place, label in enumerate(labels) if label.endswith(", told")]
    assert informed
    for place in informed:
        one, before = scenarios[place], scenarios[place - 1]
        assert one.world_noise == before.world_noise, (
            f"{labels[place]}: it tells what the row before does not"
        )
        told_of = {"range_delay": 0.1, "odometry_strays": 0.02}
        news = {name: value for name, value in told_of.items() if getattr(one.mission.noise, name) == value}
        assert len(news) == 1 or one.mission.noise.profile is not None
        assert one.mission.noise == replace(before.mission.noise, **news)
        assert one.mission.noise != before.mission.noise
    scenarios = [one for place, one in enumerate(scenarios) if place not in informed]
    assert {cell.key for cell in cells(sweep)} == {"{}"}
    assert scenarios[0].sensors.noise == scenarios[0].mission.noise
    of_noise: dict[Noise, list[WorldNoise | None]] = {}
    for one in scenarios:
        of_noise.setdefault(one.mission.noise, []).append(one.world_noise)
    assert len(of_noise) == told
    first = next(iter(of_noise.values()))
    for sensors in of_noise.values():
        assert sensors == first
        assert all(one not in sensors[:i] for i, one in enumerate(sensors))


ALWAYS = 10**9
LOSSES = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95)
TICKS = (0, 1, 2, 5, 10, 20)
WINDOWS = (0, 1, 5, 10, 20, 50)


def scenarios(name: str) -> list[Scenario]:
    """Return one scenario for each cell of the sweep `name`. All have the same seed and starts."""
    sweep = spec.load(name)
    found = []
    for cell in cells(sweep):
        assert cell.key == "{}"
        setting = setting_of(sweep, cell)
        found.append(setting.seeded(7))
    assert len({tuple(robot.start for robot in scenario.robots) for scenario in found}) == 1
    return found


def there(scenario: Scenario) -> Fault:
    """Return the only fault of `scenario` that is active."""
    (fault,) = [fault for fault in scenario.faults if fault.ticks == (0, ALWAYS)]
    return fault


def test_the_sweep_of_loss_has_the_loss_of_its_labels() -> None:
    for (share, bursts), scenario in zip(product(LOSSES, (False, True)), scenarios("loss"), strict=True):
        fault = there(scenario)
        assert fault.let_through == pytest.approx(1.0 - share)
        if bursts:
            assert (fault.loss, 1.0 / fault.burst_end) == (0.0, 20.0)


def test_the_sweep_of_delay_has_the_delays_of_its_labels() -> None:
    for (ticks, how), scenario in zip(product(TICKS, range(3)), scenarios("delay"), strict=True):
        fault = there(scenario)
        assert fault.delay == (ticks if how == 0 else 0, ticks)
        assert (fault.reorder, fault.duplicate) == ((0.0, 0.0) if how == 0 else (0.3, 0.3))
        assert fault.corrupt == (0.1 if how == 2 else 0.0)
        assert fault.bursty == pytest.approx(0.9 if how == 2 else 0.0)


def test_the_sweep_of_partitions_has_the_windows_and_directions_of_its_labels() -> None:
    ways = ("a->b", "b->a", "a<->b")
    for (ticks, begin, way), scenario in zip(
        product(WINDOWS, (0, 2), ways), scenarios("partition"), strict=True
    ):
        (fault,) = [fault for fault in scenario.faults if fault.partition]
        assert fault.contact_ticks == (begin, begin + ticks)
        assert fault.on("a", "b") == (way != "b->a")
        assert fault.on("b", "a") == (way != "a->b")


def test_a_fault_may_be_varied_that_the_base_scenario_leaves_out() -> None:
    bases: tuple[dict[str, Any], ...] = ({}, {"fault": []}, {"fault": [{"loss": 0.5}]})
    for base in bases:
        changed = with_value(base, steps("fault[1].delay", base), [0, 3])
        assert changed["fault"] == [*(base.get("fault") or [{}]), {"delay": [0, 3]}]
        assert with_value(base, steps("fault", base), [{"loss": 0.1}])["fault"] == [{"loss": 0.1}]
    with pytest.raises(NoSuchField, match=r"fault\[0\]: unknown field 'los'"):
        steps("fault[0].los", {})
    with pytest.raises(NoSuchField, match=r"robot\[\d\]: missing field 'id'"):
        steps("robot[2].anchor", {"robot": [{}, {}]})


def test_a_row_counts_what_was_lost_and_refused() -> None:
    scenario = load("random", faults=["loss=0.5, corrupt=0.3"])
    recording = in_process.run_mission(scenario)
    found = row(Trial(0, 0, scenario, processes=False), recording, 0.1)
    said = recording.final_reports.values()
    assert found.reports_lost == sum([one.reports_lost for one in said]) > 0
    assert found.reports_refused == sum([one.reports_refused for one in said]) > 0
    heard = sum([one.reports_heard for one in said])
    assert found.reports_sent == heard + found.reports_lost + found.reports_refused


SMALL = """
name = "small"
scenario = "random"
trials = 3
[[axis]]
name = "lost"
fields = ["fault[0].loss"]
labels = LABELS
values = [[0.0], [0.5]]
"""


@pytest.mark.parametrize(("labels", "curve"), [('["0", "0.5"]', True), ('["none", "half"]', False)])
def test_labels_that_are_numbers_make_a_curve(labels: str, curve: bool, tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL.replace("LABELS", labels))
    sweep = spec.load(str(tmp_path / "small.toml"))
    silent = execution.Progress(say=print, begin=lambda *_: None, done=lambda _: None)
    results = execution.sweep(
        sweep, tmp_path / "out", execution.ExecutionOptions(workers=1), Inbox("test"), silent
    )
    ticks = axis_figures.STATISTICS["ticks"]
    points = axis_figures.points(results, 0, ticks)
    (axes,) = axis_figures.over_axis(sweep, 0, ticks, points).axes
    median = axes.lines[0]
    assert median.get_linestyle() == ("-" if curve else "None")
    assert np.asarray(median.get_xdata()).tolist() == ([0.0, 0.5] if curve else [0.0, 1.0])
    assert axes.get_legend_handles_labels()[1] == ["median", "95 % quantile"]
    found = [results.figures[cell.index] for cell in results.cells]
    assert [one.estimate for one in points] == [
        *(ticks for one in found for ticks in (one.ticks_p50, one.ticks_p95)),
    ]
    assert [one.localised for one in found] == [3, 3]
    assert found[0].reports_lost == 0 < found[1].reports_lost
    for one in found:
        in_order = [one.ticks_p10, one.ticks_p50, one.ticks_p90, one.ticks_p95, one.ticks_max]
        assert in_order == sorted(in_order, key=lambda ticks: ticks or 0.0)


def test_no_label_of_a_legend_leaves_the_figure(tmp_path: Path) -> None:
    sweep = spec.load(str(written(tmp_path, "mission.noise.anchor_sigma", [0.03, 0.05, 0.1, 0.25])))
    names = [f"anchor_sigma = {one}" for one in (0.03, 0.05, 0.1, 0.25)]
    points = [axis_figures.FigurePoint(name, value, "", 0.5, 0.4, 0.6) for name in names for value in (0, 1)]
    with look(SWEEP_MEDIUM):
        figure = axis_figures.over_axis(sweep, 1, axis_figures.STATISTICS["success"], points)
        figure.draw_without_rendering()
        extents = [text.get_window_extent() for text in figure.legends[0].texts]
    assert len(extents) == len(names)
    assert all(figure.bbox.x0 <= one.x0 < one.x1 <= figure.bbox.x1 for one in extents)


def written(folder: Path, field: str, values: list[float]) -> Path:
    """Return the path of a sweep over `values` of a field, and over two planners."""
    axes = f'[[axis]]\nfield = "{field}"\nvalues = {values}\n[[axis]]\nfield = "planner.name"\n'
    path = folder / "two.toml"
    path.write_text(f'name = "two"\nscenario = "noisy"\ntrials = 1\n{axes}values = ["assured", "paper"]\n')
    return path


SPEC = """
name = "few-attacks"
scenario = "random"
trials = 4
seed = 4

[[axis]]
name = "attack"
field = "robot.a.attack"
paired = true
labels = ["honest", "scale orbit 0.5", "rotate encounter 15 deg"]
values = [
    {kind = "scale", part = "all", size = 1.0},
    {kind = "scale", part = "orbit", size = 0.5},
    {kind = "rotate", part = "encounter", size = 0.26},
]

[[axis]]
name = "sigma"
paired = true
fields = ["mission.noise.anchor_sigma", "mission.noise.mutual_sigma"]
labels = ["0 m", "0.01 m"]
values = [[0.0, 0.0], [0.01, 0.01]]
"""


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> execution.Results:
    """Return the results of a few missions with a few attacks."""
    folder = tmp_path_factory.mktemp("attacks")
    (folder / "few.toml").write_text(SPEC)
    progress = execution.Progress(say=lambda _: None, begin=lambda *_: None, done=lambda _: None)
    sweep = spec.load(str(folder / "few.toml"))
    return execution.sweep(
        sweep, folder / "out", execution.ExecutionOptions(workers=1), Inbox("test"), progress
    )


def test_the_shipped_sweep_has_the_attacks_of_its_labels() -> None:
    sweep = spec.load("attacks")
    seen: dict[str, Attack | None] = {}
    for cell in cells(sweep):
        setting = setting_of(sweep, cell)
        a, b = setting.scenario.robots
        assert b.attack is None
        seen[sweep.axes[0].label(cell.place[0])] = a.attack
    assert seen.pop("honest") == Attack("scale", 1.0), "which is no lie"
    for label, attack in seen.items():
        assert attack is not None
        kind, *part, size = label.removesuffix(" deg").removesuffix(" m").split()
        assert (attack.kind, attack.part) == (kind, part[0] if part else "all")
        assert attack.size == pytest.approx(math.radians(float(size)) if "deg" in label else float(size))


@pytest.mark.long
def test_honest_missions_localise_and_attacks_are_inconsistent(results: execution.Results) -> None:
    outcomes: dict[tuple[int, ...], set[str]] = {cell.place: set() for cell in results.cells}
    places = {cell.index: cell.place for cell in results.cells}
    for one in results.table.to_pylist():
        outcomes[places[one["cell"]]].add(one["outcome"])
    assert outcomes == {(i, j): {"inconsistent" if i else "localised"} for i in range(3) for j in range(2)}


@pytest.mark.long
def test_a_figure_shows_how_often_each_attack_is_found(results: execution.Results, tmp_path: Path) -> None:
    axis_figures.draw(results, tmp_path)
    assert {path.stem for path in tmp_path.iterdir()} == {
        f"{name}-{axis}" for name in ("success", "inconsistent", "ticks") for axis in ("attack", "sigma")
    }
    found = axis_figures.points(results, 0, axis_figures.STATISTICS["inconsistent"])
    rates = [
        (line, attack, 1.0 if attack else 0.0) for line in ("0 m", "0.01 m") for attack in range(3)
    ]  # fmt: skip
    assert [(one.line, one.value, one.estimate) for one in found] == rates
    assert all(one.low < one.high for one in found), "four trials leave an interval"


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
