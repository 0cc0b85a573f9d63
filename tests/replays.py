"""A measurement: bit-exact replays of recordings, also of those of killed processes.

    uv run python -m tests.replays 50 --kills 20

It replays both simulations of the paper and random plans of faults, a third of them with noise, each run as
processes and in one process. If both give the same bytes, they are replayed once. Then one process of a run
is killed with SIGKILL at a random moment. The incomplete recording is replayed and exported, and no journaled
frame may be missing.
"""

from __future__ import annotations

import argparse
import csv
import os
import random
import signal
import sys
import tempfile
from collections import Counter
from pathlib import Path

from compose.audit.findings import Findings
from compose.audit.rules import replayed
from compose.recording.recording_files import WORLD_JOURNAL, agent_journal
from compose.recording.run import read
from compose.view.export.folder import export
from protocol.journal import journal_file
from tests.commands import LONG, TandemProcess, journals, process_of, processes_of, tandem, until
from tests.same_plans import described, run_both_ways, scenario

PAPER = ("paper-1", "paper-2")
KILL_BYTES = 20_000
"""The largest size of a journal, in bytes, at which the process is killed; about 200 ticks."""


def main(count: int, kills: int) -> int:
    """Run all cases; return 0 if none fails."""
    wrong = 0
    for name in (*PAPER, *range(1, count + 1)):
        with tempfile.TemporaryDirectory(prefix="tandem-replays-") as folder:
            what, found = _both_ways(name, Path(folder))
        wrong += not found
        print(f"{name:>7} {'identical' if found else 'DIFFERENT'}: {what}", flush=True)
    print(f"{len(PAPER) + count - wrong} of {len(PAPER) + count} runs are replayed bit by bit, in both cases")
    lost = 0
    for number in range(1, kills + 1):
        with tempfile.TemporaryDirectory(prefix="tandem-killed-") as folder:
            what, found = killed(random.Random(number), Path(folder))
        lost += not found
        print(f"{number:>7} {'complete' if found else 'LOST'}: {what}", flush=True)
    print(f"{kills - lost} of {kills} recordings of a killed process are replayed and exported completely")
    return 1 if wrong or lost else 0


def _both_ways(name: str | int, folder: Path) -> tuple[str, bool]:
    if isinstance(name, int):
        text = scenario(random.Random(name))
        outcomes, found = run_both_ways(text, folder)
        what = f"{outcomes[0]}; {described(text)}"
    else:
        for out, mode in (("processes", []), ("one-process", ["--in-process"])):
            tandem("run", name, "-q", "--out", folder / out, *mode)
        found = [journals(folder / out) for out in ("processes", "one-process")]
        what = "a simulation of the paper"
    once: list[Findings] = [replayed(read(folder / "processes"))]
    if found[0] != found[1]:
        once.append(replayed(read(folder / "one-process")))
    same = all(not one.differences and not one.tears and one.checks for one in once)
    return f"{once[0].checks} checks in {once[0].ticks} ticks; {what}", same


def killed(draw: random.Random, folder: Path) -> tuple[str, bool]:
    """Run a mission and kill a process at a random moment.

    Return a description, and true if the replay and the export contain every complete frame.
    """
    (folder / "long.toml").write_text(LONG)
    out = folder / "out"
    victim = draw.choice(["world", "agent a", "agent b", "run"])
    watched = out / (WORLD_JOURNAL if victim in ("world", "run") else agent_journal(victim[-1]))
    moment = draw.randint(1, KILL_BYTES)
    with TandemProcess("run", folder / "long.toml", "-q", "--out", out) as run:
        run.until_written(watched, moment)
        os.kill(run.pid if victim == "run" else process_of(out, *victim.split()), signal.SIGKILL)
        run.ended()
    until(lambda: not processes_of(out), "no process writes any more")
    recording = read(out, audited=True)
    result, torn = replayed(recording), {name: one.torn for name, one in recording.journals.items()}
    export(read(out), folder / "exported")
    there = {name: list(journal_file.read(out / name)) for name in torn}
    sizes = {name: len(journal_file.packed(frames)) for name, frames in there.items()}
    whole = all(sizes[name] + torn[name] == (out / name).stat().st_size for name in torn)
    frames = {name: len(one) for name, one in there.items() if one}
    exported = exported_frames(folder / "exported") == frames
    what = f"{victim} after {moment} bytes: {result.ticks} ticks, {sum(torn.values())} bytes torn"
    return what, bool(result.tears) and not result.differences and whole and exported


def exported_frames(folder: Path) -> Counter[str]:
    """Return the numbers of frames of each journal in the frames.csv of an export."""
    with (folder / "frames.csv").open(newline="") as file:
        return Counter(row["journal"] for row in csv.DictReader(file))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("count", type=int, nargs="?", default=50)
    parser.add_argument("--kills", type=int, default=20)
    options = parser.parse_args()
    sys.exit(main(options.count, options.kills))
