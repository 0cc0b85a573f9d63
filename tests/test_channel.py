"""The radio channel between two robots: each report meets the faults of the fault plan, and no others."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from itertools import groupby, pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from tests.test_noise import Z, has_share
from world.channel import LinkState, idle_link_state, link_faults, next_link_state
from world.faults import (
    LATEST,
    MAX_DELAY,
    MAX_FAULTS,
    UNLUCKY,
    Fault,
    LinkSelector,
    Window,
    delivery_time_bound,
)

N = 10_000
"""The number of ticks of a statistical test."""
A_TO_B, BOTH_WAYS = LinkSelector("a", "b", both=False), LinkSelector("a", "b", both=True)

chances = st.sampled_from([0.0, 0.1, 0.5, 1.0])
delays = st.tuples(st.integers(0, 6), st.integers(0, 6)).map(lambda two: (min(two), max(two)))
windows = st.none() | st.tuples(st.integers(0, 40), st.integers(0, 40)).map(lambda two: (min(two), max(two)))
faults = st.builds(
    Fault,
    loss=chances,
    burst_start=chances,
    burst_end=st.sampled_from([0.1, 0.5, 1.0]),
    burst_loss=chances,
    partition=st.sampled_from([False, False, False, True]),
    delay=delays,
    duplicate=chances,
    reorder=chances,
    corrupt=chances,
    reports_per_tick=st.none() | st.sampled_from([0.2, 1.0, 1.5]),
    ticks=windows,
    contact_ticks=windows,
)
plans = st.lists(faults, max_size=4)
meetings = st.lists(st.tuples(st.booleans(), st.integers(1, 15)), min_size=1, max_size=8).map(
    lambda spells: [together for together, ticks in spells for _ in range(ticks)]
)
"""The contact of the two robots, tick by tick."""
seeds = st.integers(0, 2**63 - 1)


def flown(
    plan: Sequence[Fault], contact: Sequence[bool], seed: int = 1, way: tuple[str, str] = ("a", "b")
) -> list[LinkState]:
    """Return the state of a link, tick by tick."""
    links, air, found = link_faults(plan, *way), LinkState(), []
    for tick, together in enumerate(contact):
        air = next_link_state(air, links, seed, tick, in_contact=together)
        found.append(air)
    return found


@given(plans, seeds, st.integers(0, 40), st.integers(1, 20))
def test_a_link_before_its_first_contact_needs_no_state(
    plan: list[Fault], seed: int, first: int, ticks: int
) -> None:
    """From its first contact on, it has the states of a link that was followed from tick 0."""
    links = link_faults(plan, "a", "b")
    followed = flown(plan, [False] * first + [True] * ticks, seed)[first:]
    air, found = idle_link_state(links, first), []
    for tick in range(first, first + ticks):
        air = next_link_state(air, links, seed, tick, in_contact=True)
        found.append(air)
    assert found == followed


def came(airs: Sequence[LinkState]) -> list[tuple[int, int, bool]]:
    """Return each arrived copy: the tick of arrival, the tick of its report, and whether it was damaged."""
    return [
        (now, tick, damaged)
        for now, air in enumerate(airs)
        for damaged, ticks in ((False, air.heard), (True, air.damaged))
        for tick in ticks
    ]


def heard_at_once(plan: Sequence[Fault], ticks: int = N, seed: int = 1) -> list[bool]:
    """Return, for each tick of permanent contact, whether its report is received in the same tick."""
    return [tick in air.heard for tick, air in enumerate(flown(plan, [True] * ticks, seed))]


# --- any plan -----------------------------------------------------------------------------------------


@given(meetings, seeds)
def test_without_a_fault_every_report_is_received_in_its_tick(contact: list[bool], seed: int) -> None:
    for plan in ([], [Fault()], [Fault(), Fault(link=A_TO_B, ticks=(0, 9))]):
        airs = flown(plan, contact, seed)
        assert [air.heard for air in airs] == [
            (tick,) if together else () for tick, together in enumerate(contact)
        ]
        assert not any(air.damaged or air.flying for air in airs)


@settings(max_examples=60)
@given(plans, meetings, seeds)
@pytest.mark.long
def test_no_report_is_sent_or_received_out_of_contact(
    plan: list[Fault], contact: list[bool], seed: int
) -> None:
    for now, tick, _ in came(flown(plan, contact, seed)):
        assert contact[now]
        assert contact[tick]


@settings(max_examples=60)
@given(plans, meetings, seeds)
@pytest.mark.long
def test_a_report_comes_at_most_once_unless_a_fault_doubles_it(
    plan: list[Fault], contact: list[bool], seed: int
) -> None:
    doubling = sum([fault.duplicate > 0.0 for fault in plan])
    copies = Counter(tick for _, tick, _ in came(flown(plan, contact, seed)))
    assert all(count <= 2**doubling for count in copies.values())


@settings(max_examples=60)
@given(plans, meetings, seeds)
@pytest.mark.long
def test_a_report_comes_within_the_delays_of_the_faults_that_were_there_when_it_was_sent(
    plan: list[Fault], contact: list[bool], seed: int
) -> None:
    for now, tick, _ in came(flown(plan, contact, seed)):
        there = [fault for fault in plan if fault.active(tick, sum(contact[:tick]))]
        least = sum([fault.delay[0] for fault in there])
        most = sum([fault.delay[1] + (fault.reorder > 0.0) for fault in there])
        assert least <= now - tick <= most


def test_agents_store_reports_for_the_longest_delay_of_the_fault_plan() -> None:
    most = [Fault(delay=(MAX_DELAY, MAX_DELAY), reorder=1.0), *[Fault(reorder=1.0)] * (MAX_FAULTS - 1)]
    lags = {now - tick for now, tick, _ in came(flown(most, [True] * 200))}
    assert lags == {LATEST}


# --- each kind of fault -------------------------------------------------------------------------------


@pytest.mark.parametrize("loss", [0.05, 0.3, 0.9])
def test_reports_are_lost_independently_with_the_given_probability(loss: float) -> None:
    heard = heard_at_once([Fault(loss=loss)])
    assert has_share(heard.count(False), N, loss)
    both = sum([not one and not other for one, other in pairwise(heard)])
    assert has_share(both, N - 1, loss * loss)


@pytest.mark.parametrize("contact", [[True] * 2 * N, [True, False] * 2 * N], ids=["always", "every other"])
@pytest.mark.long
def test_bursts_have_the_length_and_frequency_of_the_gilbert_elliott_model(contact: list[bool]) -> None:
    start, end = 0.02, 0.1
    airs = flown([Fault(burst_start=start, burst_end=end)], contact)
    lost = [not air.heard for air, together in zip(airs, contact, strict=True) if together]
    bursts = [sum(1 for _ in run) for burst, run in groupby(lost) if burst]
    mean, spread = 1.0 / end, math.sqrt(1.0 - end) / end
    assert abs(sum(bursts) / len(bursts) - mean) <= Z * spread / math.sqrt(len(bursts))
    assert has_share(bursts.count(1), len(bursts), end)
    share, memory = start / (start + end), 1.0 - start - end
    spread = math.sqrt(share * (1.0 - share) * (1.0 + memory) / (1.0 - memory))
    assert abs(sum(lost) / len(lost) - share) <= Z * spread / math.sqrt(len(lost))


def test_the_first_contact_is_in_a_burst_as_often_as_any_other() -> None:
    plan = [Fault(burst_start=0.02, burst_end=0.01)]
    at_first = [not flown(plan, [False] * 5 + [True], seed)[-1].heard for seed in range(2000)]
    assert has_share(sum(at_first), 2000, 2.0 / 3.0)


def test_a_burst_goes_on_while_the_two_are_out_of_contact() -> None:
    plan = [Fault(burst_start=1e-9, burst_end=1e-9)]
    for seed in range(20):
        heard = [bool(air.heard) for air in flown(plan, ([True] * 5 + [False] * 5) * 5, seed)]
        assert heard.count(True) in {0, 25}


def test_reports_in_a_burst_are_lost_with_the_given_probability() -> None:
    always = Fault(burst_start=1.0, burst_end=1e-9, burst_loss=0.4)
    assert has_share(heard_at_once([always]).count(False), N, 0.4)
    both = Fault(loss=0.5, burst_start=1.0, burst_end=1e-9, burst_loss=0.4)
    assert has_share(heard_at_once([both]).count(True), N, 0.5 * 0.6)


def test_a_partition_lets_nothing_through() -> None:
    assert not any(heard_at_once([Fault(partition=True)], ticks=50))


@pytest.mark.long
def test_a_delay_is_uniform_between_its_bounds_both_included() -> None:
    assert {now - tick for now, tick, _ in came(flown([Fault(delay=(3, 3))], [True] * 50))} == {3}
    lags = Counter(now - tick for now, tick, _ in came(flown([Fault(delay=(2, 5))], [True] * N)))
    assert set(lags) == {2, 3, 4, 5}
    assert all(has_share(count, lags.total(), 0.25) for count in lags.values())


@pytest.mark.long
def test_a_doubled_report_comes_twice_each_with_a_delay_of_its_own() -> None:
    copies = Counter(tick for _, tick, _ in came(flown([Fault(duplicate=0.3)], [True] * N)))
    assert set(copies.values()) == {1, 2}
    assert has_share(list(copies.values()).count(2), N, 0.3)
    delayed = came(flown([Fault(duplicate=1.0, delay=(0, 3))], [True] * N))[: -2 * 4 * 2]
    lags: dict[int, list[int]] = {}
    for now, tick, _ in delayed:
        lags.setdefault(tick, []).append(now - tick)
    pairs = [two for two in lags.values() if len(two) == 2]
    assert len(pairs) > N - 20
    assert has_share(sum([one == other for one, other in pairs]), len(pairs), 0.25)


def test_a_reordered_report_comes_a_tick_later_behind_what_is_sent_then() -> None:
    airs = flown([Fault(reorder=0.3)], [True] * N)
    late = {tick for now, tick, _ in came(airs) if now == tick + 1}
    assert has_share(len(late), N, 0.3)
    for tick, air in enumerate(airs[1:], start=1):
        at_once = () if tick in late else (tick,)
        assert air.heard == at_once + ((tick - 1,) if tick - 1 in late else ())
    assert airs[-1].flying or N - 1 not in late


def test_a_damaged_report_arrives_and_is_not_used() -> None:
    airs = flown([Fault(corrupt=0.2)], [True] * N)
    assert has_share(sum([len(air.damaged) for air in airs]), N, 0.2)
    assert all(sorted(air.heard + air.damaged) == [tick] for tick, air in enumerate(airs))


@pytest.mark.parametrize("rate", [0.05, 0.1, 0.3, 0.6, 0.75, 1.0, 2.5])
def test_no_more_come_in_a_tick_than_the_bandwidth_lets_through_in_the_mean(rate: float) -> None:
    four_of_each = [Fault(duplicate=1.0)] * 2
    airs = flown([*four_of_each, Fault(reports_per_tick=rate)], [True] * 1000)
    heard = sum([len(air.heard) for air in airs])
    assert abs(heard - 1000 * rate) <= 2
    assert max(len(air.heard) for air in airs) <= rate + 1
    assert {now - tick for now, tick, _ in came(airs)} == {0}, "what is more is lost, not late"


def test_bandwidth_that_is_enough_loses_nothing() -> None:
    assert all(heard_at_once([Fault(reports_per_tick=1.0)], ticks=500))
    slow = heard_at_once([Fault(reports_per_tick=0.25)], ticks=400)
    assert slow[0]
    assert {later - earlier for earlier, later in pairwise(i for i, one in enumerate(slow) if one)} <= {3, 4}


# --- links and ticks of a fault -----------------------------------------------------------------------


@given(windows, windows, meetings)
@pytest.mark.long
def test_a_fault_is_there_in_its_windows_and_at_no_other_time(
    ticks: Window | None, contact_ticks: Window | None, contact: list[bool]
) -> None:
    airs = flown([Fault(partition=True, ticks=ticks, contact_ticks=contact_ticks)], contact)
    so_far = 0
    for tick, together in enumerate(contact):
        if together:
            cut = ticks is None or ticks[0] <= tick < ticks[1]
            cut = cut and (contact_ticks is None or contact_ticks[0] <= so_far < contact_ticks[1])
            assert airs[tick].heard == (() if cut else (tick,))
        so_far += together


@pytest.mark.parametrize(
    ("link", "cut"),
    [
        (A_TO_B, {("a", "b")}),
        (BOTH_WAYS, {("a", "b"), ("b", "a")}),
        (None, {("a", "b"), ("b", "a"), ("c", "d"), ("d", "c")}),
    ],
    ids=["a->b", "a<->b", "*"],
)
def test_a_fault_is_on_its_link_and_on_no_other(link: LinkSelector | None, cut: set[tuple[str, str]]) -> None:
    plan = [Fault(link=link, partition=True)]
    for way in [("a", "b"), ("b", "a"), ("c", "d"), ("d", "c")]:
        heard = any(air.heard for air in flown(plan, [True] * 20, way=way))
        assert heard != (way in cut), way


def test_every_link_every_fault_and_every_seed_has_draws_of_its_own() -> None:
    half = Fault(loss=0.5)
    arrivals = [
        tuple(bool(air.heard) for air in flown(plan, [True] * 64, seed=seed, way=way))
        for plan in ([half], [Fault(), half])
        for seed in (1, 2)
        for way in (("a", "b"), ("b", "a"), ("a", "c"))
    ]
    assert len(set(arrivals)) == len(arrivals)


# --- independence of random draws ---------------------------------------------------------------------

ROUGH = (
    Fault(duplicate=0.5),
    Fault(loss=0.3, duplicate=0.3),
    Fault(delay=(0, 4), reorder=0.3, corrupt=0.3),
)


def arrivals(airs: Sequence[LinkState]) -> dict[int, Counter[tuple[int, bool]]]:
    """Return, for each report, the ticks of arrival of its copies, and which were damaged."""
    found: dict[int, Counter[tuple[int, bool]]] = {}
    for now, tick, damaged in came(airs):
        found.setdefault(tick, Counter())[now, damaged] += 1
    return found


@pytest.mark.parametrize("loss", [0.0, 0.2, 0.5, 0.9])
@pytest.mark.long
def test_more_or_less_loss_shifts_no_other_draw(loss: float) -> None:
    """A higher loss loses a superset of the reports; the others arrive unchanged."""
    contact = [True] * 2000
    less, more = [
        arrivals(flown([ROUGH[0], replace(ROUGH[1], loss=share), ROUGH[2]], contact))
        for share in sorted((loss, 0.3))
    ]
    assert sum(map(Counter.total, more.values())) < sum(map(Counter.total, less.values())) or loss == 0.3
    for tick, copies in more.items():
        assert copies <= less[tick]


def test_what_is_not_in_contact_shifts_no_draw() -> None:
    always = arrivals(flown(ROUGH, [True] * 2000))
    broken = [tick % 40 < 20 for tick in range(2000)]
    now_and_then = arrivals(flown(ROUGH, broken))
    assert all(copies <= always[tick] for tick, copies in now_and_then.items())
    early = [tick for tick in range(2000) if tick % 40 < 15]
    assert all(now_and_then.get(tick) == always.get(tick) for tick in early)


# --- the bound on a mission's delay -------------------------------------------------------------------


@pytest.mark.parametrize(
    "fault",
    [
        Fault(loss=0.7),
        Fault(burst_start=0.05, burst_end=0.2),
        Fault(burst_start=0.2, burst_end=0.2, burst_loss=0.5, loss=0.2),
        Fault(corrupt=0.6),
        Fault(reports_per_tick=0.3),
        Fault(reports_per_tick=3.0),
    ],
)
@pytest.mark.long
def test_the_delivery_ratio_is_that_of_the_deliveries(fault: Fault) -> None:
    heard = heard_at_once([fault], ticks=2 * N)
    assert abs(sum(heard) / len(heard) - fault.let_through) < 0.03


def test_the_delivery_time_bound_is_that_of_the_slowest_fault() -> None:
    assert delivery_time_bound([Fault()]) == UNLUCKY
    assert delivery_time_bound([Fault(loss=0.9)]) == pytest.approx(10.0 * UNLUCKY, abs=1.0)
    assert delivery_time_bound([Fault(burst_start=0.001, burst_end=0.01)]) == 100.0 * UNLUCKY
    assert delivery_time_bound([Fault(delay=(3, 20), reorder=0.1)]) == 21 + UNLUCKY
    assert delivery_time_bound([Fault(partition=True, contact_ticks=(10, 60))]) == 50 + UNLUCKY
    assert delivery_time_bound([Fault(loss=1.0, ticks=(0, 30))]) == 30 + UNLUCKY
    assert delivery_time_bound([Fault(partition=True)]) == UNLUCKY, "nobody waits for what never comes"
