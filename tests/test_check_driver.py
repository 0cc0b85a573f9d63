"""`tandem check-driver`: the example driver passes, and for each broken driver the violation is reported."""

from __future__ import annotations

import re

import pytest

from compose.hardware.conformance import check_results
from compose.hardware.exercise import Broken, ExerciseRun
from compose.launch.driver_loader import config_of
from compose.scenario.scenario_file import load, parse
from compose.terminal.finding import WRONG
from tests import broken_drivers, virtual_time
from tests.commands import refused, tandem
from tests.test_group_field import FAR

MANOEUVRE_S = 0.1
CONFIG = config_of(load("paper-1"), "a", MANOEUVRE_S)


def test_the_example_fulfils_the_driver_contract() -> None:
    ended = tandem("check-driver", "tests.virtual_time:Rover", "--rate", "8")
    assert ended.status == 0, ended.out
    lines = [line for line in ended.out.splitlines() if "truly at" not in line]
    assert len(lines) == 8
    assert all(line.startswith("ok     ") for line in lines)


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        ("TellsWhatWasAsked", "it reports 1.00 of a manoeuvre that was stopped after 0.5"),
        ("TurnsInDegrees", "expected (0 m/s, 1 rad/s): degrees?"),
        ("RangesInFeet", "ranges are 3.281 times as long as on the path from the odometry"),
        ("RangesBeyondReach", "m to the anchor, beyond R = 3 m"),
        ("RepeatsStaleRanges", "is the range of tick 4, to the bit"),
        ("MissesRanges", "tick 4: no range, "),
        ("TellsTheTickBefore", "it reports what was driven in tick 2"),
        ("SkipsEverySecondTick", "it drove"),
        ("DrivesWithoutEnd", "at rest, without another command: it drove"),
        ("DrivesOnAfterStop", "it reports 1.00 of a manoeuvre that was stopped after 0.5"),
        ("DrivesForTwiceAsLong", "m/s, 0 rad/s), expected (0.5 m/s, 0 rad/s)"),
        ("DrivesInHalfTheTime", "1.00 of the manoeuvre was driven in 0.5"),
        ("WaitsForItsWheels", "of a manoeuvre, expected at most 0.05: it must not wait"),
    ],
)
@pytest.mark.long
def test_a_broken_driver_is_reported_with_what_it_violates(
    broken: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = virtual_time.Clock()
    for module in virtual_time.MODULES:
        monkeypatch.setattr(module, "time", clock)
    driver = getattr(broken_drivers, broken)(CONFIG, MANOEUVRE_S)
    trial = ExerciseRun(driver, CONFIG, MANOEUVRE_S)
    trial.go_through()
    assert said in "; ".join([one.text for one in check_results(trial) if one.mark == WRONG])


def test_a_driver_of_a_group_is_checked_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = virtual_time.Clock()
    for module in virtual_time.MODULES:
        monkeypatch.setattr(module, "time", clock)
    config = config_of(parse(FAR, "four"), "a", MANOEUVRE_S)
    driver = broken_drivers.RangesToOthersBeyondReach(config, MANOEUVRE_S)
    trial = ExerciseRun(driver, config, MANOEUVRE_S)
    trial.go_through()
    (found,) = [one.text for one in check_results(trial) if one.mark == WRONG]
    assert found.endswith(": tick 4: 3.5 m to c, beyond R = 3 m")


def test_a_range_to_a_robot_that_is_not_in_the_group_ends_the_exercise() -> None:
    config = config_of(parse(FAR, "four"), "a", MANOEUVRE_S)
    trial = ExerciseRun(broken_drivers.RangesToStrangers(config, MANOEUVRE_S), config, MANOEUVRE_S)
    with pytest.raises(Broken, match=re.escape("sense(0): mutual_ranges: 'x' is none of b, c, d")):
        trial.go_through()


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        (
            "virtual_time:RangesInFeet",
            "wrong  ranges to the anchor are in metres, and agree with the path from the odometry: ",
        ),
        ("broken_drivers:SensesNonsense", "the exercise can be completed: after 'arc': sense(5): Expected"),
        (
            "broken_drivers:LosesItsSensors",
            "the exercise can be completed: after 'straight': OSError: no such device",
        ),
    ],
)
def test_what_is_wrong_is_a_line_and_a_status(broken: str, said: str) -> None:
    ended = tandem("check-driver", f"tests.{broken}", "--rate", "10")
    assert ended.status == 1
    assert said in ended.out
    assert ended.err == ""


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("docs.rover", "'docs.rover' is not a driver; expected MODULE:CLASS"),
        ("docs.nothing:Rover", "docs.nothing:Rover: there is no module 'docs.nothing'"),
        ("docs.rover:Nobody", "docs.rover:Nobody: there is no 'Nobody' in docs.rover"),
        ("tests.broken_drivers:NoDriver", "is not a driver: it has no drive, stop, close"),
    ],
)
def test_what_is_no_driver_is_one_line(name: str, said: str) -> None:
    refused(tandem("check-driver", name), "tandem check-driver: ", said)


def test_an_option_that_a_driver_does_not_know_is_one_line() -> None:
    refused(
        tandem("check-driver", "docs.rover:Rover", "--option", "colour=red"),
        "docs.rover:Rover: cannot be created: TypeError: ",
        "colour",
    )
