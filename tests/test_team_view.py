"""Teams in viewers, exports and figures: anchors by name, ranges to several, poses and claims."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from compose.launch import in_process
from compose.recording.run import Run, read
from compose.scenario import scenario_file
from compose.scenario.scenario_change import RobotChange, changed, values_of
from compose.view.drawing import DARK, GREY, drawing, standing
from compose.view.numbers import Numbers
from compose.view.recorded import run_data, scenes
from compose.view.scene import HeldPoses, Scene
from protocol.motion import ORIGIN
from tests.browser import Open, shot, until_shown, watching
from tests.commands import tandem

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
    copy = tmp_path / "recording"
    copy.mkdir()
    for path in survey.glob("*.journal"):
        (copy / path.name).write_bytes(path.read_bytes())
    drawn = tandem("figures", str(copy), "--format", "svg")
    assert drawn.status == 0, drawn.err
    assert {path.name for path in (copy / "figures").iterdir()} == {"trajectory.svg", "errors.svg"}
    assert drawn.err == (
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
        page = opened(f"{where}#tick=0")
        until_shown(page, 0)
        shot(page, "team")
        assert page.evaluate(ANCHORS) == ["A1", "A2", "A3", "A4"]
        assert {"A1", "A3"} <= {*page.evaluate(LABELS)}
        assert "A1\u00a0" in page.locator(".card[data-robot=a] [data-row=measured]").last.inner_text()
        page.keyboard.press("t")
        page.wait_for_function(f"() => ({ANCHORS})().length === 3")
        assert page.evaluate(ANCHORS) == ["A1", "A2", "A4"]
        assert "A3" not in page.evaluate(LABELS)
        page.keyboard.press("End")  # where it has been located, with its sigma, and the way that was driven
        page.wait_for_function(f"() => ({LABELS})().some((text) => /^A3 ± [0-9.]+ m?m$/.test(text))")
        shot(page, "team-located")
        legend = page.locator("#legend").inner_text()
        assert "where a robot has located an anchor" in legend
        assert "path, located" in legend
