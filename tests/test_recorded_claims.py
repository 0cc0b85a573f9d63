"""Claims of recorded robots: none on ranges that disagree, late odometry, or depths taken for distances."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from agent.estimation.claim import CONDITIONS, Condition, odometry_on_time, parts, parts_before
from agent.estimation.fit import Fit
from agent.estimation.following import ClaimRule
from compose import scenario
from compose.errors import USER_ERROR
from compose.recording.estimating.estimate_rows import LearnedError
from compose.recording.estimating.estimate_run import RecordingEstimate, estimated
from compose.recording.estimating.noise_files import AssumedNoise
from compose.recording.estimating.recorded_measurements import measurements
from compose.recording.estimating.recording_estimator import RecordingEstimator
from compose.recording.ranging.range_recording import FixedAnchor, RangeRecording
from docs import recorded_windows
from docs.recorded_windows import is_wrong
from protocol.noise import Noise
from tests.commands import refused, tandem
from tests.range_tables import SAMPLE, written_csv
from tests.test_anchored import ANCHORS, driven

NOISY = Path(scenario.__file__).parent / "shipped" / "noisy.toml"
SIGMA = 0.05
HALF_VIEW = math.radians(35.0)
LANDMARKS = tuple([
    FixedAnchor(f"L{k:02}", 4.0 + (4.0 + k % 3) * math.cos(k), 3.0 + (4.0 + k % 3) * math.sin(k))
    for k in range(24)
])  # fmt: skip


def seen(seed: int, *, share: float, yaw: float = 0.0) -> RangeRecording:
    """Return a recording of one robot that measures the landmarks in its view, with this share of depth.

    `yaw` (rad) is the angle of the axis of its camera to the heading.
    """
    recording = driven(LANDMARKS, seed=seed)
    (robot,), ranges = recording.robots, recording.ranges
    assert robot.truth is not None
    x, y, heading = [np.interp(ranges.t, robot.truth.t, axis) for axis in robot.truth.poses.T]
    landmarks = np.array([(one.x, one.y) for one in LANDMARKS])
    away = landmarks[:, None] - np.stack((x, y), 1)  # of each landmark at each time
    bearing = np.abs(np.angle(np.exp(1j * (np.arctan2(away[..., 1], away[..., 0]) - heading - yaw))))
    far, at = np.hypot(away[..., 0], away[..., 1]), np.arange(len(x))
    nearest = np.where(bearing < HALF_VIEW, far, np.inf)
    which = np.argsort(nearest, 0)[at % 2, at]
    distance = far[which, at]
    depth = distance * np.cos(bearing[which, at])
    measured = (1.0 - share) * distance + share * depth
    measured += SIGMA * np.random.default_rng(seed).standard_normal(len(x))
    told = ranges._replace(second=1 + which, range=measured, sigma=np.full(len(x), SIGMA))
    return recording._replace(ranges=told.rows(np.isfinite(nearest[which, at])))


def estimate_of(
    recording: RangeRecording, noise: str | None = None, conditions: Sequence[Condition] = CONDITIONS
) -> RecordingEstimate:
    return estimated(measurements(recording, None, noise), ClaimRule(conditions=conditions))


def depth_of(found: RecordingEstimate) -> LearnedError:
    assert found.summary.calibration is not None
    learned = found.summary.calibration.range_depth
    assert learned is not None
    return learned


@pytest.mark.parametrize("share", [0.0, 1.0])
@pytest.mark.parametrize("noise", [None, "camera"])
def test_a_recording_tells_whether_its_ranges_are_depths_and_claims_are_right(
    share: float, noise: str | None
) -> None:
    for seed in range(3):
        found = estimate_of(seen(seed, share=share), noise)
        claims = [row for row in found.rows if row.claim and row.nees is not None]
        assert len(claims) > 20
        assert not any(map(is_wrong, claims))
        learned = depth_of(found)
        assert abs(learned.value - share) < 4.0 * learned.sigma < 0.5


@pytest.mark.parametrize("yaw", [0.1, -0.3])
def test_a_camera_that_does_not_look_along_the_heading_leads_to_no_wrong_claim(yaw: float) -> None:
    claims = [
        row
        for seed in range(4)
        for row in estimate_of(seen(seed, share=1.0, yaw=yaw)).rows
        if row.claim and row.nees is not None
    ]
    assert claims
    assert not any(map(is_wrong, claims))


@pytest.mark.parametrize("noise", ["wheels", "uwb-calibrated"])
def test_a_robot_with_a_camera_that_is_told_radios_claims_no_wrong_pose_and_hears_of_cameras(
    noise: str,
) -> None:
    found = [estimate_of(seen(seed, share=1.0), noise) for seed in range(3)]
    assert not any(is_wrong(row) for one in found for row in one.rows if row.claim and row.nees is not None)
    reasons = [epoch.blocking_reason for one in found for epoch in one.epochs]
    assert any("the profile 'camera' explains them better" in reason for reason in reasons)


@pytest.mark.parametrize("noise", ['profile = "camera"', "range_depth = 0.5"])
def test_a_mission_has_no_depths(tmp_path: Path, noise: str) -> None:
    path, noisy = tmp_path / "seen.toml", NOISY.read_text()
    path.write_text(noisy.replace("[mission.noise]", f"[mission.noise]\n{noise}"))
    what = "mission.noise.range_depth: depths, and the profile 'camera', are for recordings only"
    refused(tandem("run", path), what)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_estimate_and_calibrate_say_that_ranges_are_depths(tmp_path: Path, share: float) -> None:
    recording = seen(1, share=share)
    (robot,), ranges = recording.robots, recording.ranges
    assert robot.truth is not None
    names = ("t0", "t1", "dx", "dy", "dheading")
    moves = np.column_stack((robot.odometry.t0, robot.odometry.t1, robot.odometry.increments)).tolist()
    lengths = zip(ranges.t.tolist(), (ranges.second - 1).tolist(), ranges.range.tolist(), strict=True)
    tables = {
        "odometry": [{"robot": "A", **dict(zip(names, one, strict=True))} for one in moves],
        "ranges": [
            {"t": t, "from": "A", "to": LANDMARKS[k].id, "range": rho, "sigma": SIGMA}
            for t, k, rho in lengths
        ],
        "anchors": [{"anchor": one.id, "x": one.x, "y": one.y} for one in LANDMARKS],
        "truth": [
            {"robot": "A", "t": t, "x": x, "y": y, "heading": heading}
            for t, (x, y, heading) in zip(robot.truth.t.tolist(), robot.truth.poses.tolist(), strict=True)
        ],
    }
    path = written_csv(tmp_path / "seen", tables)
    ended, calibrated = tandem("estimate", path), tandem("calibrate", path)
    assert ended.status == 0
    assert (calibrated.status == USER_ERROR) == (share > 0.0)
    assert ("the ranges are depths along the headings, as of a camera" in calibrated.err) == (share > 0.0)
    assert ("the ranges are depths along the headings, as of a camera: a share of" in ended.out) == (
        share > 0.0
    )


SHARED_SIGMA, LASTS_S = 0.2, 8.0


def with_shared_error(seed: int) -> RangeRecording:
    """Return a recording whose ranges are off together by SHARED_SIGMA (m), for LASTS_S.

    Only SIGMA is stated. There are two anchors. The odometry has the noise that it states.
    """
    recording, draws = driven(ANCHORS[:2], sigma=SIGMA, seed=seed), np.random.default_rng([seed, 7])
    ranges, (robot,) = recording.ranges, recording.robots
    off = [SHARED_SIGMA * draws.standard_normal()]
    for lasted in np.diff(ranges.t).tolist():
        share = math.exp(-lasted / LASTS_S)
        off.append(share * off[-1] + SHARED_SIGMA * math.sqrt(1.0 - share**2) * draws.standard_normal())
    sigmas = np.array((0.002, 0.002, 0.004))
    increments = robot.odometry.increments
    increments = increments + draws.normal(size=increments.shape) * sigmas
    covariance = np.tile(np.diag(sigmas**2), (len(increments), 1, 1))
    odometry = robot.odometry._replace(increments=increments, covariance=covariance)
    return recording._replace(
        robots=(robot._replace(odometry=odometry),),
        ranges=ranges._replace(range=ranges.range + off, sigma=np.full(len(ranges.t), SIGMA)),
    )


@pytest.mark.parametrize("seed", [4, 45])
def test_errors_that_all_ranges_share_lead_to_no_wrong_claim(seed: int) -> None:
    recording = with_shared_error(seed)
    assert not any(is_wrong(row) for row in estimate_of(recording, "wheels").rows if row.claim)
    others = tuple([one for one in CONDITIONS if one not in (parts, parts_before)])
    found = estimate_of(recording, "wheels", others)
    assert any(is_wrong(row) for row in found.rows if row.claim)


def fit_of(**priors: float) -> Fit:
    """Return the last fit to ranges that are five times as accurate as told, with some priors of errors."""
    untold = dict.fromkeys(("range_bias", "pair_bias", "range_scale", "wheel_scale", "gyro_bias"), 0.0)
    noise = replace(Noise(anchor_sigma=SIGMA, mutual_sigma=SIGMA), **{**untold, **priors})
    found = measurements(driven(sigma=0.2 * SIGMA), None, AssumedNoise("told", noise), (0.0, 15.0))
    (*_, epoch) = RecordingEstimator(ClaimRule()).epochs(found)
    assert epoch.fitted is not None
    assert epoch.fitted.fit.level < 0.5
    return epoch.fitted.fit


def test_without_other_errors_a_low_noise_level_scales_the_covariance() -> None:
    fit = fit_of()
    assert np.allclose(fit.covariance, fit.level * fit.linear.step.ends, rtol=0.01, atol=1e-9)


def test_small_residuals_do_not_tell_that_biases_are_small() -> None:
    fit = fit_of(pair_bias=0.2)
    told, scaled = fit.linear.step.ends, fit.level * fit.linear.step.ends
    assert np.linalg.eigvalsh(fit.covariance - scaled).min() > -1e-9
    assert np.linalg.eigvalsh(told - fit.covariance).min() > -1e-9
    assert np.trace(fit.covariance[:2, :2]) > 2.0 * np.trace(scaled[:2, :2])


@pytest.mark.long
def test_the_table_of_recordings_has_a_row_for_each_series(capsys: pytest.CaptureFixture[str]) -> None:
    recorded_windows.main(["--tiers", str(SAMPLE)])
    head, _, row = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()]
    cells = dict(zip(head, row, strict=True))
    assert (cells["recording"], cells["windows"], cells["with a claim"]) == ("TIERS, pairs", "1", "1")
    assert (int(cells["claims"]) > 10, cells["wrong"], cells["of robots"]) == (True, "0", "-")


LATE_S = 0.4


def with_late_odometry(late_s: float) -> RangeRecording:
    """Return a recording whose odometry is stamped late, though its ranges and true poses are not."""
    recording = driven(sigma=SIGMA)
    (robot,) = recording.robots
    odometry = robot.odometry._replace(t0=robot.odometry.t0 + late_s, t1=robot.odometry.t1 + late_s)
    return recording._replace(robots=(robot._replace(odometry=odometry),))


def wrong(found: RecordingEstimate) -> int:
    judged = [row for row in found.rows if row.claim and row.position_error_m is not None]
    return sum(map(is_wrong, judged))


def test_odometry_that_is_stamped_late_is_named_and_holds_back_claims() -> None:
    recording = with_late_odometry(LATE_S)
    found = estimate_of(recording, "uwb")
    assert "its odometry seems to be 0.28 s late" in found.summary.blocking_reason  # the prior is 0.1 s
    others = tuple([one for one in CONDITIONS if one is not odometry_on_time])
    assert wrong(estimate_of(recording, "uwb", others)) > 5 * wrong(found)


def test_ranges_that_are_stamped_late_hold_back_no_claim() -> None:
    found = estimate_of(with_late_odometry(-LATE_S), "uwb")
    assert found.summary.blocking_reason == ""
    assert any(row.claim for row in found.rows)
