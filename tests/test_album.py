"""The paper's figures of any recording: they show what the journals contain, for any run."""

from __future__ import annotations

import math
import os
import pty
import re
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.text import Annotation
from msgspec.structs import replace

from agent.planning.assured import Assured
from agent.planning.phase3_last_manoeuvre import compared
from agent.planning.strides import stride
from compose.cli.figures import draw
from compose.figures import (
    PICTURES,
    catalogue,
    encounter,
    geometry,
    manoeuvre,
    over_time,
    phase_one,
    trajectory,
)  # fmt: skip
from compose.figures.agent_replay import agent_replay
from compose.figures.pair import PairRecord, encounters, pair_of
from compose.figures.sheet import Absent
from compose.figures.style import SCREEN, look
from compose.launch.in_process import run_mission
from compose.recording.recording_files import agent_journal
from compose.recording.run import read
from compose.scenario.scenario_file import load, parse
from protocol.journal.journal_file import read as frames
from protocol.messages import Command
from protocol.mission import ROLES, Role
from protocol.motion import step, wrap
from protocol.wire import MalformedFrame, decode, encode
from tests.commands import PAIR, PAPER_1, SECTION_IV, copied, on_a_terminal, several_pairs, tandem
from tests.reference import REFERENCE
from tests.series import series
from world.scenario import Scenario

NOISE = "[mission.noise]\nanchor_sigma = 0.01\nmutual_sigma = 0.01\n"
FAULT = "[[fault]]\nloss = 0.6\ndelay = [0, 5]\n"
RANDOM = f"""
name = "random"
seed = 3
{SECTION_IV}{PAIR}"""
NOISY_PAPER = RANDOM.replace("seed = 3", "seed = 5").replace(
    "[[robot]]", f'{NOISE}[planner]\nname = "paper"\n[[robot]]', 1
)
BRIEF = PAPER_1.replace("seed = 1", "seed = 1\nmax_ticks = 4")


def scenario_of(name: str) -> Scenario:
    match name:
        case "paper-1" | "paper-2" | "noisy":
            return load(name)
        case "assured":
            return parse(RANDOM, name)
        case "faulty":
            return parse(RANDOM + FAULT, name)
        case "letter":
            return parse(NOISY_PAPER, name)
        case "undecided":
            return parse(BRIEF, name)
        case _:
            return parse(several_pairs(2), name)


@pytest.fixture(scope="session")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("records")


def recorded(name: str, recordings: Path) -> Path:
    folder = recordings / name
    if not (folder / "world.journal").exists():
        folder.mkdir(exist_ok=True)
        run_mission(scenario_of(name), folder)
    return folder


def pair(folder: Path, number: int = 0) -> PairRecord:
    run = read(folder)
    known = [robot for robot in run.pairs[number] if (folder / agent_journal(robot)).exists()]
    found = pair_of(run, encounters(run)[number], {robot: agent_replay(run, robot) for robot in known})
    assert found is not None
    return found


def found(figure: Figure, gid: str) -> list[Artist]:
    """Return the artists whose gid matches the pattern `gid`."""
    return figure.findobj(lambda one: re.fullmatch(gid, one.get_gid() or "") is not None)


def line(figure: Figure, gid: str) -> list[tuple[float, float]]:
    """Return the points of the first line whose gid matches."""
    one = found(figure, gid)[0]
    assert isinstance(one, Line2D)
    return list(zip(np.asarray(one.get_xdata()).tolist(), np.asarray(one.get_ydata()).tolist(), strict=True))


def radii(figure: Figure, gid: str) -> list[float]:
    return [one.radius for one in found(figure, gid) if isinstance(one, Circle)]


def drawn(figure: Figure | Absent) -> Figure:
    assert isinstance(figure, Figure), figure
    return figure


def cut(journal: Path, count: int) -> None:
    """Truncate the journal to its first `count` frames and a torn one."""
    left = list(frames(journal))[:count]
    journal.write_bytes(b"".join([msgpack.packb(frame) for frame in left]) + b"\xc4\x10torn")


# --- contents -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "simulation"), [("paper-1", 0), ("paper-2", 1)])
def test_a_plan_shows_each_hypothesis_and_the_axis_of_each_two_and_the_choice(
    name: str, simulation: int, recordings: Path
) -> None:
    told, computed = pair(recorded(name, recordings)), REFERENCE.sims[simulation]
    (figure,) = [drawn(one) for one in manoeuvre.draw(told).values()]
    final_report = told.run.final_reports["b"]
    assert final_report.candidates is not None
    count = final_report.candidates[1]
    assert len(found(figure, r"hypothesis-\d+")) == count == len(computed.d_i)
    assert len(found(figure, r"bisector-\d+-\d+")) == count * (count - 1) // 2
    places = [line(figure, f"hypothesis-{i + 1}")[0] for i in range(count)]
    start, end = line(figure, "chosen-ends")
    rho = told.mutual[computed.k_second][1]
    assert radii(figure, "rho") == [rho]
    assert [math.dist(start, place) for place in places] == pytest.approx([rho] * count)
    away = [math.dist(end, place) for place in places]
    assert sorted(away) == pytest.approx(sorted(computed.d_i), abs=1e-6)
    labels = [one.get_label() for i in range(count) for one in found(figure, f"hypothesis-{i + 1}")]
    assert labels == [f"{i}: predicted range {far:.4f} m" for i, far in enumerate(away, start=1)]
    for i, j in combinations(range(count), 2):
        for point in line(figure, f"bisector-{i + 1}-{j + 1}"):
            assert math.dist(point, places[i]) == pytest.approx(math.dist(point, places[j]))
    ((omega, value),) = line(figure, "cost-chosen")
    assert omega == final_report.last_turn_rate == pytest.approx(computed.w2, abs=1e-9)
    assert value == final_report.separation_m2 == pytest.approx(computed.J, abs=1e-9)
    assert max(value for _, value in line(figure, "cost")) == value
    assert min(math.dist(end, point) for point in line(figure, "reach")) < 1e-9


def test_what_is_compared_is_what_was_chosen_from(recordings: Path) -> None:
    told = pair(recorded("assured", recordings))
    (one,) = [one for role in ("b", "a") for one in manoeuvre.planned(told, role)][:1]
    ways = compared(one.plan.question, told.mission, Assured.MANOEUVRES)
    row, column = np.unravel_index(np.argmax(ways.value), ways.value.shape)
    assert (ways.reach.v[row, 0], ways.reach.omega[column]) == (one.plan.command.v, one.plan.command.omega)
    command = told.command(one.plan.question.mover, one.tick)
    assert command is not None
    assert (command.v, command.omega, command.task) == (
        one.plan.command.v,
        one.plan.command.omega,
        "last-manoeuvre",
    )
    (figure,) = [drawn(one) for one in manoeuvre.draw(told).values()][:1]
    assert len(found(figure, r"reach-\d+")) == len(ways.reach.v) - 1


def test_a_plan_of_a_is_seen_from_a(recordings: Path) -> None:
    """The distances are symmetric: b's hypotheses around a, and a's around b."""
    told = pair(recorded("paper-1", recordings))
    ((_, plan),) = manoeuvre.planned(told, "b")
    turned = manoeuvre.scene(plan._replace(question=plan.question._replace(mover="a")))
    straight = manoeuvre.scene(plan)
    for one, other in zip(turned.others, straight.others, strict=True):
        apart = math.dist((one.x, one.y), (turned.mover.x, turned.mover.y))
        assert apart == pytest.approx(math.dist((other.x, other.y), (straight.mover.x, straight.mover.y)))
        assert straight.mover.y == pytest.approx(0.0)
        assert turned.mover.y == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("name", "role", "ranges", "against"),
    [
        ("paper-1", "a", [0, 5], "3, 4"),
        ("paper-1", "b", [0, 1, 2], "2"),
        ("paper-2", "a", [0, 1], "2"),
        ("paper-2", "b", [0, 1, 2], "2"),
    ],
)
def test_phase_1_shows_both_branches_the_rings_and_what_rules_one_out(
    name: str, role: Role, ranges: Sequence[int], against: str, recordings: Path
) -> None:
    told = pair(recorded(name, recordings))
    figure = drawn(phase_one.draw(told, role))
    rho = told.robot(role).anchor_ranges
    assert radii(figure, r"rho-\d") == [rho[tick] for tick in ranges]
    assert radii(figure, "range") == [3.0]
    assert len(found(figure, "rejected")) == 1
    assert [one.get_linestyle() for one in found(figure, "rejected") if isinstance(one, Line2D)] == [":"]
    anchor = told.robot(role).anchor
    true = [math.hypot(p.x - anchor.x, p.y - anchor.y) for p in told.robot(role).path]
    kept = line(figure, "kept")
    assert [math.hypot(x, y) for x, y in kept] == pytest.approx(true[: len(kept)])
    words = [one.get_label() for one in found(figure, "contradicted")]
    assert words == [f"ruled out by $k$ = {against}"]
    assert len(line(figure, "ranged-kept")) == len(ranges)
    if (name, role) == ("paper-2", "a"):
        assert radii(figure, "rho-virtual") == pytest.approx([true[2]])


@pytest.mark.parametrize(("name", "ticks"), [("paper-1", [46, 47, 48]), ("paper-2", [106, 109, 110])])
def test_the_encounter_has_a_panel_for_each_mutual_range(
    name: str, ticks: list[int], recordings: Path
) -> None:
    told = pair(recorded(name, recordings))
    assert encounter.steps(told) == ticks
    figure = drawn(encounter.draw(told))
    assert len(figure.axes) == 4, "a panel for each, and the key"
    for axes, tick in zip(figure.axes, ticks, strict=False):
        assert axes.get_title(loc="left").startswith(f"({ticks.index(tick) + 1}) $k$ = {tick}, ")
        assert axes.get_aspect() == 1.0
        truth = [told.robot(role).path[tick] for role in ("a", "b")]
        ((x, y), (other_x, other_y)) = line(figure, f"rho-{tick}")
        assert [(x, y), (other_x, other_y)] == [(p.x, p.y) for p in truth]


def test_the_trajectory_has_both_paths_the_ranges_and_the_orbits(recordings: Path) -> None:
    told = pair(recorded("paper-1", recordings))
    figure = drawn(trajectory.draw(told))
    arrows = [one for one in figure.findobj(Annotation) if isinstance(one, Annotation)]
    for role in ("a", "b"):
        assert line(figure, f"path-{role}") == [(p.x, p.y) for p in told.robot(role).path]
        assert radii(figure, f"range-{role}") == [3.0]
        assert radii(figure, f"orbit-{role}") == [6.5]
        start = told.robot(role).path[0]
        (arrow,) = [one for one in arrows if one.xyann == (start.x, start.y)]
        along = math.atan2(arrow.xy[1] - start.y, arrow.xy[0] - start.x)
        assert wrap(along - start.heading) == pytest.approx(0.0, abs=1e-9)
    assert len(line(figure, "path-a")) == 49
    assert figure.axes[0].get_aspect() == 1.0


def test_an_encounter_far_away_is_drawn_larger_in_an_inset(recordings: Path, tmp_path: Path) -> None:
    assert not drawn(trajectory.draw(pair(recorded("paper-1", recordings)))).axes[0].child_axes
    far = PAPER_1.replace("[10.0, 0.0]", "[40.0, 0.0]").replace("[11.3, -0.4", "[41.3, -0.4")
    run_mission(parse(far, "far", seed=1), tmp_path)
    told = pair(tmp_path)
    figure = drawn(trajectory.draw(told))
    (inset,) = figure.axes[0].child_axes
    assert told.encounter_tick is not None
    for role in ROLES:
        for pose in told.robot(role).path[told.encounter_tick :]:
            assert inset.get_xlim()[0] < pose.x < inset.get_xlim()[1]
            assert inset.get_ylim()[0] < pose.y < inset.get_ylim()[1]
    assert len(found(figure, "path-a")) == 1, "names of marks stay unique"


def test_ranges_are_those_that_were_measured_and_contact_is_shaded(recordings: Path) -> None:
    told = pair(recorded("paper-2", recordings))
    figure = over_time.ranges(told)
    assert line(figure, "mutual-range") == [
        (k, rho) for k, (_, rho) in enumerate(told.mutual) if rho is not None
    ]
    assert [k for k, _ in line(figure, "mutual-range")] == [106, 109, 110]
    assert [k for k, _ in line(figure, "anchor-range-a")][:2] == [0, 1]
    assert line(figure, "separation") == list(enumerate(told.separations))
    names = {one.get_gid() for one in found(figure, r"contact-.*")}
    assert names == {"contact-106-106", "contact-109-110"}


@pytest.mark.parametrize("name", ["paper-1", "noisy"])
@pytest.mark.long
def test_the_last_error_is_that_of_the_claim(name: str, recordings: Path) -> None:
    told = pair(recorded(name, recordings))
    figure = drawn(over_time.errors(told))
    for place, role in enumerate("ab"):
        claim = told.run.claim(told.run.robots[place])
        assert claim is not None
        for what, error in (("position", claim.position_error), ("heading", claim.heading_error)):
            tick, value = line(figure, f"{what}-{role}")[-1]
            assert tick == claim.tick
            assert value == max(error, over_time.FLOOR)
        if claim.covariance is not None:
            sigmas = claim.covariance.position_sigma, claim.covariance.heading_sigma
            for what, sigma in zip(("position", "heading"), sigmas, strict=True):
                tick, value = line(figure, f"{what}-sigma-{role}")[-1]
                assert (tick, value) == pytest.approx((claim.tick, 3.0 * sigma))
    assert [axes.get_yscale() for axes in figure.axes[:2]] == ["log", "log"]
    assert bool(found(figure, "position-sigma-a")) == (name == "noisy")


@pytest.mark.long
def test_all_error_lines_differ_in_grey(
    recordings: Path,
) -> None:
    figure = drawn(over_time.errors(pair(recorded("noisy", recordings))))
    dashes: dict[str, Any] = {}
    for gid in (f"position-{what}{role}" for what in ("", "alone-", "sigma-") for role in "ab"):
        (one,) = found(figure, gid)[:1]
        dashes[gid] = str(one._unscaled_dash_pattern)  # type: ignore[attr-defined]
    assert len(set(dashes.values())) == len(dashes) == 6


@pytest.mark.long
def test_a_panel_has_each_hypothesis_of_the_journal_under_noise(recordings: Path) -> None:
    folder = recorded("noisy", recordings)
    told = pair(folder)
    figure = drawn(encounter.draw_decisions(told))
    shown = {int(one.get_gid().split("-")[1]) for one in found(figure, r"truth-.*")}  # type: ignore[union-attr]
    assert len(shown) == len(figure.axes) - 1 > 1
    for role in ("a", "b"):
        held = read(folder).estimates(role)
        for tick in shown:
            marks = [
                line(figure, f"hypothesis-{tick}-{role}-{i + 1}")[0] for i in range(len(held[tick].world))
            ]
            assert marks == [(pose.x, pose.y) for pose in held[tick].world]
            assert not found(figure, f"hypothesis-{tick}-{role}-{len(marks) + 1}")
            command = told.command(role, tick)
            assert command is not None
            if command.verdict is None:
                goal = step(
                    held[tick].world[0], command.v, command.omega, stride(told.mission) * told.mission.period
                )
                assert line(figure, f"chosen-{tick}-{role}") == [(goal.x, goal.y)]


def test_a_noisy_plan_of_the_paper_planner_is_drawn_in_bs_frame(recordings: Path) -> None:
    told = pair(recorded("letter", recordings))
    ((_, plan),) = manoeuvre.planned(told, "b")
    (figure,) = [drawn(one) for one in manoeuvre.draw(told).values()]
    assert len(found(figure, r"hypothesis-\d+")) == len(plan.question.placements)
    assert any("in b's own frame" in text.get_text() for text in figure.texts)


# --- any run --------------------------------------------------------------------------------------------

ABSENT = {"undecided": {"phase-1-a", "plan-a-b", "encounter-a-b"}}


@pytest.mark.parametrize("name", series(["undecided", "assured", "faulty", "letter"], 0))
def test_each_kind_of_figure_is_drawn_or_the_reason_is_printed(
    name: str, recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = pair(recorded(name, recordings))
    kinds = [kind for kind in PICTURES if kind != "robot"]
    out = [
        path
        for kind in kinds
        for path in draw(
            partial(catalogue.pictures, told, kind), ["svg"], tmp_path, torn=False, medium=SCREEN
        )
    ]
    err = capsys.readouterr().err
    made = {path.stem for path in tmp_path.iterdir()}
    missing = ABSENT.get(name, set())
    assert sorted(re.findall(r"^tandem figures: no (\S+): .+$", err, re.MULTILINE)) == sorted(missing)
    always = {"trajectory-a-b", "phase-1-a", "phase-1-b", "encounter-a-b", "ranges-a-b", "errors-a-b"}
    assert made >= always - missing
    assert any(name.startswith("plan-") for name in made) == ("plan-a-b" not in missing)
    assert sorted(out) == sorted(tmp_path.iterdir())


def test_the_bands_of_figure_1_cover_both_paths_each_in_the_colour_of_its_phase(recordings: Path) -> None:
    told = pair(recorded("paper-1", recordings))
    figure = drawn(trajectory.draw(told, phases=True))
    for role in ROLES:
        side, ends = told.robot(role), []
        for one in found(figure, f"band-{side.id}-.*"):
            assert isinstance(one, Line2D)
            first, phase = [int(word) for word in str(one.get_gid()).split("-")[2:]]
            last = first + len(np.asarray(one.get_xdata())) - 1
            assert one.get_color() == trajectory.PHASE_COLOURS[phase]
            assert {side.phase(k) for k in range(first, last)} == {phase}
            ends += [first, last]
        assert [ends[0], *ends[1:-1:2], ends[-1]] == [0, *ends[2::2], len(side.path) - 1], "no gap"


@pytest.mark.parametrize("name", ["paper-1", "assured"])
def test_the_angles_of_figure_2_end_where_robots_come_into_range(name: str, recordings: Path) -> None:
    told = pair(recorded(name, recordings))
    figure, reach, (a, b) = drawn(geometry.draw(told)), told.mission.sensing_range, (told.a, told.b)
    for one in found(figure, "eta"):
        assert isinstance(one, Line2D)
        (start, end) = np.transpose(np.asarray((one.get_xdata(), one.get_ydata()), float))
        assert math.dist(start, end) == pytest.approx(told.mission.first_straight)
        assert math.dist(end, (a.anchor.x, a.anchor.y)) == pytest.approx(reach)
    assert len(found(figure, "eta")) == (2 if name == "paper-1" else 0)
    reached = b.orbit.radius if name == "paper-1" else reach - b.orbit.radius
    for one in found(figure, "omega"):
        assert isinstance(one, Line2D)
        (start, end) = np.transpose(np.asarray((one.get_xdata(), one.get_ydata()), float))
        assert math.dist(start, end) == pytest.approx(a.orbit.radius)
        assert math.dist(end, (b.anchor.x, b.anchor.y)) == pytest.approx(reached)
    assert len(found(figure, "omega")) == 2


def test_every_pair_has_figures_of_its_own(recordings: Path) -> None:
    folder = recorded("pairs", recordings)
    names = []
    with look(SCREEN):
        for number in range(2):
            names += [name for name, _ in catalogue.pictures(pair(folder, number), "trajectory")]
    assert names == ["trajectory-a-b", "trajectory-c-d"]


@pytest.mark.parametrize("ticks", series([0, 47, 1, 30], 2))
def test_a_truncated_recording_is_drawn_up_to_the_truncation(
    ticks: int, recordings: Path, tmp_path: Path
) -> None:
    folder = copied(recorded("paper-1", recordings), tmp_path)
    cut(folder / "world.journal", 2 + 2 * ticks)
    cut(folder / "agent-b.journal", 2 + 3 * min(ticks, 20))
    told = pair(folder)
    kinds = ("trajectory", "phase-1", "plan", "encounter")
    figures = {name: one for kind in kinds for name, one in catalogue.pictures(told, kind)}
    path = drawn(figures["trajectory-a-b"])
    assert len(line(path, "path-a")) == max(1, ticks)
    assert any("the recording breaks off" in text.get_text() for text in path.texts)
    assert isinstance(figures["encounter-a-b"], Absent) == (ticks < 47)
    assert isinstance(figures["plan-a-b"], Absent)
    assert isinstance(figures["phase-1-a"], Absent) == (ticks < 30)
    if ticks == 47:
        assert len(drawn(figures["encounter-a-b"]).axes) == 2


def test_a_journal_of_another_version_is_followed_to_where_it_decides_otherwise(
    recordings: Path, tmp_path: Path
) -> None:
    folder = copied(recorded("paper-1", recordings), tmp_path)
    path = folder / "agent-b.journal"
    path.write_bytes(b"".join([msgpack.packb(_turned(frame, 20)) for frame in frames(path)]))
    assert len(pair(folder).states("b")) == 20
    ended = tandem("figures", folder, "--only", "plan", "--format", "svg")
    assert ended.status == 3
    assert ended.err == (
        "tandem figures: figures of b end where its journal cannot be replayed: the recorded decision "
        "at tick 20 differs: another version wrote the journal\n"
        "tandem figures: no plan-a-b: the journal of b is missing or cannot be replayed to its end\n"
    )


def test_a_missing_journal_is_not_mistaken_for_a_missing_plan(recordings: Path, tmp_path: Path) -> None:
    for name, whole in (
        ("paper-1", "no last manoeuvre was planned"),
        ("noisy", "no robot scored hypotheses"),
    ):
        folder = tmp_path / name
        folder.mkdir()
        copied(recorded(name, recordings), folder)
        (folder / "agent-b.journal").unlink()
        cut(folder / "agent-a.journal", 4)
        ended = tandem("figures", folder, "--only", "plan", "--format", "svg")
        assert (ended.status, whole in ended.err) == (3, False)
        assert "no plan-a-b: the journal of b is missing or cannot be replayed to its end" in ended.err


def _turned(frame: bytes, tick: int) -> bytes:
    """Return the frame; the Command of `tick` gets a slightly larger turn rate."""
    try:
        command = decode(frame, Command)
    except MalformedFrame:
        return frame
    return encode(replace(command, omega=command.omega + 1e-12)) if command.tick == tick else frame


# --- the command ----------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_terminal_shows_how_far_it_is_and_each_file_on_a_line_of_its_own(
    recordings: Path, tmp_path: Path
) -> None:
    folder = tmp_path / f"{'long' * 20}"
    folder.mkdir()
    copied(recorded("undecided", recordings), folder)
    status, shown = on_a_terminal(
        "figures", folder, "--only", "ranges", "--only", "errors", "--format", "svg"
    )
    assert status == 0
    for name in ("ranges", "errors"):
        assert f"{folder}/figures/{name}-a-b.svg\r\n" in shown
    assert "tandem figures" in shown
    percentages = [int(percentage) for percentage in re.findall(r"(\d+)%", shown)]
    assert percentages == sorted(percentages)
    assert (percentages[0], percentages[-1]) == (0, 100)


@pytest.mark.long
def test_with_its_output_in_a_file_the_progress_bar_stays_on_the_terminal(
    recordings: Path, tmp_path: Path
) -> None:
    folder = copied(recorded("undecided", recordings), tmp_path)
    ours, theirs = pty.openpty()
    arguments = ["figures", str(folder), "--only", "ranges", "--format", "svg"]
    with (tmp_path / "out").open("wb") as out:
        command = [sys.executable, "-P", "-m", "compose.cli", *arguments]
        subprocess.run(command, stdout=out, stderr=theirs, check=True)
    shown = os.read(ours, 65536).decode(errors="replace")
    os.close(ours)
    os.close(theirs)
    assert (tmp_path / "out").read_text() == f"{folder}/figures/ranges-a-b.svg\n"
    assert "tandem figures" in shown
    assert "ranges-a-b" not in shown


@pytest.mark.parametrize(("journal", "torn"), [("world.journal", "the world"), ("agent-b.journal", "b")])
def test_no_part_of_a_truncated_recording_is_reported_as_absent(
    paper_1: Path, journal: str, torn: str, tmp_path: Path
) -> None:
    copied(paper_1, tmp_path)
    os.truncate(tmp_path / journal, (paper_1 / journal).stat().st_size // 2)
    ended = tandem("figures", tmp_path, "--only", "plan", "--only", "encounter", "--format", "svg")
    assert f"tandem figures: the recording of {torn} ends before the mission does\n" in ended.err
    reasons = re.findall(r"no [\w-]+: (.*)", ended.err)
    assert reasons
    assert all(reason.endswith(" (in the incomplete recording)") for reason in reasons)


@pytest.mark.parametrize("words", [("--only", "plans"), ("--format", "jpg")])
def test_what_is_no_picture_or_format_is_refused(words: Sequence[Any], tmp_path: Path) -> None:
    ended = tandem("figures", tmp_path, *words)
    assert ended.status == 2
    assert re.fullmatch(r"tandem figures: argument [^\n]+\n", ended.err), ended.err
