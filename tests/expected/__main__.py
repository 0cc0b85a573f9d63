"""Run shipped sweeps and compare them with their expected results: `python -m tests.expected [NAME ...]`.

Without a name, all sweeps are run. The exit status is 1 if anything differs, for better or worse, at a rate
of false alarms of 1 % over all statistics together. `--write` replaces the files of the sweeps that have run,
after the same comparison, and also where a sweep has other cells than its file.

Three forms decide the number of trials of each cell, from the processor time that the files state: that of
the long suite (the default, a minute on two cores), `--hour`, and `--whole` (those of the sweep files).
With the seed of the file, which is the default, trials are also compared with those in the file one by one:
where the libraries and the processor are those of the file, every decision has to be the same, to the bit. A
change that means to decide otherwise is compared by its statistics alone (`--statistics`), and writes the
files again.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
import zlib
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import msgspec
import numpy as np
import pyarrow.parquet as pq

from compose.sweep import spec
from compose.sweep.results_folder import TRIALS_PARQUET
from compose.sweep.statistics import column
from tests.expected.comparison import (
    ALARM,
    Run,
    Test,
    compare,
    findings,
    number_changed,
    same_environment,
    weights,
)
from tests.expected.playing import play
from tests.expected.results import SAMPLE, Expected, Trials, expected, path_of, read, toml_text

FORMS = {"long": 100.0, "hour": 6000.0}
"""The processor time of a form in s, for all files."""
PACKAGES = ("agent", "world", "protocol")
"""The packages on whose code results depend."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the sweeps, print how they differ, and return the exit status."""
    options = _options(arguments)
    names = options.names or list(spec.shipped())
    files = {name: read(name) for name in names}
    if not options.write and (missing := [name for name, file in files.items() if file is None]):
        sys.exit(f"{', '.join(missing)}: no expected results; --write makes them")
    rounds = _rounds(options, files)
    runs = []
    for name, file in files.items():
        if not rounds[name]:
            print(f"{name}: left out, one trial of each cell takes {file.cost if file else 0.0:.0f} s")
            continue
        began = time.monotonic()
        new, trials = _ran(name, rounds[name], _seed(options.seed, name, file), options)
        took = f"{time.monotonic() - began:.0f} s"
        beside = f"; the file has {file.trials}, of {file.commit}" if file is not None else ""
        cells = f"{rounds[name]} trials in each of {len(new.cell)} cells"
        print(f"{name}: {cells}, seed {new.seed}, {took}{beside}", flush=True)
        if file is not None:
            same_cells = [one.label for one in new.cell] == [one.label for one in file.cell]
            if not (same_cells or options.write):
                sys.exit(f"{path_of(name)}: it has other cells than the sweep; --write makes it again")
            runs += [Run(new, trials, file)] * same_cells
        if options.write:
            landed = [one for one in file.landed if one.trials > rounds[name]] if file is not None else []
            path_of(name).write_text(toml_text(msgspec.structs.replace(new, landed=tuple(landed))))
    differs = report(runs, every=options.all, statistics=options.statistics)
    return 0 if options.write else differs


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tests.expected", description="Compare sweeps with their files."
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="shipped sweeps [default: all]")
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--trials", type=int, help="number of trials in each cell")
    form.add_argument("--hour", action="store_true", help="trials for about an hour on two cores")
    form.add_argument("--whole", action="store_true", help="the trials of the shipped sweeps")
    parser.add_argument(
        "--seed", type=int, help="a seed from which those of the sweeps follow [default: the file's]"
    )
    parser.add_argument("--write", action="store_true", help="replace the files by what has run")
    parser.add_argument(
        "--folder", type=Path, help="a folder with the results of `tandem sweep NAME`, in place of a run"
    )
    parser.add_argument("--commit", help="the commit that made these results")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="number of processes")
    parser.add_argument("--statistics", action="store_true", help="let decisions be others")
    parser.add_argument("--all", action="store_true", help="print all statistics, not only what differs")
    options = parser.parse_args(arguments)
    for name in options.names:
        if name not in spec.shipped():
            parser.error(f"'{name}' is no shipped sweep ({', '.join(spec.shipped())})")
    for name in ("trials", "jobs"):
        if (number := getattr(options, name)) is not None and number < 1:
            parser.error(f"argument --{name}: {number} is less than 1")
    if options.folder is not None and not (options.folder / TRIALS_PARQUET).is_file():
        parser.error(f"argument --folder: there is no {options.folder / TRIALS_PARQUET}")
    return options


def _rounds(options: argparse.Namespace, files: dict[str, Expected | None]) -> dict[str, int]:
    """Return the number of trials in each cell of each sweep."""
    whole = {name: spec.load(name).trials for name in files}
    if options.trials is not None:
        return dict.fromkeys(files, options.trials)
    if options.whole:
        return whole
    most = whole if options.hour else {name: min(SAMPLE, trials) for name, trials in whole.items()}
    left = FORMS["hour" if options.hour else "long"]
    rounds = dict.fromkeys(files, 1)
    cost = {name: max(file.cost, 1e-3) if file is not None else 1.0 for name, file in files.items()}
    for i, name in enumerate(sorted(files, key=lambda name: most[name] * cost[name])):
        rounds[name] = min(most[name], int(left / (len(files) - i) / cost[name]))
        left -= rounds[name] * cost[name]
    return rounds


def _seed(given: int | None, name: str, file: Expected | None) -> int:
    """Return the seed of a sweep: another one for each, so that no two have the same missions."""
    if given is None and file is not None:
        return file.seed
    return zlib.crc32(f"{1 if given is None else given}/{name}".encode())


def _ran(name: str, trials: int, seed: int, options: argparse.Namespace) -> tuple[Expected, Trials]:
    """Return the results of a sweep that runs now, or those in the folder that the options name."""
    commit = options.commit or _commit()  # before the run, during which another one may be checked out
    if options.folder is not None:
        table = pq.read_table(options.folder / TRIALS_PARQUET)
        decisions: list[str] = []
        cost = float(np.nansum(column(table, "wall_s")))
        sweep = spec.load(name, trials=trials)
        if any(axis.paired for axis in sweep.axes):
            sys.exit(
                f"{options.folder}: cells of {name} share missions there, and those of a file are independent"
            )
    else:
        sweep = spec.load(name, trials=trials, seed=seed)
        table, decisions, cost = play(sweep, options.jobs)
    rows = Trials.of(table, decisions)
    return expected(sweep, rows, version("tandem-ranging"), commit, cost), rows


def _commit() -> str:
    """Return the last commit that changed what results depend on; "unknown" outside a clone."""
    command = ["git", "log", "-1", "--format=%h", "--", *PACKAGES]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip() or "unknown"


def report(runs: Sequence[Run], *, every: bool = False, statistics: bool = False) -> int:
    """Print what differs, and what the pooled statistics are. Return 1 if anything differs.

    Other decisions count only if `statistics` is False, and in the environment of the file.
    """
    tests = compare(runs)
    weight = weights(tests)
    found = findings(tests)
    others = 0
    for run in runs:
        if run.new.seed == run.old.seed:
            changed, of = number_changed(run)
            here = "" if same_environment(run) else ", in another environment"
            print(f"{run.old.sweep}: {changed} of {of} trials with the same seeds are others{here}")
            others += changed if same_environment(run) else 0
    shown = tests if every else [test for test in tests if test.level != "cell"]
    for test in shown:
        print(_line(test, weight[test.level]))
    print(f"{len(tests)} statistics, of which {len(found)} differ (a false alarm in {ALARM:.0%} of runs)")
    for test in found:
        print(f"{test.verdict}: {_line(test, weight[test.level])}; p = {test.p:.1g}")
    if others and not statistics:
        print(f"decisions: {others} trials with the same seeds are others, in the same environment")
    return 1 if found or (others and not statistics) else 0


def _line(test: Test, weight: float) -> str:
    return (
        f"{test.sweep}, {test.where}: {test.quantity} {test.old} -> {test.new} "
        f"(found from {test.smallest(ALARM * weight)} on)"
    )


if __name__ == "__main__":
    sys.exit(main())
