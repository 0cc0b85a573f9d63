"""A measurement: bit-exact replays of recordings, also of those of killed processes.

    uv run python -m tests.replays 50 --kills 20

It replays both simulations of the paper and random plans of faults, a third of them with noise, each run as
processes and in one process, which must give the same bytes. Then one process of a run is killed with SIGKILL
at a random moment. The incomplete recording is replayed and exported, and no journaled frame may be missing.
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

from compose.audit.rules import replayed
from compose.recording.recording_files import WORLD_JOURNAL, agent_journal
from compose.recording.run import read
from compose.scenario.shipped_files import shipped
from compose.view.export.folder import export
from protocol.journal import journal_file
from tests.commands import LONG, SECTION_IV, TandemProcess, journals, process_of, processes_of, tandem, until
from tests.surveys import ODOMETRY, SIGMA, WHEELS

PAPER = ("paper-1", "paper-2")
EXACT, RANGES, ALL_NOISE = "", SIGMA, f"{SIGMA}\noutliers = 0.05\n{WHEELS}\n{ODOMETRY}"
MAX_TICKS = 300
"""The length of a mission. A plan that delivers almost no report ends undecided, which is fine, too."""
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
    text = scenario(random.Random(name)) if isinstance(name, int) else shipped()[name].read_text()
    outcomes, (processes, one_process) = run_both_ways(text, folder)
    found = replayed(read(folder / "processes"))
    same = processes == one_process and outcomes[0] == outcomes[1]
    what = f"{outcomes[0]}; {described(text)}" if isinstance(name, int) else "a simulation of the paper"
    whole = not found.differences and not found.tears and bool(found.checks)
    return f"{found.checks} checks in {found.ticks} ticks; {what}", same and whole


def run_both_ways(text: str, folder: Path) -> tuple[list[str], list[dict[str, bytes]]]:
    """Run a plan as processes, then in one process; return the outcomes and the journals."""
    (folder / "plan.toml").write_text(text)
    outcomes, found = [], []
    for out, mode in (("processes", []), ("one-process", ["--in-process"])):
        ended = tandem("run", "plan.toml", "-q", "--out", out, *mode, cwd=folder)
        outcomes.append(ended.out.strip() or ended.err.strip())
        found.append(journals(folder / out))
    return outcomes, found


def scenario(draw: random.Random) -> str:
    """Return a scenario with one to four faults; a third have noise, and a fifth of the others two pairs."""
    noise = draw.choice((EXACT, EXACT, EXACT, EXACT, RANGES, ALL_NOISE))
    planner_name = draw.choice(("assured", "assured", "assured", "paper"))
    pairs = 2 if draw.random() < 0.2 and not noise else 1
    anchors = [(10.0 * (i % 2), 40.0 * (i // 2)) for i in range(2 * pairs)]
    robots = "".join(
        f'[[robot]]\nid = "{robot}"\npeer = "{peer}"\nanchor = [{x}, {y}]\n'
        for robot, peer, (x, y) in zip("abcd", "badc", anchors, strict=False)
    )
    faults = "".join(f"[[fault]]\n{fault(draw, pairs)}" for _ in range(draw.randint(1, 4)))
    table = f"[mission.noise]\n{noise}\n" if noise else ""
    return (
        f'name = "plan"\nseed = {draw.randrange(2**32)}\nmax_ticks = {MAX_TICKS}\n'
        f'planner = {{name = "{planner_name}"}}\n{SECTION_IV}{table}{robots}{faults}'
    )


def fault(draw: random.Random, pairs: int) -> str:
    """Return the table of a random fault."""
    links = ["*", "a->b", "b->a", "a<->b", *(["c->d", "c<->d"] if pairs == 2 else [])]
    lines = [f'link = "{draw.choice(links)}"']
    least, most = sorted((draw.randrange(11), draw.randrange(11)))
    begin, ticks = draw.randrange(10), draw.randrange(30)
    options = (
        f"loss = {draw.uniform(0.0, 0.9):.3f}",
        f"burst_start = {draw.uniform(0.0, 0.5):.3f}\nburst_end = {draw.uniform(0.05, 1.0):.3f}",
        f"delay = [{least}, {most}]",
        f"duplicate = {draw.random():.3f}",
        f"reorder = {draw.random():.3f}",
        f"corrupt = {draw.uniform(0.0, 0.8):.3f}",
        f"reports_per_tick = {draw.uniform(0.1, 2.0):.3f}",
        f"partition = true\ncontact_ticks = [{begin}, {begin + ticks}]",
    )
    lines += [line for line in options if draw.random() < 0.4]
    return "\n".join(lines) + "\n"


def described(text: str) -> str:
    """Return a plan as one line of text."""
    planner_name = "paper" if '"paper"' in text else "assured"
    noise = "noisy" if "mission.noise" in text else "exact"
    pairs = text.count("[[robot]]") // 2
    faults = [" ".join(part.split()) for part in text.split("[[fault]]")[1:]]
    return f"{planner_name}, {noise}, {pairs} pair{'s' if pairs > 1 else ''}; {' | '.join(faults)}"


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
