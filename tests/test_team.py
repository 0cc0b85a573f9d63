"""Teams: robots that share all measurements, with several anchors, anchors that they survey, or none."""

from __future__ import annotations

import json
import math
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

import tandem
from agent.estimation import following, judged
from agent.estimation.fit import Fit
from agent.estimation.gaussian import search as searching
from agent.estimation.gaussian.claim_agreement import united
from agent.estimation.gaussian.claim_rivals import Rival, likeliest_rival
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.search import search
from agent.estimation.judged import MUTUAL_RANGES
from agent.estimation.posterior import Posterior, carried
from agent.estimation.team_measurements import TeamMeasurements
from agent.peer.team_log import Entry, LogPart, Ranging, TeamLog, TeamReport
from agent.planning.team import TeamPlanner
from agent.planning.team_state import TeamState
from agent.planning.team_tasks import next_task
from compose.audit.claim_rules import bound, distance
from compose.audit.rules import audit_run, replayed
from compose.errors import BadScenario
from compose.launch.in_process import run_mission
from compose.recording.ranging.run_ranges import ranges_of_run
from compose.recording.run import of_frames, read
from compose.recording.summary_json import summary
from compose.scenario.scenario_change import file_table
from compose.scenario.scenario_file import load, parse, template_of, validate
from compose.scenario.shipped_files import shipped
from compose.sweep.group_columns import group_columns
from compose.sweep.trial import Trial, row
from protocol.journal.journal_file import CorruptJournal
from protocol.messages import Contact, Localised, NamedRange, Observation
from protocol.mission import Anchor
from protocol.motion import REST, Controls, Covariance, Pose
from protocol.team_motion import spiral
from protocol.wire import decode, encode
from tests.commands import journals
from tests.commands import tandem as tandem_command
from tests.missions import kept, outcome
from tests.moving_groups import PERIOD_S, joint_measurements, moving_group
from tests.relative_teams import scenario_of
from tests.series import series
from world.hardware.driver import Reading
from world.hardware.measurements import InvalidReading, observation_frame
from world.scenario import Scenario
from world.tick import World, advance, observations, release
from world.world_noise import WorldNoise

SHIPPED = ("room", "relative")
MISSION = """
[mission]
sensing_range = 5.0
period = 1.0
max_speed = 0.5
max_turn_rate = 1.0
accuracy = 0.1
noise = {anchor_sigma = 0.05, mutual_sigma = 0.05}
"""
ANCHORS = """
[[anchor]]
id = "A1"
position = [0.0, 0.0]
[[anchor]]
id = "A2"
position = [3.0, 0.0]
[[anchor]]
id = "A3"
position = [0.0, 3.0]
"""


def team(robots: str, anchors: str = ANCHORS, mission: str = MISSION, more: str = "") -> Scenario:
    """Return the scenario of a team with these tables."""
    return parse(f'name = "team"\nseed = 1\n{more}\n{mission}\n{anchors}\n{robots}', "team")


IN_A_LINE = ANCHORS.rpartition("[[anchor]]")[0]
"""Two anchors: across their line, no range tells where they stand."""
ALONE = '[[robot]]\nid = "a"\nstart = [1.0, 1.0, 0.5]'


# --- missions -------------------------------------------------------------------------------------------


def test_a_robot_alone_in_a_room_is_localised() -> None:
    run = run_mission(team(ALONE))
    assert outcome(run) == "localised"
    claim = run.claim("a")
    assert claim is not None
    assert claim.position_error < 0.3
    assert summary(run, None, None)["t_max_s"] == run.scenario.t_max > 0.0


def test_an_anchor_that_is_not_in_the_list_of_a_robot_is_not_ranged() -> None:
    run = run_mission(team(ALONE + '\nanchors = ["A1", "A3"]'))
    ranged = {one.anchor for seen in run.observations for one in seen["a"].anchors}
    assert ranged == {"A1", "A3"}
    assert outcome(run) == "localised"
    everything = {one.anchor for one in observations(release(team(ALONE)))[0].anchors}
    assert everything == {"A1", "A2", "A3"}


def test_poses_without_anchors_are_those_in_the_frame_of_the_first_robot() -> None:
    run = run_mission(load("relative"))
    assert outcome(run) == "localised"
    first = run.truth("a")[0]
    assert (first.x, first.y, first.heading) == (0.0, 0.0, 0.0)
    assert not any(seen[robot].anchors for seen in run.observations for robot in seen)


def test_a_robot_with_three_ranges_keeps_no_other_one_from_its_claim() -> None:
    """Fits of the third one end where no step descends: its ranges are explained by their linear model."""
    exact = MISSION.replace("0.05", "0.0").replace("accuracy", 'frame = "relative"\naccuracy')
    run = run_mission(parse(f'name = "met"\nseed = 3199\n{exact}[team]\nrobots = 3\nside = 10.0', "met"))
    assert run.end is not None
    assert run.end.outcome == "localised"
    assert run.end.tick < 30


@pytest.mark.parametrize(("seed", "ticks"), [(1, 4), (104124, 7)])
def test_two_exact_robots_claim_by_five_ranges_or_drive_to_where_more_tell_enough(
    seed: int, ticks: int
) -> None:
    """The second two begin where five ranges leave more than rounding: they took 427 ticks."""
    area = 'accuracy = 0.2\nframe = "relative"\narea = [0.0, 0.0, 10.0, 10.0]'
    exact = MISSION.replace("0.05", "0.0").replace("accuracy = 0.1", area)
    run = run_mission(
        parse(f'name = "met"\nseed = {seed}\n{exact}[[robot]]\nid = "r0"\n[[robot]]\nid = "r1"', "met")
    )
    assert outcome(run) == "localised"
    assert run.length - 1 == ticks
    claim = run.claim("r1")
    assert claim is not None
    assert claim.position_error < 1e-9


def test_robots_without_anchors_turn_back_before_the_range_that_connects_them_is_lost() -> None:
    """Two of them start 4.5 m apart; on loops that did not turn back, they took 14 ticks."""
    run = run_mission(parse(scenario_of(3, 0.0, 1002), "met"))
    assert outcome(run) == "localised"
    assert run.length - 1 <= 6


def test_an_anchor_off_its_survey_is_named_before_its_ranges_pass_as_strays() -> None:
    room = MISSION.replace("5.0", "8.0") + "[team]\nrobots = 2\nanchors = 5\nside = 10.0"
    table = file_table(parse(f'name = "off"\nseed = 104\n{room}', "off"))
    x, y = table["anchor"][0]["position"]
    table["anchor"][0]["stands"] = [x + 0.208, y - 0.216]
    run = run_mission(replace(template_of(table).scenario, max_ticks=8))
    assert run.end is not None
    assert run.end.outcome == "undecided"
    assert any("anchor A1 seems to stand elsewhere" in (one.text or "") for one in run.end.causes)


def test_a_claim_says_across_which_line_of_anchors_no_range_tells_where_they_stand(tmp_path: Path) -> None:
    for anchors, unverified in ((IN_A_LINE, ["A1", "A2"]), (ANCHORS, [])):
        found = run_mission(team(ALONE, anchors, EXACT)).final_reports["a"].unverified_anchors
        assert list(found) == unverified
        assert all(
            "off along (-0.00, 1.00)" in why or "off along (0.00, 1.00)" in why for why in found.values()
        )
    (tmp_path / "line.toml").write_text(f'name = "line"\nseed = 1\n{EXACT}{IN_A_LINE}{ALONE}')
    said = tandem_command("run", tmp_path / "line.toml", "--in-process")
    assert "no range tells whether A1, A2 stand off by the accuracy of a claim" in said.out
    assert "summary.json of --out" in " ".join(said.out.split())


def to_a_sigma(sigma: float, scenario: Scenario) -> Scenario:
    """Return a scenario in which anchors are surveyed to a `sigma` (m)."""
    assert scenario.team is not None
    return replace(scenario, team=replace(scenario.team, survey=sigma))


@pytest.mark.parametrize("seed", [19, 101143])
def test_robots_survey_an_anchor_where_the_known_ones_tell_in_which_frame_it_stands(seed: int) -> None:
    """A3 and A7 are in a corner of the square from where only one of the two known anchors is in range.

    With the other seed, robots leave A7 after few ranges, and return to where they had them.
    """
    run = run_mission(to_a_sigma(0.05, replace(load("survey", seed=seed), max_ticks=60)))
    assert run.end is not None
    assert run.end.outcome == "localised"


def test_a_robot_that_is_located_for_the_first_time_searches_its_measurements_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    searched, extended = list[JointMeasurements](), searching.extended

    def counted(known: Posterior, measured: JointMeasurements, *more: Any, **named: Any) -> Posterior:
        searched.append(measured)
        return extended(known, measured, *more, **named)

    searching.from_nothing.cache_clear()
    for module in (searching, following):
        monkeypatch.setattr(module, "extended", counted)
    assert outcome(run_mission(load("relative"))) == "localised"
    assert len(searched) == len(set(searched)) > 2


def test_robots_ask_for_rivals_of_their_claims_only_when_the_survey_has_ended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = list[int]()

    def counted(fit: Fit, measured: JointMeasurements, *more: Any) -> Rival:
        asked.append(max(len(path.v) for path in measured.paths))
        return likeliest_rival(fit, measured, *more)

    monkeypatch.setattr(judged, "likeliest_rival", counted)
    run = run_mission(to_a_sigma(0.05, load("survey")))
    claims = [made for robot in run.robots if (made := run.standing_claim(robot)) is not None]
    assert asked == [tick for tick, _ in claims]


def test_a_survey_says_where_each_anchor_stands_and_by_how_much_that_may_be_off(tmp_path: Path) -> None:
    said = tandem_command("run", "survey", "--in-process", "--no-export", "--out", tmp_path / "out")
    run = read(tmp_path / "out")
    assert run.scenario.team is not None
    places = {one.told.id: one.place for one in run.scenario.team.anchors if one.told.position is None}
    found = json.loads((tmp_path / "out" / "summary.json").read_text())["team"]["anchors"]
    assert list(found) == list(places) == ["A3", "A4", "A5", "A6", "A7", "A8"]
    assert found == summary(run, None, None)["team"]["anchors"], "from the journals"
    for name, one in found.items():
        (x, y), place = one["position"], places[name]
        assert one["error_m"] == math.hypot(x - place.x, y - place.y) <= one["bound_m"]
        assert one["bound_m"] == 3.0 * one["sigma_m"] <= 0.05
        assert f"anchor {name}: {x:.2f} {y:.2f}, within {one['bound_m']:.2g} m (3 sigma)" in said.out


def test_a_robot_gives_up_if_twice_as_many_ranges_still_blame_one_of_two_anchors() -> None:
    """Only their distance is wrong, so both are named; more ranges would say the same for 1 009 ticks."""
    survey = file_table(load("survey"))
    survey["anchor"][0]["stands"] = [0.212, 0.212]
    run = run_mission(template_of(survey).scenario)
    assert run.end is not None
    assert run.end.outcome == "undecided"
    assert run.end.tick < 60
    (blamed,) = [one.text or "" for one in run.end.causes if "stand elsewhere" in (one.text or "")]
    assert {"A1", "A2"} == set(re.findall("A[0-9]", blamed))


def test_an_anchor_with_three_ranges_from_one_line_is_not_said_to_stand_at_their_mirror_image() -> None:
    room = MISSION.replace("5.0", "3.0") + "[team]\nrobots = 2\nanchors = 5\nside = 10.0"
    run = run_mission(replace(parse(f'name = "line"\nseed = 1021\n{room}', "line"), max_ticks=8))
    assert run.standing_claim("r1") is not None


def test_hypotheses_stay_those_of_their_robots_when_another_one_gets_its_first_range() -> None:
    """Then the indices of all robots change that come after it by name, and the origin may."""
    group = moving_group(3, 1, ticks=12)
    early = [
        one for one in group.facts if "r00" not in (one.key.robot, one.key.other) and one.key.robot != "Mr00"
    ]
    before, now = (joint_measurements(one, group.noise, PERIOD_S, 30.0) for one in (early, group.facts))
    assert (before.robots, now.robots) == (("r01", "r02"), ("r00", "r01", "r02"))
    assert before.origin != now.origin
    found = search(before)
    after = carried(found, before, now)
    assert (found.located, after.located) == ((0, 1), (1, 2))
    for one, other in zip(found.hypotheses, after.hypotheses, strict=True):
        moved = other.fit.start.poses[:, :2] + now.origin
        assert np.allclose(moved, one.fit.start.poses[:, :2] + before.origin, atol=1e-12)
    room = MISSION.replace("5.0", "3.0") + "[team]\nrobots = 4\nanchors = 5\nside = 10.0"
    run = run_mission(replace(parse(f'name = "late"\nseed = 1019\n{room}', "late"), max_ticks=12))
    assert run.end is not None
    assert run.end.outcome == "localised"


def test_an_anchor_with_a_sigma_that_is_ranged_for_the_first_time_ends_no_robot() -> None:
    places = [(9.0, 9.0), (0.5, 0.0), (6.0, 0.0), (0.0, 6.0), (3.0, 4.0)]
    anchors = [f'[[anchor]]\nid = "A{k}"\nposition = {[*at]}\nsigma = 0.05\n' for k, at in enumerate(places)]
    run = run_mission(team(ALONE + '\n[[robot]]\nid = "b"\nstart = [6.0, 6.0, 0.5]', "".join(anchors)))
    ranged = [{near.anchor for one in seen.values() for near in one.anchors} for seen in run.observations]
    assert not ranged[-1] <= ranged[0]
    assert run.end is not None
    assert run.end.outcome == "localised"


APART = '[[robot]]\nid = "a"\nstart = [1.0, 1.0, 0.5]\n[[robot]]\nid = "b"\nstart = [9.0, 7.0, 2.0]'
SCATTERED = team(APART, "", MISSION.replace("0.05", "0.0") + '\nframe = "relative"\ndiameter = 10.0')


def test_the_first_robot_searches_for_one_that_starts_out_of_range_and_stands() -> None:
    run = run_mission(SCATTERED)
    assert run.end is not None
    assert run.end.outcome == "localised"
    assert run.end.tick * run.scenario.mission.period <= run.scenario.t_max
    met = next(seen["b"].tick for seen in run.observations if seen["b"].contacts)
    assert met > 10
    assert {run.truth("b")[k] for k in range(met)} == {run.truth("b")[0]}


@given(st.floats(0.0, 30.0), st.floats(0.0, math.tau))
def test_the_spiral_passes_each_place_well_in_range(distance: float, angle: float) -> None:
    mission = SCATTERED.mission
    place = complex(distance * math.cos(angle), distance * math.sin(angle))
    sides = pairwise([complex(*one) for one in spiral(mission, distance)])
    nearest = min(_distance(place, *side) for side in sides)
    assert nearest <= 0.6 * mission.sensing_range


def _distance(place: complex, begin: complex, end: complex) -> float:
    along = ((place - begin) * (end - begin).conjugate()).real / abs(end - begin) ** 2
    return abs(place - begin - min(max(along, 0.0), 1.0) * (end - begin))


@pytest.mark.parametrize("frame", series(["", 'frame = "relative"\n'], 1))
def test_robots_of_a_team_keep_the_safety_distance(frame: str) -> None:
    drawn = "[team]\nrobots = 4\nside = 4.0\n" + ("" if frame else "anchors = 2\n")
    text = f'name = "apart"\nseed = 2\n{MISSION}safety_distance = 0.6\n{frame}{drawn}'
    run = of_frames(kept(parse(text, "apart")))
    assert outcome(run) == "localised"
    assert audit_run(run).violations == ()
    assert summary(run, None, None)["nearest_m"] >= 0.6


def test_robots_that_block_each_other_make_way_in_their_order() -> None:
    """Two robots that both made way came nearer by half of what was left, again and again."""
    mission = (
        MISSION.replace("5.0", "2.5").replace("0.05", "0.0") + 'safety_distance = 0.6\nframe = "relative"\n'
    )
    run = run_mission(parse(f'name = "tight"\nseed = 1010\n{mission}[team]\nrobots = 4\nside = 4.0', "tight"))
    assert run.end is not None
    assert run.end.outcome == "localised"
    assert run.end.tick < 100
    assert summary(run, None, None)["nearest_m"] >= 0.6


def test_robots_that_come_too_near_and_a_search_that_takes_too_long_are_violations() -> None:
    run = run_mission(SCATTERED)
    assert [one for rule in (distance, bound) for one in rule(run) if one is not None] == []
    assert run.scenario.team is not None
    mission, late = replace(run.scenario.mission, safety_distance=9.0), replace(run.scenario.team, bound=1.0)
    history = run.history
    for changed, rule in (
        (replace(run.scenario, mission=mission), distance),
        (replace(run.scenario, team=late), bound),
    ):
        other = replace(run, world=replace(history, scenario=changed))
        (found,) = [one for one in rule(other) if one is not None]
        assert found.rule == rule.__name__
        untold = replace(changed, world_noise=WorldNoise(mutual_sigma=0.5))  # nothing is promised then
        assert not any(rule(replace(run, world=replace(history, scenario=untold))))


KILLS = ("a@2 world@4", "", "b@1:command b@3:report world@0")
EACH_KILLED = [(SHIPPED[i % 2], kills) for i, kills in enumerate(KILLS[:2])]
EACH_KILLED += [(name, kills) for name in SHIPPED for kills in KILLS if (name, kills) not in EACH_KILLED]


@pytest.mark.parametrize("killed", series(EACH_KILLED, 2), ids=" ".join)
def test_a_team_as_processes_has_the_recording_of_one_process(
    killed: tuple[str, str], tmp_path: Path
) -> None:
    name, kills = killed
    tandem_command("run", name, "--in-process", "-q", "--no-export", "--out", tmp_path / "one")
    words = [word for kill in kills.split() for word in ("--kill", kill)]
    ended = tandem_command("run", name, "-q", "--no-export", "--out", tmp_path / "processes", *words)
    assert ended.status == 0, ended
    assert journals(tmp_path / "one") == journals(tmp_path / "processes")


@pytest.mark.parametrize("name", SHIPPED)
def test_a_team_is_replayed_to_the_bit_and_has_no_violation(name: str) -> None:
    run = of_frames(kept(load(name)))
    assert (replayed(run).differences, replayed(run).tears) == ((), ())
    findings = audit_run(run)
    assert findings.violations == ()


@pytest.mark.parametrize("seed", series(range(3), 1))
def test_loss_delay_and_duplication_of_reports_change_ticks_only(seed: int) -> None:
    mission = MISSION.replace("accuracy", 'frame = "relative"\narea = [0.0, 0.0, 4.0, 4.0]\naccuracy')
    robots = "".join([f'[[robot]]\nid = "{robot}"\n' for robot in "abc"])
    fault = "[[fault]]\nloss = 0.4\ndelay = [0, 3]\nduplicate = 0.3"
    text = f"{mission}\n{robots}\n{fault}"
    scenario = parse(f'name = "faulty"\nseed = {seed}\n{text}', "faulty")
    run = of_frames(kept(scenario))
    assert outcome(run) == "localised"
    assert audit_run(run).violations == ()


def test_the_others_go_on_without_a_robot_that_dies_and_the_outcome_names_it(tmp_path: Path) -> None:
    text = shipped()["relative"].read_text().replace('id = "b"', 'id = "b"\ndies = 4')
    (tmp_path / "dead.toml").write_text(text)
    out = tmp_path / "out"
    ended = tandem_command("run", tmp_path / "dead.toml", "--in-process", "-q", "--no-export", "--out", out)
    assert (ended.status, tandem_command("audit", out).status) == (1, 0), ended
    summed = json.loads((out / "summary.json").read_text())
    assert (summed["outcome"], summed["reason"]) == ("undecided", "b is dead from tick 4 on")
    assert summed["team"] == {
        "anchors": {},
        "not_localised": {"b": "it is dead from tick 4 on"},
        "deaths": {"b": 4},
    }
    assert [summed["robots"][robot]["localised"] for robot in "abc"] == [True, False, True]
    assert validate(file_table(read(out).scenario), "again").scenario == read(out).scenario


def test_poses_unite_to_a_claim_that_covers_all_of_them_or_to_none() -> None:
    noisy, exact = load("room").mission, load("paper-1").mission
    wide = Covariance(*[0.004, 0.0, 0.0, 0.004, 0.0, 0.0004])
    one = Localised(Pose(1.0, 2.0, 0.5), wide)
    claim = united([one, Localised(Pose(1.02, 2.0, 0.5), wide)], noisy)
    assert claim is not None
    assert claim.covariance is not None
    assert claim.pose.x == 1.02
    assert claim.covariance.xx == pytest.approx(0.004 + 0.02**2)
    assert united([one, Localised(Pose(1.6, 2.0, 0.5), wide)], noisy) is None, "they contradict each other"
    assert united([one, Localised(Pose(1.1, 2.0, 0.5), wide)], noisy) is None, "not accurate enough"
    assert united([Localised(Pose(1.0, 2.0, 0.5)), Localised(Pose(1.0, 2.0 + 1e-9, 0.5))], exact) is not None
    assert united([Localised(Pose(1.0, 2.0, 0.5)), Localised(Pose(1.0, 2.001, 0.5))], exact) is None


EXACT = MISSION.replace("\nnoise =", "\n# noise =")


RADIUS, SCALE = '"radius", size = 0.5', '"scale", size = 0.3'


@pytest.mark.long
@pytest.mark.parametrize(
    "case", series([(RADIUS, MISSION), (SCALE, EXACT), (RADIUS, EXACT), (SCALE, MISSION)], 1)
)
def test_a_team_that_tolerates_false_data_claims_right_poses(case: tuple[str, str]) -> None:
    attack, sensors = case
    mission = sensors.replace("= 5.0", "= 3.0") + "tolerates = 1\n"
    drawn = DRAWN.replace("robots = 2", "robots = 4").replace("side = 4.0", "side = 8.0")
    scenario = team("", f"{drawn}attack = {{kind = {attack}}}\n", mission)
    assert template_of(file_table(scenario)).scenario == scenario
    run = of_frames(kept(scenario))
    assert audit_run(run).violations == ()
    columns = group_columns(run)
    assert columns is not None
    assert (columns.honest_localised, columns.honest_wrong) == (3, 0)


# --- reports -------------------------------------------------------------------------------------------

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


# --- scenarios -----------------------------------------------------------------------------------------

TWO = ALONE + '\n[[robot]]\nid = "b"\nstart = [2.0, 1.0, 0.0]'
SAME = ANCHORS.replace("[3.0, 0.0]", "[0.0, 0.0]").split('[[anchor]]\nid = "A3"')[0]
RELATIVE = MISSION.replace("accuracy", 'frame = "relative"\naccuracy')
ATTACK = '\nattack = {kind = "shift", size = 1.0, part = "all"}'
DRAWN = "[team]\nrobots = 2\nside = 4.0\nanchors = 3\n"


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"robots": ALONE, "anchors": SAME}, "robot[0]: 'a' may range fewer than two anchors at different"),
        ({"robots": ALONE.replace("1.0, 1.0", "9.0, 9.0")}, "robot[0].start: no anchor that 'a' knows"),
        ({"robots": ALONE, "anchors": ANCHORS.replace("A3", "A1")}, "anchor.id: 2 anchors have the id 'A1'"),
        ({"robots": ALONE + '\nanchors = ["A1", "B2"]'}, "robot[0].anchors: there is no anchor 'B2'"),
        ({"robots": ALONE + '\nanchors = ["A1"]'}, "robot[0]: 'a' may range fewer than two anchors"),
        ({"robots": TWO, "mission": RELATIVE}, "mission.frame: anchors determine the frame"),
        (
            {"robots": TWO, "mission": MISSION + "safety_distance = 0.5"},
            "robot[1].start: nearer to another one than 1.65 m",
        ),
        (
            {
                "robots": APART,
                "anchors": "",
                "mission": RELATIVE.replace("0.05}", "0.05, gyro_bias = 0.01}") + "diameter = 10.0",
            },
            "mission.noise.gyro_bias: within the",
        ),
        ({"robots": ALONE, "anchors": "", "mission": RELATIVE}, "mission.frame: the poses of at least two"),
        ({"robots": ALONE, "mission": MISSION + "diameter = 9.0"}, "mission.diameter: it is for robots with"),
        (
            {"robots": APART, "anchors": "", "mission": RELATIVE + "\ndiameter = 9.0"},
            "robot[1].start: it is not within mission.diameter = 9 m of that of 'a'",
        ),
        (
            {"robots": TWO, "anchors": "", "mission": RELATIVE.replace("5.0", "0.5")},
            "is in range of no robot",
        ),
        ({"robots": TWO, "more": "[team]\nrobots = 2\nside = 4.0"}, "team: its robots and anchors are drawn"),
        ({"robots": "", "anchors": DRAWN + "unknown = 4"}, "team.unknown: more than team.anchors = 3"),
        ({"robots": ALONE + "\nanchor = [0.0, 0.0]"}, "robot[0].anchor: it is not for robots that share"),
        (
            {"robots": ALONE + '\nattack = {kind = "shift", size = 1.0}'},
            "robot[0].attack: robots of a team be",
        ),
        (
            {"robots": ALONE + '\nattack = {kind = "heading", size = 1.0}'},
            "robot[0].attack: robots of a team re",
        ),
        (
            {"robots": TWO, "anchors": "", "mission": RELATIVE + "tolerates = 1"},
            "mission.tolerates: with mission.frame",
        ),
        (
            {"robots": TWO + ATTACK, "anchors": "", "mission": RELATIVE},
            "robot[1].attack: robots of a team believe the measurements of all others: with mission.frame,",
        ),
        (
            {
                "robots": TWO + ATTACK,
                "anchors": ANCHORS + '[[anchor]]\nid = "A4"',
                "mission": MISSION + "survey = 0.05",
            },
            "robot[1].attack: robots of a team believe the measurements of all others: with mission.survey,",
        ),
        ({"robots": TWO + ATTACK}, "others: set mission.tolerates = 1"),
        ({"robots": TWO + '\npeer = "a"'}, "robot[1].peer: it is not for robots that share"),
        (
            {"robots": "", "anchors": DRAWN.replace("robots = 2", "robots = 1") + "dies = 3"},
            "team.dies: it is",
        ),
        ({"robots": "", "anchors": DRAWN + "dies = [9, 3]"}, "team.dies: the lower bound 9 is above"),
        ({"robots": ALONE, "anchors": ""}, "robot: one robot alone needs at least two [[anchor]]"),
        ({"robots": TWO.replace('"b"', '"a"')}, "robot.id: 2 robots have the id 'a'"),
        (
            {"robots": TWO, "more": 'planner = {name = "paper"}'},
            "planner.name: robots with the planner paper",
        ),
    ],
)
def test_a_team_that_cannot_run_is_refused_with_one_line(fields: dict[str, Any], why: str) -> None:
    with pytest.raises(BadScenario) as refused:
        team(**fields)
    assert why in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("link", "anchors", "why"),
    [("mutual/a", "", "the fit fails the consistency test"), ("anchor/a-A1", ANCHORS, "ranges fit no other")],
)
def test_a_link_of_a_team_whose_ranges_are_attacked_leads_to_no_wrong_claim(
    link: str, anchors: str, why: str
) -> None:
    attacked = f'[world.range]\nmodel = "attacked"\noptions = {{link = "{link}", by = 1.0}}\n'
    run = run_mission(replace(team(TWO, anchors + attacked, MISSION if anchors else RELATIVE), max_ticks=40))
    assert run.end is not None
    assert run.end.outcome == "undecided"
    assert any(why in (one.text or "") for one in run.end.causes)


@pytest.mark.parametrize(
    "scenario",
    [
        load("room"),
        load("relative"),
        SCATTERED,
        team("", DRAWN + "unknown = 1"),
        team(ALONE + '\nanchors = ["A3", "A1"]', ANCHORS.replace("[3.0, 0.0]", "[3.0, 0.0]\nsigma = 0.2")),
    ],
    ids=["room", "relative", "scattered", "drawn", "listed"],
)
def test_a_file_with_the_content_of_a_team_has_the_same_scenario(scenario: Scenario) -> None:
    assert template_of(file_table(scenario)).scenario == scenario


def test_a_room_that_is_drawn_follows_from_its_seed() -> None:
    one, again = team("", DRAWN), team("", DRAWN)
    assert one == again
    other = parse(f'name = "team"\nseed = 2\n{MISSION}\n{DRAWN}', "team")
    assert parse(f'name = "team"\nseed = 1\n{MISSION}\n{DRAWN}', "team", seed=2) == other
    assert other.team != one.team
    assert [robot.start for robot in other.robots] != [robot.start for robot in one.robots]


def spoilt(scenario: Scenario, changed: Scenario) -> None:
    frames = kept(scenario)
    frames["world.journal"] = [
        encode(changed) if x == encode(scenario) else x for x in frames["world.journal"]
    ]
    of_frames(frames)


def test_a_journal_of_a_team_that_is_none_is_refused() -> None:
    scenario = load("room")
    assert scenario.team is not None
    a, b = scenario.robots
    met = load("paper-1").robots[0].encounter
    for changed, why in (
        (replace(scenario, robots=(a, replace(b, encounter=met))), "b of a team has a peer"),
        (replace(scenario, robots=(a, replace(b, given_anchor=Anchor(0.0, 0.0)))), "an anchor of its own"),
        (
            replace(scenario, robots=(a, replace(b, ranges=("A9",)))),
            "b may range an anchor that is not there",
        ),
        (replace(scenario, team=replace(scenario.team, origin="z")), "there is no robot z"),
        (replace(scenario, team=replace(scenario.team, anchors=scenario.team.anchors * 2)), "the same name"),
        (replace(scenario, team=None), "a has no peer"),
    ):
        with pytest.raises(CorruptJournal, match=why):
            spoilt(scenario, changed)


# --- what is made of a run -----------------------------------------------------------------------------


def test_a_claim_with_fewer_ranges_than_determine_a_pose_is_a_violation() -> None:
    run = run_mission(team(ALONE))
    recorded = of_frames(kept(run.scenario))
    agent = recorded.agents["a"]
    bare = [replace(one, observation=replace(one.observation, anchors=())) for one in agent.steps]
    spoilt_run = replace(recorded, agents={"a": replace(agent, steps=tuple(bare))})
    found = [one.what for one in audit_run(spoilt_run).violations if one.rule == "claim"]
    assert any("ranges that determine a pose" in one for one in found)


def test_an_exact_team_without_anchors_claims_by_fewer_ranges_without_a_violation() -> None:
    mission = MISSION.replace("0.05", "0.0").replace("0.1", "0.2")
    drawn = 'frame = "relative"\narea = [0.0, 0.0, 10.0, 10.0]\n[team]\nrobots = 3\nside = 10.0\n'
    text = f'name = "relative"\nseed = 2837363329321034163\n{mission}{drawn}'
    run = of_frames(kept(parse(text, "relative")))
    first, *_ = [k for k, tick in enumerate(run.ticks) if tick.commands["r1"].verdict is not None]
    assert 2 * (first + 1) < MUTUAL_RANGES
    assert audit_run(run).violations == ()


def test_a_run_of_a_team_is_a_range_recording_with_its_anchors_by_name() -> None:
    run = run_mission(team("", DRAWN + "unknown = 1"))
    recording = ranges_of_run(run)
    assert [one.id for one in recording.anchors] == ["A1", "A2", "A3"]
    assert [one.sigma for one in recording.anchors] == [0.0, 0.0, float("inf")]
    assert len(recording.ranges.t) == sum(
        len(seen[robot].anchors) for seen in run.observations[: run.length] for robot in seen
    ) + sum(bool(seen["r1"].contacts) for seen in run.observations[: run.length])


def test_a_trial_of_a_team_has_no_columns_of_pairs() -> None:
    scenario = load("room")
    found = row(Trial(0, 0, scenario, processes=False), run_mission(scenario), 1.0)
    assert (found.outcome, found.claims, found.claims_within) == ("localised", 2, 2)
    assert (found.meeting_tick, found.orbiting_tick, found.robots["a"].bound_m) == (None,) * 3
    assert found.t_max_s == scenario.t_max
    columns = found.group
    assert columns is not None
    assert (columns.bound_ticks, columns.honest_localised) == (round(scenario.t_max), 2)
    assert (columns.honest_undecided, columns.honest_wrong, columns.attacker_met) == (0, 0, None)


def test_the_python_api_has_the_ranges_to_all_anchors() -> None:
    world = tandem.World(file_table(team(ALONE)))
    seen = world.observe()["a"]
    assert [one.anchor for one in seen.anchors] == ["A1", "A2", "A3"]
    assert seen.anchor_range is None
    assert seen.nearest_anchor_range == min(one.range for one in seen.anchors)
    result = tandem.run("room")
    assert result.outcome == "localised"


def test_a_driver_reports_the_ranges_to_the_anchors_of_a_team() -> None:
    config = team(ALONE + '\nanchors = ["A1", "A3"]').config("a")
    reading = Reading(Controls(0.0, 0.0), anchors={"A3": 2.0, "A1": None})
    assert decode(observation_frame(reading, 1, config), Observation).anchors == (NamedRange("A3", 2.0),)
    for wrong, why in (
        (replace(reading, anchors={"A2": 1.0}), "'A2' is none that a may range"),
        (replace(reading, anchors=3), "anchors is a int"),
        (replace(reading, mutual_range=1.0), "robots of a team have no peer"),
        (replace(reading, anchors={"A1": -1.0}), "Expected `float` >= 0.0"),
    ):
        with pytest.raises(InvalidReading, match=why):
            observation_frame(wrong, 1, config)


def test_a_recorded_team_is_audited_and_exported(tmp_path: Path) -> None:
    out = tmp_path / "out"
    shown = tandem_command("run", "relative", "--in-process", "--out", out)
    assert shown.status == 0, shown
    assert "ranges to anchors + to other robots" in " ".join(shown.out.split())
    assert tandem_command("audit", out).status == 0
    summed = json.loads((out / "summary.json").read_text())
    assert summed["t_max_s"] > 0.0
    assert {robot["localised"] for robot in summed["robots"].values()} == {True}
    run = read(out)
    assert all(isinstance(one, Localised) for one in run.verdicts().values())
    assert "poses are in the frame of that of a" in tandem_command("estimate", out).out
    assert "b has ranges to no anchor" in tandem_command("estimate", out, "--robots", "b,c").err
