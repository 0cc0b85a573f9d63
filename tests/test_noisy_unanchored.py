"""Groups with robots without an anchor under noise: they are found, and their covariances are right."""

from __future__ import annotations

import json
import math
import re
from functools import cache
from pathlib import Path
from signal import SIGINT
from typing import Any

import numpy as np
import pytest
import tomli_w
from msgspec.structs import replace

from agent.estimation.claim import is_definite
from agent.planning.assured import Assured
from agent.planning.group import GroupPlanner
from agent.planning.state import RobotState
from agent.planning.unanchored import UnanchoredPlanner
from agent.process.agent_journal import Step
from compose.audit.rules import audit_run, replayed
from compose.errors import UserError
from compose.launch.in_process import run_mission
from compose.recording.claim_errors import nees
from compose.recording.recording_files import agent_journal
from compose.recording.run import Run, of_frames
from protocol.messages import Localised, Report, ReportedPose, Undecided
from protocol.motion import Covariance
from protocol.wire import MAX_REPORT_BYTES, decode, encode
from tests.commands import TandemProcess
from tests.commands import journals as journals_of
from tests.commands import tandem as tandem_command
from tests.groups import R, localised
from tests.missions import kept, outcome
from tests.test_group_runs import audited
from tests.test_unanchored import bound, four, last_claim, scenario_of, table_with
from world.scenario import Scenario

NOISE: dict[str, Any] = {"anchor_sigma": 0.05, "mutual_sigma": 0.05, "gyro_bias": 0.0002}


def noisy(table: dict[str, Any], accuracy: float = 0.3, **noise: Any) -> Scenario:
    """Return the scenario of a file with the noise of the sweep `group`, other `noise` and an accuracy."""
    table["mission"] |= {"noise": {**NOISE, **noise}, "accuracy": accuracy}
    return scenario_of(table)


@cache
def journals() -> dict[str, list[bytes]]:
    """Return the journals of four robots, two of which have no anchor."""
    return kept(noisy(four()))


def references(run: Run) -> list[tuple[str, Report, ReportedPose]]:
    """Return the first report with each pose, with the robot that has received it and that pose."""
    found: dict[tuple[str, str, int], tuple[str, Report, ReportedPose]] = {}
    for robot, agent in run.agents.items():
        for one_step in agent.steps:
            for framed in one_step.received:
                if (prior := framed.report.prior) is not None:
                    key = robot, framed.report.robot, prior.tick
                    found.setdefault(key, (robot, framed.report, prior))
    return list(found.values())


def of_robots(step_: Step) -> list[Report]:
    """Return the reports that a robot has used in a tick."""
    return [framed.report for framed in step_.received]


def of_finders(run: Run) -> list[float]:
    """Return the normalised errors squared of the poses that covering robots have reported."""
    ids = [robot.id for robot in run.scenario.robots]
    return [
        nees(one.pose, run.ticks[one.tick].world.truth.poses[ids.index(report.robot)], one.covariance)
        for _, report, one in references(run)
        if one.covariance is not None
    ]


# --- groups -------------------------------------------------------------------------------------------


def test_robots_without_an_anchor_are_localised_under_noise_within_the_bound() -> None:
    run = of_frames(journals())
    assert outcome(run) == "localised"
    assert localised(run) == {"a", "b", "u", "v"}
    assert last_claim(run) <= bound(run.scenario)
    for robot in ("u", "v"):
        claim = run.claim(robot)
        assert claim is not None
        assert claim.nees is not None
        assert claim.nees < 16.3  # 99.9 % of chi-square with 3 degrees of freedom


def test_the_reference_of_a_contact_stays_fixed_and_its_log_begins_there() -> None:
    run = of_frames(journals())
    assert references(run)
    for robot, _, first in references(run):
        same = [
            framed.report
            for one_step in run.agents[robot].steps
            for framed in one_step.received
            if framed.report.prior is not None and framed.report.prior.tick == first.tick
        ]
        assert {one.prior for one in same} == {first}
        assert all(first.tick <= one.since <= one.through <= one.tick for one in same)


def test_the_audit_and_the_replay_find_nothing_where_nothing_is_wrong() -> None:
    run = of_frames(journals())
    assert audit_run(run).violations == ()
    assert replayed(run).differences == ()


@pytest.mark.parametrize(
    ("noise", "world"),
    [
        ({"drop_outs": 0.2}, {}),
        pytest.param({"outliers": 0.05}, {}, marks=pytest.mark.long),
        pytest.param({}, {"outliers": 0.05}, marks=pytest.mark.long),
        pytest.param(
            {},
            {"anchor_sigma": 0.075, "mutual_sigma": 0.075, "odometry": {"scale": -0.01}},
            marks=pytest.mark.long,
        ),
    ],
)
def test_a_recording_with_other_noise_is_audited_and_replayed_without_a_finding(
    noise: dict[str, Any], world: dict[str, Any]
) -> None:
    table = four()
    if world:
        table["world"] = {"noise": world}
    run = of_frames(kept(noisy(table, **noise)))
    assert outcome(run) == "localised"
    assert audit_run(run).violations == ()
    assert replayed(run).differences == ()


def test_the_audit_finds_a_reported_covariance_that_is_not_the_computed_one() -> None:
    frames = {name: list(some) for name, some in journals().items()}
    (_, report, prior), *_ = references(of_frames(frames))
    assert prior.covariance is not None
    own = frames[agent_journal(report.robot)]
    place = own.index(encode(report))
    smaller = replace(prior.covariance, xx=0.5 * prior.covariance.xx)
    own[place] = encode(replace(report, prior=replace(prior, covariance=smaller)))
    assert (report.tick, report.robot, "decision") in audited(frames)


def test_lost_and_late_reports_only_cost_time() -> None:
    run = run_mission(noisy(four(fault=[{"loss": 0.7, "delay": 5}])))
    assert len(localised(run)) == 4


def test_reports_under_odometry_noise_fit_in_a_frame_and_no_claim_is_wrong() -> None:
    odometry = {"v": 0.01, "omega": 0.01, "v_floor": 0.002, "omega_floor": 0.0005}
    scenario = replace(noisy(four(), odometry=odometry), max_ticks=250)
    run = of_frames(kept(scenario))
    sizes = [
        len(encode(framed.report))
        for agent in run.agents.values()
        for one_step in agent.steps
        for framed in one_step.received
    ]
    assert max(sizes) <= MAX_REPORT_BYTES
    assert outcome(run) in ("localised", "undecided")


@pytest.mark.long("slow")
def test_random_groups_make_no_wrong_claim_under_noise_and_reported_poses_have_right_covariances() -> None:
    scores: list[float] = []
    outcomes: list[str] = []
    for robots, unanchored, seeds in (
        (4, 2, range(5000, 5008)),
        (8, 4, (5000, 5002)),
        (8, 6, (5003,)),
    ):
        for seed in seeds:
            run = of_frames(kept(noisy(table_with(robots, unanchored, seed))))
            assert run.end is not None
            outcomes.append(run.end.outcome)
            scores += of_finders(run)
    # in large areas, a robot may be left to wait for a finder that knows its own pose well enough
    assert set(outcomes) <= {"localised", "undecided"}
    assert outcomes.count("localised") > len(outcomes) / 2
    assert (
        3.0 - 3.0 * math.sqrt(6.0 / len(scores)) < np.mean(scores) < 3.0 + 4.0 * math.sqrt(6.0 / len(scores))
    )


@pytest.mark.long
def test_larger_errors_than_told_lead_to_no_wrong_claim() -> None:
    for seed in range(6000, 6004):
        table = table_with(4, 2, seed)
        world = {"anchor_sigma": 0.075, "mutual_sigma": 0.075, "odometry": {"scale": -0.01}}
        table["world"] = {"noise": world}
        run = run_mission(noisy(table))
        assert outcome(run) != "wrong", (seed, run.end)


@pytest.mark.long
def test_a_robot_whose_fit_has_ended_in_a_wrong_optimum_passes_on_no_pose() -> None:
    """A pose that was 3.7 m wrong without the search before a reference, when the robot had come back."""
    odometry = {"v": 0.01, "omega": 0.01, "v_floor": 0.002, "omega_floor": 0.0005}
    planned = noisy(
        table_with(4, 2, 2), accuracy=0.9, odometry=odometry
    )  # refused with the accuracy of 0.3 m
    run = of_frames(kept(replace(planned, mission=replace(planned.mission, accuracy=0.3), max_ticks=330)))
    assert of_finders(run)
    assert max(of_finders(run)) < 16.3
    assert outcome(run) != "wrong"


# --- meetings that contradict each other -----------------------------------------------------------------


def three_and_one() -> dict[str, Any]:
    """Return a scenario file in which a meets b, visits c, and then looks for u, which has no anchor."""
    table = four()
    table["robot"] = [
        {"id": "a", "anchor": [0.0, 0.0]},
        {"id": "b", "anchor": [10.0, 3.0]},
        {"id": "c", "anchor": [2.0, 11.0]},
        {"id": "u"},
    ]
    return table


def in_search(run: Run, peers: tuple[str, ...], shift: float) -> RobotState | None:
    """Return the state of a when it begins to cover; None if it does not, because its claim is withdrawn.

    Before it claims its pose with c, the pose that it knows is from its meetings with `peers`, and `shift` m
    beside the one that it has computed.
    """
    agent, planner = run.agents["a"], GroupPlanner(Assured())
    state, changed = planner.start(agent.config), False
    for one in agent.steps:
        state = planner.observe(state, one.observation)
        fix = state.fix
        if not changed and fix is not None and state.config.peer == "c" and state.in_contact:
            pose = replace(fix.claim.pose, x=fix.claim.pose.x + shift)
            fix = replace(fix, peers=peers, claim=replace(fix.claim, pose=pose))
            state, changed = replace(state, fix=fix), True
        state = planner.decide(state, of_robots(one))
        if state.covers:
            return state
    return None


def test_the_search_begins_with_the_pose_that_the_robot_knows_after_a_meeting_that_contradicts_it() -> None:
    run = of_frames(kept(noisy(three_and_one())))
    agreeing = in_search(run, ("b",), 0.0)
    assert agreeing is not None
    assert agreeing.config.peer == "c"
    kept_claim = in_search(run, ("b", "d"), 2.0)
    assert kept_claim is not None
    assert kept_claim.other("c").failed
    assert kept_claim.config.peer == "b"
    assert in_search(run, ("b",), 2.0) is None


@pytest.mark.parametrize(("peers", "shift"), [(("b",), 0.0), (("b",), 2.0), (("b", "d"), 2.0)])
def test_a_claim_that_later_ranges_contradict_is_withdrawn_in_the_search_and_no_pose_is_reported(
    peers: tuple[str, ...], shift: float
) -> None:
    run = of_frames(journals())
    (finder,) = {report.robot for _, report, _ in references(run)}
    first = min(prior.tick for _, _, prior in references(run))
    agent, planner = run.agents[finder], GroupPlanner(Assured())
    state = planner.start(agent.config)
    for one in agent.steps[: first + 1]:
        if one.observation.tick == first:
            assert state.fix is not None
            claim = state.fix.claim
            claim = replace(claim, pose=replace(claim.pose, x=claim.pose.x + shift))
            state = replace(state, fix=replace(state.fix, claim=claim, peers=peers))
        state = planner.observe(state, one.observation)
        state = planner.decide(state, of_robots(one))
    assert (state.own_pose.reference is not None) == (shift == 0.0)
    if shift == 0.0 or len(peers) > 1:
        assert isinstance(planner.command(state).verdict, Localised)
        assert state.covers
        return
    command = planner.command(state)
    assert command.verdict is None
    assert command.task in ("aligning", "radial", "orbiting")
    assert isinstance(state.failure, Undecided)
    assert state.failure.reason.startswith("its ranges since its claim contradict it by ")
    assert planner.report_to(state, state.config.peer).verdict == state.failure


def test_a_robot_that_takes_a_finder_anew_receives_the_manoeuvres_since_the_reference_again() -> None:
    run = of_frames(journals())
    receiver, report, first = references(run)[0]
    agent, planner = run.agents[report.robot], GroupPlanner(Assured())
    state, since = planner.start(agent.config), []
    for one in agent.steps[: first.tick + 9]:
        state = planner.decide(planner.observe(state, one.observation), of_robots(one))
        report = planner.report_to(state, receiver)
        if report.prior is not None and report.prior.tick == first.tick:
            since.append(report.since)
    assert since[0] == first.tick < since[-1]
    acknowledged = [report for report in of_robots(one) if report.robot == receiver]
    anew = planner.decide(state, [replace(report, heard=0) for report in acknowledged])
    again = planner.report_to(anew, receiver)
    assert again.prior is not None
    assert again.since == first.tick


# --- the scenario -------------------------------------------------------------------------------------


def test_gyros_that_turn_a_sweeping_robot_too_far_are_refused_with_the_value_that_would_do() -> None:
    table = four()
    table["mission"]["area"] = [-500.0, -500.0, 500.0, 500.0]
    message = r"^group.toml: mission.noise.gyro_bias: within the \d+ s between two passages of its anchor"
    with pytest.raises(UserError, match=message) as refused:
        noisy(table)
    enough = float(str(refused.value).split("calibrate the gyros to ")[1].split(" ")[0])
    assert noisy(table, gyro_bias=enough).planned_sweep is not None


CALIBRATED = dict.fromkeys(("gyro_bias", "wheel_scale", "range_bias", "pair_bias", "range_scale"), 1e-6)


@pytest.mark.parametrize(("accuracy", "ranges", "least"), [(1e-3, 46955, 0.023), (0.015, 209, 0.023)])
def test_an_accuracy_that_needs_too_many_ranges_is_refused_with_their_number(
    accuracy: float, ranges: int, least: float
) -> None:
    message = (
        f"^group.toml: mission.accuracy: {accuracy:g} m needs about {ranges} mutual ranges with "
        rf"noise.mutual_sigma = 0.05 m, more than the 94 that a group may take: set at least {least} m$"
    )
    table = four()
    with pytest.raises(UserError, match=message):
        noisy(table, accuracy=accuracy, **CALIBRATED)
    assert noisy(table, accuracy=least, **CALIBRATED).planned_sweep is not None


def test_a_prior_that_forbids_the_accuracy_of_robots_without_an_anchor_is_named() -> None:
    with pytest.raises(UserError, match=r"^group.toml: mission.accuracy: the prior noise.wheel_scale"):
        noisy(four(), accuracy=0.045)
    assert noisy(four(), accuracy=0.05).planned_sweep is not None


@pytest.mark.long
def test_robots_are_localised_at_an_accuracy_just_above_the_one_that_is_refused() -> None:
    """At 0.8 of the accuracy in the reference mission, where the limit is 1.25."""
    for seed in range(1, 4):
        table = four(seed=seed)
        run = run_mission(noisy(table, accuracy=0.03, **CALIBRATED))
        assert outcome(run) == "localised"


@pytest.mark.parametrize("kind", ["v", "omega", "v_floor", "omega_floor"])
def test_odometry_noise_that_leaves_a_finder_too_inaccurate_is_refused_with_the_values_that_would_do(
    kind: str,
) -> None:
    sigma = 0.2
    message = r"^group.toml: mission.noise.odometry: between two passages of its anchor, a robot that covers"
    with pytest.raises(UserError, match=message) as refused:
        noisy(four(), odometry={kind: sigma})
    share = float(re.findall(r"reduce this noise to (\S+) of it", str(refused.value))[0])
    accuracy = float(re.findall(r"set an accuracy of (\S+) m", str(refused.value))[0])
    assert noisy(four(), odometry={kind: share * sigma}).planned_sweep is not None
    with pytest.raises(UserError, match=message):
        noisy(four(), odometry={kind: 1.2 * share * sigma})
    if accuracy < R / math.sqrt(2.0):
        assert noisy(four(), accuracy=accuracy, odometry={kind: sigma}).planned_sweep is not None


def test_visitors_sweep_and_the_robots_that_they_have_visited_are_their_beacons() -> None:
    scenario = noisy(table_with(8, 4, 2006))
    planned = scenario.planned_sweep
    assert planned is not None
    finders = planned.sweepers[: planned.sweep.parts]
    last = {robot: one for one in scenario.meetings for robot in (one.visitor, one.visited)}
    for robot, one in last.items():
        assert (robot in finders) == (one.visitor == robot and last[one.visited] is one)


# --- a robot without an anchor ------------------------------------------------------------------------


def test_malformed_references_are_refused() -> None:
    planner = GroupPlanner(UnanchoredPlanner())
    good = decode(encode(references(of_frames(journals()))[0][1]), Report)
    assert good.prior is not None
    assert planner.malformed(good) is None
    flat = Covariance(1.0, 2.0, 0.0, 1.0, 0.0, 1.0)
    assert not is_definite(np.array(flat.matrix))
    tiny = Covariance(1e-300, 0.0, 0.0, 1e-300, 0.0, 1e-300)
    for wrong in ({"covariance": flat}, {"covariance": tiny}, {"tick": good.since + 1}):
        assert planner.malformed(replace(good, prior=replace(good.prior, **wrong))) is not None


# --- a robot that dies --------------------------------------------------------------------------------


@pytest.mark.long
def test_a_finder_that_has_died_is_named_with_the_robots_that_it_has_not_found(tmp_path: Path) -> None:
    table = four(name="four")
    table["robot"][0]["dies"] = 60
    table["mission"] |= {"noise": NOISE, "accuracy": 0.3}
    scenario, out = tmp_path / "four.toml", tmp_path / "run"
    scenario.write_text(tomli_w.dumps(table), encoding="utf-8")
    done = tandem_command("run", scenario, "--in-process", "--out", out)
    why = "u: no localised robot has found it; a is dead from tick 60 on; v is not localised either"
    assert done.status == 1
    assert why in done.out
    assert "all robots but u, v were localised by tick 21" in done.out
    found = json.loads((out / "summary.json").read_text())
    assert found["reason"] == why
    assert found["group"]["not_localised"] == dict.fromkeys("uv", "no localised robot has found it")
    assert tandem_command("audit", out).status == 0


# --- processes ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def inline(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the scenario `four.toml`, and its recording of one process, `inline`."""
    folder = tmp_path_factory.mktemp("noisy")
    table = four(name="four")
    table["mission"] |= {"noise": NOISE, "accuracy": 0.3}
    (folder / "four.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
    done = tandem_command("run", folder / "four.toml", "--out", folder / "inline", "--in-process")
    assert done.status == 0, done.err
    return folder


@pytest.mark.long
@pytest.mark.parametrize(
    "kills",
    [
        "a@27:report a@60:journal a@101:report a@104:command u@108:journal u@112:report",
        "world@70 world@100:report world@101:journal u@101:command b@150 a@200 v@300:report a@300:journal",
        "a@100:journal a@101:command a@102:report u@102:journal v@50 world@302:command",
    ],
)
def test_processes_that_are_killed_at_any_point_of_the_search_write_the_same_journals(
    kills: str, inline: Path, tmp_path: Path
) -> None:
    options = [word for kill in kills.split() for word in ("--kill", kill)]
    done = tandem_command("run", inline / "four.toml", "--out", tmp_path, *options)
    assert done.status == 0, done.err
    assert journals_of(tmp_path) == journals_of(inline / "inline")


@pytest.mark.long
def test_a_search_that_is_stopped_leaves_a_recording_that_is_replayed_until_then(
    inline: Path, tmp_path: Path
) -> None:
    world = tmp_path / "world.journal"
    enough = math.ceil(0.45 * (inline / "inline" / world.name).stat().st_size)
    with TandemProcess("run", inline / "four.toml", "--out", tmp_path) as running:
        running.until_written(world, enough)
        running.tell(SIGINT)
        assert running.ended().status == 130
    replayed_until = tandem_command("replay", tmp_path)
    assert replayed_until.status == 0, replayed_until.out
    assert "breaks off here" in replayed_until.out
    for name, journal in journals_of(tmp_path).items():
        assert journals_of(inline / "inline")[name].startswith(journal)


@pytest.mark.long
def test_each_command_shows_a_search_under_noise(inline: Path) -> None:
    figures = ["figures", "--only", "meetings", "--only", "errors", "--only", "robot", "--format", "svg"]
    for command in (["audit"], ["replay"], figures, ["export"], ["export", "--rerun"]):
        done = tandem_command(command[0], inline / "inline", *command[1:])
        assert done.status == 0, done.err
