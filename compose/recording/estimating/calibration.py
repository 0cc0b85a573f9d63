"""The calibration of the radios of a recording, by its true poses or by an estimate, and its profile."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from agent.estimation.following import ClaimRule
from compose.errors import UserError
from compose.recording.estimating.estimate_run import estimated
from compose.recording.estimating.noise_files import RangeCorrection
from compose.recording.estimating.radio_errors import (
    FEWEST_ERRORS,
    MOST_SLOW,
    PairErrors,
    RadioErrors,
    RangeCalibration,
    absurd_error,
    are_depths,
    range_calibration,
    true_errors,
)
from compose.recording.estimating.recorded_measurements import Measurements, chosen_part, numerics
from compose.recording.estimating.true_poses import TRUTH_GAP_S
from compose.recording.ranging.range_recording import RangeRecording
from protocol.noise import PROFILES, ProfileName

ASSUMED = "uwb"
"""The profile of the estimate that replaces the truth: that of radios that nobody has calibrated."""

RULE = ClaimRule(accuracy=1.0)
"""The claim rule of that estimate: the radios' errors need the right hypothesis, not an accurate one."""


class NoTruth(UserError):
    """No pair of radios has enough ranges whose ends have true poses."""


def calibrated(
    recording: RangeRecording, robots: Sequence[str] | None, window: tuple[float, float] | None
) -> RangeCalibration:
    """Return the errors of the radios of `robots`, or of all, within `window` (s from the first odometry on).

    They are against the truth. Raises NoTruth if there is none, and UserError.
    """
    part = chosen_part(recording, robots, window)
    with numerics(recording.source):
        errors = true_errors(part)
        if not errors:
            raise NoTruth(f"no {FEWEST_ERRORS} ranges of a pair have true poses within {TRUTH_GAP_S:g} s")
        if are_depths(part):
            what = "the ranges are depths along the headings, as of a camera, and no distances of radios"
            raise UserError(f"{recording.source}: {what}: estimate poses with --noise camera")
        found = range_calibration(errors, "the truth")
        for pair, one in found.pairs.items():
            if why := absurd_error(one.bias, one.sure_scale, float(np.max(errors[pair].measured))):
                what = f"by its true poses, {'-'.join(pair)} has {why}"
                raise UserError(f"{recording.source}: {what}: are stamps, positions and units right?")
        return found._replace(unused=len(part.ranges.t) - sum([len(one.t) for one in errors.values()]))


def calibrated_by_fit(measured: Measurements, done: Callable[[], None] = lambda: None) -> RangeCalibration:
    """Return the errors against the ranges that an estimate predicts; `done` is called after each epoch."""
    without = f"{measured.source}: without true poses"
    epochs, summary = estimated(measured, RULE, done)
    fitted = epochs[-1].fitted if epochs and all(epochs[-1].claims) else None
    if fitted is None or summary.calibration is None:
        who, reason = " and ".join(summary.robots), summary.blocking_reason or "too few ranges"
        raise UserError(f"{without}, an estimate of {who} is needed, and there is none: {reason}")
    ranges, radios = fitted.used.ranges, measured.joint.radios
    errors = {
        radios[ranges.radio[rows][0]]: PairErrors(
            measured.time_of(ranges.tick[rows]), ranges.rho[rows], fitted.fit.residuals[rows]
        )
        for _, rows in ranges.pairs
    }
    most = max([len(one.t) for one in errors.values()], default=0)
    if most < FEWEST_ERRORS:
        raise UserError(
            f"{without}, {FEWEST_ERRORS} ranges of a pair of radios are needed, "
            f"and the estimate uses at most {most}: one a second of each pair, and of many ranges only a part"
        )
    found = range_calibration(
        {pair: one for pair, one in errors.items() if len(one.t) >= FEWEST_ERRORS}, "the fit"
    )
    bias, scale = summary.calibration.range_bias_m, summary.calibration.range_scale
    return found._replace(
        bias_sigma=bias.sigma if bias is not None else 0.0,
        scale_sigma=max(found.scale_sigma, scale.sigma if scale is not None else 0.0),
    )


# --- the profile --------------------------------------------------------------------------------------------

LEAST_BIAS, LEAST_SCALE, LEAST_STRAYS = 0.01, 0.002, 1e-3
"""The least priors (m, 1, 1) of a calibrated radio. Temperature and orientation change its errors by more
than a long recording tells."""

LARGEST_OUTLIER_SHARE = 0.5
"""The largest fraction of outliers for which a profile is written."""

DIGITS = 4
"""The decimals of numbers in the file."""

UNCALIBRATED: ProfileName = "uwb"
"""The profile with the spread of the biases of pairs that counts as one pair more: that of two or three may
be small by chance."""

WHEELS: ProfileName = "uwb-calibrated"
"""The profile with the priors of odometry, which a calibration of radios does not change."""


def correction_of(calibration: RangeCalibration) -> RangeCorrection:
    """Return the known errors of ranges. A pair without ranges has the mean bias of the others."""
    biases = {"-".join(pair): one.bias for pair, one in calibration.pairs.items()}
    rounded = {pair: round(bias, DIGITS) for pair, bias in biases.items()}
    mean = float(np.mean(list(biases.values())))
    return RangeCorrection(round(mean, DIGITS), round(calibration.scale, DIGITS), rounded)


def noise_table(calibration: RangeCalibration, anchors: frozenset[str]) -> dict[str, float]:
    """Return the fields of `[mission.noise]`. `anchors` are the names of anchors."""
    all_pairs = list(calibration.pairs.values())
    to_anchor = [one for pair, one in calibration.pairs.items() if not anchors.isdisjoint(pair)]
    mutual = [one for pair, one in calibration.pairs.items() if anchors.isdisjoint(pair)]
    slow = _root_mean_square([one.slow_sigma for one in all_pairs])
    biases, usual = [one.bias for one in all_pairs], PROFILES[UNCALIBRATED]["pair_bias"]
    spread = math.sqrt(float(np.var(biases)) + usual**2 / len(biases))
    outliers = sum([one.outliers * one.ranges for one in all_pairs]) / sum([one.ranges for one in all_pairs])
    table = {
        "anchor_sigma": _white(to_anchor or mutual, slow),
        "mutual_sigma": _white(mutual or to_anchor, slow),
        "range_bias": max(spread / math.sqrt(len(biases)), LEAST_BIAS, calibration.bias_sigma),
        "pair_bias": max(spread, LEAST_BIAS),
        "range_scale": max(math.hypot(calibration.scale_sigma, calibration.scale_spread), LEAST_SCALE),
        "slow_sigma": slow,
        "slow_time": calibration.slow_time,
        "wheel_scale": PROFILES[WHEELS]["wheel_scale"],
        "gyro_bias": PROFILES[WHEELS]["gyro_bias"],
        "strays": min(max(outliers, LEAST_STRAYS), LARGEST_OUTLIER_SHARE),
    }
    return {name: round(value, DIGITS) for name, value in table.items()}


def _white(pairs: Sequence[RadioErrors], slow: float) -> float:
    """Return the sigma (m) of what is not slow."""
    total = _root_mean_square([one.sigma for one in pairs])
    return math.sqrt(max(total**2 - slow**2, (1.0 - MOST_SLOW) * total**2))


def _root_mean_square(values: list[float]) -> float:
    return math.sqrt(float(np.mean(np.square(values))))


def profile_toml(calibration: RangeCalibration, anchors: frozenset[str], source: str) -> str:
    """Return the text of the file; `source` says where the numbers come from."""
    correction = correction_of(calibration)
    tables = {
        "mission.noise": noise_table(calibration, anchors),
        "calibration": {"range_bias": correction.range_bias, "range_scale": correction.range_scale},
        "calibration.pairs": correction.pairs,
    }
    texts = [
        "\n".join([f"[{name}]", *[f"{key} = {value!r}" for key, value in table.items()], ""])
        for name, table in tables.items()
    ]
    return f"# Radios calibrated by {source}.\n" + "\n".join(texts)
