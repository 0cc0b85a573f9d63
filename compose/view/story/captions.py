"""Captions of a mission: a sentence or two for each important event.

Captions follow from the data of a tick and of the one before, as events do. There are far fewer of them,
and each is about a pair of robots. They state what was measured, held, claimed and decided, and no more: a
claim counts as true only once the mission has ended `localised`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from compose.recording.run_setup import RobotSetup, RunSetup
from compose.view.events import Event
from compose.view.pair_data import PairData
from compose.view.run_data import TickData
from compose.view.story.caption import Caption, faults
from compose.view.story.encounter_captions import fitting, meeting, planning
from compose.view.story.ending_captions import concluding, ending
from compose.view.story.search_captions import (
    beginning_again,
    choosing_branch,
    mirrored,
    ranging,
    rules,
    searching,
)
from protocol.messages import MissionEnd


def captions(
    setup: RunSetup,
    before: TickData | None,
    now: TickData,
    events: Sequence[Event],
    end: MissionEnd | None,
) -> Iterator[Caption]:
    """Yield the captions of the tick of `now`, pair by pair, and at last that of the end of the mission.

    `events` are those of this tick.
    """
    pairs: list[tuple[RobotSetup, ...]] = [*setup.pairs()]
    paired = {robot.id for pair in pairs for robot in pair}
    groups = [*pairs, *[(robot,) for robot in setup.robots if robot.id not in paired]]
    ended = end if end is not None and end.tick == now.tick else None
    for robots in groups:
        pair = PairData(robots, setup.mission.noise.exact, before, now)
        yield from rules(pair, len(groups))
        yield from ranging(pair, setup.mission.sensing_range)
        if not pair.own_planner:
            yield from mirrored(pair)
        yield from choosing_branch(pair)
        if not pair.own_planner:
            yield from searching(pair)
            yield from beginning_again(pair)
        yield from meeting(pair)
        yield from fitting(pair)
        if not pair.own_planner:
            yield from planning(pair)
        yield from concluding(pair, ended)
        yield from faults([one for one in events if one.robot in pair.ids], pair.ids)
    yield from faults([one for one in events if one.robot is None])
    if ended is not None:
        yield ending(setup, now, ended)
