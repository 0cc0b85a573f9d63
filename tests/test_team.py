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
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from agent.estimation import following, judged
from agent.estimation.fit import Fit
from agent.estimation.gaussian import search as searching
from agent.estimation.gaussian.claim_agreement import united
from agent.estimation.gaussian.claim_rivals import Rival, likeliest_rival
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.search import search
from agent.estimation.posterior import Posterior, carried
from compose.audit.claim_rules import bound, distance
from compose.audit.rules import audit_run, replayed
from compose.errors import BadScenario
from compose.launch.in_process import run_mission
from compose.recording.run import of_frames, read
from compose.recording.summary_json import summary
from compose.scenario.scenario_change import file_table
from compose.scenario.scenario_file import load, parse, scenario_table, template_of, validate
from compose.scenario.shipped_files import shipped
from compose.sweep.group_columns import group_columns
from protocol.journal.journal_file import CorruptJournal
from protocol.messages import Localised
from protocol.mission import Anchor
from protocol.motion import Covariance, Pose
from protocol.team_motion import spiral
from protocol.wire import encode
from tests.commands import journals
from tests.commands import tandem as tandem_command
from tests.missions import kept, outcome
from tests.moving_groups import PERIOD_S, joint_measurements, moving_group
from tests.relative_teams import scenario_of
from tests.series import series
from world.scenario import Scenario
from world.tick import observations, release
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


def team(
    robots: str, anchors: str = ANCHORS, mission: str = MISSION, more: str = "", *, seed: int = 1
) -> Scenario:
    """Return the scenario of a team with these tables."""
    return parse(f'name = "team"\nseed = {seed}\n{more}\n{mission}\n{anchors}\n{robots}', "team")


def drawn(robots: int, seed: int, mission: str, *, anchors: int = 0, side: float = 10.0) -> Scenario:
    """Return the scenario of a team that is drawn in a square of `side` m."""
    more = f"\nanchors = {anchors}" if anchors else ""
    return team(f"[team]\nrobots = {robots}\nside = {side}{more}", "", mission, seed=seed)


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


def test_a_robot_that_finds_no_anchor_on_its_laps_returns_to_that_which_it_has_ranged() -> None:
    """Three ranges left two places of the anchor, and the robot drove about the wrong one to the end."""
    exact = MISSION.replace("0.05", "0.0").replace("sensing_range = 5.0", "sensing_range = 3.0")
    run = run_mission(drawn(1, 383674227, exact, anchors=5))
    assert outcome(run) == "localised"


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
    run = run_mission(drawn(3, 3199, exact))
    assert outcome(run) == "localised"
    assert (run.length - 1) < 30


def test_fits_that_have_not_converged_are_no_rivals_of_exact_ones() -> None:
    """Linear models explained ranges that the fits did not: the mission took 710 ticks."""
    exact = MISSION.replace("0.05", "0.0").replace(
        "accuracy = 0.1", 'accuracy = 0.2\nframe = "relative"\narea = [0.0, 0.0, 10.0, 10.0]'
    )
    run = run_mission(drawn(6, 77, exact))
    assert outcome(run) == "localised"
    assert run.length < 30


@pytest.mark.parametrize(("seed", "ticks"), [(1, 4), (104124, 7)])
def test_two_exact_robots_claim_by_five_ranges_or_drive_to_where_more_tell_enough(
    seed: int, ticks: int
) -> None:
    """The second two begin where five ranges leave more than rounding: they took 427 ticks."""
    area = 'accuracy = 0.2\nframe = "relative"\narea = [0.0, 0.0, 10.0, 10.0]'
    exact = MISSION.replace("0.05", "0.0").replace("accuracy = 0.1", area)
    run = run_mission(team('[[robot]]\nid = "r0"\n[[robot]]\nid = "r1"', "", exact, seed=seed))
    assert outcome(run) == "localised"
    assert run.length - 1 == ticks
    claim = run.claim("r1")
    assert claim is not None
    assert claim.position_error < 1e-9


def test_robots_without_anchors_turn_back_before_the_range_that_connects_them_is_lost() -> None:
    """Two of them start 4.5 m apart; on loops that did not turn back, they took 14 ticks."""
    run = run_mission(parse(scenario_of(3, 0.0, 1002), "met"))
    assert outcome(run) == "localised"
    assert run.length - 1 <= 7


def test_an_anchor_off_its_survey_is_named_before_its_ranges_pass_as_strays() -> None:
    table = file_table(drawn(2, 104, MISSION.replace("5.0", "8.0"), anchors=5))
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
    assert outcome(run) == "localised"


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


def test_a_robot_goes_to_one_that_has_ranged_the_anchor_that_it_does_not_know() -> None:
    """Late reports left b with a few ranges of a to two anchors, when a had its claim: 1 455 ticks."""
    table = scenario_table("survey")
    table["mission"]["noise"] = {"anchor_sigma": 0.0, "mutual_sigma": 0.0}
    table |= {"seed": 1, "fault": [{"link": "*", "duplicate": 0.7, "delay": [0, 3]}]}
    run = run_mission(validate(table, "late.toml").scenario)
    assert outcome(run) == "localised"
    assert run.length < 30


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
    assert (run.length - 1) < 60
    (blamed,) = [one.text or "" for one in run.end.causes if "stand elsewhere" in (one.text or "")]
    assert {"A1", "A2"} == set(re.findall("A[0-9]", blamed))


def test_an_anchor_with_three_ranges_from_one_line_is_not_said_to_stand_at_their_mirror_image() -> None:
    run = run_mission(replace(drawn(2, 1021, MISSION.replace("5.0", "3.0"), anchors=5), max_ticks=8))
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
    run = run_mission(replace(drawn(4, 1019, MISSION.replace("5.0", "3.0"), anchors=5), max_ticks=12))
    assert outcome(run) == "localised"


def test_an_anchor_with_a_sigma_that_is_ranged_for_the_first_time_ends_no_robot() -> None:
    places = [(9.0, 9.0), (0.5, 0.0), (6.0, 0.0), (0.0, 6.0), (3.0, 4.0)]
    anchors = [f'[[anchor]]\nid = "A{k}"\nposition = {[*at]}\nsigma = 0.05\n' for k, at in enumerate(places)]
    run = run_mission(team(ALONE + '\n[[robot]]\nid = "b"\nstart = [6.0, 6.0, 0.5]', "".join(anchors)))
    ranged = [{near.anchor for one in seen.values() for near in one.anchors} for seen in run.observations]
    assert not ranged[-1] <= ranged[0]
    assert outcome(run) == "localised"


APART = '[[robot]]\nid = "a"\nstart = [1.0, 1.0, 0.5]\n[[robot]]\nid = "b"\nstart = [9.0, 7.0, 2.0]'
SCATTERED = team(APART, "", MISSION.replace("0.05", "0.0") + '\nframe = "relative"\ndiameter = 10.0')


def test_the_first_robot_searches_for_one_that_starts_out_of_range_and_stands() -> None:
    run = run_mission(SCATTERED)
    assert outcome(run) == "localised"
    assert (run.length - 1) * run.scenario.mission.period <= run.scenario.t_max
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
    mission = f"{MISSION}safety_distance = 0.6\n{frame}"
    run = of_frames(kept(drawn(4, 2, mission, anchors=0 if frame else 2, side=4.0)))
    assert outcome(run) == "localised"
    assert audit_run(run).violations == ()
    assert summary(run, None, None)["nearest_m"] >= 0.6


def test_robots_that_block_each_other_make_way_in_their_order() -> None:
    """Two robots that both made way came nearer by half of what was left, again and again."""
    mission = (
        MISSION.replace("5.0", "2.5").replace("0.05", "0.0") + 'safety_distance = 0.6\nframe = "relative"\n'
    )
    run = run_mission(drawn(4, 1010, mission, side=4.0))
    assert outcome(run) == "localised"
    assert (run.length - 1) < 100
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
    run = of_frames(kept(team(robots, fault, mission, seed=seed)))
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
    square = DRAWN.replace("robots = 2", "robots = 4").replace("side = 4.0", "side = 8.0")
    scenario = team("", f"{square}attack = {{kind = {attack}}}\n", mission)
    assert template_of(file_table(scenario)).scenario == scenario
    run = of_frames(kept(scenario))
    assert audit_run(run).violations == ()
    columns = group_columns(run)
    assert columns is not None
    assert (columns.honest_localised, columns.honest_wrong) == (3, 0)


# --- scenarios -----------------------------------------------------------------------------------------

TWO = ALONE + '\n[[robot]]\nid = "b"\nstart = [2.0, 1.0, 0.0]'
SAME = ANCHORS.replace("[3.0, 0.0]", "[0.0, 0.0]").split('[[anchor]]\nid = "A3"')[0]
RELATIVE = MISSION.replace("accuracy", 'frame = "relative"\naccuracy')
ATTACK = '\nattack = {kind = "shift", size = 1.0, part = "all"}'
DRAWN = "[team]\nrobots = 2\nside = 4.0\nanchors = 3\n"


REFUSED = {
    "robot[0]: 'a' may range fewer than two anchors at different": (ALONE, SAME),
    "robot[0].start: no anchor that 'a' knows": (ALONE.replace("1.0, 1.0", "9.0, 9.0"),),
    "anchor.id: 2 anchors have the id 'A1'": (ALONE, ANCHORS.replace("A3", "A1")),
    "robot[0].anchors: there is no anchor 'B2'": (ALONE + '\nanchors = ["A1", "B2"]',),
    "robot[0]: 'a' may range fewer than two anchors": (ALONE + '\nanchors = ["A1"]',),
    "mission.frame: anchors determine the frame": (TWO, ANCHORS, RELATIVE),
    "robot[1].start: nearer to another one than 1.65 m": (TWO, ANCHORS, MISSION + "safety_distance = 0.5"),
    "mission.noise.gyro_bias: within the": (
        APART,
        "",
        RELATIVE.replace("0.05}", "0.05, gyro_bias = 0.01}") + "diameter = 10.0",
    ),
    "mission.frame: the poses of at least two": (ALONE, "", RELATIVE),
    "mission.diameter: it is for robots with": (ALONE, ANCHORS, MISSION + "diameter = 9.0"),
    "robot[1].start: it is not within mission.diameter = 9 m of that of 'a'": (
        APART,
        "",
        RELATIVE + "\ndiameter = 9.0",
    ),
    "is in range of no robot": (TWO, "", RELATIVE.replace("5.0", "0.5")),
    "team: its robots and anchors are drawn": (TWO, ANCHORS, MISSION, "[team]\nrobots = 2\nside = 4.0"),
    "team.unknown: more than team.anchors = 3": ("", DRAWN + "unknown = 4"),
    "robot[0].anchor: it is not for robots that share": (ALONE + "\nanchor = [0.0, 0.0]",),
    "robot[0].attack: robots of a team be": (ALONE + '\nattack = {kind = "shift", size = 1.0}',),
    "robot[0].attack: robots of a team re": (ALONE + '\nattack = {kind = "heading", size = 1.0}',),
    "mission.tolerates: with mission.frame": (TWO, "", RELATIVE + "tolerates = 1"),
    "robot[1].attack: robots of a team believe the measurements of all others: with mission.frame,": (
        TWO + ATTACK,
        "",
        RELATIVE,
    ),
    "robot[1].attack: robots of a team believe the measurements of all others: with mission.survey,": (
        TWO + ATTACK,
        ANCHORS + '[[anchor]]\nid = "A4"',
        MISSION + "survey = 0.05",
    ),
    "others: set mission.tolerates = 1": (TWO + ATTACK,),
    "robot[1].peer: it is not for robots that share": (TWO + '\npeer = "a"',),
    "team.dies: it is": ("", DRAWN.replace("robots = 2", "robots = 1") + "dies = 3"),
    "team.dies: the lower bound 9 is above": ("", DRAWN + "dies = [9, 3]"),
    "robot: one robot alone needs at least two [[anchor]]": (ALONE, ""),
    "robot.id: 2 robots have the id 'a'": (TWO.replace('"b"', '"a"'),),
    "planner.name: robots with the planner paper": (TWO, ANCHORS, MISSION, 'planner = {name = "paper"}'),
}
"""Tables that no team has: robots, anchors, mission and more, by what is wrong with them."""


@pytest.mark.parametrize("why", REFUSED)
def test_a_team_that_cannot_run_is_refused_with_one_line(why: str) -> None:
    with pytest.raises(BadScenario) as refused:
        team(*REFUSED[why])
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
    other = team("", DRAWN, seed=2)
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
