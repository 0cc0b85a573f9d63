"""A profile of radios from their calibration: `[mission.noise]` and `[calibration]` of a TOML file."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from compose.recording.estimating.noise_files import RangeCorrection
from compose.recording.estimating.radio_errors import (
    MOST_SLOW,
    SLOW_TIME_S,
    RadioErrors,
    RangeCalibration,
)
from protocol.noise import PROFILES, ProfileName

LEAST_BIAS, LEAST_SCALE, LEAST_STRAYS = 0.01, 0.002, 1e-3
"""The least priors (m, 1, 1) of a calibrated radio. Temperature and orientation change its errors by more
than a long recording tells."""

DIGITS = 4
"""The decimals of numbers in the file."""

UNCALIBRATED: ProfileName = "uwb"
"""The profile with the spread of the biases of pairs that counts as one pair more."""

WHEELS: ProfileName = "uwb-calibrated"
"""The profile with the priors of odometry, which a calibration of radios does not change."""


def correction_of(calibration: RangeCalibration) -> RangeCorrection:
    """Return the known errors of ranges. A pair without ranges has the mean bias of the others."""
    biases = {"-".join(pair): round(one.bias, DIGITS) for pair, one in calibration.pairs.items()}
    mean = float(np.mean([one.bias for one in calibration.pairs.values()]))
    return RangeCorrection(round(mean, DIGITS), round(calibration.scale, DIGITS), biases)


def noise_table(calibration: RangeCalibration, anchors: frozenset[str]) -> dict[str, float]:
    """Return the fields of `[mission.noise]`. `anchors` are the names of anchors."""
    pairs = calibration.pairs
    to_anchor = [one for pair, one in pairs.items() if not anchors.isdisjoint(pair)]
    mutual = [one for pair, one in pairs.items() if anchors.isdisjoint(pair)]
    slow = _root_mean_square([one.slow_sigma for one in pairs.values()])
    biases = [one.bias for one in pairs.values()]
    spread = _spread(biases, PROFILES[UNCALIBRATED]["pair_bias"])
    outliers = sum([one.outliers * one.ranges for one in pairs.values()]) / sum(
        [one.ranges for one in pairs.values()]
    )
    found = {
        "anchor_sigma": _white(to_anchor or mutual, slow),
        "mutual_sigma": _white(mutual or to_anchor, slow),
        "range_bias": max(spread / math.sqrt(len(biases)), LEAST_BIAS, calibration.bias_sigma),
        "pair_bias": max(spread, LEAST_BIAS),
        "range_scale": max(math.hypot(calibration.scale_sigma, calibration.scale_spread), LEAST_SCALE),
        "slow_sigma": slow,
        "slow_time": SLOW_TIME_S,
        "wheel_scale": PROFILES[WHEELS]["wheel_scale"],
        "gyro_bias": PROFILES[WHEELS]["gyro_bias"],
        "strays": min(max(outliers, LEAST_STRAYS), LARGEST_OUTLIER_SHARE),
    }
    return {name: round(value, DIGITS) for name, value in found.items()}


LARGEST_OUTLIER_SHARE = 0.5
"""The largest fraction of outliers for which a profile is written."""


def _spread(values: list[float], usual: float) -> float:
    """Return the standard deviation of `values` from their mean, with one more value off by `usual`.

    Of two or three values, it may be small by chance.
    """
    return math.sqrt(float(np.var(values)) + usual**2 / len(values))


def _root_mean_square(values: list[float]) -> float:
    return math.sqrt(float(np.mean(np.square(values)))) if values else 0.0


def _white(pairs: list[RadioErrors], slow: float) -> float:
    """Return the sigma (m) of what is not slow."""
    total = _root_mean_square([one.sigma for one in pairs])
    return math.sqrt(max(total**2 - slow**2, (1.0 - MOST_SLOW) * total**2))


def profile_toml(noise: Mapping[str, float], correction: RangeCorrection, source: str) -> str:
    """Return the text of the file; `source` says where the numbers come from."""
    lines = [f"# Radios calibrated by {source}.", "[mission.noise]"]
    lines += [f"{name} = {value!r}" for name, value in noise.items()]
    lines += ["", "[calibration]", f"range_bias = {correction.range_bias!r}"]
    lines += [f"range_scale = {correction.range_scale!r}", "", "[calibration.pairs]"]
    lines += [f"{name} = {value!r}" for name, value in correction.pairs.items()]
    return "\n".join([*lines, ""])
