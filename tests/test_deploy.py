"""Files of compose, containers and systemd match the commands and run missions; the wheel needs no clone."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path, PurePath
from signal import SIGKILL, SIGTERM
from typing import Any

import pytest
from ruamel.yaml import YAML

from compose.cli.main import parse
from compose.hardware.compose_file import MOUNTED
from compose.launch.processes import free_endpoint
from protocol.journal import journal_file
from tests.commands import PAPER_1, TandemProcess, refused, tandem
from tests.series import series
from tests.test_group_field import FAR

HOUSE = Path(__file__).parents[1]
DEPLOY = HOUSE / "compose" / "hardware" / "deploy"
COMPOSE = DEPLOY / "compose.yaml"
CONTAINER = DEPLOY / "Containerfile"
UNIT = DEPLOY / "tandem-agent@.service"


def content(file: Path, **environment: str) -> dict[str, Any]:
    """Return the content of a compose file, with its variables substituted as compose does."""
    text = re.sub(
        r"(?<!\$)\$\{(\w+):-([^}]*)\}", lambda found: environment.get(found[1], found[2]), file.read_text()
    ).replace("$$", "$")
    found: dict[str, Any] = YAML(typ="safe", pure=True).load(text)
    return found


def services(**environment: str) -> dict[str, dict[str, Any]]:
    """Return the services of the compose file that ships."""
    found: dict[str, dict[str, Any]] = content(COMPOSE, **environment)["services"]
    return found


def ours() -> dict[str, dict[str, Any]]:
    """Return the services that run a `tandem` command."""
    return {name: one for name, one in services().items() if "build" in one}


def unit() -> dict[str, list[str]]:
    """Return the values of each field of the systemd unit."""
    found: dict[str, list[str]] = {}
    for line in UNIT.read_text().splitlines():
        if line and line[0] not in "#[":
            name, _, value = line.partition("=")
            found.setdefault(name, []).append(value)
    return found


def valid(file: Path) -> bool:
    """Return whether `file` is valid by the compose specification."""
    check = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec"]
    return subprocess.run([*check, file], check=False, capture_output=True).returncode == 0


def test_the_compose_file_is_valid_by_the_compose_specification(tmp_path: Path) -> None:
    assert valid(COMPOSE)
    broken = tmp_path / "compose.yaml"
    broken.write_text(COMPOSE.read_text().replace("read_only: true", "readonly: true"))
    assert not valid(broken)


def test_every_service_has_an_existing_command_and_its_own_recording() -> None:
    recordings = []
    for name, service in ours().items():
        options = parse(service["command"])
        if options.command == "watch":
            continue
        assert options.out == Path("/journal")
        assert service["volumes"] == [f"{name}:/journal"]
        recordings.append(name)
    assert recordings == ["world", "agent-a", "agent-b"]


def test_every_service_connects_to_one_that_listens_in_the_same_network() -> None:
    listening = {"zenoh": "7447"}
    for name, service in ours().items():
        for endpoint in getattr(parse(service["command"]), "listen", ()):
            listening[name] = endpoint.rpartition(":")[2]
    for service in ours().values():
        for endpoint in parse(service["command"]).connect:
            host, _, port = endpoint.removeprefix("tcp/").partition(":")
            assert listening[host] == port
            assert set(service["networks"]) & set(services()[host]["networks"])
    zenoh = services()["zenoh"]["command"]
    assert zenoh[zenoh.index("--connect") + 1] == f"tcp/world:{listening['world']}"


def test_only_the_page_is_published_and_on_loopback_only() -> None:
    published = {name: service["ports"] for name, service in services().items() if "ports" in service}
    assert published == {"page": ["127.0.0.1:8080:8080"]}
    options = parse(services()["page"]["command"])
    assert (options.address, options.port) == ("0.0.0.0", 8080)
    assert [name for name, service in services().items() if service["networks"] != ["mission"]] == ["page"]


def test_every_service_is_confined_watched_over_and_started_again() -> None:
    for service in services().values():
        assert service["read_only"] is True
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert service["restart"].startswith("on-failure")
        assert service["healthcheck"]["test"]


def test_the_image_takes_the_arguments_that_the_compose_file_gives_and_runs_as_nobody() -> None:
    lines = CONTAINER.read_text().splitlines()
    known = {line.split()[1].partition("=")[0] for line in lines if line.startswith("ARG ")}
    given = set().union(*(service["build"]["args"] for service in ours().values()))
    assert given == {"BASE", "EXTRAS"}
    assert given <= known
    default = next(line for line in lines if line.startswith("ARG BASE=")).partition("=")[2]
    assert {service["build"]["args"]["BASE"] for service in ours().values()} == {default}
    assert next(line for line in reversed(lines) if line.startswith("USER ")) == "USER 10001:10001"
    assert 'ENTRYPOINT ["tandem"]' in lines
    for service in ours().values():
        assert (DEPLOY / service["build"]["context"]).resolve() == HOUSE
        assert (HOUSE / service["build"]["dockerfile"]) == CONTAINER


def test_what_the_wheel_is_made_of_goes_into_the_image() -> None:
    project = tomllib.loads((HOUSE / "pyproject.toml").read_text())
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    needed = {
        "pyproject.toml",
        project["project"]["readme"],
        *project["project"]["license-files"],
        *(path.split("/")[1].replace("*", "agent") for path in wheel["include"]),
    }
    let_in = {line[1:] for line in (HOUSE / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert let_in == needed


@pytest.mark.parametrize("killed", series(["agent-a", "world"], 0))
def test_the_commands_of_the_services_complete_a_mission_despite_a_kill(killed: str, tmp_path: Path) -> None:
    complete_despite_a_kill(services(TANDEM_RATE="20"), "ab", killed, tmp_path)


def complete_despite_a_kill(
    found: dict[str, dict[str, Any]], robots: Sequence[str], killed: str, tmp_path: Path, **mounted: str
) -> None:
    """Run the commands of the services of a compose file as processes, kill one of them, and restart it.

    `mounted` is the file `scenario`, if it is one in the container of the world.
    """
    world, router = free_endpoint(), free_endpoint()
    places = {"tcp/world:7447": world, "tcp/0.0.0.0:7447": world, "tcp/zenoh:7447": router}
    if "scenario" in mounted:
        places[MOUNTED] = mounted["scenario"]
    commands = {}
    for name, service in found.items():
        if name in ("page", "zenoh"):
            continue
        line = "\n".join(service["command"]).replace("/journal", str(tmp_path / name))
        for said, place in places.items():
            line = line.replace(said, place)
        commands[name] = line.split("\n")
    with ExitStack() as stack:
        playing = {name: stack.enter_context(TandemProcess(*line)) for name, line in commands.items()}
        for robot in robots:
            playing[f"agent-{robot}"].until_answered(robot, tmp_path / f"agent-{robot}")
        recording = tmp_path / "world" / "world.journal"
        playing["world"].until(
            lambda: len(list(journal_file.read(recording))) >= 4, "three ticks are on record"
        )
        playing[killed].tell(SIGKILL)
        playing[killed] = stack.enter_context(TandemProcess(*commands[killed]))
        ended = {name: command.ended() for name, command in playing.items()}
    assert {name: end.status for name, end in ended.items()} == dict.fromkeys(commands, 0), ended
    assert "resumed at tick " in ended[killed].out


# --- other scenarios --------------------------------------------------------------------------------

IDS = ("1", "on", "c", "D_d")
"""Ids of robots; some are no strings in YAML unless they are quoted."""


@pytest.fixture
def of_a_group(tmp_path: Path) -> tuple[Path, Path]:
    """Return the file of a scenario of a group, and the compose file made of it, in another folder."""
    text = FAR
    for name, other in zip("abcd", IDS, strict=True):
        text = text.replace(f'id = "{name}"', f'id = "{other}"')
    scenario = tmp_path / "for: $me" / "four.toml"
    scenario.parent.mkdir()
    scenario.write_text(text)
    (tmp_path / "containers").mkdir()
    made = tandem("containers", scenario, tmp_path / "containers" / "four.yaml")
    assert made.status == 0, made.err
    return scenario, tmp_path / "containers" / "four.yaml"


def test_the_compose_file_of_a_pair_is_the_one_that_ships(tmp_path: Path) -> None:
    file = tmp_path / "pair.yaml"
    assert tandem("containers", "random", file).status == 0
    context = content(file)["services"]["world"]["build"]["context"]
    assert (tmp_path / context).resolve() == HOUSE
    shipped = COMPOSE.read_text()
    expected = shipped[shipped.index("name: tandem") :]
    for ours, theirs in (
        ("name: tandem", "name: tandem-random"),
        ("${TANDEM_SCENARIO:-random}", "random"),
        ("context: ../../..", f'context: "{context}"'),
    ):
        expected = expected.replace(ours, theirs)
    assert file.read_text() == expected


def test_the_compose_file_of_a_group_has_a_confined_service_and_a_volume_per_robot(
    of_a_group: tuple[Path, Path],
) -> None:
    scenario, file = of_a_group
    assert valid(file)
    found = content(file)
    assert found["name"] == "tandem-four"
    assert list(found["services"]) == ["world", *(f"agent-{robot}" for robot in IDS), "page", "zenoh"]
    assert list(found["volumes"]) == ["world", *(f"agent-{robot}" for robot in IDS)]
    kept = ("image", "restart", "read_only", "tmpfs", "cap_drop", "security_opt", "networks", "healthcheck")
    for robot in IDS:
        service = found["services"][f"agent-{robot}"]
        assert service["volumes"] == [f"agent-{robot}:/journal"]
        assert parse(service["command"]).id == robot
        assert service["command"][2:] == services()["agent-a"]["command"][2:]
        assert [service[one] for one in kept] == [services()["agent-a"][one] for one in kept]
    journal, mount = found["services"]["world"]["volumes"]
    assert journal == "world:/journal"
    assert (file.parent / mount.pop("source")).resolve() == scenario
    assert mount == {"type": "bind", "target": MOUNTED, "read_only": True}


@pytest.mark.long
@pytest.mark.parametrize("killed", ["agent-on", "world"])
def test_the_commands_of_a_group_complete_a_mission_despite_a_kill(
    killed: str, of_a_group: tuple[Path, Path], tmp_path: Path
) -> None:
    scenario, file = of_a_group
    found = content(file, TANDEM_RATE="20")["services"]
    complete_despite_a_kill(found, IDS, killed, tmp_path, scenario=str(scenario))


def test_what_containers_cannot_run_is_refused_in_one_line(tmp_path: Path) -> None:
    kills = tmp_path / "kills.toml"
    kills.write_text(f'{PAPER_1}\n[[kill]]\nwho = "a"\ntick = 3\n')
    own = tmp_path / "own.toml"
    own.write_text(PAPER_1.replace('"paper"', '"tests.own_planners:Wrapping"'))
    there = tmp_path / "there.yaml"
    there.write_text("services: {}")
    link = tmp_path / "link.yaml"
    link.symlink_to("nowhere.yaml")
    for source, file, why in (
        (kills, "new.yaml", "kill: a scenario has no effect on containers"),
        (own, "new.yaml", "is not in the image, which has shipped planners only"),
        ("nothing", "new.yaml", "neither a file nor a shipped scenario"),
        ("random", "there.yaml", "there.yaml already exists; choose another file"),
        ("random", "link.yaml", "link.yaml already exists; choose another file"),
        ("random", "no folder/new.yaml", "cannot be written: No such file or directory"),
    ):
        refused(tandem("containers", source, tmp_path / file), why)
    assert there.read_text() == "services: {}"
    assert link.is_symlink()
    assert not (tmp_path / "nowhere.yaml").exists()
    assert not (tmp_path / "new.yaml").exists()


# --- without containers -----------------------------------------------------------------------------


def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze; Debian's package is systemd")
    copy = tmp_path / UNIT.name
    copy.write_text(UNIT.read_text().replace("/opt/tandem/bin/tandem", sys.executable))
    for options in (["verify"], ["security", "--offline=yes", "--threshold=20"]):
        checked = subprocess.run(
            ["systemd-analyze", "--no-pager", *options, copy], check=False, capture_output=True, text=True
        )
        assert checked.returncode == 0, checked.stdout + checked.stderr
        if options == ["verify"]:
            assert checked.stdout + checked.stderr == ""


def test_the_unit_hands_over_every_file_of_the_robots_keys(tmp_path: Path) -> None:
    assert tandem("keys", tmp_path / "keys", "--robots", "a").status == 0
    given = dict(line.split(":") for line in unit()["LoadCredential"])
    assert given == {
        path.name: f"/etc/tandem/agent-%i/{path.name}" for path in (tmp_path / "keys" / "agent-a").iterdir()
    }


def test_the_command_of_the_unit_runs_a_robot_with_its_keys(tmp_path: Path) -> None:
    keys, endpoint = tmp_path / "keys", free_endpoint("tls")
    assert tandem("keys", keys, "--robots", "a,b").status == 0
    (start,) = unit()["ExecStart"]
    with ExitStack() as stack:
        listens = ("--listen", endpoint, "--keys", keys / "world", "-q")
        playing = [stack.enter_context(TandemProcess("world", "paper-1", *listens))]
        for robot in ("a", "b"):
            line = start.replace("%i", robot).replace("%d", str(keys / f"agent-{robot}"))
            line = line.replace("%S", str(tmp_path / "state"))
            line = line.replace("$TANDEM_OPTIONS", f"--connect {endpoint} --connect-timeout 60")
            program, *arguments = shlex.split(line)
            assert program == "/opt/tandem/bin/tandem"
            playing.append(stack.enter_context(TandemProcess(*arguments)))
        assert [one.ended().status for one in playing] == [0, 0, 0]
    assert (tmp_path / "state" / "tandem" / "a" / "agent-a.journal").exists()


@pytest.mark.long
def test_a_stop_is_none_of_the_failures_after_which_the_unit_starts_again(tmp_path: Path) -> None:
    service = unit()
    assert service["Restart"] == ["on-failure"]
    with TandemProcess("agent", "a", "--connect", free_endpoint(), "--out", tmp_path) as waiting:
        waiting.until_prints("searching for up to")
        waiting.tell(SIGTERM)
        assert [str(waiting.ended().status)] == service["SuccessExitStatus"]
    mistaken = tandem("agent", "a", "--keys", tmp_path)
    assert str(mistaken.status) in service["RestartPreventExitStatus"][0].split()


ROOT = Path(__file__).parents[1]
SECRET = "not to be packed"
FOREIGN = (
    "keys/ca-key.pem",
    "keys/world/key.pem",
    "compose/keys/ca-key.pem",
    "compose/hardware/deploy/key.txt",
    "record/world.journal",
    "docs/record/summary.json",
    "tests/agent-a.journal",
    "notes.md",
)
PROJECT_FILES = {
    "CHANGELOG.md",
    "CITATION.cff",
    "CONTRIBUTING.md",
    "LICENSE",
    "README.md",
    "mkdocs.yml",
    "pyproject.toml",
}


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the files of the repository, and files that a user has written into it."""
    folder = tmp_path_factory.mktemp("tree")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("the tests do not run in a repository")
    for name in filter(None, listed.stdout.split("\0")):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, folder / name)
    (folder / ".gitignore").unlink()  # the list of packed files must suffice without it
    for name in FOREIGN:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(SECRET)
    return folder


def built(tree: Path, kind: str, out: Path) -> Path:
    """Return the file that `uv build` writes."""
    uv = shutil.which("uv")
    if uv is None:
        pytest.skip("uv is not installed")
    made = subprocess.run(
        [uv, "build", "-q", f"--{kind}", "--out-dir", out, tree],
        capture_output=True,
        text=True,
        check=False,
    )
    if made.returncode and "hatchling" in made.stderr:
        pytest.skip("the build back end is not to be had: there is no package index")
    assert made.returncode == 0, made.stderr
    (file,) = (path for path in out.iterdir() if path.name != ".gitignore")
    return file


def tracked(tree: Path, *folders: str) -> set[str]:
    """Return the files of the project in these folders."""
    files = [path for folder in folders for path in (tree / folder).rglob("*") if path.is_file()]
    names = {str(PurePath(path).relative_to(tree)) for path in files}
    return {name for name in names if name not in FOREIGN}


@pytest.mark.long
def test_an_sdist_has_the_sources_and_nothing_else(tree: Path, tmp_path: Path) -> None:
    with tarfile.open(built(tree, "sdist", tmp_path)) as packed:
        names = {name.partition("/")[2] for name in packed.getnames()}
    assert not names & set(FOREIGN)
    wanted = tracked(tree, "tandem", "agent", "world", "protocol", "compose", "docs", "tests")
    assert names == wanted | PROJECT_FILES | {"PKG-INFO"}


@pytest.mark.long
def test_a_wheel_has_the_packages_with_their_data_and_types_and_nothing_else(
    tree: Path, tmp_path: Path
) -> None:
    with zipfile.ZipFile(built(tree, "wheel", tmp_path)) as packed:
        names = {name for name in packed.namelist() if ".dist-info/" not in name}
    compiled = {"agent/estimation/libsmoother.so"}  # not in the tree, which may be read-only
    assert names == tracked(tree, "tandem", "agent", "world", "protocol", "compose") | compiled
    assert not compiled & tracked(tree, "agent")
    assert {f"{package}/py.typed" for package in ("tandem", "agent", "world", "protocol", "compose")} <= names


@pytest.mark.long("slow")
@pytest.mark.timeout(600)
@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13"])
def test_a_wheel_works_without_a_clone(version: str, tree: Path, tmp_path: Path) -> None:
    """The environment is empty, and has the Python of this version that is on this machine."""
    wheel, environment = built(tree, "wheel", tmp_path / "wheel"), tmp_path / "environment"
    apart = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    run = partial(subprocess.run, cwd=tmp_path, env=apart, capture_output=True, text=True, check=False)
    uv = ("uv", "--no-config", "--no-python-downloads")
    if run([*uv, "venv", "-q", "--python", version, environment]).returncode:
        pytest.skip(f"there is no Python {version}")
    made = run([*uv, "pip", "install", "-q", "--python", environment, wheel])
    if made.returncode:
        pytest.skip(f"there is no package index: {made.stderr}")
    for words in (
        "run paper-1 --out recording",
        "export recording --html",
        "replay recording",
        "run noisy",
    ):
        ended = run([environment / "bin" / "tandem", *words.split()])
        assert ended.returncode == 0, ended.stderr


OUTSIDE = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")} | {
    "UV_PYTHON_DOWNLOADS": "never"
}
"""The environment of a process that finds nothing of the clone."""


def uv(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["uv", *arguments], cwd=folder, env=OUTSIDE, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(ROOT, "wheel", tmp_path_factory.mktemp("dist"))


@pytest.mark.long
@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13"])
def test_the_wheel_runs_a_mission_in_an_empty_environment(version: str, wheel: Path, tmp_path: Path) -> None:
    python = uv(tmp_path, "python", "find", "--no-project", version)
    if python.returncode:
        pytest.skip(f"there is no Python {version}")
    run = ("tool", "run", "--isolated", "--python", python.stdout.strip(), "--from", str(wheel), "tandem")
    for scenario, says in (("paper-1", "localised after 48 ticks\n"), ("noisy", "localised after ")):
        ended = uv(tmp_path, *run, "run", scenario, "-q")
        assert ended.returncode == 0, ended.stderr
        assert ended.stdout.startswith(says)
