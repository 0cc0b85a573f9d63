"""A group of robots: what the simulator measures, and what records, checks and repeats its runs."""

from __future__ import annotations

import math
import random
from itertools import combinations

from hypothesis import given
from hypothesis import strategies as st

from world.near_pairs import near_pairs

places = st.lists(st.tuples(*[st.floats(-50.0, 50.0) | st.integers(-9, 9).map(float)] * 2), max_size=30)


# --- the world ----------------------------------------------------------------------------------------


@given(places, st.floats(0.1, 20.0) | st.sampled_from([1.0, 3.0]))
def test_no_pair_within_reach_is_missed_and_the_order_is_that_of_all_pairs(
    places: list[tuple[float, float]], reach: float
) -> None:
    found = near_pairs(places, reach)
    everything = list(combinations(range(len(places)), 2))
    within = [(i, j) for i, j in everything if math.dist(places[i], places[j]) <= reach]
    assert [pair for pair in everything if pair in set(found)] == found
    assert set(within) <= set(found)


def test_few_pairs_are_near_where_robots_are_spread() -> None:
    draw = random.Random(1)
    side = 30.0 * math.sqrt(100)
    places = [(side * draw.random(), side * draw.random()) for _ in range(100)]
    assert len(near_pairs(places, 3.0)) < 100
