"""The guided play of a recording as an animated picture, taken from the page in headless Chromium.

The clock of the page stands still between two frames, so that the frames do not depend on the
speed of the machine.
"""

from __future__ import annotations

import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Page, sync_playwright

from compose.view.web.standalone import PAGE

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
"""The names of the program that draws the page."""
WIDTH, HEIGHT = 900, 600
"""The size of the picture in pixels."""
FRAME_MS = 250
"""The time between two frames in ms; the page lets no more pass between two of its drawings."""
STILL_AFTER = 6
"""The number of frames with a mark before the one that is a picture of it."""
MOVED = 0.025
"""The share of changed pixels from which on the camera moves. Of its movement, the last frame is shown."""
FAINT, STRONG, STRONGLY = 0.008, 0.002, 90
"""The share of changed pixels from which on something fades, or the camera comes to rest.

Less than the share STRONG then changes by more than STRONGLY, of 255. Of these, too, the last is shown.
"""
LAST_MS = 3000
"""The time in ms for which the last frame is shown."""
MOST_MS = 300_000
"""The longest time in ms that is shown. Guided play takes about a minute."""
STYLE = """
header, aside, #further, #legend summary, #transport button, #pace { display: none !important; }
#mission { grid-template-columns: 1fr; }
#caption { min-height: 2.8rem; }
"""
"""The style that hides the parts of the page which are not the story, or are for the mouse."""
COLOUR_SHARES = (1.0, 0.5)
"""The shares of a colour of the page on its background that are colours of the picture."""
MIXED = (("robot-a", "ink", 0.8), ("robot-b", "ink", 0.8), ("accent", "paper", 0.05))
"""Further colours of the picture, each a share of one colour on another.

They are those of contact on the time line, and of the range of an anchor.
"""
SAME_PIXEL = 255
"""The colour of pixels that are as in the frame before."""


def gif(html: str) -> bytes:
    """Return the guided play of the standalone page as an animated GIF."""
    with _opened(html, (WIDTH, HEIGHT)) as page:
        page.add_style_tag(content=STYLE)
        return _gif(list(_played(page)))


def still(html: str, mark: str, size: tuple[int, int]) -> bytes:
    """Return a picture of the standalone page in guided play, as a PNG file.

    It is the one STILL_AFTER frames after the legend lists `mark`; the last one if it never does.
    """
    with _opened(html, size) as page:
        marked = page.locator("#legend li").get_by_text(mark)
        after = 0
        for _ in _played(page):
            after += marked.count() > 0
            if after > STILL_AFTER:
                break
        file = BytesIO()
        with Image.open(BytesIO(page.screenshot())) as picture:
            picture.convert("RGB").quantize(256).save(file, "PNG", optimize=True)
    return file.getvalue()


@contextmanager
def _opened(html: str, size: tuple[int, int]) -> Iterator[Page]:
    """Yield the standalone page with a clock that stands still."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        sys.exit("docs/picture.py needs chromium: apt-get install chromium")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        file = Path(folder) / "run.html"
        file.write_text(html, encoding="utf-8")
        shown = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        page = shown.new_page(viewport={"width": size[0], "height": size[1]}, color_scheme="light")
        page.clock.install(time=0)
        page.goto(file.as_uri())
        page.clock.pause_at(1000)
        page.wait_for_selector("body[data-shown='0']", state="attached")
        yield page
        shown.close()


def _played(page: Page) -> Iterator[tuple[bytes, str]]:
    """Play the page, and yield a PNG file and the caption in it for each FRAME_MS."""
    page.locator("#play").evaluate("(button) => button.click()")
    for _ in range(MOST_MS // FRAME_MS):
        page.clock.fast_forward(FRAME_MS)
        yield page.screenshot(), page.locator("#caption").inner_text()
        if page.locator("#play").get_attribute("aria-label") == "Play":
            return


def _gif(frames: list[tuple[bytes, str]]) -> bytes:
    """Return PNG files with captions as an animated GIF; equal frames in a row become one."""
    images: list[Image.Image] = []
    durations: list[int] = []
    captions: list[str] = []
    before = b""
    for frame, caption in frames:
        if frame == before:
            durations[-1] += FRAME_MS
            continue
        before = frame
        images.append(Image.open(BytesIO(frame)).convert("RGB"))
        durations.append(FRAME_MS)
        captions.append(caption)
    durations[-1] = LAST_MS
    images, durations = _cut(images, durations, captions)
    palette = Image.new("P", (1, 1))
    palette.putpalette(_colours())
    shown = [np.asarray(image.quantize(palette=palette, dither=Image.Dither.NONE)) for image in images]
    changes = [shown[0], *[np.where(now == was, SAME_PIXEL, now) for was, now in pairwise(shown)]]
    first, *rest = [Image.fromarray(change.astype(np.uint8)) for change in changes]
    for image in (first, *rest):
        image.putpalette(_colours())
    file = BytesIO()
    first.save(
        file, "GIF", save_all=True, append_images=rest, duration=durations, loop=0,
        palette=bytes(_colours()), transparency=SAME_PIXEL, disposal=1, optimize=False,
    )  # fmt: skip
    return file.getvalue()


def _cut(
    images: list[Image.Image], durations: list[int], captions: list[str]
) -> tuple[list[Image.Image], list[int]]:
    """Return the frames and their durations without those in which the camera moves, or something fades.

    Each of the former would be as large as ten others, each of the latter as three. Their time is that of the
    next frame if it has the same caption, else of the frame before.
    """
    pixels = [np.asarray(image).astype(int) for image in images]
    moved = [_passing(np.abs(now - was).max(axis=2)) for was, now in pairwise(pixels)]
    kept: list[int] = []
    lasting: list[int] = []
    for i, goes_on in enumerate([*moved, False]):
        if i > 0 and moved[i - 1] and goes_on and durations[i] == FRAME_MS:
            continue
        left_out = range(kept[-1] + 1 if kept else 0, i)
        lasting.append(durations[i] + FRAME_MS * sum([captions[one] == captions[i] for one in left_out]))
        if kept:
            lasting[-2] += FRAME_MS * sum([captions[one] != captions[i] for one in left_out])
        kept.append(i)
    return [images[i] for i in kept], lasting


def _passing(change: NDArray[np.int_]) -> bool:
    """Return whether the camera moves or something fades in a frame, whose pixels differ by `change`."""
    share = float((change > 0).mean())
    return share > MOVED or (share > FAINT and float((change > STRONGLY).mean()) < STRONG)


def _colours() -> list[int]:
    """Return the red, green and blue of all colours of the page's light theme, their shares and MIXED."""
    theme = (PAGE / "style.css").read_text("utf-8").partition("@media")[0]
    named = {name: bytes.fromhex(colour) for name, colour in re.findall(r"--([\w-]+): #([0-9a-f]{6})", theme)}
    mixed = [(name, "paper", share) for name in named for share in COLOUR_SHARES] + list(MIXED)
    parts = [
        round(share * part + (1.0 - share) * back)
        for name, under, share in mixed
        for part, back in zip(named[name], named[under], strict=True)
    ]
    return parts + [0] * (3 * 256 - len(parts))
