"""Recordings that contradict themselves or determine no pose: the estimate says which of the two, and why."""

from __future__ import annotations

import csv
import json
import math
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import tandem as api
from agent.estimation import following
from agent.estimation.following import ClaimRule
from agent.estimation.gaussian.search import search
from agent.estimation.posterior import Posterior
from compose.errors import ENDED, NOT_LOCALISED, USER_ERROR, UserError
from compose.recording.estimating.calibration import calibrated
from compose.recording.estimating.doubtful_units import doubtful_units
from compose.recording.estimating.estimate_run import estimated
from compose.recording.estimating.recorded_measurements import measurements
from compose.recording.estimating.sound_odometry import sound
from compose.recording.estimating.true_poses import true_pose, with_bridged_truth
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_recording import FixedAnchor, RecordedRobot, RobotOdometry, TruePath
from protocol.motion import wrap
from tests.commands import tandem
from tests.series import series
from tests.test_anchored import ANCHORS, driven
from tests.test_estimate import simulated, with_ranges
from tests.test_follow import messages_of, written

CASES = Path(__file__).parent / "data" / "cases"
MILLIMETRES, STANDING, WRAPPED = CASES / "millimetres", CASES / "standing", CASES / "wrapped-yaw"
IN_MM = "ranges are about 1 000 times what odometry and anchors allow: are they in mm?"
MOST_S = 20.0
"""The time of the processor in s within which the suspicion about a unit is said."""

Factors = dict[str, float]
"""The factor of each column that is changed."""


def changed(source: Path, target: Path, factors: dict[str, Factors], last_s: float = math.inf) -> Path:
    """Copy a folder of CSV files with columns multiplied by `factors`, by file; no ranges after `last_s`."""
    target.mkdir()
    for path in source.glob("*.csv"):
        with path.open() as file:
            rows = list(csv.DictReader(file))
        if path.stem == "ranges":
            rows = [row for row in rows if float(row["t"]) <= last_s]
        for name, factor in factors.get(path.stem, {}).items():
            for row in rows:
                row[name] = repr(float(row[name]) * factor)
        with (target / path.name).open("w") as file:
            out = csv.DictWriter(file, list(rows[0]))
            out.writeheader()
            out.writerows(rows)
    return target


@pytest.fixture(scope="module")
def metres(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recording of two robots and two anchors with its ranges in m."""
    folder = tmp_path_factory.mktemp("units") / "metres"
    return changed(MILLIMETRES, folder, {"ranges": {"range": 1e-3}})


# --- units ------------------------------------------------------------------------------------------------


def test_ranges_in_mm_are_refused_in_one_line_and_the_api_says_why_nothing_is_claimed(tmp_path: Path) -> None:
    ended = tandem("estimate", MILLIMETRES, "--out", "found", cwd=tmp_path)
    assert ended == (USER_ERROR, "", f"tandem estimate: {MILLIMETRES}: {IN_MM}\n")
    assert not (tmp_path / "found").exists()
    begun = time.process_time()
    assert api.estimate(MILLIMETRES).summary.blocking_reason == IN_MM
    assert time.process_time() - begun < MOST_S


@pytest.mark.parametrize("robots", series([["r", "s"], ["r"]]))
@pytest.mark.parametrize(
    ("factors", "says"),
    [
        ({"ranges": {"range": 100.0}}, "ranges are about 100 times .*: are they in cm"),
        ({"ranges": {"range": 3.281}}, "ranges are about 3.3 times .*: are they in feet"),
        ({"odometry": {"dx": 1e3, "dy": 1e3}}, "odometry is about 1 000 times .*: is it in mm"),
        ({"anchors": {"x": 1e3, "y": 1e3}}, "positions of anchors are about 1 000 times .*: are they in mm"),
        ({"anchors": {"x": 3.281, "y": 3.281}}, "positions of anchors are about 3.3 .*: are they in feet"),
        ({"ranges": {"range": 1e3}, "odometry": {"dx": 1e3, "dy": 1e3}}, "are ranges and odometry in mm"),
        ({"odometry": {"dheading": 180.0 / math.pi}}, "the turns of odometry .*: are they in degrees"),
    ],
)
def test_the_api_suspects_each_unit_of_one_robot_and_of_two(
    factors: dict[str, Factors], says: str, robots: list[str], metres: Path, tmp_path: Path
) -> None:
    found = api.estimate(changed(metres, tmp_path / "other", factors), robots=robots)
    assert re.search(says, found.summary.blocking_reason)
    assert says.partition(" ")[0] in repr(found)
    assert not len(found.rows["robot"])
    assert all(one.first_claim is None for one in found.summary.robots.values())


@pytest.mark.parametrize(
    ("ranges", "dx", "turn", "says"),
    [
        (1e3, 1.0, 1.0, "s: ranges are about 1 000 times what odometry and anchors allow: are they in mm?"),
        (1.0, 1e3, 1.0, "s: odometry is about 1 000 times what ranges and anchors allow: is it in mm?"),
        (
            1.0,
            1.0,
            180.0 / math.pi,
            "s: the turns of odometry agree with the ranges only as degrees: are they",
        ),
    ],
)
def test_of_two_robots_the_one_in_another_unit_is_named(
    ranges: float, dx: float, turn: float, says: str, metres: Path
) -> None:
    recording = read_ranges(metres)
    of_s = (recording.ranges.first == 1) & (recording.ranges.second >= 2)
    recording = with_ranges(recording, np.where(of_s, ranges, 1.0) * recording.ranges.range)
    r, s = recording.robots
    increments = s.odometry.increments * np.array((dx, dx, turn))
    s = s._replace(odometry=s.odometry._replace(increments=increments))
    assert says in measurements(recording._replace(robots=(r, s)), None, None, None).doubt


@pytest.mark.parametrize(("anchors", "suspected"), [(4, True), (2, False)])
def test_clockwise_turns_are_suspected_by_ranges_to_three_anchors(anchors: int, suspected: bool) -> None:
    recording = driven(ANCHORS[:anchors], sigma=0.05)
    assert measurements(recording, None, None, None).doubt == ""
    (robot,) = recording.robots
    increments = robot.odometry.increments * np.array((1.0, -1.0, -1.0))
    robot = robot._replace(odometry=robot.odometry._replace(increments=increments))
    doubt = measurements(recording._replace(robots=(robot,)), None, None, None).doubt
    assert ("are turns clockwise?" in doubt) == suspected


@pytest.mark.parametrize("seed", [10, 12, 31])
def test_a_straight_path_does_not_tell_left_from_right(seed: int) -> None:
    """Places on the wrong side fitted best by chance, and a good recording was refused."""
    on_the_left = FixedAnchor("B", 4.3, 6.6), FixedAnchor("C", 7.3, 9.4), FixedAnchor("D", 11.6, 10.0)
    assert doubtful_units(driven(on_the_left, turn_rate=0.0, sigma=0.05, seed=seed)) == ""


@pytest.mark.parametrize("speed", [0.0, 0.1])
def test_turns_of_a_robot_that_stands_or_drives_straight_are_not_suspected(speed: float) -> None:
    """Each anchor may be on either side of a straight path: some such robots were suspected."""
    (robot,) = driven(ANCHORS).robots
    t0, count = robot.odometry.t0, len(robot.odometry.t0)
    increments = np.tile((speed * (t0[1] - t0[0]), 0.0, 0.0), (count, 1))
    straight = robot._replace(odometry=robot.odometry._replace(increments=increments))
    for seed in range(20):
        draws, ranges = np.random.default_rng(seed), driven(ANCHORS).ranges
        places = np.array([complex(one.x, one.y) for one in ANCHORS])[ranges.second - 1]
        away = places - complex(3.0 + seed / 10.0, 3.0) - speed * ranges.t
        recording = driven(ANCHORS)._replace(robots=(straight,))
        recording = with_ranges(recording, np.abs(away) + 0.1 * draws.standard_normal(len(away)))
        assert doubtful_units(recording) == ""


@pytest.mark.parametrize(("factor", "suspected"), [(11.0, False), (39.37, True)])
def test_the_ranges_to_one_anchor_in_one_part_tell_of_units_only(factor: float, suspected: bool) -> None:
    """Odometry that slips looked like a factor of 11, and a good recording was refused."""
    recording = simulated()
    recording = recording.part([recording.robots[0].id], 0.0, 30.0)
    recording = with_ranges(recording, factor * recording.ranges.range)
    ranges = recording.ranges
    one = recording._replace(ranges=ranges.rows(ranges.second == ranges.second[0]))
    assert bool(doubtful_units(one)) == suspected


def test_two_robots_with_an_anchor_each_are_suspected_too() -> None:
    recording = simulated()
    in_mm = with_ranges(recording, 1e3 * recording.ranges.range)
    assert "ranges are about 1 000 times what odometry" in measurements(in_mm, None, None, None).doubt
    assert not measurements(recording, None, None, None).doubt


@pytest.mark.parametrize(("factor", "says"), [(1e3, "1 000 times"), (1e-3, "1/1 000 of")])
def test_ranges_between_two_robots_in_another_unit_than_those_to_anchors_are_named(
    factor: float, says: str, metres: Path
) -> None:
    recording = read_ranges(metres)
    ranges = recording.ranges
    mutual = ranges.second < 2
    changed_ranges = with_ranges(recording, np.where(mutual, factor, 1.0) * ranges.range)
    doubt = measurements(changed_ranges, None, None, None).doubt
    assert f"ranges of r and s are about {says}" in doubt
    assert re.search("are (they|ranges to anchors) in mm", doubt)
    with pytest.raises(
        UserError, match=r"by its true poses, r-s has a .*: are stamps, positions and units right"
    ):
        calibrated(changed_ranges, None, None)


def test_the_suspicion_is_said_while_a_stream_arrives_and_no_estimate_is_printed(tmp_path: Path) -> None:
    early = [
        (t, topic, {name: value for name, value in row.items() if str(value) != "nan"})
        for t, topic, row in messages_of(read_ranges(MILLIMETRES))
        if t <= 10.0
    ]
    (tmp_path / "it.mcap").write_bytes(written(early))
    ended = tandem("estimate", "it.mcap", "--follow", "--out", "found", cwd=tmp_path)
    assert ended.status == NOT_LOCALISED
    assert IN_MM in ended.err
    assert ",true," not in ended.out
    assert json.loads((tmp_path / "found" / "estimate.json").read_text())["blocking_reason"] == IN_MM


@pytest.mark.parametrize(
    ("flags", "says"),
    [((), "by its true poses, r-s has a bias of +6641 m"), (("--without-truth",), IN_MM)],
)
def test_radios_whose_unit_is_suspected_are_not_calibrated(flags: tuple[str, ...], says: str) -> None:
    ended = tandem("calibrate", MILLIMETRES, *flags)
    assert (ended.status, ended.out) == (USER_ERROR, "")
    assert ended.err.count("\n") == 1
    assert says in ended.err


# --- the search -------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_recording_that_contradicts_itself_is_searched_a_bounded_number_of_times(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recording, searched = simulated(), []
    shuffled = np.random.default_rng(1).permutation(recording.ranges.range)

    def counted(*given: Any) -> Posterior:
        searched.append(given)
        return search(*given)

    monkeypatch.setattr(following, "search", counted)
    monkeypatch.setattr(following, "MOST_SEARCHES", 5)
    found = estimated(measurements(with_ranges(recording, shuffled), None, "uwb", (0.0, 16.0)), ClaimRule())
    assert not any(row.claim for row in found.rows)
    assert len(searched) <= 5 + len(following.SEARCHED_AT)


# --- all anchors ------------------------------------------------------------------------------------------


def test_two_robots_use_all_anchors_by_default(metres: Path) -> None:
    found = api.estimate(metres, window=(0.0, 8.0)).summary
    assert list(found.ranges) == ["r-n1", "r-n2", "s-n1", "s-n2", "r-s"]
    assert set(found.unused_ranges) == {"within a second after another"}
    for robot in found.robots.values():
        assert robot.anchors == ["n1", "n2"]
        assert robot.first_claim is not None
        assert robot.first_claim.t_s <= 6.0
        assert robot.final is not None
        assert robot.final.position_error_m is not None
        assert robot.final.position_error_m < 0.3


def test_of_two_robots_one_needs_no_anchor() -> None:
    recording = read_ranges(MILLIMETRES)
    ranges = recording.ranges._replace(range=1e-3 * recording.ranges.range)
    kept = (ranges.first == 0) | (ranges.second < 2)
    part = recording._replace(ranges=ranges.rows(kept))
    found = estimated(measurements(part, None, "uwb", (0.0, 20.0)), ClaimRule()).summary
    assert found.robots["s"].anchors == []
    assert found.robots["s"].final is not None
    assert found.robots["s"].final.position_error_m is not None
    assert found.robots["s"].final.position_error_m < 0.5


# --- odometry ---------------------------------------------------------------------------------------------


def test_of_a_robot_that_stands_it_is_said_that_it_does_not_move() -> None:
    ended = tandem("estimate", STANDING)
    assert (ended.status, ended.err) == (NOT_LOCALISED, "")
    assert "no claim at the end: r does not move, by its odometry" in ended.out
    assert "both" not in ended.out


def test_of_two_robots_the_one_that_stands_is_named(metres: Path, tmp_path: Path) -> None:
    stands = changed(metres, tmp_path / "it", {"odometry": {"dx": 0.0, "dy": 0.0, "dheading": 0.0}})
    both = api.estimate(stands, window=(0.0, 5.0)).summary
    assert both.blocking_reason.startswith("r, s do not move, by their odometry")


@pytest.mark.long
def test_whole_turns_are_removed_from_increments_and_counted(tmp_path: Path) -> None:
    ended = tandem("estimate", WRAPPED, "--out", "found", cwd=tmp_path)
    assert ended.status == ENDED
    assert (
        "r: 10 increments of odometry turned by 2 pi or more too far: whole turns were removed" in ended.out
    )
    robot = json.loads((tmp_path / "found" / "estimate.json").read_text())["robots"]["r"]
    assert (robot["whole_turns"], robot["gross_increments"]) == (10, 0)
    assert robot["final"]["t_s"] == pytest.approx(60.0)
    assert robot["final"]["position_error_m"] < 0.15
    assert abs(robot["final"]["heading_error_rad"]) < 0.1


@pytest.mark.parametrize(
    ("turn", "others", "removed"), [(2.0 - math.tau, 2.0, 1), (5.0, 5.0, 0), (4.0, 3.0, 0)]
)
def test_a_robot_that_turns_far_within_an_increment_keeps_its_turn(
    turn: float, others: float, removed: int
) -> None:
    increments = np.tile(np.array((0.5, 0.0, others)), (20, 1))
    increments[10, 2] = turn
    t = np.arange(21.0)
    found = sound(RobotOdometry(t[:-1], t[1:], increments, np.full((20, 3, 3), np.nan)))
    assert len(found.whole_turns) == removed
    assert found.odometry.increments[10, 2] == pytest.approx(others if removed else turn)


# --- what is said of claims and of the truth --------------------------------------------------------------


@pytest.mark.long
def test_a_claim_that_does_not_hold_at_the_end_is_the_last_line_and_status_1(tmp_path: Path) -> None:
    few = changed(WRAPPED, tmp_path / "few", {}, last_s=8.0)
    ended = tandem("estimate", few, "--out", "found", cwd=tmp_path)
    assert ended.status == NOT_LOCALISED
    robot = json.loads((tmp_path / "found" / "estimate.json").read_text())["robots"]["r"]
    assert robot["first_claim"] is not None
    assert robot["first_claim"]["t_s"] < robot["withdrawn_s"] <= 60.0
    last = ended.out.splitlines()[-1]
    assert last.startswith(f"r: the claim is withdrawn after {robot['withdrawn_s']:.1f} s")
    assert "and withdraws it" in repr(api.estimate(few))


def with_truth_at(t: NDArray[np.floating[Any]]) -> RecordedRobot:
    robot = simulated().robots[0]
    assert robot.truth is not None
    kept = np.isin(np.round(robot.truth.t, 6), np.round(t, 6))
    return robot._replace(truth=TruePath(robot.truth.t[kept], robot.truth.poses[kept]))


def test_the_last_estimate_is_compared_with_a_truth_that_ends_a_sample_before() -> None:
    whole, ended = simulated().robots[0], with_truth_at(0.1 * np.arange(300))
    expected, found = true_pose(whole, 30.0), true_pose(ended, 30.0)
    assert expected is not None
    assert found is not None
    assert np.hypot(*(found - expected)[:2]) < 0.01
    assert true_pose(ended, 30.1) is None


def test_true_poses_at_most_10_s_apart_are_joined_along_the_odometry_and_others_are_said(
    tmp_path: Path,
) -> None:
    whole = simulated().robots[0]
    for spacing, times in ((2.0, 16), (9.0, 4)):
        seldom = with_bridged_truth(with_truth_at(spacing * np.arange(times)))
        for t in (3.3, 8.0, 12.6, 17.9):
            expected, found = true_pose(whole, t), true_pose(seldom, t)
            assert expected is not None
            assert found is not None
            assert np.hypot(*(found - expected)[:2]) < 0.05
            assert abs(wrap(float(found[2] - expected[2]))) < 0.05
    apart = with_bridged_truth(with_truth_at(11.0 * np.arange(3)))
    assert true_pose(apart, 11.0) is not None
    assert true_pose(apart, 12.0) is None
    folder = changed(STANDING, tmp_path / "it", {})
    lines = (WRAPPED / "truth.csv").read_text().splitlines()
    (folder / "truth.csv").write_text("\n".join([*lines[:25], lines[-1], ""]))
    for name in ("odometry.csv", "ranges.csv"):
        (folder / name).write_text((WRAPPED / name).read_text())
    ended = tandem("estimate", folder, "--window", "0..9.6")
    assert "estimates have no error: no true poses around them are within 10 s" in ended.out
