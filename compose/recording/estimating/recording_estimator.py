"""The estimates of recorded robots over time, by one fit to everything that is known of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from agent.estimation.claim import BEFORE_SEARCH, blocked
from agent.estimation.fit import Fit
from agent.estimation.gaussian.joint_claims import Displacement, displaced_anchor, open_position, undetermined
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.search import candidates, extended, search
from agent.estimation.judged import of_joint
from agent.estimation.posterior import NO_HYPOTHESES, Certainty, Hypothesis, Posterior, certainties, settled
from agent.estimation.solver import Solver
from compose.recording.estimating.recorded_measurements import Measurements, numerics
from compose.recording.ranging.range_recording import Numbers
from protocol.motion import wrap

GROUP_SEARCHES = tuple(8 * 2**n for n in range(16))
"""The numbers of ranges at which the whole plane is searched again."""

MOST_SEARCHES = 100
"""The number of searches of the whole plane after which it is only searched with twice as many ranges.

Where no hypothesis fits, each epoch has a search. With fewer, recordings of a minute that settle late would
have other estimates; with more, recordings that contradict themselves take longer.
"""

GIVEN_UP = (
    f"not settled after {MOST_SEARCHES} searches of the plane; the next is due with twice as many ranges"
)
"""The reason against a claim that such a search has not confirmed."""

RETESTED = 1.1
"""The factor by which ranges must have grown before the places of the anchors are tested again.

With less, claims of robots with many anchors take twice as long; with more, a false place is found later.
"""

MORE_RANGES = 1.5
"""The factor by which the decisive ranges of a robot must have grown before it is tried again."""


class ClaimRule(NamedTuple):
    """The accuracy and the confidence that a claim needs."""

    accuracy: float = 0.3
    """The largest sigma of the position in m: the root of the trace of its covariance."""
    confidence: float = 0.9999
    """The least probability of the hypothesis."""


class PosesHypothesis(NamedTuple):
    """One hypothesis about the centres of all robots at the end of an epoch; NaN for those without a pose."""

    probability: float
    poses: Numbers
    """x (m), y (m) and heading (rad) in <W> of each robot; shape (R, 3)."""
    covariance: Numbers
    """The covariance of each pose; shape (R, 3, 3)."""


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
    certainties: tuple[Certainty, ...]
    """The certainty of the pose of each robot."""
    undetermined: Mapping[str, str]
    """The robots that have no pose, with the reason."""


class RecordingEstimator:
    """The estimate of any number of robots, which goes on from epoch to epoch.

    Robots that are located are followed. The whole plane is searched at the numbers of ranges GROUP_SEARCHES,
    and before the first claim of each robot.
    """

    def __init__(self, rule: ClaimRule, solver: Solver | None = None) -> None:
        self._rule, self._solver = rule, solver
        self._next = 0
        self._known: Posterior = NO_HYPOTHESES
        self._searched = self._searches = 0
        self._failed: dict[tuple[int, ...], int] = {}
        self._claimed: set[str] = set()
        self._displaced: Displacement | None = None
        self._tested = 0

    def epochs(
        self, measured: Measurements, done: Callable[[], None] = lambda: None, after_s: float = -math.inf
    ) -> Iterator[EstimateEpoch]:
        """Yield the estimates at the ends of further epochs, of those after the time `after_s`.

        The measurements may have grown since the last call, and are otherwise the same; while their units are
        in doubt, epochs are left out. `done` is called after each epoch. Raises NoEstimate if numbers leave
        the range of floats (see `numerics`).
        """
        numbers, self._next = range(self._next, len(measured.ends)), len(measured.ends)
        for number in numbers if not measured.doubt else ():
            t = float(measured.ends[number])
            if t > after_s and not measured.silent[number]:
                with numerics(f"{measured.source}: at {t:.15g} s"):
                    epoch = self._epoch(measured, number)
                yield epoch
            done()

    def _epoch(self, measured: Measurements, number: int) -> EstimateEpoch:
        """Return the estimate at the end of the epoch with this `number`, from 0 on, in their order."""
        used = msgspec.structs.replace(measured.until(number), solver=self._solver)
        known = settled(self._known, used)
        found = self._extended(known if known.hypotheses else NO_HYPOTHESES, used)
        count = len(used.ranges.rho)
        due = found.hypotheses and any(self._searched < at <= count for at in GROUP_SEARCHES)
        reasons = self._reasons(found, used)
        claiming = {name for name, reason in reasons.items() if not reason} - self._claimed
        if claiming and not due and self._searches >= MOST_SEARCHES:
            reasons |= dict.fromkeys(sorted(claiming), GIVEN_UP)
        elif due or claiming:
            found, self._searched = search(used, found), count
            self._searches += 1
            reasons = self._reasons(found, used)
        self._known = found
        self._claimed |= {name for name, reason in reasons.items() if not reason}
        return _result(measured, number, used, found, reasons)

    def _extended(self, found: Posterior, used: JointMeasurements) -> Posterior:
        """Return `found` with further robots; those that failed are tried again with more ranges."""
        possible = candidates(found.located, used)
        failed = [one for one in possible if one.decisive < MORE_RANGES * self._failed.get(one.robots, 0)]
        if len(failed) == len(possible):
            return found
        more = extended(found, used, failed)
        for one in candidates(more.located, used):
            if one not in failed:
                self._failed[one.robots] = one.decisive
        return more

    def _reasons(self, found: Posterior, used: JointMeasurements) -> dict[str, str]:
        """Return what blocks the claim of each located robot; an empty text if nothing does."""
        part = used.some(found.located)
        judged = {
            part.robots[i]: of_joint("recording", i, found, certainty, part, *self._rule)
            for i, certainty in enumerate(certainties(found))
            if not part.is_anchor(i)
        }
        claiming = {name for name, one in judged.items() if blocked(one, BEFORE_SEARCH) is None}
        if claiming:
            count = len(part.ranges.rho)
            if count >= RETESTED * self._tested or not claiming <= self._claimed:
                self._tested, self._displaced = count, displaced_anchor(found.hypotheses[0].fit, part)
            judged = {name: one._replace(displaced=self._displaced) for name, one in judged.items()}
        reasons = {name: blocked(one) for name, one in judged.items()}
        return {name: one.reason if one is not None else "" for name, one in reasons.items()}


def _result(
    measured: Measurements,
    number: int,
    used: JointMeasurements,
    found: Posterior,
    reasons: dict[str, str],
) -> EstimateEpoch:
    """Return the estimate at the end of an epoch, by what was `found` with what is `used`."""
    names, part = [one.id for one in measured.robots], used.some(found.located)
    place = {used.robots[robot]: i for i, robot in enumerate(found.located)}
    without = {
        name: open_position(place[name], found.hypotheses[0].fit, used)
        if name in place
        else undetermined(used.robots.index(name), found.located, used)
        for name in names
    }
    without = {name: why for name, why in without.items() if why}
    sure, places = certainties(found), [None if name in without else place[name] for name in names]
    reason = [f"{name}: {reasons[name]}" for name in names if reasons.get(name) and name not in without]
    reason += [f"{name} is undetermined: {why}" for name, why in without.items()]
    more = f"; and {len(reason) - 1} more" if len(reason) > 1 else ""
    return EstimateEpoch(
        float(measured.ends[number]),
        tuple(np.bincount(part.ranges.radio, minlength=len(measured.joint.radios)).tolist()),
        tuple([_of_centres(one, places, measured) for one in found.hypotheses]),
        tuple([reasons.get(name) == "" for name in names]),
        reason[0] + more if reason else "",
        EpochFit(found.hypotheses[0].fit, part) if found.hypotheses else None,
        tuple([sure[place[name]] if name in place else Certainty(0, 0.0) for name in names]),
        without,
    )


def _of_centres(one: Hypothesis, places: Sequence[int | None], measured: Measurements) -> PosesHypothesis:
    """Return a hypothesis about the centres of robots; their antennas are at `places` in the fit."""
    poses, covariance = np.full((len(places), 3), np.nan), np.full((len(places), 3, 3), np.nan)
    for i, k in enumerate(places):
        if k is None:
            continue
        (x, y, heading), own = one.fit.poses[k].tolist(), slice(3 * k, 3 * k + 3)
        forward, left, _ = measured.robots[i].recorded.antenna
        offset = (forward + 1j * left) * np.exp(1j * heading)
        x0, y0 = measured.joint.origin
        poses[i] = x + x0 - offset.real, y + y0 - offset.imag, wrap(heading)
        centred = np.array(((1.0, 0.0, offset.imag), (0.0, 1.0, -offset.real), (0.0, 0.0, 1.0)))
        covariance[i] = centred @ one.fit.covariance[own, own] @ centred.T
        if not np.all(np.isfinite(poses[i])):
            raise FloatingPointError("a pose is not finite")
    return PosesHypothesis(one.probability, poses, covariance)
