"""Mutations of small range recordings: of their rows, of their bytes, and of the frames of journals."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from typing import Any

import msgspec

from compose.recording.recording_files import KINDS
from protocol.wire import MAX_FRAME_BYTES, decode, encode

DURATION_S = 10.0


Rows = list[dict[str, Any]]


Tables = dict[str, Rows]


ODD = (
    *(0.0, -0.0, 1e-320, 1e-300, 1e-12, 1e-6, 0.5, -0.5, math.pi, math.tau, -math.tau, 100.0, 1e4, 1e7, -1e7),
    *(1e9, 1e12, -1e12, 1e15, 1e300, math.nan, math.inf, -1.0),
    *(".5", "5.", "+3.2", "-.5", "1e-3", "1E2", "", "x", "0x10", "1_000", "1,5", "9" * 40, "true", " 1 "),
)
"""Values in place of a number; most are valid in some column."""


STAMPS = ("t", "t0", "t1")


TEXTS = ("robot", "anchor", "from", "to")


def of_some(tables: Tables, draw: random.Random) -> tuple[str, Rows]:
    name = draw.choice([*tables, "odometry", "ranges", "odometry", "ranges"])
    return name, tables.setdefault(name, [])


def deleted(tables: Tables, draw: random.Random) -> None:
    _, rows = of_some(tables, draw)
    begin = draw.randrange(len(rows) + 1)
    del rows[begin : begin + draw.choice([1, 1, 3, 10, 100])]


def duplicated(tables: Tables, draw: random.Random) -> None:
    rows = tables[draw.choice(["ranges", "truth", "anchors", "ranges", "odometry"])]
    for _ in range(draw.choice([1, 1, 5, 300])):
        if rows:
            i = draw.randrange(len(rows))
            rows.insert(i, dict(rows[i]))


def swapped(tables: Tables, draw: random.Random) -> None:
    _, rows = of_some(tables, draw)
    if len(rows) > 1:
        i = draw.randrange(len(rows) - 1)
        rows[i], rows[i + 1] = rows[i + 1], rows[i]


def moved(tables: Tables, draw: random.Random) -> None:
    _, rows = of_some(tables, draw)
    if rows:
        rows.insert(draw.randrange(len(rows)), rows.pop(draw.randrange(len(rows))))


def replaced(tables: Tables, draw: random.Random) -> None:
    _, rows = of_some(tables, draw)
    if rows:
        row = draw.choice(rows)
        name = draw.choice(list(row))
        if name in TEXTS:
            row[name] = draw.choice(["r", "s", "n1", "n3", "q", "", "r" * 40])
        elif isinstance(row[name], float):
            row[name] = draw.choice([*ODD, -row[name], 1e3 * row[name], 1e-3 * row[name], 1e6 * row[name]])


def column_changed(tables: Tables, draw: random.Random) -> None:
    """Change a whole column: another unit, a constant, noise, a sigma that is not stated."""
    _, rows = of_some(tables, draw)
    if not rows:
        return
    names = [name for name in rows[0] if name not in (*TEXTS, *STAMPS)]
    name = draw.choice(names)
    factor = draw.choice([1e-9, 1e-3, 0.5, -1.0, 0.0, 57.3, 1e3, 1e6])
    robot = draw.choice([None, rows[0].get("robot")])
    kind, constant, noise = draw.randrange(4), draw.choice(ODD), 10 ** draw.uniform(-3, 3)
    for row in rows:
        value = row.get(name)
        if isinstance(value, float) and robot in (None, row.get("robot")):
            row[name] = (factor * value, constant, value + draw.gauss(0.0, noise), "")[kind]


def jumped(tables: Tables, draw: random.Random) -> None:
    """Let the stamps jump from some time on: of all rows, of a table, or of a robot."""
    begin, jump = draw.uniform(0, DURATION_S), 10.0 ** draw.uniform(-4, 11)
    table = draw.choice([None, None, "odometry", "ranges", "truth"])
    robot = draw.choice([None, None, "r"])
    for name, rows in tables.items():
        if table in (None, name):
            for row in rows:
                if robot in (None, row.get("robot"), row.get("from")):
                    for stamp in STAMPS:
                        if isinstance(row.get(stamp), float) and row[stamp] >= begin:
                            row[stamp] += jump


def stretched(tables: Tables, draw: random.Random) -> None:
    factor, begin = 10.0 ** draw.uniform(-6, 6), draw.choice([0.0, 0.0, 1.7e9, -1e6, 5e11])
    for rows in tables.values():
        for row in rows:
            for stamp in STAMPS:
                if isinstance(row.get(stamp), float):
                    row[stamp] = begin + factor * row[stamp]


def instants(tables: Tables, draw: random.Random) -> None:
    """Let increments take no time, or hardly any."""
    lasts, robot = draw.choice([0.0, 1e-9, 1e-6, 1e-3]), draw.choice([None, "r"])
    for row in tables.get("odometry", []):
        if robot in (None, row["robot"]) and isinstance(row["t0"], float):
            row["t1"] = row["t0"] + lasts


def coarse_stamps(tables: Tables, draw: random.Random) -> None:
    digits = draw.choice([0, -1])
    for rows in tables.values():
        for row in rows:
            for stamp in STAMPS:
                if isinstance(row.get(stamp), float):
                    row[stamp] = float(round(row[stamp], digits))


def emptied(tables: Tables, draw: random.Random) -> None:
    name = draw.choice(["truth", "truth", "anchors", "ranges", "odometry"])
    match draw.randrange(3):
        case 0:
            tables.pop(name, None)
        case 1:
            tables[name] = []
        case _:
            tables[name] = tables.get(name, [])[: draw.randrange(1, 40)]


def renamed(tables: Tables, draw: random.Random) -> None:
    old, new = draw.choice(["r", "s", "n1", "n2"]), draw.choice(["z", "n2", "n9", "r", "A", "long-name_7"])
    for rows in tables.values():
        for row in rows:
            for name in TEXTS:
                if row.get(name) == old:
                    row[name] = new


def anchored(tables: Tables, draw: random.Random) -> None:
    """Move anchors: together, onto a line, far away; add an antenna far from its robot."""
    spread = draw.choice([0.0, 1e-9, 1e-3, 1.0, 1e3, 1e7])
    for row in tables.get("anchors", []):
        row["x"], row["y"] = spread * draw.uniform(-1, 1), draw.choice([0.0, spread * draw.uniform(-1, 1)])
        if draw.random() < 0.3:
            row["height"] = draw.choice([0.0, 2.0, 100.0, -1e7])
    if draw.random() < 0.3:
        far = draw.choice([0.1, 1.0, 100.0, 1e7])
        tables["antennas"] = [{"robot": "r", "forward": far, "left": -far, "height": draw.choice([0.0, far])}]


def continued(tables: Tables, draw: random.Random) -> None:
    """Append the whole recording once more, later or at the same time."""
    later = draw.choice([0.0, DURATION_S, DURATION_S + 0.1, 60.0, 1000.0, 1.7e9])
    for name, rows in tables.items():
        more = (
            [dict(row) for row in rows] if name not in ("anchors", "antennas") or draw.random() < 0.1 else []
        )
        for row in more:
            for stamp in STAMPS:
                if isinstance(row.get(stamp), float):
                    row[stamp] += later
        rows.extend(more)


def still(tables: Tables, draw: random.Random) -> None:
    """Let robots stand, or turn on the spot, or slip."""
    gone = draw.choice([("dx", "dy"), ("dx", "dy", "dheading"), ("dheading",)])
    for row in tables.get("odometry", []):
        row.update(dict.fromkeys(gone, 0.0))


def outlying(tables: Tables, draw: random.Random) -> None:
    for row in tables.get("ranges", []):
        if draw.random() < 0.3 and isinstance(row["range"], float):
            row["range"] += abs(draw.gauss(0.0, 10 ** draw.uniform(-1, 6)))


ROW_MUTATIONS = (
    *(deleted, duplicated, swapped, moved, replaced, replaced, replaced, column_changed, column_changed),
    *(jumped, jumped, stretched, instants, coarse_stamps, emptied, renamed, anchored, continued, still),
    outlying,
)


def damaged(data: bytes, draw: random.Random) -> tuple[str, bytes]:
    """Return the name of a change of bytes, and `data` with it."""
    found = bytearray(data)
    place = draw.randrange(len(found) + 1)
    match draw.randrange(8):
        case 0:
            for _ in range(draw.choice([1, 1, 2, 10])):
                if found:
                    found[draw.randrange(len(found))] ^= 1 << draw.randrange(8)
            return "bits", bytes(found)
        case 1:
            return "truncated", bytes(found[:place])
        case 2:
            return "cut out", bytes(found[:place] + found[place + draw.choice([1, 9, 100, 1000]) :])
        case 3:
            return "repeated", bytes(found[:place] + found[max(place - 200, 0) :])
        case 4:
            return "zeros", bytes(found[:place] + bytes(draw.choice([1, 8, 500])) + found[place:])
        case 5:
            return "joined", data + data
        case 6:
            return "trailing", data + draw.randbytes(draw.choice([1, 8, 100]))
        case _:
            length = draw.choice([0, 1, 2**16, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1])
            found[place : place + 8] = length.to_bytes(8, "little")
            return "length", bytes(found)


def record_damaged(data: bytes, draw: random.Random) -> tuple[str, bytes]:
    """Return an MCAP file in which one record is left out, doubled, or has another kind or length."""
    places, at = [], 8
    while at + 9 <= len(data):
        length = int.from_bytes(data[at + 1 : at + 9], "little")
        if at + 9 + length > len(data):
            break
        places.append((at, at + 9 + length))
        at += 9 + length
    if not places:
        return "nothing", data
    begin, end = draw.choice(places)
    match draw.randrange(5):
        case 0:
            return "record left out", data[:begin] + data[end:]
        case 1:
            return "record doubled", data[:end] + data[begin:]
        case 2:
            return "kind", data[:begin] + bytes([draw.choice([*range(17), 0x80, 0xFF])]) + data[begin + 1 :]
        case 3:
            length = draw.choice([0, 1, end - begin - 8, 2**31, 2**63, 2**64 - 1])
            return "record length", data[: begin + 1] + length.to_bytes(8, "little") + data[begin + 9 :]
        case _:  # the sizes of a chunk, if it is one
            place = min(begin + 9 + draw.choice([16, 28, 32, 36, 40]), end)
            size = draw.choice([0, 2**20, 2**28, 2**31, 2**40, 2**63, 2**64 - 1]).to_bytes(8, "little")
            return "size", data[:place] + size + data[place + 8 :]


def frames_changed(frames: list[bytes], draw: random.Random) -> str:
    """Change the frames of a journal in place, and return the name of the change."""
    i = draw.randrange(len(frames))
    match draw.choice(["left out", "doubled", "swapped", "end", "number", "number", "number", "number"]):
        case "left out":
            del frames[i]
            return "frame left out"
        case "doubled":
            frames.insert(i, frames[i])
            return "frame doubled"
        case "swapped":
            frames[i - 1], frames[i] = frames[i], frames[i - 1]
            return "frames swapped"
        case "end":
            del frames[draw.randrange(5, max(6, len(frames))) :]
            return "frames cut off"
    try:
        content = msgspec.to_builtins(decode(frames[i], KINDS, MAX_FRAME_BYTES))
        numbers = list(_numbers(content))
        holder, key = draw.choice(numbers)
        value = draw.choice([one for one in ODD if isinstance(one, float)] + [0, 1, -1, 10**6, 2**31, 2**53])
        holder[key] = draw.choice([value, holder[key] * draw.choice([-1, 2, 1000])])
        frames[i] = encode(msgspec.convert(content, KINDS))
    except (msgspec.ValidationError, IndexError, OverflowError, TypeError, ValueError):
        return "nothing"
    return "number of a frame"


def _numbers(content: Any) -> Iterator[tuple[Any, Any]]:
    """Yield the holder and the key of each number in `content`."""
    items = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in list(items):
        if isinstance(value, dict | list):
            yield from _numbers(value)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield content, key
