"""Range recordings for tests: the recorded sample, and a small recording as tables."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Iterable, Mapping
from pathlib import Path

import pytest
from mcap.writer import Writer

from compose.errors import USER_ERROR, UserError
from compose.recording.ranging.range_files import read_ranges
from protocol.motion import Controls, Pose, step

SAMPLE = Path(__file__).parent / "data" / "uwb" / "tiers-a-b-30-s.pyfg"
TABLES = {
    "odometry": [
        {"robot": "a", "t0": 0.0, "t1": 0.5, "dx": 0.1, "dy": 0.01, "dheading": 0.2},
        {"robot": "b", "t0": 0.1, "t1": 0.4, "dx": 0.2, "dy": 0.0, "dheading": -0.1},
        {"robot": "a", "t0": 0.5, "t1": 1.0, "dx": 0.3, "dy": -0.01, "dheading": 0.0},
        {"robot": "a", "t0": 2.0, "t1": 2.5, "dx": 0.3, "dy": -0.01, "dheading": 0.0},
    ],
    "ranges": [
        {"t": 0.3, "from": "a", "to": "b", "range": 2.5, "sigma": 0.1},
        {"t": 0.2, "from": "M1", "to": "a", "range": 1.5},
    ],
    "anchors": [{"anchor": "M1", "x": 3.0, "y": -4.0, "height": 1.25}],
    "antennas": [{"robot": "b", "forward": 0.2, "left": -0.1, "height": 0.3}],
    "truth": [
        {"robot": "a", "t": 0.0, "x": 1.0, "y": 2.0, "heading": 3.0},
        {"robot": "a", "t": 0.0, "x": 1.0, "y": 2.0, "heading": 3.0},
        {"robot": "a", "t": 0.4, "x": 1.1, "y": 2.1, "heading": 3.1},
    ],
}
SIGMAS = {"sigma_dx": 0.01, "sigma_dy": 0.02, "sigma_dheading": 0.03}
Tables = Mapping[str, Iterable[Mapping[str, object]]]


def written_csv(folder: Path, tables: Tables) -> Path:
    """Write a CSV file for each of `tables` to `folder`."""
    folder.mkdir(exist_ok=True)
    for name, rows in tables.items():
        columns = list(dict.fromkeys(column for row in rows for column in row))
        lines = [",".join(str(row.get(column, "")) for column in columns) for row in rows]
        (folder / f"{name}.csv").write_text("\n".join([",".join(columns), *lines, ""]))
    return folder


def written_mcap(path: Path, tables: Tables, encoding: str = "json") -> Path:
    """Write a message for each row of `tables` to `path`, and one on a topic that is not read."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for name, rows in {**tables, "battery": [{"volts": 12}]}.items():
            channel = writer.register_channel(f"/{name}", encoding, 0)
            for row in rows:
                writer.add_message(channel, 0, json.dumps(row).encode(), 0)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def circling(duration_s: float) -> dict[str, list[dict[str, object]]]:
    """Return the tables of a robot that circles among four anchors, with two ranges to each in a second."""
    anchors, draw, period = (
        {"A": (0.0, 0.0), "B": (10.0, 0.0), "C": (10.0, 10.0), "D": (0.0, 10.0)},
        random.Random(1),
        0.1,
    )
    tables: dict[str, list[dict[str, object]]] = {"odometry": [], "ranges": []}
    tables["anchors"] = [{"anchor": name, "x": x, "y": y} for name, (x, y) in anchors.items()]
    pose, controls = Pose(5.0, 2.0, 0.3), Controls(0.6, 0.25)
    for k in range(round(duration_s / period)):
        ends = {"t0": round(k * period, 3), "t1": round((k + 1) * period, 3)}
        moved = {"dx": controls.v * period, "dy": 0.0, "dheading": controls.omega * period}
        tables["odometry"].append({"robot": "r", **ends, **moved})
        pose = step(pose, controls.v, controls.omega, period)
        for name, place in anchors.items() if k % 5 == 0 else ():
            rho = round(math.dist((pose.x, pose.y), place) + draw.gauss(0.0, 0.05), 4)
            tables["ranges"].append({"t": ends["t1"], "from": "r", "to": name, "range": rho, "sigma": 0.05})
    return tables


POSE: dict[str, object] = {"robot": "a", "t": 0, "x": 1, "y": 2, "heading": 3}


def refused(path: Path) -> str:
    """Return the one line with which `path` is refused."""
    with pytest.raises(UserError) as error:
        read_ranges(path)
    assert error.value.exit_status == USER_ERROR
    assert "\n" not in str(error.value)
    return str(error.value)
