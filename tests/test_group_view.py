"""The views of a group: who meets whom at any time, and how localisation spreads."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from matplotlib.text import Annotation
from msgspec.structs import replace
from playwright.sync_api import expect

from agent.process.robot import PlannerReplay
from compose.figures import catalogue
from compose.figures.agent_replay import agent_replay
from compose.figures.pair import PairRecord, pairs_of
from compose.figures.sheet import Absent
from compose.figures.style import SCREEN, look
from compose.launch import in_process
from compose.launch.planner_loader import planner_of
from compose.recording.group_localisation import PastMeeting, past_meetings
from compose.recording.run import Run
from compose.recording.run import read as read_run
from compose.scenario.scenario_file import parse
from compose.scenario.shipped_files import shipped
from compose.terminal import progress
from compose.terminal.live_display import ProgressLine
from compose.view.foxglove.views import Views
from compose.view.numbers import Numbers
from compose.view.recorded import run_data, scenes, scenes_of
from compose.view.run_data import RunData
from compose.view.scene import Scene
from compose.view.series import series
from compose.view.web.sources import Recorded
from protocol.journal import journal_file
from protocol.journal.journal_file import packed
from protocol.messages import Command, Contact, Estimate, GroundTruth, Localised, Message, Observation, Report
from protocol.motion import Pose
from tests.browser import Open, inks, scrub_to, shot, watching
from tests.commands import SECTION_IV, anchored, copied, tandem
from tests.conftest import recorded

WAYS = {
    "r0": [(0, "r1"), (22, "r3"), (65, "r5")],
    "r1": [(0, "r0"), (22, "r2"), (63, "r4")],
    "r2": [(0, "r1"), (63, "r6")],
    "r3": [(0, "r0"), (65, "r7")],
    "r4": [(0, "r1")],
    "r5": [(0, "r0")],
    "r6": [(0, "r2")],
    "r7": [(0, "r3")],
}
"""The peers of the robots of group-8, with the ticks from which on they are."""
CROWD = f"""
name = "crowd"
seed = 5
{SECTION_IV}
{anchored(a=(0.0, 0.0), b=(1.5, 0.0), c=(0.0, 1.5), d=(1.5, 1.5))}
"""
"""A group whose robots are in range of several others from the first tick on."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded("group-8", tmp_path_factory.mktemp("recorded"))


@pytest.fixture(scope="module")
def run(folder: Path) -> Run:
    return read_run(folder)


@pytest.fixture(scope="module")
def shown(run: Run) -> tuple[Scene, ...]:
    return scenes_of(run)


@pytest.fixture(scope="module")
def crowd(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("crowd")
    in_process.run_mission(parse(CROWD, "crowd"), folder)
    return read_run(folder)


def peers(shown: tuple[Scene, ...]) -> dict[str, list[tuple[int, str | None]]]:
    """Return the peer of each robot with the ticks in which it changes."""
    found: dict[str, list[tuple[int, str | None]]] = {}
    for scene in shown:
        for player in scene.players:
            known = found.setdefault(player.robot, [])
            if not known or known[-1][1] != player.peer:
                known.append((scene.tick, player.peer))
    return found


# --- which robots meet --------------------------------------------------------------------------------


def test_the_scene_says_with_which_robot_each_one_is_or_to_which_it_drives(shown: tuple[Scene, ...]) -> None:
    assert peers(shown) == WAYS
    assert shown[30].player("r0").activity == "r0 drives to r3 to localise it"
    assert shown[30].player("r3").activity == "r3 waits beside its anchor until r0 comes into range"
    assert shown[63].player("r3").activity == (
        "r3 drives to where the remaining hypotheses predict different ranges"
    )


@pytest.mark.parametrize(
    "faults",
    [
        "",
        pytest.param("[[fault]]\nloss = 0.7\ndelay = [0, 4]\n", marks=pytest.mark.long),
        pytest.param('[[fault]]\nlink = "r0->r3"\npartition = true\n', marks=pytest.mark.long),
    ],
    ids=["no fault", "loss", "a failed visit"],
)
def test_the_meetings_that_viewers_find_are_those_of_the_planners(faults: str, tmp_path: Path) -> None:
    text = shipped()["group-8"].read_text().replace("[[robot]]", f"{faults}[[robot]]", 1)
    in_process.run_mission(parse(text, "group-8"), tmp_path)
    run = read_run(tmp_path)
    compared, same = 0, 0
    played: dict[str, list[str]] = {robot: [] for robot in run.robots}
    for robot, agent in run.agents.items():
        again = PlannerReplay(agent, planner_of(agent.config))
        for step in again:
            if step.command is not None:
                played[robot].append(again.robot.state.config.peer)
    for scene in scenes_of(run):
        for player in scene.players:
            compared += 1
            same += player.peer == played[player.robot][scene.tick]
    assert compared == 8 * run.length
    assert same >= 0.99 * compared
    if not faults:
        assert same == compared


def test_a_robot_of_a_group_rests_when_it_has_no_robot_to_drive_to_any_more(run: Run) -> None:
    rested: set[str] = set()
    for tick in run.ticks:
        for robot, command in tick.commands.items():
            assert command.rests == (command.peer is None) == (command.role is None)
            assert command.rests or robot not in rested
            if command.rests:
                assert command.verdict is not None
                assert (command.v, command.omega) == (0.0, 0.0)
                rested.add(robot)
    assert rested


def test_journals_that_grow_show_the_same_meetings(folder: Path, run: Run, tmp_path: Path) -> None:
    names = [path.name for path in folder.glob("*.journal")]
    stored = {name: list(journal_file.read(folder / name)) for name in names}
    journals = Recorded("", tmp_path)
    shown: list[Scene] = []
    for share in (0.2, 0.45, 0.7, 1.0):
        for name, frames in stored.items():
            (tmp_path / name).write_bytes(packed(frames[: round(share * len(frames))]))
        journals.read()
        assert journals.setup is not None
        shown += scenes(journals.setup, journals.known, len(shown), journals.known.last - 5)
    journals.load()
    assert journals.setup is not None
    shown += scenes(journals.setup, journals.known, len(shown))
    assert peers(tuple(shown)) == WAYS
    assert scenes(journals.setup, journals.known) == scenes_of(run)


def test_a_viewer_that_joins_late_finds_the_meetings_from_the_verdicts(run: Run) -> None:
    whole, late = run_data(run), RunData()
    for tick in range(75, whole.last + 1):
        for command in whole.ticks[tick].commands.values():
            late.add(command)
    assert run.setup is not None
    found = {robot.id: robot.peer for robot in late.setup_at(run.setup, 75).robots}
    assert found == {robot: ways[-1][1] for robot, ways in WAYS.items()}


STRANGER = "z"
"""A robot outside the mission, which keys and frames may name all the same."""


def foreign(tick: int, to: str) -> list[tuple[Message, str]]:
    """Return frames of a tick in which a robot outside the mission is sender or receiver, or is named."""
    here = Pose(0.0, 0.0, 0.0)
    log = Report(tick, to, 1, "standing", here, 0, 0, (), 0, (), 0, 0)
    return [
        (log, STRANGER),
        (log, to),
        (replace(log, robot=STRANGER), to),
        (Command(tick, STRANGER, 0.0, 0.0, 1, "travelling", Localised(here)), ""),
        (Estimate(tick, STRANGER, (here,), (here,), localised=True), ""),
        (Observation(tick, STRANGER, None, 1.0, (Contact(to, 1.0, (tick,)),)), ""),
        (Observation(tick, to, None, 1.0, (Contact(STRANGER, 1.0, (tick,)), Contact(to, 1.0, (tick,)))), ""),
        (GroundTruth(tick, {STRANGER: here}), ""),
    ]


def test_a_robot_outside_the_mission_changes_nothing_that_viewers_show(run: Run) -> None:
    """A member may send reports to any robot, and without certificates anyone may send as any robot."""
    setup, whole, told = run.setup, RunData(), RunData()
    assert setup is not None
    for tick, data in run_data(run).ticks.items():
        for frame, receiver in foreign(tick, "r1"):
            told.add(frame, receiver=receiver)
        for known in (whole, told):
            known.add(GroundTruth(tick, data.truth))
            for command in data.commands.values():
                known.add(command)
    scenes_told = scenes(setup, told)
    assert peers(scenes_told) == peers(scenes(setup, whole))
    assert {player.robot for scene in scenes_told for player in scene.players} == {*setup.ids}
    views = Views(setup)
    for scene in scenes_told:
        list(views.of(scene))
    series(setup, told)


def test_configurations_alone_have_the_same_plan_of_meetings(run: Run) -> None:
    agents_only = Run(None, run.agents, {name: one for name, one in run.journals.items() if "agent" in name})
    assert run.setup is not None
    assert agents_only.setup is not None
    told, planned = agents_only.setup.visits, run.setup.visits
    assert [(one.visitor, one.visited) for one in told] == [(one.visitor, one.visited) for one in planned]
    for one, other in zip(told, planned, strict=True):  # robots are told the last tick within the bound
        assert other.ends_s - run.setup.mission.period < one.ends_s <= other.ends_s
    assert agents_only.setup.t_max_s == max(one.ends_s for one in told)
    assert run.setup.t_max_s == max(one.ends_s for one in planned)
    assert [(one.a, one.b, one.first) for one in past_meetings(agents_only)] == [
        (one.a, one.b, one.first) for one in past_meetings(run)
    ]


def test_meetings_last_until_one_of_the_robots_leaves(run: Run) -> None:
    found = past_meetings(run)
    assert found[:3] == (
        PastMeeting("r1", "r0", 0, 21, newcomers=frozenset({"r0", "r1"})),
        PastMeeting("r1", "r2", 22, 62, newcomers=frozenset({"r2"})),
        PastMeeting("r0", "r3", 22, 64, newcomers=frozenset({"r3"})),
    )
    assert {(one.a, one.b, one.first, one.last) for one in found[3:]} == {
        ("r1", "r4", 63, 108),
        ("r2", "r6", 63, 108),
        ("r0", "r5", 65, 108),
        ("r3", "r7", 65, 108),
    }


# --- captions, events, deliveries, numbers ------------------------------------------------------------


def test_the_captions_of_a_group_tell_who_drives_to_whom_and_how_many_are_localised(
    shown: tuple[Scene, ...],
) -> None:
    told = [(scene.tick, caption.text) for scene in shown for caption in scene.captions]
    assert told[:6] == [
        (
            0,
            "Eight robots measure no more than the distance to their own anchor. "
            "First, r1 meets r0; then those that are localised drive to the others.",
        ),
        (19, "r1 and r0 meet. Their distance is 2.39 m. They exchange reports of their paths."),
        (21, "r0 and r1 claim to know their poses: 2 of 8 robots now do."),
        (22, "r0 drives to r3 and r1 drives to r2, which wait beside their anchors."),
        (60, "r1 reaches r2. Their distance is 2.76 m. They exchange reports of their paths."),
        (62, "r0 reaches r3. Their distance is 2.59 m. They exchange reports of their paths."),
    ]
    assert told[-1] == (108, "All 8 robots are localised: each knows its position and its heading.")
    assert (shown[-1].captions[-1].truth or "").startswith("The claimed positions are off by less than 1 µm")


def test_the_log_has_what_robots_do_after_their_claims_and_each_contact_once(
    shown: tuple[Scene, ...],
) -> None:
    texts = [(event.tick, event.kind, event.text) for scene in shown for event in scene.events]
    assert (22, "state", "r0 drives to r3 to localise it") in texts
    contacts = [(tick, text) for tick, kind, text in texts if kind == "contact"]
    assert [text.partition(" are ")[0] for _, text in contacts] == [
        "r1 and r0", "r1 and r2", "r0 and r3", "r1 and r4", "r0 and r5", "r2 and r6", "r3 and r7",
    ]  # fmt: skip


def test_reports_to_several_robots_in_a_tick_are_all_deliveries(crowd: Run) -> None:
    several = 0
    for scene in scenes_of(crowd):
        sent = {(one.sender, one.receiver) for one in scene.passages if one.what == "sent"}
        contacts = {(p.robot, contact.peer) for p in scene.players for contact in p.contacts}
        assert sent == contacts
        heard = {(one.receiver, one.sender, one.tick) for one in scene.passages if one.what == "heard"}
        assert heard == {
            (p.robot, contact.peer, tick)
            for p in scene.players
            for contact in p.contacts
            for tick in contact.heard or ()
        }
        several += len(sent) > len({sender for sender, _ in sent})
    assert several > 0


def test_one_journal_has_all_reports_of_its_robot_and_the_world_s_all_that_are_received(
    crowd: Run, tmp_path: Path
) -> None:
    folder = Path(str(crowd.source))
    (tmp_path / "agent-a.journal").write_bytes((folder / "agent-a.journal").read_bytes())
    known = run_data(read_run(tmp_path))
    for tick, step in enumerate(crowd.agents["a"].steps):
        sent = {link for link in known.ticks[tick].reports if link[0] == "a"}
        assert sent == {("a", contact.peer) for contact in step.observation.contacts}
    (tmp_path / "agent-a.journal").unlink()
    (tmp_path / "world.journal").write_bytes((folder / "world.journal").read_bytes())
    alone = scenes_of(read_run(tmp_path))
    assert [one.passages for one in alone] == [one.passages for one in scenes_of(crowd)]


def test_the_mutual_range_is_that_to_the_robot_of_the_present_meeting(crowd: Run) -> None:
    setup, known = crowd.setup, run_data(crowd)
    assert setup is not None
    for scene in scenes_of(crowd):
        for player in scene.players:
            assert player.peer is not None
            one = Numbers.in_scene(scene, setup.robot_setup(player.robot), setup)
            ranges = [contact.range for contact in player.contacts if contact.peer == player.peer]
            assert [one.mutual_range_m] == ranges or not ranges
    (curves,) = series(setup, known, ["a"]).robots
    numbers = [scene.player("a").contacts for scene in scenes_of(crowd)]
    assert len(curves.curves["mutual_range_m"].low) == len(numbers)


# --- figures ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pairs(run: Run) -> list[PairRecord]:
    return list(pairs_of(run, {robot: agent_replay(run, robot) for robot in run.robots}))


def test_a_meeting_is_drawn_from_the_tick_in_which_its_visitor_leaves(pairs: list[PairRecord]) -> None:
    (visit,) = [pair for pair in pairs if pair.name == "r0-r3"]
    assert visit.title.endswith("; meeting of r0 and r3, ticks 22 to 64")
    assert (visit.first, len(visit.mutual), visit.encounter_tick) == (22, 65, 62)
    assert [(span.phase, span.first, span.last) for span in visit.spans("a", "b")] == [
        (2, 22, 61),
        (3, 62, 64),
    ]
    assert visit.spans("b")[0].first == 0
    assert visit.a.claim is None
    assert visit.b.claim is not None
    assert visit.b.claim.tick == 64
    assert {state.config.peer for state in visit.states("a")} == {"r3"}
    errors = [abs(one.world[0].x - truth.x) for one, truth in visit.a.likeliest]
    assert len(errors) == 43
    assert max(errors) < 1e-6  # the estimate moves with the robot after its claim


def test_each_robot_has_one_sheet_and_each_meeting_its_own(pairs: list[PairRecord]) -> None:
    newcomers = [pair.robot(role).id for pair in pairs for role in pair.newcomers]
    assert sorted(newcomers) == [f"r{i}" for i in range(8)]
    with look(SCREEN):
        ((name, figure),) = catalogue.pictures(pairs[1], "trajectory")
    assert name == "trajectory-r1-r2"
    assert not isinstance(figure, Absent)
    gids = {one.get_gid() for one in figure.axes[0].get_children()}
    assert "orbit-r2" in gids
    assert "orbit-r1" not in gids  # it drives straight


def test_the_sheet_of_the_group_has_the_tree_and_the_tick_of_each_claim(
    run: Run, pairs: list[PairRecord]
) -> None:
    with look(SCREEN):
        drawn = [picture for pair in pairs for picture in catalogue.pictures(pair, "meetings")]
    ((name, figure),) = drawn
    assert name == "meetings"
    assert not isinstance(figure, Absent)
    plane, _, lanes = figure.axes
    found = {str(one.get_gid()): one for one in [*plane.get_children(), *lanes.get_children()]}
    for robot in run.robots:
        claim, label = run.claim(robot), found[f"localised-{robot}"]
        assert claim is not None
        assert isinstance(label, Annotation)
        assert label.get_text() == f"{robot}, $k$ = {claim.tick}"
    assert {gid for gid in found if gid.startswith("meeting-")} <= {
        f"meeting-{one.visitor}-{one.visited}" for one in run.scenario.meetings
    }
    assert {gid for gid in found if gid.startswith("at-")} == {
        f"at-{one.visitor}-{one.visited}" for one in run.scenario.meetings
    }
    assert [label.get_text() for label in lanes.get_yticklabels()][-1] == "r7"


@pytest.mark.long
def test_tandem_figures_draws_a_group_and_no_such_sheet_for_a_pair(folder: Path, tmp_path: Path) -> None:
    copy = copied(folder, tmp_path / "recording")
    drawn = tandem("figures", str(copy), "--format", "svg", "--only", "meetings", "--only", "ranges")
    assert drawn.status == 0, drawn.err
    names = {path.stem for path in (copy / "figures").iterdir()}
    assert names == {"meetings", *[f"ranges-{one.a}-{one.b}" for one in past_meetings(read_run(copy))]}
    assert tandem("run", "paper-1", "--in-process", "--out", str(tmp_path / "pair")).status == 0
    assert tandem("figures", str(tmp_path / "pair"), "--format", "svg", "--only", "meetings") == (0, "", "")


# --- terminal, Foxglove -------------------------------------------------------------------------------


def test_the_table_has_the_tick_and_the_pose_of_each_claim_in_place_of_the_last_pose(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    from compose.recording.summary_json import summary  # noqa: PLC0415

    progress.result(summary(run, None, None))
    out = capsys.readouterr().out
    assert re.search(r"r7 +108 ", out)
    assert "true x, y" not in out
    assert "tick: of the claim" in out


def test_the_line_of_a_mission_counts_robots_by_outcome(folder: Path, tmp_path: Path, run: Run) -> None:
    line = ProgressLine(run.scenario, tmp_path)
    assert line.display().plain.endswith(f"tick 0 of {run.scenario.max_ticks} at most: waiting for 8")
    frames = list(journal_file.read(folder / "world.journal"))
    (tmp_path / "world.journal").write_bytes(packed(frames[: round(0.68 * len(frames))]))
    assert line.display().plain.endswith(" at most: 4 localised, 4 no verdict yet")
    assert line.display().plain.endswith(" at most: 4 localised, 4 no verdict yet")


def test_localised_robots_have_another_colour_in_foxglove(run: Run, shown: tuple[Scene, ...]) -> None:
    setup = run.setup
    assert setup is not None
    assert [shown[75].player(robot.id).hue(robot) for robot in setup.robots] == [*"aaaabbbb"]
    stage = Views(setup).standing().message
    assert b"meetings" in stage.encode()


# --- the page -----------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_meeting_is_shown_large_beside_a_map_of_all_robots(
    opened: Open, folder: Path, shown: tuple[Scene, ...]
) -> None:
    met = next(scene.tick for scene in shown if any(one.kind == "contact" for one in scene.captions))
    with watching(folder) as (_, address):
        page = opened(address)
        apart = {}
        for tick in (met - 1, met, met + 1):
            scrub_to(page, tick)
            inks(page)
            robots = page.evaluate("document.getElementById('canvas').targets").copy()
            (x, y), (other_x, other_y) = (
                one["at"] for one in robots if one["kind"] == "robot" and one["robot"] in ("r0", "r1")
            )
            apart[tick] = ((x - other_x) ** 2 + (y - other_y) ** 2) ** 0.5
            explained = "all robots, and what is in view" in page.locator("#legend").inner_text()
            assert explained == (tick >= met)
        assert apart[met] > 4 * apart[met - 1]
        assert apart[met + 1] > 4 * apart[met - 1]


@pytest.mark.long
def test_the_page_shows_how_localisation_spreads(opened: Open, folder: Path) -> None:
    with watching(folder) as (_, address):
        page = opened(address)
        scrub_to(page, 10)
        before = inks(page)
        expect(page.locator("#counts")).to_have_text("0 of 8 robots localised, 0 travelling, 7 waiting")
        scrub_to(page, 75)
        expect(page.locator("#counts")).to_have_text("4 of 8 robots localised, 4 travelling, 4 waiting")
        expect(page.locator("#caption")).to_have_text(
            "r0 drives to r5 and r3 drives to r7, which wait beside their anchors."
        )
        expect(page.locator("#robots .name")).to_have_text(["r0", "r5"])  # of those that are told of
        for text, role in (("r0 to r5", "a"), ("r4 waiting", "b")):
            entry = page.locator("#roster .entry", has_text=text)
            expect(entry).to_have_attribute("data-role", role)
        after = inks(page)
        assert after["robot-a"] > 4 * max(before["robot-a"], 1)
        labels = page.evaluate("document.getElementById('canvas').labels.map((one) => one.text)")
        assert {f"r{i}" for i in range(8)} <= set(labels)
        shot(page, "group-8")
        page.locator("#roster .entry", has_text="r0 to r5").click()
        expect(page.locator("#robots .name")).to_have_text(["r0", "r5"])
        scrub_to(page, 40)
        expect(page.locator("#robots .name")).to_have_text(["r0", "r3"])


@pytest.mark.long
def test_guided_play_tells_the_story_of_the_whole_group(opened: Open, folder: Path) -> None:
    from tests.test_guided import played, started  # noqa: PLC0415

    with watching(folder) as (_, address):
        page = started(opened, address)
        told = list(dict.fromkeys(caption for _, caption in played(page)))
    assert told[0].startswith("Eight robots measure")
    assert told[-1].startswith("All 8 robots are localised: ")
    assert len(told) >= 15
