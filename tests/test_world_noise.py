"""The noise that the sensors have and the robots are not told: its effects, its recording and its audit."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray
from scipy.stats import expon, kstest, laplace, t, uniform  # type: ignore[import-untyped]

from compose.audit.rules import audit_run, replayed
from compose.errors import BadScenario, Unworkable
from compose.launch import in_process
from compose.recording.cramer_rao import position_bounds
from compose.recording.run import of_frames
from compose.scenario.scenario_file import parse
from protocol.messages import Command
from protocol.motion import REST, Controls, Pose
from protocol.noise import Noise, VelocityNoise
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from tests.commands import journals, tandem
from tests.missions import kept, own_ranges
from tests.series import series
from tests.test_noise import (
    APART,
    RHO_A,
    RHO_B,
    N,
    Z,
    are_uncorrelated,
    at_tick,
    has_share,
    is_gaussian,
    is_white,
    known,
    mutual,
    near_text,
    to_anchors,
)
from world import random_streams
from world.random_streams import correlated, random_walk
from world.scenario import Scenario
from world.sensors import executed, mutual_ranges, odometry
from world.tick import World, advance, observations, release
from world.truth import Truth
from world.world_noise import WorldNoise

Floats = NDArray[np.float64]
UNLIKELY = 1e-5
"""The smallest p-value of a test with a fixed seed."""
TOLD = "anchor_sigma = 0.05\nmutual_sigma = 0.05"
"""The noise that the robots are told."""


def text(world: str, *, told: str = TOLD, seed: int = 1, max_ticks: int = 500) -> str:
    """Return a scenario file in which all ranges are within R from the start."""
    return near_text(told, f"[world.noise]\n{world}", seed=seed, max_ticks=max_ticks)


def near(world: str, *, told: str = TOLD, seed: int = 1, max_ticks: int = 500) -> Scenario:
    """Return the scenario of `text`."""
    return parse(text(world, told=told, seed=seed, max_ticks=max_ticks), "near")


def anchor_errors(scenario: Scenario, ticks: int = N) -> Floats:
    """Return the errors of the ranges of robot a to its anchor, tick by tick."""
    return known(to_anchors(scenario, ticks)[0]) - RHO_A


EFFECTS = {
    "sigma": "anchor_sigma = 0.1\nmutual_sigma = 0.1",
    "wheels": "actuation = {v = 0.01}",
    "laplace": 'distribution = "laplace"',
    "student-t": 'distribution = "student-t"\ndegrees_of_freedom = 4',
    "exponential": 'distribution = "exponential"',
    "correlation": "correlation = 0.9",
    "outliers": "outliers = 0.1",
    "short outliers": "short_outliers = 0.1",
    "biases": "anchor_bias = 0.1\nmutual_bias = -0.1",
    "bias by robot": "anchor_bias = {a = 0.1}\nmutual_bias = {b = 0.2}",
    "scales": "anchor_scale = 0.02\nmutual_scale = 0.03",
    "radio biases": "radio_bias_sigma = 0.1",
    "radio scales": "radio_scale_sigma = 0.02",
    "true R": "sensing_range_factor = 0.9",
    "detection": "detection_exponent = 4",
    "lobes": "lobe_depth = 0.2",
    "survey": "survey_error = 0.1",
    "late ranges": "range_delay = 0.3",
    "wheel scale": "odometry.scale = 0.01",
    "wheel scales": "odometry.scale_sigma = 0.01",
    "gyro bias": "odometry.gyro_bias = 0.01",
    "gyro biases": "odometry.gyro_bias_sigma = 0.01",
    "gyro walk": "odometry.gyro_walk = 0.01",
    "late odometry": "odometry.delay = 0.3",
    "odometry strays": "odometry.strays = 0.1",
}
by_effect = pytest.mark.parametrize("world", EFFECTS.values(), ids=EFFECTS)


# --- the two tables -------------------------------------------------------------------------------------


def test_sensors_have_by_default_the_noise_that_the_robots_are_told() -> None:
    for world in ("", "anchor_sigma = 0.05", "odometry = {v = 0.0}"):
        scenario = near(world)
        assert type(scenario) is Scenario
        assert scenario.sensors.noise == scenario.mission.noise


def test_a_field_that_is_left_out_has_the_value_of_the_mission() -> None:
    told = TOLD + "\noutliers = 0.1\nodometry = {v = 0.01, omega = 0.02}\nactuation = {v_floor = 0.1}"
    scenario = near("mutual_sigma = 0.1\nodometry = {omega = 0.0, scale = 0.1}", told=told)
    assert scenario.sensors.noise == Noise(
        anchor_sigma=0.05,
        mutual_sigma=0.1,
        outliers=0.1,
        odometry=VelocityNoise(v=0.01, omega=0.0),
        actuation=VelocityNoise(v_floor=0.1),
    )


@by_effect
def test_no_robot_is_told_what_its_sensors_do(world: str) -> None:
    as_told, other = near(""), near(world)
    for robot in ("a", "b"):
        assert encode(other.config(robot)) == encode(as_told.config(robot))


# --- range errors ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("world", "law"),
    [
        ('distribution = "laplace"', laplace(scale=0.05 / math.sqrt(2.0))),
        ('distribution = "student-t"', t(3, scale=0.05 / math.sqrt(3.0))),
        ('distribution = "student-t"\ndegrees_of_freedom = 5', t(5, scale=0.05 * math.sqrt(0.6))),
        ('distribution = "exponential"', expon(scale=0.05)),
    ],
)
def test_each_distribution_is_its_own_with_sigma_as_its_standard_deviation(world: str, law: object) -> None:
    errors = anchor_errors(near(world))
    assert kstest(errors, law.cdf).pvalue > UNLIKELY  # type: ignore[attr-defined]
    assert law.std() == pytest.approx(0.05)  # type: ignore[attr-defined]
    assert is_white(errors)


@pytest.mark.parametrize("correlation", series([0.5, 0.95]))
def test_correlated_errors_are_an_ar1_process(correlation: float) -> None:
    errors = anchor_errors(near(f"correlation = {correlation}"), N // 2)
    innovations = errors[1:] - correlation * errors[:-1]
    assert is_gaussian(innovations, 0.05 * math.sqrt(1.0 - correlation**2))
    assert is_white(innovations)
    first = np.array([anchor_errors(near("correlation = 0.9", seed=seed), 1)[0] for seed in range(400)])
    assert is_gaussian(first, 0.05), "stationary from the first tick"


def test_errors_of_sensors_are_correlated_over_time_only() -> None:
    scenario = near("correlation = 0.9")
    a, b = (known(ranges) for ranges in to_anchors(scenario, N // 3))
    between = known(mutual(scenario, N // 3))
    for one, other in ((a, b), (a, between), (b, between)):
        white = [errors[1:] - 0.9 * errors[:-1] for errors in (one, other)]
        assert are_uncorrelated(*white)


def test_short_outliers_are_too_short_by_a_uniform_amount() -> None:
    errors = anchor_errors(near("anchor_sigma = 0\nshort_outliers = 0.2\nshort_outlier_bias = [0.3, 0.9]"))
    short = -errors[errors != 0.0]
    assert has_share(len(short), N, 0.2)
    assert kstest(short, uniform(0.3, 0.6).cdf).pvalue > UNLIKELY


def test_outliers_that_no_robot_was_told_are_those_of_a_mission_with_them() -> None:
    """The streams of the two tables are the same."""
    assert to_anchors(near("outliers = 0.1"), 500) == to_anchors(
        near("", told=TOLD + "\noutliers = 0.1"), 500
    )


@pytest.mark.parametrize(
    ("world", "a", "b", "between"),
    [
        ("anchor_bias = 0.1", RHO_A + 0.1, RHO_B + 0.1, APART),
        ("mutual_bias = -0.1", RHO_A, RHO_B, APART - 0.1),
        ("anchor_bias = {b = 0.1}", RHO_A, RHO_B + 0.1, APART),
        ("mutual_bias = {a = 0.2}", RHO_A, RHO_B, APART + 0.2),
        ("mutual_bias = {b = 0.2}", RHO_A, RHO_B, APART + 0.2),
        ("anchor_scale = 0.02", 1.02 * RHO_A, 1.02 * RHO_B, APART),
        ("mutual_scale = {a = 0.1}", RHO_A, RHO_B, 1.1 * APART),
        ("anchor_scale = {a = -0.1}\nanchor_bias = 1", 0.9 * RHO_A + 1.0, RHO_B + 1.0, APART),
    ],
)
def test_biases_and_scales_are_of_all_ranges_or_of_one(
    world: str, a: float, b: float, between: float
) -> None:
    scenario = near(f"anchor_sigma = 0\nmutual_sigma = 0\n{world}")
    assert [ranges[0] for ranges in to_anchors(scenario, 1)] == pytest.approx([a, b])
    assert mutual(scenario, 1) == pytest.approx([between])


@pytest.mark.parametrize(("field", "lengths"), [("bias", (1.0,) * 3), ("scale", (RHO_A, RHO_B, APART))])
def test_a_range_has_the_errors_of_both_its_radios(field: str, lengths: tuple[float, ...]) -> None:
    world = f"anchor_sigma = 0\nmutual_sigma = 0\nradio_{field}_sigma = 0.02"
    drawn = []
    for seed in range(600):
        scenario = near(world, seed=seed)
        told = [*[known(ranges) for ranges in to_anchors(scenario, 2)], known(mutual(scenario, 2))]
        assert all(ranges[0] == ranges[1] for ranges in told), "constant over the mission"
        drawn.append([ranges[0] for ranges in told])
    errors = (np.array(drawn) - (RHO_A, RHO_B, APART)) / lengths
    for of_one in errors.T:
        assert is_gaussian(of_one, 0.02 * math.sqrt(2.0))
    assert are_uncorrelated(errors[:, 0], errors[:, 1])
    shared = np.corrcoef(errors[:, 0], errors[:, 2])[0, 1]
    assert abs(shared - 0.5) <= Z * 0.75 / math.sqrt(len(errors)), "the radio of robot a is in both"


# --- detection ------------------------------------------------------------------------------------------


def test_detection_fades_with_range_and_without_it_there_is_no_contact() -> None:
    scenario = near("detection_exponent = 2")
    a, b = to_anchors(scenario, N)
    for ranges, rho in ((a, RHO_A), (b, RHO_B)):
        assert has_share(len(known(ranges)), N, 1.0 - (rho / 3.0) ** 2)
        assert is_white(np.array([rho is None for rho in ranges], float))
    heard = []
    for tick in range(N // 4):
        (contact,) = mutual_ranges(at_tick(scenario, tick), scenario, scenario.pairs())
        heard.append(contact is not None)
    assert has_share(sum(heard), len(heard), 1.0 - (APART / 3.0) ** 2)
    first = heard.index(False)
    world = replace(release(scenario), truth=at_tick(scenario, first))
    assert [one.contacts for one in observations(world)] == [(), ()]


def reaches(scenario: Scenario, rho: float, direction: float, heading: float = 0.0) -> tuple[bool, bool]:
    """Return whether there is a range to the anchor of a and to b, if a is `rho` m from both."""
    x, y = rho * math.cos(direction), rho * math.sin(direction)
    truth = Truth(0, (Pose(x, y, heading), Pose(2.0 * x, 2.0 * y, 0.0)), release(scenario).truth.origins)
    return own_ranges(truth, scenario)[0] is not None, mutual_ranges(truth, scenario, [(0, 1)])[0] is not None


def test_the_true_sensing_range_is_a_multiple_of_the_assumed_one() -> None:
    for factor in (0.9, 1.1):
        scenario = near(f"sensing_range_factor = {factor}")
        assert scenario.mission.sensing_range == 3.0
        assert reaches(scenario, 3.0 * factor - 1e-9, 1.0) == (True, True)
        assert reaches(scenario, 3.0 * factor + 1e-9, 1.0) == (False, False)


def test_lobes_turn_with_a_robot_and_stand_still_with_an_anchor() -> None:
    scenario = near("lobe_depth = 0.5\nlobes = 4")
    directions = np.linspace(0.0, math.tau, 360, endpoint=False)
    assert all(reaches(scenario, 1.5 - 1e-9, direction) == (True, True) for direction in directions)
    assert not any(any(reaches(scenario, 3.0 + 1e-9, direction)) for direction in directions)
    far = [reaches(scenario, 2.25, direction) for direction in directions]
    by_anchor = np.array([of_anchor for of_anchor, _ in far])
    assert abs(by_anchor.mean() - 0.5) < 0.02
    assert np.count_nonzero(by_anchor != np.roll(by_anchor, 1)) == 8, "four lobes"
    turned = [reaches(scenario, 2.25, direction, heading=0.8) for direction in directions]
    assert [of_anchor for of_anchor, _ in turned] == by_anchor.tolist()
    assert [mutual for _, mutual in turned] != [mutual for _, mutual in far]
    other = near("lobe_depth = 0.5\nlobes = 4", seed=2)
    assert [reaches(other, 2.25, direction)[0] for direction in directions] != by_anchor.tolist()


def test_an_anchor_stands_elsewhere_than_the_robots_are_told() -> None:
    offsets = []
    for seed in range(300):
        scenario = near("anchor_sigma = 0\nsurvey_error = {a = 0.3}", seed=seed)
        (x, y), b = scenario.sensors.survey.values()
        assert math.hypot(x, y) == pytest.approx(0.3)
        assert b == (0.0, 0.0)
        told = known([own_ranges(at_tick(scenario, 0), scenario)[0]])[0]
        assert told == pytest.approx(math.hypot(RHO_A - x, y))
        assert scenario.config("a").anchor == scenario.robots[0].anchor
        offsets.append(math.atan2(y, x))
    assert kstest(offsets, uniform(-math.pi, math.tau).cdf).pvalue > UNLIKELY


# --- odometry -------------------------------------------------------------------------------------------


def measured(world: str, *driven: Controls, told: str = TOLD, seed: int = 1) -> list[Controls]:
    """Return the odometry of robot a in the ticks after it has executed `driven`."""
    scenario = near(world, told=told, seed=seed)
    pairs = zip((REST, *driven), driven, strict=False)
    return [odometry(now, scenario, "a", k + 1, before) for k, (before, now) in enumerate(pairs)]


def test_wheels_measure_v_with_a_constant_relative_error() -> None:
    assert measured("odometry.scale = 0.02", Controls(0.5, 1.0)) == [Controls(0.51, 1.0)]
    assert measured("odometry.scale = {a = -0.02}", Controls(0.5, 1.0)) == [Controls(0.49, 1.0)]
    assert measured("odometry.scale = {b = 0.02}", Controls(0.5, 1.0)) == [Controls(0.5, 1.0)]
    drawn = [measured("odometry.scale_sigma = 0.02", *[Controls(1.0, 0.0)] * 2, seed=k) for k in range(500)]
    assert all(one == other for one, other in drawn), "constant over the mission"
    assert is_gaussian(np.array([one.v - 1.0 for one, _ in drawn]), 0.02)


def test_a_gyro_has_its_bias_while_the_robot_moves() -> None:
    moving, at_rest = measured("odometry.gyro_bias = 0.01", Controls(0.5, 1.0), REST)
    assert moving == Controls(0.5, 1.01)
    assert at_rest == REST
    assert measured("odometry.gyro_bias = {b = 0.01}", Controls(0.5, 1.0)) == [Controls(0.5, 1.0)]
    drawn = [measured("odometry.gyro_bias_sigma = 0.02", Controls(1.0, 0.0), seed=k)[0] for k in range(500)]
    assert is_gaussian(np.array([one.omega for one in drawn]), 0.02)


def test_strays_of_the_odometry_have_the_stated_share_and_size() -> None:
    driven = Controls(0.5, 0.1)
    table = "odometry.strays = 0.2\nodometry.stray_turn = 0.3\nodometry.stray_distance = 0.4"
    found = np.array([(one.v - driven.v, one.omega - driven.omega) for one in measured(table, *[driven] * N)])
    strays = found[found[:, 1] != 0.0]
    assert has_share(len(strays), N, 0.2)
    assert is_gaussian(strays[:, 1], 0.3)
    assert is_gaussian(strays[:, 0], 0.4 * 0.5)
    assert measured(table, REST) == [REST], "a robot at rest does not slip"


def test_the_bias_of_a_gyro_walks() -> None:
    found = measured("odometry.gyro_walk = 0.01", *[Controls(1.0, 0.0)] * N)
    steps = np.diff([0.0, *[one.omega for one in found]])
    assert is_gaussian(steps, 0.01)
    assert is_white(steps)


def test_a_late_odometry_measures_a_part_of_the_tick_before() -> None:
    world = "odometry.delay = 0.25"
    driven = (Controls(1.0, 0.0), Controls(0.0, 2.0), REST, REST)
    assert measured(world, *driven) == [Controls(0.75, 0.0), Controls(0.25, 1.5), Controls(0.0, 0.5), REST]
    scenario = near(world)
    now: World = release(scenario)
    for k, (expected, asked) in enumerate(((None, 1.0), (0.75, 0.5), (0.625, 0.0))):
        found = observations(now)[0].executed
        assert (None if found is None else found.v) == expected
        onward = advance(now, {"a": Command(k, "a", asked, 0.0, 1, "straight")})
        assert isinstance(onward, World)
        now = onward


def test_white_noise_of_odometry_comes_on_top() -> None:
    found = measured("odometry = {v = 0.1, scale = 0.5}", *[Controls(1.0, 0.0)] * N)
    assert is_gaussian(np.array([one.v - 1.5 for one in found]), 0.15)


# --- random streams -------------------------------------------------------------------------------------


@pytest.mark.parametrize("draw", [random_walk, partial(correlated, correlation=0.9)])
def test_a_process_is_the_same_at_each_tick_in_whatever_order(draw: Callable[..., float]) -> None:
    ticks = [0, 1, 2, 3, 17, 64, 65, 1000]
    found = [draw(1, "x", "a", tick) for tick in ticks]
    random_streams._remembered.cache_clear()
    assert [draw(1, "x", "a", tick) for tick in reversed(ticks)] == found[::-1]


def streams(monkeypatch: pytest.MonkeyPatch, scenario: Scenario) -> set[str]:
    """Return the names of the random streams that the sensors draw from in some ticks."""
    drawn: set[str] = set()
    draw = random_streams._uniforms

    def noted(seed: int, sensor: str, robot: str, tick: int) -> tuple[float, float]:
        drawn.add(sensor)
        return draw(seed, sensor, robot, tick)

    random_streams._remembered.cache_clear()
    monkeypatch.setattr(random_streams, "_uniforms", noted)
    for tick in range(3):
        own_ranges(at_tick(scenario, tick), scenario)
        mutual_ranges(at_tick(scenario, tick), scenario, scenario.pairs())
        done = executed(Controls(0.5, 0.5), scenario, "a", tick)
        odometry(done, scenario, "a", tick + 1)
    monkeypatch.setattr(random_streams, "_uniforms", draw)
    return drawn


STREAMS = {
    "wheels": {"actuation-v"},
    "laplace": {"anchor-laplace", "mutual-laplace"},
    "student-t": {f"{sensor}-student-{i}" for sensor in ("anchor", "mutual") for i in range(4)},
    "outliers": {"anchor-outlier", "mutual-outlier", "anchor-bias", "mutual-bias"},
    "short outliers": {
        f"{sensor}-{of}" for sensor in ("anchor", "mutual") for of in ("short-outlier", "short-bias")
    },
    "radio biases": {"robot-radio-bias", "anchor-radio-bias"},
    "radio scales": {"robot-radio-scale", "anchor-radio-scale"},
    "detection": {"anchor-detection", "mutual-detection"},
    "lobes": {"anchor-lobes", "robot-lobes"},
    "survey": {"survey"},
    "wheel scales": {"wheel-scale"},
    "gyro biases": {"gyro-bias"},
    "gyro walk": {"gyro-walk", "gyro-walk-middle"},
    "odometry strays": {"odometry-stray", "odometry-stray-v", "odometry-stray-omega"},
}
"""The random streams of each effect that has any of its own."""


@pytest.mark.parametrize("name", ["", *EFFECTS])
def test_an_effect_draws_from_its_own_streams_and_what_is_off_draws_nothing(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = streams(monkeypatch, near(EFFECTS.get(name, "")))
    assert drawn <= {"anchor", "mutual"} | STREAMS.get(name, set())
    assert drawn >= {"anchor", "mutual"} - ({"anchor", "mutual"} if name == "detection" else set())


@by_effect
def test_an_effect_leaves_other_sensors_as_they_were(world: str) -> None:
    told = TOLD + "\nodometry = {v = 0.01, omega = 0.01}\nactuation = {v = 0.01, omega = 0.01}"
    one, other = near("", told=told), near(world, told=told)
    if "odometry" in world or "actuation" in world:
        assert to_anchors(one, 20) == to_anchors(other, 20)
        assert mutual(one, 20) == mutual(other, 20)
    else:
        for tick in range(20):
            assert odometry(Controls(1.0, 1.0), one, "a", tick) == odometry(
                Controls(1.0, 1.0), other, "a", tick
            )
    if "actuation" not in world:
        for tick in range(20):
            assert executed(Controls(1.0, 1.0), one, "a", tick) == executed(
                Controls(1.0, 1.0), other, "a", tick
            )


# --- the recording --------------------------------------------------------------------------------------


def test_a_table_that_changes_nothing_leaves_the_same_bytes() -> None:
    assert kept(near("", max_ticks=20)) == kept(near("mutual_sigma = 0.05", max_ticks=20))


@pytest.mark.parametrize("world", series(EFFECTS.values(), 1))
def test_the_audit_and_the_replay_accept_each_effect_and_find_a_forged_range(world: str) -> None:
    recorded = kept(near(world, max_ticks=25))
    run = of_frames(recorded)
    findings = audit_run(run)
    assert findings.violations == ()
    assert replayed(run).differences == ()

    agent = run.agents["a"]
    step = next(one for one in agent.steps if one.observation.tick > 0 and one.observation.anchor_range)
    rho = step.observation.anchor_range
    assert rho is not None
    forged = encode(replace(step.observation, anchor_range=math.nextafter(rho, 0.0)))
    name = "agent-a.journal"
    frames = [forged if frame == step.frame else frame for frame in recorded[name]]
    found = audit_run(of_frames({**recorded, name: frames})).violations
    assert (step.observation.tick, "a", "observation") in [(one.tick, one.robot, one.rule) for one in found]


def test_the_audit_finds_a_table_that_no_run_accepts() -> None:
    recorded = kept(near("anchor_bias = 0.1", max_ticks=3))
    scenario = decode(recorded["world.journal"][1], Scenario, MAX_FRAME_BYTES)
    for noise, says in (
        (
            WorldNoise(anchor_bias={"c": 0.1}),
            "world.noise.anchor_bias: there is no robot 'c'; there are a, b",
        ),
        (WorldNoise(short_outlier_bias=(2.0, 1.0)), "world.noise.short_outlier_bias: the lower bound 2 m"),
    ):
        other = [recorded["world.journal"][0], encode(replace(scenario, world_noise=noise))]
        run = of_frames({**recorded, "world.journal": other + recorded["world.journal"][2:]})
        found = [one.what for one in audit_run(run).violations if one.rule == "scenario"]
        assert found[0].startswith(says)


def test_processes_and_one_process_leave_the_same_bytes_and_commands_read_them(tmp_path: Path) -> None:
    (tmp_path / "near.toml").write_text(text("anchor_bias = 0.1\ncorrelation = 0.9", max_ticks=15))
    for out, mode in (("processes", []), ("one", ["--in-process"])):
        ended = tandem("run", "near.toml", "-q", "--out", out, *mode, cwd=tmp_path)
        assert ended.status in (0, 1), ended
        assert ended.err == ""
    assert journals(tmp_path / "processes") == journals(tmp_path / "one")
    parameters = json.loads((tmp_path / "one" / "summary.json").read_text())["parameters"]
    assert parameters["noise"]["anchor_sigma"] == 0.05
    assert (parameters["world_noise"]["anchor_bias"], parameters["world_noise"]["anchor_sigma"]) == (
        0.1,
        None,
    )
    for command in ("audit", "replay"):
        ended = tandem(command, "processes", cwd=tmp_path)
        assert ended.status == 0, ended


@pytest.mark.long
def test_figures_and_exports_are_made_of_such_a_recording(tmp_path: Path) -> None:
    in_process.run_mission(near("anchor_bias = 0.1\ncorrelation = 0.9", max_ticks=15), tmp_path / "one")
    for command in (["export"], ["figures", "--format", "svg"]):
        ended = tandem(command[0], "one", *command[1:], cwd=tmp_path)
        assert ended.status == 0, ended


def test_the_cramer_rao_bound_is_that_of_the_true_sigma_and_of_gaussian_noise_only() -> None:
    def bound(world: str) -> tuple[float, float] | None:
        return position_bounds(in_process.run_mission(near(world, max_ticks=12)), (0, 1), 11)

    assert bound('distribution = "laplace"') is None
    as_told, exact_odometry = bound(""), bound("odometry.scale = 0.1")
    assert as_told is not None
    assert exact_odometry is None
    assert bound("anchor_sigma = 0\nmutual_sigma = 0") is None


# --- invalid tables -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("world", "says"),
    [
        ("anchor_sigma = -1", "world.noise.anchor_sigma: "),
        ("sigma = 1", "world.noise: unknown field 'sigma'"),
        ("odometry.scal = 1", "world.noise.odometry: unknown field 'scal'"),
        ("actuation.scale = 1", "world.noise.actuation: unknown field 'scale'"),
        (
            'distribution = "laplac"',
            "world.noise.distribution: there is no 'laplac'; there are exponential, gaussian, ",
        ),
        ("degrees_of_freedom = 2", "world.noise.degrees_of_freedom: "),
        ("correlation = 1.0", "world.noise.correlation: "),
        ("outlier_bias = [2.0, 1.0]", "world.noise.outlier_bias: the lower bound 2 m is above"),
        ("short_outlier_bias = [2.0, 1.0]", "world.noise.short_outlier_bias: the lower bound 2 m is above"),
        ("short_outliers = 0.6", "world.noise.short_outliers: "),
        ("anchor_bias = inf", "world.noise.anchor_bias: "),
        ("anchor_bias = {c = 0.1}", "world.noise.anchor_bias: there is no robot 'c'; there are a, b"),
        ("mutual_scale = {a = 0.1, b = 0.1}", "world.noise.mutual_scale: 'a' and 'b' are one pair"),
        ("odometry.scale = {c = 0.1}", "world.noise.odometry.scale: there is no robot 'c'"),
        ("odometry.gyro_bias = {c = 0.1}", "world.noise.odometry.gyro_bias: there is no robot 'c'"),
        ("survey_error = -0.1", "world.noise.survey_error: "),
        ("range_delay = 1.1", "world.noise.range_delay: it is longer than a tick (mission.period), 1 s"),
        ("detection_exponent = 0", "world.noise.detection_exponent: "),
        ("lobe_depth = 1", "world.noise.lobe_depth: "),
        ("sensing_range_factor = 0", "world.noise.sensing_range_factor: "),
        ("odometry.delay = 1.5", "world.noise.odometry.delay: "),
    ],
)
def test_a_mistake_in_the_table_is_named(world: str, says: str) -> None:
    with pytest.raises(BadScenario) as bad:
        near(world)
    assert str(bad.value).startswith(f"near: {says}")
    assert "\n" not in str(bad.value)


def test_robots_that_are_told_exact_sensors_have_exact_ones() -> None:
    with pytest.raises(
        Unworkable, match=r"near: world\.noise: the robots are told that all sensors are exact"
    ):
        near("anchor_sigma = 0.05", told="")
    with pytest.raises(Unworkable):
        near("odometry.scale = 0.01", told="")
    assert near("anchor_sigma = 0", told="") == near("", told="")
    exact = near("anchor_sigma = 0\nmutual_sigma = 0")
    assert exact.sensors.exact
    assert not exact.mission.noise.exact
    assert to_anchors(exact, 1) == [[RHO_A], [RHO_B]]
