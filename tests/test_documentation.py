"""The README and the documentation: their commands run, and their names are those of the code.

Each page is run from top to bottom in a folder of its own. A fenced block of `sh` is run command by command,
a block of `python` as a script. A comment in the line before a block changes that:

- `<!-- file: NAME -->` writes the block to that file;
- `<!-- exit status: N -->` is the exit status of its commands, which is 0 otherwise;
- `<!-- together -->` is a block whose commands run at the same time, and have a test of their own;
- `<!-- not run: REASON -->` is a block whose commands are only parsed.
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from playwright.sync_api import Browser, expect

from compose import errors
from compose.audit import rules
from compose.cli import commands, main
from compose.figures import PICTURES
from compose.launch.processes import free_endpoint
from docs import constraints, reference
from tests.browser import until_shown
from tests.commands import OVER, Ended, TandemProcess, tandem
from tests.series import series

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = [README, ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
MAX_WORDS = 1200
MAX_LINES = 200
MAX_WORDS_OF_DOCS = 35_000
"""The budget of README and docs, without code, and without what `docs/reference.py` writes. Raise it only for
what a user needs."""
BLOCK = re.compile(
    r"(?:^<!-- (?P<comment>[^\n]*) -->\n)?^```(?P<language>\w+)\n(?P<text>.*?)^```$", re.M | re.S
)
DRIVEN = ("tandem", "cp", "cmp")
"""commands that are run; others belong to the reader's system, or to the development of Tandem"""
ROBOT_BOUND_S = 120.0


class Block(NamedTuple):
    """A fenced block of a page, with the comment before it."""

    comment: str
    language: str
    text: str

    @property
    def run(self) -> bool:
        """True if a test runs it with its page."""
        return not self.comment.startswith(("not run", "together"))

    @property
    def status(self) -> int:
        """The exit status of its commands."""
        found = re.search(r"exit status: (\d)", self.comment)
        return int(found[1]) if found is not None else 0

    @property
    def file(self) -> str | None:
        """The name of the file that it is."""
        return self.comment.removeprefix("file: ") if self.comment.startswith("file: ") else None

    def commands(self) -> Iterator[list[str]]:
        """Yield its commands as words, without `uv run`, comments and prompts."""
        for line in self.text.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words:
                yield words[2:] if words[:2] == ["uv", "run"] else words


def blocks(page: Path) -> list[Block]:
    """Return the fenced blocks of a page, in order."""
    return [
        Block(one["comment"] or "", one["language"], one["text"]) for one in BLOCK.finditer(page.read_text())
    ]


def tandem_commands(page: Path) -> list[list[str]]:
    """Return the arguments of every `tandem` command in the blocks of a page."""
    shells = [one for one in blocks(page) if one.language == "sh"]
    return [words[1:] for one in shells for words in one.commands() if words[0] == "tandem"]


def mentioned(page: Path) -> list[list[str]]:
    """Return the arguments of every `tandem` command in the running text of a page; some may be missing."""
    text = BLOCK.sub("", page.read_text())
    return [quoted.split() for quoted in re.findall(r"`(?:uv run )?tandem ([a-z-][^`]*)`", text)]


def run_page(page: Path, folder: Path) -> None:
    """Run the blocks of a page in `folder`."""
    for block in blocks(page):
        if block.file is not None:
            (folder / block.file).write_text(block.text)
        elif block.language == "python" and block.run and "..." not in block.text:
            ran = subprocess.run(
                [sys.executable, "-c", block.text], cwd=folder, capture_output=True, text=True, check=False
            )
            assert ran.returncode == 0, f"{block.text}\n{ran.stderr}"
        elif block.language == "sh" and block.run:
            for words in block.commands():
                if words[0] in DRIVEN:
                    run_command(words, block.status, folder)


def run_command(words: list[str], status: int, folder: Path) -> None:
    """Run one command in `folder`, and check its exit status."""
    if words[0] == "tandem":
        ended = tandem(*words[1:], cwd=folder)
        assert ended.status == status, f"tandem {shlex.join(words[1:])}: {ended}"
    else:
        assert subprocess.run(words, cwd=folder, check=False).returncode == status, shlex.join(words)


def runnable(page: Path) -> bool:
    return any(one.run and one.language in ("sh", "python") for one in blocks(page))


def prepare(folder: Path) -> None:
    """Put into `folder` the file of the repository that commands of the pages name."""
    (folder / "docs").mkdir()
    shutil.copyfile(ROOT / "docs" / "rover.py", folder / "docs" / "rover.py")


@pytest.mark.timeout(300)
@pytest.mark.parametrize("page", series(filter(runnable, PAGES)), ids=lambda one: one.stem)
def test_the_commands_of_a_page_run(page: Path, tmp_path: Path) -> None:
    """README first, which is the one that every run of the tests checks."""
    prepare(tmp_path)
    run_page(page, tmp_path)


@pytest.mark.parametrize("page", PAGES, ids=lambda one: one.stem)
def test_every_command_of_a_page_exists_with_its_flags(
    page: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in tandem_commands(page):
        if words == ["--version"]:
            continue
        try:
            main.parse(words)
        except SystemExit:
            pytest.fail(f"{page.name}: tandem {shlex.join(words)}: {capsys.readouterr().err}")
    options = flags()
    for words in mentioned(page):
        if words[0] not in ("--version", "--help"):
            assert words[0] in options, f"{page.name}: tandem {words[0]}"
            wrong = {word for word in words[1:] if word.startswith("-") and word != "-"} - options[words[0]]
            assert not wrong, f"{page.name}: tandem {words[0]}: {wrong}"


def flags() -> dict[str, set[str]]:
    """Return the flags of each command."""
    return {
        command.name: {
            flag for action in main.command_parser(command)._actions for flag in action.option_strings
        }
        for command in commands.COMMANDS
    }


@pytest.mark.timeout(300)
@pytest.mark.long
def test_the_pair_of_the_tutorial_localises(tmp_path: Path) -> None:
    page = ROOT / "docs" / "tutorial-robot.md"
    (block,) = (one for one in blocks(page) if one.comment == "together")
    beacon, *robots = block.commands()
    assert beacon[0] == "docs/rover.py"
    prepare(tmp_path)
    listening = [sys.executable, "-P", str(ROOT / beacon[0]), "--reach", beacon[beacon.index("--reach") + 1]]
    with subprocess.Popen(listening, stdout=subprocess.PIPE, text=True, cwd=ROOT) as radio:
        try:
            assert radio.stdout is not None
            port = radio.stdout.readline().rpartition(":")[2].strip()
            endpoint = free_endpoint()
            a, b = (
                [
                    word.replace("127.0.0.1:4747", f"127.0.0.1:{port}").replace(
                        "tcp/127.0.0.1:7447", endpoint
                    )
                    for word in words
                ]
                for words in robots
            )
            with TandemProcess(*a[1:], cwd=tmp_path) as first, TandemProcess(*b[1:], cwd=tmp_path) as second:
                for ended in (first.ended(ROBOT_BOUND_S), second.ended(ROBOT_BOUND_S)):
                    assert ended.status in OVER, ended
        finally:
            radio.kill()
    shutil.copyfile(
        tmp_path / "recording-b" / "agent-b.journal", tmp_path / "recording-a" / "agent-b.journal"
    )
    assert tandem("replay", "recording-a", cwd=tmp_path).status == 0


def shown(ended: Ended) -> str:
    """Return an output without its rounding errors, which differ from one processor to another."""
    return re.sub(r"\d\.\de-\d\d", "ROUNDING", ended.out)


@pytest.mark.parametrize("page", [README, ROOT / "docs" / "tutorial-mission.md"], ids=lambda one: one.stem)
def test_the_output_shown_for_the_first_command_is_its_output(page: Path) -> None:
    text = next(one.text for one in blocks(page) if one.language == "text")
    assert re.sub(r"\d\.\de-\d\d", "ROUNDING", text) in shown(tandem("run", "paper-1"))


def test_the_readme_is_short() -> None:
    text = README.read_text()
    assert len(text.split()) < MAX_WORDS
    assert len(text.splitlines()) <= MAX_LINES


def test_the_documentation_keeps_its_budget_of_words() -> None:
    words = {}
    for page in (one for one in PAGES if one.name != "CONTRIBUTING.md"):
        text = BLOCK.sub("", reference.PLACE.sub("", page.read_text()))
        words[page.name] = len(text.split())
    assert sum(words.values()) < MAX_WORDS_OF_DOCS, sorted(words.items(), key=lambda one: -one[1])[:8]


@pytest.mark.parametrize("page", [one for one in PAGES if one.parent == ROOT], ids=lambda one: one.stem)
def test_links_of_a_page_outside_the_site_lead_to_files(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if "://" not in link:
            assert (ROOT / link.partition("#")[0]).exists(), f"{page.name}: {link}"


def first_column(page: Path, heading: str) -> list[str]:
    """Return the quoted names in the first column of the table below that heading row."""
    _, _, below = page.read_text().partition(heading)
    names: list[str] = []
    for line in below.splitlines()[2:]:
        if not line.startswith("|"):
            break
        names += re.findall(r"`([^`]+)`", line.split("|")[1])
    return names


def test_the_page_of_the_audit_lists_the_rules_of_hardware_mode() -> None:
    page = ROOT / "docs" / "howto-audit.md"
    named = ", ".join(f"`{rule.__name__}`" for rule in rules.HARDWARE_RULES[:-1])
    assert f"{named} and `{rules.HARDWARE_RULES[-1].__name__}`" in " ".join(page.read_text().split())


def test_the_page_of_the_figures_lists_their_names() -> None:
    assert first_column(ROOT / "docs" / "howto-figures.md", "| `--only` | file | content |") == [*PICTURES]


def test_the_page_of_exit_statuses_has_those_of_the_code() -> None:
    page = (ROOT / "docs" / "exit-statuses.md").read_text()
    listed = {int(status) for status in re.findall(r"^\| (\d+) \|", page, re.M)}
    assert listed == {
        value for name, value in vars(errors).items() if name.isupper() and isinstance(value, int)
    }


def test_every_generated_table_is_on_a_page_and_explains_each_row() -> None:
    used = [name for page in PAGES for name in reference.BEGIN.findall(page.read_text())]
    assert sorted(used) == sorted(reference.TABLES)
    for name, table in reference.TABLES.items():
        if name.startswith("results-"):
            continue
        lines = table().splitlines()
        assert any(line.startswith(("| `", "| proto")) for line in lines), name
        assert not [line for line in lines if line.endswith("|  |")], f"{name}: a field without a meaning"


def write_tables(docs: Path, *flags: str) -> int | str | None:
    """Run the script that writes the generated tables, and return its exit status."""
    with pytest.raises(SystemExit) as end:
        reference.main(flags, docs)
    return end.value.code


def test_the_tables_on_the_pages_are_those_of_the_code_and_one_command_writes_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert write_tables(ROOT / "docs", "--check") == 0, (
        f"run `uv run docs/reference.py`: {capsys.readouterr().out}"
    )
    text = (ROOT / "docs" / "recordings.md").read_text()
    page = tmp_path / "recordings.md"
    page.write_text(text.replace("| `tick` |", "| `tock` |"))
    assert write_tables(tmp_path, "--check") == 1
    assert capsys.readouterr().out == "recordings.md\n"
    assert write_tables(tmp_path) == 0
    assert page.read_text() == text
    page.write_text(text.replace("<!-- end of tick-columns -->", ""))
    assert str(write_tables(tmp_path)).startswith("recordings.md: a table has no line `<!-- end of NAME -->`")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the built site."""
    pytest.importorskip("material")
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", folder],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stdout + built.stderr
    return folder


@pytest.mark.long
def test_the_site_is_built_without_a_warning_and_loads_nothing_from_other_hosts(site: Path) -> None:
    for page in site.rglob("*.html"):
        loaded = re.findall(
            r'<(?:script|img|iframe)[^>]* src="([^"]*)"|<link[^>]* href="([^"]*)"', page.read_text()
        )
        assert not [one for pair in loaded for one in pair if "//" in one], page.name
    equations = re.findall(r"<math .*?</math>", (site / "method.html").read_text())
    assert len(equations) == (ROOT / "docs" / "method.md").read_text().count("$$") / 2


@pytest.mark.long
def test_figures_follow_their_sliders_no_page_is_wider_than_a_telephone_and_missions_are_played(
    site: Path, browser: Browser
) -> None:
    page = browser.new_page(viewport={"width": 390, "height": 844})
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto((site / "method.html").as_uri())
    figures = page.locator("figure[data-figure]")
    assert figures.count() == 5
    for figure in figures.all():
        said, drawn = figure.locator("output").inner_text(), figure.locator("svg").inner_html()
        figure.locator("input").press("End")
        assert figure.locator("output").inner_text() != said
        assert figure.locator("svg").inner_html() != drawn
    for name in ("index", "method", "peers", "results", "glossary"):
        page.goto((site / f"{name}.html").as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= 390, name
    page.goto((site / "index.html").as_uri())
    page.get_by_role("link", name="noisy").click()
    until_shown(page, 0)
    page.keyboard.press("End")
    expect(page.locator("#status")).to_have_text(re.compile("localised after"))
    assert errors == []


def test_the_project_has_one_version_and_lists_tested_versions_of_its_dependencies() -> None:
    text = (ROOT / "pyproject.toml").read_text()
    project = tomllib.loads(text)
    version = project["project"]["version"]
    assert f"version: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"## {version}\n" in (ROOT / "CHANGELOG.md").read_text()
    assert f"tandem_ranging-{version}.tar.gz" in (ROOT / "docs" / "howto-raspberry-pi.md").read_text()
    listed = constraints.pinned(text)
    extras = project["project"]["optional-dependencies"].values()
    required = [*project["project"]["dependencies"], *(one for extra in extras for one in extra)]
    assert {constraints.normalised(re.split(r"[<>=;\[ ]", one)[0]) for one in required} <= set(listed)
    assert project["tool"]["uv"]["constraint-dependencies"] == [
        f"{name}=={one}" for name, one in listed.items()
    ]


def test_refreshed_versions_replace_the_old_ones_and_nothing_else() -> None:
    text = (ROOT / "pyproject.toml").read_text()
    changed = constraints.refreshed(text, {"numpy": "9.9"})
    assert constraints.pinned(changed) == {"numpy": "9.9"}
    assert constraints.refreshed(changed, constraints.pinned(text)) == text
