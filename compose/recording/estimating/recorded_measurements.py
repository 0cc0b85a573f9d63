"""The measurements of recorded robots: facts in ticks, and what the estimator makes of them.

A tick is so short that no robot moves further in half of it than a small part of a range's sigma, and each
range counts at the nearest tick.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import msgspec
import numpy as np

from agent.estimation.facts import AnchorPlace, MeasuredRange, MeasuredRow, StartPose
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.measured_rows import of_rows
from agent.estimation.gaussian.odometry_noise import Track
from agent.estimation.gaussian.range_model import SIGMA_FLOOR
from compose.errors import BadRecording, NoEstimate, UserError
from compose.recording.estimating.doubtful_units import doubtful_units
from compose.recording.estimating.noise_files import AssumedNoise, stated_noise, told_noise
from compose.recording.estimating.sound_odometry import FLOOR_S, SoundOdometry, at_antenna, levelled, sound
from compose.recording.estimating.true_poses import in_frame_of, with_bridged_truth
from compose.recording.ranging.range_recording import (
    SAME_TIME_S,
    FixedAnchor,
    Numbers,
    Places,
    RangeRecording,
    RecordedRobot,
    locked,
)
from compose.recording.ranging.range_steps import (
    NEARLY_ALL,
    WITHOUT_ODOMETRY,
    Flags,
    RangeSteps,
    speeds,
    steps_of,
)
from compose.recording.ranging.unseen_motion import UnseenMotion, unseen_motion
from compose.recording.reasons import listed
from protocol.noise import Noise

EPOCH_S = 0.5
"""The time in s between two estimates."""

RANGE_SILENCE_S = 1.0
"""The time in s without a range and without the end of an increment after which there are no estimates.

So the measurements bound the number of estimates, not the time between them.
"""

MOST_TICKS_APART = 50
"""The largest number of ticks in an epoch."""

SHARE = 0.25
"""The largest part of a range's sigma that a robot moves in half a tick.

With it, rounding the times of ranges adds at most 1 % to their sigma.
"""

HORIZON = 1.25
"""The assumed sensing range, as a multiple of the longest possible range so far.

A missing range of a recording says nothing, so that this only scales the tolerances of the search. With 1,
the estimator would take it for information that no range is longer.
"""

POSSIBLE = 2.0
"""The longest possible range, as a multiple of the largest median of two radios and the ways of two robots.

A range of two radios differs from any other one by at most the way that they drive in between. A range beyond
twice that is an outlier under any guess; as the longest range, it would scale all tolerances.
"""

MOST_USED_ANCHORS = 32
"""The largest number of anchors of a robot that are used. Each has a bias of its own, which a fit learns."""


class MeasuredRobot(NamedTuple):
    """One robot of an estimate."""

    recorded: RecordedRobot
    """The robot with its antenna, and with its truth if there is one."""
    anchors: tuple[FixedAnchor, ...]
    """The anchors to which it has ranges, that with the most first; there may be none."""
    sound: SoundOdometry
    unseen: UnseenMotion
    """The deviation of its antenna from the arcs of its increments."""

    @property
    def id(self) -> str:
        """The name of the robot."""
        return self.recorded.id


class Measurements(msgspec.Struct, frozen=True, kw_only=True):
    """The measurements of the robots of an estimate, and what is known of their source."""

    source: str
    robots: tuple[MeasuredRobot, ...]
    """The robots, in the order of the user."""
    joint: JointMeasurements
    """The measurements as a fit takes them, with the robots in the order of their names."""
    t0: float
    """The time in s of tick 0."""
    ticks_per_epoch: int
    noise: str
    """The name of the assumed noise."""
    unused: dict[str, int]
    """The number of ranges that are not used, by the reason."""
    skipped_s: Numbers
    """The time in s of long gaps that is left out before each tick; shape (K + 1,)."""
    ends: Numbers
    """The time in s of the end of each epoch; shape (E,)."""
    silent: Flags
    """True for an epoch before whose end nothing was measured in RANGE_SILENCE_S: no estimate; shape (E,)."""
    doubt: str = ""
    """The suspicion that parts of the recording are in different units; with one, nothing is estimated."""
    relative_to: str | None = None
    """The robot whose pose at tick 0 is the origin; None in the frame of the anchors."""

    def time_of(self, tick: Places) -> Numbers:
        """Return the times in s of ticks."""
        return np.asarray(self.t0 + self.joint.period * tick + self.skipped_s[tick], np.float64)

    @property
    def anchors(self) -> tuple[FixedAnchor, ...]:
        """The anchors of all robots."""
        return tuple({one.id: one for robot in self.robots for one in robot.anchors}.values())

    def path(self, robot: str) -> Track:
        """Return the path of the antenna of a robot, in the frame of its first pose."""
        return self.joint.paths[self.joint.robots.index(robot)]

    def until(self, epoch: int) -> JointMeasurements:
        """Return what was measured up to the end of `epoch`, from 0 on; see HORIZON."""
        known = self.joint.until((epoch + 1) * self.ticks_per_epoch)
        return known.thinned(HORIZON * max(longest_possible(known), SIGMA_FLOOR))


def longest_possible(known: JointMeasurements) -> float:
    """Return the longest range (m) that its radios may have, 0 without ranges; see POSSIBLE."""
    rho = known.ranges.rho
    medians = [
        float(np.partition(own, (len(own) - 1) // 2)[(len(own) - 1) // 2])
        for own in [rho[rows] for _, rows in known.ranges.pairs]
    ]
    ways = sorted([float(np.sum(np.abs(path.v))) * known.period for path in known.paths])
    most = POSSIBLE * (max(medians, default=0.0) + sum(ways[-2:]))
    return float(np.max(rho, initial=0.0, where=rho <= most))


@contextmanager
def numerics(where: str) -> Iterator[None]:
    """Raise NoEstimate, which begins with `where`, if numbers in the block leave the range of floats.

    They may in a valid recording, with values of 1e7 m or 1e-300 m. Other errors are not hidden.
    """
    try:
        with np.errstate(all="ignore"):
            yield
    except (np.linalg.LinAlgError, ArithmeticError) as error:
        raise NoEstimate(f"{where}: its numbers are too large or small for an estimate ({error})") from None


def chosen_part(
    recording: RangeRecording, robots: Sequence[str] | None, window: tuple[float, float] | None
) -> RangeRecording:
    """Return the part with `robots`, or with all, within `window` (s from the first odometry on).

    Raises UserError if the recording has not all of them, or no odometry so late.
    """
    known, (begin, end) = [one.id for one in recording.robots], recording.span
    for name in robots or ():
        if name not in known:
            raise UserError(f"--robots: {recording.source} has no robot {name}; it has {', '.join(known)}")
    if robots is not None and not 0 < len(robots) == len(set(robots)):
        raise UserError(f"--robots: it names {'a robot twice' if robots else 'no robot'}")
    lasts = end - begin
    if window is not None:
        begin, end = begin + window[0], min(begin + window[1], end)
        if begin >= end:
            raise UserError(f"--window: {recording.source} has odometry of {lasts:.3f} s")
    return recording.part(known if robots is None else robots, begin, end)


def measurements(
    recording: RangeRecording,
    robots: Sequence[str] | None,
    noise: str | AssumedNoise | None,
    window: tuple[float, float] | None = None,
    *,
    relative: str | None = None,
    ticks: int | None = None,
    doubt: str | None = None,
) -> Measurements:
    """Return the measurements of `robots` within `window`, in s from the first odometry on.

    `noise` is the name of a profile, the path of a file, or what was read of one; None: what the recording
    states. `relative` is the robot whose start defines the frame, in which no anchor has a position; None:
    the frame is that of the recording. `ticks` is the number of them in an epoch; None: by the speed of the
    robots. `doubt` is the suspicion about the units; None: they are examined. Raises UserError.
    """
    told = told_noise(noise) if isinstance(noise, str) else noise
    part = chosen_part(recording, robots, window)
    outside = _without_odometry(recording, part) if window is None else 0
    assumed = told or stated_noise(part)
    if assumed.correction is not None:
        part = assumed.correction.corrected(part)
    if relative is None and recording.origin in [one.id for one in part.robots]:
        relative = recording.origin
    if relative is not None:
        if relative not in (names := [one.id for one in part.robots]):
            raise UserError(f"--relative: {relative} is not among the robots {', '.join(names)}")
        anchors = [one._replace(x=math.nan, y=math.nan, sigma=math.inf) for one in part.anchors]
        part = part._replace(anchors=tuple(anchors))
    with numerics(recording.source):
        found = _measurements(part, assumed, ticks, relative)
        if relative is None:
            _check_anchors(part, recording)
        unused = Counter(found.unused)
        unused[WITHOUT_ODOMETRY] += outside
        doubt = doubtful_units(part) if doubt is None else doubt
        return msgspec.structs.replace(found, doubt=doubt, unused=dict(+unused))


def _without_odometry(recording: RangeRecording, part: RangeRecording) -> int:
    """Return the number of ranges of the robots of `part` outside of the time of their odometry."""
    t = recording.part([one.id for one in part.robots], -math.inf, math.inf).ranges.t
    begin, end = part.span
    return int(np.count_nonzero((t < begin) | (t > end)))


def _measurements(
    part: RangeRecording, assumed: AssumedNoise, ticks: int | None, relative: str | None
) -> Measurements:
    """Return the measurements in `part`, whose units are not examined."""
    names = [one.id for one in part.robots]
    whole, part = part, part.part(names, *part.span)
    for robot in part.robots:
        if not len(robot.odometry.t0):
            raise BadRecording(f"{part.source}: {robot.id} has no odometry")
        if robot.jumps:
            raise BadRecording(robot.jumps[0].why)
    arrivals = np.sort(np.concatenate([[-np.inf], part.ranges.t, *[one.odometry.t1 for one in part.robots]]))
    prepared = [sound(robot.odometry, assumed.odometry, assumed.sigma) for robot in whole.robots]
    moved = [
        robot._replace(odometry=at_antenna(one.odometry, *robot.antenna[:2]))
        for robot, one in zip(part.robots, prepared, strict=True)
    ]
    part = part._replace(robots=tuple(moved))
    ticks = ticks or ticks_per_epoch(part, assumed.noise)
    period = EPOCH_S / ticks
    steps = steps_of(part, period)
    t0, skipped_s = float(steps.t[0]), steps.skipped_s[ticks::ticks]
    ends = t0 + np.arange(1, len(skipped_s) + 1) * EPOCH_S + skipped_s
    last = arrivals[np.searchsorted(arrivals, ends + SAME_TIME_S) - 1]
    used = part._replace(ranges=steps.ranges)
    lasts = np.median(np.concatenate([one.odometry.t1 - one.odometry.t0 for one in part.robots]))
    noise = assumed.of_fit(float(lasts) / period)
    anchors = [used.anchors_of(i)[:MOST_USED_ANCHORS] for i in range(len(names))]
    unseen = [unseen_motion(robot.odometry, assumed.sigma / FLOOR_S) for robot in part.robots]
    ranges = list(_ranges(used, steps, assumed, anchors, unseen))
    placed = {one.id: one for own in anchors for one in own}.values()
    places = {
        one.id: AnchorPlace(0.0, 0.0, one.sigma)
        if one.sigma == math.inf
        else AnchorPlace(one.x + 0.0, one.y + 0.0, one.sigma + 0.0)
        for one in placed
    }
    manoeuvres = {
        name: _manoeuvres(increments, covariance, period)
        for name, increments, covariance in zip(names, steps.increments, steps.covariance, strict=True)
    }
    starts: dict[str, StartPose] = {}
    recorded = tuple(map(with_bridged_truth, whole.robots))
    if relative is not None:
        x, y, _ = whole.robot(relative).antenna
        starts[relative] = StartPose(x + 0.0, y + 0.0, 0.0)
        recorded = tuple(in_frame_of(relative, t0, recorded))
    unused = {
        f"to others than the {MOST_USED_ANCHORS} anchors with the most": len(steps.ranges.t) - len(ranges),
        **steps.unused,
    }
    return Measurements(
        source=part.source,
        robots=tuple(map(MeasuredRobot, recorded, anchors, prepared, unseen)),
        joint=of_rows(places, starts, manoeuvres, ranges, noise, period),
        t0=t0,
        ticks_per_epoch=ticks,
        noise=assumed.name,
        unused={why: count for why, count in unused.items() if count},
        skipped_s=steps.skipped_s,
        ends=locked(ends),
        silent=locked(last < ends - RANGE_SILENCE_S),
        relative_to=relative,
    )


def ticks_per_epoch(recording: RangeRecording, noise: Noise) -> int:
    """Return the number of ticks in an epoch, by the speed of the fastest robot (see SHARE)."""
    least = max(min(noise.anchor_sigma, noise.mutual_sigma), SIGMA_FLOOR)
    fastest = max(float(np.percentile(speeds(one.odometry)[0], NEARLY_ALL)) for one in recording.robots)
    return min(max(math.ceil(0.5 * EPOCH_S * fastest / (SHARE * least)), 1), MOST_TICKS_APART)


def _ranges(
    used: RangeRecording,
    steps: RangeSteps,
    assumed: AssumedNoise,
    anchors: list[tuple[FixedAnchor, ...]],
    unseen: list[UnseenMotion],
) -> Iterator[MeasuredRow]:
    """Yield the ranges in the plane between robots and to their `anchors`, each at the nearest tick.

    The variance of a range within increments includes that of the `unseen` motion of its robots.
    """
    ranges, count, noise = steps.ranges, len(used.robots), assumed.noise
    heights = np.array([*[one.antenna[2] for one in used.robots], *[one.height for one in used.anchors]])
    rho, ratio = levelled(ranges.range, heights[ranges.first] - heights[ranges.second])
    sigma = np.where(ranges.second < count, noise.mutual_sigma, noise.anchor_sigma)
    if assumed.stated:
        sigma = np.where(np.isfinite(ranges.sigma), ranges.sigma, sigma)
    sigma = np.maximum(sigma, SIGMA_FLOOR) * ratio
    away = np.stack([one.sigmas(ranges.t)[:, 0] for one in unseen])
    mutual = ranges.second < count
    variance = np.square(away[ranges.first, np.arange(len(ranges.t))])
    variance[mutual] += np.square(away[ranges.second[mutual], np.flatnonzero(mutual)])
    sigma = np.sqrt(np.square(sigma) + variance)
    ticks = steps.step + (steps.fraction >= 0.5)
    own, radios = [{one.id for one in each} for each in anchors], used.radios
    columns = [each.tolist() for each in (ranges.first, ranges.second, ticks, rho, sigma)]
    for first, second, tick, distance, spread in zip(*columns, strict=True):
        robot, other = radios[first], radios[second]
        measured = MeasuredRange(distance + 0.0, spread + 0.0, second < count and other < robot)
        if second < count:
            yield MeasuredRow(True, min(robot, other), max(robot, other), tick, measured)
        elif other in own[first]:
            yield MeasuredRow(False, robot, other, tick, measured)


def _manoeuvres(increments: Numbers, covariance: Numbers, period: float) -> Numbers:
    """Return the motion in each step of `period` s, with the variances of the increments; see `of_rows`.

    The error sideways is not used: a path has none but that of its heading.
    """
    dx, dy, turn = increments.T
    half = 0.5 * turn
    slip = np.remainder(np.arctan2(dy, dx) - half + math.pi, math.tau) - math.pi
    backwards = np.abs(slip) > 0.5 * math.pi
    slip = np.where(backwards, np.remainder(slip, math.tau) - math.pi, slip)
    unit = period * np.sinc(half / math.pi)
    moved = np.hypot(dx, dy)
    slip = np.where(moved > 0.0, slip, 0.0)
    along = np.stack((np.cos(half + slip), np.sin(half + slip)), 1)
    v_variance = np.einsum("ki,kij,kj->k", along, covariance[:, :2, :2], along) / np.square(unit)
    v = np.where(backwards, -moved, moved) / unit
    return np.stack((v, turn / period, slip, v_variance, covariance[:, 2, 2] / period**2), 1) + 0.0


class NoAnchors(UserError):
    """One robot, or two, have no ranges to two anchors with positions at different places."""


def _check_anchors(part: RangeRecording, recording: RangeRecording) -> None:
    """Raise NoAnchors for one robot, or for two, in `part`. Of more robots, some may be estimated.

    It also raises NoAnchors if all ranges of these robots in `recording` are of other times than odometry, or
    half of them where the others are to too few anchors.
    """
    whole = recording.part([one.id for one in part.robots], -math.inf, math.inf)
    t, (begin, end) = whole.ranges.t, whole.span
    count, placed = len(part.robots), part.with_places()
    anchors = [placed.anchors_of(robot) for robot in range(count)]
    enough = count > 2 or len({(one.x, one.y) for own in anchors for one in own}) > 1
    if t.size and np.mean((t >= begin) & (t <= end)) <= (0.0 if enough else 0.5):
        when = f"{t[0]:.15g} s to {t[-1]:.15g} s, and odometry of {begin:.15g} s to {end:.15g} s"
        raise NoAnchors(f"{part.source}: ranges are of {when}: stamps have to be in s, on one clock")
    if enough:
        return
    heard = [
        f"{robot.id} has ranges to {listed([one.id for one in own]) or 'no anchor'}"
        for robot, own in zip(part.robots, anchors, strict=True)
    ]
    who = "two robots need" if count == 2 else "one robot needs"
    raise NoAnchors(f"{part.source}: {who} ranges to two anchors at different places: " + ", ".join(heard))
