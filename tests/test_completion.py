"""Shells complete commands, flags and files, by scripts that shtab makes."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
import shtab

from compose.cli.main import whole_parser


@pytest.fixture(scope="module")
def script() -> str:
    return shtab.complete(whole_parser(), "bash")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("ru",), "run"),
        (("run", "--fa"), "--fault"),
        (("figures", "recording", "--only", "enc"), "encounter"),
        (("run", "my"), "my file.toml"),
        (("run", "--out", "my"), "my file.toml"),
        (("run", "--launch"), ""),
    ],
)
def test_words_are_commands_flags_and_files(
    script: str, words: tuple[str, ...], expected: str, tmp_path: Path
) -> None:
    (tmp_path / "my file.toml").write_text("")
    line = " ".join(f"'{word}'" for word in ("tandem", *words))
    asked = (
        f"COMP_WORDS=({line}); COMP_CWORD={len(words)}; _shtab_tandem; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    )
    ran = subprocess.run(
        [shutil.which("bash") or pytest.skip("there is no bash"), "-c", f"{script}\n{asked}"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert (ran.stdout, ran.stderr) == (f"{expected}\n", "")
