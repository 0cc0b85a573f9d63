"""`run.rrd` opens in Rerun: its own validation passes, and its blueprint shows what the recording has."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from compose.cli import export as command
from compose.cli.main import parse
from compose.errors import UserError
from compose.launch import in_process
from compose.launch.processes import free_endpoint
from compose.recording.run import read
from compose.scenario.scenario_file import load
from compose.view.numbers import PLOTS
from tests.commands import BOUND_S, until

SOFTWARE_VULKAN = Path("/usr/lib/chromium/vk_swiftshader_icd.json")
"""The graphics driver without a graphics card that Chromium has; Rerun's viewer can use it."""


def test_without_the_library_one_line_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("compose.extras.find_spec", lambda _: None)
    with pytest.raises(UserError, match=r"needs rerun: install `tandem-ranging\[rerun\]`"):
        command.main(parse(["export", str(tmp_path), "--rerun"]))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recording that the command exports of a run with noise."""
    pytest.importorskip("rerun")
    folder = tmp_path_factory.mktemp("noisy")
    in_process.run_mission(load("noisy"), folder)
    assert command.main(parse(["export", str(folder), "--rerun"])) == 0
    return folder / "run.rrd"


def of_rerun(*words: object, home: Path) -> str:
    """Return the output of Rerun's own command."""
    ended = subprocess.run(
        [sys.executable, "-m", "rerun", *map(str, words)],
        capture_output=True,
        text=True,
        timeout=BOUND_S,
        check=False,
        env=os.environ | {"HOME": str(home)},
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout + ended.stderr


@pytest.mark.long
def test_rerun_verifies_the_file(recording: Path, tmp_path: Path) -> None:
    assert "verified without error" in of_rerun("rrd", "verify", recording, home=tmp_path)


def views(part: Any) -> Iterator[Any]:
    """Yield the views of a part of a blueprint."""
    contents = getattr(part, "contents", [])
    if isinstance(contents, str) or not any(hasattr(one, "contents") for one in contents):
        yield part
        return
    for one in contents:
        yield from views(one)


@pytest.mark.long
def test_the_blueprint_is_in_the_file_and_shows_only_what_it_has(recording: Path, tmp_path: Path) -> None:
    from compose.view.export.rerun_recording import blueprint  # noqa: PLC0415  # it imports Rerun

    printed = of_rerun("rrd", "print", recording, home=tmp_path)
    entities = {*re.findall(r"rows \([^)]*\) - /([^ ]*) - ", printed)}
    setup = read(recording.parent).setup
    assert setup is not None
    shown = {view.name: view for view in views(blueprint(setup).root_container)}
    assert {*shown} == {"Scene", *PLOTS, "Log"}
    assert "viewport" in entities
    assert sum(bool(re.fullmatch("view/[^/]*", one)) for one in entities) == len(shown)
    drawn = {f"robots/{robot}/{what}" for robot in "ab" for what in ("pose", "path", "hypotheses")}
    stage = {f"stage/{what}/{robot}" for robot in "ab" for what in ("anchor", "range", "orbit")}
    assert {*drawn, *stage, "robots/a/ellipse", "robots/a/range", "contact/a-b", "log"} <= entities
    for view in shown.values():
        contents = ["log"] if view.name == "Log" else view.contents
        for content in contents:
            found = [one for one in entities if re.fullmatch(content.replace("**", ".*"), one)]
            assert found, content
        assert {*view.visualizer_overrides} <= entities


@pytest.mark.long
@pytest.mark.skipif(not SOFTWARE_VULKAN.exists(), reason="there is no Vulkan driver without a graphics card")
def test_the_viewer_opens_all_views_without_a_complaint(recording: Path, tmp_path: Path) -> None:
    from rerun.experimental import ViewerClient  # noqa: PLC0415  # optional
    from rerun_cli import __main__ as viewer  # noqa: PLC0415

    port = int(free_endpoint().rpartition(":")[2])
    words = ["--headless", "--renderer", "vulkan", "--bind", "127.0.0.1", "--port", str(port), str(recording)]
    started = subprocess.Popen(
        [Path(str(viewer.__file__)).with_name("rerun"), *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ
        | {"HOME": str(tmp_path), "VK_DRIVER_FILES": str(SOFTWARE_VULKAN)}
        | {"LD_LIBRARY_PATH": str(SOFTWARE_VULKAN.parent)},
    )
    seen: list[Any] = []

    def opened() -> bool:
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            seen[:] = client.get_state().views
        except (RuntimeError, ConnectionError):
            return False
        return len(seen) == 5

    try:
        until(opened, "all views are open")
        client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        client.set_time("tick", sequence=15, play_state="paused")
        client.save_screenshot(str(tmp_path / "rerun.png"))
        assert [view.reports for view in client.get_state().views] == [[]] * 5
        assert (tmp_path / "rerun.png").stat().st_size > 10_000
    finally:
        started.kill()
        started.wait()
