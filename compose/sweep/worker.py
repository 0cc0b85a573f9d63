"""The process in which trials run, forked from a fork server that has imported this module.

It receives chunks from its launcher, and sends one row per trial, both as msgpack, then READY. The process
ends when the connection is closed, even during a trial that hangs.
"""

from __future__ import annotations

import os
import select
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any

import msgspec
from msgspec.structs import replace

from compose.errors import Unworkable
from compose.launch.class_loader import trust
from compose.launch.forked import launcher
from compose.launch.model_loader import trust_all
from compose.scenario.scenario_file import ScenarioTemplate, validate
from compose.sweep import trial
from compose.sweep.draws import Draws
from protocol.output import one_line

PLAY = "compose.sweep.trial:run_trial"
"""The default function that runs a trial."""
READY = b""
"""The message for more work: the first one, when all modules are imported, and the last one of a chunk."""
CHUNK_S = 1.0
"""The wall time in s after which a process leaves the rest of a chunk to others.

It is long compared to the overhead of a chunk, and short enough to lose.
"""
MAX_ERROR = 300
"""The largest length of an error text, in characters."""
WORKER_IDLE_S = 300.0
"""The time in s without work after which the process ends.

The command that started the sweep may have been killed while the Dask worker that owns this process lives on.
"""


class TrialOptions(msgspec.Struct, frozen=True):
    """The options that all trials of a sweep have in common."""

    processes: bool
    """true to run trials as processes over Zenoh"""
    timeout: float
    """wall time in s that a trial may take"""
    play: str = PLAY
    """function that runs a Trial and returns its TrialRow, as module:function"""
    audit: bool = False
    """true to audit the journals of every trial"""
    draws: Draws = Draws()
    """values drawn for each trial"""


class Chunk(msgspec.Struct, frozen=True):
    """Trials of one cell that a process runs in sequence, as many as it can in CHUNK_S, but at least one."""

    cell: int
    trials: tuple[int, ...]
    """indices of the trials within the cell"""
    seeds: tuple[int, ...]
    """seed of each trial"""
    setting: ScenarioTemplate
    options: TrialOptions
    table: dict[str, Any] = {}
    """parsed table of the cell's scenario file; empty without draws"""

    def split(self, size: int) -> tuple[Chunk, list[Chunk]]:
        """Return the chunk with its first `size` trials only, and one with the others if there are any."""
        parts = [
            replace(self, trials=self.trials[part], seeds=self.seeds[part])
            for part in (slice(size), slice(size, None))
        ]
        return parts[0], parts[1:] if parts[1].trials else []


def main() -> None:
    """Run trials until the connection is closed, or until there has been no work for WORKER_IDLE_S."""
    tempfile.tempdir = sys.argv[1]  # removed by the owner, with all files that trials leave in it
    threading.Thread(target=_end_with_owner, daemon=True).start()
    owner, encoder, decoder = launcher(), msgspec.msgpack.Encoder(), msgspec.msgpack.Decoder(Chunk)
    try:
        owner.send_bytes(READY)
        while owner.poll(WORKER_IDLE_S):
            chunk = decoder.decode(owner.recv_bytes())
            began = time.monotonic()
            for number, seed in zip(chunk.trials, chunk.seeds, strict=True):
                owner.send_bytes(encoder.encode(played(chunk, number, seed)))
                if time.monotonic() - began > CHUNK_S:
                    break
            owner.send_bytes(READY)
    finally:  # the owner is gone, or there was no work for WORKER_IDLE_S
        shutil.rmtree(sys.argv[1], ignore_errors=True)


def _end_with_owner() -> None:
    """End the process once the connection is closed, and remove its files."""
    connection = select.poll()
    connection.register(launcher(), 0)  # the end of a connection is reported in any case
    connection.poll()
    shutil.rmtree(sys.argv[1], ignore_errors=True)
    os._exit(0)


def played(chunk: Chunk, number: int, seed: int) -> trial.TrialRow:
    """Run one trial, and return its row. An exception gives the row of a lost trial."""
    began, options = time.perf_counter(), chunk.options
    try:
        player = _function(options.play)
        setting, drawn = chunk.setting, {}
        trust(setting.scenario.planner_name)  # the user has named it in the scenario or in the sweep
        trust_all(setting.scenario)
        try:
            if options.draws:
                table = options.draws.table(chunk.table, seed)
                drawn = options.draws.values(table)
                setting = validate(table, "its draws")
            scenario = setting.seeded(seed)
        except Unworkable as error:
            why = str(error).removeprefix("its draws: ").removeprefix(f"{setting.source}: ")
            return trial.refused(chunk.cell, number, seed, why, drawn)
        kills = setting.kills(seed) if setting.file.kill else None
        row = player(trial.Trial(chunk.cell, number, scenario, options.processes, options.audit, kills))
        return replace(row, drawn=drawn) if drawn else row
    except BaseException as error:  # noqa: BLE001  # SystemExit from a trial must not end the process
        why = error_text(f"{type(error).__name__}: {error}")
        return trial.lost(chunk.cell, number, seed, why, time.perf_counter() - began)


def error_text(text: str) -> str:
    """Return `text` as the error of a row: one line of at most MAX_ERROR characters."""
    return one_line(text)[:MAX_ERROR]


@cache
def _function(path: str) -> Callable[[trial.Trial], trial.TrialRow]:
    """Return the function at `path`, as module:function."""
    module, _, name = path.partition(":")
    found: Callable[[trial.Trial], trial.TrialRow] = getattr(import_module(module), name)
    return found
