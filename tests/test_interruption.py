"""Ctrl-C and signals to the same effect end every command with exit status 130 and without a traceback."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from signal import SIGHUP, SIGINT, SIGTERM, Signals

import pytest

from tests.commands import BOUND_S, ENDLESS, Ended, TandemProcess, size
from tests.series import series

HOUSE = Path(__file__).parents[1]
SIGNALLED = """
import runpy, signal, sys

class Finder:
    def find_spec(self, name, *_):
        imports = sys._getframe(2).f_code.co_name == "_find_and_load_unlocked"
        if name == "MODULE" and imports:
            signal.raise_signal(signal.SIGNAL)

sys.meta_path.insert(0, Finder())
runpy.run_module("tandem", run_name="__main__", alter_sys=True)
"""
"""The program `tandem`, which receives a signal just before it imports MODULE, not where it looks for it."""
AT_EXIT = """
import atexit, runpy, signal

atexit.register(signal.raise_signal, signal.SIGINT)
runpy.run_module("tandem", run_name="__main__", alter_sys=True)
"""
"""The program `tandem`, which receives a signal when it exits."""
LOST = """
import signal
from compose.launch.signals import INTERRUPTION

class Finalized:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)

INTERRUPTION.begin("tandem run")
Finalized()
print("went on")
"""
"""A program whose finalizer receives a signal: Python only prints errors there."""


def program(code: str, *words: str | Path) -> Ended:
    """Return the result of a program with the arguments `words`."""
    ended = subprocess.run(
        [sys.executable, "-c", code, *words],
        env={**os.environ, "PYTHONPATH": str(HOUSE)},
        capture_output=True,
        text=True,
        timeout=BOUND_S,
        check=False,
    )
    return Ended(ended.returncode, ended.stdout, ended.stderr)


def signalled(module: str, number: Signals, *words: str | Path) -> Ended:
    """Return the result of `tandem WORDS`, which receives a signal just before it imports `module`."""
    return program(SIGNALLED.replace("MODULE", module).replace("SIGNAL", number.name), *words)


@pytest.mark.parametrize(
    "module", series(["argparse", "datetime", "tandem.clash", "compose.cli.main", "compose.cli.commands"], 2)
)
def test_ctrl_c_while_tandem_starts_ends_it_without_output(module: str) -> None:
    assert signalled(module, SIGINT, "scenarios") == (130, "", "")


@pytest.mark.parametrize(
    "start",
    series(
        [
            ("sweep any-start --out OUT", "distributed"),
            ("figures RECORDING", "matplotlib"),
            ("audit RECORDING", "numpy"),
            ("replay RECORDING", "numpy"),
            ("export RECORDING --html --out OUT", "compose.view.web.standalone"),
            ("export RECORDING --out OUT", "foxglove"),
            ("watch RECORDING", "uvicorn"),
            ("check-planner assured", "compose.audit.rules"),
            ("run paper-1 --secure --out OUT", "cryptography"),
            ("doctor", "compose.doctor.machine_checks"),
            ("run paper-1 --in-process --out OUT", "numpy"),
            ("run paper-1 --out OUT", "compose.launch.processes"),
            ("estimate RECORDING", "numpy"),
            ("calibrate RECORDING", "numpy"),
        ],
        3,
    ),
)
def test_ctrl_c_while_a_command_starts_is_one_line(
    start: tuple[str, str], paper_1: Path, tmp_path: Path
) -> None:
    words, module = start
    places = {"RECORDING": str(paper_1), "OUT": str(tmp_path / "out")}
    command, *arguments = [places.get(word, word) for word in words.split()]
    ended = signalled(module, SIGINT, command, *arguments)
    assert ended == (130, "", f"tandem {command}: stopped by SIGINT\n")


def test_ctrl_c_when_a_command_has_ended_does_not_change_its_exit_status() -> None:
    assert program(AT_EXIT, "--version").status == 0
    assert program(AT_EXIT, "scenarios").status == 0


def test_a_signal_whose_error_python_drops_ends_the_command_with_its_line_all_the_same() -> None:
    assert program(LOST) == (130, "", "tandem run: stopped by SIGINT\n")


@pytest.mark.parametrize("number", series([SIGINT, SIGTERM, SIGHUP]), ids=lambda number: number.name)
@pytest.mark.parametrize(
    ("words", "reached"),
    [
        (["run", "SCENARIO", "--in-process", "-q"], lambda _, out: size(out / "world.journal") > 10_000),
        pytest.param(
            ["figures", "RECORDING", "--format", "svg"],
            lambda _, out: any((out.parent / "recording" / "figures").glob("*.svg")),
            marks=pytest.mark.long,
        ),
    ],
    ids=["run", "figures"],
)
def test_a_command_that_is_stopped_while_it_works_says_so(
    words: list[str],
    reached: Callable[[TandemProcess, Path], bool],
    number: Signals,
    paper_1: Path,
    tmp_path: Path,
) -> None:
    (tmp_path / "endless.toml").write_text(ENDLESS)
    shutil.copytree(paper_1, tmp_path / "recording")
    places = {"RECORDING": str(tmp_path / "recording"), "SCENARIO": str(tmp_path / "endless.toml")}
    out = tmp_path / "out"
    arguments = [places.get(word, word) for word in words] + (["--out", str(out)] if "run" in words else [])
    with TandemProcess(*arguments) as command:
        command.until(lambda: reached(command, out), "it works")
        assert command.tell(number)
        ended = command.ended()
    assert (ended.status, ended.err) == (130, f"tandem {words[0]}: stopped by {number.name}\n")
    if "run" in words:
        summary = json.loads((out / "summary.json").read_text())
        assert (summary["reason"], summary["mode"]) == (f"stopped by {number.name}", "in-process")


def test_a_command_under_nohup_outlives_its_terminal(tmp_path: Path) -> None:
    (tmp_path / "endless.toml").write_text(ENDLESS)
    out = tmp_path / "out"
    words = ("run", tmp_path / "endless.toml", "--in-process", "-q", "--out", out)
    with TandemProcess(*words, through=["nohup"]) as command:
        command.until_written(out / "world.journal", 10_000)
        command.tell(SIGHUP)
        command.until_written(out / "world.journal", size(out / "world.journal") + 10_000)
        command.tell(SIGINT)
        ended = command.ended()
    assert ended.status == 130
    assert ended.err.endswith("tandem run: stopped by SIGINT\n")
