"""`tandem run`: a whole mission as processes over Zenoh, and its files."""

from __future__ import annotations

import csv
import json
import math
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from compose.launch.processes import free_endpoint
from tests.commands import (
    OVER,
    PAPER_1,
    TandemProcess,
    journals,
    on_a_terminal,
    processes_of,
    several_pairs,
    tandem,
)
from tests.range_tables import SAMPLE
from tests.series import series

PAPER_TICKS = {"paper-1": 48, "paper-2": 110}
COLUMNS = ["tick", "robot", "x", "y", "heading", "v", "omega", "anchor_range", "mutual_range"]
FLOATS = ["x", "y", "heading", "v", "omega", "anchor_range", "mutual_range"]
EXACT_WHEELS = dict.fromkeys(("v", "omega", "v_floor", "omega_floor"), 0.0)
RECORD = ["agent-a.journal", "agent-b.journal", "summary.json", "ticks.csv", "world.journal"]


def summary(folder: Path) -> dict[str, Any]:
    told: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return told


def ticks(folder: Path) -> list[dict[str, str]]:
    with (folder / "ticks.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def distance(one: dict[str, str], other: dict[str, str]) -> float:
    return math.hypot(float(one["x"]) - float(other["x"]), float(one["y"]) - float(other["y"]))


@pytest.fixture(scope="module", params=["paper-1", "paper-2"])
def played(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Return the name of a simulation of the paper, run as processes, and its recording."""
    out = tmp_path_factory.mktemp(request.param) / "out"
    ended = tandem("run", request.param, "--out", out)
    assert ended.status == 0, ended
    assert ended.err == ""
    assert not processes_of(out)
    return request.param, out


# --- files ------------------------------------------------------------------------------------------


def test_the_missions_of_the_paper_localise_at_their_tick_with_a_complete_recording(
    played: tuple[str, Path],
) -> None:
    name, out = played
    told = summary(out)
    assert sorted(path.name for path in out.iterdir()) == RECORD
    assert (told["outcome"], told["ticks"], told["reason"]) == ("localised", PAPER_TICKS[name], None)
    for robot in told["robots"].values():
        assert robot["position_error_m"] < 1e-9
        assert robot["heading_error_rad"] < 1e-9


def test_summary_has_every_documented_value_of_a_run(played: tuple[str, Path]) -> None:
    name, out = played
    told = summary(out)
    assert list(told) == [
        *("scenario", "seed", "mode", "outcome", "reason", "ticks", "wall_s", "first_contact_tick"),
        *("t_max_s", "min_separation_m", "nearest_m", "parameters", "versions", "robots"),
    ]
    assert (told["scenario"], told["seed"], told["mode"]) == (name, 1, "processes")
    assert 0.0 < told["wall_s"] < 60.0
    assert told["first_contact_tick"] == {"paper-1": 46, "paper-2": 106}[name]
    assert told["t_max_s"] == pytest.approx(225.942087, abs=1e-6)
    assert told["parameters"] == {
        "sensing_range": 3.0,
        "period": 1.0,
        "max_speed": 1.0,
        "max_turn_rate": math.pi,
        "accuracy": 0.1,
        "confidence": 0.9999,
        "safety_distance": 0.0,
        "noise": {
            **dict.fromkeys(("anchor_sigma", "mutual_sigma", "outliers", "drop_outs"), 0.0),
            "outlier_bias": [0.3, 2.0],
            **dict.fromkeys(("actuation", "odometry"), EXACT_WHEELS),
            **dict.fromkeys(
                (
                    "profile",
                    "range_bias",
                    "pair_bias",
                    "range_scale",
                    "wheel_scale",
                    "gyro_bias",
                )
            ),
            "slow_sigma": 0.0,
            "survey_error": 0.0,
            "range_delay": 0.0,
            "range_depth": 0.0,
            "slow_time": 2.0,
            "sigma_degrees": 4.0,
            "strays": 0.001,
            "odometry_strays": 0.0,
        },
        "planner": "paper",
        "planner_options": {},
        "max_ticks": told["parameters"]["max_ticks"],
        "world_noise": None,
        "world_range": None,
        "world_radio": None,
    }
    assert told["parameters"]["max_ticks"] > 2 * 226
    assert {"python", "tandem-ranging", "eclipse-zenoh", "numpy"} <= told["versions"].keys()
    assert all(isinstance(version, str) for version in told["versions"].values())
    rows = ticks(out)
    nearest = min(distance(a, b) for a, b in zip(rows[::2], rows[1::2], strict=True))
    assert told["min_separation_m"] == pytest.approx(nearest, abs=1e-12)


PAPER_ROBOTS: dict[tuple[str, str], dict[str, Any]] = {
    ("paper-1", "a"): {"branch": "circle", "alpha": 1.980462, "candidates": [4, 4], "anchor_ranges": 3},
    ("paper-1", "b"): {
        "branch": "three-ranges",
        "alpha": -2.384686,
        "candidates": [4, 4],
        "last_turn_rate": 0.9076,
        "separation_m2": 1.80395,
    },
    ("paper-2", "a"): {"branch": "three-ranges-virtual", "alpha": -1.389410, "candidates": [4, 2]},
    ("paper-2", "b"): {
        "branch": "three-ranges",
        "alpha": 1.287611,
        "candidates": [4, 2],
        "last_turn_rate": 0.1484,
        "separation_m2": 0.95768,
    },
}


@pytest.mark.parametrize("robot", ["a", "b"])
def test_summary_has_every_documented_value_of_a_robot(played: tuple[str, Path], robot: str) -> None:
    name, out = played
    told = summary(out)["robots"][robot]
    assert set(told) >= {
        *("localised", "localised_tick", "estimate", "truth", "position_error_m", "heading_error_rad"),
        *("anchor_ranges", "mutual_ranges", "branch", "alpha", "candidates", "last_turn_rate"),
        *("separation_m2", "reports_sent", "reports_heard", "reports_refused", "bytes_sent"),
    }
    expected = {"last_turn_rate": None, "separation_m2": None} | PAPER_ROBOTS[name, robot]
    for field, value in expected.items():
        assert told[field] == (pytest.approx(value, abs=1e-4) if isinstance(value, float) else value), field
    assert told["localised"] is True
    assert told["localised_tick"] == PAPER_TICKS[name]
    assert told["mutual_ranges"] == 3
    assert told["reports_refused"] == 0
    assert told["deadlines_missed"] == 0
    assert told["reports_sent"] == told["reports_heard"] >= 3
    assert 0 < told["bytes_sent"] <= 4096 * told["reports_sent"]
    last = [row for row in ticks(out) if row["robot"] == robot][-1]
    assert told["truth"] == [float(last[field]) for field in ("x", "y", "heading")]
    assert told["estimate"] == pytest.approx(told["truth"], abs=1e-9)
    error = math.dist(told["estimate"][:2], told["truth"][:2])
    assert told["position_error_m"] == pytest.approx(error, abs=1e-15)
    own = [row for row in ticks(out) if row["robot"] == robot and row["anchor_range"]]
    assert told["anchor_ranges"] == len(own)


def test_ticks_has_a_row_per_tick_and_robot_from_tick_0_on(played: tuple[str, Path]) -> None:
    name, out = played
    assert (out / "ticks.csv").read_text().splitlines()[0].split(",") == [*COLUMNS, "phase", "state"]
    rows = [(int(row["tick"]), row["robot"]) for row in ticks(out)]
    assert rows == [(tick, robot) for tick in range(PAPER_TICKS[name] + 1) for robot in ("a", "b")]


def test_ticks_gives_floats_in_their_shortest_exact_form(played: tuple[str, Path]) -> None:
    cells = [row[column] for row in ticks(played[1]) for column in FLOATS if row[column]]
    assert cells == [repr(float(cell)) for cell in cells]


def test_ticks_gives_headings_in_the_half_open_turn(played: tuple[str, Path]) -> None:
    headings = [float(row["heading"]) for row in ticks(played[1])]
    assert all(-math.pi < heading <= math.pi for heading in headings)


def test_ticks_gives_the_controls_of_the_tick_to_come_and_none_in_the_last_row(
    played: tuple[str, Path],
) -> None:
    for robot in ("a", "b"):
        rows = [row for row in ticks(played[1]) if row["robot"] == robot]
        assert (rows[-1]["v"], rows[-1]["omega"]) == ("", "")
        for now, after in pairwise(rows):
            v, omega, heading = (float(now[field]) for field in ("v", "omega", "heading"))
            turned = math.remainder(float(after["heading"]) - heading - omega, 2 * math.pi)
            assert turned == pytest.approx(0.0, abs=1e-9)
            chord = v if omega == 0.0 else abs(2.0 * v / omega * math.sin(omega / 2.0))
            assert distance(now, after) == pytest.approx(abs(chord), abs=1e-9)


def test_ticks_gives_the_ranges_that_are_within_reach_and_no_others(played: tuple[str, Path]) -> None:
    rows = ticks(played[1])
    anchors = {"a": {"x": "0", "y": "0"}, "b": {"x": "10", "y": "0"}}
    peers = [row for a, b in zip(rows[::2], rows[1::2], strict=True) for row in (b, a)]
    for row, peer in zip(rows, peers, strict=True):
        for column, other in (("anchor_range", anchors[row["robot"]]), ("mutual_range", peer)):
            rho = distance(row, other)
            assert bool(row[column]) == (rho <= 3.0)
            assert not row[column] or float(row[column]) == pytest.approx(rho, abs=1e-12)


def test_ticks_names_the_phases_in_order(played: tuple[str, Path]) -> None:
    for robot in ("a", "b"):
        rows = [row for row in ticks(played[1]) if row["robot"] == robot]
        phases = [int(row["phase"]) for row in rows]
        assert phases == sorted(phases)
        assert set(phases) == {1, 2, 3}
        assert rows[0]["state"] == "straight"
        assert rows[-1]["state"] == "localised"


# --- in one process -------------------------------------------------------------------------------------


def same_in_process(out: Path, again: Path, *arguments: str) -> None:
    ended = tandem("run", *arguments, "--out", again, "--in-process", "-q")
    assert ended.status == 0, ended
    assert journals(again) == journals(out)
    assert (again / "ticks.csv").read_bytes() == (out / "ticks.csv").read_bytes()
    one, other = summary(out), summary(again)
    assert (one.pop("mode"), other.pop("mode")) == ("processes", "in-process")
    assert one.pop("wall_s") > 0.0
    assert other.pop("wall_s") > 0.0
    assert one == other


def test_in_process_leaves_the_same_bytes(played: tuple[str, Path], tmp_path: Path) -> None:
    name, out = played
    assert sorted(journals(out)) == [file for file in RECORD if file.endswith("journal")]
    same_in_process(out, tmp_path / "again", name)


@pytest.mark.parametrize("seed", series(range(8)))
def test_in_process_leaves_the_same_bytes_from_random_starts(seed: int, tmp_path: Path) -> None:
    out, arguments = tmp_path / "out", ("random", "--seed", str(seed))
    ended = tandem("run", *arguments, "--out", out, "-q")
    assert ended.status == 0, ended
    assert summary(out)["seed"] == seed
    same_in_process(out, tmp_path / "again", *arguments)


# --- output -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [[], ["--in-process"]], ids=["processes", "in-process"])
def test_quiet_prints_only_the_outcome(mode: list[str]) -> None:
    assert tandem("run", "paper-1", "-q", *mode) == (0, "localised after 48 ticks\n", "")


def test_without_out_nothing_is_left(tmp_path: Path) -> None:
    assert tandem("run", "paper-1", "-q", cwd=tmp_path).status == 0
    assert list(tmp_path.iterdir()) == []


def test_the_table_at_the_end_has_the_result_of_each_robot() -> None:
    ended = tandem("run", "paper-1", "--in-process")
    assert "localised after 48 ticks" in ended.out
    rows = {words[0]: words[1:] for line in ended.out.splitlines() if (words := line.strip(" │┃").split())}
    for robot, x, y, heading in (("a", "3.65", "-5.47", "+0.44"), ("b", "3.74", "-3.08", "+3.06")):
        for figure in (x, y, heading):  # the true and the estimated pose
            assert sum(figure in word for word in rows[robot]) == 2, ended.out


@pytest.mark.parametrize(
    "words", [["run", "paper-1", "-q"], ["--version"], ["world", "paper-1", "--listen", free_endpoint()]]
)
def test_a_closed_output_is_one_line_and_no_traceback(words: list[str]) -> None:
    with Path("/dev/full").open("wb") as full, TandemProcess(*words, terminal=full.fileno()) as command:
        ended = command.ended()
    name = "tandem" if words[0].startswith("-") else f"tandem {words[0]}"
    assert (ended.status, ended.err) == (3, f"{name}: cannot continue: No space left on device\n")


def test_a_mistake_has_its_exit_status_where_it_cannot_be_printed(tmp_path: Path) -> None:
    with (
        Path("/dev/full").open("wb") as full,
        TandemProcess("audit", tmp_path, errors=full.fileno()) as audit,
    ):
        assert audit.ended().status == 2


@pytest.mark.long
def test_a_message_that_cannot_be_printed_does_not_end_a_mission() -> None:
    with (
        Path("/dev/full").open("wb") as full,
        TandemProcess("run", "paper-1", "-q", "--kill", "a@17", errors=full.fileno()) as run,
    ):
        assert run.ended() == (0, "localised after 48 ticks\n", "")


def test_a_terminal_shows_one_line_with_the_tick_and_the_outcomes_while_it_runs() -> None:
    status, shown = on_a_terminal("run", "paper-1", "--rate", "20")
    assert status in OVER
    assert re.search(r"(localised|undecided) after \d+ ticks", shown)
    drawn = re.findall(r"paper-1, tick \d+ of \d+ at most: ((?:\d|waiting for \d)[^\r\n\x1b]*)", shown)
    assert len(drawn) == shown.count("paper-1, tick ")
    assert any("2 no verdict yet" in frame for frame in drawn)


@pytest.mark.parametrize("mode", [[], ["--in-process"]], ids=["processes", "in-process"])
def test_a_mission_that_reaches_max_ticks_is_undecided_and_reports_it(
    mode: list[str], tmp_path: Path
) -> None:
    short = tmp_path / "short.toml"
    short.write_text(PAPER_1.replace("seed = 1", "seed = 1\nmax_ticks = 5"))
    ended = tandem("run", short, "--out", tmp_path / "out", "-q", *mode)
    told = summary(tmp_path / "out")
    assert ended.status == 1
    assert ended.out.startswith("undecided after 5 ticks")
    assert told["outcome"] == "undecided"
    assert "max_ticks" in told["reason"]
    assert told["ticks"] == 5
    for robot in told["robots"].values():
        assert robot["localised"] is False
        for field in ("localised_tick", "estimate", "position_error_m", "heading_error_rad", "candidates"):
            assert robot[field] is None, field
        assert len(robot["truth"]) == 3
    assert told["first_contact_tick"] is None


def test_rate_runs_in_real_time(tmp_path: Path) -> None:
    ended = tandem("run", "random", "--seed", "3", "--rate", "20", "-q", "--out", tmp_path / "out")
    assert ended.status in OVER, ended
    told = summary(tmp_path / "out")
    assert told["wall_s"] >= (told["ticks"] - 1) / 20


def test_scenarios_lists_what_ships() -> None:
    ended = tandem("scenarios")
    lines = dict(line.split(maxsplit=1) for line in ended.out.splitlines())
    assert ended.status == 0
    assert {"paper-1", "paper-2", "random"} <= lines.keys()
    assert "48" in lines["paper-1"]


def test_whatever_is_listed_is_a_whole_sentence_and_stands_in_one_column() -> None:
    listed = tandem("scenarios").out.splitlines()
    scenarios = listed[: listed.index("sweeps, for `tandem sweep`:")]
    for lines in (scenarios, listed[len(scenarios) + 1 :]):
        width = max(len(line.split()[0]) for line in lines)
        assert all(line[width] == " " != line[width + 1] and line.endswith(".") for line in lines), lines


# --- several runs ----------------------------------------------------------------------------------------


def test_runs_side_by_side_do_not_disturb_each_other(paper_1: Path, tmp_path: Path) -> None:
    runs = [TandemProcess("run", "paper-1", "--out", tmp_path / str(i), "-q") for i in range(2)]
    for i, run in enumerate(runs):
        with run:
            assert run.ended() == (0, f"localised after {PAPER_TICKS['paper-1']} ticks\n", "")
        assert journals(tmp_path / str(i)) == journals(paper_1)


def test_folders_that_are_called_like_our_packages_do_not_disturb_a_run(tmp_path: Path) -> None:
    for package in ("world", "agent", "protocol", "compose", "zenoh", "numpy"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").write_text("raise SystemExit('the wrong one')")
    assert tandem("run", "paper-1", "-q", cwd=tmp_path) == (0, "localised after 48 ticks\n", "")


# --- on a narrow terminal -----------------------------------------------------------------------------


LONG_IDS = [f"robot-{'x' * 24}-{i}" for i in range(6)]
NAMED_AT_LENGTH = several_pairs(3).replace("max_turn_rate", "noise.anchor_sigma = 0.01\nmax_turn_rate")
for short, long in zip("abcdef", LONG_IDS, strict=True):
    NAMED_AT_LENGTH = NAMED_AT_LENGTH.replace(f'"{short}"', f'"{long}"')


@pytest.mark.long
def test_no_table_is_broken_by_a_terminal_of_80_columns(tmp_path: Path) -> None:
    (tmp_path / "long.toml").write_text(NAMED_AT_LENGTH)
    out = tmp_path / "out"
    shown = {}
    for words in (
        ("run", tmp_path / "long.toml", "--in-process", "--fault", "loss=0.3", "--out", out),
        ("run", "noisy", "--in-process"),
        ("audit", out),
        ("scenarios",),
        ("--help",),
        ("estimate", SAMPLE, "--noise", "uwb-calibrated"),
        ("calibrate", SAMPLE, "--out", "radios.toml"),
    ):
        status, text = on_a_terminal(*words, cwd=tmp_path)
        assert status == 0, text
        text = text.rpartition("\x1b[2K")[2]  # what is left when a display is gone
        assert max(map(len, text.splitlines())) <= 80, text
        shown[words[0]] = text
    for robot in LONG_IDS:
        assert sum(line.count(robot) for line in shown["audit"].splitlines()) <= 2
    for row in (r" A +LC0 +19\.0 +3\.67 1\.53 -1\.49 ", r" B +LC1 +18\.5 +2\.88 0\.27 \+2\.52 "):
        assert re.search(rf"^{row} +[\d.]+ +[\d.]+ +[\d.]+\r?$", shown["estimate"], re.MULTILINE)
    (row,) = [line for line in shown["scenarios"].splitlines() if line.startswith("paper-2")]
    assert "The paper's second simulation" in row


def test_a_footnote_is_there_only_with_its_column() -> None:
    _, text = on_a_terminal("run", "noisy", "--in-process")
    assert "sigma: claimed, of the position" in " ".join(text.split())
    assert "late:" not in text
    assert "sigma" not in tandem("run", "paper-1", "--in-process").out
