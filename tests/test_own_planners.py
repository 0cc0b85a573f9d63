"""A planner of a user runs in all modes, is replayed and audited, and is loaded only if its user names it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any

import msgspec
import pytest
import tomli_w
from msgspec.structs import replace

import tandem
from agent.planning.planner import malformed, report_of
from agent.process.report_buffer import ReportBuffer
from compose.audit.planner_checks import QuietInbox, check_planner
from compose.audit.rules import audit_run
from compose.errors import BadScenario, PlannerFailed, UserError
from compose.launch import class_loader
from compose.launch.in_process import run_mission
from compose.launch.planner_guard import GuardedPlanner
from compose.launch.planner_loader import planner_of
from compose.launch.processes import free_endpoint
from compose.recording.run import read
from compose.scenario.scenario_file import ScenarioTemplate, load, setting, validate
from compose.terminal.finding import WRONG
from protocol.messages import MAX_BODY_BYTES, Inconsistent, Localised, Observation, Report, Undecided
from protocol.motion import ORIGIN, Covariance, Pose
from protocol.network import keys
from protocol.network.inbox import Arrival
from protocol.wire import MAX_REPORT_BYTES, encode
from tandem.planning import Assured, Paper, RobotState
from tests.commands import PAPER_1, TandemProcess, journals
from tests.commands import tandem as command
from tests.groups import group_of, table_of
from tests.own_planners import Counting, Parcel, Wrapping
from tests.series import series
from world.scenario import Scenario

OWN = "tests.own_planners:Wrapping"
FAULTS = "loss=0.2, delay=0..2, duplicate=0.1, reorder=0.1, corrupt=0.05"
OPTIONS = ("--planner", OWN, "--planner-option", "note=a b", "--planner-option", "weight=2")


def own(name: str, scenario: str = "paper-1", **options: Any) -> ScenarioTemplate:
    """Return a scenario with a planner of `own_planners`."""
    return setting(scenario, (), f"tests.own_planners:{name}", [*options.items()])


def first_state() -> RobotState:
    """Return the state of a robot that has been observed once."""
    return Assured().observe(Assured().start(load("paper-1").config("a")), Observation(0, "a", None, 1.0))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recording of a mission in one process, with options and faults."""
    out = tmp_path_factory.mktemp("own") / "out"
    ended = command("run", "paper-1", *OPTIONS, "--fault", FAULTS, "--in-process", "--out", out)
    assert ended.status == 0, ended
    return out


# --- all modes ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kills", series([(), ("--kill", "a@11:report", "--kill", "b@8", "--kill", "world@9")])
)
def test_processes_and_killed_processes_write_the_same_journals(
    recording: Path, kills: tuple[str, ...], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    ended = command("run", "paper-1", *OPTIONS, "--fault", FAULTS, *kills, "--out", out)
    assert ended.status == 0, ended
    assert ended.err.count("is restarted") == len(kills) // 2
    assert journals(out) == journals(recording)


def test_a_recording_is_audited_and_replayed_if_its_planner_is_named(recording: Path) -> None:
    for name in ("audit", "replay"):
        ended = command(name, recording, "--planner", OWN)
        assert ended.status == 0, ended
        refused = command(name, recording)
        assert refused.status == 2
        assert refused.err == f"tandem {name}: the planner is {OWN}; to run its code, add --planner {OWN}\n"


def test_reports_and_options_are_in_the_recording(recording: Path) -> None:
    run = read(recording)
    agent = run.agents["a"]
    assert agent.config.planner_options == {"note": "a b", "weight": 2}
    bodies = [framed.report for step in agent.steps for framed in step.received]
    assert bodies
    body = bodies[-1].body
    assert body is not None
    parcel = msgspec.msgpack.decode(body, type=Parcel)
    assert parcel.double == 2 * parcel.log.tick
    assert run.final_reports["a"].blocking_reason == "a b"
    assert run.final_reports["a"].reports_heard == len(bodies)


@pytest.mark.long
def test_figures_and_exports_need_no_code_of_the_planner(recording: Path) -> None:
    ended = command("figures", recording, "--format", "svg")
    assert ended.status == 0, ended
    assert f"no plan-a-b: the states of the planner {OWN} cannot be drawn" in ended.err
    assert (recording / "figures" / "trajectory-a-b.svg").exists()
    assert command("export", recording).status == 0


def test_a_sweep_runs_and_audits_it_beside_a_shipped_planner() -> None:
    results = tandem.sweep("paper-1", {"planner.name": [Wrapping, "assured"]}, trials=2, workers=1)
    assert list(results.trials["outcome"]) == ["localised"] * 4
    assert list(results.trials["violations"]) == [0] * 4
    assert results.trials["ticks"][0] == results.trials["ticks"][2]


def test_the_python_api_takes_a_class_and_its_options() -> None:
    run = tandem.run("paper-1", planner=Wrapping, planner_options={"note": "n"})
    assert run.outcome == "localised"
    assert run.audit().violations == ()
    assert run.summary["parameters"]["planner"] == OWN
    again = tandem.Scenario.load("paper-1").with_planner(OWN, weight=3)
    assert again.template.scenario.planner_options == {"weight": 3}
    with pytest.raises(UserError, match="planner_options: they need planner"):
        tandem.run("paper-1", planner_options={"note": "n"})
    with pytest.raises(UserError, match="not at the top level of a module"):
        tandem.run("paper-1", planner=type("X", (Paper,), {"__qualname__": "f.<locals>.X"}))


def test_a_planner_for_teams_needs_no_more_than_the_contract() -> None:
    run = tandem.run("room", planner=Counting)
    assert run.audit().violations == ()
    assert (run.outcome, run.reason) == ("undecided", "a: 12 ranges counted; b is not localised either")
    with pytest.raises(UserError, match=r"planner.name: robots with the planner tests.own_planners:Sound"):
        tandem.run("room", planner="tests.own_planners:Sound")


def test_opening_a_recording_loads_no_code(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(class_loader, "_trusted", set())
    with pytest.raises(UserError, match="to run its code"):
        tandem.open(recording).audit()
    assert tandem.open(recording, planner=Wrapping).audit().violations == ()


# --- who decides which code runs ----------------------------------------------------------------------


def test_an_agent_runs_only_planners_that_its_command_line_names(tmp_path: Path) -> None:
    """The module is not even imported: importing it would leave a file."""
    (tmp_path / "hostile.py").write_text(
        "from pathlib import Path\nfrom tests.own_planners import Wrapping\n"
        "(Path(__file__).parent / 'imported').touch()\n"
    )
    scenario = tmp_path / "scenario.toml"
    scenario.write_text(PAPER_1.replace('"paper"', '"hostile:Wrapping"'))
    endpoint = free_endpoint()
    with TandemProcess("world", scenario, "--listen", endpoint, cwd=tmp_path):
        agent = command("agent", "a", "--connect", endpoint, cwd=tmp_path)
        (tmp_path / "imported").unlink()  # by the world, whose user has named it
        agent = command("agent", "a", "--connect", endpoint, "--planner", "other:Planner", cwd=tmp_path)
        assert not (tmp_path / "imported").exists()
    assert agent.status == 2
    assert agent.err.count("\n") == 1
    assert "uses the planner 'hostile:Wrapping', which this command does not name" in agent.err
    assert "add --planner hostile:Wrapping" in agent.err


@pytest.mark.long
def test_a_planner_of_an_installed_package_has_a_name(tmp_path: Path) -> None:
    (tmp_path / "gleaner.py").write_text("from tests.own_planners import Wrapping as Gleaner\n")
    info = tmp_path / "gleaner-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: gleaner\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[tandem.planners]\nglean = gleaner:Gleaner\n")
    root = str(Path(__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{root}"}

    def ran(*words: str | Path) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "tandem", *map(str, words)],
            capture_output=True,
            text=True,
            check=False,
            env=environment,
            cwd=tmp_path,
            timeout=120,
        )

    out = tmp_path / "out"
    ended = ran("run", "paper-1", "--planner", "glean", "--no-export", "--kill", "a@9", "--out", out)
    assert ended.returncode == 0, ended
    refused = ran("audit", out)
    assert refused.returncode == 2
    assert refused.stderr == "tandem audit: the planner is glean; to run its code, add --planner glean\n"
    assert ran("audit", out, "--planner", "glean").returncode == 0
    wrong = ran("run", "paper-1", "--planner", "glaen", "--in-process")
    assert wrong.returncode == 2
    assert "there is no 'glaen'; there are assured, paper, glean, fisher, greedy, random; " in wrong.stderr
    assert "did you mean 'glean'?" in wrong.stderr
    assert "glean" in ran("scenarios", "--schema", "scenario").stdout


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("nowhere:Planner", "planner.name: nowhere:Planner: there is no module 'nowhere'"),
        ("tests.own_planners:Nobody", "there is no 'Nobody' in tests.own_planners"),
        ("tests.own_planners:Local", "is not a planner: not a subclass of tandem.planning.Planner"),
        ("tests.own_planners:Incomplete", "is not a planner: it does not define start, observe, decide"),
        (
            "tests.own_planners:Suited",
            "suited() was removed in version 0.3: a planner asks config.mission.noise",
        ),
        ("own planner", "invalid name"),
        ("asured", "there is no 'asured'; there are assured, paper"),
    ],
)
def test_a_name_that_is_no_planner_is_one_line(name: str, says: str) -> None:
    with pytest.raises(BadScenario, match=re.escape(says)):
        setting("paper-1", (), name)


@pytest.mark.parametrize("name", ["AssuredExact", "AccuracySeeking"])
def test_a_removed_class_names_the_one_that_replaces_it(name: str) -> None:
    says = f"tandem.planning.{name} was removed in version 0.3: subclass Assured"
    with pytest.raises(ImportError, match=says):
        getattr(tandem.planning, name)
    assert not hasattr(tandem.planning, "AssuredNothing")


def test_options_are_checked_before_the_mission() -> None:
    with pytest.raises(BadScenario, match=r"planner\.options: .* ValueError: weight -1 is negative"):
        own("Wrapping", weight=-1)
    with pytest.raises(BadScenario, match=r"planner\.options: .* unexpected keyword argument 'wieght'"):
        own("Wrapping", wieght=1)
    with pytest.raises(BadScenario, match=r"planner\.options: the planner 'paper' has none"):
        setting("paper-1", (), None, [("weight", 1)])


# --- mistakes -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [("--in-process",), ()])
def test_a_planner_that_raises_an_error_is_one_line(mode: tuple[str, ...]) -> None:
    ended = command("run", "paper-1", "--planner", "tests.own_planners:Failing", "-q", *mode)
    assert ended.status == 3
    assert "the planner tests.own_planners:Failing: observe() at tick 7 raises KeyError: 'seven'" in ended.err
    assert "own_planners.py:" in ended.err
    assert "Traceback" not in ended.err


BROKEN = {
    "Drawing": ("two runs", "the first difference is in tick 1: b's command"),
    "Clock": ("two runs", "the first difference is in tick 0: a's command"),
    "Remembers": ("equal arguments", "another answer when it is called again"),
    "Idle": ("equal arguments", "command() of a new object of the class raises AttributeError"),
    "Mutable": ("equal arguments", "observe() changes the state"),
    "Unpicklable": ("equal arguments", "its state cannot be pickled"),
    "Fast": ("it completes", "command() at tick 0 returns v = 1.5, expected at most 1"),
    "Stranger": ("it completes", "command() at tick 0 returns the peer nobody, expected b"),
    "NotANumber": (
        "it completes",
        "command() at tick 5: its Command cannot be sent: v: Expected 'float' >= -100000000.0, got nan",
    ),
    "Talkative": ("it completes", "its report has 5"),
    "Undecodable": ("it completes", "its report cannot be sent: its body: Expected `int`"),
    "Gullible": ("no report", "a false report that its decoder takes"),
    "Bragging": ("the audit", "it claims a pose that is"),
    "Fickle": ("a verdict", "a has another verdict at tick 4"),
    "Failing": ("it completes", "raises KeyError"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_check_planner_finds_each_mistake_for_its_own_reason(name: str) -> None:
    check, why = BROKEN[name]
    checks = check_planner(own(name).scenario, QuietInbox("test"))
    wrong = next(one for one in checks if one.mark == WRONG)
    assert wrong.text.startswith(check)
    assert why in wrong.text


@pytest.mark.parametrize("name", series([OWN, "assured", "paper"]))
def test_check_planner_passes_a_sound_planner(name: str) -> None:
    ended = command("check-planner", name, "--mission", "paper-1", "--fault", FAULTS)
    if name == "paper":  # it has no rule for lost reports
        assert ended.out.count("ok  ") == len(ended.out.splitlines())
    assert ended.status == 0, ended
    assert len([*takewhile(str.strip, ended.out.splitlines())]) >= 8
    said = re.compile(r"tandem (agent \w+|world): back, replayed \d+ ticks?, identical")
    assert ended.err
    assert all(said.fullmatch(line) for line in ended.err.splitlines()), ended.err


# --- in groups ----------------------------------------------------------------------------------------


def test_robots_with_a_subclass_of_the_shipped_planner_form_a_group(tmp_path: Path) -> None:
    """A subclass that changes nothing does the same as the planner `assured`, as processes and in one."""
    name, group = "tests.own_planners:Sound", tmp_path / "group.toml"
    group.write_text(tomli_w.dumps(table_of(3, 4)))
    for out, options in (("processes", ("--planner", name)), ("one", ("--planner", name, "--in-process"))):
        ended = command("run", group, *options, "--out", tmp_path / out)
        assert ended.status == 0, ended
    assert journals(tmp_path / "processes") == journals(tmp_path / "one")
    assert command("audit", tmp_path / "one", "--planner", name).status == 0
    refused = command("audit", tmp_path / "one")
    assert (refused.status, refused.out) == (2, "")
    assert refused.err == f"tandem audit: the planner is {name}; to run its code, add --planner {name}\n"
    run, shipped = read(tmp_path / "one"), run_mission(group_of(3, 4))
    assert len(run.robots) == 3
    for robot in run.robots:
        assert run.claim(robot) is not None
        assert run.claim(robot) == shipped.claim(robot)


def test_robots_with_another_planner_cannot_form_a_group() -> None:
    table = table_of(3, 4)
    table["planner"] = {"name": OWN}
    class_loader.trust(OWN)
    with pytest.raises(UserError, match=f"planner.name: robots with the planner {OWN} meet in pairs"):
        validate(table, "group.toml")


BELIEVING = "docs.examples.group_planner:Believing"
"""A planner that is no subclass of a shipped one, and defines `meet`."""


def believing(robots: int, seed: int, **fields: Any) -> Scenario:
    """Return a group with the planner BELIEVING."""
    table = table_of(robots, seed) | fields
    table["planner"] = {"name": BELIEVING}
    class_loader.trust(BELIEVING)
    return validate(table, "group.toml").seeded(None)


@pytest.mark.parametrize("seed", series((1, 2, 3, 4)))
def test_robots_with_any_planner_that_begins_another_meeting_form_a_group(seed: int, tmp_path: Path) -> None:
    run_mission(believing(5, seed), tmp_path)
    run = read(tmp_path)
    assert all(run.claim(robot) is not None for robot in run.robots)
    assert audit_run(run).violations == ()


def test_such_a_group_is_localised_though_reports_are_lost_and_late() -> None:
    fault = {"loss": 0.3, "delay": 5, "duplicate": 0.1}
    run = run_mission(believing(4, 1, fault=[fault]))
    assert all(run.claim(robot) is not None for robot in run.robots)


@pytest.mark.long
def test_such_a_group_of_processes_that_are_killed_decides_the_same() -> None:
    checks = list(check_planner(believing(4, 1), QuietInbox("test")))
    assert [one for one in checks if one.mark == WRONG] == []


@pytest.mark.parametrize(
    ("sigma", "change", "says"),
    [
        (0.05, lambda table: table["mission"].update(tolerates=1), "confirm no poses"),
        (0.0, lambda table: table["robot"].append({"id": "u"}), "do not search for others"),
    ],
    ids=["poses that others confirm", "a robot without an anchor"],
)
def test_such_a_planner_helps_nobody_and_that_is_one_line(
    sigma: float, change: Callable[[dict[str, Any]], None], says: str
) -> None:
    table = table_of(5, 1, sigma=sigma)
    table["mission"]["area"] = [0.0, 0.0, 60.0, 60.0]
    table["planner"] = {"name": BELIEVING}
    class_loader.trust(BELIEVING)
    change(table)
    with pytest.raises(UserError, match=says):
        validate(table, "group.toml")


def test_a_group_refuses_a_body_that_its_planner_does_not_take_and_a_log_in_its_place() -> None:
    config = believing(3, 1).config("r0")
    planner = planner_of(config)
    state = planner.observe(planner.start(config), Observation(0, "r0", None, 1.0))
    good = planner.report_to(state, config.peer)
    assert planner.malformed(good) is None
    assert planner.malformed(replace(good, body=b"\x83")) == "its body: Input data was truncated"
    log = Report(5, "r1", start=ORIGIN)
    assert planner.malformed(log) == "a log, and this robot's planner has reports of its own"


# --- reports ------------------------------------------------------------------------------------------


def test_a_report_that_its_decoder_refuses_is_refused_on_arrival() -> None:
    planner = planner_of(own("Wrapping").scenario.config("a"))
    state = first_state()
    good = report_of(Wrapping().report(state), 0, "a")
    assert malformed(good, planner) is None
    assert malformed(replace(good, body=b"\x93"), planner) == "its body: Input data was truncated"
    parcel = msgspec.msgpack.encode(Parcel(Assured().report(state), 3))
    assert malformed(replace(good, body=parcel), planner) == "3 is not twice 0"
    assert malformed(Assured().report(state), planner) == (
        "a report without a body, and this robot's planner has reports of its own"
    )
    shipped = planner_of(load("paper-1").config("a"))
    assert malformed(good, shipped) == "a body, and this robot's planner has none"


def test_the_agent_counts_and_drops_a_report_that_the_decoder_refuses() -> None:
    planner, inbox = planner_of(own("Wrapping").scenario.config("a")), QuietInbox("test")
    buffer = ReportBuffer(inbox, (), partial(malformed, planner=planner), real_time=False)
    log = Assured().report(first_state())
    for tick, double in ((0, 0), (1, 3)):
        parcel = Parcel(replace(log, tick=tick, robot="b"), double)
        frame = encode(report_of(parcel, tick, "b"))
        buffer.take(Arrival("report", "key", frame, keys.Key(keys.report, "run", "b")), 1)
    assert inbox.refused["report"] == 1
    assert buffer.of("b", 0) is not None
    assert buffer.of("b", 1) is None


def test_a_decoder_that_fails_refuses_the_report() -> None:
    class Strict(Wrapping):
        def malformed(self, body: Parcel) -> str | None:
            raise ZeroDivisionError(str(body.double))

    planner = GuardedPlanner("x:Strict", Strict())
    body = Wrapping().report(first_state())
    assert (
        malformed(report_of(body, 0, "a"), planner) == "the decoder of x:Strict raises ZeroDivisionError: 0"
    )


@pytest.mark.parametrize(
    "verdict",
    [
        Undecided("\U0001f600" * 300),
        Inconsistent("\U0001f600" * 300, 1e15, 0.5),
        Localised(Pose(1e6, 1e6, 1.0), Covariance(0.1, 0.2, 0.3, 0.4, 0.5, 0.6)),
    ],
)
def test_the_largest_body_fits_a_frame_with_any_verdict(verdict: Any) -> None:
    body = b"x" * (MAX_BODY_BYTES - 3)  # msgpack adds its length
    report = report_of(body, 2**31, "r" * 32, 2**31, verdict)
    assert report.body is not None
    assert len(report.body) == MAX_BODY_BYTES
    assert len(encode(report)) <= MAX_REPORT_BYTES


def test_a_planner_that_is_neither_a_class_nor_a_name_is_one_line() -> None:
    with pytest.raises(UserError, match=r"^3: expected a class, or its name$"):
        tandem.run("paper-1", planner=3)  # type: ignore[arg-type]


def test_orbits_that_are_none_are_one_line() -> None:
    with pytest.raises(PlannerFailed, match=r"rendezvous\(\) returns NoneType, expected Rendezvous"):
        own("Rendezvousless")


def test_a_class_of_an_interactive_session_runs_in_one_process_only() -> None:
    code = """
import tandem
from tandem.planning import Paper
class Mine(Paper): pass
print(tandem.run("paper-1", planner=Mine).outcome)
try:
    tandem.run("paper-1", planner=Mine, processes=True)
except tandem.UserError as error:
    print(error)
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.splitlines() == [
        "localised",
        "__main__:Mine: defined in an interactive session; other processes need it in a module",
    ]
