"""Groups with noisy sensors or dead robots: near anchors, meetings that contradict each other, and bounds."""

from __future__ import annotations

import math
import random
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from agent.estimation.gaussian.claim_agreement import difference
from agent.estimation.knowledge import Knowledge
from agent.peer.motion_log import MotionLog
from agent.planning import meetings
from agent.planning.group import GroupPlanner
from agent.planning.state import Fix, Other, RobotState
from compose.audit.rules import audit_run
from compose.errors import BadScenario, Unworkable
from compose.launch.in_process import run_mission
from compose.launch.planner_loader import planner_of
from compose.recording.corrected_bounds import corrected_bounds
from compose.recording.reasons import reason_for
from compose.recording.recording_files import WORLD_JOURNAL, agent_journal
from compose.recording.run import Run, read
from compose.recording.summary_json import summary
from compose.scenario.group_meetings import ALLOWED_SIDES
from compose.scenario.scenario_change import file_table
from compose.scenario.scenario_file import load, parse, scenario_table, validate
from compose.terminal.progress import result
from protocol.messages import Localised, Undecided
from protocol.mission import Mission
from protocol.motion import ORIGIN, Covariance, Pose, compose, inverse, step
from protocol.noise import Noise, VelocityNoise
from protocol.orbits import SEARCH_SIDES, meeting_ticks, search_ticks
from tests.commands import SECTION_IV, anchored
from tests.commands import tandem as tandem_command
from tests.groups import SIGMA, R, group_of, localised, random_group, table_of
from tests.series import series
from world.faults import EXCHANGED, IN_TURN, Fault, exchange_ticks
from world.scenario import Death, Scenario
from world.tick import World, advance

TURNED = {"kind": "rotate", "part": "orbit", "size": math.radians(15.0)}
"""False reports that pass the first meeting of r3 in the group of `attacked`."""


# --- robots with nearly the same anchor ---------------------------------------------------------------


def with_near_anchors(robots: int, seed: int, apart: float, *, sigma: float = SIGMA) -> Scenario:
    """Return a group whose first two anchors are `apart` m from each other."""
    table = table_of(robots, seed, sigma=sigma)
    x, y = table["robot"][0]["anchor"]
    table["robot"][1]["anchor"] = [x + apart, y]
    return validate(table, "group.toml").seeded(None)


@pytest.mark.parametrize("robots", [3, 5, 14])
def test_no_two_robots_with_nearly_the_same_anchor_are_planned_to_meet_under_noise(robots: int) -> None:
    planned, exact = (with_near_anchors(robots, 1, 0.03, sigma=sigma).meetings for sigma in (SIGMA, 0.0))
    near = {"r0", "r1"}
    assert near not in [{one.visitor, one.visited} for one in planned]
    assert near in [{one.visitor, one.visited} for one in exact]
    assert {one.visitor for one in planned} | {one.visited for one in planned} == {
        f"r{i}" for i in range(robots)
    }


def test_a_noisy_group_with_two_robots_beside_nearly_the_same_anchor_is_localised_in_time() -> None:
    scenario = with_near_anchors(3, 1, 0.03)
    run = run_mission(scenario)
    assert localised(run) == {"r0", "r1", "r2"}
    assert run.end is not None
    assert run.end.outcome == "localised"
    assert run.end.tick <= scenario.meetings[-1].ends


def test_a_noisy_group_whose_anchors_are_all_at_one_place_is_refused_in_one_line() -> None:
    table = table_of(3, 1, sigma=SIGMA)
    for i, robot in enumerate(table["robot"]):
        robot["anchor"] = [0.01 * i, 0.0]
    with pytest.raises(Unworkable, match=r"robot\.anchor: no two anchors are 0\.15 m apart") as refusal:
        validate(table, "group.toml")
    assert "\n" not in str(refusal.value)


# --- claims that a later meeting contradicts ----------------------------------------------------------


def attacked() -> Scenario:
    """Return a group whose attacker r1 turns the path of its visit to r3 by 15 degrees; r3 then visits r2."""
    return random_group(120, robots=3, attack=TURNED)


def test_a_claim_that_a_later_meeting_contradicts_is_withdrawn_and_no_claim_is_wrong(tmp_path: Path) -> None:
    run_mission(attacked(), tmp_path)
    run = read(tmp_path)
    assert audit_run(run).violations == ()
    assert run.end is not None
    assert run.end.outcome == "undecided"
    assert "r3: r1 and r2 contradict each other" in str(reason_for(run.end))
    assert localised(run) == {"r1", "r2"}
    commands = [command for tick in run.ticks if (command := tick.commands.get("r3")) is not None]
    assert any(isinstance(one.verdict, Localised) for one in commands), "it claimed what was wrong"
    assert isinstance(commands[-1].verdict, Undecided)


SMALL = Covariance(0.01, 0.0, 0.0, 0.01, 0.0, 0.01)
"""The covariance of a claim: sigmas of 0.1 m and 0.1 rad."""


def after_meetings(agreeing: tuple[str, ...]) -> RobotState:
    """Return the state of r0 in a meeting with r1, if those with `agreeing` have given the same pose."""
    config = group_of(5, 1, sigma=SIGMA).config("r0")
    planner = planner_of(config)
    assert isinstance(planner, GroupPlanner)
    state = planner.start(config.in_meeting("r1", "a"))
    claim = Localised(ORIGIN, SMALL)
    return replace(state, robot_verdict=claim, fix=Fix(Knowledge(state.config, 0), claim, agreeing))


def test_a_pose_on_which_two_meetings_agree_stays_and_the_third_peer_is_not_met_again() -> None:
    state = after_meetings(("r2", "r3"))
    after = meetings.with_pose(state, Localised(Pose(0.0, 0.0, 2.0), SMALL))
    assert (after.robot_verdict, after.fix) == (state.robot_verdict, state.fix)
    assert after.frame == state.frame
    assert after.other("r1").failed


def test_a_pose_from_one_meeting_is_withdrawn_with_both_peers_if_the_next_contradicts_it() -> None:
    state = after_meetings(("r2",))
    after = meetings.with_pose(state, Localised(Pose(0.0, 0.0, 2.0), SMALL))
    assert (after.robot_verdict, after.fix) == (None, None)
    assert isinstance(after.failure, Undecided)
    assert after.failure.reason.startswith("r2 and r1 contradict each other")
    assert after.other("r2") == Other(failed=True)


def test_a_meeting_that_agrees_changes_no_claim() -> None:
    state = after_meetings(("r2",))
    after = meetings.with_pose(state, Localised(Pose(0.1, -0.1, 0.1), SMALL))
    assert after.robot_verdict == state.robot_verdict
    assert after.fix is not None
    assert after.fix.peers == ("r2", "r1")


def test_the_p_values_of_right_claims_are_uniform_or_larger() -> None:
    noise = Noise(
        anchor_sigma=SIGMA, gyro_bias=0.002, odometry=VelocityNoise(v=0.05, omega=0.05, omega_floor=0.01)
    )
    mission = Mission(R, 1.0, 1.0, math.pi, noise=noise)
    rng, values = np.random.default_rng(1), []
    v, omega = np.full(40, 0.8), np.tile((0.3, 0.0, -0.2, 0.1), 10)
    for _ in range(400):
        log, truth, begin, bias = MotionLog(), Pose(3.0, -2.0, 1.0), 8, 0.002 * rng.standard_normal()
        poses = [truth]
        for one, turn in zip(v, omega, strict=True):
            truth = step(truth, one, turn, 1.0)
            poses.append(truth)
            measured_v = one * (1.0 + 0.05 * rng.standard_normal())
            spread = math.hypot(0.05 * turn, 0.01)
            log = log.drove(measured_v, turn + bias + spread * rng.standard_normal())
        claims = []
        for tick in (begin, 40):
            x, y, heading = rng.standard_normal(3) * 0.1
            claims.append(
                Localised(Pose(poses[tick].x + x, poses[tick].y + y, poses[tick].heading + heading), SMALL)
            )
        values.append(difference(claims[0], begin, claims[1], 40, log, mission).p_value)
    for bound in (0.02, 0.1, 0.5):
        share = sum(value <= bound for value in values) / len(values)
        assert share <= bound + 3.0 * math.sqrt(bound * (1.0 - bound) / len(values))
        assert share >= 0.3 * bound


def test_an_error_of_the_earlier_heading_alone_explains_a_far_pose() -> None:
    mission = Mission(R, 1.0, 1.0, math.pi, noise=Noise(anchor_sigma=SIGMA))
    log, odometry = MotionLog(), ORIGIN
    for _ in range(30):
        log, odometry = log.drove(1.0, 0.0), step(odometry, 1.0, 0.0, 1.0)
    turned = Pose(0.0, 0.0, 0.1)  # one sigma
    now = compose(turned, compose(inverse(ORIGIN), odometry))
    found = difference(Localised(ORIGIN, SMALL), 0, Localised(now, SMALL), 30, log, mission)
    assert found.position == pytest.approx(30.0 * 2.0 * math.sin(0.05))
    assert found.heading == pytest.approx(0.1)
    assert found.p_value > 0.5
    assert (
        difference(
            Localised(ORIGIN, SMALL), 0, Localised(replace(now, heading=-0.5), SMALL), 30, log, mission
        ).p_value
        < 1e-4
    )


# --- bounds -------------------------------------------------------------------------------------------


def test_the_bound_of_a_meeting_allows_for_reports_that_are_received_with_its_probability() -> None:
    assert exchange_ticks([]) == (0, 0)
    assert exchange_ticks([Fault(duplicate=0.5)]) == (0, 0)
    ticks, once = exchange_ticks([Fault(loss=0.9)])
    assert once == 0
    rng = np.random.default_rng(1)
    waits = rng.geometric(0.1, (20_000, IN_TURN)).sum(1)
    assert np.mean(waits <= ticks + IN_TURN) == pytest.approx(EXCHANGED, abs=0.003)


@pytest.mark.parametrize(
    ("fault", "delays"),
    [
        (Fault(delay=(0, 20)), (20 * IN_TURN, 0)),
        (Fault(reorder=0.1), (IN_TURN, 0)),
        (Fault(partition=True, ticks=(10, 60)), (0, 50)),
        (Fault(loss=1.0, contact_ticks=(0, 7)), (7, 0)),
        (Fault(partition=True), (0, 0)),
    ],
)
def test_delays_and_windows_without_any_delivery_are_in_the_bound(
    fault: Fault, delays: tuple[int, int]
) -> None:
    assert exchange_ticks([fault]) == delays


def test_loss_makes_each_bound_of_a_plan_later_and_changes_no_meeting() -> None:
    table = table_of(8, 1)
    plain = validate(table, "group.toml").seeded(None)
    lossy = validate(table | {"fault": [{"loss": 0.9}]}, "group.toml").seeded(None)
    each, _ = exchange_ticks(lossy.faults)
    ends = {(one.visitor, one.visited): one.ends for one in plain.meetings}
    assert {(one.visitor, one.visited) for one in lossy.meetings} == ends.keys()
    for one in lossy.meetings:
        later = one.ends - ends[one.visitor, one.visited]
        assert later >= each
        assert later == pytest.approx(each * round(later / each))


@pytest.mark.parametrize("seed", [5, 19, 22])
def test_groups_of_sixteen_that_lose_nine_of_ten_reports_are_localised_within_the_bound(seed: int) -> None:
    table = table_of(16, seed) | {"fault": [{"loss": 0.9}]}
    scenario = validate(table, "group.toml").seeded(None)
    run = run_mission(scenario)
    claims = [claim.tick for robot in run.robots if (claim := run.claim(robot)) is not None]
    assert len(claims) == 16
    assert max(claims) <= scenario.meetings[-1].ends


def test_the_bound_of_a_visit_under_noise_allows_for_a_search() -> None:
    exact, noisy = (group_of(4, 1, sigma=sigma) for sigma in (0.0, SIGMA))
    assert search_ticks(exact.mission, SEARCH_SIDES) == 0
    firsts = [one for one in noisy.meetings if one.ends == noisy.meetings[0].ends]
    assert firsts
    visits = [one for one in noisy.meetings if one.visited not in (noisy.meetings[0].visitor,)][1:]
    least = meeting_ticks(noisy.mission) + search_ticks(noisy.mission, ALLOWED_SIDES)
    assert noisy.meetings[-1].ends >= noisy.meetings[0].ends + least
    assert visits


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "visitor"),
    [(6601513976186210778, "r1"), (4918257111182012597, "r9")],
    ids=["it loses the robot at the edge of its range", "its heading is off by 0.15 rad"],
)
def test_a_visitor_searches_where_an_error_of_its_heading_leads(seed: int, visitor: str) -> None:
    """On a square spiral, or by its own anchor, it found the other robot after 385 and 600 ticks."""
    scenario = random_group(seed, robots=16)
    run = run_mission(scenario)
    claims = [claim.tick for robot in run.robots if (claim := run.claim(robot)) is not None]
    assert len(claims) == 16
    assert max(claims) <= 0.7 * scenario.meetings[-1].ends
    commands = [command for tick in run.ticks if (command := tick.commands.get(visitor)) is not None]
    states = {command.task for command in commands if isinstance(command.verdict, Localised)}
    assert "travelling" in states
    assert "homing" not in states


FOUR = f"""
name = "four"
seed = 1
{SECTION_IV}
[[robot]]
id = "a"
anchor = [0.0, 0.0]
dies = 20
{anchored(b=(10.0, 3.0), c=(-4.0, 9.0), d=(5.0, -12.0))}
"""
"""A group in which a should meet d first."""


@pytest.fixture(scope="module")
def four() -> Run:
    """Return the run of FOUR."""
    return run_mission(parse(FOUR, "four"))


def with_death(scenario: Scenario, robot: str, tick: int) -> Scenario:
    return replace(scenario, deaths=(Death(robot, tick),))


# --- the world ----------------------------------------------------------------------------------------


def test_a_dead_robot_stands_still_and_measures_and_receives_nothing(four: Run) -> None:
    path = four.truth("a")
    assert path[18] != path[19]
    assert set(path[20:]) == {path[20]}
    for observations in four.observations[20:]:
        own = observations["a"]
        assert own.anchor_range is None
        assert own.contacts == ()
        assert all(contact.peer != "a" for one in observations.values() for contact in one.contacts)


def test_the_outcome_names_the_dead_robot_once_the_others_are_localised(four: Run) -> None:
    assert localised(four) == {"b", "c", "d"}
    assert four.end is not None
    assert (four.end.outcome, reason_for(four.end)) == ("undecided", "a is dead from tick 20 on")


def test_a_verdict_of_a_dead_robot_does_not_count(four: Run) -> None:
    tick = four.ticks[30]
    given = replace(tick.commands["a"], verdict=Undecided("too late"))
    after = advance(tick.world, {**tick.commands, "a": given})
    assert isinstance(after, World)
    assert "a" not in after.verdicts


def test_a_robot_that_dies_after_its_claim_is_localised() -> None:
    scenario = group_of(4, 1)
    claim = run_mission(scenario).claim("r0")
    assert claim is not None
    run = run_mission(with_death(scenario, "r0", claim.tick + 1))
    assert "r0" in localised(run)


def test_a_scenario_with_a_death_is_written_and_read_again() -> None:
    scenario = parse(FOUR, "four")
    assert scenario.deaths == (Death("a", 20),)
    assert validate(file_table(scenario), "again").scenario == scenario


def test_robots_die_in_groups_only() -> None:
    table: dict[str, Any] = scenario_table("paper-1")
    table["robot"][0]["dies"] = 3
    with pytest.raises(BadScenario, match=r"robot\[0\]\.dies: robots die in groups and teams only"):
        validate(table, "it")


def test_the_tick_in_which_a_robot_of_a_drawn_group_dies_follows_from_the_seed() -> None:
    table = scenario_table("random-group")
    table["group"] = table["group"] | {"dies": [5, 50]}
    template = validate(table, "it")
    found = [template.seeded(seed).deaths for seed in (1, 2, 3, 1)]
    assert found[0] == found[3]
    assert len(set(found)) > 1
    for (death,) in found:
        assert death.robot == "r2"
        assert 5 <= death.tick <= 50


# --- the others ---------------------------------------------------------------------------------------


CASES = [(3, 2), (4, 4), (6, 26), (6, 33), (4, 17), (3, 18), (6, 19), (8, 3), (4, 36), (3, 26), (16, 1)]
"""Groups in which robots orbited in vain, or stood out on their orbits, before they waited at home."""


@pytest.mark.parametrize("group", series(CASES, 3))
def test_all_others_are_localised_within_the_corrected_bound(group: tuple[int, int]) -> None:
    scenario, draw = group_of(*group), random.Random(group[1])
    dead = f"r{draw.randrange(group[0])}"
    run = run_mission(with_death(scenario, dead, draw.randrange(80)))
    assert localised(run) >= set(run.robots) - {dead}
    last = max(claim.tick for robot in run.robots if (claim := run.claim(robot)) is not None)
    corrected = corrected_bounds(run)
    planned = scenario.meetings[-1].ends / scenario.mission.period
    assert last <= max([planned, *[one.bound_ticks for one in corrected]])
    if last > planned:
        assert corrected


@pytest.mark.long
@pytest.mark.parametrize(("robots", "seed"), [(4, 2190611898021423449), (8, 4689520878616184904)])
def test_all_others_are_localised_where_a_robot_meets_the_same_one_twice_under_noise(
    robots: int, seed: int
) -> None:
    """In the second meeting, it did not receive the log from its beginning, and both waited for ever."""
    run = run_mission(random_group(seed, robots=robots, dies=[0, 80]))
    (dead,) = run.scenario.deaths
    assert localised(run) >= set(run.robots) - {dead.robot}


def test_bounds_are_corrected_when_a_robot_is_late_by_what_is_known_then(four: Run) -> None:
    (only,) = corrected_bounds(four)
    ends = {one.robot: one.ends for one in four.scenario.members}
    assert only.tick == min(ends["a"], ends["d"]) + 1
    assert set(only.late) <= {"a", "d"}
    assert only.bound_ticks > max(ends.values())
    known = replace(four, world=replace(four.history, ticks=four.ticks[: only.tick + 2]))
    assert corrected_bounds(known) == (only,)


def test_the_bound_is_corrected_again_when_the_next_pair_could_not_localise_itself() -> None:
    run = run_mission(with_death(group_of(3, 2), "r0", 11))
    first, *others = corrected_bounds(run)
    assert others
    for one, other in pairwise((first, *others)):
        assert one.tick < other.tick
        assert one.bound_ticks < other.bound_ticks


def test_no_bound_is_corrected_where_no_robot_is_late() -> None:
    assert corrected_bounds(run_mission(group_of(8, 1))) == ()
    assert corrected_bounds(run_mission(load("paper-1"))) == ()


def test_the_bound_is_corrected_when_the_localised_robot_is_an_attacker_and_no_help() -> None:
    attack = {"kind": "scale", "size": 0.5, "part": "encounter"}
    run = run_mission(group_of(3, 1, attacker=0, attack=attack))
    corrected = corrected_bounds(run)
    honest = [claim.tick for robot in ("r1", "r2") if (claim := run.claim(robot)) is not None]
    assert len(honest) == 2
    assert min(one.bound_ticks for one in corrected) < max(honest) <= corrected[-1].bound_ticks
    for one, other in pairwise(corrected):
        assert other.tick <= one.bound_ticks + 1


# --- results ------------------------------------------------------------------------------------------


def test_the_corrected_bound_is_shown_with_the_result(four: Run, capsys: pytest.CaptureFixture[str]) -> None:
    found = summary(four, None, None)
    (only,) = corrected_bounds(four)
    assert found["group"]["corrected_bounds"] == [
        {"tick": only.tick, "late": only.late, "bound_ticks": only.bound_ticks}
    ]
    assert found["group"]["deaths"] == {"a": 20}
    result(found)
    shown, were = " ".join(capsys.readouterr().out.split()), "was" if len(only.late) == 1 else "were"
    assert "all robots but a were localised by tick" in shown
    assert (
        f"corrected in tick {only.tick} to {only.bound_ticks}, as {', '.join(only.late)} {were} late" in shown
    )


@pytest.mark.long
def test_a_death_is_the_same_as_processes_and_in_one_and_the_audit_is_clean(
    tmp_path: Path, four: Run
) -> None:
    (tmp_path / "four.toml").write_text(FOUR)
    ended = tandem_command("run", "four.toml", "--out", "recording", cwd=tmp_path)
    assert ended.status == 1
    run_mission(parse(FOUR, "four"), tmp_path / "again")
    names = [WORLD_JOURNAL, *[agent_journal(robot) for robot in four.robots]]
    for name in names:
        assert (tmp_path / "recording" / name).read_bytes() == (tmp_path / "again" / name).read_bytes()
    assert audit_run(read(tmp_path / "recording", audited=True)).violations == ()
