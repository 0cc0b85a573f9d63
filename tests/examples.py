"""One of each message, with nothing left out that it may hold."""

from __future__ import annotations

from compose.scenario.scenario_file import load
from protocol.messages import (
    Alarm,
    Beat,
    Contact,
    Drive,
    End,
    Environment,
    Estimate,
    Farewell,
    Localised,
    Message,
    Missed,
    Ranged,
    Report,
    Sense,
    Truth,
    Undecided,
)
from protocol.motion import Controls, Covariance, Pose, Run
from world.hardware.driver_journal import Mark, Start

POSE = Pose(1.5, -2.5, 0.75)

EXAMPLES: tuple[Message, ...] = (
    load("paper-1").briefing("a", tick_s=0.25),
    Sense(7, "a", Controls(1.0, -0.5), 2.5, (Contact("b", 1.25, (5, 7)), Contact("c", None, ()))),
    Sense(0, "a", None, None),
    Report(
        tick=9,
        robot="a",
        phase=2,
        state="orbiting",
        start=POSE,
        since=2,
        through=9,
        runs=(Run(4, 1.0, 0.0), Run(3, 0.5, -0.25)),
        ranges=(Ranged(3, 1.0), Ranged(9, 2.0)),
        ranges_since=1,
        heard=8,
        ranges_heard=2,
        verdict=Undecided("no pose explains the anchor ranges"),
    ),
    Report(0, "a", 1, "asleep", None, 0, 0, (), 0, (), 0, 0),
    Drive(3, "b", 0.5, 0.25, 3, "localised", Localised(POSE, Covariance(0.5, 0.25, 0.0, 0.75, -0.5, 1.0))),
    Drive(5, "b", 0.0, 0.0, 3, "localised", Localised(POSE)),
    Drive(4, "b", 0.0, 0.0, 1, "straight"),
    Estimate(5, "a", (POSE,), (POSE, Pose(0.5, 0.5, 0.5)), localised=True),
    Estimate(5, "a", (POSE,), (), False, (1.0,), Covariance(0.5, 0.25, 0.0, 0.75, -0.5, 1.0)),
    Truth(6, {"a": POSE, "b": Pose(0.5, 0.5, 0.5)}),
    Missed(8, "b"),
    End(48, "wrong", "a claims a pose that is 1 m off"),
    End(48, "localised", None),
    Farewell(
        "b", 5, 3, "circle", -2.5, (4, 2), 0.5, 1.5, 2, 0.75, "8 mutual ranges", 0.25, 3, 4, 1, 2, 5, 3, 600
    ),
    Farewell("b", 0, 0, None, None, None, None, None, None, None, None, None, 0, 0, 0, 0, 0, 0, 0),
    Sense(8, "a", Controls(1.0, -0.5), None, (Contact("b", 1.25, None),)),
    Environment("0.1.0", "glibc 2.36", "x86-64-v3", "2.4.1 (AVX2)", "OpenBLAS 0.3.31 (Haswell)"),
    Mark(4, "a", (0.5, -1.0)),
    Start("6f1c2a", synced=True),
    Beat(7, "a"),
    Drive(4, "b", 0.0, 0.0, 3, "alarm", Alarm("a start that it told otherwise before", 0.5, 0.25)),
)
