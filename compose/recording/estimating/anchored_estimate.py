"""The measurements and estimates of one robot with any number of anchors."""

from __future__ import annotations

import numpy as np

from agent.estimation.gaussian.consistency import FINISHED
from agent.estimation.gaussian.known_anchors import (
    FEWEST_FOR_POSE,
    AnchoredRobot,
    blocking_reason,
    follow,
    search,
)
from agent.estimation.gaussian.range_model import Ranges
from agent.estimation.posterior import JointHypothesis
from compose.recording.estimating.estimate_epoch import (
    GIVEN_UP,
    MOST_SEARCHES,
    ClaimRule,
    EpochFit,
    EstimateEpoch,
    doubted,
    of_centres,
)
from compose.recording.estimating.pair_measurements import NoAnchors, listed
from compose.recording.estimating.prepared_steps import (
    Measurements,
    OneRobot,
    horizon,
    prepared_steps,
)
from compose.recording.estimating.recorded_noise import RecordedNoise
from compose.recording.ranging.range_recording import FixedAnchor, RangeRecording, locked


class AnchoredMeasurements(Measurements, frozen=True, kw_only=True):
    """All measurements of one robot."""

    robot: OneRobot

    @property
    def sides(self) -> tuple[OneRobot, ...]:
        """The robot."""
        return (self.robot,)

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """The names of each pair of radios."""
        return tuple([(self.robot.id, anchor.id) for anchor in self.anchors])

    @property
    def anchors(self) -> tuple[FixedAnchor, ...]:
        """The anchors of the robot."""
        return self.robot.anchors

    def until(self, epoch: int) -> AnchoredRobot:
        """Return what was measured up to the end of `epoch`; the first is 1."""
        known = self.t <= self.end(epoch)
        ranges, place, radio = self.ranges, self.ranges.place, self.ranges.radio
        assert place is not None
        assert radio is not None
        count = int(np.count_nonzero(known))
        some = Ranges(
            ranges.rho[known],
            ranges.tick[known],
            ranges.sigma[known],
            (count, 0, 0),
            place[known],
            radio[known],
        )
        reach = horizon(some)
        path = self.robot.path.until(epoch * self.ticks_per_epoch)
        return AnchoredRobot(
            path, some.within(reach, self.noise.priors, 0.0).thinned(self.noise), reach, self.noise
        )


def anchored_measurements(
    recording: RangeRecording, robot: str, assumed: RecordedNoise, *, ticks: int | None = None
) -> AnchoredMeasurements:
    """Return the measurements of one `robot`, with the noise that is `assumed`.

    `ticks` is the number of them in an epoch; None: by the speed of the robot. Raises NoAnchors unless it has
    ranges to two anchors at different places.
    """
    prepared = prepared_steps(recording, [robot], assumed, ticks)
    ranges, anchors = prepared.steps.ranges, prepared.anchors_of(0)
    if len({(one.x, one.y) for one in anchors}) < 2:
        names = listed([one.id for one in anchors]) or "no anchor"
        raise NoAnchors(
            f"{recording.source}: one robot needs ranges to two anchors at different places: "
            f"{robot} has ranges to {names}"
        )
    place, radios = {one.id: k for k, one in enumerate(anchors)}, prepared.part.radios
    radio = np.array([place[radios[second]] for second in ranges.second], np.intp)
    places = np.array([(one.x - anchors[0].x, one.y - anchors[0].y) for one in anchors])
    rho, sigma = prepared.in_plane(np.arange(len(ranges.t)))
    return AnchoredMeasurements(
        robot=prepared.robot(0, anchors),
        ranges=Ranges(
            locked(rho), locked(prepared.ticks), locked(sigma), (len(rho), 0, 0), places[radio], radio
        ),
        t=ranges.t,
        **prepared.shared(""),
    )


ANCHORED_SEARCHES = frozenset((FEWEST_FOR_POSE, *(8 * 2**n for n in range(12))))
"""The numbers of ranges at which the whole plane is searched again, as in a mission."""


class AnchoredEstimator:
    """The estimate of one robot, which goes on from epoch to epoch."""

    def __init__(self, rule: ClaimRule) -> None:
        self._rule = rule
        self._known: tuple[JointHypothesis, ...] = ()
        self._searched = self._searches = 0
        self._claimed = False

    def epoch(self, measured: AnchoredMeasurements, number: int) -> EstimateEpoch:
        """Return the estimate at the end of the epoch with this `number`, from 1 on, in their order."""
        robot, t = measured.until(number), measured.end(number)
        count = len(robot.ranges.rho)
        radio = robot.ranges.radio
        assert radio is not None
        counts = tuple([int(np.count_nonzero(radio == k)) for k in range(len(measured.anchors))])
        due = any(self._searched < at <= count for at in ANCHORED_SEARCHES)
        scored = follow(robot, self._known) if self._known and not due else ()
        reason = "" if not scored else self._reason(robot, scored)
        moving = not scored or scored[0].fit.last_step > FINISHED
        wanted = count >= FEWEST_FOR_POSE and (moving or (not reason and not self._claimed))
        if wanted and not due and self._searches >= MOST_SEARCHES:
            reason = reason or GIVEN_UP
        elif wanted:
            scored = search(robot, scored or self._known)
            self._searched, self._searches = count, self._searches + 1
            reason = self._reason(robot, scored) if scored else ""
        if not scored:
            what = "no hypothesis explains the ranges" if count >= FEWEST_FOR_POSE else "too few ranges"
            return EstimateEpoch(t, counts, (), (False,), what, None)
        self._known = scored
        self._claimed = self._claimed or not reason
        hypotheses = tuple(
            [
                of_centres(
                    one.probability, one.fit.poses, one.fit.covariance, measured.sides, measured.origin
                )
                for one in scored
            ]
        )
        return EstimateEpoch(t, counts, hypotheses, (not reason,), reason, EpochFit(scored[0].fit, robot))

    def _reason(self, robot: AnchoredRobot, scored: tuple[JointHypothesis, ...]) -> str:
        reason = blocking_reason(scored, robot, self._rule.accuracy, self._rule.confidence)
        return reason or doubted(scored[0].fit, robot.measured)
