"""The figures of a recording: they show its data, and every recording has one; figures for a paper."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.path import Path as PlanePath
from matplotlib.transforms import Bbox
from PIL import Image

from compose.figures import PICTURES, catalogue, one_robot, over_time
from compose.figures.one_robot import outline_of
from compose.figures.pair import PairRecord
from compose.figures.sheet import Absent
from compose.figures.style import PAPER, SCREEN, Medium, look, save
from compose.launch.in_process import run_mission
from compose.recording.run import read
from compose.scenario.scenario_file import load, parse
from compose.view.colours import COLOURS
from compose.view.outlines import arc
from compose.view.recorded import scenes_of
from compose.view.web.sources import Recorded
from protocol.journal.journal_file import CorruptJournal
from protocol.mission import ROLES
from protocol.motion import Covariance, Pose
from tests.commands import BENT, PAPER_1, Ended, copied, refused, several_pairs, tandem
from tests.missions import outcome
from tests.test_album import cut
from tests.test_album import pair as pair_of
from world.scenario import Scenario

NOISE = "[mission.noise]\nanchor_sigma = 0.05\nmutual_sigma = 0.05\n"
BRIEF = PAPER_1.replace('name = "paper"', 'name = "assured"').replace("seed = 1", "seed = 1\nmax_ticks = 4")


@pytest.fixture(scope="module")
def drawn(noisy: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of its figures."""
    folder = copied(noisy, tmp_path_factory.mktemp("drawn"))
    assert draw(folder).status == 0
    return folder / "figures"


def recorded(scenario: Scenario, folder: Path) -> Path:
    run_mission(scenario, folder)
    return folder


def draw(folder: Path) -> Ended:
    return tandem("figures", folder, "--only", "robot", "--format", "svg")


def test_without_legends_their_content_and_the_title_are_a_text_file(noisy: Path, tmp_path: Path) -> None:
    out = tmp_path / "for" / "paper"
    ended = tandem(
        "figures", noisy, *("--only", "trajectory", "--format", "svg"), "--no-legend", "--out", out
    )
    assert ended.status == 0
    assert ended.out.split() == [str(out / "trajectory-a-b.svg"), str(out / "trajectory-a-b.txt")]
    title, *entries = (out / "trajectory-a-b.txt").read_text().splitlines()
    assert title.startswith("noisy")
    assert {"grey dotted line: path in phase 1", "grey dashed line: path in phase 2"} <= {*entries}
    assert any(re.fullmatch(r"white squares: start", entry) for entry in entries)
    with_legend = copied(noisy, tmp_path / "copy")
    assert tandem("figures", with_legend, "--only", "trajectory", "--format", "svg").status == 0
    assert not (with_legend / "figures" / "trajectory-a-b.txt").exists()


def picture(folder: Path, name: str) -> Path:
    """Return the figure of one robot, drawn in this process."""
    (folder / "figures").mkdir(exist_ok=True)
    with look(SCREEN):
        svg, *_ = save(figure_of(folder, name), folder / "figures" / f"robot-{name}")
    return svg


def figure_of(folder: Path, name: str) -> Figure:
    """Return the figure of the robot `name` of the first pair."""
    figure = one_robot.draw(pair_of(folder), "a" if name == "a" else "b")
    assert not isinstance(figure, Absent), figure
    return figure


def texts(svg: Path) -> set[str]:
    """Return the lines of text in `svg`, which Matplotlib writes as comments beside the outlines."""
    return {
        line
        for text in re.findall(r"<!-- (.*?) -->", svg.read_text(), re.DOTALL)
        for line in text.split("\n")
    }


def line(axes: Axes, gid: str) -> tuple[list[Any], list[Any]]:
    """Return the x and y of the line with this id."""
    (found,) = [one for one in axes.lines if one.get_gid() == gid]
    return np.asarray(found.get_xdata()).tolist(), np.asarray(found.get_ydata()).tolist()


def ids(svg: Path) -> set[str]:
    return set(re.findall(r'id="([^"]+)"', svg.read_text()))


# --- content --------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_line_a_file_is_printed_and_the_files_are_there(noisy: Path, tmp_path: Path) -> None:
    folder = copied(noisy, tmp_path)
    ended = tandem("figures", folder, "--only", "robot")
    names = [f"robot-{robot}.{ending}" for robot in "ab" for ending in ("svg", "pdf", "png")]
    assert ended.status == 0
    assert ended.err == ""
    assert ended.out.splitlines() == [str(folder / "figures" / name) for name in names]
    assert {path.name for path in (folder / "figures").iterdir()} == set(names)
    for name in names:
        head = (folder / "figures" / name).read_bytes()[:8]
        assert head.startswith({"svg": b"<?xml", "pdf": b"%PDF", "png": b"\x89PNG"}[name[-3:]])


def test_a_run_draws_nothing_by_itself(tmp_path: Path) -> None:
    assert tandem("run", "paper-1", "--in-process", "--out", tmp_path / "out").status == 0
    assert not (tmp_path / "out" / "figures").exists()


@pytest.mark.parametrize("place", [0, 1])
def test_a_figure_has_the_claim_of_the_robot_and_its_error(place: int, noisy: Path, drawn: Path) -> None:
    recording = read(noisy)
    claim = recording.claim(recording.robots[place])
    assert claim is not None
    assert claim.covariance is not None
    name = recording.scenario.robots[place].id
    words = texts(drawn / f"robot-{name}.svg")
    (said,) = [line for line in words if line.startswith("The robot claims its pose")]
    assert f"in tick {claim.tick}: errors {claim.position_error:.2g} m" in said
    assert f"(sigmas {claim.covariance.position_sigma:.2g} m" in said
    assert f"claim of {name}, tick {claim.tick}" in words
    assert (
        f"Robot {name} of noisy, seed {recording.scenario.seed}: localised after {claim.tick} ticks" in words
    )


def test_a_figure_names_its_axes_with_units_and_the_required_accuracy(drawn: Path) -> None:
    words = texts(drawn / "robot-a.svg")
    assert {"x [m]", "y [m]", "position error [m]", "probability of a hypothesis"} <= words
    assert {"required sigma: 0.1 m", "required: 99.99 %", "sensing range, 3 m"} <= words
    assert {"phase 2", "phase 3", "tick (1 s)"} <= words
    assert {"$M_1$", "$M_2$", "true path of a", "true path of b"} <= words


def test_each_part_of_a_noisy_mission_is_in_its_picture(noisy: Path, drawn: Path) -> None:
    held = [one for one in read(noisy).estimates("a") if one.world]
    found = ids(drawn / "robot-a.svg")
    assert {"path-a", "path-b", "anchor-a", "range-b", "met", "final", "estimates"} <= found
    assert {
        "position-a",
        "sigma",
        "envelope",
        "accuracy",
        "claim-a",
        "phase-1",
        "phase-2",
        "phase-3",
    } <= found
    assert {"probability-1-anchor", "probability-1-plane", "confidence", "near-truth"} <= found
    assert ("ghosts" in found) == any(len(one.world) > 1 for one in held)
    assert {f"outline-{held[-1].tick}", f"near-{held[-1].tick}"} <= found
    outlines = {int(name.removeprefix("outline-")) for name in found if name.startswith("outline-")}
    assert 1 < len(outlines) <= 5
    assert outlines <= {one.tick for one in held}


@pytest.mark.long
def test_the_error_over_time_is_that_of_the_estimates_against_the_truth(noisy: Path) -> None:
    pair, held = pair_of(noisy), read(noisy).estimates("a")
    truth = [moment.truth.poses[0] for moment in read(noisy).ticks]
    said = [one for one in held if one.world]
    off = [math.hypot(one.world[0].x - truth[one.tick].x, one.world[0].y - truth[one.tick].y) for one in said]
    errors, probability = Figure().subplots(2)
    over_time.draw_errors(errors, pair, "position", "a")
    over_time.draw_hypotheses(probability, pair, "a")
    assert line(errors, "position-a") == ([one.tick for one in said], off)
    assert line(errors, "sigma")[1] == [one.covariance.position_sigma for one in said if one.covariance]
    likeliest = line(probability, "probability-1-plane")
    assert likeliest[0] == [one.tick for one in said]
    assert likeliest[1] == pytest.approx(
        [one.probabilities[0] for one in said], abs=1e-5
    )  # the limit is 99.9995 %
    assert max(likeliest[1]) < 1.0
    before = line(probability, "probability-1-anchor")
    assert before[0] == [one.tick for one in held if not one.world]
    (claimed,) = line(errors, "claim-a")[0][:1]
    assert held[claimed].localised
    assert not held[claimed - 1].localised


def test_an_outline_holds_what_is_within_3_sigma(noisy: Path) -> None:
    axes = Figure().subplots()
    one_robot.draw_estimates(axes, pair_of(noisy), "a")
    last = read(noisy).estimates("a")[-1]
    assert last.covariance is not None
    (drawn,) = axes.findobj(lambda artist: artist.get_gid() == f"outline-{last.tick}")
    assert isinstance(drawn, Polygon)
    outline = np.asarray(drawn.get_xy())
    sigma = [[last.covariance.xx, last.covariance.xy], [last.covariance.xy, last.covariance.yy]]
    for point in outline - [last.world[0].x, last.world[0].y]:
        assert point @ np.linalg.solve(sigma, point) == pytest.approx(9.0)


def test_a_position_along_an_arc_is_drawn_along_it(tmp_path: Path) -> None:
    """A robot that has measured few mutual ranges knows how far it is from its anchor, and little else."""
    bent = recorded(load("noisy", seed=BENT), tmp_path)
    shown, pair = scenes_of(read(bent)), pair_of(bent)
    for role in ROLES:
        sigmas = {
            one.tick: one.covariance.position_sigma for one, _ in pair.robot(role).placed if one.covariance
        }
        tick = max(sigmas, key=sigmas.__getitem__)
        player = shown[tick].player(role)
        assert player.pose
        assert player.held
        assert sigmas[tick] > 10.0
        assert PlanePath(player.held.arc).contains_point((player.pose.x, player.pose.y))
        estimate = next(one for one, _ in pair.robot(role).placed if one.tick == tick)
        assert outline_of(estimate)[:-1] == player.held.arc
    assert not any(player.held.arc for player in shown[-1].players if player.held)


def test_a_position_turned_about_a_point_keeps_its_distance_and_a_small_turn_is_an_ellipse() -> None:
    across, pose = 0.1, Pose(14.0, 3.0, 0.7)  # 10 m from (6, -3)
    for sigma, span in ((0.3, 0.9), (5.0, math.pi)):
        out, up = 0.8, 0.6
        turned = 10.0 * sigma
        covariance = Covariance(
            (up * turned) ** 2 + (out * across) ** 2,
            out * up * (across**2 - turned**2),
            -6.0 * sigma**2,
            (out * turned) ** 2 + (up * across) ** 2,
            8.0 * sigma**2,
            sigma**2,
        )
        points = np.array(arc(pose, covariance)) - [6.0, -3.0]
        assert np.abs(np.hypot(*points.T) - 10.0).max() < 3.0 * across + 1e-9
        angles = np.angle((points @ [1.0, 1.0j]) * np.exp(-1j * math.atan2(6.0, 8.0)))
        assert np.abs(angles).max() == pytest.approx(span, abs=0.09)
    assert not arc(pose, Covariance(0.01, 0.0, 0.0, 0.01, 0.0, 1e-4))
    assert not arc(pose, Covariance(0.01, 0.0, 0.0, 0.01, 0.0, 0.0))


@pytest.mark.long
def test_an_exact_recording_has_counts_for_probabilities_and_no_ellipse(tmp_path: Path) -> None:
    svg = picture(recorded(load("paper-1"), tmp_path), "a")
    words, found = texts(svg), ids(svg)
    assert {"hypotheses", "one pose", "tolerance: 1e-06; smaller", "than 1e-07 is drawn there"} <= words
    assert {"count", "tolerance", "position-a", "ghosts", "near-truth"} <= found
    assert not {"envelope", "sigma", "confidence", "accuracy"} & found
    assert not [name for name in found if name.startswith(("outline-", "probability-"))]


@pytest.mark.parametrize(
    ("probability", "said"), [(0.5, "50 %"), (0.9999, "99.99 %"), (0.999999, "99.9999 %"), (1e-4, "0.01 %")]
)
def test_probabilities_are_shown_with_their_significant_digits(probability: float, said: str) -> None:
    assert over_time.percent(probability) == said


# --- all kinds of recordings ----------------------------------------------------------------------------


@pytest.mark.parametrize(("planner_name", "noise"), [("assured", NOISE), ("paper", "")])
@pytest.mark.long
def test_a_mission_that_ends_undecided_is_drawn(noise: str, planner_name: str, tmp_path: Path) -> None:
    text = BRIEF.replace("assured", planner_name).replace("[planner]", f"{noise}[planner]")
    recording = run_mission(parse(text, "brief"), tmp_path)
    assert outcome(recording) == "undecided"
    svg = picture(tmp_path, "b")
    words = texts(svg)
    assert "The robot claims no pose." in words
    assert any("undecided after" in line for line in words)
    assert not {"met", "claim-b"} & ids(svg)


@pytest.mark.parametrize("ticks", [17, 0])
@pytest.mark.long
def test_a_truncated_recording_is_drawn_as_far_as_it_goes(ticks: int, noisy: Path, tmp_path: Path) -> None:
    folder = copied(noisy, tmp_path)
    cut(folder / "world.journal", 2 + 2 * ticks)
    cut(folder / "agent-b.journal", 2 + ticks)
    assert len(read(folder).ticks) == ticks
    for robot in "ab":
        words = texts(picture(folder, robot))
        assert f"Robot {robot} of noisy, seed 5: the recording breaks off" in words
        assert {"$M_1$", "$M_2$", "start"} <= words


@pytest.mark.long
def test_an_agent_killed_before_its_configuration_has_a_figure_without_estimates(
    noisy: Path, tmp_path: Path
) -> None:
    folder = copied(noisy, tmp_path)
    (folder / "agent-a.journal").write_bytes(b"")
    assert "nothing-near" in ids(picture(folder, "a"))


@pytest.mark.long
def test_a_robot_with_an_empty_journal_is_drawn_without_a_warning(tmp_path: Path) -> None:
    run_mission(load("paper-1"), tmp_path)
    (tmp_path / "agent-a.journal").write_bytes(b"")
    ended = draw(tmp_path)
    assert (ended.status, ended.err) == (0, "")
    assert "tolerance" in ids(tmp_path / "figures" / "robot-a.svg")


@pytest.mark.long
def test_each_robot_of_several_pairs_has_a_picture_of_its_own_pair(tmp_path: Path) -> None:
    recorded(parse(several_pairs(2), "pairs"), tmp_path)
    assert draw(tmp_path).status == 0
    assert {path.name for path in (tmp_path / "figures").glob("*.svg")} == {
        f"robot-{one}.svg" for one in "abcd"
    }
    assert {"path-c", "path-d", "anchor-d"} <= ids(tmp_path / "figures" / "robot-c.svg")
    assert not {"path-a", "anchor-b"} & ids(tmp_path / "figures" / "robot-c.svg")


# --- bad input ------------------------------------------------------------------------------------------


@pytest.mark.long
def test_where_nothing_can_be_written_is_refused(noisy: Path, tmp_path: Path) -> None:
    folder = copied(noisy, tmp_path)
    (folder / "figures").write_text("")
    refused(draw(folder), "figures cannot be written: File exists")
    (folder / "figures").unlink()
    (folder / "figures" / "robot-a.svg").mkdir(parents=True)
    refused(draw(folder), "figures cannot be written: Is a directory")


@pytest.mark.long
def test_a_robot_without_a_journal_is_named_and_the_others_are_drawn(noisy: Path, tmp_path: Path) -> None:
    folder = copied(noisy, tmp_path)
    (folder / "agent-a.journal").unlink()
    ended = draw(folder)
    assert ended.status == 3
    assert ended.err == "tandem figures: no figure of a: agent-a.journal is missing\n"
    assert {path.name for path in (folder / "figures").iterdir()} == {"robot-b.svg"}
    (folder / "agent-a.journal").write_bytes(b"\xc1")
    ended = draw(folder)
    assert ended.status == 3
    assert re.fullmatch(
        r"tandem figures: no figure of a: [^\n]*agent-a.journal: damaged at byte 0[^\n]*\n", ended.err
    )


# --- the reader -----------------------------------------------------------------------------------------


def test_a_journal_of_another_run_is_not_used(noisy: Path, tmp_path: Path) -> None:
    folder, other = copied(noisy, tmp_path), tmp_path / "other"
    run_mission(load("paper-1"), other)
    shutil.copyfile(other / "agent-a.journal", folder / "agent-a.journal")
    with pytest.raises(CorruptJournal, match=r"agent-a\.journal: belongs to another run: its conf"):
        read(folder).estimates("a")
    journals = Recorded("", folder)
    journals.load()
    assert [note.split("/")[-1] for note in journals.notes] == [
        "agent-a.journal: belongs to another run: its configuration does not match the world's"
    ]
    refused(tandem("export", folder), "another run")


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
