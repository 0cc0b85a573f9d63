"""`tandem ps`: list the missions on a network and the robots in them."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator

import msgspec

from compose.doctor import running_missions
from compose.doctor.running_missions import Participant, RunningMission, Unreached, linked
from compose.errors import ENDED, FAILED
from compose.network import places
from compose.terminal import text_width
from protocol.output import one_line, say
from protocol.wire import VERSION

INDENT = 4
"""The spaces before each continuation of a line that is wider than the terminal."""


def main(options: argparse.Namespace) -> int:
    """List the missions at every router once, and return FAILED if a router does not answer."""
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
        missions = [{"at": at, **msgspec.to_builtins(one), "missing": one.missing} for at, one in found]
        say(*json.dumps({"missions": missions}, indent=2).replace("\x7f", "\\u007f").splitlines())
    else:
        for at, mission in found:
            for line in _lines(at, mission, options.timeout):
                say(*text_width.wrapped(one_line(line), INDENT))
    return status


def _lines(at: str, mission: RunningMission, timeout: float) -> Iterator[str]:
    """Yield a line about `mission`, which was listened to for `timeout` seconds, then one per robot."""
    words = [f"{mission.run} at {at}"]
    words.append(f"tick {mission.tick}" if mission.tick is not None else f"no tick within {timeout:g} s")
    if mission.outcome is not None:
        words.append(f"over: {mission.outcome}")
    if mission.missing:
        words.append(f"missing: {', '.join(mission.missing)}")
    if others := [str(version) for version in mission.versions if version != VERSION]:
        words.append(f"protocol version {' and '.join(others)} instead of {VERSION}")
    yield ", ".join(words)
    width = max((len(one.robot) for one in mission.robots), default=0)
    for one in mission.robots:
        yield f"  {one.robot:{width}}  {_state(one, timeout)}"


def _state(one: Participant, timeout: float) -> str:
    """Return what is known of a robot that was listened to for `timeout` seconds."""
    there = "" if one.there else "no longer connected: "
    if one.tick is not None:
        return f"{there}tick {one.tick}, phase {one.phase}, {one.state}"
    return f"connected, no message within {timeout:g} s" if one.there else "not connected"
