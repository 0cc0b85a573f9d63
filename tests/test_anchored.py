"""Poses by ranges to several anchors: of one recorded robot, and of groups, also without an anchor."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

import tandem as api
from agent.estimation.following import ClaimRule
from agent.estimation.gaussian.beacon_guesses import predicted
from agent.estimation.gaussian.consistency import chi2_p_value
from agent.estimation.gaussian.search import search
from agent.estimation.posterior import certainties
from compose.errors import ENDED, NOT_LOCALISED, UserError
from compose.recording.estimating.calibration import ASSUMED, calibrated_by_fit
from compose.recording.estimating.estimate_rows import estimate_csv
from compose.recording.estimating.estimate_run import RecordingEstimate, estimated
from compose.recording.estimating.recorded_measurements import measurements
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_recording import (
    FixedAnchor,
    Numbers,
    RangeRecording,
    RangeSeries,
    RecordedRobot,
    RobotOdometry,
    TruePath,
)
from compose.recording.ranging.range_steps import relative
from tests.commands import tandem
from tests.moving_groups import moving_group
from tests.range_tables import circling, written_csv
from tests.test_estimate import NEES_99_9

ANCHORS = (
    FixedAnchor("M0", 1.0, -2.0),
    FixedAnchor("M1", 9.0, 0.0),
    FixedAnchor("M2", 3.0, 8.0),
    FixedAnchor("M3", 8.0, 7.0, 2.0),
)
STEP_S, STEPS = 0.1, 400


def driven(
    anchors: tuple[FixedAnchor, ...] = ANCHORS,
    *,
    turn_rate: float = 0.4,
    sigma: float = 0.0,
    scale: float = 0.0,
    seed: int = 1,
) -> RangeRecording:
    """Return a recording of one robot for 40 s, whose turns alternate, with a range every 0.25 s.

    The ranges have errors of `sigma` (m), and are longer by `scale`.
    """
    draws = np.random.default_rng(seed)
    t = STEP_S * np.arange(STEPS + 1.0)
    turn = turn_rate * STEP_S * np.sign(np.sin(0.3 * t[:-1] + 0.4))
    heading = 0.5 + np.concatenate(([0.0], np.cumsum(turn)))
    moved = 0.3 * STEP_S * np.exp(1j * (heading[:-1] + 0.5 * turn)) * np.sinc(0.5 * turn / math.pi)
    place = 4.0 + 3.0j + np.concatenate(([0.0], np.cumsum(moved)))
    poses = np.stack((place.real, place.imag, heading), 1)
    increments = relative(poses[:-1], poses[1:])
    covariance = np.tile(np.diag([1e-6, 1e-6, 1e-6]), (STEPS, 1, 1))
    robot = RecordedRobot("A", RobotOdometry(t[:-1], t[1:], increments, covariance), TruePath(t, poses))
    at = np.arange(0.05, 40.0, 0.25)
    x, y = (np.interp(at, t, poses[:, axis]) for axis in (0, 1))
    which = np.arange(len(at)) % len(anchors)
    apart = np.array([(one.x, one.y, one.height) for one in anchors])[which]
    true: Numbers = np.sqrt((x - apart[:, 0]) ** 2 + (y - apart[:, 1]) ** 2 + apart[:, 2] ** 2)
    measured = true * (1.0 + scale) + sigma * draws.standard_normal(len(at))
    series = RangeSeries(at, np.zeros(len(at), np.intp), 1 + which, measured, np.full(len(at), np.nan))
    return RangeRecording("driven", (robot,), anchors, series)


def estimate_of(recording: RangeRecording, noise: str = "uwb-calibrated") -> RecordingEstimate:
    return estimated(measurements(recording, None, noise, None), ClaimRule(0.2))


@pytest.mark.parametrize("count", [2, 4])
@pytest.mark.long
def test_a_robot_claims_its_pose_by_ranges_to_several_anchors(count: int) -> None:
    found = estimate_of(driven(ANCHORS[:count], sigma=0.05))
    (robot,) = found.summary.robots.values()
    assert sorted(robot.anchors) == [one.id for one in ANCHORS[:count]]
    assert robot.first_claim is not None
    assert robot.first_claim.t_s < 25.0
    claimed = [row for row in found.rows if row.claim]
    assert all(row.nees is not None and row.nees < NEES_99_9 for row in claimed)
    assert claimed[-1].position_error_m is not None
    assert claimed[-1].position_error_m < 0.15


@pytest.mark.long
def test_covariances_of_many_recordings_are_right() -> None:
    nees = []
    for seed in range(12):
        last = estimate_of(driven(sigma=0.05, seed=seed)).rows[-1]
        assert last.nees is not None
        nees.append(last.nees)
    assert 0.5 < np.mean(nees) < 5.0


@pytest.mark.long
def test_a_scale_of_all_ranges_is_learned() -> None:
    found = estimate_of(driven(scale=0.07, sigma=0.03), "uwb")
    assert found.summary.calibration is not None
    scale = found.summary.calibration.range_scale
    assert scale is not None
    bias = found.summary.calibration.range_bias_m
    assert bias is not None
    explained = scale.value * 5.0 + bias.value  # ranges are 3 to 7 m long
    assert explained == pytest.approx(0.07 * 5.0, abs=0.12)
    assert found.rows[-1].nees is not None
    assert found.rows[-1].nees < NEES_99_9


def test_a_straight_way_leaves_the_mirror_image_at_two_anchors() -> None:
    found = estimate_of(driven(ANCHORS[:2], turn_rate=0.0))
    last = found.rows[-1]
    assert last.hypotheses == 2
    assert 0.3 < last.probability < 0.7
    assert not any(row.claim for row in found.rows)
    assert "the most probable of 2 hypotheses has probability" in found.summary.blocking_reason


@pytest.mark.parametrize(("count", "unverified"), [(2, ["M0", "M1"]), (4, [])])
def test_an_anchor_of_which_no_range_tells_whether_it_is_off_its_survey_is_named(
    count: int, unverified: list[str]
) -> None:
    problem = measurements(driven(ANCHORS[:count], sigma=0.02), None, "uwb-calibrated", None)
    found = estimated(problem, ClaimRule(0.5))
    assert found.summary.doubtful_anchors == {}
    assert sorted(found.summary.unverified_anchors) == unverified
    for why in found.summary.unverified_anchors.values():
        assert why.startswith("no range tells whether it stands 0.5 m off along (")


def test_one_place_is_not_enough() -> None:
    twice = (ANCHORS[0], ANCHORS[0]._replace(id="M9"))
    with pytest.raises(UserError, match=r"ranges to two anchors at different places: A has ranges to M0, M9"):
        measurements(driven(twice), None, None, None)


def test_equal_recordings_give_equal_estimates() -> None:
    one, other = (measurements(driven(), None, "uwb-calibrated", (0.0, 12.0)) for _ in range(2))
    assert estimate_csv(estimated(one, ClaimRule()).rows) == estimate_csv(estimated(other, ClaimRule()).rows)


def test_ranges_belong_to_their_anchor() -> None:
    measured = measurements(driven(), None, "uwb-calibrated", None)
    ranges, place = measured.joint.ranges, {one.id: (one.x, one.y) for one in measured.anchors}
    for k, (_, anchor) in enumerate(measured.joint.radios):
        own = ranges.place[ranges.radio == k] + measured.joint.origin
        np.testing.assert_allclose(own, np.broadcast_to(place[anchor], own.shape), atol=1e-12)


def test_the_derivatives_of_ranges_to_several_anchors_are_right() -> None:
    draws = np.random.default_rng(3)
    place, at = draws.uniform(-5.0, 5.0, (6, 2)), draws.uniform(-5.0, 5.0, (2, 6))
    guesses, small = draws.uniform(-2.0, 2.0, (2, 3)), 1e-6
    _, derivatives = predicted(guesses, at, place)
    for i in range(3):
        step = small * np.eye(3)[i]
        more, less = (predicted(guesses + sign * step, at, place)[0] for sign in (1.0, -1.0))
        np.testing.assert_allclose((more - less) / (2.0 * small), derivatives[..., i], atol=1e-6)


def test_the_radios_of_one_robot_are_calibrated_without_truth() -> None:
    recording = driven(sigma=0.05)
    found = calibrated_by_fit(measurements(recording, None, ASSUMED))
    assert found.source == "the fit"
    assert {pair[1] for pair in found.pairs} == {one.id for one in ANCHORS}
    assert all(0.02 < one.sigma < 0.1 for one in found.pairs.values())


def test_the_p_value_of_a_chi_square_is_that_of_its_distribution() -> None:
    assert chi2_p_value(18.307, 10) == pytest.approx(0.05, abs=1e-3)
    assert chi2_p_value(3.940, 10) == pytest.approx(0.95, abs=3e-3)


def test_an_anchor_with_a_sigma_has_a_certainty_like_a_robot(tmp_path: Path) -> None:
    """Robots that survey others beside it ask for that of each anchor that is not surveyed."""
    tables = circling(4.0)
    tables["anchors"][3]["sigma"] = 0.3
    used = measurements(read_ranges(written_csv(tmp_path, tables)), None, None).until(7)
    found = search(used)
    assert (used.robots, found.located) == (("r", "D"), (0,))
    assert [one.poses for one in certainties(found)] == [1, 1]


SIGMA = 0.05


def recorded(robots: int, seed: int, *, unanchored: tuple[int, ...] = (), alone: int = 0) -> RangeRecording:
    """Return a recording of a moving group, and of `alone` more robots without any range.

    Of the true poses, the headings are those of the odometry.
    """
    group = moving_group(robots, seed, unanchored=unanchored)
    names = [*group.robots, *[f"x{i}" for i in range(alone)]]
    found = []
    for name in names:
        own = name if name in group.robots else "r00"
        steps = [value for key, value in group.facts if key.kind == "manoeuvre" and key.robot == own]
        turned = np.concatenate(([0.0], np.cumsum([one[1] for one in steps])))
        moved = np.array([one[0] for one in steps]) * np.exp(1j * (turned[:-1] + 0.5 * np.diff(turned)))
        moved = moved * np.sinc(0.5 * np.diff(turned) / np.pi)
        at = np.concatenate(([0.0], np.cumsum(moved)))
        dead = np.stack((at.real, at.imag, turned), 1)
        t = np.arange(41.0)
        truth = None
        if name in group.robots:
            index = group.robots.index(name)
            truth = TruePath(t, np.column_stack((*group.paths[index], group.starts[index, 2] + turned)))
        odometry = RobotOdometry(t[:-1], t[1:], relative(dead[:-1], dead[1:]), np.full((40, 3, 3), np.nan))
        found.append(RecordedRobot(name, odometry, truth))
    anchors = [FixedAnchor(key.robot, *value) for key, value in group.anchors]
    radios = [*names, *[one.id for one in anchors]]
    rows = sorted(
        [
            (float(key.tick), radios.index(key.robot), radios.index(key.other), value[0])
            for key, value in group.facts
            if key.other
        ]
    )
    t, first, second, rho = (np.array(column) for column in zip(*rows, strict=True))
    series = RangeSeries(t, first.astype(np.intp), second.astype(np.intp), rho, np.full(len(t), SIGMA))
    return RangeRecording("recorded", tuple(found), tuple(anchors), series)


def estimate_of_group(
    recording: RangeRecording, robots: tuple[str, ...] | None = None, relative_to: str | None = None
) -> RecordingEstimate:
    """Return the estimate. Far from the origin of a frame, a pose is as uncertain as the first heading."""
    problem = measurements(recording, robots, None, (0.0, 36.0), relative=relative_to)
    return estimated(problem, ClaimRule(0.3 if relative_to is None else 1.5))


@pytest.mark.parametrize("unanchored", [(0, 1, 2), ()])
def test_robots_and_anchors_are_estimated_in_the_frame_of_a_first_pose(unanchored: tuple[int, ...]) -> None:
    recording = recorded(3, 3, unanchored=unanchored)
    found = estimate_of_group(recording, None, "r01")
    assert found.summary.relative_to == "r01"
    for robot in found.summary.robots.values():
        assert robot.first_claim is not None
        assert robot.final is not None
        assert robot.final.position_error_m is not None
        assert robot.final.position_error_m < 1.0
        assert robot.final.nees is not None
        assert robot.final.nees < NEES_99_9
    assert not found.summary.undetermined
    origin = recording.robot("r01").truth
    assert origin is not None
    assert len(found.summary.anchors) == 3 - len(unanchored)
    for name, anchor in found.summary.anchors.items():
        (one,) = (one for one in recording.anchors if one.id == name)
        place = relative(origin.poses[:1], np.array([[one.x, one.y, 0.0]]))[0, :2]
        assert anchor.given is None
        assert math.dist(anchor.position, place) < 5.0 * anchor.sigma


def test_the_origin_of_a_frame_is_the_centre_of_a_robot_and_not_its_antenna() -> None:
    recording = recorded(3, 3)
    robots = [one._replace(antenna=(0.3, -0.2, 0.0)) for one in recording.robots]
    found = estimate_of_group(recording._replace(robots=tuple(robots)), ("r01",), "r01")
    first = found.rows[0]
    assert first.position_error_m is not None
    assert first.position_error_m < 0.03
    assert first.x == pytest.approx(0.5 * recording.robots[1].odometry.increments[0, 0], abs=0.03)


@pytest.mark.long
def test_all_robots_of_a_recording_are_estimated_also_one_without_an_anchor() -> None:
    found = estimate_of_group(recorded(4, 3, unanchored=(2,)))
    assert list(found.summary.robots) == ["r00", "r01", "r02", "r03"]
    assert found.summary.robots["r02"].anchors == []
    for robot in found.summary.robots.values():
        assert robot.first_claim is not None
        assert robot.final is not None
        assert robot.final.position_error_m is not None
        assert robot.final.position_error_m < 0.3
    assert not found.summary.undetermined
    assert not found.summary.blocking_reason
    assert found.summary.calibration is not None
    assert sorted(found.summary.calibration.gyro_bias_rad_s) == ["r00", "r01", "r02", "r03"]


def test_a_robot_without_ranges_has_no_pose_and_the_summary_says_why() -> None:
    found = estimate_of_group(recorded(3, 4, alone=1))
    summary = found.summary
    assert summary.robots["x0"].final is None
    assert not any(row.robot == "x0" for row in found.rows)
    assert summary.undetermined == {"x0": "it has no range to an anchor; two at different places are needed"}
    assert summary.blocking_reason == f"x0 is undetermined: {summary.undetermined['x0']}"
    assert all(summary.robots[name].first_claim is not None for name in ("r00", "r01", "r02"))


@pytest.mark.long
def test_the_order_of_the_robots_changes_the_order_of_the_rows_alone() -> None:
    recording = recorded(3, 5)
    one, other = estimate_of_group(recording), estimate_of_group(recording, ("r02", "r00", "r01"))
    assert estimate_csv(sorted(one.rows, key=lambda row: (row.t_s, row.robot))) == estimate_csv(
        sorted(other.rows, key=lambda row: (row.t_s, row.robot))
    )
    assert list(other.summary.robots) == ["r02", "r00", "r01"]


def test_two_robots_of_a_group_are_estimated_as_a_pair() -> None:
    recording = recorded(3, 5)
    two = estimate_of_group(recording, ("r00", "r01"))
    begin, end = recording.span
    alone = recording.part(("r00", "r01"), begin, end)
    assert estimate_csv(two.rows) == estimate_csv(estimate_of_group(alone).rows)


def test_an_anchor_without_a_position_is_estimated_once_a_robot_is_located() -> None:
    recording = recorded(3, 4)
    first, *others = recording.anchors
    unknown = first._replace(x=math.nan, y=math.nan, sigma=math.inf)
    found = estimate_of_group(recording._replace(anchors=(unknown, *others)))
    assert all(robot.first_claim is not None for robot in found.summary.robots.values())
    x, y = found.summary.anchors[first.id].position
    assert math.hypot(x - first.x, y - first.y) < 0.5


GROUP = """
name = "noisy-group"
seed = 1

[mission]
sensing_range = 3.0
period = 1.0
max_speed = 1.0
max_turn_rate = 3.141592653589793
accuracy = 0.3

[mission.noise]
anchor_sigma = 0.05
mutual_sigma = 0.05
gyro_bias = 0.0003
"""
GROUP_ANCHORS = {"a": (0.0, 0.0), "b": (7.0, 2.0), "c": (-3.0, 7.0)}


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("group")
    robots = [f'[[robot]]\nid = "{name}"\nanchor = [{x}, {y}]\n' for name, (x, y) in GROUP_ANCHORS.items()]
    (folder / "group.toml").write_text("\n".join([GROUP, *robots]))
    ran = tandem("run", "group.toml", "--in-process", "--out", "recording", cwd=folder)
    assert ran.status == ENDED, ran.err
    return folder


@pytest.mark.long
def test_a_recorded_mission_of_a_group_is_estimated_by_default_with_all_robots(mission: Path) -> None:
    ran = tandem("estimate", "recording", "--noise", "group.toml", "--out", "estimated", cwd=mission)
    assert ran.status == ENDED, ran.out + ran.err
    summary = json.loads((mission / "estimated" / "estimate.json").read_text())
    assert list(summary["robots"]) == ["a", "b", "c"]
    assert summary["undetermined"] == {}
    for robot in summary["robots"].values():
        assert robot["final"]["nees"] < NEES_99_9
        assert robot["final"]["position_error_m"] < 0.3
    assert (mission / "estimated" / "estimate-path.svg").exists()
    assert "time from the first odometry of all on" in ran.out
    found = api.estimate(mission / "recording", noise=mission / "group.toml")
    assert found.robots == ("a", "b", "c")
    lines = (mission / "estimated" / "estimate.csv").read_text().splitlines()
    assert len(lines) - 1 == len(found.rows["robot"])


@pytest.mark.long
def test_a_recorded_mission_is_estimated_in_the_frame_of_a_robot(mission: Path) -> None:
    flags = ("--noise", "group.toml", "--relative")
    ran = tandem("estimate", "recording", *flags, "b", "--accuracy", "1", "--out", "frame", cwd=mission)
    assert ran.status == ENDED, ran.out + ran.err
    assert "poses are in the frame of that of b at the beginning" in ran.out
    for robot in json.loads((mission / "frame" / "estimate.json").read_text())["robots"].values():
        assert robot["final"]["nees"] < NEES_99_9
    assert "frame of b" in (mission / "frame" / "estimate-path.svg").read_text()
    found = api.estimate(mission / "recording", noise=mission / "group.toml", relative="b")
    assert found.summary.relative_to == "b"
    assert abs(found.rows.where(robot="b")["x"][0]) < 1.0
    ran = tandem("estimate", "recording", *flags, "x", cwd=mission)
    assert "--relative: x is not among the robots a, b, c" in ran.err


def test_radios_of_a_group_without_anchors_are_calibrated_without_truth() -> None:
    recording = recorded(3, 3, unanchored=(0, 1, 2))
    names = [one.id for one in recording.robots]
    found = calibrated_by_fit(measurements(recording, names, ASSUMED, relative=names[0]))
    assert list(found.pairs) == [("r00", "r01"), ("r00", "r02"), ("r01", "r02")]


def test_a_group_of_which_some_robot_has_no_pose_ends_with_status_1(mission: Path) -> None:
    ran = tandem("estimate", "recording", "--noise", "group.toml", "--window", "0..15", cwd=mission)
    assert ran.status == NOT_LOCALISED
    assert "no claim at the end: " in ran.out


def test_measurements_of_a_group_are_facts_in_the_order_of_names() -> None:
    measured = measurements(recorded(3, 5), ("r02", "r00", "r01"), None, None)
    assert measured.joint.robots == ("r00", "r01", "r02")
    assert [one.id for one in measured.robots] == ["r02", "r00", "r01"]
    assert measured.joint.radios[0] == ("r00", "Mr00")
    assert measured.joint.radios[-1] == ("r01", "r02")
