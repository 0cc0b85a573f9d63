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
from compose.recording.ranging.range_recording import SAME_TIME_S, RangeRecording, RecordedRobot
from compose.recording.ranging.recording_rows import (
    AnchorRow,
    Covariance6,
    OdometryRow,
    RangeRow,
    RecordingBuilder,
    SourcePlace,
    TruePoseRow,
    number_of,
    row_of,
)
from protocol import files

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


class Vertex(NamedTuple):
    """A pose with its stamp in s and its true pose."""

    row: TruePoseRow
    place: SourcePlace


class Edge(NamedTuple):
    """An odometry edge from the pose with number `base` to the next."""

    base: int
    row: OdometryRow
    """The edge with its stamp as both t0 and t1."""
    covariance: Covariance6
    place: SourcePlace


class Graph(NamedTuple):
    """The poses and edges of each robot, by its name; poses also by their numbers."""

    vertices: dict[str, dict[int, Vertex]]
    edges: dict[str, list[Edge]]


def read_pyfg(path: Path, anchors: Sequence[AnchorRow] = ()) -> RangeRecording:
    """Return the recording in the file `path`, with `anchors` in place of those of the same names there.

    Raises OSError, and BadRecording, which names the line.
    """
    try:
        text = files.read_text(path)
    except UnicodeDecodeError:
        raise BadRecording(f"{path}: it is not UTF-8 text") from None
    builder, graph = RecordingBuilder(path, anchors), Graph({}, {})
    for number, line in enumerate(text.split("\n"), 1):
        if words := line.split():
            _take(words[0], words[1:], SourcePlace(path, number), graph, builder)
    for robot in {**graph.vertices, **graph.edges}:
        builder.add_robot(robot)
    ends = _stamps_are_ends(graph)
    for robot, edges in graph.edges.items():
        for row, covariance, place in _increments(robot, edges, graph.vertices.get(robot, {}), ends=ends):
            builder.add_odometry(row, covariance, place)
    for vertices in graph.vertices.values():
        for _, (truth, place) in sorted(vertices.items()):
            builder.add(truth, place)
    return builder.recording()


def _take(
    kind: str, words: Sequence[str], place: SourcePlace, graph: Graph, builder: RecordingBuilder
) -> None:
    """Take one line: its kind, and the words after that."""
    if kind in UNUSED:
        builder.unused[kind] += 1
        return
    if kind not in LINE_FIELDS:
        why = "; only two-dimensional files are read" if re.search("SE3|XYZ", kind) else ""
        raise BadRecording(f"{place}: unknown kind of line {kind[:40]!a}{why}")
    if len(words) != len(LINE_FIELDS[kind]):
        raise BadRecording(f"{place}: {kind} has {len(words)} fields and needs {len(LINE_FIELDS[kind])}")
    values = dict(zip(LINE_FIELDS[kind], words, strict=True))
    match kind:
        case "VERTEX_SE2":
            _take_vertex(values, place, graph)
        case "EDGE_SE2":
            _take_edge(values, place, graph, builder)
        case "EDGE_RANGE":
            builder.add(_range_row(values, place), place)
        case "VERTEX_XY:PRIOR":
            builder.add_prior(_prior_row(values, place))
        case _:
            builder.add(row_of(values, AnchorRow, place), place)


def _pose(name: str, place: object) -> tuple[str, int]:
    """Return the robot and the number of a pose."""
    found = POSE.match(name)
    if found is None:
        raise BadRecording(f"{place}: {name[:40]!a} is not the name of a pose, such as A17")
    return found["robot"], int(found["index"])


def _take_vertex(values: Mapping[str, str], place: SourcePlace, graph: Graph) -> None:
    robot, index = _pose(values["name"], place)
    vertices = graph.vertices.setdefault(robot, {})
    if index in vertices:
        raise BadRecording(f"{place}: there are two poses {robot}{index}")
    pose = {name: values[name] for name in ("t", "x", "y", "heading")}
    vertices[index] = Vertex(row_of({"robot": robot, **pose}, TruePoseRow, place), place)


def _take_edge(
    values: Mapping[str, str], place: SourcePlace, graph: Graph, builder: RecordingBuilder
) -> None:
    (robot, base), (other, to) = _pose(values["from"], place), _pose(values["to"], place)
    if robot != other or to != base + 1:
        builder.unused["EDGE_SE2 between poses that do not follow each other"] += 1
        return
    moved = {name: values[name] for name in ("dx", "dy", "dheading")}
    row = row_of({"robot": robot, "t0": values["t"], "t1": values["t"], **moved}, OdometryRow, place)
    stated = [_number(values[name], name, place) for name in COVARIANCE_FIELDS]
    for name, value in zip(COVARIANCE_FIELDS, stated, strict=True):
        if value < 0.0 and name in ("cov_xx", "cov_yy", "cov_hh"):
            raise BadRecording(f"{place}: {name}: the variance {value:g} is negative")
    xx, xy, xh, yy, yh, hh = stated
    if not _is_covariance(xx, xy, xh, yy, yh, hh):
        raise BadRecording(f"{place}: no errors have this covariance: it has a negative eigenvalue")
    graph.edges.setdefault(robot, []).append(Edge(base, row, (xx, xy, xh, yy, yh, hh), place))


def _is_covariance(xx: float, xy: float, xh: float, yy: float, yh: float, hh: float) -> bool:
    """Return whether a matrix with these elements, and variances from 0 on, has no negative eigenvalue."""
    if not xy and not xh and not yh:
        return True
    x, y, h = [math.sqrt(value) or math.inf for value in (xx, yy, hh)]
    if (xy and not xx * yy) or (xh and not xx * hh) or (yh and not yy * hh):
        return False
    a, b, c = xy / x / y, xh / x / h, yh / y / h
    determinant = 1.0 + 2.0 * a * b * c - a * a - b * b - c * c
    return max(abs(a), abs(b), abs(c)) <= 1.0 + DECIMALS_ROUNDING and determinant >= -DECIMALS_ROUNDING


DECIMALS_ROUNDING = 1e-6
"""The error of correlations from the decimals of a file."""


def _prior_row(values: Mapping[str, str], place: SourcePlace) -> AnchorRow:
    """Return the anchor of a prior, with the mean of both variances."""
    xx, _, yy = [_number(values[name], name, place) for name in ("cov_xx", "cov_xy", "cov_yy")]
    if min(xx, yy) < 0.0:
        raise BadRecording(f"{place}: cov_xx, cov_yy: a variance is negative")
    told = {name: values[name] for name in ("anchor", "x", "y")}
    return row_of({**told, "sigma": repr(math.sqrt(0.5 * (xx + yy)))}, AnchorRow, place)


def _range_row(values: Mapping[str, str], place: SourcePlace) -> RangeRow:
    variance = _number(values["variance"], "variance", place)
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


def _number(text: str, name: str, place: object) -> float:
    value = number_of(text)
    if isinstance(value, str) or abs(value) > LARGEST_NUMBER:
        raise BadRecording(f"{place}: {name}: {text[:40]!a} is not a number")
    return value


LARGEST_NUMBER = 1e15
"""The largest variance or covariance."""


def _stamps_are_ends(graph: Graph) -> bool:
    """Return whether the stamps of edges are nearer to their later poses than to their earlier ones."""
    late = early = 0.0
    for robot, edges in graph.edges.items():
        vertices = graph.vertices.get(robot, {})
        for edge in edges:
            if edge.base in vertices and edge.base + 1 in vertices:
                early += abs(edge.row.t1 - vertices[edge.base].row.t)
                late += abs(edge.row.t1 - vertices[edge.base + 1].row.t)
    return late <= early


def _increments(
    robot: str, unsorted: Sequence[Edge], vertices: Mapping[int, Vertex], *, ends: bool
) -> Iterator[tuple[OdometryRow, Covariance6, SourcePlace]]:
    """Yield the increments of `robot`; the stamps of edges are their ends, or their starts."""
    edges = sorted(unsorted, key=lambda edge: edge.base)
    for i, (base, row, covariance, place) in enumerate(edges):
        far = i - 1 if ends else i + 1
        joined = base - 1 if ends else base + 1
        pose = base if ends else base + 1
        stamp = row.t1
        if 0 <= far < len(edges) and edges[far].base == joined:
            other = edges[far].row.t1
        elif pose in vertices:
            at = vertices[pose].row.t
            other = min(at, stamp) if ends else max(at, stamp)
        else:
            raise BadRecording(f"{place}: the time of {robot}{pose} is unknown: it has no VERTEX_SE2")
        if ends and other > stamp:
            before = f"the edge before it is of {other:.15g} s"
            raise BadRecording(f"{place}: t: it is of {stamp:.15g} s, and {before}")
        t0, t1 = (other, stamp) if ends else (stamp, other)
        yield OdometryRow(robot, t0, t1, row.dx, row.dy, row.dheading), covariance, place


# --- writing ------------------------------------------------------------------------------------------------


class WrittenGraph(NamedTuple):
    """A recording in the text format, and the names that its radios have there."""

    text: str
    names: dict[str, str]
    """The names in the file of all robots and anchors, by their names in the recording."""


LETTERS = "ABCDEFGHIJKMNOPQRSTUVWXYZ"
"""The names that robots can have. L is that of landmarks."""


def written_pyfg(recording: RangeRecording) -> WrittenGraph:
    """Return `recording` as text, with every number in its shortest exact form.

    Poses are numbered from 0, and each needs a true pose. Raises UserError if there is none, and for what the
    format cannot hold: heights, antennas, more than 25 robots, and measurements without stated sigmas.
    """
    names = _names(recording)
    lines: list[str] = []
    edges: list[str] = []
    stamps: dict[str, np.ndarray] = {}
    for robot in recording.robots:
        own, moves, stamps[robot.id] = _chain(recording, robot, names[robot.id])
        lines += own
        edges += moves
    for anchor in recording.anchors:
        if anchor.height:
            raise UserError(f"{recording.source}: a .pyfg file cannot hold the height of {anchor.id}")
        if anchor.sigma == math.inf:
            raise UserError(
                f"{recording.source}: the position of {anchor.id}, which a .pyfg file needs, is unknown"
            )
        lines.append(f"VERTEX_XY {names[anchor.id]} {anchor.x!r} {anchor.y!r}")
    return WrittenGraph("\n".join([*lines, *edges, *_range_lines(recording, names, stamps), ""]), names)


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


def _chain(
    recording: RangeRecording, robot: RecordedRobot, letter: str
) -> tuple[list[str], list[str], np.ndarray]:
    """Return the lines of the poses and of the edges of `robot`, and the times in s of its poses."""
    if any(robot.antenna):
        raise UserError(f"{recording.source}: a .pyfg file cannot hold the antenna of {robot.id}")
    t0, t1, increments, covariance = robot.odometry
    if not np.all(np.isfinite(covariance)):
        raise UserError(f"{recording.source}: the odometry of {robot.id} states no sigmas")
    starts = np.ones(len(t0), bool)
    starts[1:] = t0[1:] - t1[:-1] > SAME_TIME_S
    base = np.arange(len(t0)) + np.cumsum(starts) - 1
    times = np.empty(len(t0) + int(np.sum(starts)))
    times[base + 1] = t1
    times[base[starts]] = t0[starts]
    truth = robot.truth
    if truth is None:
        raise UserError(
            f"{recording.source}: the true poses of {robot.id}, which a .pyfg file needs, are unknown"
        )
    if not len(t0):
        times = truth.t[:1]
    if len(truth.t) != len(times):
        poses = f"{len(truth.t)} true poses for {len(times)} poses"
        raise UserError(f"{recording.source}: {robot.id} has {poses} of its odometry")
    lines = [
        f"VERTEX_SE2 {_plain(t)} {letter}{i} {_plain(*pose)}"
        for i, (t, pose) in enumerate(zip(truth.t, truth.poses, strict=True))
    ]
    edges = [
        f"EDGE_SE2 {_plain(t)} {letter}{i} {letter}{i + 1} {_plain(*move)} {_plain(*matrix[UPPER_TRIANGLE])}"
        for i, t, move, matrix in zip(base, t1, increments, covariance, strict=True)
    ]
    return lines, edges, times


UPPER_TRIANGLE = np.triu_indices(3)


def _range_lines(
    recording: RangeRecording, names: Mapping[str, str], stamps: Mapping[str, np.ndarray]
) -> Iterator[str]:
    """Yield the lines of the ranges, each with the poses that are nearest in time."""
    radios = recording.radios
    for t, first, second, measured, sigma in zip(*recording.ranges, strict=True):
        if not math.isfinite(sigma):
            raise UserError(f"{recording.source}: the range at {t:.15g} s states no sigma")
        ends = []
        for name in (radios[first], radios[second]):
            times = stamps.get(name)
            ends.append(names[name] + ("" if times is None else str(int(np.argmin(np.abs(times - t))))))
        yield f"EDGE_RANGE {_plain(t)} {' '.join(ends)} {_plain(measured, sigma * sigma)}"


def _plain(*values: float) -> str:
    return " ".join([repr(float(value)) for value in values])
