"""Fault plans: their tables and lines, and their effect on missions, the same in all modes of execution."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import pytest
from msgspec.structs import replace

from compose.errors import BadScenario
from compose.launch import in_process
from compose.recording.run import Run
from compose.recording.summary_json import summary
from compose.scenario.scenario_file import load, parse
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
from tests.commands import PAPER_1, SECTION_IV, journals, refused, several_pairs, tandem
from tests.missions import outcome
from tests.series import series
from tests.surveys import scenario_of
from tests.test_bad_input import refused_scenario, refused_text
from world.faults import Fault, LinkSelector

ROUGH = """
[[fault]]
link = "a->b"
loss = 0.3
burst_start = 0.2
burst_end = 0.25
burst_loss = 0.9
delay = [0, 3]
ticks = [5, 500]
[[fault]]
delay = 2
duplicate = 0.3
reorder = 0.2
corrupt = 0.1
reports_per_tick = 0.75
contact_ticks = [2, 100]
[[fault]]
link = "a<->b"
partition = true
contact_ticks = [4, 9]
"""
ROUGH_OPTIONS = [
    "a->b: loss=0.3, burst_start=0.2, burst_end=0.25, burst_loss=0.9, delay=0..3, ticks=5..500",
    "delay=2, duplicate=0.3, reorder=0.2, corrupt=0.1, reports_per_tick=.75, contact_ticks=2..100",
    "a <-> b: partition, contact_ticks=4..9",
]
RANDOM = PAPER_1.replace("start", "# start").replace('"paper"', '"assured"')
"""A scenario with random starts."""


def test_a_file_and_the_command_line_give_the_same_faults(tmp_path: Path) -> None:
    written, said = parse(RANDOM + ROUGH, "mine.toml"), parse(RANDOM, "mine.toml", faults=ROUGH_OPTIONS)
    assert written == said
    assert written.faults == (
        Fault(
            LinkSelector("a", "b", both=False),
            loss=0.3,
            burst_start=0.2,
            burst_end=0.25,
            burst_loss=0.9,
            delay=(0, 3),
            ticks=(5, 500),
        ),
        Fault(
            delay=(2, 2),
            duplicate=0.3,
            reorder=0.2,
            corrupt=0.1,
            reports_per_tick=0.75,
            contact_ticks=(2, 100),
        ),
        Fault(LinkSelector("a", "b", both=True), partition=True, contact_ticks=(4, 9)),
    )
    (tmp_path / "rough.toml").write_text(RANDOM + ROUGH)
    (tmp_path / "plain.toml").write_text(RANDOM)
    more = [word for fault in ROUGH_OPTIONS for word in ("--fault", fault)]
    tandem("run", "rough.toml", "--in-process", "--out", "rough", cwd=tmp_path)
    tandem("run", "plain.toml", "--in-process", "--out", "plain", *more, cwd=tmp_path)
    assert journals(tmp_path / "rough") == journals(tmp_path / "plain") != {}


@pytest.mark.parametrize("said", ["partition", "partition=true"])
def test_a_partition_may_be_written_with_or_without_true(said: str) -> None:
    assert parse(RANDOM, "mine.toml", faults=[said]).faults == (Fault(partition=True),)
    assert parse(RANDOM, "mine.toml", faults=["partition=false"]).faults == (Fault(),)


def test_the_command_lines_faults_come_after_those_of_the_file() -> None:
    found = parse(RANDOM + "[[fault]]\nloss = 0.1\n", "mine.toml", faults=["loss=0.2", "b->a: loss=0.3"])
    assert [fault.loss for fault in found.faults] == [0.1, 0.2, 0.3]


def test_another_seed_draws_other_deliveries_of_the_same_plan() -> None:
    one, other = (parse(RANDOM, "mine.toml", seed=seed, faults=["loss=0.5"]) for seed in (1, 2))
    assert one.faults == other.faults
    assert (one.seed, other.seed) == (1, 2)


BAD_FIELDS: dict[str, Sequence[str]] = {
    "loss": ("-0.1", "1.1", "nan", '"0.1"', "true", "[0.1]"),
    "burst_start": ("-0.1", "1.1", '"often"', "false"),
    "burst_end": ("-0.1", "1.1", '"soon"'),
    "burst_loss": ("-0.1", "1.1", "[]"),
    "partition": ("1", '"yes"', "0.0"),
    "delay": ("-1", "51", "1.5", '"long"', "true", "[1]", "[1, 2, 3]"),
    "duplicate": ("-0.1", "2", '"twice"'),
    "reorder": ("-0.1", "2", "{}"),
    "corrupt": ("-0.1", "2", "inf"),
    "reports_per_tick": ("0", "-1.0", "1e4", "nan", '"few"'),
    "ticks": ("5", "[5]", "[1, 2, 3]", '"5..9"'),
    "contact_ticks": ("5", "[5]", "[1, 2, 3]", "{}"),
    "link": ("1", '["a", "b"]', "true"),
}


@pytest.mark.parametrize(
    ("field", "value"), [(field, value) for field, values in BAD_FIELDS.items() for value in values]
)
def test_a_field_that_cannot_be_is_named_with_its_place(field: str, value: str) -> None:
    refused_text(RANDOM + f"[[fault]]\nloss = 0.1\n[[fault]]\n{field} = {value}\n", f"fault[1].{field}: ")


BAD_TABLES = [
    ("los = 0.1", "fault[0]: unknown field 'los'; did you mean 'loss'?"),
    ("delay = [0, 51]", "fault[0].delay[1]: "),
    ("delay = [1.5, 2]", "fault[0].delay[0]: "),
    ("ticks = [-1, 5]", "fault[0].ticks[0]: "),
    ("contact_ticks = [0, 1.5]", "fault[0].contact_ticks[1]: "),
    ("delay = [5, 2]", "fault[0].delay: the lower bound 5 is above the upper bound 2"),
    ("ticks = [5, 2]", "fault[0].ticks: the lower bound 5 is above the upper bound 2"),
    ("contact_ticks = [5, 2]", "fault[0].contact_ticks: the lower bound 5 is above the upper bound 2"),
    ("burst_start = 0.1\nburst_end = 0.0", "fault[0].burst_end: must be above 0"),
    ('link = "a-b"', "fault[0].link: 'a-b' is not a link; expected a->b, a<->b or *"),
    ('link = ""', "fault[0].link: '' is not a link"),
    ('link = "a->c"', "fault[0].link: 'a' and 'c' are not a pair of the scenario"),
    ('link = "a->a"', "fault[0].link: 'a' and 'a' are not a pair of the scenario"),
    ("delay = 30\n[[fault]]\ndelay = 21", "fault[1].delay: up to 51 ticks in total"),
    ("loss = 0.1\n" + "[[fault]]\n" * 8, "fault[8].link: more than 8 faults from 'a' to 'b'"),
    ("partition = true\nticks = [0, 1000000000]", "fault: the delivery of reports could take "),
]


@pytest.mark.parametrize(("table", "says"), BAD_TABLES)
def test_a_table_that_cannot_be_is_named_with_its_place(table: str, says: str) -> None:
    refused_text(RANDOM + f"[[fault]]\n{table}\n", says)


def test_faults_are_a_list_of_tables() -> None:
    refused_text(RANDOM + "[fault]\nloss = 0.1\n", "fault: ")
    refused_text("fault = 0.1\n" + RANDOM, "fault: ")
    refused_text("fault = [0.1]\n" + RANDOM, "fault[0]: ")


def test_a_link_of_another_pair_takes_nothing_of_this_ones_room() -> None:
    text = several_pairs(2) + '[[fault]]\nlink = "a->b"\ndelay = 50\n'
    plan = parse(text, "mine.toml", faults=["b->a: delay=50", "c<->d: delay=50"]).faults
    assert [fault.delay for fault in plan] == [(50, 50)] * 3
    with pytest.raises(BadScenario, match="--fault 'delay=1': delay: up to 51 ticks"):
        parse(text, "mine.toml", faults=["delay=1"])
    with pytest.raises(BadScenario, match="'a' and 'c' are not a pair"):
        parse(text, "mine.toml", faults=["a->c: delay=1"])


INVALID_FAULTS = [
    ("", "'' has an empty entry; expected the form a->b: loss=0.3, delay=0..3"),
    ("a->b:", "has an empty entry"),
    ("loss=0.1,", "has an empty entry"),
    ("loss", "loss: expected a number, got true or false"),
    ("loss=2", "loss: expected a number <= 1.0"),
    ("loss=-1", "loss: expected a number >= 0.0"),
    ("loss=true", "loss: expected a number, got true or false"),
    ("loss=nan", "loss: 'nan' is neither a number nor a range"),
    ("loss=0..1", "loss: expected a number, got a list"),
    ("loss=0.1; delay=3", "loss: '0.1; delay=3' is neither a number nor a range"),
    ("loss=0.1, loss=0.2", "loss: given twice"),
    ("a->b: link=1", "link: given twice"),
    ("los=0.1", "unknown field 'los'; did you mean 'loss'?"),
    ("los=0.1", "; did you mean 'loss'?"),
    ("two\nlines=0.1", "unknown field 'two"),
    ("delay=1..2..3", "delay: '1..2..3' is neither a number nor a range"),
    ("delay=5..2", "delay: the lower bound 5 is above the upper bound 2"),
    ("delay=0..51", "delay[1]: expected a whole number <= 50"),
    ("ticks=0..1.5", "ticks[1]: expected a whole number, got a number"),
    ("partition=yes", "partition: 'yes' is neither a number nor a range"),
    ("a-b: loss=1", "link: 'a-b' is not a link; expected a->b, a<->b or *"),
    ("a->b: b->a: loss=1", "link: 'a->b: b->a' is not a link"),
    ("a->c: loss=1", "link: 'a' and 'c' are not a pair of the scenario"),
    ("burst_start=0.1, burst_end=0", "burst_end: must be above 0"),
]


@pytest.mark.parametrize(("said", "says"), INVALID_FAULTS)
def test_an_invalid_fault_is_quoted_with_its_error(said: str, says: str) -> None:
    with pytest.raises(BadScenario) as bad:
        parse(RANDOM, "mine.toml", faults=["loss=0.1", said])
    assert str(bad.value).startswith(f"--fault '{said}': ")
    assert says in str(bad.value)


def test_a_mistake_about_faults_is_one_line_and_status_2(tmp_path: Path) -> None:
    refused(tandem("run", "random", "--fault", "a->b: loss=2"), "--fault 'a->b: loss=2': loss: ")
    refused(tandem("run", "random", "--fault", "two\nlines=1"), "unknown field 'two")
    refused(tandem("run", "random", "--fault", "a->b loss=1"), "'a->b loss' has no colon after its link")
    listen = ("--listen", "tcp/127.0.0.1:7447")
    refused(tandem("world", "random", *listen, "--fault", "x->y: loss=1"), "'x' and 'y' are not a pair")
    refused_scenario(RANDOM + "[[fault]]\ndelay = [5, 2]\n", tmp_path, "fault[0].delay: the lower bound 5")


def test_the_sections_of_a_scenario_are_all_that_a_plan_needs() -> None:
    """A scenario of two robots and a fault needs no further settings."""
    text = f'name = "x"\n{SECTION_IV}' + "".join(
        f'[[robot]]\nid = "{robot}"\nanchor = [{x}, 0.0]\n' for robot, x in (("a", 0.0), ("b", 10.0))
    )
    assert parse(text + "[[fault]]\n", "x").faults == (Fault(),)


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
    assert outcome(recording) == "undecided"
    told = summary(recording, "in-process", None)["robots"]
    assert all(robot["reports_heard"] == 0 and not robot["localised"] for robot in told.values())
    assert all(robot["reports_lost"] == robot["reports_sent"] > 200 for robot in told.values())


def test_neither_robot_claims_if_the_reports_of_one_are_all_lost() -> None:
    scenario = load("random", faults=["a->b: partition"])
    recording = in_process.run_mission(replace(scenario, max_ticks=300))
    assert outcome(recording) == "undecided"
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
