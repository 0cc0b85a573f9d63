"""Claimed poses with a covariance, and how the results of a run report them."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Container
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray
from scipy.stats import chi2  # type: ignore[import-untyped]

from compose.launch.in_process import run_mission
from compose.recording.claim_errors import nees, truth_held
from compose.recording.run import Run, read
from compose.recording.summary_json import leave, summary
from compose.scenario.scenario_file import load, parse
from compose.sweep import execution, report, spec, trial
from compose.sweep.cells import cells
from compose.sweep.statistics import CellSummary, counted
from compose.sweep.table import of_rows, schema_of
from compose.terminal.progress import result
from protocol.journal.environment import of_world
from protocol.messages import Command, Estimate, FinalReport, Localised, MissionEnd
from protocol.motion import Covariance, Pose
from tests.commands import SECTION_IV, tandem
from tests.surveys import scenario_of
from world.tick import World, advance, release
from world.world_journal import Tick, WorldHistory

FLOOR = 1e-6
"""The least standard deviation in m and rad."""
NOISY = f"""
name = "noisy"
{SECTION_IV}
noise.anchor_sigma = 0.01
noise.actuation.v_floor = 0.1
[[robot]]
id = "a"
anchor = [0.0, 0.0]
start = [1.5, 0.0, 1.0]
[[robot]]
id = "b"
anchor = [6.0, 0.0]
start = [4.0, 0.0, 4.0]
"""
EXACT = NOISY.replace("noise", "# noise").replace('"# noisy"', '"noisy"')
SURE = Covariance(0.0009, 0.0002, -0.0001, 0.0016, 0.0003, 0.0004)
"""A covariance with sigmas of 0.05 m and 0.02 rad."""


def covariance_of(p: NDArray[np.float64]) -> Covariance:
    return Covariance(*[float(p[i, j]) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))])


def claims(tick: int, robot: str, pose: Pose, covariance: Covariance | None) -> Command:
    return Command(tick, robot, 0.0, 0.0, 3, "localised", Localised(pose, covariance))


def off(pose: Pose, by: float) -> Pose:
    return Pose(pose.x + by, pose.y, pose.heading)


def claimed(text: str, covariance: Covariance | None, *, by: float = 0.03) -> Run:
    """Return a recording in which a claims at once, `by` m off, b never claims, and time runs out."""
    scenario = parse("max_ticks = 1\n" + text, "noisy")
    world = release(scenario)
    first = {
        "a": claims(0, "a", off(world.truth.poses[0], by), covariance),
        "b": Command(0, "b", 0.0, 0.0, 1, "straight", None),
    }
    onward = advance(world, first)
    assert isinstance(onward, World)
    end = advance(onward, {})
    assert isinstance(end, MissionEnd)
    return Run(
        WorldHistory(of_world(), scenario, (Tick(world, first), Tick(onward, {})), None, None, end, {})
    )


# --- NEES ---------------------------------------------------------------------------------------------


def test_nees_is_the_error_squared_in_units_of_the_covariance() -> None:
    draw = np.random.default_rng(1)
    for _ in range(100):
        root = draw.normal(size=(3, 3)) * [[0.05], [0.02], [0.01]]
        p, e = root @ root.T, draw.normal(size=3) * 0.1
        truth = Pose(3.0, -2.0, 1.0)
        estimate = Pose(truth.x + e[0], truth.y + e[1], truth.heading + e[2])
        assert nees(estimate, truth, covariance_of(p)) == pytest.approx(e @ np.linalg.solve(p, e), rel=1e-6)


def test_nees_wraps_the_error_in_heading() -> None:
    truth, estimate = Pose(0.0, 0.0, 3.1), Pose(0.0, 0.0, -3.1)
    assert nees(estimate, truth, SURE) == pytest.approx(
        nees(Pose(0.0, 0.0, math.tau - 6.2), Pose(0.0, 0.0, 0.0), SURE)
    )
    assert nees(Pose(1.0, 2.0, 0.5 + 4 * math.tau), Pose(1.0, 2.0, 0.5), SURE) == pytest.approx(0.0, abs=1e-9)


def test_nees_of_a_singular_covariance_counts_no_sigma_below_a_micrometre() -> None:
    here = Pose(0.0, 0.0, 0.0)
    nothing = Covariance(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert nees(here, here, nothing) == 0.0
    assert nees(Pose(2.0 * FLOOR, 0.0, 3.0 * FLOOR), here, nothing) == pytest.approx(13.0)
    along = Covariance(0.02, 0.02, 0.0, 0.02, 0.0, 0.01)  # x and y have the same error
    assert nees(Pose(0.2, 0.2, 0.0), here, along) == pytest.approx(2.0)
    assert nees(Pose(FLOOR, -FLOOR, 0.0), here, along) == pytest.approx(2.0)
    assert nees(Pose(0.1, -0.1, 0.0), here, along) == pytest.approx(0.02 / FLOOR**2)


# --- summary.json -------------------------------------------------------------------------------------


def robots(recording: Run, folder: Path) -> dict[str, dict[str, Any]]:
    leave(recording, summary(recording, "in-process", 0.5), folder)
    told: dict[str, dict[str, Any]] = json.loads((folder / "summary.json").read_text())["robots"]
    return told


def test_summary_has_the_claims_and_their_errors(tmp_path: Path) -> None:
    told = robots(claimed(NOISY, SURE), tmp_path)["a"]
    assert told["covariance"] == [
        [0.0009, 0.0002, -0.0001],
        [0.0002, 0.0016, 0.0003],
        [-0.0001, 0.0003, 0.0004],
    ]
    assert told["position_sigma_m"] == pytest.approx(0.05)
    assert told["heading_sigma_rad"] == pytest.approx(0.02)
    assert told["position_error_m"] == pytest.approx(0.03)
    inverse = np.linalg.inv(told["covariance"])
    assert told["nees"] == pytest.approx(0.03**2 * inverse[0, 0])


def test_an_error_is_that_of_the_tick_of_the_claim(tmp_path: Path) -> None:
    recording = claimed(NOISY, SURE)
    told = robots(recording, tmp_path)["a"]
    last = recording.ticks[-1].truth.poses[0]
    assert told["truth"][:2] == [last.x, last.y]
    assert abs(math.dist(told["estimate"][:2], told["truth"][:2]) - told["position_error_m"]) > 1e-3


def test_what_does_not_apply_is_null(tmp_path: Path) -> None:
    of_covariance = ("covariance", "position_sigma_m", "heading_sigma_rad", "nees")
    told = robots(claimed(EXACT, None, by=0.0), tmp_path)
    for robot in ("a", "b"):
        assert [told[robot][field] for field in of_covariance] == [None] * 4
    assert told["a"]["position_error_m"] == 0.0
    told = robots(claimed(NOISY, SURE), tmp_path)
    for field in (*of_covariance, "estimate", "position_error_m", "hypotheses", "probability"):
        assert told["b"][field] is None, field


def test_a_mission_of_the_paper_ends_with_one_hypothesis_and_no_probability(tmp_path: Path) -> None:
    assert tandem("run", "paper-1", "--in-process", "-q", "--out", tmp_path / "out").status == 0
    told = json.loads((tmp_path / "out" / "summary.json").read_text())["robots"]
    for robot in ("a", "b"):
        assert (told[robot]["hypotheses"], told[robot]["probability"]) == (1, None)


# --- rows and figures of a sweep --------------------------------------------------------------------

HONEST = ["cov_xx", "cov_xy", "cov_xh", "cov_yy", "cov_yh", "cov_hh"]
SWEEP = 'name = "noisy"\nscenario = "noisy.toml"\ntrials = 3\n'


def row_of(recording: Run, number: int = 0) -> trial.TrialRow:
    return trial.row(trial.Trial(0, number, recording.scenario, processes=False), recording, 0.5)


def final_report(robot: str, hypotheses: int, probability: float) -> FinalReport:
    counts = (3, 4, 0, 0, 0, 0, 600)
    return FinalReport(
        robot, 5, 3, "circle", -2.5, (4, 2), 0.5, 1.5, hypotheses, probability, None, None, *counts
    )


def test_a_row_has_what_each_robot_claimed() -> None:
    final_reports = {"a": final_report("a", 1, 0.99995), "b": final_report("b", 3, 0.6)}
    recording = Run(replace(claimed(NOISY, SURE).history, final_reports=final_reports))
    row = row_of(recording)
    a, b = row.robots["a"], row.robots["b"]
    assert [getattr(a, name) for name in HONEST] == [0.0009, 0.0002, -0.0001, 0.0016, 0.0003, 0.0004]
    assert (a.hypotheses, a.probability, b.hypotheses, b.probability) == (1, 0.99995, 3, 0.6)
    assert a.position_sigma_m == pytest.approx(0.05)
    assert a.nees == row.nees == pytest.approx(summary(recording, "in-process", 0.5)["robots"]["a"]["nees"])
    assert [getattr(b, name) for name in (*HONEST, "nees", "position_sigma_m", "position_error_m")] == [
        None
    ] * 9
    assert (row.hypotheses, row.claims, row.claims_within) == (3, 1, 1)


def test_a_row_counts_the_claims_within_three_times_the_accuracy() -> None:
    assert row_of(claimed(NOISY, SURE, by=0.299)).claims_within == 1
    assert row_of(claimed(NOISY, SURE, by=0.301)).claims_within == 0
    generous = NOISY.replace("noise.anchor", "accuracy = 0.2\nnoise.anchor")
    assert row_of(claimed(generous, SURE, by=0.5)).claims_within == 1


# --- the truth among the hypotheses -------------------------------------------------------------------


def estimate_of(*poses: Pose, covariance: Covariance | None = SURE) -> Estimate:
    equal = tuple([1.0 / len(poses)] * len(poses))
    return Estimate(0, "a", (), poses, localised=True, probabilities=equal, covariance=covariance)


def test_the_truth_is_held_if_any_hypothesis_is_near_it_in_position_and_in_heading() -> None:
    truth, far = Pose(1.0, 2.0, 0.5), Pose(3.0, 2.0, 0.5)
    for pose, held in (
        (off(truth, 0.299), True),
        (off(truth, 0.301), False),
        (Pose(1.0, 2.0, 0.5 + 0.59), True),
        (Pose(1.0, 2.0, 0.5 + 0.61), False),
        (Pose(1.0, 2.0, 0.5 - math.tau), True),
    ):
        assert truth_held(estimate_of(far, pose), truth, 0.1) is held, pose


def test_the_truth_is_held_within_six_sigmas_of_the_claimed_pose() -> None:
    truth, wide = Pose(1.0, 2.0, 0.5), Covariance(0.01, 0.0, 0.0, 0.01, 0.0, 0.01)
    assert truth_held(estimate_of(off(truth, 0.599), covariance=wide), truth, 0.01) is True
    assert truth_held(estimate_of(off(truth, 0.601), covariance=wide), truth, 0.01) is False
    far = Pose(9.0, 9.0, 0.0)
    assert truth_held(estimate_of(far, off(truth, 0.1), covariance=wide), truth, 0.01) is False, "the first"


def test_exact_sensors_have_no_truth_held() -> None:
    pose = Pose(1.0, 2.0, 0.5)
    assert truth_held(Estimate(0, "a", (), (pose,), localised=True), pose, 0.1) is None
    assert row_of(claimed(EXACT, None, by=0.0)).truth_held is None


def test_a_mission_in_this_process_and_its_recording_agree_on_whether_the_truth_was_held(
    tmp_path: Path,
) -> None:
    scenario = scenario_of("anchor_sigma = 0.05\nmutual_sigma = 0.05", 4)
    run = run_mission(scenario, tmp_path)
    recorded = read(tmp_path)
    assert run.final_reports["a"].probability is not None
    for robot in run.robots:
        assert run.truth_held(robot) is True
        assert recorded.truth_held(robot) is True
    elsewhere = {robot: estimate_of(Pose(99.0, 0.0, 0.0)) for robot in run.robots}
    assert replace(run, claim_estimates=elsewhere).truth_held("a") is False


def test_a_summary_has_the_fraction_of_trials_in_which_the_truth_was_held(tmp_path: Path) -> None:
    row = row_of(claimed(NOISY, SURE))
    assert row.truth_held is None, "neither this process nor a journal has the Estimate"
    rows = [replace(row, trial=i, truth_held=held) for i, held in enumerate((True, False, True, None))]
    assert figures_of(rows, tmp_path).truth_held == pytest.approx(2 / 3)
    assert figures_of([row], tmp_path).truth_held is None


def results_of(rows: list[trial.TrialRow], folder: Path) -> execution.Results:
    """Return the results of a sweep with one cell."""
    (folder / "noisy.toml").write_text(NOISY)
    (folder / "sweep.toml").write_text(SWEEP)
    sweep = spec.load(str(folder / "sweep.toml"))
    (cell,) = cells(sweep)
    table = of_rows(rows, sweep, {0: cell}, schema_of(sweep, [cell]))
    return execution.Results(sweep, (cell,), table, {0: counted(table)}, None, False, len(rows))


def figures_of(rows: list[trial.TrialRow], folder: Path) -> CellSummary:
    return results_of(rows, folder).figures[0]


def test_a_summary_has_the_mean_nees_with_its_band_and_the_rate_within_three_times_the_accuracy(
    tmp_path: Path,
) -> None:
    rows = [row_of(claimed(NOISY, SURE, by=by), i) for i, by in enumerate((0.01, 0.1, 0.4))]
    rows += [trial.lost(0, 3, 1, "lost", None), row_of(claimed(EXACT, None, by=0.0), 4)]
    figures = figures_of(rows, tmp_path)
    assert (figures.trials, figures.claims, figures.within_3_accuracy) == (5, 4, 0.75)
    assert rows[2].outcome == "wrong"
    assert figures.nees_mean == pytest.approx(np.mean([row.nees for row in rows[:3]])), "all claims are in"
    assert (figures.nees_low, figures.nees_high) == pytest.approx(
        (chi2.ppf(0.005, 9) / 3, chi2.ppf(0.995, 9) / 3)
    )


def test_without_claims_a_summary_has_no_nees_and_no_rate(tmp_path: Path) -> None:
    for rows in ([], [trial.lost(0, 0, 1, "lost", None)]):
        figures = figures_of(rows, tmp_path)
        assert figures.claims == 0
        for name in ("within_3_accuracy", "nees_mean", "nees_low", "nees_high"):
            assert getattr(figures, name) is None, name


def test_a_trial_with_two_claims_counts_once_in_the_mean_nees() -> None:
    """The errors of a pair are correlated, so two claims of a pair are not independent."""
    scenario = parse("max_ticks = 1\n" + NOISY, "noisy")
    world = release(scenario)
    poses = world.truth.poses
    commands = {
        robot: claims(0, robot, off(pose, by), SURE)
        for robot, pose, by in zip("ab", poses, (0.01, 0.05), strict=True)
    }
    row = row_of(
        Run(
            WorldHistory(
                of_world(), scenario, (Tick(world, commands),), None, None, MissionEnd(0, "localised")
            )
        )
    )
    each = [nees(off(pose, by), pose, SURE) for pose, by in zip(poses, (0.01, 0.05), strict=True)]
    assert row.claims == 2
    assert row.nees == pytest.approx(sum(each) / 2)


def test_the_table_of_a_sweep_gives_the_nees_where_covariances_are_claimed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report.show(results_of([row_of(claimed(NOISY, SURE))], tmp_path), tmp_path, quiet=False)
    noisy = capsys.readouterr().out.splitlines()
    heading = next(line for line in noisy if line.startswith(" cell"))
    assert heading.split()[-6:] == ["within", "nees", "nees", "low", "nees", "high"]
    (line,) = (line for line in noisy if line.startswith(" 0 "))
    assert line.split()[-4:] == ["1.0000", "1.1", "0.0717", "12.8"]
    assert any("; within: claims within 3 x accuracy; nees: " in line for line in noisy)
    report.show(results_of([row_of(claimed(EXACT, None, by=0.0))], tmp_path), tmp_path, quiet=False)
    assert "nees" not in capsys.readouterr().out


# --- the table ----------------------------------------------------------------------------------------


PLAYED = run_mission(load("paper-1"))


def missing_at(recording: Run, robot: str, ticks: Container[int]) -> Run:
    """Return the recording without that robot's Commands of `ticks`, and without its FinalReport."""
    moments = [
        replace(one, commands={who: command for who, command in one.commands.items() if who != robot})
        if one.truth.tick in ticks
        else one
        for one in recording.ticks
    ]
    final_reports = {who: said for who, said in recording.final_reports.items() if who != robot}
    return Run(replace(recording.history, ticks=tuple(moments), final_reports=final_reports))


def test_the_last_lines_have_the_missed_deadlines_of_each_robot_and_suggest_a_lower_rate(
    capsys: pytest.CaptureFixture[str],
) -> None:
    recording = missing_at(missing_at(PLAYED, "a", range(3, 10)), "b", [5])
    result(summary(recording, "processes", 0.5), 40.0)
    last = recording.ticks[-1].truth.tick
    said = capsys.readouterr().out.splitlines()[-1]
    assert said == (
        f"deadlines missed, of {last}: a 7, b 1; "
        "a lower --rate, such as --rate 20, gives each robot more time"
    )


@pytest.mark.parametrize(
    ("ticks", "why"),
    [
        (range(1000), "none of its Commands arrived in time"),
        (range(9, 1000), "its last Command that arrived in time is of tick 8 of LAST"),
        ((), "it did not answer the MissionEnd"),
    ],
)
def test_the_summary_has_the_reason_for_a_missing_final_report(ticks: Container[int], why: str) -> None:
    recording = missing_at(PLAYED, "a", ticks)
    told = summary(recording, "processes", 0.5)["robots"]
    assert told["a"]["no_farewell"] == why.replace("LAST", str(recording.ticks[-1].truth.tick))
    assert told["b"]["no_farewell"] is None
    assert told["a"]["reports_sent"] is None
    cut = summary(Run(replace(recording.history, end=None)), "processes", 0.5)["robots"]
    assert cut["a"]["no_farewell"] == "the recording breaks off"


def test_the_table_of_many_robots_fits_a_narrow_terminal_and_explains_only_its_columns(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    told = summary(claimed(NOISY, SURE), "in-process", 0.5)
    many = {f"{i:03d}-{'x' * 28}": told["robots"]["a"] for i in range(200)}
    result({**told, "robots": many})
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    rows = [line.split() for line in lines if "x" * 28 in line]
    assert len(rows) == 200
    heading = next(line for line in lines if line.startswith(" robot"))
    notes = " ".join(lines[lines.index("", 3) :])
    for column, note in (("sigma m", "sigma: "), ("reports", "reports sent"), ("ranges", "ranges to")):
        assert (column in heading) == (note in notes)


def table(recording: Run, capsys: pytest.CaptureFixture[str]) -> list[str]:
    result(summary(recording, "in-process", 0.5))
    return capsys.readouterr().out.splitlines()


def test_the_table_gives_the_claimed_sigma_beside_the_error(capsys: pytest.CaptureFixture[str]) -> None:
    lines = table(claimed(NOISY, SURE), capsys)
    heading = next(line for line in lines if line.startswith(" robot"))
    (a,) = (line for line in lines if line.startswith(" a "))
    (b,) = (line for line in lines if line.startswith(" b "))
    assert heading.split()[-6:] == ["error", "m", "sigma", "m", "ranges", "reports"]
    assert heading.index("sigma m") + len("sigma m") == a.index("5.0e-02") + len("5.0e-02")
    assert heading.index("error m") + len("error m") == a.index("3.0e-02") + len("3.0e-02")
    assert b.split()[4:] == ["-"] * 3 + ["-", "+", "-", "-", "/", "-"]
    assert lines[-1].startswith("sigma: claimed, of the position; poses in m and rad; ")


def test_without_noise_the_table_has_no_sigma(capsys: pytest.CaptureFixture[str]) -> None:
    assert "sigma" not in "\n".join(table(claimed(EXACT, None), capsys))


def test_the_table_is_a_list_of_all_columns_where_the_terminal_is_narrow(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    lines = table(claimed(NOISY, SURE), capsys)
    assert max(map(len, lines)) <= 40
    text = " ".join(" ".join(lines).split())
    assert "robot a: true x, y, heading " in text
    assert "; error m 3.0e-02; sigma m 5.0e-02; ranges " in text
