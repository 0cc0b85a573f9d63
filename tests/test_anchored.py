"""One robot finds its pose by ranges to several anchors, and says when they leave two possibilities."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from agent.estimation.following import ClaimRule
from agent.estimation.gaussian.beacon_guesses import predicted
from agent.estimation.gaussian.consistency import chi2_p_value
from agent.estimation.gaussian.search import search
from agent.estimation.posterior import certainties
from compose.errors import UserError
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
    assert estimate_csv(estimate_of(driven()).rows) == estimate_csv(estimate_of(driven()).rows)


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
