"""The scene of a run from every source, complete, torn or incomplete, with the configurations of a pair."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import pytest
from msgspec.structs import replace

from agent.planning.tasks import UNCONFIRMED
from compose.figures.agent_replay import agent_replay
from compose.launch import in_process
from compose.recording.recording_files import WORLD_JOURNAL
from compose.recording.run import Run, read
from compose.recording.run_setup import RunSetup, of_scenario
from compose.scenario.scenario_file import load, parse
from compose.scenario.shipped_files import shipped
from compose.view.configurations import Configurations, configurations
from compose.view.recorded import run_data, scenes, scenes_of
from compose.view.run_data import RunData
from compose.view.scene import Scene
from compose.view.web import sources
from compose.view.web.sources import Recorded, writers_of
from compose.view.words import DOING, SEEKING, doing
from protocol.attack import Attack
from protocol.journal import journal_file
from protocol.journal.journal_file import Journal
from protocol.messages import MissionEnd
from protocol.motion import REST, compose, wrap
from protocol.wire import decode
from tests.commands import copied
from tests.series import series
from tests.steps import NAMES
from world.channel import LinkState
from world.scenario import Scenario
from world.world_journal import world_history


class Performance(NamedTuple):
    """A recorded run with all its scenes, and what a viewer notes about its journals."""

    setup: RunSetup
    scenes: tuple[Scene, ...]
    end: MissionEnd | None
    notes: tuple[str, ...]


def performance(folder: Path) -> Performance:
    """Read the journals as a viewer does, and as a recording: both show the same."""
    run, journals = read(folder), Recorded("", folder)
    journals.load()
    assert journals.setup is not None
    assert run.setup == journals.setup
    shown = scenes(journals.setup, journals.known)
    assert scenes_of(run) == shown
    assert run.end == journals.known.end
    assert run.final_reports == journals.known.final_reports
    return Performance(journals.setup, shown, run.end, tuple(journals.notes))


def said(shown: Performance, kind: str) -> list[tuple[int, str]]:
    return [(event.tick, event.text) for one in shown.scenes for event in one.events if event.kind == kind]


def test_an_event_says_apart_what_only_the_ground_truth_tells(paper_1: Path) -> None:
    claims = [event for one in performance(paper_1).scenes for event in one.events if event.kind == "claim"]
    assert len(claims) == 2
    for event in claims:
        assert "error" not in event.text
        assert event.truth is not None
        assert event.truth.startswith("the error is ")
        assert event.whole == f"{event.text}; {event.truth}"


def test_a_scene_shows_where_everyone_is_and_what_everyone_does(paper_1: Path) -> None:
    recording, shown = read(paper_1), performance(paper_1)
    assert [one.tick for one in shown.scenes] == [moment.truth.tick for moment in recording.ticks]
    for moment, one in zip(recording.ticks, shown.scenes, strict=True):
        for player, pose in zip(one.players, moment.truth.poses, strict=True):
            command = moment.commands[player.robot]
            assert player.pose == replace(pose, heading=wrap(pose.heading))
            assert player.command is not None
            assert (player.command.v, player.command.state) == (command.v, command.task)


def test_the_first_contact_of_paper_1_is_shown_at_tick_46(paper_1: Path) -> None:
    shown = performance(paper_1)
    assert said(shown, "contact") == [(46, "a and b are in range of each other: 2.95 m")]
    assert said(shown, "anchor")[0] == (0, "a is in its anchor's range: 2.68 m")
    assert shown.scenes[46].player("b").activity == "b stands still and waits for a's second range"
    assert said(shown, "candidates")[-1] == (48, "b's hypotheses fall from 4 to 1")
    assert said(shown, "end") == [(48, "The mission ends: localised")]


def test_local_poses_stand_where_the_robot_is_in_the_frame_that_the_stage_gives(paper_1: Path) -> None:
    shown = performance(paper_1)
    for player in shown.scenes[20].players:
        frame = shown.setup.robot_setup(player.robot).frame
        assert frame is not None
        assert player.held is not None
        assert player.pose is not None
        place = compose(frame, player.held.local[0])
        assert (place.x, place.y) == pytest.approx((player.pose.x, player.pose.y), abs=1e-9)


def test_without_the_worlds_journal_the_scene_has_the_data_of_the_robots(
    paper_1: Path, tmp_path: Path
) -> None:
    copied(paper_1, tmp_path, "agent-a.journal", "agent-b.journal")
    shown, whole = performance(tmp_path), performance(paper_1)
    assert [robot_setup.id for robot_setup in shown.setup.robots] == ["a", "b"]
    assert all(player.pose is None for one in shown.scenes for player in one.players)
    assert said(shown, "contact") == said(whole, "contact")
    assert shown.scenes[47].passages == whole.scenes[47].passages


def test_without_a_robot_s_journal_what_it_sensed_follows_from_the_world_s(
    paper_1: Path, tmp_path: Path
) -> None:
    copied(paper_1, tmp_path, "world.journal", "agent-b.journal")
    shown, whole = performance(tmp_path), performance(paper_1)
    for one, other in zip(shown.scenes, whole.scenes, strict=True):
        assert one.player("a").anchor_range == other.player("a").anchor_range
        assert one.player("a").contacts == other.player("a").contacts
        assert one.player("b") == other.player("b")
        assert one.passages == other.passages


@pytest.mark.parametrize("share", [0.02, 0.3, 0.77])
def test_a_truncated_recording_is_shown_up_to_the_truncation(
    paper_1: Path, tmp_path: Path, share: float
) -> None:
    for path in paper_1.glob("*.journal"):
        data = path.read_bytes()
        (tmp_path / path.name).write_bytes(data[: 1500 + int(share * (len(data) - 1500))])
    shown, whole = performance(tmp_path), performance(paper_1)
    assert shown.end is None
    assert shown.notes == ()
    known = [
        one
        for one in shown.scenes
        if all(player.held and player.pose and player.command for player in one.players)
    ]
    assert known == [one for one in whole.scenes if one.tick in {other.tick for other in known}]


def test_a_folder_without_a_journal_holds_nothing_to_see(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="No such file"):
        performance(tmp_path)


def test_the_deliveries_in_a_scene_are_those_of_the_simulation_and_each_report_comes_or_is_lost(
    tmp_path: Path,
) -> None:
    faults = ["loss=0.3, delay=0..3, corrupt=0.2, duplicate=0.3, reorder=0.2", "a->b: reports_per_tick=0.7"]
    scenario = load("random", seed=3, faults=faults)
    in_process.run_mission(scenario, tmp_path)
    told = world_history(journal_file.read(tmp_path / "world.journal"), tmp_path)
    shown = {one.tick: one.passages for one in performance(tmp_path).scenes}
    ever: set[str] = set()
    for way, sender in (((0, 1), "a"), ((1, 0), "b")):
        for tick in told.ticks:
            k, air = tick.world.truth.tick, (tick.world.links or {}).get(way, LinkState())
            here = {
                what: [one.tick for one in shown[k] if (one.sender, one.what) == (sender, what)]
                for what in ("sent", "heard", "damaged", "lost")
            }
            assert (here["heard"], here["damaged"]) == (list(air.heard), list(air.damaged))
            assert here["lost"] == list(air.lost)
            ever |= {what for what, ticks in here.items() if ticks} | ({"late"} if air.flying else set())
        passages = [one for of_tick in shown.values() for one in of_tick if one.sender == sender]
        came = {one.tick for one in passages if one.what in ("heard", "damaged")}
        came |= {flying.tick for flying in air.flying}
        sent, lost = ([one.tick for one in passages if one.what == what] for what in ("sent", "lost"))
        assert sorted(lost) == sorted({*sent} - came)
    assert ever == {"sent", "heard", "damaged", "lost", "late"}


def test_a_robot_is_shown_as_down_in_every_tick_without_its_process(paper_1: Path) -> None:
    journals = Recorded("", paper_1)
    journals.load()
    known, setup = RunData(), journals.setup
    assert setup is not None

    def begin(tick: int) -> None:
        for command in journals.known.ticks[tick].commands.values():
            known.add(command)

    def present(**there: bool) -> None:
        for robot, one in there.items():
            known.present(robot, one)

    present(a=False)  # nothing has begun
    begin(0)
    present(a=False, b=True)  # not there yet
    present(a=True)
    begin(1)
    present(a=False)
    present(a=False)
    begin(2)
    known.present(None, True)
    known.present(None, False)
    present(a=True)
    known.present(None, True)
    begin(3)
    present(b=False)
    present(b=True)
    known.add(journals.known.final_reports["a"])
    present(a=False)  # its part of the mission has ended
    for tick in (1, 3):
        known.ticks[tick].late.add("a")  # every tick of a robot that is down: told once, as that
    shown = scenes(setup, known)
    assert [event.tick for one in shown for event in one.events if event.kind == "late"] == [3]
    assert [one.player("a").down for one in shown] == [False, True, False, False]
    assert shown[1].player("a").activity == "a is down: its process is gone"
    assert [
        (event.tick, event.kind, event.robot)
        for one in shown
        for event in one.events
        if event.kind in ("down", "back")
    ] == [
        (1, "down", "a"),
        (2, "down", None),
        (2, "back", None),
        (2, "back", "a"),
        (3, "down", "b"),
        (3, "back", "b"),
    ]


def test_the_end_is_shown_though_it_comes_after_a_page_has_seen_the_last_tick(
    paper_1: Path, tmp_path: Path
) -> None:
    frames = list(journal_file.read(paper_1 / WORLD_JOURNAL))
    before = len(frames) - 1 - len(read(paper_1).final_reports)
    assert isinstance(decode(frames[before], MissionEnd), MissionEnd)
    journal = tmp_path / WORLD_JOURNAL
    journal.write_bytes(journal_file.packed(frames[:before]))
    show = Recorded("growing", tmp_path, expected=True)
    show.poll()
    seen, last = show.version, show.known.last
    with journal.open("ab") as file:
        file.write(journal_file.packed(frames[before : before + 1]))
    show.poll()
    assert show.known.end is not None
    assert show.since(seen) == show.known.end.tick == last
    assert show.setup is not None
    changed = scenes(show.setup, show.known, last)
    assert [event.text for event in changed[0].events if event.kind == "end"] == [
        "The mission ends: localised"
    ]


def test_a_page_that_is_behind_shows_ticks_of_which_it_has_read_all(
    paper_1: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sources, "PORTION_BYTES", 3000)
    monkeypatch.setattr(sources, "LEAST_OF_A_JOURNAL_BYTES", 700)
    show, whole = Recorded("", paper_1), scenes_of(read(paper_1))
    heads: list[int] = []
    show.poll()
    while show.more:
        assert show.live
        if show.head > max([0, *heads]):
            assert show.setup is not None
            assert scenes(show.setup, show.known, show.head, show.head) == whole[show.head : show.head + 1]
            heads.append(show.head)
        show.poll()
    assert len(heads) > 3
    assert show.setup is not None
    assert scenes(show.setup, show.known) == whole


def test_the_process_that_writes_a_journal_is_known_by_its_lock(tmp_path: Path) -> None:
    path, other = tmp_path / "agent-a.journal", tmp_path / "agent-b.journal"
    other.touch()
    with Journal(path):
        assert writers_of([path, other, tmp_path / "none"]) == {path.name: os.getpid()}
    assert writers_of([path]) == {}


def test_every_state_has_its_sentence() -> None:
    assert {*NAMES, "localised", UNCONFIRMED} == {*DOING, *SEEKING}
    robot_setup = of_scenario(load("paper-1")).robot_setup("b")
    for phase in (1, 2, 3):
        for state in (*DOING, *SEEKING):
            sentence = doing(robot_setup, phase, state, None)
            assert sentence.startswith("b ")
            assert "{" not in sentence


def recorded(scenario: Scenario, folder: Path) -> Run:
    in_process.run_mission(scenario, folder)
    return read(folder)


def shown(run: Run) -> dict[int, Configurations]:
    return {scene.tick: scene.configurations[0] for scene in scenes_of(run) if scene.configurations}


@pytest.mark.parametrize("case", series(["paper-1", "random 3", "paper-2", "random 4", "random 7"], 2))
def test_the_shown_value_of_a_last_manoeuvre_is_that_of_its_planner(case: str, tmp_path: Path) -> None:
    name, _, seed = case.partition(" ")
    run = recorded(load(name, seed=int(seed) if seed else None), tmp_path)
    planned = {
        (state.tick, robot): state.plan.separation_m2
        for robot in run.robots
        for state in agent_replay(run, robot).states
        if state.task.name == "last-manoeuvre" and state.plan and state.plan.separation_m2 is not None
    }
    found = {
        (tick, one.manoeuvre.robot): one.manoeuvre
        for tick, one in shown(run).items()
        if one.manoeuvre is not None
    }
    assert found.keys() == planned.keys()
    for key, manoeuvre in found.items():
        assert manoeuvre.separation_m2 == pytest.approx(planned[key], rel=1e-6)
        assert len(manoeuvre.reachable) > 50


def test_the_configurations_of_paper_1_are_four_and_then_one(tmp_path: Path) -> None:
    assert {tick: one.count for tick, one in shown(recorded(load("paper-1"), tmp_path)).items()} == {
        47: 4,
        48: 1,
    }


def test_exact_poses_that_do_not_fit_the_range_are_not_joined(tmp_path: Path) -> None:
    run = recorded(load("paper-1"), tmp_path)
    ticks = run_data(run).ticks
    assert run.setup is not None
    before, now = ticks[46], ticks[47]
    assert [one.count for one in configurations(run.setup, before, now)] == [4]
    b = now.estimates["b"]
    turned = now.estimates | {"b": replace(b, world=b.world[1:] + b.world[:1])}
    assert not list(configurations(run.setup, before, replace(now, estimates=turned)))


def test_thousands_of_poses_are_no_configurations(tmp_path: Path) -> None:
    """Their last manoeuvre would take gigabytes to compare."""
    run = recorded(load("paper-1"), tmp_path)
    ticks = run_data(run).ticks
    assert run.setup is not None
    counts = []
    for times in (15, 10_000):
        held = {robot: replace(one, world=one.world * times) for robot, one in ticks[47].estimates.items()}
        now = replace(ticks[47], estimates=held)
        counts.append([one.count for one in configurations(run.setup, ticks[46], now)])
    assert counts == [[60], []]


def test_a_late_robot_begins_its_last_manoeuvre_once(tmp_path: Path) -> None:
    run = recorded(load("paper-1"), tmp_path)
    ticks = run_data(run).ticks
    assert run.setup is not None
    stands = {robot: replace(one, tick=48, executed=REST) for robot, one in ticks[47].observations.items()}
    late = replace(ticks[47], tick=48, observations=stands)
    again = replace(late, observations=ticks[48].observations)
    begun = [
        [one.manoeuvre is not None for one in configurations(run.setup, before, now)]
        for before, now in ((ticks[46], ticks[47]), (ticks[47], late), (ticks[47], again))
    ]
    assert begun == [[True], [False], [True]]


@pytest.mark.long
def test_under_noise_configurations_have_no_last_manoeuvre(tmp_path: Path) -> None:
    found = shown(recorded(load("noisy", seed=8), tmp_path))
    assert max(one.count for one in found.values()) > 1
    assert all(one.manoeuvre is None for one in found.values())


def test_what_only_one_robot_holds_joins_nothing(tmp_path: Path) -> None:
    run = recorded(load("random", seed=3, faults=["loss=0.5, delay=0..3"]), tmp_path)
    held = {
        tick: (len(run.estimates("a")[tick].world), len(run.estimates("b")[tick].world)) for tick in range(58)
    }
    assert held[52] == (2, 0)
    assert held[55] == (2, 2)
    assert held[56] == (2, 1)
    assert {tick: one.count for tick, one in shown(run).items()} == {54: 2, 55: 2, 57: 1}


@pytest.mark.long
def test_an_attacker_and_its_victim_hold_no_configurations_in_common(tmp_path: Path) -> None:
    text = (
        shipped()["random"].read_text().replace("[mission]\n", "[mission]\nnoise = {mutual_sigma = 0.05}\n")
    )
    scenario = parse(text, "random", seed=2)
    attacks = {"a": Attack("scale", 0.9)}
    robots = tuple([replace(one, attack=attacks.get(one.id)) for one in scenario.robots])
    run = recorded(replace(scenario, robots=robots, max_ticks=100), tmp_path)
    held = [[tick for tick, one in enumerate(run.estimates(robot)) if one.world] for robot in run.robots]
    assert min(len(ticks) for ticks in held) > 5
    assert not shown(run)
