"""The sample of recorded UWB ranges in tests/data/uwb, cut from the recording of which its README tells.

The recording has one anchor, and a pair of robots needs two. The second is made from the truth and from the
residuals of a robot's ranges to the first, which it replaces: its errors are those of a radio.

`uv run python -m tests.uwb_sample tiers.pyfg tests/data/uwb/tiers-a-b-30-s.pyfg` writes it. To a file whose
name ends in .xz, it writes all robots and the one anchor, compressed: of the first 60 s of the recording, the
file of docs/peers.py. With a CSV file of raw ranges, it writes the two measurements of each, compressed.
"""

from __future__ import annotations

import csv
import lzma
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from compose.recording.ranging.range_files import read_ranges
from docs.recorded_claims import SECOND_ANCHOR, second_place, second_ranges

ROBOTS = "AB"
BEGIN_S = 1671300425.0
"""The time that is subtracted from all stamps, in s."""
LAST_POSE = 700
"""The number of the last pose of each robot: 600 poses, at 20 Hz, after the first, which is 100."""
STAMP_DIGITS, VALUE_DIGITS = 4, 6
"""The decimals of stamps (s), and of lengths (m) and angles (rad): far below the errors of the sensors."""
NAMES = {"VERTEX_SE2": (2,), "VERTEX_XY": (), "EDGE_SE2": (2, 3), "EDGE_RANGE": (2, 3)}
"""The places of the poses and landmarks in each kind of line."""


def sample_lines(lines: Sequence[str], *, whole: bool = False) -> Iterator[str]:
    """Yield the lines of the sample, or all, with fewer decimals and with stamps from 0 s on."""
    for words in map(str.split, lines):
        if not whole and not all(_kept(words[place]) for place in NAMES[words[0]]):
            continue
        if words[0] != "VERTEX_XY":
            words[1] = f"{float(words[1]) - BEGIN_S:.{STAMP_DIGITS}f}"
        values = words[:4] if words[0].startswith("EDGE") else words[:3]
        rest = [f"{round(float(word), VALUE_DIGITS) or 0.0:.7g}" for word in words[len(values) :]]
        if words[0] == "VERTEX_XY":
            values, rest = words[:2], [f"{float(word):.{VALUE_DIGITS}f}" for word in words[2:]]
        yield " ".join([*values, *rest])


def _kept(name: str) -> bool:
    return name.startswith("L") or (name[0] in ROBOTS and int(name[1:]) <= LAST_POSE)


def with_second_anchor(path: Path, robot: str = ROBOTS[-1]) -> Iterator[str]:
    """Yield the lines of the sample at `path`, with ranges of `robot` to a second anchor.

    They replace those to the first, whose errors are the same: an estimate would count these twice.
    """
    recording = read_ranges(path)
    place = second_place(recording)
    _, measured = second_ranges(recording, robot, place)
    lengths = iter(measured.tolist())
    first = recording.anchors[0].id
    moved = []
    for line in path.read_text().splitlines():
        words = line.split()
        if words[0] == "EDGE_RANGE" and words[2][0] == robot and words[3] == first:
            moved.append(f"{' '.join(words[:3])} {SECOND_ANCHOR} {next(lengths):.{VALUE_DIGITS}f} {words[5]}")
        else:
            yield line
    yield f"VERTEX_XY {SECOND_ANCHOR} {place[0]:.{VALUE_DIGITS}f} {place[1]:.{VALUE_DIGITS}f}"
    yield from moved


def raw_lines(source: Path) -> Iterator[str]:
    """Yield the columns of a CSV file of raw ranges that docs/recorded_claims.py reads, in mm."""
    yield "node1,node2,uwb_range,mocap_range"
    with source.open(newline="") as file:
        for row in csv.DictReader(file):
            nodes = ",".join(f"{float(row[name]):.0f}" for name in ("node1", "node2"))
            yield f"{nodes},{float(row['uwb_range']):.3f},{float(row['mocap_range']):.3f}"


if __name__ == "__main__":
    source, target = map(Path, sys.argv[1:])
    packed, raw = target.suffix == ".xz", source.suffix == ".csv"
    lines = raw_lines(source) if raw else sample_lines(source.read_text().splitlines(), whole=packed)
    content = "\n".join([*lines, ""])
    if packed:
        target.write_bytes(lzma.compress(content.encode(), preset=9))
    else:
        target.write_text(content)
        target.write_text("\n".join([*with_second_anchor(target), ""]))
