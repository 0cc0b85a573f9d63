"""The noise that a user names: a profile, or a TOML file with the table `[mission.noise]`.

The file may also have the table `[calibration]`, which `tandem calibrate` writes: errors of ranges that are
known, and are removed before the estimate. What is left has the priors in `[mission.noise]`.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, get_args

import msgspec
import numpy as np

from compose.errors import UserError
from compose.recording.estimating.radio_errors import absurd_error
from compose.recording.estimating.recorded_noise import profile_noise
from compose.recording.ranging.range_recording import RangeRecording, locked
from compose.scenario.toml_file import field_first, read_text, table_in
from protocol.noise import Noise, ProfileName, with_profile
from protocol.spelling import did_you_mean


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
        longest = float(np.max(recording.ranges.range, initial=0.0))
        for name, value in {"range_bias": self.range_bias, **self.pairs}.items():
            if why := absurd_error(value, self.range_scale, longest):
                raise UserError(f"--noise: [calibration] {name} has {why}")
        bias = np.full(len(recording.ranges.t), self.range_bias)
        for (first, second), rows in recording.pairs().items():
            for name in (f"{first}-{second}", f"{second}-{first}"):
                if name in self.pairs:
                    bias[rows] = self.pairs[name]
        ranges = recording.ranges
        measured = np.maximum(ranges.range * (1.0 - self.range_scale) - bias, 0.0)
        return recording._replace(ranges=ranges._replace(range=locked(measured)))


class _MissionNoise(msgspec.Struct, frozen=True):
    noise: Noise


class _NoiseFile(msgspec.Struct, frozen=True):
    """The tables of a TOML file that are used; a scenario has others."""

    mission: _MissionNoise
    calibration: RangeCorrection | None = None


class ToldNoise(NamedTuple):
    """The noise of a profile or of a file."""

    noise: Noise
    correction: RangeCorrection | None


def told_noise(name: str) -> ToldNoise:
    """Return the noise of the profile `name`, or of the file at this path. Raises UserError."""
    known: tuple[ProfileName, ...] = get_args(ProfileName)
    for profile in known:
        if name == profile:
            return ToldNoise(profile_noise(profile), None)
    path = Path(name)
    if path.suffix != ".toml":
        profiles = f"a profile ({', '.join(known)})"
        raise UserError(
            f"--noise: {name[:80]!a} is neither {profiles} nor a .toml file{did_you_mean(name, known)}"
        )
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
    return ToldNoise(read.mission.noise, read.calibration)
