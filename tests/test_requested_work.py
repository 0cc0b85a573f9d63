"""No folder chooses code, and work that a request to the page starts is bounded and stopped."""

from __future__ import annotations

import asyncio
import http.client
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from signal import SIGINT
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import msgspec
import pytest

import tandem
from compose.errors import UserError
from compose.launch import class_loader
from compose.scenario.shipped_files import shipped
from compose.scenario.toml_file import table_in
from compose.sweep.cells import cell_at, cells
from compose.sweep.results_folder import Manifest
from compose.sweep.spec import Axis, Sweep
from compose.sweep.table import encoded, of_rows, schema_of
from compose.sweep.trial import TrialRow
from compose.view.web import reruns, results_page
from compose.view.web.requested_work import RequestedWork
from compose.view.web.server import application
from compose.view.web.site import Site
from tests.browser import watching
from tests.commands import ENDLESS, PAPER_1, Ended, processes_of, until
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
