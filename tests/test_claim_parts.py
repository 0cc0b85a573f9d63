"""A recorded robot claims no pose on which parts of its ranges disagree, and none by small residuals alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from msgspec.structs import replace

from agent.estimation import claim, following
from agent.estimation.claim import CONDITIONS, parts, parts_before
from agent.estimation.fit import Fit, with_told_priors
from agent.estimation.following import ClaimRule
from agent.estimation.gaussian.claim_parts import disagreement
from compose.recording.estimating.estimate_run import RecordingEstimate, estimated
from compose.recording.estimating.noise_files import AssumedNoise
from compose.recording.estimating.recorded_measurements import measurements
from compose.recording.ranging.range_recording import RangeRecording
from docs import recorded_windows
from docs.recorded_windows import is_wrong
from protocol.noise import Noise
from tests.test_anchored import ANCHORS, driven
from tests.test_estimate import SAMPLE

SIGMA, SHARED_SIGMA, LASTS_S = 0.05, 0.2, 8.0


def with_shared_error(seed: int) -> RangeRecording:
    """Return a recording whose ranges are off together by SHARED_SIGMA (m), for LASTS_S; only SIGMA is stated.

    There are two anchors. The odometry has the noise that it states.
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


def estimate_of(recording: RangeRecording) -> RecordingEstimate:
    return estimated(measurements(recording, None, None), ClaimRule())


@pytest.mark.parametrize("seed", [0, 2])
def test_errors_that_all_ranges_share_lead_to_no_wrong_claim(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = with_shared_error(seed)
    assert not any(is_wrong(row) for row in estimate_of(recording).rows if row.claim)
    others = tuple([one for one in CONDITIONS if one not in (parts, parts_before)])
    monkeypatch.setattr(following, "blocked", lambda one, asked=others: claim.blocked(one, asked))
    assert any(is_wrong(row) for row in estimate_of(recording).rows if row.claim)


def fit_of(noise: Noise, recording: RangeRecording) -> Fit:
    """Return the fit that a recording ends with."""
    epochs = estimated(measurements(recording, None, AssumedNoise("told", noise)), ClaimRule()).epochs
    assert epochs[-1].fitted is not None
    return epochs[-1].fitted.fit
