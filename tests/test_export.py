"""The exports of a recording can be read by other tools: run.mcap by MCAP readers, tables by pandas."""

from __future__ import annotations

import csv
import functools
import io
import itertools
import json
import math
import random
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from signal import Signals
from typing import Any

import msgpack
import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from compose.cli import export as export_command
from compose.cli import run
from compose.cli.main import parse
from compose.launch import in_process
from compose.recording.recording_files import WORLD_JOURNAL, agent_journal
from compose.recording.run import read
from compose.scenario.scenario_file import load
from compose.view.drawing import LEAST_OPACITY
from compose.view.export.folder import export
from protocol.journal import journal_file
from protocol.messages import Estimate, Observation
from protocol.motion import wrap
from protocol.wire import decode
from tests.commands import BOUND_S, TandemProcess, copied, tandem
from tests.replays import exported_frames, killed
from tests.series import series
from world.referee import errors
from world.scenario import Scenario

FILES = ["frames.csv", "run.foxglove.json", "run.mcap", "ticks.csv", "ticks.parquet"]
A, B = agent_journal("a"), agent_journal("b")


def exported(scenario: Scenario, folder: Path) -> Path:
    """Return the folder of the recording and exports of a run of `scenario`."""
    in_process.run_mission(scenario, folder)
    export(read(folder), folder)
    return folder


@pytest.fixture(scope="module")
def paper_1(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(load("paper-1"), tmp_path_factory.mktemp("paper-1"))


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run whose hypotheses have probabilities and covariances."""
    return exported(load("noisy"), tmp_path_factory.mktemp("noisy"))


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run in which Reports are lost and delayed."""
    return exported(load("random", faults=["loss=0.3, delay=0..2"]), tmp_path_factory.mktemp("faulty"))


def told(path: Path) -> Iterator[tuple[Any, Any, Any]]:
    """Yield the schema, channel and content of each message, in the order of the file."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        yield from reader.iter_messages(log_time_order=False)


def seen(path: Path, topic: str) -> list[Any]:
    """Return the messages on a topic."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [one.decoded_message for one in reader.iter_decoded_messages(topics=[topic])]


def rows_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(path.read_text())))


# --- run.mcap -------------------------------------------------------------------------------------------


def test_every_viewers_channel_decodes_with_its_own_schema(faulty: Path) -> None:
    with (faulty / "run.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        topics = {
            channel.topic
            for _, channel, _ in told(faulty / "run.mcap")
            if channel.message_encoding == "protobuf"
        }
        decoded = Counter(
            (
                one.channel.topic,
                one.schema and one.schema.name,
                type(one.decoded_message).DESCRIPTOR.full_name,
            )
            for one in reader.iter_decoded_messages(topics=list(topics))
        )
    assert {topic for topic, _, _ in decoded} == topics
    assert all(schema == kind for _, schema, kind in decoded)
    ticks = len(read(faulty).ticks)
    assert decoded["/a/pose", "foxglove.PoseInFrame", "foxglove.PoseInFrame"] == ticks
    assert {name for _, name, _ in decoded} == {
        f"foxglove.{kind}"
        for kind in ("FrameTransforms", "Log", "PoseInFrame", "PosesInFrame", "SceneUpdate")
    }


def test_times_are_those_of_the_simulation_in_order(faulty: Path) -> None:
    period = read(faulty).scenario.mission.period
    times = [(message.log_time, message.publish_time) for _, _, message in told(faulty / "run.mcap")]
    assert times == sorted(times)
    for logged, published in times:
        assert logged == published == round(round(logged / 1e9 / period) * period * 1e9)


def test_viewers_see_robots_where_they_were_and_their_trails(paper_1: Path) -> None:
    recording = read(paper_1)
    poses, trails = seen(paper_1 / "run.mcap", "/b/pose"), seen(paper_1 / "run.mcap", "/b/trail")
    transforms = seen(paper_1 / "run.mcap", "/tf")
    assert len(poses) == len(trails) == len(transforms) == len(recording.ticks)
    for moment, pose, trail, tf in zip(recording.ticks, poses, trails, transforms, strict=True):
        truth = moment.truth.poses[1]
        assert (pose.frame_id, pose.pose.position.x, pose.pose.position.y) == ("world", truth.x, truth.y)
        turn = pose.pose.orientation
        assert wrap(2.0 * math.atan2(turn.z, turn.w) - truth.heading) == pytest.approx(0.0, abs=1e-9)
        assert str(trail.poses[-1]) == str(pose.pose)
        assert len(trail.poses) == moment.truth.tick + 1
        frames = {one.child_frame_id: one for one in tf.transforms}
        assert set(frames) == {"a", "b", "a/anchor", "b/anchor"}
        assert (frames["b"].translation.x, frames["b"].rotation.z) == (truth.x, pose.pose.orientation.z)
        assert (frames["b/anchor"].translation.x, frames["b/anchor"].translation.y) == (10.0, 0.0)


def test_viewers_see_anchors_with_their_ranges_and_contact_while_there_is_any(paper_1: Path) -> None:
    (stage,) = seen(paper_1 / "run.mcap", "/stage")
    assert [entity.id for entity in stage.entities] == ["a/anchor", "b/anchor"]
    for entity, x in zip(stage.entities, (0.0, 10.0), strict=True):
        assert entity.cubes[0].pose.position.x == x
        reach = entity.lines[0].points
        assert all(abs((point.x - x) ** 2 + point.y**2 - 9.0) < 1e-9 for point in reach)
    linked = [bool(one.entities[0].lines) for one in seen(paper_1 / "run.mcap", "/contact")]
    assert linked.index(True) == 46
    assert linked[46:] == [True] * 3


def test_viewers_see_the_hypotheses_of_a_robot_in_its_own_frame(paper_1: Path) -> None:
    held = read(paper_1).estimates("a")
    shown = seen(paper_1 / "run.mcap", "/a/hypotheses")
    for one, poses in zip(held, shown, strict=True):
        expected = one.world or one.local
        assert poses.frame_id == ("world" if one.world else "a/anchor")
        assert [(pose.position.x, pose.position.y) for pose in poses.poses] == [(p.x, p.y) for p in expected]
    assert {poses.frame_id for poses in shown} == {"world", "a/anchor"}


def test_viewers_see_an_ellipse_where_there_is_a_covariance(noisy: Path) -> None:
    held = read(noisy).estimates("a")
    shown = seen(noisy / "run.mcap", "/a/belief")
    for one, belief in zip(held, shown, strict=True):
        (entity,) = belief.entities
        assert len(entity.arrows) == len(one.world or one.local)
        assert [arrow.color.a for arrow in entity.arrows] == [
            max(LEAST_OPACITY, share) for share in one.probabilities
        ]
        assert bool(entity.lines) == (one.covariance is not None and bool(one.world))
        for point in entity.lines[0].points if one.covariance is not None and entity.lines else ():
            assert one.covariance is not None
            if one.covariance.position_sigma > 0.3:  # along an arc
                continue
            off = np.array([point.x - one.world[0].x, point.y - one.world[0].y])
            sigma = [[one.covariance.xx, one.covariance.xy], [one.covariance.xy, one.covariance.yy]]
            assert off @ np.linalg.solve(sigma, off) == pytest.approx(9.0)
    assert any(one.entities[0].lines for one in shown)


def test_viewers_see_what_a_robot_does_and_the_range_to_its_anchor_while_there_is_one(paper_1: Path) -> None:
    shown = seen(paper_1 / "run.mcap", "/a/body")
    ranges = [row["anchor_range"] for row in rows_of(paper_1 / "ticks.csv") if row["robot"] == "a"]
    for body, measured in zip(shown, ranges, strict=True):
        (entity,) = body.entities
        assert entity.texts[0].text.startswith("a: a ")
        assert [text.text for text in entity.texts[1:]] == ([f"{float(measured):.3f} m"] if measured else [])
    assert "" in ranges


def test_viewers_read_what_happens(paper_1: Path) -> None:
    lines = [line.message for line in seen(paper_1 / "run.mcap", "/log")]
    assert "a and b are in range of each other: 2.95 m" in lines
    assert lines[-1] == "The mission ends: localised"


def test_viewers_plot_the_numbers_that_the_tables_have(noisy: Path) -> None:
    numbers = [
        json.loads(message.data)
        for _, channel, message in told(noisy / "run.mcap")
        if channel.topic == "/a/numbers"
    ]
    table = [row for row in pq.ParquetFile(noisy / "ticks.parquet").read().to_pylist() if row["robot"] == "a"]
    assert len(numbers) == len(table)
    for shown, row in zip(numbers, table, strict=True):
        assert shown["hypotheses"] == len(row["world"] or row["local"])
        if row["world"] and shown["probability"] <= 0.5:  # no pose leads: it is that of the farthest
            assert shown["position_error_m"] > row["position_error_m"]
        else:
            assert shown.get("position_error_m") == row["position_error_m"]
        assert shown.get("anchor_range_m") == row["anchor_range"]
        sigma = row["position_sigma_m"]
        assert shown.get("position_bound_m") == (None if sigma is None else 3.0 * sigma)
    assert sum("mutual_range_m" in shown for shown in numbers) > 1


def values_in(part: Any, key: str) -> Iterator[str]:
    """Yield the texts of `key` in a JSON value, at any depth."""
    if isinstance(part, dict):
        if isinstance(part.get(key), str):
            yield part[key]
        part = list(part.values())
    if isinstance(part, list):
        for one in part:
            yield from values_in(one, key)


@pytest.mark.parametrize("recording", ["paper_1", "noisy"])
def test_every_topic_path_and_panel_of_the_layout_exists(
    recording: str, request: pytest.FixtureRequest
) -> None:
    folder: Path = request.getfixturevalue(recording)
    layout = json.loads((folder / "run.foxglove.json").read_bytes())
    numbers: dict[str, set[str]] = {}
    topics = set()
    for schema, channel, message in told(folder / "run.mcap"):
        topics.add(channel.topic)
        if channel.topic.endswith("/numbers"):
            assert set(json.loads(message.data)) <= set(json.loads(schema.data)["properties"])
            numbers.setdefault(channel.topic, set()).update(json.loads(message.data))
    panels = layout["configById"]
    scene = panels["3D!scene"]
    assert {topic for topic, one in scene["topics"].items() if one["visible"]} == {
        *("/stage", "/contact", "/a/body", "/b/body", "/a/belief", "/b/belief")
    }
    assert {*scene["topics"], *values_in(panels, "topicToRender")} <= topics
    frames = {one.child_frame_id for tf in seen(folder / "run.mcap", "/tf") for one in tf.transforms}
    assert {name.removeprefix("frame:") for name in scene["transforms"]} == {"world", *frames}
    plotted = [path.partition(".") for path in values_in(panels, "value")]
    assert len(plotted) == 10
    exact = {"position_bound_m"} if recording == "paper_1" else set()  # without noise there is no sigma
    assert all(number in numbers[topic] | exact for topic, _, number in plotted)
    named = [*values_in(layout["layout"], "first"), *values_in(layout["layout"], "second")]
    assert sorted(named) == sorted(panels)


def test_the_layout_shows_all_anchors_and_orbits_from_above(paper_1: Path) -> None:
    camera = json.loads((paper_1 / "run.foxglove.json").read_bytes())["configById"]["3D!scene"]["cameraState"]
    (stage,) = seen(paper_1 / "run.mcap", "/stage")
    assert not camera["perspective"]
    for line in [line for entity in stage.entities for line in entity.lines]:
        for point in line.points:
            assert abs(point.x - camera["targetOffset"][0]) < camera["distance"] / 2
            assert abs(point.y - camera["targetOffset"][1]) < camera["distance"] / 2


def test_a_recording_always_gives_the_same_bytes(paper_1: Path, tmp_path: Path) -> None:
    first = {name: (paper_1 / name).read_bytes() for name in FILES}
    ended = tandem("export", paper_1, "--out", tmp_path / "elsewhere")
    assert (ended.status, ended.err) == (0, "")
    assert ended.out.splitlines() == [
        str(tmp_path / "elsewhere" / name)
        for name in ("run.mcap", "run.foxglove.json", "frames.csv", "ticks.csv", "ticks.parquet")
    ]
    assert {name: (tmp_path / "elsewhere" / name).read_bytes() for name in FILES} == first
    assert sorted(path.name for path in (tmp_path / "elsewhere").iterdir()) == FILES


# --- tables ---------------------------------------------------------------------------------------------


def test_ticks_as_a_table_are_those_of_ticks_csv_with_what_was_held_possible(noisy: Path) -> None:
    table = pq.ParquetFile(noisy / "ticks.parquet").read().to_pylist()
    rows = rows_of(noisy / "ticks.csv")
    assert len(table) == len(rows) > 0
    held = {robot: {one.tick: one for one in read(noisy).estimates(robot)} for robot in "ab"}
    for row, line in zip(table, rows, strict=True):
        for name, text in line.items():
            assert ("" if row[name] is None else str(row[name])) == text
        one: Estimate = held[row["robot"]][row["tick"]]
        assert [msgspec.convert(pose, dict) for pose in row["world"]] == [
            {"x": pose.x, "y": pose.y, "heading": pose.heading} for pose in one.world
        ]
        if one.world:
            truth = type(one.world[0])(row["x"], row["y"], row["heading"])
            assert (row["position_error_m"], row["heading_error_rad"]) == errors(one.world[0], truth)
            assert row["estimate_x"] == one.world[0].x
        assert row["cov_xx"] == (one.covariance.xx if one.covariance and one.world else None)
        assert (row["nees"] is None) == (row["cov_xx"] is None)
        if one.covariance is not None and one.world:
            sigmas = one.covariance.position_sigma, one.covariance.heading_sigma
            assert (row["position_sigma_m"], row["heading_sigma_rad"]) == sigmas
    assert {row["verdict"] for row in table} == {None, "localised"}


def test_frames_are_rows_with_their_fields_by_name(faulty: Path) -> None:
    frames = {path.name: list(journal_file.read(path)) for path in faulty.glob("*.journal")}
    rows, late = rows_of(faulty / "frames.csv"), 0
    assert Counter(row["journal"] for row in rows) == {name: len(ones) for name, ones in frames.items()}
    for row in rows:
        frame = frames[row["journal"]][int(row["place"])]
        assert int(row["bytes"]) == len(frame)
        assert row["kind"] == msgpack.unpackb(frame[5:])[0]
        late += row["kind"] == "report" and json.loads(row["message"])["tick"] < int(row["tick"])
        if row["kind"] == "observation":
            said, observation = json.loads(row["message"]), decode(frame, Observation)
            assert (said["robot"], said["anchor_range"]) == (observation.robot, observation.anchor_range)
    assert late > 0  # a report that was received later than it was sent is of the tick of its arrival


# --- recordings that are incomplete, or from several hosts --------------------------------------------


@pytest.mark.parametrize("name", [WORLD_JOURNAL, A])
def test_a_torn_journal_is_exported_to_the_tear(name: str, faulty: Path, tmp_path: Path) -> None:
    torn = copied(faulty, tmp_path / "torn")
    size = (torn / name).stat().st_size * 2 // 3
    (torn / name).write_bytes((torn / name).read_bytes()[:size])
    frames = {path.name: len(list(journal_file.read(path))) for path in torn.glob("*.journal")}
    whole = journal_file.packed(journal_file.read(torn / name))
    ended = tandem("export", torn)
    assert (ended.status, ended.err) == (
        0,
        f"tandem export: {name} ends with {size - len(whole)} bytes of a torn write\n",
    )
    assert exported_frames(torn) == frames
    assert [*told(torn / "run.mcap")]


@pytest.mark.parametrize("number", series([1, 2, 3]))
def test_what_a_killed_process_leaves_is_exported_and_replayed(number: int, tmp_path: Path) -> None:
    what, whole = killed(random.Random(number), tmp_path)
    assert whole, what


def test_a_robot_that_has_left_no_journal_is_named(paper_1: Path, tmp_path: Path) -> None:
    copied(paper_1, tmp_path, WORLD_JOURNAL, A)
    ended = tandem("export", tmp_path)
    assert (ended.status, ended.err) == (3, "tandem export: agent-b.journal is missing\n")
    assert set(exported_frames(tmp_path)) == {WORLD_JOURNAL, A}
    assert len(seen(tmp_path / "run.mcap", "/b/pose")) == 49


def test_a_missing_recording_and_an_unwritable_folder_are_refused(paper_1: Path, tmp_path: Path) -> None:
    ended = tandem("export", tmp_path)
    assert (ended.status, ended.out) == (2, "")
    assert ended.err == f"tandem export: {tmp_path} contains no recording: there is no world.journal\n"
    ended = tandem("export", tmp_path, "--tum")
    no = f"{tmp_path} contains no recording and no estimate: there is no world.journal and no estimate.csv"
    assert (ended.status, ended.err) == (2, f"tandem export: {no}\n")
    (tmp_path / "estimate.csv").touch()
    assert "`tandem export --tum` read the estimate in it" in tandem("export", tmp_path).err
    (tmp_path / "file").touch()
    ended = tandem("export", paper_1, "--out", tmp_path / "file")
    assert ended.status == 2
    assert ended.err.startswith(f"tandem export: {tmp_path / 'file'} cannot be written: ")


# --- exports during a run -----------------------------------------------------------------------------


@pytest.mark.parametrize("mode", series([[], ["--in-process"]]))
def test_a_run_exports_its_recording_at_its_end(mode: list[str], paper_1: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    ended = subprocess.run(
        [sys.executable, "-P", "-m", "compose.cli", "run", "paper-1", "-q", "--out", out, *mode],
        capture_output=True,
        text=True,
        timeout=BOUND_S,
        check=False,
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "localised after 48 ticks\n", "")
    assert {name: (out / name).read_bytes() for name in FILES} == {
        name: (paper_1 / name).read_bytes() for name in FILES
    }
    ended_without = tandem("run", "paper-1", "-q", "--out", tmp_path / "bare", "--no-export", *mode)
    assert ended_without.status == 0
    assert {path.name for path in out.iterdir()} - {path.name for path in (tmp_path / "bare").iterdir()} == {
        *("run.mcap", "run.foxglove.json", "frames.csv", "ticks.parquet")
    }
    assert tandem("run", "paper-1", "-q", "--export", *mode).status == 2


def test_a_run_that_cannot_export_prints_its_outcome(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(export_command, "EXPORT_MODULES", ("no_such_module",))
    monkeypatch.setattr(run, "stop_by_signal", lambda _: None)  # it would affect the process of the tests
    for quiet, said in ((True, ""), (False, "tandem run: not exported: needs no_such_module")):
        words = ["run", "paper-1", "--in-process", "--out", str(tmp_path / str(quiet)), *["-q"] * quiet]
        assert run.main(parse(words)) == 0
        told = capsys.readouterr()
        assert "localised after 48 ticks" in told.out
        assert told.err.startswith(said)
        assert bool(told.err) == bool(said)


def test_a_run_that_cannot_export_has_failed(tmp_path: Path) -> None:
    (tmp_path / "out" / "run.mcap").mkdir(parents=True)  # a directory cannot be replaced by a file
    for told, status in (("--export", 3), ("--no-export", 0)):
        out = shutil.copytree(tmp_path / "out", tmp_path / told)
        ended = tandem("run", "paper-1", "-q", "--in-process", "--out", out, told)
        assert (ended.status, ended.out) == (status, "localised after 48 ticks\n")
        assert ended.err.startswith("tandem run: not exported: ") == (status == 3)


@pytest.mark.long
def test_where_there_is_no_room_nothing_half_written_is_left(paper_1: Path, tmp_path: Path) -> None:
    sizes = {name: (paper_1 / name).stat().st_size for name in FILES}
    for name in FILES:
        out = tmp_path / name
        limit = f'ulimit -f {sizes[name] // 2 // 512}; exec "$@"'  # blocks of 512 bytes
        with TandemProcess("export", paper_1, "--out", out, through=["sh", "-c", limit, "sh"]) as command:
            ended = command.ended()
        assert (ended.status, ended.out) == (3, "")
        assert re.fullmatch(r"tandem export: \S+ cannot be written: .*\n", ended.err), ended.err
        assert {path.name: path.stat().st_size for path in out.iterdir()}.items() <= sizes.items()
        assert name not in {path.name for path in out.iterdir()}


def stopped_unless(some: Iterator[bool]) -> None:
    """Raise an AssertionError unless `some` has another item."""
    assert next(some, False), "stopped"


def test_ctrl_c_ends_an_export_and_leaves_nothing_half_written(paper_1: Path, tmp_path: Path) -> None:
    with TandemProcess("export", paper_1, "--out", tmp_path / "out") as command:
        command.until(lambda: command.catches(Signals.SIGHUP), "it catches signals")
        command.tell(Signals.SIGINT)
        ended = command.ended()
    assert (ended.status, ended.out, ended.err) == (130, "", "tandem export: stopped by SIGINT\n")
    assert not (tmp_path / "out").exists()
    all_checks = itertools.count()
    export(read(paper_1), tmp_path / "whole", check=lambda: next(all_checks))
    for checks, left in (
        (10, set()),
        (60, {"run.mcap", "run.foxglove.json"}),
        (next(all_checks) - 1, {*FILES} - {"ticks.parquet"}),
    ):
        some = iter([True] * checks)
        with pytest.raises(AssertionError, match="stopped"):
            export(read(paper_1), tmp_path / "out", check=functools.partial(stopped_unless, some))
        assert {path.name for path in (tmp_path / "out").iterdir()} == left
