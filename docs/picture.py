"""The figures of the documentation: draw them, or say which are stale.

`uv run docs/picture.py` draws all of them (an hour: one is of 3 000 missions),
`uv run docs/picture.py page.gif noisy-a.svg` those two. Then `figures.json` says from what each was made:
hashes of its file, of the code that draws it with its input, and of what its missions decided. With `--check`
it draws none, and prints a line for each stale figure; the exit status is 1 if there are any.

The figures of sweeps, of 14 000 and 42 000 missions, are drawn from tables of their points, `loss.csv` and
`settings.csv`. `uv run docs/picture.py --sweep loss.svg` runs the sweep, and writes its table again.

A figure is stale if its file, the code that draws it, or its input has changed since it was drawn, or if its
missions end or decide otherwise in any tick. Positions are not compared: their last bits depend on the
processor. Under noise decisions may, too, and are compared only in the environment of the drawing.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import hashlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

DOCS = Path(__file__).parent
ROOT = DOCS.parent
RECORD = "figures.json"
sys.path.insert(0, str(ROOT))  # for docs.examples

from compose.errors import LOCALISED, NOT_LOCALISED  # noqa: E402
from compose.figures import PICTURES, catalogue  # noqa: E402
from compose.figures.agent_replay import agent_replay  # noqa: E402
from compose.figures.pair import pairs_of  # noqa: E402
from compose.figures.sheet import Absent  # noqa: E402
from compose.figures.style import SCREEN, SWEEP_MEDIUM, look, save  # noqa: E402
from compose.launch import in_process  # noqa: E402
from compose.recording.run import Run, read  # noqa: E402
from compose.scenario import scenario_file  # noqa: E402
from compose.sweep import axis_figures, spec  # noqa: E402
from compose.view.web.standalone import standalone_page  # noqa: E402
from docs import film  # noqa: E402
from protocol.journal import environment  # noqa: E402
from tandem.sweeps import sweep as run_sweep  # noqa: E402

STYLE = ("compose/figures/style.py", "compose/view/colours.py")
MISSIONS = ("compose/figures/*.py", "compose/view/colours.py", "compose/view/outlines.py")
PAGE = (
    *[f"compose/view/{name}.py" for name in ("captions", "configurations", "events", "outlines", "words")],
    *["docs/film.py", "compose/view/web/standalone.py"],
    "compose/view/web/page/*",
)
"""The code that draws figures of missions, and the page, as patterns of paths."""
COMMENTS = {
    ".py": r'(?m)^\s*#.*$|^\s*"""(?s:.*?)"""',
    ".js": r"(?m)^\s*//.*$|/\*(?s:.*?)\*/",
    ".css": r"/\*(?s:.*?)\*/",
}
"""The parts that are no code, by the ending of a file, beside the spaces."""
STILL = ("distance that a hypothesis predicts", (1360, 840))
"""The mark of the legend that page.png shows, and its size in pixels."""
RECORDED = "tests/data/uwb/tiers-a-b-30-s.pyfg"


class Source(NamedTuple):
    """The subject of some figures: a mission, a recording, a sweep or an example."""

    figures: Mapping[str, str]
    """The files in docs/, each with the name of the figure in the source."""
    code: Sequence[str]
    """Paths of the input and of the code that draws, as patterns."""
    draw: Callable[[Path, Mapping[str, str]], None]
    """Draws some of the figures, in a temporary folder, as files of their names in it."""
    decided: Callable[[Path], dict[str, Any]]
    """Returns what was decided; for a sweep, in the first trial of each cell."""
    exact: bool = False
    """True if decisions are the same on all processors."""
    quick: bool = False
    """True if what was decided is known within a second."""
    sweep: Callable[[], None] | None = None
    """Runs the missions and writes the table from which `draw` draws; None if `draw` runs them."""


def mission(name: str, figures: Mapping[str, str], *, exact: bool = True) -> Source:
    """Return the source of figures of the shipped scenario `name`."""
    named = {f"{file}.svg": title for file, title in figures.items()}

    def draw(folder: Path, wanted: Mapping[str, str]) -> None:
        run = ran(name, folder)
        pair = next(pairs_of(run, {robot: agent_replay(run, robot) for robot in run.robots}), None)
        for kind in PICTURES:
            with look(SCREEN):
                drawn = catalogue.pictures(pair, kind) if pair is not None else catalogue.of_team(run, kind)
                for title, figure in drawn:
                    for file in [one for one in wanted if wanted[one] == title]:
                        if not isinstance(figure, Absent):
                            save(figure, folder / Path(file).stem, ["svg"])

    return Source(
        named, (f"compose/scenario/shipped/{name}.toml", *MISSIONS), draw,
        lambda folder: decisions(ran(name, folder)), exact, quick=True,
    )  # fmt: skip


def ran(name: str, folder: Path) -> Run:
    """Return the run of a shipped scenario, recorded in `folder`."""
    in_process.run_mission(scenario_file.load(name), folder)
    return read(folder)


def decisions(run: Run) -> dict[str, Any]:
    """Return the end of a run, and when a robot changes its phase, state, or number of hypotheses."""
    found: dict[str, Any] = {"ticks": run.length - 1, "outcome": run.end.outcome if run.end else None}
    for robot in run.robots:
        held = {one.tick: len(one.world or one.local) for one in run.estimates(robot)}
        changes: list[tuple[int, str]] = []
        for tick in range(run.length):
            command = run.command(robot, tick)
            state = f"{command.phase} {command.task} {held.get(tick, 0)}" if command is not None else "late"
            if not changes or changes[-1][1] != state:
                changes.append((tick, state))
        found[robot] = "; ".join(f"{tick}: {state}" for tick, state in changes)
    return found


def page(folder: Path, wanted: Mapping[str, str]) -> None:
    """Draw the guided play of paper-1, and one picture of it."""
    ran("paper-1", folder)
    html = standalone_page(folder)[0]
    if "page.gif" in wanted:
        (folder / "page.gif").write_bytes(film.gif(html))
    if "page.png" in wanted:
        (folder / "page.png").write_bytes(film.still(html, *STILL))


def estimate(folder: Path, wanted: Mapping[str, str] = {}) -> None:
    """Estimate the recorded sample into `folder`, and rename its figures."""
    tandem("estimate", str(ROOT / RECORDED), "--noise", "uwb-calibrated", "--out", str(folder / "estimated"))
    for file, name in wanted.items():
        shutil.copyfile(folder / "estimated" / f"{name}.svg", folder / file)


def estimated(folder: Path) -> dict[str, Any]:
    """Return when each robot of the recorded sample may claim its pose, and how many ranges count."""
    estimate(folder)
    result = json.loads((folder / "estimated" / "estimate.json").read_text())
    claims = {robot: (one["first_claim"] or {}).get("t_s") for robot, one in result["robots"].items()}
    return {"first claims": claims, "ranges": result["ranges"]}


def sweep(name: str, place: int, title: str) -> Source:
    """Return the source of the figure of a shipped sweep over one of its axes, of a name in STATISTICS."""
    table, statistic = DOCS / f"{name}.csv", axis_figures.STATISTICS[title]

    def run() -> None:
        with tempfile.TemporaryDirectory() as folder:
            points = axis_figures.points(run_sweep(name, out=folder).results, place, statistic)
        with table.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([axis_figures.FigurePoint._fields, *points])

    def draw(folder: Path, _: Mapping[str, str]) -> None:
        with table.open(newline="") as file:
            points = [
                axis_figures.FigurePoint(
                    row["line"], int(row["value"]), row["quantity"],
                    *[float(row[key] or "nan") for key in ("estimate", "low", "high")],
                )
                for row in csv.DictReader(file)
            ]  # fmt: skip
        with look(SWEEP_MEDIUM):
            figure = axis_figures.over_axis(spec.load(name), place, statistic, points)
            save(figure, folder / name, ["svg"])

    def decided(folder: Path) -> dict[str, Any]:
        tandem("sweep", name, "--trials", "1", "--out", str(folder / name))
        with (folder / name / "summary.csv").open(newline="") as file:
            return {"cells": [(row["localised"], row["ticks_p50"]) for row in csv.DictReader(file)]}

    code = (f"compose/sweep/shipped/{name}.toml", f"docs/{name}.csv", "compose/sweep/axis_figures.py", *STYLE)
    return Source({f"{name}.svg": title}, code, draw, decided, exact=True, sweep=run)


def radios(folder: Path, wanted: Mapping[str, str] = {}, trials: int = 200) -> str:
    """Run the example of planners over radio models, and return what it prints."""
    from docs.examples import planners_and_radios  # noqa: PLC0415  # an example of the Python API

    printed = io.StringIO()
    with look(SWEEP_MEDIUM), contextlib.redirect_stdout(printed):
        os.environ["SOURCE_DATE_EPOCH"] = "0"  # for the date that Matplotlib writes
        for file in wanted or ["radios.svg"]:
            planners_and_radios.main(str(folder / file), trials)
    return printed.getvalue()


def tandem(*arguments: str) -> None:
    """Run a command of the program. Raises CalledProcessError if it fails; another outcome is no failure."""
    command = [sys.executable, "-m", "tandem", *arguments]
    ended = subprocess.run(command, check=False, cwd=ROOT, stdout=sys.stderr)
    if ended.returncode not in (LOCALISED, NOT_LOCALISED):
        ended.check_returncode()


SOURCES = (
    mission(
        "paper-1",
        {
            "paper-1": "trajectory-a-b", "paper-1-phase-1": "phase-1-a", "paper-1-plan": "plan-b-47",
            "paper-1-encounter": "encounter-a-b", "paper-1-ranges": "ranges-a-b",
        },
    ),
    mission(
        "paper-2",
        {"paper-2": "trajectory-a-b", "paper-2-plan": "plan-b-109", "paper-2-encounter": "encounter-a-b"},
    ),
    mission("noisy", {"noisy-plan": "plan-a-b", "noisy-a": "robot-a"}, exact=False),
    mission("group-8", {"group-8": "meetings"}),
    mission("room", {"room": "trajectory"}, exact=False),
    mission("relative", {"relative": "trajectory"}, exact=False),
    Source(
        {"page.gif": "guided play", "page.png": STILL[0]}, ("compose/scenario/shipped/paper-1.toml", *PAGE),
        page, lambda folder: decisions(ran("paper-1", folder)), exact=True, quick=True,
    ),
    Source(
        {f"{one}.svg": one for one in ("estimate-path", "estimate-over-time")},
        (RECORDED, *[f"compose/{one}.py" for one in ("figures/estimated", "figures/sheet", "view/outlines")],
         *STYLE),
        estimate, estimated,
    ),
    sweep("settings", 0, "ticks"),
    sweep("loss", 0, "ticks"),
    Source(
        {"radios.svg": "planners over radio models"}, ("docs/examples/planners_and_radios.py",),
        lambda folder, wanted: print(radios(folder, wanted), end=""),
        lambda folder: {"printed": radios(folder, trials=1).splitlines()},
    ),
)  # fmt: skip
"""All figures."""


def code_of(source: Source, title: str) -> str:
    """Return a hash of the code and the input of a figure, without comments, docstrings and spaces."""
    parts = [title.encode()]
    for path in sorted({path for pattern in source.code for path in ROOT.glob(pattern) if path.is_file()}):
        content = path.read_bytes()
        if (pattern := COMMENTS.get(path.suffix)) is not None:
            content = re.sub(r"\s+", "", re.sub(pattern, "", content.decode())).encode()
        parts += [path.relative_to(ROOT).as_posix().encode(), content]
    return hashed(b"\0".join(parts))


def file_of(name: str) -> str | None:
    """Return a hash of a figure's file; None if there is none."""
    path = DOCS / name
    return hashed(path.read_bytes()) if path.is_file() else None


def hashed(content: bytes) -> str:
    """Return the first 16 digits of the SHA-256 hash of `content`."""
    return hashlib.sha256(content).hexdigest()[:16]


def names_of_figures() -> list[str]:
    """Return the names of all figures in docs/."""
    return [name for source in SOURCES for name in source.figures]


def here() -> str:
    """Return the environment on which the last bits of numbers depend."""
    one = environment.of_robot()
    return "; ".join([one.c_library, one.instruction_set, str(one.numpy), str(one.linear_algebra)])


def recorded() -> dict[str, Any]:
    """Return the content of `figures.json`, by the name of the figure."""
    found: dict[str, Any] = json.loads((DOCS / RECORD).read_text())
    return found


def stale(*, quick: bool = False) -> Iterator[str]:
    """Yield a line for each stale figure; if `quick`, without running sweeps and estimates."""
    made = recorded()
    for source in SOURCES:
        decided = None
        for name, title in source.figures.items():
            then = made.get(name)
            if then is None or file_of(name) != then["file"]:
                yield f"{name}: the file is not the one that docs/picture.py has drawn"
            elif code_of(source, title) != then["code"]:
                yield f"{name}: the code that draws it, or its input, has changed"
            elif (source.quick or not quick) and (source.exact or then["environment"] == here()):
                decided = decided if decided is not None else tried(source)
                if decided != then["decided"]:
                    yield f"{name}: the missions that it shows decide otherwise now"


def tried(source: Source) -> str:
    """Return a hash of what is decided in a source now."""
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        return hashed(json.dumps(source.decided(Path(folder)), sort_keys=True).encode())


def draw(names: Sequence[str], *, sweep: bool = False) -> None:
    """Draw the figures with these names, and record from what they are made.

    With `sweep`, run the sweeps of those that are drawn from a table. Without, what their missions decided
    stays as it was when the table was made.
    """
    for source in SOURCES:
        wanted = {name: title for name, title in source.figures.items() if name in names}
        if not wanted:
            continue
        if source.sweep is not None and sweep:
            source.sweep()
        with tempfile.TemporaryDirectory() as folder:
            source.draw(Path(folder), wanted)
            for name in wanted:
                shutil.copyfile(Path(folder) / name, DOCS / name)
        made = recorded()
        if source.sweep is None or sweep:
            played = {"environment": here(), "decided": tried(source)}
        for name, title in wanted.items():
            if source.sweep is not None and not sweep:
                played = {key: made[name][key] for key in ("environment", "decided")}
            made[name] = {"file": file_of(name), "code": code_of(source, title), **played}
            print(name)
        text = json.dumps(dict(sorted(made.items())), indent=1)
        (DOCS / RECORD).write_text(text + "\n")


def main() -> int:
    """Draw figures, or check them."""
    names = names_of_figures()
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="FIGURE", help="a file in docs/ (default: all)")
    parser.add_argument("--check", action="store_true", help="print which figures are stale")
    parser.add_argument("--sweep", action="store_true", help="run sweeps again instead of using their tables")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(names):
        parser.error(f"no figure of docs/: {', '.join(sorted(unknown))} (there are {', '.join(names)})")
    if arguments.check:
        found = list(stale())
        print(*found, sep="\n", end="\n" if found else "")
        return 1 if found else 0
    draw(arguments.names or names, sweep=arguments.sweep)
    return 0


if __name__ == "__main__":
    sys.exit(main())
