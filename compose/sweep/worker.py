"""The process in which trials run, forked from a fork server that has imported this module.

It is asked for chunks on its standard input and answers a row a trial on its standard output, each a frame:
its length in four bytes, and msgpack. It ends with its standard input, even while a trial never does.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from functools import cache
from importlib import import_module
from queue import Empty, SimpleQueue
from typing import Any, BinaryIO

import msgspec
from msgspec.structs import replace

from compose.errors import Unworkable
from compose.scenario.scenario_file import ScenarioTemplate, validate
from compose.sweep import trial
from compose.sweep.draws import Draws
from protocol.output import one_line

PLAY = "compose.sweep.trial:play"
"""what plays a trial"""
READY = b""
"""the first frame: everything is imported"""
LENGTH_BYTES = 4
MAX_ERROR = 300
"""characters"""
IDLE_S = 300.0
"""how long to wait for work: whoever ran the sweep may have been killed, and the owner live on"""


class Chunk(msgspec.Struct, frozen=True):
    """Trials of one cell."""

    cell: int
    trials: tuple[int, ...]
    seeds: tuple[int, ...]
    """of each trial"""
    setting: ScenarioTemplate
    processes: bool
    timeout: float
    """s of wall time that a trial may last"""
    play: str = PLAY
    """module:function, from a trial to its row"""
    audit: bool = False
    """each of them"""
    draws: Draws = Draws()
    """what each of them draws in its scenario's file"""
    table: dict[str, Any] = {}
    """that file, where there are draws"""

    def after(self, done: int) -> Chunk:
        """What is left of it after so many trials."""
        return msgspec.structs.replace(self, trials=self.trials[done:], seeds=self.seeds[done:])


def warm_up() -> None:
    """Get ready to fork such processes: importing this module is all."""


def main() -> None:
    """Answer until standard input ends."""
    folder = sys.argv[1]
    tempfile.tempdir = folder  # its owner removes it, whatever a trial left there
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a trial prints is no answer
    chunks: SimpleQueue[Chunk] = SimpleQueue()
    threading.Thread(target=_listen, args=(chunks, folder), daemon=True).start()
    try:
        _play(chunks, answers)
    finally:  # nobody waits for the answers, or nobody has asked for long
        shutil.rmtree(folder, ignore_errors=True)


def _play(chunks: SimpleQueue[Chunk], answers: BinaryIO) -> None:
    _answer(answers, READY)
    encoder = msgspec.msgpack.Encoder()
    while True:
        try:
            chunk = chunks.get(timeout=IDLE_S)
        except Empty:
            return
        for number, seed in zip(chunk.trials, chunk.seeds, strict=True):
            _answer(answers, encoder.encode(_played(chunk, number, seed)))


def _listen(chunks: SimpleQueue[Chunk], folder: str) -> None:
    decoder = msgspec.msgpack.Decoder(Chunk)
    try:
        while (head := sys.stdin.buffer.read(LENGTH_BYTES)) != b"":
            chunks.put(decoder.decode(sys.stdin.buffer.read(int.from_bytes(head, "big"))))
    finally:  # whoever asked has gone
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(0)


def _answer(answers: BinaryIO, body: bytes) -> None:
    answers.write(framed(body))
    answers.flush()


def framed(body: bytes) -> bytes:
    """`body` with its length in front."""
    return len(body).to_bytes(LENGTH_BYTES, "big") + body


def _played(chunk: Chunk, number: int, seed: int) -> trial.TrialRow:
    began = time.perf_counter()
    try:
        player = _function(chunk.play)
        setting, drawn = chunk.setting, {}
        if chunk.draws:
            table = chunk.draws.table(chunk.table, seed)
            drawn = chunk.draws.values(table)
            try:
                setting = validate(table, "its draws")
            except Unworkable as error:
                return trial.refused(chunk.cell, number, seed, str(error).removeprefix("its draws: "), drawn)
        scenario = setting.seeded(seed)
        kills = setting.kills(seed) if setting.file.kill else None
        row = player(trial.Trial(chunk.cell, number, scenario, chunk.processes, chunk.audit, kills))
        return replace(row, drawn=drawn) if drawn else row
    except BaseException as error:  # noqa: BLE001  # a trial that tries to end the process is lost, too
        said = one_line(f"{type(error).__name__}: {error}")[:MAX_ERROR]
        return trial.lost(chunk.cell, number, seed, said, time.perf_counter() - began)


@cache
def _function(path: str) -> Callable[[trial.Trial], trial.TrialRow]:
    module, _, name = path.partition(":")
    found: Callable[[trial.Trial], trial.TrialRow] = getattr(import_module(module), name)
    return found
