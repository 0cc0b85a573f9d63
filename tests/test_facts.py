"""Facts have no order: the one in which they arrive changes no bit of an estimate."""

from __future__ import annotations

import random

from agent.estimation.facts import Manoeuvre
from agent.estimation.fit import Fit
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.search import search
from tests.moving_groups import (
    NOISE,
    PERIOD_S,
    anchor,
    anchor_range,
    joint_measurements,
    manoeuvre,
    moving_group,
)

REACH = 20.0


def bits(measured: JointMeasurements) -> tuple[object, ...]:
    ranges, paths = measured.ranges, [path.content for path in measured.paths]
    parts = (ranges.rho, ranges.tick, ranges.sigma, ranges.first, ranges.second, ranges.place, ranges.radio)
    return *[part.tobytes() for part in parts], paths, measured.robots, measured.radios, measured.origin


def bits_of_fit(fit: Fit) -> tuple[bytes, bytes, float]:
    return fit.poses.tobytes(), fit.covariance.tobytes(), fit.weight


def test_a_hundred_orders_of_the_same_facts_give_the_same_bits() -> None:
    group = moving_group(3, 2, ticks=20, unanchored=[2])
    measured = joint_measurements(group.facts, group.noise, PERIOD_S, REACH)
    expected, fit = bits(measured), bits_of_fit(search(measured).hypotheses[0].fit)
    for seed in range(100):
        facts = random.Random(seed).sample(group.facts, len(group.facts))
        measured = joint_measurements(facts, group.noise, PERIOD_S, REACH)
        assert bits(measured) == expected
        if seed % 10 == 0:
            assert bits_of_fit(search(measured).hypotheses[0].fit) == fit


def test_ranges_after_the_path_of_a_robot_or_to_an_anchor_without_a_place_are_not_used() -> None:
    known = [manoeuvre("a", tick, Manoeuvre(1.0, 0.0)) for tick in (0, 1, 3, 4)]
    known += [anchor("M", 0.0, 0.0), *[anchor_range("a", "M", tick, 1.0 + tick, 0.1) for tick in range(5)]]
    known.append(anchor_range("a", "unknown", 1, 2.0, 0.1))
    measured = joint_measurements(known, NOISE, PERIOD_S, REACH)
    assert len(measured.paths[0].v) == 2
    assert measured.ranges.tick.tolist() == [0, 1, 2]
    assert measured.anchors == ("M",)
