"""Invalid input is reported in one line with the file and the field, with exit status 2 and no traceback."""

from __future__ import annotations

import re
import socket
import time
from pathlib import Path

import pytest

from compose.cli import commands, main
from compose.cli.removed import REMOVED
from compose.errors import BadScenario, UserError
from compose.scenario.scenario_file import parse
from protocol.mission import Mission, infeasibility
from tests.commands import PAPER_1, refused, several_pairs, tandem, world

LISTEN = ("--listen", "tcp/127.0.0.1:7447")
CONNECT = ("--connect", "tcp/127.0.0.1:7447")
GOOD = PAPER_1.replace("seed = 1", "seed = 1\nmax_ticks = 500")
FOUR = several_pairs(2)
QUANTITIES = {"sensing_range": 3.0, "period": 1.0, "max_speed": 1.0, "max_turn_rate": 3.141592653589793}
SWEEP = 'name = "mine"\nscenario = "paper-1"\ntrials = 1\n'


def refused_scenario(text: str | bytes, folder: Path, field: str) -> None:
    """Assert that the error names the file and the field, and that no other file is written."""
    file = folder / "mine.toml"
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    refused(tandem("run", "mine.toml", "--out", "out", cwd=folder), f"mine.toml: {field}")
    assert list(folder.iterdir()) == [file]


def changed(text: str, was: str, new: str) -> str:
    assert was in text
    return text.replace(was, new, 1)


def refused_text(text: str, field: str) -> None:
    """Assert the same as `refused_scenario`, without a process."""
    with pytest.raises(BadScenario) as bad:
        parse(text, "mine.toml")
    assert str(bad.value).startswith(f"mine.toml: {field}")
    assert "\n" not in str(bad.value)


# --- scenario files ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"", "missing field 'name'"),
        (b"name = ", "not TOML"),
        (b"[mission", "not TOML"),
        (b"name = 'x'\nname = 'y'", "not TOML"),
        (b"\x00\x01\x02", "not TOML"),
        (b"a = " + b"[" * 100_000, "not TOML"),
        (b'name = "\xff\xfe"', "cannot be read: it is not UTF-8"),
    ],
    ids=["empty", "cut off", "open table", "said twice", "binary", "nested deeply", "not UTF-8"],
)
def test_a_file_that_is_not_toml_is_refused(text: bytes, says: str, tmp_path: Path) -> None:
    refused_scenario(text, tmp_path, says)


@pytest.mark.parametrize(
    ("was", "typo", "field"),
    [
        ("seed = 1", "sede = 1", "unknown field 'sede'; did you mean 'seed'?"),
        ("[planner]", "[planer]", "unknown field 'planer'"),
        ("period =", "peroid =", "mission: unknown field 'peroid'; did you mean 'period'?"),
        ('name = "paper"', 'nmae = "paper"', "planner: unknown field 'nmae'"),
        ("start = [11", "statr = [11", "robot[1]: unknown field 'statr'; did you mean 'start'?"),
        ("seed = 1", '"two\\nlines" = 1', "unknown field 'two"),
    ],
)
def test_an_unknown_field_is_named(was: str, typo: str, field: str, tmp_path: Path) -> None:
    refused_scenario(changed(GOOD, was, typo), tmp_path, field)


ATTACK = 'id = "a"\nattack = {{kind = "{}", size = 2, part = "{}"}}'
VALUES: list[tuple[str, str, str]] = [
    (
        '"paper"',
        '"papers"',
        "planner.name: there is no 'papers'; there are assured, paper, fisher, greedy, ra",
    ),
    ('id = "a"', ATTACK.format("scal", "all"), "robot[0].attack.kind: there is no 'scal'; "),
    ('id = "a"', ATTACK.format("radius", "orbit"), "robot[0].attack.part: an attack of kind radius changes"),
    (
        'id = "a"',
        ATTACK.format("scale", "orbits"),
        "robot[0].attack.part: there is no 'orbits'; there are all, encounter, orbit, phase-1; did",
    ),
    (
        "[planner]",
        '[[kill]]\npoint = "sens"\n[planner]',
        "kill[0].point: there is no 'sens'; there are ?, command, journal, observation, report",
    ),
    ('name = "paper-1"\n', "", "missing field 'name'"),
    *((f"{name} = {value}\n", "", f"mission: missing field '{name}'") for name, value in QUANTITIES.items()),
    ('id = "b"\n', "", "robot[1]: missing field 'id'"),
    ("anchor = [0.0, 0.0]\n", "", "robot[0]: missing field 'anchor'"),
    *(
        (f"{name} = {value}", f"{name} = {wrong}", f"mission.{name}: ")
        for name, value in QUANTITIES.items()
        for wrong in ("nan", "inf", "-1.0", "0", "1e300", "5e-324", '"1"')
    ),
    *(("seed = 1", f"seed = {v}", "seed: ") for v in ("-1", "1.5", '"1"', "true", "nan", str(2**63))),
    *(("= 500", f"= {v}", "max_ticks: ") for v in ("0", "-1", "1.5", '"1"', "inf", str(10**30))),
    *((GOOD.split('"')[1], v, "name: ") for v in ("", "a b", "a/b", "*", "é", "x" * 65, "x\\n")),
    *(('id = "a"', f'id = "{v}"', "robot[0].id: ") for v in ("", "a b", "a/b", "*", "x" * 33, "a\\n")),
    *(('id = "a"', f"id = {v}", "robot[0].id: ") for v in ("1", "[]")),
    *(('"paper"', v, "planner.name: ") for v in ('"Paper"', '""', "1", '"two\\nlines"')),
    ("[0.0, 0.0]", "[0.0]", "robot[0].anchor: "),
    ("[0.0, 0.0]", "[0.0, nan]", "robot[0].anchor[1]: "),
    ("[0.0, 0.0]", "[1e300, 0.0]", "robot[0].anchor[0]: "),
    ("[0.0, 0.0]", '"origin"', "robot[0].anchor: "),
    ("[2.4, -1.2, 4.8]", "[2.4, -1.2]", "robot[0].start: "),
    ("[2.4, -1.2, 4.8]", "[2.4, -1.2, nan]", "robot[0].start[2]: "),
    ("[2.4, -1.2, 4.8]", "[-inf, -1.2, 4.8]", "robot[0].start[0]: "),
    ("[2.4, -1.2, 4.8]", '["x", -1.2, 4.8]', "robot[0].start[0]: "),
    ("[2.4, -1.2, 4.8]", "2.4", "robot[0].start: "),
]
"""Changes of GOOD that are refused: unknown words, missing fields, and values out of bounds."""


@pytest.mark.parametrize(("was", "new", "field"), VALUES)
def test_a_missing_field_and_a_value_out_of_bounds_are_named(was: str, new: str, field: str) -> None:
    refused_text(changed(GOOD, was, new), field)


@pytest.mark.parametrize(
    ("was", "new", "why"),
    [
        ("max_speed = 1.0", "max_speed = 9e-5", "a robot moves at most 9e-05 m in a tick"),
        ("period = 1.0", "period = 5e-5", "a robot moves at most 5e-05 m in a tick"),
        ("sensing_range = 3.0", "sensing_range = 2000.0", "ranges up to 2000 m"),
        ("anchor = [10.0", "anchor = [1e6", "manoeuvres of 1 m are too short to compute a pose"),
    ],
)
@pytest.mark.parametrize("planner_name", ["paper", "assured"])
def test_a_mission_in_which_no_robot_could_claim_is_refused(
    was: str, new: str, why: str, planner_name: str, tmp_path: Path
) -> None:
    text = changed(changed(GOOD, was, new), "start = [11.3, -0.4, 3.6]", "")
    text = changed(text, '"paper"', f'"{planner_name}"')
    refused_scenario(text, tmp_path, "mission: ")
    refused(tandem("run", "mine.toml", cwd=tmp_path), why)


def test_a_mission_in_which_a_turn_takes_a_month_is_checked_at_once() -> None:
    """The largest error of phase 1 is sought among the ticks of half a turn: here, three million."""
    begin = time.process_time()
    assert infeasibility(Mission(3.0, 1.0, 1.0, 1e-6), 10.0) is None
    assert time.process_time() - begin < 0.5


def with_noise(field: str, value: str) -> str:
    """Return GOOD with that field in its mission table; dotted TOML keys are nested tables."""
    return changed(GOOD, "[mission]\n", f"[mission]\n{field} = {value}\n")


AMOUNTS = {
    "accuracy": ("0.0", "5e-324", "-0.1", "2e6", "nan", "inf", '"0.1"', "true", "[0.1]"),
    "confidence": ("0.4", "1.0", "1", "-0.5", "nan", '"sure"', "false"),
    "noise.anchor_sigma": ("-1e-9", "1.1e4", "nan", "-inf", '"0.1"', "true", "[]"),
    "noise.mutual_sigma": ("-1e-9", "1.1e4", "nan", "inf", '"0.1"', "true", "{}"),
    "noise.outliers": ("-0.01", "0.51", "1", "nan", '"few"', "false"),
    "noise.drop_outs": ("-0.01", "0.51", "1", "nan", '"few"', "false"),
    "noise.outlier_bias": ("1.0", "[]", "[1.0]", "[1.0, 2.0, 3.0]", '"long"', "{}"),
    "noise.actuation.v": ("-0.01", "0.51", "nan", '"1 %"', "true"),
    "noise.actuation.omega": ("-0.01", "0.51", "nan", '"1 %"', "true"),
    "noise.odometry.v_floor": ("-0.01", "1.1e4", "inf", '"1 %"', "true"),
    "noise.odometry.omega_floor": ("-0.01", "1.1e4", "inf", '"1 %"', "true"),
    "noise.actuation": ("0.01", "[0.01]", '"1 %"'),
    "noise": ("0.01", "[]", "true"),
}
"""Invalid values for the fields of `noise`."""
TOO_MANY_RANGES = "0.001 m takes the mean of more than 10000 ranges"
USELESS_NOISE = {
    "noise.outlier_bias = [2.0, 0.3]": "noise.outlier_bias: the lower bound 2 m is above the upper bound 0.3",
    "noise.outlier_bias = [-0.1, 0.3]": "noise.outlier_bias[0]: ",
    "noise.outlier_bias = [0.3, nan]": "noise.outlier_bias[1]: ",
    "noise.outlier_bias = [0.3, 2e6]": "noise.outlier_bias[1]: ",
    "noise.sigma_degrees = 5e-324": "noise.sigma_degrees: set 0 or at least 1e-300",
    "noise.strays = 5e-324": "noise.strays: set 0 or at least 1e-300",
    "noise.anchor_sigma = 3.1": "noise.anchor_sigma: a range with an error of 3.1 m contains no more",
    "noise.mutual_sigma = 9.0": "noise.mutual_sigma: a range with an error of 9 m contains no more",
    "noise = {outliers = 0.1}\naccuracy = 2.2": "accuracy: any robot in range of its anchor knows",
    "noise.anchor_sigma = 0.11\naccuracy = 0.001": f"accuracy: {TOO_MANY_RANGES}",
    "noise.mutual_sigma = 0.11\naccuracy = 0.001": f"accuracy: {TOO_MANY_RANGES}",
    "noise.outliers = 0.26": "noise.outliers: with more than 0.25, all ranges that agree may",
    "noise.actuation.v_floor = 1.1": "noise.actuation.v_floor: more than mission.max_speed = 1 m/s",
    "noise.odometry.omega_floor = 4.0": "noise.odometry.omega_floor: more than mission.max_turn_rate = 3.14",
}
MISSPELT = {
    "acuracy": "mission: unknown field 'acuracy'",
    "confidense": "mission: unknown field 'confidense'",
    "noise.sigma": "mission.noise: unknown field 'sigma'",
    "noise.outlier": "mission.noise: unknown field 'outlier'",
    "noise.odometry.w": "mission.noise.odometry: unknown field 'w'",
    "noise.actuation.vfloor": "mission.noise.actuation: unknown field 'vfloor'",
}


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        *((field, value, f"mission.{field}: ") for field, values in AMOUNTS.items() for value in values),
        *((field, "0.1", says) for field, says in MISSPELT.items()),
        *((*told.split(" = ", 1), f"mission.{says}") for told, says in USELESS_NOISE.items()),
        ("noise", '"little"', "mission.noise.profile: there is no 'little'; there are camera, uwb, "),
    ],
)
def test_noise_that_is_misspelt_out_of_bounds_or_too_large_for_a_claim_is_named(
    field: str, value: str, says: str
) -> None:
    refused_text(with_noise(field, value), says)


def test_a_mission_with_noise_at_its_bounds_runs() -> None:
    for noise in (
        "{anchor_sigma = 3.0, mutual_sigma = 3.0, outliers = 0.25, drop_outs = 0.5, outlier_bias = [1, 1]}",
        "{actuation = {v = 0.5, omega = 0.5, v_floor = 1.0, omega_floor = 3.1}, odometry = {omega = 0.5}}",
        "{}\naccuracy = 1e6",
        "{outliers = 0.1}\naccuracy = 2.1\nconfidence = 0.5",
    ):
        parse(with_noise("noise", noise), "mine.toml")


@pytest.mark.parametrize(
    ("text", "field"),
    [
        (changed(GOOD, "[2.4, -1.2, 4.8]", "[2.4, -2.2, 4.8]"), "robot[0].start: "),
        (changed(GOOD, "[11.3, -0.4, 3.6]", "[1.3, -0.4, 3.6]"), "robot[1].start: "),
        (changed(GOOD, 'id = "b"', 'id = "a"'), "robot.id: "),
        (changed(GOOD, "[10.0, 0.0]", "[0.0, 0.0]"), "robot[1].anchor: "),
        (GOOD[: GOOD.rindex("[[robot]]")], "robot: "),
        (changed(GOOD, 'id = "b"', 'id = "b"\npeer = "a"'), "robot[0].peer: "),
        (changed(FOUR, 'peer = "a"\n', ""), "robot[1].peer: "),
        (FOUR[: FOUR.rindex("[[robot]]")], "robot[2].peer: there is no robot 'd'"),
        (changed(FOUR, 'peer = "a"', 'peer = "z"'), "robot[1].peer: there is no robot 'z'"),
        (changed(FOUR, 'peer = "a"', 'peer = "c"'), "robot[0].peer: 'a' names 'b'"),
        (changed(FOUR, 'peer = "a"', 'peer = "b"'), "robot[0].peer: 'a' names 'b'"),
    ],
    ids=[
        *("a starts out of range", "b starts out of range", "one id twice", "one anchor twice"),
        *("one robot", "only one of two names its peer", "no peer of four", "three robots"),
        *("an unknown peer", "not each other's", "its own peer"),
    ],
)
def test_robots_that_do_not_make_a_mission_are_refused(text: str, field: str) -> None:
    refused_text(text, field)


@pytest.mark.parametrize("command", [("run",), ("world", *LISTEN)], ids=["run", "world"])
@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("paper-3", "paper-3: neither a file nor a shipped scenario"),
        ("missing.toml", "missing.toml: neither a file"),
        ("folder", "folder: cannot be read: it is a directory"),
        ("two\nlines", "neither a file"),
        ("x" * 5000, "x: "),
        ("\udcff", "neither a file"),
    ],
    ids=["name", "file", "folder", "two lines", "long", "not text"],
)
def test_an_unknown_scenario_is_refused(
    command: tuple[str, ...], source: str, says: str, tmp_path: Path
) -> None:
    (tmp_path / "folder").mkdir()
    refused(tandem(*command, source, "--out", "out", cwd=tmp_path), says)
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


# --- the command line -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "COMMAND"),
        (["fly"], "'fly'"),
        (["run"], "SCENARIO"),
        (["world", "paper-1"], "--listen"),
        (["world", *LISTEN], "SCENARIO"),
        (["agent", "a"], "--connect"),
        (["agent", *CONNECT], "ID"),
        (["run", "paper-1", "--fast"], "--fast"),
        (["run", "paper-1", "--out"], "--out"),
        (["run", "paper-1", "--in-process", "--rate", "2"], "--rate"),
        (["run", "paper-1", "--export"], "--export: it needs --out DIR"),
        (["run", "paper-1", "--port", "8080"], "--port: it needs --watch"),
        (["replay", ""], "'' is not a path"),
        *((["run", "paper-1", "--rate", v], "--rate: ") for v in ("0", "-1", "nan", "inf", "fast", "1e400")),
        (["run", "paper-1", "--timeout", "0"], "--timeout: "),
        *((["run", "paper-1", "--seed", v], "--seed: ") for v in ("-1", "1.5", "x", "nan", "²", str(2**63))),
        (["agent", "a", *CONNECT, "--connect-timeout", "0"], "--connect-timeout: "),
        (["sweep", "noise", "--workers", "x"], "--workers: 'x' is not a whole number from 1 to 1000"),
        (["sweep", "noise", "--workers", "0"], "--workers: '0' is not a whole number from 1 to 1000"),
        (["sweep", "noise", "--print-trial", ":"], "--print-trial: ':' is not a trial such as 17, or 3:17"),
        (["sweep", "noise", "--print-trial", "x:1"], "--print-trial: 'x:1' is not a trial such as 17, or"),
        (["sweep", "noise", "--trials", "3", "--print-trial", "7"], "with --trials 3, trials are 0 to 2"),
        (["estimate", "run", "--confidence", "nan"], "'nan' is not a probability from 0.5 to below 1"),
        (["estimate", "run", "--confidence", "x"], "'x' is not a probability from 0.5 to below 1"),
        *((["agent", v, *CONNECT], "ID: ") for v in ("", "a/b", "*", "a\n", "x" * 65)),
        (["agent", "a", *CONNECT, "--run", "a/b"], "--run: "),
        *((["world", "paper-1", *LISTEN, "--run", v], "--run: ") for v in ("", "a/b", "@x", "x" * 65)),
    ],
)
def test_a_mistyped_command_line_is_one_line(arguments: list[str], says: str, tmp_path: Path) -> None:
    refused(tandem(*arguments, cwd=tmp_path), says)
    assert list(tmp_path.iterdir()) == []


ENDPOINTS = [
    *("", "7447", "127.0.0.1:7447", "tcp/127.0.0.1", "tcp/127.0.0.1:", "tcp/127.0.0.1:0"),
    *("tcp/127.0.0.1:65536", "tcp/127.0.0.1:-1", "tcp/127.0.0.1:port", "tcp/:7447", "tpc/127.0.0.1:7447"),
    *("tcp:127.0.0.1:7447", "tcp//127.0.0.1:7447", "tcp/127.0.0.1:7447 ", "http://127.0.0.1:7447", "\n"),
    "tcp/127.0.0.1:7447\n",
]


@pytest.mark.parametrize(
    ("command", "endpoint"),
    [
        *((("world", "paper-1", "--listen"), endpoint) for endpoint in ENDPOINTS),
        (("agent", "a", "--connect"), "127.0.0.1:7447"),
    ],
)
def test_an_endpoint_that_does_not_parse_is_refused(
    command: tuple[str, ...], endpoint: str, tmp_path: Path
) -> None:
    refused(
        tandem(*command, endpoint, "--out", "out", cwd=tmp_path), f"{command[-1]}: ", "is not an endpoint"
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("host", ["192.0.2.1", "nowhere.invalid"])
def test_an_address_of_another_machine_cannot_be_listened_on(host: str, tmp_path: Path) -> None:
    endpoint = f"tcp/{host}:7447"
    refused(tandem("world", "paper-1", "--listen", endpoint, cwd=tmp_path), f"--listen: {endpoint}: ")


def test_a_port_in_use_is_one_line(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        ended = tandem("world", "paper-1", "--listen", endpoint, "--out", "out", cwd=tmp_path)
        page = tandem("run", "paper-1", "--watch", "--port", endpoint.rpartition(":")[2])
    refused(ended, f"--listen: {endpoint}: already in use")
    refused(page, "--port: ", "cannot be used: Address already in use")
    assert list(tmp_path.glob("out/*")) == []


def test_what_was_removed_is_one_line_that_names_what_replaces_it() -> None:
    for name in REMOVED:
        with pytest.raises(UserError, match=re.escape(f"`{name}` was removed in version 0.3: ")):
            main.parse(name.split())
    for seeds in ("--seed=1..3", "--seed 1..3"):
        with pytest.raises(UserError, match=re.escape("`run --seed N..N` was removed")):
            main.parse(["run", "paper-1", *seeds.split()])
    refused(tandem("run", "paper-1", "--foxglove=8765"), "`run --foxglove` was removed", "run.mcap")


def test_no_flag_begins_with_the_abbreviation_of_one_that_was_removed() -> None:
    for command, _, flag in (name.partition(" ") for name in REMOVED):
        if re.fullmatch("--[a-z0-9-]+", flag):
            entry = next(one for one in commands.COMMANDS if one.name == command)
            assert not re.findall(rf"{flag[:4]}[\w-]*", main.command_parser(entry).format_help())


# --- the folder of the recording --------------------------------------------------------------------


@pytest.mark.parametrize("out", ["file", "file/out", "/proc/out", "/proc/self/fdinfo"])
@pytest.mark.parametrize(
    "command",
    [("run", "paper-1"), ("run", "paper-1", "--in-process"), ("world", "paper-1", *LISTEN)],
    ids=["run", "in-process", "world"],
)
def test_a_folder_that_cannot_be_written_is_refused(
    command: tuple[str, ...], out: str, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("mine")
    refused(tandem(*command, "--out", out, cwd=tmp_path), f"{out} cannot be written: ")
    assert (tmp_path / "file").read_text() == "mine"


def test_an_agents_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with world("paper-1") as (_, endpoint):
        ended = tandem("agent", "a", "--connect", endpoint, "--out", "file/out", cwd=tmp_path)
    refused(ended, "file/out", "cannot be written: ")


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (("run", "paper-2"), " already contains a recording"),
        (("run", "paper-2", "--in-process"), " already contains a recording"),
        (("world", "paper-2", *LISTEN), "/world.journal: damaged at byte 0"),
    ],
    ids=["run", "in-process", "world"],
)
def test_a_recording_is_never_overwritten(command: tuple[str, ...], says: str, tmp_path: Path) -> None:
    (tmp_path / "world.journal").write_text("precious")
    refused(tandem(*command, "--out", tmp_path), f"--out: {tmp_path}{says}", "; choose another folder")
    assert [path.name for path in tmp_path.iterdir()] == ["world.journal"]
    assert (tmp_path / "world.journal").read_text() == "precious"


def test_an_agents_journal_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "agent-a.journal").write_text("precious")
    with world("paper-1") as (_, endpoint):
        ended = tandem("agent", "a", "--connect", endpoint, "--out", tmp_path)
    says = f"--out: {tmp_path}/agent-a.journal: damaged at byte 0"
    refused(ended, says, "; choose another folder")
    assert (tmp_path / "agent-a.journal").read_text() == "precious"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("run noise", "noise is a sweep; run it with `tandem sweep noise`"),
        ("world noise --listen tcp/127.0.0.1:7447", "noise is a sweep; run it with `tandem sweep noise`"),
        ("sweep noisy", "noisy is a scenario; run it with `tandem run noisy`"),
        ("run papr-1", "; did you mean 'paper-1'?"),
        ("run niose", "; did you mean 'noise'?"),
        ("sweep los", "; did you mean 'loss'?"),
        ("rnu paper-1", "; did you mean 'run'?"),
        ("run paper-1 paper-2", ": a loop of the shell runs several files"),
        ("run random --seed 1..3", ": `tandem sweep` runs many seeds, with one table"),
        ("estimate x --all-anchors", ": all anchors are used without it"),
        ("bench --rounds 3", ": `uv run python -m tests.benchmark` in a clone measures the same"),
        ("run paper-1 --sede 3", "tandem run: unrecognized arguments: --sede 3; did you mean '--seed'?"),
        ("figures x --size y", "tandem figures: unrecognized arguments: --size y"),
        ("estimate x --nois uwb", "unrecognized arguments: --nois uwb; did you mean '--noise'?"),
        ("run random --faul loss=0.1", "unrecognized arguments: --faul loss=0.1; did you mean '--fault'?"),
        ("run paper-1 --kill=--", "tandem run: argument --kill: '--' is not a value"),
        ("sweep noise --print-trial=--", "tandem sweep: argument --print-trial: '--' is not a value"),
        ("figures x --only encunter", "; did you mean 'encounter'?"),
        ("run paper-1 --kill wolrd@3", "; did you mean 'world'?"),
        ("robot robot2 --mission FILE --driver docs.rover:Rover", "; did you mean 'robot-2'?"),
    ],
)
def test_a_misspelt_name_is_refused_with_the_nearest_one(words: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "named.toml"
    file.write_text(PAPER_1.replace('"a"', '"robot-1"').replace('"b"', '"robot-2"'))
    ended = tandem(*[word.replace("FILE", str(file)) for word in words.split()])
    assert (ended.status, ended.out) == (2, "")
    assert ended.err.rstrip("\n").endswith(said)
    assert ended.err.count("\n") == 1


@pytest.mark.parametrize(
    ("command", "text", "kind", "runs_it"),
    [
        (("run",), SWEEP, "sweep", "sweep"),
        (("world", *LISTEN), SWEEP, "sweep", "sweep"),
        (("sweep",), PAPER_1, "scenario", "run"),
    ],
    ids=["run", "world", "sweep"],
)
def test_a_file_of_the_other_kind_is_refused_with_the_command_that_runs_it(
    command: tuple[str, ...], text: str, kind: str, runs_it: str, tmp_path: Path
) -> None:
    (tmp_path / "my file.toml").write_text(text)
    ended = tandem(*command[:1], "my file.toml", *command[1:], cwd=tmp_path)
    said = f"my file.toml is a {kind}; run it with `tandem {runs_it} 'my file.toml'`"
    assert ended == (2, "", f"tandem {command[0]}: {said}\n")


def test_an_agent_with_a_misspelt_name_prints_the_nearest_one(tmp_path: Path) -> None:
    file = tmp_path / "named.toml"
    file.write_text(PAPER_1.replace('"a"', '"robot-1"').replace('"b"', '"robot-2"'))
    with world(file) as (_, endpoint):
        ended = tandem("agent", "robot2", "--connect", endpoint)
    assert ended.status == 2
    assert "it has robot-1, robot-2; did you mean 'robot-2'?" in ended.err
