"""The simulations of Section IV and the reference values, compared at every tick."""

from __future__ import annotations

import csv
import io
import math
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

from agent.estimation.closed_forms import Placement, placements
from compose.launch.in_process import run_mission
from compose.recording.rows import ticks_csv
from compose.recording.run import Run
from compose.recording.summary_json import summary
from compose.scenario.scenario_file import load
from protocol.journal import journal_file
from protocol.messages import (
    Command,
    Environment,
    Estimate,
    FinalReport,
    MissionEnd,
    Observation,
    Report,
    RobotConfig,
)
from protocol.mission import Mission
from protocol.motion import Pose, wrap
from protocol.orbits import half_arc, longest_meeting, rendezvous
from protocol.wire import decode
from tests.missions import mission_of
from tests.reference import REFERENCE, Equation7, Phase1, Simulation

NAMES = ("paper-1", "paper-2")
SIMULATIONS = dict(zip(NAMES, REFERENCE.sims, strict=True))
EXACT = 1e-9


@cache
def played(name: str) -> Run:
    return run_mission(load(name))


def first_tick(recording: Run, robot: str, state: str) -> int:
    return next(moment.truth.tick for moment in recording.ticks if moment.commands[robot].task == state)


def command(recording: Run, robot: str, tick: int) -> Command:
    return recording.ticks[tick].commands[robot]


def optional(cell: str) -> float | None:
    return float(cell) if cell else None


# --- Section IV, tick by tick -------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_every_pose_control_and_range_of_section_iv_is_the_references(name: str) -> None:
    reference = SIMULATIONS[name]
    rows = list(csv.DictReader(io.StringIO(ticks_csv(played(name)))))
    assert [(int(row["tick"]), row["robot"]) for row in rows] == [
        (tick, robot) for tick in range(reference.k_last + 1) for robot in "ab"
    ]
    for row in rows:
        tick = int(row["tick"])
        poses, controls, ranges = (
            (reference.poses_a, reference.u_a, reference.range_a)
            if row["robot"] == "a"
            else (reference.poses_b, reference.u_b, reference.range_b)
        )
        x, y, heading = poses[tick]
        assert [float(row["x"]), float(row["y"])] == pytest.approx([x, y], abs=EXACT)
        assert wrap(float(row["heading"]) - heading) == pytest.approx(0.0, abs=EXACT)
        assert -math.pi < float(row["heading"]) <= math.pi
        expected = controls[tick] if tick < reference.k_last else (None, None)
        driven = (optional(row["v"]), optional(row["omega"]))
        assert driven == pytest.approx(expected, abs=EXACT)
        assert optional(row["anchor_range"]) == pytest.approx(ranges[tick], abs=EXACT)
        assert optional(row["mutual_range"]) == pytest.approx(reference.mutual[tick], abs=EXACT)


@pytest.mark.parametrize("robot", ["a", "b"])
@pytest.mark.parametrize("name", NAMES)
def test_a_robot_senses_the_references_ranges_and_what_it_drove(
    name: str, robot: str, tmp_path: Path
) -> None:
    reference = SIMULATIONS[name]
    run_mission(load(name), tmp_path)
    kinds = Environment | RobotConfig | Observation | Report | Command | Estimate | MissionEnd | FinalReport
    frames = [decode(frame, kinds) for frame in journal_file.read(tmp_path / f"agent-{robot}.journal")]
    observations = [frame for frame in frames if isinstance(frame, Observation)]
    controls = reference.u_a if robot == "a" else reference.u_b
    ranges = reference.range_a if robot == "a" else reference.range_b

    assert [observation.tick for observation in observations] == list(range(reference.k_last + 1))
    assert observations[0].executed is None
    for observation, driven in zip(observations[1:], controls, strict=True):
        assert observation.executed is not None
        assert (observation.executed.v, observation.executed.omega) == pytest.approx(driven, abs=EXACT)
    for observation in observations:
        assert observation.anchor_range == pytest.approx(ranges[observation.tick], abs=EXACT)
        mutual = reference.mutual[observation.tick]
        heard = [contact.range for contact in observation.contacts]
        assert heard == ([pytest.approx(mutual, abs=EXACT)] if mutual is not None else [])


# --- the table of Section IV --------------------------------------------------------------------------


class Row(NamedTuple):
    """The expected values of phases 1 and 2 of one robot, from the notes on the paper."""

    scenario: str
    robot: str
    branch: str
    alpha: float
    located: int
    """tick in which phase 1 ends"""
    anchor_ranges: int
    """number of anchor ranges until then"""
    mu: float
    orbits: int


ROWS = (
    Row("paper-1", "a", "circle", +1.980462, 5, 2, -3.113663, 12),
    Row("paper-1", "b", "three-ranges", -2.384686, 2, 3, +0.952119, 9),
    Row("paper-2", "a", "three-ranges-virtual", -1.389410, 2, 2, +1.287471, 8),
    Row("paper-2", "b", "three-ranges", +1.287611, 2, 3, +1.892149, 10),
)


@pytest.mark.parametrize("row", ROWS, ids=[f"{row.scenario}-{row.robot}" for row in ROWS])
def test_phases_1_and_2_are_those_of_the_table(row: Row) -> None:
    recording = played(row.scenario)
    final_report = recording.final_reports[row.robot]
    reference = SIMULATIONS[row.scenario]
    ranges = reference.range_a if row.robot == "a" else reference.range_b
    assert final_report.branch == row.branch
    assert final_report.alpha == pytest.approx(row.alpha, abs=5.1e-7)
    assert first_tick(recording, row.robot, "aligning") == row.located
    assert sum(rho is not None for rho in ranges[: row.located + 1]) == row.anchor_ranges
    aligning = command(recording, row.robot, row.located)
    assert (aligning.v, -aligning.omega) == pytest.approx((0.0, row.mu), abs=5.1e-7)
    assert first_tick(recording, row.robot, "orbiting") == row.orbits


def test_in_simulation_1_a_leaves_its_anchors_range_and_circles_for_three_ticks() -> None:
    recording = played("paper-1")
    assert [command(recording, "a", tick).task for tick in range(6)] == [
        "straight",
        "turning",
        "circling",
        "circling",
        "circling",
        "aligning",
    ]


def test_in_simulation_2_a_drives_its_third_manoeuvre_at_the_optimum_and_full_speed() -> None:
    third = command(played("paper-2"), "a", 1)
    assert (third.task, third.v) == ("third-point", 1.0)
    assert third.omega == pytest.approx(2.331122, abs=5.1e-7)


@pytest.mark.parametrize(
    ("name", "first", "first_range", "second", "second_range", "way"),
    [
        ("paper-1", 46, 2.949342, 47, 2.106468, ["straight"]),
        ("paper-2", 106, 2.998668, 109, 2.176967, ["straight", "turning", "circling"]),
    ],
)
def test_a_takes_its_second_mutual_range_while_b_stands(
    name: str, first: int, first_range: float, second: int, second_range: float, way: list[str]
) -> None:
    recording = played(name)
    rows = list(csv.DictReader(io.StringIO(ticks_csv(recording))))
    mutual = {int(row["tick"]): float(row["mutual_range"]) for row in rows if row["mutual_range"]}
    assert list(mutual) == [first, second, recording.ticks[-1].truth.tick]
    assert mutual[first] == pytest.approx(first_range, abs=5.1e-7)
    assert mutual[second] == pytest.approx(second_range, abs=5.1e-7)
    assert [command(recording, "a", tick).task for tick in range(first, second)] == way
    assert {command(recording, "b", tick).task for tick in range(first, second)} == {"standing"}
    assert command(recording, "a", second).task == "waiting"
    assert command(recording, "b", second).task == "last-manoeuvre"
    assert summary(recording, "in-process", None)["first_contact_tick"] == first


@pytest.mark.parametrize(
    ("name", "solutions", "omega", "separation", "last"),
    [
        ("paper-1", (4, 4), +0.9076, 1.80395, 48),
        ("paper-2", (4, 2), +0.1484, 0.95768, 110),
    ],
)
def test_b_chooses_the_last_manoeuvre_of_the_table(
    name: str, solutions: tuple[int, int], omega: float, separation: float, last: int
) -> None:
    recording = played(name)
    reference = SIMULATIONS[name]
    b = recording.final_reports["b"]
    assert b.candidates == solutions
    assert recording.final_reports["a"].candidates == solutions
    assert b.last_turn_rate == pytest.approx(omega, abs=5.1e-5)
    assert b.last_turn_rate == pytest.approx(reference.w2, abs=EXACT)
    assert b.separation_m2 == pytest.approx(separation, abs=5.1e-6)
    assert b.separation_m2 == pytest.approx(reference.J, abs=EXACT)
    assert recording.ticks[-1].truth.tick == last == reference.k_last
    assert command(recording, "b", last - 1).v == 1.0


@pytest.mark.parametrize("name", NAMES)
def test_both_robots_end_knowing_their_pose(name: str) -> None:
    recording = played(name)
    told = summary(recording, "in-process", None)
    assert told["outcome"] == "localised"
    for robot in told["robots"].values():
        assert robot["localised"]
        assert robot["localised_tick"] == told["ticks"]
        assert robot["position_error_m"] < EXACT
        assert robot["heading_error_rad"] < EXACT


def test_the_constants_of_section_iv_are_the_notes() -> None:
    mission = Mission(3.0, 1.0, 1.0, math.pi)
    plan = rendezvous(mission, 10.0, "paper")
    assert half_arc(10.0, 3.0) == pytest.approx(0.6931599, abs=5.1e-8)
    assert plan.a.omega == pytest.approx(0.15384615, abs=5.1e-9)
    assert plan.b.omega == pytest.approx(-0.0339445617, abs=5.1e-11)
    assert plan.b.v == pytest.approx(0.2206396513, abs=5.1e-11)
    assert plan.bound == longest_meeting(mission, 10.0, plan.b.omega) == pytest.approx(225.942087, abs=5.1e-7)


# --- phase 1 ------------------------------------------------------------------------------------------

BRANCHES = {
    "straight-3meas": "three-ranges",
    "straight-3meas-virtual": "three-ranges-virtual",
    "circle-2meas": "circle",
}


@pytest.mark.parametrize("case", REFERENCE.phase1, ids=lambda case: f"{case.start[0]:+.3f}")
def test_phase_1_finds_the_references_branch_and_orientation(case: Phase1) -> None:
    recording = mission_of(case.start, planner_name="paper")
    final_report = recording.final_reports["a"]
    for tick, controls in enumerate(case.u):
        driven = command(recording, "a", tick)
        assert (driven.v, driven.omega) == pytest.approx(controls, abs=EXACT)
    measured = [math.hypot(*_place(recording, tick)) for tick in range(case.k_end + 1)]
    assert [rho if rho <= 3.0 else None for rho in measured] == pytest.approx(case.ranges, abs=EXACT)
    assert measured[0] == pytest.approx(case.rho0, abs=EXACT)
    assert measured[-1] == pytest.approx(case.r_end, abs=EXACT)
    assert final_report.branch == BRANCHES[case.branch]
    assert final_report.alpha == pytest.approx(case.alpha_signed, abs=EXACT)
    assert first_tick(recording, "a", "aligning") == case.k_end
    aligning = command(recording, "a", case.k_end)
    assert (aligning.v, -aligning.omega) == pytest.approx((0.0, case.mu), abs=EXACT)
    radial = [moment.commands["a"].v for moment in recording.ticks if moment.commands["a"].task == "radial"]
    assert sum(radial) == pytest.approx(6.5 - case.r_end, abs=EXACT)


def _place(recording: Run, tick: int) -> tuple[float, float]:
    pose = recording.ticks[tick].truth.poses[0]
    return pose.x, pose.y


def test_every_way_through_phase_1_is_among_the_cases() -> None:
    assert {case.branch for case in REFERENCE.phase1} == set(BRANCHES)
    assert len(REFERENCE.phase1) == 14


# --- eq. (7) ------------------------------------------------------------------------------------------


def by_turn(found: list[Placement]) -> list[float]:
    return [part for placement in sorted(found) for part in placement]


@pytest.mark.parametrize("case", REFERENCE.eq7, ids=lambda case: f"{case.D:.3f}")
def test_eq_7_has_all_the_references_placements_and_no_more(case: Equation7) -> None:
    found = placements(
        case.D, Pose(*case.p1b, 0.0), Pose(*case.p1a, 0.0), Pose(*case.p2a, 0.0), case.rho1, case.rho2
    )
    expected = [Placement(solution.phi, *solution.T) for solution in case.solutions]
    assert len(found) == len(expected)
    assert by_turn(found) == pytest.approx(by_turn(expected), abs=EXACT)


@pytest.mark.parametrize("name", NAMES)
def test_eq_7_has_the_references_four_placements_at_each_encounter(name: str) -> None:
    """Both frames are those of the paper: centred at the own anchor, with the x-axis through p_0."""
    reference = SIMULATIONS[name]
    a1, a2 = (_from_anchor(reference, "a", tick) for tick in (reference.k_meet, reference.k_second))
    b = _from_anchor(reference, "b", reference.k_meet)
    rho1, rho2 = reference.mutual[reference.k_meet], reference.mutual[reference.k_second]
    assert rho1 is not None
    assert rho2 is not None
    found = placements(10.0, b, a1, a2, rho1, rho2)
    expected = [Placement(phi, *shift) for phi, shift in reference.candidates]
    assert len(found) == len(expected) == 4
    assert by_turn(found) == pytest.approx(by_turn(expected), abs=EXACT)


def _from_anchor(reference: Simulation, robot: str, tick: int) -> Pose:
    poses, anchor_x = (reference.poses_a, 0.0) if robot == "a" else (reference.poses_b, 10.0)
    bearing = math.atan2(poses[0][1], poses[0][0] - anchor_x)
    x, y, heading = poses[tick]
    c, s = math.cos(bearing), math.sin(bearing)
    return Pose(c * (x - anchor_x) + s * y, -s * (x - anchor_x) + c * y, heading - bearing)
