"""Constant errors that nobody told: profiles, what robots learn, refusals, and who is inconsistent."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from scipy import stats  # type: ignore[import-untyped]

from agent.estimation.fit import Fit, fits
from agent.estimation.gaussian.beacon_guesses import start_of
from agent.estimation.gaussian.consistency import beta_binomial_tail, f_tail, fisher, sigmas
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.noise_level import LEAST_LEVEL, noise_level, residual_correlation
from agent.estimation.gaussian.odometry_noise import Array, Track, track
from agent.estimation.gaussian.own_sensors import doubt
from agent.estimation.gaussian.range_model import inlier_probability
from agent.estimation.gaussian.range_weights import Weighing, weights_by_errors
from agent.estimation.gaussian.reachable_accuracy import reference_sigma
from agent.peer.peer_state import PeerState
from agent.planning.assured import Assured
from agent.planning.plausibility import objection
from compose.errors import Unworkable
from compose.launch.in_process import run_mission
from compose.recording.reasons import reason_for
from compose.scenario import scenario_file
from protocol.messages import Observation, Report
from protocol.motion import REST, Segment
from protocol.noise import PROFILES, UNTOLD, Noise, with_profile
from tests.pair_starts import alone
from world.scenario import Scenario

PLAIN = """
name = "plain"
seed = 1

[mission]
sensing_range = 3.0
period = 1.0
max_speed = 1.0
max_turn_rate = 3.14159
accuracy = {accuracy}
noise = {noise}

[[robot]]
id = "a"
anchor = [0.0, 0.0]

[[robot]]
id = "b"
anchor = [10.0, 0.0]
"""


def parsed(noise: str, accuracy: float = 0.3, world: str = "") -> Scenario:
    return scenario_file.parse(PLAIN.format(noise=noise, accuracy=accuracy) + world, "plain.toml")


# --- profiles and priors ------------------------------------------------------------------------------


def test_a_profile_is_a_table_of_noise_and_fields_beside_it_replace_its_values() -> None:
    by_name = parsed('"uwb"').mission.noise
    assert by_name.range_bias == PROFILES["uwb"]["range_bias"]
    assert by_name == parsed('{profile = "uwb"}').mission.noise
    other = parsed('{profile = "uwb", range_bias = 0.1}').mission.noise
    assert other == replace(by_name, range_bias=0.1)


@pytest.mark.parametrize("name", sorted({*PROFILES} - {"camera"}))
def test_every_profile_is_valid_and_its_mission_may_start(name: str) -> None:
    assert parsed(f'"{name}"').mission.noise == msgspec.convert(with_profile(name), Noise)


def test_whoever_tells_no_prior_has_one_that_shrinks_with_sigma() -> None:
    assert Noise(0.1, 0.1).priors == UNTOLD
    assert Noise(0.005, 0.005).priors.range_bias == pytest.approx(0.01 * UNTOLD.range_bias)
    assert Noise(0.005, 0.005, range_bias=0.4).priors.range_bias == 0.4
    assert not any(Noise(0.1, 0.1).as_told.priors[:4])


def test_without_noise_there_is_no_prior_and_with_a_prior_there_is_noise() -> None:
    assert Noise().exact
    assert Noise(range_bias=0.0, wheel_scale=0.0).exact
    assert not Noise(range_bias=0.1).exact


# --- refusal ------------------------------------------------------------------------------------------


def test_an_accuracy_that_the_priors_forbid_is_refused_with_the_prior_and_what_would_help() -> None:
    parsed('"uwb"', 0.3)
    with pytest.raises(Unworkable) as raised:
        parsed('"uwb"', 0.05)
    line = str(raised.value)
    assert "mission.accuracy" in line
    assert "0.05 m" in line
    assert "\n" not in line
    assert any(f"noise.{name}" in line for name in PROFILES["uwb"])


@pytest.mark.parametrize("name", ["range_bias", "gyro_bias"])
def test_a_prior_that_costs_little_forbids_no_accuracy_if_mutual_ranges_are_exact(name: str) -> None:
    """With cancellation in the covariance of ranges, the reference mission reached 1.3 m."""
    parsed(f"{{anchor_sigma = 0.01, {name} = 0.004}}", 0.1)


def test_the_profile_of_uncalibrated_radios_needs_a_coarser_accuracy_than_a_tenth_of_a_metre() -> None:
    with pytest.raises(Unworkable, match=r"mission\.accuracy: the prior noise"):
        parsed('"uwb"', 0.1)
    parsed('"uwb-calibrated"', 0.1)


# --- what a robot learns ------------------------------------------------------------------------------


def fitted(path: Track, rho: Array, noise: Noise, anchor: Array) -> Fit:
    """Return the fit to a range in each tick that begins with the anchor at `anchor` (m)."""
    (found,) = fits(alone(path, rho.tolist(), noise), [start_of(anchor)])
    return found


def drawn(seed: int, noise: Noise, level: float = 1.0) -> tuple[float, float]:
    """Return the NEES of an anchor and the noise level, with all constant errors drawn from their priors."""
    draw, priors, count = np.random.default_rng(seed), noise.priors, 30
    v, omega = draw.uniform(0.3, 0.8, count), draw.uniform(-1.0, 1.0, count)
    driven = track(v, omega, 1.0)
    scale, turn, gyro = draw.normal(size=3) * (priors.wheel_scale, priors.wheel_scale, priors.gyro_bias)
    measured = track(v / (1.0 + scale), (omega - gyro) / (1.0 + turn), 1.0)
    anchor = draw.uniform(-1.5, 1.5, 2)
    rho = np.hypot(driven.x - anchor[0], driven.y - anchor[1])
    bias, pair, factor = draw.normal(size=3) * (priors.range_bias, priors.pair_bias, priors.range_scale)
    rho = (rho + bias + pair + level * noise.anchor_sigma * draw.normal(size=count + 1)) / (1.0 - factor)
    found = fitted(measured, rho, noise, anchor)
    error = found.guess[:2] - anchor
    return float(error @ np.linalg.solve(found.of_start[:2, :2], error)), found.level


@pytest.mark.parametrize("noise", ['"uwb"', '"uwb-calibrated"', "{anchor_sigma = 0.05, mutual_sigma = 0.05}"])
def test_no_distance_between_the_smallest_and_the_largest_is_less_accurate_than_both(noise: str) -> None:
    """Therefore these two decide whether a prior forbids the accuracy of a group."""
    mission = parsed(noise, 1.0).mission
    found = [reference_sigma(mission, distance, mission.noise) for distance in np.geomspace(0.5, 100.0, 25)]
    for i in range(len(found)):
        for j in range(i + 1, len(found)):
            assert max(found[i : j + 1]) <= 1.05 * max(found[i], found[j])


def test_errors_from_the_priors_are_in_the_covariance() -> None:
    """200 draws of 2 unknowns: the mean NEES is 2 +- 0.6 in 99.9 %; a robot without priors has far more."""
    noise = msgspec.convert(PROFILES["uwb-calibrated"], Noise)
    nees = [drawn(seed, noise)[0] for seed in range(200)]
    assert 1.4 < np.mean(nees) < 2.6


def test_a_noise_level_is_learned_from_the_residuals() -> None:
    noise = Noise(0.05, 0.05)
    assert np.mean([drawn(seed, noise)[1] for seed in range(40)]) == pytest.approx(1.0, abs=0.2)
    assert np.mean([drawn(seed, noise, level=2.0)[1] for seed in range(40)]) == pytest.approx(4.0, rel=0.25)
    assert noise_level(100.0, 10, noise.as_told.sigma_degrees) == 1.0


def test_small_residuals_that_are_alike_do_not_make_a_robot_sure() -> None:
    alike, given, degrees = [0.01] * 21, ([1.0] * 21, [0.05] * 21), Noise(0.05, 0.05).sigma_degrees
    of_one_kind = [0] * 21
    by_chance = 2.0 / math.sqrt(21.0)
    found = residual_correlation(alike, *given, of_one_kind, 1.0)
    assert found == pytest.approx(20 / 21 - by_chance)
    assert residual_correlation([0.01, -0.01] * 10 + [0.01], *given, of_one_kind, 1.0) == 0.0
    assert noise_level(1.0, 19, degrees, 0.5) > 2.0 * noise_level(1.0, 19, degrees)
    assert noise_level(1.0, 19, degrees) < 0.6
    white = np.random.default_rng(1).normal(size=21).tolist()
    assert residual_correlation(white, *given, of_one_kind, 1.0) == 0.0
    of_two_kinds = residual_correlation(alike, *given, [0] * 10 + [1] * 11, 1.0)
    assert of_two_kinds == pytest.approx(19 / 21 - by_chance)


def test_residuals_that_are_too_small_count_only_as_far_as_they_are_white() -> None:
    """Slow errors look like a constant one: 3 of 1 000 claims of robots with AR(1) errors were wrong."""
    alike, given = [0.01] * 21, ([1.0] * 21, [0.05] * 21, [0] * 21)
    less_by_chance = 0.4 * 2.0 / math.sqrt(21.0)
    accurate, inaccurate = (residual_correlation(alike, *given, level) for level in (0.4, 3.0))
    assert accurate == pytest.approx(20 / 21 - less_by_chance)
    assert inaccurate < 20 / 21 - less_by_chance
    assert noise_level(0.0, 100, Noise(0.05, 0.05).sigma_degrees) == LEAST_LEVEL


def test_a_bias_of_all_ranges_is_no_correlation_of_their_errors() -> None:
    """It is estimated. Taken for correlation, it made the noise level 3, and most robots never claimed."""
    noise = Noise(0.05, 0.05, range_bias=0.4)
    assert np.mean([drawn(seed, noise)[1] for seed in range(40)]) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("outliers", [0.0, 0.05])
@pytest.mark.parametrize("strays", [0.0, 1e-3])
def test_the_probability_of_an_inlier_is_that_of_the_mixture(outliers: float, strays: float) -> None:
    noise = Noise(0.1, 0.1, outliers=outliers, strays=strays, sigma_degrees=0.0)
    residuals, sigma = np.linspace(-9.0, 9.0, 91), np.linspace(0.05, 3.0, 91)
    by = Weighing.of(noise, sigma, np.zeros(91, np.intp), np.arange(91), 1.0, free=0, noisy=False)
    probability, _ = weights_by_errors(residuals.tolist(), sigma.tolist(), by)
    assert probability == pytest.approx(inlier_probability(residuals, sigma, noise), abs=1e-12)


def test_the_tail_of_an_f_ratio_is_that_of_tables() -> None:
    """From the usual tables of the F distribution, at 5 % and 1 %."""
    for ratio, over, under, tail in ((3.33, 5, 10, 0.05), (2.98, 10, 10, 0.05), (4.85, 10, 10, 0.01)):
        assert f_tail(ratio, over, under) == pytest.approx(tail, rel=0.02)


# --- who is inconsistent ------------------------------------------------------------------------------


@pytest.mark.parametrize(("least", "count"), [(0, 5), (1, 12), (3, 12), (12, 12), (9, 200)])
def test_the_tail_of_a_beta_binomial_distribution_is_that_of_scipy(least: int, count: int) -> None:
    expected = stats.betabinom.sf(least - 1, count, 0.05, 35.0)
    assert beta_binomial_tail(least, count, 0.05, 35.0) == pytest.approx(expected, rel=1e-9)


def test_several_tests_that_are_each_a_little_improbable_are_very_improbable_together() -> None:
    p_values = [4e-4, 4e-4, 0.3]
    assert fisher(p_values) == pytest.approx(stats.combine_pvalues(p_values).pvalue, rel=1e-9)
    assert fisher(p_values) < 2e-5
    assert fisher([0.02]) == pytest.approx(0.02)
    assert fisher([0.0, 1.0]) < 1e-290


@pytest.mark.parametrize("value", [0.0, 0.5, 3.0, 8.0, 30.0])
def test_a_p_value_as_sigmas_is_that_of_a_normal_distribution(value: float) -> None:
    assert sigmas(float(stats.norm.sf(value))) == pytest.approx(value, abs=1e-9)
    assert sigmas(0.9) == 0.0


def own(bias: float) -> JointMeasurements:
    draw = np.random.default_rng(3)
    path = track(np.full(20, 0.5), np.full(20, 0.4), 1.0)
    rho = np.hypot(path.x - 0.7, path.y - 0.4) + bias + 0.05 * draw.normal(size=21)
    return alone(path, rho.tolist(), Noise(0.05, 0.05))


def test_a_robot_whose_own_ranges_contradict_its_odometry_names_the_profile_to_try() -> None:
    found = doubt(own(0.35))
    assert found is not None
    assert found.profile == "uwb"
    assert 'noise = "uwb"' in found.reason()
    assert doubt(own(0.0)) is None


@pytest.mark.parametrize(
    ("v", "strays", "fits"),
    [(1.001, 0.0, True), (1.03, 0.0, True), (1.5, 0.0, False), (1.5, 0.01, True), (3.0, 0.01, False)],
)
def test_the_limit_of_a_reported_speed_knows_the_scale_of_wheels_and_strays(
    v: float, strays: float, fits: bool
) -> None:
    told_noise = f"{{anchor_sigma = 0.05, mutual_sigma = 0.05, odometry_strays = {strays}}}"
    config = parsed(told_noise, 0.1).config("a")
    told = Report(
        tick=1,
        robot="b",
        phase=1,
        state="straight",
        start=None,
        since=0,
        through=1,
        runs=(Segment(1, v, 0.0),),
        ranges_since=0,
        ranges=(),
        heard=0,
        ranges_heard=0,
        verdict=None,
    )
    assert (objection(PeerState(), PeerState(), told, config, math.inf, Assured().rendezvous) is None) == fits


WORLD = """
[world.noise]
anchor_bias = 0.1
mutual_bias = 0.1
[world.noise.odometry]
scale = 0.001
"""


def test_a_bias_and_a_wheel_scale_that_nobody_told_leave_the_peer_unsuspected() -> None:
    """At the told sigma of 0.05 m, this mission ended `inconsistent` without priors."""
    scenario = parsed("{anchor_sigma = 0.05, mutual_sigma = 0.05}", 0.1, WORLD)
    end = run_mission(scenario).end
    assert end is not None
    assert end.outcome == "localised"


BIASED = """
[world.noise]
anchor_bias = 0.35
"""


def test_a_bias_of_the_anchors_only_ends_undecided_and_names_the_profile_to_try() -> None:
    """The noise level explains the residuals, and the claim would be 4 sigmas off."""
    end = run_mission(parsed("{anchor_sigma = 0.05, mutual_sigma = 0.05}", 0.3, BIASED)).end
    assert end is not None
    assert end.outcome == "undecided"
    assert 'noise = "uwb' in str(reason_for(end))
    assert "contradict the assumed noise" in str(reason_for(end))


@pytest.mark.parametrize("heading", [0.0, 1.5, 3.1])
def test_a_robot_without_any_range_to_its_anchor_searches_for_one(heading: float) -> None:
    """The true R is 2.7 m, and b starts 2.8 m from its anchor. It used to sleep until max_ticks."""
    text = PLAIN.format(noise="{anchor_sigma = 0.05, mutual_sigma = 0.05}", accuracy=0.3)
    text = text.replace("[10.0, 0.0]", f"[10.0, 0.0]\nstart = [10.0, 2.8, {heading}]")
    end = run_mission(scenario_file.parse(f"{text}[world.noise]\nsensing_range_factor = 0.9\n", "plain")).end
    assert end is not None
    assert end.outcome == "localised"


@pytest.mark.parametrize(("drop_outs", "ticks"), [(0.0, 0), (0.001, 1), (0.3, 6), (0.5, 10)])
def test_a_robot_searches_when_drop_outs_hardly_explain_that_it_has_no_range(
    drop_outs: float, ticks: int
) -> None:
    told = f"{{anchor_sigma = 0.05, mutual_sigma = 0.05, drop_outs = {drop_outs}}}"
    start = Assured().start(parsed(told, 0.3).config("a"))
    tasks = []
    for tick in range(ticks + 1):
        start = Assured().observe(start, Observation(tick, "a", REST if tick else None, None))
        tasks.append(start.task.name)
    assert tasks == ["asleep"] * ticks + ["straight"]


def test_many_ranges_are_not_shrunk_to_make_their_noise_smaller() -> None:
    # a scale that multiplied the measured ranges would move the anchor by 0.4 m
    ticks = np.arange(1000)
    forward = np.where(ticks // 4 % 2 == 0, 0.3, -0.3)
    path = track(forward, np.where(ticks % 8 == 0, 1.1, 0.0), 1.0)
    noise = Noise(anchor_sigma=0.05, mutual_sigma=0.05, range_bias=0.4, range_scale=0.05, wheel_scale=0.02)
    anchor, white = np.array((0.4, 1.5)), np.random.default_rng(1).standard_normal(1001)
    rho = np.hypot(path.x - anchor[0], path.y - anchor[1]) + 0.05 * white
    found = fitted(path, rho, noise, anchor)
    assert np.hypot(*(found.guess[:2] - anchor)) < 0.05
