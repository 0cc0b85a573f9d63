"""A solver of a user fits the poses of missions, groups and recordings in place of the smoother."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

import tandem
from agent.estimation.fit import Start, fits
from compose import scenario
from compose.errors import PlannerFailed, UserError
from compose.recording.run import read
from tests.commands import refused
from tests.commands import tandem as command
from tests.expected.playing import decisions
from tests.groups import table_of
from tests.moving_groups import NOISE, PERIOD_S, joint_measurements, moving_group
from tests.own_solvers import Broken, Exiting, Smoother, WithBroken, WithNoSolver, WithNothing, WithSmoother
from tests.range_tables import SAMPLE

SHIPPED = Path(scenario.__file__).parent / "shipped" / "noisy.toml"
EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"


def test_a_mission_with_a_solver_is_localised_and_its_claims_are_right() -> None:
    for seed in range(1, 4):
        run = tandem.run("noisy", seed=seed, planner=WithSmoother)
        assert run.outcome == "localised"
        assert run.audit().violations == ()
        assert np.all(run.claims["nees"] < 20.0)


def test_a_fit_by_a_solver_has_its_poses_covariance_and_evidence() -> None:
    group = moving_group(3, 1, ticks=20, noise=NOISE)
    measured = joint_measurements(group.facts, NOISE, PERIOD_S)
    (fit,) = fits(measured, [Start(group.starts)])
    (by_solver,) = fits(replace(measured, solver=Smoother()), [Start(group.starts)])
    assert np.array_equal(by_solver.start.poses, fit.start.poses)
    assert np.array_equal(by_solver.covariance, fit.covariance)
    assert by_solver.weight == fit.weight
    assert by_solver.last_step == 0.0, "a solver has converged"
    assert np.allclose(by_solver.paths, fit.paths, atol=1e-9)
    assert by_solver.chi2 == pytest.approx(fit.chi2, rel=0.05)


def test_measurements_with_another_solver_are_others() -> None:
    measured = joint_measurements(moving_group(2, 1, ticks=5, noise=NOISE).facts, NOISE, PERIOD_S)
    one = Smoother()
    assert replace(measured, solver=one) == replace(measured, solver=one)
    assert replace(measured, solver=one) != measured
    assert replace(measured, solver=one) != replace(measured, solver=Smoother())


@pytest.mark.long
def test_a_robot_whose_solver_finds_nothing_claims_nothing() -> None:
    run = tandem.run("noisy", planner=WithNothing)
    assert run.outcome == "undecided"
    assert run.audit().violations == ()


@pytest.mark.parametrize(
    ("solution", "why"),
    [
        ("poses", "no finite poses of shape (1, 3)"),
        ("shape", "no finite poses of shape (1, 3)"),
        ("covariance", "no finite covariance of shape (3, 3)"),
        ("evidence", "no finite log evidence"),
        ("texts", "no finite poses of shape (1, 3)"),
        ("complex", "no finite poses of shape (1, 3)"),
        ("no-errors", "errors that are no tuple of OdometryErrors"),
        ("more-robots", "odometry errors of 9 of 1 robots"),
        ("errors", "no finite errors omega of shape (2,)"),
        ("weights", "no finite weights of shape"),
        ("negative-weights", "weights that are not all from 0 to 1"),
        ("variance", "a covariance whose variances are not all positive"),
        ("poses-alone", "returned Start, not a Solution or None"),
        ("nothing-else", "a Solution of NoneType, not of a Start"),
        ("raises", "ZeroDivisionError: by the solver"),
        ("exits", "observe() at tick 1 raises SystemExit: 3 (own_solvers.py:"),
        ("changes", "ValueError: assignment destination is read-only (own_solvers.py:"),
        ("changes-path", "ValueError: assignment destination is read-only (own_solvers.py:"),
        ("changes-start", "ValueError: output array is read-only (own_solvers.py:"),
    ],
)
def test_a_solution_that_cannot_be_used_ends_the_run_in_one_line(solution: str, why: str) -> None:
    with pytest.raises(PlannerFailed) as failed:
        tandem.run("noisy", planner=WithBroken, planner_options={"solution": solution})
    assert why in str(failed.value)
    assert "\n" not in str(failed.value)


@pytest.mark.parametrize(
    ("planner", "options", "why"),
    [
        (Exiting, {}, "decide() at tick 0 raises SystemExit: no more (own_solvers.py:"),
        (Exiting, {"at_once": True}, "tests.own_solvers:Exiting cannot be created: SystemExit: 7"),
        (WithNoSolver, {}, "SOLVER: the class tests.own_solvers:Smoother is no solver: an object with the"),
    ],
)
def test_a_planner_that_exits_or_has_no_solver_is_one_line(
    planner: type[tandem.planning.Planner[Any, Any]], options: dict[str, Any], why: str
) -> None:
    with pytest.raises(UserError) as failed:
        tandem.run("noisy", planner=planner, planner_options=options)
    assert why in str(failed.value)
    assert "\n" not in str(failed.value)


@pytest.mark.long
def test_a_group_uses_the_solver_in_each_of_its_meetings() -> None:
    scenario = table_of(3, 2, sigma=0.05)
    run = tandem.run(scenario, planner=WithSmoother)
    assert run.outcome == "localised"
    assert run.audit().violations == ()
    assert decisions(run.model) != decisions(tandem.run(scenario).model), (
        "the smoother follows, and stops early"
    )


@pytest.mark.long
def test_processes_decide_as_one_process_with_the_solver_of_the_example(tmp_path: Path) -> None:
    pytest.importorskip("gtsam", reason="gtsam has no wheel for this platform or this Python")
    path, here, apart = tmp_path / "no-outliers.toml", tmp_path / "here", tmp_path / "apart"
    path.write_text(SHIPPED.read_text().replace("outliers = 0.05\n", ""))
    own = ("--planner", "gtsam_solver:WithGtsam")
    for out, how in ((here, ["--in-process"]), (apart, [])):
        ended = command("run", path, *own, *how, "--out", out, cwd=EXAMPLES)
        assert ended.status == 0, ended
    assert decisions(read(here)) == decisions(read(apart))
    assert command("replay", apart, *own, cwd=EXAMPLES).status == 0
    assert command("replay", apart, cwd=EXAMPLES).status == 2, "the code of a recording is not trusted"


def test_a_recording_is_estimated_with_a_solver_as_with_the_smoother() -> None:
    found = tandem.estimate(SAMPLE, noise="uwb-calibrated", solver=Smoother(), window=(0.0, 25.0))
    expected = tandem.estimate(SAMPLE, noise="uwb-calibrated", window=(0.0, 25.0))
    assert {one: claim is not None for one, claim in claims(found).items()} == {"A": True, "B": True}
    last, again = (one.summary.robots["A"].final for one in (found, expected))
    assert last is not None
    assert again is not None
    assert np.allclose(last.pose, again.pose, atol=0.01)


def claims(found: tandem.PoseEstimates) -> dict[str, object]:
    return {name: one.first_claim for name, one in found.summary.robots.items()}


@pytest.mark.parametrize(
    ("solver", "why"),
    [
        (Broken("shape"), "tests.own_solvers:Broken: solve() returned no finite poses"),
        (Broken("raises"), "tests.own_solvers:Broken: solve() raised ZeroDivisionError: by the solver"),
        (Broken("exits"), "tests.own_solvers:Broken: solve() raised SystemExit: 3"),
        (Broken("changes"), "solve() raised ValueError: assignment destination is read-only"),
        (Broken("something"), "solve() returned str, not a Solution or None"),
        (Smoother, "the class tests.own_solvers:Smoother is no solver: an object with the method solve"),
        (object(), "builtins:object is no solver: an object with the method solve"),
    ],
)
def test_a_recording_with_a_broken_solver_is_refused_in_one_line(solver: Any, why: str) -> None:
    with pytest.raises(UserError, match=re.escape(why)) as refused:
        tandem.estimate(SAMPLE, solver=solver)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("tests.own_solvers:Smother", "there is no 'Smother' in tests.own_solvers"),
        ("tests.own_solvers:Broken", "tests.own_solvers:Broken cannot be created: TypeError"),
        ("nowhere", "'nowhere' is not a solver; expected MODULE:CLASS, such as mine:Own"),
        ("./own.py:Own", "'./own.py:Own' is not a solver; expected MODULE:CLASS, such as mine:Own"),
        ("own.py:Own", "'own.py:Own' is not a solver; expected MODULE:CLASS, such as mine:Own"),
        ("tests.own_solvers:math", "tests.own_solvers:math cannot be created: TypeError"),
    ],
)
def test_a_solver_that_cannot_be_loaded_ends_the_command_with_2(name: str, why: str) -> None:
    refused(command("estimate", SAMPLE, "--solver", name), why)


def test_the_command_estimates_with_the_solver_that_is_named() -> None:
    ended = command("estimate", SAMPLE, "--window", "0..8", "--solver", "tests.own_solvers:Nothing")
    assert ended.status == 1, ended
    assert "no claim at the end" in ended.out
