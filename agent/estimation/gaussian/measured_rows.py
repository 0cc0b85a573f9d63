"""The rows of ranges, and what else is known, from which the measurements of a fit are made.

They are a function of a set of facts, in canonical order: robots by name, ranges by kind, radios and tick.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter

import numpy as np

from agent.estimation.facts import AnchorPlace, Manoeuvre, MeasuredRow, StartPose
from agent.estimation.gaussian.joint_ranges import (
    JointMeasurements,
    JointRanges,
    PosePrior,
    Silence,
    prior_of,
)
from agent.estimation.gaussian.odometry_noise import Array, Track, track
from agent.estimation.gaussian.range_model import SIGMA_FLOOR
from protocol.noise import Noise

OF_START = 1e-3
"""The sigma (m, rad) of an exact pose at tick 0, as a fraction of that of a range in m.

Without it, the covariance of a robot that only its odometry moves would be singular, and no claim. With more,
the covariances of other robots would contain it.
"""

Listed = Sequence[tuple[int, float]]
"""Ticks and ranges in m, as the robots log them."""


def near_anchors(
    paths: Sequence[Track],
    own: Sequence[Listed],
    places: Sequence[tuple[float, float]],
    noise: Noise,
    reach: float,
    mutual: Listed = (),
    silent: tuple[Silence, ...] = (),
) -> JointMeasurements:
    """Return the measurements of robots with one anchor each, the first of which is the origin.

    `own` contains the ranges of each to its anchor, whose place (m) is in `places`. `mutual` contains those
    between the first two.
    """
    lists, robots = [*own, mutual], len(paths)
    counts = [len(one) for one in lists]
    kind = np.repeat(np.arange(robots + 1), counts)
    sigmas = np.array(
        [max(noise.anchor_sigma, SIGMA_FLOOR)] * robots + [max(noise.mutual_sigma, SIGMA_FLOOR)]
    )
    ranges = JointRanges(
        np.array([rho for ranges in lists for _, rho in ranges], np.float64),
        np.array([tick for ranges in lists for tick, _ in ranges], np.intp),
        sigmas[kind],
        kind % robots,
        np.where(kind == robots, 1, -1),
        np.array([*places, (0.0, 0.0)])[kind],
        kind,
        np.zeros(len(kind), bool),
    )
    return JointMeasurements(
        *(("a", "b")[:robots], (), (), tuple(paths), ranges, paths[0].period, (0.0, 0.0), noise),
        reach=reach,
        silent=silent,
    )


def of_rows(
    places: Mapping[str, AnchorPlace],
    starts: Mapping[str, StartPose],
    steps: Mapping[str, Sequence[Manoeuvre] | Array],
    measured: Iterable[MeasuredRow],
    noise: Noise,
    period: float,
    reach: float = math.inf,
) -> JointMeasurements:
    """Return what was `measured` by robots whose manoeuvres from tick 0 on are in `steps`.

    Manoeuvres may also be the rows of an array, (K, 5). `places` are those of the anchors, and `starts` those
    of the robots that have one. Ticks last `period` s, and no range above `reach` m is expected. Ranges after
    the path of a robot are not used, nor those to anchors that have no place.
    """
    surveyed, robots = {name: one for name, one in places.items() if not one.sigma}, sorted(steps)
    rows = [
        row
        for row in measured
        if row.tick <= len(steps[row.first])
        and (row.tick <= len(steps[row.second]) if row.mutual else row.second in places)
    ]
    rows.sort(key=itemgetter(0, 1, 2, 3))
    used = tuple(sorted({row.second for row in rows if not row.mutual}))
    unsure = [one for one in used if one not in surveyed]
    unsure.sort(key=lambda name: places[name].sigma < math.inf)
    index = {name: number for number, name in enumerate((*robots, *unsure))}
    radios = tuple(dict.fromkeys([(row.first, row.second) for row in rows]))
    radio = {names: number for number, names in enumerate(radios)}
    first = sorted(used, key=lambda name: places[name].sigma)[:1]
    origin = places[first[0]] if first else AnchorPlace(0.0, 0.0)
    at = [surveyed.get(row.second, origin) for row in rows]
    standing = _path(np.zeros((max(map(len, steps.values()), default=0), 5)), period)
    relative = [
        one and one._replace(x=one.x - origin.x, y=one.y - origin.y)
        for one in (*map(starts.get, robots), *map(places.get, unsure))
    ]
    anchors = tuple([one if isinstance(one, AnchorPlace) else None for one in relative]) if unsure else ()
    return JointMeasurements(
        tuple(index),
        used,
        radios,
        tuple([_path(steps[name], period) if name in steps else standing for name in index]),
        JointRanges(
            np.array([row.measured.range for row in rows], np.float64),
            np.array([row.tick for row in rows], np.intp),
            np.maximum(np.array([row.measured.sigma for row in rows], np.float64), SIGMA_FLOOR),
            np.array([index[row.first] for row in rows], np.intp),
            np.array([index.get(row.second, -1) for row in rows], np.intp),
            np.array([(one.x - origin.x, one.y - origin.y) for one in at], np.float64).reshape(-1, 2),
            np.array([radio[row.first, row.second] for row in rows], np.intp),
            np.array([row.measured.by_second for row in rows], bool),
        ),
        period,
        (origin.x, origin.y),
        noise,
        _prior(relative, OF_START * max(noise.anchor_sigma, noise.mutual_sigma, SIGMA_FLOOR)),
        anchors,
        reach,
    )


def _prior(poses: Sequence[AnchorPlace | StartPose | None], of_start: float) -> PosePrior | None:
    """Return what is known of the poses of robots and anchors; None if nothing is.

    The heading of an anchor means nothing, and is held. `of_start` is the sigma (m, rad) of a start.
    """
    if not any(poses):
        return None
    mean, information = np.zeros((len(poses), 3)), np.zeros((3 * len(poses), 3 * len(poses)))
    for k, one in enumerate(poses):
        block = information[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        match one:
            case AnchorPlace(x, y, sigma):
                mean[k, :2], block[:] = (x, y), np.diag((sigma**-2, sigma**-2, 1.0))
            case StartPose():
                mean[k], block[:] = one, np.diag((of_start**-2, of_start**-2, of_start**-2))
    return prior_of(mean, information)


def _path(steps: Sequence[Manoeuvre] | Array, period: float) -> Track:
    """Return the path of `steps`; without slip or extra variances if all of them are 0."""
    v, omega, slip, *extra = np.array(steps, np.float64).reshape(-1, 5).T
    path = track(v + 0.0, omega + 0.0, period, slip if slip.any() else None)
    both = np.stack(extra)
    return path._replace(extra=both) if both.any() else path
