"""Kills a, b and the world at every tick, one after another: `python -m tests.every_kill paper-1`.

No test: it takes long. Each run ends with the bytes of the undisturbed one, or is printed.
"""

from __future__ import annotations

import argparse
import itertools
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from compose.inline import play
from compose.kill import POINTS, WORLD
from compose.record import leave, summary
from compose.scenario import load
from tests.commands import journals, tandem

AT_ONCE = 2
"""runs"""
SEED = 5
"""of the random pairs"""


class Trial(NamedTuple):
    """One run, and who is killed in it."""

    kind: str
    kills: tuple[str, ...]


def every(robots: list[str], ticks: int, points: list[str]) -> Iterator[Trial]:
    """One kill a run: everyone, in every tick; the points in turn, or all of them."""
    turns = itertools.cycle(POINTS)
    for tick in range(ticks + 1):
        for who in (*robots, WORLD):
            for point in points or [next(turns)]:
                yield Trial(f"{who}:{point}", (f"{who}@{tick}:{point}",))


def pairs(robots: list[str], ticks: int, number: int) -> Iterator[Trial]:
    """Two kills a run: of anybody at any time, and of two robots in one tick, in turns."""
    draw = random.Random(SEED)
    for _ in range(number):
        one = [
            f"{draw.choice([*robots, WORLD])}@{draw.randint(0, ticks)}:{draw.choice(POINTS)}"
            for _ in range(2)
        ]
        yield Trial("any two", tuple(one))
        tick = draw.randint(0, ticks)
        yield Trial(
            "same tick", tuple(f"{who}@{tick}:{draw.choice(POINTS)}" for who in draw.sample(robots, 2))
        )


def outcome(scenario: str, trial: Trial, expected: tuple[dict[str, bytes], bytes]) -> str:
    """ "same", "never came", or what went wrong."""
    with tempfile.TemporaryDirectory(prefix="every-kill-") as folder:
        out = Path(folder) / "out"
        kills = [word for kill in trial.kills for word in ("--kill", kill)]
        try:
            ended = tandem("run", scenario, "-q", "--out", out, *kills)
        except AssertionError as error:
            return str(error)
        if ended.status != 0:
            return f"status {ended.status}: {ended.out}{ended.err}"
        if (journals(out), (out / "ticks.csv").read_bytes()) != expected:
            return f"another record: {ended.err}"
    return "never came" if ended.err.count("never came") == len(trial.kills) else "same"


def main(arguments: argparse.Namespace) -> int:
    """Play them all, and print how many went how."""
    scenario = load(arguments.scenario)
    with tempfile.TemporaryDirectory(prefix="every-kill-") as folder:
        played = play(scenario, Path(folder))
        leave(played, summary(played, "in-process", None), Path(folder))
        expected = journals(Path(folder)), (Path(folder) / "ticks.csv").read_bytes()
    robots, ticks = [robot.id for robot in scenario.robots], played.moments[-1].truth.tick
    trials = list(pairs(robots, ticks, arguments.pairs))
    if not arguments.pairs:
        trials = list(every(robots, ticks, list(POINTS) if arguments.points == "all" else []))
    counts: Counter[tuple[str, str]] = Counter()
    began = time.monotonic()
    with ThreadPoolExecutor(AT_ONCE) as pool:
        results = pool.map(lambda trial: outcome(arguments.scenario, trial, expected), trials)
        for trial, result in zip(trials, results, strict=True):
            known = result in ("same", "never came")
            counts[trial.kind, result if known else "WRONG"] += 1
            if not known:
                print(*trial.kills, result, flush=True)
            if sum(counts.values()) % 50 == 0:
                lasted = time.monotonic() - began
                print(f"{sum(counts.values())} of {len(trials)} in {lasted:.0f} s", file=sys.stderr)
    columns = ("same", "never came", "WRONG")
    print(f"{'':16}", *(f"{column:>12}" for column in columns))
    for kind in dict.fromkeys(trial.kind for trial in trials):
        print(f"{kind:16}", *(f"{counts[kind, column]:12}" for column in columns))
    print(f"{len(trials)} runs in {time.monotonic() - began:.0f} s")
    return int(any(result == "WRONG" for _, result in counts))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("scenario")
    parser.add_argument("--points", choices=["turns", "all"], default="turns")
    parser.add_argument("--pairs", type=int, default=0, metavar="N", help="N random pairs, N in one tick")
    sys.exit(main(parser.parse_args()))
