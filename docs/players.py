"""The hook of mkdocs that adds pages which play missions, and links to them from the first page."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from compose.launch import in_process
from compose.scenario import scenario_file
from compose.view.web.standalone import standalone_page

PLAYED = ("paper-1", "noisy", "group-8")
LINKED = "\nIt is for researchers"
"""The text of the first page before which the links are."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each of PLAYED to the files of the site."""
    for name in PLAYED:
        with tempfile.TemporaryDirectory() as folder:
            in_process.run_mission(scenario_file.load(name), Path(folder))
            html = standalone_page(Path(folder))[0]
        files.append(File.generated(config, f"play-{name}.html", content=html))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Return the text of a page, and on the first one, which GitHub shows without players, the links."""
    if page.file.src_uri != "index.md":
        return markdown
    links = ", ".join([f"[{name}](play-{name}.html)" for name in PLAYED])
    before, linked, after = markdown.partition(LINKED)
    assert linked, "the first page has no place for the links to players"
    return f"{before}\nPlay a recorded mission here: {links}.\n{linked}{after}"
