"""The guided play of a recording as an animated picture or a video, taken from the page in headless Chromium.

The clock of the page stands still between two frames, so that the frames do not depend on the
speed of the machine.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from compose.errors import UserError
from compose.view.web.standalone import PAGE, standalone_page

if TYPE_CHECKING:
    from PIL.Image import Image as Picture
    from playwright.sync_api import Page

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
"""The names of the program that draws the page."""
WIDTH, HEIGHT = 900, 640
"""The size of the picture in pixels."""
FRAME_MS = 250
"""The time between two frames of a picture in ms; the page lets no more pass between two of its drawings."""
VIDEO_FRAME_MS = 100
"""The time between two frames of a video in ms."""
STILL_AFTER = 6
"""The number of frames with a mark before the one that is a picture of it."""
LAST_MS = 3000
"""The time in ms for which the last frame is shown."""
MOST_MS = 300_000
"""The longest time in ms that is shown. Guided play takes about a minute."""
QUALITY = "20"
"""The constant rate factor of a video; text is sharp with it, and a smaller one makes larger files."""
STYLE = """
header, aside, #further, #legend summary, #transport button, #pace { display: none !important; }
#mission { grid-template-columns: 1fr; }
#caption { min-height: 2.8rem; }
"""
"""The style that hides the parts of the page which are not the story, or are for the mouse."""
SHARES = (1.0, 0.72, 0.45, 0.2)
"""The shares of a colour of the page on its background that are colours of the picture."""
MIXED = (("robot-a", "ink", 0.8), ("robot-b", "ink", 0.8), ("accent", "paper", 0.05))
"""Further colours of the picture, each a share of one colour on another.

They are those of contact on the time line, and of the range of an anchor.
"""
SAME = 255
"""The colour of pixels that are as in the frame before."""


def gif(folder: Path) -> bytes:
    """Return the guided play of the recording in `folder` as an animated GIF.

    Raises UserError if there is not exactly one recording, or if Chromium is not installed.
    """
    return _gif(_frames(folder, "--gif", FRAME_MS))


def mp4(folder: Path) -> bytes:
    """Return the guided play of the recording in `folder` as a video: MP4 with H.264. Raises like `gif`."""
    return _mp4(_frames(folder, "--mp4", VIDEO_FRAME_MS))


def still(folder: Path, mark: str, size: tuple[int, int]) -> bytes:
    """Return the page in guided play as a PNG file, STILL_AFTER frames after its legend first lists `mark`.

    It is the last frame if the legend never does. Raises like `gif`.
    """
    from PIL import Image  # noqa: PLC0415  # optional

    with _opened(folder, "a picture of the page", size) as page:
        marked = page.locator("#legend li").get_by_text(mark)
        after = 0
        for _ in _played(page, FRAME_MS):
            after += marked.count() > 0
            if after > STILL_AFTER:
                break
        file = BytesIO()
        with Image.open(BytesIO(page.screenshot())) as picture:
            picture.convert("RGB").quantize(256).save(file, "PNG", optimize=True)
    return file.getvalue()


def _frames(folder: Path, flag: str, frame_ms: int) -> list[bytes]:
    """Return the frames of guided play as PNG files, one for each `frame_ms`. Raises like `gif`."""
    with _opened(folder, flag, (WIDTH, HEIGHT)) as page:
        page.add_style_tag(content=STYLE)
        page.keyboard.press("f")  # a camera at rest: most of the picture stays the same
        return list(_played(page, frame_ms))


@contextmanager
def _opened(folder: Path, flag: str, size: tuple[int, int]) -> Iterator[Page]:
    """Yield the page of the recording in `folder`, whose clock stands still. Raises like `gif`."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        raise UserError(f"{flag} needs chromium: apt-get install chromium")
    html = standalone_page(folder).html
    from playwright.sync_api import sync_playwright  # noqa: PLC0415  # slow, and optional

    with TemporaryDirectory() as temporary, sync_playwright() as playwright:
        file = Path(temporary) / "run.html"
        file.write_text(html, encoding="utf-8")
        browser = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": size[0], "height": size[1]}, color_scheme="light")
        page.clock.install(time=0)
        page.goto(file.as_uri())
        page.clock.pause_at(1000)
        page.wait_for_selector("body[data-shown='0']", state="attached")
        yield page
        browser.close()


def _played(page: Page, frame_ms: int) -> Iterator[bytes]:
    """Play the page, and yield a PNG file for each `frame_ms`."""
    page.locator("#play").evaluate("(button) => button.click()")
    for _ in range(MOST_MS // frame_ms):
        page.clock.fast_forward(frame_ms)
        yield page.screenshot()
        if page.locator("#play").get_attribute("aria-label") == "Play":
            return


def _gif(frames: list[bytes]) -> bytes:
    """Return PNG files as an animated GIF; equal frames in a row become one."""
    from PIL import Image  # noqa: PLC0415  # optional

    images: list[Picture] = []
    durations: list[int] = []
    before = b""
    for frame in frames:
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
    changes = [shown[0], *[np.where(now == was, SAME, now) for was, now in pairwise(shown)]]
    first, *rest = [Image.fromarray(change.astype(np.uint8)) for change in changes]
    for image in (first, *rest):
        image.putpalette(_colours())
    file = BytesIO()
    first.save(
        file, "GIF", save_all=True, append_images=rest, duration=durations, loop=0,
        transparency=SAME, disposal=1, optimize=False,
    )  # fmt: skip
    return file.getvalue()


def _mp4(frames: list[bytes]) -> bytes:
    """Return PNG files as a video; the last one stays for LAST_MS."""
    import av  # noqa: PLC0415  # optional
    from PIL import Image  # noqa: PLC0415

    file = BytesIO()
    with av.open(file, "w", format="mp4") as video:
        stream = video.add_stream("libx264", rate=1000 // VIDEO_FRAME_MS, options={"crf": QUALITY})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for frame in frames + frames[-1:] * (LAST_MS // VIDEO_FRAME_MS):
            pixels = np.asarray(Image.open(BytesIO(frame)).convert("RGB"))
            video.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        video.mux(stream.encode())
    return file.getvalue()


def _colours() -> list[int]:
    """Return the red, green and blue of all colours of the page's light theme, their shares and MIXED."""
    theme = (PAGE / "style.css").read_text("utf-8").partition("@media")[0]
    named = {name: bytes.fromhex(colour) for name, colour in re.findall(r"--([\w-]+): #([0-9a-f]{6})", theme)}
    mixed = [(name, "paper", share) for name in named for share in SHARES] + list(MIXED)
    parts = [
        round(share * part + (1.0 - share) * back)
        for name, under, share in mixed
        for part, back in zip(named[name], named[under], strict=True)
    ]
    return parts + [0] * (3 * 256 - len(parts))
