"""`tandem calibrate`: the errors of radios in a recording, as a table and as a noise profile."""

from __future__ import annotations

import argparse
from contextlib import ExitStack

from compose.errors import ENDED, UserError, writing
from compose.recording.estimating.calibration import (
    ASSUMED,
    NoTruth,
    calibrated,
    calibrated_by_fit,
    profile_toml,
)
from compose.recording.estimating.radio_errors import FEWEST_ERRORS, RangeCalibration
from compose.recording.estimating.recorded_measurements import measurements
from compose.recording.estimating.true_poses import TRUTH_GAP_S
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_recording import RangeRecording
from compose.terminal.outcome import counting
from compose.terminal.tables import shown
from compose.terminal.text_width import tell
from protocol import files
from protocol.output import say


def main(options: argparse.Namespace) -> int:
    """Calibrate, print the table, and write or print the profile."""
    if options.out is not None and options.out.suffix != ".toml":
        raise UserError(f"--out: {options.out} is not the path of a .toml file")
    with ExitStack() as written:  # a path that cannot be written is refused before the work
        if options.out is not None:
            written.enter_context(writing(f"--out: {options.out}"))
            draft = written.enter_context(files.draft(options.out))
        recording = read_ranges(options.recording, options.anchors)
        found = _calibrated(recording, options)
        anchors = frozenset([one.id for one in recording.anchors])
        text = profile_toml(found, anchors, f"{found.source} of {recording.source}")
        if options.out is not None:
            draft.write_text(text)
    tell(*_lines(found))
    say(*(["", *text.splitlines()] if options.out is None else [str(options.out)]))
    return ENDED


def _calibrated(recording: RangeRecording, options: argparse.Namespace) -> RangeCalibration:
    """Return the errors against the truth, or against an estimate if there is none or the user says so."""
    why = None
    if not options.without_truth:
        try:
            return calibrated(recording, options.robots, options.window)
        except NoTruth as error:
            why = error
    robots = options.robots or [one.id for one in recording.robots]
    relative = None if recording.with_places().anchors else robots[0]  # errors are the same in any frame
    measured = measurements(recording, robots, ASSUMED, options.window, relative=relative)
    if why is not None:
        reference = f"the reference is an estimate of {len(measured.ends)} epochs"
        say(f"tandem calibrate: {why}: {reference}", error=True)
    with counting("tandem calibrate", len(measured.ends)) as done:
        return calibrated_by_fit(measured, done)


def _lines(found: RangeCalibration) -> list[str]:
    """Return the table of the errors of each pair of radios."""
    rows = [
        (
            "-".join(pair),
            str(one.ranges),
            f"{one.bias:+.3f}",
            f"{one.bias_sigma:.3f}",
            "-" if one.scale is None else f"{100.0 * one.scale:+.1f}",
            f"{one.sigma:.3f}",
            f"{one.slow_sigma:.3f}",
            f"{100.0 * one.outliers:.1f}",
        )
        for pair, one in found.pairs.items()
    ]
    right = ("ranges", "bias m", "+-", "own scale %", "sigma m", "slow m", "outliers %")
    common = f"common scale {100.0 * found.scale:+.2f} % +- {100.0 * found.scale_sigma:.2f} %"
    common += f", from which those of pairs differ by {100.0 * found.scale_spread:.1f} %"
    if not found.scale_told:
        common = "no common scale: the distances of each pair are too much alike to tell a scale from a bias"
    lines = [*shown(("radios",), right, rows), f"{common}; against {found.source}"]
    if found.unused:
        why = f"no true poses within {TRUTH_GAP_S:g} s, or fewer than {FEWEST_ERRORS} ranges of the pair"
        lines.append(f"{found.unused} {'range' if found.unused == 1 else 'ranges'} not used: {why}")
    return lines
