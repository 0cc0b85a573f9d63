"""The rows of a sweep depend only on its sweep file, not on its workers or on failures."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from signal import SIGCONT, SIGINT, SIGKILL, SIGSTOP, SIGTERM

import pytest
from distributed import Client

from compose.errors import UserError
from compose.sweep import cluster
from tests.commands import TandemProcess, tandem, until
from tests.sweep_runs import (
    nothing_left,
    parts,
    played,
    rows,
    summary_rows,
    sweep,
    trial_processes,
    with_files,
)

HOUSE = Path(__file__).parents[1]


@pytest.fixture(autouse=True)
def nothing_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with nothing_left(tmp_path, monkeypatch):
        yield


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return with_files(tmp_path)


def sweep_up(folder: Path) -> None:
    """Remove the files that a killed command could not."""
    for left in (folder / "tmp").glob("tandem-dask-*"):
        shutil.rmtree(left)


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
    played(folder, "lengthy.toml", "here", audit=False)
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
            words = ("lengthy.toml", "--out", out, "--scheduler", address, "--no-audit")
            return TandemProcess("sweep", *words, cwd=folder)

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
    words = ("lengthy.toml", "--out", "out", "--workers", "1", "--trials", "15", "--no-audit")
    with TandemProcess("sweep", *words, cwd=folder) as command:
        command.until(lambda: parts(folder / "out"), "a chunk is done")
        command.tell(SIGSTOP)
        time.sleep(6.0)  # longer than ten heartbeats of a worker, which are 0.5 s apart
        command.tell(SIGCONT)
        assert command.ended().status == 1  # some of the missions are undecided
    assert len(rows(folder / "out")) == 30


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


@pytest.mark.long
def test_a_folder_in_use_is_refused(folder: Path) -> None:
    with misbehaving("endless", "both.toml", folder) as process:
        until(lambda: list(folder.glob("tmp/*/playing")), "trials are played")
        with pytest.raises(UserError, match="out is in use by another sweep"):
            played(folder, "both.toml", "out")
        os.killpg(process.pid, SIGTERM)
        process.communicate(timeout=30.0)


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
