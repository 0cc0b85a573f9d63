"""A recorded robot claims no pose on which parts of its ranges disagree, or by small residuals alone."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from msgspec.structs import replace

from agent.estimation.claim import CONDITIONS, Condition, parts, parts_before
from agent.estimation.fit import Fit
from agent.estimation.following import ClaimRule
from compose.recording.estimating.estimate_run import RecordingEstimate, estimated
from compose.recording.estimating.noise_files import AssumedNoise
from compose.recording.estimating.recorded_measurements import measurements
from compose.recording.estimating.recording_estimator import RecordingEstimator
from compose.recording.ranging.range_recording import RangeRecording
from docs import recorded_windows
from docs.recorded_windows import is_wrong
from protocol.noise import Noise
from tests.range_tables import SAMPLE
from tests.test_anchored import ANCHORS, driven

SIGMA, SHARED_SIGMA, LASTS_S = 0.05, 0.2, 8.0


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


def estimate_of(recording: RangeRecording, conditions: Sequence[Condition] = CONDITIONS) -> RecordingEstimate:
    return estimated(measurements(recording, None, "wheels"), ClaimRule(conditions=conditions))


@pytest.mark.parametrize("seed", [4, 45])
def test_errors_that_all_ranges_share_lead_to_no_wrong_claim(seed: int) -> None:
    recording = with_shared_error(seed)
    assert not any(is_wrong(row) for row in estimate_of(recording).rows if row.claim)
    others = tuple([one for one in CONDITIONS if one not in (parts, parts_before)])
    found = estimate_of(recording, others)
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
