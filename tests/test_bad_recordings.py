"""Range recordings that users have: invalid ones are one line with the place, others end within bounds."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.writer import Writer

import tandem
from compose.errors import LOCALISED, NOT_LOCALISED, USER_ERROR, BadRecording
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_mcap import rows_as_they_arrive
from compose.recording.ranging.range_recording import FixedAnchor
from tests.commands import tandem as command
from tests.mutated_recordings import End, csv_text, mcap_bytes, pyfg_text, recording, summary, trials
from tests.range_tables import POSE, TABLES, Tables, refused, written_csv, written_mcap
from tests.recording_mutations import Tables as Mutable
from tests.test_house import HOUSE
from tests.test_range_recordings import same as same_numbers


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
    assert refused(tmp_path / "uwb.csv").endswith(
        "/uwb.csv: name the folder that it is in, with ranges.csv and odometry.csv or poses.csv"
    )
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


CASES = Path(__file__).parent / "data" / "cases"
BOUND_CPU_S, BOUND_MB = 5.0, 500
CUT_OFF = "it is not a complete MCAP file"
REFUSED = {
    "clock-jump": "/odometry.csv, line 22: t0: it starts 1.7e+09 s after the end of the increment of r b",
    "damaged-mcap/crash-OverflowError.mcap": f": {CUT_OFF}: before byte 14707: a chunk of 17654110539292",
    "damaged-mcap/unknown.mcap": f": {CUT_OFF}: before byte 14707: a chunk is compressed with",
    "truncated-mcap/empty.mcap": f": {CUT_OFF}: it is empty\n",
    "truncated-mcap/half.mcap": f": {CUT_OFF}: it was cut off after byte 79",
    "joined-mcap/twice.mcap": ", /odometry, message 201: t0: it starts at 0 s, and the increment of r be",
    "estimate-tracebacks/no-odometry.pyfg": ": A has no odometry\n",
    "estimate-tracebacks/zero-size.pyfg": ", line 226: no errors have this covariance: it has a negative",
    "estimate-tracebacks/eigenvalues.pyfg": ", line 299: no errors have this covariance: it has a negati",
    "estimate-tracebacks/length.mcap": f": {CUT_OFF}: it was cut off after byte 5006",
    "estimate-unbounded/gap1e5.pyfg": ", line 27: t1: it lasts 99994.5 s, and an estimate bridges at mos",
    "estimate-unbounded/bomb.mcap": f": {CUT_OFF}: before byte 65636: a chunk of 2147483648 bytes",
    "estimate-unbounded/jump.mcap": f": {CUT_OFF}: it was cut off after byte 28232",
}
"""The line with which each recording is refused, after its path."""
JUMP = CASES / "clock-jump"
OTHERS: dict[str, tuple[str | Path, ...]] = {
    "before": ("estimate", JUMP, "--window", "0..2.05"),
    "after": ("estimate", JUMP, "--window", "1700000002.3..1700000010"),
    "calibrated": ("calibrate", JUMP),
    "followed": ("estimate", CASES / "estimate-unbounded" / "jump.mcap", "--follow", "--noise", "wheels"),
}


def test_recordings_that_users_have_end_in_one_line_within_bounds_or_with_an_estimate() -> None:
    """One process of its own starts all commands, so that what each takes can be told."""
    commands = {path: ("estimate", CASES / path) for path in REFUSED} | OTHERS
    words = [list(map(str, one)) for one in commands.values()]
    code = "import json, sys; from tests.mutated_recordings import ended, prepared; prepared()\n"
    code += "print(json.dumps([ended(words) for words in json.load(sys.stdin)]))"
    process = subprocess.run(
        [sys.executable, "-c", code],
        cwd=HOUSE,
        input=json.dumps(words),
        capture_output=True,
        text=True,
        check=True,
    )
    ends = {name: End(*one) for name, one in zip(commands, json.loads(process.stdout), strict=True)}
    for name, end in ends.items():
        assert end.cpu_s < BOUND_CPU_S, name
        assert end.mb < BOUND_MB, name
    for path, says in REFUSED.items():
        assert (ends[path].status, ends[path].out) == (USER_ERROR, ""), path
        assert ends[path].errors.startswith(f"tandem estimate: {CASES / path}{says}")
        assert ends[path].errors.count("\n") == 1
    statuses = {name: ends[name].status for name in OTHERS}
    assert statuses == {"before": NOT_LOCALISED, "after": LOCALISED, "calibrated": 0, "followed": USER_ERROR}
    assert (
        ", /odometry, message 61: t1: it lasts 100000 s, and an estimate bridges" in ends["followed"].errors
    )
    assert ends["followed"].out.count("\n") > 4  # the estimates before the jump


def written(folder: Path, tables: Mutable) -> Path:
    """Write `tables` as CSV files to `folder`, and return it."""
    folder.mkdir(exist_ok=True)
    for name, rows in tables.items():
        (folder / f"{name}.csv").write_text(csv_text(rows))
    return folder


@pytest.mark.parametrize("robots", [1, 2, 3])
def test_nothing_is_computed_in_a_gap_and_the_estimate_goes_on_after_it(robots: int, tmp_path: Path) -> None:
    """The ranges in the gap are counted, and its time costs no estimates."""
    tables, gap_s = recording(robots, random.Random(1)), 3000.0
    for rows in tables.values():
        for row in rows:
            for stamp in ("t", "t0", "t1"):
                if stamp in row and row[stamp] >= 5.0:
                    row[stamp] += gap_s
    late = [row for row in tables["ranges"] if row["t"] >= 5.0]
    tables["ranges"] += [{**row, "t": gap_s} for row in late[:3]]
    tables["odometry"] = [row for row in tables["odometry"] if row["t1"] - row["t0"] < 1.0]
    tables["ranges"].sort(key=lambda row: row["t"])
    found = tandem.estimate(written(tmp_path, tables))
    assert found.summary.unused_ranges["in a gap of the odometry"] == 3
    times = sorted(set(found.rows["t_s"].tolist()))
    assert times[-1] == gap_s + 10.0
    assert all(t <= 6.0 or t >= gap_s + 5.0 for t in times)
    assert len(times) <= 22


def test_the_number_of_estimates_is_bounded_by_that_of_the_measurements(tmp_path: Path) -> None:
    """Nineteen times the time for equal rows; an increment then lasts 9.5 s."""
    tables = recording(1, random.Random(1))
    for rows in tables.values():
        for row in rows:
            row.update({stamp: 19.0 * row[stamp] for stamp in ("t", "t0", "t1") if stamp in row})
    found = tandem.estimate(written(tmp_path, tables))
    assert len(found.rows["t_s"]) <= 3 * len(tables["odometry"])
    assert all(t % 9.5 in (0.0, 0.5, 1.0) for t in found.rows["t_s"])


def test_a_stream_that_begins_with_a_gap_is_estimated_after_it(tmp_path: Path) -> None:
    tables, gap_s = recording(1, random.Random(1)), 20.0
    for rows in tables.values():
        for row in rows:
            row.update({stamp: row[stamp] + gap_s for stamp in ("t", "t0", "t1") if row.get(stamp)})
    path = tmp_path / "it.mcap"
    path.write_bytes(mcap_bytes(tables, random.Random(1), stream=True))
    found = command("estimate", path, "--follow")
    assert "Traceback" not in found.err
    assert found.status in (LOCALISED, NOT_LOCALISED), found.err
    assert float(found.out.splitlines()[-1].partition(",")[0]) > gap_s


def test_numbers_are_read_as_c_and_spreadsheets_write_them(tmp_path: Path) -> None:
    plain, same = recording(2, random.Random(1)), recording(2, random.Random(1))
    for text, value in ((".5", 0.5), ("5.", 5.0), ("+3.2", 3.2), ("-.5", -0.5), ("05", 5.0), ("1.E-1", 0.1)):
        for name, rows in plain.items():
            for column in list(rows[-1]):
                if column not in ("robot", "anchor", "from", "to", "t", "t0", "t1"):
                    refused = column.startswith("sigma") or column == "range"
                    rows[-1][column] = repr(abs(value) if refused else value)
                    same[name][-1][column] = text.lstrip("-") if refused else text
        read = read_ranges(written(tmp_path / "plain", plain)), read_ranges(written(tmp_path / "it", same))
        same_numbers(*read)
        for stamp in ("t0", "t1"):
            same["odometry"][0][stamp] = {"t0": "-.5", "t1": ".5"}[stamp]
        assert read_ranges(written(tmp_path / "it", same)).robots[0].odometry.t0[0] == -0.5
        same["odometry"][0] |= {"t0": 0.0, "t1": 0.5}
        for path, tables in ((tmp_path / "plain.pyfg", plain), (tmp_path / "it.pyfg", same)):
            path.write_text(pyfg_text(tables))
        same_numbers(read_ranges(tmp_path / "plain.pyfg"), read_ranges(tmp_path / "it.pyfg"))
    anchors = tmp_path / "anchors.csv"
    anchors.write_text("anchor,x,y,height\nn1,.5,+5.,-.5\n")
    assert read_ranges(tmp_path / "plain", anchors).anchors[0] == FixedAnchor("n1", 0.5, 5.0, -0.5)


@pytest.mark.parametrize("stream", [False, True])
def test_mcap_files_after_each_other_are_read_as_one(stream: bool, tmp_path: Path) -> None:
    tables = recording(1, random.Random(1))
    halves: list[Mutable] = [
        {
            name: [row for row in rows if later == (float(row.get("t0", row.get("t", 0.0)) or 0.0) >= 5.0)]
            for name, rows in tables.items()
        }
        for later in (False, True)
    ]
    halves[1]["anchors"] = halves[0]["anchors"]  # each file has them
    data = b"".join([mcap_bytes(half, random.Random(1), stream=False) for half in halves])
    (tmp_path / "it.mcap").write_bytes(data)
    (tmp_path / "more.mcap").write_bytes(data + b"more")
    if stream:
        with (tmp_path / "it.mcap").open("rb") as file:
            assert len(list(rows_as_they_arrive(file, "it"))) == sum(map(len, tables.values())) + 3
        return
    same_numbers(read_ranges(tmp_path / "it.mcap"), read_ranges(written(tmp_path / "it", tables)))
    with pytest.raises(BadRecording, match=f"it was cut off after byte {len(data)}"):
        read_ranges(tmp_path / "more.mcap")
    halves[1]["anchors"] = [{**row, "x": 7.0} for row in halves[0]["anchors"]]
    (tmp_path / "moved.mcap").write_bytes(
        b"".join([mcap_bytes(half, random.Random(1), stream=False) for half in halves])
    )
    with pytest.raises(BadRecording, match=r"moved\.mcap, /anchors, message 4: there are two anchors n1"):
        read_ranges(tmp_path / "moved.mcap")


@pytest.mark.long
def test_mutated_recordings_end_with_a_status_and_one_line() -> None:
    found = list(trials(60, 0, jobs=1))
    assert not any(one.problem for one in found), "\n".join(summary(found))
    assert sum(one.accepted for one in found) >= 18  # of 60; the command requires half of all
