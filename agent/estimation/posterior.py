"""The hypotheses about the poses of robots, with their probabilities by the evidence for their fits.

Ranges and ticks without a detection determine the probability of a hypothesis. It is dropped when that
becomes small, and no single measurement excludes it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from agent.estimation.compiled import address, library
from agent.estimation.fit import TO_THE_END, Fit, Start, fits
from agent.estimation.gauss_newton import Convergence
from agent.estimation.gaussian.consistency import FINISHED
from agent.estimation.gaussian.evidence import detection_log_likelihoods
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.noise_level import misfit_log_likelihood

NEGLIGIBLE_PROBABILITY = 1e-7
"""The probability, relative to the likeliest hypothesis, below which a hypothesis is dropped."""

SAME_SIGMAS = 1.0
"""The distance in sigmas below which the poses of a robot by two fits are the same."""

LEAST_EVIDENCE = -math.log(100.0)
"""The least log-likelihood of detections and of ticks without one that counts for a probability.

R may not be as it was told, and detection may fade with range. So they never suffice for a claim.
"""

MOST_JOINT = 12
"""The largest number of hypotheses whose poses are all in more probable ones, too.

Robots that are each one of two mirror images have as many hypotheses as there are combinations. Only the most
probable ones are fitted; see `_representative`.
"""

MOST_POSES = 24
"""The largest number of hypotheses. The time of an estimate is proportional to it."""

WARM_STEPS = 2
"""The Gauss-Newton steps from the fit of the previous tick.

Where the best fit has not converged by then, all fits go on to their end (see `settled`). With one step, that
is every third tick; with more, each tick takes longer."""

FAR_OFF = 10.0
"""The length in sigmas of the next step from which on a fit is far from its minimum."""

PATIENT = Convergence(64)
"""The convergence of fits that are far from their minimum after TO_THE_END: mostly, they are in none."""

FOLLOWED = Convergence(WARM_STEPS)
"""The convergence of fits that begin at those of the previous tick."""


class Hypothesis(NamedTuple):
    """One possible explanation of all measurements."""

    probability: float
    """The probability that this hypothesis is true; the probabilities of all remaining ones sum to 1."""
    fit: Fit
    """The fit, with the poses. The next one begins at its poses and at the odometry errors that it has found.

    A fit that began on the measured path again could end in another mode.
    """
    detections: float = 0.0
    """The log-likelihood of the detections and of the ticks without one, given this fit."""


class Posterior(NamedTuple):
    """The hypotheses about all located robots: those that have any. A localised robot claims its pose."""

    located: tuple[int, ...]
    """The indices of the robots to which the fits belong, ascending."""
    hypotheses: tuple[Hypothesis, ...] = ()
    """The hypotheses, the most probable first."""

    @property
    def has_converged(self) -> bool:
        """True if the fit of the most probable hypothesis has reached its minimum, or if there is none."""
        return not self.hypotheses or self.hypotheses[0].fit.last_step <= FINISHED


NO_HYPOTHESES = Posterior(())

PAIR = (0, 1)
"""The robots of a mission's pair: `Posterior.located`."""


def hypotheses_of(found: Sequence[Fit], measured: JointMeasurements) -> tuple[Hypothesis, ...]:
    """Return the hypotheses for fits to what was `measured`, likeliest first, without duplicates.

    Improbable ones are dropped. With exact sensors, so are fits that have not converged, if others have:
    their linear models explain ranges that they do not fit.
    """
    if measured.only_rounding:
        found = [one for one in found if one.last_step <= FINISHED] or found
    detections = detection_log_likelihoods(found, measured)
    weighed = [
        (one.weight + max(seen, LEAST_EVIDENCE), one, seen)
        for one, seen in zip(found, detections, strict=True)
    ]
    best = max([weight for weight, _, _ in weighed], default=0.0)
    probable = [each for each in weighed if each[0] >= best + math.log(NEGLIGIBLE_PROBABILITY)]
    probable.sort(key=lambda each: -each[0])
    left = [(math.exp(probable[k][0] - best), *probable[k][1:]) for k in _representative(probable)]
    total = sum([relative for relative, _, _ in left])
    return tuple([Hypothesis(relative / total, one, seen) for relative, one, seen in left])


def _representative(weighed: Sequence[tuple[float, Fit, float]]) -> list[int]:
    """Return the indices of the different fits: all in which a robot has a pose of its own.

    Of the others, which combine poses of likelier fits, they are the first ones. So no ambiguity of a robot
    is lost to the number of combinations of those of others.
    """
    left: list[int] = []
    for k, (_, one, _) in enumerate(weighed):
        agreed = [same(one, weighed[other][1]) for other in left]
        if any(all(each) for each in agreed):
            continue
        novel = not all(any(own) for own in zip(*agreed, strict=True)) if agreed else True
        if len(left) < (MOST_POSES if novel else MOST_JOINT):
            left.append(k)
    return left


def same(one: Fit, other: Fit) -> list[bool]:
    """Return for each robot whether two fits to the same facts have the same pose, within SAME_SIGMAS.

    Directions without variance are left out.
    """
    found = np.empty(len(one.poses), np.intp)
    arrays = [np.ascontiguousarray(part) for part in (one.poses, other.poses, other.covariance)]
    library().same_poses(len(found), *map(address, arrays), SAME_SIGMAS**2, NO_VARIANCE, address(found))
    return [bool(each) for each in found.tolist()]


NO_VARIANCE = 1e-15
"""The fraction of the largest variance up to which a variance is 0 by rounding."""


# --- from tick to tick --------------------------------------------------------------------------------


def carried(known: Posterior, before: JointMeasurements, now: JointMeasurements) -> Posterior:
    """Return the hypotheses `known`, which are fits to `before`, with the indices and the origin of `now`.

    A robot or an anchor that gets its first range changes the indices of others, and may change the origin.
    """
    names, count, index = before.robots, len(known.located), {name: k for k, name in enumerate(now.robots)}
    located = tuple([index[name] for name in names[:count]])
    of_all, origin = (*names[:count], *[now.robots[k] for k in now.placed]), now.origin
    if not known.hypotheses or (names, before.origin) == (of_all, origin):
        return Posterior(located, known.hypotheses)
    told = {} if now.prior is None else dict(zip(now.robots, now.prior.mean, strict=True))
    shift, hypotheses = (before.origin[0] - origin[0], before.origin[1] - origin[1], 0.0), []
    for one in known.hypotheses:
        start = one.fit.start
        poses = {**told, **dict(zip(names, start.poses + shift, strict=True))}
        moved = Start(np.array([poses[name] for name in of_all]), start.errors[:count])
        hypotheses.append(one._replace(fit=one.fit._replace(start=moved)))
    return Posterior(located, tuple(hypotheses))


@lru_cache(maxsize=8)
def follow(known: Posterior, measured: JointMeasurements, until: Convergence = FOLLOWED) -> Posterior:
    """Return the hypotheses that follow from those `known` before the latest facts."""
    if not known.hypotheses:
        return known
    part = measured.some(known.located)
    found = fits(part, [one.fit.start for one in known.hypotheses], until)
    return Posterior(known.located, hypotheses_of(found, part))


def settled(known: Posterior, measured: JointMeasurements) -> Posterior:
    """Return the hypotheses that follow from those `known`; fits go on to their end if the likeliest moves.

    They do so in one loop, in which the weights of the ranges go on: begun again after every two steps, 34 of
    48 recorded pairs with outliers made a claim, and not 46 (docs/howto-estimate.md).
    """
    found = follow(known, measured)
    return found if found.has_converged else follow(found, measured, TO_THE_END)


def ended(found: Posterior, measured: JointMeasurements) -> Posterior:
    """Return the hypotheses with fits that have ended, if the likeliest is FAR_OFF its linear model.

    What is off then counts as misfit. The model would explain three ranges of a robot wherever it is: no
    other robot that has ranges to it could ever claim its pose. With exact sensors, that is any step above
    FINISHED: fits go to and fro between two poses that explain the same ranges.
    """
    far = FINISHED if measured.only_rounding else FAR_OFF
    if not found.hypotheses or found.hypotheses[0].fit.last_step <= far:
        return found
    part, nu, fitted = measured.some(found.located), measured.noise.sigma_degrees, []
    for one in found.hypotheses:
        for fit in fits(part, [one.fit.start], PATIENT) if one.fit.last_step > far else [one.fit]:
            chi2 = fit.chi2 + (fit.last_step**2 * fit.level if fit.last_step > far else 0.0)
            before, after = [misfit_log_likelihood(each, fit.freedom, nu) for each in (fit.chi2, chi2)]
            fitted.append(fit._replace(chi2=chi2, weight=fit.weight + after - before))
    return Posterior(found.located, hypotheses_of(fitted, part))


def merged(known: Posterior, found: Posterior, measured: JointMeasurements) -> Posterior:
    """Return the hypotheses of both, or those of `found` alone if it locates more robots.

    Both are fitted to what was `measured`; the fits of those `known` are continued to the end. If `found`
    does not locate all of their robots, they are returned alone.
    """
    if not known.hypotheses or set(known.located) < set(found.located):
        return found
    part = measured.some(known.located)
    ended = [one.fit for one in known.hypotheses if one.fit.last_step <= TO_THE_END.shortest]
    moving = [one.fit.start for one in known.hypotheses if one.fit.last_step > TO_THE_END.shortest]
    both = ended + (fits(part, moving) if moving else [])
    if known.located == found.located:
        both += [one.fit for one in found.hypotheses]
    return Posterior(known.located, hypotheses_of(both, part))


# --- one robot of them --------------------------------------------------------------------------------


class Certainty(NamedTuple):
    """The hypotheses as far as they concern one robot."""

    poses: int
    """The number of different poses."""
    probability: float
    """The probability of the pose in the most probable hypothesis."""


def certainties(found: Posterior) -> list[Certainty]:
    """Return the certainty of each located robot, and of the anchors with a sigma, which are the last ones.

    Hypotheses that differ in others only count as one, the most probable of them. That is exact for
    ambiguities that are independent of each other, of which not all combinations are known.
    """
    result = []
    for i in range(len(found.hypotheses[0].fit.poses) if found.hypotheses else 0):
        poses = with_other_poses(found, i)
        total = sum([one.probability for one in poses])
        result.append(Certainty(len(poses), poses[0].probability / total))
    return result


def with_other_poses(found: Posterior, robot: int) -> list[Hypothesis]:
    """Return the most probable hypothesis with each of the poses of a robot, the most probable first."""
    left: list[Hypothesis] = []
    for one in found.hypotheses:
        if not any(same(one.fit, other.fit)[robot] for other in left):
            left.append(one)
    return left
