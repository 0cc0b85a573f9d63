"""The time until two orbiting robots meet, for all starting phases, and the limits of their orbits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from protocol.mission import RANGE_MARGIN, Mission
from protocol.motion import TAU
from protocol.orbits import WAITING_PLACE, Orbit, half_passage, rendezvous
from tests.series import series

Setting = tuple[float, float, float, float, float]
"""A setting: D, R, T_s, v_max, omega_max."""

SECTION_IV: Setting = (10.0, 3.0, 1.0, 1.0, math.pi)
SETTINGS: tuple[Setting, ...] = (
    SECTION_IV,
    *((distance, 3.0, 1.0, 1.0, math.pi) for distance in (7.0, 8.0, 15.0, 30.0)),
    *((10.0, reach, 1.0, 1.0, math.pi) for reach in (1.5, 5.0)),
    *((10.0, 3.0, 1.0, speed, math.pi) for speed in (0.3, 0.5, 2.0, 5.0)),
    (10.0, 3.0, 1.0, 1.0, 0.5),
    *((10.0, 3.0, period, 1.0, math.pi) for period in (0.1, 0.5)),
    *((10.0, 1.0, period, 1.0, turn_rate) for period in (0.05, 1.0) for turn_rate in (0.2, math.pi)),
)
ALWAYS_IN_RANGE: tuple[Setting, ...] = tuple(
    (10.0, 15.0, period, 1.0, turn_rate) for period in (0.05, 1.0) for turn_rate in (0.2, math.pi)
)

FINE = (8192, 128)
"""The number of sampled phases of a and b. Those of a are finer because a moves.

The phases of b include the nearest to M1 and the farthest from it.
"""
COARSE = (120, 120)
ROUNDING = 1e-9
"""The tolerance in s, m and rad, above the rounding error of sums of this size."""

Array = NDArray[np.float64]


def drawn(least: float, most: float) -> st.SearchStrategy[Setting]:
    """Return a strategy for settings with R / D from `least` to `most`."""
    ranges = st.floats(least, most), st.floats(0.05, 1.0), st.floats(0.3, 5.0), st.floats(0.2, math.pi)
    return st.tuples(st.floats(1.0, 40.0), *ranges).map(lambda of: (of[0], of[0] * of[1], *of[2:]))


def mission_of(setting: Setting) -> Mission:
    return Mission(*setting[1:])


def pairs(phases: tuple[int, int]) -> tuple[Array, Array]:
    """Return all pairs of starting phases of a and b."""
    alpha, beta = np.meshgrid(*(np.arange(n) * (TAU / n) for n in phases))
    return alpha.ravel(), beta.ravel()


def apart(distance: float, a: Orbit, alpha: Array, b: Orbit, beta: Array) -> Array:
    """Return the distance in m of robots at the phases alpha and beta; M1 is at (0, 0) and M2 at (D, 0)."""
    x = distance + b.radius * np.cos(beta) - a.radius * np.cos(alpha)
    y = b.radius * np.sin(beta) - a.radius * np.sin(alpha)
    return np.hypot(x, y)


def meeting(setting: Setting, a: Orbit, b: Orbit, phases: tuple[int, int]) -> Array:
    """Return the ticks until the robots are first in range, for every pair of starting phases.

    Distances are sampled once per tick, as by the robots. Ticks in which the robots cannot have closed the
    gap are skipped. Fails if a pair of phases never leads to a meeting.
    """
    distance, reach, period, _, _ = setting
    alpha, beta = pairs(phases)
    most = 2.0 * rendezvous(mission_of(setting), distance, "paper").bound / period
    ticks, left = np.zeros_like(alpha), np.arange(alpha.size)
    while left.size:
        time = ticks[left] * period
        gap = apart(distance, a, alpha[left] + a.omega * time, b, beta[left] + b.omega * time) - reach
        left, gap = left[gap > 0.0], gap[gap > 0.0]
        ticks[left] += np.maximum(1.0, np.floor(gap / ((a.v + b.v) * period)))
        assert np.all(ticks[left] <= most)
    return ticks


# --- time to meet -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "setting", series(SETTINGS[::3] + SETTINGS[1::3] + SETTINGS[2::3], len(SETTINGS[::9]))
)
@pytest.mark.long
def test_they_meet_within_the_bound_from_all_phases_and_no_sooner_from_some(setting: Setting) -> None:
    distance, _, period, _, _ = setting
    plan = rendezvous(mission_of(setting), distance, "assured")
    longest = np.max(meeting(setting, plan.a, plan.b, FINE)) * period
    assert longest <= plan.bound + ROUNDING
    assert longest >= plan.bound - period - ROUNDING


@given(drawn(0.1, 1.5))
@pytest.mark.long
def test_the_bound_holds_in_every_setting(setting: Setting) -> None:
    plan = rendezvous(mission_of(setting), setting[0], "assured")
    assume(plan.bound > 0.0)
    assert np.max(meeting(setting, plan.a, plan.b, (240, 24))) * setting[2] <= plan.bound + ROUNDING


def paper_orbits(setting: Setting) -> tuple[Orbit, Orbit]:
    """Return the orbits of eq. (6), smaller than (D + R) / 2 by the margin that sampled orbits need."""
    distance, reach, period, speed, turn_rate = setting
    share = math.acos(distance / (distance + reach)) / math.pi
    radius = 0.5 * (distance + reach) - (speed * period * (1.0 - share)) ** 2 / (16.0 * reach)
    omega = min(turn_rate, speed / radius)
    return Orbit(radius, radius * omega, omega), Orbit(radius, radius * share * omega, -share * omega)


def compared(setting: Setting) -> tuple[float, float]:
    """Return the ratio of the time to meet to that on the paper's orbits: mean and maximum."""
    plan = rendezvous(mission_of(setting), setting[0], "assured")
    ours = meeting(setting, plan.a, plan.b, COARSE)
    theirs = meeting(setting, *paper_orbits(setting), COARSE)
    return float(np.mean(ours) / np.mean(theirs)), float(np.max(ours) / np.max(theirs))


def test_at_section_ivs_parameters_they_meet_in_well_under_the_time_that_the_papers_orbits_take() -> None:
    mean, worst = compared(SECTION_IV)
    assert mean <= 0.6
    assert worst <= 0.6


@pytest.mark.parametrize("setting", SETTINGS)
def test_they_meet_sooner_than_on_the_papers_orbits(setting: Setting) -> None:
    mean, _ = compared(setting)
    assert mean <= 0.75


# --- orbits always in range ---------------------------------------------------------------------------


@given(drawn(1.1, 1.5))
@example(ALWAYS_IN_RANGE[0])
@example(ALWAYS_IN_RANGE[1])
@example(ALWAYS_IN_RANGE[2])
@example(ALWAYS_IN_RANGE[3])
def test_where_they_are_in_range_wherever_they_wait_both_wait(setting: Setting) -> None:
    distance, reach, *_ = setting
    assume(distance + WAITING_PLACE * reach < reach - 2.0 * RANGE_MARGIN)
    plan = rendezvous(mission_of(setting), distance, "assured")
    assert plan.bound == plan.a.v == plan.a.omega == plan.b.v == plan.b.omega == 0.0
    assert plan.a.radius > 0.0
    assert np.max(apart(distance, plan.a, pairs(COARSE)[0], plan.b, pairs(COARSE)[1])) <= reach


# --- limits of orbits ---------------------------------------------------------------------------------


@given(drawn(0.1, 1.5))
def test_b_waits_near_its_anchor_and_a_orbits_within_what_it_can_drive(setting: Setting) -> None:
    distance, reach, _, speed, turn_rate = setting
    plan = rendezvous(mission_of(setting), distance, "assured")
    assert plan.b == Orbit(reach / 8.0, 0.0, 0.0)
    assert 0.0 <= plan.a.v <= speed * (1.0 + 1e-12)
    assert 0.0 <= plan.a.omega <= turn_rate
    assert plan.a.v == pytest.approx(plan.a.omega * plan.a.radius)


lengths = st.floats(0.1, 40.0)


@given(lengths, lengths, lengths)
def test_half_a_passage_ends_where_the_range_does(distance: float, radius: float, reach: float) -> None:
    half = half_passage(distance, radius, reach)
    if reach <= abs(distance - radius):
        assert half == pytest.approx(0.0, abs=1e-6)
    elif reach >= distance + radius:
        assert half == pytest.approx(math.pi, abs=1e-6)
    else:
        end = math.hypot(distance - radius * math.cos(half), radius * math.sin(half))
        assert end == pytest.approx(reach, abs=ROUNDING)


@given(lengths, st.floats(0.01, 0.99), lengths, lengths)
def test_a_passage_is_shortest_where_b_waits_nearest_to_as_anchor_or_farthest(
    distance: float, share: float, radius: float, reach: float
) -> None:
    waiting = share * distance
    places = np.linspace(distance - waiting, distance + waiting, 101)
    halves = [half_passage(float(place), radius, reach) for place in places]
    assert min(halves) >= min(halves[0], halves[-1]) - ROUNDING
