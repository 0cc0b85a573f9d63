"""Example messages of every kind, with all of their optional fields set."""

from __future__ import annotations

from msgspec.structs import replace

from compose.scenario.scenario_file import load
from protocol.messages import (
    Cause,
    Command,
    Contact,
    DeadlineMissed,
    Environment,
    Estimate,
    FinalReport,
    GroundTruth,
    Inconsistent,
    Localised,
    Message,
    MissionEnd,
    Observation,
    Ranged,
    Report,
    ReportedPose,
    TickStart,
    Undecided,
)
from protocol.motion import Controls, Covariance, Pose, Segment
from world.hardware.driver_journal import Mark, ProcessStart

CONFIG = load("paper-1").config("a", tick_s=0.25)
POSE = Pose(1.5, -2.5, 0.75)

EXAMPLES: tuple[Message, ...] = (
    CONFIG,
    Observation(7, "a", Controls(1.0, -0.5), 2.5, (Contact("b", 1.25, (5, 7)), Contact("c", None, ()))),
    Observation(0, "a", None, None),
    Report(
        tick=9,
        robot="a",
        phase=2,
        state="orbiting",
        start=POSE,
        since=2,
        through=9,
        runs=(Segment(4, 1.0, 0.0), Segment(3, 0.5, -0.25)),
        ranges=(Ranged(3, 1.0), Ranged(9, 2.0)),
        ranges_since=1,
        heard=8,
        ranges_heard=2,
        verdict=Undecided("no pose explains the anchor ranges"),
    ),
    Report(0, "a", 1, "asleep"),
    Report(9, "a", 2, "sweeping", ranges_since=3, verdict=Localised(POSE), prior=ReportedPose(9, POSE)),
    Report(
        tick=9,
        robot="a",
        phase=3,
        state="looping",
        since=7,
        through=9,
        runs=(Segment(2, 0.5, -0.25),),
        ranges_since=3,
        verdict=Localised(POSE),
        prior=ReportedPose(6, POSE, Covariance(0.5, 0.25, 0.0, 0.75, -0.5, 1.0)),
    ),
    Command(3, "b", 0.5, 0.25, 3, "localised", Localised(POSE, Covariance(0.5, 0.25, 0.0, 0.75, -0.5, 1.0))),
    Command(5, "b", 0.0, 0.0, 3, "localised", Localised(POSE)),
    Command(4, "b", 0.0, 0.0, 1, "straight"),
    Estimate(5, "a", (POSE,), (POSE, Pose(0.5, 0.5, 0.5)), localised=True),
    Estimate(5, "a", (POSE,), (), False, (1.0,), Covariance(0.5, 0.25, 0.0, 0.75, -0.5, 1.0)),
    GroundTruth(6, {"a": POSE, "b": Pose(0.5, 0.5, 0.5)}),
    DeadlineMissed(8, "b"),
    MissionEnd(48, "wrong", (Cause("wrong", ("a",), (1.0, 0.5)),)),
    MissionEnd(48, "localised"),
    FinalReport(
        "b", 5, 3, "circle", -2.5, (4, 2), 0.5, 1.5, 2, 0.75, "8 mutual ranges", 0.25, 3, 4, 1, 2, 5, 3, 600
    ),
    FinalReport("b", 0, 0, None, None, None, None, None, None, None, None, None, 0, 0, 0, 0, 0, 0, 0),
    Observation(8, "a", Controls(1.0, -0.5), None, (Contact("b", 1.25, None),)),
    Environment("0.1.0", "glibc 2.36", "x86-64-v3", "2.4.1 (AVX2)", "OpenBLAS 0.3.31 (Haswell)"),
    Mark(4, "a", (0.5, -1.0)),
    ProcessStart("6f1c2a", synced=True),
    TickStart(7, "a"),
    TickStart(7, "a", Localised(POSE), complete=True),
    Command(
        4, "b", 0.0, 0.0, 3, "inconsistent", Inconsistent("a start that it told otherwise before", 0.5, 0.25)
    ),
    replace(CONFIG, planner_options={"step": 2, "gain": 0.5, "way": "left", "on": True}),
    Report(9, "a", heard=8, verdict=Undecided("no pose"), body=b"\x93\x01\x02\x03"),
    Report(0, "a", body=b""),
)
