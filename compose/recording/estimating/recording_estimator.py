"""The estimates of recorded robots over time, by one fit to everything that is known of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import msgspec
import numpy as np

from agent.estimation.fit import Fit, with_unscaled_priors
from agent.estimation.following import ClaimRule, Following
from agent.estimation.gaussian.joint_claims import open_position, undetermined
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.posterior import Posterior, certainties
from agent.estimation.solver import Solver, UnusableSolution
from compose.errors import UserError
from compose.recording.estimating.estimate_rows import FinalHypothesis, PoseEstimateRow, pose_row
from compose.recording.estimating.recorded_measurements import Measurements, numerics
from compose.recording.ranging.range_recording import Numbers, RecordedRobot
from protocol.mission import HEADING_ACCURACY
from protocol.motion import wrap


class EpochFit(NamedTuple):
    """The fit of the first hypothesis, and what it was fitted to."""

    fit: Fit
    used: JointMeasurements
    """The measurements up to the end of the epoch."""


class EstimateEpoch(NamedTuple):
    """The estimate at the end of one epoch."""

    t: float
    """The time in s, on the clock of the recording."""
    rows: list[PoseEstimateRow]
    """The poses of the first hypothesis; none before there are enough ranges."""
    hypotheses: list[FinalHypothesis]
    """The hypotheses, the most probable first."""
    ranges: tuple[int, ...]
    """The number of ranges that are used, of each pair of radios."""
    claims: tuple[bool, ...]
    """True if a robot may claim the pose of the first hypothesis."""
    blocking_reason: str
    """The condition for a claim that is not met; empty if all are."""
    fitted: EpochFit | None
    """The fit of the first hypothesis; None without one, and if there is a later epoch."""
    undetermined: dict[str, str]
    """The robots that have no pose, with the reason."""


class RecordingEstimator:
    """The estimate of any number of robots, which goes on from epoch to epoch (see `following`)."""

    def __init__(self, rule: ClaimRule, solver: Solver | None = None) -> None:
        self.rule, self._solver = rule, solver
        self.past: list[EstimateEpoch] = []
        """All epochs so far."""
        self.begin()

    def begin(self) -> None:
        """Begin the search of all further epochs again."""
        self._next = 0
        self._following = Following()

    def epochs(
        self, measured: Measurements, done: Callable[[], None] = lambda: None
    ) -> Iterator[EstimateEpoch]:
        """Yield the estimates at the ends of further epochs, of those after the last one.

        The measurements may have grown since the last call, and are otherwise the same; while their units are
        in doubt, epochs are left out. `done` is called after each epoch. Raises NoEstimate if numbers leave
        the range of floats (see `numerics`), and UserError if a solution of the user's solver cannot be used.
        """
        numbers, self._next = range(self._next, len(measured.ends)), len(measured.ends)
        after_s = self.past[-1].t if self.past else -math.inf
        for number in numbers if not measured.doubt else ():
            t = float(measured.ends[number])
            if t > after_s and not measured.silent[number]:
                try:
                    with numerics(f"{measured.source}: at {t:.15g} s"):
                        epoch = self._epoch(measured, number)
                except UnusableSolution as error:
                    raise UserError(f"{self._solver}: {error}") from None
                self.past[-1:] = [one._replace(fitted=None) for one in self.past[-1:]]  # fits are large
                self.past.append(epoch)
                yield epoch
            done()

    def _epoch(self, measured: Measurements, number: int) -> EstimateEpoch:
        """Return the estimate at the end of the epoch with this `number`, from 0 on, in their order."""
        used = msgspec.structs.replace(measured.until(number), solver=self._solver)
        found = self._following = self._following.after(used, self.rule, "recording", used.robots)
        return _result(measured, number, used, found.known, found.reasons, self.rule.accuracy)


def _result(
    measured: Measurements,
    number: int,
    used: JointMeasurements,
    found: Posterior,
    reasons: Mapping[str, str],
    accuracy: float,
) -> EstimateEpoch:
    """Return the estimate at the end of an epoch, by what was `found` with what is `used`."""
    t, part, sure = float(measured.ends[number]), used.some(found.located), certainties(found)
    place = {used.robots[robot]: i for i, robot in enumerate(found.located)}
    without = {
        one.id: open_position(place[one.id], found.hypotheses[0].fit, part)
        if one.id in place
        else undetermined(used.robots.index(one.id), found.located, used)
        for one in measured.robots
    }
    posed = [one for one in measured.robots if not without[one.id]]
    unseen = {one.id: one.unseen.sigmas(np.array([t]))[0] for one in posed}
    fits = [with_unscaled_priors(each.fit) for each in found.hypotheses]
    blocking = {name: why_unseen_blocks(fits[0], place[name], one, accuracy) for name, one in unseen.items()}
    reasons = {name: reason or blocking.get(name, "") for name, reason in reasons.items()}
    without = {name: why for name, why in without.items() if why}
    reason = [f"{one.id}: {reasons[one.id]}" for one in posed if reasons.get(one.id)]
    reason += [f"{name} is undetermined: {why}" for name, why in without.items()]
    more = f"; and {len(reason) - 1} more" if len(reason) > 1 else ""
    claims = {one.id: reasons.get(one.id) == "" for one in measured.robots}
    centres = [
        {one.id: _centre(one.recorded, place[one.id], fit, used.origin, unseen[one.id]) for one in posed}
        for fit in fits
    ]
    rows = [
        pose_row(one.recorded, t, sure[place[one.id]], *centres[0][one.id], claim=claims[one.id])
        for one in posed
    ]
    return EstimateEpoch(
        t,
        rows,
        [
            FinalHypothesis(each.probability, {name: pose for name, (pose, _) in poses.items()})
            for each, poses in zip(found.hypotheses, centres, strict=True)
        ],
        tuple(np.bincount(part.ranges.radio, minlength=len(measured.joint.radios)).tolist()),
        tuple(claims.values()),
        reason[0] + more if reason else "",
        EpochFit(fits[0], part) if fits else None,
        without,
    )


def _centre(
    robot: RecordedRobot, k: int, fit: Fit, origin: tuple[float, float], unseen: Numbers
) -> tuple[tuple[float, float, float], Numbers]:
    """Return the pose of a robot's centre in <W> and its covariance; its antenna is robot `k` of a fit."""
    (x, y, heading), own = fit.poses[k].tolist(), slice(3 * k, 3 * k + 3)
    forward, left, _ = robot.antenna
    offset = (forward + 1j * left) * np.exp(1j * heading)
    pose = float(x + origin[0] - offset.real), float(y + origin[1] - offset.imag), wrap(heading)
    if not all(map(math.isfinite, pose)):
        raise FloatingPointError("a pose is not finite")
    centred = np.array(((1.0, 0.0, offset.imag), (0.0, 1.0, -offset.real), (0.0, 0.0, 1.0)))
    more = np.diag(np.square(unseen[[0, 0, 1]]))
    return pose, centred @ (fit.covariance[own, own] + more) @ centred.T


def why_unseen_blocks(fit: Fit, k: int, unseen: Numbers, accuracy: float) -> str:
    """Return why the `unseen` motion of robot `k` makes its pose too inaccurate; empty if it does not.

    `unseen` has its sigmas (m, rad), and `accuracy` is the largest sigma (m) of a position that is claimed.
    """
    x, y, heading = np.diagonal(fit.covariance)[3 * k : 3 * k + 3].tolist()
    away, turned = unseen.tolist()
    if x + y + 2.0 * away**2 <= accuracy**2 and heading + turned**2 <= HEADING_ACCURACY**2:
        return ""
    return f"between two poses of its odometry, it may be {away:.2g} m and {turned:.2g} rad from the arc"
