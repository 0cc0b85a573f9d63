"""Ranges that an estimate has not used tell whether it or the recorded truth is the better reference."""

from __future__ import annotations

import numpy as np
import pytest

from compose.recording.ranging.range_recording import TruePath
from docs.held_out import errors_of, estimated_path, without
from tests.test_anchored import driven

SIGMA = 0.05


@pytest.mark.parametrize(("truth_sigma", "is_reference"), [(0.0, True), (1.0, False)])
def test_a_truth_that_misses_ranges_which_nobody_has_used_is_no_reference(
    truth_sigma: float, is_reference: bool
) -> None:
    recording = driven(sigma=SIGMA)
    (robot,) = recording.robots
    assert robot.truth is not None
    poses = robot.truth.poses.copy()
    poses[:, :2] += truth_sigma * np.random.default_rng(1).standard_normal((len(poses), 2))
    told = recording._replace(robots=(robot._replace(truth=TruePath(robot.truth.t, poses)),))
    for anchor in [one.id for one in recording.anchors][:3]:  # the fourth is 2 m higher
        path = estimated_path(without(told, anchor), "A", (0.0, 40.0), 0.3)
        estimate, truth = [float(np.std(one.error)) for one in errors_of(told, anchor, "A", path)]
        assert estimate < 4.0 * SIGMA
        assert (truth < 1.5 * estimate) == is_reference
