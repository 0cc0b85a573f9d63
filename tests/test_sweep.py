"""The rows of a sweep depend only on its sweep file, not on its workers or on failures."""

from __future__ import annotations

import csv
import errno
import json
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from itertools import product
from pathlib import Path
from signal import SIGCONT, SIGINT, SIGKILL, SIGSTOP, SIGTERM
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from distributed import Client
from matplotlib.figure import Figure
from msgspec.structs import replace
from scipy.stats import binom, binomtest  # type: ignore[import-untyped]

from compose.cli.sweep import status_of
from compose.errors import Unworkable, UserError
from compose.scenario.scenario_file import load
from compose.sweep import axis_figures, cluster, execution, report, spec
from compose.sweep.cells import cells, label, setting_of, trial_seed
from compose.sweep.statistics import quantile, wilson
from compose.sweep.table import schema_of
from compose.sweep.worker import PLAY
from protocol.network.inbox import Inbox
from protocol.noise import Noise, VelocityNoise
from tests.commands import PAPER_1, Ended, TandemProcess, on_a_terminal, refused, tandem, temporary_in, until
from tests.series import series
from world.world_noise import WorldNoise

HOUSE = Path(__file__).parents[1]
RANDOM = PAPER_1.replace("start", "# start")
"""A scenario with random starts."""
BOTH = """
name = "both"
scenario = "base.toml"
trials = 12
seed = 5
[[axis]]
field = "robot.b.anchor[0]"
values = [10.0, 8]
[[axis]]
field = "planner.name"
values = ["paper", "assured"]
paired = true
"""
LENGTHY = BOTH.replace("[10.0, 8]", "[60.0]").replace("trials = 12", "trials = 40")
"""A sweep that takes several seconds."""
ASTRAY = 'name = "astray"\nscenario = "base.toml"\ntrials = 8\n'
HASTY = ASTRAY + "trial_timeout = 1.5\n"
"""A sweep only for trials that hang; others may take longer than its timeout on a busy machine."""


@pytest.fixture(autouse=True)
def nothing_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Put all temporary folders into tmp_path, and check that no processes or files remain."""
    folder = temporary_in(tmp_path, monkeypatch)
    yield
    until(lambda: not trial_processes(tmp_path), "no process for trials is left")
    assert list(folder.iterdir()) == []


def trial_processes(tmp_path: Path) -> list[int]:
    return [
        pid
        for pid in map(int, filter(str.isdigit, os.listdir("/proc")))
        if (words := said_by(pid))
        and words[:3] == ["tandem", "sweep", "worker"]
        and words[-1].startswith(f"{tmp_path}/")
    ]


def said_by(pid: int) -> list[str]:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode().replace("\0", " ").split()
    except OSError:  # ended meanwhile
        return []


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with base.toml, both.toml, lengthy.toml, astray.toml and hasty.toml."""
    (tmp_path / "base.toml").write_text(RANDOM)
    for name, text in (("both", BOTH), ("lengthy", LENGTHY), ("astray", ASTRAY), ("hasty", HASTY)):
        (tmp_path / f"{name}.toml").write_text(text)
    return tmp_path


def rows(out: Path) -> list[dict[str, Any]]:
    """Return all rows without their wall times."""
    return [
        {name: value for name, value in row.items() if name != "wall_s"}
        for row in pq.read_table(out / "trials.parquet").to_pylist()
    ]


def summary_rows(out: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((out / "summary.csv").read_text().splitlines()))


def sweep(folder: Path, spec: str, out: str, *arguments: str) -> Ended:
    return tandem("sweep", spec, "--out", out, *arguments, cwd=folder)


def played(
    folder: Path,
    source: str,
    out: str,
    *,
    trials: int | None = None,
    workers: int = 2,
    play: str = PLAY,
    audit: bool = True,
    done: Callable[[int], None] = lambda _: None,
) -> execution.Results:
    """Run the sweep as the command does, without figures and output."""
    silent = execution.Progress(say=print, begin=lambda *_: None, done=done)
    sweep = spec.load(str(folder / source), trials=trials)
    return execution.sweep(
        sweep,
        folder / out,
        execution.ExecutionOptions(workers=workers, play=play, audit=audit),
        Inbox("test"),
        silent,
    )


def sweep_up(folder: Path) -> None:
    """Remove the files that a killed command could not."""
    for left in (folder / "tmp").glob("tandem-dask-*"):
        shutil.rmtree(left)


def parts(out: Path) -> int:
    return len(list(out.glob("parts/*.parquet")))


# --- workers -----------------------------------------------------------------------------------------


@pytest.mark.long
def test_rows_are_the_same_on_one_worker_and_on_two(folder: Path) -> None:
    played(folder, "both.toml", "one", workers=1)
    played(folder, "both.toml", "two", workers=2)
    found = rows(folder / "one")
    assert [(row["cell"], row["trial"]) for row in found] == [(i, k) for i in range(4) for k in range(12)]
    assert found == rows(folder / "two")
    for file in ("summary.csv", "sweep.json", "cells/003.toml"):
        assert (folder / "one" / file).read_bytes() == (folder / "two" / file).read_bytes()
    assert len({row["seed"] for row in found}) == 24
    assert [row["seed"] for row in found[:12]] == [row["seed"] for row in found[12:24]], "paired"


@pytest.mark.long
def test_rows_are_the_same_as_processes_over_zenoh(folder: Path) -> None:
    played(folder, "both.toml", "inline", trials=1)
    assert sweep(folder, "both.toml", "zenoh", "--trials", "1", "--processes").status in (0, 1)
    assert rows(folder / "zenoh") == rows(folder / "inline")
    assert {row["violations"] for row in rows(folder / "zenoh")} == {0}


def dask(stack: ExitStack, module: str, *arguments: str | Path, cwd: Path) -> subprocess.Popen[bytes]:
    """Start a process of a Dask cluster."""
    process = subprocess.Popen(
        [sys.executable, "-P", "-W", "ignore", "-m", f"distributed.cli.{module}", *map(str, arguments)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        cwd=cwd,
        env=os.environ | {"DASK_TEMPORARY_DIRECTORY": str(cwd)},
    )
    stack.callback(process.wait)
    stack.callback(process.kill)
    return process


@pytest.mark.long("slow")
def test_rows_are_the_same_by_a_scheduler_that_is_slow_and_loses_workers_and_connections(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    played(folder, "lengthy.toml", "here")
    with ExitStack() as stack:
        file = folder / "scheduler.json"
        arguments = ("--host", "127.0.0.1", "--no-dashboard")
        scheduler = dask(
            stack, "dask_scheduler", "--port", "0", "--scheduler-file", file, *arguments, cwd=folder
        )
        until(lambda: file.exists() and file.read_text().endswith("}"), "the scheduler listens")
        address = json.loads(file.read_text())["address"]
        watcher = stack.enter_context(Client(address, set_as_default=False))

        def worker() -> subprocess.Popen[bytes]:
            return dask(
                stack, "dask_worker", address, "--nthreads", "1", "--no-nanny", *arguments, cwd=folder
            )

        def command(out: str) -> TandemProcess:
            return TandemProcess("sweep", "lengthy.toml", "--out", out, "--scheduler", address, cwd=folder)

        first, second = worker(), worker()
        with command("there") as sweep:
            sweep.until(lambda: parts(folder / "there") >= 2, "two chunks are done")
            sweep.tell(SIGSTOP)
            until(lambda: set(watcher.processing().values()) == {()}, "all submitted chunks are done")
            first.kill()
            until(lambda: len(watcher.nthreads()) == 1, "the scheduler has lost the worker")
            sweep.tell(SIGCONT)  # it reads that a chunk is done, then that the rows are lost
            done = parts(folder / "there")
            sweep.until(lambda: parts(folder / "there") > done, "the sweep goes on")
            known = watcher.id
            watcher.run_on_scheduler(
                lambda dask_scheduler: [
                    connection.abort()
                    for client, connection in dask_scheduler.client_comms.items()
                    if client != known
                ]
            )
            third = worker()
            until(lambda: len(watcher.nthreads()) == 2, "another worker has come")
            second.kill()
            scheduler.send_signal(SIGSTOP)
            time.sleep(cluster.SCHEDULER_S + 2.0)  # as on a busy machine
            scheduler.send_signal(SIGCONT)
            assert sweep.ended().status == 1, sweep.err
        until(lambda: not trial_processes(folder), "the workers keep no process of a sweep that is over")
        assert rows(folder / "there") == rows(folder / "here")
        monkeypatch.setenv("DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT", "2s")
        with command("gone") as sweep:
            sweep.until(lambda: parts(folder / "gone"), "a chunk is done")
            watcher.close()
            scheduler.kill()
            ended = sweep.ended()
        assert ended.status == 3
        assert re.fullmatch(
            r"tandem sweep: the connection to the scheduler is lost: \d+ of 80 trials are done; [^\n]+\n",
            ended.err,
        ), ended.err
        third.wait(20.0)


@pytest.mark.long
def test_a_scheduler_that_is_not_there_is_one_line(folder: Path) -> None:
    for address in ("tcp://127.0.0.1:9", "nonsense://x", "nonsense", "ucx://127.0.0.1:9", "inproc://x"):
        ended = sweep(folder, "both.toml", "out", "--scheduler", address)
        assert ended.status == 2
        assert re.fullmatch(rf"tandem sweep: --scheduler: {address} cannot be reached: [^\n]+\n", ended.err)


@pytest.mark.long
def test_the_wait_for_a_scheduler_that_sends_nothing_is_bounded(folder: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        address = f"tcp://127.0.0.1:{mute.getsockname()[1]}"
        ended = sweep(folder, "both.toml", "out", "--scheduler", address)
    assert ended.status == 2
    assert ended.err == f"tandem sweep: --scheduler: {address} cannot be reached: no answer within 5 s\n"


def test_a_seed_follows_from_the_sweep_the_cell_and_the_trial(folder: Path) -> None:
    def seeds(text: str) -> dict[tuple[str, ...], int]:
        (folder / "x.toml").write_text(text)
        sweep = spec.load(str(folder / "x.toml"))
        return {tuple(map(str, cell.fields.values())): trial_seed(5, cell.key, 0) for cell in cells(sweep)}

    before = seeds(BOTH)
    assert trial_seed(5, '{"robot.b.anchor[0]":10}', 0) == before["10.0", "paper"] == 2706173664366694412
    more = seeds(BOTH.replace("[10.0, 8]", "[1.5, 8, 10]"))
    assert more["10", "assured"] == before["10.0", "assured"], "cells beside it, and how numbers are written"
    assert more["8", "paper"] == before["8", "paper"] != before["10.0", "paper"]
    assert seeds(BOTH.replace("paired = true", "")) == before, "planners are paired by default"
    unpaired = seeds(BOTH.replace("paired = true", "paired = false"))
    assert len(set(unpaired.values())) == 4
    assert len(set(before.values())) == 2
    assert trial_seed(6, "{}", 0) != trial_seed(5, "{}", 0) != trial_seed(5, "{}", 1)
    assert all(0 <= trial_seed(5, "{}", k) < 2**63 for k in range(100))


# --- failures -----------------------------------------------------------------------------------------


def misbehaving(function: str, source: str, folder: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "tests.misbehaving", function, str(folder / source), str(folder / "out")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=HOUSE,
        env=os.environ | {"PYTHONPATH": str(HOUSE)},
        start_new_session=True,
    )


@pytest.mark.long
def test_trials_that_raise_die_or_hang_are_rows_and_the_others_go_on(folder: Path) -> None:
    played(folder, "astray.toml", "well")
    with misbehaving("astray", "hasty.toml", folder) as process:
        assert process.communicate(timeout=60.0) == ("8 rows, None\n", "")
    found, expected = rows(folder / "out"), rows(folder / "well")
    errors = {row["trial"]: row["error"] for row in found if row["error"] is not None}
    assert errors == {
        1: "ValueError: two\\nlines",
        3: "died: its process ended with status 3",
        5: "hung: no answer within 1.5 s",
    }
    assert {row["outcome"] for row in found if row["error"] is not None} == {"failed"}
    assert [row["seed"] for row in found] == [row["seed"] for row in expected]
    assert [row for row in found if row["error"] is None] == [
        row for row in expected if row["trial"] not in errors
    ]
    summary = summary_rows(folder / "out")[0]
    assert (summary["trials"], summary["failed"]) == ("8", "3")
    again = sweep(folder, "astray.toml", "out")
    assert again.status == 3
    assert "trial 1 of cell 0 first: failed (ValueError: two\\nlines)" in again.out
    sweep(folder, "astray.toml", "out", "--retry")
    assert rows(folder / "out") == expected


@pytest.mark.long("slow")
def test_a_sweep_that_is_killed_twice_goes_on_where_it_was(folder: Path) -> None:
    out = folder / "killed"
    for already in (0, 1):
        with TandemProcess("sweep", "lengthy.toml", "--out", "killed", cwd=folder) as command:
            was = parts(out)
            assert was >= already
            command.until(lambda: parts(out) > was, "a chunk is done")  # noqa: B023  # within the round
            command.tell(SIGKILL)
            assert command.ended().status == -SIGKILL
        until(lambda: not trial_processes(folder), "the trials' processes end with their owner")
        assert not (out / "trials.parquet").exists()
    sweep_up(folder)
    done = parts(out)
    (out / "parts" / "00000-99999999.parquet").write_bytes(b"torn")
    ended = sweep(folder, "lengthy.toml", "killed")
    assert ended.status == 1
    assert ended.err.count("cannot be read: its trials will run again\n") == 1
    assert done > 1
    assert parts(out) == 0
    played(folder, "lengthy.toml", "straight")
    assert rows(out) == rows(folder / "straight")


@pytest.mark.long
def test_a_sweep_whose_trials_hang_can_be_stopped(folder: Path) -> None:
    with misbehaving("endless", "both.toml", folder) as process:
        until(lambda: len(list(folder.glob("tmp/*/playing"))) == 2, "trials are played")
        os.killpg(process.pid, SIGTERM)
        said = process.communicate(timeout=30.0)
    assert said == ("0 rows, stopped by SIGTERM\n", "")


@pytest.mark.long
def test_an_interrupted_sweep_reports_it_in_one_line_and_resumes(folder: Path) -> None:
    with TandemProcess("sweep", "lengthy.toml", "--out", "out", "--workers", "1", cwd=folder) as command:
        command.until(lambda: parts(folder / "out"), "a chunk is done")
        command.tell(SIGINT)
        ended = command.ended()
    assert ended.status == 130
    assert ended.out == ""
    said = re.fullmatch(r"tandem sweep: stopped by SIGINT: (\d+) of 80 trials are done; [^\n]+\n", ended.err)
    assert said is not None, ended.err
    found = rows(folder / "out")
    assert 0 < int(said[1]) == len(found) < 80
    assert trial_processes(folder) == []
    played(folder, "lengthy.toml", "out")
    finished = rows(folder / "out")
    assert len(finished) == 80
    assert all(row in finished for row in found)


@pytest.mark.long("slow")
def test_a_sweep_goes_on_after_its_machine_has_slept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL", "1s")
    with TandemProcess("sweep", "lengthy.toml", "--out", "out", "--workers", "1", cwd=folder) as command:
        command.until(lambda: parts(folder / "out"), "a chunk is done")
        command.tell(SIGSTOP)
        time.sleep(12.0)  # longer than ten heartbeats of a worker
        command.tell(SIGCONT)
        assert command.ended().status == 1  # some of the missions are undecided
    assert len(rows(folder / "out")) == 80


@pytest.mark.long
def test_a_trial_that_hangs_does_not_outlive_whoever_ran_it(folder: Path) -> None:
    with misbehaving("endless", "both.toml", folder) as process:
        until(lambda: len(list(folder.glob("tmp/*/playing"))) == 2, "trials are played")
        process.kill()
        process.communicate(timeout=30.0)
    until(lambda: not trial_processes(folder), "the trials' processes end with their owner")
    sweep_up(folder)


@pytest.mark.long
def test_a_folder_may_be_called_anything_and_a_label_stands_as_it_is_written(folder: Path) -> None:
    name = "two words: 12:30"
    (folder / "both.toml").write_text(
        'name = "both"\nscenario = "base.toml"\ntrials = 1\n[[axis]]\nname = "way"\n'
        'field = "planner.name"\nvalues = ["paper", "assured"]\nlabels = ["$\\\\nosuch{$ a", "b_c$"]\n'
    )
    ended = sweep(folder, "both.toml", name, "-q")
    assert ended.status in (0, 1), ended.err
    assert len(rows(folder / name)) == 2
    assert "$\\nosuch{$ a" in (folder / name / "summary.csv").read_text()
    assert (folder / name / "figures" / "success-way.png").exists()


# --- results folder ------------------------------------------------------------------------------


@pytest.mark.long
def test_more_trials_extend_a_sweep_and_fewer_leave_it(folder: Path) -> None:
    played(folder, "both.toml", "grown", trials=3)
    more: list[int] = []
    played(folder, "both.toml", "grown", done=more.append)
    assert sum(more) == 48 - 12, "what is there is not played again"
    assert len(played(folder, "both.toml", "grown", trials=3).table) == 48
    played(folder, "both.toml", "whole")
    assert rows(folder / "grown") == rows(folder / "whole")


def test_a_folder_of_another_sweep_is_refused(folder: Path) -> None:
    played(folder, "both.toml", "out", trials=1)
    before = rows(folder / "out")
    (folder / "other.toml").write_text(RANDOM.replace("period = 1.0", "period = 0.5"))
    for was, new, says in (
        ("seed = 5", "seed = 6", "seed is 5 in the folder and 6 in this sweep"),
        ("[10.0, 8]", "[10.0, 9]", "axis[0].values[1][0] is 8 in the folder and 9 in this sweep"),
        ("base.toml", "other.toml", "scenario.mission.period is 1 in the folder and 0.5 in this sweep"),
    ):
        (folder / "both.toml").write_text(BOTH.replace(was, new))
        with pytest.raises(UserError) as refused:
            played(folder, "both.toml", "out")
        assert str(refused.value).endswith(f"out contains another sweep: {says}; choose another folder")
    assert rows(folder / "out") == before


@pytest.mark.long
def test_a_folder_in_use_is_refused(folder: Path) -> None:
    with misbehaving("endless", "both.toml", folder) as process:
        until(lambda: list(folder.glob("tmp/*/playing")), "trials are played")
        with pytest.raises(UserError, match="out is in use by another sweep"):
            played(folder, "both.toml", "out")
        os.killpg(process.pid, SIGTERM)
        process.communicate(timeout=30.0)


@pytest.mark.long
def test_results_are_left_in_a_folder_named_for_the_sweep_and_the_printed_command_runs_a_trial_again(
    folder: Path,
) -> None:
    ended = tandem("sweep", "both.toml", cwd=folder)
    out = folder / "sweep-both"
    drawn = {path.name: path.stat().st_size for path in (out / "figures").iterdir()}
    assert set(drawn) == {
        f"{name}.{kind}"
        for kind in ("svg", "pdf", "png")
        for name in (
            *("success-robot-b-anchor-0", "success-planner-name"),
            *("ticks-robot-b-anchor-0", "ticks-planner-name"),
        )
    }
    assert min(drawn.values()) > 5_000
    assert {path.name for path in out.iterdir()} == {
        *("sweep.json", "cells", "figures", "summary.csv", "differences.csv", "trials.parquet")
    }
    summary = summary_rows(out)
    assert [row["trials"] for row in summary] == ["12"] * 4
    assert list(summary[0])[:9] == [
        *("cell", "robot.b.anchor[0]", "planner.name"),
        *("trials", "localised", "undecided", "inconsistent", "wrong", "failed"),
    ]
    assert ended.out.splitlines()[-1] == "results: sweep-both"
    command = shlex.split(next(line for line in ended.out.splitlines() if line.startswith("  tandem run ")))
    assert command[0] == "tandem"
    tandem(*command[1:], cwd=folder)
    recording = folder / command[command.index("--out") + 1]
    again = json.loads((recording / "summary.json").read_text())
    cell = int(Path(command[2]).stem)
    row = next(row for row in rows(out) if (row["cell"], row["seed"]) == (cell, again["seed"]))
    for name in ("outcome", "reason", "ticks", "first_contact_tick", "t_max_s"):
        assert row[name] == again[name]
    for robot in ("a", "b"):
        said = again["robots"][robot]
        for name in ("branch", "alpha", "position_error_m", "heading_error_rad"):
            assert row[f"{robot}_{name}"] == said[name]
    assert row["bytes_sent"] == sum(robot["bytes_sent"] for robot in again["robots"].values())


@pytest.mark.long
def test_the_bar_of_a_sweep_says_what_its_times_are_and_fits_80_columns(folder: Path) -> None:
    (folder / "few.toml").write_text('name = "a-name-of-18-chars"\nscenario = "random"\ntrials = 40\n')
    status, shown = on_a_terminal("sweep", "few.toml", "--workers", "1", "--out", "out", cwd=folder)
    assert status == 0
    lines = [line for line in re.split("\x1b\\[2K|\r|\n", shown) if "left" in line]
    text = re.sub("\x1b\\[[?0-9;]*[a-zA-Z]", "", lines[-1])
    assert re.search(r"/40 [0-9.e+]+ trials/s [0-9:]+ elapsed, [0-9:]+ left", text)
    assert text.startswith("a-name-of-18-chars")
    assert len(text) <= 80


@pytest.mark.long
def test_a_narrow_terminal_shows_all_outcomes_and_breaks_no_word_and_no_command(folder: Path) -> None:
    columns = 40
    axes = '[[axis]]\nfield = "max_ticks"\nvalues = [9, 500]\n[[axis]]\nfield = "planner.name"\n'
    (folder / "narrow.toml").write_text(
        f'name = "narrow"\nscenario = "random"\ntrials = 2\n{axes}values = ["assured"]\n'
    )
    status, shown = on_a_terminal("sweep", "narrow.toml", columns=columns, cwd=folder)
    assert status == 1
    lines = re.split("\x1b\\[[?0-9;]*[a-zA-Z]|\r?\n|\r", shown)
    (command,) = [line for line in lines if line.startswith("  tandem run ")]
    assert re.fullmatch(
        r"  tandem run sweep-narrow/cells/000.toml --seed \d+ --out recording-narrow-0-\d", command
    )
    result = lines[next(i for i, line in enumerate(lines) if line.startswith("narrow: ")) :]
    assert [line for line in result if line != command and len(line) > columns] == []
    text = " ".join(" ".join(result).split())
    counts = "2 trials, 0 localised, 2 undecided, 0 inconsistent, 0 wrong, 0 failed"
    assert f"cell 0, max_ticks 9, name assured: {counts}; rate 0.0000 (0.0000 to 0.6576) cell 1" in text
    assert "2 localised, 0 undecided, 0 inconsistent, 0 wrong, 0 failed; rate 1.0000 (0.3424 to" in text
    assert "\n\n\n" not in "\n".join(result)
    assert "(max_ticks: a, b not localised by then); to run it again:" in text


@pytest.mark.long
def test_of_more_cells_than_fit_a_screen_those_in_which_all_is_well_are_counted(folder: Path) -> None:
    starts = ", ".join([f"[{0.3 + 0.01 * i:.2f}, 0.1, 1.0]" for i in range(51)])
    axis = f'[[axis]]\nfield = "robot.a.start"\nvalues = [{starts}]\n'
    planner_name = '[[axis]]\nfield = "planner.name"\nvalues = ["assured", "paper"]\n'
    (folder / "many.toml").write_text(
        f'name = "many"\nscenario = "random"\ntrials = 1\nseed = 1\n{axis}{planner_name}'
    )
    ended = sweep(folder, "many.toml", "out")
    total = {row["cell"]: row["localised"] for row in summary_rows(folder / "out")}
    assert len(total) == 102
    poor = [cell for cell, localised in total.items() if localised == "0"]
    lines = ended.out.splitlines()
    listed = [line.split()[0] for line in lines if line[:1] == " " and line[1:2].isdigit()]
    assert listed == poor
    assert f"{102 - len(poor)} cells without a problem are not listed; see out/summary.csv" in lines
    assert 0 < len(poor) < 102


# --- audits -------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_trial_that_breaks_a_rule_fails_the_sweep_and_is_named(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = played(folder, "both.toml", "out", trials=4, play="tests.misbehaving:boastful")
    found = rows(folder / "out")
    assert [row["violations"] > 0 for row in found] == [row["trial"] == 2 for row in found]
    first = "tick 0, a, decision: in its Estimate, localised is true, expected false"
    assert {row["first_violation"] for row in found} == {first, None}
    summary = summary_rows(folder / "out")
    assert [(row["audited"], row["clean"]) for row in summary] == [("4", "3")] * 4
    assert [int(row["violations"]) for row in summary] == [
        row["violations"] for row in found if row["trial"] == 2
    ]
    assert status_of(results) == 3
    report.show(results, folder / "out", quiet=True)
    said = capsys.readouterr().out.splitlines()
    assert said[-1] == f"audited: 16 of 16 trials, 12 clean; trial 2 of cell 0: {first}"
    report.show(results, folder / "out", quiet=False)
    said = capsys.readouterr().out.splitlines()
    assert any(line.startswith("look at trial 2 of cell 0 first: ") and first in line for line in said)
    heading = next(line for line in said if line.startswith(" cell")).split()
    line = next(line for line in said if line.startswith(" 0 ")).split()
    assert (heading[-1], line[-1]) == ("clean", "3")


@pytest.mark.long
def test_the_command_that_runs_a_trial_again_records_to_a_new_folder(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    results = played(folder, "both.toml", "out", trials=4, play="tests.misbehaving:boastful")
    monkeypatch.chdir(folder)
    for name in ("recording-both-0-2", "recording-both-0-2-2", "recording-both-0-2-3"):
        report.show(results, Path("out"), quiet=False)
        (line,) = [one for one in capsys.readouterr().out.splitlines() if one.startswith("  tandem run ")]
        assert line.endswith(f" --out {name}")
        Path(name).mkdir()


@pytest.mark.long
def test_a_sweep_without_audit_does_not_mention_it(folder: Path) -> None:
    ended = sweep(folder, "both.toml", "out", "--trials", "1", "--no-audit")
    assert "audited" not in ended.out
    assert {(row["violations"], row["first_violation"]) for row in rows(folder / "out")} == {(None, None)}
    assert [(row["audited"], row["clean"], row["violations"]) for row in summary_rows(folder / "out")] == [
        ("0", "0", "0")
    ] * 4


@pytest.mark.long
def test_a_cell_in_which_no_robots_can_meet_is_refused(folder: Path) -> None:
    slow = '[[axis]]\nname = "pace"\nfields = ["mission.max_speed", "mission.period"]\nvalues = '
    start = 'name = "slow"\nscenario = "base.toml"\ntrials = 2\n' + slow
    (folder / "slow.toml").write_text(start + "[[1.0, 1.0], [1e-6, 1e-3]]")
    ended = sweep(folder, "slow.toml", "out")
    assert ended.status in (0, 1)
    assert "cell 1 cannot run: mission: a robot moves at most " in ended.out
    summary = summary_rows(folder / "out")
    assert [row["trials"] for row in summary] == ["2", "0"]
    assert [bool(row["refused"]) for row in summary] == [False, True]
    (folder / "slow.toml").write_text(start + "[[1e-6, 1e-3]]")
    with pytest.raises(UserError, match="no cell can run; cell 0: mission: a robot moves at most"):
        played(folder, "slow.toml", "none")
    assert not (folder / "none").exists()


@pytest.mark.long
def test_a_sweep_in_which_none_localises_has_its_figures(folder: Path) -> None:
    (folder / "short.toml").write_text(
        'name = "short"\nscenario = "base.toml"\ntrials = 1\n[[axis]]\nfield = "max_ticks"\nvalues = [1, 2]\n'
    )
    ended = sweep(folder, "short.toml", "out", "--workers", "1")
    assert (ended.status, ended.err) == (1, "")
    assert (folder / "out" / "figures" / "ticks-max_ticks.svg").exists()


def test_a_resource_that_the_system_refuses_to_dask_is_reported() -> None:
    said = RuntimeError("Cluster failed to start")
    said.__cause__ = OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(OSError, match="No space left"), cluster._system_errors():
        raise said


@pytest.mark.parametrize(("k", "n"), [(0, 1), (1, 1), (3, 10), (9990, 10_000), (0, 500), (500, 500)])
def test_a_rate_s_interval_is_wilson_s(k: int, n: int) -> None:
    interval = binomtest(k, n).proportion_ci(method="wilson")
    assert wilson(k, n) == pytest.approx((k / n, interval.low, interval.high), abs=1e-12)


def test_an_interval_of_a_quantile_holds_it_in_95_of_100_samples() -> None:
    """The numbers 1 to n of a sample are its ranks, so the bounds say which order statistics they are."""
    for n, p in ((20, 0.5), (100, 0.95), (1000, 0.5)):
        estimate, low, high = quantile(np.arange(1.0, n + 1.0), p)
        inside = binom.cdf(high - 1, n, p) - binom.cdf(low - 1, n, p)
        narrower = binom.cdf(high - 2, n, p) - binom.cdf(low - 1, n, p)
        assert inside >= 0.95
        assert narrower < 0.975
        assert low < estimate < high
    assert quantile(np.array([7.0]), 0.95) == (7.0, 7.0, 7.0)


def test_an_axis_reaches_into_tables_that_the_base_scenario_leaves_out(folder: Path) -> None:
    (folder / "nested.toml").write_text(
        'name = "nested"\nscenario = "base.toml"\ntrials = 1\n[[axis]]\nname = "noise"\n'
        'fields = ["mission.noise.odometry.v", "mission.noise.anchor_sigma", "mission.accuracy"]\n'
        "values = [[0, 0, 0.1], [0.01, 0.02, 0.3]]\n"
    )
    assert "noise" not in RANDOM
    results = played(folder, "nested.toml", "out")
    for cell, (v, sigma, accuracy) in zip(results.cells, [(0.0, 0.0, 0.1), (0.01, 0.02, 0.3)], strict=True):
        setting = setting_of(results.sweep, cell)
        assert load(str(folder / "out" / "cells" / cell.file_name)) == setting.scenario
        mission = setting.scenario.mission
        assert mission.noise == Noise(anchor_sigma=sigma, odometry=VelocityNoise(v=v))
        assert mission.accuracy == accuracy
    assert [row["mission.noise.odometry.v"] for row in rows(folder / "out")] == [0.0, 0.01]


@pytest.mark.parametrize("noise", ["3", "[]", '"little"', "{odometry = [1]}", "{odometry = 0.01}"])
def test_a_base_scenario_whose_table_is_none_is_one_line(noise: str, folder: Path) -> None:
    (folder / "base.toml").write_text(RANDOM.replace("[mission]", f"[mission]\nnoise = {noise}"))
    (folder / "bad.toml").write_text(BOTH.replace("robot.b.anchor[0]", "mission.noise.odometry.v"))
    where = "mission.noise.odometry" if noise.startswith("{") else "mission.noise"
    with pytest.raises(UserError) as refused:
        played(folder, "bad.toml", "out")
    assert str(refused.value) == (
        f"{folder / 'bad.toml'}: axis[0].field: 'mission.noise.odometry.v': "
        f"{where} of the base scenario is not a table"
    )


@pytest.mark.long
def test_a_figure_distinguishes_the_values_of_the_other_axes_while_they_are_few(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: dict[str, Figure] = {}
    monkeypatch.setattr(axis_figures, "save", lambda figure, path: drawn.update({path.name: figure}))
    third = '[[axis]]\nfield = "mission.noise.outliers"\nvalues = [0, 0.05]\n'
    third += '[[axis]]\nfield = "max_ticks"\nvalues = [1, 2, 3, 4]\npaired = false\n'
    (folder / "four.toml").write_text(BOTH + third)
    axis_figures.draw(played(folder, "four.toml", "out", trials=1), folder / "figures")

    def told_apart(name: str) -> list[str]:
        return [text.get_text() for text in drawn[name].legends[0].get_texts()]

    both = [f"{planner_name}, anchor[0] = {d}" for planner_name in ("paper", "assured") for d in (10, 8)]
    assert told_apart("success-mission-noise-outliers") == told_apart("success-max_ticks") == both
    assert told_apart("success-planner-name") == [
        f"anchor[0] = {d}, outliers = {share}" for d in (10, 8) for share in (0, 0.05)
    ]


@pytest.mark.parametrize("name", series(sorted(spec.shipped()), 6))
def test_every_shipped_sweep_runs(name: str) -> None:
    sweep = spec.load(name)
    execution.check_columns(sweep, schema_of(sweep, list(cells(sweep))))
    for cell in cells(sweep):
        with suppress(Unworkable):
            assert setting_of(sweep, cell).scenario.name == sweep.base["name"]
    assert f"{name:10} " in tandem("scenarios").out


@pytest.mark.long
def test_the_sweep_of_noise_has_the_same_starts_in_every_cell() -> None:
    sweep = spec.load("noise")
    settings = [setting_of(sweep, cell) for cell in cells(sweep)]
    assert {cell.key for cell in cells(sweep)} == {"{}"}
    assert len(settings) == (15 * 2 + 4) * 2
    missions = set()
    hard = set()
    starts = set()
    for setting in settings:
        scenario = setting.seeded(7)
        starts.add(tuple(robot.start for robot in scenario.robots))
        mission, noise = scenario.mission, scenario.mission.noise
        if noise.drop_outs or noise.odometry.v_floor or noise.odometry.omega_floor:
            hard.add((noise.drop_outs, noise.odometry.v_floor, noise.odometry.omega_floor))
            continue
        fractions = {noise.odometry.v, noise.odometry.omega, noise.actuation.v, noise.actuation.omega}
        (fraction,) = fractions
        assert noise.anchor_sigma == noise.mutual_sigma
        fine = 0.03 if noise.anchor_sigma <= 0.01 else 0.1
        assert mission.accuracy == (0.3 if fraction >= 0.01 else fine)
        missions.add((noise.anchor_sigma, fraction, noise.outliers, scenario.planner_name))
    assert len(starts) == 1
    planners = ("paper", "assured")
    known = product((0, 0.001, 0.01, 0.05, 0.1), (0, 0.001, 0.01), (0, 0.05), planners)
    assert missions == {*known, *product((0.05,), (0.05,), (0,), planners)}
    assert hard == {(0.3, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, 0.02)}


@pytest.mark.parametrize(("name", "told"), [("mismatch", 1), ("mismatch-uwb", 2)])
def test_the_sensors_of_each_row_of_mismatch_differ_whatever_robots_are_told(name: str, told: int) -> None:
    sweep = spec.load(name)
    scenarios = [setting_of(sweep, cell).scenario for cell in cells(sweep)]
    labels = [sweep.axes[-1].label(cell.place[-1]) for cell in cells(sweep)]
    informed = [place for place, label in enumerate(labels) if label.endswith(", told")]
    assert informed
    for place in informed:
        one, before = scenarios[place], scenarios[place - 1]
        assert one.world_noise == before.world_noise, (
            f"{labels[place]}: it tells what the row before does not"
        )
        told_of = {"range_delay": 0.1, "odometry_strays": 0.02}
        news = {name: value for name, value in told_of.items() if getattr(one.mission.noise, name) == value}
        assert len(news) == 1 or one.mission.noise.profile is not None
        assert one.mission.noise == replace(before.mission.noise, **news)
        assert one.mission.noise != before.mission.noise
    scenarios = [one for place, one in enumerate(scenarios) if place not in informed]
    assert {cell.key for cell in cells(sweep)} == {"{}"}
    assert scenarios[0].sensors.noise == scenarios[0].mission.noise
    of_noise: dict[Noise, list[WorldNoise | None]] = {}
    for one in scenarios:
        of_noise.setdefault(one.mission.noise, []).append(one.world_noise)
    assert len(of_noise) == told
    first = next(iter(of_noise.values()))
    for sensors in of_noise.values():
        assert sensors == first
        assert all(one not in sensors[:i] for i, one in enumerate(sensors))


ROWS = """
name = "rows"
scenario = "base.toml"
trials = 2
seed = 5
[set]
"mission.noise.anchor_sigma" = 0.01
"mission.noise.mutual_sigma" = 0.01
"mission.accuracy" = 0.2
[[axis]]
name = "sensors"
paired = true
rows = [
    {label = "as told", set = {}},
    {label = "10 % outliers", set = {"world.noise.outliers" = 0.1}},
    {label = "a is biased", set = {"world.noise.anchor_bias" = {a = 0.1}, "mission.accuracy" = 0.3}},
]
"""


@pytest.mark.long
def test_rows_differ_from_the_base_in_the_fields_that_they_set(folder: Path) -> None:
    (folder / "rows.toml").write_text(ROWS)
    results = played(folder, "rows.toml", "out")
    settings = [setting_of(results.sweep, cell) for cell in cells(results.sweep)]
    found = []
    for setting in settings:
        assert setting.scenario.mission.noise == Noise(anchor_sigma=0.01, mutual_sigma=0.01)
        noise = setting.scenario.world_noise or WorldNoise()
        found.append((setting.scenario.mission.accuracy, noise.outliers, noise.anchor_bias))
    assert found == [(0.2, None, 0.0), (0.2, 0.1, 0.0), (0.3, None, {"a": 0.1})]
    fields = ("sensors", "world.noise.outliers", "world.noise.anchor_bias", "mission.accuracy")
    assert [tuple(row[name] for name in fields) for row in rows(folder / "out")[::2]] == [
        ("as told", None, None, None),
        ("10 % outliers", 0.1, None, None),
        ("a is biased", None, '{"a":0.1}', 0.3),
    ]
    assert len({row["seed"] for row in rows(folder / "out")}) == 2, "the same starts in all rows"
    assert [tuple(row[name] for name in fields) for row in summary_rows(folder / "out")] == [
        ("as told", "", "", ""),
        ("10 % outliers", "0.1", "", ""),
        ("a is biased", "", '{"a":0.1}', "0.3"),
    ]
    assert label(results.sweep, list(cells(results.sweep))[1]) == "sensors = 10 % outliers"


@pytest.mark.parametrize(
    ("was", "new", "says"),
    [
        ("rows = [", "values = [1]\nrows = [", "axis[0]: needs either 'values' or 'rows'"),
        ('name = "sensors"', "", "axis[0].name: missing: an axis with 'rows' needs a name"),
        ("paired = true", 'labels = ["x"]', "axis[0].labels: an axis with 'rows' has none"),
        ('"as told"', '"a is biased"', "axis[0].rows[2].label: equal to that of rows[0]"),
        ('label = "as told", ', "", "axis[0].rows[0]: missing field 'label'"),
        ("noise.outliers", "noise.outlier", "axis[0].rows[1].set: 'world.noise.outlier': world.noise has no"),
        (
            'outliers" = 0.1',
            'outliers" = nan',
            "axis[0].rows[1].set: 'world.noise.outliers': must be a number",
        ),
        (
            '"mission.accuracy" = 0.3',
            '"world.noise" = {}',
            "axis[0].rows[2].set: 'world.noise' is already set by",
        ),
        ('"mission.accuracy" = 0.2', '"mission.acuracy" = 1', "set: 'mission.acuracy': mission has no field"),
        ('outliers" = 0.1', 'outliers" = 1.0', "cell 1 (sensors = 10 % outliers): world.noise.outliers: "),
    ],
)
def test_a_mistake_in_a_row_is_one_line_that_names_it(was: str, new: str, says: str, folder: Path) -> None:
    assert was in ROWS
    (folder / "bad.toml").write_text(ROWS.replace(was, new, 1))
    with pytest.raises(UserError) as refused:
        played(folder, "bad.toml", "out")
    assert str(refused.value).startswith(f"{folder / 'bad.toml'}: {says}")


# --- invalid sweep files ----------------------------------------------------------------------------

AXIS = 'field = "robot.b.anchor[0]"\nvalues = [10.0, 8]'
JOINT = 'name = "both"\nfields = ["mission.period", "mission.max_speed"]\nvalues = [[1.0, 1.0], [0.5, 1.0]]'


@pytest.mark.parametrize(
    ("was", "new", "says"),
    [
        ('name = "both"', "name = 1", "name: expected"),
        ('name = "both"', 'name = "a b"', "name: invalid name"),
        ("trials = 12", "", "missing field 'trials'"),
        ("trials = 12", "trials = 0", "trials: "),
        ("trials = 12", 'trials = "12"', "trials: "),
        ("trials = 12", "trails = 12", "unknown field 'trails'"),
        ("seed = 5", "seed = -1", "seed: "),
        ("seed = 5", "trial_timeout = 0", "trial_timeout: "),
        ("base.toml", "absent.toml", "scenario: 'absent.toml' is neither"),
        ("base.toml", "both.toml/x", "scenario: "),
        ("name", "name = ", "not TOML"),
        ("paired = true", "paird = true", "axis[1]: unknown field 'paird'"),
        (
            "robot.b.anchor[0]",
            "robot.b.anker",
            "axis[0].field: 'robot.b.anker': robot[1] has no field 'anker'",
        ),
        (
            "robot.b.anchor[0]",
            "robot.c.anchor",
            "axis[0].field: 'robot.c.anchor': the base scenario has no robot",
        ),
        (
            "robot.b.anchor[0]",
            "robot[2].anchor",
            "axis[0].field: 'robot[2].anchor': the base scenario has no",
        ),
        (
            "robot.b.anchor[0]",
            "mission.noise.odometry.w",
            "axis[0].field: 'mission.noise.odometry.w': mission.noise.odometry has no field 'w'",
        ),
        (
            "robot.b.anchor[0]",
            "mission.noise.outlier_bias[0]",
            "axis[0].field: 'mission.noise.outlier_bias[0]': the base scenario has no mission.noise.out",
        ),
        ("robot.b.anchor[0]", "robot..anchor", "axis[0].field: 'robot..anchor': not a path"),
        (
            "robot.b.anchor[0]",
            "mission.period.x",
            "axis[0].field: 'mission.period.x': mission.period is a single",
        ),
        ("robot.b.anchor[0]", "seed", "axis[0].field: 'seed': every trial has its own seed"),
        ("robot.b.anchor[0]", "planner", "axis[1]: 'planner.name' is already set by axis[0] ('planner')"),
        ("robot.b.anchor[0]", "planner.name", "axis[1]: another axis has the name 'planner.name'"),
        ("[10.0, 8]", "[]", "axis[0].values: "),
        ("[10.0, 8]", "[8, 8.0]", "axis[0].values[1]: equal to values[0]"),
        ("[10.0, 8]", "[8, 1979-05-27]", "axis[0].values[1]: must be a number"),
        ("[10.0, 8]", "[8, nan]", "axis[0].values[1]: must be a number"),
        (
            "[10.0, 8]",
            '[8, "x"]',
            "cell 2 (robot.b.anchor[0] = x; planner.name = paper): robot[1].anchor[0]: ",
        ),
        ("[10.0, 8]", "[8, 0]", "cell 2 (robot.b.anchor[0] = 0; planner.name = paper): robot[1].anchor: "),
        ('field = "robot.b.anchor[0]"', "", "axis[0]: needs either 'field', or 'name'"),
        (AXIS, AXIS + '\nlabels = ["x", "y"]', "axis[0].name: missing"),
        (AXIS, AXIS + '\nname = "D"\nlabels = ["x", "x"]', "axis[0].labels: must be 2 different labels"),
        (AXIS, AXIS + '\nname = "rate"\nlabels = ["x", "y"]', "axis: 2 columns would have the name 'rate'"),
        (AXIS, JOINT.replace('name = "both"', ""), "axis[0].name: missing"),
        (AXIS, JOINT.replace("[0.5, 1.0]", "[0.5]"), "axis[0].values[1]: must be a list of 2 values"),
        (
            AXIS,
            JOINT.replace("mission.period", "mission.perod"),
            "axis[0].fields[0]: 'mission.perod': mission has no",
        ),
    ],
)
def test_a_mistake_in_a_spec_is_one_line_that_names_the_field(
    was: str, new: str, says: str, folder: Path
) -> None:
    assert was in BOTH
    (folder / "bad.toml").write_text(BOTH.replace(was, new, 1))
    with pytest.raises(UserError) as refused:
        played(folder, "bad.toml", "out")
    assert str(refused.value).startswith(f"{folder / 'bad.toml'}: {says}")
    assert not (folder / "out").exists()


def test_a_mistake_in_a_spec_is_one_line_and_status_2(folder: Path) -> None:
    for new in ("[8, 0]", "[8, 8.0]"):
        (folder / "bad.toml").write_text(BOTH.replace("[10.0, 8]", new))
        ended = sweep(folder, "bad.toml", "out")
        assert ended.status == 2
        assert ended.out == ""
        assert re.fullmatch(r"tandem sweep: bad\.toml: [^\n]+\n", ended.err), ended.err


def test_a_spec_that_is_not_there_is_named() -> None:
    refused(
        tandem("sweep", "nowhere"),
        "tandem sweep: nowhere: neither a file nor a shipped sweep (anchors, any-start, ",
    )


def test_refused_trials_do_not_make_the_chunks_small(folder: Path) -> None:
    slow = '[[draw]]\nfield = "mission.max_speed"\nlog_uniform = [1e-6, 1e-5]\n'
    (folder / "slow.toml").write_text(f'name = "slow"\nscenario = "base.toml"\ntrials = 400\n{slow}')
    chunks: list[int] = []
    results = played(folder, "slow.toml", "out", done=chunks.append)
    assert results.table["outcome"].to_pylist() == ["refused"] * 400
    assert len(chunks) < 80


@pytest.mark.long
def test_a_sweep_of_draws_counts_what_it_refused_and_resumes(folder: Path) -> None:
    words = ("anywhere", "--trials", "80", "--workers", "1", "--no-audit")
    with TandemProcess("sweep", *words, "--out", "out", cwd=folder) as command:
        command.until(lambda: parts(folder / "out"), "a chunk is done")
        command.tell(SIGINT)
        assert command.ended().status == 130
    found = rows(folder / "out")
    assert 0 < len(found) < 80
    ended = tandem("sweep", *words, "--out", "out", cwd=folder)
    assert ended.status == 0, ended.err
    straight = tandem("sweep", *words, "--out", "straight", cwd=folder)
    finished = rows(folder / "out")
    assert finished == rows(folder / "straight")
    assert all(row in finished for row in found)
    refused = [row for row in finished if row["outcome"] == "refused"]
    assert 0 < len(refused) < 20
    assert all("to a micrometre in double precision" in row["reason"] for row in refused)
    assert all(row["ticks"] is None for row in refused)
    counts = f"{80 - len(refused)} localised, {len(refused)} refused of 80 trials"
    assert counts in ended.out
    assert counts in straight.out
    (summary,) = summary_rows(folder / "out")
    first = f"trial {refused[0]['trial']} of cell 0: {refused[0]['reason']}"
    said = " ".join(straight.out.split())
    assert f"{len(refused)} trials refused; the first is {first[:60]}" in said
    assert (summary["trials"], summary["refused_trials"]) == (str(80 - len(refused)), str(len(refused)))
