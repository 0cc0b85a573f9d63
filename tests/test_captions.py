"""The captions of a mission say what happened, for every outcome."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

import pytest
from msgspec.structs import replace

from compose.launch import in_process
from compose.recording.run import Run, read
from compose.recording.run_setup import RunSetup
from compose.scenario.scenario_file import load, parse, setting
from compose.scenario.shipped_files import shipped
from compose.view.captions import FAULTS, Caption, captions
from compose.view.recorded import run_data, scenes_of
from compose.view.run_data import TickData
from compose.view.scene import Scene, scene
from protocol.attack import Attack
from protocol.messages import Cause, Contact, Inconsistent, Localised, MissionEnd, Outcome, Undecided
from tests.commands import SECTION_IV
from world.faults import Fault, LinkSelector
from world.scenario import Scenario

Record = Callable[[Scenario], Run]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Scenario], Run]:
    """Return a function that runs a scenario; its recording has the robots' estimates."""

    def record(scenario: Scenario) -> Run:
        folder = tmp_path_factory.mktemp("recorded")
        in_process.run_mission(scenario, folder)
        return read(folder)

    return record


@pytest.fixture(scope="module")
def paper_1(recorded: Record) -> Run:
    return recorded(load("paper-1"))


def told(run: Run) -> list[tuple[int, str]]:
    return [(scene.tick, caption.text) for scene in scenes_of(run) for caption in scene.captions]


def test_the_story_of_paper_1_has_a_caption_for_each_of_its_beats(paper_1: Run) -> None:
    assert told(paper_1) == [
        (
            0,
            "Each robot knows where the anchors are and how it moves, "
            "but not where it is or which way it heads.",
        ),
        (
            0,
            "A robot measures how far away its anchor or the other robot is, up to 3 m, "
            "but not in which direction.",
        ),
        (
            1,
            "After a straight drive and a second distance, b has two hypotheses of the pose relative to its "
            "anchor, mirror images of each other.",
        ),
        (
            2,
            "b had two hypotheses of its pose relative to its anchor. "
            "The distance now measured, 1.69 m, rules out one of them.",
        ),
        (
            5,
            "After a short drive, each robot knows its path relative to its anchor, "
            "but the whole path may be turned around the anchor by any angle.",
        ),
        (
            5,
            "They drive on circles around their anchors to find each other, b more slowly than a, "
            "so that sooner or later both are near where the circles cross.",
        ),
        (
            46,
            "a and b meet. Their distance is 2.95 m. They exchange reports of their paths. "
            "a drives on to measure a second distance, while b stands still.",
        ),
        (
            47,
            "The distance was 2.95 m and is 2.11 m now. "
            "Four hypotheses fit, each with one angle, and so one pose, of a and one of b.",
        ),
        (
            47,
            "Now a stands still and b drives to where the four predict distances that differ most: "
            "then the next measured distance can tell which one is true.",
        ),
        (
            48,
            "The distance is 2.39 m now. "
            "Hypotheses that predicted another distance are ruled out, one by one.",
        ),
        (48, "Only one of the four hypotheses is left."),
        (48, "Both are localised: each knows its position and its heading."),
    ]
    truths = [one.truth for scene in scenes_of(paper_1) for one in scene.captions if one.truth]
    assert truths == [
        "The simulated sensors are exact.",
        "The claimed positions are off by less than 1 µm: the simulated sensors are exact.",
    ]


@pytest.mark.long
def test_under_noise_captions_speak_of_estimates_and_probabilities(recorded: Record) -> None:
    run = recorded(load("noisy", seed=1))
    text = " ".join(text for _, text in told(run))
    assert "After a short drive, each robot has an estimate of its path" in text
    assert "a drives on a circle around its anchor to find b, which waits near its own." in text
    assert re.search(r"the most probable with \d\d %\.", text)
    assert "Both drive to where the next distances are expected to distinguish them" in text
    assert "Only one of the two hypotheses is left. It is not claimed yet." in text
    assert "roughly how it moves" in text
    assert "The hypothesis that does not fit it is ruled out." in text
    assert "exact" not in " ".join(sentences(scenes_of(run)))
    assert text.endswith("Both are localised: each knows its position and its heading.")


def test_robots_that_lose_contact_are_told_to_meet_again(recorded: Record) -> None:
    text = [text for _, text in told(recorded(load("noisy", seed=779)))]
    left = text.index("They have left each other's range.")
    assert text[left + 1].startswith("a and b are in range of each other again.")
    assert text[left + 2].startswith("Two hypotheses fit, each with one pose of a and one of b")


def test_a_detected_attack_is_told_as_a_contradiction_and_named_with_the_truth_only(recorded: Record) -> None:
    scenario = parse(shipped()["random"].read_text(), "random", seed=1)
    robots = tuple(
        replace(one, attack=Attack("scale", 0.5, "orbit") if one.id == "a" else None)
        for one in scenario.robots
    )
    run = recorded(replace(scenario, robots=robots))
    captions = [caption for scene in scenes_of(run) for caption in scene.captions]
    assert captions[-2].text.startswith("b found an inconsistency in the reports of a: ")
    assert captions[-1].text == "The mission ends inconsistent."
    assert [one.truth for one in captions if one.truth and "false data" in one.truth] == [
        "The simulated sensors are exact. a will report false data about itself.",
        "a does report false data about itself. Believed, a would be 4.40 m off.",
    ]
    assert not any("localised" in one.text or "false data" in one.text for one in captions)


def test_a_partition_is_told_when_it_begins_and_with_the_truth_only(recorded: Record) -> None:
    run = recorded(load("paper-1", faults=["b->a: partition=true, ticks=2..5"]))
    cuts = [(one.tick, cut) for one in scenes_of(run) for cut in one.captions if cut.kind == "cut"]
    assert cuts == [
        (2, Caption("cut", "", truth="From now on, no report from b to a arrives before tick 5."))
    ]


def test_kills_and_faults_of_every_kind_are_told(recorded: Record) -> None:
    run = recorded(load("random", seed=3, faults=["loss=0.3, delay=0..3, duplicate=0.5, corrupt=0.3"]))
    assert run.setup is not None
    kinds = {caption.kind for one in scenes_of(run) for caption in one.captions}
    assert kinds >= {"report-lost", "report-damaged", "report-late", "report-doubled"}
    data = run_data(run)
    before, now = data.ticks[46], data.ticks[47]
    killed = replace(now, down={"a", None}, back={"a"}, replayed={"a": 47}, late={"b"})
    told = [(one.text, one.robots) for one in scene(run.setup, before, killed).captions if one.kind in FAULTS]
    assert told[:4] == [
        ("a is down: its process is gone.", ("a", "b")),
        ("a is back: its process replayed 47 ticks, identical.", ("a", "b")),
        ("b misses the deadline and stops for this tick.", ("a", "b")),
        ("The world is down: its process is gone.", ()),
    ]


def test_the_phases_and_states_of_a_planner_of_the_user_are_shown_as_they_are(recorded: Record) -> None:
    run = recorded(setting("paper-1", planner="tests.own_planners:Wrapping").scenario)
    scenes = scenes_of(run)
    begun = [one.text for shown in scenes for one in shown.events if one.kind == "phase"]
    assert set(begun) == {f"{robot} begins phase {phase}" for robot in "ab" for phase in (1, 2, 3)}
    assert {one.player("a").activity for one in scenes[:-1]} >= {"a: radial", "a: waiting"}
    kinds = {caption.kind for one in scenes for caption in one.captions}
    assert kinds.isdisjoint({"mirrored", "path", "search", "manoeuvre"})
    assert kinds >= {"rules", "ranging", "contact", "configurations", "ruled-out", "end"}


def test_what_each_robot_of_a_pair_finds_at_another_time_is_told_of_it_alone(recorded: Record) -> None:
    run = recorded(load("random", seed=3, faults=["loss=0.5, delay=0..3"]))
    text = " ".join(text for _, text in told(run))
    for one in (
        "a's report of tick 57 to b is lost.",
        "For a, two hypotheses fit, each with one angle, and so one pose, of a and one of b.",
        "For b, two hypotheses fit, each with one angle, and so one pose, of a and one of b.",
        "For b, only one of the two hypotheses is left.",
        "b claims to know its pose.",
    ):
        assert one in text


def test_each_pair_of_several_has_its_captions_and_the_end_counts_all(recorded: Record) -> None:
    robots = "".join(
        f'[[robot]]\nid = "{role}{i}"\npeer = "{peer}{i}"\nanchor = [{x}, {25.0 * i}]\n'
        for i in range(2)
        for role, peer, x in (("a", "b", 0.0), ("b", "a", 10.0))
    )
    scenes = scenes_of(recorded(parse(f'name = "four"\nseed = 5\n{SECTION_IV}{robots}', "four")))
    for pair in (("a0", "b0"), ("a1", "b1")):
        kinds = [one.kind for scene in scenes for one in scene.captions if one.robots == pair]
        assert kinds[0] == "rules"
        assert any(
            one.text.startswith(f"{pair[0]} and {pair[1]} are one of 2 pairs. ") for one in scenes[0].captions
        )
        assert "contact" in kinds
        assert "ruled-out" in kinds
    assert (
        scenes[-1].captions[-1].text == "All 4 robots are localised: each knows its position and its heading."
    )
    assert scenes[-1].captions[-1].robots == ()


# --- endings and ticks that paper-1 does not have -----------------------------------------------------


def last(run: Run, **changes: object) -> tuple[RunSetup, TickData, TickData]:
    """Return the setup of a run, and the data of its last two ticks, the last one with `changes`."""
    assert run.setup is not None
    ticks = run_data(run).ticks
    return run.setup, ticks[47], replace(ticks[48], **changes)


def with_verdicts(now: TickData, **verdicts: object) -> TickData:
    commands = {
        robot: replace(command, verdict=verdicts.get(robot)) for robot, command in now.commands.items()
    }
    return replace(now, commands=commands)


@pytest.mark.parametrize(
    ("outcome", "cause", "text"),
    [
        (
            "undecided",
            Cause("undecided", ("b",), text="too few ranges"),
            "The mission ends undecided: b: too few ranges.",
        ),
        (
            "wrong",
            Cause("wrong", ("a",), (2.0, 0.1)),
            "The mission ends with a wrong claim: a claims a pose that is 2 m and 0.1 rad off.",
        ),
        ("failed", Cause("failed", text="no answer of b"), "The mission fails: no answer of b."),
        (
            "undecided",
            Cause("max-ticks", ("a", "b")),
            "The mission ends undecided: the time is up, and a and b are not localised.",
        ),
        ("localised", None, "Both are localised: each knows its position and its heading."),
    ],
)
def test_only_an_end_that_is_localised_says_so(
    paper_1: Run, outcome: Outcome, cause: Cause | None, text: str
) -> None:
    setup, before, now = last(paper_1)
    end = MissionEnd(48, outcome, () if cause is None else (cause,))
    told = [one.text for one in captions(setup, before, now, (), end)]
    assert told[-1] == text
    assert ("Both claim to know their poses." in told) == (outcome != "localised")


def test_a_link_that_delivers_nothing_is_named_at_the_end_with_the_truth(paper_1: Run) -> None:
    setup, before, now = last(paper_1)
    end = MissionEnd(48, "undecided", (Cause("max-ticks", ("b",)),))
    lost = Fault(link=LinkSelector("a", "b", both=False), loss=1.0)
    for faults, text in (
        ((lost,), "No report from a to b ever arrives."),
        ((Fault(partition=True),), "No report from a to b or from b to a ever arrives."),
        ((replace(lost, ticks=(0, 5)),), None),
        ((replace(lost, loss=0.9),), None),
    ):
        *_, told = captions(replace(setup, faults=faults), before, now, (), end)
        assert told.text == "The mission ends undecided: the time is up, and b is not localised."
        assert (told.truth or "").startswith(text or "The claimed positions are off by")


def test_a_robot_that_stops_without_a_claim_is_told_with_its_reason(paper_1: Run) -> None:
    setup, before, now = last(paper_1)
    pose = now.commands["b"].verdict
    assert isinstance(pose, Localised)
    now = with_verdicts(now, a=Undecided("too few ranges"), b=pose)
    told = [one.text for one in scene(setup, before, now).captions]
    assert told[-2:] == ["b claims to know its pose.", "a is undecided: too few ranges."]


def test_a_contradiction_is_not_blamed_on_an_honest_robot(paper_1: Run) -> None:
    setup, before, now = last(paper_1)
    now = with_verdicts(now, b=Inconsistent("its path"))
    told = [one for one in scene(setup, before, now).captions if one.kind == "inconsistent"]
    assert told == [
        Caption(
            "inconsistent",
            "b found an inconsistency in the reports of a: its path.",
            ("a", "b"),
            "No robot reports false data.",
        )
    ]


def test_without_a_range_or_an_answer_captions_claim_neither(paper_1: Run) -> None:
    setup, before, now = last(paper_1)
    known = run_data(paper_1).ticks
    dropped = {
        robot: replace(one, contacts=tuple([Contact(two.peer, None, ()) for two in one.contacts]))
        for robot, one in known[46].observations.items()
    }
    (meeting,) = captions(setup, known[45], replace(known[46], observations=dropped), (), None)
    assert meeting.text == "a and b meet. The distance between them is not measured in this tick."
    lacking: tuple[dict[str, object], ...] = (
        {"commands": {}},
        {"estimates": {}},
        {"observations": {}},
        {"truth": {}},
    )
    for missing in lacking:
        list(captions(setup, before, replace(now, **missing), (), None))
        list(captions(setup, replace(before, **missing), now, (), None))
    assert not list(captions(setup, None, TickData(0), (), None))


def test_no_configuration_and_more_configurations_are_told(paper_1: Run) -> None:
    setup, before, now = last(paper_1)
    held = before.estimates
    none = {robot: replace(one, world=()) for robot, one in held.items()}
    assert texts(setup, before, replace(now, estimates=none))[1] == (
        "No hypothesis fits what was measured and reported any more."
    )
    two = {robot: replace(one, world=one.world[:2]) for robot, one in held.items()}
    assert texts(setup, replace(before, estimates=two), replace(now, estimates=held))[0] == (
        "Four hypotheses fit now, instead of two."
    )


def texts(setup: RunSetup, before: TickData, now: TickData) -> list[str]:
    return [one.text for one in captions(setup, before, now, (), None)]


def sentences(scenes: tuple[Scene, ...]) -> Iterator[str]:
    for one in scenes:
        for caption in one.captions:
            yield caption.text
            if caption.truth:
                yield caption.truth


def test_every_caption_is_made_of_whole_sentences(paper_1: Run) -> None:
    for text in sentences(scenes_of(paper_1)):
        assert text.endswith(".")
        assert ".." not in text
