"""`tandem run` runs several scenarios and seeds, and prints one table."""

from __future__ import annotations

from pathlib import Path

import pytest

from compose.cli.main import parse
from tests.commands import tandem

ALONE = ("--in-process",)


def test_scenarios_and_seeds_are_lines_of_one_table(tmp_path: Path) -> None:
    ended = tandem("run", "paper-1", "random", "--seed", "1..2", *ALONE, "--out", "all", cwd=tmp_path)
    assert (ended.status, ended.err) == (0, "")
    lines = [line.split() for line in ended.out.splitlines()]
    assert [line[:2] for line in lines[2:6]] == [
        [name, "localised"] for name in ("paper-1-1", "paper-1-2", "random-1", "random-2")
    ]
    single = tandem("run", "random", "--seed", "2", *ALONE, "--out", "single", cwd=tmp_path)
    assert f"random: localised after {lines[5][2]} ticks" in single.out
    for name in ("world.journal", "agent-a.journal", "ticks.csv"):
        both = [(tmp_path / folder / name).read_bytes() for folder in ("all/random-2", "single")]
        assert both[0] == both[1], name


def test_processes_run_several_missions_and_a_kill_happens_in_each(tmp_path: Path) -> None:
    ended = tandem("run", "paper-1", "paper-2", "--kill", "a@9", "-q", cwd=tmp_path)
    assert ended.status == 0
    assert [line.partition(":")[0] for line in ended.out.splitlines()] == ["paper-1-1", "paper-2-1"]
    assert ended.err.count("agent a was killed at tick 9") == 2


def test_the_exit_status_is_the_worst(tmp_path: Path) -> None:
    text = tandem("sweep", "any-start", "--print-trial", "0").out
    (tmp_path / "short.toml").write_text(f"max_ticks = 3\n{text}")
    ended = tandem("run", "paper-1", "short.toml", *ALONE, "-q", cwd=tmp_path)
    assert ended.status == 1
    assert "undecided" in ended.out.splitlines()[1]


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("paper-1", "papr-2"), "papr-2: neither a file nor a shipped scenario"),
        (("paper-1", "paper-1"), "paper-1: another mission has the name and the seed of paper-1-1"),
        (("paper-1", "--seed", "1,2", "--watch"), "--watch: it needs a single mission"),
        (("paper-1", "--seed", "2..1"), "argument --seed: '2..1' is not a range of 1 to 1000 seeds"),
        (("paper-1", "--seed", "1,1"), "argument --seed: '1,1' has a seed twice"),
        (("paper-1", "--seed", "1.."), "argument --seed: '' is not a whole number"),
    ],
)
def test_nothing_runs_after_a_mistake(words: tuple[str, ...], text: str, tmp_path: Path) -> None:
    ended = tandem("run", *words, *ALONE, "--out", "out", cwd=tmp_path)
    assert ended.status == 2
    assert ended.err.startswith(f"tandem run: {text}")
    assert len(ended.err.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_seeds_are_numbers_and_ranges() -> None:
    assert parse(["run", "paper-1", "--seed", "7"]).seed == (7,)
    assert parse(["run", "paper-1", "--seed", "3,1..2"]).seed == (3, 1, 2)
    assert parse(["world", "paper-1", "--seed", "7", "--listen", "tcp/127.0.0.1:7447"]).seed == 7
