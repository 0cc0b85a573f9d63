"""Figures for a paper: exact widths, embedded TrueType fonts, no title, and text of one legible size."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import matplotlib as mpl
import pytest
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from PIL import Image

from compose.figures import PICTURES, catalogue
from compose.figures.pair import PairRecord
from compose.figures.sheet import Absent
from compose.figures.style import PAPER, SCREEN, Medium, look, save
from compose.launch.in_process import run_mission
from compose.scenario.scenario_file import load
from compose.view.colours import COLOURS
from tests.commands import tandem
from tests.test_album import pair as pair_of

WIDTHS = {3.5: (252.0, 1050), 7.16: (515.52, 2148)}
"""The widths in inches: one column and two columns; each in points, and in pixels of a PNG file."""
STYLE = Path(__file__).parent.parent / "compose/view/web/page/style.css"


def figures(pair: PairRecord, medium: Medium) -> Iterator[tuple[str, Figure]]:
    """Yield all figures, within their `look`."""
    for kind in PICTURES:
        with look(medium):
            for name, figure in catalogue.pictures(pair, kind, medium):
                if not isinstance(figure, Absent):
                    yield name, figure


@pytest.mark.long("slow")
def test_each_figure_is_laid_out_one_or_two_columns_wide_in_small_text_and_embedded_fonts(
    paper_1: Path, noisy: Path, tmp_path: Path
) -> None:
    widths = set()
    for name, figure in chain(figures(pair_of(paper_1), PAPER), figures(pair_of(noisy), PAPER)):
        laid_out(name, figure, PAPER)
        width = figure.get_size_inches()[0]
        points, pixels = WIDTHS[width]
        formats = ["pdf"] if width in widths else ["pdf", "png"]
        widths.add(width)
        with mpl.rc_context({"pdf.compression": 0}):
            pdf, *pngs = save(figure, tmp_path / name, formats, PAPER.dpi)
        content = pdf.read_bytes()
        (box,) = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) [\d.]+ \]", content)
        assert float(box) == points
        assert all(pixels_across(png) == pixels for png in pngs)
        assert b"/Subtype /Type3" not in content
        assert b"/FontFile2" in content  # an embedded TrueType font, of a Type 42
        sizes = {float(size) for size in re.findall(rb"/\S+ ([\d.]+) Tf", content)}
        assert max(sizes) == 8.0
        assert min(sizes) >= 6.0, name
    assert widths == set(WIDTHS)


@pytest.mark.long
@pytest.mark.parametrize("name", ["noisy", "paper-2"])
def test_figures_to_look_at_are_laid_out_as_well(name: str, tmp_path: Path) -> None:
    run_mission(load(name), tmp_path)
    for kind, figure in figures(pair_of(tmp_path), SCREEN):
        laid_out(kind, figure, SCREEN)


@pytest.mark.long
def test_figures_in_hardware_mode_are_laid_out_as_well(noisy: Path, tmp_path: Path) -> None:
    for robot in "ab":
        name = f"agent-{robot}.journal"
        (tmp_path / name).write_bytes((noisy / name).read_bytes())
    for name, figure in figures(pair_of(tmp_path), PAPER):
        laid_out(name, figure, PAPER)


def laid_out(name: str, figure: Figure, medium: Medium) -> None:
    """Assert that all text is on the sheet, no key covers a panel, and only SCREEN has titles."""
    assert bool(figure.texts) == medium.titled, name
    assert medium.titled or figure.get_suptitle() == ""
    figure.set_dpi(medium.dpi)
    figure.draw_without_rendering()
    sheet = figure.bbox.padded(0.5)
    keys = [key.get_window_extent() for axes in figure.axes if not axes.axison and (key := axes.get_legend())]
    panels = [panel for axes in figure.axes if axes.axison and (panel := axes.get_tightbbox()) is not None]
    for box in [*keys, *panels, *[text.get_window_extent() for text in figure.texts]]:
        assert sheet.x0 <= box.x0 <= box.x1 <= sheet.x1, (name, box, sheet)
        assert sheet.y0 <= box.y0 <= box.y1 <= sheet.y1, (name, box, sheet)
    for i, one in enumerate(keys):
        for other in [*keys[:i], *panels]:
            assert Bbox.intersection(one.padded(-0.5), other) is None, (name, one, other)


def pixels_across(png: Path) -> int:
    with Image.open(png) as image:
        return image.width


def test_the_command_draws_for_a_paper(paper_1: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(paper_1, tmp_path / "it"))
    ended = tandem("figures", folder, "--paper", "--only", "ranges", "--format", "png")
    assert (ended.status, ended.err) == (0, "")
    assert pixels_across(folder / "figures" / "ranges-a-b.png") == 1050


def test_the_page_has_the_robots_in_the_hues_of_the_figures() -> None:
    light = STYLE.read_text().split("@media")[0]
    assert dict(re.findall(r"--robot-([ab]): (#[0-9a-f]{6});", light)) == {
        role: hue for role, hue in COLOURS.items() if role
    }
