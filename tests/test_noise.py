"""The noise of the simulator: its random streams, and its effect on ranges, actuation and odometry."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Sequence
from contextlib import closing
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from compose.launch import in_process
from compose.recording.reasons import reason_for
from compose.recording.recording_files import WORLD_JOURNAL
from compose.recording.rows import ticks_csv
from compose.recording.run import Run, read
from compose.scenario.scenario_file import load, parse
from protocol.journal import journal_file
from protocol.journal.environment import of_world
from protocol.messages import Cause, Command, Localised, MissionEnd, Observation, Undecided
from protocol.motion import REST, Controls, Covariance, Pose, step
from protocol.noise import Noise, VelocityNoise
from protocol.wire import decode, encode
from tests.commands import SECTION_IV, decided, journals, tandem
from tests.missions import own_ranges
from tests.series import series
from world import random_streams
from world.random_streams import gaussian, uniform
from world.scenario import Scenario
from world.sensors import Mutual, executed, in_contact, mutual_ranges, odometry
from world.simulation import Simulation
from world.tick import World, advance, observations, release
from world.truth import Truth
from world.world_journal import Tick, WorldHistory

Floats = NDArray[np.float64]
N = 6_000
"""The number of draws in a statistical test."""
Z = 4.5
"""The tolerance of a statistic in standard errors, exceeded by one in 150 000 seeds."""
RHO_A, RHO_B, APART = 1.5, 2.0, 2.5
"""The distances in m of the robots of `near` from their anchors, and from each other."""


def near_text(noise: str, world: str = "", *, seed: int = 1, max_ticks: int = 500) -> str:
    """Return a scenario file in which all ranges are within R from the start.

    `noise` is what the robots are told, and `world` a table of the world's noise, if it is another.
    """
    return f"""
        name = "near"
        seed = {seed}
        max_ticks = {max_ticks}
        {SECTION_IV}
        [mission.noise]
        {noise}
        {world}
        [[robot]]
        id = "a"
        anchor = [0.0, 0.0]
        start = [{RHO_A}, 0.0, 1.0]
        [[robot]]
        id = "b"
        anchor = [6.0, 0.0]
        start = [{RHO_A + APART}, 0.0, 4.0]
        """


def near(noise: str = "", *, seed: int = 1, max_ticks: int = 500) -> Scenario:
    """Return the scenario of `near_text`."""
    return parse(near_text(noise, seed=seed, max_ticks=max_ticks), "near")


def at_tick(scenario: Scenario, tick: int) -> Truth:
    """Return the truth at `tick` with all robots at their starts."""
    return replace(release(scenario).truth, tick=tick)


def to_anchors(scenario: Scenario, ticks: int = N) -> list[list[float | None]]:
    """Return the anchor ranges of every robot, tick by tick."""
    told = [own_ranges(at_tick(scenario, tick), scenario) for tick in range(ticks)]
    return [list(ranges) for ranges in zip(*told, strict=True)]


def mutual(scenario: Scenario, ticks: int = N) -> list[float | None]:
    """Return the mutual ranges, tick by tick; the robots are always in contact."""
    told = []
    for tick in range(ticks):
        (found,) = mutual_ranges(at_tick(scenario, tick), scenario, scenario.pairs())
        assert found is not None
        told.append(found.range)
    return told


def all_ranges(scenario: Scenario, ticks: int = N) -> list[list[float | None]]:
    """Return the anchor ranges of a, those of b, and the mutual ranges."""
    return [*to_anchors(scenario, ticks), mutual(scenario, ticks)]


def known(ranges: Sequence[float | None]) -> Floats:
    return np.array([rho for rho in ranges if rho is not None])


def sent(v: float, omega: float, robot: str = "a", tick: int = 0) -> Command:
    return Command(tick, robot, v, omega, 1, "straight")


def has_mean(values: Floats, mean: float, sigma: float) -> bool:
    return bool(abs(values.mean() - mean) <= Z * sigma / math.sqrt(len(values)))


def has_share(hits: int, of: int, share: float) -> bool:
    return abs(hits / of - share) <= Z * math.sqrt(share * (1.0 - share) / of)


def is_gaussian(values: Floats, sigma: float) -> bool:
    """Return true if `values` are consistent with a Gaussian of mean 0 and standard deviation `sigma`."""
    shares = ((1.0, 0.682689), (2.0, 0.954500), (3.0, 0.997300))
    within = [has_share(int((np.abs(values) <= k * sigma).sum()), len(values), share) for k, share in shares]
    spread = abs(values.std() / sigma - 1.0) <= Z / math.sqrt(2.0 * len(values))
    return has_mean(values, 0.0, sigma) and bool(spread) and all(within)


def are_uncorrelated(one: Floats, other: Floats) -> bool:
    return bool(abs(np.corrcoef(one, other)[0, 1]) <= Z / math.sqrt(len(one)))


def is_white(values: Floats) -> bool:
    return all(are_uncorrelated(values[lag:], values[:-lag]) for lag in (1, 2, 3))


# --- random streams ------------------------------------------------------------------------------------


def test_without_noise_nothing_is_drawn_and_every_tick_is_the_same_to_the_bit(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def drawn(*_: object) -> float:
        raise AssertionError("something is drawn")

    exact = load("paper-1")
    without, zero = tmp_path / "without", tmp_path / "zero"
    for folder in (without, zero):
        folder.mkdir()
    table = ticks_csv(in_process.run_mission(exact, without))
    monkeypatch.setattr(random_streams, "_uniforms", drawn)
    zeros = Noise(outlier_bias=(0.1, 0.2), actuation=VelocityNoise(0.0, 0.0, 0.0, 0.0))
    assert zeros.exact
    scenario = replace(exact, mission=replace(exact.mission, noise=zeros))
    assert ticks_csv(in_process.run_mission(scenario, zero)) == table
    assert len(table.splitlines()) == 1 + 2 * 49
    for robot in ("a", "b"):
        assert frames(zero, robot) == frames(without, robot)
    with pytest.raises(AssertionError, match="something is drawn"):
        in_process.run_mission(near("anchor_sigma = 0.1"))


def frames(folder: Path, robot: str) -> list[bytes]:
    """Return the journal of a robot after its RobotConfig, which contains the noise parameters."""
    return list(journal_file.read(folder / f"agent-{robot}.journal"))[2:]


@pytest.mark.parametrize("draw", [uniform, gaussian])
def test_a_draw_follows_from_seed_sensor_robot_and_tick_alone(
    draw: Callable[[int, str, str, int], float],
) -> None:
    keys = list(product((0, 1, 12), ("x", "y"), ("a", "b"), (0, 1, 23, 123)))
    values = [draw(*key) for key in keys]
    assert len(set(values)) == len(keys), "each key has its own"
    assert [draw(*key) for key in reversed(keys)] == values[::-1], "in whatever order"


def test_uniform_draws_are_uniform_between_0_and_1_and_gaussian_ones_gaussian() -> None:
    flat = np.array([uniform(1, "x", "a", tick) for tick in range(N)])
    assert 0.0 < flat.min() < flat.max() < 1.0
    counts = np.histogram(flat, 20, (0.0, 1.0))[0]
    assert all(has_share(int(count), N, 0.05) for count in counts)
    bell = np.array([gaussian(1, "x", "a", tick) for tick in range(N)])
    assert is_gaussian(bell, 1.0)
    assert is_white(flat)
    assert is_white(bell)


def test_an_outlier_or_a_drop_out_shifts_no_other_draw() -> None:
    sigmas = "anchor_sigma = 0.01\nmutual_sigma = 0.02\nactuation = {v = 0.1}\nodometry = {omega = 0.1}"
    plain, rough = near(sigmas), near(f"{sigmas}\noutliers = 0.25\ndrop_outs = 0.2")
    ticks = 500
    for clean, seen in zip(all_ranges(plain, ticks), all_ranges(rough, ticks), strict=True):
        extra = [
            now - was for was, now in zip(clean, seen, strict=True) if was is not None and now is not None
        ]
        assert len(clean) == len(known(clean))
        assert 0.7 * ticks < len(extra) < 0.9 * ticks
        biased = [bias for bias in extra if bias != 0.0]
        assert 0.15 * ticks < len(biased) < 0.4 * len(extra)
        assert 0.3 < min(biased) < max(biased) < 2.0
    for tick in range(ticks):
        asked = Controls(1.0, 0.5)
        assert executed(asked, plain, "a", tick) == executed(asked, rough, "a", tick)
        assert odometry(asked, plain, "a", tick) == odometry(asked, rough, "a", tick)


def test_other_robots_shift_no_draw() -> None:
    two = near("anchor_sigma = 0.1\nmutual_sigma = 0.1")
    far = [
        replace(
            one,
            id=name,
            encounter=replace(one.meeting, peer=peer),
            given_anchor=replace(one.anchor, y=90.0),
            start=replace(one.start, y=90.0),
        )
        for one, name, peer in zip(two.robots, "cd", "dc", strict=True)
    ]
    four = replace(two, robots=(*far, *two.robots))
    for tick in range(20):
        assert own_ranges(at_tick(four, tick), four)[2:] == own_ranges(at_tick(two, tick), two)
        assert own_ranges(at_tick(four, tick), four)[:2] != own_ranges(at_tick(two, tick), two)
        _, ours = mutual_ranges(at_tick(four, tick), four, four.pairs())
        assert [ours] == mutual_ranges(at_tick(two, tick), two, two.pairs())


def moved_to(world: World, tick: int) -> World:
    """Return `world` at another tick."""
    truth = at_tick(world.scenario, tick)
    return replace(world, truth=truth, contacts=in_contact(truth, world.scenario, world.pairs))


def test_a_mutual_range_is_measured_once_and_sent_to_both() -> None:
    scenario = near("mutual_sigma = 0.1\noutliers = 0.2\ndrop_outs = 0.2")
    world = release(scenario)
    told = set()
    for tick in range(200):
        one, other = observations(moved_to(world, tick))
        (by_a,), (by_b,) = one.contacts, other.contacts
        assert (by_a.peer, by_b.peer) == ("b", "a")
        assert by_a.range == by_b.range
        told.add(by_a.range)
    assert None in told
    assert len(told) > 150, "each of its own"


# --- ranges -------------------------------------------------------------------------------------------


def test_ranges_are_gaussian_with_the_given_sigmas() -> None:
    ranges = all_ranges(near("anchor_sigma = 0.05\nmutual_sigma = 0.2"))
    errors = [known(told) - rho for told, rho in zip(ranges, (RHO_A, 2.0, APART), strict=True)]
    for error, sigma in zip(errors, (0.05, 0.05, 0.2), strict=True):
        assert len(error) == N
        assert is_gaussian(error, sigma)
        assert is_white(error)
    assert are_uncorrelated(errors[0], errors[1])
    assert are_uncorrelated(errors[0], errors[2])


@pytest.mark.parametrize("share", series([0.05, 0.25]))
def test_outliers_have_their_probability_and_a_uniform_positive_bias(share: float) -> None:
    least, most = 0.4, 1.6
    scenario = near(f"outliers = {share}\noutlier_bias = [{least}, {most}]")
    for told, rho in zip(all_ranges(scenario), (RHO_A, RHO_B, APART), strict=True):
        bias = known(told) - rho
        biased = bias[bias != 0.0]
        assert len(bias) == N
        assert has_share(len(biased), N, share)
        assert least <= biased.min() < biased.max() <= most
        quarters = np.histogram(biased, 4, (least, most))[0]
        assert all(has_share(int(quarter), len(biased), 0.25) for quarter in quarters)
        assert is_white(bias)


def test_outliers_and_sigmas_add_up() -> None:
    told = (
        known(to_anchors(near("anchor_sigma = 0.1\noutliers = 0.25\noutlier_bias = [1.0, 1.0]"))[0]) - RHO_A
    )
    upper = told[told > 0.5]
    assert has_share(len(upper), N, 0.25)
    assert is_gaussian(upper - 1.0, 0.1)
    assert is_gaussian(told[told <= 0.5], 0.1)


@pytest.mark.parametrize("share", series([0.02, 0.5]))
def test_drop_outs_have_their_probability_each_sensor_on_its_own(share: float) -> None:
    gone = [
        np.array([rho is None for rho in told], float) for told in all_ranges(near(f"drop_outs = {share}"))
    ]
    for dropped in gone:
        assert has_share(int(dropped.sum()), N, share)
        assert is_white(dropped)
    assert are_uncorrelated(gone[0], gone[1])
    assert are_uncorrelated(gone[0], gone[2])


def test_reports_are_received_despite_a_drop_out(tmp_path: Path) -> None:
    """The seed drops every mutual range of the mission."""
    dropping = next(
        seed for seed in range(1000) if mutual(near("drop_outs = 0.5", seed=seed), 4) == [None] * 4
    )
    recording = in_process.run_mission(near("drop_outs = 0.5", seed=dropping, max_ticks=3), tmp_path)
    said = recording.final_reports
    assert (said["a"].mutual_ranges, said["b"].mutual_ranges) == (0, 0)
    assert said["a"].reports_sent >= 1
    assert said["a"].reports_heard == said["b"].reports_sent
    assert said["b"].reports_heard == said["a"].reports_sent


def test_who_is_in_range_follows_from_the_distance_and_not_from_what_is_measured() -> None:
    scenario = near("anchor_sigma = 0.1\nmutual_sigma = 0.1")
    origins, reach = release(scenario).truth.origins, scenario.mission.sensing_range
    rim, beyond = (Pose(rho, 0.0, 0.0) for rho in (reach, reach * (1.0 + 1e-9)))
    for tick in range(100):
        on_it = Truth(tick, (rim, Pose(0.0, 0.0, 0.0)), origins)
        off_it = Truth(tick, (beyond, Pose(0.0, 0.0, 0.0)), origins)
        assert own_ranges(on_it, scenario)[0] is not None
        assert isinstance(mutual_ranges(on_it, scenario, [(0, 1)])[0], Mutual)
        assert own_ranges(off_it, scenario)[0] is None
        assert mutual_ranges(off_it, scenario, [(0, 1)]) == [None]
    measured = [own_ranges(Truth(tick, (rim, rim), origins), scenario)[0] or 0.0 for tick in range(100)]
    assert min(measured) < reach < max(measured)


def test_a_range_is_never_negative() -> None:
    scenario = near("anchor_sigma = 0.5")
    origins = release(scenario).truth.origins
    here = Pose(0.01, 0.0, 0.0)
    told = known([own_ranges(Truth(tick, (here, here), origins), scenario)[0] for tick in range(100)])
    assert told.min() == 0.0
    assert 30 < (told > 0.0).sum() < 70


# --- actuation and odometry ------------------------------------------------------------------------------

DRIFT = "{v = 0.02, omega = 0.05}"


def test_actuation_noise_moves_the_robot_and_an_exact_odometry_says_how() -> None:
    world = release(near(f"actuation = {DRIFT}"))
    onward = advance(world, {"a": sent(1.0, 0.5)})
    assert isinstance(onward, World)
    (observation, _), period = observations(onward), world.scenario.mission.period
    asked, done = Controls(1.0, 0.5), observation.executed
    assert done is not None
    assert done.v != asked.v
    assert done.omega != asked.omega
    assert onward.truth.local[0] == step(world.truth.local[0], done.v, done.omega, period)
    assert onward.truth.local[0] != step(world.truth.local[0], asked.v, asked.omega, period)


def test_odometry_noise_moves_no_robot() -> None:
    world = release(near(f"odometry = {DRIFT}"))
    onward = advance(world, {"a": sent(1.0, 0.5)})
    assert isinstance(onward, World)
    (observation, _), period = observations(onward), world.scenario.mission.period
    assert onward.truth.local[0] == step(world.truth.local[0], 1.0, 0.5, period)
    assert observation.executed is not None
    assert observation.executed.v != 1.0
    assert observation.executed.omega != 0.5


@pytest.mark.parametrize("act", [executed, odometry], ids=["actuation", "odometry"])
@pytest.mark.parametrize(("v", "omega"), [(1.0, 0.0), (-0.5, 2.0), (0.0, -1.0), (0.0, 0.0)])
def test_noise_is_a_fraction_of_v_and_omega_and_a_floor_in_squares(
    act: Callable[[Controls, Scenario, str, int], Controls], v: float, omega: float
) -> None:
    drift = "{v = 0.02, omega = 0.03, v_floor = 0.015, omega_floor = 0.04}"
    scenario = near(f"actuation = {drift}\nodometry = {drift}")
    done = [act(Controls(v, omega), scenario, "a", tick) for tick in range(N)]
    by_v = np.array([controls.v - v for controls in done])
    by_omega = np.array([controls.omega - omega for controls in done])
    assert is_gaussian(by_v, math.hypot(0.02 * v, 0.015))
    assert is_gaussian(by_omega, math.hypot(0.03 * omega, 0.04))
    assert are_uncorrelated(by_v, by_omega)
    for values in (by_v, by_omega):
        assert is_white(values)


def test_wheels_and_odometry_err_each_on_their_own_and_each_robot_too() -> None:
    scenario, asked = near(f"actuation = {DRIFT}\nodometry = {DRIFT}"), Controls(1.0, 1.0)
    driven, measured = (
        np.array([act(asked, scenario, "a", tick).v for tick in range(N)]) for act in (executed, odometry)
    )
    others = np.array([executed(asked, scenario, "b", tick).v for tick in range(N)])
    assert are_uncorrelated(driven, measured)
    assert are_uncorrelated(driven[:-1], measured[1:]), "of the same manoeuvre"
    assert are_uncorrelated(driven, others)


def test_a_robot_at_rest_is_disturbed_by_a_floor_only() -> None:
    fractions = near(f"actuation = {DRIFT}\nodometry = {DRIFT}")
    floors = near("actuation = {v_floor = 1e-3}\nodometry = {omega_floor = 1e-3}")
    for tick in range(100):
        assert executed(REST, fractions, "a", tick) == odometry(REST, fractions, "a", tick) == REST
        assert executed(REST, floors, "a", tick).v != 0.0
        assert executed(REST, floors, "a", tick).omega == 0.0
        assert odometry(REST, floors, "a", tick).v == 0.0
        assert odometry(REST, floors, "a", tick).omega != 0.0


def test_wheels_saturate_before_they_err() -> None:
    scenario = near(f"actuation = {DRIFT}")
    world = release(scenario)
    onward = advance(world, {"a": sent(1e3, -1e3)})
    assert isinstance(onward, World)
    assert onward.executed is not None
    assert onward.executed[0] == executed(Controls(1.0, -math.pi), scenario, "a", 0)


def test_the_largest_noisy_motion_fits_an_observation() -> None:
    drift = VelocityNoise(0.5, 0.5, 1e4, 1e4)
    noise = Noise(outliers=0.5, outlier_bias=(0.0, 1e6), actuation=drift, odometry=drift)
    exact = near()
    mission = replace(exact.mission, max_speed=1e6, max_turn_rate=1e6, noise=noise)
    scenario = replace(exact, mission=mission)
    fastest = 0.0
    for tick in range(2000):
        done = odometry(executed(Controls(1e6, 1e6), scenario, "a", tick), scenario, "a", tick + 1)
        observation = Observation(tick, "a", done, own_ranges(at_tick(scenario, tick), scenario)[0])
        assert decode(encode(observation), Observation) == observation
        fastest = max(fastest, abs(done.v))
    assert fastest > 3e6


# --- claims -------------------------------------------------------------------------------------------


def claims(tick: int, robot: str, pose: Pose, covariance: Covariance | None = None) -> Command:
    return Command(tick, robot, 0.0, 0.0, 3, "localised", Localised(pose, covariance))


def moved_on(world: World, commands: dict[str, Command]) -> World:
    onward = advance(world, commands)
    assert isinstance(onward, World)
    return onward


def test_a_claim_is_compared_with_the_true_pose_at_its_tick() -> None:
    """Actuation noise with a floor moves it on while it waits for the verdict of its peer."""
    at_first = release(near("actuation = {v_floor = 0.1}"))
    a, b = at_first.truth.poses
    later = moved_on(at_first, {"a": claims(0, "a", a), "b": sent(0.0, 0.0, "b")})
    now_a, now_b = later.truth.poses
    assert math.hypot(now_a.x - a.x, now_a.y - a.y) > 1e-3
    assert advance(later, {"b": claims(1, "b", now_b)}) == MissionEnd(1, "localised")
    stale = advance(later, {"b": claims(1, "b", b)})
    assert isinstance(stale, MissionEnd)
    assert stale.outcome == "wrong"
    gives_up = Command(1, "b", 0.0, 0.0, 3, "undecided", Undecided("no way"))
    assert advance(later, {"b": gives_up}) == MissionEnd(
        1, "undecided", (Cause("undecided", ("b",), text="no way"),)
    )


def test_a_claim_is_wrong_beyond_five_of_its_sigmas_and_the_reason_names_them() -> None:
    world = release(near("anchor_sigma = 0.01"))
    a, b = world.truth.poses
    sure = Covariance(0.0009, 0.0, 0.0, 0.0016, 0.0, 0.0004)  # 0.05 m, 0.02 rad
    for off, turned, outcome in (
        (0.249, 0.0, None),
        (0.251, 0.0, "wrong"),
        (0.0, 0.099, None),
        (0.0, 0.101, "wrong"),
    ):
        claim = Pose(a.x + off, a.y, a.heading + turned)
        onward = advance(world, {"a": claims(0, "a", claim, sure), "b": claims(0, "b", b)})
        assert isinstance(onward, MissionEnd)
        assert onward.outcome == (outcome or "localised")
        assert outcome is None or str(reason_for(onward)).endswith("rad off, with sigmas 0.05 m and 0.02 rad")


# --- the recording ---------------------------------------------------------------------------------------

NOISES = {
    "wheels": "actuation = {v = 0.01, omega = 0.02}",
    "gaps": "outliers = 0.02\ndrop_outs = 0.1",
    "everything": "anchor_sigma = 0.01\nmutual_sigma = 0.02\noutliers = 0.05\ndrop_outs = 0.05\n"
    "actuation = {v = 0.02, omega_floor = 1e-3}\nodometry = {v_floor = 1e-3, omega = 0.05}",
}
by_noise = pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES)


def noisy(noise: str, folder: Path) -> Path:
    """Write a scenario file with random starts, and return its path."""
    file = folder / "noisy.toml"
    file.write_text(
        f'name = "noisy"\n{SECTION_IV}[mission.noise]\n{noise}\n'
        '[[robot]]\nid = "a"\nanchor = [0.0, 0.0]\n[[robot]]\nid = "b"\nanchor = [10.0, 0.0]\n'
    )
    return file


@by_noise
@pytest.mark.parametrize("seed", series(["10", "11"]))
def test_processes_leave_the_same_bytes_as_one_process(noise: str, seed: str, tmp_path: Path) -> None:
    file = noisy(noise, tmp_path)
    for out, mode in (("processes", []), ("one", ["--in-process"])):
        ended = tandem("run", file, "--seed", seed, "-q", "--out", tmp_path / out, *mode)
        assert ended.status in (0, 1), ended
        assert ended.err == ""
    one, other = tmp_path / "processes", tmp_path / "one"
    assert len(journals(one)) == 3
    assert decided(one) == decided(other)
    told = [json.loads((folder / "summary.json").read_text()) for folder in (one, other)]
    assert [summary.pop("mode") for summary in told] == ["processes", "in-process"]
    assert all(summary.pop("wall_s") > 0.0 for summary in told)
    assert told[0] == told[1]


def driven(scenario: Scenario, folder: Path, ticks: int) -> tuple[list[Truth], list[list[Observation]]]:
    """Return the truth and observations of robots with fixed commands; the world's journal is in `folder`."""
    with closing(journal_file.Journal(folder / WORLD_JOURNAL)) as kept:
        simulation = Simulation(scenario, kept)
        truths, told = [], []
        for tick in range(ticks):
            truths.append(simulation.world.truth)
            told.append(simulation.observations())
            v, omega = math.cos(tick), math.sin(3.0 * tick)
            ended = simulation.command(
                {robot.id: sent(v, omega, robot.id, tick) for robot in scenario.robots}
            )
            assert ended is None
        simulation.end(MissionEnd(ticks, "undecided"))
    return truths, told


@by_noise
def test_ticks_gives_what_was_driven_and_measured(noise: str, tmp_path: Path) -> None:
    """It contains the true v and omega, and the ranges with noise that the robots received."""
    scenario = near(noise)
    _, told = driven(scenario, tmp_path, 60)
    rows = list(csv.DictReader(ticks_csv(read(tmp_path)).splitlines()))
    assert len(rows) == 2 * len(told)
    for i in range(2):
        own, senses_of = rows[i::2], [sensed[i] for sensed in told]
        for row, observation in zip(own, senses_of, strict=True):
            peer = observation.contacts[0].range if observation.contacts else None
            assert row["anchor_range"] == shortest(observation.anchor_range)
            assert row["mutual_range"] == shortest(peer)
        for now, after in pairwise(own):
            start = Pose(*(float(now[name]) for name in ("x", "y", "heading")))
            end = step(start, float(now["v"]), float(now["omega"]), scenario.mission.period)
            assert (end.x, end.y) == pytest.approx((float(after["x"]), float(after["y"])), abs=1e-9)


def shortest(value: float | None) -> str:
    return "" if value is None else repr(value)


def test_ticks_has_the_motion_of_a_robot_without_a_command() -> None:
    """In real time, a robot with a late Command is stopped, but a noise floor still moves it."""
    scenario = near("actuation = {v_floor = 0.1}", max_ticks=1)
    world = release(scenario)
    onward = moved_on(world, {})
    recording = Run(WorldHistory(of_world(), scenario, (Tick(world, {}), Tick(onward, {})), None, None))
    first, *_, last = csv.DictReader(ticks_csv(recording).splitlines())
    assert onward.executed is not None
    assert float(first["v"]) == onward.executed[0].v != 0.0
    assert last["v"] == ""
