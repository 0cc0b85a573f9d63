"""A measurement: records of all kinds, replayed to the bit; and records of killed processes, to the tear.

    uv run python -m tests.replays 50 --kills 20

Both of the paper's runs and random plans of faults, a third of them under noise, each as processes and in one
process: the same bytes both ways are replayed once. Then runs of which a process is killed with SIGKILL at a
random moment: what is left is replayed, and exported, and no frame that was journaled may be missing.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import struct
import sys
import tempfile
import zlib
from collections import defaultdict
from pathlib import Path

import msgpack
from mcap.reader import make_reader

from compose.audit.replay import Replay, replay
from compose.recording.run import WORLD_JOURNAL, agent_journal
from compose.view.export.folder import export
from protocol.journal import journal_file
from tests.commands import LONG, TandemProcess, journals, process_of, processes_of, tandem, until
from tests.same_plans import played, said, scenario

PAPER = ("paper-1", "paper-2")
KILL_BYTES = 20_000
"""of its journal, at most, after which a process is killed: 200 ticks or so"""


def main(count: int, kills: int) -> int:
    """0 if all is as it must be."""
    wrong = 0
    for name in (*PAPER, *range(1, count + 1)):
        with tempfile.TemporaryDirectory(prefix="tandem-replays-") as folder:
            what, found = _both_ways(name, Path(folder))
        wrong += not found
        print(f"{name:>7} {'to the bit' if found else 'DIFFERENT'}: {what}", flush=True)
    print(f"{len(PAPER) + count - wrong} of {len(PAPER) + count} runs are replayed to the bit, both ways")
    lost = 0
    for number in range(1, kills + 1):
        with tempfile.TemporaryDirectory(prefix="tandem-killed-") as folder:
            what, found = killed(random.Random(number), Path(folder))
        lost += not found
        print(f"{number:>7} {'whole' if found else 'LOST'}: {what}", flush=True)
    print(f"{kills - lost} of {kills} records of a killed process are replayed, and exported, to the tear")
    return 1 if wrong or lost else 0


def _both_ways(name: str | int, folder: Path) -> tuple[str, bool]:
    if isinstance(name, int):
        text = scenario(random.Random(name))
        outcomes, found = played(text, folder)
        what = f"{outcomes[0]}; {said(text)}"
    else:
        for out, mode in (("processes", []), ("one-process", ["--in-process"])):
            tandem("run", name, "-q", "--out", folder / out, *mode)
        found = [journals(folder / out) for out in ("processes", "one-process")]
        what = "the paper's"
    once: list[Replay] = [replay(folder / "processes")[0]]
    if found[0] != found[1]:
        once.append(replay(folder / "one-process")[0])
    same = all(not one.differences and not one.tears and one.checks for one in once)
    return f"{once[0].checks} checks in {once[0].ticks} ticks; {what}", same


def killed(draw: random.Random, folder: Path) -> tuple[str, bool]:
    """A run of which one process is killed at a random moment: how it went, and whether nothing is lost."""
    (folder / "long.toml").write_text(LONG)
    out = folder / "out"
    who = draw.choice(["world", "agent a", "agent b", "run"])
    watched = out / (WORLD_JOURNAL if who in ("world", "run") else agent_journal(who[-1]))
    moment = draw.randint(1, KILL_BYTES)
    with TandemProcess("run", folder / "long.toml", "-q", "--out", out) as run:
        run.until_written(watched, moment)
        os.kill(run.pid if who == "run" else process_of(out, *who.split()), signal.SIGKILL)
        run.ended()
    until(lambda: not processes_of(out), "nobody writes any more")
    told, torn = replay(out)
    export(out, folder / "exported")
    there = {name: journal_file.packed(journal_file.read(out / name)) for name in torn}
    whole = all(len(there[name]) + torn[name] == (out / name).stat().st_size for name in torn)
    exported = journals_of(folder / "exported" / "run.mcap") == {k: v for k, v in there.items() if v}
    what = f"{who} after {moment} bytes: {told.ticks} ticks, {sum(torn.values())} bytes torn"
    return what, bool(told.tears) and not told.differences and whole and exported


def journals_of(path: Path) -> dict[str, bytes]:
    """The journals, made anew of the messages of a run.mcap that hold their frames."""
    frames: dict[str, list[bytes]] = defaultdict(list)
    with path.open("rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False):
            if not channel.topic.startswith("/journal/"):
                continue
            _, _, name, kind = channel.topic.split("/")
            assert (channel.message_encoding, msgpack.unpackb(message.data)[0]) == ("msgpack", kind)
            head = struct.pack(">BI", int(channel.metadata["version"]), zlib.crc32(message.data))
            frames[f"{name}.journal"].append(head + message.data)
    return {name: journal_file.packed(ones) for name, ones in frames.items()}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("count", type=int, nargs="?", default=50)
    parser.add_argument("--kills", type=int, default=20)
    options = parser.parse_args()
    sys.exit(main(options.count, options.kills))
