"""The mission of a trial, run in this process, as processes, or as processes with kills."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec

from compose.audit import rules
from compose.audit.findings import Findings
from compose.launch import in_process
from compose.recording.rows import ticks_csv
from compose.recording.run import Run, of_frames, read
from compose.scenario.kills import Kill
from compose.scenario.run_settings import run_name
from protocol.journal.journal_file import MemoryJournal, packed
from protocol.network.inbox import Inbox
from protocol.wire import EncodedMessages
from world.scenario import Scenario

PROCESSES_TIMEOUT_S = 30.0
"""The time in s that the processes of a trial wait for each other."""


class Played(msgspec.Struct, frozen=True):
    """A completed mission."""

    run: Run
    findings: Findings | None
    """findings of its audit; None if it was not audited"""
    wall_s: float
    """wall time in s, with the audit"""
    kills: int | None = None
    """number of kills that took place; None if none was requested"""
    differing: tuple[str, ...] = ()
    """names of the files of its recording whose bytes differ from those of a run in one process"""


def run_in_process(scenario: Scenario, *, audit: bool) -> Played:
    """Run `scenario` in this process. Journals are written, to memory, only for an audit."""
    began = time.perf_counter()
    if not audit:
        return Played(in_process.run_mission(scenario), None, time.perf_counter() - began)
    journals = {name: MemoryJournal() for name in in_process.journals(scenario)}
    messages = EncodedMessages()
    run = in_process.played(scenario, journals, encode=messages.encode)
    recorded = of_frames({name: journal.frames for name, journal in journals.items()}, messages=messages)
    findings = rules.audit_run(recorded)
    if scenario.meetings:  # their reports say who has met whom
        run = msgspec.structs.replace(run, agents=recorded.agents)
    return Played(run, findings, time.perf_counter() - began)


def as_processes(
    scenario: Scenario, *, audit: bool, kills: Sequence[Kill] | None = None, inbox: Inbox | None = None
) -> Played:
    """Run `scenario` as processes; `inbox` prints what it says, and receives signals.

    Unless `kills` is None, the recording is compared with that of a run in one process. `kills` may be empty.
    """
    from compose.launch import processes  # noqa: PLC0415  # not needed for trials in this process

    began = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="tandem-") as folder:
        out = Path(folder)
        missed = processes.run_mission(
            scenario,
            out,
            inbox or Inbox("tandem sweep"),
            run=run_name(scenario),
            rate=None,
            timeout=PROCESSES_TIMEOUT_S,
            kills=kills or (),
            agents_journal=audit or kills is not None,
        )
        run = read(out, audited=audit)
        findings = rules.audit_run(run) if audit else None
        wall_s = time.perf_counter() - began
        if kills is None:
            return Played(run, findings, wall_s)
        return Played(run, findings, wall_s, len(kills) - len(missed), _differing(run, out))


def _differing(run: Run, out: Path) -> tuple[str, ...]:
    """Return the names of the files in `out` whose bytes differ from those of a run in one process."""
    undisturbed = {name: MemoryJournal() for name in in_process.journals(run.scenario)}
    ticks = ticks_csv(in_process.played(run.scenario, undisturbed))
    files = [
        name for name, journal in undisturbed.items() if (out / name).read_bytes() != packed(journal.frames)
    ]
    return (*files, "ticks.csv") if ticks_csv(run) != ticks else tuple(files)
