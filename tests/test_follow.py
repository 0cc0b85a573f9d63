"""A stream is estimated while it arrives, by the code that estimates files."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from mcap.writer import Writer
from msgspec.structs import asdict, replace

from agent.estimation.following import ClaimRule
from compose.errors import BROKEN_PIPE, STOPPED_STATUS, USER_ERROR, UserError
from compose.recording.estimating import estimate_run
from compose.recording.estimating.estimate_rows import PoseEstimateRow, estimate_csv
from compose.recording.estimating.estimate_run import StreamEstimate, estimated
from compose.recording.estimating.noise_files import told_noise
from compose.recording.estimating.recorded_measurements import measurements
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_mcap import rows_as_they_arrive
from compose.recording.ranging.range_recording import LONG_GAP_S, RangeRecording
from compose.recording.ranging.recording_rows import (
    AnchorRow,
    AntennaRow,
    AnyRow,
    OdometryRow,
    RangeRow,
    SourcePlace,
)
from protocol.motion import Pose, compose
from tests.commands import tandem
from tests.range_tables import SAMPLE, circling
from tests.test_house import HOUSE

PROFILE = "uwb-calibrated"
Messages = list[tuple[float, str, dict[str, object]]]
BOUND_S = 120.0


def messages_of(recording: RangeRecording) -> Messages:
    """Return time, topic and content of each message of a stream, anchors first, then by time."""
    found: Messages = [
        (-1.0, "/anchors", {"anchor": one.id, "x": one.x, "y": one.y}) for one in recording.anchors
    ]
    for robot in recording.robots:
        odometry = robot.odometry
        for t0, t1, (dx, dy, turn), covariance in zip(
            odometry.t0.tolist(),
            odometry.t1.tolist(),
            odometry.increments.tolist(),
            odometry.covariance.tolist(),
            strict=True,
        ):
            row = {"robot": robot.id, "t0": t0, "t1": t1, "dx": dx, "dy": dy, "dheading": turn}
            names = ("sigma_dx", "sigma_dy", "sigma_dheading")
            sigmas = {name: covariance[i][i] ** 0.5 for i, name in enumerate(names)}
            found.append((t1, "/odometry", row | sigmas))
        assert robot.truth is not None
        for t, (x, y, heading) in zip(robot.truth.t.tolist(), robot.truth.poses.tolist(), strict=True):
            found.append((t, "/truth", {"robot": robot.id, "t": t, "x": x, "y": y, "heading": heading}))
    radios, ranges = recording.radios, recording.ranges
    for t, first, second, measured, sigma in zip(*[part.tolist() for part in ranges], strict=True):
        row = {"t": t, "from": radios[first], "to": radios[second], "range": measured, "sigma": sigma}
        found.append((t, "/ranges", row))
    return sorted(found, key=lambda one: (one[0], one[1] != "/ranges"))


def stream(messages: Messages) -> tuple[io.BytesIO, Writer, dict[str, int]]:
    """Return a stream that has begun, its writer and the numbers of its topics."""
    target = io.BytesIO()
    writer = Writer(target, use_chunking=False)
    writer.start()
    topics = {
        topic: writer.register_channel(topic, "json", 0)
        for topic in dict.fromkeys(one[1] for one in messages)
    }
    return target, writer, topics


def written(messages: Messages, *, whole: bool = True) -> bytes:
    target, writer, topics = stream(messages)
    for t, topic, content in messages:
        time_ns = round(max(t, 0.0) * 1e9)
        writer.add_message(topics[topic], time_ns, json.dumps(content).encode(), time_ns)
    if whole:
        writer.finish()  # type: ignore[no-untyped-call]
    return target.getvalue()


@pytest.fixture(scope="module")
def messages() -> Messages:
    return messages_of(read_ranges(SAMPLE))


@pytest.mark.long
def test_a_stream_gives_what_its_file_gives(messages: Messages) -> None:
    recording = read_ranges(SAMPLE)
    followed = StreamEstimate("it", ("A", "B"), told_noise(PROFILE), ClaimRule())
    rows = list(followed.rows(rows_as_they_arrive(io.BytesIO(written(messages)), "it")))
    problem = measurements(recording, None, PROFILE, None)
    measured = problem
    assert measured.ticks_per_epoch != estimate_run.STREAM_TICKS
    _, result = followed.result()
    claims = {name: one.first_claim for name, one in result.summary.robots.items()}
    assert all(one is not None and one.nees is not None and one.nees < 16.27 for one in claims.values())
    of_file = estimated(problem, ClaimRule()).rows
    for row, other in zip(rows, of_file, strict=True):
        assert row.robot == other.robot
        assert row.t_s == pytest.approx(other.t_s)
        if row.claim and other.claim:
            assert abs(row.x - other.x) < 0.05
            assert abs(row.y - other.y) < 0.05


def test_a_long_stream_is_estimated_from_its_last_part(
    messages: Messages, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimate_run, "MOST_S", 24.0)
    monkeypatch.setattr(estimate_run, "KEPT_S", 20.0)
    followed = StreamEstimate("it", ("A", "B"), told_noise(PROFILE), ClaimRule())
    rows = list(followed.rows(rows_as_they_arrive(io.BytesIO(written(messages)), "it")))
    measured, result = followed.result()
    whole = measurements(read_ranges(SAMPLE), None, PROFILE, None, ticks=estimate_run.STREAM_TICKS)
    assert result.summary.begin_s == pytest.approx(whole.t0)
    assert measured.t0 > whole.t0 + 3.0
    assert len(measured.path("A").v) * measured.joint.period <= estimate_run.MOST_S
    later = [row for row in rows if row.t_s > whole.t0 + 24.5]
    assert later
    assert all(row.claim for row in later)
    begin = measured.t0 - min(one.odometry.t0[0] for one in read_ranges(SAMPLE).robots)
    part = measurements(read_ranges(SAMPLE), None, PROFILE, (begin, 60.0), ticks=estimate_run.STREAM_TICKS)
    of_part = estimated(part, ClaimRule()).rows
    for row in later:
        other = min(
            [one for one in of_part if one.robot == row.robot], key=lambda one: abs(one.t_s - row.t_s)
        )
        assert other.t_s == pytest.approx(row.t_s, abs=0.06)
        assert (row.x, row.y) == pytest.approx((other.x, other.y), abs=0.05)


def test_nothing_of_a_stream_is_forgotten_while_a_robot_stands(
    messages: Messages, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimate_run, "MOST_S", 10.0)
    monkeypatch.setattr(estimate_run, "KEPT_S", 4.0)
    still = [
        (t, topic, {**row, "dx": 0.0, "dy": 0.0, "dheading": 0.0} if topic == "/odometry" else row)
        for t, topic, row in messages
        if t <= 14.0
    ]
    followed = StreamEstimate("it", ("A", "B"), told_noise(PROFILE), ClaimRule())
    for _ in followed.rows(rows_as_they_arrive(io.BytesIO(written(still)), "it")):
        pass
    measured, result = followed.result()
    assert measured.t0 == result.summary.begin_s


def test_a_robot_that_joins_a_stream_begins_the_estimate_again(messages: Messages) -> None:
    late = [
        one
        for one in messages
        if one[0] <= 9.3 and (one[1] == "/anchors" or one[0] > 6.2 or "A" not in one[2].values())
    ]
    for end in (7.0, 9.3):  # in the first, both have moved for a shorter time than one alone
        estimate = StreamEstimate("it", None, told_noise(PROFILE), ClaimRule())
        data = written([one for one in late if one[0] <= end])
        list(estimate.rows(rows_as_they_arrive(io.BytesIO(data), "it")))
        _, result = estimate.result()
        assert set(result.summary.robots) == {"A", "B"}
        times = [one.t for one in result.epochs]
        assert times == sorted(set(times))
        assert len(result.epochs[-1].claims) == 2
        assert times[-1] > end - 0.6


@pytest.mark.parametrize("first_end", [3.0, LONG_GAP_S + 12.0])
def test_a_robot_that_is_known_before_its_odometry_joins_a_stream(first_end: float) -> None:
    tables = circling(first_end + 2.0)
    rows: list[tuple[float, AnyRow]] = [(0.0, AntennaRow("late", 0.0, 0.0, 0.0))]
    rows += [(0.0, AnchorRow(**one)) for one in tables["anchors"]]  # type: ignore[arg-type]
    for name in ("r", "late"):
        for one in tables["ranges"]:
            row = RangeRow(float(str(one["t"])), name, str(one["to"]), float(str(one["range"])), 0.05)
            rows.append((row.t, row))
    for one in tables["odometry"]:
        increment = OdometryRow(**one)  # type: ignore[arg-type]
        rows.append((increment.t1, increment))
        if increment.t0 >= first_end:
            rows.append((increment.t1, replace(increment, robot="late")))
    rows.append((first_end, OdometryRow("late", first_end - 3.0, first_end, 0.5, 0.0, 0.75)))
    rows.sort(key=lambda one: (one[0], isinstance(one[1], OdometryRow)))
    told: list[str] = []
    estimate = StreamEstimate("it", None, told_noise(PROFILE), ClaimRule(), told.append)
    arriving = ((row, SourcePlace("it", i)) for i, (_, row) in enumerate(rows))
    assert {row.robot for row in estimate.rows(arriving) if row.t_s > first_end} == {"r", "late"}
    awaited = [one for one in told if "has no odometry" in one]
    assert awaited == ["it, line 0: robot: late has no odometry"] * (first_end > LONG_GAP_S)


def test_a_stream_tells_what_is_missing_for_an_estimate(messages: Messages) -> None:
    def told(some: Messages, robots: tuple[str, ...] | None = None) -> list[str]:
        said: list[str] = []
        estimate = StreamEstimate("it", robots, told_noise(PROFILE), ClaimRule(), said.append)
        list(estimate.rows(rows_as_they_arrive(io.BytesIO(written(some)), "it")))
        with suppress(UserError):
            estimate.result()
            return said
        with pytest.raises(UserError) as ended:
            estimate.result()
        return [*said, str(ended.value)]

    def without(topic: str, of: str = "robot") -> Messages:
        return [one for one in messages if not (one[1] == topic and of in one[2] and one[0] > 6.0)]

    end = max(t for t, topic, row in messages if topic == "/odometry" and t <= 6.0 and row["robot"] == "B")
    late = [one for one in messages if one[2].get("robot") != "B" or one[0] <= 6.0]
    assert told(late) == [f"it: there is no odometry of B after {end:.15g} s. Nothing is estimated."]
    assert told(messages, ("A", "C"))[-1] == "it: there is no odometry of C"
    nobody = "it: two robots need ranges to two anchors at different places"
    lacking = told([one for one in messages if one[1] != "/ranges"])
    assert [one.startswith(nobody) for one in lacking] == [True, True]
    unknown = told([one for one in messages if one[1] != "/anchors"])
    strange = [one for one in unknown if not one.startswith(nobody)]
    assert (len(strange), len(unknown)) == (2, 4)
    assert all("is neither a robot with odometry nor a known anchor" in one for one in strange)


def test_a_pause_of_a_stream_is_no_part_of_what_is_kept(
    messages: Messages, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimate_run, "MOST_S", 24.0)
    monkeypatch.setattr(estimate_run, "KEPT_S", 20.0)
    stamps = ("t", "t0", "t1")
    paused = [
        (t, topic, {name: x + 30.0 * (t > 20.0) if name in stamps else x for name, x in row.items()})  # type: ignore[operator]
        for t, topic, row in messages
    ]

    told: list[str] = []
    estimate = StreamEstimate("it", None, told_noise(PROFILE), ClaimRule(), told.append)
    rows = list(estimate.rows(rows_as_they_arrive(io.BytesIO(written(paused)), "it")))
    assert estimate.result()[0].t0 < 20.0
    assert [one.claim for one in rows[-2:]] == [True, True]
    assert told == []


def test_poses_in_a_stream_are_its_odometry(messages: Messages) -> None:
    at: dict[object, Pose] = {}
    early = [one for one in messages if one[0] <= 6.0]
    poses: Messages = []
    for t, topic, row in early:
        match topic, row:
            case "/odometry", {"robot": str(robot), "t0": float(t0), "dx": dx, "dy": dy, "dheading": turn}:
                begin = at.get(robot) or Pose(7.0, -3.0, 2.0)
                at[robot] = end = compose(begin, Pose(dx, dy, turn))  # type: ignore[arg-type]
                for stamp, pose in ((t0, begin), (t, end)):
                    poses.append((t, "/poses", {"robot": robot, "t": stamp, **asdict(pose)}))
            case _:
                poses.append((t, topic, row))

    def times(some: Messages) -> list[tuple[float, str]]:
        estimate = StreamEstimate("it", None, told_noise(PROFILE), ClaimRule())
        rows = estimate.rows(rows_as_they_arrive(io.BytesIO(written(some)), "it"))
        return [(row.t_s, row.robot) for row in rows]

    assert times(poses) == times(early) != []


@pytest.mark.long
def test_a_stream_that_breaks_off_gives_the_estimates_before_that(messages: Messages) -> None:
    def rows(data: bytes) -> str:
        estimate = StreamEstimate("it", None, told_noise(PROFILE), ClaimRule())
        return estimate_csv(list(estimate.rows(rows_as_they_arrive(io.BytesIO(data), "it"))))

    early = [one for one in messages if one[0] <= 12.4]
    whole = rows(written(early))
    assert whole.count("\n") > 10
    assert rows(written(early, whole=False)) == whole
    assert rows(written(early, whole=False)[:-20]) == whole


def following(folder: Path) -> subprocess.Popen[bytes]:
    """Return a process in `folder` that estimates the stream on its standard input, and writes to `found`."""
    words = ["-m", "tandem", "estimate", "-", "--follow", "--noise", PROFILE, "--out", "found"]
    return subprocess.Popen(
        [sys.executable, *words],
        cwd=folder,
        env={"PYTHONPATH": str(HOUSE), "PATH": "/usr/bin:/bin"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


@pytest.mark.long
def test_estimates_are_printed_while_the_stream_is_open(messages: Messages, tmp_path: Path) -> None:
    early = [one for one in messages if one[0] <= 12.0]
    with following(tmp_path) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        first = written(early, whole=False)
        process.stdin.write(first)
        process.stdin.flush()
        assert process.stdout.readline().decode().strip() == ",".join(PoseEstimateRow.__struct_fields__)
        lines = [process.stdout.readline().decode().split(",") for _ in range(10)]
        assert {line[1] for line in lines} == {"A", "B"}
        assert process.poll() is None
        process.stdin.write(written(messages)[len(first) :])
        rest, errors = process.communicate(timeout=BOUND_S)
    assert process.returncode == 0, errors
    assert rest.decode().count(",true,") > 10
    assert (tmp_path / "found" / "estimate.json").exists()


@pytest.mark.long
@pytest.mark.parametrize("how", [STOPPED_STATUS, BROKEN_PIPE])
def test_a_stream_is_ended_by_ctrl_c_and_by_the_end_of_its_reader_and_the_files_are_written(
    how: int, messages: Messages, tmp_path: Path
) -> None:
    with following(tmp_path) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        first = written([one for one in messages if one[0] <= 9.0], whole=False)
        process.stdin.write(first)
        process.stdin.flush()
        for _ in range(3):
            process.stdout.readline()
        if how == STOPPED_STATUS:
            process.send_signal(signal.SIGINT)
        else:
            process.stdout.close()
            with suppress(BrokenPipeError):  # it may have ended already
                process.stdin.write(written(messages)[len(first) :])
                process.stdin.close()
        assert process.wait(BOUND_S) == how
        assert process.stderr is not None
        errors = process.stderr.read().decode()
    assert "Traceback" not in errors, errors
    assert (tmp_path / "found" / "estimate.json").exists()


def test_the_estimates_before_a_wrong_row_of_a_stream_are_written(tmp_path: Path) -> None:
    tables = circling(3.0)
    rows = [(-1.0, "/anchors", row) for row in tables["anchors"]]
    rows += sorted(
        [
            (float(str(row[stamp])), f"/{name}", row)
            for name, stamp in (("ranges", "t"), ("odometry", "t1"))
            for row in tables[name]
        ],
        key=lambda one: (one[0], one[1] != "/ranges"),
    )
    (tmp_path / "back.mcap").write_bytes(written([*rows, rows[10]]))
    ended = tandem("estimate", "back.mcap", "--follow", "--out", "found", cwd=tmp_path)
    assert (ended.status, ended.err.count("\n")) == (USER_ERROR, 1)
    assert ended.err.endswith("; the estimates before that are in found\n")
    assert ended.out.count("\n") > 2
    assert (tmp_path / "found" / "estimate.csv").read_text() == ended.out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("bad.mcap", "--follow"), "bad.mcap, /ranges, message 1: range: expected a number, got 'str'"),
        (
            ("bad.txt", "--follow"),
            "bad.txt: it is not a complete MCAP file: no MCAP begins or ends before byte 8",
        ),
        (("empty.mcap", "--follow", "--out", "bad.txt"), "bad.txt cannot be written: File exists"),
        (("empty.mcap", "--follow"), "empty.mcap: there is no second with odometry of all robots"),
        (("no.mcap", "--follow"), "no.mcap cannot be read: No such file or directory"),
        (
            ("bad.mcap", "--follow", "--window", "1..2"),
            "--follow: a stream has its own anchors, and no window",
        ),
        (("-",), "-: standard input is read with --follow only"),
        (("bad.mcap", "--follow", "--relative", "A"), "--relative: with --follow, --robots has to name"),
    ],
)
def test_a_wrong_stream_is_one_line(words: tuple[str, ...], says: str, tmp_path: Path) -> None:
    wrong: Messages = [(0.0, "/ranges", {"t": 0.0, "from": "A", "to": "B", "range": "x"})]
    (tmp_path / "bad.mcap").write_bytes(written(wrong))
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "bad.txt").write_text("this is no MCAP")
    ended = tandem("estimate", *words, cwd=tmp_path)
    assert ended.status == USER_ERROR
    assert ended.err.count("\n") == 1
    assert says in ended.err
    assert ended.out == "", "no heading"


def test_a_closed_standard_input_is_an_empty_stream() -> None:
    command = f"exec '{sys.executable}' -m tandem estimate - --follow <&-"
    ended = subprocess.run(
        ["/bin/sh", "-c", command], cwd=HOUSE, capture_output=True, text=True, timeout=BOUND_S, check=False
    )
    empty = "tandem estimate: standard input: there is no second with odometry of all robots\n"
    assert (ended.returncode, ended.stderr) == (USER_ERROR, empty)
