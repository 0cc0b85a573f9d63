"""`tandem export --gif`: the guided play of a recording as an animated picture."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path
from signal import SIGINT, SIGTERM, Signals

import pytest
from PIL import Image, ImageSequence

from compose.view.web import film
from tests.commands import TandemProcess, tandem, temporary_in, until
from tests.series import series

MOST_BYTES = 500_000
"""The largest size of the picture of paper-1."""


def need_browser() -> None:
    """Skip the test where no browser is installed."""
    if not any(map(shutil.which, film.BROWSERS)):
        pytest.skip("there is no chromium: apt-get install chromium")


@pytest.mark.long
def test_the_picture_lasts_as_long_as_guided_play_and_is_small(paper_1: Path, tmp_path: Path) -> None:
    need_browser()
    ended = tandem("export", paper_1, "--gif", "--out", tmp_path)
    assert (ended.status, ended.out, ended.err) == (0, f"{tmp_path / 'run.gif'}\n", "")
    assert (tmp_path / "run.gif").stat().st_size < MOST_BYTES
    with Image.open(tmp_path / "run.gif") as picture:
        assert picture.size == (film.WIDTH, film.HEIGHT)
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(picture)]
    assert 40_000 < sum(durations) < 60_000
    assert len(durations) > 30


def test_without_a_browser_there_is_one_line(
    paper_1: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    ended = tandem("export", paper_1, "--gif", "--out", tmp_path / "out")
    message = "tandem export: --gif needs chromium: apt-get install chromium\n"
    assert ended == (2, "", message)


@pytest.mark.long
@pytest.mark.parametrize("number", series([SIGINT, SIGTERM]), ids=["SIGINT", "SIGTERM"])
def test_a_stopped_film_leaves_no_file_and_no_browser(
    number: Signals, paper_1: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A signal that reaches all processes of the command, as Ctrl-C does."""
    need_browser()
    temporary = temporary_in(tmp_path, monkeypatch)
    with TandemProcess("export", paper_1, "--gif", "--out", tmp_path / "out") as export:
        export.until(lambda: browsers(temporary), "the browser has started")
        assert export.tell(number)
        assert export.ended() == (130, "", f"tandem export: stopped by {number.name}\n")
    until(lambda: not browsers(temporary), "the browser has ended")
    assert [*temporary.iterdir()] == []
    assert not (tmp_path / "out").exists()


def browsers(temporary: Path) -> list[str]:
    """Return the ids of all processes of browsers whose profile is in `temporary`."""
    profile = f"--user-data-dir={temporary}/".encode()
    found = []
    for line in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):  # it has ended meanwhile
            found += [line.parent.name] * (profile in line.read_bytes())
    return found
