"""Missions of shipped sweeps in one process: `python -m tests.many SWEEP=COUNT ... [--seed S] [--processes]`.

The sweeps and their cells take turns, so that Ctrl-C or SIGTERM ends it with an even share of each. A table
counts the outcomes. A mission that breaks an invariant is printed with the command that prints its scenario:
a wrong claim, a failed mission, an honest peer called inconsistent, a mission that is guaranteed to localise
its robots and does not, and a violation that the audit finds, which decides all of one in AUDITED_EACH again.
The exit status is then 1.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections import Counter
from typing import Any

from compose.sweep import spec
from compose.sweep.cells import Cell, cells, setting_of, trial_seed
from compose.sweep.hunt.invariants import guaranteed
from compose.sweep.trial import TrialRow
from compose.sweep.worker import Chunk, TrialOptions, played

AUDITED_EACH = 53
"""The number of missions of which one is audited; a prime, so that all cells have their turn."""
BROKEN = ("wrong", "failed", "inconsistent")
"""The outcomes that no mission with honest robots may have."""
COLUMNS = ("missions", "localised", "undecided", "refused", *BROKEN, "audited", "violated")
"""The columns of the table."""


class Series:
    """The missions of one sweep, cell by cell."""

    def __init__(self, name: str, most: int, seed: int, *, processes: bool) -> None:
        """`most` is the number of missions; `processes` is whether they run as processes."""
        self.name, self.most = name, most
        self.found = Counter[str]()
        self.cpu_s = 0.0
        self._sweep, self._processes = spec.load(name, seed=seed), processes
        self._cells: list[Cell] = [*cells(self._sweep)]
        self._settings = [setting_of(self._sweep, one) for one in self._cells]

    def play(self) -> str | None:
        """Run the next mission, and return the invariant that it breaks, with the mission."""
        began, number = sum(os.times()[:4]), self.found["missions"]
        trial, at = divmod(number, len(self._cells))
        cell, sweep = self._cells[at], self._sweep
        audited = number % AUDITED_EACH == 0
        options = TrialOptions(self._processes, sweep.trial_timeout, audit=audited, draws=sweep.draws)
        seed = trial_seed(sweep.seed, cell.key, trial)
        table = cell.table if sweep.draws else {}
        chunk = Chunk(cell.index, (trial,), (seed,), self._settings[at], options, table)
        signal.setitimer(signal.ITIMER_PROF, sweep.trial_timeout)
        row = played(chunk, trial, seed)  # one that uses more time fails; a stopped one does not
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        broken = self._broken(row, at)
        self.found.update(["missions", row.outcome, *["audited"] * audited, *["violated"] * bool(broken)])
        self.cpu_s += sum(os.times()[:4]) - began
        if not broken:
            return None
        return f"{broken}: tandem sweep {self.name} --seed {sweep.seed} --print-trial {at}:{trial}"

    def _broken(self, row: TrialRow, at: int) -> str | None:
        """Return the invariant that the mission of `row` breaks."""
        must = not self._sweep.draws.fields and guaranteed(self._settings[at].scenario)
        if row.outcome in BROKEN or (must and row.outcome != "localised"):
            return f"{row.outcome}: {row.error or row.reason}"
        return row.first_violation


def main(arguments: list[str]) -> int:
    """Run the missions, print the table, and return 1 if an invariant was broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("series", nargs="+", metavar="SWEEP=COUNT")
    parser.add_argument("--seed", type=int, default=46)
    parser.add_argument("--processes", action="store_true", help="run the missions as processes")
    options = parser.parse_args(arguments)
    parts = [one.partition("=") for one in options.series]
    every = [Series(name, int(n), options.seed, processes=options.processes) for name, _, n in parts]
    stops = list[int]()  # `played` turns exceptions into failed missions
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stops.append(number))
    signal.signal(signal.SIGPROF, _hung)
    while not stops and (left := [one for one in every if one.found["missions"] < one.most]):
        if broken := min(left, key=lambda one: one.found["missions"] / one.most).play():
            print(broken, flush=True)
    print(f"| sweep | {' | '.join(COLUMNS)} | CPU, s |\n{'| --- ' * (2 + len(COLUMNS))}|")
    for one in every:
        print(f"| {one.name} | {' | '.join([str(one.found[name]) for name in COLUMNS])} | {one.cpu_s:.0f} |")
    return 1 if any(one.found["violated"] for one in every) else 0


def _hung(*_: Any) -> None:
    raise TimeoutError("it hangs")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
