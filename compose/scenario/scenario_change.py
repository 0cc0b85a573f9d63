"""A recorded scenario as the content of a scenario file again, with another geometry, R, noise or loss."""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec
from msgspec.structs import fields, replace

from compose.errors import BadScenario, UserError, no_such
from compose.launch import planner_loader
from compose.scenario.scenario_file import template_of
from compose.scenario.scenario_tables import LONGEST_NAME
from protocol.noise import Noise
from protocol.units import Finite, RobotId
from world.faults import Fault
from world.scenario import PlacedAnchor, Scenario

SUFFIX = "-changed"
"""The end of the name of a changed scenario."""


class RobotChange(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The start and the anchor of one robot."""

    x: Finite
    """The x coordinate of the start in <W>, in m."""
    y: Finite
    """The y coordinate of the start in <W>, in m."""
    heading: Finite
    """The heading at the start, in rad."""
    anchor_x: Finite | None = None
    """The x coordinate of the anchor in <W>, in m; None in a team, like the y coordinate."""
    anchor_y: Finite | None = None
    """The y coordinate of the anchor in <W>, in m."""


class ScenarioChange(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The values of a scenario that can be changed."""

    robots: dict[RobotId, RobotChange]
    """The starts and anchors by robot. A robot that is left out, or has no anchor, keeps its own start."""
    sensing_range: Finite
    """The sensing range R, in m."""
    sigma: Finite
    """The standard deviation of all ranges, in m; 0 for a mission without any noise."""
    loss: Finite
    """The probability that a report is lost, on all links."""


class ChangedScenario(NamedTuple):
    """A scenario with other values."""

    table: dict[str, Any]
    """The content of its scenario file."""
    scenario: Scenario


def values_of(scenario: Scenario) -> ScenarioChange:
    """Return the values that `scenario` has. Sigma is the larger one of ranges to anchors and to robots.

    Raises UserError if it cannot be run again because this process may not load its planner.
    """
    if not planner_loader.is_shipped(scenario.planner_name):
        planner_loader.planner_class(scenario.planner_name)
    noise = scenario.mission.noise
    place = _place_of_loss(scenario.faults)
    return ScenarioChange(
        robots={
            one.id: RobotChange(
                one.start.x, one.start.y, one.start.heading, at.x if at else None, at.y if at else None
            )
            for one in scenario.robots
            if (at := one.given_anchor) is not None or one.encounter is None
        },
        sensing_range=scenario.mission.sensing_range,
        sigma=max(noise.anchor_sigma, noise.mutual_sigma),
        loss=0.0 if place is None else scenario.faults[place].loss,
    )


def changed(scenario: Scenario, change: ScenarioChange, most_ticks: int) -> ChangedScenario:
    """Return `scenario` with the values of `change`.

    Its last tick is computed again if that of `scenario` follows from the mission, and is at most
    `most_ticks`. Raises UserError if a value is refused, as one of a file is, or if its planner is not
    one that this process may load.
    """
    before = values_of(scenario)
    unknown = next((one for one in change.robots if one not in before.robots), None)
    if unknown is not None:
        raise UserError(f"robots: {no_such(unknown, before.robots)}")
    table = file_table(_with_values(scenario, before, change))
    for robot in table["robot"]:
        if (one := change.robots.get(robot["id"])) is not None:
            if "anchor" in robot:
                robot["anchor"] = [one.anchor_x, one.anchor_y]
            robot["start"] = [one.x, one.y, one.heading]
    if _has_default_ticks(scenario):
        del table["max_ticks"]
    found = template_of(table).scenario
    if found.max_ticks > most_ticks:
        table["max_ticks"] = most_ticks
        found = replace(found, max_ticks=most_ticks)
    return ChangedScenario(table, found)


def _with_values(scenario: Scenario, before: ScenarioChange, change: ScenarioChange) -> Scenario:
    """Return `scenario` with R, sigma and loss of `change`, not validated."""
    mission = replace(scenario.mission, sensing_range=change.sensing_range)
    given: dict[str, Any] = {}
    if change.sigma != before.sigma:
        sigma = change.sigma
        noise = replace(mission.noise, anchor_sigma=sigma, mutual_sigma=sigma) if sigma else Noise()
        mission = replace(mission, noise=noise)
        if (own := scenario.world_noise) is not None:
            given["world_noise"] = replace(own, anchor_sigma=None, mutual_sigma=None) if sigma else None
    faults = list(scenario.faults)
    if change.loss != before.loss:
        place = _place_of_loss(scenario.faults)
        if place is not None:
            del faults[place]
        if change.loss:
            faults.insert(place or 0, Fault(loss=change.loss))
    name = scenario.name.removesuffix(SUFFIX)[: LONGEST_NAME - len(SUFFIX)] + SUFFIX
    return replace(scenario, name=name, mission=mission, faults=tuple(faults), **given)


def _place_of_loss(faults: tuple[Fault, ...]) -> int | None:
    """Return the index of the fault that is only a loss on all links in all ticks; None if there is none."""
    return next((i for i, one in enumerate(faults) if replace(one, loss=0.0) == Fault()), None)


def _has_default_ticks(scenario: Scenario) -> bool:
    """Return whether the last tick of `scenario` is the one that is computed from its mission."""
    table = file_table(scenario)
    del table["max_ticks"]
    try:
        return template_of(table).scenario.max_ticks == scenario.max_ticks
    except BadScenario:
        return False


# --- the file of a scenario -----------------------------------------------------------------------------


def file_table(scenario: Scenario) -> dict[str, Any]:
    """Return the content of a scenario file that describes `scenario`, with all starts and the last tick."""
    mission = _given(scenario.mission)
    if scenario.planned_sweep is not None:
        mission["area"] = list(scenario.planned_sweep.sweep.bounds)
    if scenario.team is not None and scenario.team.origin is not None:
        mission["frame"] = "relative"
    for name in ("survey", "diameter") if scenario.team is not None else ():
        if value := getattr(scenario.team, name):
            mission[name] = value
    if scenario.tolerates:
        mission["tolerates"] = scenario.tolerates
    if scenario.mission.noise.profile is not None:  # a default would have the value of the profile
        noise = msgspec.to_builtins(scenario.mission.noise)
        mission["noise"] = {name: value for name, value in noise.items() if value is not None}
    world = {
        "noise": _given(scenario.world_noise) if scenario.world_noise is not None else {},
        "range": msgspec.to_builtins(scenario.range_model),
        "radio": msgspec.to_builtins(scenario.radio_model),
    }
    dies = {one.robot: one.tick for one in scenario.deaths}
    planner = {"name": scenario.planner_name, "options": msgspec.to_builtins(scenario.planner_options)}
    table = {
        "name": scenario.name,
        "seed": scenario.seed,
        "max_ticks": scenario.max_ticks,
        "mission": mission,
        "planner": {name: value for name, value in planner.items() if value},
        "world": {name: value for name, value in world.items() if value},
        "robot": [
            {
                "id": one.id,
                **({"peer": one.peer} if scenario.in_pairs else {}),
                **({"anchors": list(one.ranges)} if scenario.team and scenario.team.anchors else {}),
                **({"anchor": [at.x, at.y]} if (at := one.given_anchor) is not None else {}),
                "start": [one.start.x, one.start.y, one.start.heading],
                **({"attack": _given(one.attack)} if one.attack is not None else {}),
                **({"dies": dies[one.id]} if one.id in dies else {}),
            }
            for one in scenario.robots
        ],
        "anchor": [_anchor_table(one) for one in scenario.team.anchors] if scenario.team else [],
        "fault": [_fault_table(one) for one in scenario.faults],
    }
    return {name: value for name, value in table.items() if value or name == "seed"}


def _anchor_table(anchor: PlacedAnchor) -> dict[str, Any]:
    """Return the `[[anchor]]` table of `anchor`."""
    told, place = anchor.told, anchor.place
    return {
        "id": told.id,
        **({"position": [told.position.x, told.position.y]} if told.position is not None else {}),
        **({"sigma": told.sigma} if told.sigma else {}),
        "stands": [place.x, place.y],
    }


def _fault_table(fault: Fault) -> dict[str, Any]:
    """Return the `[[fault]]` table of `fault`."""
    table = _given(fault)
    if fault.link is not None:
        arrow = "<->" if fault.link.both else "->"
        table["link"] = f"{fault.link.sender}{arrow}{fault.link.receiver}"
    return table


def _given(struct: msgspec.Struct) -> dict[str, Any]:
    """Return the fields of `struct` that do not have their default, as values of TOML."""
    found: dict[str, Any] = {}
    for field in fields(type(struct)):
        value = getattr(struct, field.name)
        if value is not None and value != field.default:
            found[field.name] = _given(value) if isinstance(value, msgspec.Struct) else value
    return msgspec.to_builtins(found)  # type: ignore[no-any-return]
