"""The noise that is assumed for a recording: a profile, a TOML file, or what the recording states.

A file has the table `[mission.noise]`. It may also have the table `[calibration]`, which `tandem calibrate`
writes: errors of ranges that are known, and are removed before the estimate. What is left has the priors in
`[mission.noise]`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, get_args

import msgspec
import numpy as np
from msgspec.structs import replace

from compose.errors import UserError
from compose.recording.estimating.radio_errors import absurd_error
from compose.recording.ranging.range_recording import RangeRecording, locked
from compose.scenario.toml_file import field_first, read_text, table_in
from protocol.noise import PROFILES, UNTOLD, UNTOLD_SIGMA, Noise, ProfileName, VelocityNoise, with_profile
from protocol.spelling import did_you_mean

RESIDUAL_S, RESIDUAL_TURN = 50.0, 1e-4
"""The noise of odometry besides that of increments: the sigma of a range in so many s, and rad/s.

It sets the bound below which a robot counts as standing, with which a gyro has no bias.
"""

CAMERA: Mapping[str, Any] = PROFILES["camera"]
"""The priors for recordings that state the sigmas of ranges: these say nothing of other errors.

In a recording of a mission, whose errors its robots know, the priors are those of UNTOLD.

With those of UNTOLD, without a depth, 23 of 136 claims of three robots of MRCLAM 6, whose ranges are depths,
were wrong; with these, 2 of 1 961. Where ranges are distances, they cost claims: on TIERS, 770 poses are
claimed instead of 1 002.
"""

STATED_DELAY_S: float = PROFILES["uwb"]["range_delay"]
"""The prior in s of the delay of such ranges.

Of ranges that are 0.3 s late at 1 m/s, 5 claims of 107 were wrong without it (by 5 of their sigmas along an
axis), 2 of 113 with it, and the median error of a claim is 0.10 m, not 0.3 m.
"""

ACCURATE = 0.002
"""The sigma of ranges, as a fraction of their median, below which the priors become narrower."""

FALLBACK: ProfileName = "uwb"
"""The profile for recordings that do not state the sigma of each range."""


class RangeCorrection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table `[calibration]`: errors of ranges that are known.

    A range r between the radios of a pair is r - bias - scale r.
    """

    range_bias: float = 0.0
    """The bias (m) of pairs that are not in `pairs`."""
    range_scale: float = 0.0
    """The relative error of all ranges: the part by which they are too long."""
    pairs: dict[str, float] = {}
    """The bias (m) of each pair of radios, by their names with a hyphen between."""

    def corrected(self, recording: RangeRecording) -> RangeRecording:
        """Return `recording` with the known errors removed from its ranges.

        Raises UserError if no radio has such errors.
        """
        ranges = recording.ranges
        longest = float(np.max(ranges.range, initial=0.0))
        errors = {"range_bias": (self.range_bias, 0.0), "range_scale": (0.0, self.range_scale)}
        for name, error in {**errors, **{pair: (value, 0.0) for pair, value in self.pairs.items()}}.items():
            if why := absurd_error(*error, longest):
                raise UserError(f"--noise: [calibration] {name} has {why}")
        bias = np.full(len(ranges.t), self.range_bias)
        for (first, second), rows in recording.pairs().items():
            for name in (f"{first}-{second}", f"{second}-{first}"):
                bias[rows] = self.pairs.get(name, bias[rows])
        measured = np.maximum(ranges.range * (1.0 - self.range_scale) - bias, 0.0)
        return recording._replace(ranges=ranges._replace(range=locked(measured)))


class AssumedNoise(NamedTuple):
    """The noise that an estimate assumes, and its source."""

    name: str
    """The name of the profile, the path of the file, or that the recording states it."""
    noise: Noise
    correction: RangeCorrection | None = None
    stated: bool = False
    """True if the sigmas of ranges are those that the recording states."""

    @property
    def sigma(self) -> float:
        """The larger sigma (m) of ranges to anchors and between robots: the unit of lengths of odometry."""
        return max(self.noise.anchor_sigma, self.noise.mutual_sigma)

    @property
    def odometry(self) -> VelocityNoise | None:
        """The noise of odometry over one second; None: what the recording states."""
        return None if self.noise.odometry == VelocityNoise() else self.noise.odometry

    def of_fit(self, steps: float) -> Noise:
        """Return the noise in a fit, in which a recorded increment, with its own variances, lasts `steps`."""
        share = self.noise.odometry_strays / max(steps, 1.0)
        odometry = VelocityNoise(0.0, 0.0, self.sigma / RESIDUAL_S, RESIDUAL_TURN)
        return replace(self.noise, odometry=odometry, odometry_strays=share)


def stated_noise(recording: RangeRecording) -> AssumedNoise:
    """Return the noise that `recording` states; that of FALLBACK if it does not for each range."""
    sigmas = recording.ranges.sigma
    if not len(sigmas) or not np.all(np.isfinite(sigmas)):
        return told_noise(FALLBACK)
    usual = float(np.median(sigmas))
    share = usual / max(ACCURATE * float(np.median(recording.ranges.range)), usual)
    size = share * usual / UNTOLD_SIGMA
    of: dict[str, Any] = {**UNTOLD._asdict(), **({} if recording.of_mission else CAMERA)}
    priors = {one: share**2 * of[one] for one in ("range_scale", "wheel_scale", "gyro_bias")}
    priors |= {one: size * of[one] for one in ("range_bias", "pair_bias")}
    priors |= {"range_delay": STATED_DELAY_S, "range_depth": of["range_depth"]}
    noise = Noise(anchor_sigma=usual, mutual_sigma=usual, **priors)
    return AssumedNoise("stated in the recording", noise, stated=True)


class _MissionNoise(msgspec.Struct, frozen=True):
    noise: Noise


class _NoiseFile(msgspec.Struct, frozen=True):
    """The tables of a TOML file that are used; a scenario has others."""

    mission: _MissionNoise
    calibration: RangeCorrection | None = None


def told_noise(name: str) -> AssumedNoise:
    """Return the noise of the profile `name`, or of the file at this path. Raises UserError."""
    known, path = get_args(ProfileName), Path(name)
    if name in known:
        return AssumedNoise(name, msgspec.convert(with_profile(name), Noise))
    if path.suffix != ".toml":
        what = f"neither a profile ({', '.join(known)}) nor a .toml file"
        raise UserError(f"--noise: {name[:80]!a} is {what}{did_you_mean(name, known)}")
    try:
        content = table_in(read_text(path), str(path))
    except FileNotFoundError:
        raise UserError(f"--noise: there is no file {path}") from None
    except ValueError as error:
        raise UserError(f"{path} {error}") from None
    mission = content.get("mission")
    if isinstance(mission, dict) and "noise" in mission:
        content = {**content, "mission": {**mission, "noise": with_profile(mission["noise"])}}
    try:
        read = msgspec.convert(content, _NoiseFile)
    except msgspec.ValidationError as error:
        raise UserError(f"{path}: {field_first(str(error), _NoiseFile)}") from None
    return AssumedNoise(name, read.mission.noise, read.calibration)
