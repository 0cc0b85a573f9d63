"""An attacker is detected by its earlier Reports, its speed limits or ranges. An honest peer never is."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from agent.peer import false_reports, peer_state
from agent.peer.motion_log import MotionLog
from agent.planning import plausibility
from agent.planning.assured import Assured
from compose.errors import BadScenario
from compose.launch.in_process import run_mission
from compose.recording.reasons import reason_for
from compose.recording.run import Run
from compose.recording.summary_json import summary
from compose.scenario.scenario_file import parse
from compose.scenario.shipped_files import shipped
from protocol.attack import Attack, Kind, Part
from protocol.messages import Inconsistent, Ranged, Report, RobotConfig, Undecided
from protocol.motion import ORIGIN, Pose, Segment, follow
from protocol.orbits import rendezvous
from tests.groups import group_of
from tests.series import series
from tests.steps import Step, planner_of, steps

DEGREE = math.pi / 180.0
PARTS: tuple[Part, ...] = ("phase-1", "orbit", "encounter", "all")
SIZES: dict[Kind, tuple[float, ...]] = {
    "scale": (0.5, 0.99, 1.01),
    "rotate": (15.0 * DEGREE, DEGREE),
    "shift": (-0.3, 0.01),
}
OF_DRIVES = [Attack(kind, size, part) for kind, sizes in SIZES.items() for size in sizes for part in PARTS]
OF_STARTS = [Attack("radius", 0.01), Attack("radius", 0.3), Attack("heading", DEGREE), Attack("heading", 0.5)]
FINE = "noise = {anchor_sigma = 0.01, mutual_sigma = 0.01}\n"


def mission(seed: int, lies: dict[str, Attack], noise: str = "") -> Run:
    """Return the recording of a random mission with these attacks."""
    text = shipped()["random"].read_text().replace("[mission]\n", f"[mission]\n{noise}")
    scenario = parse(text, "random", seed=seed)
    robots = tuple(replace(robot, attack=lies.get(robot.id)) for robot in scenario.robots)
    return run_mission(replace(scenario, robots=robots, max_ticks=400))


def outcome(recording: Run) -> str:
    return str(summary(recording, "in-process", None)["outcome"])


# --- exact sensors ------------------------------------------------------------------------------------


@pytest.mark.parametrize("attacker", ["a", "b"])
@pytest.mark.parametrize(
    "attack", [*OF_DRIVES, *OF_STARTS], ids=lambda attack: f"{attack.kind}-{attack.part}-{attack.size:.2g}"
)
def test_every_false_manoeuvre_or_start_is_inconsistent(attack: Attack, attacker: str) -> None:
    for seed in range(6):
        recording = mission(seed, {attacker: attack})
        if not _is_falsified(recording, attacker, attack):
            continue
        assert outcome(recording) == "inconsistent", seed
        assert recording.end is not None
        peer = "b" if attacker == "a" else "a"
        assert str(reason_for(recording.end)).startswith(f"{peer}: {attacker} reports ")


def _is_falsified(recording: Run, attacker: str, attack: Attack) -> bool:
    """Return whether the attack changes anything: whether the robot has moved in that part of its log."""
    phases = {"phase-1": 1, "orbit": 2, "encounter": 3}
    return attack.part == "all" or any(
        command.phase == phases[attack.part]
        and (command.v if attack.kind == "scale" else command.v or command.omega)
        for moment in recording.ticks
        for command in [moment.commands[attacker]]
    )


def test_a_rotation_of_the_whole_path_about_the_anchor_is_harmless() -> None:
    """An anchor frame has no direction of its own, so this cannot be detected, and misleads no robot."""
    for seed in range(6):
        for attacker in ("a", "b"):
            assert outcome(mission(seed, {attacker: Attack("reframe", 1.0)})) == "localised"


def test_two_attackers_are_detected_like_one() -> None:
    for seed in range(6):
        assert (
            outcome(mission(seed, {"a": Attack("heading", 0.1), "b": Attack("radius", 0.2)}))
            == "inconsistent"
        )


def test_an_attacker_gives_up_when_its_peer_is_inconsistent() -> None:
    recording = mission(0, {"a": Attack("scale", 0.5)})
    last = recording.ticks[-1].commands
    assert isinstance(last["b"].verdict, Inconsistent)
    met = next(step for step in steps("paper-1") if step.heard["a"])
    told = [replace(report, verdict=Inconsistent("a tall story")) for report in met.heard["a"]]
    verdict = planner_of(met.observed["a"]).decide(met.observed["a"], told).verdict
    assert verdict == Undecided("b found a contradiction: a tall story")


# --- noisy sensors ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "attack",
    series(
        [
            Attack("scale", 0.5, "orbit"),
            Attack("scale", 0.5, "encounter"),
            Attack("rotate", 15.0 * DEGREE, "encounter"),
        ]
    ),
    ids=lambda attack: f"{attack.kind}-{attack.part}",
)
@pytest.mark.long
def test_an_attack_larger_than_the_noise_is_inconsistent(attack: Attack) -> None:
    """Robot a is the attacker: no anchor range depends on its path from the anchor to the encounter."""
    for seed in range(3):
        recording = mission(seed, {"a": attack}, FINE)
        assert outcome(recording) == "inconsistent", seed
        alarm = next(
            command.verdict
            for moment in recording.ticks
            for command in moment.commands.values()
            if isinstance(command.verdict, Inconsistent)
        )
        assert alarm.p_value < 1e-4
        assert alarm.residual is not None
        assert alarm.residual > 3.0


MISLEADING = {
    "a robot that is misled finds other places to range from": (30, "phase-1"),
    "three of seven ranges of the peer to its anchor fit no path": (3186469040901952592, "phase-1"),
    "a hypothesis that drops the first two mutual ranges fits the others": (2456274391522540820, "encounter"),
}
MORE_MISLEADING = [
    *((seed, "phase-1") for seed in (49, 109, 4703860127338927889, 3023018364303879480)),
    *((seed, "encounter") for seed in (2683537179718644026, 3512950558579086514)),
]


@pytest.mark.parametrize(
    ("seed", "part"),
    [
        *[pytest.param(*case, id=name) for name, case in MISLEADING.items()],
        *[pytest.param(*case, marks=pytest.mark.long) for case in MORE_MISLEADING],
    ],
)
def test_ranges_that_fit_false_data_do_not_hide_those_that_contradict_it(seed: int, part: Part) -> None:
    """Many good ranges once hid some strays of another kind, or of another time."""
    assert outcome(mission(seed, {"a": Attack("scale", 0.5, part)}, FINE)) == "inconsistent"


@pytest.mark.long
def test_honest_robots_are_consistent_under_noise() -> None:
    for seed in range(8):
        assert outcome(mission(seed, {}, FINE)) == "localised", seed


# --- consistency of a Report --------------------------------------------------------------------------


def told_to_a(phase: int) -> tuple[Step, Report]:
    """Return the first Report of b that a receives in `phase` of b, and the step in which it does."""
    step = next(step for step in steps("paper-1") if step.heard["a"] and step.heard["a"][0].phase == phase)
    return step, step.heard["a"][0]


def objection(step: Step, *reports: Report) -> Inconsistent | None:
    """Return the objection of a to the last of `reports`, after it has received the others."""
    state = step.observed["a"]
    for report in reports[:-1]:
        state = replace(state, peer_state=peer_state.with_report(state.peer_state, report))
    return plausibility.objection(
        state.peer_state,
        peer_state.with_report(state.peer_state, reports[-1]),
        reports[-1],
        state.config,
        1e-6,
        Assured().rendezvous,
    )


def test_reports_of_an_honest_peer_are_accepted_when_repeated_too() -> None:
    step, report = told_to_a(2)
    assert objection(step, report) is None
    assert objection(step, report, report) is None


def test_a_report_that_contradicts_an_earlier_one_is_inconsistent() -> None:
    step, report = told_to_a(2)
    last = report.runs[-1]
    slower = replace(report, runs=(*report.runs[:-1], Segment(last.ticks, 0.5 * last.v, last.omega)))
    assert "earlier report" in _claim(objection(step, report, slower))
    farther = replace(report, ranges=(Ranged(report.ranges[0].tick, 0.5), *report.ranges[1:]))
    assert "earlier report" in _claim(objection(step, report, farther))
    assert report.start is not None
    elsewhere = replace(report, start=replace(report.start, heading=report.start.heading + 1e-9))
    assert "a start" in _claim(objection(step, report, elsewhere))


def test_a_reported_manoeuvre_beyond_v_max_or_omega_max_is_inconsistent() -> None:
    step, report = told_to_a(2)
    first = report.runs[0]
    for run in (Segment(first.ticks, 1.001, first.omega), Segment(first.ticks, first.v, -3.15)):
        alarm = objection(step, replace(report, runs=(run, *report.runs[1:])))
        assert ", limit " in _claim(alarm)


def test_reported_anchor_ranges_must_agree_with_the_reported_path() -> None:
    step, report = told_to_a(2)
    one = report.ranges[1]
    ranges = (report.ranges[0], Ranged(one.tick, one.range + 1e-4), *report.ranges[2:])
    alarm = objection(step, replace(report, ranges=ranges))
    assert f"at tick {one.tick}" in _claim(alarm)
    assert alarm is not None
    assert alarm.residual == pytest.approx(1e-4)


def test_a_robot_that_reports_orbiting_must_be_on_its_orbit_and_head_along_it() -> None:
    step, report = told_to_a(2)
    assert report.state == "orbiting"
    last = report.runs[-1]
    late = (*report.runs[:-1], Segment(last.ticks - 1, last.v, last.omega))
    straight = replace(report, runs=(*late, Segment(1, last.v, 0.0)))
    assert "off its orbit" in _claim(objection(step, straight))
    turned = replace(report, runs=(*late, Segment(1, 0.0, 1.0)))
    assert "heading" in _claim(objection(step, turned))


@pytest.mark.parametrize("seed", range(3))
def test_a_visitor_admits_the_orbits_of_each_meeting_that_the_visited_robot_may_have_with_it(
    seed: int,
) -> None:
    scenario = group_of(4, seed)
    planned = [
        (one.visitor, one.visited) for one in scenario.meetings if scenario.config(one.visitor).role == "a"
    ]
    for retry in scenario.retries:
        distance = scenario.config(retry.visitor).in_meeting(retry.visited, "a").anchor_distance
        assert retry.rendezvous == rendezvous(scenario.mission, distance, "assured")
        planned.append((retry.visitor, retry.visited))
    for searching, other in planned:
        visit = scenario.config(other).in_meeting(searching, "a")
        plan = rendezvous(scenario.mission, visit.anchor_distance, "assured")
        for orbit in (plan.a, plan.b, visit.rendezvous.b):
            assert _of_orbiting(visit, orbit.radius) is None
        off = _of_orbiting(visit, 1.1 * plan.a.radius)
        assert "off its orbit" in _claim(off)


def _of_orbiting(config: RobotConfig, radius: float) -> Inconsistent | None:
    """Return the objection to a report of the peer that it is on an orbit of this radius."""
    start = Pose(radius, 0.0, 0.5 * math.pi)
    report = Report(0, config.peer, phase=2, state="orbiting", start=start)
    heard = peer_state.with_report(peer_state.PeerState(), report)
    return plausibility.objection(peer_state.PeerState(), heard, report, config, 1e-6, Assured().rendezvous)


def _claim(alarm: Inconsistent | None) -> str:
    return alarm.claim if alarm is not None else ""


# --- false data ---------------------------------------------------------------------------------------

runs = st.builds(Segment, st.integers(1, 5), st.floats(-1.0, 1.0), st.floats(-3.0, 3.0))
logs = st.lists(runs, min_size=1, max_size=8).map(
    lambda runs: MotionLog().extended(0, 0, MotionLog(sum(run.ticks for run in runs), tuple(runs)))
)
ticks = st.none() | st.integers(0, 40)


@settings(max_examples=60)
@given(logs, st.sampled_from([*OF_DRIVES, *OF_STARTS]), ticks, ticks, st.integers(1, 40))
def test_the_false_log_of_an_attacker_only_grows(
    log: MotionLog, attack: Attack, parted: int | None, later: int | None, seen: int
) -> None:
    """The reported first ticks stay the same when the log grows."""
    met = None if parted is None or later is None else parted + later
    seen = min(seen, log.through)
    young = MotionLog(seen, log.between(0, seen))
    known = [tick if tick is not None and tick <= seen else None for tick in (parted, met)]
    whole = false_reports.falsified_log(log, attack, parted, met, 1.0)
    assert whole.through == log.through
    assert false_reports.falsified_log(young, attack, known[0], known[1], 1.0).between(
        0, seen
    ) == whole.between(0, seen)


@settings(max_examples=30)
@given(logs, st.integers(0, 10), st.integers(0, 10), st.floats(-3.0, 3.0))
def test_a_rotation_turns_what_was_driven_in_its_part_and_nothing_after(
    log: MotionLog, parted: int, orbit: int, angle: float
) -> None:
    told = false_reports.falsified_log(log, Attack("rotate", angle, "orbit"), parted, parted + orbit, 1.0)
    true_end = follow(ORIGIN, log.between(0, log.through), 1.0)
    told_end = follow(ORIGIN, told.between(0, log.through), 1.0)
    over = orbit > 0 and parted + orbit < log.through
    inside = orbit > 0 and parted < log.through and not over
    assert told_end.heading - true_end.heading == pytest.approx(angle if inside else 0.0, abs=1e-9)


def test_a_false_radius_goes_with_false_ranges_and_moves_the_start_only() -> None:
    log = MotionLog(3, (Segment(3, 1.0, 0.0),), (Ranged(0, 1.0), Ranged(1, 0.2)))
    attack = Attack("radius", -0.5)
    assert false_reports.falsified_log(log, attack, None, None, 1.0).ranges == (
        Ranged(0, 0.5),
        Ranged(1, 0.0),
    )
    assert false_reports.start(Pose(1.0, 0.0, 2.0), attack) == Pose(0.5, 0.0, 2.0)


# --- the scenario -------------------------------------------------------------------------------------


def test_a_scenario_names_the_attackers_and_their_attacks() -> None:
    text = (
        shipped()["paper-1"]
        .read_text()
        .replace('id = "b"', 'id = "b"\nattack = {kind = "scale", size = 0.5}')
    )
    scenario = parse(text, "paper-1")
    assert [robot.attack for robot in scenario.robots] == [None, Attack("scale", 0.5, "all")]
    assert [scenario.config(robot).attack for robot in ("a", "b")] == [None, Attack("scale", 0.5, "all")]


@pytest.mark.parametrize(
    ("attack", "words"),
    [
        ('{kind = "boast", size = 1.0}', ("robot[1].attack.kind", "boast")),
        ('{kind = "scale"}', ("robot[1].attack", "size")),
        ('{kind = "scale", size = 1e9}', ("robot[1].attack.size",)),
        ('{kind = "shift", size = 1.0, part = "lunch"}', ("robot[1].attack.part", "lunch")),
    ],
)
def test_an_invalid_attack_is_refused_with_its_field(attack: str, words: tuple[str, ...]) -> None:
    text = shipped()["paper-1"].read_text().replace('id = "b"', f'id = "b"\nattack = {attack}')
    with pytest.raises(BadScenario) as error:
        parse(text, "mine")
    assert all(word in str(error.value) for word in ("mine", *words)), str(error.value)
