"""The sweeps that ship: each runs, and varies what its labels say."""

from __future__ import annotations

from contextlib import suppress
from itertools import product

import pytest
from msgspec.structs import replace

from compose.errors import Unworkable
from compose.sweep import execution, spec
from compose.sweep.cells import cells, setting_of
from compose.sweep.table import schema_of
from protocol.noise import Noise
from tests.commands import tandem
from tests.series import series
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
