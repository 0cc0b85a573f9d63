"""The results of an estimate at one time, and the rule for claims."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from agent.estimation.fit import Fit
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.posterior import Certainty
from compose.recording.estimating.prepared_steps import OneRobot
from compose.recording.ranging.range_recording import Numbers
from protocol.motion import wrap


class PosesHypothesis(NamedTuple):
    """One hypothesis about all robots."""

    probability: float
    poses: Numbers
    """x (m), y (m) and heading (rad) in <W> of each robot, at the end of the epoch; shape (R, 3)."""
    covariance: Numbers
    """The covariance of all poses; shape (3 R, 3 R)."""


MOST_SEARCHES = 100
"""The number of searches of the whole plane after which it is only searched with twice as many ranges.

Where no hypothesis fits, each epoch has a search. With fewer, recordings of a minute that settle late would
have other estimates; with more, recordings that contradict themselves take longer.
"""

GIVEN_UP = (
    f"not settled after {MOST_SEARCHES} searches of the plane; the next is due with twice as many ranges"
)
"""The reason against a claim that such a search has not confirmed."""


class EpochFit(NamedTuple):
    """The fit of the first hypothesis, and what it was fitted to."""

    fit: Fit
    used: JointMeasurements
    """The measurements up to the end of the epoch."""


class EstimateEpoch(NamedTuple):
    """The estimate at the end of one epoch."""

    t: float
    """The time in s, on the clock of the recording."""
    ranges: tuple[int, ...]
    """The number of ranges that are used, of each pair of radios."""
    hypotheses: tuple[PosesHypothesis, ...]
    """The hypotheses, the most probable first; none before there are enough ranges."""
    claims: tuple[bool, ...]
    """True if a robot may claim the pose of the first hypothesis."""
    blocking_reason: str
    """The condition for a claim that is not met; empty if all are."""
    fitted: EpochFit | None
    """The fit of the first hypothesis; None without one, and if there is a later epoch."""
    certainties: tuple[Certainty, ...] = ()
    """The certainty of the pose of each robot; empty without hypotheses."""
    undetermined: Mapping[str, str] = {}
    """The robots of a group that have no pose, with the reason."""


def add_epoch(epochs: list[EstimateEpoch], epoch: EstimateEpoch) -> None:
    """Append `epoch` to `epochs`, and drop the fit of the one before: fits grow with the number of ranges."""
    if epochs:
        epochs[-1] = epochs[-1]._replace(fitted=None)
    epochs.append(epoch)


class ClaimRule(NamedTuple):
    """The accuracy and the confidence that a claim needs."""

    accuracy: float = 0.3
    """The largest sigma of the position in m: the root of the trace of its covariance."""
    confidence: float = 0.9999
    """The least probability of the hypothesis."""


def of_centres(
    probability: float,
    mean: Numbers,
    covariance: Numbers,
    robots: tuple[OneRobot, ...],
    origin: tuple[float, float],
) -> PosesHypothesis:
    """Return a hypothesis about the centres of `robots`, in <W>.

    `mean` and `covariance` are about their antennas, relative to `origin` (m), mostly an anchor.
    """
    poses = mean.reshape(-1, 3).copy()
    poses[:, 0] += origin[0]
    poses[:, 1] += origin[1]
    centred = np.eye(poses.size)
    for i, robot in enumerate(robots):
        forward, left, _ = robot.antenna
        offset = (forward + 1j * left) * np.exp(1j * poses[i, 2])
        poses[i, :2] -= offset.real, offset.imag
        centred[3 * i, 3 * i + 2], centred[3 * i + 1, 3 * i + 2] = offset.imag, -offset.real
        poses[i, 2] = wrap(float(poses[i, 2]))
    return PosesHypothesis(probability, poses, centred @ covariance @ centred.T)
