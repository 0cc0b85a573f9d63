"""Mutated range recordings of 10 s in all formats: `python -m tests.mutated_recordings 10000`.

This is a measurement, because it takes long; `tests/test_bad_recordings.py` runs 60. Each trial changes a
small recording at a few places, and estimates or calibrates it in a process of its own. It must end with the
exit status 0, 1 or 2, without a traceback, with one line of error at most, within BOUND_CPU_S and BOUND_MB.

`--keep DIR --only 17` writes the recording of trial 17 to DIR, and shows what the command prints.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
import os
import random
import resource
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal, NamedTuple

from mcap.writer import CompressionType, Writer
from rich.console import Console
from rich.table import Table

import tandem
from compose.cli import main as command_line
from compose.launch import in_process
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_mcap import rows_as_they_arrive
from compose.recording.ranging.recording_builder import RecordingBuilder
from compose.recording.recording_files import KINDS
from protocol.journal import journal_file
from protocol.wire import MAX_FRAME_BYTES, decode
from tests.recording_mutations import (
    DURATION_S,
    ROW_MUTATIONS,
    Rows,
    Tables,
    damaged,
    frames_changed,
    record_damaged,
)

BOUND_CPU_S = 20.0
BOUND_MB = 1000
ADDRESS_SPACE = 4 << 30
"""The address space of a trial, and with it the damage that a failure can do."""

Format = Literal["csv", "pyfg", "mcap", "stream", "run"]
FORMATS: tuple[Format, ...] = ("csv", "pyfg", "mcap", "stream", "run")
ACCEPTED_SHARE = 0.5
"""The fraction of trials whose recording the reader must accept, so that most trials reach the estimate."""


class Trial(NamedTuple):
    """One mutated recording, and how the command ended."""

    number: int
    format: Format
    mutations: tuple[str, ...]
    words: tuple[str, ...]
    accepted: bool
    """True if the reader accepted it."""
    status: int
    cpu_s: float
    mb: int
    problem: str
    """The broken promise; empty if there is none."""


# --- recordings -------------------------------------------------------------------------------------------


def recording(robots: int, draw: random.Random) -> Tables:
    """Return a recording of 10 s: robots on arcs among three anchors, with ranges once a second."""
    step, found = 0.5, Tables()
    anchors = {"n1": (-4.0, -3.0), "n2": (4.0, -2.0), "n3": (0.5, 5.0)}
    found["anchors"] = [{"anchor": name, "x": x, "y": y} for name, (x, y) in anchors.items()]
    found["odometry"], found["ranges"], found["truth"] = [], [], []
    poses: dict[str, tuple[float, float, float]] = {}
    turns = {}
    for i in range(robots):
        poses["rstuv"[i]] = (draw.uniform(-2, 2), draw.uniform(-2, 2), draw.uniform(-3, 3))
        turns["rstuv"[i]] = draw.choice((-1, 1)) * draw.uniform(0.2, 0.6)
    for k in range(round(DURATION_S / step) + 1):
        t = k * step
        for name, (x, y, heading) in poses.items():
            pose = {"robot": name, "t": t, "x": x, "y": y, "heading": heading}
            found["truth"].append(pose)
        places = {**{name: pose[:2] for name, pose in poses.items()}, **anchors}
        if k % 2 == 0:
            for i, one in enumerate(poses):
                for other in [*list(poses)[i + 1 :], *anchors]:
                    measured = math.dist(places[one], places[other]) + draw.gauss(0.0, 0.05)
                    row = {"t": t, "from": one, "to": other, "range": abs(measured), "sigma": 0.05}
                    found["ranges"].append(row)
        if k == round(DURATION_S / step):
            break
        for name, (x, y, heading) in poses.items():
            turn = turns[name] * step
            dx, dy = 0.5 * step * math.cos(turn / 2), 0.5 * step * math.sin(turn / 2)
            c, s = math.cos(heading), math.sin(heading)
            poses[name] = (x + c * dx - s * dy, y + s * dx + c * dy, heading + turn)
            sigmas = {"sigma_dx": 0.005, "sigma_dy": 0.005, "sigma_dheading": 0.005}
            moved = {"dx": dx + draw.gauss(0, 2e-3), "dy": dy, "dheading": turn + draw.gauss(0, 2e-3)}
            found["odometry"].append({"robot": name, "t0": t, "t1": t + step, **moved, **sigmas})
    return found


def csv_text(rows: Rows) -> str:
    columns = list(dict.fromkeys(column for row in rows for column in row)) or ["robot"]
    text = io.StringIO()
    csv.writer(text).writerows([columns, *[[row.get(column, "") for column in columns] for row in rows]])
    return text.getvalue()


def pyfg_text(tables: Tables) -> str:
    """Return the lines of a graph; whatever a mutation has left out of a row is 0."""
    names: dict[str, str] = {}

    def name_of(name: object) -> str:
        return names.setdefault(str(name), f"L{name}" if str(name).startswith("n") else str(name).upper())

    lines = []
    poses: Counter[str] = Counter()
    for row in tables.get("truth", []):
        name = name_of(row["robot"])
        lines.append(f"VERTEX_SE2 {row['t']} {name}{poses[name]} {row['x']} {row['y']} {row['heading']}")
        poses[name] += 1
    anchors = tables.get("anchors", [])
    lines += [f"VERTEX_XY {name_of(row['anchor'])} {row['x']} {row['y']}" for row in anchors]
    edges: Counter[str] = Counter()
    for row in tables.get("odometry", []):
        name = name_of(row["robot"])
        number, edges[name] = edges[name], edges[name] + 1
        moved = f"{row['dx']} {row['dy']} {row['dheading']}"
        xx, yy, hh = [squared(row.get(f"sigma_{one}", "")) for one in ("dx", "dy", "dheading")]
        covariance = f"{xx} 0 0 {yy} 0 {hh}"
        lines.append(f"EDGE_SE2 {row['t1']} {name}{number} {name}{number + 1} {moved} {covariance}")
    for row in tables.get("ranges", []):
        ends = [name_of(row[end]) for end in ("from", "to")]
        ends = [end if end.startswith("L") else f"{end}0" for end in ends]
        lines.append(f"EDGE_RANGE {row['t']} {' '.join(ends)} {row['range']} {squared(row.get('sigma', ''))}")
    return "\n".join([*lines, ""])


def squared(value: object) -> object:
    return value * value if isinstance(value, float) else value or 1e-4


def mcap_bytes(tables: Tables, draw: random.Random, *, stream: bool) -> bytes:
    target = io.BytesIO()
    compression = draw.choice([CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE])
    writer = Writer(
        target,
        chunk_size=draw.choice([500, 4000, 1 << 20]),
        compression=compression,
        use_chunking=not stream,
        enable_crcs=draw.random() < 0.3,
    )
    writer.start()
    rows: list[tuple[float, str, dict[str, Any]]] = []
    for table, content in tables.items():
        for row in content:
            t = row.get("t1", row.get("t", -1e18))
            rows.append((t if isinstance(t, int | float) else 0.0, table, row))
    if stream:
        rows.sort(key=lambda one: (one[0], one[1] != "ranges"))
    channels: dict[str, int] = {}
    for _, table, row in rows:
        if table not in channels:
            channels[table] = writer.register_channel(f"/{table}", "json", 0)
        if draw.random() < 0.02:
            channels[table] = writer.register_channel(f"/{table}", "json", 0)
        writer.add_message(channels[table], 0, json_text(row).encode(), 0)
    if not stream or draw.random() < 0.5:
        writer.finish()  # type: ignore[no-untyped-call]
    return target.getvalue()


def json_text(row: dict[str, Any]) -> str:
    """Return `row` as JSON, in which a text that looks like a number is written as it is."""
    names = ("robot", "anchor", "from", "to")
    return (
        "{"
        + ", ".join(
            f'"{name}": {json.dumps(value) if name in names or isinstance(value, float) else value or "null"}'
            for name, value in row.items()
        )
        + "}"
    )


def run_frames(seed: int) -> dict[str, list[bytes]]:
    """Return the frames of the journals of a noisy mission in its first 10 s, with ticks of 0.3 s."""
    scenario = tandem.Scenario.load("noisy").with_({"mission.period": PERIOD_S}, seed=seed).template.scenario
    with tempfile.TemporaryDirectory() as folder:
        in_process.run_mission(scenario, Path(folder))
        return {
            path.name: [frame for frame in journal_file.read(path) if _tick(frame) <= DURATION_S / PERIOD_S]
            for path in Path(folder).glob("*.journal")
        }


PERIOD_S = 0.3


def _tick(frame: bytes) -> int:
    return int(getattr(decode(frame, KINDS, MAX_FRAME_BYTES), "tick", 0))


# --- a trial ----------------------------------------------------------------------------------------------


def written(number: int, seed: int, folder: Path) -> tuple[Format, Path, tuple[str, ...], tuple[str, ...]]:
    """Write the recording of a trial to `folder`; return its format, path and mutations, and the command."""
    draw = random.Random(f"{seed}-{number}")
    format_ = FORMATS[number % len(FORMATS)]
    if format_ == "run":
        path, names = _written_run(draw, folder)
    else:
        robots = draw.choice([1, 1, 2, 2, 3]) if format_ != "stream" else draw.choice([1, 2])
        tables = recording(robots, draw)
        names = []
        by_bytes = draw.random() < 0.25
        for _ in range(0 if by_bytes else draw.choice([1, 1, 2, 3])):
            mutation = draw.choice(ROW_MUTATIONS)
            mutation(tables, draw)
            names.append(mutation.__name__)
        path = _written_tables(tables, format_, folder, draw, names, by_bytes=by_bytes)
    words = ["estimate", str(path)]
    if format_ == "stream" and draw.random() < 0.7:
        words.append("--follow")
    elif draw.random() < 0.15:
        words = ["calibrate", str(path), *(["--without-truth"] if draw.random() < 0.3 else [])]
    elif draw.random() < 0.2:
        words += ["--window", draw.choice(["0..5", "3..8", "2..1000"])]
    if words[0] == "estimate":
        words += draw.choice(
            [[], [], ["--noise", "uwb"], ["--accuracy", "0.1"], ["--noise", "uwb-calibrated"]]
        )
    return format_, path, tuple(names), tuple(words)


def _written_run(draw: random.Random, folder: Path) -> tuple[Path, list[str]]:
    names = []
    frames = {name: list(content) for name, content in RUNS[draw.randrange(len(RUNS))].items()}
    if draw.random() < 0.7:
        frames.pop("world.journal")
    chosen = draw.choice(sorted(frames))
    by_bytes = draw.random() < 0.2
    changes = 0 if by_bytes else draw.choice([1, 2, 5])
    names += [frames_changed(frames[chosen], draw) for _ in range(changes)]
    for name, content in frames.items():
        data = journal_file.packed(content)
        if by_bytes and name == chosen:
            what, data = damaged(data, draw)
            names.append(what)
        (folder / name).write_bytes(data)
    return folder, names


def _written_tables(
    tables: Tables, format_: Format, folder: Path, draw: random.Random, names: list[str], *, by_bytes: bool
) -> Path:
    if format_ == "csv":
        chosen = draw.choice(sorted(tables))
        for name, rows in tables.items():
            data = csv_text(rows).encode()
            if by_bytes and name == chosen:
                what, data = damaged(data, draw)
                names.append(what)
            (folder / f"{name}.csv").write_bytes(data)
        return folder
    if format_ == "pyfg":
        path, data = folder / "it.pyfg", pyfg_text(tables).encode()
    else:
        path, data = folder / "it.mcap", mcap_bytes(tables, draw, stream=format_ == "stream")
    if by_bytes:
        what, data = (
            damaged(data, draw) if format_ == "pyfg" or draw.random() < 0.5 else record_damaged(data, draw)
        )
        names.append(what)
    path.write_bytes(data)
    return path


RUNS: list[dict[str, list[bytes]]] = []
"""The frames of a mission; filled before processes are forked."""


def prepared() -> None:
    """Import what the commands need, before processes are forked."""
    for name in (
        "compose.recording.estimating.calibration",
        "compose.recording.ranging.range_mcap",
        "compose.terminal.tables",
        "rich.table",
        "scipy.linalg",
    ):
        import_module(name)
    for name in ("estimate", "calibrate"):
        import_module(f"compose.cli.{name}")


def tried(number: int, seed: int) -> Trial:
    """Run one trial in a process of its own, and return how it ended."""
    with tempfile.TemporaryDirectory(prefix="mutated-") as name:
        folder = Path(name) / "recording"
        folder.mkdir()
        format_, path, mutations, words = written(number, seed, folder)
        accepted = _accepted(path, follow="--follow" in words)
        end = ended(words)
    problem = ""
    lines = end.errors.count("\n")
    # a stream may tell a suspicion before it breaks off, and a calibration why it needs a fit
    most_lines = 2 if "--follow" in words or ": the reference is an estimate of " in end.errors else 1
    if end.status not in (0, 1, 2):
        problem = f"status {end.status}"
    elif "Traceback" in end.errors or lines > most_lines or (end.status == 2 and not lines):
        problem = "the error is not one line"
    elif end.cpu_s > BOUND_CPU_S or end.mb > BOUND_MB:
        problem = "too large"
    if problem:
        problem += f": {end.errors.strip().splitlines()[-1] if end.errors.strip() else ''}"
    return Trial(number, format_, mutations, words, accepted, end.status, end.cpu_s, end.mb, problem)


class End(NamedTuple):
    """How a command ended, and what it took."""

    status: int
    out: str
    errors: str
    cpu_s: float
    mb: int


def ended(words: Sequence[str]) -> End:
    """Run a command to its end in a process of its own, and return its result."""
    with tempfile.TemporaryDirectory() as name:
        out, errors = Path(name) / "out", Path(name) / "errors"
        child = os.fork()
        if child == 0:
            _run(words, out, errors)
        _, status, used = os.wait4(child, 0)
        return End(
            os.waitstatus_to_exitcode(status),
            out.read_text(errors="replace"),
            errors.read_text(errors="replace"),
            used.ru_utime + used.ru_stime,
            used.ru_maxrss >> 10,
        )


def _accepted(path: Path, *, follow: bool) -> bool:
    """Return whether the reader accepts a recording or a stream; in a process of its own."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
            if follow:
                builder = RecordingBuilder(path)
                with path.open("rb") as file:
                    for row, place in rows_as_they_arrive(file, "it"):
                        builder.add(row, place)
                builder.recording()
            else:
                read_ranges(path)
            code = 0
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def _run(words: Sequence[str], out: Path, errors: Path) -> None:
    """Run a command in this process, and end it."""
    code = 99
    try:
        resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
        resource.setrlimit(resource.RLIMIT_CPU, (round(2 * BOUND_CPU_S), round(2 * BOUND_CPU_S)))
        for path, number in ((out, 1), (errors, 2)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), number)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        command_line.main(words)
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 98
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def trials(count: int, seed: int, jobs: int) -> Iterator[Trial]:
    """Yield the trials 0 to `count` - 1 as they end."""
    prepared()
    RUNS.append(run_frames(seed))
    with get_context("fork").Pool(jobs) as pool:
        yield from pool.imap_unordered(partial(tried, seed=seed), range(count), chunksize=5)


def summary(found: Sequence[Trial]) -> list[str]:
    """Return what is to be told of trials."""
    accepted = sum(one.accepted for one in found) / len(found)
    slowest, largest = max(found, key=lambda one: one.cpu_s), max(found, key=lambda one: one.mb)
    cpu_s = sum(one.cpu_s for one in found)
    return [
        f"{len(found)} recordings, of which the reader accepts {accepted:.1%}; {cpu_s:.0f} s of CPU",
        f"slowest: trial {slowest.number}, {slowest.cpu_s:.1f} s ({', '.join(slowest.mutations)})",
        f"largest: trial {largest.number}, {largest.mb} MB ({', '.join(largest.mutations)})",
        *[
            f"trial {one.number}: {' '.join(one.words[:1] + one.words[2:])} ({one.format}; "
            f"{', '.join(one.mutations)}), {one.cpu_s:.1f} s, {one.mb} MB: {one.problem}"
            for one in found
            if one.problem
        ],
    ]


def main() -> int:
    """Run the trials, print the result, and return 1 if a promise was broken."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int, nargs="?", default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--only", type=int, help="one trial")
    parser.add_argument("--keep", type=Path, help="folder for its recording")
    options = parser.parse_args()
    if options.only is not None:
        prepared()
        RUNS.append(run_frames(options.seed))
        if options.keep is not None:
            shutil.rmtree(options.keep, ignore_errors=True)
            options.keep.mkdir(parents=True)
            print(*written(options.only, options.seed, options.keep))
        print(tried(options.only, options.seed))
        return 0
    began = time.monotonic()
    found: list[Trial] = []
    for one in trials(options.count, options.seed, options.jobs):
        found.append(one)
        if one.problem:
            print(summary([one])[-1], flush=True)
        if len(found) % 500 == 0:
            print(f"{len(found)} after {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    counts = Table("format", "recordings", "accepted", "status 0", "1", "2", "other", "CPU s")
    for format_ in FORMATS:
        own = [one for one in found if one.format == format_]
        by = Counter(one.status for one in own)
        rest = len(own) - by[0] - by[1] - by[2]
        cells = [len(own), sum(one.accepted for one in own), by[0], by[1], by[2], rest]
        counts.add_row(format_, *map(str, cells), f"{sum(one.cpu_s for one in own):.0f}")
    Console().print(counts)
    print(*summary(found)[:3], sep="\n")
    return int(
        any(one.problem for one in found) or sum(one.accepted for one in found) < ACCEPTED_SHARE * len(found)
    )


if __name__ == "__main__":
    sys.exit(main())
