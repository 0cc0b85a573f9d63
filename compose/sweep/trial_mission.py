"""A trial's mission, played: in this process, as processes, or as processes some of which are killed."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec

from compose.audit import rules
from compose.audit.findings import Findings
from compose.launch import in_process
from compose.recording.run import Recording, read
from compose.recording.ticks_csv import ticks_csv
from compose.scenario.kills import Kill
from compose.scenario.scenario_file import run_name
from protocol.journal.journal_file import MemoryJournal, packed
from protocol.network.inbox import Inbox
from world.scenario import Scenario

PATIENCE_S = 30.0
"""how long the processes of a trial wait for each other"""


class Played(msgspec.Struct, frozen=True):
    """A mission to its end."""

    recording: Recording
    belief: Findings | None
    """of its audit, if there was one"""
    wall_s: float
    """with its audit"""
    kills: int | None = None
    """that were taken, where there were to be any"""
    otherwise: tuple[str, ...] = ()
    """the files of its record that are not, to the byte, those of the same in one process"""


def run_in_process(scenario: Scenario, *, audit: bool) -> Played:
    """Its run in this process; its journals are kept only to be judged."""
    began = time.perf_counter()
    if not audit:
        return Played(in_process.play(scenario), None, time.perf_counter() - began)
    kept = {name: MemoryJournal() for name in in_process.journals(scenario)}
    recording = in_process.played(scenario, kept)
    findings = rules.judge({name: journal.frames for name, journal in kept.items()})
    return Played(recording, findings, time.perf_counter() - began)


def as_processes(scenario: Scenario, *, audit: bool, kills: Sequence[Kill] | None = None) -> Played:
    """Its run as processes. Where there are `kills`, if only none, it is held against that in one process."""
    from compose.launch import processes  # noqa: PLC0415  # in-process trials do without

    began = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="tandem-") as folder:
        out = Path(folder)
        spared = processes.play(
            scenario,
            out,
            Inbox("tandem sweep"),
            run=run_name(scenario),
            rate=None,
            timeout=PATIENCE_S,
            kills=kills or (),
            agents_journal=audit or kills is not None,
        )
        recording = read(out)
        findings = rules.audit(out) if audit else None
        wall_s = time.perf_counter() - began
        if kills is None:
            return Played(recording, findings, wall_s)
        return Played(recording, findings, wall_s, len(kills) - len(spared), _otherwise(recording, out))


def _otherwise(recording: Recording, out: Path) -> tuple[str, ...]:
    undisturbed = {name: MemoryJournal() for name in in_process.journals(recording.scenario)}
    ticks = ticks_csv(in_process.played(recording.scenario, undisturbed))
    files = [name for name, kept in undisturbed.items() if (out / name).read_bytes() != packed(kept.frames)]
    return (*files, "ticks.csv") if ticks_csv(recording) != ticks else tuple(files)
