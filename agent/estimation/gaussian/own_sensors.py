"""The comparison of the noise that a robot was told with the profiles of common sensors.

A robot does not blame its peer for what a profile explains, and claims no pose that a profile contradicts.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import msgspec
from msgspec.structs import replace

from agent.estimation.fit import Fit, Start, fits
from agent.estimation.gauss_newton import FIT_STEPS, Convergence
from agent.estimation.gaussian.anchor_guesses import anchors
from agent.estimation.gaussian.beacon_guesses import start_of
from agent.estimation.gaussian.consistency import CLAIM_P_VALUE, consistency_test
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.odometry_noise import rescaled
from agent.estimation.gaussian.search import search
from protocol.noise import PROFILES, SIZES, UNTOLD_SIGMA, Noise, ProfileName

DOUBTED_EVIDENCE = 3.0
"""The log evidence for another profile from which on a robot doubts what it was told of its own sensors.

With less, robots doubt their own sensors where a peer attacks; with more, honest peers are suspected where
both robots have a bias that nobody told.
"""

NOT_AGAINST = -1.0
"""The log evidence of the own measurements for a profile above which it may excuse the peer.

The profile must also explain all measurements without a contradiction. The own ranges of a robot that stays
near its anchor often tell nothing for or against a bias: with 1, 5 honest peers of 60 were suspected with a
bias of 0.35 m that nobody told, whose log evidence was -0.8 to 0. With ranges as told, it is -1 to -4. Of 187
detected attacks at 0.05 m, 4 are excused with -1; of 528 at 0.01 m, none.
"""

DOUBTFUL_CLAIM = 12.0
"""The log evidence of the ranges of both robots for another profile from which on a robot does not claim.

Set on the sweeps `mismatch` and `mismatch-uwb`. Ranges with errors as told, or with larger ones, gave at most
6, and errors that are correlated over 20 ticks 12. A bias of 0.35 m of the anchors' ranges gave at least 22,
and wrong claims 15.
"""

ONE_MODEL_ERROR = 8.0
"""The bound on the error of the log evidence for a profile by one linear model, without further steps.

Only profiles that may contradict a claim are fitted to the end. The error was at most 2.5 in 404 claims with
ranges as told, with a bias and with correlated errors. With 0, profiles would be overlooked; with more, all
of them are fitted.
"""

DOUBTFUL_CLAIMS = 5
"""The number of claims that a robot withholds for this reason before it ends with `undecided`."""

FEWEST_RANGES = 4
"""The least number of ranges for the test. Two determine the position of the anchor."""


class Doubt(NamedTuple):
    """The profile that explains measurements better than the noise that the robots were told."""

    what: str
    """The measurements that contradict the noise."""
    profile: ProfileName
    how: str
    """The degree to which the profile explains them better, in words."""

    def reason(self, option: str = 'noise = "{}"') -> str:
        """Return the reason against a claim; `option` is how a user states a profile."""
        return (
            f"{self.what} contradict the assumed noise; the profile '{self.profile}' explains them "
            f"{self.how}: try {option.format(self.profile)}, or calibrate the sensors"
        )


OWN_SENSORS = "the own ranges to the anchor and the own odometry"
"""The measurements that do not depend on the peer, and those of a single robot."""

ALL = "the ranges and the odometry"
"""All measurements."""


def doubt(own: JointMeasurements, pair: JointMeasurements | None = None, robot: int = 0) -> Doubt | None:
    """Return the profile that explains a contradiction between the reports of the peer and the own ranges.

    It explains the `own` ranges to the anchor much better than the told noise; or about as well, and those of
    the `pair` without a contradiction, as `robot` (0 or 1) tests it.
    """
    noise = own.noise
    if len(own.ranges.rho) < FEWEST_RANGES:
        return None
    told = _log_evidence(own)
    profiles = {name: replace(own, noise=_profile(name, noise)).alone(0) for name in _others(noise)}
    others = {name: _log_evidence(one) - told for name, one in profiles.items()}
    found = _best(OWN_SENSORS, others, DOUBTED_EVIDENCE)
    if found is not None or pair is None:
        return found
    possible = [name for name in others if others[name] > NOT_AGAINST]
    return next(
        (Doubt(ALL, name, "without a contradiction") for name in possible if _explains(name, pair, robot)),
        None,
    )


@lru_cache(maxsize=2)
def contradiction(fitted: Fit, measured: JointMeasurements, *, recorded: bool = False) -> Doubt | None:
    """Return the profile that explains what was `measured` much better than the told noise.

    `fitted` is the fit that would be claimed. Ranges that were `recorded` may be those of a camera, those of
    a mission are not. Only constant errors are compared: slow ones and strays do not move a pose by more than
    the noise level that robots learn. Biases are in proportion to the sigma.
    """
    noise = measured.noise
    others, size = {}, max(noise.anchor_sigma, noise.mutual_sigma) / UNTOLD_SIGMA
    for name in _others(noise, CAMERAS if recorded and not noise.range_depth else ()):
        other = _profile(name, noise)
        if recorded and all(one <= told for one, told in zip(other.priors, noise.priors, strict=True)):
            continue  # wide priors explain less of what narrow ones explain, and contradict nothing
        biases = {one: size * getattr(other.priors, one) for one in ("range_bias", "pair_bias")}
        other = replace(other, slow_sigma=noise.slow_sigma, strays=noise.strays, **biases)
        errors = tuple([rescaled(one, noise, other) for one in fitted.start.errors])
        start, again = Start(fitted.start.poses, errors), replace(measured, noise=other)
        for steps in (0, FIT_STEPS):
            found = [one.weight for one in fits(again, [start], Convergence(steps))]
            others[name] = max(found, default=-math.inf) - fitted.weight
            if others[name] < DOUBTFUL_CLAIM - ONE_MODEL_ERROR:
                break
    return _best(ALL, others, DOUBTFUL_CLAIM)


def _explains(name: ProfileName, pair: JointMeasurements, robot: int) -> bool:
    """Return whether the ranges and reports that `robot` (0 or 1) has are consistent under a profile.

    The priors of the profile are smaller for accurate ranges, as the default ones are.
    """
    under = replace(pair, noise=_profile(name, pair.noise, _share(pair.noise)))
    found = search(under).hypotheses
    return bool(found) and consistency_test(found[0].fit, under, robot).p_value >= CLAIM_P_VALUE


def _others(noise: Noise, further: tuple[ProfileName, ...] = ()) -> list[ProfileName]:
    """Return the profiles other than that of `noise`, the narrowest first, then `further` ones."""
    return [name for name in (*NARROWEST_FIRST, *further) if name != noise.profile]


NARROWEST_FIRST: tuple[ProfileName, ...] = ("wheels", "uwb-calibrated", "uwb")
"""The profiles of missions, in the order of their priors."""

CAMERAS: tuple[ProfileName, ...] = ("camera",)
"""The profiles that are for recordings only."""


def _best(what: str, log_evidence: dict[ProfileName, float], least: float) -> Doubt | None:
    """Return the profile with the largest log evidence over the told noise, if it is more than `least`."""
    best = max(log_evidence, key=log_evidence.__getitem__)
    how = f"better (log evidence {log_evidence[best]:.3g})"
    return Doubt(what, best, how) if log_evidence[best] > least else None


def _share(noise: Noise) -> float:
    """Return the fraction of the priors of a profile that remains for ranges of this accuracy."""
    return min(1.0, max(noise.anchor_sigma, noise.mutual_sigma) / UNTOLD_SIGMA) ** 2


def _profile(name: ProfileName, noise: Noise, share: float = 1.0) -> Noise:
    """Return `noise` with the priors of a profile, whose sizes are times `share`, and its own white noise."""
    priors = msgspec.convert(PROFILES[name], Noise).priors._asdict()
    other = msgspec.convert({**PROFILES[name], **{one: share * priors[one] for one in SIZES}}, Noise)
    return replace(
        other,
        anchor_sigma=noise.anchor_sigma,
        mutual_sigma=noise.mutual_sigma,
        outliers=noise.outliers,
        outlier_bias=noise.outlier_bias,
        actuation=noise.actuation,
        odometry=noise.odometry,
        odometry_strays=noise.odometry_strays,
    )


def _log_evidence(own: JointMeasurements) -> float:
    """Return the log evidence of the ranges to the anchor, with its position integrated out."""
    found = fits(own, map(start_of, anchors(own)))
    return max([one.weight for one in found], default=-math.inf)
