"""The plan of meetings of a group: valid, bounded, optimal when small, near the optimum when large."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator
from functools import partial
from statistics import mean

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compose.scenario.group_plan import GroupPlan, PlannedVisit, group_plan, least_makespan, planned_meetings
from compose.scenario.wake_up_search import short_forest
from compose.scenario.wake_up_sectors import MOST_TRAVEL, sector_forest
from compose.scenario.wake_up_tree import MeetingTimes, WakeUpForest, optimal_forest
from protocol.mission import Mission
from protocol.noise import Noise
from protocol.orbits import meeting_ticks, pair_ticks, searching
from tests import plans

MEETING_S = 10.0
Anchors = list[tuple[float, float]]
SeedTime = Callable[[int, int], float]


def orbit_time(anchors: Anchors) -> SeedTime:
    """Return the seed time of the measured series: an orbit at 1 m/s and 20 s."""
    return lambda a, b: 2 * math.pi * math.dist(anchors[a], anchors[b]) + 20.0


def plan_of(anchors: Anchors) -> GroupPlan:
    return group_plan(anchors, orbit_time(anchors), speed=1.0, meeting=MEETING_S)


def drawn_anchors(robots: int, seed: int) -> Anchors:
    """Return anchors drawn in a square of side 10 sqrt(n), R being 1."""
    draw = random.Random(1000 * seed + robots)
    side = 10 * math.sqrt(robots)
    return [(draw.uniform(0, side), draw.uniform(0, side)) for _ in range(robots)]


def meeting_times(anchors: Anchors, meeting: float = MEETING_S) -> MeetingTimes:
    seed_time = orbit_time(anchors)
    numbers = range(len(anchors))
    return MeetingTimes(
        seed=tuple(tuple(seed_time(a, b) for b in numbers) for a in numbers),
        hop=tuple(tuple(math.dist(p, q) + meeting for q in anchors) for p in anchors),
    )


def ratio_of_search(anchors: Anchors) -> float:
    """Return how many times longer than the optimum the forest of the search is."""
    times = meeting_times(anchors)
    return short_forest(times).last_end(times) / optimal_forest(times).last_end(times)


def simulated_ends(
    meetings: tuple[PlannedVisit, ...], anchors: Anchors, seed_time: SeedTime, speed: float, meeting: float
) -> list[float]:
    """Drive the robots through `meetings` and return the end of each, after checks that each is possible."""
    free: dict[int, tuple[int, float]] = {}
    """The anchor at which each localised robot is, and the time from which it can leave."""
    ends = []
    for each in meetings:
        assert each.visited not in free
        assert each.first == (each.visitor not in free)
        if each.first:
            end = seed_time(each.visitor, each.visited)
        else:
            place, time = free[each.visitor]
            end = time + math.dist(anchors[place], anchors[each.visited]) / speed + meeting
        free[each.visitor] = free[each.visited] = (each.visited, end)
        ends.append(end)
    assert sorted(free) == list(range(len(anchors)))
    return ends


def least_bound(anchors: Anchors, seed_time: SeedTime, meeting: float) -> float:
    """Return the least bound of all plans at 1 m/s, each of which is tried."""

    def bounds(free: dict[int, tuple[int, float]], latest: float) -> Iterator[float]:
        waiting = [robot for robot in range(len(anchors)) if robot not in free]
        if not waiting:
            yield latest
        for visited in waiting:
            for visitor, (place, time) in free.items():
                end = time + math.dist(anchors[place], anchors[visited]) + meeting
                here = (visited, end)
                yield from bounds({**free, visitor: here, visited: here}, max(latest, end))

    def with_seeds(free: dict[int, tuple[int, float]], latest: float, least: int) -> Iterator[float]:
        if free:
            yield from bounds(free, latest)
        waiting = [robot for robot in range(len(anchors)) if robot not in free]
        for a in waiting:
            for b in waiting:
                if a != b and min(a, b) > least:
                    end = seed_time(a, b)
                    yield from with_seeds({**free, a: (b, end), b: (b, end)}, max(latest, end), min(a, b))

    return min(with_seeds({}, 0.0, -1))


def groups(least: int, most: int) -> st.SearchStrategy[Anchors]:
    """Anchors at different places whose coordinates, differences and shifts are exact."""
    coordinate = st.integers(-400, 400).map(lambda number: number / 8)
    return st.lists(st.tuples(coordinate, coordinate), min_size=least, max_size=most, unique=True)


@given(groups(2, 14), st.floats(0.1, 3.0), st.floats(0.0, 60.0))
@settings(max_examples=15, deadline=None)
def test_a_plan_is_possible_and_ends_at_its_bound(anchors: Anchors, speed: float, meeting: float) -> None:
    seed_time = orbit_time(anchors)
    plan = group_plan(anchors, seed_time, speed, meeting)
    ends = simulated_ends(plan.meetings, anchors, seed_time, speed, meeting)
    assert [each.ends for each in plan.meetings] == pytest.approx(ends)
    assert plan.bound == pytest.approx(max(ends))
    assert ends == pytest.approx(sorted(ends))
    assert plan.bound >= least_makespan(plan.travel) * (1 - 1e-12)
    assert plan.bound >= plan.least_bound * (1 - 1e-12)


@given(groups(2, 5), st.lists(st.floats(1.0, 400.0), min_size=25, max_size=25), st.floats(0.0, 60.0))
@settings(max_examples=20, deadline=None)
def test_a_small_plan_is_the_best_of_all_plans(anchors: Anchors, drawn: list[float], meeting: float) -> None:
    def seed_time(a: int, b: int) -> float:
        return drawn[5 * a + b]

    plan = group_plan(anchors, seed_time, 1.0, meeting)
    assert plan.bound == pytest.approx(least_bound(anchors, seed_time, meeting))
    assert least_makespan(plan.travel) == pytest.approx(least_bound(anchors, seed_time, 0.0))


@given(groups(3, 7), st.randoms(use_true_random=False))
@settings(max_examples=20, deadline=None)
def test_the_optimum_is_between_the_lower_bound_and_any_search(anchors: Anchors, draw: random.Random) -> None:
    seed = tuple(tuple(draw.uniform(1.0, 400.0) for _ in anchors) for _ in anchors)
    times = MeetingTimes(seed, meeting_times(anchors).hop)
    optimum = optimal_forest(times).last_end(times)
    assert times.earliest_end() <= optimum * (1 + 1e-12)
    for steps in (0, 20):
        assert optimum <= short_forest(times, steps).last_end(times) * (1 + 1e-12)


@given(groups(3, 12), st.integers(-1000, 1000), st.integers(-1000, 1000), st.randoms(use_true_random=False))
@settings(max_examples=20, deadline=None)
def test_numbers_and_the_origin_do_not_change_the_bound(
    anchors: Anchors, east: int, north: int, draw: random.Random
) -> None:
    moved = [(x + east, y + north) for x, y in anchors]
    draw.shuffle(moved)
    here, there = plan_of(anchors), plan_of(moved)
    assert there.bound == pytest.approx(here.bound)
    assert least_makespan(there.travel) == pytest.approx(least_makespan(here.travel))


@pytest.mark.parametrize("robots", [5, 6, 7])
def test_the_search_is_near_the_optimum(robots: int) -> None:
    """Not more than 1.001 times on average: 1.2 is promised."""
    assert mean(ratio_of_search(drawn_anchors(robots, seed)) for seed in range(3)) < 1.001


@pytest.mark.long
@pytest.mark.parametrize(("robots", "groups"), [(5, 50), (8, 100)])
def test_the_search_is_near_the_optimum_in_many_groups(robots: int, groups: int) -> None:
    ratios = [ratio_of_search(drawn_anchors(robots, seed)) for seed in range(groups)]
    assert mean(ratios) < 1.001
    assert max(ratios) < 1.01


@pytest.mark.parametrize("robots", [16, pytest.param(50, marks=pytest.mark.long)])
def test_a_large_plan_is_possible_and_near_its_lower_bound(robots: int) -> None:
    anchors = drawn_anchors(robots, 0)
    plan = plan_of(anchors)
    ends = simulated_ends(plan.meetings, anchors, orbit_time(anchors), 1.0, MEETING_S)
    assert plan.bound == pytest.approx(max(ends))
    assert least_makespan(plan.travel) <= plan.bound <= 1.4 * least_makespan(plan.travel)


FACTOR = 1.0 + MOST_TRAVEL
"""The proved factor for at most 490 robots.

Here, m is the time of a meeting, v = v_max, d(a, b) the distance of two anchors, s(a, b) the bound of a first
meeting, and chord(x) = 2 sin(x / 2), and 2 from x = pi on.

Lower bound. No plan localises a robot sooner than its quickest first meeting, or than one visit from the
place of the quickest first meeting of another robot: several visits take no less time. L is the latest of
these times of all robots. Up to 8 robots, the plan is optimal, and its bound is the lower bound.

Assumption. Each first meeting takes at least one and a half meetings and twice the way: s(a, b) >= 1.5 m + 2
d(a, b) / v. The orbits of `assured` satisfy it if a robot moves at least R / 25 in a tick.

Construction (`sector_forest`). First meetings that end by L are chosen, the quickest first, each robot at
most once. Each other robot w joins the cell of the chosen one with the smallest s(a, b) + C d(b, w) / v,
where C = 5.97. Two localised robots at one place share the robots that are left there: sorted by their angle
about b, these are cut into two parts. Each of the two visits the nearest to b of its part, and then both
share the others of this part. The cut is the one for which the larger A(angle) r / v + m log2(number) of both
parts is smallest, with r the largest distance from b in the cell and A(x) = chord(x) + chord(x / 2) + chord(x
/ 4) + x / 4. The halved sectors are those of Bonichon et al., *Freeze-tag in L1 has wake-up time five with
linear complexity* (DISC 2024); the cut differs, because meetings take time.

A cell of k robots takes at most C r / v + m log2(k + 1) after its first meeting, with C = 1 + A(pi). A way
from distance p to q >= p by an angle x is at most q - p + r chord(x) long, and the differences add up to at
most r. The rest is at most A(x) r / v + m log2(k + 1) for two robots that share k of a sector of x, by
induction on k: of the first cut whose first part has the larger value and the one before, the larger values
are those of parts with one robot in common, so that their angles add up to at most x and their numbers to k +
1. A and log2 are concave, so the smaller value is at most A(x / 2) r / v + m log2((k + 1) / 2); the visit
before takes at most chord(x) r / v + m, and A(x) >= chord(x) + A(x / 2). At b itself, the first ways have no
angle.

The bound is at most (1 + C) L up to 490 robots. Let P = (a, b) be the first meeting by which L counts w. If
it was chosen, d(b, w) / v <= L - m - s(P). Otherwise a robot of P is in a chosen Q with s(Q) <= s(P), and by
the assumption the ways of both take at most s(P) - 1.5 m. So w is at most v (L - 1.5 m) from where Q ends,
its cell ends by (1 + C) L - m (1.5 C - log2(k + 1)), and 2^(1.5 C) = 494. With more robots, m (log2(k + 1) -
8.9) comes on top.
"""
SHAPES = (
    *(plans.square, plans.clusters, plans.line),
    *(plans.circle, plans.disc, plans.far_cluster, plans.fan, plans.spiral),
)


class Group:
    """A group whose first meetings take as little time as the proof of FACTOR assumes, some at one place."""

    def __init__(self, robots: int, meeting: float, seed: int, shape: plans.Shape | None = None) -> None:
        draw = random.Random(seed)
        anchors = (shape or draw.choice(SHAPES))(robots, draw)
        if draw.random() < 0.2:
            anchors[2:] = draw.choices(anchors[: 2 + robots // 3], k=robots - 2)
        self.anchors, self.meeting, self.pair = sorted(anchors), meeting, anchors[:2]
        self.possible = "one pair" if shape else draw.choice(["any two", "three nearest", "one pair"])
        near = [sorted(self.anchors, key=partial(math.dist, one))[:4] for one in self.anchors]
        self.near = near if self.possible == "three nearest" else []
        numbers = range(robots)
        rows = tuple(tuple(self.seed_time(a, b) for b in numbers) for a in numbers)
        ways = tuple(tuple(math.dist(p, q) + meeting for q in self.anchors) for p in self.anchors)
        self.times = MeetingTimes(rows, ways)

    def seed_time(self, a: int, b: int) -> float:
        one, other = self.anchors[a], self.anchors[b]
        far = self.near and other not in self.near[a]
        if a == b or far or (self.possible == "one pair" and not {one, other} <= {*self.pair}):
            return math.inf
        return 1.5 * self.meeting + 2.0 * math.dist(one, other) + 0.01


drawn_groups = st.builds(
    Group, st.integers(2, 200), st.sampled_from([0.0, 1.0, 38.0, 1000.0]), st.integers(0, 1 << 32)
)


@given(drawn_groups)
@settings(max_examples=30, deadline=None)
def test_a_forest_of_sectors_ends_within_the_proved_factor_of_the_lower_bound(group: Group) -> None:
    forest = sector_forest(group.times, group.anchors, group.meeting)
    meetings = tuple(planned_meetings(forest, group.times))
    simulated_ends(meetings, group.anchors, group.seed_time, 1.0, group.meeting)
    assert forest.last_end(group.times) <= FACTOR * group.times.earliest_end() * (1 + 1e-12)


@given(
    st.floats(1 / 25, 2.0), st.floats(-3.0, 2.5), st.floats(0.3, 3.0), st.sampled_from([0.0, 0.02, 0.05, 0.2])
)
def test_first_meetings_take_the_time_that_the_proof_assumes(
    step: float, scale: float, turn: float, sigma: float
) -> None:
    noise = Noise(anchor_sigma=sigma, mutual_sigma=sigma)
    mission = Mission(sensing_range=3.0, period=1.0, max_speed=3.0 * step, max_turn_rate=turn, noise=noise)
    distance = 3.0 * 10.0**scale
    ticks = pair_ticks(mission, searching(mission, distance))
    assert ticks >= 1.5 * meeting_ticks(mission) + 2.0 * distance / mission.max_speed


@given(st.builds(Group, st.integers(9, 24), st.sampled_from([0.0, 38.0]), st.integers(0, 1 << 32)))
@settings(max_examples=10, deadline=None)
def test_a_plan_is_no_worse_than_the_search_nor_than_the_factor(group: Group) -> None:
    plan = group_plan(group.anchors, group.seed_time, 1.0, group.meeting)
    simulated_ends(plan.meetings, group.anchors, group.seed_time, 1.0, group.meeting)
    assert plan.bound <= short_forest(group.times).last_end(group.times)
    assert plan.least_bound == group.times.earliest_end()
    assert plan.least_bound * (1 - 1e-12) <= plan.bound <= FACTOR * plan.least_bound


def test_sectors_are_the_plan_where_the_search_finds_a_longer_one() -> None:
    anchors = sorted(plans.disc(90, random.Random(1)))
    pair = [i for i, anchor in enumerate(anchors) if anchor == (0.0, 0.0)]

    def seed_time(a: int, b: int) -> float:
        return 151.0 if [a, b] == pair else math.inf

    plan = group_plan(anchors, seed_time, speed=1.0, meeting=100.0)
    numbers = range(len(anchors))
    seed = tuple(tuple(seed_time(a, b) for b in numbers) for a in numbers)
    times = MeetingTimes(seed, meeting_times(anchors, 100.0).hop)
    assert plan.bound == pytest.approx(sector_forest(times, anchors, 100.0).last_end(times))
    assert plan.bound < 0.95 * short_forest(times).last_end(times)


def test_pairs_that_are_far_apart_meet_at_the_same_time() -> None:
    plan = plan_of([(0.0, 0.0), (5.0, 0.0), (35.0, 0.0), (40.0, 0.0), (70.0, 0.0), (75.0, 0.0)])
    assert [each.first for each in plan.meetings] == [True, True, True]
    assert plan.bound == pytest.approx(10 * math.pi + 20)


def test_one_seed_pair_fetches_all_others_if_the_next_takes_too_long() -> None:
    anchors = [(0.0, 0.0), (1.0, 0.0), (30.0, 0.0), (60.0, 0.0)]
    plan = group_plan(anchors, lambda a, b: 20.0 if a + b == 1 else 1000.0, speed=1.0, meeting=5.0)
    assert [(each.visitor, each.visited) for each in plan.meetings] == [(0, 1), (0, 2), (1, 3)]
    assert [each.ends for each in plan.meetings] == [20.0, 54.0, 84.0]


@pytest.mark.parametrize("robots", [4, 12])
def test_robots_that_cannot_meet_first_are_fetched(robots: int) -> None:
    anchors = drawn_anchors(robots, 1)
    plan = group_plan(anchors, lambda a, b: 30.0 if (a, b) == (3, 2) else math.inf, 1.0, MEETING_S)
    assert [(each.visitor, each.visited) for each in plan.meetings if each.first] == [(3, 2)]
    assert plan.bound < math.inf


def test_the_visited_robot_goes_where_the_last_end_is() -> None:
    anchors = [(0.0, 0.0), (0.0, 0.0), (1.0, 0.0), (9.0, 0.0)]
    times = meeting_times(anchors)
    meetings = planned_meetings(WakeUpForest(seeds=((0, 1),), hops=((1, 2), (1, 3))), times)
    assert [(each.visitor, each.visited) for each in meetings] == [(0, 1), (0, 2), (1, 3)]


def test_a_group_in_which_no_two_can_meet_first_has_no_plan() -> None:
    with pytest.raises(ValueError, match="no two robots of the group can meet first"):
        group_plan([(0.0, 0.0), (1.0, 0.0)], lambda _a, _b: math.inf, speed=1.0, meeting=MEETING_S)


def test_one_robot_is_no_group() -> None:
    with pytest.raises(ValueError, match="at least two robots, not 1"):
        plan_of([(0.0, 0.0)])
