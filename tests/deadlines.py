"""A measurement of missed deadlines: two agents in real time at 1, 10 and 100 Hz.

    uv run python -m tests.deadlines

Two missions of 10 s run at each rate; in the second, the agent of a is stopped for 3 s. Each prints one line.
The exit status is 0 if all missions ended, and if robots stopped in the ticks whose deadline they missed.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from compose.recording.run import Run, read
from tests.commands import ENDLESS, TandemProcess, process_of

RATES = (1, 10, 100)
"""The rates of ticks, in Hz."""
LASTS_S = 10
"""The duration of a mission, in s."""
STOPPED_S = 3.0
"""The time in s for which the agent of a is stopped."""


def main() -> int:
    """Run all missions, and return the exit status."""
    shown = Table("rate Hz", "stopped s", "ticks", "a missed", "b missed", "a moved on", "wall s")
    well = True
    for rate in RATES:
        for stopped in (0.0, STOPPED_S):
            with tempfile.TemporaryDirectory(prefix="tandem-") as folder:
                began = time.monotonic()
                recording = run_mission(Path(folder), rate, stopped)
                wall = time.monotonic() - began
            ticks = recording.ticks[-1].truth.tick
            missed = {robot: late(recording, robot) for robot in "ab"}
            moved = max([moved_by(recording, tick) for tick in missed["a"]], default=0.0)
            well &= ticks == rate * LASTS_S and moved == 0.0
            well &= not stopped or len(missed["a"]) >= (STOPPED_S - 1.0) * rate
            share = [f"{len(ticks_)} ({len(ticks_) / ticks:.2%})" for ticks_ in missed.values()]
            shown.add_row(str(rate), f"{stopped:g}", str(ticks), *share, f"{moved:g} m", f"{wall:.1f}")
    Console().print(shown)
    return 0 if well else 1


def run_mission(folder: Path, rate: int, stopped: float) -> Run:
    """Return the recording of LASTS_S s at `rate`, with the agent of a stopped for `stopped` s."""
    scenario, out = folder / "mission.toml", folder / "out"
    scenario.write_text(f"max_ticks = {rate * LASTS_S}\n" + ENDLESS.replace("max_ticks", "# max_ticks"))
    with TandemProcess("run", scenario, "--rate", str(rate), "--out", out, "-q") as run:
        if stopped:
            run.until_answered("a", out)
            agent = process_of(out, "agent", "a")
            os.kill(agent, signal.SIGSTOP)
            time.sleep(stopped)  # the interruption that is measured
            os.kill(agent, signal.SIGCONT)
        run.ended()
    return read(out)


def late(recording: Run, robot: str) -> list[int]:
    """Return the ticks whose command from `robot` was late."""
    return [moment.truth.tick for moment in recording.ticks[:-1] if robot not in moment.commands]


def moved_by(recording: Run, tick: int) -> float:
    """Return the distance in m (1-norm) that a moved in `tick`."""
    before, after = recording.ticks[tick].truth.poses[0], recording.ticks[tick + 1].truth.poses[0]
    return abs(after.x - before.x) + abs(after.y - before.y)


if __name__ == "__main__":
    sys.exit(main())
