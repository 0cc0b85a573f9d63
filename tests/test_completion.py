"""Shells complete commands, flags, names and files."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from compose.cli.commands import COMMANDS
from compose.figures import PICTURES
from compose.scenario.shipped_files import shipped
from tests.commands import tandem


@pytest.fixture(scope="module")
def script() -> str:
    ended = tandem("completion", "bash")
    assert (ended.status, ended.err) == (0, "")
    return ended.out


def completed(script: str, folder: Path, *words: str) -> list[str]:
    """Return what bash offers for the last of `words`."""
    line = " ".join(f"'{word}'" for word in ("tandem", *words))
    asked = f"COMP_WORDS=({line}); COMP_CWORD={len(words)}; _tandem; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    ran = subprocess.run(
        [shutil.which("bash") or pytest.skip("there is no bash"), "-uc", f"{script}\n{asked}"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    assert ran.stderr == ""
    return ran.stdout.split("\n")[:-1]


def test_the_first_word_is_a_command(script: str, tmp_path: Path) -> None:
    (tmp_path / "run.toml").write_text("")
    assert completed(script, tmp_path, "") == [*(one.name for one in COMMANDS), "--help", "--version"]
    assert completed(script, tmp_path, "ru") == ["run"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("run", "--fa"), ["--fault"]),
        (("run", "paper"), [name for name in shipped() if name.startswith("paper")]),
        (("sweep", "nois"), ["noise"]),
        (("figures", "recording", "--only", ""), [*PICTURES, "my file.toml"]),
        (("figures", "recording", "--only", "enc"), ["encounter"]),
        (("run", "my"), ["my file.toml"]),
        (("run", "--out", "my"), ["my file.toml"]),
        (("run", "--launch"), [""]),
        (("figures", "--only", "--form"), [""]),
    ],
)
def test_other_words_are_flags_names_and_files(
    script: str, words: tuple[str, ...], expected: list[str], tmp_path: Path
) -> None:
    (tmp_path / "my file.toml").write_text("")
    assert completed(script, tmp_path, *words) == expected


def test_zsh_runs_the_same_script(script: str) -> None:
    zsh = tandem("completion", "zsh").out
    assert zsh == f"autoload -U +X bashcompinit && bashcompinit\n{script}"
