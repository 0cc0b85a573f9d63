"""The display of a run on a terminal: its map fits 80 x 24 characters, and shows where everything is."""

from __future__ import annotations

import io
import re
from pathlib import Path

import pytest
from rich.console import Console

from compose.launch import in_process
from compose.recording.run import read
from compose.scenario.scenario_file import load
from compose.terminal.braille import Drawing
from compose.terminal.live_display import RobotMap
from compose.view.outlines import Box
from tests.commands import on_a_terminal


def drawn(columns: int, rows: int) -> Drawing:
    """Return a drawing whose dots are 1 m apart, with the origin in its lower left corner."""
    width, height = 2 * columns - 1, 4 * rows - 1
    return Drawing(columns, rows, Box(width / 2, height / 2, width, height))


def test_a_dot_is_in_its_character_and_a_line_has_no_gaps() -> None:
    corners = drawn(2, 2)
    corners.dots([(0.0, 0.0), (3.0, 7.0), (9.0, 0.0), (0.0, -1.0)], "")
    assert corners.text().plain == " \u2808\n\u2840 "
    line = drawn(3, 1)
    line.line([(0.0, 3.0), (5.0, 3.0), (6.0, 3.0)], "")
    assert line.text().plain == "\u2809\u2809\u2809"
    letter = drawn(1, 1)
    letter.dots([(0.0, 0.0)], "")
    letter.letter((1.0, 2.0), "a", "")
    assert letter.text().plain == "a"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("paper-1")
    in_process.run_mission(load("paper-1"), folder)
    return folder


def page(folder: Path, width: int, height: int, encoding: str = "utf-8") -> list[str]:
    """Return the lines of the map of a recording on a terminal."""
    out = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    console = Console(file=out, width=width, height=height, markup=False)
    console.print(RobotMap(read(folder).scenario, folder, console).display())
    out.flush()
    assert isinstance(out.buffer, io.BytesIO)
    return out.buffer.getvalue().decode(encoding).splitlines()


def test_the_map_fits_80_by_24_and_has_robots_anchors_hypotheses_and_contact(recording: Path) -> None:
    lines = page(recording, 80, 24)
    assert len(lines) <= 23
    assert max(map(len, lines)) <= 80
    assert lines[0] == "paper-1, tick 47 of 538 at most"
    drawing = "\n".join(lines[1:-3])
    assert drawing.count("+") == 2
    assert (drawing.count("a"), drawing.count("b")) == (1, 1)
    assert drawing.count("o") == 6  # of eight hypotheses, those at the true poses are below the robots
    assert lines[-3].startswith("a  phase 3: waiting  0.00 m/s +0.00 rad/s  4 hypotheses  b 2.1")
    at = {
        name: next((row, line.index(name)) for row, line in enumerate(lines[1:-3]) if name in line)
        for name in "ab"
    }
    a, b = at["a"], at["b"]
    between = lines[1 + (a[0] + b[0]) // 2][min(a[1], b[1]) : max(a[1], b[1]) + 1]
    assert re.search("[\u2801-\u28ff]", between), "the line of contact"


@pytest.mark.parametrize(("height", "encoding"), [(8, "utf-8"), (24, "latin-1")])
def test_without_room_or_characters_for_a_map_there_are_only_lines(
    recording: Path, height: int, encoding: str
) -> None:
    lines = page(recording, 80, height, encoding)
    assert len(lines) == 3
    assert lines[1].startswith("a  phase 3")


@pytest.mark.long
def test_the_bar_of_a_sweep_says_what_its_times_are_and_fits_80_columns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "few.toml").write_text('name = "a-name-of-18-chars"\nscenario = "random"\ntrials = 40\n')
    monkeypatch.chdir(tmp_path)
    status, shown = on_a_terminal("sweep", "few.toml", "--workers", "1", "--out", "out")
    assert status == 0
    lines = [line for line in re.split("\x1b\\[2K|\r|\n", shown) if "left" in line]
    text = re.sub("\x1b\\[[?0-9;]*[a-zA-Z]", "", lines[-1])
    assert re.search(r"/40 [0-9.e+]+ trials/s [0-9:]+ elapsed, [0-9:]+ left", text)
    assert text.startswith("a-name-of-18-chars")
    assert len(text) <= 80
