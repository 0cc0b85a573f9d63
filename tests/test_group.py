"""Groups: robots that meet in turn, localise themselves, and help where a meeting has failed."""

from __future__ import annotations

import math
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from msgspec.structs import replace

from agent.estimation.knowledge import Knowledge
from agent.planning import meetings
from agent.planning.appointments import PEER_LOST_AFTER
from agent.planning.drive import towards
from agent.planning.state import Fix
from agent.planning.tasks import Done, Travelling
from agent.planning.travelling import MOST_SIDES, next_leg
from compose.errors import BadScenario, Unworkable, UserError
from compose.launch.in_process import run_mission
from compose.launch.planner_loader import planner_of
from compose.recording.run import read
from compose.scenario.scenario_file import validate
from protocol.messages import Contact, Localised, Observation, Report, Undecided
from protocol.mission import HEADING_ACCURACY, Mission
from protocol.motion import Pose, step
from protocol.orbits import SHORT_OF_ANCHOR, search_legs, search_ticks
from protocol.wire import MAX_REPORT_BYTES, encode
from tests.groups import R, group_of, localised, table_of
from tests.missions import outcome
from tests.series import series
from world.referee import mistake

MISSION = Mission(R, 1.0, 1.0, math.pi)
SCALED = {"kind": "scale", "part": "encounter", "size": 0.5}
"""False reports that each honest peer finds."""


@pytest.mark.parametrize("group", series([(3, 1), (4, 2), (8, 1), (3, 323), (16, 1), (50, 1)], 3))
def test_all_robots_of_a_group_are_localised_before_the_bound_of_its_plan(group: tuple[int, int]) -> None:
    scenario = group_of(*group)
    run = run_mission(scenario)
    assert run.end is not None
    assert run.end.outcome == "localised"
    assert localised(run) == set(run.robots)
    assert run.end.tick * scenario.mission.period <= scenario.meetings[-1].ends
    for meeting in scenario.meetings:
        claim = run.claim(meeting.visited)
        assert claim is not None
        assert claim.tick * scenario.mission.period <= meeting.ends


@pytest.mark.parametrize("group", series([(3, 2), (4, 1), (8, 2), (4, 9)], 2))
def test_a_group_with_noisy_ranges_is_localised_as_accurately_as_it_claims(group: tuple[int, int]) -> None:
    run = run_mission(group_of(*group, sigma=0.05))
    assert outcome(run) == "localised"
    for robot in run.robots:
        claim = run.claim(robot)
        assert claim is not None
        assert claim.nees is not None
        assert claim.nees < 25.0


def test_a_noisy_visitor_states_no_covariance_on_its_way(tmp_path: Path) -> None:
    run_mission(group_of(3, 2, sigma=0.05), tmp_path)
    on_the_way = at_rest = 0
    for agent in read(tmp_path).agents.values():
        for one in agent.steps:
            assert one.command is not None
            assert one.estimate is not None
            if one.command.task == Travelling.name:
                assert one.estimate.covariance is None
                on_the_way += 1
            elif one.command.task == "localised":
                assert one.estimate.covariance is not None
                at_rest += 1
    assert on_the_way > 0
    assert at_rest > 0


@pytest.mark.parametrize("seed", series([9, 0, 1, 2, 3, 4, 5, 6, 14], 2))
def test_one_attacker_keeps_no_honest_robot_from_a_right_claim(seed: int) -> None:
    for attacker in range(4):
        scenario = group_of(4, seed, attacker=attacker, attack=SCALED)
        run = run_mission(scenario)
        honest = set(run.robots) - {f"r{attacker}"}
        assert honest <= localised(run)
        for place, robot in enumerate(run.robots):
            claim = run.claim(robot)
            if robot in honest:
                assert claim is not None
                at = run.ticks[claim.tick].truth.poses[place]
                assert mistake(robot, Localised(claim.pose), at, scenario.mission) is None


def test_a_pair_tries_again_with_another_robot_when_its_first_meeting_has_failed() -> None:
    honest = group_of(3, 1)
    first = honest.meetings[0]
    attacker = int(first.visited[1:])
    scenario = group_of(3, 1, attacker=attacker, attack=SCALED)
    run = run_mission(scenario)
    assert localised(run) >= set(run.robots) - {first.visited}
    claim = run.claim(first.visitor)
    assert claim is not None
    assert claim.tick * scenario.mission.period > scenario.retries[0].begins


ROTATED = {"kind": "rotate", "part": "encounter", "size": 0.0872664626}
SHIFTED = {"kind": "shift", "part": "all", "size": 0.3}


@pytest.mark.parametrize(
    ("robots", "seed", "attacker", "attack"),
    [
        pytest.param(3, 13, 1, SCALED, id="the attacker stays where the retry takes place"),
        pytest.param(3, 14, 2, SHIFTED, id="the attacker is found in phase 1"),
        pytest.param(3, 18, 2, ROTATED, id="the attacker interrupts a retry"),
        pytest.param(4, 5, 2, ROTATED, id="the attacker interrupts the retry of four"),
        pytest.param(3, 2, 2, SCALED, id="the honest robots refuse each other before the retries"),
    ],
)
def test_an_attacker_cannot_end_the_meeting_of_two_honest_robots(
    robots: int, seed: int, attacker: int, attack: dict[str, Any]
) -> None:
    run = run_mission(group_of(robots, seed, attacker=attacker, attack=attack))
    assert localised(run) >= set(run.robots) - {f"r{attacker}"}


def test_an_attacker_in_six_robots_hears_that_each_has_found_it_and_gives_up() -> None:
    attack = {"kind": "scale", "size": 0.5, "part": "phase-1"}
    scenario = group_of(6, 3, attacker=3, attack=attack)
    run = run_mission(scenario)
    assert localised(run) == set(run.robots) - {"r3"}
    assert run.end is not None
    assert run.end.tick < 0.25 * scenario.max_ticks


def test_a_robot_whose_meetings_with_all_others_have_failed_gives_up_at_once() -> None:
    scenario = group_of(3, 14, attacker=2, attack=SHIFTED)
    run = run_mission(scenario)
    assert run.end is not None
    claims = [claim.tick for robot in ("r0", "r1") if (claim := run.claim(robot)) is not None]
    assert run.end.tick < max(claims) + 20
    assert run.end.tick < 0.5 * scenario.max_ticks


@pytest.mark.parametrize("sigma", [0.0, 0.05])
def test_a_robot_in_phase_1_goes_on_with_it_when_its_peer_ends_their_meeting(sigma: float) -> None:
    config = group_of(3, 1, sigma=sigma).config("r0")
    planner = planner_of(config)
    near = (Contact(config.peer, 2.0, (0,)),)
    state = planner.observe(planner.start(config), Observation(0, "r0", None, 1.0, near))
    refusal = Report(0, config.peer, 1, "straight", None, 0, 0, (), 0, (), 0, 0, Undecided("a false log"))
    after = planner.decide(state, [refusal])
    assert after.robot_verdict is None
    assert after.other(config.peer).failed
    command = planner.command(after)
    assert (command.phase, command.task) == (1, "straight")
    assert command.v > 0.0


@pytest.mark.parametrize(
    ("silence", "refused", "leaves"),
    [(PEER_LOST_AFTER, False, False), (PEER_LOST_AFTER + 1, False, True), (0, True, True)],
    ids=["the peer may still report its result", "the peer is silent", "the peer has ended the meeting"],
)
def test_a_localised_robot_waits_for_its_peer_beside_it_for_a_bounded_time(
    silence: int, refused: bool, leaves: bool
) -> None:
    scenario = group_of(3, 1)
    config = scenario.config(scenario.meetings[-1].visitor)
    planner = planner_of(config)
    state, claim = planner.start(config), Localised(Pose(0.0, 0.0, 0.0))
    fix = Fix(Knowledge(config, 0), claim, (config.peer,))
    state = replace(state, task=Done(3, claim), in_contact=True, fix=fix)
    state = replace(state, robot_verdict=claim, silence=silence)
    assert meetings.onward(state, peer_has_left=refused).visiting == leaves


def test_a_robot_sends_its_log_only_to_the_robot_that_it_meets(tmp_path: Path) -> None:
    scenario = group_of(8, 1)
    run_mission(scenario, tmp_path)
    run = read(tmp_path)
    partners = {frozenset((one.visitor, one.visited)) for one in scenario.meetings}
    strangers = 0
    for robot, agent in run.agents.items():
        for step_ in agent.steps:
            for contact, framed in zip(step_.observation.contacts, step_.reports, strict=True):
                assert isinstance(framed.report, Report)
                if frozenset((robot, contact.peer)) not in partners:
                    assert not framed.report.has_log
                    assert not framed.report.runs
                    assert not framed.report.ranges
                    strangers += 1
    assert strangers > 0


def test_the_configuration_of_a_robot_of_a_hundred_fits_in_the_largest_report() -> None:
    scenario = group_of(100, 1)
    sizes = [len(encode(scenario.config(robot.id))) for robot in scenario.robots]
    assert max(sizes) <= MAX_REPORT_BYTES


@given(
    st.floats(1e-3, 1e4), st.sampled_from([0.1, 0.3, 1.0, 1 / 3]) | st.floats(0.01, 100.0), st.integers(0, 5)
)
def test_a_robot_is_late_in_the_tick_in_which_its_bound_in_seconds_is_over(
    bound: float, period: float, ticks: int
) -> None:
    scenario = group_of(3, 1)
    mission = replace(scenario.mission, period=period)
    for ends in (bound, ticks * period):
        meetings = tuple([replace(one, ends=ends) for one in scenario.meetings])
        (last,) = {one.ends for one in replace(scenario, mission=mission, meetings=meetings).members}
        assert last * period <= ends < (last + 1) * period


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (
            {"planner": {"name": "paper"}},
            "group.toml: planner.name: robots with the planner paper meet in pairs",
        ),
        (
            {"mission": table_of(3, 1)["mission"] | {"noise": {"anchor_sigma": 0.05}, "accuracy": 0.3}},
            "group.toml: mission.noise.gyro_bias: within the",
        ),
        ({"twice": True}, "group.toml: robot.id: 2 robots have the id 'r0'"),
        ({"near": True}, "group.toml: robot[1].anchor: less than"),
        (
            {"peer": True},
            "robot[1].peer: 'r1' needs a peer, because other robots have one; robots form a group if none",
        ),
    ],
)
def test_a_group_that_cannot_be_is_refused_in_one_line(change: dict[str, Any], what: str) -> None:
    table = table_of(3, 1)
    if change.pop("twice", False):
        table["robot"][1]["id"] = "r0"
    if change.pop("near", False):
        table["robot"][1]["anchor"] = table["robot"][0]["anchor"]
    if change.pop("peer", False):
        table["robot"][0]["peer"] = "r1"
    with pytest.raises(BadScenario) as refused:
        validate(table | change, "group.toml")
    assert what in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("third", [(7.5, 0.0), (90.0, 0.0)], ids=["near", "far"])
def test_an_accuracy_that_a_prior_forbids_for_any_two_robots_is_refused(third: tuple[float, float]) -> None:
    """Robots 7 m apart may ask for it; two that are very near to each other or very far apart may not."""
    table = table_of(3, 1, sigma=0.05)
    table["mission"]["accuracy"] = 0.05
    table["mission"]["noise"] |= {"range_bias": 0.1, "gyro_bias": 1e-6}
    for robot, anchor in zip(table["robot"], ((0.0, 0.0), (7.0, 0.0), (3.5, 6.1)), strict=True):
        robot["anchor"] = list(anchor)
    validate(table, "group.toml")
    table["robot"][2]["anchor"] = list(third)
    with pytest.raises(Unworkable, match=r"mission\.accuracy: the prior noise"):
        validate(table, "group.toml")


@pytest.mark.parametrize("max_speed", [1.0, 0.005])
def test_the_gyros_that_a_refusal_asks_for_are_good_enough_and_can_be_had(max_speed: float) -> None:
    table = table_of(4, 1)
    table["mission"] |= {
        "max_speed": max_speed,
        "noise": {"anchor_sigma": 0.05, "mutual_sigma": 0.05},
        "accuracy": 0.3,
    }
    with pytest.raises(BadScenario) as refused:
        validate(table, "group.toml")
    asked = re.search(r"calibrate the gyros to (\S+) rad/s", str(refused.value))
    assert asked is not None
    assert float(asked[1]) > 0.0
    table["mission"]["noise"]["gyro_bias"] = float(asked[1])
    assert validate(table, "group.toml").scenario.meetings


def test_a_configuration_of_a_group_with_the_planner_paper_is_refused_in_one_line() -> None:
    config = msgspec.structs.replace(group_of(3, 1).config("r0"), planner_name="paper")
    with pytest.raises(UserError, match="robots with the planner paper meet in pairs, not in a group"):
        planner_of(config)


# --- visits -------------------------------------------------------------------------------------------


PLACES = st.tuples(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0))


@given(PLACES, st.floats(-math.pi, math.pi))
def test_a_visitor_reaches_its_place_by_a_turn_and_straights(
    place: tuple[float, float], heading: float
) -> None:
    pose = Pose(0.0, 0.0, heading)
    distance = math.hypot(*place)
    for _ in range(math.ceil(distance) + 4):
        controls = towards(place, pose, MISSION, 1e-9)
        if controls is None:
            break
        assert abs(controls.v) <= MISSION.max_speed * (1.0 + 1e-12)
        assert abs(controls.omega) <= MISSION.max_turn_rate * (1.0 + 1e-12)
        assert controls.v == 0.0 or controls.omega == 0.0
        pose = step(pose, controls.v, controls.omega, MISSION.period)
    assert math.hypot(pose.x - place[0], pose.y - place[1]) <= 1e-6


@given(
    st.integers(1, MOST_SIDES),
    st.floats(10.0 * R, 50.0 * R),
    st.floats(-1.0, 1.0),
    st.floats(0.0, 2.0 * math.pi),
)
@example(MOST_SIDES, 10.0 * R, 1.0, 0.0)
def test_a_search_passes_a_robot_within_range_wherever_an_error_of_the_heading_has_led(
    sides: int, way: float, share: float, bearing: float
) -> None:
    turned = share * (2.0 * (sides - 1) + 0.75) * R / way
    anchor = way * math.cos(bearing), way * math.sin(bearing)
    waits = way * math.cos(bearing + turned), way * math.sin(bearing + turned)
    short = 1.0 - SHORT_OF_ANCHOR * R / way
    mode = Travelling((short * anchor[0], short * anchor[1]))
    places = [mode.place]
    for _ in range(search_legs(sides)):
        mode = next_leg(mode, (0.0, 0.0), anchor, MISSION)
        places.append(mode.place)
    nearest = min(_distance(waits, one, other) for one, other in pairwise(places))
    assert nearest <= 0.85 * R


def test_the_ticks_of_a_search_are_those_of_its_legs() -> None:
    noisy = group_of(4, 1, sigma=0.05).mission
    way, short = 30.0 * R, (30.0 - SHORT_OF_ANCHOR) * R
    for sides in range(MOST_SIDES + 1):
        mode, pose, ticks = Travelling((short, 0.0)), Pose(short, 0.0, 0.0), 0
        for _ in range(search_legs(sides)):
            mode = next_leg(mode, (0.0, 0.0), (way, 0.0), noisy)
            while (controls := towards(mode.place, pose, noisy, 1e-9)) is not None:
                pose, ticks = step(pose, controls.v, controls.omega, noisy.period), ticks + 1
        assert ticks <= search_ticks(noisy, sides) <= 1.2 * ticks + 2


def _distance(target: tuple[float, float], one: tuple[float, float], other: tuple[float, float]) -> float:
    """Return the distance in m of `target` from the straight between two places."""
    (x, y), (ax, ay), (bx, by) = target, one, other
    length = (bx - ax) ** 2 + (by - ay) ** 2
    share = min(1.0, max(0.0, ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / length))
    return math.hypot(x - ax - share * (bx - ax), y - ay - share * (by - ay))


def test_pairs_are_no_group() -> None:
    table = table_of(4, 1)
    for i, peer in enumerate(("r1", "r0", "r3", "r2")):
        table["robot"][i]["peer"] = peer
    scenario = validate(table, "group.toml").seeded(None)
    assert scenario.meetings == ()
    assert scenario.radio_pairs() == ((0, 1), (2, 3))
    assert scenario.config("r0").others == ("r1",)
    assert replace(scenario, seed=1).pairs() == ((0, 1), (2, 3))


def test_a_robot_leaves_for_a_far_visit_only_with_an_accurate_heading() -> None:
    scenario = group_of(8, 16, sigma=0.05)
    for robot in scenario.robots:
        config = scenario.config(robot.id)
        if not config.visits:
            assert config.heading_accuracy == HEADING_ACCURACY
            continue
        begin = config.peer_anchor if config.role == "a" else config.anchor
        to = config.member(config.visits[0]).anchor
        aside = 3.0 * config.heading_accuracy * math.hypot(begin.x - to.x, begin.y - to.y)
        assert aside <= 3.75 * R * (1.0 + 1e-9)  # its search finds a robot nearly 4 R aside
        last = config.in_meeting(config.visits[-1], "a")
        assert last.heading_accuracy == HEADING_ACCURACY
