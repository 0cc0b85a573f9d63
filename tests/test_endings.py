"""A run that is stopped, or loses a process, ends with a reason, and every command ends by Ctrl-C."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from itertools import cycle
from pathlib import Path
from random import Random
from signal import SIGHUP, SIGINT, SIGKILL, SIGSTOP, SIGTERM, Signals

import pytest

from compose.launch.page_process import PageProcess
from compose.launch.processes import free_endpoint
from compose.launch.supervisor import Supervisor
from protocol.network.diagnosis import MUTE
from protocol.network.inbox import Arrival, Inbox, Interrupted
from tests.commands import (
    BOUND_S,
    ENDLESS,
    LONG,
    LONG_JOURNAL_BYTES,
    LONG_TICKS,
    Ended,
    TandemProcess,
    process_of,
    processes_of,
    size,
    tandem,
    until,
    world,
)
from tests.series import series

PATIENT = ("--timeout", "600")
"""A timeout in s that no test waits for: a process that has ended did so for another reason."""
TIMEOUT = "5"
"""The timeout in s. It is longer than a busy machine takes to connect a process."""

draw = Random(7).random
Moment = Callable[[TandemProcess, Path], bool]


def journaled(bytes_written: int) -> Moment:
    return lambda _run, out: size(out / "world.journal") >= bytes_written


def processes(number: int) -> Moment:
    return lambda run, out: ready(run, out) and len(processes_of(out)) >= number


def ready(run: TandemProcess, _out: Path) -> bool:
    """Return whether the command has set its handlers: as it starts, Python itself has none for SIGHUP."""
    return run.catches(SIGHUP)


def concluded(_run: TandemProcess, out: Path) -> bool:
    return (out / "summary.json").exists()


MOMENTS: dict[str, Moment] = {
    "ready": ready,
    **{f"{number} processes": processes(number) for number in (2, 3, 4)},
    **{f"{size} bytes": journaled(size) for size in sorted(int(200_000 * draw()) for _ in range(8))},
}
LAST_MOMENTS: dict[str, Moment] = {
    "99.9 %": journaled(int(0.999 * LONG_JOURNAL_BYTES)),
    "concluded": concluded,
}
SIGNALS = dict(zip([*MOMENTS, *LAST_MOMENTS], cycle([SIGINT, SIGTERM]), strict=False))
"""The signal that is sent at each moment: both in turn."""


@pytest.fixture
def long(tmp_path: Path) -> Path:
    """Return the file of a scenario with a long run."""
    path = tmp_path / "long.toml"
    path.write_text(LONG)
    return path


# --- stopped by a signal ----------------------------------------------------------------------------


@pytest.mark.parametrize("moment", series(MOMENTS, 2))
def test_an_interrupted_run_reports_it_and_leaves_no_process(
    moment: str, endless: Path, tmp_path: Path
) -> None:
    out, number = tmp_path / "out", SIGNALS[moment]
    with TandemProcess("run", endless, "--out", out, "-q", *PATIENT) as run:
        run.until(lambda: MOMENTS[moment](run, out), moment)
        run.tell(number)
        ended = run.ended()
    assert ended == (130, "", f"tandem run: stopped by {number.name}\n")
    assert not processes_of(out)


def test_a_signal_that_does_not_interrupt_a_wait_ends_it_all_the_same() -> None:
    inbox = Inbox("the test")
    main = threading.main_thread().ident
    before = signal.signal(signal.SIGUSR1, lambda *_: inbox.put("stop", "SIGUSR1"))

    def waits() -> bool:
        return sys._current_frames()[main or 0].f_code is Inbox._queued.__code__

    def take() -> None:  # the main thread is not interrupted, as if the signal came just before its wait
        until(waits, "the main thread waits")
        signal.raise_signal(signal.SIGUSR1)

    other = threading.Thread(target=take)
    try:
        other.start()
        with pytest.raises(Interrupted, match="SIGUSR1"):
            inbox.next(BOUND_S)
    finally:
        other.join()
        signal.signal(signal.SIGUSR1, before)


@pytest.mark.parametrize("moment", series(LAST_MOMENTS, 0))
def test_a_run_interrupted_as_it_ends_reports_the_outcome_or_the_interruption(
    moment: str, long: Path, tmp_path: Path
) -> None:
    out, number = tmp_path / "out", SIGNALS[moment]
    with TandemProcess("run", long, "--out", out, "-q", *PATIENT) as run:
        until(lambda: LAST_MOMENTS[moment](run, out) or not run.running, moment)
        run.tell(number)
        ended = run.ended()
    assert not processes_of(out)
    if ended.status == 130:
        assert ended[1:] == ("", f"tandem run: stopped by {number.name}\n")
    else:  # the signal may arrive after the FinalReport
        assert ended.status == 0
        assert ended[1:] == (f"localised after {LONG_TICKS} ticks\n", "")


@pytest.mark.parametrize("delay", series([round(0.15 * draw(), 3) for _ in range(6)]))
def test_a_run_interrupted_while_it_starts_leaves_no_process(
    delay: float, endless: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with TandemProcess("run", endless, "--out", out, "-q", *PATIENT) as run:
        began = time.monotonic()
        run.until(lambda: time.monotonic() >= began + delay, f"{delay} s have passed")
        run.tell(SIGTERM)
        ended = run.ended()
    assert not processes_of(out)
    if ended.status != -SIGTERM:  # Python was not yet started
        assert ended.status == 130
        assert ended[1:] in (("", ""), ("", "tandem run: stopped by SIGTERM\n"))


def test_a_second_ctrl_c_changes_nothing(endless: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with TandemProcess("run", endless, "--out", out, "-q", *PATIENT) as run:
        run.until_written(out / "world.journal", 10_000)
        until(lambda: not run.tell(SIGINT), "it ends, told again and again")
        ended = run.ended()
    assert not processes_of(out)
    assert ended.status == 130
    assert "Traceback" not in ended.err


@pytest.mark.parametrize("number", series([SIGINT, SIGTERM]), ids=["SIGINT", "SIGTERM"])
def test_an_interrupted_world_and_agent_report_it(number: signal.Signals) -> None:
    with world("paper-1") as (clock, endpoint):
        with TandemProcess("agent", "a", "--connect", endpoint, *PATIENT) as agent:
            agent.until_prints("a: in run")
            agent.tell(number)
            assert agent.ended()[::2] == (130, f"tandem agent a: stopped by {number.name}\n")
        clock.tell(number)
        assert clock.ended()[::2] == (130, f"tandem world: stopped by {number.name}\n")


def test_an_agent_that_searches_for_a_world_can_be_interrupted() -> None:
    with TandemProcess("agent", "a", "--connect", free_endpoint()) as agent:
        agent.until(lambda: agent.catches(SIGHUP), "it is ready")
        agent.tell(SIGINT)
        ended = agent.ended()
    assert ended.status == 130
    assert re.fullmatch(r"tandem agent( a)?: stopped by SIGINT\n", ended.err)


# --- loss of a process ------------------------------------------------------------------------------


@pytest.mark.parametrize("child", series(["world", "agent b", "agent a"], 2))
def test_a_process_that_dies_ends_the_run_at_once_and_is_named(
    child: str, endless: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with TandemProcess("run", endless, "--out", out, "-q", *PATIENT) as run:
        run.until_written(out / "world.journal", 10_000)
        os.kill(process_of(out, *child.split()), SIGKILL)
        ended = run.ended()
    assert ended == (3, "", f"tandem run: failed: {child} was killed by signal 9\n")
    assert not processes_of(out)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["outcome"] == "failed"
    assert f"{child} was killed by signal 9" in summary["reason"]
    assert summary["ticks"] > 0


@pytest.mark.long
def test_a_robot_that_stops_sending_fails_the_run_within_the_timeout(endless: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with TandemProcess("run", endless, "--out", out, "--timeout", TIMEOUT, "-q") as run:
        run.until_written(out / "world.journal", 10_000)
        os.kill(process_of(out, "agent", "b"), SIGSTOP)
        ended = run.ended()
    assert ended.status != 0
    assert re.search(r"no answer from b( \(not connected\))? at tick ", ended.out + ended.err)
    assert f"for {TIMEOUT} s" in ended.out + ended.err
    assert not processes_of(out)


@pytest.mark.long
def test_an_agent_whose_world_dies_ends_within_its_timeout(tmp_path: Path) -> None:
    with world("paper-1", "--run", "mine") as (clock, endpoint):
        timeout = ("--timeout", TIMEOUT, "--out", tmp_path)
        with TandemProcess("agent", "a", "--connect", endpoint, *timeout) as agent:
            agent.until_answered("a", tmp_path)
            clock.tell(SIGKILL)
            ended = agent.ended()
    assert ended.status == 3
    assert ended.err.splitlines() == [
        f"tandem agent a: the world has gone; waiting {TIMEOUT} s for it",
        f"tandem agent a: nothing received from the world for {TIMEOUT} s",
    ]


@pytest.mark.parametrize("comes", series(["nobody", "a"]))
@pytest.mark.long
def test_a_world_whose_robot_never_connects_fails_and_names_it(comes: str, tmp_path: Path) -> None:
    missing = {"nobody": "a (not connected), b (not connected)", "a": "b (not connected)"}[comes]
    reason = f"no answer from {missing} at tick 0 for {TIMEOUT} s"
    endpoint = free_endpoint()
    with ExitStack() as stack:
        if comes == "a":
            agent = stack.enter_context(TandemProcess("agent", "a", "--connect", endpoint))
            agent.until(lambda: agent.catches(SIGHUP), "it looks for its world")
        arguments = ("--listen", endpoint, "--timeout", TIMEOUT, "--out", tmp_path)
        clock = stack.enter_context(TandemProcess("world", "paper-1", *arguments))
        ended = clock.ended()
        if comes == "a":
            parted = agent.ended()
            assert parted.status == 3
            assert f"a: failed after 0 ticks ({reason})" in parted.out
    assert ended.status == 3
    assert reason in " ".join(ended.out.split())
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["outcome"], summary["reason"], summary["ticks"]) == ("failed", reason, 0)


# --- a port in use ----------------------------------------------------------------------------------


@pytest.mark.long
def test_a_world_whose_port_another_world_has_is_one_clear_line() -> None:
    with world("paper-1") as (_, endpoint):
        assert tandem("world", "paper-1", "--listen", endpoint) == (
            *(2, ""),
            f"tandem world: --listen: {endpoint}: already in use\n",
        )


@pytest.mark.long
def test_an_agent_at_a_port_that_does_not_speak_zenoh_gives_up() -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        endpoint = f"tcp/127.0.0.1:{mute.getsockname()[1]}"
        ended = tandem("agent", "a", "--connect", endpoint, "--connect-timeout", "2")
    assert ended == (3, "", f"tandem agent a: no world at {endpoint}; gave up after 2 s: {MUTE}\n")


def test_processes_end_when_their_launcher_is_killed(endless: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with TandemProcess("run", endless, "--out", out, "-q", *PATIENT) as run:
        run.until_written(out / "world.journal", 10_000)
        os.kill(run.pid, SIGKILL)
        until(lambda: not processes_of(out), "all have ended")


# --- processes that stay open -----------------------------------------------------------------------


def test_a_page_that_stays_is_not_ended_by_another_process_that_ends_late() -> None:
    """It is killed after the end of a late agent has been taken from the inbox."""
    taken = []

    class Watched(Inbox):
        def next(self, timeout: float | None) -> Arrival:
            taken.append(child.running)
            if len(taken) == 2:
                child.kill()
            return super().next(timeout)

    inbox = Watched("test")
    inbox.put("ended", "agent a")
    children = Supervisor(inbox)
    child = children.start("the page", main="signal:pause")
    assert PageProcess(child, "here").stay(inbox) is False
    children.stop()
    assert taken == [True, True]


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
