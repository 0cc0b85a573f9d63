"""Facts merge like sets: neither their order nor echoes change an estimate, and contradictions are found."""

from __future__ import annotations

import random
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.estimation.facts import (
    ContradictoryFacts,
    Fact,
    Facts,
    Manoeuvre,
    anchor,
    anchor_range,
    manoeuvre,
    mutual_range,
)
from agent.estimation.fit import Fit, Start, fits
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.measured_rows import joint_measurements
from agent.estimation.gaussian.search import search
from tests.moving_groups import NOISE, PERIOD_S, MovingGroup, moving_group

REACH = 20.0

NAMES = st.sampled_from("abc")
LENGTHS = st.floats(0.0, 10.0)
FACT = st.one_of(
    st.builds(anchor, st.sampled_from(("M", "N")), st.just(1.0), st.just(2.0)),
    st.builds(lambda name, tick: anchor_range(name, "M", tick, 1.5, 0.1), NAMES, st.integers(0, 9)),
    st.builds(lambda name, tick: manoeuvre(name, tick, Manoeuvre(0.5, 0.1)), NAMES, st.integers(0, 9)),
    st.builds(lambda tick: mutual_range("a", "b", tick, 3.0, 0.1), st.integers(0, 9)),
)
SETS = st.builds(lambda some: Facts(frozenset(some)), st.lists(FACT, max_size=12))


def bits(measured: JointMeasurements) -> tuple[object, ...]:
    ranges, paths = measured.ranges, [path.content for path in measured.paths]
    parts = (ranges.rho, ranges.tick, ranges.sigma, ranges.first, ranges.second, ranges.place, ranges.radio)
    return *[part.tobytes() for part in parts], paths, measured.robots, measured.radios, measured.origin


def bits_of_fit(fit: Fit) -> tuple[bytes, bytes, float]:
    return fit.poses.tobytes(), fit.covariance.tobytes(), fit.weight


def fitted(facts: Facts, group: MovingGroup) -> Fit:
    """Return the fit to `facts` that begins at the truth."""
    measured = joint_measurements(facts, group.noise, PERIOD_S, REACH)
    starts = group.starts.copy()
    starts[:, :2] -= measured.origin
    (fit,) = fits(measured, [Start(starts)])
    return fit


@given(SETS, SETS, SETS)
def test_a_merge_is_idempotent_commutative_and_associative(one: Facts, other: Facts, third: Facts) -> None:
    assert one | one == one
    assert (one | other) == (other | one)
    assert (one | other).ordered == (other | one).ordered
    assert (one | other) | third == one | (other | third)
    assert one | Facts() == one


@given(NAMES, st.integers(0, 9), LENGTHS, LENGTHS)
def test_facts_with_the_same_key_and_other_values_contradict_each_other(
    robot: str, tick: int, rho: float, other: float
) -> None:
    one = Facts(frozenset([anchor_range(robot, "M", tick, rho, 0.1)]))
    another = Facts(frozenset([anchor_range(robot, "M", tick, other, 0.1)]))
    if rho == other:
        assert one | another == one
        return
    with pytest.raises(ContradictoryFacts, match=rf"the range of {robot} to anchor M at tick {tick} has the"):
        _ = one | another


def test_a_contradiction_names_its_first_key_in_every_order() -> None:
    facts = [anchor("M", 0.0, 0.0), anchor("M", 1.0, 0.0), manoeuvre("b", 3, Manoeuvre(1.0, 0.0))]
    again = manoeuvre("b", 3, Manoeuvre(2.0, 0.0))
    expected = re.escape("the position of anchor M has the values (x = 0.0, y = 0.0) and (x = 1.0, y = 0.0)")
    for some in ([*facts, again], [again, *reversed(facts)]):
        with pytest.raises(ContradictoryFacts, match=expected):
            Facts(frozenset(some))


def test_a_range_between_two_robots_has_one_key_whoever_reports_it() -> None:
    one, other = mutual_range("a", "b", 4, 2.0, 0.1), mutual_range("b", "a", 4, 2.0, 0.1)
    assert len(Facts(frozenset([one])) | Facts(frozenset([other]))) == 1


def test_minus_zero_is_zero_and_no_fact_has_a_number_that_is_not_finite() -> None:
    _, value = manoeuvre("a", 0, Manoeuvre(-0.0, -0.0))
    assert np.array(value).tobytes() == bytes(40)
    with pytest.raises(ValueError, match=r"the range between a and b at tick 1: .* is not finite"):
        mutual_range("a", "b", 1, float("nan"), 0.1)
    with pytest.raises(ValueError, match="no robot ranges itself"):
        mutual_range("a", "a", 1, 1.0, 0.1)


def test_facts_echoed_round_a_ring_of_four_leave_the_covariance_unchanged_to_the_bit() -> None:
    group = moving_group(4, 1, ticks=16)
    names = group.facts.robots
    once = fitted(group.facts, group)
    own = [
        Facts(frozenset([one for one in group.facts.known if name in (one.key.robot, one.key.other)]))
        for name in names
    ]
    anchors = Facts(frozenset(group.facts.of_kind("anchor")))
    known = [one | anchors for one in own]
    for turn in range(4000):
        sender, receiver = turn % 4, (turn + 1) % 4
        known[receiver] |= known[sender]
    for each in known:
        assert len(each) == len(group.facts)
        assert bits_of_fit(fitted(each, group)) == bits_of_fit(once)


def test_a_hundred_orders_and_partitions_of_the_same_facts_give_the_same_bits() -> None:
    group = moving_group(3, 2, ticks=20, unanchored=[2])
    expected = bits(joint_measurements(group.facts, group.noise, PERIOD_S, REACH))
    fit = bits_of_fit(search(joint_measurements(group.facts, group.noise, PERIOD_S, REACH)).hypotheses[0].fit)
    everything = group.facts.ordered
    for seed in range(100):
        draw = random.Random(seed)
        facts: list[Fact] = draw.sample(everything, len(everything))
        parts = [Facts(frozenset(facts[i::7])) for i in range(7)]
        merged = Facts()
        for part in draw.sample(parts, 7) + draw.sample(parts, 3):
            merged = part | merged if draw.random() < 0.5 else merged | part
        measured = joint_measurements(merged, group.noise, PERIOD_S, REACH)
        assert bits(measured) == expected
        if seed % 10 == 0:
            assert bits_of_fit(search(measured).hypotheses[0].fit) == fit


def test_a_path_ends_at_its_first_unknown_manoeuvre_and_so_do_its_ranges() -> None:
    known = [manoeuvre("a", tick, Manoeuvre(1.0, 0.0)) for tick in (0, 1, 3, 4)]
    known += [anchor("M", 0.0, 0.0), *[anchor_range("a", "M", tick, 1.0 + tick, 0.1) for tick in range(5)]]
    known.append(anchor_range("a", "unknown", 1, 2.0, 0.1))
    measured = joint_measurements(Facts(frozenset(known)), NOISE, PERIOD_S, REACH)
    assert len(measured.paths[0].v) == 2
    assert measured.ranges.tick.tolist() == [0, 1, 2]
    assert measured.anchors == ("M",)
