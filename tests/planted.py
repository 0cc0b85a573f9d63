"""Violations planted into the recording of paper-1: messages replaced, and what the audit finds."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import msgpack
from msgspec.structs import replace

from compose.audit.findings import Findings
from compose.audit.rules import audit_run
from compose.recording.recording_files import KINDS, agent_journal
from compose.recording.run import read
from protocol.journal import journal_file
from protocol.wire import MAX_FRAME_BYTES, decode, encode


def audit(folder: Path) -> Findings:
    """Return the findings in the recording in `folder`."""
    return audit_run(read(folder, audited=True))


Found = tuple[int | None, str | None, str]
"""The tick, robot and rule of a violation."""


LAST = 48
"""The tick in which paper-1 ends."""


A, B = agent_journal("a"), agent_journal("b")


A, B = agent_journal("a"), agent_journal("b")


def found(findings: Findings) -> list[Found]:
    return [(one.tick, one.robot, one.rule) for one in findings.violations]


def checks(findings: Findings) -> dict[str, int]:
    return {one.rule: one.checks for one in findings.counts}


def messages(path: Path) -> list[Any]:
    return [decode(frame, KINDS, MAX_FRAME_BYTES) for frame in journal_file.read(path)]


def written(path: Path, told: Iterable[Any]) -> None:
    """Write a journal of these messages, each in a frame with a correct CRC."""
    path.write_bytes(b"".join([msgpack.packb(encode(message)) for message in told]))


Edit = tuple[Callable[[Any], bool], Callable[[Any], Any]]
"""A function that selects a message, and one that returns another, several or none in its place."""


def plant(path: Path, *edits: Edit) -> None:
    """Replace the single message that each of `edits` selects by another message, by several, or by none."""
    told = messages(path)
    for picks, change in edits:
        (place,) = [i for i, message in enumerate(told) if picks(message)]
        put = change(told[place])
        told[place : place + 1] = put if isinstance(put, list) else [put]
    written(path, told)


def of(kind: type, tick: int | None = None, robot: str | None = None) -> Callable[[Any], bool]:
    """Return a function that selects a message by kind, tick and robot."""
    return lambda message: (
        isinstance(message, kind)
        and (tick is None or getattr(message, "tick", None) == tick)
        and (robot is None or getattr(message, "robot", None) == robot)
    )


def to(**fields: Any) -> Callable[[Any], Any]:
    return lambda message: replace(message, **fields)


def nothing(_: Any) -> list[Any]:
    return []


def what(findings: Findings, rule: str) -> list[str]:
    return [one.what for one in findings.violations if one.rule == rule]
