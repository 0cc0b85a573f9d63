"""The constant errors of radios and odometry that a fit has learned, with their remaining sigmas."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from agent.estimation.fit import Fit


class LearnedError(msgspec.Struct, frozen=True):
    """A constant error by the fit, and how well the measurements determine it."""

    value: float
    """The estimate."""
    sigma: float
    """The standard deviation; that of the prior if the measurements tell nothing."""


class LearnedErrors(msgspec.Struct, frozen=True):
    """The constant errors of all sensors. Errors with a prior of 0 are left out."""

    noise_level: float
    """The factor by which the sigmas of ranges differ from the assumed ones."""
    range_bias_m: LearnedError | None
    """The bias that all ranges have in common, in m."""
    range_scale: LearnedError | None
    """The relative error of all ranges: the part by which they are too long."""
    pair_bias_m: dict[str, LearnedError]
    """The further bias of each pair of radios, in m."""
    range_delay_s: LearnedError | None
    """The delay of all ranges in s: the time by which their stamps are late."""
    wheel_scale: dict[str, LearnedError]
    """The relative error of the distance of each robot: the part by which its odometry is too short."""
    turn_scale: dict[str, LearnedError]
    """The relative error of its turns: the part by which its odometry is too small."""
    gyro_bias_rad_s: dict[str, LearnedError]
    """The bias of the turn rate of each robot while it moves, in rad/s, to be added to the measured one."""


def learned_errors(fit: Fit, names: Sequence[str], pairs: Sequence[str]) -> LearnedErrors:
    """Return the errors that `fit` has learned.

    `names` are those of the robots that drive, and `pairs` those of the pairs of radios that have ranges, in
    order.
    """
    priors = fit.problem.noise.priors
    taken = iter(zip(fit.constants.tolist(), fit.constant_sigmas.tolist(), strict=True))

    def next_of(prior: float) -> LearnedError:
        mean, sigma = next(taken)
        return LearnedError(prior * mean, prior * sigma)

    bias = next_of(priors.range_bias) if priors.range_bias else None
    scale = next_of(priors.range_scale) if priors.range_scale else None
    of_pairs = {name: next_of(priors.pair_bias) for name in pairs} if priors.pair_bias else {}
    delay = next_of(priors.range_delay) if priors.range_delay else None
    wheels: dict[str, LearnedError] = {}
    turns: dict[str, LearnedError] = {}
    gyros: dict[str, LearnedError] = {}
    if priors.of_odometry:
        for name in names:
            wheels[name], turns[name] = next_of(priors.wheel_scale), next_of(priors.wheel_scale)
            gyros[name] = next_of(priors.gyro_bias)
    return LearnedErrors(fit.level**0.5, bias, scale, of_pairs, delay, wheels, turns, gyros)
