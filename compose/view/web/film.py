"""The guided play of a recording as an animated picture, taken from the page in headless Chromium.

The clock of the page stands still between two frames, so that the frames do not depend on the
speed of the machine.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from compose.errors import UserError
from compose.view.web.standalone import PAGE

if TYPE_CHECKING:
    from PIL.Image import Image as Picture
    from playwright.sync_api import Page

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
"""The names of the program that draws the page."""
WIDTH, HEIGHT = 900, 640
"""The size of the picture in pixels."""
FRAME_MS = 250
"""The time between two frames in ms; the page lets no more pass between two of its drawings."""
STILL_AFTER = 6
"""The number of frames with a mark before the one that is a picture of it."""
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
COLOUR_SHARES = (1.0, 0.72, 0.45, 0.2)
"""The shares of a colour of the page on its background that are colours of the picture."""
MIXED = (("robot-a", "ink", 0.8), ("robot-b", "ink", 0.8), ("accent", "paper", 0.05))
"""Further colours of the picture, each a share of one colour on another.

They are those of contact on the time line, and of the range of an anchor.
"""
REMOVE_S = 2.0
"""The time in s in which the processes of a browser that has been stopped end."""
SAME_PIXEL = 255
"""The colour of pixels that are as in the frame before."""


def browser(flag: str) -> str:
    """Return the path of the program that draws the page. Raises UserError, which names `flag`."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        raise UserError(f"{flag} needs chromium: apt-get install chromium")
    return found


def gif(page: str, program: str, check: Callable[[], object] = lambda: None) -> bytes:
    """Return the guided play of the standalone `page` as an animated GIF.

    `program` is the browser. `check` is called between two frames; if it raises, the browser is closed.
    """
    return _gif(_frames(page, program, check), check)


def still(html: str, program: str, mark: str, size: tuple[int, int]) -> bytes:
    """Return a picture of the standalone page in guided play, as a PNG file.

    It is the one STILL_AFTER frames after the legend lists `mark`; the last one if it never does.
    `program` is the browser.
    """
    from PIL import Image  # noqa: PLC0415  # optional

    with _opened(html, program, size, lambda: None) as page:
        marked = page.locator("#legend li").get_by_text(mark)
        after = 0
        for _ in _played(page, lambda: None):
            after += marked.count() > 0
            if after > STILL_AFTER:
                break
        file = BytesIO()
        with Image.open(BytesIO(page.screenshot())) as picture:
            picture.convert("RGB").quantize(256).save(file, "PNG", optimize=True)
    return file.getvalue()


def _frames(html: str, program: str, check: Callable[[], object]) -> list[bytes]:
    """Return the frames of guided play as PNG files."""
    with _opened(html, program, (WIDTH, HEIGHT), check) as page:
        page.add_style_tag(content=STYLE)
        page.keyboard.press("f")  # a camera at rest: most of the picture stays the same
        return list(_played(page, check))


@contextmanager
def _opened(html: str, program: str, size: tuple[int, int], check: Callable[[], object]) -> Iterator[Page]:
    """Yield the standalone page with a clock that stands still; if something fails, call `check` first."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415  # slow, and optional

    with _temporary() as folder:
        file = folder / "run.html"
        file.write_text(html, encoding="utf-8")
        try:
            with sync_playwright() as playwright:
                shown = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
                page = shown.new_page(viewport={"width": size[0], "height": size[1]}, color_scheme="light")
                page.clock.install(time=0)
                page.goto(file.as_uri())
                page.clock.pause_at(1000)
                page.wait_for_selector("body[data-shown='0']", state="attached")
                yield page
                shown.close()
        except Exception:
            check()  # Ctrl-C in a terminal reaches Playwright's own process, too
            raise


@contextmanager
def _temporary() -> Iterator[Path]:
    """Yield a folder for all temporary files, the browser's included, and remove it with them."""
    before = os.environ.get("TMPDIR")
    folder = Path(tempfile.mkdtemp(prefix="tandem-"))
    os.environ["TMPDIR"] = str(folder)
    try:
        yield folder
    finally:
        if before is None:
            del os.environ["TMPDIR"]
        else:
            os.environ["TMPDIR"] = before
        give_up, used = time.monotonic() + REMOVE_S, True
        while (used or folder.exists()) and time.monotonic() < give_up:
            used = _killed(folder)  # a process of the browser that is about to end may make it again
            shutil.rmtree(folder, ignore_errors=True)


def _killed(folder: Path) -> bool:
    """Kill the processes that have a path in `folder` in their command line; return whether there are any."""
    name, found = os.fsencode(folder), False
    for line in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):  # it has ended meanwhile
            if name in line.read_bytes():
                found = True
                os.kill(int(line.parent.name), signal.SIGKILL)
    return found


def _played(page: Page, check: Callable[[], object]) -> Iterator[bytes]:
    """Play the page, and yield a PNG file for each FRAME_MS."""
    page.locator("#play").evaluate("(button) => button.click()")
    for _ in range(MOST_MS // FRAME_MS):
        check()
        page.clock.fast_forward(FRAME_MS)
        yield page.screenshot()
        if page.locator("#play").get_attribute("aria-label") == "Play":
            return


def _gif(frames: list[bytes], check: Callable[[], object]) -> bytes:
    """Return PNG files as an animated GIF; equal frames in a row become one."""
    from PIL import Image  # noqa: PLC0415  # optional

    images: list[Picture] = []
    durations: list[int] = []
    before = b""
    for frame in frames:
        check()
        if frame == before:
            durations[-1] += FRAME_MS
            continue
        before = frame
        images.append(Image.open(BytesIO(frame)).convert("RGB"))
        durations.append(FRAME_MS)
    durations[-1] = LAST_MS
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
        transparency=SAME_PIXEL, disposal=1, optimize=False,
    )  # fmt: skip
    return file.getvalue()


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
