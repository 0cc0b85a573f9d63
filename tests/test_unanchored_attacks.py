"""Groups with robots without an anchor, in which some robots report false data."""

from __future__ import annotations

import math
from functools import cache
from itertools import combinations
from typing import Any

import pytest
from msgspec.structs import replace

from agent.planning.group import GroupPlanner
from agent.planning.state import RobotState
from agent.planning.tasks import Travelling
from agent.planning.unanchored import UnanchoredPlanner
from compose.audit.rules import replayed
from compose.errors import UserError
from compose.launch.in_process import run_mission
from compose.launch.planner_loader import planner_of
from compose.recording.run import Run, of_frames
from compose.scenario.scenario_change import file_table
from compose.scenario.scenario_file import ScenarioTemplate
from compose.sweep import spec
from compose.sweep.cells import cells, setting_of
from protocol.messages import Contact, Localised, Observation, Report, ReportedPose, Undecided
from protocol.motion import ORIGIN, REST, Controls, Pose, Segment, compose, step, wrap
from protocol.rounding import TOLERANCE
from tests.groups import with_value
from tests.missions import kept
from tests.test_group_runs import audited
from tests.test_unanchored import four, last_claim, scenario_of, table_with

REFRAME = {"kind": "reframe", "size": 1.0}
"""The attack that no meeting contradicts, and that moves all poses which the attacker reports rigidly."""


def five(attackers: str = "", **fields: Any) -> dict[str, Any]:
    """Return a scenario file of three robots with an anchor and two without, one of which may attack."""
    table = four(**fields)
    table["mission"] = {**table["mission"], "tolerates": 1}
    table["robot"].insert(2, {"id": "c", "anchor": [2.0, 11.0]})
    for robot in table["robot"]:
        if robot["id"] in attackers:
            robot["attack"] = REFRAME
    return table


@cache
def journals() -> dict[str, list[bytes]]:
    """Return the journals of `five` with the attacker a."""
    return kept(scenario_of(five("a")))


def claims(run: Run) -> dict[str, float | None]:
    """Return the larger error (m or rad) of the claim of each honest robot; None if it has none."""
    found = {}
    for robot in run.scenario.robots:
        if robot.attack is None:
            claim = run.claim(robot.id)
            found[robot.id] = None if claim is None else max(claim.position_error, claim.heading_error)
    return found


def all_right(run: Run) -> bool:
    return all(error is not None and error <= TOLERANCE for error in claims(run).values())


# --- missions -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("attacker", ["a", "b", "c", "u"])
def test_honest_robots_are_localised_and_never_wrong_whoever_attacks(attacker: str) -> None:
    assert all_right(run_mission(scenario_of(five(attacker))))


def test_an_attacker_that_is_a_finder_is_believed_by_a_robot_that_tolerates_no_false_report() -> None:
    """This is why a scenario with an attack must say how many are tolerated."""
    scenario = scenario_of(five("a"))
    believing = replace(scenario, tolerates=0)
    assert any(error is not None and error > 0.1 for error in claims(run_mission(believing)).values())


def test_without_an_attacker_the_second_finder_costs_time_within_the_bound() -> None:
    once = five()
    del once["mission"]["tolerates"]
    both = [run_mission(scenario_of(table)) for table in (once, five())]
    assert all(all_right(run) for run in both)
    assert last_claim(both[0]) < last_claim(both[1])
    for run in both:
        assert run.scenario.planned_sweep is not None
        assert last_claim(run) <= run.scenario.planned_sweep.ends / run.scenario.mission.period


@pytest.mark.long
def test_a_recording_with_an_attacker_passes_the_audit_and_the_replay() -> None:
    assert audited(journals()) == []
    assert replayed(of_frames(journals())).differences == ()


@pytest.mark.long
def test_a_robot_with_no_second_finder_stays_undecided_and_names_the_one() -> None:
    table = five()
    for robot in table["robot"][1:3]:
        robot["dies"] = 0
    table["fault"] = [{"link": "b->u", "loss": 1.0}, {"link": "c->u", "loss": 1.0}]
    table["robot"][1].pop("dies")  # it localises itself with a, but u does not hear it
    run = run_mission(scenario_of(table))
    found = claims(run)
    assert found["u"] is None
    assert found["a"] is not None
    command = run.ticks[-1].commands["u"]
    assert command.verdict == Undecided("2 robots must agree on its pose; it is found by: a")


@pytest.mark.long
@pytest.mark.parametrize("fault", [{"loss": 0.8}, {"delay": 20}], ids=["loss", "delay"])
def test_lost_and_late_reports_only_cost_time_with_an_attacker(fault: dict[str, Any]) -> None:
    assert all_right(run_mission(scenario_of(five("a", fault=[fault]))))


@pytest.mark.long("slow")
def test_no_shipped_attack_leads_to_a_wrong_claim() -> None:
    shipped = spec.load("group-attacks-unanchored")
    for cell in cells(shipped):
        template = setting_of(shipped, cell)
        assert isinstance(template, ScenarioTemplate)
        assert all_right(run_mission(template.seeded(3))), cell


SLIGHTLY_LONGER = {"kind": "shift", "part": "all", "size": 1e-6}
SLIGHTLY_FARTHER = {"kind": "radius", "size": 1e-6}
FIRST_FOUND = [
    *((2.7, 1.1), (7.4, 15.3), (0.4, 10.3), (20.7, 19.7), (4.7, 19.6), (14.7, 4.1), (11.3, 17.0), (4.0, 21.1))
]
VISITED = [
    *((8.3, 1.0), (10.2, 7.0), (2.7, 6.3), (12.0, 11.1), (5.1, 9.4), (1.9, 1.6), (8.8, 0.6), (11.5, 2.2))
]


@pytest.mark.parametrize(
    ("seed", "anchors", "attackers", "unanchored"),
    [
        pytest.param(
            480005,
            FIRST_FOUND,
            {6: SLIGHTLY_LONGER, 7: SLIGHTLY_FARTHER},
            1,
            id="an attacker is found while it is in phase 1",
        ),
        pytest.param(
            591718,
            [(5.1, 16.9), (12.5, 3.3), (17.2, 17.8), (7.6, 6.4), (7.8, 8.3)],
            {2: SLIGHTLY_LONGER, 3: SLIGHTLY_FARTHER},
            2,
            id="an attacker is localised beside a robot that has found it",
        ),
        pytest.param(
            107945,
            VISITED,
            {4: {"kind": "heading", "size": 1e-6}, 6: SLIGHTLY_FARTHER},
            1,
            id="an attacker that has been found stays beside a robot that others visit",
        ),
        pytest.param(
            316929,
            [(11.67, 6.57), (6.83, 8.24), (2.97, 8.55), (4.38, 10.16), (5.54, 7.96)],
            {1: {"kind": "rotate", "part": "orbit", "size": 0.2}, 4: {"kind": "radius", "size": 0.3}},
            2,
            id="two robots that are near each other have a retry",
        ),
    ],
)
def test_two_attackers_of_different_kinds_keep_no_honest_robot_from_a_right_claim(
    seed: int, anchors: list[tuple[float, float]], attackers: dict[int, Any], unanchored: int
) -> None:
    robots: list[dict[str, Any]] = [{"id": f"r{i}", "anchor": [*at]} for i, at in enumerate(anchors)]
    for i, attack in attackers.items():
        robots[i]["attack"] = attack
    robots += [{"id": f"u{len(anchors) + i}"} for i in range(unanchored)]
    table = {**five(), "seed": seed, "robot": robots, "max_ticks": 2000}
    side = math.ceil(max(max(at) for at in anchors))
    table["mission"] |= {"area": [0.0, 0.0, side, side], "tolerates": 2}
    assert all_right(run_mission(scenario_of(table)))


@pytest.mark.parametrize(("anchored", "tolerates"), [(3, 1), (4, 1), (5, 2), (6, 2), (9, 2), (7, 3), (9, 4)])
def test_some_pair_of_the_plan_is_without_any_robots_that_may_report_false_data(
    anchored: int, tolerates: int
) -> None:
    for seed in range(4):
        table = table_with(anchored + 1, 1, seed)
        table["mission"]["tolerates"] = tolerates
        scenario = scenario_of(table)
        peers = {robot.id: scenario.config(robot.id).peer for robot in scenario.robots}
        pairs = [(robot, peer) for robot, peer in peers.items() if peers[peer] == robot]
        pairs += [(one.visitor, one.visited) for one in scenario.retries]
        for attackers in combinations([one.id for one in scenario.robots], tolerates):
            assert any(not {*pair} & {*attackers} for pair in pairs)


def test_a_robot_that_searches_for_the_one_that_comes_to_it_is_visited_by_it() -> None:
    """Robot r3, whose meeting with the attacker has failed, searches for r4, which visits it meanwhile.

    If both were robot a of the meeting, each would wait for the manoeuvre of the other one.
    """
    table = {**five(), "seed": 0}
    del table["robot"], table["mission"]["area"]
    attack = {"kind": "rotate", "part": "encounter", "size": math.radians(1.0)}
    table["group"] = {"robots": 6, "spacing": 30.0, "without_anchor": 2, "attack": attack}
    assert all_right(run_mission(scenario_of(table)))


def test_a_robot_without_an_anchor_that_claims_to_visit_is_not_met() -> None:
    """It has no anchor and no log. One that reports a log all the same is in no meeting."""
    scenario = scenario_of(five())
    config = scenario.config("a")
    planner = planner_of(config)
    run = run_mission(scenario)
    done = next(tick for tick, one in enumerate(run.ticks) if one.commands["a"].phase > 1)
    state = planner.start(config)
    for tick in range(done + 1):
        state = planner.decide(planner.observe(state, run.observations[tick]["a"]))
    assert state.verdict is None
    visit = Report(done, "u", 3, Travelling.name, ORIGIN, 0, 1, (Segment(1, 0.0, 0.0),), 0, (), 0, 0)
    assert visit.has_log
    met = Observation(done + 1, "a", REST, None, (Contact("u", 1.0, (done,)),))
    after = planner.decide(planner.observe(state, met), [visit])
    assert after.config.peer == config.peer


# --- the robot without an anchor ----------------------------------------------------------------------


def met(state: RobotState, pose: Pose, finder: str, offset: Pose) -> tuple[RobotState, Pose]:
    """Return the state and the true pose after `finder` has driven squares until `state` needs no more.

    The finder reports its poses as they are after the motion `offset` of the plane.
    """
    planner = GroupPlanner(UnanchoredPlanner())
    for corner in range(40):
        dx, dy = [(0.0, 0.0), (0.1, 0.0), (0.1, 0.1), (0.0, 0.1)][corner % 4]
        place, tick = Pose(6.0 + dx, 5.0 + dy, 0.0), state.tick + 1
        distance = math.hypot(place.x - pose.x, place.y - pose.y)
        command = planner.command(state)
        driven = Controls(command.v, command.omega) if tick > 0 else None
        if driven is not None:
            pose = step(pose, driven.v, driven.omega, 1.0)
            distance = math.hypot(place.x - pose.x, place.y - pose.y)
        contact = Contact(finder, distance, (tick,))
        state = planner.observe(state, Observation(tick, "u", driven, None, (contact,)))
        prior = ReportedPose(tick, compose(offset, place))
        state = planner.decide(state, [Report(tick, finder, 2, "sweeping", prior=prior)])
        if state.verdict is not None:
            break
    return state, pose


def test_a_pose_is_claimed_when_one_more_finder_than_may_lie_agrees_on_it() -> None:
    planner = GroupPlanner(UnanchoredPlanner())
    config = scenario_of(five()).config("u")
    pose = Pose(5.0, 4.0, 0.7)
    state, pose = met(planner.start(config), pose, "a", Pose(0.4, -0.2, 0.3))
    assert state.verdict is None
    assert [planner.report_to(state, peer).state for peer in "ab"] == ["unconfirmed", "standing"]
    state, pose = met(state, pose, "b", ORIGIN)
    assert state.verdict is None
    assert planner.summary(state).hypotheses == 2
    state, pose = met(state, pose, "a", ORIGIN)  # one that has reported other poses counts no more
    assert state.verdict is None
    state, pose = met(state, pose, "c", ORIGIN)
    assert isinstance(state.verdict, Localised)
    assert math.dist((state.verdict.pose.x, state.verdict.pose.y), (pose.x, pose.y)) < 1e-9
    assert abs(wrap(state.verdict.pose.heading - pose.heading)) < 1e-9


@pytest.mark.long
def test_a_finder_that_has_heard_that_it_is_not_needed_sends_no_pose_and_does_not_stop_again() -> None:
    agent = of_frames(journals()).agents["u"]
    received = [framed.report for one in agent.steps for framed in one.received]
    reports = [one for one in received if one.robot == "b"]
    assert {one.prior is None for one in reports} == {True, False}
    stops = [one.state == "looping" for one in reports]
    begins = [here and not before for before, here in zip([False, *stops], stops, strict=False)]
    assert sum(begins) == 1


# --- the poses that an attacker reports ---------------------------------------------------------------


def test_the_pose_that_an_attacker_reports_follows_from_the_log_that_it_reports() -> None:
    """`reframe` turns it about the anchor of the attacker; a scale of 1 changes nothing."""
    turned = poses_of(journals())
    table = five()
    table["robot"][0]["attack"] = {"kind": "scale", "size": 1.0}
    true = poses_of(kept(scenario_of(table)))
    tick = min(turned.keys() & true.keys())  # until then, both missions are the same
    here, there = true[tick], turned[tick]
    c, s = math.cos(1.0), math.sin(1.0)
    assert there.x == pytest.approx(c * here.x - s * here.y, abs=1e-9)
    assert there.y == pytest.approx(s * here.x + c * here.y, abs=1e-9)


def poses_of(frames: dict[str, list[bytes]]) -> dict[int, Pose]:
    """Return the poses that a reports to robots without an anchor, by tick; its anchor is the origin."""
    run = of_frames(frames)
    return {
        prior.tick: prior.pose
        for robot in run.scenario.unanchored
        for one in run.agents[robot].steps
        for framed in one.received
        if (prior := framed.report.prior) is not None and framed.report.robot == "a"
    }


# --- the scenario -------------------------------------------------------------------------------------


def test_a_changed_scenario_keeps_the_number_of_false_reporters() -> None:
    scenario = scenario_of(five("a"))
    assert scenario_of(file_table(scenario)) == scenario


ANCHORED = [{"id": robot, "anchor": [20.0, 5.0 * place]} for place, robot in enumerate("abcd")]
REFUSED: dict[str, tuple[str, Any]] = {
    r"robot\[0\].attack: .* believes the poses that others report: set mission.tolerates = 1": (
        "mission.tolerates",
        None,
    ),
    r"robot\[0\].attack: .*: set mission.tolerates = 2": ("robot.4.attack", REFRAME),
    r"mission.tolerates: to tolerate 2, 5 robots need an anchor, of which 3 are then honest; there": (
        "mission.tolerates",
        2,
    ),
    r"mission.tolerates: with noisy sensors, all robots need an anchor": (
        "mission.noise",
        {"anchor_sigma": 0.05, "mutual_sigma": 0.05},
    ),
    r"mission.tolerates: sensors are exact and all robots have an anchor, so they": ("robot", ANCHORED),
    r"mission.tolerates: it is for groups": ("robot", ANCHORED[:2]),
}
"""Values that are refused, and the place of each in the file, by the reason."""


@pytest.mark.parametrize("message", REFUSED)
def test_attackers_that_are_not_tolerated_are_refused_in_one_line(message: str) -> None:
    with pytest.raises(UserError, match=f"^group.toml: {message}"):
        scenario_of(with_value(five("a"), *REFUSED[message]))
