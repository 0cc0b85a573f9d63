"""Results of the runs of teams: audits, exports, figures, the page, anchors by name, claims."""

from __future__ import annotations

import json
import re
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

import tandem
from agent.estimation.judged import MUTUAL_RANGES
from compose.audit.rules import audit_run
from compose.launch import in_process
from compose.launch.in_process import run_mission
from compose.recording.ranging.run_ranges import ranges_of_run
from compose.recording.run import Run, of_frames, read
from compose.scenario import scenario_file
from compose.scenario.scenario_change import RobotChange, changed, file_table, values_of
from compose.scenario.scenario_file import load
from compose.sweep.trial import Trial, row
from compose.view.drawing import DARK, GREY, drawing, standing
from compose.view.numbers import Numbers
from compose.view.recorded import run_data, scenes
from compose.view.scene import HeldPoses, Scene
from protocol.messages import Localised, NamedRange, Observation
from protocol.motion import ORIGIN, Controls
from protocol.wire import decode
from tests.browser import Open, shot, watching
from tests.commands import copied
from tests.commands import tandem as command
from tests.missions import kept
from tests.test_team import ALONE, DRAWN, MISSION, drawn, team
from world.hardware.driver import Reading
from world.hardware.measurements import InvalidReading, observation_frame

SURVEY = """
name = "survey"
seed = 3
max_ticks = 300
robot = [{ id = "a" }, { id = "b" }]

[mission]
sensing_range = 8.0
period = 1.0
max_speed = 0.5
max_turn_rate = 1.0
accuracy = 0.15
noise = { anchor_sigma = 0.05, mutual_sigma = 0.05 }

[[anchor]]
id = "A1"
position = [0.0, 0.0]
[[anchor]]
id = "A2"
position = [10.0, 0.0]
sigma = 0.3
[[anchor]]
id = "A3"
stands = [7.0, 8.0]
[[anchor]]
id = "A4"
position = [0.0, 10.0]
"""
"""Four anchors: one is of unknown position, and one is not where it was surveyed."""


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("survey")
    (folder / "survey.toml").write_text(SURVEY)
    return ran(str(folder / "survey.toml"), folder / "recording")


@pytest.fixture(scope="module")
def relative(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ran("relative", tmp_path_factory.mktemp("relative") / "recording")


def ran(name: str, out: Path) -> Path:
    """Return the recording of a scenario."""
    out.mkdir()
    in_process.run_mission(scenario_file.load(name), out)
    return out


def seen(run: Run) -> list[Scene]:
    """Return the scenes of `run`."""
    assert run.setup is not None
    return list(scenes(run.setup, run_data(run)))


# --- words ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["survey", "relative"])
def test_no_sentence_of_a_team_speaks_of_a_peer_an_own_anchor_or_a_phase(
    name: str, request: pytest.FixtureRequest
) -> None:
    texts = []
    for scene in seen(read(request.getfixturevalue(name))):
        texts += [one.text for one in scene.captions] + [one.text for one in scene.events]
        texts += [player.activity for player in scene.players]
    assert len(texts) > 20
    assert not [text for text in texts if re.search(r"peer|its anchor|phase|pair|meet|orbit|None", text)]


def test_the_captions_of_a_team_begin_with_what_it_knows_and_end_with_its_claims(survey: Path) -> None:
    told = [caption for scene in seen(read(survey)) for caption in scene.captions]
    first = "The positions of three anchors are known, that of one more not. No robot knows where it is"
    assert told[0].text.startswith(first)
    assert [caption.kind for caption in told if caption.kind in ("rules", "configurations", "end")][:1] == [
        "rules"
    ]
    assert told[-1].text == "Both are localised: each knows its position and its heading."


def test_without_anchors_the_captions_name_the_frame(relative: Path) -> None:
    (first, *_) = seen(read(relative))[0].captions
    assert (
        first.text == "There is no anchor. All poses are those in the frame in which a starts at the origin."
    )


def test_a_contact_of_a_team_is_one_event_of_the_first_robot(relative: Path) -> None:
    first = [one.text for one in seen(read(relative))[0].events if one.kind == "contact"]
    assert [re.match(r"(.) and (.) are in range", text).groups() for text in first] == [  # type: ignore[union-attr]
        ("a", "b"), ("a", "c"), ("b", "c"),
    ]  # fmt: skip


def test_two_reports_of_different_senders_are_no_report_that_arrives_twice(relative: Path) -> None:
    assert not [one for scene in seen(read(relative)) for one in scene.events if one.kind == "report-doubled"]


# --- ranges ---------------------------------------------------------------------------------------------


def test_the_charted_range_of_a_team_is_that_to_the_nearest_anchor(survey: Path) -> None:
    run = read(survey)
    assert run.setup is not None
    several = residuals = 0
    for scene in seen(run):
        for player in scene.players:
            measured = run.observations[scene.tick][player.robot].anchors
            assert player.anchors == measured
            numbers = Numbers.in_scene(scene, run.setup.robot_setup(player.robot), run.setup)
            nearest = min(measured, key=lambda one: one.range)
            assert numbers.anchor_range_m == nearest.range
            several += len(measured) > 1
            if player.held is not None and player.held.world and nearest.anchor != "A3":
                residuals += abs(numbers.anchor_residual_m or 9.0) < 0.3
            if nearest.anchor == "A3":
                assert numbers.anchor_residual_m is msgspec.UNSET  # no robot knows where it is
    assert several
    assert residuals


def test_poses_in_a_frame_that_is_nowhere_in_the_world_are_not_drawn(survey: Path) -> None:
    """A robot of a team has no frame of an anchor, whatever its Estimates say."""
    run = read(survey)
    assert run.setup is not None
    scene = next(one for one in seen(run) if one.players[0].held is not None)
    held = HeldPoses(local=(ORIGIN,), world=(), probability=(), covariance=None, localised=False)
    players = (replace(scene.players[0], held=held), *scene.players[1:])
    drawn = {one.topic: one for one in drawing(run.setup, replace(scene, players=players))}
    assert drawn["/a/belief"].arrows == []


def test_exports_draw_anchors_where_they_are_and_a_line_for_each_range(survey: Path) -> None:
    run = read(survey)
    assert run.setup is not None
    drawn = {one.id: (one.place, one.rgb) for one in standing(run.setup)}
    assert drawn["A1"] == ((0.0, 0.0), DARK)
    assert drawn["A3"] == ((7.0, 8.0), GREY)
    assert drawn["A2"][0] != (10.0, 0.0)
    first = seen(run)[0]
    lines = {line.path: line.strips for one in drawing(run.setup, first) for line in one.lines}
    for player in first.players:
        found = {
            path.rpartition("/")[2] for path in lines if path.startswith(f"robots/{player.robot}/range/")
        }
        assert found == {one.id for one in run.setup.anchors}
        ranged = {one.anchor for one in player.anchors}
        assert {name for name in found if lines[f"robots/{player.robot}/range/{name}"]} == ranged


# --- change and run -------------------------------------------------------------------------------------


def test_a_team_is_run_again_from_other_starts(survey: Path) -> None:
    scenario = read(survey).scenario
    values = values_of(scenario)
    moved = RobotChange(5.0, 4.0, 0.0)
    again = changed(scenario, msgspec.structs.replace(values, robots={"a": moved}), 300).scenario
    assert (again.robots[0].start.x, again.robots[0].start.y) == (5.0, 4.0)
    assert again.robots[1].start == scenario.robots[1].start
    assert again.team == scenario.team


# --- figures --------------------------------------------------------------------------------------------


def test_tandem_figures_draws_a_team_and_says_in_one_line_what_is_not_of_teams(
    survey: Path, tmp_path: Path
) -> None:
    copy = copied(survey, tmp_path / "recording")
    done = command("figures", str(copy), "--format", "svg")
    assert done.status == 0, done.err
    assert {path.name for path in (copy / "figures").iterdir()} == {"trajectory.svg", "errors.svg"}
    assert done.err == (
        "tandem figures: no meetings, phases, geometry, phase-1, plan, encounter, ranges, robot: "
        "the robots of a team share all measurements, and form no pairs\n"
    )
    plane = (copy / "figures" / "trajectory.svg").read_text()
    named = {"path-a", "path-b", "anchor-A1", "anchor-A3", "claim-a", "outline-a"}
    assert named <= set(re.findall(r'id="([^"]+)"', plane))
    over_time = (copy / "figures" / "errors.svg").read_text()
    named = {f"{what}-{robot}" for what in ("position", "heading-sigma") for robot in "ab"}
    assert named <= set(re.findall(r'id="([^"]+)"', over_time))


# --- the page -------------------------------------------------------------------------------------------

LABELS = "() => document.getElementById('canvas').labels.map(({ text }) => text)"
ANCHORS = """() => document.getElementById('canvas').targets
  .filter(({ kind }) => kind === 'anchor').map(({ robot }) => robot)"""


def test_the_page_names_anchors_and_shows_unknown_ones_with_the_truth_only(
    opened: Open, survey: Path
) -> None:
    with watching(survey) as (_, where):
        page = opened(where, tick=0)
        shot(page, "team")
        assert page.evaluate(ANCHORS) == ["A1", "A2", "A3", "A4"]
        assert {"A1", "A3"} <= {*page.evaluate(LABELS)}
        assert "A1\u00a0" in page.locator(".card[data-robot=a] [data-row=measured]").last.inner_text()
        page.keyboard.press("t")
        page.wait_for_function(f"() => ({ANCHORS})().length === 3")
        assert page.evaluate(ANCHORS) == ["A1", "A2", "A4"]
        assert "A3" not in page.evaluate(LABELS)
        page.keyboard.press("End")  # where it is estimated, with its sigma, and the way that was driven
        page.wait_for_function(f"() => ({LABELS})().some((text) => /^A3 ± [0-9.]+ m?m$/.test(text))")
        shot(page, "team-located")
        legend = page.locator("#legend").inner_text()
        assert "anchor as a robot estimates it" in legend
        assert "path, pose estimated" in legend


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
    mission += 'frame = "relative"\narea = [0.0, 0.0, 10.0, 10.0]\n'
    run = of_frames(kept(drawn(3, 2837363329321034163, mission)))
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
    shown = command("run", "relative", "--in-process", "--out", out)
    assert shown.status == 0, shown
    assert "ranges to anchors + to other robots" in " ".join(shown.out.split())
    assert command("audit", out).status == 0
    summed = json.loads((out / "summary.json").read_text())
    assert summed["t_max_s"] > 0.0
    assert {robot["localised"] for robot in summed["robots"].values()} == {True}
    run = read(out)
    assert all(isinstance(one, Localised) for one in run.verdicts().values())
    assert "poses are in the frame of that of a" in command("estimate", out).out
    assert "b has ranges to no anchor" in command("estimate", out, "--robots", "b,c").err
