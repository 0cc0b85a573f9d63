"""The estimates of robots over time, by one fit to everything that is known of them."""

from __future__ import annotations

import numpy as np

from agent.estimation.claim import BEFORE_SEARCH, blocked, of_joint
from agent.estimation.gauss_newton import FIT_STEPS
from agent.estimation.gaussian.consistency import FINISHED
from agent.estimation.gaussian.joint_claims import (
    Displacement,
    displaced_anchor,
    open_position,
    undetermined,
)
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.joint_search import candidates, extended, follow, merged, search
from agent.estimation.posterior import NO_HYPOTHESES, Certainty, JointHypotheses, JointHypothesis, certainties
from compose.recording.estimating.estimate_epoch import (
    GIVEN_UP,
    MOST_SEARCHES,
    ClaimRule,
    EpochFit,
    EstimateEpoch,
    PosesHypothesis,
    of_centres,
)
from compose.recording.estimating.prepared_steps import Measurements

GROUP_SEARCHES = tuple(8 * 2**n for n in range(16))
"""The numbers of ranges at which the whole plane is searched again."""

RETESTED = 1.1
"""The factor by which ranges must have grown before the places of the anchors are tested again.

With less, claims of robots with many anchors take twice as long; with more, a false place is found later.
"""

MORE_RANGES = 1.5
"""The factor by which the decisive ranges of a robot must have grown before it is tried again."""


class GroupEstimator:
    """The estimate of any number of robots, which goes on from epoch to epoch.

    Robots that are located are followed. The whole plane is searched at the numbers of ranges GROUP_SEARCHES,
    and before the first claim of each robot.
    """

    def __init__(self, rule: ClaimRule) -> None:
        self._rule = rule
        self._known: JointHypotheses = NO_HYPOTHESES
        self._searched = self._searches = 0
        self._failed: dict[tuple[int, ...], int] = {}
        self._claimed: set[str] = set()
        self._displaced: Displacement | None = None
        self._tested = 0

    def epoch(self, measured: Measurements, number: int) -> EstimateEpoch:
        """Return the estimate at the end of the epoch with this `number`, from 1 on, in their order."""
        t, (used, reach) = measured.end(number), measured.until(number)
        found = self._extended(self._followed(used), used, reach)
        count = len(used.ranges.rho)
        due = found.scored and any(self._searched < at <= count for at in GROUP_SEARCHES)
        reasons = self._reasons(found, used, reach)
        claiming = {name for name, reason in reasons.items() if not reason} - self._claimed
        if claiming and not due and self._searches >= MOST_SEARCHES:
            reasons |= dict.fromkeys(sorted(claiming), GIVEN_UP)
        elif due or claiming:
            found, self._searched = merged(found, search(used, reach)), count
            self._searches += 1
            reasons = self._reasons(found, used, reach)
        self._known = found
        self._claimed |= {name for name, reason in reasons.items() if not reason}
        return _epoch(t, measured, used, found, reasons, reach)

    def _followed(self, used: JointMeasurements) -> JointHypotheses:
        """Return the known hypotheses with the latest ranges; a fit that still moves takes more steps."""
        if not self._known.scored:
            return NO_HYPOTHESES
        found = follow(self._known, used)
        if found.scored and found.scored[0].fit.last_step > FINISHED:
            found = follow(found, used, FIT_STEPS)
        return found if found.scored else NO_HYPOTHESES

    def _extended(self, found: JointHypotheses, used: JointMeasurements, reach: float) -> JointHypotheses:
        """Return `found` with further robots; those that failed are tried again with more ranges."""
        possible = candidates(found.located, used)
        failed = [one for one in possible if one.decisive < MORE_RANGES * self._failed.get(one.robots, 0)]
        if len(failed) == len(possible):
            return found
        more = extended(found, used, reach, failed)
        for one in candidates(more.located, used):
            if one not in failed:
                self._failed[one.robots] = one.decisive
        return more

    def _reasons(self, found: JointHypotheses, used: JointMeasurements, reach: float) -> dict[str, str]:
        """Return what blocks the claim of each located robot; an empty text if nothing does."""
        part, rule = used.some(found.located), self._rule
        judged = {
            part.robots[i]: of_joint(
                "recording", i, found, certainty, part, reach, rule.accuracy, rule.confidence
            )
            for i, certainty in enumerate(certainties(found))
            if not part.is_anchor(i)
        }
        claiming = {name for name, one in judged.items() if blocked(one, BEFORE_SEARCH) is None}
        if claiming:
            displaced = self._displaced_anchor(found, part, claiming)
            judged = {name: one._replace(displaced=displaced) for name, one in judged.items()}
        reasons = {name: blocked(one) for name, one in judged.items()}
        return {name: one.reason if one is not None else "" for name, one in reasons.items()}

    def _displaced_anchor(
        self, found: JointHypotheses, part: JointMeasurements, claiming: set[str]
    ) -> Displacement | None:
        """Return the anchor that seems to stand elsewhere, for robots that claim their poses."""
        count = len(part.ranges.rho)
        if count >= RETESTED * self._tested or not claiming <= self._claimed:
            self._tested, self._displaced = count, displaced_anchor(found.scored[0].fit, part)
        return self._displaced


def _epoch(
    t: float,
    measured: Measurements,
    used: JointMeasurements,
    found: JointHypotheses,
    reasons: dict[str, str],
    reach: float,
) -> EstimateEpoch:
    names = [one.id for one in measured.sides]
    part = used.some(found.located)
    place = {used.robots[robot]: i for i, robot in enumerate(found.located)}
    without = {
        name: open_position(place[name], found.scored[0].fit, reach)
        if name in place
        else undetermined(used.robots.index(name), found.located, used)
        for name in names
    }
    without = {name: why for name, why in without.items() if why}
    sure = certainties(found)
    blocked = [f"{name}: {reasons[name]}" for name in names if reasons.get(name) and name not in without]
    blocked += [f"{name} is undetermined: {why}" for name, why in without.items()]
    more = f"; and {len(blocked) - 1} more" if len(blocked) > 1 else ""
    counts = np.bincount(part.ranges.radio, minlength=len(measured.pairs)).tolist()
    return EstimateEpoch(
        t,
        tuple(counts),
        tuple([_of_all(one, names, place, without, measured) for one in found.scored]),
        tuple([name in reasons and not reasons[name] for name in names]),
        blocked[0] + more if blocked else "",
        EpochFit(found.scored[0].fit, part) if found.scored else None,
        tuple([sure[place[name]] if name in place else Certainty(0, 0.0) for name in names]),
        without,
    )


def _of_all(
    one: JointHypothesis,
    names: list[str],
    place: dict[str, int],
    without: dict[str, str],
    measured: Measurements,
) -> PosesHypothesis:
    """Return the poses of the centres of all robots; NaN for those in `without`."""
    mean = np.full((len(names), 3), np.nan)
    covariance = np.full((len(mean) * 3, len(mean) * 3), np.nan)
    known = [i for i, name in enumerate(names) if name not in without]
    rows = np.array([3 * i + k for i in known for k in range(3)], np.intp)
    own = np.array([3 * place[names[i]] + k for i in known for k in range(3)], np.intp)
    sides = tuple([measured.sides[i] for i in known])
    centred = of_centres(
        one.probability,
        one.fit.poses.ravel()[own],
        one.fit.covariance[np.ix_(own, own)],
        sides,
        measured.origin,
    )
    mean[known] = centred.poses
    covariance[np.ix_(rows, rows)] = centred.covariance
    return PosesHypothesis(one.probability, mean, covariance)
