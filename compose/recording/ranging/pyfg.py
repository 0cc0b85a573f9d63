"""PyFactorGraph's text format (`.pyfg`), two-dimensional, read and written.

An edge has one stamp and joins two poses. The stamps of edges are those of the odometry: each is the end of
its increment, or its start if it is nearer to the stamp of that pose. The stamps of the poses are those of
the truth. A range counts at its own stamp; of its poses only the robots are used.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from compose.errors import BadRecording, UserError
from compose.recording.ranging.range_recording import Numbers, RangeRecording
from compose.recording.ranging.recording_builder import UPPER, Covariance6, RecordingBuilder
from compose.recording.ranging.recording_rows import (
    AnchorRow,
    OdometryRow,
    RangeRow,
    SourcePlace,
    TruePoseRow,
    number_of,
    row_of,
)

POSE = re.compile(r"(?P<robot>[A-KM-Za-km-z][A-Za-z]*)(?P<index>[0-9]{1,15})\Z")
"""The name of a pose: the robot and a number. Names with L are those of landmarks."""

COVARIANCE_FIELDS = ("cov_xx", "cov_xy", "cov_xh", "cov_yy", "cov_yh", "cov_hh")
LINE_FIELDS = {
    "VERTEX_SE2": ("t", "name", "x", "y", "heading"),
    "VERTEX_XY": ("anchor", "x", "y"),
    "VERTEX_XY:PRIOR": ("t", "anchor", "x", "y", "cov_xx", "cov_xy", "cov_yy"),
    "EDGE_SE2": ("t", "from", "to", "dx", "dy", "dheading", *COVARIANCE_FIELDS),
    "EDGE_RANGE": ("t", "from", "to", "range", "variance"),
}
"""The fields of each kind of line that is used."""
UNUSED = ("VERTEX_SE2:PRIOR", "EDGE_SE2_XY")
"""The kinds of lines that are not used."""


class Edge(NamedTuple):
    """An odometry edge from the pose with number `base` to the next."""

    base: int
    row: OdometryRow
    """The edge with its stamp as both t0 and t1."""
    covariance: Covariance6
    place: SourcePlace


Poses = dict[int, tuple[TruePoseRow, SourcePlace]]
"""The true poses of a robot and their places, by their numbers."""


def add_pyfg(builder: RecordingBuilder, path: Path, text: str) -> None:
    """Add the content `text` of the file `path`. Raises BadRecording, which names the line."""
    poses: dict[str, Poses] = {}
    edges: dict[str, list[Edge]] = {}
    for number, line in enumerate(text.split("\n"), 1):
        if words := line.split():
            _take(words, SourcePlace(path, number), builder, poses, edges)
    for robot in {**poses, **edges}:
        builder.add_robot(robot)
    ends = _stamps_are_ends(edges, poses)
    for robot, own in edges.items():
        for row, covariance, place in _increments(robot, own, poses.get(robot, {}), ends=ends):
            builder.add_odometry(row, covariance, place)
    for numbered in poses.values():
        for _, (truth, place) in sorted(numbered.items()):
            builder.add(truth, place)


def _take(
    words: Sequence[str],
    place: SourcePlace,
    builder: RecordingBuilder,
    poses: dict[str, Poses],
    edges: dict[str, list[Edge]],
) -> None:
    """Take the words of one line."""
    kind = words[0]
    values = _values(kind, words[1:], place) if kind not in UNUSED else {}
    match kind:
        case "VERTEX_SE2":
            robot, index = _pose(values.pop("name"), place)
            if index in poses.setdefault(robot, {}):
                raise BadRecording(f"{place}: there are two poses {robot}{index}")
            poses[robot][index] = row_of({"robot": robot, **values}, TruePoseRow, place), place
        case "EDGE_SE2":
            (robot, base), to = _pose(values["from"], place), _pose(values["to"], place)
            if to == (robot, base + 1):
                edges.setdefault(robot, []).append(_edge(robot, base, values, place))
            else:
                builder.unused["EDGE_SE2 between poses that do not follow each other"] += 1
        case "EDGE_RANGE":
            builder.add(_range_row(values, place), place)
        case "VERTEX_XY:PRIOR":
            builder.add_prior(_prior_row(values, place))
        case "VERTEX_XY":
            builder.add(row_of(values, AnchorRow, place), place)
        case _:
            builder.unused[kind] += 1


def _values(kind: str, words: Sequence[str], place: SourcePlace) -> dict[str, str]:
    """Return the words of a line after its kind, by field."""
    if kind not in LINE_FIELDS:
        why = "; only two-dimensional files are read" if re.search("SE3|XYZ", kind) else ""
        raise BadRecording(f"{place}: unknown kind of line {kind[:40]!a}{why}")
    if len(words) != len(LINE_FIELDS[kind]):
        raise BadRecording(f"{place}: {kind} has {len(words)} fields and needs {len(LINE_FIELDS[kind])}")
    return dict(zip(LINE_FIELDS[kind], words, strict=True))


def _pose(name: str, place: object) -> tuple[str, int]:
    """Return the robot and the number of a pose."""
    found = POSE.match(name)
    if found is None:
        raise BadRecording(f"{place}: {name[:40]!a} is not the name of a pose, such as A17")
    return found["robot"], int(found["index"])


def _edge(robot: str, base: int, values: Mapping[str, str], place: SourcePlace) -> Edge:
    moved = {name: values[name] for name in ("dx", "dy", "dheading")}
    row = row_of({"robot": robot, "t0": values["t"], "t1": values["t"], **moved}, OdometryRow, place)
    xx, xy, xh, yy, yh, hh = [_number(values, name, place) for name in COVARIANCE_FIELDS]
    for name, value in zip(("cov_xx", "cov_yy", "cov_hh"), (xx, yy, hh), strict=True):
        if value < 0.0:
            raise BadRecording(f"{place}: {name}: the variance {value:g} is negative")
    if (xy or xh or yh) and not _is_covariance(xx, xy, xh, yy, yh, hh):
        raise BadRecording(f"{place}: no errors have this covariance: it has a negative eigenvalue")
    return Edge(base, row, (xx, xy, xh, yy, yh, hh), place)


def _is_covariance(*upper: float) -> bool:
    """Return whether a matrix with these elements, and variances from 0 on, has no negative eigenvalue."""
    matrix = np.array(upper)[UPPER]
    sigmas = np.sqrt(np.diagonal(matrix))
    matrix /= np.outer(*[np.where(sigmas > 0.0, sigmas, TINY)] * 2)
    return bool(np.linalg.eigvalsh(matrix)[0] >= -DECIMALS_ROUNDING)


TINY, DECIMALS_ROUNDING = 1e-150, 1e-6
"""The sigma in place of 0, and the error of correlations from the decimals of a file."""


def _prior_row(values: Mapping[str, str], place: SourcePlace) -> AnchorRow:
    """Return the anchor of a prior, with the mean of both variances."""
    xx, _, yy = [_number(values, name, place) for name in ("cov_xx", "cov_xy", "cov_yy")]
    if min(xx, yy) < 0.0:
        raise BadRecording(f"{place}: cov_xx, cov_yy: a variance is negative")
    told = {name: values[name] for name in ("anchor", "x", "y")}
    return row_of({**told, "sigma": repr(math.sqrt(0.5 * (xx + yy)))}, AnchorRow, place)


def _range_row(values: Mapping[str, str], place: SourcePlace) -> RangeRow:
    variance = _number(values, "variance", place)
    if variance <= 0.0:
        raise BadRecording(f"{place}: variance: {variance:g} is not positive")
    ends = {
        end: values[end] if values[end].startswith("L") else _pose(values[end], place)[0]
        for end in ("from", "to")
    }
    return row_of(
        {"t": values["t"], **ends, "range": values["range"], "sigma": repr(math.sqrt(variance))},
        RangeRow,
        place,
    )


def _number(values: Mapping[str, str], name: str, place: object) -> float:
    value = number_of(values[name])
    if isinstance(value, str) or abs(value) > LARGEST_NUMBER:
        raise BadRecording(f"{place}: {name}: {values[name][:40]!a} is not a number")
    return value


LARGEST_NUMBER = 1e15
"""The largest variance or covariance."""


def _stamps_are_ends(edges: Mapping[str, Sequence[Edge]], poses: Mapping[str, Poses]) -> bool:
    """Return whether the stamps of edges are nearer to their later poses than to their earlier ones."""
    late = early = 0.0
    for robot, each in edges.items():
        own = poses.get(robot, {})
        for edge in each:
            if edge.base in own and edge.base + 1 in own:
                early += abs(edge.row.t1 - own[edge.base][0].t)
                late += abs(edge.row.t1 - own[edge.base + 1][0].t)
    return late <= early


def _increments(
    robot: str, unsorted: Sequence[Edge], poses: Poses, *, ends: bool
) -> Iterator[tuple[OdometryRow, Covariance6, SourcePlace]]:
    """Yield the increments of `robot`; the stamps of edges are their ends, or their starts."""
    stamps = {base + ends: row.t1 for base, row, _, _ in unsorted}
    for base, row, covariance, place in sorted(unsorted, key=lambda edge: edge.base):
        far, stamp = base if ends else base + 1, row.t1
        if far in stamps:
            other = stamps[far]
        elif far in poses:
            other = (min if ends else max)(poses[far][0].t, stamp)
        else:
            raise BadRecording(f"{place}: the time of {robot}{far} is unknown: it has no VERTEX_SE2")
        if ends and other > stamp:
            before = f"the edge before it is of {other:.15g} s"
            raise BadRecording(f"{place}: t: it is of {stamp:.15g} s, and {before}")
        t0, t1 = (other, stamp) if ends else (stamp, other)
        yield OdometryRow(robot, t0, t1, row.dx, row.dy, row.dheading), covariance, place


# --- writing ------------------------------------------------------------------------------------------------


LETTERS = "ABCDEFGHIJKMNOPQRSTUVWXYZ"
"""The names that robots can have. L is that of landmarks."""


def written_pyfg(recording: RangeRecording) -> tuple[str, dict[str, str]]:
    """Return the `recording` of a run as text, and the names in it of all robots and anchors, by their own.

    Every number has its shortest exact form.

    Poses are numbered from 0, and each needs a true pose. Raises UserError if there is none, and for more
    than 25 robots.
    """
    names = _names(recording)
    lines: list[str] = []
    edges: list[str] = []
    times: dict[str, Numbers] = {}
    for robot in recording.robots:
        letter, truth = names[robot.id], robot.truth
        if truth is None:
            what = f"the true poses of {robot.id}, which a .pyfg file needs, are unknown"
            raise UserError(f"{recording.source}: {what}")
        for i, (t, pose) in enumerate(zip(truth.t, truth.poses, strict=True)):
            lines.append(f"VERTEX_SE2 {_plain(t)} {letter}{i} {_plain(*pose)}")
        t0, t1, increments, covariance = robot.odometry
        times[robot.id] = np.concatenate((t0[:1], t1)) if len(t0) else truth.t[:1]
        for i, (t, move, matrix) in enumerate(zip(t1, increments, covariance, strict=True)):
            moved = f"{_plain(*move)} {_plain(*matrix[UPPER_TRIANGLE])}"
            edges.append(f"EDGE_SE2 {_plain(t)} {letter}{i} {letter}{i + 1} {moved}")
    lines += [f"VERTEX_XY {names[one.id]} {one.x!r} {one.y!r}" for one in recording.anchors]
    radios = recording.radios
    for t, first, second, measured, sigma in zip(*recording.ranges, strict=True):
        ends = [
            names[name] + (str(np.argmin(np.abs(times[name] - t))) if name in times else "")
            for name in (radios[first], radios[second])
        ]
        edges.append(f"EDGE_RANGE {_plain(t)} {' '.join(ends)} {_plain(measured, sigma * sigma)}")
    return "\n".join([*lines, *edges, ""]), names


UPPER_TRIANGLE = np.triu_indices(3)


def _names(recording: RangeRecording) -> dict[str, str]:
    """Return the names in the file: letters of which robots already have one each, else letters in order."""
    robots = [robot.id for robot in recording.robots]
    capitals = [one.upper() for one in robots]
    if not set(capitals) <= set(LETTERS) or len(set(capitals)) < len(capitals):
        if len(robots) > len(LETTERS):
            raise UserError(f"{recording.source}: a .pyfg file holds at most {len(LETTERS)} robots")
        capitals = list(LETTERS[: len(robots)])
    anchors = {anchor.id: f"L{i}" for i, anchor in enumerate(recording.anchors)}
    return dict(zip(robots, capitals, strict=True)) | anchors


def _plain(*values: float) -> str:
    return " ".join([repr(float(value)) for value in values])
