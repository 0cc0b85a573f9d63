"""The reports of robots of a team: whatever they contain and however they come, logs are those measured."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from agent.estimation.team_measurements import TeamMeasurements
from agent.peer.team_log import Entry, LogPart, Ranging, TeamLog, TeamReport
from agent.planning.team import TeamPlanner
from agent.planning.team_state import TeamState
from agent.planning.team_tasks import next_task
from compose.scenario.scenario_file import load
from protocol.messages import Contact, Observation
from protocol.motion import REST, Controls
from protocol.wire import decode, encode
from world.tick import World, advance, observations, release

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
