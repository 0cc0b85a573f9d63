"""The test of a robot's own sensors: its ranges to its anchor against its odometry, without the peer.

A robot whose own measurements contradict what it was told of its sensors does not blame its peer.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from agent.estimation.gaussian.initial_guesses import anchors
from agent.estimation.gaussian.least_squares import fit
from agent.estimation.gaussian.odometry_noise import Track
from agent.estimation.gaussian.range_model import Ranges
from protocol.noise import PROFILES, Noise, ProfileName

DOUBTFUL = 3.0
"""The log evidence for another profile from which on a robot doubts what it was told of its own sensors.

With less, robots doubt their own sensors where a peer attacks; with more, honest peers are suspected where
both robots have a bias that nobody told.
"""

FEWEST_RANGES = 4
"""The least number of ranges for the test. Two determine the position of the anchor."""


class Doubt(NamedTuple):
    """The profile that explains a robot's own measurements better than the noise that it was told."""

    profile: ProfileName
    log_evidence: float

    @property
    def reason(self) -> str:
        """Return the reason for the verdict Undecided."""
        return (
            "the own ranges to the anchor contradict the own odometry and mission.noise; the profile "
            f"'{self.profile}' explains them better (log evidence {self.log_evidence:.3g}): try "
            f'noise = "{self.profile}", or calibrate the sensors'
        )


def doubt(path: Track, ranges: Ranges, sensing_range: float, noise: Noise) -> Doubt | None:
    """Return the profile that explains the own `ranges` along `path` best, if `noise` does not."""
    if len(ranges.rho) < FEWEST_RANGES:
        return None
    told = _log_evidence(path, ranges, sensing_range, noise)
    others = [
        Doubt(name, _log_evidence(path, ranges, sensing_range, _profile(name, noise)) - told)
        for name in PROFILES
        if name != noise.profile
    ]
    best = max(others, key=lambda one: one.log_evidence)
    return best if best.log_evidence > DOUBTFUL else None


def _profile(name: ProfileName, noise: Noise) -> Noise:
    """Return `noise` with the priors of a profile, and with its own white noise."""
    other = msgspec.convert(PROFILES[name], Noise)
    return replace(
        other,
        anchor_sigma=noise.anchor_sigma,
        mutual_sigma=noise.mutual_sigma,
        outliers=noise.outliers,
        outlier_bias=noise.outlier_bias,
        actuation=noise.actuation,
        odometry=noise.odometry,
    )


def _log_evidence(path: Track, ranges: Ranges, sensing_range: float, noise: Noise) -> float:
    """Return the log evidence of the ranges under `noise`, with the anchor's position integrated out."""
    points = anchors(path, ranges, sensing_range, noise)
    fits = [fit(np.array([*point, 0.0]), [path], ranges, noise) for point in points]
    return max(one.log_likelihood - 0.5 * float(np.linalg.slogdet(one.information)[1]) for one in fits)
