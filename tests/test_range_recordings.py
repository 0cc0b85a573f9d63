"""Range recordings: every format gives the same data, and an invalid file is one line with its place."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import scipy.io  # type: ignore[import-untyped]
from msgspec.structs import astuple, replace

from compose.errors import USER_ERROR, BadRecording, UserError
from compose.launch import in_process
from compose.recording.estimating.estimate_rows import PoseEstimateRow, estimate_csv
from compose.recording.estimating.sound_odometry import sound
from compose.recording.ranging.pyfg import written_pyfg
from compose.recording.ranging.range_files import TUM_FIELDS, read_ranges
from compose.recording.ranging.range_recording import FixedAnchor, RangeRecording
from compose.recording.ranging.run_ranges import ADDED_SIGMA, increment_covariance, ranges_of_run
from compose.recording.rows import estimate_rows
from compose.recording.run import Run, read
from compose.scenario.scenario_file import load
from compose.view.export.tum import tum_of_estimate, tum_of_run
from docs import plaza_csv
from protocol.motion import ORIGIN, Controls, Pose, compose, step, wrap
from protocol.noise import VelocityNoise
from tests.commands import tandem
from tests.range_tables import POSE, SAMPLE, SIGMAS, TABLES, refused, written_csv, written_mcap
from tests.uwb_sample import NAMES

MAX_SAMPLE_BYTES = 350_000


def same(one: RangeRecording, other: RangeRecording) -> None:
    """Fail unless both recordings have the same numbers, to the bit, apart from the names of radios."""
    assert [tuple(anchor[1:]) for anchor in one.anchors] == [tuple(anchor[1:]) for anchor in other.anchors]
    assert len(one.robots) == len(other.robots)
    columns = [(*one.ranges,), (*other.ranges,)]
    for mine, its in zip(one.robots, other.robots, strict=True):
        assert mine.antenna == its.antenna
        assert (mine.truth is None) == (its.truth is None)
        columns[0] += (*mine.odometry, *(mine.truth or ()))
        columns[1] += (*its.odometry, *(its.truth or ()))
    for left, right in zip(*columns, strict=True):
        np.testing.assert_array_equal(left, right)


@pytest.fixture(scope="module")
def noisy() -> Run:
    return in_process.run_mission(load("noisy"))


# --- the formats ------------------------------------------------------------------------------------------


def test_a_csv_folder_is_read_with_everything_that_it_states(tmp_path: Path) -> None:
    tables = {**TABLES, "odometry": [TABLES["odometry"][0] | SIGMAS, *TABLES["odometry"][1:]]}
    recording = read_ranges(written_csv(tmp_path, tables))
    assert recording.radios == ("a", "b", "M1")
    a, b = recording.robots
    np.testing.assert_array_equal(a.odometry.t0, [0.0, 0.5, 2.0])
    np.testing.assert_array_equal(a.odometry.increments[0], [0.1, 0.01, 0.2])
    np.testing.assert_allclose(a.odometry.covariance[0], np.diag([1e-4, 4e-4, 9e-4]))
    assert np.isnan(a.odometry.covariance[1:]).all()
    np.testing.assert_array_equal(a.odometry.gaps, [[1.0, 2.0]])
    assert (a.antenna, b.antenna) == ((0.0, 0.0, 0.0), (0.2, -0.1, 0.3))
    assert a.truth is not None
    np.testing.assert_array_equal(a.truth.poses[-1], [1.1, 2.1, 3.1])
    assert b.truth is None
    assert recording.anchors[0] == FixedAnchor("M1", 3.0, -4.0, 1.25)
    np.testing.assert_array_equal(recording.ranges.t, [0.2, 0.3])  # in the order of time
    np.testing.assert_array_equal(recording.ranges.first, [0, 0])  # the robot is always first
    np.testing.assert_array_equal(recording.ranges.second, [2, 1])
    np.testing.assert_array_equal(recording.ranges.sigma, [math.nan, 0.1])
    assert recording.span == (0.0, 2.5)
    assert {pair: list(rows) for pair, rows in recording.pairs().items()} == {
        ("a", "b"): [1],
        ("a", "M1"): [0],
    }


def test_an_mcap_file_gives_the_same_as_csv_files_and_counts_what_it_does_not_use(tmp_path: Path) -> None:
    recording = read_ranges(written_mcap(tmp_path / "one.mcap", TABLES))
    same(recording, read_ranges(written_csv(tmp_path / "csv", TABLES)))
    assert recording.radios == ("a", "b", "M1")
    assert recording.unused == {"messages on /battery": 1}


def test_a_recording_cannot_be_changed(tmp_path: Path) -> None:
    recording = read_ranges(written_csv(tmp_path, TABLES))
    arrays = [*recording.ranges, *recording.robots[0].odometry, *(recording.robots[0].truth or ())]
    assert not any(array.flags.writeable for array in arrays)


def test_anchors_of_another_file_are_added_and_replace_those_of_the_same_names(tmp_path: Path) -> None:
    other = tmp_path / "surveyed.csv"
    other.write_text("anchor,x,y\nM1,30,40\nM2,5,6\n")
    ranges = [*TABLES["ranges"], {"t": 1.0, "from": "b", "to": "M2", "range": 3.5}]
    tables = {**TABLES, "ranges": ranges}
    for path in (written_csv(tmp_path / "csv", tables), written_mcap(tmp_path / "one.mcap", tables)):
        assert "M2 is neither a robot" in refused(path)
        recording = read_ranges(path, other)
        assert recording.anchors == (FixedAnchor("M1", 30.0, 40.0), FixedAnchor("M2", 5.0, 6.0))
        assert recording.radios[recording.ranges.second[-1]] == "M2"
    for text, says in (
        ("LC0,30,x", "line 2: y: expected a number, got 'x'"),
        ("LC0,1,2\nLC0,1,2", "line 3: there are two anchors LC0"),
    ):
        other.write_text(f"anchor,x,y\n{text}\n")
        with pytest.raises(BadRecording) as error:
            read_ranges(SAMPLE, other)
        assert str(error.value) == f"{other}, {says}"
    other.write_text("anchor,x,y\nLC0,30,40\n")
    assert read_ranges(SAMPLE, other).anchors[0] == FixedAnchor("LC0", 30.0, 40.0)


def test_the_sample_has_its_licence_and_is_small() -> None:
    assert sum(path.stat().st_size for path in SAMPLE.parent.iterdir()) <= MAX_SAMPLE_BYTES
    assert (SAMPLE.parent / "LICENSE").read_text().startswith("MIT License")


def test_the_sample_is_two_robots_with_truth_for_30_s() -> None:
    recording = read_ranges(SAMPLE)
    assert recording.radios == ("A", "B", "LC0", "LC1")
    assert 29.9 <= recording.span[1] - recording.span[0] <= 30.1
    for robot in recording.robots:
        assert len(robot.odometry.t0) == 600
        assert not len(robot.odometry.gaps)
        assert robot.truth is not None
        assert len(robot.truth.t) == 601
    assert {pair: len(rows) for pair, rows in recording.pairs().items()} == {
        ("A", "B"): 184,
        ("A", "LC0"): 171,
        ("B", "LC1"): 133,
    }


def test_a_part_has_the_chosen_robots_and_the_chosen_time() -> None:
    whole = read_ranges(SAMPLE)
    part = whole.part("B", 10.0, 20.0)
    assert part.radios == ("B", "LC0", "LC1")
    (robot,) = part.robots
    assert robot.odometry.t0[0] >= 10.0
    assert robot.odometry.t1[-1] <= 20.0
    assert robot.truth is not None
    assert robot.truth.t[0] >= 10.0
    assert set(part.pairs()) == {("B", "LC1")}
    rows = whole.pairs()["B", "LC1"]
    inside = [row for row in rows if 10.0 <= whole.ranges.t[row] <= 20.0]
    of_part = part.pairs()["B", "LC1"]
    np.testing.assert_array_equal(part.ranges.range[of_part], whole.ranges.range[inside])


PYFG = """\
VERTEX_SE2 0.1 A0 1.0 2.0 0.5
VERTEX_SE2 1.1 A1 1.5 2.0 0.5
VERTEX_XY L0 4.0 5.0
EDGE_SE2 {first} A0 A1 0.5 0.1 0.0 0.01 0 0 0.02 0 0.03
EDGE_SE2 {second} A1 A2 0.25 0.0 0.1 0.01 0 0 0.02 0 0.03
EDGE_SE2 9.0 A0 A2 0.25 0.0 0.1 0.01 0 0 0.02 0 0.03
VERTEX_XY:PRIOR 0.0 L0 4.0 5.0 1 0 1
EDGE_RANGE 0.6 L0 A1 3.5 0.04
"""


def test_the_stamps_of_edges_are_the_ends_of_increments_or_their_starts(tmp_path: Path) -> None:
    path = tmp_path / "one.pyfg"
    path.write_text(PYFG.format(first=1.12, second=2.0))
    ends = read_ranges(path)
    np.testing.assert_array_equal(ends.robots[0].odometry.t0, [0.1, 1.12])
    np.testing.assert_array_equal(ends.robots[0].odometry.t1, [1.12, 2.0])
    path.write_text(
        PYFG.replace("VERTEX_XY L0", "VERTEX_SE2 2.2 A2 1 2 3\nVERTEX_XY L0").format(first=0.0, second=1.0)
    )
    starts = read_ranges(path)
    np.testing.assert_array_equal(starts.robots[0].odometry.t0, [0.0, 1.0])
    np.testing.assert_array_equal(starts.robots[0].odometry.t1, [1.0, 2.2])
    np.testing.assert_array_equal(ends.robots[0].odometry.covariance[0], np.diag([0.01, 0.02, 0.03]))
    np.testing.assert_array_equal(ends.ranges.sigma, [0.2])
    assert ends.radios == ("A", "L0")
    assert ends.unused == {"EDGE_SE2 between poses that do not follow each other": 1}
    assert ends.anchors == (FixedAnchor("L0", 4.0, 5.0, 0.0, 1.0),)


# --- runs of Tandem ---------------------------------------------------------------------------------------


def test_a_run_gives_what_its_robots_measured(noisy: Run) -> None:
    recording = ranges_of_run(noisy)
    mission = noisy.scenario.mission
    assert recording.radios == ("a", "b", "anchor-a", "anchor-b")
    for robot in recording.robots:
        assert robot.truth is not None
        assert [tuple(pose) for pose in robot.truth.poses] == [
            (pose.x, pose.y, pose.heading) for pose in noisy.truth(robot.id)
        ]
        for tick, moved in enumerate(robot.odometry.increments, 1):
            executed = noisy.observations[tick][robot.id].executed
            assert executed is not None
            end = step(ORIGIN, executed.v, executed.omega, mission.period)
            assert tuple(moved) == (end.x, end.y, end.heading)
    measured = {
        (tick * mission.period, robot): observation.anchor_range
        for tick, observations in enumerate(noisy.observations)
        for robot, observation in observations.items()
        if observation.anchor_range is not None
    }
    rows = [row for pair, rows in recording.pairs().items() if pair != ("a", "b") for row in rows]
    ranges = recording.ranges
    assert measured == {(ranges.t[i], recording.radios[ranges.first[i]]): ranges.range[i] for i in rows}
    mutual = recording.pairs()["a", "b"]
    contacts = [noisy.contact("a", tick) for tick in range(noisy.length)]
    assert list(ranges.range[mutual]) == [one.range for one in contacts if one is not None and one.range]
    assert ranges.sigma[mutual[0]] == math.hypot(mission.noise.mutual_sigma, ADDED_SIGMA)


def test_a_run_in_hardware_mode_has_no_truth_and_a_robot_alone_no_mutual_ranges(
    noisy: Run, tmp_path: Path
) -> None:
    in_process.run_mission(load("noisy"), tmp_path)
    (tmp_path / "world.journal").unlink()
    pair, with_truth = read_ranges(tmp_path), ranges_of_run(noisy)
    assert [robot.truth for robot in pair.robots] == [None, None]
    np.testing.assert_array_equal(pair.ranges.range, with_truth.ranges.range)
    ended = tandem("export", tmp_path, "--pyfg")
    unknown = "the true poses of a, which a .pyfg file needs, are unknown"
    assert ended == (USER_ERROR, "", f"tandem export: {tmp_path}: {unknown}\n")
    (tmp_path / "agent-b.journal").unlink()
    alone = read_ranges(tmp_path)
    assert alone.radios == ("a", "anchor-a")
    assert set(alone.pairs()) == {("a", "anchor-a")}


@pytest.mark.parametrize("omega", [0.0, 1e-5, 0.7, -2.0])
def test_the_covariance_of_an_increment_is_that_of_its_derivatives(omega: float) -> None:
    noise, executed, h = (
        VelocityNoise(v=0.1, omega=0.05, v_floor=0.02, omega_floor=0.03),
        Controls(0.8, omega),
        1e-6,
    )

    def end(v: float, turn_rate: float) -> np.ndarray:
        pose = step(ORIGIN, v, turn_rate, 0.5)
        return np.array([pose.x, pose.y, pose.heading])

    by_v = (end(executed.v + h, omega) - end(executed.v - h, omega)) / (2 * h)
    by_omega = (end(executed.v, omega + h) - end(executed.v, omega - h)) / (2 * h)
    q_v, q_omega = noise.variances(executed.v, omega)
    expected = q_v * np.outer(by_v, by_v) + q_omega * np.outer(by_omega, by_omega) + 1e-12 * np.eye(3)
    found = increment_covariance(executed, 0.5, noise)
    np.testing.assert_allclose(found, expected[np.triu_indices(3)], rtol=1e-6, atol=1e-12)


# --- export -----------------------------------------------------------------------------------------------


def errors_in(folder: Path, kind: str, robot: str) -> np.ndarray:
    """Return the distances of the poses in a TUM file from the truth, as evo_ape computes them."""
    truth, found = [np.loadtxt(folder / f"{name}-{robot}.tum", ndmin=2) for name in ("truth", kind)]
    nearest = np.argmin(np.abs(truth[:, 0] - found[:, :1]), axis=1)
    near = np.abs(truth[nearest, 0] - found[:, 0]) <= 0.01  # the bound of evo
    distance: np.ndarray = np.linalg.norm((found - truth[nearest])[near, 1:4], axis=1)
    return distance


def test_tum_files_of_a_run_have_its_errors_and_are_read_back(tmp_path: Path) -> None:
    in_process.run_mission(load("noisy"), tmp_path)
    run = read(tmp_path)
    for name, text in tum_of_run(run).items():
        (tmp_path / name).write_text(text)
    rows = [row for row in estimate_rows(run, 1.0) if row.frame == "world" and not row.hypothesis]
    for robot in ("a", "b"):
        own = [row for row in rows if row.robot == robot]
        errors = [row.position_error_m or math.nan for row in own]
        assert len(errors) > 5
        np.testing.assert_allclose(errors_in(tmp_path, "estimate", robot), errors, rtol=0, atol=1e-6)
        claims = [row.position_error_m or math.nan for row in own if row.localised]
        assert claims
        np.testing.assert_allclose(errors_in(tmp_path, "claim", robot), claims, rtol=0, atol=1e-6)
    there = ranges_of_run(run)
    radios, series = there.radios, there.ranges
    ranges = [
        {"t": t, "from": radios[first], "to": radios[second], "range": rho, "sigma": sigma}
        for t, first, second, rho, sigma in zip(*map(np.ndarray.tolist, series), strict=True)
    ]
    anchors = [{"anchor": one.id, "x": one.x, "y": one.y} for one in there.anchors]
    here = read_ranges(written_csv(tmp_path, {"ranges": ranges, "anchors": anchors}))
    for one, other in zip(here.robots, there.robots, strict=True):
        np.testing.assert_array_equal(one.odometry.t1, other.odometry.t1)
        np.testing.assert_allclose(one.odometry.increments, other.odometry.increments, atol=1e-9)
        assert one.truth is not None
        assert other.truth is not None
        np.testing.assert_allclose(np.cos(one.truth.poses), np.cos(other.truth.poses), atol=1e-12)
        np.testing.assert_allclose(np.sin(one.truth.poses), np.sin(other.truth.poses), atol=1e-12)
    for column, its in zip(here.ranges, series, strict=True):
        np.testing.assert_array_equal(column, its)


def test_tum_files_of_an_estimate_have_its_errors(tmp_path: Path) -> None:
    first = PoseEstimateRow(0.5, "a", 2, 0.9, 1.0, -0.5, 0.1, 0.1, 0.0, 0.0, 0.1, 0.0, 0.1, claim=False)
    second = replace(first, t_s=1.0, claim=True, true_x=1.3, true_y=-0.1, true_heading=3.1)
    (tmp_path / "estimate.csv").write_text(estimate_csv([first, second]))
    ended = tandem("export", tmp_path, "--tum", "--out", tmp_path / "tum")
    names = [f"{kind}-a.tum" for kind in ("claim", "estimate", "truth")]
    assert ended == (0, "".join(f"{tmp_path}/tum/{name}\n" for name in names), "")
    assert len((tmp_path / "tum" / names[1]).read_text().splitlines()) == 3
    for kind in ("claim", "estimate"):
        np.testing.assert_allclose(errors_in(tmp_path / "tum", kind, "a"), [0.5], rtol=0, atol=1e-12)
    (tmp_path / "estimate.csv").write_text("t_s,robot\n1,a\n")
    with pytest.raises(UserError, match=r"estimate.csv, line 2: .*missing required field `hypotheses`"):
        tum_of_estimate(tmp_path)


@pytest.mark.parametrize("name", ["paper-1", "noisy"])
@pytest.mark.long
def test_an_exported_run_is_read_back_without_loss(name: str, tmp_path: Path) -> None:
    recording = tmp_path / "recording"
    recording.mkdir()
    run = in_process.run_mission(load(name), recording)
    ended = tandem("export", recording, "--pyfg", "--out", tmp_path / "out")
    path = tmp_path / "out" / "run.pyfg"
    assert ended == (0, f"{path}\na is A, b is B, anchor-a is L0, anchor-b is L1\n", "")
    assert list(path.parent.iterdir()) == [path]
    same(read_ranges(path), ranges_of_run(run))
    same(read_ranges(recording), ranges_of_run(run))


def test_an_exported_graph_has_the_layout_that_pyfactorgraph_reads(noisy: Run) -> None:
    """The rules of its `read_from_pyfg_text`, which is not in the package registry.

    The first line is a pose; fields are separated by one space, and their number is fixed; names of poses
    are one capital other than L and a number, those of landmarks begin with L; a name appears before it is
    used; variances are positive.
    """
    known: set[str] = set()
    kinds = {"VERTEX_SE2": 6, "VERTEX_XY": 4, "EDGE_SE2": 13, "EDGE_RANGE": 6}
    lines = written_pyfg(ranges_of_run(noisy))[0].splitlines()
    assert lines[0].startswith("VERTEX_SE2 ")
    for line in lines:
        words = line.split(" ")
        assert len(words) == kinds[words[0]]
        named = [words[place] for place in NAMES[words[0]]]
        match words[0]:
            case "VERTEX_SE2":
                assert named[0][0] in "AB"
                known.add(named[0])
            case "VERTEX_XY":
                assert words[1].startswith("L")
                known.add(words[1])
            case "EDGE_SE2":
                assert int(named[1][1:]) == int(named[0][1:]) + 1
                matrix = np.array(words[7:], float)[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
                assert np.linalg.eigvalsh(matrix)[0] > 0.0
            case _:
                assert not named[0].startswith("L")
                assert float(words[5]) > 0.0
        assert set(named) <= known
        assert all(math.isfinite(float(word)) for word in words if word[:1] in "-0123456789")


def test_the_sample_is_written_as_it_was_read(tmp_path: Path) -> None:
    recording = read_ranges(SAMPLE)
    written, names = written_pyfg(recording)
    assert names == {"A": "A", "B": "B", "LC0": "L0", "LC1": "L1"}
    (tmp_path / "again.pyfg").write_text(written)
    same(read_ranges(tmp_path / "again.pyfg"), recording)


def test_a_recording_without_true_poses_is_no_factor_graph(tmp_path: Path) -> None:
    odometry = [row | SIGMAS for row in TABLES["odometry"] if row["robot"] == "b"]
    written_csv(tmp_path, {"odometry": odometry})
    (tmp_path / "ranges.csv").write_text("t,from,to,range\n")
    with pytest.raises(UserError) as error:
        written_pyfg(read_ranges(tmp_path))
    expected = f"{tmp_path}: the true poses of b, which a .pyfg file needs, are unknown"
    assert str(error.value) == expected


# --- odometry as poses -----------------------------------------------------------------------------------


def track(*, headings: str, begin: Pose) -> list[dict[str, object]]:
    """Return poses over two turns of a robot, at uneven times, with a gap, and one of them twice."""
    rows: list[dict[str, object]] = []
    times = [0.1 * k + 0.03 * (k % 3) for k in range(120) if not 40 <= k < 70]
    for t in [times[0], *times]:
        pose = compose(begin, step(ORIGIN, 0.5, 1.1, t))
        half = 0.5 * pose.heading
        turned: dict[str, dict[str, object]] = {
            "unwrapped": {"heading": pose.heading},
            "wrapped": {"heading": wrap(pose.heading)},
            "quaternion": {"qx": 0.0, "qy": 0.0, "qz": math.sin(half), "qw": math.cos(half)},
        }
        rows.append({"robot": "a", "t": t, "x": pose.x, "y": pose.y, **turned[headings]})
    return rows


@pytest.mark.parametrize("headings", ["unwrapped", "wrapped", "quaternion"])
def test_odometry_as_poses_that_begin_anywhere_gives_the_increments(headings: str, tmp_path: Path) -> None:
    rows = track(headings=headings, begin=Pose(400.0, -70.0, 3.0))
    tables = {"poses": rows, "ranges": [{"t": 0.3, "from": "a", "to": "M1", "range": 2.5}]}
    tables["anchors"] = TABLES["anchors"]
    (a,) = read_ranges(written_csv(tmp_path / "csv", tables)).robots
    times = np.array([row["t"] for row in rows[1:]])
    np.testing.assert_array_equal((a.odometry.t0, a.odometry.t1), (times[:-1], times[1:]))
    moved = [astuple(step(ORIGIN, 0.5, 1.1, dt)) for dt in np.diff(times)]
    gap = int(np.argmax(np.diff(times)))
    moved[gap] = (*moved[gap][:2], wrap(moved[gap][2]))
    np.testing.assert_allclose(a.odometry.increments, moved, atol=1e-12)
    assert np.isnan(a.odometry.covariance).all()
    same(
        read_ranges(written_mcap(tmp_path / "one.mcap", tables)),
        read_ranges(written_csv(tmp_path / "again", tables)),
    )


@pytest.mark.parametrize("headings", ["unwrapped", "wrapped"])
def test_headings_in_degrees_are_named(headings: str, tmp_path: Path) -> None:
    rows = track(headings=headings, begin=Pose(400.0, -70.0, 3.0))
    tables = {"poses": rows, "anchors": TABLES["anchors"]}
    tables["ranges"] = [{"t": 0.3, "from": "a", "to": "M1", "range": 2.5}]
    read_ranges(written_csv(tmp_path / "rad", tables))
    tables["poses"] = [row | {"heading": math.degrees(float(str(row["heading"])))} for row in rows]
    said = refused(written_csv(tmp_path / "degrees", tables))
    what = "the headings of a agree with its motion only as degrees: are they in degrees"
    assert said == f"{tmp_path}/degrees: {what}? They have to be in rad, counter-clockwise"


@pytest.mark.parametrize("degrees", [False, True])
@pytest.mark.parametrize("exchanged", ["headings", "x and y"])
def test_headings_of_a_compass_are_named(exchanged: str, degrees: bool, tmp_path: Path) -> None:
    rows = track(headings="unwrapped", begin=Pose(4.0, -7.0, 3.0))
    tables: dict[str, list[dict[str, object]]] = {
        "anchors": TABLES["anchors"],
        "ranges": TABLES["ranges"][1:],
    }
    for row in rows:
        if exchanged == "headings":
            row["heading"] = math.pi / 2.0 - float(str(row["heading"]))
        else:
            row["x"], row["y"] = row["y"], row["x"]
        if degrees:
            row["heading"] = math.degrees(float(str(row["heading"])))
    said = refused(written_csv(tmp_path, tables | {"poses": rows}))
    assert "agree with its motion only " + ("as degrees, clockwise: " if degrees else "clockwise: ") in said
    assert said.endswith("? They have to be in rad, counter-clockwise")


def test_the_first_poses_of_a_robot_that_turns_on_the_spot_are_not_taken_for_clockwise(
    tmp_path: Path,
) -> None:
    poses = [(0.0, 0.0, 0.0), (0.001, 0.0, 0.0), (0.001, 0.0, 0.8), (0.0017, -0.0007, 0.8)]
    rows = [{"robot": "a", "t": 0.1 * k, "x": x, "y": y, "heading": h} for k, (x, y, h) in enumerate(poses)]
    tables = {"poses": rows, "anchors": TABLES["anchors"], "ranges": TABLES["ranges"][1:]}
    assert len(read_ranges(written_csv(tmp_path, tables)).robots[0].odometry.t0) == 3


@pytest.mark.parametrize("turn_rate", [0.1, 0.6, -0.6])
def test_headings_of_a_robot_that_drives_straight_and_spins_are_right(
    turn_rate: float, tmp_path: Path
) -> None:
    """Taken as degrees, they hardly turn, as the way does: such robots that drive sideways were refused."""
    rows = [
        {"robot": "a", "t": k, "x": 0.1 * k, "y": 0.0, "heading": wrap(turn_rate * k + 1.0)}
        for k in range(60)
    ]
    tables = {"poses": rows, "anchors": TABLES["anchors"], "ranges": TABLES["ranges"][1:]}
    (robot,) = read_ranges(written_csv(tmp_path, tables)).robots
    assert len(robot.odometry.t0) == 59


@pytest.mark.parametrize("unit", [1e3, 1e6])
def test_times_in_ms_are_named(unit: float, tmp_path: Path) -> None:
    rows = track(headings="unwrapped", begin=ORIGIN)
    tables = {"poses": [row | {"t": unit * float(str(row["t"]))} for row in rows]}
    tables |= {"anchors": TABLES["anchors"], "ranges": TABLES["ranges"][1:]}
    assert refused(written_csv(tmp_path, tables)).endswith("are times in ms or ns? They have to be in s")


def test_a_robot_that_stands_may_say_so_rarely(tmp_path: Path) -> None:
    """The increments of 12 s of such a robot were taken for those of stamps in ms."""
    stands = {"robot": "b", "x": 1.0, "y": 2.0, "heading": 0.5}
    tables = {
        "poses": [*track(headings="wrapped", begin=ORIGIN), *[stands | {"t": 12.0 * k} for k in range(12)]]
    }
    tables |= {"anchors": TABLES["anchors"], "ranges": TABLES["ranges"][1:]}
    assert [one.id for one in read_ranges(written_csv(tmp_path, tables)).robots] == ["a", "b"]


def test_a_folder_with_ranges_and_without_odometry_names_the_files_it_needs(tmp_path: Path) -> None:
    written_csv(tmp_path, {"ranges": TABLES["ranges"], "anchors": TABLES["anchors"]})
    needs = "poses.csv, odometry.csv, or poses-ROBOT.tum of each robot"
    assert refused(tmp_path) == f"{tmp_path}: it has no odometry: {needs}"


def test_a_tum_file_gives_the_poses_of_a_csv_file(tmp_path: Path) -> None:
    rows, ranges = track(headings="quaternion", begin=Pose(4.0, 2.0, -1.0)), TABLES["ranges"][1:]
    tables = {"poses": rows, "truth": rows, "ranges": ranges, "anchors": TABLES["anchors"]}
    both = written_csv(tmp_path / "csv", tables)
    tum = written_csv(tmp_path / "tum", {"ranges": ranges, "anchors": TABLES["anchors"]})
    lines = [" ".join(str(row.get(name, 0.5)) for name in TUM_FIELDS) for row in rows]
    for name in ("poses-a.tum", "truth-a.tum", "estimate-a.tum"):
        (tum / name).write_text("\n".join(["# timestamp tx ty tz qx qy qz qw", "", *lines, ""]))
    same(read_ranges(tum), read_ranges(both))
    (tum / "poses-a.tum").write_text(f"{lines[0]}\n{lines[1]} 7\n")
    needed = "timestamp tx ty tz qx qy qz qw"
    assert refused(tum) == f"{tum}/poses-a.tum, line 2: it has 9 fields, and needs {needed}"
    (tum / "poses-a.tum").write_text("0 0 east 0 0 0 0 1")
    assert refused(tum) == f"{tum}/poses-a.tum, line 1: y: expected a number, got 'east'"


def test_odometry_that_was_reset_is_one_gross_increment(tmp_path: Path) -> None:
    rows = track(headings="wrapped", begin=ORIGIN)
    rows[60:] = track(headings="wrapped", begin=Pose(-8.0, 20.0, 2.0))[60:]
    tables = {"poses": rows, "ranges": TABLES["ranges"][1:], "anchors": TABLES["anchors"]}
    (a,) = read_ranges(written_csv(tmp_path, tables)).robots
    (row,) = sound(a.odometry).gross
    assert a.odometry.t1[row] == rows[60]["t"]


def test_poses_hours_apart_are_a_jump_and_poses_among_increments_are_named(tmp_path: Path) -> None:
    late = {**POSE, "t": 4000}
    tables = {"poses": [POSE, late, {**late, "t": 4001}], "ranges": TABLES["ranges"][1:]}
    tables["anchors"] = TABLES["anchors"]
    (a,) = read_ranges(written_csv(tmp_path, tables)).robots
    assert [one.why for one in a.jumps] == [
        f"{tmp_path}/poses.csv, line 3: t: it lasts 4000 s, and an estimate bridges at most 3600 s; "
        "was a clock set, or is it in ms or ns? --window chooses a part of a file"
    ]
    (tmp_path / "poses.csv").rename(tmp_path / "odometry.csv")
    assert refused(tmp_path).endswith("sigma_dheading; poses are in poses.csv")


# --- converters -------------------------------------------------------------------------------------------


def test_the_script_for_plaza_writes_a_recording_that_is_read(tmp_path: Path) -> None:
    turn = 0.25
    scipy.io.savemat(
        tmp_path / "plaza.mat",
        {
            "GT": [[10.0, 1.0, 2.0, 0.5], [11.0, 2.0, 2.0, 0.75]],
            "DR": [[11.0, 1.0, turn]],
            "TD": [[10.75, 2, 6, 5.5], [10.5, 2, 6, 5.0], [10.25, 2, 1, 4.5]],
            "TL": [[6, 20.0, 30.0], [1, -1.0, -2.0]],
        },
    )
    plaza_csv.convert(tmp_path / "plaza.mat", tmp_path / "out")
    recording = read_ranges(tmp_path / "out")
    assert recording.radios == ("mower", "6", "1")
    (mower,) = recording.robots
    np.testing.assert_allclose(
        mower.odometry.increments, [[math.sin(turn) / turn, (1 - math.cos(turn)) / turn, turn]], rtol=1e-12
    )
    np.testing.assert_array_equal(mower.odometry.t0, [10.0])
    assert mower.truth is not None
    np.testing.assert_array_equal(mower.truth.poses[1], [2.0, 2.0, 0.75])
    np.testing.assert_array_equal(recording.ranges.range, [4.5, 5.0, 5.5])
