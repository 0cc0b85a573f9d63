"""`tandem export --gif` and `--mp4`: the guided play of a recording as an animated picture and as a video."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image, ImageSequence

from compose.errors import UserError
from compose.view.web import film
from tests.commands import TandemProcess, tandem

MOST_BYTES = 500_000
"""The largest size of the picture of paper-1."""
MOST_FRAMES = 600
"""The largest number of frames of the video of paper-1."""
FRAME_S = 1.0
"""The time in s in which the browser draws a frame on any machine."""


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
    assert 40_000 < sum(durations) < 60_000
    assert len(durations) > 30


@pytest.mark.long
@pytest.mark.timeout(300)  # it draws hundreds of frames
def test_the_video_lasts_as_long_as_guided_play_and_is_small(paper_1: Path, tmp_path: Path) -> None:
    if not any(map(shutil.which, film.BROWSERS)):
        pytest.skip("there is no chromium: apt-get install chromium")
    with TandemProcess("export", paper_1, "--mp4", "--out", tmp_path) as export:
        ended = export.ended(MOST_FRAMES * FRAME_S)
    assert (ended.status, ended.out, ended.err) == (0, f"{tmp_path / 'run.mp4'}\n", "")
    assert (tmp_path / "run.mp4").stat().st_size < 2 * MOST_BYTES
    with av.open(tmp_path / "run.mp4") as video:
        (stream,) = video.streams.video
        assert (stream.width, stream.height) == (film.WIDTH, film.HEIGHT)
        frames = [frame.to_ndarray(format="gray") for frame in video.decode(stream)]
    assert 40_000 < len(frames) * film.VIDEO_FRAME_MS < 60_000
    assert len(frames) < MOST_FRAMES
    changes = sum([bool(np.abs(now.astype(np.int16) - was).max() > 64) for was, now in pairwise(frames)])
    assert changes > 100


@pytest.mark.parametrize("kind", [film.gif, film.mp4])
def test_without_a_browser_there_is_one_line(
    kind: Callable[[Path], bytes], paper_1: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(film, "BROWSERS", ("no-such-browser",))
    message = f"^--{kind.__name__} needs chromium: apt-get install chromium$"
    with pytest.raises(UserError, match=message):
        kind(paper_1)
