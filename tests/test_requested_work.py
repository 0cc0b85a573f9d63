"""No folder chooses code, requested work and documents are bounded, and modules that clash are named."""

from __future__ import annotations

import ast
import asyncio
import http.client
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from signal import SIGINT
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import msgspec
import pytest

import tandem
from compose.errors import USER_ERROR, NotToml, UserError
from compose.launch import class_loader
from compose.recording.run import read
from compose.scenario.shipped_files import shipped
from compose.scenario.toml_file import table_in
from compose.sweep import results_folder, spec
from compose.sweep.cells import cell_at, cells
from compose.sweep.results_folder import Manifest
from compose.sweep.spec import Axis, Sweep
from compose.sweep.table import encoded, of_rows, schema_of
from compose.sweep.trial import TrialRow
from compose.view.web import reruns, results_page
from compose.view.web.requested_work import RequestedWork
from compose.view.web.server import application
from compose.view.web.site import Site
from compose.view.web.sources import Recorded
from protocol import documents
from protocol.documents import MOST_NESTED, Syntax, TooNested, check_nesting
from protocol.network.endpoints import BadConfiguration, configured
from tandem import clash
from tests.browser import watching
from tests.commands import ENDLESS, PAPER_1, Ended, copied, processes_of, until
from tests.commands import tandem as command
from tests.series import series

CLASSES = """
from pathlib import Path
from tests.own_models import Long as Model
from tests.own_planners import Wrapping as Planner
(Path(__file__).parent / "imported").touch()
"""
"""A module that leaves a mark when it is imported."""


def results(folder: Path, text: str, *axes: Axis) -> Path:
    """Return a new folder with the results of a sweep of the scenario `text`: one trial of its cell 0."""
    sweep = Sweep("it.toml", "it", table_in(text, "it"), axes, 1, 1, 60.0)
    (folder / "sweep.json").write_bytes(msgspec.json.encode(Manifest(sweep, {})))
    known = {0: cell_at(sweep, 0)}
    rows = [TrialRow(0, 0, 1, "failed", error="lost")]
    table = of_rows(rows, sweep, known, schema_of(sweep, [*known.values()]))  # type: ignore[arg-type,list-item]
    (folder / "trials.parquet").write_bytes(encoded(table))
    return folder


def answered(address: str, path: str, body: object = None) -> tuple[int, Any]:
    """Return the status and the answer to a request of the page: a POST if it has a body."""
    heads = {"Origin": address.rstrip("/"), "Content-Type": "application/json"}
    data = None if body is None else json.dumps(body).encode()
    try:
        with urlopen(Request(f"{address}api/{path}", data, heads), timeout=60) as answer:
            return answer.status, json.load(answer)
    except HTTPError as error:
        return error.code, json.load(error)


# --- who chooses which code runs ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with `stranger.py`, and recordings and results of sweeps that name its classes."""
    folder = tmp_path_factory.mktemp("stranger")
    (folder / "stranger.py").write_text(CLASSES)
    text = PAPER_1.replace('"paper"', '"stranger:Planner"')
    noisy = shipped()["noisy"].read_text()
    modelled = f'max_ticks = 3\n{noisy}\n[world.range]\nmodel = "stranger:Model"\n'
    for name, scenario in (("planner", text), ("model", modelled)):
        (folder / f"{name}.toml").write_text(scenario)
        ended = command("run", f"{name}.toml", "--in-process", "--out", name, cwd=folder)
        assert ended.status in (0, 1), ended
        (folder / f"{name}-sweep").mkdir()
        results(folder / f"{name}-sweep", scenario)
    (folder / "other.toml").write_text('name = "it"\nscenario = "paper-1"\ntrials = 1\nseed = 1\n')
    (folder / "imported").unlink()
    return folder


@pytest.fixture
def mark(stranger: Path) -> Iterator[Path]:
    """Yield the file that importing the module leaves."""
    yield stranger / "imported"
    (stranger / "imported").unlink(missing_ok=True)


@pytest.mark.parametrize("name", series(["planner", "model"]))
def test_no_reader_of_a_recording_or_of_results_imports_what_they_name(
    name: str, stranger: Path, mark: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ran(*words: str) -> Ended:
        ended = command(*words, cwd=stranger)
        assert not mark.exists(), words
        assert ended.status != 70
        return ended

    asks = f"to run its code, add --{name} stranger:{name.title()}\n"
    for verb in ("audit", "replay"):
        refused = ran(verb, name)
        assert refused.status == 2
        assert refused.err.endswith(asks)
    for words in (
        ("figures", name, "--only", "trajectory", "--format", "svg"),
        ("export", name),
        ("sweep", "other.toml", "--out", f"{name}-sweep"),  # which is of another sweep
        ("estimate", name),
        ("calibrate", name),
        ("ps",),
    ):
        ran(*words)
    monkeypatch.chdir(stranger)
    monkeypatch.setattr(class_loader, "_trusted", set())
    with pytest.raises(UserError, match="to run its code"):
        tandem.open(name).audit()
    assert not mark.exists()


def test_a_file_of_settings_in_the_working_directory_changes_no_figure(tmp_path: Path) -> None:
    """It could start LaTeX. Matplotlib reads it when it is imported, so this is a process of its own."""
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\naxes.facecolor: red\n")
    code = (
        "from compose.figures import style\nimport matplotlib as mpl\nassert mpl.rcParams['text.usetex']\n"
        "with style.look(style.SCREEN):\n assert not mpl.rcParams['text.usetex']\n"
        " assert mpl.rcParams['axes.facecolor'] != 'red'\n"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True, timeout=60)


@pytest.mark.parametrize("name", series(["planner", "model"]))
@pytest.mark.long
def test_the_page_imports_what_a_folder_names_only_if_a_flag_does(
    name: str, stranger: Path, mark: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(stranger)
    asks = f"the {name} is stranger:{name.title()}; to run its code, add --{name} stranger:{name.title()}"
    with watching(f"{name}-sweep") as (_, address):
        status, answer = answered(address, "cells/0/worst", {})
        assert status == 422
        assert answer["error"].endswith(asks)
        assert not mark.exists()
    with watching(f"{name}-sweep", f"--{name}", f"stranger:{name.title()}") as (_, address):
        assert answered(address, "cells/0/worst", {})[0] == 200
        assert mark.exists()
    mark.unlink()
    if name == "planner":  # a recording whose model is not known is refused at once
        with watching("planner") as (_, address):
            assert answered(address, "shows/planner/values") == (422, {"error": asks})
        assert not mark.exists()


# --- bounds -------------------------------------------------------------------------------------------


def test_ctrl_c_ends_a_page_whose_request_is_being_computed(tmp_path: Path) -> None:
    with watching(results(tmp_path, ENDLESS)) as (page, address):
        connection = http.client.HTTPConnection(address.removeprefix("http://").rstrip("/"))
        connection.request("POST", "/api/cells/0/worst")
        until(lambda: working_for(page.pid), "the request is computed")
        began = time.monotonic()
        page.tell(SIGINT)
        assert page.ended().status == 130
        assert time.monotonic() - began < 0.5 * reruns.TRIAL_S, "the work was not waited for"
        assert page.err == ""
        connection.close()
        until(lambda: not working_for(page.pid), "its process has ended")


def working_for(page: int) -> bool:
    """Return whether a process computes a request to the page's process."""
    return any("requested" in words for words in processes_of(str(page)).values())


def test_work_beyond_its_deadline_is_ended_with_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reruns, "TRIAL_S", 0.2)
    work = RequestedWork()
    with pytest.raises(UserError, match=r"^the trial has not ended after 0.2 s: print its scenario with"):
        (slow := reruns.Trials(results(tmp_path, ENDLESS), work)).worst(0)
    slow.close()
    work.stop()
    with pytest.raises(UserError, match="the server has been stopped"):
        work.result(reruns.run_worst, within=1.0, late="")


def test_a_cell_is_found_without_those_before_it(tmp_path: Path) -> None:
    axes = [
        Axis(f"x{i}", (f"x{i}",), ((f"x{i}",),), tuple((value,) for value in range(10)), None, paired=False)
        for i in range(12)
    ]
    few = Sweep("it", "it", {}, tuple(axes[:2]), 1, 1, 1.0)
    assert [cell_at(few, i) for i in range(100)] == [*cells(few)]
    assert cell_at(few, 100) is None
    site = Site(folder=results(tmp_path, PAPER_1, *axes))
    for cell, status in ((10**12 - 1, 422), (10**12, 422), (10**300, 404), ("-1", 404), ("x", 404)):
        assert posted(site, f"/api/cells/{cell}/worst", "127.0.0.1")[0] == status
    site.stop()


def test_only_browsers_on_this_machine_start_missions(tmp_path: Path) -> None:
    site = Site(folder=results(tmp_path, PAPER_1))
    status, answer = posted(site, "/api/cells/0/worst", "192.0.2.7")
    assert status == 403
    assert answer == {"error": "missions are run again for browsers on the server's machine only"}
    assert posted(site, "/api/cells/0/worst", "127.0.0.1")[0] == 200
    site.stop()


def test_links_and_what_is_no_file_are_not_served(tmp_path: Path) -> None:
    (tmp_path / "secret.svg").write_text("secret")
    folder = tmp_path / "stranger"
    (folder / "figures").mkdir(parents=True)
    results(folder, PAPER_1)
    (folder / "figures" / "good.svg").write_text("good")
    (folder / "figures" / "link.svg").symlink_to(tmp_path / "secret.svg")
    (folder / "figures" / "device.svg").symlink_to("/dev/zero")
    (folder / "figures" / "folder.svg").mkdir()
    os.mkfifo(folder / "figures" / "pipe.svg")
    site = Site(folder=folder)
    assert results_page.of_sweep(folder)["figures"] == ["good.svg"]
    assert site.figure("good.svg") == b"good"
    for name in ("link", "device", "folder", "pipe", "none"):
        assert site.figure(f"{name}.svg") is None
    (folder / "figures").rename(tmp_path / "elsewhere")
    (folder / "figures").symlink_to(tmp_path / "elsewhere")
    assert results_page.of_sweep(folder)["figures"] == []
    for name in ("summary.csv", "sweep.json"):
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(tmp_path / "secret.svg")
        with pytest.raises(UserError, match="cannot be read: it is a link"):
            results_page.of_sweep(folder)
    site.stop()


def posted(site: Site, path: str, client: str) -> tuple[int, Any]:
    """Return the status and the answer to a POST to the application of `site`, from the address `client`."""
    sent: list[Any] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {"type": "http", "method": "POST", "path": path, "query_string": b"", "client": (client, 50000)}
    scope["headers"] = [(b"host", b"localhost")]
    asyncio.run(application(site)(scope, receive, send))
    return sent[0]["status"], json.loads(sent[1]["body"])


NESTED = 100_000 * '{"a":'
PARSERS = {"msgspec.json.decode", "msgspec.json.Decoder", "msgspec.toml.decode", "json.loads", "json.load"}
"""The functions that parse what `protocol.documents` checks."""
OWN = {
    "compose/view/foxglove/layout.py",  # what a library returned
    "protocol/network/endpoints.py",  # what Zenoh returned of a configuration that was checked
    "protocol/documents.py",
}


def test_a_recording_with_nested_files_is_read_without_them(paper_1: Path, tmp_path: Path) -> None:
    copied(paper_1, tmp_path)
    for name in ("summary.json", "kills.jsonl"):
        (tmp_path / name).write_text(f"{NESTED}\n")
    note = f"{tmp_path / 'kills.jsonl'}: line 1: it is nested more than {MOST_NESTED} deep"
    assert read(tmp_path).notes[0].startswith(note)
    assert tandem.open(tmp_path).mode is None
    show = Recorded("", tmp_path)
    show.load()
    assert show.setup is not None
    assert show.notes[0].startswith(note)
    for verb in ("audit", "replay"):
        ended = command(verb, tmp_path)
        assert ended.status == 0
        assert ended.err.startswith(f"tandem {verb}: {note}")


def test_nested_results_are_one_line(tmp_path: Path) -> None:
    for name in ("sweep.json", "estimate.json"):
        (tmp_path / name).write_text(NESTED)
    sweep = spec.load("noise")
    readers: list[Callable[[], Any]] = [
        lambda: results_page.of_sweep(tmp_path),
        lambda: results_page.of_estimate(tmp_path),
        lambda: _entered(results_folder.opened(tmp_path, sweep)),
    ]
    for reader in readers:
        with pytest.raises(UserError, match=f"nested more than {MOST_NESTED} deep"):
            reader()


def _entered(context: AbstractContextManager[Any]) -> None:
    with context:
        pass


@pytest.mark.parametrize(
    ("text", "syntax"),
    [
        ("[" * 100_000, "JSON"),
        (NESTED, "JSON"),
        (f"{'[' * 65}{']' * 65}", "JSON"),
        (f"a{50_000 * '.a'} = 1", "TOML"),
        (f"[a{50_000 * '.a'}]", "TOML"),
        (f"a{33 * '.a'} = {{ a{33 * '.a'} = 1 }}", "TOML"),
        (f"a = {'[' * 100_000}", "TOML"),
        (f"// a 'comment'\n{NESTED}", "JSON5"),
        (f"{{a: '\"', /* ' */ b: {'[' * 100_000}", "JSON5"),
    ],
)
def test_what_is_nested_too_deeply_is_refused_before_it_is_parsed(
    text: str, syntax: Syntax, tmp_path: Path
) -> None:
    began = time.process_time()
    with pytest.raises(TooNested):
        check_nesting(text, syntax)
    if syntax == "TOML":
        with pytest.raises(NotToml, match=r"^it: not TOML: it is nested"):
            table_in(text, "it")
    if syntax == "JSON5":
        (tmp_path / "zenoh.json5").write_text(text)
        with pytest.raises(BadConfiguration, match=r"zenoh\.json5: it is nested"):
            configured(tmp_path / "zenoh.json5")
    assert time.process_time() - began < 2.0


@pytest.mark.parametrize(
    ("text", "syntax"),
    [
        (json.dumps({"a": "[" * 1000, '"{' * 100: [[]] * 1000}), "JSON"),
        (f"{'[' * 64}{']' * 64}", "JSON"),
        (f"a = [{1000 * '0.5, '}]\n{''.join([f'b{i} = 1.5{chr(10)}' for i in range(100)])}", "TOML"),
        (f"# {'[' * 99}\na = '{'[' * 99}'\nb = \"\"\"\"{'[' * 99}\"\"\"\nc = '''{'.' * 99}'''", "TOML"),
        (f"{{ // {'[' * 99}\n /* {'{' * 99} */ a: '{'[' * 99}', b: \"'{'[' * 99}\" }}", "JSON5"),
        *[(path.read_text(), "TOML") for path in shipped().values()],
    ],
)
def test_brackets_in_strings_and_comments_do_not_nest(text: str, syntax: Syntax) -> None:
    check_nesting(text, syntax)
    if syntax != "JSON5":
        (documents.json_value if syntax == "JSON" else documents.toml_table)(text)


def test_a_document_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "sweep.json").open("wb") as file:
        file.truncate(10 << 30)
    with pytest.raises(UserError, match=f"larger than {documents.MOST_DOCUMENT_BYTES} bytes"):
        results_page.of_sweep(tmp_path)


@pytest.mark.long
def test_no_other_module_parses_documents() -> None:
    root = Path(__file__).parents[1]
    for package in ("agent", "compose", "protocol", "tandem", "world"):
        for path in sorted((root / package).rglob("*.py")):
            called = {
                ast.unparse(node)
                for node in ast.walk(ast.parse(path.read_text()))
                if isinstance(node, ast.Attribute)
            }
            assert not called & PARSERS or str(path.relative_to(root)) in OWN, path


ROOT = Path(__file__).parents[1]


def ended(folder: Path, *words: str, path: Path | None = None) -> tuple[int, list[str]]:
    """Return the exit status and the standard error of Python with `path` in front, run in `folder`."""
    found = os.pathsep.join([str(one) for one in (path, ROOT) if one is not None])
    ran = subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": found},
        capture_output=True,
        text=True,
        check=False,
    )
    return ran.returncode, ran.stderr.splitlines()


def module(folder: Path, name: str) -> Path:
    """Return the file of a new package `name` in `folder`."""
    file = folder / name / "__init__.py"
    file.parent.mkdir()
    file.write_text("")
    return file


@pytest.mark.parametrize("name", clash.PACKAGES)
def test_the_command_names_the_module_that_clashes_and_where_it_is(name: str, tmp_path: Path) -> None:
    file = module(tmp_path, name)
    status, lines = ended(tmp_path, "-P", "-m", "tandem", "run", "paper-1", path=tmp_path)
    assert status == USER_ERROR
    assert len(lines) == 1
    assert lines[0].startswith(f"tandem: the module '{name}' is {file}, but Tandem")
    assert f"remove {tmp_path} from PYTHONPATH" in lines[0]


def test_a_script_beside_such_a_module_gets_an_error_that_names_it(tmp_path: Path) -> None:
    file = tmp_path / "world.py"
    file.write_text("")
    (tmp_path / "script.py").write_text("import tandem\ntandem.run('paper-1')\n")
    status, lines = ended(tmp_path, "script.py")
    assert status == 1
    assert lines[-1].startswith(f"tandem.clash.ModuleClash: the module 'world' is {file}, ")
    assert lines[-1].count(str(tmp_path)) == 2


def test_a_module_that_a_script_has_imported_already_clashes(tmp_path: Path) -> None:
    code = "import sys, types; sys.modules['agent'] = types.ModuleType('agent'); import tandem; tandem.Run"
    status, lines = ended(tmp_path, "-P", "-c", code)
    assert status == 1
    assert "the module 'agent' is a module 'agent' without a file" in lines[-1]


def test_a_folder_without_modules_does_not_clash(tmp_path: Path) -> None:
    """Python prefers a package to a folder without `__init__.py`."""
    (tmp_path / "world").mkdir()
    assert ended(tmp_path, "-P", "-m", "tandem", "scenarios", path=tmp_path) == (0, [])


def test_processes_of_a_run_import_what_their_launcher_imports(tmp_path: Path) -> None:
    """The launcher finds Tandem first, by a path of its own; PYTHONPATH alone gives the user's module."""
    module(tmp_path, "world").write_text("raise SystemExit('the wrong world')")
    code = (
        f"import sys; sys.path.insert(0, {str(ROOT)!r}); import tandem; "
        "assert tandem.run('paper-1', processes=True).outcome == 'localised'"
    )
    assert ended(tmp_path, "-P", "-c", code, path=tmp_path) == (0, [])
