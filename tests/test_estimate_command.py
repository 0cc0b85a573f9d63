"""The command `estimate`: its table, its files, the run that the page plays, and its refusals."""

from __future__ import annotations

import csv
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from agent.estimation.following import ClaimRule
from compose.cli import estimate as estimate_command
from compose.cli.commands import COMMANDS
from compose.cli.main import command_parser
from compose.errors import NOT_LOCALISED, USER_ERROR, CannotWrite, UserError
from compose.recording.estimating import estimate_run
from compose.recording.estimating.estimate_rows import PoseEstimateRow
from compose.recording.estimating.estimate_run import RecordingEstimate, estimated
from compose.recording.estimating.recorded_measurements import EPOCH_S, measurements
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_recording import RangeRecording
from compose.view.epochs import played, write_player
from compose.view.played_estimate import PLAYER_JSON, read_player
from compose.view.recorded import scenes as recorded_scenes
from protocol.messages import Estimate, Observation
from protocol.motion import compose, inverse, travelled
from tandem import estimate
from tests.commands import tandem
from tests.range_tables import SAMPLE, circling, written_csv
from tests.test_estimate import sample_estimates


@pytest.fixture(scope="module")
def of_sample(sample: RangeRecording) -> RecordingEstimate:
    return sample_estimates(sample)


def test_a_folder_that_cannot_be_written_is_refused_before_the_estimate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(estimate_run, "estimated", None)
    parser = command_parser(next(one for one in COMMANDS if one.name == "estimate"))
    words = [str(SAMPLE), "--window", "0..8", "--out", str(tmp_path / "file")]
    with pytest.raises(CannotWrite, match="file cannot be written: File exists"):
        estimate_command.main(parser.parse_all(words))


def test_the_page_plays_an_estimate_as_a_run_in_which_claims_and_hypotheses_are_those_of_the_estimate(
    sample: RangeRecording, of_sample: RecordingEstimate, tmp_path: Path
) -> None:
    problem = measurements(sample, ("A", "B"), "uwb-calibrated", None)
    write_player(tmp_path, problem, of_sample)
    found = read_player(tmp_path)
    assert found is not None
    known = found.run_data()
    scenes = {one.tick: one for one in recorded_scenes(found.setup, known)}
    for epoch in of_sample.epochs:
        scene = scenes[round((epoch.t - problem.t0) / EPOCH_S)]
        for row in epoch.rows:
            player = scene.player(row.robot)
            assert player.held is not None
            assert player.command is not None
            assert player.pose is not None
            assert len(player.held.world) == len(epoch.hypotheses)
            assert (player.held.world[0].x, player.held.world[0].y) == (row.x, row.y)
            assert travelled(player.held.world[0], player.pose) == pytest.approx(row.position_error_m)
            assert (player.command.verdict is not None) == row.claim
    texts = [caption.text for scene in scenes.values() for caption in scene.captions]
    assert [text for text in texts if "to know" in text] == [
        "B claims to know its pose.",
        "A claims to know its pose.",
    ]
    assert texts[-1] == "Both are localised: each knows its position and its heading."
    ranged = sum([len(player.anchors) for scene in scenes.values() for player in scene.players])
    assert ranged == of_sample.summary.ranges["A-LC0"] + of_sample.summary.ranges["B-LC1"]
    text, file = (tmp_path / PLAYER_JSON).read_text(), tmp_path / PLAYER_JSON
    for was, new, says in [
        ('"mode":"estimate"', '"mode":null', "setup: it is not of an estimate"),
        ('{"id":"B"', '{"id":"A"', "setup.robots: there are none, or two of one name"),
        ('"tick":1,', '"tick":9,', "epochs: their ticks do not increase to that of the end"),
        ('["observation",1,"A"', '["observation",1,"z"', "epochs: something is of another robot or tick"),
    ]:
        assert was in text
        file.write_text(text.replace(was, new, 1))
        with pytest.raises(UserError) as bad:
            read_player(tmp_path)
        assert str(bad.value) == f"{file} cannot be read: {says}"


def test_after_a_long_gap_the_page_has_ranges_and_odometry_of_their_times(sample: RangeRecording) -> None:
    gap_s, after_s = 20.0, 20.0
    begin = sample.span[0]

    def later(t: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(t >= begin + after_s, gap_s, 0.0)

    robots = []
    for robot in sample.robots:
        path, late = robot.odometry, later(robot.odometry.t0)
        robots.append(robot._replace(odometry=path._replace(t0=path.t0 + late, t1=path.t1 + late)))
    moved = sample.ranges._replace(t=sample.ranges.t + later(sample.ranges.t))
    gapped = sample._replace(robots=tuple(robots), ranges=moved)
    problem = measurements(gapped, ("A", "B"), "uwb-calibrated", None)
    player = played(problem, estimated(problem, ClaimRule(0.3, 0.9999)))
    after = [one for one in player.epochs if one.tick * EPOCH_S > after_s + gap_s + 1.0]
    observed = [one for epoch in after for one in epoch.messages if isinstance(one, Observation)]
    assert len(after) > 10
    assert all(one.executed is not None for one in observed)
    assert sum([len(one.anchors) for one in observed]) > 10


def test_the_page_has_the_way_to_each_pose_by_odometry(
    sample: RangeRecording, of_sample: RecordingEstimate
) -> None:
    player = played(measurements(sample, ("A", "B"), "uwb-calibrated", None), of_sample)
    for robot in "AB":
        estimates = [
            (epoch.truth[robot], one)
            for epoch in player.epochs
            for one in epoch.messages
            if isinstance(one, Estimate) and one.robot == robot and one.world
        ]
        last = estimates[-1][1]
        turn = compose(last.world[0], inverse(last.local[0]))
        assert max(travelled(compose(turn, one.local[0]), truth) for truth, one in estimates) < 0.5
        assert travelled(estimates[0][0], estimates[-1][0]) > 2.0


def test_the_command_writes_a_table_a_summary_and_figures(tmp_path: Path) -> None:
    ended = tandem("estimate", str(SAMPLE), "--noise", "uwb-calibrated", "--out", "found", cwd=tmp_path)
    assert (ended.status, ended.err) == (0, "")
    page = (Path(__file__).parents[1] / "docs" / "howto-estimate.md").read_text("utf-8")
    assert page.split("```text\n")[1].split("```")[0] in ended.out, "the page shows this table"
    names = {"estimate.csv", "estimate.json", "estimate-path.svg", "estimate-over-time.svg"}
    assert names <= {path.name for path in (tmp_path / "found").iterdir()}
    with (tmp_path / "found" / "estimate.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == PoseEstimateRow.__struct_fields__
    assert {row["robot"] for row in rows} == {"A", "B"}
    summary = json.loads((tmp_path / "found" / "estimate.json").read_text())
    claim = summary["robots"]["A"]["first_claim"]
    assert set(claim) == {
        "t_s", "pose", "covariance", "probability", "position_error_m", "heading_error_rad", "nees",
    }  # fmt: skip
    assert [len(claim["covariance"]), len(claim["covariance"][0]), len(claim["pose"])] == [3, 3, 3]
    assert summary["hypotheses"][0]["probability"] > 0.99
    assert set(summary["calibration"]["pair_bias_m"]) == {"A-LC0", "B-LC1", "A-B"}
    first = next(row for row in rows if row["robot"] == "A" and row["claim"] == "true")
    assert [float(first[name]) for name in ("t_s", "x", "y", "heading")] == [claim["t_s"], *claim["pose"]]


def test_without_truth_there_are_no_errors(tmp_path: Path) -> None:
    lines = [line for line in SAMPLE.read_text().splitlines() if not line.startswith("VERTEX_SE2")]
    first = [line for line in SAMPLE.read_text().splitlines() if line.startswith(("VERTEX_SE2 0.3107", "V"))]
    begin = [line for line in first if line.split()[2] in ("A100", "B100")]
    (tmp_path / "blind.pyfg").write_text("\n".join([*begin, *lines, ""]))
    ended = tandem(
        "estimate", "blind.pyfg", "--noise", "uwb-calibrated", "--window", "0..6", "--out", ".", cwd=tmp_path
    )
    assert ended.status == NOT_LOCALISED
    assert "no claim at the end: " in ended.out
    with (tmp_path / "estimate.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["nees"] for row in rows} == {""}


@pytest.mark.parametrize("until_s", [-1.0, 20.0])
def test_ranges_of_other_times_than_the_odometry_are_named(until_s: float, tmp_path: Path) -> None:
    edges = [line.split() for line in SAMPLE.read_text().splitlines()]
    ranges = [words for words in edges if words[0] == "EDGE_RANGE"]
    late = [words for words in ranges if float(words[1]) - float(edges[0][1]) > until_s]
    for words in late:
        words[1] = str(float(words[1]) + 1.7e9)
    (tmp_path / "late.pyfg").write_text("\n".join([" ".join(words) for words in edges]))
    ended = tandem("estimate", "late.pyfg", cwd=tmp_path)
    if len(late) < len(ranges):
        (unused,) = re.findall(r"(\d+) ranges not used: without odometry of all robots", ended.out)
        assert 0 <= int(unused) - len(late) < 10, "a few are of the seconds before and after"
    else:
        assert ended.status == USER_ERROR
        assert "late.pyfg: ranges are of 17000" in ended.err
        assert "stamps have to be in s, on one clock" in ended.err


def test_a_window_without_ranges_is_not_said_to_be_of_another_clock(sample: RangeRecording) -> None:
    begin, _ = sample.span
    late = sample._replace(ranges=sample.ranges.rows(sample.ranges.t > begin + 10.0))
    with pytest.raises(UserError) as error:
        measurements(late, ["A"], None, (0.0, 5.0))
    assert "clock" not in str(error.value)


def test_anchors_with_a_sigma_are_estimated_and_written_as_the_next_estimate_reads_them(
    sample: RangeRecording, tmp_path: Path
) -> None:
    lines = [f"{one.id},{one.x + 0.1},{one.y - 0.1},0.1" for one in sample.anchors]
    (tmp_path / "anchors.csv").write_text("\n".join(["anchor,x,y,sigma", *lines, ""]))
    ended = tandem(
        "estimate", str(SAMPLE), "--noise", "uwb-calibrated", "--anchors", "anchors.csv", "--accuracy", "0.5",
        "--window", "0..16", "--out", "found", cwd=tmp_path,
    )  # fmt: skip
    assert ended.err == ""
    summary = json.loads((tmp_path / "found" / "estimate.json").read_text())
    assert set(summary["anchors"]) == {"LC0", "LC1"}
    (again, _) = read_ranges(SAMPLE, tmp_path / "found" / "anchors.csv").anchors
    one = summary["anchors"]["LC0"]
    assert [again.x, again.y] == one["position"]
    assert 0.02 < again.sigma < 0.15
    assert f"anchor LC0: {again.x:.2f} {again.y:.2f}, with a sigma of {again.sigma:.2f} m" in ended.out
    for true in sample.anchors:
        position = summary["anchors"][true.id]["position"]
        assert math.dist(position, (true.x, true.y)) < 0.4


@pytest.mark.parametrize(("robot", "window"), [("s", None), ("r", (0.0, 5.0))])
def test_a_robot_without_ranges_is_not_said_to_have_another_clock(
    robot: str, window: tuple[float, float] | None, tmp_path: Path
) -> None:
    tables = circling(12.0)
    tables["odometry"] += [row | {"robot": "s"} for row in tables["odometry"]]
    tables["ranges"] = [row for row in tables["ranges"] if float(str(row["t"])) > 6.0]
    with pytest.raises(UserError, match=f"one robot needs .*: {robot} has ranges to no anchor$"):
        estimate(written_csv(tmp_path, tables), robots=[robot], window=window)


def test_ranges_that_no_radio_can_have_cost_no_claim(tmp_path: Path) -> None:
    tables = circling(12.0)
    for row in [row for row in tables["ranges"] if row["to"] == "B"][8:14]:
        row["range"] = 1e7
    found = estimate(written_csv(tmp_path, tables))
    assert found.summary.blocking_reason == ""
    assert found.rows["claim"][found.rows["t_s"] > 4.0].all()


def test_the_doubtful_estimate_of_an_anchor_is_not_called_elsewhere_than_surveyed(tmp_path: Path) -> None:
    tables = circling(5.0)
    tables["anchors"][3] = {"anchor": "D", "x": "", "y": ""}
    found, why = estimate(written_csv(tmp_path, tables)), "8 of 12 of its ranges fit no other"
    summary = replace(found.summary, doubtful_anchors={"A": why, "D": why})
    lines = estimate_command._lines(found.problem, found.result._replace(summary=summary))
    assert [line for line in lines if why in line] == [
        f"anchor A seems to stand elsewhere than surveyed: {why}",
        f"anchor D has a doubtful estimate: {why}",
    ]


def test_an_anchor_that_two_ranges_do_not_locate_has_no_place_in_a_relative_frame(tmp_path: Path) -> None:
    tables = circling(8.0)
    tables["ranges"] = [row for row in tables["ranges"] if row["to"] == "A"][:2]
    found = estimate(written_csv(tmp_path, tables), relative="r")
    assert (found.summary.anchors, found.summary.unverified_anchors) == ({}, {})
    assert found.summary.blocking_reason == "r: 0 of 8 required ranges from different places"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("bad.pyfg",), "bad.pyfg, line 2: EDGE_RANGE has 3 fields and needs 5"),
        (("no.pyfg",), "no.pyfg cannot be read: No such file or directory"),
        ((str(SAMPLE), "--robots", "A,C"), "has no robot C; it has A, B"),
        ((str(SAMPLE), "--robots", "A"), "one robot needs ranges to two anchors at different places: A has"),
        ((str(SAMPLE), "--noise", "ubw"), "'ubw' is neither a profile (uwb, uwb-calibrated, wheels, camera)"),
        (
            (str(SAMPLE), "--noise", "bad.toml"),
            "bad.toml: mission.noise: unknown field 'range_bais'; did you mean 'range_bias'?",
        ),
        ((str(SAMPLE), "--window", "40..50"), "has odometry of 30.0"),
        ((str(SAMPLE), "--window", "10"), "'10' is not a window in seconds such as 10..40"),
        ((str(SAMPLE), "--anchors", "bad.csv"), "bad.csv, line 2: y: expected a number, got 'x'"),
        ((str(SAMPLE), "--anchors", "half.csv"), "half.csv, line 2: it has one of x and y"),
        ((str(SAMPLE), "--anchors", "none.csv"), "two robots need ranges to two anchors"),
    ],
)
def test_bad_input_is_one_line_with_its_place(words: tuple[str, ...], says: str, tmp_path: Path) -> None:
    (tmp_path / "bad.pyfg").write_text("VERTEX_XY L0 4.0 5.0\nEDGE_RANGE 0.6 A1 B1\n")
    (tmp_path / "bad.toml").write_text("[mission.noise]\nrange_bais = 0.1\n")
    (tmp_path / "bad.csv").write_text("anchor,x,y\nLC0,1,x\n")
    (tmp_path / "half.csv").write_text("anchor,x\nLC0,1\n")
    (tmp_path / "none.csv").write_text("anchor\nLC0\n")
    ended = tandem("estimate", *words, cwd=tmp_path)
    assert ended.status == USER_ERROR
    assert ended.out == ""
    assert ended.err.count("\n") == 1
    assert says in ended.err
