"""Recordings that users have: each ends as it should, within 5 s and 500 MB, and says why in one line."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from pathlib import Path

import pytest

import tandem
from compose.errors import LOCALISED, NOT_LOCALISED, USER_ERROR, BadRecording
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_mcap import rows_as_they_arrive
from compose.recording.ranging.range_recording import FixedAnchor
from tests.commands import tandem as command
from tests.mutated_recordings import (
    End,
    csv_text,
    mcap_bytes,
    pyfg_text,
    recording,
    summary,
    trials,
)
from tests.recording_mutations import Tables
from tests.test_house import HOUSE
from tests.test_range_recordings import same as same_numbers

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


def written(folder: Path, tables: Tables) -> Path:
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
    halves: list[Tables] = [
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
