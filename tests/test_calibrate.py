"""Errors of radios are measured by pair, against the truth or without it, and become a noise profile."""

from __future__ import annotations

import math
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from agent.estimation.following import ClaimRule
from compose.errors import USER_ERROR, UserError
from compose.recording.estimating.calibration import (
    ASSUMED,
    NoTruth,
    calibrated,
    calibrated_by_fit,
    correction_of,
    noise_table,
    profile_toml,
)
from compose.recording.estimating.estimate_run import estimated
from compose.recording.estimating.noise_files import told_noise
from compose.recording.estimating.radio_errors import PairErrors, range_calibration, true_errors
from compose.recording.estimating.recorded_measurements import measurements
from compose.recording.ranging.range_recording import Numbers, RangeRecording, TruePath
from protocol.noise import Noise
from tandem import estimate
from tests.commands import tandem
from tests.range_tables import SAMPLE
from tests.test_cases_estimates import CASES
from tests.test_estimate import NEES_99_9, with_ranges

BIAS, MORE, SCALE, OUTLIERS = 0.35, 0.15, 0.05, 0.05
"""The errors that are added to the sample: a bias (m), a further one of A and B, a scale, and outliers."""


@pytest.fixture(scope="module")
def raw(sample: RangeRecording) -> RangeRecording:
    """Return the sample with the errors of radios that nobody has calibrated."""
    draws = np.random.default_rng(5)
    lengths: Numbers = (sample.ranges.range + BIAS) / (1.0 - SCALE)
    lengths[sample.pairs()["A", "B"]] += MORE / (1.0 - SCALE)
    stray = draws.random(len(lengths)) < OUTLIERS
    return with_ranges(sample, lengths + stray * draws.uniform(0.5, 2.0, len(lengths)))


def test_the_errors_of_each_pair_are_measured_against_the_truth(raw: RangeRecording) -> None:
    found = calibrated(raw, None, None)
    assert found.source == "the truth"
    assert abs(found.scale - SCALE) < 4.0 * found.scale_sigma
    assert found.scale_sigma < 0.01
    for pair, one in found.pairs.items():
        expected = BIAS + MORE if pair == ("A", "B") else BIAS
        assert abs(one.bias - expected) < 4.0 * one.bias_sigma
        assert one.bias_sigma < 0.05
        assert 0.025 < one.sigma < 0.06
        assert 0.5 * OUTLIERS < one.outliers < 2.0 * OUTLIERS


def test_without_outliers_there_are_none(sample: RangeRecording) -> None:
    found = calibrated(sample, None, None)
    assert all(one.outliers < 0.01 for one in found.pairs.values())
    assert all(abs(one.bias) < 0.03 for one in found.pairs.values())


@pytest.mark.parametrize("stray", [30.0, 1e3, 1e7, 1e12])
def test_a_stray_range_changes_neither_bias_nor_scale(stray: float, sample: RangeRecording) -> None:
    lengths = sample.ranges.range.copy()
    lengths[sample.pairs()["A", "B"][5]] = stray
    expected, found = calibrated(sample, None, None), calibrated(with_ranges(sample, lengths), None, None)
    assert found.scale == pytest.approx(expected.scale, abs=1e-3)
    for pair, one in expected.pairs.items():
        assert found.pairs[pair].bias == pytest.approx(one.bias, abs=1e-2)
        assert found.pairs[pair].sigma == pytest.approx(one.sigma, abs=1e-2)


def with_seldom_truth(sample: RangeRecording, spacing_s: float) -> RangeRecording:
    """Return the sample with true poses at least `spacing_s` apart."""
    robots = []
    for one in sample.robots:
        assert one.truth is not None
        number = (one.truth.t - one.truth.t[0]) // spacing_s
        kept = np.insert(np.diff(number) > 0.0, 0, True)
        robots.append(one._replace(truth=TruePath(one.truth.t[kept], one.truth.poses[kept])))
    return sample._replace(robots=tuple(robots))


def test_true_poses_that_are_seconds_apart_calibrate_nearly_as_well(sample: RangeRecording) -> None:
    expected, found = calibrated(sample, None, None), calibrated(with_seldom_truth(sample, 9.0), None, None)
    assert found.source == "the truth"
    used = sum(one.ranges for one in found.pairs.values())
    begin, end = sample.span
    assert used + found.unused == np.count_nonzero((sample.ranges.t >= begin) & (sample.ranges.t <= end))
    assert used > 0.85 * len(sample.ranges.t)
    for pair, one in expected.pairs.items():
        assert abs(found.pairs[pair].bias - one.bias) < 0.02
        assert found.pairs[pair].sigma < 1.3 * one.sigma


def with_true_distances(sample: RangeRecording, spread: float, sigma: float) -> RangeRecording:
    """Return the sample with robots that turn in place, but for a way of `spread` m of A, and noise."""
    robots = []
    for one in sample.robots:
        truth = one.truth
        assert truth is not None
        poses = truth.poses.copy()
        poses[:, :2] = poses[0, :2]
        poses[:, 0] += spread * np.sin(truth.t) if one.id == "A" else 0.0
        robots.append(one._replace(truth=TruePath(truth.t, poses)))
    moved = sample._replace(robots=tuple(robots))
    exact = sample.ranges.range.copy()
    errors = true_errors(moved)
    for pair, rows in moved.pairs().items():
        known = np.isin(sample.ranges.t[rows], errors[pair].t)
        exact[rows[known]] = errors[pair].measured - errors[pair].error
    draws = np.random.default_rng(1)
    return with_ranges(moved, exact + 0.2 + sigma * draws.normal(size=len(exact)))


def test_from_ranges_of_one_length_no_scale_is_told(sample: RangeRecording) -> None:
    alike = calibrated(with_true_distances(sample, 0.0, 0.05), None, None)
    assert (alike.scale, alike.scale_told) == (0.0, False)
    for one in alike.pairs.values():
        assert one.bias == pytest.approx(0.2, abs=0.02)
    ended = tandem("calibrate", CASES / "standing")
    assert ended.status == 0
    assert "no common scale: the distances of each pair are too much alike" in ended.out
    assert "range_scale = 0.0\n" in ended.out


def test_noise_of_ranges_is_not_taken_for_a_scale(sample: RangeRecording) -> None:
    found = calibrated(with_true_distances(sample, 4.0, 0.5), None, None)
    assert found.scale_told
    assert abs(found.scale) < 0.01
    for one in found.pairs.values():
        assert abs(one.bias - 0.2) < 4.0 * one.bias_sigma


def test_slow_errors_are_told_from_white_ones(sample: RangeRecording) -> None:
    def slow(lengths: Numbers) -> float:
        return calibrated(with_ranges(sample, lengths), None, None).pairs["A", "B"].slow_sigma

    wave = 0.1 * np.sin(2.0 * np.pi * sample.ranges.t / 9.0)
    white = np.random.default_rng(1).normal(0.0, 0.1, len(sample.ranges.t))
    assert slow(sample.ranges.range + wave) > 0.05
    assert slow(sample.ranges.range + white) < 0.05


def sonar_errors(slow: float, seed: int) -> dict[tuple[str, str], PairErrors]:
    """Return errors of 3 m of four pairs, a part of which is slow: over 40 s, where ranges are 3 s apart."""
    draws, t = np.random.default_rng(seed), 3.0 * np.arange(1500.0)
    errors = {}
    for name in "abcd":
        kept, wanders = math.exp(-3.0 / 40.0), [draws.normal()]
        for each in draws.normal(size=len(t) - 1).tolist():
            wanders.append(kept * wanders[-1] + math.sqrt(1.0 - kept**2) * each)
        error = slow * np.array(wanders) + math.sqrt(9.0 - slow**2) * draws.normal(size=len(t))
        errors["auv", name] = PairErrors(t, 200.0 + 100.0 * np.sin(t / 90.0) + error, error)
    return errors


@pytest.mark.parametrize("seed", range(4))
def test_the_time_of_slow_errors_follows_from_rare_ranges(seed: int) -> None:
    found = range_calibration(sonar_errors(2.5, seed), "the truth")
    table = noise_table(found, frozenset("abcd"))
    assert table["slow_sigma"] == pytest.approx(2.5, rel=0.2)
    assert table["anchor_sigma"] == pytest.approx(math.sqrt(9.0 - 2.5**2), rel=0.3)
    assert 20.0 <= table["slow_time"] <= 80.0
    white = noise_table(range_calibration(sonar_errors(0.0, seed), "the truth"), frozenset("abcd"))
    assert white["slow_sigma"] < 1.0


@pytest.mark.long
def test_the_profile_makes_raw_ranges_as_good_as_calibrated_ones(raw: RangeRecording, tmp_path: Path) -> None:
    found = calibrated(raw, None, None)
    anchors = frozenset(one.id for one in raw.anchors)
    text = profile_toml(found, anchors, "the truth of it")
    (tmp_path / "radios.toml").write_text(text)
    told = told_noise(str(tmp_path / "radios.toml"))
    assert told.correction == correction_of(found)
    assert told.noise == msgspec.convert(noise_table(found, anchors), Noise)
    estimate = estimated(measurements(raw, ("A", "B"), str(tmp_path / "radios.toml"), None), ClaimRule())
    for robot in estimate.summary.robots.values():
        assert robot.first_claim is not None
        assert robot.first_claim.nees is not None
        assert robot.first_claim.nees < NEES_99_9
        assert robot.first_claim.t_s - estimate.summary.begin_s <= 25.0


def test_a_profile_of_other_radios_has_their_mean_bias_and_its_spread(raw: RangeRecording) -> None:
    of_pairs = calibrated(raw, None, None)
    correction, table = correction_of(of_pairs), noise_table(of_pairs, frozenset({"LC0", "LC1"}))
    biases = [one.bias for one in of_pairs.pairs.values()]
    assert correction.range_bias == pytest.approx(np.mean(biases), abs=1e-3)
    assert table["pair_bias"] == pytest.approx(np.sqrt((np.var(biases) * 3 + 0.1**2) / 3), abs=1e-3)
    unknown = replace(correction, pairs={}).corrected(raw).ranges.range
    np.testing.assert_allclose(
        raw.ranges.range - unknown, correction.range_bias + correction.range_scale * raw.ranges.range
    )


def test_the_scales_of_pairs_that_differ_widen_the_prior_of_the_scale(sample: RangeRecording) -> None:
    lengths = sample.ranges.range.copy()
    for share, rows in zip((0.0, 0.08, 0.16), sample.pairs().values(), strict=True):
        lengths[rows] *= 1.0 + share
    alike, unlike = calibrated(sample, None, None), calibrated(with_ranges(sample, lengths), None, None)
    assert alike.scale_spread < 0.01
    assert unlike.scale_spread == pytest.approx(np.std([0.0, 0.08, 0.16], ddof=1), abs=0.04)
    priors = [noise_table(one, frozenset({"LC0", "LC1"}))["range_scale"] for one in (alike, unlike)]
    assert priors[0] < 0.01 < unlike.scale_spread <= priors[1]


@pytest.mark.long
def test_without_truth_the_fit_is_the_reference(sample: RangeRecording) -> None:
    recording = with_seldom_truth(sample, 12.0)
    with pytest.raises(NoTruth, match="no 8 ranges of a pair have true poses within 10 s"):
        calibrated(recording, None, None)
    found = calibrated_by_fit(measurements(recording, None, ASSUMED))
    assert found.source == "the fit"
    assert set(found.pairs) == {("A", "LC0"), ("B", "LC1"), ("A", "B")}
    table = noise_table(found, frozenset({"LC0", "LC1"}))
    for one in found.pairs.values():
        assert 0.01 < one.sigma < 0.06
        assert abs(one.bias) < 3.0 * np.hypot(table["range_bias"], one.bias_sigma)
    assert found.bias_sigma > 0.1  # 30 s tell little of a bias that all ranges share


def test_the_command_prints_a_table_and_writes_the_profile(tmp_path: Path) -> None:
    ended = tandem("calibrate", str(SAMPLE), "--out", "radios.toml", cwd=tmp_path)
    assert (ended.status, ended.err) == (0, "")
    assert "A-LC0" in ended.out
    assert "against the truth" in ended.out
    printed = tandem("calibrate", str(SAMPLE), cwd=tmp_path).out
    assert (tmp_path / "radios.toml").read_text() in printed + "\n"


@pytest.mark.parametrize(
    ("bias", "scale", "says"),
    [
        (-30.0, 0.0, "a bias of -30"),
        (0.0, 0.5, "a scale of +0."),
    ],
)
def test_biases_and_scales_that_no_radio_has_are_refused(
    bias: float, scale: float, says: str, sample: RangeRecording, tmp_path: Path
) -> None:
    lengths = sample.ranges.range * (1.0 + scale) + bias
    with pytest.raises(UserError, match="by its true poses, A-B has " + re.escape(says)):
        calibrated(with_ranges(sample, lengths), None, None)
    (tmp_path / "it.toml").write_text(
        f"[mission.noise]\n[calibration]\nrange_bias = {bias}\nrange_scale = {scale}\n"
    )
    ended = tandem("estimate", SAMPLE, "--noise", "it.toml", cwd=tmp_path)
    assert (ended.status, ended.err.count("\n")) == (USER_ERROR, 1)
    assert f"[calibration] {'range_scale' if scale else 'range_bias'} has {says}" in ended.err


@pytest.mark.parametrize("field", ["range_bias", "range_scale", "pairs.A-B"])
def test_a_calibration_with_a_number_that_is_none_is_refused(field: str, tmp_path: Path) -> None:
    (tmp_path / "it.toml").write_text(f"[mission.noise]\n[calibration]\n{field} = nan\n")
    with pytest.raises(
        UserError, match=rf"\[calibration\] {field.removeprefix('pairs.')} has a \w+ of \+nan"
    ):
        estimate(SAMPLE, noise=tmp_path / "it.toml")


def test_stamps_that_are_all_equal_are_refused(tmp_path: Path) -> None:
    lines = []
    for line in SAMPLE.read_text().splitlines():
        words = line.split()
        lines.append(" ".join([words[0], "0.0", *words[2:]]) if words[0].startswith("EDGE") else line)
    (tmp_path / "it.pyfg").write_text("\n".join(lines))
    ranges = "\n".join(["t,from,to,range", *["3.0,A,L,1.0"] * 8, ""])
    (tmp_path / "odometry.csv").write_text("robot,t0,t1,dx,dy,dheading\nA,0,9,1,0,0\n")
    (tmp_path / "anchors.csv").write_text("anchor,x,y\nL,0,0\n")
    (tmp_path / "ranges.csv").write_text(ranges)
    said = {
        "it.pyfg": "increments of A are of 0 s: stamps are missing",
        ".": "all 8 ranges of A and L are of 3 s",
    }
    for name, says in said.items():
        for command in ("calibrate", "estimate"):
            ended = tandem(command, name, cwd=tmp_path)
            assert (ended.status, ended.err.count("\n")) == (USER_ERROR, 1)
            assert says in ended.err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("bad.pyfg",), "bad.pyfg, line 1: VERTEX_XY has 1 fields and needs 3"),
        ((str(SAMPLE), "--robots", "C"), "has no robot C; it has A, B"),
        ((str(CASES / "missing"), "--out", "no/radios.toml"), "--out: no/radios.toml cannot be written"),
        ((str(SAMPLE), "--out", "radios"), "--out: radios is not the path of a .toml file"),
        ((str(SAMPLE), "--without-truth", "--window", "0..5"), "without true poses, an estimate of A and B"),
        (
            (str(CASES / "wrapped-yaw"), "--without-truth", "--window", "0..6"),
            "8 ranges of a pair of radios are needed, and the estimate uses at most 7: one a second",
        ),
        ((str(SAMPLE), "--without-truth", "--robots", "A"), "one robot needs ranges to two anchors"),
    ],
)
def test_what_cannot_be_calibrated_is_one_line(words: tuple[str, ...], says: str, tmp_path: Path) -> None:
    (tmp_path / "bad.pyfg").write_text("VERTEX_XY L0\n")
    ended = tandem("calibrate", *words, cwd=tmp_path)
    assert ended.status == USER_ERROR
    assert ended.err.count("\n") == 1
    assert says in ended.err
