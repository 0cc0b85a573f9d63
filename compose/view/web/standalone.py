"""The page of one recording in one HTML file, which a browser opens without a server."""

from __future__ import annotations

import base64
import html
import re
from pathlib import Path

import msgspec

from compose.errors import UserError
from compose.view.recorded import scenes
from compose.view.series import series
from compose.view.web.site import of_folder

PAGE = Path(__file__).parent / "page"
"""The folder with the files of the page."""
POLICY = "default-src 'none'; script-src 'unsafe-inline' data:; style-src 'unsafe-inline'; img-src data:"
"""The content security policy of the file: nothing is loaded from anywhere."""
IMPORTED = re.compile(r'from "\./([a-z]+\.js)"')
"""An import of another module of the page. In one file, modules have no addresses relative to each other."""


def standalone_page(folder: Path) -> tuple[str, list[str]]:
    """Return the page of the recording in `folder` as HTML, and a line for each part that cannot be read.

    Raises UserError if there is not exactly one recording.
    """
    site = of_folder(folder)
    shows = site.shows
    if site.folder is not None or len(shows) != 1:
        raise UserError(f"{folder} is not the folder of one recording")
    (show,) = shows.values()
    assert show.setup is not None
    show.known.add_costs(site.costs_of(show))
    show.live = False  # the file does not change, even if the run goes on
    recording = {
        "list": site.listed(),
        "mission": show.mission,
        "scenes": scenes(show.setup, show.known),
        "series": series(show.setup, show.known),
    }
    return _page(show.setup.name, msgspec.json.encode(recording).decode()), site.notes


def _page(title: str, recording: str) -> str:
    """Return the page with its style, modules and icon, and `recording`, a value in JSON."""
    modules = {f"page/{path.name}": _data_url(path, "text/javascript") for path in sorted(PAGE.glob("*.js"))}
    imports = msgspec.json.encode({"imports": modules}).decode()
    style = (PAGE / "style.css").read_text("utf-8")
    inside = {
        "<title>Tandem</title>": f"<title>{html.escape(title)} · Tandem</title>\n"
        f'  <meta http-equiv="Content-Security-Policy" content="{POLICY}">',
        'href="/page/icon.svg"': f'href="{_data_url(PAGE / "icon.svg", "image/svg+xml")}"',
        '<link rel="stylesheet" href="/page/style.css">': f"<style>\n{style}</style>",
        '<script type="module" src="/page/main.js"></script>': "\n  ".join(
            [
                f'<script type="importmap">{imports}</script>',
                f'<script type="application/json" id="recording">{_in_script(recording)}</script>',
                '<script type="module">import "page/main.js";</script>',
            ]
        ),
    }
    page = (PAGE / "index.html").read_text("utf-8")
    for outside, content in inside.items():
        before, found, after = page.partition(outside)
        assert found, outside
        page = before + content + after
    return page


def _data_url(path: Path, kind: str) -> str:
    """Return a file as a URL; modules import others by the names in the import map."""
    text = IMPORTED.sub(r'from "page/\1"', path.read_text("utf-8"))
    return f"data:{kind};base64,{base64.b64encode(text.encode()).decode()}"


def _in_script(value: str) -> str:
    """Return a value in JSON without the characters that could end its element."""
    return value.replace("<", "\\u003c")
