"""Fault plans: their effect on missions, which is the same in all modes of execution."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from msgspec.structs import replace

from compose.launch import in_process
from compose.recording.run import Run
from compose.recording.summary_json import summary
from compose.scenario.scenario_file import load
from protocol.journal import journal_file
from protocol.messages import (
    Command,
    Environment,
    Estimate,
    FinalReport,
    MissionEnd,
    Observation,
    Report,
    RobotConfig,
)
from protocol.wire import decode
from tests.commands import journals, several_pairs, tandem
from tests.series import series
from tests.surveys import scenario_of
from tests.test_fault_tables import RANDOM, ROUGH

PLANS: dict[str, list[str]] = {
    "loss": ["loss=0.9"],
    "loss one way": ["a->b: loss=0.95"],
    "loss the other way": ["b->a: loss=0.95"],
    "bursts": ["burst_start=0.2, burst_end=0.05"],
    "a delay": ["delay=10"],
    "delays": ["delay=0..20"],
    "reordering": ["reorder=0.5, delay=0..1"],
    "duplication": ["duplicate=1, delay=0..3"],
    "damage": ["corrupt=0.9"],
    "little bandwidth": ["reports_per_tick=0.1"],
    "a partition at first": ["partition, contact_ticks=0..40"],
    "a partition in the middle": ["partition, contact_ticks=2..40"],
    "a partition one way": ["b->a: partition, contact_ticks=1..40"],
    "all together": [
        "burst_start=0.2, burst_end=0.05, delay=0..20",
        "duplicate=0.3, reorder=0.3, corrupt=0.1",
        "a->b: reports_per_tick=0.5",
        "b->a: partition, contact_ticks=5..15",
    ],
}
NOISE = "anchor_sigma = 0.1\nmutual_sigma = 0.1\nactuation = {v = 0.001}\nodometry = {omega = 0.001}"


def localises(recording: Run) -> bool:
    """Return whether all robots have claimed correct poses."""
    assert recording.end is not None
    return recording.end.outcome == "localised"


# --- the effect on missions ---------------------------------------------------------------------------


@pytest.mark.parametrize("seed", series([1, 2, 3, 4]))
@pytest.mark.parametrize("plan", PLANS)
def test_a_mission_localises_under_every_fault_of_its_reports(plan: str, seed: int) -> None:
    assert localises(in_process.run_mission(load("random", seed=seed, faults=PLANS[plan])))


@pytest.mark.parametrize("seed", series([1, 2]))
@pytest.mark.parametrize(
    "plan", series(["all together", "loss", "bursts", "delays", "damage", "a partition in the middle"])
)
def test_a_mission_with_noise_localises_under_faults(plan: str, seed: int) -> None:
    quiet = scenario_of(NOISE, seed)
    faults = load("random", faults=PLANS[plan]).faults
    assert localises(in_process.run_mission(replace(quiet, faults=faults, max_ticks=3000)))


def test_lost_reports_cost_ticks() -> None:
    ticks = []
    for faults in ([], PLANS["loss"], ["loss=0.98"]):
        found = [in_process.run_mission(load("random", seed=seed, faults=faults)).end for seed in range(8)]
        ticks.append(sum([end.tick for end in found if end is not None]))
    assert ticks[0] < ticks[1] < ticks[2]


@pytest.mark.parametrize("way", ["a->b", "b->a", "a<->b"])
@pytest.mark.parametrize("begin", [0, 2])
def test_a_partition_costs_its_duration_because_robots_wait_for_reports(begin: int, way: str) -> None:
    cut = 30
    for seed in range(1, 9):
        whole, parted = (
            in_process.run_mission(load("random", seed=seed, faults=faults))
            for faults in ([], [f"{way}: partition, contact_ticks={begin}..{begin + cut}"])
        )
        assert localises(parted)
        assert parted.ticks[-1].truth.tick == whole.ticks[-1].truth.tick + cut


@pytest.mark.parametrize("delay", [1, 7, 20])
def test_a_delay_costs_three_times_what_it_lasts(delay: int) -> None:
    """The robots wait for a Report before they can meet, before the last manoeuvre and before the claim."""
    for seed in range(1, 9):
        prompt, late = (
            in_process.run_mission(load("random", seed=seed, faults=faults))
            for faults in ([], [f"delay={delay}"])
        )
        assert localises(late)
        assert late.ticks[-1].truth.tick == prompt.ticks[-1].truth.tick + 3 * delay


def test_a_robot_without_acknowledgement_stands_still_under_noise() -> None:
    quiet = scenario_of(NOISE, 1)
    recording = in_process.run_mission(
        replace(quiet, faults=load("random", faults=["delay=6"]).faults, max_ticks=3000)
    )
    assert localises(recording)
    commands = [moment.commands[robot] for moment in recording.ticks for robot in "ab"]
    listening = [command for command in commands if command.task == "listening"]
    assert len(listening) > 20
    assert all((command.phase, command.v, command.omega) == (3, 0.0, 0.0) for command in listening)


def test_two_robots_that_receive_no_reports_claim_nothing() -> None:
    scenario = load("random", faults=["partition"])
    recording = in_process.run_mission(replace(scenario, max_ticks=300))
    assert recording.end is not None
    assert recording.end.outcome == "undecided"
    told = summary(recording, "in-process", None)["robots"]
    assert all(robot["reports_heard"] == 0 and not robot["localised"] for robot in told.values())
    assert all(robot["reports_lost"] == robot["reports_sent"] > 200 for robot in told.values())


def test_neither_robot_claims_if_the_reports_of_one_are_all_lost() -> None:
    scenario = load("random", faults=["a->b: partition"])
    recording = in_process.run_mission(replace(scenario, max_ticks=300))
    assert recording.end is not None
    assert recording.end.outcome == "undecided"
    assert recording.final_reports["a"].reports_lost == 0 < recording.final_reports["a"].reports_heard
    assert recording.final_reports["b"].reports_heard == 0 < recording.final_reports["b"].reports_lost


@pytest.mark.parametrize("plan", ["a delay", "all together", "duplication", "damage"])
def test_received_refused_and_lost_reports_add_up_to_those_sent(plan: str, tmp_path: Path) -> None:
    recording = in_process.run_mission(load("random", seed=3, faults=PLANS[plan]), tmp_path)
    for robot, peer in (("a", "b"), ("b", "a")):
        contacts = [
            (observation.tick, contact)
            for observation in observations(tmp_path, robot)
            for contact in observation.contacts
        ]
        came = {tick for _, contact in contacts for tick in (*(contact.heard or ()), *contact.damaged)}
        said, peers = recording.final_reports[robot], recording.final_reports[peer]
        assert peers.reports_sent == said.reports_sent == len(contacts) > 0
        assert said.reports_heard == sum([len(contact.heard or ()) for _, contact in contacts])
        assert said.reports_refused == sum([len(contact.damaged) for _, contact in contacts])
        links = recording.ticks[-1].world.links or {}
        flying = {one.tick for one in links[("ba".index(robot), "ab".index(robot))].flying}
        assert said.reports_lost == len({tick for tick, _ in contacts} - came - flying)
        if plan in {"a delay", "damage"}:  # no Report is received twice
            ended = said.reports_heard + said.reports_refused + said.reports_lost
            assert ended + len(flying) == peers.reports_sent


def observations(folder: Path, robot: str) -> Iterator[Observation]:
    """Yield the Observations in the journal of `robot`."""
    for frame in frames(folder, f"agent-{robot}.journal"):
        message = decode(
            frame,
            Environment | RobotConfig | Observation | Report | Command | Estimate | MissionEnd | FinalReport,
        )
        if isinstance(message, Observation):
            yield message


def frames(folder: Path, name: str) -> list[bytes]:
    return list(journal_file.read(folder / name))


# --- the same effect in all modes ---------------------------------------------------------------------


class Played(NamedTuple):
    """The recordings of a mission with separate processes, and in one process."""

    processes: Path
    in_one: Path


@pytest.fixture(
    scope="module",
    params=series(
        [
            (RANDOM + ROUGH, []),
            (several_pairs(2), ["loss=0.3, reorder=0.5", "c<->d: delay=1..4, corrupt=0.3"]),
            (RANDOM, PLANS["all together"]),
            (RANDOM.replace("[planner]", f"[mission.noise]\n{NOISE}\n[planner]"), PLANS["bursts"]),
        ],
        2,
    ),
    ids=["of a file", "two pairs", "all together", "noise"],
)
def both(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Played:
    text, faults = request.param
    folder = tmp_path_factory.mktemp("both")
    (folder / "mine.toml").write_text(text)
    said = [word for fault in faults for word in ("--fault", fault)]
    for out, mode in (("processes", []), ("inline", ["--in-process"])):
        ended = tandem("run", "mine.toml", "-q", "--seed", "4", "--out", out, *said, *mode, cwd=folder)
        assert ended.status == 0, ended
    return Played(folder / "processes", folder / "inline")


def test_the_journals_are_the_same_bytes(both: Played) -> None:
    assert journals(both.processes) == journals(both.in_one)


@pytest.mark.parametrize("base", ["random", "paper-1", "noise"])
def test_a_fault_plan_without_effect_gives_the_same_bytes_as_none(base: str, tmp_path: Path) -> None:
    scenario = scenario_of(NOISE, 1) if base == "noise" else load(base)
    nothing = load("random", faults=["loss=0", "a->b: delay=0..0, duplicate=0", "partition, ticks=7..7"])
    for folder, faults in (("without", ()), ("with", nothing.faults)):
        (tmp_path / folder).mkdir()
        in_process.run_mission(replace(scenario, faults=faults), tmp_path / folder)
    without, with_it = journals(tmp_path / "without"), journals(tmp_path / "with")
    for robot in "ab":
        assert without[f"agent-{robot}.journal"] == with_it[f"agent-{robot}.journal"]
    assert frames(tmp_path / "without", "world.journal")[2:] == frames(tmp_path / "with", "world.journal")[2:]
