"""Convert a recording of the Plaza series (`Plaza1_.mat`, as gtsam has it) to the CSV files of Tandem.

`uv run docs/plaza_csv.py plaza1.mat plaza1` writes odometry, ranges, anchors and truth to the folder plaza1.
"""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import scipy.io  # type: ignore[import-untyped]

ROBOT = "mower"


def convert(path: Path, folder: Path) -> None:
    """Write the recording in the .mat file `path` to CSV files in `folder`.

    A row of DR is the distance and the turn since the row before, of which the first starts at the first row
    of GT. The robot is taken to turn at a constant rate in between.
    """
    content = scipy.io.loadmat(path)
    folder.mkdir(parents=True, exist_ok=True)
    truth, driven, ranges, beacons = (content[name].tolist() for name in ("GT", "DR", "TD", "TL"))
    begins = [truth[0][0], *[t for t, _, _ in driven[:-1]]]
    _write(
        folder / "odometry.csv",
        ("robot", "t0", "t1", "dx", "dy", "dheading"),
        [
            (ROBOT, t0, t1, *_chord(distance, turn), turn)
            for t0, (t1, distance, turn) in zip(begins, driven, strict=True)
        ],
    )
    _write(
        folder / "ranges.csv",
        ("t", "from", "to", "range"),
        [(t, ROBOT, int(beacon), measured) for t, _, beacon, measured in sorted(ranges)],
    )
    _write(folder / "anchors.csv", ("anchor", "x", "y"), [(int(name), x, y) for name, x, y in beacons])
    _write(folder / "truth.csv", ("robot", "t", "x", "y", "heading"), [(ROBOT, *pose) for pose in truth])


def _chord(distance: float, turn: float) -> tuple[float, float]:
    """Return the motion forward and to the left on an arc."""
    half = 0.5 * turn
    chord = distance * (math.sin(half) / half if half else 1.0)
    return chord * math.cos(half), chord * math.sin(half)


def _write(path: Path, head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([head, *rows])


if __name__ == "__main__":
    convert(Path(sys.argv[1]), Path(sys.argv[2]))
