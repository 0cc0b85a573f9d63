"""`tandem export --gif`: the guided play of a recording as an animated picture."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from PIL import Image, ImageSequence

from compose.errors import UserError
from compose.view.web import film
from tests.commands import tandem

MOST_BYTES = 600_000
"""The largest size of the picture of paper-1."""


@pytest.mark.long
def test_the_picture_lasts_as_long_as_guided_play_and_is_small(paper_1: Path, tmp_path: Path) -> None:
    if not any(map(shutil.which, film.BROWSERS)):
        pytest.skip("there is no chromium: apt-get install chromium")
    ended = tandem("export", paper_1, "--gif", "--out", tmp_path)
    assert (ended.status, ended.out, ended.err) == (0, f"{tmp_path / 'run.gif'}\n", "")
    assert (tmp_path / "run.gif").stat().st_size < MOST_BYTES
    with Image.open(tmp_path / "run.gif") as picture:
        assert picture.size == (film.WIDTH, film.HEIGHT)
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(picture)]
    assert 30_000 < sum(durations) < 50_000
    assert len(durations) > 30


def test_without_a_browser_there_is_one_line(paper_1: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(film, "BROWSERS", ("no-such-browser",))
    with pytest.raises(UserError, match=r"^--gif needs chromium: apt-get install chromium$"):
        film.film(paper_1)
