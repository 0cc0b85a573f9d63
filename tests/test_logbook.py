"""Logs of motion and of measurements reach another robot completely, over any channel, whatever comes."""

from __future__ import annotations

from collections import deque
from itertools import cycle

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from agent.estimation.team_measurements import TeamMeasurements
from agent.peer.motion_log import MotionLog
from agent.peer.peer_state import PeerState, contradiction, with_report
from agent.peer.team_log import Entry, LogPart, Ranging, TeamLog, TeamReport
from agent.planning.assured import Assured
from agent.planning.state import RobotState
from agent.planning.tasks import Done
from agent.planning.team import TeamPlanner
from agent.planning.team_state import TeamState
from agent.planning.team_tasks import next_task
from compose.scenario.scenario_file import load
from protocol.messages import (
    MAX_REPORT_RANGES,
    MAX_REPORT_RUNS,
    Contact,
    Localised,
    Observation,
    Ranged,
    Report,
    Undecided,
)
from protocol.motion import REST, Controls, Pose, Segment
from protocol.wire import MAX_REPORT_BYTES, decode, encode
from world.tick import World, advance, observations, release

Tick = tuple[float, float, float | None]
"""The v and omega over one tick, and the anchor range at its end, or None: m/s, rad/s and m."""

STATE = RobotState(load("paper-1").config("a"))

ticks = st.builds(
    lambda few, times: few * times,
    st.lists(
        st.tuples(
            st.sampled_from([0.0, 1.0, 0.5]), st.sampled_from([0.0, 0.25]), st.none() | st.floats(0.0, 3.0)
        ),
        min_size=1,
        max_size=30,
    ),
    st.sampled_from([1, 1, 2, 20]),
)


def prefixes(driven: list[Tick]) -> list[MotionLog]:
    """Return the log of a robot after each of its ticks. It is in range at the start."""
    book = MotionLog().ranged(1.5)
    grown = [book]
    for v, omega, distance in driven:
        book = book.drove(v, omega)
        if distance is not None:
            book = book.ranged(distance)
        grown.append(book)
    return grown


def told(book: MotionLog, radio: PeerState) -> Report:
    """Return the Report of a planner with this log and this state of the peer."""
    return Assured().report(replace(STATE, log=book, peer_state=radio, tick=book.through))


@st.composite
def deliveries(draw: st.DrawFn) -> tuple[list[MotionLog], list[tuple[int, int]]]:
    """Draw a growing log, and the (tick, acknowledged tick) of its Reports, in the order of arrival."""
    books = prefixes(draw(ticks))
    last = len(books) - 1
    acknowledgements = draw(st.lists(st.tuples(st.integers(0, last), st.integers(0, last)), max_size=20))
    acknowledgements = [(max(pair), min(pair)) for pair in acknowledgements]
    again = draw(st.lists(st.sampled_from(acknowledgements), max_size=5)) if acknowledgements else []
    return books, draw(st.permutations(acknowledgements + again))


@settings(max_examples=80)
@given(deliveries())
@example((prefixes([(1.0, 0.0, 1.5)] * 300), [(300, 0), (300, 0)]))
def test_reports_in_any_order_repeated_and_lost_give_back_the_log(
    case: tuple[list[MotionLog], list[tuple[int, int]]],
) -> None:
    books, arrivals = case
    radio = PeerState()
    for tick, since in arrivals:
        known = len(books[since].ranges)
        report = told(books[tick], PeerState(acknowledged=since, ranges_acknowledged=known))
        assert contradiction(report) is None
        before = radio.peer
        radio = with_report(radio, report)
        assert radio.peer.runs == books[radio.peer.through].runs
        assert radio.peer.ranges == books[-1].ranges[: len(radio.peer.ranges)]
        assert radio.peer.through >= before.through
        assert len(radio.peer.ranges) >= len(before.ranges)
        if since <= before.through:
            assert radio.peer.through >= report.through
        if known <= len(before.ranges):
            assert len(radio.peer.ranges) >= known + len(report.ranges)
    whole = books[-1]
    for _ in range(2 + whole.through // MAX_REPORT_RUNS + len(whole.ranges) // MAX_REPORT_RANGES):
        caught_up = PeerState(acknowledged=radio.peer.through, ranges_acknowledged=len(radio.peer.ranges))
        radio = with_report(radio, told(whole, caught_up))
    assert radio.peer == whole


class Side:
    """A robot on a channel that loses, delays and duplicates Reports."""

    def __init__(self, driven: list[Tick]) -> None:
        self.books = prefixes(driven)
        self.peer_state = PeerState()
        self.held: deque[Report] = deque()

    def with_report(self, report: Report, delivery: str) -> None:
        match delivery:
            case "lost":
                return
            case "late":
                self.held.appendleft(report)
                return
            case "twice":
                self.peer_state = with_report(self.peer_state, report)
        self.peer_state = with_report(self.peer_state, report)
        if self.held and delivery == "late ones too":
            self.peer_state = with_report(self.peer_state, self.held.pop())


@given(
    ticks, ticks, st.lists(st.sampled_from(["heard", "lost", "late", "late ones too", "twice"]), min_size=1)
)
def test_acknowledged_entries_are_known_and_lost_entries_are_sent_again(
    a_drove: list[Tick], b_drove: list[Tick], deliveries_of_reports: list[str]
) -> None:
    length = min(len(a_drove), len(b_drove))
    a, b = Side(a_drove[:length]), Side(b_drove[:length])
    delivery = cycle(deliveries_of_reports)
    for tick in range(length + 1):
        from_a, from_b = told(a.books[tick], a.peer_state), told(b.books[tick], b.peer_state)
        a.with_report(from_b, next(delivery))
        b.with_report(from_a, next(delivery))
        for one, other in ((a.peer_state, b.peer_state), (b.peer_state, a.peer_state)):
            assert one.acknowledged <= other.peer.through
            assert one.ranges_acknowledged <= len(other.peer.ranges)
    for _ in range(5 + 2 * length // min(MAX_REPORT_RUNS, MAX_REPORT_RANGES)):
        from_a, from_b = told(a.books[-1], a.peer_state), told(b.books[-1], b.peer_state)
        a.with_report(from_b, "heard")
        b.with_report(from_a, "heard")
    assert (a.peer_state.peer, b.peer_state.peer) == (b.books[-1], a.books[-1])
    last = told(a.books[-1], a.peer_state)
    assert (last.since, last.runs, last.ranges) == (length, (), ())


@given(ticks, st.integers(0, 40))
def test_a_robot_that_begins_another_meeting_receives_the_whole_log_again(
    driven: list[Tick], again: int
) -> None:
    """The log of a robot that is still in the first meeting; it once sent only the rest."""
    a, b = Side(driven), Side(driven)
    for tick in range(len(driven) + 5 + 2 * len(driven) // min(MAX_REPORT_RUNS, MAX_REPORT_RANGES)):
        if tick == min(again, len(driven)):
            b.peer_state = PeerState()
        now = min(tick, len(driven))
        from_a, from_b = (replace(told(one.books[now], one.peer_state), tick=tick) for one in (a, b))
        a.with_report(from_b, "heard")
        b.with_report(from_a, "heard")
    assert b.peer_state.peer == a.books[-1]


def test_an_overtaken_report_does_not_bring_back_an_old_state() -> None:
    old, new = (replace(told(MotionLog(), PeerState()), tick=tick) for tick in (3, 7))
    new = replace(new, state="standing", verdict=Undecided("lost"))
    radio = with_report(with_report(PeerState(), new), old)
    assert (radio.state, radio.verdict, radio.latest) == ("standing", Undecided("lost"), 7)


# --- the size of a Report -----------------------------------------------------------------------------


@given(ticks)
@example([(1.0, 0.0, 1.5)] * 300)
@example([(1.0, 0.0, None), (0.5, 0.0, None)] * 150)
def test_a_report_has_as_many_entries_as_fit_its_frame(driven: list[Tick]) -> None:
    book = prefixes(driven)[-1]
    report = told(book, PeerState())
    frame = encode(report)
    assert len(frame) <= MAX_REPORT_BYTES
    assert decode(frame, Report, MAX_REPORT_BYTES) == report
    assert report.through > 0
    if len(book.runs) <= MAX_REPORT_RUNS:
        assert report.through == book.through
    assert len(report.ranges) == min(len(book.ranges), MAX_REPORT_RANGES)


def longest_log(begin: int, ticks_a_run: int) -> MotionLog:
    """Return a log that exceeds a Report: each manoeuvre differs from the previous one, with many ranges."""
    more = MAX_REPORT_RANGES - MAX_REPORT_RUNS
    book = MotionLog().drove(0.0, 0.0, begin) if begin else MotionLog()
    for i in range(2 * MAX_REPORT_RUNS):
        book = book.drove(0.1 + i, 0.2, ticks_a_run)
        if i >= -more:
            book = book.ranged(0.3)
        if i < more:
            book = book.drove(0.1 + i, 0.2).ranged(0.3)
    return book


VERDICTS = {
    "none": None,
    "localised": Localised(Pose(1.0, 2.0, 3.0)),
    "undecided": Undecided("eq. (5) leaves no way to a third range"),
    "the peer's": Undecided("\U0001f916" * 300),  # a repeats the reason of b
}


@pytest.mark.parametrize("ticks_a_run", [1, 200, 70_000])
@pytest.mark.parametrize("verdict", VERDICTS)
@pytest.mark.parametrize("begin", [0, 70_000])
def test_the_longest_report_that_there_is_fits_its_frame(begin: int, verdict: str, ticks_a_run: int) -> None:
    book = longest_log(begin, ticks_a_run)
    said = VERDICTS[verdict]
    state = replace(
        STATE,
        config=replace(STATE.config, robot="r" * 32),
        task=Done(3, said) if said is not None else STATE.task,
        log=book,
        tick=book.through,
        peer_state=PeerState(acknowledged=begin),
    )
    report = Assured().report(state)
    assert report.runs
    size = len(encode(report))
    assert size <= MAX_REPORT_BYTES


# --- contradictions -----------------------------------------------------------------------------------

SOUND = Report(
    tick=9,
    robot="a",
    phase=3,
    state="standing",
    start=None,
    since=2,
    through=8,
    runs=(Segment(4, 1.0, 0.0), Segment(2, 0.5, 0.1)),
    ranges_since=1,
    ranges=(Ranged(3, 1.0), Ranged(8, 2.0)),
    heard=4,
    ranges_heard=0,
)


def test_a_sound_report_contradicts_nothing() -> None:
    assert contradiction(SOUND) is None
    assert contradiction(replace(SOUND, tick=8)) is None
    assert contradiction(replace(SOUND, since=8, runs=(), ranges=())) is None
    from_the_start = replace(
        SOUND, since=0, runs=(Segment(8, 1.0, 0.0),), ranges_since=0, ranges=(Ranged(0, 1.0), Ranged(8, 2.0))
    )
    assert contradiction(from_the_start) is None


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"tick": 7}, "log over [2, 8] reported at tick 7"),
        ({"since": 9, "runs": (), "ranges": ()}, "log over [9, 8]"),
        ({"runs": ()}, "do not fill [2, 8]"),
        ({"runs": (Segment(7, 1.0, 0.0),)}, "do not fill [2, 8]"),
        ({"runs": (Segment(2**31, 1.0, 0.0),)}, "do not fill [2, 8]"),
        ({"since": 3}, "do not fill [3, 8]"),
        ({"ranges": (Ranged(10, 1.0),)}, "range of tick 10 outside"),
        ({"ranges": (Ranged(0, 1.0),)}, "range of tick 0 outside"),
        ({"ranges_since": 5}, "range of tick 3 outside"),
        ({"ranges": (Ranged(8, 1.0), Ranged(3, 1.0))}, "range of tick 3 outside"),
        ({"ranges": (Ranged(3, 1.0), Ranged(3, 2.0))}, "range of tick 3 outside"),
    ],
)
def test_an_impossible_report_is_explained(change: dict[str, object], named: str) -> None:
    found = contradiction(replace(SOUND, **change))
    assert found is not None
    assert named in found


DELIVERIES = st.lists(
    st.tuples(st.integers(0, 2), st.integers(0, 2), st.integers(0, 5), st.booleans()), max_size=60
)


@given(DELIVERIES)
def test_in_any_order_of_lost_late_and_repeated_reports_a_log_is_the_beginning_of_the_true_one(
    deliveries: list[tuple[int, int, int, bool]],
) -> None:
    """A delivery is of a report of one robot to another one, of as many reports ago; or a tick passes."""
    config = load("relative").config("a")
    assert config.team is not None
    logs = [TeamLog.of(config.team)] * 3
    truth: list[list[Entry]] = [[], [], []]
    read, mission = [TeamMeasurements()] * 3, config.mission
    sent: dict[tuple[int, int], list[TeamReport]] = {}
    for sender, receiver, ago, passes in deliveries:
        if passes:
            for place, name in enumerate(config.team.robots):
                tick = len(truth[place])
                contact = Contact(config.team.robots[(place + 1) % 3], 1.0 + place + tick / 8.0, ())
                seen = Observation(tick, name, Controls(0.1 * tick, 0.0) if tick else None, None, (contact,))
                logs[place] = logs[place].measured(place, seen, config.team)
                truth[place].append(logs[place].logs[place][-1])
        elif sender != receiver:
            reports = sent.setdefault((sender, receiver), [])
            reports.append(logs[sender].report(sender, receiver))
            logs[receiver] = logs[receiver].received([reports[max(0, len(reports) - 1 - ago)]], receiver)
        read = [one.grown(log, config.team, mission) for one, log in zip(read, logs, strict=True)]
        for log, grown in zip(logs, read, strict=True):
            assert all(list(one) == truth[k][: len(one)] for k, one in enumerate(log.logs))
            at_once = TeamMeasurements().grown(log, config.team, mission)
            assert grown.joint(config.team, mission) == at_once.joint(config.team, mission)


@pytest.mark.parametrize("hearsay", [True, False])
def test_a_false_report_says_nothing_of_later_ticks_and_gives_the_receiver_no_result(hearsay: bool) -> None:
    """Later entries would make each fit as long as the path that they tell: a kB has hundreds of ticks."""
    team = load("relative").config("a").team
    assert team is not None
    log = TeamLog.of(team, hearsay=hearsay)
    for tick in range(4):
        log = log.measured(0, Observation(tick, "a", REST if tick else None, None), team)
    many = tuple([Entry(REST if tick else None) for tick in range(500)])
    for since in (0, 2, 4):
        log = log.received([TeamReport(1, (LogPart(1, since, many[since:]),), (0, 0, 0), (0, 1))], 0)
        assert log.logs[1] == many[:4]
    assert log.done == {1}
    assert log.report(0, 2).done == (1,)


def state_after(ticks: int) -> tuple[TeamState, Observation]:
    """Return the state of a robot of the team `relative` after these ticks, and its next Observation."""
    scenario, planner = load("relative"), TeamPlanner()
    ids = [one.id for one in scenario.robots]
    world, states = release(scenario), {one: planner.start(scenario.config(one)) for one in ids}
    for _ in range(ticks):
        seen = {one.robot: one for one in observations(world)}
        states = {one: planner.observe(states[one], seen[one]) for one in ids}
        sent = {(one, other): planner.report_to(states[one], other) for one in ids for other in ids}
        states = {
            one: planner.decide(states[one], [sent[other, one] for other in ids if other != one])
            for one in ids
        }
        onward = advance(world, {one: planner.command(states[one]) for one in ids})
        assert isinstance(onward, World)
        world = onward
    return states["a"], observations(world)[0]


REACHED = state_after(3)


def test_a_robot_without_a_result_returns_to_one_that_has_one_if_it_is_alone() -> None:
    """Robots that have one wait where both were nearest, and did so for three loops."""
    state = replace(REACHED[0], apart={}, verdict=None)
    done = replace(state.log, done=frozenset({1, 2}))
    assert next_task(replace(state, log=done)).doing == "homing"
    near = replace(state, log=done, apart=REACHED[0].apart)
    assert next_task(near).doing != "homing"


COUNTS = st.integers(0, 6) | st.sampled_from([2**31, 2**53])
ANY_RANGING = st.builds(Ranging, COUNTS, st.floats(0.0, 1e7) | st.floats(0.0, 10.0))
ANY_ENTRY = st.builds(
    Entry,
    st.none() | st.builds(Controls, st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)),
    st.lists(ANY_RANGING, max_size=3).map(tuple),
    st.lists(ANY_RANGING, max_size=3).map(tuple),
)
ANY_PART = st.builds(
    LogPart, COUNTS, COUNTS, st.lists(ANY_ENTRY, max_size=4).map(tuple) | st.just((Entry(None),) * 140)
)
ANY_REPORT = st.builds(
    TeamReport,
    COUNTS,
    st.lists(ANY_PART, max_size=4).map(tuple),
    st.lists(COUNTS, max_size=5).map(tuple),
    st.lists(COUNTS, max_size=3).map(tuple),
)


@settings(max_examples=40, deadline=None)
@given(st.lists(ANY_REPORT, max_size=3))
def test_whatever_a_report_contains_it_ends_no_robot(reports: list[TeamReport]) -> None:
    state, seen = REACHED
    planner = TeamPlanner()
    after = planner.decide(planner.observe(state, seen), reports)
    assert decode(encode(planner.command(after)), type(planner.command(after))).tick == seen.tick
    encode(planner.estimate(after))
    own = after.log.logs[after.own]
    assert own[:-1] == state.log.logs[state.own], "nobody changes what the robot itself has measured"


def test_a_report_changes_no_entry_leaves_no_gap_and_names_no_place_beyond_the_team() -> None:
    state, seen = REACHED
    planner = TeamPlanner()
    observed = planner.observe(state, seen)
    has = len(observed.log.logs[1])

    def after(*parts: LogPart) -> TeamState:
        return planner.decide(observed, [TeamReport(1, parts, (0, 0, 0))])

    stray = Entry(Controls(0.2, 0.1), (Ranging(99, 1.0),), (Ranging(99, 1.0), Ranging(1, 1.0)))
    plain = after().log.logs
    assert after(LogPart(0, len(plain[0]), (stray,))).log.logs == plain, "its own log"
    assert after(LogPart(1, 0, (stray,) * has)).log.logs == plain, "what it has contradicts"
    assert after(LogPart(1, has + 1, (stray,))).log.logs == plain, "a tick is missing"
    assert after(LogPart(99, 0, (stray,))).log.logs == plain, "there is no such robot"
    alone = replace(observed.log, hearsay=False)
    third = TeamReport(1, (LogPart(2, len(plain[2]), (stray,)), LogPart(1, has, (stray,))), (0, 0, 0), (1, 2))
    believed = alone.received([third], 0)
    assert believed.logs == (plain[0], (*plain[1], stray), plain[2]), "what it tells of a third robot"
    assert believed.done == {1}
    assert [part.robot for part in alone.report(0, 1).parts] == [0]
    found = after(LogPart(1, has, (stray,)))
    assert found.log.logs[1] == (*plain[1], stray)
    bare = after(LogPart(1, has, (Entry(Controls(0.2, 0.1)),)))
    assert planner.estimate(found) == planner.estimate(bare), "stray ranges are of nobody"
