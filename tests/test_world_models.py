"""Range and radio models: what they deliver, in all modes, and with the faults of the fault plan."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from msgspec.structs import replace

import tandem
from compose.errors import BadScenario, Unworkable
from compose.launch import in_process
from compose.scenario.scenario_file import scenario_table, trust_classes, validate
from protocol.journal.journal_file import MemoryJournal
from tests.commands import tandem as command
from tests.own_models import Late
from tests.series import series
from world.radio_models import ByteRateRadio, CollidingRadio, FadingRadio, LogDistanceRadio, WalledRadio
from world.range_models import AttackedRange, FadingRange, WalledRange
from world.scenario import Scenario
from world.world_models import RadioModel, Radios, RangeModel, Transmission

OWN = "tests.own_models"
WALL = [[5.0, -100.0, 5.0, 100.0]]


def scenario_of(name: str, **world: Any) -> Scenario:
    """Return a shipped scenario with other tables in `[world]`."""
    table = {**scenario_table(name), "planner": {"name": "assured"}, "world": world}
    trust_classes(table)
    return validate(table, name).scenario


def radios(distance: float, tick: int = 0, name: str = "report/a->b") -> Radios:
    return Radios(name, (0.0, 0.0), (distance, 0.0), tick, 1)


def sent(model: RadioModel[Any], distance: float, ticks: int) -> list[int | None]:
    """Return the delays of reports over `distance` m, one per tick; R is 10 m, and a tick 1 s."""
    state, found = model.start(), []
    for tick in range(ticks):
        one = Transmission(radios(distance, tick), 10.0, 1.0, (("a", (0.0, 0.0)),), "a")
        state, delay = model.sent(state, one)
        found.append(delay)
    return found


def part_received(model: RadioModel[Any], distance: float, ticks: int = 2000) -> float:
    return sum(one is not None for one in sent(model, distance, ticks)) / ticks


# --- the shipped models -------------------------------------------------------------------------------


def test_loss_grows_with_distance() -> None:
    model = FadingRadio(near=0.1, far=0.9, exponent=1.0)
    for distance, expected in ((0.0, 0.9), (5.0, 0.5), (10.0, 0.1)):
        assert part_received(model, distance) == pytest.approx(expected, abs=0.04)


def test_half_of_the_reports_are_received_at_half_without_shadowing() -> None:
    model = LogDistanceRadio(exponent=3.0, half=0.8, shadowing_db=0.0, fading_db=4.0)
    assert part_received(model, 8.0) == pytest.approx(0.5, abs=0.04)
    margin = -30.0 * math.log10(10.0 / 8.0) / 4.0
    assert part_received(model, 10.0) == pytest.approx(0.5 * math.erfc(-margin / math.sqrt(2.0)), abs=0.04)


def test_shadowing_is_the_same_in_all_ticks_of_a_link() -> None:
    model = LogDistanceRadio(shadowing_db=10.0, fading_db=0.0)
    links = [sent(model, 8.0, 5)]
    assert all(len(set(link)) == 1 for link in links)
    received = [
        model.sent(None, Transmission(radios(8.0, 0, f"report/{i}->b"), 10.0, 1.0, (), "a"))[1] == 0
        for i in range(400)
    ]
    assert 150 < sum(received) < 250


def test_reports_queue_at_a_limited_byte_rate_and_are_lost_beyond_the_queue() -> None:
    model = ByteRateRadio(bytes_per_s=100.0, report_bytes=150.0, longest_queue=3)
    delays = sent(model, 1.0, 12)
    assert delays[:7] == [1, 2, 2, 3, 3, None, 3]
    assert sent(ByteRateRadio(bytes_per_s=100.0, report_bytes=50.0), 1.0, 5) == [0] * 5


def test_two_senders_in_one_slot_destroy_each_other() -> None:
    model, senders = CollidingRadio(slots=4), (("a", (0.0, 0.0)), ("b", (5.0, 0.0)))
    lost = 0
    for tick in range(2000):
        ways = [
            model.sent(None, Transmission(radios(5.0, tick, f"report/{robot}->x"), 10.0, 1.0, senders, robot))
            for robot in "ab"
        ]
        assert ways[0] == ways[1]
        lost += ways[0][1] is None
    assert lost / 2000 == pytest.approx(0.25, abs=0.04)
    far = (("a", (0.0, 0.0)), ("c", (100.0, 0.0)))
    assert all(
        model.sent(None, Transmission(radios(5.0, tick), 10.0, 1.0, far, "a"))[1] == 0 for tick in range(99)
    )


def test_a_wall_blocks_what_crosses_it() -> None:
    through, beside = radios(10.0), Radios("report/a->b", (0.0, 0.0), (4.0, 0.0), 0, 1)
    for model in (WalledRange(WALL), WalledRange(WALL, contact=True)):
        assert model.detects(beside, 20.0)
        assert model.measured(beside, 4.0) == 4.0
    assert not WalledRange(WALL).detects(through, 20.0)
    assert WalledRange(WALL, contact=True).detects(through, 20.0)
    assert WalledRange(WALL, contact=True).measured(through, 10.0) is None
    radio = WalledRadio(WALL)
    assert sent(radio, 10.0, 1) == [None]
    assert sent(radio, 4.0, 1) == [0]
    with pytest.raises(ValueError, match=r"segments\[0\] has 2 numbers"):
        WalledRadio([[1.0, 2.0]])


def test_an_attack_changes_the_ranges_of_one_link_while_it_lasts() -> None:
    link = radios(10.0, 5, "mutual/a")
    longer = AttackedRange("mutual/a", by=1.5, relay=2.0, begins=5, ends=6)
    assert (longer.detects(link, 8.0), longer.measured(link, 9.9)) == (True, 11.4)
    assert not longer.detects(link, 7.9)
    for other in (radios(10.0, 4, "mutual/a"), radios(10.0, 6, "mutual/a"), radios(10.0, 5, "anchor/a")):
        assert (longer.detects(other, 8.0), longer.measured(other, 9.9)) == (False, 9.9)
    assert AttackedRange("mutual/a", by=-20.0).measured(link, 9.9) == 0.0
    assert AttackedRange("mutual/a", jam=True).measured(link, 9.9) is None
    with pytest.raises(ValueError, match="relay -1 not from 0"):
        AttackedRange("mutual/a", relay=-1.0)


def test_detection_fades_between_full_and_r() -> None:
    model = FadingRange(full=0.5, exponent=1.0)
    for distance, expected in ((4.0, 1.0), (7.5, 0.5), (10.0, 0.0), (11.0, 0.0)):
        found = sum(model.detects(radios(distance, tick), 10.0) for tick in range(2000)) / 2000
        assert found == pytest.approx(expected, abs=0.04)


# --- missions -----------------------------------------------------------------------------------------


def journals(scenario: Scenario) -> list[list[bytes]]:
    sinks = {name: MemoryJournal() for name in in_process.journals(scenario)}
    in_process.played(scenario, sinks)
    return [sinks[name].frames for name in sorted(sinks)]


def test_the_disc_is_what_the_world_does_without_a_model() -> None:
    with_disc = scenario_of("noisy", range={"model": "disc"}, radio={"model": "disc"})
    without = scenario_of("noisy")
    agents, plain = journals(with_disc)[:2], journals(without)[:2]
    assert agents == plain


MODELS: dict[str, dict[str, Any]] = {
    "fading": {"range": {"model": "fading", "options": {"full": 0.6}}, "radio": {"model": "fading"}},
    "log-distance": {"radio": {"model": "log-distance"}},
    "byte-rate": {"radio": {"model": "byte-rate", "options": {"bytes_per_s": 200}}},
    "collisions": {"radio": {"model": "collisions"}},
    "walls": {"radio": {"model": "walls", "options": {"segments": [[4.0, -9.0, 4.0, 0.5]]}}},
    "own": {
        "range": {"model": f"{OWN}:Long"},
        "radio": {"model": f"{OWN}:Late", "options": {"every": 4}},
    },
}


@pytest.mark.parametrize("name", series(MODELS, 0))
def test_missions_are_audited_without_a_violation(name: str) -> None:
    table = {**scenario_table("noisy"), "world": MODELS[name]}
    mission = table["mission"]
    table["mission"] = {**mission, "noise": {**mission["noise"], "drop_outs": 0.1}}
    run = tandem.run(table, faults="loss=0.1, delay=0..1")
    assert run.audit().violations == ()
    checks = {one.rule: one.checks for one in run.audit().counts}
    assert checks["observation"] > 0


def toml(folder: Path, name: str) -> Path:
    import tomli_w  # noqa: PLC0415

    path = folder / "scenario.toml"
    path.write_text(tomli_w.dumps({**scenario_table("noisy"), "world": MODELS[name]}))
    return path


@pytest.mark.parametrize("name", series(["own", "byte-rate"]))
@pytest.mark.long
def test_processes_and_killed_processes_write_the_same_journals(name: str, tmp_path: Path) -> None:
    scenario = toml(tmp_path, name)
    for out, flags in (
        ("one", ("--in-process",)),
        ("many", ("--kill", "world@20", "--kill", "a@25:report")),
    ):
        ended = command("run", scenario, *flags, "--fault", "loss=0.1", "--out", tmp_path / out)
        assert ended.status in (0, 1), ended
    for path in (tmp_path / "one").glob("*.journal"):
        assert path.read_bytes() == (tmp_path / "many" / path.name).read_bytes()
    own = ("--model", f"{OWN}:Long", "--model", f"{OWN}:Late") if name == "own" else ()
    for verb in ("audit", "replay"):
        assert command(verb, tmp_path / "many", *own).status == 0
    if own:
        refused = command("audit", tmp_path / "many")
        assert refused.status == 2
        assert f"the world uses the model {OWN}:Long; to run its code, add --model {OWN}:Long" in refused.err


def test_robots_behind_a_wall_measure_and_do_not_talk() -> None:
    walls = [[float(x), -100.0, float(x), 100.0] for x in range(-10, 30)]
    walled = scenario_of("random", radio={"model": "walls", "options": {"segments": walls}})
    free = scenario_of("random")
    runs = [in_process.run_mission(replace(one, max_ticks=60)) for one in (walled, free)]
    heard = [
        sum(len(c.heard or ()) for tick in run.observations for one in tick.values() for c in one.contacts)
        for run in runs
    ]
    assert heard[0] < heard[1]


@pytest.mark.parametrize(
    ("world", "says"),
    [
        ({"radio": {"model": "fadng"}}, "world.radio.model: there is no 'fadng'; there are disc, fading"),
        (
            {"radio": {"model": "fading", "options": {"ner": 1}}},
            "world.radio.options: fading cannot be created",
        ),
        ({"radio": {"model": f"{OWN}:Late", "options": {"every": 1}}}, "ValueError: every is at least 2"),
        ({"radio": {"model": f"{OWN}:Long"}}, "is not a subclass of tandem.models.RadioModel"),
        ({"range": {"model": "os:system"}}, "os:system is not a range model or a radio model"),
        ({"range": {"model": "nowhere:Model"}}, "world.range.model: nowhere:Model: there is no module"),
    ],
)
def test_a_wrong_model_is_one_line(world: dict[str, Any], says: str) -> None:
    with pytest.raises(BadScenario) as bad:
        scenario_of("noisy", **world)
    assert says in str(bad.value)
    assert "\n" not in str(bad.value)


@pytest.mark.parametrize("mode", [("--in-process",), ()])
@pytest.mark.parametrize(
    ("world", "says"),
    [
        ({"radio": {"model": f"{OWN}:Failing"}}, f"the model {OWN}:Failing: sent() raises KeyError: 'first'"),
        ({"range": {"model": f"{OWN}:Exiting"}}, f"the model {OWN}:Exiting: measured() raises SystemExit: 4"),
    ],
)
def test_a_model_that_raises_an_error_is_one_line(
    world: dict[str, Any], says: str, mode: tuple[str, ...], tmp_path: Path
) -> None:
    path = tmp_path / "own.toml"
    path.write_text(tomli_w.dumps({**scenario_table("noisy"), "world": world}))
    ended = command("run", path, "-q", *mode)
    assert ended.status == 3
    assert says in ended.err
    assert ended.err.count("\n") == 1


def test_a_range_model_needs_noise_that_the_robots_are_told() -> None:
    with pytest.raises(Unworkable, match=r"world\.range: the robots are told that all sensors are exact"):
        scenario_of("random", range={"model": "fading"})


def test_contracts_are_discs() -> None:
    assert RangeModel().detects(radios(10.0), 10.0)
    assert not RangeModel().detects(radios(10.1), 10.0)
    assert sent(RadioModel(), 100.0, 2) == [0, 0]


def test_a_sweep_runs_and_audits_missions_with_a_model_of_the_user() -> None:
    results = tandem.sweep("random", {"world.radio.model": [Late, "disc"]}, trials=2, workers=1)
    assert list(results.trials["outcome"]) == ["localised"] * 4
    assert list(results.trials["violations"]) == [0] * 4
    assert sum(results.trials["reports_lost"][:2]) > sum(results.trials["reports_lost"][2:])
