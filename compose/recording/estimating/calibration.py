"""The calibration of the radios of a recording, by its true poses, or by an estimate without them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial

import numpy as np

from compose.errors import UserError
from compose.recording.estimating.doubtful_units import doubtful_lengths
from compose.recording.estimating.estimate_epoch import ClaimRule
from compose.recording.estimating.estimate_run import chosen_robots, estimated, measurements, numerics
from compose.recording.estimating.learned_errors import learned_errors
from compose.recording.estimating.radio_errors import (
    FEWEST_ERRORS,
    PairErrors,
    RangeCalibration,
    absurd_error,
    range_calibration,
    true_errors,
)
from compose.recording.estimating.true_poses import TRUTH_GAP_S
from compose.recording.ranging.range_recording import RangeRecording

ASSUMED = "uwb"
"""The profile of the estimate that replaces the truth: that of radios that nobody has calibrated."""

RULE = ClaimRule(accuracy=1.0)
"""The claim rule of that estimate: the radios' errors need the right hypothesis, not an accurate one."""


Fitting = Callable[[str, int], AbstractContextManager[Callable[[], None]]]
"""A function that is called before a fit, with the reason for it and the number of epochs.

It returns the context of the fit, with a callback for each epoch.
"""


def _quietly(_why: str, _epochs: int) -> AbstractContextManager[Callable[[], None]]:
    return nullcontext(lambda: None)


def calibrated(
    recording: RangeRecording,
    robots: Sequence[str] | None,
    window: tuple[float, float] | None,
    *,
    by_fit: bool = False,
    fitting: Fitting = _quietly,
) -> RangeCalibration:
    """Return the errors of the radios of `robots`, or of all, within `window` (s from the first odometry on).

    They are against the truth if there is some, unless `by_fit`; else against an estimate. Raises UserError.
    """
    chosen = chosen_robots(recording, robots)
    begin, end = recording.span
    part = recording.part(
        chosen, *((begin, end) if window is None else (begin + window[0], begin + window[1]))
    )
    with numerics(recording.source):
        errors = {} if by_fit else true_errors(part)
        if not errors:
            why = f"no {FEWEST_ERRORS} ranges of a pair have true poses within {TRUTH_GAP_S:g} s"
            return _by_fit(recording, chosen, window, partial(fitting, "" if by_fit else why))
        lengths = {pair: (one.measured, one.measured - one.error) for pair, one in errors.items()}
        if doubt := doubtful_lengths(lengths, "true poses and anchors"):
            raise UserError(f"{recording.source}: {doubt}")
        found = range_calibration(errors, "the truth")
        for pair, one in found.pairs.items():
            if why := absurd_error(one.bias, one.sure_scale, float(np.max(errors[pair].measured))):
                what = (
                    f"by its true poses, {'-'.join(pair)} has {why}: are stamps, positions and units right?"
                )
                raise UserError(f"{recording.source}: {what}")
        return found._replace(unused=len(part.ranges.t) - sum([len(one.t) for one in errors.values()]))


def _by_fit(
    recording: RangeRecording,
    robots: Sequence[str],
    window: tuple[float, float] | None,
    fitting: Callable[[int], AbstractContextManager[Callable[[], None]]],
) -> RangeCalibration:
    """Return the errors against the ranges that the estimate of `robots` predicts."""
    problem = measurements(recording, robots, ASSUMED, window)
    with fitting(problem.measured.epochs) as done:
        estimate = estimated(problem, RULE, done)
    last = estimate.epochs[-1] if estimate.epochs else None
    if last is None or last.fitted is None or not all(last.claims):
        why = estimate.summary.blocking_reason or "too few ranges"
        raise UserError(
            f"{recording.source}: without true poses, an estimate of {' and '.join(robots)} is needed, "
            f"and there is none: {why}"
        )
    fit, used = last.fitted
    errors, ranges, most = {}, used.ranges, 0
    ranged = [pair for pair, count in zip(problem.measured.pairs, last.ranges, strict=True) if count]
    for pair, rows in zip(ranged, ranges.pairs, strict=True):
        t = problem.measured.time_of(ranges.tick[rows])
        most = max(most, len(t))
        if len(t) >= FEWEST_ERRORS:
            errors[pair] = PairErrors(t, ranges.rho[rows], fit.residuals[rows])
    if not errors:
        raise UserError(
            f"{recording.source}: without true poses, {FEWEST_ERRORS} ranges of a pair of radios are needed, "
            f"and the estimate uses at most {most}: one a second of each pair, and of many ranges only a part"
        )
    found = range_calibration(errors, "the fit")
    learned = learned_errors(fit, used.driving, ["-".join(pair) for pair in ranged])
    bias, scale = learned.range_bias_m, learned.range_scale
    return found._replace(
        bias_sigma=bias.sigma if bias is not None else 0.0,
        scale_sigma=max(found.scale_sigma, scale.sigma if scale is not None else 0.0),
    )
