"""The noise that is assumed for a recording: a profile, or what the recording states."""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from compose.recording.ranging.range_recording import RangeRecording
from protocol.noise import PROFILES, Noise, ProfileName, VelocityNoise, with_profile

RESIDUAL = VelocityNoise(v_floor=1e-3, omega_floor=1e-4)
"""The noise of odometry in addition to that of each increment, in m/s and rad/s.

It sets the bound below which a robot counts as standing, with which a gyro has no bias.
"""

UNTOLD_DELAY_S: float = PROFILES["uwb"]["range_delay"]
"""The prior in s of a delay of ranges whose sigmas a recording states: they say nothing of its clocks.

Of ranges that are 0.3 s late at 1 m/s, 5 claims of 107 were wrong without it
(by 5 of their sigmas along an axis), 2 of 113 with it, and the median error of a claim is 0.10 m, not 0.3 m.
Where stamps are right, as many poses are claimed.
"""

FALLBACK: ProfileName = "uwb"
"""The profile for recordings that do not state the sigma of each range."""


class RecordedNoise(NamedTuple):
    """The assumed noise, and its source."""

    noise: Noise
    stated: bool
    """True if the sigmas of ranges are those that the recording states."""
    name: str
    odometry: VelocityNoise | None = None
    """The noise of odometry over one second; None: what the recording states."""


def recorded_noise(recording: RangeRecording, told: Noise | None, name: str = "") -> RecordedNoise:
    """Return the noise `told` with its `name`; None: what the recording states, or FALLBACK."""
    if told is not None:
        odometry = None if told.odometry == VelocityNoise() else told.odometry
        return RecordedNoise(replace(told, odometry=RESIDUAL), False, name, odometry)
    sigmas = recording.ranges.sigma
    if len(sigmas) and np.all(np.isfinite(sigmas)):
        usual = float(np.median(sigmas))
        return RecordedNoise(
            Noise(anchor_sigma=usual, mutual_sigma=usual, odometry=RESIDUAL, range_delay=UNTOLD_DELAY_S),
            True,
            "stated in the recording",
        )
    return recorded_noise(recording, profile_noise(FALLBACK), FALLBACK)


def profile_noise(name: ProfileName) -> Noise:
    """Return the noise of a profile."""
    return msgspec.convert(with_profile(name), Noise)
