"""A recorded robot claims no pose while its odometry seems to be stamped late."""

from __future__ import annotations

from collections.abc import Sequence

from agent.estimation.claim import CONDITIONS, Condition, odometry_on_time
from agent.estimation.following import ClaimRule
from compose.recording.estimating.estimate_run import RecordingEstimate, estimated
from compose.recording.estimating.recorded_measurements import measurements
from compose.recording.ranging.range_recording import RangeRecording
from docs.recorded_windows import is_wrong
from tests.test_anchored import driven

SIGMA = 0.05
LATE_S = 0.4


def with_late_odometry(late_s: float) -> RangeRecording:
    """Return a recording whose odometry is stamped late, though its ranges and true poses are not."""
    recording = driven(sigma=SIGMA)
    (robot,) = recording.robots
    odometry = robot.odometry._replace(t0=robot.odometry.t0 + late_s, t1=robot.odometry.t1 + late_s)
    return recording._replace(robots=(robot._replace(odometry=odometry),))


def estimate_of(recording: RangeRecording, conditions: Sequence[Condition] = CONDITIONS) -> RecordingEstimate:
    return estimated(measurements(recording, None, "uwb"), ClaimRule(conditions=conditions))


def wrong(found: RecordingEstimate) -> int:
    judged = [row for row in found.rows if row.claim and row.position_error_m is not None]
    return sum(map(is_wrong, judged))


def test_odometry_that_is_stamped_late_is_named_and_holds_back_claims() -> None:
    recording = with_late_odometry(LATE_S)
    found = estimate_of(recording)
    assert "its odometry seems to be 0.28 s late" in found.summary.blocking_reason  # the prior is 0.1 s
    others = tuple([one for one in CONDITIONS if one is not odometry_on_time])
    assert wrong(estimate_of(recording, others)) > 5 * wrong(found)


def test_ranges_that_are_stamped_late_hold_back_no_claim() -> None:
    found = estimate_of(with_late_odometry(-LATE_S))
    assert found.summary.blocking_reason == ""
    assert any(row.claim for row in found.rows)
