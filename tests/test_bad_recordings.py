"""An invalid range recording is refused in one line with its place, in every format."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.writer import Writer

from compose.errors import USER_ERROR, UserError
from compose.recording.ranging.range_files import read_ranges
from tests.range_tables import TABLES, Tables, written_csv, written_mcap


def refused(path: Path) -> str:
    """Return the one line with which `path` is refused."""
    with pytest.raises(UserError) as error:
        read_ranges(path)
    assert error.value.exit_status == USER_ERROR
    assert "\n" not in str(error.value)
    return str(error.value)


def changed(table: str, row: int, **fields: object) -> Tables:
    rows = [*TABLES[table]]
    rows[row] = {name: value for name, value in {**rows[row], **fields}.items() if value is not None}
    return {**TABLES, table: rows}


INVALID: list[tuple[str, int, dict[str, object], str]] = [
    ("odometry", 1, {"dx": "fast"}, "dx: expected a number, got 'fast'"),
    ("odometry", 1, {"dx": "nan"}, "dx: expected a number, got 'nan'"),
    ("odometry", 1, {"t0": "2e12"}, "t0: expected a number <= 1000000000000.0 (a time in s), got '2e12'"),
    ("odometry", 0, {"t1": -0.5}, "t1: -0.5 s is before t0, 0 s"),
    ("odometry", 2, {"t0": 0.25}, "t0: it starts at 0.25 s, and the increment of a before it ends at 0.5 s"),
    ("odometry", 1, {"robot": "b/c"}, "robot: expected a name of letters, digits, - and _, got 'b/c'"),
    ("odometry", 1, {"dx": None}, "missing required field 'dx'"),
    ("odometry", 1, {"sigma_dx": 0.1}, "it needs all of sigma_dx, sigma_dy, sigma_dheading, or none"),
    ("ranges", 1, {"range": -1.5}, "range: expected a number >= 0.0, got '-1.5'"),
    ("ranges", 1, {"sigma": 0}, "sigma: expected a number > 0.0, got '0'"),
    (
        "ranges",
        1,
        {"from": "M12"},
        "M12 is neither a robot with odometry nor a known anchor; robots: a, b; anchors: M1; "
        "did you mean 'M1'?",
    ),
    ("ranges", 1, {"to": "M1"}, "it is a range from M1 to itself"),
    ("ranges", 1, {"from": "b"}, "t: it is of 0.2 s, and the range between b and a before it is of 0.3 s"),
    ("antennas", 0, {"robot": "c"}, "robot: c has no odometry"),
    ("truth", 2, {"t": -1}, "t: it is of -1 s, and the true pose before it is of 0 s"),
]


@pytest.mark.parametrize(("table", "row", "fields", "says"), INVALID)
def test_an_invalid_row_is_one_line_with_its_place(
    table: str, row: int, fields: dict[str, object], says: str, tmp_path: Path
) -> None:
    tables = changed(table, row, **fields)
    said = refused(written_csv(tmp_path / "csv", tables))
    assert said == f"{tmp_path}/csv/{table}.csv, line {row + 2}: {says}"
    if "number" not in says and "name of" not in says:  # numbers are numbers in JSON
        said = refused(written_mcap(tmp_path / "one.mcap", tables))
        assert said == f"{tmp_path}/one.mcap, /{table}, message {row + 1}: {says}"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", ": there is no odometry"),
        ("VERTEX_SE3:QUAT 0 A0 0 0 0 0 0 0 1", ", line 1: unknown kind of line 'VERTEX_SE3:QUAT'; only two-"),
        ("\nEDGE_SE 1", ", line 2: unknown kind of line 'EDGE_SE'"),
        ("VERTEX_SE2 0 A0 0 0", ", line 1: VERTEX_SE2 has 4 fields and needs 5"),
        ("VERTEX_SE2 0 A 0 0 0", ", line 1: 'A' is not the name of a pose, such as A17"),
        ("VERTEX_SE2 0 L0 0 0 0", ", line 1: 'L0' is not the name of a pose, such as A17"),
        ("VERTEX_SE2 x A0 0 0 0", ", line 1: t: expected a number, got 'x'"),
        ("VERTEX_SE2 0 A0 0 0 0\nVERTEX_SE2 1 A0 0 0 0", ", line 2: there are two poses A0"),
        (
            "VERTEX_SE2 1 A0 0 0 0\nVERTEX_SE2 0 A1 0 0 0",
            ", line 2: t: it is of 0 s, and the true pose before",
        ),
        ("EDGE_SE2 1 A0 A1 0 0 0 1 0 0 1 0 1", ", line 1: the time of A0 is unknown: it has no VERTEX_SE2"),
        ("EDGE_SE2 1 A0 A1 0 0 0 1 0 0 -1 0 1", ", line 1: cov_yy: the variance -1 is negative"),
        ("EDGE_SE2 1 A0 A1 0 0 0 1 nan 0 1 0 1", ", line 1: cov_xy: 'nan' is not a number"),
        (
            "VERTEX_SE2 0 A0 0 0 0\nEDGE_RANGE 0 A0 B0 1 1",
            ", line 2: B is neither a robot with odometry nor a known anchor; robots: A; "
            "anchors: none; --anchors FILE adds some, without x and y if unknown",
        ),
        ("VERTEX_SE2 0 A0 0 0 0\nEDGE_RANGE 0 A0 L0 1 0", ", line 2: variance: 0 is not positive"),
        (
            "VERTEX_SE2 0 A0 0 0 0\nEDGE_SE2 2 A0 A1 0 0 0 1 0 0 1 0 1\nEDGE_SE2 1 A1 A2 0 0 0 1 0 0 1 0 1",
            ", line 3: t: it is of 1 s, and the edge before it is of 2 s",
        ),
        ("VERTEX_XY L0 0 0\nVERTEX_XY L0 1 1", ", line 2: there are two anchors L0"),
    ],
)
def test_an_invalid_graph_is_one_line_with_its_place(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "one.pyfg"
    path.write_text(text)
    assert refused(path).startswith(f"{path}{says}")


@pytest.mark.parametrize(
    ("head", "says"),
    [
        (
            "t,from,to,rnage",
            "unknown column 'rnage'; there may be t, from, to, range, sigma; the column range is missing; "
            "did you mean 'range'?",
        ),
        (
            "timestamp,Tag,anchor_id,distance",
            "unknown columns 'timestamp', 'Tag', 'anchor_id', 'distance'; "
            "there may be t, from, to, range, sigma; the columns t, from, to, range are missing; "
            "rename timestamp to t, Tag to from, anchor_id to to, distance to range",
        ),
        ("t,from,to", "the column range is missing"),
        ("t,t,from,to,range", "there are two columns t"),
        ("", "the columns t, from, to, range are missing"),
    ],
)
def test_a_wrong_head_of_a_table_is_refused(head: str, says: str, tmp_path: Path) -> None:
    written_csv(tmp_path, TABLES)
    (tmp_path / "ranges.csv").write_text(f"{head}\n")
    assert refused(tmp_path) == f"{tmp_path}/ranges.csv, line 1: {says}"


def test_radios_that_measured_nothing_are_named(tmp_path: Path) -> None:
    rows = [{"t": 0.1 * k, "from": "a", "to": "M1", "range": 0.0} for k in range(8)]
    written_csv(tmp_path, {**TABLES, "ranges": rows})
    assert refused(tmp_path) == f"{tmp_path}: all 8 ranges of a and M1 are 0 m: nothing was measured"
    written_csv(tmp_path / "one", {**TABLES, "ranges": [*rows[:7], {**rows[7], "range": 1.0}]})
    assert read_ranges(tmp_path / "one").ranges.range.max() == 1.0


def test_what_is_no_recording_is_refused_with_the_formats(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    formats = (
        "it is not a .pyfg file, an .mcap file, a folder with ranges.csv and odometry.csv or poses.csv, a "
    )
    assert refused(tmp_path / "notes.txt").startswith(f"{tmp_path}/notes.txt: {formats}")
    assert refused(tmp_path).startswith(f"{tmp_path}: {formats}")
    (tmp_path / "uwb.csv").write_text("t,from,to,range\n")
    assert refused(tmp_path).endswith(", or a recording of Tandem; it has uwb.csv")
    assert (
        refused(tmp_path / "none.pyfg") == f"{tmp_path}/none.pyfg cannot be read: No such file or directory"
    )
    (tmp_path / "odometry.csv").write_text("robot,t0,t1,dx,dy,dheading\na,0,1,1,0\n")
    assert refused(tmp_path) == f"{tmp_path}/odometry.csv, line 2: it has 5 fields, and the first line 6"
    (tmp_path / "odometry.csv").write_bytes(b"\xff\xfe")
    assert refused(tmp_path) == f"{tmp_path}/odometry.csv: it is not UTF-8 text"
    (tmp_path / "odometry.csv").write_text("robot,t0,t1,dx,dy,dheading\na,0,1,1,0,0\n")
    assert refused(tmp_path) == f"{tmp_path}/ranges.csv cannot be read: No such file or directory"
    (tmp_path / "Ranges.csv").write_text("t,from,to,range\n")
    assert refused(tmp_path) == f"{tmp_path}/Ranges.csv: the name of a table is in lower case: ranges.csv"


def test_a_damaged_mcap_file_is_refused(tmp_path: Path) -> None:
    path = written_mcap(tmp_path / "one.mcap", TABLES)
    whole = path.read_bytes()
    for content in (b"", b"not at all", whole[: len(whole) // 2], whole[:200] + b"\x00" * 40 + whole[240:]):
        path.write_bytes(content)
        assert refused(path).startswith(f"{path}: it is not a complete MCAP file")
    written_mcap(path, TABLES, encoding="cbor")
    assert refused(path) == f"{path}: /odometry is encoded as 'cbor', not as 'json'"


def test_mcap_files_after_each_other_may_expand_by_no_more_than_one_file(tmp_path: Path) -> None:
    path = tmp_path / "many.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 23)
        writer.start()
        writer.add_message(writer.register_channel("/other", "json", 0), 0, bytes(4_000_000), 0)
        writer.finish()  # type: ignore[no-untyped-call]  # of mcap
    path.write_bytes(3 * path.read_bytes())
    assert "a chunk of 4000066 bytes, and at most " in refused(path)


def test_names_of_robots_and_anchors_do_not_overlap(tmp_path: Path) -> None:
    tables = {**TABLES, "anchors": [{"anchor": "a", "x": 0, "y": 0}], "ranges": TABLES["ranges"][:1]}
    assert refused(written_csv(tmp_path, tables)) == f"{tmp_path}: a is a robot and an anchor"
    tables = {**TABLES, "anchors": [*TABLES["anchors"], {"anchor": "M2", "x": 0, "y": 0}]}
    tables["ranges"] = [{"t": 0, "from": "M1", "to": "M2", "range": 1}]
    said = refused(written_csv(tmp_path, tables))
    assert said == f"{tmp_path}/ranges.csv, line 2: M1 and M2 are both anchors"


def test_columns_that_semicolons_separate_are_named(tmp_path: Path) -> None:
    folder = written_csv(tmp_path, TABLES)
    (folder / "ranges.csv").write_text("t;from;to;range\n0;a;M1;2.5\n")
    assert refused(folder).endswith("there may be t, from, to, range, sigma; commas separate columns")


POSE: dict[str, object] = {"robot": "a", "t": 0, "x": 1, "y": 2, "heading": 3}


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ({"t": -1}, "t: it is of -1 s, and the pose of a before it is of 0 s"),
        ({"heading": None}, "it needs heading, or all of qx, qy, qz, qw"),
        ({"qw": 1}, "it needs heading, or all of qx, qy, qz, qw"),
        ({"heading": None, "qx": 0, "qy": 0, "qz": 0}, "it needs heading, or all of qx, qy, qz, qw"),
        (
            {"heading": None, "qx": 0, "qy": 0, "qz": 0, "qw": 0},
            "qx, qy, qz, qw: an orientation with a norm of 0, expected 1",
        ),
        (
            {"heading": None, "qx": 1, "qy": 0, "qz": 0, "qw": 0},
            "qx, qy, qz, qw: an orientation tilted by 180 degrees, expected a robot in the plane, z up",
        ),
        ({"robot": "b"}, "robot: b has increments of odometry, too"),
    ],
)
def test_an_invalid_pose_is_one_line_with_its_place(
    row: dict[str, object], says: str, tmp_path: Path
) -> None:
    poses = [POSE, {name: value for name, value in {**POSE, **row}.items() if value is not None}]
    tables = {"odometry": TABLES["odometry"][1:2], "poses": poses, "ranges": TABLES["ranges"]}
    assert refused(written_csv(tmp_path, tables)) == f"{tmp_path}/poses.csv, line 3: {says}"
    assert (
        refused(written_mcap(tmp_path / "a.mcap", tables)) == f"{tmp_path}/a.mcap, /poses, message 2: {says}"
    )
