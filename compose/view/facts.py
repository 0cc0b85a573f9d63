"""What is known of a run, tick by tick, however and in whatever order it comes to be known."""

from __future__ import annotations

import msgspec

from protocol.messages import (
    Command,
    DeadlineMissed,
    Estimate,
    FinalReport,
    GroundTruth,
    Message,
    MissionEnd,
    Observation,
    Report,
    RobotConfig,
)
from protocol.motion import Pose

Link = tuple[str, str]
"""from a robot to its peer"""


class Said(msgspec.Struct, frozen=True):
    """A report, and how long its frame was."""

    report: Report
    bytes: int


class Facts(msgspec.Struct, frozen=True):
    """One tick, as far as it is known; whatever is missing may come later."""

    tick: int
    truth: dict[str, Pose] = msgspec.field(default_factory=dict)
    observations: dict[str, Observation] = msgspec.field(default_factory=dict)
    reports: dict[str, Said] = msgspec.field(default_factory=dict)
    """by who says them"""
    commands: dict[str, Command] = msgspec.field(default_factory=dict)
    estimates: dict[str, Estimate] = msgspec.field(default_factory=dict)
    late: set[str] = msgspec.field(default_factory=set)
    """robots whose Command did not come in time"""
    without: set[str] = msgspec.field(default_factory=set)
    """robots that went without their peer's report, which did not come in time"""
    under_way: dict[Link, tuple[int, ...]] = msgspec.field(default_factory=dict)
    """the ticks of the reports that are on that link after this tick; known only to the world"""
    down: set[str | None] = msgspec.field(default_factory=set)
    """robots whose process was seen to be gone in this tick; none is the world's. No journal tells of it"""
    back: set[str | None] = msgspec.field(default_factory=set)
    """of these, those whose process was then seen again"""


class Gathering:
    """Facts, as they come in."""

    def __init__(self) -> None:
        self.ticks: dict[int, Facts] = {}
        self.configs: dict[str, RobotConfig] = {}
        self.final_reports: dict[str, FinalReport] = {}
        self.end: MissionEnd | None = None
        self.last = -1
        """the latest tick of which anything is known"""
        self.has_truth = False
        """whether the truth of any tick is known"""
        self._seen: set[str | None] = set()
        self.gone: set[str | None] = set()
        """those whose process was seen, and is not there any more; none is the world's"""
        self.touched: int | None = None
        """the earliest tick of which something has become known since somebody last set this to none"""

    def at(self, tick: int) -> Facts:
        """What is known of `tick`, to be added to."""
        down = self.gone if tick > self.last else ()
        self.last = max(self.last, tick)
        if self.touched is None or tick < self.touched:
            self.touched = tick
        known = self.ticks.get(tick)
        if known is None:
            known = self.ticks[tick] = Facts(tick, down=set(down))
        return known

    def present(self, who: str | None, there: bool) -> None:
        """Fold in whether the process of a robot, or none for the world's, is there now.

        One that has not been seen yet is not missed, nor one that has done its part.
        """
        if self.last < 0:
            return
        if there:
            self._seen.add(who)
            if who in self.gone:
                self.gone.remove(who)
                self.at(self.last).back.add(who)
        elif who in self._seen - self.gone and self.end is None and who not in self.final_reports:
            self.gone.add(who)
            now = self.at(self.last)
            now.down.add(who)
            now.back.discard(who)

    def take(self, message: Message, size: int, teller: str | None = None) -> None:
        """Fold in `message`, of a frame of `size` bytes; what is known already stays.

        `teller` is the robot in whose journal it stands; none of the world's, or on the network.
        """
        match message:
            case Observation(tick, robot):
                self.at(tick).observations.setdefault(robot, message)
            case Command(tick, robot):
                self.at(tick).commands.setdefault(robot, message)
            case Estimate(tick, robot):
                self.at(tick).estimates.setdefault(robot, message)
            case Report(tick, robot):
                self.at(tick).reports.setdefault(robot, Said(message, size))
            case GroundTruth(tick, poses):
                self.at(tick).truth.update(poses)
                self.has_truth = True
            case DeadlineMissed(tick, robot):
                facts = self.at(tick)
                (facts.late if teller is None else facts.without).add(teller or robot)
            case _:
                self._take_once(message)

    def _take_once(self, message: Message) -> None:
        match message:
            case RobotConfig(robot):
                self.configs.setdefault(robot, message)
            case FinalReport(robot):
                self.final_reports.setdefault(robot, message)
            case MissionEnd():
                self.end = self.end or message
