"""Groups with robots without an anchor: they are found, localised, recorded, checked and shown."""

from __future__ import annotations

import json
import math
import random
import time
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from playwright.sync_api import expect

from agent.planning.coverage import second_half, strips, without_strips
from agent.planning.group import GroupPlanner
from agent.planning.state import RobotState
from agent.planning.tasks import Covering, Looping
from agent.planning.unanchored import UnanchoredPlanner
from compose.audit.rules import audit_run, replayed
from compose.errors import UserError
from compose.launch.in_process import run_mission
from compose.recording.corrected_bounds import corrected_bounds
from compose.recording.reasons import reason_for
from compose.recording.recording_files import agent_journal
from compose.recording.run import Run, of_frames, read
from compose.scenario.scenario_file import load, parse, scenario_table, validate
from compose.sweep.hunt.invariants import truth_lost
from protocol.coverage_strips import SweptArea
from protocol.journal.journal_file import CorruptJournal
from protocol.messages import Command, Contact, Localised, Observation, Report, ReportedPose, TickStart
from protocol.motion import ORIGIN, REST, Controls, Pose, step
from protocol.wire import decode, encode
from tests.browser import Open, scrub_to, shot, watching
from tests.commands import tandem as tandem_command
from tests.groups import R, localised, table_of, with_value
from tests.missions import kept, outcome
from tests.test_group_runs import audited, with_scenario
from world.hardware.driver import Reading
from world.hardware.measurements import observation_frame
from world.hardware.termination import Ending
from world.scenario import Scenario

AREA = [-4.0, -4.0, 14.0, 12.0]


def table_with(robots: int, unanchored: int, seed: int) -> dict[str, Any]:
    """Return a scenario file of `robots` in a square, the last `unanchored` of which have no anchor."""
    table = table_of(robots, seed)
    for robot in table["robot"][robots - unanchored :]:
        del robot["anchor"]
    side = 10.0 * R * robots**0.5
    table["mission"]["area"] = [0.0, 0.0, side, side]
    return table


def four(**fields: Any) -> dict[str, Any]:
    """Return a scenario file of four near robots, two of which have no anchor, with other `fields`."""
    table = table_with(4, 2, 1)
    table["mission"]["area"] = AREA
    table["robot"] = [
        {"id": "a", "anchor": [0.0, 0.0]},
        {"id": "b", "anchor": [10.0, 3.0]},
        {"id": "u"},
        {"id": "v"},
    ]
    return {**table, **fields}


def scenario_of(table: dict[str, Any]) -> Scenario:
    return validate(table, "group.toml").seeded(None)


def last_claim(run: Run) -> int:
    """Return the tick of the last claim. All robots must have one."""
    claims = [run.claim(robot) for robot in run.robots]
    return max([one.tick for one in claims if one is not None])


def bound(scenario: Scenario) -> float:
    """Return the bound in ticks until all robots are localised."""
    assert scenario.planned_sweep is not None
    return scenario.planned_sweep.ends / scenario.mission.period


# --- localisation -------------------------------------------------------------------------------------


def test_robots_without_an_anchor_are_localised_within_the_bound() -> None:
    scenario = scenario_of(four())
    run = run_mission(scenario)
    assert localised(run) == {"a", "b", "u", "v"}
    assert outcome(run) == "localised"
    assert last_claim(run) <= bound(scenario)
    for robot in scenario.unanchored:
        claim = run.claim(robot)
        assert claim is not None
        assert max(claim.position_error, claim.heading_error) < 1e-9


@pytest.mark.long
@pytest.mark.parametrize(("robots", "unanchored"), [(4, 1), (4, 2), (8, 4), (8, 6)])
def test_random_groups_are_localised_within_the_bound(robots: int, unanchored: int) -> None:
    for seed in range(4):
        scenario = scenario_of(table_with(robots, unanchored, seed))
        run = run_mission(scenario)
        assert len(localised(run)) == robots
        assert last_claim(run) <= bound(scenario)


def test_a_robot_that_does_not_hear_its_finder_is_localised_by_another_one() -> None:
    deaf = [{"link": "a->u", "loss": 1.0}, {"link": "a->v", "loss": 1.0}]
    run = of_frames(kept(scenario_of(four(fault=deaf))))
    assert len(localised(run)) == 4
    reports = [
        framed.report
        for robot in ("u", "v")
        for one in run.agents[robot].steps
        for framed in one.received
        if framed.report.prior is not None
    ]
    assert "a" not in {one.robot for one in reports}


@pytest.mark.parametrize(("seed", "late"), [(12, ("r3",)), (38, ("r4",))])
def test_the_part_of_a_dead_finder_is_swept_by_others_within_the_corrected_bound(
    seed: int, late: tuple[str, ...]
) -> None:
    table = table_with(6, 3, seed)
    table["robot"][0]["dies"] = 150
    run = run_mission(scenario_of(table))
    assert len(localised(run)) == 6
    (corrected,) = corrected_bounds(run)
    assert corrected.late == late
    assert bound(run.scenario) < last_claim(run) <= corrected.bound_ticks


def finders(run: Run, robot: str) -> set[str]:
    """Return the robots whose poses `robot` has received."""
    received = [framed.report for one in run.agents[robot].steps for framed in one.received]
    return {report.robot for report in received if report.prior is not None}


def test_a_robot_that_was_found_finds_others() -> None:
    run = of_frames(kept(scenario_of(table_with(8, 6, 3))))
    robots = set(run.scenario.unanchored)
    assert len(localised(run)) == 8
    assert any(finders(run, robot) and finders(run, robot) <= robots for robot in robots)


@given(st.integers(0, 30), st.integers(1, 30), st.integers(1, 7))
def test_a_finder_and_the_robot_that_it_has_found_sweep_each_strip_once(
    first: int, more: int, parts: int
) -> None:
    area, ends = SweptArea(0.0, 0.0, 300.0, 300.0, parts), (first, first + more)
    config = replace(scenario_of(four()).config("u"), sweep=area)
    whole = area.path(ends, R)
    finder = RobotState(config, task=Covering(whole), strips_end=ends[1])
    told = strips(finder)
    assert told == ends
    beyond = (first, area.strips(R) + more)
    assert second_half(RobotState(config), beyond) == RobotState(config)
    for others in (beyond, (ends[1], ends[1]), (ends[1] + 3, ends[1]), ends):  # a peer may report anything
        assert without_strips(finder, others) == finder
    stopped = finder.doing(
        Looping((), ((0.0, 0.0), (0.0, 1.0), *whole))
    )  # on its way back to the first strip
    assert strips(stopped) == ends
    found = second_half(RobotState(config), told)
    left = without_strips(finder, strips(found))
    assert isinstance(left.task, Covering)
    taken = found.task.then[1:] if isinstance(found.task, Looping) else ()
    assert left.task.places + taken == whole
    assert len(taken) == 2 * (more // 2)


def test_the_strips_of_a_robot_that_dies_there_are_swept_by_others() -> None:
    table = table_with(8, 6, 3)
    before = run_mission(scenario_of(table))
    claims = {robot: claim.tick for robot in before.scenario.unanchored if (claim := before.claim(robot))}
    first = min(claims, key=claims.__getitem__)
    command = before.command(first, claims[first] + 20)
    assert command is not None
    assert command.task == "sweeping"
    next(one for one in table["robot"] if one["id"] == first)["dies"] = claims[first] + 20
    run = run_mission(scenario_of(table))
    assert len(localised(run)) == 8
    assert last_claim(run) > last_claim(before)


@pytest.mark.parametrize("fault", [{"loss": 0.8}, {"delay": 20}], ids=["loss", "delay"])
def test_lost_and_late_reports_only_cost_time(fault: dict[str, Any]) -> None:
    run = run_mission(scenario_of(four(fault=[fault])))
    assert len(localised(run)) == 4


def test_a_range_from_where_a_square_ends_tells_no_heading() -> None:
    """The first report from after the square is of a tick in which the robot was back."""
    faults = [{"delay": [5, 10]}, {}, {}, {"corrupt": 0.4}, {"delay": [6, 10], "contact_ticks": [1, 31]}]
    group = {"robots": 4, "spacing": 6.930000000000001, "without_anchor": 1}
    table = {**scenario_table("random-group"), "seed": 201761783, "group": group, "fault": faults}
    run = of_frames(kept(scenario_of(table)))
    assert len(localised(run)) == 4
    assert not list(truth_lost(run))


def test_reports_in_another_order_lead_to_the_same_claim_to_the_bit() -> None:
    agent = of_frames(kept(scenario_of(four()))).agents["u"]
    planner = GroupPlanner(UnanchoredPlanner())
    observed = planner.start(agent.config)
    reports: list[Report] = []
    for one_step in agent.steps:
        observed = planner.observe(observed, one_step.observation)
        reports += [one.report for one in one_step.received if one.report.prior is not None]
        if one_step.command is not None and one_step.command.verdict is not None:
            break
    *early, last = reports
    claims = []
    for seed in range(100):
        random.Random(seed).shuffle(early)
        state = planner.decide(planner.decide(observed, [*early, *early]), [last])
        claims.append(state.robot_verdict)
    assert isinstance(claims[0], Localised)
    assert claims == claims[:1] * 100


def test_a_robot_that_a_passing_one_has_left_on_a_square_is_localised_by_the_next_one() -> None:
    """The odometry of the robot then differs from where it stood first, by rounding."""
    scenario = scenario_of(four())
    config, planner = scenario.config("u"), GroupPlanner(UnanchoredPlanner())
    pose, state, tick = Pose(5.0, 4.0, 0.7), planner.start(config), 0
    driven: Controls | None = None
    square = [(0.0, 0.0), (0.5, 0.0), (0.5, 0.5), (0.0, 0.5)]
    ways = [("a", square), (None, [(0.0, 0.0)] * 150), ("b", square * 4)]
    for finder, way in ways:
        for x, y in way:
            range_ = math.hypot(6.0 + x - pose.x, 5.0 + y - pose.y)
            contacts = (Contact(finder, range_, (tick,)),) if finder is not None else ()
            state = planner.observe(state, Observation(tick, "u", driven, None, contacts))
            prior = ReportedPose(tick, Pose(6.0 + x, 5.0 + y, 0.0))
            report = Report(tick, finder or "a", 2, "sweeping", prior=prior)
            state = planner.decide(state, [report] if finder is not None else [])
            command = planner.command(state)
            driven = Controls(command.v, command.omega)
            if isinstance(command.verdict, Localised):
                assert finder == "b"
                assert math.dist((command.verdict.pose.x, command.verdict.pose.y), (pose.x, pose.y)) < 1e-9
                return
            pose, tick = step(pose, driven.v, driven.omega, 1.0), tick + 1
        if finder == "a":
            assert command.task == "looping"
    raise AssertionError("it was not localised")


# --- the scenario -------------------------------------------------------------------------------------


def test_the_configuration_of_a_robot_without_an_anchor_does_not_depend_on_where_it_is() -> None:
    scenario = scenario_of(four())
    config = scenario.config("u")
    assert config.given_anchor is None
    moved = [replace(one, start=Pose(1.0, 1.0, 0.0)) if one.id == "u" else one for one in scenario.robots]
    assert replace(scenario, robots=tuple(moved)).config("u") == config


def test_the_starts_of_robots_without_an_anchor_are_drawn_in_the_area() -> None:
    template = validate(four(), "group.toml")
    starts = [template.seeded(seed).robot("u").start for seed in range(200)]
    assert all(-4.0 <= one.x <= 14.0 and -4.0 <= one.y <= 12.0 for one in starts)
    assert max(one.x for one in starts) > 12.0
    assert min(one.y for one in starts) < -2.0


def test_the_last_robots_of_a_drawn_group_have_no_anchor() -> None:
    table = four(group={"robots": 5, "spacing": 10.0, "without_anchor": 2})
    del table["robot"], table["mission"]["area"]
    scenario = scenario_of(table)
    assert scenario.unanchored == ("r4", "r5")
    assert scenario.planned_sweep is not None
    assert scenario.planned_sweep.sweep.x_max == pytest.approx(10.0 * math.sqrt(5))


REFUSED: dict[str, tuple[str, Any]] = {
    r"robot\[1\]: missing field 'anchor': at least two robots of a group need one": ("robot.1.anchor", None),
    r"mission: missing field 'area'": ("mission.area", None),
    r"mission.area: it must be \[x_min, y_min, x_max, y_max\]": ("mission.area", [3.0, 0.0, 2.0, 1.0]),
    r"mission.safety_distance: there is a robot without an anchor": ("mission.safety_distance", 0.3),
    r"robot\[0\].attack: there is a robot without an": ("robot.0.attack", {"kind": "scale", "size": 1.1}),
    r"robot\[3\].start: 'v' is outside mission.area": ("robot.3.start", [20.0, 0.0, 0.0]),
    r"mission.area: with 2.82843e\+06 m between": ("mission.area", [-1e6, -1e6, 1e6, 1e6]),
}
"""Values that are refused, and the place of each in the file, by the reason."""


@pytest.mark.parametrize("message", REFUSED)
def test_what_cannot_be_localised_is_refused_in_one_line(message: str) -> None:
    with pytest.raises(UserError, match=f"^group.toml: {message}"):
        scenario_of(with_value(four(), *REFUSED[message]))


def test_an_area_with_swapped_corners_is_refused_where_all_robots_have_an_anchor_too() -> None:
    table = four(group={"robots": 4, "spacing": 10.0})
    del table["robot"]
    table["mission"]["area"] = [3.0, 0.0, 2.0, 1.0]
    with pytest.raises(UserError, match=r"^group.toml: mission.area: it must be \[x_min"):
        scenario_of(table)


def test_check_driver_refuses_a_robot_without_an_anchor(tmp_path: Path) -> None:
    scenario = tmp_path / "four.toml"
    scenario.write_text(FILE, encoding="utf-8")
    refused = tandem_command("check-driver", "docs.rover:Rover", "--mission", scenario, "--robot", "u")
    assert refused.status == 2
    assert "--robot: u has no anchor of its own, and the checks need ranges to one" in refused.err


def test_a_driver_may_report_the_range_to_an_anchor_that_its_robot_does_not_have() -> None:
    frame = observation_frame(Reading(REST, 1.0), 3, scenario_of(four()).config("u"))
    assert decode(frame, Observation).anchor_range is None


def given_up_after(scenario: Scenario) -> int:
    """Return the tick in which a stops waiting for u, which has sent nothing in hardware mode."""
    ending = Ending(scenario.config("a"), scenario.max_ticks, 0.0, time.monotonic)
    for robot in "bv":
        ending.receive(TickStart(1, robot, Localised(ORIGIN), complete=True))
    localised = Localised(ORIGIN)
    tick = 0
    while (end := ending.after(tick, Command(tick, "a", 0.0, 0.0, 3, "sweeping", localised))) is None:
        tick += 1
        ending.tick_start(tick)
    assert reason_for(end) == "a is localised; no result of u received"
    return end.tick


@pytest.mark.parametrize("noise", [None, {"anchor_sigma": 0.05, "mutual_sigma": 0.05, "gyro_bias": 0.0002}])
def test_a_silent_robot_without_an_anchor_is_given_up_after_the_area_is_swept(noise: Any) -> None:
    table = four()
    if noise is not None:
        table["mission"] |= {"noise": noise, "accuracy": 0.3}
    scenario = scenario_of(table)
    assert 2.0 * bound(scenario) < given_up_after(scenario) < scenario.max_ticks


def test_a_robot_of_a_pair_needs_an_anchor() -> None:
    table = four()
    table["robot"] = table["robot"][1:3]
    with pytest.raises(UserError, match=r"^group.toml: robot\[1\]: missing field 'anchor'$"):
        scenario_of(table)


# --- recordings ---------------------------------------------------------------------------------------

FILE = tomli_w.dumps(four(name="four"))


def test_the_audit_and_the_replay_find_nothing_where_nothing_is_wrong(tmp_path: Path) -> None:
    run_mission(parse(FILE, "four"), tmp_path)
    assert audit_run(read(tmp_path)).violations == ()
    assert replayed(read(tmp_path)).differences == ()


def _with_pose(frames: list[bytes]) -> list[int]:
    """Return the places of the reports with a pose."""
    reports = [(i, decode(frame, Report)) for i, frame in enumerate(frames) if b"\xa6report" in frame]
    return [i for i, report in reports if report.prior is not None]


def test_the_audit_finds_a_reported_pose_that_is_not_the_computed_one() -> None:
    journals = kept(parse(FILE, "four"))
    finder = next(robot for robot in ("a", "b") if _with_pose(journals[agent_journal(robot)]))
    frames = journals[agent_journal(finder)]
    place = _with_pose(frames)[0]
    report = decode(frames[place], Report)
    assert report.prior is not None
    pose = replace(report.prior.pose, x=report.prior.pose.x + 0.5)
    frames[place] = encode(replace(report, prior=replace(report.prior, pose=pose)))
    assert (report.tick, finder, "decision") in audited(journals)


def test_the_audit_finds_a_sweep_that_is_not_the_planned_one() -> None:
    journals = kept(parse(FILE, "four"))
    scenario = of_frames(journals).scenario
    assert scenario.planned_sweep is not None
    later = replace(scenario.planned_sweep, ends=scenario.planned_sweep.ends + 1.0)
    found = audited(with_scenario(journals, replace(scenario, planned_sweep=later)))
    assert (None, None, "scenario") in found
    away = [replace(one, start=Pose(90.0, 0.0, 0.0)) if one.id == "u" else one for one in scenario.robots]
    found = audited(with_scenario(journals, replace(scenario, robots=tuple(away))))
    assert (None, None, "scenario") in found


def test_a_recording_whose_searching_robots_are_not_those_with_an_anchor_is_refused() -> None:
    journals = kept(parse(FILE, "four"))
    scenario = of_frames(journals).scenario
    assert scenario.planned_sweep is not None
    for planned in (None, replace(scenario.planned_sweep, sweepers=("a", "u"))):
        with pytest.raises(CorruptJournal, match="the robots that search are not those with an anchor"):
            of_frames(with_scenario(journals, replace(scenario, planned_sweep=planned)))
    pair = load("paper-1")
    lacking = tuple([replace(one, given_anchor=None) for one in pair.robots])
    with pytest.raises(CorruptJournal, match="in its scenario a has no anchor"):
        of_frames(with_scenario(journals, replace(pair, robots=lacking)))


@pytest.mark.long
def test_killed_processes_write_the_same_journals_and_each_command_shows_the_recording(
    tmp_path: Path,
) -> None:
    """A finder, a robot without an anchor and the world are killed."""
    scenario = tmp_path / "four.toml"
    scenario.write_text(FILE, encoding="utf-8")
    kills = ["--kill", "a@60", "--kill", "u@40", "--kill", "world@70"]
    for name, mode in (("processes", kills), ("inline", ["--in-process"])):
        done = tandem_command("run", str(scenario), "--out", str(tmp_path / name), *mode)
        assert done.status == 0, done.err
    for journal in (tmp_path / "inline").glob("*.journal"):
        assert journal.read_bytes() == (tmp_path / "processes" / journal.name).read_bytes()
    folder = tmp_path / "inline"
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert [one["robot"] for one in summary["group"]["without_anchor"]] == ["u", "v"]
    assert summary["group"]["localised_tick"] <= summary["group"]["bound_ticks"] == summary["t_max_s"]
    drawn = ["figures", "--only", "meetings", "--format", "svg"]  # all of them take 22 s of a slow processor
    for command in (["audit"], ["replay"], drawn, ["export"], ["export", "--rerun"]):
        done = tandem_command(command[0], str(folder), *command[1:])
        assert done.status == 0, done.err
    assert "start-u" in (folder / "figures" / "meetings.svg").read_text(encoding="utf-8")


def test_a_run_of_frames_has_the_robots_without_an_anchor() -> None:
    run = of_frames(kept(parse(FILE, "four")))
    assert run.setup is not None
    assert [one.id for one in run.setup.anchored] == ["a", "b"]
    assert run.setup.bounds_s["u"] == run.setup.t_max_s


@pytest.mark.long
def test_the_page_shows_the_sweep_and_the_robots_that_it_finds(opened: Open, tmp_path: Path) -> None:
    run = run_mission(parse(FILE, "four"), tmp_path)
    assert run.end is not None
    claims = [run.claim(robot) for robot in ("u", "v")]
    found = min([one.tick for one in claims if one is not None])
    with watching(tmp_path) as (_, address):
        page = opened(address)
        scrub_to(page, 0)
        labels = page.evaluate("document.getElementById('canvas').labels.map((one) => one.text)")
        assert {"u", "anchor of a"} <= set(labels)
        assert "anchor of u" not in labels
        scrub_to(page, found - 1)
        expect(page.locator("#caption")).to_have_text(
            "a and b cover the area to find robots without an anchor."
        )
        expect(page.locator("body")).to_contain_text("no anchor")
        shot(page, "without-anchor")
        page.locator("#truth").uncheck()
        scrub_to(page, run.end.tick)
