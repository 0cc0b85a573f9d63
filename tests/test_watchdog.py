"""A process in which Zenoh does not return from a call ends, and is restarted or named."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from signal import SIGCONT, SIGSTOP

import pytest

from tests.commands import OVER, PAPER_1, tandem
from tests.test_field import ASSURED, pair

WATCHED = """
import os, sys, threading, time
from protocol.network import watchdog
watchdog.CHECK_S, watchdog.CALL.longest_s = 0.02, 0.4
watchdog.watch("tandem world", lambda: os._exit(3))
print("watched", flush=True)
"""
HANGS = "with watchdog.CALL: threading.Event().wait()"
HANGS_IN_A_THREAD = f"""
def call():
    {HANGS}
threading.Thread(target=call).start()
for _ in range(200):
    with watchdog.CALL: time.sleep(0.01)
"""
WAITS = """
for _ in range(100):
    with watchdog.CALL: time.sleep(0.02)
"""
WAITS_ONCE = """
watchdog.CALL.longest_s = 1.5
with watchdog.CALL: time.sleep(1.0)
"""
PLANNER = "tests.own_planners:Hanging"


def watched(code: str) -> subprocess.Popen[str]:
    """Return a process with a watchdog that runs `code`."""
    process = subprocess.Popen(
        [sys.executable, "-c", WATCHED + code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "watched\n"
    return process


@pytest.mark.parametrize("code", [HANGS, HANGS_IN_A_THREAD], ids=["main thread", "other thread"])
def test_a_process_in_which_a_call_does_not_return_ends_and_says_so(code: str) -> None:
    _, err = watched(code).communicate(timeout=20.0)
    assert err == "tandem world: Zenoh has not returned from a call for 0.4 s\n"


def test_calls_that_return_end_no_process() -> None:
    process = watched(WAITS)
    assert process.communicate(timeout=20.0) == ("", "")
    assert process.returncode == 0


def test_the_time_for_which_a_process_is_suspended_does_not_count() -> None:
    process = watched(WAITS_ONCE)
    os.kill(process.pid, SIGSTOP)
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(2.0)
    os.kill(process.pid, SIGCONT)
    assert process.communicate(timeout=20.0) == ("", "")
    assert process.returncode == 0


@pytest.mark.long
def test_a_robot_whose_agent_hangs_in_zenoh_restarts_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HUNG_ONCE", str(tmp_path / "hung"))
    text = ASSURED.replace('"assured"', f'"{PLANNER}"')
    with pair(tmp_path, text=text) as robots:
        robots["b"].until_prints("agent b was killed by signal 9 and is restarted")
        ends = [one.ended() for one in robots.values()]
    assert all(one.status in OVER for one in ends), ends


@pytest.mark.long
def test_a_run_whose_agent_hangs_in_zenoh_fails_and_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HUNG_ONCE", str(tmp_path / "hung"))
    (tmp_path / "scenario.toml").write_text(PAPER_1)
    ended = tandem("run", tmp_path / "scenario.toml", "--planner", PLANNER, "--out", tmp_path / "out")
    assert ended.status == 3
    assert "agent b was killed by signal 9" in ended.err
    assert "Zenoh has not returned from a call" in ended.err
