"""Asynchronous stamps become steps with all odometry, and ranges that are stamped late are noticed."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.estimation.following import ClaimRule
from compose.errors import BadRecording
from compose.launch.in_process import run_mission
from compose.recording.estimating.estimate_rows import PoseEstimateRow
from compose.recording.estimating.estimate_run import RecordingEstimate, estimated
from compose.recording.estimating.recorded_measurements import measurements
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_recording import (
    SAME_TIME_S,
    FixedAnchor,
    Numbers,
    RangeRecording,
    RangeSeries,
    RecordedRobot,
    RobotOdometry,
    TruePath,
)
from compose.recording.ranging.range_steps import (
    RangeSteps,
    dead_reckoned,
    gross,
    relative,
    speed_bound,
    step_covariance,
    steps_of,
    within,
)
from compose.scenario.scenario_file import parse
from protocol.motion import ORIGIN, Controls, Pose, step, travelled
from protocol.motion import compose as composed
from tests.commands import PAIR
from tests.missions import own_ranges
from tests.range_tables import SAMPLE
from tests.test_world_noise import near
from world.sensors import mutual_ranges
from world.tick import release


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


LATE = Path(__file__).parent / "data" / "cases" / "late-ranges"
"""One robot that drives 1 m/s among three anchors; its ranges are 0.3 s late, and have a sigma of 0.05 m."""
DELAY_S = 0.3
CONTRADICTION = "the ranges and the odometry contradict the assumed noise; the profile 'uwb' explains them"


# --- the world --------------------------------------------------------------------------------------------


def test_late_ranges_are_those_of_the_poses_before() -> None:
    told = "anchor_sigma = 0.0\nmutual_sigma = 0.0\ngyro_bias = 0.1"
    late, prompt = near(f"range_delay = {DELAY_S}", told=told), near("", told=told)
    still = release(late).truth
    assert own_ranges(still, late) == own_ranges(still, prompt), "the robots were at rest before"
    driven = Controls(0.3, 0.8), Controls(-0.2, 0.4)
    moved = still.moved(driven, 1.0)
    places = zip(still.local, driven, strict=True)
    early = [step(pose, one.v, one.omega, 1.0 - DELAY_S) for pose, one in places]
    for i, rho in enumerate(own_ranges(moved, late)):
        anchor, origin = late.robots[i].anchor, still.origins[i]
        assert rho == pytest.approx(travelled(early[i], Pose(anchor.x - origin.x, anchor.y - origin.y, 0.0)))
    (contact,) = mutual_ranges(moved, late, [(0, 1)])
    assert contact is not None
    assert contact.range == pytest.approx(travelled(*early))


RANDOM = """
name = "late"
seed = {seed}
[mission]
sensing_range = 3.0
period = 1.0
max_speed = 1.0
max_turn_rate = 3.14159
accuracy = 0.1
[mission.noise]
anchor_sigma = 0.05
mutual_sigma = 0.05
range_delay = {told}
[world.noise]
range_delay = 0.3
"""


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_robots_that_are_told_of_a_delay_localise_and_others_do_not_claim(seed: int) -> None:
    for told, outcome in ((0.3, "localised"), (0.0, "undecided")):
        end = run_mission(parse(RANDOM.format(seed=seed, told=told) + PAIR, "late")).end
        assert end is not None
        assert end.outcome == outcome


# --- recordings -------------------------------------------------------------------------------------------


def estimate_of(recording: RangeRecording, noise: str | None, seconds: float = 60.0) -> RecordingEstimate:
    return estimated(measurements(recording, None, noise, (0.0, seconds)), ClaimRule())


def is_wrong(row: PoseEstimateRow) -> bool:
    """Return whether a pose is off by more than 5 sigmas along an axis, or in heading."""
    assert row.position_error_m is not None
    assert row.heading_error_rad is not None
    sigmas = math.sqrt(0.5 * (row.xx + row.yy)), math.sqrt(row.hh)
    errors = row.position_error_m, abs(row.heading_error_rad)
    return any(error > max(1e-6, 5.0 * sigma) for error, sigma in zip(errors, sigmas, strict=True))


@pytest.mark.long
@pytest.mark.parametrize(("noise", "wrong", "least"), [(None, 2, 105), ("uwb", 0, 50)])
def test_late_ranges_are_learned_and_hardly_a_claim_is_wrong(
    noise: str | None, wrong: int, least: int
) -> None:
    """With `uwb`, the biases that radios may have leave half of the poses less accurate than 0.3 m."""
    found = estimate_of(read_ranges(LATE), noise)
    claims = [row for row in found.rows if row.claim]
    assert len(claims) >= least
    assert sum(map(is_wrong, claims)) <= wrong
    learned = found.summary.calibration
    assert learned is not None
    assert learned.range_delay_s is not None
    assert abs(learned.range_delay_s.value - DELAY_S) < 2.0 * learned.range_delay_s.sigma < 0.1


def test_late_ranges_contradict_a_profile_without_a_delay() -> None:
    found = estimate_of(read_ranges(LATE), "uwb-calibrated", 20.0)
    assert CONTRADICTION in found.summary.blocking_reason
    assert found.summary.blocking_reason.endswith("try --noise uwb, or calibrate the sensors")


def late_pair() -> RangeRecording:
    """Return a recording of two robots with an anchor each, at 1 m/s, whose ranges are 0.4 s late."""
    t, draws = 0.02 * np.arange(2001.0), np.random.default_rng(1)
    robots, places = [], []
    for name, begin, rate in (("A", 2.0 + 1.0j, 0.7), ("B", 6.0 + 3.0j, -0.6)):
        turn = rate * 0.02 * np.where(np.sin(0.3 * t[:-1]) > -0.5, 1.0, -1.0)
        heading = np.append(0.0, np.cumsum(turn))
        place = begin + np.append(0.0, np.cumsum(0.02 * np.exp(1j * (heading[:-1] + 0.5 * turn))))
        poses = np.stack((place.real, place.imag, heading), 1)
        odometry = RobotOdometry(
            t[:-1], t[1:], relative(poses[:-1], poses[1:]), np.full((2000, 3, 3), np.nan)
        )
        robots.append(RecordedRobot(name, odometry, TruePath(t, poses)))
        places.append(place)
    anchors = FixedAnchor("M1", 0.0, 0.0), FixedAnchor("M2", 9.0, 2.0)
    at = np.arange(25, 2001, 25)
    a, b = places[0][at - 20], places[1][at - 20]
    lengths = np.stack((np.abs(a), np.abs(b - (9.0 + 2.0j)), np.abs(a - b)), 1).ravel()
    lengths += 0.05 * draws.normal(size=len(lengths))
    first, second = (np.tile(np.array(one), len(at)) for one in ((0, 1, 0), (2, 3, 1)))
    series = RangeSeries(np.repeat(t[at], 3), first, second, lengths, np.full(len(lengths), 0.05))
    return RangeRecording("late", tuple(robots), anchors, series)


@pytest.mark.long
def test_a_delay_is_learned_from_two_robots_and_noticed_where_none_is_told() -> None:
    recording = late_pair()
    learned = estimate_of(recording, "uwb").summary.calibration
    assert learned is not None
    assert learned.range_delay_s is not None
    assert abs(learned.range_delay_s.value - 0.4) < 4.0 * learned.range_delay_s.sigma < 0.2
    told = estimate_of(recording, "wheels")
    noticed = [epoch.t for epoch in told.epochs if CONTRADICTION in epoch.blocking_reason]
    assert noticed[0] < 20.0
    assert not any(is_wrong(row) for row in told.rows if row.claim and row.t_s >= noticed[0])
