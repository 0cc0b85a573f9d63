"""`tandem ps`: the missions on a network, and who takes part in them."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator

import msgspec

from compose.doctor import running_missions
from compose.doctor.router_session import Unreached, linked
from compose.doctor.running_missions import Participant, RunningMission
from compose.errors import ENDED, FAILED
from compose.network import places
from compose.terminal import text_width
from protocol.output import one_line, say
from protocol.wire import VERSION

INDENT = 4
"""of what is too long for a line"""


def main(options: argparse.Namespace) -> int:
    """Look once, and tell."""
    found: list[tuple[str, RunningMission]] = []
    status = ENDED
    for place in places(options):
        try:
            with linked(place) as link:
                seen = running_missions.look(link, options.timeout)
        except Unreached as error:
            say(f"tandem ps: {error}", error=True)
            status = FAILED
            continue
        found += [(str(place), mission) for mission in seen]
        if not seen and not options.json:
            say(f"no mission at {place}")
    if options.json:
        told = [{"at": at, **msgspec.to_builtins(one), "missing": one.missing} for at, one in found]
        say(*json.dumps({"missions": told}, indent=2).replace("\x7f", "\\u007f").splitlines())
    else:
        for at, mission in found:
            for line in _lines(at, mission, options.timeout):
                say(*text_width.wrapped(one_line(line), INDENT))
    return status


def _lines(at: str, mission: RunningMission, wait: float) -> Iterator[str]:
    words = [f"{mission.run} at {at}"]
    words.append(f"tick {mission.tick}" if mission.tick is not None else f"no tick within {wait:g} s")
    if mission.outcome is not None:
        words.append(f"over: {mission.outcome}")
    if mission.missing:
        words.append(f"missing: {', '.join(mission.missing)}")
    if others := [str(version) for version in mission.versions if version != VERSION]:
        words.append(f"speaks protocol version {' and '.join(others)}, this is {VERSION}")
    yield ", ".join(words)
    width = max((len(one.robot) for one in mission.robots), default=0)
    for one in mission.robots:
        yield f"  {one.robot:{width}}  {_said(one, wait)}"


def _said(one: Participant, wait: float) -> str:
    there = "" if one.there else "not there any more: "
    if one.tick is not None:
        return f"{there}tick {one.tick}, phase {one.phase}, {one.state}"
    return f"there, nothing said within {wait:g} s" if one.there else "not there"
