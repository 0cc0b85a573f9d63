"""Asynchronous stamps become steps: no odometry is lost, and each range lies where it was measured."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compose.errors import BadRecording
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_recording import (
    SAME_TIME_S,
    FixedAnchor,
    Numbers,
    RangeRecording,
    RangeSeries,
    RecordedRobot,
    RobotOdometry,
)
from compose.recording.ranging.range_steps import (
    RangeSteps,
    dead_reckoned,
    gross,
    speed_bound,
    step_covariance,
    steps_of,
    within,
)
from protocol.motion import ORIGIN, Pose, step
from protocol.motion import compose as composed
from tests.range_tables import SAMPLE


def odometry_of(
    t0: list[float], t1: list[float], increments: list[tuple[float, float, float]]
) -> RobotOdometry:
    covariance = np.tile(np.diag([1e-4, 4e-4, 9e-4]), (len(t0), 1, 1))
    return RobotOdometry(np.array(t0), np.array(t1), np.array(increments).reshape(-1, 3), covariance)


def recording_of(odometry: list[RobotOdometry], ranges: list[tuple[float, int, int]]) -> RangeRecording:
    """Return a recording of the robots 0, 1, ... and one anchor, with `ranges` of (t, first, second)."""
    robots = tuple([RecordedRobot(str(i), one) for i, one in enumerate(odometry)])
    t, first, second = np.array(sorted(ranges), float).reshape(-1, 3).T
    ends = first.astype(np.intp), second.astype(np.intp)
    series = RangeSeries(t, *ends, np.arange(len(t), dtype=float), np.full(len(t), np.nan))
    return RangeRecording("it", robots, (FixedAnchor("M", 1.0, 2.0),), series)


def end_of(increments: Numbers) -> Pose:
    """Return the pose after all `increments`, one by one."""
    pose = ORIGIN
    for move in increments:
        pose = composed(pose, Pose(*map(float, move)))
    return pose


def assert_same_pose(one: Pose, other: Pose) -> None:
    assert np.allclose((one.x, one.y, one.heading), (other.x, other.y, other.heading), rtol=0, atol=1e-9)


moves = st.tuples(st.floats(-1.0, 1.0), st.floats(-0.2, 0.2), st.floats(-3.0, 3.0))
lengths = st.floats(0.02, 0.7) | st.just(0.0)
pauses = st.just(0.0) | st.floats(0.05, 2.0)


@st.composite
def odometries(draw: st.DrawFn, pause: st.SearchStrategy[float] = pauses) -> RobotOdometry:
    """Increments of 0 to 0.7 s, with gaps between some, that last at least 3 s in all."""
    t0: list[float] = []
    t1: list[float] = []
    increments = []
    now = draw(st.floats(-1.0, 1.0))
    begin = now
    for _ in range(draw(st.integers(2, 10))):
        t0.append(now)
        now += draw(lengths)
        t1.append(now)
        increments.append(draw(moves))
        now += draw(pause)
    t0.append(now)
    t1.append(max(now + 0.1, begin + 3.0))
    increments.append(draw(moves))
    return odometry_of(t0, t1, increments)


stamps = st.lists(
    st.tuples(st.floats(-2.0, 12.0), st.just(0), st.sampled_from([1, 2]))
    | st.tuples(st.floats(-2.0, 12.0), st.just(1), st.just(2)),
    max_size=15,
)


@given(odometries(), st.floats(0.1, 1.5))
def test_the_steps_compose_to_the_same_pose_as_the_recorded_increments(
    odometry: RobotOdometry, period_s: float
) -> None:
    found = steps_of(recording_of([odometry], []), period_s)
    last = found.t[-1]
    whole = odometry.t1 <= last
    end = end_of(odometry.increments[whole])
    begun = np.flatnonzero((odometry.t0 < last) & (odometry.t1 > last))
    for row in begun:
        share = (last - odometry.t0[row]) / (odometry.t1[row] - odometry.t0[row])
        part = within(odometry.increments[row : row + 1], np.array([share]))
        end = composed(end, Pose(*map(float, part[0])))
    first = dead_reckoned(odometry, found.t[:1])[0]
    assert_same_pose(composed(Pose(*map(float, first)), end_of(found.increments[0])), end)


@given(odometries(), odometries(), stamps, st.floats(0.1, 1.0))
@pytest.mark.long
def test_a_range_lies_at_its_time(
    a: RobotOdometry, b: RobotOdometry, ranges: list[tuple[float, int, int]], period_s: float
) -> None:
    recording = recording_of([a, b], ranges)
    try:
        found = steps_of(recording, period_s, 0.0)
    except BadRecording:
        assert min(a.t1[-1], b.t1[-1]) - max(a.t0[0], b.t0[0]) < period_s
        return
    begin, end = found.t[found.step], found.t[found.step + 1]
    assert np.all((found.fraction >= 0.0) & (found.fraction <= 1.0))
    np.testing.assert_allclose(begin + found.fraction * (end - begin), found.ranges.t, rtol=0, atol=1e-9)
    assert found.unused["within a second after another"] == 0
    assert len(found.ranges.t) + found.unused["without odometry of all robots"] == len(ranges)


@given(odometries(st.just(0.0)), st.floats(0.1, 1.0), stamps)
@pytest.mark.long
def test_thinned_ranges_of_a_pair_are_apart_and_none_is_left_out_without_one_before(
    odometry: RobotOdometry, spacing_s: float, ranges: list[tuple[float, int, int]]
) -> None:
    recording = recording_of([odometry, odometry], ranges)
    every = steps_of(recording, 0.5, 0.0).ranges
    found = steps_of(recording, 0.5, spacing_s)
    assert found.unused["within a second after another"] == len(every.t) - len(found.ranges.t)
    for first, second in {(0, 1), (0, 2), (1, 2)}:
        kept = found.ranges.t[(found.ranges.first == first) & (found.ranges.second == second)]
        assert np.all(np.diff(kept) >= spacing_s - 2 * SAME_TIME_S)
        for t in every.t[(every.first == first) & (every.second == second)]:
            before = kept[kept <= t]
            assert len(before)
            assert t - before[-1] < spacing_s


@given(odometries(), st.floats(0.1, 1.0))
def test_the_steps_last_as_long_as_the_odometry(odometry: RobotOdometry, period_s: float) -> None:
    found = steps_of(recording_of([odometry], []), period_s)
    assert np.all(np.diff(found.t) > 0.0)
    assert found.t[0] == odometry.t0[0]
    assert odometry.t1[-1] - found.t[-1] < period_s + SAME_TIME_S


def test_a_step_in_a_gap_has_no_motion() -> None:
    odometry = odometry_of([0.0, 4.0], [1.5, 5.0], [(0.3, 0.0, 0.0), (0.4, 0.0, 0.0)])
    found = steps_of(recording_of([odometry], []))
    np.testing.assert_allclose(found.increments[0, :, 0], [0.2, 0.1, 0.0, 0.0, 0.4], atol=1e-12)
    np.testing.assert_allclose(found.covariance[0, :, 0, 0], [1e-4 / 1.5, 0.5e-4 / 1.5, 0.0, 0.0, 1e-4])


@pytest.mark.parametrize("omega", [0.0, 1e-9, 0.4, -3.0])
def test_a_part_of_an_arc_is_the_arc_of_that_duration(omega: float) -> None:
    whole = step(ORIGIN, 0.7, omega, 1.0)
    for share in (0.0, 0.3, 1.0):
        part = step(ORIGIN, 0.7, omega, share)
        found = within(np.array([[whole.x, whole.y, whole.heading]]), np.array([share]))
        np.testing.assert_allclose(found[0], (part.x, part.y, part.heading), atol=1e-14)


def test_the_covariance_of_a_step_is_that_of_its_increments_by_finite_differences() -> None:
    odometry = odometry_of(
        [0.0, 0.4, 0.8], [0.4, 0.8, 1.3], [(0.3, 0.02, 0.5), (0.4, -0.01, -0.8), (0.2, 0.0, 0.3)]
    )
    t, h = np.array([0.0, 1.3]), 1e-6

    def end(increments: Numbers) -> Numbers:
        return np.array(dead_reckoned(odometry._replace(increments=increments), t)[1])

    expected = np.zeros((3, 3))
    for row in range(3):
        jacobian = np.empty((3, 3))
        for column in range(3):
            change = np.zeros((3, 3))
            change[row, column] = h
            jacobian[:, column] = (end(odometry.increments + change) - end(odometry.increments - change)) / (
                2 * h
            )
        expected += jacobian @ odometry.covariance[row] @ jacobian.T
    np.testing.assert_allclose(step_covariance(odometry, t)[0], expected, rtol=1e-6, atol=1e-12)


@given(st.integers(0, 199), st.sampled_from([0, 2]), st.sampled_from([-1.0, 1.0]))
def test_a_gross_increment_is_flagged_and_no_other(row: int, axis: int, sign: float) -> None:
    begin = 0.05 * np.arange(200)
    increments = np.tile([0.02, 0.0, 0.03], (200, 1)) * np.linspace(0.0, 1.0, 200)[:, None]
    increments[row, axis] = sign * 0.5
    odometry = odometry_of(list(begin), [*begin[1:], 10.0], list(map(tuple, increments.tolist())))
    assert list(np.flatnonzero(gross(odometry, speed_bound(odometry)))) == [row]


def test_an_increment_above_either_bound_is_gross() -> None:
    odometry = odometry_of([0.0, 1.0], [1.0, 2.0], [(0.5, 0.0, 0.1), (0.1, 0.0, 0.4)])
    assert list(gross(odometry, (0.4, 0.3))) == [True, True]
    assert list(gross(odometry, (0.6, 0.3))) == [False, True]
    standing = odometry_of([0.0], [1.0], [(0.0, 0.0, 0.0)])
    assert speed_bound(standing) == (math.inf, math.inf)


def pair_steps() -> RangeSteps:
    return steps_of(read_ranges(SAMPLE))


def test_the_sample_has_29_steps_and_a_range_of_each_pair_in_nearly_every_one() -> None:
    found = pair_steps()
    assert found.increments.shape == (2, 29, 3)
    pairs = {
        pair: len(rows) for pair, rows in read_ranges(SAMPLE)._replace(ranges=found.ranges).pairs().items()
    }
    assert set(pairs) == {("A", "B"), ("A", "LC0"), ("B", "LC1")}
    assert all(20 <= count <= 30 for count in pairs.values())
    assert len(found.ranges.t) + sum(found.unused.values()) == 184 + 171 + 133


def test_robots_without_common_odometry_are_refused() -> None:
    one = odometry_of([0.0], [2.0], [(0.1, 0.0, 0.0)])
    other = odometry_of([3.0], [5.0], [(0.1, 0.0, 0.0)])
    none = odometry_of([], [], [])
    recording = recording_of([one, other, none], [])
    with pytest.raises(BadRecording, match=r"it: there is less than a step of 1 s .* of 0 and 1 \(none\)"):
        steps_of(recording.part(["0", "1"], 0.0, 5.0))
    with pytest.raises(BadRecording, match="it: 2 has no odometry"):
        steps_of(recording.part(["2"], 0.0, 5.0))
