"""The steps of fits. A step that does not descend is shortened."""

from __future__ import annotations

from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from agent.estimation.fit import DESCENT, LARGEST_STEP, SHORTER_STEPS
from agent.estimation.gaussian.fitted import NormalEquations
from agent.estimation.gaussian.linear_model import ErrorSizes, LinearModel, Point, Problem, product
from agent.estimation.gaussian.odometry_noise import Array, Places


def stepped(
    problem: Problem, point: Point, linear: LinearModel, system: NormalEquations, variance: Array
) -> Point:
    """Return the points after a step by `system`, or after that fraction of it that descends.

    `variance` is that of each range (m^2) for known constant and slow errors.
    """
    return _descended(problem, point, *full_step(problem, point, linear, system), variance)


def full_step(
    problem: Problem, point: Point, linear: LinearModel, system: NormalEquations
) -> tuple[Array, ErrorSizes]:
    """Return the guesses and errors after a step by `system`, of at most LARGEST_STEP each."""
    change = system.change
    change = change * np.minimum(
        1.0, LARGEST_STEP / np.maximum(np.abs(change).max(-1, keepdims=True), LARGEST_STEP)
    )
    guess = point.guess.copy()
    guess[:, problem.free] += change
    left_over = system.weighted[..., -1] - product(system.weighted[..., :-1], change)
    return guess, problem.sizes(point, linear, left_over)


def _descended(problem: Problem, point: Point, guess: Array, sizes: ErrorSizes, variance: Array) -> Point:
    """Return the point after a step to `guess` and `sizes`, or after that fraction of it that descends.

    If none does, the point stays.
    """
    most = point.cost(variance) + DESCENT
    following = problem.point(guess, sizes)
    descends = following.cost(variance) <= most
    if descends.all():
        return following
    climbing = np.flatnonzero(~descends)
    for fraction in SHORTER_STEPS:
        begin, end, ends = rows_of((point, guess, sizes), climbing)
        shorter = [one + fraction * (other - one) for one, other in zip(begin.sizes, ends, strict=True)]
        nearer = problem.point(begin.guess + fraction * (end - begin.guess), ErrorSizes(*shorter))
        _put_rows(following, climbing, nearer)
        climbing = climbing[~(nearer.cost(variance[climbing]) <= most[climbing])]
        if not len(climbing):
            return following
    _put_rows(following, climbing, rows_of(point, climbing))
    return following


T = TypeVar("T")


def rows_of(values: T, some: NDArray[np.bool] | Places) -> T:
    """Return the part of `values`, a tuple of arrays or of such tuples, that belongs to some of the fits."""
    if isinstance(values, np.ndarray):
        return cast("T", values[some])
    if not isinstance(values, tuple):
        return values
    parts = [rows_of(value, some) for value in values]
    return cast("T", type(values)(*parts) if hasattr(values, "_fields") else tuple(parts))


def _put_rows(values: object, some: NDArray[np.bool] | Places, others: object) -> None:
    """Replace the part of `values` that belongs to some of the fits by `others`."""
    if isinstance(values, tuple) and isinstance(others, tuple):
        for value, other in zip(values, others, strict=True):
            _put_rows(value, some, other)
    elif isinstance(values, np.ndarray):
        values[some] = others
